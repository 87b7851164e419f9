"""Consistency of a fit, and linear steps of likely mistakes at it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..common.array_types import Array
from ..methods.solution import Solution
from ..program.collocation import ExperimentIterate
from ..program.depth.comparison import depth_residuals
from ..program.measured_motion import fitted_values
from ..recording.deviation import Deviation
from ..recording.experiment import Experiment
from ..recording.markers import Markers
from ..recording.measurement import Measurement, root_mean
from ..statistics.budget.consider_analysis import changed_residuals, changes_of_assumptions
from ..statistics.distributions import largest_deviation, normal_isf
from ..statistics.hypothesis import Hypothesis
from ..statistics.linearised import (
    LinearisedFit,
    least_squares_of_fit,
    linearise_fit,
    remaining_squares,
)
from ..statistics.thresholds import CHANCE, LEAST_DECREASE, MISFIT, NOISE, RARE, UNCORRELATED
from .doubt import Doubt

# Share of χ² that a correction is predicted to leave, and the hypothesis with it as `corrected`.
Candidate = tuple[float, Hypothesis]
# An experiment with a mistake corrected, or several with the same one.
Corrected = Experiment | tuple[Experiment, ...]


def discrepancy(part: ExperimentIterate) -> float:
    """Return the largest RMS residual of the measurements of a fitted experiment, or its largest
    nuisance parameter, over the largest one that noise causes.
    """
    limit = largest_deviation(len(part.phi), RARE)
    found = [float(np.abs(part.phi).max(initial=0.0)) / limit]
    for _, ratios in scaled_residuals(part):
        known = ratios[np.isfinite(ratios)]
        # The root mean square of few numbers is noisy, too.
        chance = 1 + float(normal_isf(CHANCE)) / np.sqrt(2 * max(1, len(known)))
        found.append(root_mean(known**2) / max(NOISE, chance))
    for residual, observation in depth_residuals(part):
        off = residual.signed_distances_m(observation, part.phi)
        known = off[np.isfinite(off)] / residual.correspondences.camera.depth.sigma_m
        found.append(root_mean(known**2) / MISFIT if len(known) else np.inf)
    return max(found)


def has_trend(part: ExperimentIterate) -> bool:
    """Return whether consecutive residuals of a homogeneous specimen are more alike than noise."""
    if part.transcription.experiment.specimen is None:
        return False
    rows = (row[np.isfinite(row)] for _, ratios in scaled_residuals(part) for row in ratios.T)
    return any(
        root_mean(row**2) > 1 / MISFIT
        and float(np.sum(row[1:] * row[:-1]))
        > UNCORRELATED / np.sqrt(len(row)) * float(np.sum(row**2))
        for row in rows
    )


def thinned(experiment: Experiment, most_samples: int) -> Experiment:
    """Return the experiment of a specimen with at most so many of its samples."""
    count = len(experiment.t_s)
    chosen = np.unique(np.linspace(0, count - 1, min(count, most_samples)).astype(int))
    readings = [
        replace(
            gauge,
            t_s=gauge.sample_times_s[chosen],
            values=gauge.measured_values[chosen],
            sigma_ratios=None if gauge.sigma_ratios is None else gauge.sigma_ratios[chosen],
        )
        for gauge in experiment.readings
        if np.isfinite(gauge.measured_values[chosen]).any()
    ]
    markers = Markers.none(experiment.t_s[chosen])
    return replace(experiment, t_s=experiment.t_s[chosen], readings=readings, markers=markers)


def with_corrected(
    experiments: Sequence[Experiment], corrected: Corrected | None
) -> tuple[Experiment, ...]:
    """Return experiments with the corrected one, or several, in place of those of the same name."""
    others = corrected if isinstance(corrected, tuple) else (corrected,)
    by_name = {each.name: each for each in others if each is not None}
    return tuple(by_name.get(each.name, each) for each in experiments)


def scaled_residuals(part: ExperimentIterate) -> Iterator[tuple[Measurement, Array]]:
    """Yield the measurements with numbers, and their residuals (S, m) in σ; NaN where a value is not
    measured or not predicted.
    """
    experiment = part.transcription.experiment
    for each, values in zip(experiment.measurements, fitted_values(part), strict=True):
        if isinstance(values, np.ndarray) and each.has_samples():
            yield each, (values - each.measured_values) / each.sample_sigmas


@dataclass(frozen=True, eq=False)
class TestedFit:
    """Fit of one experiment with a misfit, at which the linear steps of its rows are computed."""

    __test__ = False  # for pytest

    whole: Solution  # fit of the problem
    solution: Solution  # fit of the experiment alone, as stated or corrected

    @property
    def part(self) -> ExperimentIterate:
        """Experiment at the fit."""
        return self.solution.parts[0]

    @property
    def experiment(self) -> Experiment:
        """Experiment that was fitted."""
        return self.part.transcription.experiment

    @cached_property
    def linearised(self) -> LinearisedFit:
        """Residuals and derivatives at the fit."""
        return linearise_fit(self.solution.collocation, self.solution.z)

    @cached_property
    def predictions(self) -> dict[Measurement, Array]:
        """Predicted numbers (S, m) of the measurements."""
        pairs = zip(self.experiment.measurements, fitted_values(self.part), strict=True)
        return {each: values for each, values in pairs if isinstance(values, np.ndarray)}

    def blocks_of(self, changes: Mapping[Measurement, Array]) -> list[Array]:
        """Return changes of all residuals in σ from changes (S, m) of measurements."""
        transcription = self.part.transcription
        models = dict(zip(self.experiment.measurements, transcription.main_residuals, strict=True))
        numbers = {id(each): k for k, each in enumerate(transcription.residuals)}
        blocks = [np.zeros((*each.residual.shape, 1)) for each in self.linearised.blocks]
        for measurement, change in changes.items():
            own = numbers[id(models[measurement])]
            samples, groups, each = self.linearised.blocks[own].residual.shape
            filled = np.zeros((samples, groups * each))
            filled[: len(change), : change.shape[1]] = np.nan_to_num(change)
            blocks[own] = filled.reshape(blocks[own].shape)
        return blocks

    def linear_steps(self, rows: Sequence[Doubt]) -> list[tuple[float, Array]]:
        """Return the decrease of χ² by a linear step along each row, and the size of the mistake."""
        if not rows:
            return []
        effects = [
            (Deviation(row.name, row.unit, axes=row.axes, effect=row.effect), 1.0)
            for row in rows
            if row.changes is None
        ]
        collocation = self.solution.collocation
        by_effects = changed_residuals(collocation, self.solution.z, effects).blocks
        own, first = [], 0
        for row in rows:
            count = max(1, len(row.axes.split()))
            if row.changes is None:
                own.append([block[..., first : first + count] for block in by_effects])
                first += count
            else:
                own.append([*row.changes])
        blocks = [np.concatenate(each, axis=-1) for each in zip(*own, strict=True)]
        gram = projected_gram(self.linearised, blocks)
        ends = np.cumsum([1, *(each[0].shape[-1] for each in own)]).tolist()
        return [
            linear_step(gram, range(a, b), row.mean, row.wide)
            for row, a, b in zip(rows, ends[:-1], ends[1:], strict=True)
        ]

    def screened(self, rows: Iterable[Doubt]) -> Iterator[Candidate]:
        """Yield those likely mistakes that are possible and of which a linear step decreases χ² by at
        least `LEAST_DECREASE`.
        """
        rows = [*rows]
        total = sum(
            float(np.nansum(ratios**2)) for _, ratios in scaled_residuals(self.part)
        ) + float(self.part.phi @ self.part.phi)
        for row, (decrease, size) in zip(rows, self.linear_steps(rows), strict=True):
            if decrease >= LEAST_DECREASE and (found := row.hypothesis(self.experiment, size)):
                yield max(0.0, 1 - decrease / total), found


def projected_gram(fit: LinearisedFit, blocks: Sequence[Array]) -> Array:
    """Return the Gram matrix (1 + c, 1 + c) of the residuals of a fit and of c changes of them, less
    what a step of its parameters explains.
    """
    count = blocks[0].shape[-1]
    wide = fit.with_columns([""] * count, blocks)
    triangle = least_squares_of_fit(wide).triangle
    values = triangle[:, [-1, *range(len(fit.names), triangle.shape[1] - 1)]]
    jacobian = triangle[:, np.flatnonzero(~fit.at_bound)]
    explained = np.linalg.lstsq(jacobian, values, rcond=1e-10)[0]
    return (remaining := values - jacobian @ explained).T @ remaining


def least_loss(fit: Solution, deviations: Mapping[str, float | None]) -> float:
    """Return χ² after a linear step from a fit in its parameters and in all effects of the budget,
    with their standard deviations by name in place of the usual ones.
    """
    effects = changes_of_assumptions(fit.collocation, fit.z, deviations)
    known = linearise_fit(fit.collocation, fit.z)
    count = len(effects.names)
    return remaining_squares(known.with_columns(effects.names, effects.blocks, np.zeros(count)))


def linear_step(
    gram: Array, columns: Iterable[int], mean: float = 0.0, wide: float = np.inf
) -> tuple[float, Array]:
    """Return the decrease of χ² by changes of the residuals, and their sizes, which have the prior
    deviation `wide` about `mean`.

    `gram` is the result of `projected_gram`, in which changes are `columns` from 1 on.
    """
    own = [*columns]
    among = gram[np.ix_(own, own)]
    size = np.full(len(own), mean)
    if wide > 0:
        weight = np.eye(len(own)) / wide**2
        towards = weight @ size - gram[own, 0]
        size = np.linalg.lstsq(among + weight, towards, rcond=1e-8)[0].astype(np.float64)
    return float(-2 * size @ gram[own, 0] - size @ among @ size), size
