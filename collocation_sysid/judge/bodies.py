"""Misspecification hypotheses about the model of a body: its law, its mesh, and how the mesh was
made.

Each hypothesis is one more column of the linearised fit: the change of the residuals along the
motion of the fit if the body had another law, a round section in place of a square one or the
reverse, or if its mesh had been made under its weight. The decrease of χ² by one Gauss–Newton step
says which are worth a refit. Mirror images of the mesh are too different for a linear step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from ..common.array_types import Array
from ..errors import InputError
from ..fem.body import Body
from ..fem.laws.materials import MATERIALS, Material
from ..fem.meshes.mesh import TetMesh
from ..fem.rest_shape import UnderGravity
from ..program.collocation import ExperimentIterate
from ..recording.experiment import Experiment
from ..statistics.budget.effect import Effect, ExperimentAtAnswer
from ..statistics.budget.shape_error import GRAVITY_M_S2, other_section, sag_m
from ..statistics.budget.systematic_effects import section_effect
from .doubt import Correction, Doubt

AXES = "xyz"
# Distance of the nodes of a mirrored mesh from the mesh, over the largest extent, up to which they
# are the same shape.
SAME_SHAPE = 0.02
# Relative change of the length of an edge below which no law is told from another.
LEAST_STRAIN = 0.05
# Share of the weight in a scan that is taken as the whole weight.
WHOLE_WEIGHT = (0.4, 2.0)


def other_materials(body: Body) -> tuple[str, ...]:
    """Return the names of materials with the same constants as all parts of a body have."""
    own = {part.material for part in body.parts}
    if len(own) > 1 or body.has_memory:
        return ()
    (material,) = own
    names = [constant.name for constant in material.constants]
    return tuple(
        name
        for name, each in MATERIALS.items()
        if each is not material
        and name != "linear"
        and [constant.name for constant in each.constants] == names
    )


def with_material(body: Body, material: Material) -> Body:
    """Return a body with another material in all parts."""
    return body.with_parts(tuple(replace(part, material=material) for part in body.parts))


def body_rows(part: ExperimentIterate) -> Iterator[Doubt]:
    """Yield the rows of other laws and shapes of the body of a fitted experiment; none with
    obstacles, whose frames are nodes of the body, or without a grasp. Other materials only if edges
    of the mesh change by `LEAST_STRAIN`.
    """
    experiment = part.transcription.experiment
    body = experiment.body
    if experiment.obstacles or experiment.specimen is not None or not experiment.body_grasps:
        return
    corners = np.triu_indices(4, 1)
    ends = [body.cells[:, each].ravel() for each in corners]
    rest_m, moved_m = (
        np.linalg.norm(each[..., ends[0], :] - each[..., ends[1], :], axis=-1)
        for each in (body.nodes_m, part.x.reshape(len(part.x), -1, 3))
    )
    is_strained = np.abs(moved_m / rest_m - 1).max() > LEAST_STRAIN
    for material in other_materials(body) if is_strained else ():
        yield _other_law(material)
    yield from body.kind.doubts
    if not _is_uniform(body):
        return
    if other_section(body.mesh, body.nodes.points_m) is not None:
        yield SECTION
    if not isinstance(body.rest_shape, UnderGravity):
        yield REST_SHAPE


def _other_law(name: str) -> Doubt:
    def effect(at: ExperimentAtAnswer, _: int) -> Effect:
        other = with_material(at.stress_free_body, MATERIALS[name])
        return Effect(at.internal_n(body=other) - at.internal_force_n)

    def corrected(experiment: Experiment, _: Array) -> Correction:
        other = with_body(experiment, with_material(experiment.body, MATERIALS[name]))
        return other and (other, {"material": name})

    return Doubt("law", "1", effect=effect, correct=corrected)


def _scan_effect(at: ExperimentAtAnswer, axis: int) -> Effect:
    sag = sag_m(at.body, at.theta, support_dofs=at.likely_support_dofs, axis=axis)
    return Effect(at.force_change_by_reference(sag))


def _stress_free(experiment: Experiment, amplitudes: Array) -> Correction:
    """Return None unless the mesh was made under the whole weight."""
    share = float(np.linalg.norm(amplitudes))
    if not WHOLE_WEIGHT[0] < share < WHOLE_WEIGHT[1]:
        return None
    down = amplitudes / share
    held = np.unique(np.concatenate([grasp.nodes for grasp in experiment.body_grasps]))
    scanned = UnderGravity(held, gravity_m_s2=GRAVITY_M_S2 * down)
    other = with_shape(experiment, np.ones(3), rest_shape=scanned)
    return other and (other, {"down": ", ".join(f"{each:.2f}" for each in down)})


def _of_other_section(experiment: Experiment, _: Array) -> Correction:
    other = with_other_section(experiment)
    if other is None:
        return None
    is_round = other.body.mesh.volume_m3 < experiment.body.mesh.volume_m3
    real, meshed = ("round", "square") if is_round else ("square", "round")
    return other, {"real": real, "meshed": meshed}


SECTION = Doubt(
    "mesh-section", "1", effect=lambda at, _: section_effect(at), correct=_of_other_section
)
REST_SHAPE = Doubt(
    "rest-shape", "1", _stress_free, effect=_scan_effect, axes="x y z", mean=0.0, wide=1.0
)


def _is_uniform(body: Body) -> bool:
    """Return whether the body has one part without a field, so that it can be made again."""
    return len(body.parts) == 1 and all(part.field is None for part in body.parts)


def mirrored_meshes(experiment: Experiment) -> Iterator[Doubt]:
    """Yield the rows of a mesh that is a mirror image along an axis about the middle of its grasps,
    if that is another shape.
    """
    body = experiment.body
    if (
        experiment.obstacles
        or experiment.specimen is not None
        or not experiment.body_grasps
        or not _is_uniform(body)
    ):
        return
    points_m = body.mesh.points_m
    size_m = float(np.ptp(points_m, axis=0).max())
    middle_m = _middle_of_grasps_m(experiment)
    surface = points_m[np.unique(body.mesh.surface)]
    tree = KDTree(surface)
    for axis, factors in enumerate(np.ones((3, 3)) - 2 * np.eye(3)):
        away_m = tree.query(middle_m + factors * (surface - middle_m))[0]
        if away_m.max() >= SAME_SHAPE * size_m:
            yield _mirrored(axis, factors)


def _mirrored(axis: int, factors: Array) -> Doubt:
    def corrected(experiment: Experiment, _: Array) -> Correction:
        other = with_shape(experiment, factors)
        return other and (other, {"axis": AXES[axis]})

    return Doubt("mesh-mirrored", "1", corrected)


def _middle_of_grasps_m(experiment: Experiment) -> Array:
    nodes = np.unique(np.concatenate([grasp.nodes for grasp in experiment.body_grasps]))
    return experiment.body.nodes_m[nodes].mean(axis=0)


def with_shape(
    experiment: Experiment, factors: Array, rest_shape: UnderGravity | None = None
) -> Experiment | None:
    """Return the experiment with a mesh that is multiplied by factors (3,) about the middle of its
    grasps, or also made under gravity; None if it is not valid.

    The mass stays, and so do stated places of markers.
    """
    middle_m = _middle_of_grasps_m(experiment)
    return _made_again(
        experiment,
        lambda points_m: middle_m + factors * (points_m - middle_m),
        mass_kg=experiment.body.mass_kg,
        rest_shape=rest_shape,
    )


def with_other_section(experiment: Experiment) -> Experiment | None:
    """Return the experiment with a round mesh in place of a square one of the same width or the
    reverse, see `other_section`; None if it is not valid. A declared mass stays, else the density;
    stated places of markers move with the mesh.
    """
    body = experiment.body
    own = other_section(body.mesh, body.mesh.points_m)
    if own is None:
        return None
    mapped = TetMesh(body.mesh.points_m + own.moved_m, body.mesh.tetrahedra)
    wider = np.sqrt(own.volume_ratio * body.mesh.volume_m3 / mapped.volume_m3)
    factors = np.where(own.is_across, wider, 1.0)

    def reshaped(points_m: Array) -> Array:
        other = other_section(body.mesh, points_m)
        assert other is not None
        return own.middle_m + factors * (points_m + other.moved_m - own.middle_m)

    ratio = 1.0 if body.has_declared_mass else own.volume_ratio
    return _made_again(experiment, reshaped, mass_kg=ratio * body.mass_kg)


def _made_again(
    experiment: Experiment,
    reshaped: Callable[[Array], Array],
    mass_kg: float,
    rest_shape: UnderGravity | None = None,
) -> Experiment | None:
    """Return the experiment with other points (n, 3); None if it is not valid."""
    body = experiment.body
    (part,) = body.parts
    try:
        other = Body(
            TetMesh(reshaped(body.mesh.points_m), body.mesh.tetrahedra),
            part.material,
            mass_kg=mass_kg,
            element=body.element.name,
            damping=part.damping,
            prony=part.prony,
            forces=body.forces,
            rest_shape=rest_shape or "stress_free",
        )
    except InputError:
        return None
    index = np.asarray(KDTree(other.nodes_m).query(reshaped(body.nodes.points_m))[1])
    grasps = [replace(grasp, nodes=np.unique(index[grasp.nodes])) for grasp in experiment.grasps]
    return with_body(experiment, other, grasps=grasps)


def with_body(experiment: Experiment, body: Body, **changes: object) -> Experiment | None:
    """Return the experiment with another body, on which markers without a stated place are
    placed again; None if it is not valid.
    """
    markers = experiment.markers
    places_m = np.array(markers.predict_positions(experiment.body.nodes_m))
    places_m[~markers.located] = np.nan
    unplaced = replace(markers, placement=None, located=None, places_m=places_m)
    try:
        return replace(experiment, body=body, markers=unplaced, **changes)
    except InputError:
        return None
