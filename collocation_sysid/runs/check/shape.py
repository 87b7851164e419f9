"""A body as it will be simulated: its size and mesh, and its constants at the guess."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...arrays import Array
from ...fem.body import Body
from ...fem.moduli import engineering
from .elements import ElementShape, element_warnings, slenderness, worst_elements


@dataclass(frozen=True)
class BodyFinding:
    """One body.

    Attributes
    ----------
    experiments : tuple of the names of those that it is in
    element : str
    size_m : extents along the axes
    edges_m : shortest, mean and longest edge
    worst_elements : tuple of ElementShape, worst first
    cells_across : float
        Elements that share the body's thickness.
    guess : mapping of the constants, and of E and ν at small strain, to their values at the guess
    warnings : tuple of str
        What the elements will do to the answer, one sentence each.
    """

    experiments: tuple[str, ...]
    nodes: int
    elements: int
    element: str
    volume_m3: float
    mass_kg: float
    size_m: tuple[float, float, float]
    edges_m: tuple[float, float, float]
    smallest_element_quality: float
    median_element_quality: float
    worst_elements: tuple[ElementShape, ...]
    cells_across: float
    guess: dict[str, float]
    warnings: tuple[str, ...]

    @property
    def diagonal_m(self) -> float:
        """Length of the diagonal of its bounding box."""
        return float(np.linalg.norm(self.size_m))


def body_finding(body: Body, theta: Array, experiments: tuple[str, ...]) -> BodyFinding:
    """Measure a body, with the constants θ at the guess."""
    mesh = body.mesh
    quality, worst, shape = mesh.quality(), worst_elements(mesh), slenderness(mesh)
    x, y, z = np.ptp(mesh.bounds_m, axis=0).tolist()
    return BodyFinding(
        experiments,
        nodes=len(body.nodes_m),
        elements=len(body.cells),
        element=body.element.name,
        volume_m3=mesh.volume_m3,
        mass_kg=float(body.mass_of_dofs(theta).sum()) / 3,
        size_m=(x, y, z),
        edges_m=(quality.edge_min_m, quality.edge_mean_m, quality.edge_max_m),
        smallest_element_quality=quality.quality_min,
        median_element_quality=quality.quality_median,
        worst_elements=worst,
        cells_across=shape.cells_across,
        guess=_guess(body, theta),
        warnings=tuple(element_warnings(body, theta, shape, worst[0])),
    )


def _guess(body: Body, theta: Array) -> dict[str, float]:
    moduli = {}
    for part, lame in zip(body.parts, body.lame(theta).values(), strict=True):
        young, poisson = engineering(*lame)
        moduli |= {part.full_name("young_pa"): young, part.full_name("poisson"): poisson}
    return moduli | dict(zip(body.constants, theta.tolist(), strict=True))
