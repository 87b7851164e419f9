"""Solves from several stiffnesses of a scan, where there may be local minima.

Points measured by a camera are associated with the nearest part of the surface: a body that is too
soft, with the camera turned to match, can be a local minimum of the loss. So the scan's best
stiffness and those next to it are all followed to convergence, or to a minimum that is already
known, and the solution with the lowest loss counts. Without correspondences that is done where the
first solution needs an error of a pose or clock that nobody makes.

A second search starts where the first one may have ended in the worse of several optima:

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

from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..common.array_types import Array
from ..fem.laws.constants import (
    SHARE,
    USUAL_EXPONENTS,
    constant_named,
    is_limitless,
    is_modulus,
    usual_value,
    without_region,
)
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Iteration, Method, Solution, Watch
from ..methods.starts.initial_trajectories import associated_at_guess
from ..methods.starts.power_law import power_law_start
from ..methods.starts.start import Start
from ..methods.starts.stiffness_scan import Scan
from ..model.parameters import Parameter, Parameters, can_be_widened, with_widest_bounds
from ..program.collocation import Collocation
from ..statistics.linearised import AT_BOUND, parameter_values

# Difference of losses below which two solutions are the same minimum with other correspondences:
# in simulated recordings they differ by up to 5.
SAME_LOSS = 10.0
# Relative difference of all parameters below which a search with such a loss is where another one
# was, and need not continue. A first share of a recording determines them to several per cent.
SAME_PARAMETERS = 0.1
# Estimate of an error, in standard deviations of its prior, that makes a solution doubtful.
UNLIKELY = 4.5
Solve = Callable[[Method, Collocation], Solution]


def has_local_minima(collocation: Collocation) -> bool:
    """Return whether a fitted experiment has correspondences, which change during the search and
    can make local minima.
    """
    return any(
        transcription.association.correspondences for transcription in collocation.transcriptions
    )


def robust_loss(solution: Solution) -> float:
    """Return the loss with priors and with that of the measurements that the fit excludes.

    The loss of a solution leaves out points beyond the gate of a camera: compared by it, the
    solution that loses most points would seem the best.
    """
    collocation = solution.collocation
    p, _ = collocation.unpack(solution.z)
    prior, _ = collocation.prior_residuals(p)
    excluded_loss = sum(
        model.excluded_loss
        for part in solution.parts
        for model in part.transcription.main_residuals
    )
    return sum(part.loss for part in solution.parts) + float(prior @ prior) + excluded_loss


class KnownMinimum(Exception):
    """A search has arrived where another one was."""

    def __init__(self, solution: Solution) -> None:
        super().__init__()
        self.solution = solution


def until_known(method: Method, known: Sequence[Solution]) -> Method:
    """Return a method that raises `KnownMinimum` at an iterate of the search for a known solution."""

    def solve(
        collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        def watch_for_known(line: Iteration) -> None:
            """Pass an entry of the history to `watch`, then compare it with the known solutions."""
            if watch is not None:
                watch(line)
            for solution in known:
                if _is_at(line, solution):
                    raise KnownMinimum(solution)

        return method(collocation, watch_for_known, start)

    return solve if known else method


def _is_at(line: Iteration, solution: Solution) -> bool:
    return any(
        line.share == known.share
        and abs(line.loss - known.loss) <= SAME_LOSS
        and all(
            np.isclose(value, known.parameters[name], rtol=SAME_PARAMETERS, atol=0)
            for name, value in line.parameters.items()
        )
        for known in solution.history
    )


def _is_likely(solution: Solution) -> bool:
    p, _ = solution.collocation.unpack(solution.z)
    return bool((np.abs(p[solution.collocation.nq :]) <= UNLIKELY).all())


def follow_starts(
    solver: Method, start: Start, scan: Scan, solve: Solve
) -> tuple[Start, Solution | None]:
    """Follow the starts of a scan to convergence and return the one with the lowest `robust_loss`.

    Without local minima the first solution counts, unless one of its nuisance parameters is above
    `UNLIKELY`. The best start of the scan, `start`, is returned without a solution if the scan found
    only one start, or no start converges. Exceptions of `solve` are not caught.

    Parameters
    ----------
    solver : Method
        If this is not the reduced-space method, the starts are followed in reduced space, which is
        much faster, and the result has no solution: the solver goes on from the best start.
    start : Start
        With the guesses of the scan's best stiffness.
    solve : callable
        ``solve(method, collocation)``, with renewed correspondences.

    Returns
    -------
    (start, solution)
        The best start, not associated with the body there, with the scan that has it as its best and
        a note on the losses; and the solution from there if the method is reduced space.
    """
    collocation = start.collocation
    if not scan.others:
        return start, None
    is_unique = not has_local_minima(collocation)
    own = getattr(solver, "name", getattr(getattr(solver, "func", None), "name", ""))
    is_own = own == ReducedSpace.name
    if is_unique and not is_own:
        return start, None
    method: Method = solver if is_own else ReducedSpace()
    candidates: list[tuple[float, int, Solution]] = []
    for number in (scan.best, *scan.others):
        started = collocation
        if number != scan.best:
            started = collocation.with_parameters(scan.starts[number])
        if is_unique:  # otherwise the search associates cameras with its first shape itself
            started = associated_at_guess(started)
        try:
            solution = solve(until_known(method, [each for *_, each in candidates]), started)
        except KnownMinimum as known:
            candidates.append((robust_loss(known.solution), number, known.solution))
            continue
        if solution.status.converged:
            candidates.append((robust_loss(solution), number, solution))
        if is_unique and (not candidates or _is_likely(solution)):
            break
    if is_unique and len(candidates) < 2:
        return start, candidates[0][-1] if candidates else solution
    if not candidates:
        return start, None
    loss, best, solution = min(candidates, key=lambda each: each[0])
    losses = ", ".join(
        f"{each:.4g} from E = {scan.young_pa[number]:.3g} Pa" for each, number, _ in candidates
    )
    note = (
        f"{len(candidates)} initial values of the scan were solved to the end, or to a minimum that "
        f"another one had reached, with the losses {losses}"
    )
    if max(each for each, _, _ in candidates) - loss > SAME_LOSS:
        note += ": there are local minima; the lowest one is reported"
    chosen = replace(scan, best=best, parameters=scan.starts[best])
    started = collocation.with_parameters(scan.starts[best])
    chosen_start = replace(start, collocation=started, note=note, scan=chosen)
    return chosen_start, solution if is_own else None


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
    start = _usual_poisson_start(solution)
    if start is None and all(part.transcription.experiment.specimen for part in solution.parts):
        return _power_law_start(solution)
    return start


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
