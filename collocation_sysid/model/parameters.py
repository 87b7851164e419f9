"""What is estimated: guesses, bounds, priors, ties, and the coordinates they are solved in.

The solver works on q, one number for each parameter that is free, in the order of
`Parameters.free`: the logarithm of a positive parameter, or a linear one over what it may change
by in a step. Parameters have the names of the model's constants, or of moduli that stand for them;
`ThetaMap` leads from q to the constants θ of a body, with derivatives by CasADi.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import casadi as ca
import numpy as np

from ..arrays import Array
from ..checked import Finite, Positive
from ..errors import InputError, hint_at
from ..fem.body import Body
from ..fem.constants import (
    INSTANTANEOUS,
    Scale,
    bare,
    constant_named,
    is_density,
    is_mode,
    is_modulus,
    usual_value,
)
from ..fem.moduli import ENGINEERING, engineering
from .generated import Generated


@dataclass(frozen=True)
class Unknown:
    """A parameter to estimate, as a user states it; what is left out follows from its constant.

    Attributes
    ----------
    guess : float, optional
        Where the search starts; found by a scan of the stiffness by default.
    lower, upper : float, optional
        Bounds.
    prior : (mean, deviation), optional
        A normal prior: on the logarithm, with a relative deviation; of a linear parameter, with
        an absolute one.
    scale : {"log", "linear"}, optional
        Whether the logarithm of a positive number is estimated, or any number.
    typical : float, optional
        What a linear parameter may change by in a step; its guess where its constant tells none.
    """

    guess: Finite | None = None
    lower: Finite | None = None
    upper: Finite | None = None
    prior: tuple[float, float] | None = None
    scale: Scale | None = None
    typical: Positive | None = None


# What the table of a parameter may hold in a problem file.
KEYS = (*(field.name for field in fields(Unknown)), "fixed", "tied_to", "ratio")


@dataclass(frozen=True)
class Tied:
    """A parameter that is a multiple of another.

    Attributes
    ----------
    to : str
    ratio : float
    """

    to: str
    ratio: float = 1.0


@dataclass(frozen=True)
class Parameter:
    """One parameter of a problem.

    Attributes
    ----------
    name : str
        With its unit, and the region in front if it has one.
    guess : float or None
        None where a scan is to find it.
    lower, upper : float
        Bounds; positive for a logarithm.
    fixed : bool
        Kept at `guess`.
    prior : tuple (mean, deviation) or None
        A normal prior: ((ln value − ln mean) / deviation)² joins the loss, or for a linear
        parameter ((value − mean) / deviation)².
    scale : {"log", "linear"}
    unit : float
        What a linear parameter changes by where its q changes by one; NaN until the scan of the
        stiffness tells.
    tied : Tied or None
        Follows another parameter; guess and bounds then do not count.
    """

    name: str
    guess: float | None
    lower: float = 0.0
    upper: float = np.inf
    fixed: bool = False
    prior: tuple[float, float] | None = None
    scale: Scale = "log"
    unit: float = 1.0
    tied: Tied | None = None

    def __post_init__(self) -> None:
        if self.tied is not None:
            return
        if self.fixed:
            self._check_fixed()
            return
        least = 0.0 if self.scale == "log" else constant_named(self.name).at_least
        if not least <= self.lower < self.upper or (self.scale == "log" and self.lower == 0):
            raise InputError(
                f"lower = {self.lower:g}, upper = {self.upper:g}, expected "
                f"{'0 < ' if self.scale == 'log' else '0 <= ' if least == 0 else ''}lower < upper",
                None,
                self.name,
            )
        if self.guess is not None and not self.lower <= self.guess <= self.upper:
            raise InputError(
                f"guess = {self.guess:g}, expected a value within [{self.lower:g}, {self.upper:g}]",
                None,
                self.name,
            )
        self._refuse_beyond(self.upper, "upper")
        if self.prior is not None and not (
            self.prior[1] > 0 and (self.prior[0] > 0 or self.scale == "linear")
        ):
            raise InputError(
                f"prior = {self.prior}, expected positive mean and deviation", None, self.name
            )

    def _check_fixed(self) -> None:
        constant = constant_named(self.name)
        least = constant.at_least if self.scale == "linear" else constant.least
        value = np.nan if self.guess is None else self.guess
        if not (np.isfinite(value) and value >= least):
            expected = "a number" if least < 0 else "a number >= 0"
            raise InputError(f"fixed = {value:g}, expected {expected}", None, self.name)
        self._refuse_beyond(value, "fixed")

    def _refuse_beyond(self, value: float, what: str) -> None:
        if not value < (limit := constant_named(self.name).below):
            why = ": an incompressible body has no finite λ" if bare(self.name) == "poisson" else ""
            raise InputError(
                f"{what} = {value:g}, expected less than {limit:g}{why}", None, self.name
            )

    def q(self, value: float) -> float:
        """The solver's coordinate of a value."""
        return float(np.log(value)) if self.scale == "log" else value / self.unit

    def value(self, q: float) -> float:
        """The value at a solver's coordinate."""
        return float(np.exp(q)) if self.scale == "log" else q * self.unit

    def per_value(self, value: float) -> float:
        """Derivative of the value by q."""
        return value if self.scale == "log" else self.unit


# Where the search for the contrast of two phases starts if nothing is known of it: where it is 1,
# the loss does not depend on where the phases are.
FIRST_CONTRAST = 2.0


def parameter(name: str, given: Unknown | Tied | float) -> Parameter:
    """A parameter as stated, completed by what its constant says.

    Raises
    ------
    InputError
        For a guess out of bounds, a linear parameter without a size, or one that has no guess
        and of which no usual value is known.
    """
    constant = constant_named(name)
    if isinstance(given, Tied):
        return Parameter(name, 0.0, tied=given)
    if not isinstance(given, Unknown):
        return Parameter(name, float(given), fixed=True)
    scale = given.scale or constant.scale
    low, high = constant.bounds
    if scale == "linear" and constant.scale == "log":
        low = -high
    if scale == "log" and low <= 0:
        low = 1e-9 * high
    if given.guess is None and given.prior is None and usual_value(name, 1.0) is None:
        raise InputError(
            "no guess is given and no usual value is known of it; expected guess = a value",
            None,
            name,
        )
    # The size of a modulus without a guess follows from the scan.
    size = np.nan if is_modulus(name) else 0.0
    size = size if given.guess is None else abs(given.guess)
    typical = given.typical or constant.typical or size
    if scale == "linear" and typical == 0:
        found = "no guess" if given.guess is None else "guess = 0"
        raise InputError(
            f"{found} of a linear parameter does not tell its size; expected typical, what it "
            "may change by in a step",
            None,
            name,
        )
    try:
        return Parameter(
            name,
            None if given.guess is None else float(given.guess),
            low if given.lower is None else float(given.lower),
            high if given.upper is None else float(given.upper),
            prior=(0.0, 1.0) if given.prior is None and is_mode(name) else given.prior,
            scale=scale,
            unit=float(typical) if scale == "linear" else 1.0,
        )
    except InputError as error:
        if given.lower is not None and given.upper is not None:
            raise
        message = f"{error.message}; where lower or upper is not given, these bounds are assumed"
        raise InputError(message, None, name) from error


@dataclass(frozen=True)
class Parameters:
    """All parameters of a problem.

    Raises
    ------
    InputError
        For a name given twice, or a tie to a parameter that is not there or is tied itself.
    """

    items: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "items", tuple(self.items))
        for name, count in Counter(self.names).items():
            if count > 1:
                raise InputError("given twice, expected one value", None, name)
        rooted = [item.name for item in self.items if item.tied is None]
        for item in self.items:
            if item.tied is not None and item.tied.to not in rooted:
                raise InputError(
                    f"tied to {item.tied.to!r}, expected a parameter that is estimated or fixed: "
                    f"{', '.join(rooted)}{hint_at(item.tied.to, rooted)}",
                    None,
                    item.name,
                )

    def __repr__(self) -> str:
        told = (item for item in self.items if not is_mode(item.name))
        return f"Parameters({', '.join(map(_stated, told))})"

    @classmethod
    def of(cls, given: Mapping[str, Unknown | Tied | float]) -> Parameters:
        """Parameters by name; a number is a fixed value."""
        return cls(tuple(parameter(name, value) for name, value in given.items()))

    def with_fields(self, bodies: Iterable[Body]) -> Parameters:
        """Return these and the coefficients and contrasts of fields that are not stated.

        A stated contrast without a prior gets that of its field.
        """
        bodies = tuple(bodies)
        names = dict.fromkeys(name for body in bodies for name in body.mode_names)
        priors = {
            name: (1.0, deviation) for body in bodies for name, deviation in body.contrasts.items()
        }
        own = (
            replace(item, prior=priors[item.name])
            if item.name in priors and item.prior is None and not item.fixed
            else item
            for item in self.items
        )
        contrasts = (
            parameter(name, Unknown(FIRST_CONTRAST, prior=prior))
            for name, prior in priors.items()
            if name not in self.names
        )
        modes = (parameter(name, Unknown(0.0)) for name in names if name not in self.names)
        return Parameters((*own, *contrasts, *modes))

    def fixed_at(self, values: Mapping[str, float]) -> Parameters:
        """Those of these names, all with these values."""
        own = (item for item in self.items if item.name in values)
        return Parameters(
            tuple(replace(item, guess=values[item.name], fixed=True, tied=None) for item in own)
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The user's names, in order."""
        return tuple(item.name for item in self.items)

    @cached_property
    def free(self) -> tuple[Parameter, ...]:
        """Those that are estimated, in the order of q."""
        return tuple(item for item in self.items if not item.fixed and item.tied is None)

    @property
    def linear(self) -> frozenset[str]:
        """Names of those that are not found by their logarithms."""
        return frozenset(item.name for item in self.items if item.scale == "linear")

    def scale_and_bounds(self, name: str) -> tuple[bool, tuple[float, float]]:
        """Return whether an estimate is its own coordinate, and its (lower, upper) bounds.

        The bounds of a derived modulus, or of a fixed or tied parameter, are infinite.
        """
        item = next((each for each in self.free if each.name == name), None)
        if item is None:
            return name in self.linear, (-np.inf, np.inf)
        return item.scale == "linear", (item.lower, item.upper)

    @property
    def unguessed(self) -> tuple[str, ...]:
        """Names of those that are estimated without a guess."""
        return tuple(item.name for item in self.free if item.guess is None)

    @property
    def guess_q(self) -> Array:
        """(nq,) coordinates of the guesses.

        Raises
        ------
        InputError
            Where there is none.
        """
        return np.array([item.q(_guess(item)) for item in self.free])

    @property
    def bounds_q(self) -> tuple[Array, Array]:
        """(nq,) lower and upper bounds of q."""
        return (
            np.array([item.q(item.lower) for item in self.free]),
            np.array([item.q(item.upper) for item in self.free]),
        )

    def expressions(self, q: ca.SX) -> dict[str, ca.SX]:
        """Every parameter as an expression in q, by name."""
        found = {item.name: ca.SX(item.guess or 0.0) for item in self.items}
        for k, item in enumerate(self.free):
            found[item.name] = ca.exp(q[k]) if item.scale == "log" else q[k] * item.unit
        for item in self.items:
            if item.tied is not None:
                found[item.name] = item.tied.ratio * found[item.tied.to]
        return found

    def values(self, q: Sequence[float] | Array) -> dict[str, float]:
        """Every parameter at q, by name."""
        found = {item.name: float(item.guess or 0.0) for item in self.items}
        for item, coordinate in zip(self.free, q, strict=True):
            found[item.name] = item.value(float(coordinate))
        for item in self.items:
            if item.tied is not None:
                found[item.name] = item.tied.ratio * found[item.tied.to]
        return found

    @property
    def guesses(self) -> dict[str, float]:
        """Every parameter at its guess, by name; an `InputError` where one has none."""
        return self.values(self.guess_q)

    def prior(self, q: Array) -> tuple[Array, Array]:
        """Residuals of the priors (nq,), zero where there is none, and their slopes (nq,)."""
        residuals, slopes = np.zeros(len(q)), np.zeros(len(q))
        for k, item in enumerate(self.free):
            if item.prior is not None:
                mean, deviation = item.prior
                slopes[k] = (1.0 if item.scale == "log" else item.unit) / deviation
                residuals[k] = (q[k] - item.q(mean)) * slopes[k]
        return residuals, slopes

    def with_guess(self, values: Mapping[str, float]) -> Parameters:
        """The same parameters with other guesses (fixed ones included).

        Raises
        ------
        InputError
            For a name that is not among them, or a guess out of bounds.
        """
        if unknown := sorted(set(values) - set(self.names)):
            raise InputError(
                f"no parameter {unknown[0]!r}; there are {', '.join(self.names)}"
                f"{hint_at(unknown[0], self.names)}"
            )
        return Parameters(
            tuple(replace(i, guess=values[i.name]) if i.name in values else i for i in self.items)
        )

    def with_fixed(self, values: Mapping[str, float]) -> Parameters:
        """The same parameters, some of them fixed."""
        return Parameters(
            tuple(
                Parameter(i.name, values[i.name], fixed=True) if i.name in values else i
                for i in self.items
            )
        )

    def fit(self, bodies: Iterable[Body]) -> None:
        """Refuse parameters that do not give the constants of the bodies.

        Raises
        ------
        InputError
            For a name that none of them knows, a constant that is missing or given twice, or a
            stiffness of zero.
        """
        bodies = list(bodies)
        known = [name for body in bodies for name in body.parameter_names]
        for name in self.names:
            if name not in known:
                parameter, _, key = name.rpartition(".")
                if parameter in known:  # a misspelt key of a parameter's table reads like a region
                    raise InputError(
                        f"unknown key; expected one of {', '.join(KEYS)}{hint_at(key, KEYS)}",
                        None,
                        name,
                    )
                expected = ", ".join(dict.fromkeys(n for body in bodies for n in body.constants))
                raise InputError(
                    f"no such parameter; the model's are {expected}{hint_at(name, known)}",
                    None,
                    name,
                )
        used = {name for body in bodies for name in body.used_names(self.names)}
        used |= {item.tied.to for item in self.items if item.tied is not None}
        for name in self.names:
            if name not in used:
                raise InputError(
                    "no part of the model uses it: every region has a value of its own", None, name
                )
        for item in self.items:
            stiff = bare(item.name) in ("mu_pa", "young_pa")
            if item.fixed and item.guess == 0 and (stiff or is_density(item.name)):
                what = "a stiffness" if stiff else "a density"
                raise InputError(f"fixed = 0, expected {what} above 0", None, item.name)


def _guess(item: Parameter) -> float:
    if item.guess is None:
        raise InputError(
            "there is no guess of it; expected guess = a value here (solve and check find one)",
            None,
            item.name,
        )
    return item.guess


def _stated(item: Parameter) -> str:
    if item.tied is not None:
        return f"{item.name} = {item.tied.ratio:g} × {item.tied.to}"
    if item.fixed:
        return f"{item.name} = {item.guess:g}"
    start = "" if item.guess is None else f" from {item.guess:g}"
    return f"{item.name}{start} in [{item.lower:g}, {item.upper:g}]"


@dataclass(frozen=True, eq=False)
class ThetaMap:
    """The constants θ of a body, and moduli derived from them, as functions of q."""

    parameters: Parameters
    body: Body

    def expression(self, q: ca.SX, _: ca.SX | None = None) -> ca.SX:
        """(k,) θ."""
        return ca.vertcat(*self.body.assembled(self.parameters.expressions(q)))

    def theta(self, q: Sequence[float] | Array) -> Array:
        """(k,) constants at q."""
        return self._theta.value(_numbers(q), NOTHING)

    def slopes(self, q: Array) -> Array:
        """∂θ/∂q (k, nq)."""
        return self._theta.slopes(_numbers(q), NOTHING)[1]

    @property
    def derived_names(self) -> tuple[str, ...]:
        """Names of the derived moduli."""
        return self._derived[0]

    def derived(self, q: Array) -> tuple[Array, Array]:
        """Their values, and derivatives by q."""
        return self._derived[1].slopes(_numbers(q), NOTHING)

    @cached_property
    def _theta(self) -> Generated:
        return Generated(self.expression, len(self.parameters.free), 0)

    @cached_property
    def _derived(self) -> tuple[tuple[str, ...], Generated]:
        names, body = self.parameters.names, self.body
        found, _ = _derived(names, body, self.expression(ca.SX.sym("q", self._theta.inputs)))

        def values(q: ca.SX, _: ca.SX) -> ca.SX:
            return _derived(names, body, self.expression(q))[1]

        return found, Generated(values, self._theta.inputs, 0)


# Data of an expression of q alone.
NOTHING = np.zeros(0)


def _numbers(q: Sequence[float] | Array) -> Array:
    return np.asarray(q, dtype=np.float64)


def _derived(names: Sequence[str], body: Body, theta: ca.SX) -> tuple[tuple[str, ...], ca.SX]:
    """(E, ν) of every part at small strain; (λ, μ) of those that are given by (E, ν).

    With memory these are the long-term moduli, and E(1 + Σg) is the instantaneous one.
    """
    found: dict[str, ca.SX] = {}
    shares = body.split(theta)
    for part, share, source in zip(body.parts, shares, body.sources(names), strict=True):
        lame = part.material.lame(share[: len(part.material.constants)])
        young, poisson = engineering(lame[0], lame[1])
        moduli = {"young_pa": young, "poisson": poisson, "lambda_pa": lame[0], "mu_pa": lame[1]}
        by_young = "young_pa" in source.names
        front = f"{part.name}."
        shares_all = not any(name.startswith(front) for name in source.names.values())
        if found and shares_all:
            continue  # it has the moduli of the rest
        for own, value in moduli.items():
            if own not in source.names and (own in ENGINEERING or by_young):
                found[part.full_name(own)] = value
        if part.prony:
            of_memory = share[part.of_law : part.of_law + 2 * len(part.prony)]
            found[part.full_name(INSTANTANEOUS.name)] = young * (1 + ca.sum1(of_memory[::2]))
    return tuple(found), ca.vertcat(*found.values()) if found else ca.SX(0, 1)


def theta_of(
    body: Body, given: Parameters | Mapping[str, float] | Sequence[float] | Array
) -> Array:
    """Constants of a body from guesses, values by name, or θ itself.

    Raises
    ------
    InputError
        If names or numbers are missing, or unknown.
    """
    if isinstance(given, Parameters):
        return body.theta(given.guesses)
    if isinstance(given, Mapping):
        Parameters.of(given).fit([body])
        return body.theta(given)
    if len(given) != len(body.constants):
        raise InputError(
            f"{len(given)} parameters given, expected {len(body.constants)}: "
            f"{', '.join(body.constants)}"
        )
    return np.array(given, dtype=float)
