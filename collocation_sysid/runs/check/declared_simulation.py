"""Whether a problem declares that its recordings were simulated."""

from __future__ import annotations

from ...problem import Problem

# Assumption that is exact only in simulations: the damping law of a real body is never known.
SIMULATION_ASSUMPTION = "damping_law"


def is_declared_simulated(problem: Problem) -> bool:
    """Return whether the assumptions state that the damping law is exact, which declares that the
    recordings were simulated.
    """
    return problem.uncertainty.collect_considered().get(SIMULATION_ASSUMPTION) is None
