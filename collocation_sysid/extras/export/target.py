"""Description of export targets: their files, what they cannot express, and comparison of
predictions.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from ...common.array_types import Array, Index
from ...errors import InputError, printable
from ...fem.meshes.refinement import split_in_eight
from ...kinds.rod.element import LAWS as LAWS_OF_RODS
from ...model.forces import Forces
from ...program.forward.initial_equilibrium import equilibrium
from ...program.simulation import simulate
from .identified import IdentifiedBody

_CALCULIX = (
    *("neo-hookean", "st-venant-kirchhoff", "linear", "mooney-rivlin", "yeoh", "arruda-boyce"),
    *(f"{law}-{terms}" for law in ("ogden", "hyperfoam") for terms in (1, 2, 3)),
    "neo-hookean with fibres",
)
# Laws that each target has, by the names of `IdentifiedBody.laws`; the json file has all. Newton has
# that of its `SolverVBD`, with which it also reads a stage.
LAWS: Mapping[str, tuple[str, ...]] = {
    "mujoco": ("st-venant-kirchhoff", *LAWS_OF_RODS),
    "newton": ("stable-neo-hookean",),
    "usd": ("stable-neo-hookean", *LAWS_OF_RODS),
    "calculix": _CALCULIX,
    "abaqus": (*_CALCULIX, "ogden-4", "hyperfoam-4", "neo-hookean with dispersed fibres"),
    "febio": (
        *("neo-hookean", "st-venant-kirchhoff", "mooney-rivlin", "yeoh"),
        *(f"ogden-{terms}" for terms in range(1, 5)),
        *("neo-hookean with fibres", "neo-hookean with dispersed fibres"),
        *("st-venant-kirchhoff with fibres", "st-venant-kirchhoff with dispersed fibres"),
    ),
}
LINEAR_ONLY = (
    "each quadratic tetrahedron is split into eight linear ones with the same nodes, which are "
    "too stiff in bending and near ν = ½"
)
MEAN_DILATATION = (
    "tet10-p0 becomes the standard quadratic tetrahedron, which is too stiff for ν near ½ (ν = "
    "{worst:.4g} here)"
)
VISCOELASTICITY = (
    "viscoelastic memory is not supported; the exported stiffness is the long-term one, and the "
    "instantaneous one is {at_once:.4g} times that"
)
MOTION = (
    "grasped nodes are fixed at their positions of the first sample; the motion is in the CSV "
    "files of poses beside this file, and your simulation has to apply it"
)


def require_known_laws(body: IdentifiedBody, target_name: str) -> None:
    """Refuse a body with a law that a target in `LAWS` does not have.

    Raises
    ------
    InputError
        With the law, those of the target, and the targets that have it.
    """
    for region, law in zip(body.regions, body.laws, strict=True):
        if law not in LAWS[target_name]:
            others = [f"--to {name}" for name, laws in LAWS.items() if {*body.laws} <= {*laws}]
            raise InputError(
                f"{target_name} has no law {law}; expected one of {', '.join(LAWS[target_name])}: solve "
                "again with such a material, or export with one of "
                f"{', '.join([*others, '--to json'])}",
                where=f"region '{region.name}'",
            )


@dataclass(frozen=True)
class ExportedFiles:
    """Files of an export."""

    # mapping of file name to text: content of each file; `write_export` adds ``identified.json``
    # and the poses.
    files: Mapping[str, str] = field(repr=False)
    limitations: tuple[str, ...]  # what the target cannot express, and what was done instead


@dataclass(frozen=True)
class PredictionComparison:
    """One quantity as predicted by the target and by this package."""

    what: str  # name of the quantity
    # Prediction of the target, and of this package, in `unit`.
    theirs: float
    ours: float
    unit: str  # unit of both
    remark: str = ""  # further sentence; empty if there is none

    @property
    def relative_difference(self) -> float:
        """Relative difference (theirs − ours) / ours; NaN if ours is zero."""
        return (self.theirs - self.ours) / self.ours if self.ours else float("nan")


@dataclass(frozen=True)
class ExportTarget:
    """Simulator to which a body can be exported."""

    name: str  # name of the simulator as it writes it itself
    main_file: str  # name of the file that the simulator opens; its suffix is that of the format
    export: Callable[[IdentifiedBody], ExportedFiles]  # returns the files for a body
    # Runs the files of a folder in the simulator, and compares predictions; None if it cannot be
    # run from here.
    verify: Callable[[IdentifiedBody, Path], Sequence[PredictionComparison]] | None = None


@dataclass(frozen=True)
class TargetCapabilities:
    """Features of a body beside its law that a simulator can express; all others become limitations
    of an export.

    Attributes
    ----------
    stiffness_damping, mass_damping : str
        Sentences on the two kinds of damping, which may contain the names of constants of a region.
        Empty if the simulator expresses the damping.
    damping_law : str
        Name of the damping law that the simulator has, for which no sentence is needed.
    has_moving_grasps, has_moving_obstacles, has_quadratic_elements : bool
        Whether it has moving grasps, moving obstacles, and elements with nodes on their edges
        (which are split otherwise).
    node_forces, point_masses : str
        Sentences for forces and for point masses on nodes; empty if the simulator has them.
    has_memory : bool
        Whether it has branches of a memory.
    has_rounded_edges, has_face_selection : bool
        Whether obstacles may have rounded edges, and be limited to some faces of the body.
    """

    stiffness_damping: str = ""
    mass_damping: str = "γ_m = {gamma_m_1_s:.4g} 1/s is not supported"
    damping_law: str = ""
    has_moving_grasps: bool = False
    has_moving_obstacles: bool = False
    node_forces: str = "forces on nodes are not exported"
    point_masses: str = ""
    has_quadratic_elements: bool = False
    has_memory: bool = False
    has_rounded_edges: bool = True
    has_face_selection: bool = True

    def limitations(self, body: IdentifiedBody) -> list[str]:
        """Return sentences on what the simulator cannot express of a body, and what was done
        instead.

        The order is: what no target expresses, obstacles, regions, motion, elements, and forces and
        point masses on nodes. Sentences may end with a period or not; the list is a new one.
        """
        sentences = [*_common_limitations(body)]
        sentences += self._obstacle_limitations(body)
        for region in body.regions:
            damped = bool(region.gamma_r_s)
            templates = [
                *[VISCOELASTICITY] * (bool(region.branches) and not self.has_memory),
                *[self.stiffness_damping] * (damped and region.damping != self.damping_law),
                *[self.mass_damping] * bool(region.gamma_m_1_s),
            ]
            at_once = 1 + sum(branch["share"] for branch in region.branches)
            values = {**vars(region), "at_once": at_once}
            sentences += [
                f"{region.name}: {each.format(**values)}" for each in filter(None, templates)
            ]
        if not self.has_moving_grasps:
            sentences.append(MOTION)
        if body.is_quadratic and not self.has_quadratic_elements:
            sentences.append(LINEAR_ONLY)
        elif body.body.element.mean_dilatation:
            worst = max(region.poisson for region in body.regions)
            sentences.append(MEAN_DILATATION.format(worst=worst))
        return [*sentences, *self._load_limitations(body)]

    def _load_limitations(self, body: IdentifiedBody) -> Iterator[str]:
        e = body.experiment
        if e.forces and self.node_forces:
            yield self.node_forces
        elif np.ptp(e.declared_node_forces_n(e.t_s), axis=0).any():
            yield (
                "forces on nodes that change within the recording: they have their values of the "
                "first sample in the exported model"
            )
        if body.point_masses_kg.any() and self.point_masses:
            yield self.point_masses
        elif np.ptp(e.point_mass_at_nodes_kg(e.t_s), axis=0).any():
            yield (
                "point masses that begin or end within the recording: only those of the first "
                "sample are exported"
            )

    def _obstacle_limitations(self, body: IdentifiedBody) -> Iterator[str]:
        for each in body.obstacles:
            if getattr(each.shape, "rounding_m", 0.0) and not self.has_rounded_edges:
                yield f"{each.name}: its edges are not rounded"
            if each.faces is not None and not self.has_face_selection:
                yield f"{each.name}: the whole surface of the body may touch it"
            if len(each.poses.t_s) > 1 and not self.has_moving_obstacles:
                yield (
                    f"{each.name} is fixed at its position of the first sample; its motion is "
                    "in its poses file"
                )


def _common_limitations(body: IdentifiedBody) -> Iterator[str]:
    """Moving grasps are expressed by some targets."""
    e = body.experiment
    times = body.experiment.t_s
    if e.specimen is not None:
        yield (
            "the specimen is one homogeneous cell with a nominal density of "
            f"{e.body.parts[0].density_kg_m3:g} kg/m³: use the card of the material in a model of your own"
        )
    if any(grasp.poses.deformation is not None for grasp in e.grasps):
        yield "measured displacements of grasped nodes are not exported: the nodes move rigidly"
    if e.actuators:
        yield "tendons and pressures are not exported"
    if e.air_density_kg_m3:
        yield "buoyancy, added mass and drag of the air are not exported"
    if e.body.forces:
        yield f"custom forces are not exported: {', '.join(f.name for f in e.body.forces)}"
    if any(not grasp.is_active(times).all() for grasp in e.grasps):
        yield (
            "grasps that begin or end within the recording: they are exported as they are at the "
            "first sample"
        )


def equilibria(body: IdentifiedBody, samples: int = 1) -> tuple[Array, Array]:
    """Return the equilibria of this package at the first samples, without the loads that exports
    omit: tendons, pressures and air.

    Parameters
    ----------
    samples : int
        Number of samples; more than one for static recordings only.

    Returns
    -------
    moved_m : (T, n, 3)
        Displacements [m] of the n nodes of the body from `IdentifiedBody.nodes_m` at the T samples.
    forces_n : (T, o, 3)
        Force [N] of each of the o obstacles on the body.

    Raises
    ------
    SimulationError
        If an equilibrium cannot be found.
    """
    experiment = replace(
        body.experiment_with_obstacles or body.experiment,
        tendons=(),
        pressures=(),
        loaded_since_s=np.inf,
        air_density_kg_m3="none",
    )
    if samples > 1:
        states = simulate(experiment, body.theta).positions_m[:samples].reshape(samples, -1)
    else:
        states = equilibrium(experiment, body.theta)[None]
    # In statics friction follows the displacement since the previous sample.
    ways = np.diff(states, axis=0, prepend=states[:1])
    forces = Forces.from_experiment(experiment, experiment.t_s[:samples], theta=body.theta).total(
        states, ways
    )
    on_nodes = forces.reshape(samples, -1, 3)
    on_body = [-on_nodes[:, each.nodes].sum(axis=1) for each in body.obstacles]
    moved_m = states.reshape(samples, -1, 3)[:, : len(body.nodes_m)] - body.nodes_m
    return moved_m, np.stack(on_body, axis=1) if on_body else np.zeros((samples, 0, 3))


def longest_displacement_m(displacements_m: Array) -> float:
    """Return the largest length of displacements (n, 3) [m], at least one; NaN if one is NaN."""
    return float(np.linalg.norm(displacements_m, axis=1).max())


def linear_tetrahedra(body: IdentifiedBody) -> list[Index]:
    """Return the node indices of the linear tetrahedra (k, 4) of each region, in the order of
    `IdentifiedBody.regions`.

    Linear elements are returned as they are, in the order of the region's cells; each quadratic one
    is split into eight, which follow each other. Indices count from 0 and refer to
    `IdentifiedBody.nodes_m`, to which no nodes are added.
    """
    if not body.is_quadratic:
        return [body.body.cells[region.cells] for region in body.regions]
    eight = split_in_eight(body.body.mesh).tetrahedra.reshape(-1, 8, 4)
    return [eight[region.cells].reshape(-1, 4) for region in body.regions]


def values_as_text(values: Iterable[float] | Array, separator: str = " ") -> str:
    """Return numbers, of an array in row-major order, as text from which they are read back
    exactly, with `separator` between them.
    """
    return separator.join(repr(float(value)) for value in np.ravel(np.asarray(values)))


def comment_lines(
    body: IdentifiedBody, limitations: Iterable[str], start: str, end: str = ""
) -> str:
    """Return comment lines on the body: title, warnings, limitations, and constants of each region.

    Each line begins with `start` and ends with `end`, the marks of a comment in the format, and a
    line break. Within a line white space is joined, control characters are replaced, and two
    hyphens are separated, so that no line can end the comment.
    """
    lines = [
        f"{body.title}: identified body; SI units",
        *(f"warning: {warning}" for warning in body.warnings),
        *(f"not expressed: {limit}" for limit in limitations),
    ]
    for region in body.regions:
        stiffness = f"E = {region.young_pa:.6g} Pa, nu = {region.poisson:.6g}"
        if np.isnan(region.young_pa):
            stiffness = ", ".join(f"{name} = {v:.6g}" for name, v in region.constants.items())
        lines.append(
            f"{region.name}: {region.material}, {stiffness}, density = {region.density_kg_m3:.6g} kg/m3, "
            f"gamma_r = {region.gamma_r_s:.6g} s ({region.damping}), "
            f"gamma_m = {region.gamma_m_1_s:.6g} 1/s"
        )
    return as_comments(lines, start, end)


def as_comments(lines: Iterable[str], start: str, end: str = "") -> str:
    """Return comment lines as those of `comment_lines`, which no line ends itself."""
    texts = (re.sub("-(?=-)", "- ", " ".join(printable(line).split())) for line in lines)
    return "".join(f"{start}{text}{end}\n" for text in texts)


def xml_attribute(text: str) -> str:
    """Return a name as the value of an XML attribute, escaped and in quotation marks, with marks in
    place of control characters.
    """
    return quoteattr(printable(text))
