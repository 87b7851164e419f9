"""Description of export targets: their files, what they cannot express, and comparison of
predictions.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from ...array_types import Array, Index
from ...errors import printable
from ...fem.refinement import split_in_eight
from ...model.forces import Forces
from ...program.initial_equilibrium import equilibrium
from ...program.simulation import simulate
from .identified import Identified
from .obstacle_shapes import Primitive

LINEAR_ONLY = (
    "quadratic tetrahedra are split into eight linear ones on the same nodes: too stiff in bending "
    "and near ν = ½"
)
MEAN_DILATATION = (
    "tet10-p0 becomes the plain quadratic tetrahedron: where ν is near ½ it is too stiff "
    "(ν = {worst:.4g} here)"
)
MEMORY = (
    "memory is not known; the stiffness is the long-term one, at once it is {at_once:.4g} "
    "times that"
)
MOTION = (
    "grasped nodes are held where they are at the first sample; poses_1.csv and so on have the "
    "motion, which something has to drive"
)
UNTRIED = (
    "untested: written after the description of the format, never read by the simulator itself"
)


@dataclass(frozen=True)
class Exported:
    """Files of an export.

    Attributes
    ----------
    files : mapping of file name to text
    limits : tuple of str
        What the target cannot express, and what was done instead.
    """

    files: Mapping[str, str]
    limits: tuple[str, ...]


@dataclass(frozen=True)
class Comparison:
    """One quantity as predicted by the target (`theirs`) and by this package (`ours`), in `unit`.

    `what` names the quantity, `remark` adds a sentence.
    """

    what: str
    theirs: float
    ours: float
    unit: str
    remark: str = ""

    @property
    def relative(self) -> float:
        """Relative difference (theirs − ours) / ours; NaN if ours is zero."""
        return (self.theirs - self.ours) / self.ours if self.ours else float("nan")


@dataclass(frozen=True)
class Target:
    """Simulator to which a body can be exported.

    Attributes
    ----------
    name : str
        Name of the simulator as it writes it itself.
    export : callable
        Returns the files for a body.
    verify : callable, optional
        Runs the files of a folder in the simulator, and compares predictions; None if it cannot be
        run
        from here.
    """

    name: str
    export: Callable[[Identified], Exported]
    verify: Callable[[Identified, Path], Sequence[Comparison]] | None = None


@dataclass(frozen=True)
class Holds:
    """Features of a body that a simulator can express; all others become limitations of an export.

    Attributes
    ----------
    materials : mapping of str to str
        Names in the simulator of the materials that it has; all others become what `instead`
        states.
    instead, stiffness_damping, mass_damping : str
        Sentences on other materials, and on the two kinds of damping; they may contain `{material}`
        and
        the names of constants of a region. Empty if the simulator expresses the damping.
    damping : str
        Name of the damping law that the simulator has, for which no sentence is needed.
    memory, motion, drives, quadratic : bool
        Whether it has viscoelastic branches, moving grasps, moving obstacles, and elements with
        nodes on
        their edges (which are split otherwise).
    forces : str
        Sentence for forces on nodes; empty if the simulator has them.
    shapes : tuple of str
        Kinds of `Primitive` that obstacles may have.
    roundings, faces, friction : bool
        Whether obstacles may have rounded edges, be limited to some faces of the body, and have
        friction.
    tried : bool
        Whether such files have been read by the simulator itself.
    """

    materials: Mapping[str, str]
    instead: str = "{material} becomes the neo-Hookean material of the same λ and μ at small strain"
    stiffness_damping: str = ""
    mass_damping: str = "γ_m = {gamma_m_1_s:.4g} 1/s is not known"
    damping: str = ""
    memory: bool = False
    motion: bool = False
    drives: bool = False
    forces: str = "forces on nodes are left out"
    quadratic: bool = False
    shapes: tuple[str, ...] = ("plane", "sphere", "box", "cylinder", "capsule")
    roundings: bool = True
    faces: bool = True
    friction: bool = True
    tried: bool = True

    def lost(self, body: Identified) -> list[str]:
        """Return sentences on what the simulator cannot express of a body, and what was done
        instead.
        """
        sentences = [*_never_held(body)]
        sentences += self._lost_of_obstacles(body)
        for region in body.regions:
            damped = bool(region.gamma_r_s)
            templates = [
                *[MEMORY] * (bool(region.branches) and not self.memory),
                *[self.instead] * (region.material not in self.materials),
                *[self.stiffness_damping] * (damped and region.damping != self.damping),
                *[self.mass_damping] * bool(region.gamma_m_1_s),
            ]
            at_once = 1 + sum(branch.share for branch in region.branches)
            values = {**vars(region), "at_once": at_once}
            sentences += [
                f"{region.name}: {each.format(**values)}" for each in filter(None, templates)
            ]
        if not self.motion:
            sentences.append(MOTION)
        if body.quadratic and not self.quadratic:
            sentences.append(LINEAR_ONLY)
        elif body.body.element.mean_dilatation:
            worst = max(region.poisson for region in body.regions)
            sentences.append(MEAN_DILATATION.format(worst=worst))
        if body.experiment.forces and self.forces:
            sentences.append(self.forces)
        return sentences if self.tried else [*sentences, UNTRIED]

    def _lost_of_obstacles(self, body: Identified) -> Iterator[str]:
        """Yield sentences on what the simulator cannot express of the obstacles."""
        for each in body.obstacles:
            if (kind := Primitive.of(each.shape).kind) not in self.shapes:
                yield f"{each.name}: what the body may touch is not exported if it is a {kind}"
                continue
            if getattr(each.shape, "rounding_m", 0.0) and not self.roundings:
                yield f"{each.name}: its edges are not rounded"
            if each.faces is not None and not self.faces:
                yield f"{each.name}: all of the body may touch it"
            if each.friction and not self.friction:
                yield f"{each.name}: nothing rubs on it"
            if len(each.poses.t_s) > 1 and not self.drives:
                yield f"{each.name} is where it is at the first sample; its poses have the motion"


def _never_held(body: Identified) -> Iterator[str]:
    """Yield sentences on what none of the targets can express."""
    e = body.experiment
    times = body.experiment.t_s
    if e.actuators:
        yield "tendons and pressures are not exported"
    if e.air_density_kg_m3:
        yield "buoyancy, added mass and drag of the air are not exported"
    if e.body.forces:
        yield f"custom forces are not exported: {', '.join(f.name for f in e.body.forces)}"
    if (
        np.ptp(e.stated_node_forces_n(times), axis=0).any()
        or np.ptp(e.point_mass_at_nodes_kg(times), axis=0).any()
    ):
        yield "forces and point masses stay as they are at the first sample"
    if any(not grasp.is_active(times).all() for grasp in e.grasps):
        yield "grasps that begin or end to hold within the recording stay as they begin"


def at_rest(body: Identified, samples: int = 1) -> tuple[Array, Array]:
    """Return the equilibria of this package at the first samples, without the loads that exports
    omit.

    Parameters
    ----------
    body : Identified
    samples : int
        Number of samples; more than one for static recordings only.

    Returns
    -------
    moved_m : (T, n, 3)
        Displacements of the nodes from `Identified.nodes_m`.
    forces_n : (T, o, 3)
        Forces of each obstacle on the body.
    """
    experiment = replace(
        body.touching or body.experiment,
        tendons=(),
        pressures=(),
        loaded_since_s=np.inf,
        air_density_kg_m3="none",
    )
    if samples > 1:
        states = simulate(experiment, body.theta).positions_m[:samples].reshape(samples, -1)
    else:
        states = equilibrium(experiment, body.theta)[None]
    # In statics what slides is the way since the sample before.
    ways = np.diff(states, axis=0, prepend=states[:1])
    forces = Forces.from_experiment(experiment, experiment.t_s[:samples], body.theta).total(
        states, ways
    )
    on_nodes = forces.reshape(samples, -1, 3)
    on_body = [-on_nodes[:, each.nodes].sum(axis=1) for each in body.obstacles]
    moved_m = states.reshape(samples, -1, 3)[:, : len(body.nodes_m)] - body.nodes_m
    return moved_m, np.stack(on_body, axis=1) if on_body else np.zeros((samples, 0, 3))


def longest(way_m: Array) -> float:
    """Return the largest length of displacements (n, 3)."""
    return float(np.linalg.norm(way_m, axis=1).max())


def linear_cells(body: Identified) -> list[Index]:
    """Return the linear tetrahedra (k, 4) of each region; quadratic ones are split on the same
    nodes.
    """
    if not body.quadratic:
        return [body.body.cells[region.cells] for region in body.regions]
    eight = split_in_eight(body.body.mesh).tetrahedra.reshape(-1, 8, 4)
    return [eight[region.cells].reshape(-1, 4) for region in body.regions]


def numbers(values: Iterable[float] | Array, separator: str = " ") -> str:
    """Return numbers as text from which they are read back exactly."""
    return separator.join(repr(float(value)) for value in np.ravel(np.asarray(values)))


def heading(body: Identified, limits: Iterable[str], start: str, end: str = "") -> str:
    """Return comment lines on the body: title, warnings, limitations, and constants of each region.

    Each line begins with `start` and ends with `end`, the marks of a comment in the format.
    """
    lines = [
        f"{body.title}: as identified; SI units",
        *(f"warning: {warning}" for warning in body.warnings),
        *(f"not expressed: {limit}" for limit in limits),
    ]
    for region in body.regions:
        lines.append(
            f"{region.name}: {region.material}, E = {region.young_pa:.6g} Pa, "
            f"nu = {region.poisson:.6g}, density = {region.density_kg_m3:.6g} kg/m3, "
            f"gamma_r = {region.gamma_r_s:.6g} s ({region.damping}), "
            f"gamma_m = {region.gamma_m_1_s:.6g} 1/s"
        )
    # No line may end the comment itself.
    texts = (re.sub("-(?=-)", "- ", " ".join(printable(line).split())) for line in lines)
    return "".join(f"{start}{text}{end}\n" for text in texts)


def attribute(text: str) -> str:
    """Return a name as a quoted attribute of XML, with marks in place of control characters."""
    return quoteattr(printable(text))
