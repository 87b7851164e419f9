"""What an export is: files, what they leave out, and how the target predicts compared with us."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from ...arrays import Array, Index
from ...errors import printable
from ...fem.refinement import split_in_eight
from ...model.forces import Forces
from ...program.rest import rest_state
from ...program.simulation import simulate
from .identified import Identified
from .solids import Primitive

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
    """The files of an export.

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
    """One number that the target predicts, and the same of this package."""

    what: str
    theirs: float
    ours: float
    unit: str
    remark: str = ""

    @property
    def relative(self) -> float:
        """How much larger theirs is, as a share of ours; NaN where ours is zero."""
        return (self.theirs - self.ours) / self.ours if self.ours else float("nan")


@dataclass(frozen=True)
class Target:
    """A simulator.

    Attributes
    ----------
    name : str
        As it calls itself.
    export : callable
    verify : callable, optional
        Predict with the files in a folder what the body does, in the simulator itself.
    """

    name: str
    export: Callable[[Identified], Exported]
    verify: Callable[[Identified, Path], Sequence[Comparison]] | None = None


@dataclass(frozen=True)
class Holds:
    """What a simulator holds of a body, so that what it does not is told alike by all.

    Attributes
    ----------
    materials : mapping of a material's name to its own; what all others become is in `instead`
    instead : str
        With places for the `material` and the region's constants, as `stiffness_damping` and
        `mass_damping` have; what these say where a body has them, empty where they are held.
    damping : str
        The law of its own, of which nothing is said.
    memory, motion, drives, quadratic : bool
        Branches of memory; grasps that move, and what is touched; elements with nodes on their
        edges, which are split where they are not held.
    forces : str
        What is said where forces act on nodes, empty where they are held.
    shapes : tuple of str
        Of what the body may touch.
    roundings, faces, friction : bool
        Of that: edges that are round; that some faces alone touch it; that it rubs.
    tried : bool
        Whether the simulator itself has ever read such files.
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
        """What it does not hold of a body, and what was done instead."""
        said = [*_never_held(body)]
        said += self._lost_of_obstacles(body)
        for region in body.regions:
            damped = bool(region.gamma_r_s)
            told = [
                *[MEMORY] * (bool(region.branches) and not self.memory),
                *[self.instead] * (region.material not in self.materials),
                *[self.stiffness_damping] * (damped and region.damping != self.damping),
                *[self.mass_damping] * bool(region.gamma_m_1_s),
            ]
            at_once = 1 + sum(branch.share for branch in region.branches)
            values = {**vars(region), "at_once": at_once}
            said += [f"{region.name}: {each.format(**values)}" for each in filter(None, told)]
        if not self.motion:
            said.append(MOTION)
        if body.quadratic and not self.quadratic:
            said.append(LINEAR_ONLY)
        elif body.body.element.mean_dilatation:
            worst = max(region.poisson for region in body.regions)
            said.append(MEAN_DILATATION.format(worst=worst))
        if body.experiment.forces and self.forces:
            said.append(self.forces)
        return said if self.tried else [*said, UNTRIED]

    def _lost_of_obstacles(self, body: Identified) -> Iterator[str]:
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
    """What no target of ours takes."""
    e, times = body.experiment, body.experiment.t_s
    if e.actuators:
        yield "tendons and pressures are not exported"
    if e.air_density_kg_m3:
        yield "buoyancy, added mass and drag of the air are not exported"
    if e.body.forces:
        yield f"{', '.join(f.name for f in e.body.forces)} of your own is not exported"
    if np.ptp(e.node_forces_n(times), axis=0).any() or np.ptp(e.tied_mass_kg(times), axis=0).any():
        yield "forces and point masses stay as they are at the first sample"
    if any(not grasp.holds(times).all() for grasp in e.grasps):
        yield "grasps that begin or end to hold within the recording stay as they begin"


def at_rest(body: Identified, samples: int = 1) -> tuple[Array, Array]:
    """Our equilibria at so many samples, without what exports leave out.

    Returns
    -------
    (T, n, 3) how far they move the nodes, and (T, o, 3) the forces of obstacles on the body
    """
    whole = replace(
        body.touching or body.experiment,
        tendons=(),
        pressures=(),
        loaded_since_s=np.inf,
        air_density_kg_m3="none",
    )
    if samples > 1:
        states = simulate(whole, body.theta).positions_m[:samples].reshape(samples, -1)
    else:
        states = rest_state(whole, body.theta)[None]
    # In statics what slides is the way since the sample before.
    ways = np.diff(states, axis=0, prepend=states[:1])
    forces = Forces.of(whole, whole.t_s[:samples], body.theta).total(states, ways)
    on_nodes = forces.reshape(samples, -1, 3)
    on_body = [-on_nodes[:, each.nodes].sum(axis=1) for each in body.obstacles]
    moved_m = states.reshape(samples, -1, 3)[:, : len(body.nodes_m)] - body.nodes_m
    return moved_m, np.stack(on_body, axis=1) if on_body else np.zeros((samples, 0, 3))


def longest(way_m: Array) -> float:
    """How far what moves farthest moves, of (n, 3)."""
    return float(np.linalg.norm(way_m, axis=1).max())


def linear_cells(body: Identified) -> list[Index]:
    """(k, 4) of each region; quadratic cells are split on the same nodes."""
    if not body.quadratic:
        return [body.body.cells[region.cells] for region in body.regions]
    eight = split_in_eight(body.body.mesh).tetrahedra.reshape(-1, 8, 4)
    return [eight[region.cells].reshape(-1, 4) for region in body.regions]


def numbers(values: Iterable[float] | Array, separator: str = " ") -> str:
    """Numbers that read back as they are."""
    return separator.join(repr(float(value)) for value in np.ravel(np.asarray(values)))


def heading(body: Identified, limits: Iterable[str], start: str, end: str = "") -> str:
    """Comment lines: what this is, and what it does not say."""
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
