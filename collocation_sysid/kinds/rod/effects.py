"""What may be wrong in the description of a rod."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...common.array_types import Index
from ...fem.laws.constants import TORSION
from ...fem.rods import RodMesh
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
