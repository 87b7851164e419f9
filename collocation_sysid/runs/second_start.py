"""Starts of a second search, where the first one may have ended in the worse of several optima.

- *Poisson's ratio near one half*: linear elements lock towards ν = ½, so that with a smaller
  modulus
  and a ratio near one half a body can move almost like a stiffer, compressible one.
- *Exponents of two terms in powers of the stretches*: the two exponents have the same sign in one
  optimum and opposite signs in another, and no search crosses an exponent of zero, at which the
  term vanishes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ..fem.laws.constants import usual_value, without_region
from ..methods.solution import Solution
from ..model.parameters import Parameters
from ..statistics.linearised import parameter_values

# Poisson's ratio above which a second search starts from the usual one at the same Young's modulus.
# Smaller ratios do not lock.
NEARLY_INCOMPRESSIBLE = 0.42
# Poisson's ratio of that start.
USUAL_POISSON = 0.3
# Names of the constants that determine Young's modulus and Poisson's ratio, two of them at a time.
LAME = ("young_pa", "poisson", "lambda_pa", "mu_pa")
# Factor and exponent of the second term, and the exponent of the third one.
SECOND_FACTOR = "mu_2_pa"
SECOND_EXPONENT = "alpha_2"
THIRD_EXPONENT = "alpha_3"
# Second exponent of the other start; rubber in tension and compression needs a negative one.
NEGATIVE_EXPONENT = -2.0


@dataclass(frozen=True)
class SecondStart:
    """Start of a second search.

    Attributes
    ----------
    parameters : Parameters
        Parameters with the start as guesses.
    reason : str
        Why there is a second search, and its start: a sentence without its predicate.
    """

    parameters: Parameters
    reason: str


def second_start(solution: Solution) -> SecondStart | None:
    """Return the start of a second search after a converged solution; None if a worse optimum is
    unlikely.
    """
    return _usual_poisson_start(solution) or _negative_exponent_start(solution)


def _usual_poisson_start(solution: Solution) -> SecondStart | None:
    """Return the parameters at a solution, as guesses, with high Poisson's ratios replaced by the
    usual one at the same Young's modulus.

    A ratio is high above `NEARLY_INCOMPRESSIBLE`. Only ratios of regions count in which both
    moduli, or the ratio alone, are estimated. Other estimated parameters have their estimates as
    guesses. None if no ratio is high, or if a replaced value is not within its bounds.
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
                changed |= {each: _usual_modulus(each, young_pa) for each in own}
    if not changed:
        return None
    return _changed_start(
        collocation.parameters,
        values,
        changed,
        reason="Poisson's ratio ended near one half; a second start, from the usual "
        f"{USUAL_POISSON},",
    )


def _usual_modulus(name: str, young_pa: float) -> float:
    """Return the starting value of the constant `name`, one of the `LAME` constants with its
    region: `USUAL_POISSON` for a Poisson's ratio, or the modulus [Pa] that follows from it and from
    Young's modulus `young_pa`.
    """
    value = (
        USUAL_POISSON
        if without_region(name) == "poisson"
        else usual_value(name, young_pa, poisson=USUAL_POISSON)
    )
    assert value is not None
    return value


def _negative_exponent_start(solution: Solution) -> SecondStart | None:
    """Return the guesses of a solution with a negative second exponent.

    The second factor keeps the contribution μ₂ α₂ of its term to the shear modulus in Ogden's law.
    None unless all recordings are tests of homogeneous specimens, in which a search takes seconds,
    the law has two terms of which the second is estimated, and its exponent began and ended
    positive; also if the new guesses are not within their bounds.
    """
    collocation = solution.collocation
    free = {item.name: item for item in collocation.parameters.free}
    names = [item.name for item in collocation.parameters.components]
    if (
        any(each.specimen is None for each in collocation.experiments)
        or not {SECOND_FACTOR, SECOND_EXPONENT} <= free.keys()
        or THIRD_EXPONENT in names
    ):
        return None
    guesses = collocation.parameters.guesses
    ended = parameter_values(collocation, solution.q)[SECOND_EXPONENT]
    if min(guesses[SECOND_EXPONENT], ended) <= 0:
        return None
    changed = {SECOND_EXPONENT: NEGATIVE_EXPONENT}
    if "beta_1" not in names:  # in foam the factors alone are shear moduli
        changed[SECOND_FACTOR] = (
            guesses[SECOND_FACTOR] * guesses[SECOND_EXPONENT] / NEGATIVE_EXPONENT
        )
    return _changed_start(
        collocation.parameters,
        guesses,
        changed,
        reason=f"the exponent α₂ ended at {ended:.3g}; a second start, from {NEGATIVE_EXPONENT:g},",
    )


def _changed_start(
    parameters: Parameters, values: Mapping[str, float], changed: Mapping[str, float], reason: str
) -> SecondStart | None:
    """Return the start from values of the estimated parameters, some of them changed, all by name;
    None if a changed value is not within its bounds.
    """
    free = {item.name: item for item in parameters.free}
    if any(not free[n].lower < v < free[n].upper for n, v in changed.items()):
        return None
    start = {name: values[name] for name in free} | dict(changed)
    return SecondStart(parameters.with_estimates(start), reason)
