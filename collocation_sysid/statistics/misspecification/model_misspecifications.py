"""Misspecification hypotheses about the model of a body: its laws, its mesh, and how the mesh was
made.

Each hypothesis is one more column of the linearised fit: the change of the residuals along the
motion of the fit if the body had another law, another width along an axis of the mesh, a round
section in place of a square one or the reverse, a finer mesh, or if its mesh had been made under its
weight. The decrease of χ² by one Gauss–Newton step says which are worth a refit (`screened_bodies`);
of a finer mesh this step is the only test. Mirror images of the mesh are too different for a linear
step.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from ...common.array_types import Array
from ...errors import InputError, SimulationError
from ...fem.body import Body
from ...fem.laws.materials import DAMPINGS, MATERIALS, DampingLaw, Material
from ...fem.meshes.mesh import TetMesh
from ...fem.rest_shape import UnderGravity
from ...methods.solution import Solution
from ...recording.deviation import Deviation
from ...recording.experiment import Experiment
from ..budget.consider_analysis import changed_residuals
from ..budget.mesh_error import LARGEST_NODE_COUNT, finer_mesh_row
from ..budget.shape_error import GRAVITY_M_S2, other_section, sag_m
from ..budget.systematic_effects import Effect, ExperimentAtAnswer, section_effect, shape_effect
from ..linearised import LinearisedFit, linearise_fit
from ..thresholds import LEAST_DECREASE, LEAST_SIGMAS, WIDEST
from .misspecification_hypothesis import Hypothesis

AXES = "xyz"
# Most hypotheses of a screening that are fitted again.
MOST_REFITS = 5
# The same of one kind.
MOST_OF_A_KIND = 2
# Distance of the nodes of a mirrored mesh from the mesh, over the largest extent, up to which they
# are the same shape.
SAME_SHAPE = 0.02
# Smallest and largest error of a mesh over the change to half the edge lengths: with the order of
# convergence n it is 2ⁿ / (2ⁿ − 1), 1.3 to 3.4 for the lowest orders, to first order.
MESH_AMPLITUDES = (0.5, 3.5)
# Share of the weight in a scan that is taken as the whole weight.
WHOLE_WEIGHT = (0.4, 2.0)


@dataclass(frozen=True)
class LinearCorrection:
    """Correction of the description whose effect is known to first order only.

    Attributes
    ----------
    share : float
        χ² of the fit with the correction over that without.
    """

    share: float


@dataclass(frozen=True, eq=False)
class _Change:
    """One possible change of the body, as columns of the linearised fit.

    Attributes
    ----------
    columns : tuple of int
        Columns that belong to it.
    is_whole : bool
        Whether the change happens as a whole (a law), or with amplitudes that are estimated.
    kind : str
        Code of the hypothesis.
    laws : tuple of (Material or None, DampingLaw or None)
        Laws of the changed body.
    axis : int
        Axis of a change of the width.
    """

    columns: tuple[int, ...]
    is_whole: bool
    kind: str
    material: str = ""
    damping: str = ""
    axis: int = 0


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


def other_dampings(body: Body) -> tuple[str, ...]:
    """Return the names of damping laws with the same constants as all parts of a body have."""
    own = {part.damping for part in body.parts}
    if len(own) > 1 or not own <= {*DAMPINGS.values()}:
        return ()
    (damping,) = own
    return tuple(
        name
        for name, each in DAMPINGS.items()
        if each is not damping and each.constants == damping.constants
    )


def with_laws(body: Body, material: Material | None, damping: DampingLaw | None) -> Body:
    """Return a body with another material or damping law in all parts; None keeps the law."""
    laws = {"material": material, "damping": damping}
    changed = {name: law for name, law in laws.items() if law is not None}
    return body.with_parts(tuple(replace(part, **changed) for part in body.parts))


def _law_effect(at: ExperimentAtAnswer, material: str, damping: str) -> Effect | None:
    """Return the effect of other laws with the same constants, "" for the stated one: the
    difference of the forces along the answer.
    """
    own = at.stress_free_body
    other = with_laws(own, MATERIALS.get(material), DAMPINGS.get(damping))
    return Effect(at.internal_n(body=other) - at.internal_force_n)


def _width_effect(at: ExperimentAtAnswer, axis: int) -> Effect:
    """Return the effect of a body that is wider along an axis of the mesh (index), about the middle
    of its grasped nodes, as a share of the width.
    """
    moved_m = np.zeros_like(at.body.nodes_m)
    points_m = at.body.nodes_m
    dofs = at.iterate.equations.prescribed.dofs
    moved_m[:, axis] = points_m[:, axis] - points_m[np.unique(dofs // 3), axis].mean()
    return shape_effect(at, moved_m)


def _scan_effect(at: ExperimentAtAnswer, axis: int) -> Effect:
    """Return the effect of a mesh that was made under the whole weight of the body along one of its
    axes (index).
    """
    sag = sag_m(at.body, at.theta, support_dofs=at.likely_support_dofs, axis=axis)
    return Effect(at.force_change_by_reference(sag))


def _list_changes(body: Body) -> tuple[list[Deviation], list[_Change]]:
    """Return the columns of the linearised fit, and the changes of the body that consist of them."""
    rows: list[Deviation] = []
    changes: list[_Change] = []

    def add(name: str, effect: object) -> int:
        rows.append(Deviation(name, "1", effect=effect))  # type: ignore[arg-type]
        return len(rows) - 1

    materials = other_materials(body)
    dampings = other_dampings(body)
    of_law: dict[tuple[str, str], int] = {}
    for pair in [(m, d) for m in ("", *materials) for d in ("", *dampings)][1:]:
        of_law[pair] = add("law", lambda at, _, pair=pair: _law_effect(at, *pair))
        changes.append(_Change((of_law[pair],), True, _law_code(*pair), *pair))
    if not _is_uniform(body):
        return rows, changes
    if other_section(body.mesh, body.nodes.points_m) is not None:
        column = add("section", lambda at, _: section_effect(at))
        changes.append(_Change((column,), True, "mesh-section"))
    for axis in range(3):
        column = add("width", lambda at, _, axis=axis: _width_effect(at, axis))
        changes.append(_Change((column,), False, "mesh-width", axis=axis))
    if not isinstance(body.rest_shape, UnderGravity):
        columns = [
            add("scan", lambda at, _, axis=axis: _scan_effect(at, axis)) for axis in range(3)
        ]
        changes.append(_Change(tuple(columns), False, "rest-shape"))
    return rows, changes


def _is_uniform(body: Body) -> bool:
    """Return whether a body consists of one part without a field, so that it can be made again."""
    return len(body.parts) == 1 and all(part.field is None for part in body.parts)


def _law_code(material: str, damping: str) -> str:
    """Return the code of the hypothesis of another material, another damping law, or both."""
    if material and damping:
        return "law/both"
    return "law" if material else "law/damping"


def screened_bodies(
    solution: Solution, experiment: Experiment, *, is_far: bool = False
) -> Iterator[Hypothesis]:
    """Yield hypotheses of other bodies, those first that decrease χ² most by one linear step, with
    the experiment with the other body as `corrected`.

    Parameters
    ----------
    solution : Solution
        The fit.
    experiment : Experiment
        The experiment that is changed.
    is_far : bool
        Whether the fit moved the body so far from its stated pose that a linear step from there says
        little: other materials come first then, whatever it says.

    Notes
    -----
    At most `MOST_OF_A_KIND` of each kind and `MOST_REFITS` in all are yielded; nothing that
    decreases χ² by less than `LEAST_DECREASE`, and nothing with obstacles, whose frames are nodes
    of the body, or without a grasp.
    """
    collocation = solution.collocation
    body = experiment.body
    if experiment.obstacles or experiment.specimen is not None or not experiment.body_grasps:
        return
    rows, changes = _list_changes(body)
    if not rows:
        return
    columns = changed_residuals(collocation, solution.z, [(row, 1.0) for row in rows])
    gram = projected_gram(linearise_fit(collocation, solution.z), columns.blocks)
    found: list[tuple[float, Hypothesis]] = []
    for change in changes:
        own = [1 + column for column in change.columns]
        whole = np.ones(len(own)) if change.is_whole else None
        decrease, amplitudes = linear_step(gram, own, whole)
        if is_far and change.kind == "law":
            decrease = np.inf
        corrected = _changed_experiment(experiment, change, amplitudes)
        if decrease < LEAST_DECREASE or corrected is None:
            continue
        found.append((decrease, _hypothesis(experiment, change, amplitudes, corrected)))
    found.sort(key=lambda each: -each[0])
    count = Counter[str]()
    for _, hypothesis in found:
        if count[hypothesis.code] < MOST_OF_A_KIND and count.total() < MOST_REFITS:
            count[hypothesis.code] += 1
            yield hypothesis


def coarse_mesh_hypotheses(solution: Solution, of: str) -> Iterator[Hypothesis]:
    """Yield the hypothesis, about the subject `of`, that a finer mesh explains the residuals, with a
    `LinearCorrection`; nothing if it is smaller than noise or hardly decreases χ², for large bodies,
    or if its effect cannot be computed.
    """
    collocation = solution.collocation
    bodies = [each.body for each in collocation.transcriptions if each.experiment.specimen is None]
    if max((len(body.nodes.points_m) for body in bodies), default=0) > LARGEST_NODE_COUNT:
        return
    try:
        row = finer_mesh_row(collocation)
        columns = changed_residuals(collocation, solution.z, [(row, 1.0)])
    except (InputError, SimulationError, np.linalg.LinAlgError):
        return
    gram = projected_gram(linearise_fit(collocation, solution.z), columns.blocks)
    least, most = MESH_AMPLITUDES
    amplitude = min(most, float(linear_step(gram, [1])[1][0]))
    if amplitude < least:
        return
    decrease, _ = linear_step(gram, [1], np.array([amplitude]))
    sigmas = float(amplitude * np.sqrt(gram[1, 1] / collocation.count_measurements()))
    if decrease > LEAST_DECREASE and sigmas > LEAST_SIGMAS:
        linear = any(body.element.name == "tet4" for body in bodies)
        data = {
            "sigmas": sigmas,
            "remedy": 'set object.element = "tet10", or refine the mesh'
            if linear
            else "refine the mesh",
        }
        corrected = LinearCorrection(1 - decrease / gram[0, 0])
        yield Hypothesis("mesh-coarse", of, data=data, corrected=corrected)


def projected_gram(fit: LinearisedFit, blocks: Sequence[Array]) -> Array:
    """Return the Gram matrix (1 + c, 1 + c) of the residuals of a fit and of c changes of them, less
    what a step of its parameters explains.
    """
    free = ~fit.at_bound
    stacked = []
    slopes = []
    for block, change in zip(fit.blocks, blocks, strict=True):
        weight = (block.compute_root_weight() * block.is_measured)[..., None]
        both = np.concatenate([block.residual[..., None], change * weight], axis=3)
        stacked.append(both.reshape(-1, both.shape[-1]))
        slopes.append(block.jacobian.reshape(len(stacked[-1]), block.jacobian.shape[-1]))
    values = np.concatenate(stacked)
    jacobian = np.concatenate(slopes)[:, free]
    of_prior = np.zeros((len(fit.prior_residual), values.shape[1]))
    of_prior[:, 0] = fit.prior_residual
    values = np.concatenate([values, of_prior])
    jacobian = np.concatenate([jacobian, np.diag(fit.prior_jacobian)[:, free]])
    explained = np.linalg.lstsq(jacobian, values, rcond=1e-10)[0]
    return (remaining := values - jacobian @ explained).T @ remaining


def linear_step(
    gram: Array, columns: Iterable[int], amplitudes: Array | None = None
) -> tuple[float, Array]:
    """Return the decrease of χ² by changes of the residuals, and their amplitudes, by default those
    that decrease it most.

    `gram` is the result of `projected_gram`, in which changes are `columns` from 1 on.
    """
    own = [*columns]
    among = gram[np.ix_(own, own)]
    if amplitudes is None:
        amplitudes = -np.linalg.lstsq(among, gram[own, 0], rcond=1e-8)[0].astype(np.float64)
    return float(-2 * amplitudes @ gram[own, 0] - amplitudes @ among @ amplitudes), amplitudes


def _changed_experiment(
    experiment: Experiment, change: _Change, amplitudes: Array
) -> Experiment | None:
    """Return the experiment with a changed body; None if that is impossible, or the change is too
    large to be a mistake of this kind.
    """
    body = experiment.body
    if change.kind == "mesh-section":
        return with_other_section(experiment)
    if change.is_whole:
        laws = MATERIALS.get(change.material), DAMPINGS.get(change.damping)
        return with_body(experiment, with_laws(body, *laws))
    if change.kind == "mesh-width":
        if abs(amplitudes[0]) > WIDEST:
            return None
        factors = np.ones(3)
        factors[change.axis] += amplitudes[0]
        return with_shape(experiment, factors)
    share = float(np.linalg.norm(amplitudes))
    if not WHOLE_WEIGHT[0] < share < WHOLE_WEIGHT[1]:
        return None
    held = np.unique(np.concatenate([grasp.nodes for grasp in experiment.body_grasps]))
    scanned = UnderGravity(held, gravity_m_s2=GRAVITY_M_S2 * amplitudes / share)
    return with_shape(experiment, np.ones(3), rest_shape=scanned)


def _hypothesis(
    experiment: Experiment, change: _Change, amplitudes: Array, corrected: Experiment
) -> Hypothesis:
    """Return the hypothesis of a change of the body, not yet tested by a refit."""
    of = f"'{experiment.name}'"
    data: dict[str, object] = {"material": change.material, "damping": change.damping}
    if change.kind == "mesh-width":
        width = float(amplitudes[0])
        data = {
            "axis": AXES[change.axis],
            "percent": 100 * abs(width),
            "way": "narrow" if width > 0 else "wide",
        }
    elif change.kind == "mesh-section":
        real = (
            "round" if corrected.body.mesh.volume_m3 < experiment.body.mesh.volume_m3 else "square"
        )
        data = {"real": real, "meshed": "square" if real == "round" else "round"}
    elif change.kind == "rest-shape":
        down = amplitudes / np.linalg.norm(amplitudes)
        data = {"down": ", ".join(f"{each:.2f}" for each in down)}
    return Hypothesis(change.kind, of, data=data, corrected=corrected)


def mirror_images(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield the hypotheses that the mesh is a mirror image along each axis about the middle of its
    grasps, if that is another shape.
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
    for axis, name in enumerate(AXES):
        factors = np.ones(3)
        factors[axis] = -1.0
        away_m = tree.query(middle_m + factors * (surface - middle_m))[0]
        if away_m.max() < SAME_SHAPE * size_m:
            continue
        mirrored = with_shape(experiment, factors)
        if mirrored is not None:
            yield Hypothesis(
                "mesh-mirrored", f"'{experiment.name}'", data={"axis": name}, corrected=mirrored
            )


def _middle_of_grasps_m(experiment: Experiment) -> Array:
    """Return the mean position (3,) of the grasped nodes in the mesh [m]."""
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
    """Return the experiment with points (n, 3) of the mesh elsewhere; None if it is not valid."""
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
