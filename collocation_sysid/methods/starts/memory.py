"""Start of the branches of a memory from tables of moduli over frequency or time.

The complex modulus of a specimen is E (1 + Σ g_k iωτ_k/(1 + iωτ_k)), its relaxation modulus
E (1 + Σ g_k exp(−t/τ_k)). Both are linear in E and E g_k: with relaxation times on a grid, a
non-negative fit finds the spectrum, and the free shifts of the times with the temperature. The
relaxation times of the branches start evenly over this spectrum, at its peaks, or at their guesses;
the best least-squares fit in closed form is the start of the search.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from ...common.array_types import Array
from ...fem.laws.constants import is_modulus
from ...fem.regions import BodyPart
from ...model.parameters import Parameters
from ...program.collocation import Collocation
from ...recording.experiment import Experiment
from ...recording.specimen import RELAXED_STRAIN
from ...recording.specimen_files import specimen_strains
from .start import Start

# Relaxation times of the grid for each decade of the measured times.
PER_DECADE = 4
# Strength of a time of the grid, over the largest one, from which on it belongs to the spectrum, and
# the smallest share of spring and branch over the others at the start.
PRESENT = 1e-3
SMALL_STRAIN = ("uniaxial", "simple-shear")  # kinds of test of such a table
# Largest difference of a strain from that of a table, by rounding of the positions.
CLOSE = 1e-9
# Loss at the guesses over that of the closed form up to which guesses are kept.
AS_GOOD = 1.01


@dataclass(frozen=True, eq=False)
class _Table:
    """Table of one specimen: rows are those of a modulus that are linear in the strengths."""

    experiment: Experiment
    part: BodyPart
    rates: Array  # (R,): angular frequencies [rad/s], or reciprocals of times [1/s]
    oscillates: bool
    moduli_pa: (
        Array  # (M,): of harmonic tests the storage moduli, then the loss moduli; NaN: missing
    )
    weights: Array  # (M,): reciprocals of the standard deviations; 0 where missing

    @classmethod
    def of(cls, experiment: Experiment) -> _Table | None:
        """Return the table of a specimen with memory at a small strain; None for another test."""
        specimen = experiment.specimen
        if specimen is None or len(experiment.body.parts) != 1 or not experiment.body.has_memory:
            return None
        (part,) = experiment.body.parts
        t_s, gauge = experiment.t_s, experiment.readings[0]
        strain, _ = specimen_strains(experiment)
        if specimen.test not in SMALL_STRAIN or len(experiment.readings) > 1 or len(strain) < 3:
            return None
        stress = np.ravel(gauge.measured_values)
        sigma = np.broadcast_to(np.ravel(gauge.sigma), stress.shape)
        if part.oscillates:
            rates = 0.5 * np.pi / np.diff(t_s)[::2]
            amplitudes = np.tile(strain[1::2], 2)
            moduli = np.r_[stress[1::2], -stress[2::2]] / amplitudes
            sigmas = np.r_[sigma[1::2], sigma[2::2]] / amplitudes
        elif abs(strain[0]) < CLOSE and (np.abs(strain[1:] - RELAXED_STRAIN) < CLOSE).all():
            rates = 1 / t_s[2:]
            moduli, sigmas = stress[2:] / RELAXED_STRAIN, sigma[2:] / RELAXED_STRAIN
        else:
            return None
        weights = np.where(np.isfinite(moduli), 1 / sigmas, 0.0)
        return cls(experiment, part, rates, part.oscillates, np.nan_to_num(moduli), weights)

    def responses(self, tau_s: Array) -> Array:
        """Return the response (M, K) of a branch of strength 1 with each relaxation time."""
        x = self.rates[:, None] * tau_s
        if not self.oscillates:
            return np.exp(-1 / x)
        return np.concatenate([x**2, x]) / np.tile(1 + x**2, (2, 1))

    @property
    def constant(self) -> Array:
        """Response (M,) of a spring of strength 1."""
        return np.r_[np.ones(len(self.rates)), np.zeros(len(self.moduli_pa) - len(self.rates))]

    def shift(self, values: Mapping[str, float]) -> float:
        """Return the factor on the relaxation times."""
        return 1.0 if self.part.shift is None else float(self.part.shift.factor(values))

    def modulus_pa(self, values: Mapping[str, float]) -> float:
        body = self.experiment.body
        lam, mu = body.lame(body.theta_from_values(values))[self.part.name]
        specimen = self.experiment.specimen
        assert specimen is not None
        return mu if specimen.test == "simple-shear" else mu * (3 * lam + 2 * mu) / (lam + mu)


def memory_start(collocation: Collocation, parameters: Parameters) -> Start | None:
    """Return a start of a fit of specimens; None unless all are harmonic tests or tables of a
    relaxation modulus with the same branches, all of whose shares are estimated; or if the guesses
    are as good. `parameters` are those of the collocation, with guesses of all.
    """
    tables = [_Table.of(each.experiment) for each in collocation.transcriptions]
    found = [each for each in tables if each is not None]
    if not found or len(found) < len(tables):
        return None
    names = _branch_names(found[0].part)
    known = set(parameters.names)
    is_alike = all(_branch_names(each.part) == names for each in found)
    if not is_alike or not known.issuperset(name for pair in names for name in pair):
        return None
    started = _MemoryFit(parameters, found, names).start()
    return None if started is None else Start(collocation.with_parameters(started))


def _branch_names(part: BodyPart) -> list[tuple[str, str]]:
    prefix = f"{part.name}." if part.name else ""
    return [(f"{prefix}{b.name}.share", f"{prefix}{b.name}.tau_s") for b in part.prony]


class _MemoryFit:
    """Least-squares fit of the branches in closed form."""

    def __init__(
        self, parameters: Parameters, tables: Sequence[_Table], names: Sequence[tuple[str, str]]
    ) -> None:
        self.parameters = parameters
        self.tables = tables
        self.names = names
        self.items = {item.name: k for k, item in enumerate(parameters.free)}
        self.lower = np.array([i.to_coordinate(i.lower) for i in parameters.free])
        self.upper = np.array([i.to_coordinate(i.upper) for i in parameters.free])
        self.moduli = [
            n for n in self.items if is_modulus(n) and parameters.free[self.items[n]].scale == "log"
        ]
        shifts = {n for t in tables if t.part.shift for n in t.part.shift.constants}
        self.of_memory = shifts.union(*names)
        self.of_elasticity: dict[tuple[float, ...], list[float]] = {}

    def start(self) -> Parameters | None:
        """None without free relaxation times and moduli, or if the guesses are as good."""
        free = [tau for _, tau in self.names if tau in self.items]
        if not free or not self.moduli or not self.items.keys() >= {s for s, _ in self.names}:
            return None
        first = np.clip(self.parameters.guess_q, self.lower, self.upper)
        shifted, grid_s, strengths = self._spectrum(first)
        present = grid_s[strengths > PRESENT * strengths.max()] if strengths.any() else grid_s
        count = len(free)
        even = np.geomspace(present[0], present[-1], count + 2)[1:-1]
        largest = np.sort(present[np.argsort(-strengths[np.isin(grid_s, present)])[:count]])
        given = np.sort([np.exp(first[self.items[name]]) for name in free])
        order = sorted(free, key=lambda name: first[self.items[name]])
        tried = []
        for times_s in [given, even, *([largest] if len(largest) == count else [])]:
            q = shifted.copy()
            q[[self.items[name] for name in order]] = np.log(times_s)
            tried.append(self._fit(self._with_strengths(np.clip(q, self.lower, self.upper))))
        best = min(tried, key=lambda fit: fit.cost)
        at_guess = 0.5 * float(np.sum(self._residuals(first) ** 2))
        if not at_guess > AS_GOOD * best.cost:
            return None
        q = self._in_order(best.x, order)
        return self.parameters.with_guess(
            {
                item.name: float(np.clip(item.from_coordinate(q), item.lower, item.upper))
                for item, q in zip(self.parameters.free, q.tolist(), strict=True)
            }
        )

    def _fit(self, q: Array) -> scipy.optimize.OptimizeResult:
        bounds = (self.lower, self.upper)
        return scipy.optimize.least_squares(self._residuals, q, bounds=bounds, x_scale="jac")

    def _in_order(self, q: Array, order: Sequence[str]) -> Array:
        """Exchange branches so that relaxation times ascend as the guesses do, if admissible."""
        shares = {tau: share for share, tau in self.names}
        times = [self.items[name] for name in order]
        own = [self.items[shares[name]] for name in order]
        ascending = np.argsort(q[times])
        found = q.copy()
        found[times], found[own] = q[times][ascending], q[own][ascending]
        is_inside = (self.lower <= found) & (found <= self.upper)
        same = self._residuals(found), self._residuals(q)
        return found if is_inside.all() and np.allclose(*same) else q

    def _long_term_pa(self, values: Mapping[str, float]) -> list[float]:
        key = tuple(value for name, value in values.items() if name not in self.of_memory)
        if key not in self.of_elasticity:
            self.of_elasticity[key] = [table.modulus_pa(values) for table in self.tables]
        return self.of_elasticity[key]

    def _residuals(self, q: Array) -> Array:
        values = self.parameters.values(q)
        shares = np.array([values[share] for share, _ in self.names])
        tau_s = np.array([values[tau] for _, tau in self.names])
        rows = [
            table.weights
            * (
                modulus * (table.constant + table.responses(tau_s * table.shift(values)) @ shares)
                - table.moduli_pa
            )
            for table, modulus in zip(self.tables, self._long_term_pa(values), strict=True)
        ]
        return np.concatenate([*rows, self.parameters.prior_residuals(q)[0]])

    def _strengths(self, q: Array, tau_s: Array) -> tuple[Array, Array]:
        """Return strengths (1 + K,) of spring and branches, and the weighted residuals."""
        values = self.parameters.values(q)
        rows, data = [], []
        for table, modulus in zip(self.tables, self._long_term_pa(values), strict=True):
            columns = [table.constant, *table.responses(tau_s * table.shift(values)).T]
            rows.append(modulus * table.weights[:, None] * np.column_stack(columns))
            data.append(table.weights * table.moduli_pa)
        matrix, right = np.vstack(rows), np.concatenate(data)
        strengths, _ = scipy.optimize.nnls(matrix, right)
        return strengths, matrix @ strengths - right

    def _spectrum(self, q: Array) -> tuple[Array, Array, Array]:
        """Return the best coordinates, the relaxation times of the grid, and their strengths."""
        branches = {name for pair in self.names for name in pair}
        shifts = [k for name, k in self.items.items() if name in self.of_memory - branches]

        def grid(at: Array) -> Array:
            values = self.parameters.values(at)
            ends = np.concatenate(
                [
                    [t.rates.min() * t.shift(values), t.rates.max() * t.shift(values)]
                    for t in self.tables
                ]
            )
            decades = np.log10(ends.max() / ends.min())
            return np.geomspace(1 / ends.max(), 1 / ends.min(), 1 + int(PER_DECADE * decades))

        def misfit(of_shifts: Array) -> Array:
            at = q.copy()
            at[shifts] = of_shifts
            residuals = self._strengths(at, grid(at))[1]
            return np.r_[residuals, self.parameters.prior_residuals(at)[0][shifts]]

        q = q.copy()
        if shifts:
            limits = (self.lower[shifts], self.upper[shifts])
            q[shifts] = scipy.optimize.least_squares(
                misfit, q[shifts], bounds=limits, diff_step=1e-3
            ).x
        tau_s = grid(q)
        return q, tau_s, self._strengths(q, tau_s)[0][1:]

    def _with_strengths(self, q: Array) -> Array:
        """Return q with the shares, and then the modulus, that fit best."""
        values = self.parameters.values(q)
        spring, *strengths = self._strengths(q, np.array([values[tau] for _, tau in self.names]))[0]
        # Shares of a liquid are as large as their bounds.
        spring = max(spring, PRESENT * (spring + sum(strengths)))
        q = q.copy()
        for (share, _), strength in zip(self.names, strengths, strict=True):
            k = self.items[share]
            q[k] = self.parameters.free[k].to_coordinate(max(strength / spring, PRESENT))
        q = np.clip(q, self.lower, self.upper)
        # The model is proportional to the modulus: w (c m − y) has its smallest norm at this c.
        data = np.concatenate([table.weights * table.moduli_pa for table in self.tables])
        model = self._residuals(q)[: len(data)] + data
        factor = max(model @ data, 0.0) / max(model @ model, 1e-300)
        if factor > 0:
            q[[self.items[name] for name in self.moduli]] += np.log(factor)
        return np.clip(q, self.lower, self.upper)
