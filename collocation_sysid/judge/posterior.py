"""Posterior of an answer: parameters, nuisance parameters and effects of the budget in one fit.

An effect is one way in which reality may deviate from the description. It has a prior, and its
columns E = ∂r/∂b follow by linear algebra at the answer, see `consider_analysis`. One least-squares
step over parameters q, nuisance parameters φ and effects b,

    min ‖r + J (q, φ) + E b‖² + ‖(φ, b) − mean‖² / deviation²,

gives the published estimates, their covariance, and the posterior of each effect (Bayesian
approximation error: Kaipio & Somersalo, J. Comput. Appl. Math. 198, 2007). Where the data see an
effect, they correct the estimates for it and narrow their intervals; where they do not, its whole
prior counts, as in a type B evaluation (JCGM 100:2008, 4.3). The estimates depend linearly on
residuals and priors, so that their variance is a sum over noise and priors: with C the inverse of the
information, that of an estimate with derivative g by q contains (gᵀ C_k)² for effect k, whose unit
is the standard deviation of its prior.

The error of the mesh and of the time step are effects with a mean: that of the estimated change to
elements, or steps, of half the length, extrapolated to infinitely small ones. The data learn the
size of that of the mesh, but not its shape, which is known as badly: each channel (one number of a
marker over time), and the part that parameters reproduce, of which residuals show nothing, have
amplitudes of their own with the same deviation, which are considered. The error of the time step is
considered: its estimate is closer than what residuals tell of it.

A single curve of a static test does not tell effects from each other, nor from the law of the
material, which is never exact. There effects are considered but not learnt: the estimates are
corrected for their means, and their priors add to the variance (Schmidt, NASA TN D-1235, 1962). Only
those that may be much larger than is typical (`Deviation.typical`), such as a toe, are learnt. The
residuals by which the fit is judged contain an error of the mesh as large as they show it.

An effect that redefines a constant, such as another damping law for γ_r, does not change that
constant: the constant is the one given the stated definition, b = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..common.array_types import Array, Index
from ..fem.laws.constants import without_region
from ..model.parameters import Parameters
from ..program.transcription import Transcription
from ..recording.nuisance import GRIP, PLACE
from ..statistics.assessment import fit_concerns
from ..statistics.budget.combined_intervals import NORMAL_95, ReportedEstimate, combine
from ..statistics.budget.consider_analysis import ResidualChanges
from ..statistics.budget.discretisation_error import estimate_changes
from ..statistics.budget.effect_estimates import (
    AS_WELL,
    EFFECT,
    EffectEstimate,
    JointPosterior,
    effect_row,
)
from ..statistics.budget.systematic_effects import DEVIATIONS, DISCRETISATION
from ..statistics.distributions import largest_deviation, student_95
from ..statistics.estimates import Estimate, IntervalCoordinate
from ..statistics.linearised import LinearisedFit, gauss_newton_step, least_squares_of_fit
from ..statistics.thresholds import CHANCE
from ..statistics.uncertainty import ErrorModel, Uncertainty, uncertainty_from_fit

NOISE = "noise"
NUISANCES = "nuisance parameters"
BETWEEN = "between recordings"
# Cosine of the columns of two effects, beside all parameters, from which on they look alike.
ALIKE = 0.9
# Share of the prior variance of an effect below which the data say nothing about it.
UNSEEN = 1e-6


@dataclass(frozen=True)
class BudgetLine:
    """Uncertainty budget of one estimate."""

    value: float
    # mapping of str to float: share of each source in the variance, largest first; they sum to one.
    shares: Mapping[str, float]
    combined95: tuple[float, float]  # (lower, upper): 95 % interval due to all sources
    combined_std_error: float  # standard uncertainty due to all sources


@dataclass(frozen=True, eq=False)
class Effects:
    """Columns of effects at one point, in standard deviations of their priors."""

    names: tuple[str, ...]  # (a,): names with component
    blocks: tuple[Array, ...]  # (T, M, 3, a): changes of the residuals of each block of a fit
    means: Array  # (a,): means of the priors
    deviations: Array  # (a,): standard deviations of the priors, in the unit of each effect

    @classmethod
    def from_changes(
        cls,
        changes: ResidualChanges,
        deviations: Mapping[str, float | None],
        means: Mapping[str, float],
        discretisation: Mapping[str, Sequence[Array]],
    ) -> Effects:
        """Return the effects that change any residual.

        Parameters
        ----------
        changes : ResidualChanges
            Changes of the residuals if each effect is off by its standard deviation.
        means : mapping of str to float
            Known effects over their standard deviations.
        discretisation : mapping of str to sequence of (T, M, 3, 1) arrays
            Changes of the residuals without the error of the mesh and of the time step.
        """
        count = len(changes.names)
        blocks = list(changes.blocks)
        for name, added in discretisation.items():
            size = effect_row(name).considered or 1.0
            own = [size * each for each in added]
            blocks = [np.concatenate(each, axis=3) for each in zip(blocks, own, strict=True)]
        names = (*changes.names, *discretisation)
        rows = [name.partition(" ")[0] for name in names]
        sizes = np.array([deviations.get(r) or DEVIATIONS[r].considered for r in rows], dtype=float)
        expected = np.array([means.get(row, 0.0) for row in rows])
        expected[count:] = 1 / sizes[count:]
        seen = [k for k in range(len(names)) if any(block[..., k].any() for block in blocks)]
        return cls(
            tuple(names[k] for k in seen),
            tuple(block[..., seen] for block in blocks),
            expected[seen],
            sizes[seen],
        )

    @property
    def typical(self) -> Array:
        """Standard deviations (a,) of right descriptions, over those of the priors."""
        known = [effect_row(name).typical.get(name, np.inf) for name in self.names]
        return np.fmin(1.0, known / self.deviations)

    def without(self, rows: Iterable[str]) -> Effects:
        """Return the effects without those of some rows, by name."""
        left_out = set(rows)
        return self.only(
            k for k, name in enumerate(self.names) if name.partition(" ")[0] not in left_out
        )

    def only(self, indices: Iterable[int]) -> Effects:
        """Return some of the effects."""
        kept = list(indices)
        return Effects(
            tuple(self.names[k] for k in kept),
            tuple(block[..., kept] for block in self.blocks),
            self.means[kept],
            self.deviations[kept],
        )

    def expected_in(self, fit: LinearisedFit) -> LinearisedFit:
        """Return the fit with residuals that contain the effects, each as large as its mean."""
        pairs = zip(fit.blocks, self.blocks, strict=True)
        return replace(
            fit, blocks=tuple(b.changed(b.weighted(each) @ self.means) for b, each in pairs)
        )

    def added_to(self, fit: LinearisedFit, parameters: Parameters) -> tuple[LinearisedFit, Array]:
        """Return the fit with the effects as its last parameters, and their definition: the matrix
        (p + a, p + a) that turns these parameters into those of the body.
        """
        wide = fit.with_columns(self._unique_names, self.blocks, self.means)
        definition = self._definition(wide, parameters)
        changed = [
            replace(b, jacobian=b.jacobian @ definition) if self._redefining else b
            for b in wide.blocks
        ]
        return replace(wide, blocks=tuple(changed)), definition

    @property
    def _redefining(self) -> list[int]:
        return [k for k, name in enumerate(self.names) if effect_row(name).redefines]

    @property
    def _unique_names(self) -> list[str]:
        known = self.names
        return [
            f"{name} {known[: k + 1].count(name)}" if known.count(name) > 1 else name
            for k, name in enumerate(known)
        ]

    def _definition(self, fit: LinearisedFit, parameters: Parameters) -> Array:
        """Return the matrix of `added_to`: constants that an effect redefines are those of its absence,
        and the change of the constants with the effect belongs to the column of the effect.

        Forces of an alternative may be K times those of the answer, as viscosities that contain the
        bulk modulus of a nearly incompressible body. With 1/K of the constant they agree; only 1/K of
        what they differ in otherwise is the effect.
        """
        first = len(fit.names) - len(self.names)
        redefining = [first + k for k in self._redefining]
        kept = np.setdiff1d(np.flatnonzero(~fit.at_bound), redefining)
        matrix = np.eye(len(fit.names))
        for k in redefining:
            redefined = effect_row(self.names[k - first]).redefines
            defined = [
                j
                for j, item in enumerate(parameters.free)
                if without_region(item.name) in redefined and not fit.at_bound[j]
            ]
            slopes = _conditional_slopes(least_squares_of_fit(fit).information, k, kept)
            ratio = 1.0 - min(0.0, *(float(slopes[j]) for j in defined)) if defined else 1.0
            matrix[defined, k] = slopes[defined] / ratio
            matrix[k, k] = 1 / ratio
        return matrix


def _conditional_slopes(information: Array, column: int, others: Index) -> Array:
    """Return the changes (p,) of some parameters if another one changes by one."""
    slopes = np.zeros(len(information))
    inverse = np.linalg.pinv(information[np.ix_(others, others)], hermitian=True)
    slopes[others] = -inverse @ information[others, column]
    return slopes


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of an answer.

    The step and the covariances are those of `fit`; `uncertainty` has the statistical part, without
    the priors of the effects.
    """

    fit: LinearisedFit  # linearised fit with the learnt effects as its last parameters, before the step
    parameters: Parameters
    start: Array  # (nq,): q at which `fit` is linearised
    effects: Effects  # that are learnt
    considered: Effects  # that are not
    definition: Array  # (p + a, p + a): turns parameters and learnt effects into those of the body
    step: Array  # (p + a,): step of all parameters and learnt effects
    uncertainty: Uncertainty  # of the fit after the step
    reported_q: Array  # (nq,): q of `uncertainty`, after the step

    @classmethod
    def from_fit(
        cls,
        fit: LinearisedFit,
        effects: Effects,
        parameters: Parameters,
        q: Array,
        error_model: ErrorModel,
        *,
        is_learnt: bool = True,
        derived_at: Callable[[Array], object] | None = None,
    ) -> Posterior:
        """Return the posterior by one step.

        Parameters
        ----------
        fit : LinearisedFit
            Linearised fit at q (nq,), without effects.
        is_learnt : bool
            Whether the data correct the effects. They never correct that of the time step, which
            is known better than they show it.
        derived_at : callable, optional
            ``derived_at(q)``, the derived moduli at q; by default those of the fit.
        """
        mesh, time_step = DISCRETISATION
        corrected = [k for k, name in enumerate(effects.names) if effect_row(name).typical]
        learnt = effects.without([time_step.name]) if is_learnt else effects.only(corrected)
        considered = effects.only(
            k for k, name in enumerate(effects.names) if name not in learnt.names
        )
        wide, definition = learnt.added_to(fit, parameters)
        expected = considered.expected_in(wide)
        step = gauss_newton_step(expected)
        after = expected.after_step(step)
        if mesh.name in considered.names:  # its mean may be wrong by more than the noise
            others = considered.without([mesh.name])
            shown = considered.only(
                k for k, name in enumerate(considered.names) if name not in others.names
            )
            with_mesh, _ = shown.added_to(others.expected_in(wide), parameters)
            judged = with_mesh.after_step(gauss_newton_step(with_mesh)).only(range(len(wide.names)))
            after = replace(after, blocks=judged.blocks)
        there = np.clip(q + step[: len(q)], *parameters.bounds_q)
        if derived_at is not None:
            after = replace(after, derived=derived_at(there))
        uncertainty = uncertainty_from_fit(after, parameters, there, error_model)
        wide = replace(wide, derived=after.derived)
        return cls(wide, parameters, q, learnt, considered, definition, step, uncertainty, there)

    @cached_property
    def q(self) -> Array:
        """Estimates (nq,) in the solver's coordinates."""
        moved = self.start + self.step[: len(self.start)]
        return np.clip(moved, *self.parameters.bounds_q)

    @property
    def phi(self) -> Array:
        """Nuisance parameters (nphi,), in units of their priors."""
        places = slice(len(self.start), self._of_effects[0] if self.effects.names else None)
        return (self.fit.prior_residual + self.fit.prior_jacobian * self.step)[places]

    @property
    def expected_phi(self) -> Array:
        """Standard deviations (nphi,) that `phi` has for a true description."""
        return np.sqrt(np.maximum(self._expected_variances[: len(self.phi)], UNSEEN))

    @cached_property
    def _expected_variances(self) -> Array:
        """Variances (nphi + a,) that nuisance parameters and learnt effects have for a true
        description.
        """
        own = np.diag(self.covariance)[len(self.start) :]
        # The residuals may show more noise than stated, or correlated noise.
        actual = np.diag(self.uncertainty.nuisance_covariance)[: len(own)]
        return np.maximum(1 - own, 0.0) + np.maximum(actual - own, 0.0)

    @cached_property
    def _information(self) -> Array:
        return least_squares_of_fit(self.fit).information

    @cached_property
    def covariance(self) -> Array:
        """Covariance (p + a, p + a) with the stated noise; zero for parameters at a bound."""
        free = np.flatnonzero(~self.fit.at_bound)
        matrix = np.zeros(2 * (len(self.fit.names),))
        own = self._information[np.ix_(free, free)]
        matrix[np.ix_(free, free)] = np.linalg.pinv(own, hermitian=True)
        return matrix

    @cached_property
    def sources(self) -> tuple[tuple[str, ...], Array]:
        """Names of the effects, and changes (p + a, …) of parameters and learnt effects if each is off
        by the standard deviation of its prior; a learnt error of the mesh occurs again, once for each
        amplitude of its shape, and a row with a surprise for all that it changes, because another error may
        look alike.
        """
        names, ways = self._priors
        limit = largest_deviation(len(self.effect_estimates), CHANCE)
        rows = [
            each.name.partition(" ")[0]
            for each in self.effect_estimates
            if abs(each.surprise) > limit
        ]
        for row in dict.fromkeys(rows):
            own = [k for k, name in enumerate(self.effects.names) if name.partition(" ")[0] == row]
            at = self._of_effects[own]
            known = self.covariance[:, at]
            off = self.step[at] - self.effects.means[own]
            ways = np.column_stack([ways, known @ np.linalg.pinv(known[at]) @ off])
            names += (row,)
        return names, ways

    @cached_property
    def _priors(self) -> tuple[tuple[str, ...], Array]:
        """`sources` without surprises."""
        ways = [self.covariance[:, self._of_effects]]
        ways.append(estimate_changes(self.fit, self.considered.blocks))
        rows = {row.name for row in DISCRETISATION}
        again = [k for k, name in enumerate(self.effects.names) if name in rows]
        names = (*self.effects.names, *self.considered.names)
        for k in again:
            unknown = self._changes_by_shape(k) * self.effects.deviations[k]
            ways.append(unknown)
            names += (self.effects.names[k],) * unknown.shape[1]
        return names, np.hstack(ways)

    def _changes_by_shape(self, k: int) -> Array:
        """Return the changes (p + a, c + 1) by each channel of effect k alone, as large as it is
        estimated, and by what parameters reproduce of it; a channel is one number of a marker over
        time.
        """
        place = self._of_effects[k]
        scores = [
            np.einsum("tmap,tma->pma", block.jacobian, block.jacobian[..., place])
            for block in self.fit.blocks
        ]
        flat = np.hstack([each.reshape(len(each), -1) for each in scores])
        kept = np.flatnonzero(~self.fit.at_bound)[: -len(self.effects.names)]
        reproduced = _conditional_slopes(self._information, place, kept)
        return self.step[place] * np.column_stack([-self.covariance @ flat, reproduced])

    @property
    def _of_effects(self) -> Index:
        return np.arange(len(self.fit.names) - len(self.effects.names), len(self.fit.names))

    def without(self, rows: Iterable[str]) -> Posterior:
        """Return the posterior without some effects, with the same statistical uncertainty.

        The data learn the other effects from residuals in which these effects are as large as their
        means; what the means alone change in the parameters is left out with them.
        """
        first = len(self.fit.names) - len(self.effects.names)
        left_out = set(rows)
        is_kept = [name.partition(" ")[0] not in left_out for name in self.effects.names]
        kept = [*range(first), *(first + np.flatnonzero(is_kept))]
        fit = self.fit.only(kept, effect_count=len(kept) - first)
        alone = self.fit.only(range(first))
        considered = self.considered.without(left_out)
        learnt = self.effects.without(left_out)
        definition = self.definition[np.ix_(kept, kept)]
        step = gauss_newton_step(considered.expected_in(fit))
        omitted = self.effects.only(np.flatnonzero(~np.array(is_kept, dtype=bool)))
        step = step + estimate_changes(fit, omitted.blocks) @ omitted.means
        step[:first] -= estimate_changes(alone, omitted.blocks) @ omitted.means
        return replace(
            self, fit=fit, effects=learnt, considered=considered, definition=definition, step=step
        )

    def joint(self, transcriptions: Iterable[Transcription]) -> JointPosterior:
        """Return the joint posterior of what acts on the body in the fitted experiments, without grips
        of single recordings, which another session does not have.
        """
        count, learnt = len(self.fit.names), len(self.effects.names)
        rows = {name: (k, 1.0) for k, name in enumerate(self.fit.names[: len(self.start)])}
        for each in transcriptions:
            entries, scope = each.nuisance.entries, each.experiment.nuisance.scope
            places = each.nuisance_indices.indices.tolist()
            for place, name, entry in zip(places, each.nuisance.names, entries, strict=True):
                acts = entry.row == PLACE or entry.row.changes_motion
                if acts and (entry.row not in GRIP or entry.row.name in scope):
                    rows[name] = place, entry.sigma
        effects = (*self.effects.names, *self.considered.names)
        for k, name in enumerate(effects, start=count - learnt):
            row = effect_row(name)
            if row.effect is not None or row in DISCRETISATION:
                rows[EFFECT + name] = k, 1.0
        own = len(self.considered.names)
        ways = np.pad(self.sources[1], ((0, own), (0, 0)))
        ways[count:, learnt : learnt + own] = np.eye(own)
        covariance = np.pad(self.uncertainty.noise_covariance, (0, own)) + ways @ ways.T
        scatter = self.uncertainty.scatter
        if scatter is not None:
            between = scatter.sensitivities
            covariance[: len(between), : len(between)] += between @ between.T
        offset = self.definition @ self.step
        definition = np.eye(count + own)
        definition[:count, :count] = self.definition
        kept = np.array([k for k, _ in rows.values()], dtype=np.int64)
        units = np.array([unit for _, unit in rows.values()])
        of_body = units[:, None] * definition[kept]
        return JointPosterior(
            tuple(rows),
            units * np.append(offset, self.considered.means)[kept],
            of_body @ covariance @ of_body.T,
            tuple(name.partition(" ")[0] for name in effects),
            of_body @ ways[:, : len(effects)],
        )

    @cached_property
    def derivatives(self) -> dict[str, Array]:
        """Derivatives (nq,) of each estimate by q, by name; zero for fixed ones."""
        values = self.parameters.values(self.reported_q)
        slopes = {name: np.zeros(len(self.start)) for name in values}
        for k, item in enumerate(self.parameters.free):
            slopes[item.name][k] = item.value_derivative(values[item.name])
        for item in self.parameters.components:
            if item.tied is not None:
                slopes[item.name] = item.tied.ratio * slopes[item.tied.to]
        return slopes | dict(self.fit.derived.derivatives)

    # Estimates ------------------------------------------------------------------------------------

    @cached_property
    def statistical(self) -> dict[str, Estimate]:
        """Estimates with their statistical intervals, by name: parameters and derived moduli."""
        return {**self.uncertainty.estimates, **self.uncertainty.derived}

    def reported(self, name: str) -> ReportedEstimate:
        """Return an estimate with its combined interval, without the one of the optimum."""
        estimate = self.statistical[name]
        linear, bounds = self.parameters.scale_and_bounds(name)
        systematic = self.systematic(name) if estimate.statistical95 is not None else None
        return combine(name, estimate, None, systematic, linear=linear, bounds=bounds)

    def systematic(self, name: str) -> float:
        """Return the standard deviation of an estimate, in the coordinate of its interval, due to all
        effects and to differences between recordings.
        """
        return float(
            np.sqrt(sum(self._systematic_variances(name, self._coordinate(name)).values()))
        )

    def change(self, name: str, optimum: float) -> float:
        """Return the change of an estimate from its value `optimum` without effects, in the coordinate
        of its interval.
        """
        value = self.statistical[name].value
        linear, _ = self.parameters.scale_and_bounds(name)
        at = IntervalCoordinate.for_estimate(name, (value, optimum), linear=linear)
        besides = float(self.derivatives[name] @ (self.q - self.reported_q)) * at.derivative(value)
        return at.from_value(value) - at.from_value(optimum) + besides

    def _coordinate(self, name: str) -> IntervalCoordinate:
        estimate = self.statistical[name]
        linear, _ = self.parameters.scale_and_bounds(name)
        known = (estimate.value, *(estimate.statistical95 or ()))
        return IntervalCoordinate.for_estimate(name, known, linear=linear)

    def _systematic_variances(self, name: str, at: IntervalCoordinate) -> dict[str, float]:
        """Return the variances of an estimate by each row of effects and by differences between
        recordings, in the coordinate of its interval.
        """
        by_q = self.derivatives[name] * at.derivative(self.statistical[name].value)
        variances: dict[str, float] = {}
        names, ways = self.sources
        for effect, way in zip(names, by_q @ ways[: len(by_q)], strict=True):
            row = effect.partition(" ")[0]
            variances[row] = variances.get(row, 0.0) + float(way) ** 2
        between = self._variance_between_recordings(name, at, by_q, sum(variances.values()))
        return variances | ({BETWEEN: between} if between else {})

    def _variance_between_recordings(
        self, name: str, at: IntervalCoordinate, by_q: Array, others: float
    ) -> float:
        """Return the variance due to differences of other parameters between recordings, beyond
        what the statistical interval contains.

        It is enlarged such that a normal interval is as wide as Student's interval of the sum (Welch
        & Satterthwaite: JCGM 100:2008, G.4).
        """
        scatter = self.uncertainty.scatter
        if scatter is None:
            return 0.0
        noise, _, counted = self._noise_parts(name, at, by_q)
        between = by_q @ scatter.sensitivities[: len(self.start)]
        more = max(0.0, float(np.sum(between**2)) - counted)
        if not more:
            return 0.0
        freedom = (len(scatter.recordings) - 1) * ((noise + others + more) / more) ** 2
        return more * float(student_95(freedom) / NORMAL_95) ** 2

    def _noise_parts(
        self, name: str, at: IntervalCoordinate, by_q: Array
    ) -> tuple[float, float, float]:
        """Return the parts of the statistical variance of an estimate, in the coordinate of its
        interval: by noise, by the priors of nuisance parameters, and by the disagreement of
        recordings.
        """
        estimate = self.statistical[name]
        assert estimate.statistical95 is not None
        noise = _variance(at, estimate.value, estimate.statistical95)
        count = len(self.start)
        widened = self.uncertainty.widening * by_q
        learnt = self.covariance[:count, self._of_effects]
        free = self.covariance[:count, :count] - learnt @ learnt.T
        agreeing, of_all = float(by_q @ free @ by_q), float(widened @ free @ widened)
        share = 1.0 if not of_all > 0 else agreeing / of_all
        phi = slice(count, len(self.fit.names) - len(self.effects.names))
        of_priors = (by_q @ self.covariance[:count, phi]) * self.fit.prior_jacobian[phi]
        nuisances = min(1.0, float(of_priors @ of_priors) / agreeing) if agreeing > 0 else 0.0
        return noise * share * (1 - nuisances), noise * share * nuisances, noise * (1 - share)

    @cached_property
    def budget(self) -> dict[str, BudgetLine]:
        """Uncertainty budget of every estimate that has a statistical interval, by name; estimates
        that do not depend on q, such as fixed ones, are left out.
        """
        lines = {}
        for name, estimate in self.statistical.items():
            if estimate.statistical95 is None or not self.derivatives[name].any():
                continue
            at = self._coordinate(name)
            by_q = self.derivatives[name] * at.derivative(estimate.value)
            noise, nuisances, between = self._noise_parts(name, at, by_q)
            variances = {NOISE: noise, NUISANCES: nuisances}
            variances |= self._systematic_variances(name, at)
            variances[BETWEEN] = variances.get(BETWEEN, 0.0) + between
            total = sum(variances.values())
            shares = {source: part / total for source, part in variances.items() if part > 0}
            shares = dict(sorted(shares.items(), key=lambda part: -part[1]))
            reported = self.reported(name)
            assert reported.combined95 is not None
            assert reported.combined_std_error is not None
            lines[name] = BudgetLine(
                reported.value, shares, reported.combined95, reported.combined_std_error
            )
        return lines

    def combine_covariance(self, statistical: Array, sizes: Array) -> Array:
        """Return the covariance (nq, nq) due to noise and systematic effects in the coordinates of a
        statistical one, `sizes` (nq,) being the derivatives of these coordinates by q.
        """
        ways = [self.sources[1][: len(self.start)]]
        if self.uncertainty.scatter is not None:
            ways.append(self.uncertainty.scatter.sensitivities[: len(self.start)])
        moved = sizes[:, None] * np.hstack(ways)
        return statistical + moved @ moved.T

    # Consistency ----------------------------------------------------------------------------------

    @cached_property
    def effect_estimates(self) -> tuple[EffectEstimate, ...]:
        """Posterior of each effect that the data may see, the most surprising first."""
        places = self._of_effects
        values = self.step[places]
        own = np.diag(self.covariance)[places]
        count = len(self.effects.names)
        predicted = self._expected_variances[len(self.phi) :]
        # Some effects are seldom as large as their prior allows.
        response = np.eye(count) - self.covariance[np.ix_(places, places)]
        predicted = predicted - response**2 @ (1 - self.effects.typical**2)
        # The shape of the errors of mesh and time step is not known.
        by_shape = self._priors[1][places, count + len(self.considered.names) :]
        predicted += np.sum(by_shape**2, axis=1)
        sizes = self.effects.deviations
        seen = np.maximum(1 - own, UNSEEN)  # change of the posterior by one of the data alone
        found = []
        for k, name in enumerate(self.fit.names[len(self.fit.names) - count :]):
            if predicted[k] < UNSEEN:
                continue
            off = float(values[k] - self.effects.means[k])
            found.append(
                EffectEstimate(
                    name,
                    float(self.effects.means[k] * sizes[k]),
                    float(self.effects.typical[k] * sizes[k]),
                    float(values[k] * sizes[k]),
                    float(np.sqrt(own[k]) * sizes[k]),
                    off / float(np.sqrt(predicted[k])),
                    self._alike(k),
                    needed=float((self.effects.means[k] + off / seen[k]) * sizes[k]),
                )
            )
        return tuple(sorted(found, key=lambda each: -abs(each.surprise)))

    def suspected(self, others: Effects, errors: ErrorModel) -> tuple[EffectEstimate, ...]:
        """Return those of other effects that explain the residuals best (`AS_WELL`), with the root of
        twice the logarithm of their Bayes factor as surprise: the decrease of the least loss, less
        what columns with so wide priors decrease by chance. Their priors have the mean zero and the
        deviations of the columns; columns of one name count together. Those that cannot be negative
        and would be are left out.
        """
        fit = self.considered.expected_in(self.fit)
        before = least_squares_of_fit(fit).loss(self.step)
        found = []
        for name in dict.fromkeys(others.names):
            own = others.only(k for k, each in enumerate(others.names) if each == name)
            wide, _ = replace(own, means=np.zeros(len(own.names))).added_to(fit, self.parameters)
            step = gauss_newton_step(wide)
            if step[len(fit.names) :].min() > 0 or not effect_row(name).is_one_sided:
                squares = least_squares_of_fit(wide)
                left = np.linalg.pinv(squares.information, hermitian=True)[len(fit.names) :]
                chance = np.linalg.slogdet(left[:, len(fit.names) :]).logabsdet
                gain = max(0.0, before - squares.loss(step) + float(chance))
                count = fit.effect_count + len(own.names)
                found.append((gain, name, replace(wide.after_step(step), effect_count=count)))
        most = max((gain for gain, *_ in found), default=0.0)
        suspects = []
        for gain, name, after in found:
            if gain > AS_WELL * most:
                bars = uncertainty_from_fit(after, self.parameters, self.reported_q, errors)
                suspects.append(EffectEstimate.beyond(name, gain, not fit_concerns(bars)))
        return tuple(suspects)

    @cached_property
    def _cosines(self) -> Array:
        """Cosines (a, a) of the columns of effects beside all parameters."""
        information = self._information
        places = self._of_effects
        others = np.flatnonzero(~self.fit.at_bound)[: -len(places)]
        inverse = np.linalg.pinv(information[np.ix_(others, others)], hermitian=True)
        across = information[np.ix_(places, others)]
        own = information[np.ix_(places, places)] - across @ inverse @ across.T
        own -= np.eye(len(places))  # the priors
        length = np.sqrt(np.maximum(np.diag(own), UNSEEN))
        return own / np.outer(length, length)

    def _alike(self, k: int) -> tuple[str, ...]:
        cosines = np.abs(self._cosines[k])
        names = self.fit.names[len(self.fit.names) - len(self.effects.names) :]
        order = np.argsort(-cosines)
        return tuple(names[j] for j in order if j != k and cosines[j] > ALIKE)


def _variance(at: IntervalCoordinate, middle: float, ends: tuple[float, float]) -> float:
    """Return the variance of a 95 % interval, in the coordinate of the interval.

    If both sides are equal, half the interval counts as 1.96 standard deviations; else, as where
    one end is cut off by a bound, it is the mean of the variances of both sides.
    """
    centre = at.from_value(middle)
    low, high = map(at.from_value, ends)
    if np.isclose(centre - low, high - centre, rtol=1e-6, atol=0):
        return ((high - low) / 2 / NORMAL_95) ** 2
    return float(np.mean([((centre - low) / NORMAL_95) ** 2, ((high - centre) / NORMAL_95) ** 2]))


def main_sources(shares: Mapping[str, Mapping[str, float]], minimum_share: float) -> list[str]:
    """Return the sources whose share in the variance of at least one estimate is `minimum_share` or
    more, by their largest share, the largest first.

    Parameters
    ----------
    shares : mapping of str to mapping of str to float
        Shares by estimate and source.
    minimum_share : float
        Smallest share of interest.
    """
    largest: dict[str, float] = {}
    for source, share in (each for line in shares.values() for each in line.items()):
        largest[source] = max(share, largest.get(source, 0.0))
    return sorted((s for s in largest if largest[s] >= minimum_share), key=lambda s: -largest[s])
