"""What may be wrong in the description of a rod."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...common.array_types import Index
from ...fem.laws.constants import TORSION
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ...statistics.budget.effect import (
    SMALL,
    Effect,
    ExperimentAtAnswer,
    effect_of_constants,
    shape_effect,
    stated_names,
)
from .element import ROD_CURVATURE, RodMaterial, RodMesh, rod_material


def _size(at: ExperimentAtAnswer, _: int) -> Effect:
    """Return the effect of a section that is larger by a share, with the same masses."""
    body, larger = at.body, 1 + SMALL
    parts = [
        replace(
            part,
            material=rod_material(
                part.material.name,
                part.material.section.scaled(larger),
                part.material.natural_curvature,
            ),
        )
        for part in body.parts
        if isinstance(part.material, RodMaterial)
    ]
    geometry = body.geometry.copy()
    geometry[..., -1] *= larger**2
    thicker = body.with_parts(tuple(parts)).with_geometry(geometry)
    return Effect((at.internal_n(body=thicker) - at.internal_n()) / SMALL)


def _rest_shape(at: ExperimentAtAnswer, axis: int) -> Effect | None:
    """Return the effect of natural curvature about d₁ and d₂, and of natural twist, in units of
    `ROD_CURVATURE` over the length of the rod, also if it is stated to be straight; None if they are
    constants.
    """
    body = at.body
    assert isinstance(body.mesh, RodMesh)
    if body.natural_strain_indices:
        return None
    geometry = body.geometry.copy()
    geometry[..., -4 + axis] += ROD_CURVATURE / float(body.mesh.s_m[-1])
    return Effect(at.internal_n(body=body.with_geometry(geometry)) - at.internal_n())


def _torsion(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect of a relative error of the torsional stiffnesses that are stated."""
    values = at.parameters.values(at.iterate.q)
    units = {name: values[name] for name in stated_names(at.parameters, TORSION.name)}
    return effect_of_constants(at, units, SMALL) if units else None


def end_mass_effect(at: ExperimentAtAnswer, _: int) -> Effect:
    """Return the effect per kilogram at the free end of a rod, see `free_end`."""
    mass_kg = np.zeros(at.body.nodes_m.size)
    mass_kg[3 * free_end(at.iterate.transcription.experiment)[:, None] + np.arange(3)] = 1 / 3
    return Effect(at.weight_and_drag(mass_kg), mass_kg)


def free_end(experiment: Experiment) -> Index:
    """Return the three nodes of the end of a rod that is farther from what holds it."""
    held = np.concatenate([grasp.nodes for grasp in experiment.body_grasps])
    mesh = experiment.body.mesh
    count = len(mesh.points_m)
    return np.arange(3) if held.mean() > count / 2 else np.arange(count - 3, count)


def _length(at: ExperimentAtAnswer, _: int) -> Effect | None:
    """Return the effect of a rod that is longer by a share, with the places on it; None for another
    body.
    """
    mesh = at.body.mesh
    if not isinstance(mesh, RodMesh):
        return None
    centres_m = mesh.centres_of_sections_m
    moved_m = np.zeros_like(at.body.nodes_m)
    moved_m[: 3 * len(centres_m)] = np.repeat(centres_m - centres_m[0], 3, axis=0)
    longer = shape_effect(at, moved_m)
    assert longer.force_n is not None
    weight_n = at.weight_and_drag(at.own_mass_kg)
    return replace(longer, force_n=longer.force_n + weight_n, mass_kg=at.own_mass_kg)


ROWS = (
    Deviation(
        "torsion",
        "1",
        considered=0.2,
        description="relative error of a stated torsional stiffness of a rod",
        remedy="estimate the torsional stiffness from a motion out of a plane, or measure it",
        effect=_torsion,
    ),
    Deviation(
        "length",
        "1",
        wide=0.05,
        description="relative error of the length of a rod and of all places along it",
        remedy="measure the length of the rod and the places of the markers along it",
        effect=_length,
    ),
)
# Of rows of solids.
OTHERS = {
    "body_scale": _size,
    "rest_shape": _rest_shape,
    **dict.fromkeys(["surface", "section", "anisotropy", "memory_share"]),
}
