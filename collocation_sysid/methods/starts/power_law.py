"""Start of laws in powers of the stretches, from the closed forms of homogeneous specimens.

For given exponents the stress of Ogden's law is linear in its factors, and that of a foam too if
all its terms have the same β. So the factors follow from linear least squares for every combination
of exponents of a grid (variable projection, Golub and Pereyra 1973), and the best combinations are
improved in all constants. This takes a fraction of a second, and does not stop where two terms run
together, as a search from a single guess does.

Laws with fewer terms, and with one β for all terms, are fitted in the same way. Of the laws that
explain the measurements equally well the one with the fewest constants counts; the measurements do
not determine the constants of the stated law that it lacks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise

import numpy as np
import scipy
from numpy.typing import NDArray

from ...common.array_types import Array
from ...fem.laws.constants import constant_named, symbol_of
from ...fem.laws.ogden import is_power_law, term_numbers
from ...model.parameters import Parameter, Tied, with_widest_bounds
from ...program.collocation import Collocation
from ...recording.experiment import Experiment
from ...recording.homogeneous_deformation import AXES
from ...recording.specimen import LATERAL_NAME, SECOND_STRESS_NAME, STRESS_NAME
from ...recording.specimen_files import deformed_gradients
from .initial_trajectories import simulate_trajectories
from .start import Start

# Sizes of the exponents of the grid, each with both signs.
GRID = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 15.0, 18.0, 22.0)
# β of the grid; the largest one is nearly incompressible.
BETA_GRID = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 20.0)
# Least distance of two exponents: nearer ones are one term and its derivative by the exponent,
# with factors of opposite signs that grow without bound.
SEPARATION = 0.5
# Combinations of the grid that are improved.
MOST_IMPROVED = 4
# Difference of χ², over χ² of one measurement, up to which fits count as equal: smaller exponents
# are then preferred.
EQUAL_LOSS = 4.0
# Least decrease of χ² per constant that a larger law has more, over χ² of one measurement: normal
# noise exceeds it in 1 of 1000 fits.
LEAST_GAIN = 10.8
# Deviation of χ² from its mean that chance allows, in its standard deviations.
MOST_DEVIATIONS = 3.0
# Largest χ² of one measurement with two exponents that run together: of a misfit of the law itself
# they explain a little more with factors that cancel, and a search among such terms does not end.
MOST_TOGETHER = 2.0


@dataclass(frozen=True, eq=False)
class _Stress:
    # Direction; in simple shear that of the larger principal stretch, of a difference that of the
    # first stress.
    axis: int
    values: Array  # (T,)
    sigma: Array  # (T,) or (1,)
    # (2,): prior standard deviations of the relative error of the area and of the zero; 0 if exact.
    deviations: Array


@dataclass(frozen=True, eq=False)
class _Test:
    gradient: Array  # (T, 3, 3): prescribed deformation gradients, 1 where the specimen is free
    per_strain: Array  # (3, 3): derivative of the gradient by an offset of all strains
    free_axes: list[int]  # directions in which the specimen is free to contract
    test: str  # kind of test, see `Specimen`
    # Prior standard deviation of a constant offset of the first strain; 0 if exact.
    strain_zero: float
    stresses: list[_Stress]
    lateral: tuple[Array, Array] | None  # (values (T,), sigma) or None: measured free stretch

    @property
    def free(self) -> int:
        """Number of directions in which the specimen is free to contract."""
        return len(self.free_axes)

    @property
    def measurements(self) -> int:
        values = [stress.values for stress in self.stresses]
        values += [self.lateral[0]] if self.lateral is not None else []
        return sum(int(np.isfinite(each).sum()) for each in values)

    def log_stretches(self, offset: float) -> Array:
        """Return logarithms (T, 3) of the stretches, 0 where free; in shear the larger last."""
        gradient = self.gradient + offset * self.per_strain
        x, y, z = np.einsum("tii->it", gradient)
        shear = gradient[:, 0, 2]
        if self.test == "simple-shear":
            total = np.hypot(x + z, shear)
            difference = np.copysign(np.hypot(x - z, shear), shear)
            x, z = (total - difference) / 2, (total + difference) / 2
        elif self.test == "biaxial-difference":
            x, z = z - shear, z + shear
        return np.log(np.column_stack([x, y, z]))


@dataclass(frozen=True, eq=False)
class _Fit:
    """Fit of a law with n terms, whose exponents ascend."""

    loss: float  # χ² of the measurements
    # (n,): exponents, and shares of the shear modulus.
    alpha: Array
    shear_pa: Array
    beta: Array | None  # (n,) or None: none for an incompressible law
    has_one_beta: bool  # whether all terms share one estimated β
    constants: int  # number of fitted constants of the law
    # Errors of strains and stresses over their prior standard deviations; none without them.
    deviations: Array

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Successive exponents that run together: they are as near as they may be."""
        successive = pairwise(range(len(self.alpha)))
        return [(a, b) for a, b in successive if self.alpha[b] - self.alpha[a] < 1.01 * SEPARATION]


@dataclass(frozen=True, eq=False)
class PowerLawStart(Start):
    """Start of a law in powers of the stretches: guesses of its factors, exponents and β; those that
    the measurements do not determine are fixed or tied, and named in the note.
    """

    # Young's modulus of an incompressible body with these constants, for the other guesses.
    young_pa: float = 0.0
    loss: float = np.inf  # χ² of the closed form at the start
    is_at_bound: bool = False  # whether an exponent is at the largest one that is allowed
    # Errors of strains and stresses of all tests over their prior standard deviations.
    deviations: Array = field(default_factory=lambda: np.zeros(0))

    def fitted_variables(self, collocation: Collocation) -> Array | None:
        """Return z of a simulation at the guesses of `collocation` with the errors of the closed
        forms; None if they are not all nuisance parameters, or the simulation fails.
        """
        p = np.append(collocation.parameters.guess_q, self.deviations)
        if len(p) != len(collocation.guess_p):
            return None
        positions, failure = simulate_trajectories(collocation, p)
        return collocation.pack(p, positions) if failure is None else None


def power_law_start(collocation: Collocation) -> PowerLawStart | None:
    """Return the start of a law in powers of the stretches; None unless all recordings are, as
    they must be, tests of homogeneous specimens, of one such law without memory, whose factors and
    exponents are all estimated without ties and priors.

    Guesses are replaced, bounds are kept, except that the default bounds of the first term admit
    exponents of both signs. No constant is fixed if one of the law has a guess: who states a guess
    asks for this term.
    """
    fits = _PowerLawFits.of(collocation, _with_both_signs)
    start = None if fits is None else fits.start()
    if start is None or not start.is_at_bound:
        return start
    # Wider bounds are no better start of others: bounded searches depend on them.
    wider = _PowerLawFits.of(collocation, _widened)
    other = None if wider is None else wider.start()
    return start if other is None or other.loss >= start.loss else other


class _PowerLawFits:
    """Closed forms of the tests of one law, and their least-squares fits."""

    def __init__(
        self,
        collocation: Collocation,
        tests: Sequence[_Test],
        is_foam: bool,
        widened: Callable[[Parameter], Parameter],
    ) -> None:
        self.collocation = collocation
        self.parameters = parameters = collocation.parameters
        self.tests = tests
        self.is_foam = is_foam
        self.items = {item.name: widened(item) for item in parameters.components}
        self.terms = len(term_numbers(self.items))
        self.measurements = sum(test.measurements for test in tests)
        sigmas = [
            np.append(test.strain_zero, np.ravel([each.deviations for each in test.stresses]))
            for test in tests
        ]
        self.prior_sigmas = np.array([each for each in np.concatenate(sigmas) if each])
        alphas = [self.items[f"alpha_{p}"] for p in self._numbers()]
        self.lowest = min(item.lower for item in alphas)
        self.highest = max(item.upper for item in alphas)
        betas = [self.items[f"beta_{p}"] for p in self._numbers()] if is_foam else []
        self.beta_is_free = np.array([not b.is_fixed and b.tied is None for b in betas], dtype=bool)
        self.stated_beta = np.array([b.guess if b.is_fixed else np.nan for b in betas], dtype=float)
        self.beta_bounds = (
            max((item.lower for item in betas if not item.is_fixed), default=0.0),
            min((item.upper for item in betas if not item.is_fixed), default=1.0),
        )

    @classmethod
    def of(
        cls, collocation: Collocation, widened: Callable[[Parameter], Parameter]
    ) -> _PowerLawFits | None:
        experiments = [each.experiment for each in collocation.transcriptions]  # fitted ones
        parts = [part for each in experiments for part in each.body.parts]
        laws = {part.material.name for part in parts}
        parameters = collocation.parameters
        estimated = {item.name for item in parameters.free if item.prior is None}
        own = [name for name in parameters.names if name.startswith(("mu_", "alpha_"))]
        if (
            len(laws) != 1
            or not is_power_law(law := laws.pop())
            or any(part.prony for part in parts)
            or not set(own) <= estimated
            or any(item.tied is not None for item in parameters.components)
        ):
            return None
        is_foam = law.startswith("hyperfoam-")
        tests = [test for each in experiments if (test := _test(each, is_foam))]
        fits = cls(collocation, tests, is_foam, widened)
        return fits if own and fits.measurements > len(own) else None

    def _numbers(self) -> range:
        return range(1, self.terms + 1)

    # Closed forms -------------------------------------------------------------------------------

    def _system(self, alpha: Array, beta: Array | None) -> tuple[Array, Array]:
        """Return predictions (m, n) by shares of the shear modulus, and measured values (m,)."""
        # Measured lateral stretches have rows of zeros; their values are measured minus free.
        rows, right = [], []
        for test in self.tests:
            logs = test.log_stretches(0.0)
            free = _free_stretch(test, logs, alpha, np.ones(len(alpha)), beta)
            for stress in test.stresses:
                matrix = _nominal_stresses(test, logs, stress.axis, free, alpha, beta)
                rows.append(matrix / stress.sigma[:, None])
                right.append(stress.values / stress.sigma)
            if test.lateral is not None:
                values, sigma = test.lateral
                rows.append(np.zeros((len(values), len(alpha))))
                right.append((values - np.exp(free)) / sigma)
        matrix, measured = np.concatenate(rows), np.concatenate(right)
        known = np.isfinite(measured)
        return matrix[known], measured[known]

    def _residuals(
        self, alpha: Array, shear_pa: Array, beta: Array | None, deviations: Array
    ) -> Array:
        """Return all residuals in standard deviations; `deviations` are over their priors."""
        parts = [deviations]
        values = iter(deviations * self.prior_sigmas)
        for test in self.tests:
            logs = test.log_stretches(next(values) if test.strain_zero else 0.0)
            free = _free_stretch(test, logs, alpha, shear_pa, beta)
            for stress in test.stresses:
                predicted = _nominal_stresses(test, logs, stress.axis, free, alpha, beta) @ shear_pa
                area, zero = (next(values) if sigma else 0.0 for sigma in stress.deviations)
                residual = ((1 + area) * predicted + zero - stress.values) / stress.sigma
                parts.append(residual[np.isfinite(residual)])
            if test.lateral is not None:
                residual = (np.exp(free) - test.lateral[0]) / test.lateral[1]
                parts.append(residual[np.isfinite(residual)])
        return np.concatenate(parts)

    def _exponents(self, distances: Array) -> Array:
        """Return exponents from the first one and the distances of the others, none of them 0."""
        alpha = np.minimum(np.cumsum(distances), self.highest)
        return np.where(np.abs(alpha) < 1e-5, 1e-5, alpha)  # quotients by α would lose digits

    # Fits ---------------------------------------------------------------------------------------

    def _may_be_first(self, alpha: Array, shear_pa: Array) -> NDArray[np.bool_]:
        """Return whether terms may be the first one, by the bounds of its exponent and factor."""
        first = self.items["alpha_1"]
        factor = shear_pa if self.is_foam else shear_pa * alpha
        is_positive = (factor > 0) | (_has_default_bounds(self.items["mu_1_pa"]))
        return (alpha >= first.lower) & (alpha <= first.upper) & is_positive

    def _starts(self, terms: int) -> list[tuple[Array, float | None]]:
        """Return the best exponents, with β, of the grid."""
        grid = np.array(sorted(sign * size for size in GRID for sign in (1, -1)))
        grid = grid[(grid >= self.lowest) & (grid <= self.highest)]
        chosen = np.array(list(combinations(range(len(grid)), terms)))
        betas: Sequence[float | None] = (None,)
        if self.is_foam:
            stated = self.stated_beta[np.isfinite(self.stated_beta)]
            betas = BETA_GRID if not len(stated) else [float(np.mean(stated))]
        found = []
        for beta in betas:
            own = None if beta is None else np.full(len(grid), beta)
            matrix, measured = self._system(grid, own)
            matrix = matrix / np.linalg.norm(matrix, axis=0)
            gram, right = matrix.T @ matrix, matrix.T @ measured
            blocks = gram[chosen[:, :, None], chosen[:, None, :]] + 1e-12 * np.eye(terms)
            sides = right[chosen]
            shares = np.linalg.solve(blocks, sides[:, :, None])[:, :, 0]
            loss = measured @ measured - (shares * sides).sum(axis=1)
            loss[~self._may_be_first(grid[chosen], shares).any(axis=1)] = np.inf
            best = np.argsort(loss)[: 4 * MOST_IMPROVED]
            found += [(loss[k], grid[chosen[k]], beta) for k in best if np.isfinite(loss[k])]
        starts: list[tuple[Array, float | None]] = []
        for _, alpha, beta in sorted(found, key=lambda each: each[0]):
            if all((alpha != other).any() for other, _ in starts):
                starts.append((alpha, beta))
        return starts[:MOST_IMPROVED]

    def _fit(self, terms: int) -> _Fit | None:
        projected = [self._project(alpha, beta) for alpha, beta in self._starts(terms)]
        fits = [fit for fit in projected if fit]
        if not fits:
            return None
        least = min(fit.loss for fit in fits)
        equal = least + EQUAL_LOSS * max(1.0, least / self.measurements)
        # A uniaxial test alone hardly distinguishes α from −2α, and planar tests and shear do not
        # distinguish α from −α, of which the positive one counts.
        best = min(
            (fit for fit in fits if fit.loss <= equal),
            key=lambda fit: np.sum(np.abs(fit.alpha) - 0.01 * fit.alpha),
        )
        return self._improve(best)

    def _project(self, alpha: Array, beta: float | None) -> _Fit | None:
        """Return the fit with one β and without deviations; None if no term may be the first."""
        # Variables are the first exponent, the distances of the others, and β if it is estimated;
        # the shares of the shear modulus follow from linear least squares.
        n = len(alpha)
        count = int(beta is not None and self.beta_is_free[:n].any())

        def linear(x: Array) -> tuple[Array, Array | None, Array, Array]:
            """Return exponents, β, shares, and residuals."""
            exponents = self._exponents(x[:n])
            betas = None if beta is None else np.full(n, x[-1] if count else beta)
            matrix, measured = self._system(exponents, betas)
            scale = np.linalg.norm(matrix, axis=0)
            shares = np.linalg.lstsq(matrix / scale, measured, rcond=1e-12)[0] / scale
            return exponents, betas, shares, matrix @ shares - measured

        low, high = self.beta_bounds
        lower = np.r_[self.lowest, np.full(n - 1, SEPARATION), np.full(count, low)]
        upper = np.r_[self.highest, np.full(n - 1, np.inf), np.full(count, high)]
        start = np.r_[alpha[0], np.diff(alpha), np.full(count, beta or 0.0)]
        result = _least_squares(lambda x: linear(x)[-1], start, lower, upper)
        alpha, betas, shares, _ = linear(result.x)
        if not self._may_be_first(alpha, shares).any():
            return None
        return _Fit(2 * float(result.cost), alpha, shares, betas, True, 2 * n + count, np.zeros(0))

    def _improve(self, fit: _Fit, has_one_beta: bool = True) -> _Fit | None:
        """Return the fit with deviations and, unless `has_one_beta`, a β of each term."""
        n = len(fit.alpha)
        size, beta = fit.shear_pa, fit.beta
        is_free = self.beta_is_free[:n]
        count = int(min(1, is_free.sum()) if has_one_beta else is_free.sum())
        fixed = None if beta is None else np.where(is_free, beta, self.stated_beta[:n])

        def unpacked(x: Array) -> tuple[Array, Array, Array | None, Array]:
            """Return exponents, shares, β and deviations."""
            betas = None if fixed is None else fixed.copy()
            if betas is not None and count:
                betas[is_free] = x[2 * n : 2 * n + count]
            return self._exponents(x[:n]), x[n : 2 * n] * size, betas, x[2 * n + count :]

        low, high = self.beta_bounds
        infinite, others = np.full(n, np.inf), np.full(len(self.prior_sigmas), np.inf)
        lower = np.r_[
            self.lowest, np.full(n - 1, SEPARATION), -infinite, np.full(count, low), -others
        ]
        upper = np.r_[self.highest, infinite[1:], infinite, np.full(count, high), others]
        free_beta = np.zeros(0) if beta is None else beta[is_free][:count]
        start = np.r_[
            fit.alpha[0], np.diff(fit.alpha), np.ones(n), free_beta, np.zeros(len(others))
        ]
        result = _least_squares(lambda x: self._residuals(*unpacked(x)), start, lower, upper)
        alpha, shares, betas, deviations = unpacked(result.x)
        if not self._may_be_first(alpha, shares).any():
            return None
        constants = 2 * n + count
        return _Fit(
            2 * float(result.cost), alpha, shares, betas, has_one_beta, constants, deviations
        )

    def _is_stable(self, fit: _Fit) -> bool:
        """Return whether the law resists shear in each principal plane at all measured stretches.

        In a plane of principal directions i and j this is Σ_p G_p (λ_i^α_p + λ_j^α_p) > 0 with the
        shares G_p of the shear modulus.
        """
        for test in self.tests:
            logs = test.log_stretches(0.0)
            free = _free_stretch(test, logs, fit.alpha, fit.shear_pa, fit.beta)
            logs[:, test.free_axes] = free[:, None]
            moduli = np.stack([_power(each, fit.alpha) @ fit.shear_pa for each in logs.T])
            if min((moduli[i] + moduli[j]).min() for i, j in combinations(range(3), 2)) <= 0:
                return False
        return True

    def _smallest_sufficient(self, fits: Sequence[_Fit]) -> _Fit:
        """Return the fit with the fewest constants that no larger law improves clearly.

        If σ is more than what the best law leaves, σ contains more than noise: then the fit with the
        fewest constants counts that explains the measurements within σ.
        """
        fits = sorted(fits, key=lambda fit: fit.constants)
        freedom = max(1, self.measurements - fits[-1].constants)
        chance = MOST_DEVIATIONS * np.sqrt(2 * freedom)
        if min(fit.loss for fit in fits) < freedom - chance:
            return next(fit for fit in fits if fit.loss <= freedom + chance)
        unit = max(1.0, min(fit.loss for fit in fits) / freedom)
        for k, fit in enumerate(fits):
            gains = [
                (fit.loss - larger.loss) / unit / max(1, larger.constants - fit.constants)
                for larger in fits[k + 1 :]
            ]
            if max(gains, default=0.0) <= LEAST_GAIN:
                return fit
        return fits[-1]

    def start(self) -> PowerLawStart | None:
        names = [f"{key}_{p}{unit}" for p in self._numbers() for key, unit in _KEYS]
        has_guess = any(
            item.guess is not None and not item.is_fixed
            for item in self.parameters.components
            if item.name in names
        )
        fits = self._fits([self.terms] if has_guess else self._numbers(), may_tie=not has_guess)
        admissible = list(filter(self._is_admissible, fits))
        if has_guess and fits and not admissible:
            fits += self._fits(self._numbers()[:-1], may_tie=True)
            admissible = list(filter(self._is_admissible, fits))
            has_guess = not admissible
        if not fits:
            return None
        chosen = self._smallest_sufficient(admissible or fits)
        is_unstable = any(
            each.loss < chosen.loss and not self._is_stable(each)
            for each in fits
            if len(each.alpha) > len(chosen.alpha)
        )
        return self._with_fit(chosen, may_fix=not has_guess, is_unstable=is_unstable)

    def _fits(self, numbers: Iterable[int], may_tie: bool) -> list[_Fit]:
        """Return the fits of laws with numbers of terms; those with one β too if `may_tie`."""
        fits = []
        for terms in numbers:
            fit = self._fit(terms)
            own = None
            if fit and terms > 1 and self.beta_is_free.sum() > 1:
                own = self._improve(fit, has_one_beta=False)
            fits += [each for each in (own or fit, fit if own and may_tie else None) if each]
        return fits

    def _is_admissible(self, fit: _Fit) -> bool:
        """Whether the law is stable, and exponents that run together explain the measurements."""
        explains = fit.loss < MOST_TOGETHER * self.measurements
        return (explains or not fit.pairs) and self._is_stable(fit)

    def _with_fit(self, fit: _Fit, may_fix: bool, is_unstable: bool) -> PowerLawStart:
        """Return the start from a fit; constants that it lacks are fixed or tied if `may_fix`."""
        may_be_first = self._may_be_first(fit.alpha, fit.shear_pa)
        order = sorted(
            range(len(fit.alpha)), key=lambda k: (not may_be_first[k], -abs(fit.shear_pa[k]))
        )
        # The first term comes first, the others follow by their size.
        order = [order[0], *sorted(order[1:], key=lambda k: -abs(fit.shear_pa[k]))]
        guesses: dict[str, float] = {}
        fixed: dict[str, float] = {}
        tied: dict[str, Tied] = {}
        for p, k in enumerate(order, start=1):
            shear_pa, alpha = float(fit.shear_pa[k]), float(fit.alpha[k])
            guesses[f"alpha_{p}"] = alpha
            guesses[f"mu_{p}_pa"] = shear_pa if self.is_foam else 2 * shear_pa / alpha
            if fit.beta is not None and self.beta_is_free[p - 1]:
                guesses[f"beta_{p}"] = float(fit.beta[k])
                if p > 1 and fit.has_one_beta and may_fix and self.beta_is_free[0]:
                    tied[f"beta_{p}"] = Tied("beta_1")
        near = [order.index(max(pair, key=order.index)) + 1 for pair in fit.pairs]
        notes = []
        if may_fix:
            fixed |= {f"alpha_{p}": guesses.pop(f"alpha_{p}") for p in near}
            for p in range(len(order) + 1, self.terms + 1):
                fixed |= {
                    f"mu_{p}_pa": 0.0,
                    f"alpha_{p}": constant_named(f"alpha_{p}").usual or 1.0,
                }
                if self.is_foam and self.beta_is_free[p - 1]:
                    fixed[f"beta_{p}"] = 0.0
            notes = self._notes(len(order), is_unstable, near=near, tied=tied, fixed=fixed)
        young_pa = 3 * max(abs(float(fit.shear_pa.sum())), 1e-3 * float(np.abs(fit.shear_pa).max()))
        parameters = self.parameters.map_components(
            lambda item: _started(self.items[item.name], guesses, fixed=fixed, tied=tied)
        )
        is_at_bound = not (
            0.99 * self.lowest < fit.alpha.min() and fit.alpha.max() < 0.99 * self.highest
        )
        return PowerLawStart(
            self.collocation.with_parameters(parameters),
            note="; ".join(notes),
            young_pa=young_pa,
            loss=fit.loss,
            is_at_bound=is_at_bound,
            deviations=fit.deviations,
        )

    def _notes(
        self,
        terms: int,
        is_unstable: bool,
        near: Sequence[int],
        tied: Mapping[str, Tied],
        fixed: Mapping[str, float],
    ) -> list[str]:
        notes = []
        if terms < self.terms:
            zero = ", ".join(symbol_of(f"mu_{p}_pa") for p in range(terms + 1, self.terms + 1))
            why = ""
            if is_unstable:
                why = ", because with more terms the law that fits is unstable at their stretches"
            notes.append(
                f"the measurements determine {terms} of {self.terms} terms of the law: {zero} = 0{why}"
            )
        for p in near:
            name = f"alpha_{p}"
            notes.append(
                f"two exponents run together: {symbol_of(name)} is held at {fixed[name]:.3g}, at a "
                f"distance of {SEPARATION:g} from the next one"
            )
        if tied:
            names = ", ".join(symbol_of(name) for name in tied)
            notes.append(
                f"the measurements determine one β only: {names} "
                f"{'equals' if len(tied) == 1 else 'equal'} {symbol_of('beta_1')}"
            )
        return notes


# Beginning and end of the names of the constants of a term.
_KEYS = (("mu", "_pa"), ("alpha", ""), ("beta", ""))


def _has_default_bounds(item: Parameter) -> bool:
    is_free = not item.is_fixed and item.tied is None
    return is_free and item.has_default_bound(0) and item.has_default_bound(1)


def _with_both_signs(item: Parameter) -> Parameter:
    """Return the first exponent with default bounds that admit both signs."""
    if item.name != "alpha_1" or not _has_default_bounds(item):
        return item
    return replace(item, lower=-item.upper)


def _widened(item: Parameter) -> Parameter:
    """Return an exponent with its widest bounds, which admit both signs."""
    if not item.name.startswith("alpha_") or not _has_default_bounds(item):
        return item
    return with_widest_bounds(item)


def _with_factor(item: Parameter, value: float) -> Parameter:
    """Return a factor with its guess, linear if that is negative or very small."""
    if item.scale == "log" and _has_default_bounds(item) and value < 10 * item.lower:
        item = replace(item, scale="linear", lower=-item.upper)
    value = float(np.clip(value, item.lower, item.upper))
    unit = abs(value) if item.scale == "linear" and value else item.unit
    return replace(item, guess=value, unit=unit)


def _least_squares(
    residuals: Callable[[Array], Array], start: Array, lower: Array, upper: Array
) -> scipy.optimize.OptimizeResult:
    inside = np.clip(start, lower, upper)
    return scipy.optimize.least_squares(residuals, inside, bounds=(lower, upper), x_scale="jac")


def _started(
    item: Parameter,
    guesses: Mapping[str, float],
    fixed: Mapping[str, float],
    tied: Mapping[str, Tied],
) -> Parameter:
    if item.name in tied:
        return Parameter(item.name, 0.0, tied=tied[item.name])
    if item.name in fixed:
        scale = item.scale if fixed[item.name] else "linear"
        return Parameter(item.name, fixed[item.name], is_fixed=True, scale=scale)
    if item.name in guesses and item.name.startswith("mu_"):
        return _with_factor(item, guesses[item.name])
    if item.name in guesses:
        return replace(item, guess=float(np.clip(guesses[item.name], item.lower, item.upper)))
    return item


def _free_stretch(
    test: _Test, logs: Array, alpha: Array, shear_pa: Array, beta: Array | None
) -> Array:
    """Return the logarithm (T,) of the stretch without stress across; else zeros."""
    prescribed = logs.sum(axis=1)
    if not test.free or beta is None:
        return -prescribed / max(1, test.free) * (test.free > 0)
    mean = float(np.mean(beta))
    free = -mean / (1 + test.free * mean) * prescribed
    if np.ptp(beta) < 1e-12:
        return free
    weights = shear_pa / alpha
    for _ in range(20):  # Newton's method for Σ g/α (λ^α − J^(−αβ)) = 0 in ln λ
        stretched = _power(free, alpha)
        pressed = _power(prescribed + test.free * free, -alpha * beta)
        value = (stretched - pressed) @ weights
        slope = (stretched + test.free * beta * pressed) @ (weights * alpha)
        step = np.divide(value, slope, out=np.zeros_like(value), where=slope != 0)
        free = free - np.clip(step, -0.3, 0.3)
        if np.abs(step).max(initial=0.0) < 1e-12:
            break
    return free


def _nominal_stresses(
    test: _Test, logs: Array, axis: int, free: Array, alpha: Array, beta: Array | None
) -> Array:
    """Return the nominal stress (T, n) of each term with a share of the shear modulus of 1:
    (2/α) (λ^α − v^α) / λ, where v is the free stretch of an incompressible specimen, or J^(−β).

    In simple shear it is (2/α) (λ^(α−1) ∂λ + ν^(α−1) ∂ν) with the derivatives of the principal
    stretches λ and ν in the plane of shear by F_xz; of a difference of true stresses, multiplied by
    J, it is (2/α) (λ^α − ν^α).
    """
    stretch = logs[:, axis]
    size = np.exp(stretch)
    if test.test == "simple-shear":
        other = np.exp(logs[:, 0])
        # F_xz² = (λ − ν)² − (F_xx − F_zz)².
        gap = test.gradient[:, 0, 0] - test.gradient[:, 2, 2]
        share = np.divide(gap, size - other, out=np.zeros_like(size), where=gap != 0)
        ratio = np.sqrt(np.maximum(0.0, 1 - share**2))
        turned = ratio * (size - other) / (size + other)
        of_larger, of_smaller = ((turned + sign * ratio) / 2 for sign in (1, -1))
        return (2 / alpha) * (
            _power(stretch, alpha - 1) * of_larger[:, None]
            + _power(logs[:, 0], alpha - 1) * of_smaller[:, None]
        )
    if test.test == "biaxial-difference":
        pressed, size = _power(logs[:, 0], alpha), np.ones_like(size)
    elif beta is None:
        pressed = _power(free, alpha)
    else:
        pressed = _power(logs.sum(axis=1) + test.free * free, -alpha * beta)
    return 2 / alpha * (_power(stretch, alpha) - pressed) / size[:, None]


def _power(logarithm: Array, exponent: Array) -> Array:
    """Return e^(l a) as (T, n) for logarithms (T,) and exponents (n,)."""
    return np.exp(np.clip(np.outer(logarithm, exponent), -300.0, 300.0))  # finite


def _test(experiment: Experiment, is_foam: bool) -> _Test | None:
    """None without a stress, and for nearly incompressible tests that determine κ."""
    deformation = experiment.specimen
    assert deformation is not None
    if not (deformation.free or deformation.test == "simple-shear" or is_foam):
        return None
    gradient = deformed_gradients(experiment)
    per_strain = deformation.per_strain().sum(axis=0)
    axes = {STRESS_NAME: AXES.index("z"), SECOND_STRESS_NAME: AXES.index("x")}
    stresses, lateral = [], None
    for gauge in experiment.readings:
        values = np.asarray(gauge.values, dtype=float)[:, 0]
        if gauge.name == LATERAL_NAME:
            lateral = values, gauge.sample_sigmas[:, 0]
        elif gauge.name in axes:
            sigmas = [gauge.unknowns.get(name, 0.0) for name in ("area_error", "stress_zero_pa")]
            noise = gauge.sample_sigmas[:, 0]
            stresses.append(_Stress(axes[gauge.name], values, noise, np.array(sigmas)))
    if not stresses:
        return None
    zero = experiment.nuisance.strain_zero or 0.0
    free = [AXES.index(axis) for axis in deformation.free]
    return _Test(gradient, per_strain, free, deformation.test, zero, stresses, lateral)
