"""Look at a problem before solving it: what it holds, what it will cost, and what will go wrong.

Every warning is one sentence that ends with the remedy.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..fem.body import Body
from ..fem.moduli import engineering
from ..methods.start import initial_variables
from ..nlp.collocation import Collocation
from ..nlp.schemes import scheme_named
from ..problem import Problem
from ..run import build_collocation
from .cost import Cost, cost_notes, cost_warnings, costs
from .derivatives import SAMPLES, derivative_errors, shortened
from .elements import ElementShape, element_warnings, slenderness, worst_elements
from .measurements import MarkerFinding, Recording, recording_of, recording_warnings
from .motion import ModeFinding, Motion, motion_notes, motion_of, motion_warnings

__all__ = [
    "Cost",
    "ElementShape",
    "Findings",
    "MarkerFinding",
    "ModeFinding",
    "Motion",
    "Recording",
    "check_problem",
]


# Agreement with fourth-order central differences that rounding allows.
AGREEMENT = 1e-6


@dataclass(frozen=True)
class Findings:
    """What `check` reports.

    Attributes
    ----------
    element : str
    size_m : extents along the axes
    edges_m : shortest, mean and longest edge
    worst_elements : tuple of ElementShape, worst first
    cells_across : float
        Elements that share the body's thickness.
    guess : mapping of the constants, and of E and ν at small strain, to their values at the guess
    samples, missing : int
        Marker samples that are there and that are not, of all experiments.
    largest_marker_distance_m : float
    rms_at_guess_m : float
        Distance of the markers from their measurements in the simulation at the guess.
    recordings : tuple of Recording, one for each experiment
    motions : tuple of Motion, one for each fitted experiment
    method : str
        The chosen one; `memory_mb` is what it takes, if it is among the `costs`.
    costs : tuple of Cost, one for each method of which they are known
    jacobian_error, hessian_error : float
        Largest relative deviation from central differences along random directions.
    notes, warnings : tuple of str
    """

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
    experiments: int
    timesteps: int
    samples: int
    missing: int
    largest_marker_distance_m: float
    rms_at_guess_m: float
    recordings: tuple[Recording, ...]
    motions: tuple[Motion, ...]
    variables: int
    constraints: int
    jacobian_nonzeros: int
    hessian_nonzeros: int
    method: str
    memory_mb: float | None
    costs: tuple[Cost, ...]
    jacobian_error: float
    hessian_error: float
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

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
    parameters, body = problem.parameters, problem.body
    theta = body.theta(parameters.guesses)
    z, start_notes = initial_variables(collocation)
    short = build_collocation(shortened(problem, SAMPLES))
    jacobian_error, hessian_error = derivative_errors(short, initial_variables(short)[0])
    jacobian, hessian = _nonzeros(problem)
    solver = problem.file.solver
    factorisation = solver.method_named("reduced-space").factorisation
    found_costs = costs(collocation, z, jacobian + hessian, factorisation)
    chosen = next((cost for cost in found_costs if cost.method == solver.method), None)

    quality, worst, shape = body.mesh.quality(), worst_elements(body.mesh), slenderness(body.mesh)
    recordings = _recordings(problem, collocation, z)
    scheme = scheme_named(collocation.scheme)
    motions = tuple(
        motion_of(s.experiment, scheme, s.dynamics.step_s, s.body.theta(parameters.guesses))
        for s in collocation.segments
    )
    extents = np.ptp(body.mesh.bounds_m, axis=0)
    diagonal_m = float(np.linalg.norm(extents))
    warnings = element_warnings(body, theta, shape, worst[0])
    for motion in motions:
        warnings += motion_warnings(motion)
    for recording in recordings:
        warnings += recording_warnings(recording, quality.edge_mean_m, diagonal_m)
    warnings += cost_warnings(chosen, found_costs) if chosen else []
    notes = [*problem.notes, *start_notes]
    for motion in motions:
        notes += motion_notes(motion)
    notes += cost_notes(chosen, found_costs) if chosen else []
    return Findings(
        nodes=len(body.nodes_m),
        elements=len(body.cells),
        element=body.element.name,
        volume_m3=body.mesh.volume_m3,
        mass_kg=body.mass_kg,
        size_m=(float(extents[0]), float(extents[1]), float(extents[2])),
        edges_m=(quality.edge_min_m, quality.edge_mean_m, quality.edge_max_m),
        smallest_element_quality=quality.quality_min,
        median_element_quality=quality.quality_median,
        worst_elements=worst,
        cells_across=shape.cells_across,
        guess=_guess(body, theta),
        experiments=len(problem.experiments),
        timesteps=sum(segment.grid_rows for segment in collocation.segments),
        samples=sum(recording.samples for recording in recordings),
        missing=sum(recording.missing for recording in recordings),
        largest_marker_distance_m=max(r.farthest.distance_m for r in recordings),
        rms_at_guess_m=collocation.rms_m(z),
        recordings=recordings,
        motions=motions,
        variables=collocation.variables,
        constraints=collocation.constraints,
        jacobian_nonzeros=jacobian,
        hessian_nonzeros=hessian,
        method=solver.method,
        memory_mb=chosen.memory_mb if chosen else None,
        costs=found_costs,
        jacobian_error=jacobian_error,
        hessian_error=hessian_error,
        notes=tuple(notes),
        warnings=tuple(warnings),
    )


def _guess(body: Body, theta: Array) -> dict[str, float]:
    found = {}
    for part, lame in zip(body.parts, body.lame(theta).values(), strict=True):
        young, poisson = engineering(*lame)
        found |= {part.full_name("young_pa"): young, part.full_name("poisson"): poisson}
    return found | dict(zip(body.constants, theta.tolist(), strict=True))


def _recordings(problem: Problem, collocation: Collocation, z: Array) -> tuple[Recording, ...]:
    simulated = {}
    for part in collocation.parts(z):
        at_samples = part.x[part.segment.observation.grid_rows]
        simulated[part.segment.experiment.name] = at_samples.reshape(len(at_samples), -1, 3)
    return tuple(recording_of(e, simulated.get(e.name)) for e in problem.experiments)


def _nonzeros(problem: Problem) -> tuple[int, int]:
    """Nonzeros of Jacobian and Hessian, without laying them out: each sample adds as many."""
    fitted = [experiment for experiment in problem.experiments if not experiment.validation]
    nq = len(problem.parameters.free)
    total = np.array([0, (1 - len(fitted)) * nq * (nq + 1) // 2])  # the block of q is shared
    for experiment in fitted:
        alone = replace(problem, experiments=(experiment,))
        some, longer = (_counted(shortened(alone, SAMPLES + more)) for more in (0, 1))
        total += some + max(0, len(experiment.t_s) - SAMPLES) * (longer - some)
    return int(total[0]), int(total[1])


def _counted(problem: Problem) -> NDArray[np.int64]:
    collocation = build_collocation(problem)
    structures = (collocation.jacobian_structure, collocation.hessian_structure)
    return np.array([len(indices) for _, indices in structures])
