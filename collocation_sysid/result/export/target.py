"""What an export is: files, what they leave out, and how the target predicts compared with us."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...arrays import Array, Index
from ...fem.refinement import split_in_eight
from .identified import Identified

LINEAR_ONLY = (
    "quadratic tetrahedra are split into eight linear ones on the same nodes: too stiff in bending "
    "and near ν = ½"
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


def left_out(body: Identified, memory: bool = False, moving: bool = True) -> list[str]:
    """What no target of ours takes, or those that know no memory and no moving boundary."""
    e, said = body.experiment, []
    if e.actuators:
        said.append("tendons and pressures are not exported")
    if e.body.forces:
        said.append(f"{', '.join(f.name for f in e.body.forces)} of your own is not exported")
    times = e.t_s
    if np.ptp(e.node_forces_n(times), axis=0).any() or np.ptp(e.tied_mass_kg(times), axis=0).any():
        said.append("forces and point masses stay as they are at the first sample")
    if not memory:
        for region in body.regions:
            if region.branches:
                at_once = 1 + sum(branch.share for branch in region.branches)
                said.append(
                    f"{region.name}: memory is not known; the stiffness is the long-term one, at "
                    f"once it is {at_once:.4g} times that"
                )
    if not moving:
        said.append(
            "grasped nodes are held where they are at the first sample; poses_1.csv and so on have "
            "the motion, which something has to drive"
        )
    if any(not grasp.holds(times).all() for grasp in e.grasps):
        said.append("grasps that begin or end to hold within the recording stay as they begin")
    return said


def linear_cells(body: Identified) -> list[Index]:
    """(k, 4) of each region; quadratic cells are split on the same nodes."""
    if body.body.element.nodes == 4:
        return [body.body.cells[region.cells] for region in body.regions]
    eight = split_in_eight(body.body.mesh).tetrahedra.reshape(-1, 8, 4)
    return [eight[region.cells].reshape(-1, 4) for region in body.regions]


def mean_dilatation_lost(body: Identified) -> list[str]:
    """Said where a target has no element with one pressure."""
    if not body.body.element.mean_dilatation:
        return []
    worst = max(region.poisson for region in body.regions)
    return [
        "tet10-p0 becomes the plain quadratic tetrahedron: where ν is near ½ it is too stiff "
        f"(ν = {worst:.4g} here)"
    ]


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
    return "".join(f"{start}{' '.join(line.split()).replace('--', '- -')}{end}\n" for line in lines)
