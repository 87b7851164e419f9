"""Look at a problem before solving it: sizes, memory, and the derivatives at the guess."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .methods.reduced_space import memory_mb
from .methods.start import initial_variables
from .nlp.collocation import Collocation
from .problem import Problem
from .run import build_collocation

Array = NDArray[np.float64]

# Agreement with fourth-order central differences that rounding allows.
AGREEMENT = 1e-6
STEP = 1e-5


@dataclass(frozen=True)
class Findings:
    """What `check` reports.

    Attributes
    ----------
    jacobian_error, hessian_error : float
        Largest relative deviation from central differences along random directions.
    """

    nodes: int
    elements: int
    volume_m3: float
    mass_kg: float
    smallest_element_quality: float
    experiments: int
    timesteps: int
    samples: int
    missing: int
    largest_marker_distance_m: float
    variables: int
    constraints: int
    jacobian_nonzeros: int
    hessian_nonzeros: int
    memory_mb: float
    jacobian_error: float
    hessian_error: float
    notes: tuple[str, ...]

    @property
    def derivatives_agree(self) -> bool:
        """Whether both derivative checks pass."""
        return max(self.jacobian_error, self.hessian_error) < AGREEMENT

    def as_dict(self) -> dict[str, Any]:
        """For JSON and tables."""
        return asdict(self)


def check_problem(problem: Problem) -> Findings:
    """Validate a loaded problem further and measure it."""
    collocation = build_collocation(problem)
    z, notes = initial_variables(collocation)
    markers = [experiment.markers for experiment in problem.experiments]
    jacobian = len(collocation.jacobian_structure[1])
    hessian = len(collocation.hessian_structure[1])
    rows = sum(
        s.constraint_times * (s.body.linearisation_width + s.body.curvature_width)
        for s in collocation.segments
    )
    quality = problem.body.mesh.quality()
    jacobian_error, hessian_error = _derivative_errors(collocation, z)
    return Findings(
        nodes=len(problem.body.nodes_m),
        elements=len(problem.body.cells),
        volume_m3=problem.body.mesh.volume_m3,
        mass_kg=problem.body.mass_kg,
        smallest_element_quality=quality.quality_min,
        experiments=len(problem.experiments),
        timesteps=sum(segment.grid_rows for segment in collocation.segments),
        samples=sum(m.samples for m in markers),
        missing=sum(int(m.missing.sum()) for m in markers),
        largest_marker_distance_m=max(float(m.placement.distance_m.max()) for m in markers),
        variables=collocation.variables,
        constraints=collocation.constraints,
        jacobian_nonzeros=jacobian,
        hessian_nonzeros=hessian,
        # Values and row numbers, and the element results that are kept between calls.
        memory_mb=memory_mb(collocation)
        if problem.file.solver.method == "reduced-space"
        else (16 * (jacobian + hessian) + 8 * rows) / 1e6,
        jacobian_error=jacobian_error,
        hessian_error=hessian_error,
        notes=(*problem.notes, *notes, quality.describe()),
    )


def _derivative_errors(collocation: Collocation, z: Array) -> tuple[float, float]:
    """Largest relative deviations of J and H along a random direction at a disturbed start."""
    rng = np.random.default_rng(0)
    point = z + 1e-3 * rng.normal(size=len(z))
    direction = rng.normal(size=len(z))
    multipliers = rng.normal(size=collocation.constraints)

    def lagrangian_gradient(at: Array) -> Array:
        return collocation.gradient(at) + collocation.jacobian(at).T @ multipliers

    hessian = collocation.hessian(point, 1.0, multipliers)
    return (
        _deviation(
            collocation.constraint_values, collocation.jacobian(point) @ direction, point, direction
        ),
        _deviation(lagrangian_gradient, hessian @ direction, point, direction),
    )


def _deviation(function, exact: Array, point: Array, direction: Array) -> float:
    ahead, behind, far_ahead, far_behind = (
        function(point + k * STEP * direction) for k in (1, -1, 2, -2)
    )
    differences = (8 * (ahead - behind) - (far_ahead - far_behind)) / (12 * STEP)
    return float(np.abs(differences - exact).max() / np.abs(exact).max())
