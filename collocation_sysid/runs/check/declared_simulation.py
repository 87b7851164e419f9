"""Whether a problem declares that its recordings were simulated."""

from __future__ import annotations

from ...problem import Problem


def is_declared_simulated(problem: Problem) -> bool:
    """Return whether the assumptions state that the damping law is exact, which declares that the
    recordings were simulated: the law of a real body is never known.
    """
    return problem.uncertainty.assumptions.damping_law == "none"
