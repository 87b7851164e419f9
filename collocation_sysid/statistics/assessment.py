"""Verdict on a fit: "good", "check" or "doubtful", with its reasons.

Each function whose name ends in "concerns" examines one thing and returns a list of concerns, empty
if there are none. Levels of significance are strict: at least 95 % of fits to faultless data are to
be "good", however many markers and nuisance parameters there are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import ClassVar, Literal

import numpy as np

from ..common.array_types import Array
from ..common.display import predicted_change
from ..model.parameters import Parameters, is_default_bound
from ..program.modes.stability import Instability
from ..recording.deviation import Deviation, in_readable_unit
from ..recording.experiment import Experiment
from ..recording.impact_steps import impact_steps
from ..recording.measurement import root_mean
from .budget.discretisation_error import Refinement
from .concerns import Concern, Grade, concern_if
from .distributions import chi2_sf, largest_deviation, normal_isf
from .estimates import Estimate, display_name, limitless_shares
from .hypothesis import Hypothesis
from .residuals.autocorrelation import Dependence
from .residuals.diagnostics import MOST_WILD
from .residuals.noise_level import ROUNDING, NoiseLevel
from .thresholds import (
    AS_GOOD_AS_CERTAIN,
    CHANCE,
    CLEARLY_PERSISTENT,
    DAMPING_SHARE,
    E_FOLDINGS,
    GROSS_DAMPING_SHARE,
    GROSS_E_FOLDINGS,
    GROSS_MISFIT,
    GROSS_PERIOD_ERROR,
    GROSS_PREDICTION,
    GROSS_ROLLOUT,
    HARDLY_TAME,
    LITTLE_DAMPING,
    MARKER_MISFIT,
    MISFIT,
    MOVED,
    OWN_ONSET,
    PERIOD_ERROR,
    PERSISTENT,
    PREDICTION,
    RARE,
    ROLLOUT,
)
from .uncertainty import ErrorBasis, Uncertainty

Verdict = Literal["good", "check", "doubtful"]

# Codes of concerns about bounds, and about the start, from which others may follow.
FIRST = (
    "description/not-at-rest",
    "information/default-bound",
    "information/flat",
    "information/liquid",
)
# Codes of hypotheses that stand for several, none of which is likely alone.
OPEN_CAUSES = "description/several", "description/insufficient"
# Share of the samples beyond Huber's threshold: "check".
WILD = MOST_WILD
# Advice about an unknown of a specimen that is far from its prior, and about one that is so far that
# no such error is as large.
WIDENING = (
    "check whether this value is possible, and if it is, widen its prior in the [[experiment]]"
)
HIDING = (
    "it hides another error, such as a preload at which the displacement was set to zero (strain_zero "
    "states the strain under it), a law that is too simple, or a wrong unit, area or kind of test"
)
# Where the priors of components that are not keys of [experiment.nuisance] are stated.
STATED_IN = {
    "images": "the table of the camera's measurement (pose_sigma, clock_sigma_s, …)",
    "gauge": "the table of the measurement",
}
# Ratio of the steps that impacts need and the stated ones from which E is wrong by tens of percent: a
# falling block with 4 in place of 15 was 46 % too stiff.
FEW_IMPACT_STEPS = 2.0
# Code of the concern about a measured discretisation error.
NUMERICAL = "mesh/refined"
# Rotation within a grid step [rad] above which there is a warning: it seems a strain of 4e-4.
WARNING_ANGLE_RAD = 0.055
# Rotation within a grid step [rad] that the recommended substeps reach; below FAST for rounding.
TARGET_ANGLE_RAD = 0.05
# Rotation within a grid step [rad] that makes the result doubtful: it seems a strain of 1e-3.
DOUBTFUL_ANGLE_RAD = 0.1
_KEY = "transcription.substeps"


@dataclass(frozen=True)
class Assessment:
    """Concerns, the gravest first, and the resulting verdict.

    Notes
    -----
    `from_concerns` establishes the order; the constructor takes the concerns as they are.
    """

    concerns: tuple[Concern, ...] = ()  # empty if the verdict is "good"
    SERIALISED_PROPERTIES: ClassVar = ("verdict", "reasons")

    @classmethod
    def from_concerns(cls, concerns: Iterable[Concern]) -> Assessment:
        """Build from concerns: "doubtful" ones come first, in their given order, then "check" ones.

        Those of `FIRST` come before all others, with their gravest grade, because the others may
        follow from them. Of several concerns with the same message the first is kept, whatever its
        grade and code.
        """
        by_message: dict[str, Concern] = {}
        for concern in concerns:
            by_message.setdefault(concern.message, concern)
        gravest = sorted(by_message.values(), key=lambda each: each.grade == "check")
        first = [replace(e, grade=gravest[0].grade) for e in gravest if e.code in FIRST]
        return cls((*first, *(each for each in gravest if each.code not in FIRST)))

    @property
    def verdict(self) -> Verdict:
        """Verdict in one word: "good" without concerns, else the grade of the first concern.

        "good": nothing speaks against the answer and its error bars. "check": usable, after a look
        at the reasons. "doubtful": something is wrong with data, model or solve.
        """
        return self.concerns[0].grade if self.concerns else "good"

    @property
    def reasons(self) -> tuple[str, ...]:
        """Messages of the concerns, in the order of `concerns`."""
        return tuple(concern.message for concern in self.concerns)


def cause_concerns(causes: Iterable[Hypothesis]) -> list[Concern]:
    """Return a concern for each likely misspecification, in the same order.

    It is "doubtful" if the misfit decreases by more than a factor of two (`AS_GOOD_AS_CERTAIN`) without the
    misspecification, else "check"; its message begins with "likely: " unless it names several. No
    hypothesis is left out.
    """
    return [
        (
            each
            if f"description/{each.cause}" in OPEN_CAUSES
            else replace(each, subject=f"likely: {each.subject}")
        ).concern("doubtful" if each.strength > AS_GOOD_AS_CERTAIN else "check")
        for each in causes
    ]


def fit_concerns(uncertainty: Uncertainty) -> list[Concern]:
    """Return concerns about the residuals: size compared with σ, correlation, outliers and
    disagreement of recordings.

    Correlation counts only if the error bars use autocorrelated errors and slow errors within σ do
    not explain it (`ErrorBasis.unexplained`): "residuals/persist" in time
    ("doubtful" if the residuals are also more than `GROSS_MISFIT` times σ), else
    "residuals/shared". Residuals more than `MISFIT` times σ are "doubtful" above `GROSS_MISFIT` if
    they are also correlated, or if nothing is known about their correlation in time. Residuals less
    than 1/`MISFIT` of σ are "check" unless they are exactly zero or correlated. All need
    significance at `RARE`, except large residuals (`CHANCE`) and their correlation, which may also
    be above `CLEARLY_PERSISTENT`. One concern for each outlier beyond `GROSS_MISFIT`, for noisy
    markers, and for parameters on which recordings disagree is added.

    Parameters
    ----------
    uncertainty : Uncertainty
        Error bars with the tests of the residuals, which are those of the posterior.
    """
    return [*_residual_concerns(uncertainty), *_disagreement_concerns(uncertainty)]


def _residual_concerns(uncertainty: ErrorBasis) -> list[Concern]:
    level = uncertainty.level
    dependence = uncertainty.unexplained
    factor = float(np.sqrt(level.pooled))
    persistent, shared = _correlations(dependence)
    is_used = uncertainty.errors == "autocorrelated"
    larger = factor > MISFIT and level.larger_p < CHANCE
    # Of single samples nothing tells that it is noise; of a few, only a clear correlation tells
    # that it is not.
    no_noise = (
        persistent
        or shared
        or not np.isfinite(dependence.lag1_deviation)
        or abs(dependence.lag1) > CLEARLY_PERSISTENT
    )
    # Residuals of exactly zero are those of no measurement at all. Dependent residuals scatter less
    # by chance, too, and their error bars do not follow from sigma.
    least = GROSS_MISFIT if is_used and any(_correlations(uncertainty.dependence)) else MISFIT
    # The stated σ of instruments that may err slowly contains more than the noise of a sample.
    may_err_slowly = uncertainty.unexplained is not uncertainty.dependence
    # Where noise of the poses explains more than the residuals, σ is at its least value.
    smaller = 10 * ROUNDING < factor < 1 / least and level.smaller_p < RARE
    smaller = smaller and not (larger or may_err_slowly)
    sigma_key = level.sigma_key
    return [
        *(each.to_concern() for each in uncertainty.outliers if each.deviations > GROSS_MISFIT),
        *concern_if(
            is_used and persistent,
            factor > GROSS_MISFIT,
            code="residuals/persist",
            autocorrelation=dependence.lag1,
        ),
        *concern_if(is_used and shared and not persistent, False, code="residuals/shared"),
        *concern_if(
            larger,
            factor > GROSS_MISFIT and no_noise,
            code="noise/larger",
            factor=factor,
            stated=sigma_key,
        ),
        *concern_if(
            smaller, False, code="noise/smaller", factor=1 / (factor or 1.0), stated=sigma_key
        ),
        *_noisy_marker_concerns(level),
    ]


def _correlations(dependence: Dependence) -> tuple[bool, bool]:
    limit = float(normal_isf(RARE / 2)) * dependence.lag1_deviation
    return abs(dependence.lag1) > max(PERSISTENT, limit), dependence.shared_p < RARE


def _disagreements(uncertainty: Uncertainty) -> list[str]:
    scatter = uncertainty.scatter
    disagreeing = [] if scatter is None else np.flatnonzero(scatter.find_disagreements()).tolist()
    return [uncertainty.names[k] for k in disagreeing]


def _disagreement_concerns(uncertainty: Uncertainty) -> list[Concern]:
    names = [
        display_name(name, is_scalar=name in uncertainty.estimates)
        for name in _disagreements(uncertainty)
    ]
    return concern_if(bool(names), False, code="residuals/recordings", names=names)


def _noisy_marker_concerns(level: NoiseLevel) -> list[Concern]:
    """Return one concern, as a list, if markers or other sensors are much noisier than the others;
    else empty.

    Noisy are markers whose residuals exceed `MARKER_MISFIT` times the median of all markers (the
    lower one of an even number), and `MARKER_MISFIT` times σ. Nothing is reported unless the test
    for unequal variances is significant at `RARE`.
    """
    if not level.unequal_p < RARE:
        return []
    usual = sorted(level.factors.values())[(len(level.factors) - 1) // 2]
    noisy = [n for n, f in level.factors.items() if f > MARKER_MISFIT * max(1.0, usual)]
    if not noisy:
        return []
    worst = max(noisy, key=level.factors.__getitem__)
    stated = level.sigma_keys.get(worst, "sigma_m")
    kind = "marker" if stated == "sigma_m" else "sensor"
    data = {"marker": worst, "factor": level.factors[worst], "count": len(noisy), "stated": stated}
    return [Concern(f"noise/{kind}{'s' * (len(noisy) > 1)}", data=data)]


def parameter_concerns(
    uncertainty: Uncertainty, parameters: Parameters | None = None
) -> list[Concern]:
    """Return concerns about estimated parameters at their bounds, and one, "doubtful", if no
    parameter has a standard error, so that there is no answer.

    Several parameters at stated bounds are one concern, "doubtful"; a single one is "check". Those
    at default bounds of `parameters`, if given, are another one, "check", and so are shares of
    memory that grew to the largest one; one whose interval contains all that its bounds allow is
    not determined in place of being at its bound. Mode coefficients of fields do not count. That some
    parameters are not determined contradicts nothing and is no concern: the table of the estimates
    shows it.
    """
    known = uncertainty.estimates
    estimates = {name: known[name] for name in uncertainty.names if name in known}
    at_default = [
        item.name
        for item in (() if parameters is None else parameters.free)
        if item.name in estimates
        and estimates[item.name].at_bound
        and is_default_bound(item, estimates[item.name].value)
    ]
    at_bound = [name for name, estimate in estimates.items() if estimate.at_bound]
    liquid = [] if parameters is None else limitless_shares(parameters)
    bounded = [name for name in at_bound if name not in at_default]
    undetermined = [
        name
        for name, estimate in estimates.items()
        if not estimate.at_bound and estimate.statistical_std_error is None
    ]
    # Each recording alone may determine what they disagree on.
    is_open = not set(undetermined) & set(_disagreements(uncertainty))
    flat = [name for name in at_default if _is_flat(uncertainty, name, parameters)]
    pressed = [name for name in at_default if name not in flat]
    return [
        *concern_if(bool(pressed), False, code="information/default-bound", names=pressed),
        *concern_if(bool(flat), False, code="information/flat", names=flat),
        *concern_if(bool(liquid), False, code="information/liquid", names=liquid),
        *concern_if(bool(bounded), len(bounded) > 1, code="information/bound", names=bounded),
        *concern_if(
            bool(undetermined) and len(undetermined) == len(estimates) and is_open,
            True,
            code="information/none",
            names=undetermined,
        ),
    ]


def _is_flat(uncertainty: Uncertainty, name: str, parameters: Parameters | None) -> bool:
    """Whether the 95 % interval of a parameter at its upper bound is longer than its bounds are
    apart. At a lower bound a logarithm has no effect although the data may exclude larger values.
    """
    item = next(each for each in parameters.free if each.name == name) if parameters else None
    if item is None or item.scale != "log":
        return False
    k = uncertainty.names.index(name)
    reach = 2 * uncertainty.quantiles[k] * np.sqrt(uncertainty.complete_covariance[k, k])
    is_upper = uncertainty.estimates[name].value > np.sqrt(item.lower * item.upper)
    return bool(is_upper and reach > np.log(item.upper / item.lower))


def numerical_concerns(
    optimum: Mapping[str, Estimate],
    combined_std_errors: Mapping[str, float | None],
    refinement: Refinement | None,
) -> list[Concern]:
    """Return a concern if the measured correction for step and mesh is large compared with the
    standard uncertainty of a parameter; it names the parameter with the largest ratio.

    Parameters
    ----------
    optimum : mapping of name to Estimate
        Estimates before the correction of the discretisation error.
    combined_std_errors : mapping of name to float or None
        Combined standard uncertainties; None if unknown, then the parameter is left out.
    refinement : Refinement or None
        Measured discretisation errors; None without.

    Returns
    -------
    list of Concern
        Empty, or one concern of grade "check" if the largest correction exceeds `MOVED` standard
        uncertainties.
    """
    if refinement is None:
        return []
    worst, largest = refinement.largest_correction(optimum, combined_std_errors)
    if largest <= MOVED:
        return []
    value = optimum[worst].value
    change = (refinement.errors[worst].extrapolated - value) / abs(value)
    text = predicted_change(change, f"{100 * change:+.2g} %")
    return [Concern(NUMERICAL, data={"name": worst, "change": text, "errors": largest})]


def outlier_share_concerns(wild: int, samples: int) -> list[Concern]:
    """Return one concern, as a list, if the share of samples beyond Huber's threshold, of all
    samples, exceeds `WILD`; "doubtful" above `HARDLY_TAME`. Else empty, also without samples.
    """
    share = wild / max(1, samples)
    return concern_if(share > WILD, share > HARDLY_TAME, code="residuals/wild", percent=100 * share)


def nuisance_concerns(
    names: Iterable[str],
    deviations: Iterable[float],
    low: Iterable[float],
    high: Iterable[float],
    *,
    expected: Iterable[float] = (),
    is_specimen: bool = False,
    rows: Sequence[Deviation] = (),
    scales: Sequence[float] = (),
) -> list[Concern]:
    """Return concerns about nuisance parameters far from their priors or at their limits; of the
    components of a vector that are far, about the farthest.

    Parameters
    ----------
    deviations : iterable of float
        Estimates φ in standard deviations of their priors.
    low, high : iterables of float
        Limits of the estimates, likewise.
    expected : iterable of float, optional
        Standard deviations that φ have for a true description, at most 1 unless the residuals show
        more noise than stated: data that hardly see a parameter leave it near zero.
    is_specimen : bool
        Whether they are those of a specimen, whose page explains them.
    rows : sequence of Deviation
        Their kinds; empty if these are not known.
    scales : sequence of float
        Standard deviations of their priors, in the units of the kinds.

    Notes
    -----
    At a limit (within 0.001 standard deviations) the concern is "doubtful". Else, as for effects of
    the budget, it is "check" beyond the deviation that is exceeded with the probability `CHANCE` by
    any of the n parameters (Bonferroni), 2.6 standard deviations for one parameter and 3.5 for 20,
    and "doubtful" beyond that of the probability `RARE`, 3.9 and 4.6, or of these standard
    deviations that are expected. Limits may be infinite.
    """
    items = [*zip(names, deviations, low, high, strict=True)]
    sizes = [*expected] or [1.0] * len(items)
    limit, gross = (largest_deviation(len(items), p) for p in (CHANCE, RARE))
    concerns: list[Concern] = []
    far: dict[str, tuple[float, Concern]] = {}
    for k, (name, phi, lowest, highest) in enumerate(items):
        deviation = abs(float(phi))
        limited = not lowest + 1e-3 < phi < highest - 1e-3
        concerns += concern_if(
            limited, True, code="specimen/limit" if is_specimen else "nuisance/limit", name=name
        )
        vector = name.rpartition(", ")[0] or name
        is_gross = deviation > gross * min(1.0, sizes[k])
        if limited or deviation <= max(0.0 if is_gross else limit, far.get(vector, (0.0,))[0]):
            continue
        data: dict[str, object] = {"name": name, "deviations": deviation}
        code = "specimen/far" if is_specimen else "nuisance/far"
        if is_specimen:
            data["advice"] = HIDING if is_gross else WIDENING
        elif rows:
            size, unit = in_readable_unit(deviation * scales[k], rows[k].unit)
            where = STATED_IN.get(rows[k].of, "[experiment.nuisance]")
            data |= {"size": f"{size:.2g}{unit}", "where": where}
            code = "nuisance/large" if deviation * scales[k] > rows[k].largest else "nuisance/sized"
        far[vector] = deviation, Concern(code, "doubtful" if is_gross else "check", data)
    concerns += (concern for _, concern in far.values())
    return concerns


def forward_simulation_concerns(
    name: str, simulated: InstrumentMisfit, fitted: InstrumentMisfit, *, is_static: bool = False
) -> list[Concern]:
    """Return one concern, as a list, if the forward simulation of a fitted experiment misses the
    measurements of an instrument by much more than the fit; else empty.

    √(simulated² − fitted²) is "check" above `ROLLOUT` times the larger of the fit's misfit and the
    noise, and "doubtful" above `GROSS_ROLLOUT`.
    """
    squares = simulated.robust_sigmas**2 - fitted.robust_sigmas**2
    missed = float(np.sqrt(max(0.0, squares))) / max(1.0, fitted.robust_sigmas)
    return concern_if(
        missed > ROLLOUT,
        missed > GROSS_ROLLOUT,
        code="roll-out/misses",
        experiment=name,
        what=simulated.what,
        simulated=simulated.size_text,
        fitted=fitted.size_text,
        why="its loads lead to other equilibria than the fitted ones: add loads between its samples"
        if is_static
        else "the time step is too long; raise transcription.substeps",
    )


def validation_concerns(
    name: str, misfit: InstrumentMisfit, level: float, deviations: Mapping[str, float]
) -> list[Concern]:
    """Return one concern, as a list, if the prediction of an experiment that was not fitted misses
    the measurements of an instrument; else empty.

    Parameters
    ----------
    misfit : InstrumentMisfit
        Misfit of the prediction: "check" above `PREDICTION`, "doubtful" above `GROSS_PREDICTION`
        times the larger of `level` and the noise; none if χ² is as large by chance (p > `RARE`).
    level : float
        Misfit of such instruments in the fits of the other experiments, in σ.
    deviations : mapping of name to float
        Changes of the nuisance parameters that would fit the experiment best, in standard
        deviations of their priors; the message names the largest if it is implausible.
    """
    times = misfit.robust_sigmas / max(1.0, level)
    is_chance = float(chi2_sf(misfit.count * times**2, misfit.count)) > RARE
    label = max(deviations, key=lambda each: abs(deviations[each]), default="")
    is_absorbed = label and abs(deviations[label]) > largest_deviation(len(deviations), RARE)
    return concern_if(
        times > PREDICTION and not is_chance,
        times > GROSS_PREDICTION,
        code="roll-out/predicted",
        experiment=name,
        what=misfit.what,
        size=misfit.size_text,
        sigmas=misfit.sigmas,
        stated=misfit.sigma_key,
        times=times,
        absorbed=f" (to explain it by '{label}' would take {deviations[label]:.3g} standard "
        "deviations of its prior)"
        if is_absorbed
        else "",
    )


def onset_concerns(name: str, label: str, deviation: float) -> list[Concern]:
    """Return one concern, as a list, if an onset or a clock that a prediction takes from its own
    recording is more than `OWN_ONSET` standard deviations of its prior from zero; else empty.
    """
    return concern_if(
        abs(deviation) > OWN_ONSET,
        False,
        code="roll-out/onset",
        experiment=name,
        name=label,
        deviations=abs(deviation),
    )


def prediction_concerns(
    name: str,
    what: str,
    sigma_key: str,
    sigmas: float,
    robust_sigmas: float,
    count: int,
    size: str = "",
    surprise: Grade | None = None,
) -> list[Concern]:
    """Return a concern if a prediction, for which nothing was fitted, differs from the measurements
    by more than chance and a limit, or is much closer to them than their noise; else an empty list.

    Parameters
    ----------
    what : str
        Name of the measured quantity.
    sigmas : float
        Root mean square difference over σ, for the message only.
    robust_sigmas : float
        Root mean square difference over σ with outliers shortened, which decides: "check" above
        `MISFIT`, "doubtful" above `GROSS_MISFIT`, none if χ² is as large by chance (p > `RARE`).
    count : int
        Number of measured values.
    size : str
        Root mean square difference with its unit, for the message; "" leaves it out.
    surprise : {"check", "doubtful"} or None
        Grade of a difference of any size that is larger than by chance; None if its effects are
        expected.
    """
    squares = count * robust_sigmas**2
    is_chance = float(chi2_sf(squares, count)) > RARE
    is_closer = 0 < robust_sigmas < 1 / GROSS_MISFIT and 1 - float(chi2_sf(squares, count)) < RARE
    data = {
        "experiment": name,
        "what": what,
        "stated": sigma_key,
        "sigmas": sigmas,
        "size": f"{size}, " if size else "",
    }
    return [
        *concern_if(
            (robust_sigmas > MISFIT or surprise is not None) and not is_chance,
            robust_sigmas > GROSS_MISFIT or surprise == "doubtful",
            code="prediction/misses",
            **data,
        ),
        *concern_if(is_closer, False, code="prediction/closer", **data),
    ]


def stability_concerns(instabilities: Iterable[Instability]) -> list[Concern]:
    """Return a concern for each instability whose disturbances grow by more than e to the power
    `E_FOLDINGS` in the recording; "doubtful" above `GROSS_E_FOLDINGS`.
    """
    concerns: list[Concern] = []
    for each in instabilities:
        grows = each.e_foldings > E_FOLDINGS
        grossly = each.e_foldings > GROSS_E_FOLDINGS
        concerns += concern_if(grows, grossly, code="stability/grows", **vars(each))
    return concerns


def rotation_step_concerns(
    experiment: Experiment,
    substeps: int,
    limit_rad: float = WARNING_ANGLE_RAD,
    code: str = "scheme/turns",
) -> list[Concern]:
    """Return one concern, as a list, if a grasp rotates by more than a limit within a step of the
    time grid; else empty, also for a static experiment.

    Parameters
    ----------
    substeps : int
        Steps per sample of the grid.
    limit_rad : float
        Largest rotation in a step [rad].
    code : str
        Code of the concern, whose grade is "check".
    """
    turn = fastest_rotation(experiment, substeps)
    sizes = {"step_ms": 1e3 * turn.step_s, "rate_rad_s": turn.angle_rad / turn.step_s}
    return concern_if(turn.angle_rad > limit_rad, False, code=code, **vars(turn), **sizes)


def impact_step_concerns(experiment: Experiment, substeps: int) -> list[Concern]:
    """Return one concern, as a list, if a body that may strike an obstacle moves by much more than the
    noise of its markers in one of the `substeps` of a sample; else empty.
    """
    needed = impact_steps(experiment)
    is_coarse = needed > FEW_IMPACT_STEPS * substeps
    return concern_if(
        is_coarse,
        True,
        "scheme/impacts",
        experiment=experiment.name,
        stated=substeps,
        needed=needed,
    )


def scheme_concerns(
    name: str, damping_ratio: float, added_ratio: float, period_error: float
) -> list[Concern]:
    """Return concerns about the effect of the scheme on the first mode of an experiment, at most
    one about damping and one about the period.

    Added damping is "check" above `DAMPING_SHARE` of the mode's and above `LITTLE_DAMPING`, and
    "doubtful" above `GROSS_DAMPING_SHARE`; negative added damping is no concern. A change of the
    period of either sign is "check" above `PERIOD_ERROR`, "doubtful" above `GROSS_PERIOD_ERROR`.

    Parameters
    ----------
    damping_ratio : float
        Damping ratio of the mode at the answer.
    added_ratio : float
        Damping ratio that the scheme adds.
    period_error : float
        Relative change of the period by the scheme.
    """
    return [
        *concern_if(
            added_ratio > max(DAMPING_SHARE * damping_ratio, LITTLE_DAMPING),
            added_ratio > GROSS_DAMPING_SHARE * damping_ratio,
            code="scheme/damping",
            experiment=name,
            added=added_ratio,
            damping=damping_ratio,
        ),
        *concern_if(
            abs(period_error) > PERIOD_ERROR,
            abs(period_error) > GROSS_PERIOD_ERROR,
            code="scheme/period",
            experiment=name,
            change=period_error,
        ),
    ]


def rms_expected_from_noise_m(
    sigma_m: Array, samples: Array, numbers: Array, parameter_count: float
) -> float:
    """Return the RMS distance of markers that noise alone would leave [m], the root of (1 − p/N)
    Σ n σ² / Σ s; 0 without samples or if p ≥ N.

    Parameters
    ----------
    sigma_m, samples, numbers : (M,) arrays
        Stated σ, number of samples s and of measured coordinates n of the markers of all
        experiments.
    parameter_count : float
        Number p of parameters that the data determine, of N = Σ n measurements.
    """
    if not samples.sum():
        return 0.0
    remaining = max(0.0, 1 - parameter_count / float(numbers.sum()))
    return float(np.sqrt(remaining * (numbers @ sigma_m**2) / samples.sum()))


@dataclass(frozen=True)
class GraspRotation:
    """The largest rotation of a grasp between two times of the grid."""

    experiment: str
    angle_rad: float  # angle of the rotation within the step
    time_s: float  # begin of the step
    step_s: float  # length of the step
    # What to change in the problem, for messages: the substeps that reduce the angle to
    # `TARGET_ANGLE_RAD`, or, for poses held between samples, a smooth interpolation.
    remedy: str


def fastest_rotation(experiment: Experiment, substeps: int) -> GraspRotation:
    """Return the largest rotation of an experiment's grasps and obstacles within a step of the time
    grid, while they are active.

    Parameters
    ----------
    experiment : Experiment
        Of a static experiment the angle is 0, as there are no steps, and the time that of the first
        sample.
    substeps : int
        Steps per sample.
    """
    step_s = experiment.timestep_s / substeps
    steps = (len(experiment.t_s) - 1) * substeps
    t_s = experiment.t_s[0] + step_s * np.arange(steps + 1)
    largest = 0.0
    time_s = float(t_s[0])
    is_rigid_grasp = False
    for grasp in () if experiment.is_static else experiment.grasps:
        times_s = t_s[grasp.is_active(t_s)]
        if len(times_s) < 2:
            continue
        rotations = grasp.poses.at(times_s)[0]
        # tr RᵀQ = 1 + 2 cos θ loses small angles to rounding; |R − Q|² = 8 sin²(θ/2) does not.
        chords = np.linalg.norm(np.diff(rotations, axis=0), axis=(1, 2))
        k = int(np.argmax(chords))
        angle = 2 * float(np.arcsin(min(1.0, chords[k] / np.sqrt(8))))
        if angle > largest:
            largest = angle
            time_s = float(times_s[k])
            is_rigid_grasp = grasp.poses.interpolation == "hold"
    needed = max(1, ceil(substeps * largest / TARGET_ANGLE_RAD))
    # A pose that is held turns by as much at a sample, however many steps there are between.
    remedy = (
        'set interpolation = "smooth" in the grasp' if is_rigid_grasp else f"set {_KEY} = {needed}"
    )
    return GraspRotation(experiment.name, largest, time_s=time_s, step_s=step_s, remedy=remedy)


@dataclass(frozen=True)
class InstrumentMisfit:
    """Differences between a prediction and the measurements of one kind, in stated σ."""

    what: str  # what is measured, for people
    sigma_key: str  # key of σ in the problem, for people
    sigmas: float  # root mean square of the differences over σ
    # The same without outliers of depth, see `DepthError`; predictions are judged by it.
    robust_sigmas: float
    count: int  # number of measured values
    size: str = ""  # root mean square in a unit, for people; empty if units differ

    @property
    def size_text(self) -> str:
        """`size`, or without one the multiple of σ in words."""
        return self.size or f"{self.sigmas:.3g} times {self.sigma_key}"


def misfit(what: str, declared_size: str, ratio: Array, size: str = "") -> InstrumentMisfit:
    """Return the misfit of one instrument; its RMS is that of the values that are finite.

    Parameters
    ----------
    what : str
        The instrument, for messages.
    declared_size : str
        Name of its stated σ, for messages.
    ratio : array
        Differences over σ; NaN is ignored.
    size : str
        RMS with its unit, for messages; "" if there is none.
    """
    known = ratio[np.isfinite(ratio)]
    sigmas = root_mean(known**2)
    return InstrumentMisfit(
        what, declared_size, sigmas=sigmas, robust_sigmas=sigmas, count=known.size, size=size
    )
