"""Starts of a second search, where the first one may have ended in the worse of several optima.

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

import numpy as np

from ..fem.laws.constants import (
    SHARE,
    USUAL_EXPONENTS,
    constant_named,
    is_limitless,
    is_modulus,
    usual_value,
    without_region,
)
from ..methods.solution import Solution
from ..methods.starts.power_law import power_law_start
from ..methods.starts.start import Start
from ..model.parameters import Parameter, Parameters, can_be_widened, with_widest_bounds
from ..statistics.linearised import AT_BOUND, parameter_values

# Poisson's ratio above which a second search starts from the usual one at the same Young's modulus.
# Smaller ratios do not lock.
NEARLY_INCOMPRESSIBLE = 0.42
# Poisson's ratio of that start.
USUAL_POISSON = 0.3
# Names of the constants that determine Young's modulus and Poisson's ratio, two of them at a time.
LAME = ("young_pa", "poisson", "lambda_pa", "mu_pa")
# Least difference of an exponent, relative to one plus its size, of another optimum, and least
# share of χ² by which that is better.
OTHER_EXPONENT = 0.05
LEAST_SHARE = 0.01
# Least share of a branch of memory, whose logarithm is estimated beyond the default bound.
LITTLE_MEMORY = 1e-3


def second_start(solution: Solution) -> Start | None:
    """Return the start of a second search after a solution; None if a worse optimum is unlikely.

    The note of a second start says why there is one: a sentence without its predicate.
    """
    return _usual_poisson_start(solution) or _power_law_start(solution)


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
        note=f"the search ended at the default bound{'s' * (len(ended) > 1)} {listed}; a second one, "
        "with wider bounds,",
    )


def without_limitless_shares(solution: Solution) -> Parameters | None:
    """Return the estimates of a solution with the shares of memory fixed that grew to their largest
    value; None if there are none.

    Of a liquid the data determine E (1 + Σg), the instantaneous modulus, and neither factor.
    """
    parameters = solution.collocation.parameters
    values = parameter_values(solution.collocation, solution.q)
    fixed = {
        item.name: replace(item, guess=values[item.name], is_fixed=True)
        for item in parameters.free
        if is_limitless(item.name, values[item.name])
    }
    if not fixed:
        return None
    known = {item.name: values[item.name] for item in parameters.free}
    return parameters.with_estimates(known).map_components(lambda item: fixed.get(item.name, item))


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
        lower = max(widened.lower, LITTLE_MEMORY)
        return replace(widened, lower=lower, scale="log", unit=1.0)
    if widened is not item and constant_named(item.name).may_be_negative and item.scale == "log":
        value = values[item.name]
        if value < 0 or (item.name in ended and value < 10 * item.lower):
            size = max(abs(values[each]) for each in values if is_modulus(each))
            return replace(widened, lower=-widened.upper, scale="linear", unit=0.1 * size)
    return widened


def _usual_poisson_start(solution: Solution) -> Start | None:
    """Keep Young's modulus, where a ratio above `NEARLY_INCOMPRESSIBLE` is estimated."""
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
                changed |= {each: _usual_modulus(each, young_pa) for each in own}
    if not changed or any(not free[n].lower < v < free[n].upper for n, v in changed.items()):
        return None
    estimates = {name: values[name] for name in free} | changed
    return Start(
        collocation.with_parameters(collocation.parameters.with_estimates(estimates)),
        note="Poisson's ratio ended near one half; a second start, from the usual "
        f"{USUAL_POISSON},",
    )


def _usual_modulus(name: str, young_pa: float) -> float:
    """Return `USUAL_POISSON`, or the modulus [Pa] that follows from it and Young's modulus."""
    value = (
        USUAL_POISSON
        if without_region(name) == "poisson"
        else usual_value(name, young_pa, poisson=USUAL_POISSON)
    )
    assert value is not None
    return value


def _power_law_start(solution: Solution) -> Start | None:
    """None if the exponents are the same, or the closed forms fit as well."""
    collocation = solution.collocation
    start = power_law_start(collocation)
    if start is None:
        return None
    values = parameter_values(collocation, solution.q)
    guesses = start.collocation.parameters.guesses
    exponents = [
        sorted(value for name, value in each.items() if name.startswith("alpha_"))
        for each in (values, guesses)
    ]
    is_same = all(
        abs(ended - other) <= OTHER_EXPONENT * (1 + abs(other))
        for ended, other in zip(*exponents, strict=True)
    )
    is_as_good = solution.history[-1].loss <= (1 + LEAST_SHARE) * start.loss
    if is_same or (is_as_good and solution.status.converged):
        return None
    found = ", ".join(f"{exponent:.3g}" for exponent in exponents[1])
    note = f"a second start, from the exponents {found} of the closed forms,"
    return replace(start, note=note)
