"""Starts that may lead to a better solution than the best so far, see `searches`.

- *Other stiffnesses of a scan*: points measured by a camera are associated with the nearest part of the
  surface; a body that is too soft, with the camera turned to match, can be a local minimum of the loss.
  So those next to the scan's best are searched, too, and of bodies that touch obstacles, whose impacts
  make other minima; of others where the best solution needs an error of a pose or clock that nobody
  makes.
- *Stated guesses* where the scan fits better, and *the best of a scan* where the search from guesses
  failed.
- *Poisson's ratio near one half*: linear elements lock towards ν = ½, so that with a smaller
  modulus and a ratio near one half a body can move almost like a stiffer, compressible one.
- *Laws in powers of the stretches*: with every order and every sign of the exponents there is
  another optimum, and no search crosses an exponent of zero, at which a term vanishes. The closed
  forms of specimens tell whether there is a better one, see `methods.starts.power_law`.
- *Default bounds*: they are those of foams and rubbers. A search that ends at one of them is
  continued within what is physically possible, for metals, liquids and auxetic bodies. A factor
  that may be negative is then estimated on a linear scale, and a first exponent of Ogden's law that
  ended at its positive bound starts again from its negative, with the same shear modulus.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from ..fem.laws.constants import (
    SHARE,
    USUAL_EXPONENTS,
    constant_named,
    is_modulus,
    usual_value,
    without_region,
)
from ..methods.solution import Solution, Status
from ..methods.starts.power_law import power_law_start
from ..methods.starts.start import Start
from ..methods.starts.stiffness_scan import rescue
from ..model.parameters import Parameter, can_be_widened, with_widest_bounds
from ..statistics.linearised import AT_BOUND, parameter_values
from .searches import NextStart, has_correspondences

# Estimate of an error, in standard deviations of its prior, that makes a solution doubtful.
UNLIKELY = 4.5
# Outcomes of a failed search, after which another start may help.
FAILED_STATUSES = (
    Status.INFEASIBLE,
    Status.STALLED,
    Status.DIVERGED,
    Status.NUMERICAL_FAILURE,
    Status.NOT_SIMULABLE,
)


def of_scan(first: Start) -> list[NextStart]:
    """Return the other stiffnesses of the scan of a start, and the stated guesses."""
    others = () if first.scan is None else first.scan.others
    return [
        *(partial(_other_stiffness, first, number) for number in others),
        lambda _: first.stated and Start(first.stated, note="the search from the stated guess"),
    ]


def _other_stiffness(first: Start, number: int, best: Solution) -> Start | None:
    """None where the best solution is no local minimum."""
    is_unlikely = best.status.converged and not _is_likely(best)
    has_contact = any(each.experiment.obstacles for each in best.collocation.transcriptions)
    if not (is_unlikely or has_contact or has_correspondences(best.collocation)):
        return None
    assert first.scan is not None
    scan = replace(first.scan, best=number, parameters=first.scan.starts[number])
    note = f"the search from E = {scan.young_pa[number]:.3g} Pa"
    return Start(first.collocation.with_parameters(scan.parameters), note=note, scan=scan)


def _is_likely(solution: Solution) -> bool:
    p, _ = solution.collocation.unpack(solution.z)
    return bool((np.abs(p[solution.collocation.nq :]) <= UNLIKELY).all())


def after_failure(failed: Solution, is_complete: bool) -> Start | None:
    """Return the best stiffness of a scan after a search from guesses failed; with `is_complete` one
    at which the complete recordings can be simulated.
    """
    if failed.scan is not None or failed.status not in FAILED_STATUSES:
        return None
    reason = f"the search from the guess failed ({failed.status.value})"
    scan = rescue(failed.collocation, reason, is_complete=is_complete)
    if scan is None:
        return None
    note = "a search from the best stiffness of a scan"
    return Start(failed.collocation.with_parameters(scan.parameters), note=note, scan=scan)


# Poisson's ratio above which a second search starts from the usual one at the same Young's modulus.
# Smaller ratios do not lock.
NEARLY_INCOMPRESSIBLE = 0.42
# Names of the constants that determine Young's modulus and Poisson's ratio, two of them at a time.
LAME = ("young_pa", "poisson", "lambda_pa", "mu_pa")
# Least share of χ² by which another optimum is better.
LEAST_SHARE = 0.01


def start_beyond_bounds(solution: Solution) -> Start | None:
    """Return the estimates of a solution as a start within the `widest` bounds of its constants;
    None if no parameter ended at a default bound that can be widened.

    Stated bounds are kept. Beyond its bound a share of memory is estimated by its logarithm: the
    long-term modulus falls as it grows. The upper bound of Poisson's ratio remains for elements
    that lock near one half.
    """
    parameters = solution.collocation.parameters
    lower, upper = parameters.bounds_q
    known = parameter_values(solution.collocation, solution.q)
    locks = any(
        each.experiment.specimen is None and not each.body.element.mean_dilatation
        for each in solution.collocation.transcriptions
    )
    ended = {
        item.name: known[item.name]
        for item, distance in zip(
            parameters.free, np.minimum(solution.q - lower, upper - solution.q), strict=True
        )
        if distance < AT_BOUND
        and can_be_widened(item, known[item.name])
        and not (locks and _is_nearly_half(item.name, known[item.name]))
    }
    if not ended:
        return None
    listed = " and ".join(f"{name} = {bound:.4g}" for name, bound in ended.items())
    values = {item.name: known[item.name] for item in parameters.free}
    values |= _negative_terms(solution, values, ended)
    wider = parameters.map_components(lambda item: _widened(item, values, ended, locks))
    return Start(
        solution.collocation.with_parameters(wider.with_estimates(values)),
        scan=solution.scan,
        note=f"the search ended at the default bound{'s' * (len(ended) > 1)} {listed}; a second one, "
        "with wider bounds,",
    )


def _is_nearly_half(name: str, value: float) -> bool:
    return without_region(name) == "poisson" and value > NEARLY_INCOMPRESSIBLE


def _negative_terms(
    solution: Solution, values: Mapping[str, float], ended: Container[str]
) -> dict[str, float]:
    """Give the usual exponents a negative sign, and the same shear modulus."""
    ogden = any(
        part.material.name.startswith("ogden-")
        for each in solution.collocation.transcriptions
        for part in each.body.parts
    )
    starts: dict[str, float] = {}
    for name, ended_at in values.items():
        factor = name.removesuffix("alpha_1") + "mu_1_pa"
        is_first = without_region(name) == "alpha_1" and factor in values
        if ogden and is_first and name in ended and 0 < ended_at < 1:
            starts[name] = -USUAL_EXPONENTS[0]
            starts[factor] = -values[factor] * ended_at / USUAL_EXPONENTS[0]
    return starts


def _widened(
    item: Parameter, values: Mapping[str, float], ended: Container[str], locks: bool
) -> Parameter:
    """Widen default bounds; a parameter that may be negative is linear."""
    is_share = without_region(item.name) == SHARE.name
    if is_share and item.name not in ended:
        return item
    widened = with_widest_bounds(item)
    if locks and _is_nearly_half(item.name, item.upper):
        widened = replace(widened, upper=item.upper)
    if is_share and widened is not item:
        lower = max(widened.lower, 1e-3)  # whose logarithm is finite
        return replace(widened, lower=lower, scale="log", unit=1.0)
    if widened is not item and constant_named(item.name).may_be_negative and item.scale == "log":
        value = values[item.name]
        if value < 0 or (item.name in ended and value < 10 * item.lower):
            size = max(abs(values[each]) for each in values if is_modulus(each))
            return replace(widened, lower=-widened.upper, scale="linear", unit=0.1 * size)
    return widened


def usual_poisson_start(solution: Solution) -> Start | None:
    """Return a start from the usual Poisson's ratio, with the same Young's modulus, where a ratio above
    `NEARLY_INCOMPRESSIBLE` is estimated.
    """
    collocation = solution.collocation
    values = parameter_values(solution.collocation, solution.q)
    free = {item.name: item for item in collocation.parameters.free}
    changed: dict[str, float] = {}
    for name, ratio in values.items():
        if without_region(name) == "poisson" and ratio > NEARLY_INCOMPRESSIBLE:
            region = name.removesuffix("poisson")
            own = [region + each for each in LAME if region + each in free]
            if len(own) == 2 or own == [name]:
                young_pa = values[region + "young_pa"]
                changed |= {each: usual_value(each, young_pa) or 0.0 for each in own}
    if not changed or any(not free[n].lower < v < free[n].upper for n, v in changed.items()):
        return None
    estimates = {name: values[name] for name in free} | changed
    return Start(
        collocation.with_parameters(collocation.parameters.with_estimates(estimates)),
        scan=solution.scan,
        note="Poisson's ratio ended near one half; a second start, from the usual 0.3,",
    )


def other_exponents(solution: Solution) -> Start | None:
    """Return the start of the closed forms of specimens of a law in powers of the stretches; None if
    the solution fits as well.
    """
    are_specimens = all(each.experiment.specimen for each in solution.collocation.transcriptions)
    start = power_law_start(solution.collocation) if are_specimens else None
    if start is None:
        return None
    is_as_good = solution.history[-1].loss <= (1 + LEAST_SHARE) * start.loss
    if is_as_good and solution.status.converged:
        return None
    guesses = start.collocation.parameters.guesses
    exponents = sorted(value for name, value in guesses.items() if name.startswith("alpha_"))
    found = ", ".join(f"{exponent:.3g}" for exponent in exponents)
    note = f"a second start, from the exponents {found} of the closed forms,"
    return replace(start, note=note)


# A search beyond a bound may end at that of another parameter: of two shares of memory and a modulus.
BEYOND_BOUNDS: tuple[NextStart, ...] = 3 * (start_beyond_bounds,)
# Starts after a solution in reduced space.
SECOND_STARTS: tuple[NextStart, ...] = (usual_poisson_start, other_exponents, *BEYOND_BOUNDS)
