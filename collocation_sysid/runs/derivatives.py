"""Taylor test of the derivatives at the guess, on the first samples of every experiment."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from ..common.array_types import Array
from ..errors import InputError
from ..fem.laws.materials import DampingLaw
from ..problem import Problem
from ..program.collocation import Collocation, convert_variables
from ..program.lifted.collocation import lifted_nonzeros, with_lifted_variables
from ..recording.experiment import Experiment
from ..recording.measurement_selection import shortened_experiment

# First samples of a motion that contain all kinds of equations; more would not change derivatives.
SAMPLES = 12
# Number of first samples of a static experiment that contain all kinds of equations.
STATIC_SAMPLES = 3
# Steps along a random direction, in scaled z. Remainders at the smallest are rounding errors.
STEPS = 0.1 * 4.0 ** -np.arange(19)
ROUNDED = 3
# Ratio of a remainder to these, above which its rate is known to some per cent.
CLEAR = 30.0
# Pairs of steps, the smallest with clear remainders, whose median counts: where a remainder changes
# sign, one rate is too high and the next too low.
PAIRS = 3
# Largest difference of a rate from its order: the nearest whole number counts.
RATE_TOLERANCE = 0.5
DERIVATIVES = ("value", "first derivative", "second derivative")
# Order of the remainder that each derivative leaves.
ORDERS = {
    f"{derivative} of the {name}": order
    for name in ("loss", "constraints")
    for order, derivative in enumerate(DERIVATIVES, start=1)
}
# Most nonzeros of lifted variables for which the whole program is laid out and checked.
MOST_LIFTED_NONZEROS = 5e6
UNDAMPED = DampingLaw("none", (), stress=lambda _, F, rate: (0 * rate, ca.SX(9, 9)))


def shortened_problem(problem: Problem, more: int = 0) -> Problem:
    """Return the problem with the first samples of every experiment, also of those for validation:
    at least `STATIC_SAMPLES` or `SAMPLES`, and `more`, or, if there are fewer, all, see
    `shortened_experiment`.
    """
    short = []
    for each in problem.experiments:
        count = (STATIC_SAMPLES if each.is_static else SAMPLES) + more
        short.append(shortened_experiment(each, count, shortens_sensors=True))
    return replace(problem, experiments=short)


def taylor_rates(collocation: Collocation, z: Array) -> dict[str, float]:
    """Return the rates at which the remainders of Taylor's formula decrease with the step h.

    Along a random direction d near z, the same in every call, |f(z + h d) − f(z)| is O(h), without
    h f′d O(h²), and without h²/2 dᵀf″d O(h³); f is the loss, and the constraints times random
    multipliers. Eliminated variables are tested as well as lifted ones, of which f″ is known.

    Parameters
    ----------
    collocation : Collocation
        Program without lifted variables.
    z : (variables,) array
        Start; not modified.

    Returns
    -------
    dict of str to float
        Rates by derivative; infinite where a remainder is only rounding. Without second derivatives
        if the program with lifted variables is too large to be laid out.
    """
    program = with_lifted_variables(collocation)
    if program is collocation:
        return _rates(collocation, z, has_second=True)
    rates = _rates(collocation, z, has_second=False)
    if sum(lifted_nonzeros(program)) > MOST_LIFTED_NONZEROS:
        return rates
    lifted = _rates(program, convert_variables(z, collocation, target=program), has_second=True)
    return {name: min(rate, rates.get(name, rate)) for name, rate in lifted.items()}


def _rates(program: Collocation, z: Array, has_second: bool) -> dict[str, float]:
    rng = np.random.default_rng(0)
    point = z + 1e-3 * rng.normal(size=len(z))
    direction = rng.normal(size=len(z))
    multipliers = rng.normal(size=program.constraint_count)
    functions: dict[str, tuple[Callable[[Array], float], Array, float, Array]] = {
        "loss": (program.objective, program.gradient(point), 1.0, 0 * multipliers),
        "constraints": (
            lambda at: float(multipliers @ program.constraint_values(at)),
            program.jacobian_vjp(point, multipliers),
            0.0,
            multipliers,
        ),
    }
    rates = {}
    for name, (function, slope, weight, own) in functions.items():
        terms = [0.0, slope @ direction]
        if has_second:
            terms.append(direction @ program.hessian(point, weight, own) @ direction / 2)
        value = function(point)
        remainder = np.array([function(point + h * direction) - value for h in STEPS])
        for power, (derivative, term) in enumerate(zip(DERIVATIVES, terms, strict=False)):
            remainder = remainder - STEPS**power * term
            rates[f"{derivative} of the {name}"] = _rate(np.abs(remainder))
    return rates


def _rate(remainders: Array) -> float:
    is_clear = remainders > CLEAR * remainders[-ROUNDED:].max()
    pairs = np.flatnonzero(is_clear[:-1] & is_clear[1:])[-PAIRS:]
    rates = np.log(remainders[pairs] / remainders[pairs + 1]) / np.log(STEPS[0] / STEPS[1])
    return float(np.median(rates)) if len(pairs) else np.inf


def derivative_fault(collocation: Collocation, z: Array, rates: Mapping[str, float]) -> str:
    """Return a sentence on the first derivative whose rate is too low, and on the term of the
    program that has it without the others, too; empty if there is none.

    Parameters
    ----------
    collocation, z, rates
        See `taylor_rates`.
    """
    wrong = [name for name, rate in rates.items() if _is_low(name, rate)]
    if not wrong:
        return ""
    name = wrong[0]
    alone = _rates_of_terms(collocation, z, name)
    term, rate = next((each for each in alone if _is_low(name, each[1])), ("program", rates[name]))
    return (
        f"The {name} is wrong in the {term}: found a Taylor remainder of order {rate:.2f} in the "
        f"step, expected {ORDERS[name]}; correct the derivatives of this term, see the checks of "
        "collocation_sysid.testing."
    )


def _is_low(name: str, rate: float) -> bool:
    return not rate >= ORDERS[name] - RATE_TOLERANCE


def _rates_of_terms(collocation: Collocation, z: Array, name: str) -> Iterator[tuple[str, float]]:
    """Yield each term of the loss or of the constraints with the rate of the program that has no
    other one; for the loss of priors and the constraints of the material they always remain.
    """
    values = dict(zip(collocation.parameter_names, collocation.parameters_from(z), strict=True))
    for part in collocation.iterates(z):
        experiment = part.transcription.experiment
        terms = _measurements(experiment) if "loss" in name else _forces(experiment)
        for term, changed in terms.items():
            with suppress(InputError):  # a recording may be impossible without its other terms
                alone = changed()
                known = collocation.parameters
                unused = {*known.names} - alone.body.used_names(known.names)
                program = replace(
                    collocation,
                    experiments=[alone],
                    parameters=known.without(unused),
                    associations={},
                )
                x = part.x[:, : program.transcriptions[0].dof_count]
                point = program.pack(program.with_values(values, program.guess_p), [x])
                yield (
                    f"{term} of experiment {experiment.name!r}",
                    taylor_rates(program, point)[name],
                )


def _measurements(experiment: Experiment) -> dict[str, Callable[[], Experiment]]:
    """Return functions that return the experiment with one measurement alone, by its title."""
    every = experiment.measurements
    return {
        f"measurement {each.title!r}": partial(
            experiment.with_measurements, [other if other is each else None for other in every]
        )
        for each in every
    }


def _forces(experiment: Experiment) -> dict[str, Callable[[], Experiment]]:
    """Return functions that return the experiment with elastic forces alone, by the names of the
    materials, and then with one further force each, by its name.
    """
    body, parts = experiment.body, experiment.body.parts
    elastic = body.with_parts(tuple(replace(part, damping=UNDAMPED) for part in parts), forces=())
    bare: dict[str, Any] = {
        "body": elastic,
        "grasps": experiment.body_grasps,
        "tendons": (),
        "pressures": (),
        "nuisance": replace(experiment.nuisance, own=()),
        "known_deviations": {},
        "air_density_kg_m3": "none",
    }
    materials, dampings = (
        " or ".join(dict.fromkeys(repr(law.name) for law in laws))
        for laws in ((p.material for p in parts), (p.damping for p in parts))
    )
    further: dict[str, dict[str, Any]] = {
        f"material {materials}": {},
        f"damping law {dampings}": {"body": body.with_parts(parts, forces=())},
        **{
            f"force {force.name!r}": {"body": elastic.with_parts(elastic.parts, forces=(force,))}
            for force in body.forces
        },
        **{f"tendon {each.name!r}": {"tendons": (each,)} for each in experiment.tendons},
        **{f"pressure {each.name!r}": {"pressures": (each,)} for each in experiment.pressures},
        **{
            f"obstacle {each.name!r}": {"grasps": (*experiment.body_grasps, each)}
            for each in experiment.obstacles
        },
        "deviations of the stiffness": {
            key: getattr(experiment, key) for key in ("nuisance", "known_deviations")
        },
        "air drag": {"air_density_kg_m3": experiment.air_density_kg_m3},
    }
    return {
        name: lambda own=own: replace(experiment, **bare | own) for name, own in further.items()
    }
