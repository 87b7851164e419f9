"""The four material parameters: guesses, bounds, priors, and the coordinates they are solved in.

The solver works on q, the logarithms of the parameters that are not fixed, in the order of
`Parameters.free`. Whatever the user's elastic pair, the physics sees

    θ = (λ [Pa], μ [Pa], γ_r [s], γ_m [1/s]),

and the map q → θ with its derivatives is a CasADi expression.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from ..arrays import Array
from ..errors import InputError

LAME = ("lambda_pa", "mu_pa")
ENGINEERING = ("young_pa", "poisson")
DAMPING = ("gamma_r_s", "gamma_m_1_s")


class Theta(NamedTuple):
    """Physical parameters in the order every kernel expects."""

    lambda_pa: float
    mu_pa: float
    gamma_r_s: float
    gamma_m_1_s: float

    @property
    def young_pa(self) -> float:
        """Young's modulus E = μ (3λ + 2μ) / (λ + μ)."""
        return self.mu_pa * (3 * self.lambda_pa + 2 * self.mu_pa) / (self.lambda_pa + self.mu_pa)

    @property
    def poisson(self) -> float:
        """Poisson's ratio ν = λ / 2(λ + μ)."""
        return self.lambda_pa / (2 * (self.lambda_pa + self.mu_pa))


@dataclass(frozen=True)
class Parameter:
    """One parameter to estimate.

    Attributes
    ----------
    name : str
        With its unit, as in the problem file.
    guess : float
    lower, upper : float
        Bounds, positive.
    fixed : bool
        Kept at `guess`.
    prior : tuple (mean, relative standard deviation) or None
        A normal prior on the logarithm: ((ln value − ln mean) / deviation)² joins the loss.
    """

    name: str
    guess: float
    lower: float = 0.0
    upper: float = np.inf
    fixed: bool = False
    prior: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.fixed:
            if not (np.isfinite(self.guess) and self.guess >= 0):
                raise InputError(f"fixed = {self.guess:g}, expected a number >= 0", None, self.name)
            return
        if not 0 < self.lower < self.upper:
            raise InputError(
                f"lower = {self.lower:g}, upper = {self.upper:g}, expected 0 < lower < upper",
                None,
                self.name,
            )
        if not self.lower <= self.guess <= self.upper:
            raise InputError(
                f"guess = {self.guess:g}, expected a value within [{self.lower:g}, {self.upper:g}]",
                None,
                self.name,
            )
        if self.prior is not None and not (self.prior[0] > 0 and self.prior[1] > 0):
            raise InputError(
                f"prior = {self.prior}, expected positive mean and deviation", None, self.name
            )


@dataclass(frozen=True)
class Parameters:
    """All four parameters, two elastic ones in either convention and two of damping.

    Raises
    ------
    InputError
        For missing or mixed names, or a Poisson's ratio that can leave (0, 0.5).
    """

    items: tuple[Parameter, ...]

    def __post_init__(self) -> None:
        names = tuple(item.name for item in self.items)
        if names not in (LAME + DAMPING, ENGINEERING + DAMPING):
            raise InputError(
                f"parameters are {', '.join(names) or 'none'}; expected "
                f"{', '.join(LAME + DAMPING)}, or young_pa, poisson in place of the first two"
            )
        for item in self.items:
            top = item.guess if item.fixed else item.upper
            if item.name == "poisson" and not top < 0.5:
                raise InputError(
                    f"{'fixed' if item.fixed else 'upper'} = {top:g}, expected less than 0.5: "
                    "an incompressible body has no finite λ",
                    None,
                    "poisson",
                )

    @property
    def names(self) -> tuple[str, ...]:
        """The user's names, in order."""
        return tuple(item.name for item in self.items)

    @property
    def free(self) -> tuple[Parameter, ...]:
        """Those that are estimated, in the order of q."""
        return tuple(item for item in self.items if not item.fixed)

    @property
    def guess_q(self) -> Array:
        """(nq,) logarithms of the guesses."""
        return np.log([item.guess for item in self.free])

    @property
    def bounds_q(self) -> tuple[Array, Array]:
        """(nq,) lower and upper bounds of q."""
        return (
            np.log([item.lower for item in self.free]),
            np.log([item.upper for item in self.free]),
        )

    @cached_property
    def _map(self) -> ca.Function:
        q = ca.SX.sym("q", len(self.free))
        values: dict[str, ca.SX | float] = {item.name: item.guess for item in self.items}
        for k, item in enumerate(self.free):
            values[item.name] = ca.exp(q[k])
        if ENGINEERING[0] in values:
            young, poisson = values["young_pa"], values["poisson"]
            first = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
            second = young / (2 * (1 + poisson))
        else:
            first, second = values["lambda_pa"], values["mu_pa"]
        theta = ca.vertcat(first, second, values["gamma_r_s"], values["gamma_m_1_s"])
        jacobian = ca.jacobian(theta, q)
        hessians = [ca.densify(ca.hessian(theta[k], q)[0]) for k in range(4)]
        return ca.Function("theta", [q], [ca.SX(theta), ca.densify(jacobian), *hessians])

    def theta(self, q: Sequence[float] | Array) -> Theta:
        """Physical parameters at q (nq,)."""
        return Theta(*self._map(np.asarray(q))[0].full().ravel().tolist())

    def theta_derivatives(self, q: Array) -> tuple[Array, Array]:
        """∂θ/∂q (4, nq) and ∂²θ/∂q² (4, nq, nq)."""
        _, jacobian, *hessians = self._map(np.asarray(q))
        return jacobian.full(), np.array([h.full() for h in hessians])

    def values(self, q: Sequence[float] | Array) -> dict[str, float]:
        """The user's parameters at q, by name."""
        estimated = dict(zip((item.name for item in self.free), np.exp(q), strict=True))
        return {item.name: float(estimated.get(item.name, item.guess)) for item in self.items}

    def prior(self, q: Array) -> tuple[Array, Array]:
        """Residuals of the priors (nq,), zero where there is none, and their slopes (nq,)."""
        residuals, slopes = np.zeros(len(q)), np.zeros(len(q))
        for k, item in enumerate(self.free):
            if item.prior is not None:
                mean, deviation = item.prior
                residuals[k] = (q[k] - np.log(mean)) / deviation
                slopes[k] = 1 / deviation
        return residuals, slopes

    def with_guess(self, values: Mapping[str, float]) -> Parameters:
        """The same parameters with other guesses (fixed ones included).

        Raises
        ------
        InputError
            For a name that is not among them, or a guess out of bounds.
        """
        if unknown := sorted(set(values) - set(self.names)):
            raise InputError(f"no parameter {unknown[0]!r}; there are {', '.join(self.names)}")
        return Parameters(
            tuple(replace(i, guess=values[i.name]) if i.name in values else i for i in self.items)
        )


def as_theta(parameters: Parameters | Mapping[str, float] | Sequence[float]) -> Theta:
    """Physical parameters from guesses, a mapping by name, or (λ, μ, γ_r, γ_m).

    Raises
    ------
    InputError
        If names or numbers are missing.
    """
    if isinstance(parameters, Parameters):
        return parameters.theta(parameters.guess_q)
    if isinstance(parameters, Mapping):
        elastic = LAME if LAME[0] in parameters else ENGINEERING
        missing = [name for name in elastic + DAMPING if name not in parameters]
        if missing:
            raise InputError(f"parameters lack {', '.join(missing)}")
        return as_theta(
            Parameters(
                tuple(Parameter(n, float(parameters[n]), fixed=True) for n in elastic + DAMPING)
            )
        )
    if len(parameters) != len(Theta._fields):
        expected = ", ".join(Theta._fields)
        raise InputError(f"{len(parameters)} parameters given, expected four: {expected}")
    return Theta(*map(float, parameters))
