"""How small the error bars are: one number, the logarithm of a relative error bar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ...arrays import Array
from ...errors import InputError, hint_at
from ...model.parameters import Parameters, ThetaMap
from ...statistics.estimates import UNDETERMINED, relative_slopes
from ...statistics.linearised import Derived

Kind = Literal["worst", "A", "D"]
Over = Literal["mean", "worst"]


@dataclass(frozen=True)
class Criterion:
    """What is to be small.

    Attributes
    ----------
    kind : {"worst", "A", "D"}
        The largest error bar, their root mean square, or the size of their joint ellipsoid: the
        geometric mean of its half axes.
    names : tuple of str
        Parameters and derived moduli that count; every estimated parameter by default. Of one
        alone all kinds are the same.
    over : {"mean", "worst"}
        Over draws of θ: of the geometric mean, or of the largest.

    Raises
    ------
    InputError
        For an unknown kind.
    """

    kind: Kind = "worst"
    names: tuple[str, ...] = ()
    over: Over = "mean"

    def __post_init__(self) -> None:
        for option, chosen, known in (
            ("--criterion", self.kind, get_args(Kind)),
            ("--over", self.over, get_args(Over)),
        ):
            if chosen not in known:
                raise InputError(
                    f"found {chosen!r}; expected one of {', '.join(known)}", None, option
                )

    def log_size(self, errors: Errors) -> float:
        """The logarithm of the error bar that is to be small."""
        slopes = errors.slopes_of(self.names)
        covariance = slopes @ errors.covariance @ slopes.T
        if self.kind == "D":
            return float(np.linalg.slogdet(covariance)[1]) / (2 * len(covariance))
        variances = np.diag(covariance)
        return 0.5 * float(np.log(variances.max() if self.kind == "worst" else variances.mean()))

    def over_draws(self, sizes: Sequence[float]) -> float:
        """One number of those at several θ."""
        return float(np.max(sizes) if self.over == "worst" else np.mean(sizes))

    def require_known(self, errors: Errors) -> None:
        """Refuse names that are not estimated, and for "D" those that follow from one another.

        Raises
        ------
        InputError
        """
        known = list(errors.slopes)
        for name in self.names:
            if name not in known:
                raise InputError(
                    f"found {name!r}; expected some of {', '.join(known)}{hint_at(name, known)}",
                    None,
                    "--for",
                )
        slopes = errors.slopes_of(self.names)
        if self.kind == "D" and np.linalg.matrix_rank(slopes) < len(slopes):
            raise InputError(
                f"of {', '.join(self.names)} one follows from the others, so that their ellipsoid "
                "has no size; name fewer, or choose --criterion A or worst",
                None,
                "--for",
            )


@dataclass(frozen=True, eq=False)
class Errors:
    """Relative error bars at one θ, to first order.

    Attributes
    ----------
    covariance : (nq, nq) of q
    values : by name, parameters that are estimated, and derived moduli
    slopes : by name, (nq,) relative change of each by q
    estimated : number of parameters, the first of the names
    """

    covariance: Array
    values: dict[str, float]
    slopes: dict[str, Array]
    estimated: int

    @classmethod
    def of(
        cls, information: Array, parameters: Parameters, constants: ThetaMap, q: Array
    ) -> Errors:
        """From the information (nq, nq) of all recordings; priors of the parameters join it.

        No error bar becomes larger than `UNDETERMINED` times a parameter: that much is as good as
        nothing, and the sizes of motions that tell nothing can be compared.
        """
        sizes = relative_slopes(parameters, q)
        prior = parameters.prior(q)[1] ** 2 + (sizes / UNDETERMINED) ** 2
        units = 1 / np.sqrt(np.diag(information) + prior)
        scaled = units[:, None] * (information + np.diag(prior)) * units
        covariance = units[:, None] * np.linalg.inv(scaled) * units
        values = {
            item.name: item.value(float(c)) for item, c in zip(parameters.free, q, strict=True)
        }
        slopes = dict(zip(values, np.diag(sizes), strict=True))
        derived = Derived.of([constants], q)
        moving = {name: by_q for name, by_q in derived.by_q.items() if by_q.any()}
        values |= {name: derived.values[name] for name in moving}
        slopes |= {name: by_q / derived.values[name] for name, by_q in moving.items()}
        return cls(covariance, values, slopes, len(parameters.free))

    def slopes_of(self, names: Sequence[str]) -> Array:
        """(k, nq) of those names, of the estimated parameters where there are none."""
        chosen = names or list(self.slopes)[: self.estimated]
        return np.array([self.slopes[name] for name in chosen])

    @property
    def relative(self) -> dict[str, float]:
        """Standard errors over values, by name."""
        return {
            name: float(np.sqrt(slope @ self.covariance @ slope))
            for name, slope in self.slopes.items()
        }


def draws_about(parameters: Parameters, spread: float, pairs: int, seed: int) -> list[Array]:
    """Draws (nq,) of q: the middle, then pairs on either side of it.

    A parameter with a prior is drawn from that. Others lie about their guess: logarithms within a
    standard deviation of ln `spread`, linear ones of `spread` − 1 times their typical size.
    """
    middle = parameters.guess_q.copy()
    deviation = np.array(
        [np.log(spread) if item.scale == "log" else spread - 1 for item in parameters.free]
    )
    for k, item in enumerate(parameters.free):
        if item.prior is not None:
            middle[k] = item.q(item.prior[0])
            deviation[k] = item.prior[1] / (1.0 if item.scale == "log" else item.unit)
    return both_sides(parameters, middle, np.diag(deviation), pairs, seed)


def both_sides(
    parameters: Parameters, middle: Array, root: Array, pairs: int, seed: int
) -> list[Array]:
    """The middle of a normal distribution of q, and draws on either side, within the bounds."""
    rng = np.random.default_rng(seed)
    ways = [root @ rng.normal(size=len(middle)) for _ in range(pairs)]
    lower, upper = parameters.bounds_q
    inside = 1e-3 * np.minimum(upper - lower, 1.0)
    draws = [middle, *(middle + sign * way for way in ways for sign in (1, -1))]
    return [np.clip(q, lower + inside, upper - inside) for q in draws]
