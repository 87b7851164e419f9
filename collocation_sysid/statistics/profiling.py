"""Profile likelihoods of a solved problem: every point another solve, by reduced space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..errors import InputError
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..nlp.parameters import Parameter
from .linearised import LinearisedFit
from .profile import Profile, profile
from .uncertainty import Uncertainty, uncertainty_of


def profile_of(
    solution: Solution, fit: LinearisedFit, uncertainty: Uncertainty, name: str
) -> Profile:
    """Profile likelihood of an estimated parameter.

    Raises
    ------
    InputError
        If the parameter is not among those estimated.
    """
    parameters = solution.collocation.parameters
    free = [item.name for item in parameters.free]
    if name not in free:
        raise InputError(
            f"found {name!r}; expected one of the estimated parameters {', '.join(free)}",
            None,
            "uncertainty.profile",
        )
    k = free.index(name)
    variance = float(uncertainty.covariance[k, k])
    item = parameters.free[k]

    def solve_fixed(_: str, value: float) -> float:
        return _loss_with(solution, item, value)

    return profile(
        solve_fixed,
        name,
        (solution.parameters[name], _loss(solution)),
        (item.lower, item.upper),
        float(np.sqrt(variance)),
        _noise_scale(solution, fit, uncertainty, k),
    )


def _loss(solution: Solution) -> float:
    return solution.collocation.objective(solution.z) / solution.collocation.loss_scale


def _loss_with(solution: Solution, item: Parameter, value: float) -> float:
    """Smallest loss with one parameter at a value, the search starting at the answer."""
    before = solution.collocation
    started = before.parameters.with_guess(solution.parameters)
    held = started.with_fixed({item.name: value})
    found = ReducedSpace()(replace(before, parameters=held)).unless_interrupted()
    if not found.status.converged:
        return float("inf")
    prior = 0.0
    if item.prior is not None:
        mean, deviation = item.prior
        away = np.log(value / mean) if item.scale == "log" else value - mean
        prior = (away / deviation) ** 2
    return _loss(found) + float(prior)


def _noise_scale(solution: Solution, fit: LinearisedFit, uncertainty: Uncertainty, k: int) -> float:
    """Variance of the estimate over what the σ given would make it."""
    parameters, q = solution.collocation.parameters, solution.q
    given = uncertainty_of(fit, parameters, q, "given", "independent").covariance[k, k]
    scale = float(uncertainty.covariance[k, k] / given)
    return scale if np.isfinite(scale) else 1.0
