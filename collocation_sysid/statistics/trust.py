"""One word on how far an answer can be trusted, with its reasons.

Every function here looks at one thing and returns what gives concern, each a sentence and how
strong it is. The levels are strict: of answers to faultless data at least 95 % are to be called
good, however many markers and nuisance parameters there are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ..arrays import Array
from ..errors import listed
from ..nlp.stability import Instability
from .cause import Cause
from .diagnostics import MOST_WILD, MarkerDiagnosis
from .distributions import normal_isf
from .estimates import Estimate
from .noise import NoiseLevel
from .numerical import Refinement
from .uncertainty import Uncertainty

Verdict = Literal["good", "check", "doubtful"]
Concern = tuple[str, Literal["check", "doubtful"]]

# A cause without which the misfit falls by more than this is as good as certain.
CERTAIN = 2.0
# Probability of a false alarm, of each test.
RARE = 1e-4
# Residuals this many times sigma_m, or one over it, deserve a look; as many as the second, and not
# white, are no noise.
MISFIT, GROSS_MISFIT = 1.5, 3.0
# One marker alone may differ by more.
MARKER_MISFIT = 2.0
# Autocorrelation that matters, and from which on hardly any of the residuals is noise.
PERSISTENT, NO_NOISE = 0.2, 0.9
# What a roll-out misses more than the fit, over the fit's own RMS or that of the noise.
ROLLOUT, GROSS_ROLLOUT = 0.35, 2.0
# A prediction this many times worse than the fit.
PREDICTION, GROSS_PREDICTION = 3.0, 10.0
# Nuisance parameters this many deviations of their priors away.
FAR, ABSURD = 3.0, 6.0
LATE = 1.8
# Share of the samples beyond Huber's threshold, of all.
WILD, HARDLY_TAME = MOST_WILD, 0.2
# What a scheme adds to the damping ratio, over it; and by how much it may lengthen a period.
DAMPING_SHARE, GROSS_DAMPING_SHARE, LITTLE_DAMPING = 0.2, 1.0, 0.005
PERIOD_ERROR, GROSS_PERIOD_ERROR = 0.02, 0.1
# Powers of e by which a disturbance may grow in a recording.
E_FOLDINGS, GROSS_E_FOLDINGS = 1.0, 7.0
# Standard errors that step and mesh may move a parameter: the half width of its interval.
MOVED = 2.0
# How what is said of the numerical error begins: estimated, and measured.
STEP_MOVES = "the step moves", "step and mesh move"


@dataclass(frozen=True)
class Trust:
    """A verdict and the sentences it rests on, the gravest first.

    Attributes
    ----------
    verdict : {"good", "check", "doubtful"}
        "good": nothing speaks against the answer and its error bars. "check": usable, after a
        look at the reasons. "doubtful": something is wrong with data, model or solve.
    reasons : tuple of str
        Empty if the verdict is good.
    """

    verdict: Verdict
    reasons: tuple[str, ...] = ()

    @classmethod
    def of(cls, concerns: Iterable[Concern]) -> Trust:
        """The verdict that the gravest concern brings."""
        found = tuple(concerns)
        grave, light = (
            [said for said, strength in found if strength == wanted]
            for wanted in ("doubtful", "check")
        )
        verdict = "doubtful" if grave else "check" if light else "good"
        return cls(verdict, tuple(dict.fromkeys((*grave, *light))))

    def joined(self, other: Trust) -> Trust:
        """The graver of two verdicts, with the reasons of both."""
        gravity = get_args(Verdict).index
        light, grave = sorted((other, self), key=lambda each: gravity(each.verdict))
        return Trust(grave.verdict, tuple(dict.fromkeys((*grave.reasons, *light.reasons))))


def cause_concerns(causes: Iterable[Cause]) -> list[Concern]:
    """What is likely described wrongly."""
    return [
        (f"likely: {each.sentence}", "doubtful" if each.strength > CERTAIN else "check")
        for each in causes
    ]


def fit_concerns(uncertainty: Uncertainty) -> list[Concern]:
    """The residuals against sigma_m and against white noise."""
    level, found = uncertainty.level, uncertainty.dependence
    factor = float(np.sqrt(level.pooled))
    limit = float(normal_isf(RARE / 2)) * found.lag1_deviation
    persistent = abs(found.lag1) > max(PERSISTENT, limit)
    shared = found.shared_p < RARE
    matters = uncertainty.errors == "autocorrelated" and (persistent or shared)
    concerns: list[Concern] = [
        (f"{each.series}: {each.said}", "check") for each in uncertainty.outliers
    ]
    if matters and persistent:
        concerns.append(
            (
                f"the residuals are not noise: they persist from sample to sample "
                f"(autocorrelation {found.lag1:.2f})",
                "doubtful" if found.lag1 > NO_NOISE and factor > MISFIT else "check",
            )
        )
    elif matters:
        concerns.append(("the residuals are not noise: markers or axes share them", "check"))
    if factor > MISFIT and level.larger_p < RARE:
        # Of single samples nothing tells that it is noise.
        untested = not np.isfinite(found.lag1_deviation)
        gross = factor > GROSS_MISFIT and (persistent or shared or untested)
        said = f"the residuals are {factor:.2g} times as large as {level.stated} says"
        concerns.append((said, "doubtful" if gross else "check"))
    elif factor < 1 / MISFIT and level.smaller_p < RARE and not matters:
        concerns.append(
            (f"{level.stated} seems {1 / factor:.2g} times too large for these residuals", "check")
        )
    return concerns + _uneven_concerns(uncertainty.level) + _scatter_concerns(uncertainty)


def _scatter_concerns(uncertainty: Uncertainty) -> list[Concern]:
    """Recordings that disagree on what they share."""
    scatter = uncertainty.scatter
    if scatter is None or not scatter.disagreeing.any():
        return []
    which = [uncertainty.names[k] for k in np.flatnonzero(scatter.disagreeing)]
    said = f"the recordings disagree on {listed(which)}: model error decides, not noise"
    return [(said, "check")]


def _uneven_concerns(level: NoiseLevel) -> list[Concern]:
    """Markers that are noisier than the others."""
    if not level.unequal_p < RARE:
        return []
    usual = float(np.median([*level.factors.values()]))
    noisy = [n for n, f in level.factors.items() if f > MARKER_MISFIT * max(1.0, usual)]
    if not noisy:
        return []
    worst = max(noisy, key=level.factors.__getitem__)
    which = worst if len(noisy) == 1 else f"{len(noisy)} markers, most of all {worst},"
    verb = "is" if len(noisy) == 1 else "are"
    return [(f"{which} {verb} off by {level.factors[worst]:.2g} times sigma_m", "check")]


def parameter_concerns(uncertainty: Uncertainty) -> list[Concern]:
    """Parameters at their bounds, and those that the data do not tell."""
    estimates = {name: uncertainty.estimates[name] for name in uncertainty.names}
    bounded = [name for name, found in estimates.items() if found.at_bound]
    vague = [n for n, found in estimates.items() if not found.at_bound and found.std_error is None]
    concerns: list[Concern] = []
    if bounded:
        ended = f"{listed(bounded)} ended at {'its bound' if len(bounded) == 1 else 'their bounds'}"
        concerns.append((ended, "doubtful" if len(bounded) > 1 else "check"))
    if vague:
        none = len(vague) == len(estimates)
        said = f"these data do not tell {listed(vague)}"
        concerns.append((said, "doubtful" if none else "check"))
    return concerns


def numerical_concerns(
    estimates: Mapping[str, Estimate], refinement: Refinement | None
) -> list[Concern]:
    """Where step or mesh matter more than the noise; what is unknown gives no concern."""
    worst, many = ("", 0.0) if refinement is None else refinement.worst(estimates)
    if refinement is None or many <= MOVED:
        return []
    if refinement.levels:
        what, remedy = STEP_MOVES[1], ""
    else:
        what, remedy = STEP_MOVES[0], "; raise transcription.substeps, or see what refine says"
    value = estimates[worst].value
    share = (value - refinement.errors[worst].extrapolated) / abs(value)
    said = f"{what} {worst} by {100 * share:+.2g} %, {many:.2g} standard errors"
    return [(f"{said}: its interval allows for that{remedy}", "check")]


def marker_concerns(diagnoses: Iterable[MarkerDiagnosis]) -> list[Concern]:
    """Samples that Huber's loss takes for wild."""
    found = tuple(diagnoses)
    wild, samples = sum(d.wild for d in found), max(1, sum(d.samples for d in found))
    if wild <= WILD * samples:
        return []
    said = f"{100 * wild / samples:.0f} % of the samples are beyond Huber's threshold"
    return [(said, "doubtful" if wild > HARDLY_TAME * samples else "check")]


def nuisance_concerns(
    names: Iterable[str], deviations: Iterable[float], low: Iterable[float], high: Iterable[float]
) -> list[Concern]:
    """Nuisance parameters φ in deviations of their priors: far from these, or at their limits."""
    items = [*zip(names, deviations, low, high, strict=True)]
    far = max(FAR, float(normal_isf(RARE / 2 / max(1, len(items))))) if items else FAR
    concerns: list[Concern] = []
    for name, phi, lowest, highest in items:
        if not lowest + 1e-3 < phi < highest - 1e-3:
            concerns.append((f"{name} ended at the largest value allowed", "doubtful"))
        elif abs(phi) > far:
            said = f"{name} is {abs(phi):.1f} deviations of its prior away from zero"
            concerns.append((said, "doubtful" if abs(phi) > ABSURD else "check"))
    return concerns


def clock_concerns(name: str, shift_s: float, prior_s: float) -> list[Concern]:
    """A time shift that is unusual for its prior, though it is estimated and allowed for."""
    if abs(shift_s) <= LATE * prior_s:
        return []
    when = "later" if shift_s > 0 else "earlier"
    return [
        (
            f"the markers of '{name}' were seen {1e3 * abs(shift_s):.2g} ms {when} than their "
            "times say: the estimates allow for it; better find out why",
            "check",
        )
    ]


def rollout_concerns(
    name: str, rms_m: float, fit_rms_m: float, noise_rms_m: float, fitted: bool
) -> list[Concern]:
    """The forward simulation of an experiment against its fit, or its prediction."""
    yardstick_m = max(fit_rms_m, noise_rms_m)
    if not yardstick_m:  # nothing of the kind is measured
        return []
    if not fitted:
        times = rms_m / yardstick_m
        if times <= PREDICTION:
            return []
        said = f"'{name}' is predicted {times:.2g} times worse than the others are fitted"
        return [(said, "doubtful" if times > GROSS_PREDICTION else "check")]
    missed_m = float(np.sqrt(max(0.0, rms_m**2 - fit_rms_m**2)))
    if missed_m <= ROLLOUT * yardstick_m:
        return []
    said = (
        f"the roll-out of '{name}' misses by {1e3 * rms_m:.2g} mm, the fit by "
        f"{1e3 * fit_rms_m:.2g} mm"
    )
    return [(said, "doubtful" if missed_m > GROSS_ROLLOUT * yardstick_m else "check")]


def stability_concerns(found: Iterable[Instability]) -> list[Concern]:
    """States of the answer in which disturbances grow."""
    return [
        (each.sentence, "doubtful" if each.e_foldings > GROSS_E_FOLDINGS else "check")
        for each in found
        if each.e_foldings > E_FOLDINGS
    ]


def scheme_concerns(
    name: str, damping_ratio: float, added_ratio: float, period_error: float
) -> list[Concern]:
    """What the scheme does to the first mode of an experiment, with the answer's parameters."""
    concerns: list[Concern] = []
    if added_ratio > max(DAMPING_SHARE * damping_ratio, LITTLE_DAMPING):
        gross = added_ratio > GROSS_DAMPING_SHARE * damping_ratio
        said = (
            f"the scheme adds a damping ratio of {added_ratio:.2g} to the {damping_ratio:.2g} of "
            f"the first mode of '{name}'"
        )
        concerns.append((said, "doubtful" if gross else "check"))
    if abs(period_error) > PERIOD_ERROR:
        said = f"the scheme changes the first period of '{name}' by {period_error:+.1%}"
        gross = abs(period_error) > GROSS_PERIOD_ERROR
        concerns.append((said, "doubtful" if gross else "check"))
    return concerns


def noise_rms_m(sigma_m: Array, samples: Array, fitted: float) -> float:
    """RMS distance of markers that noise alone would leave: √(3 (1 − p/N)) σ, pooled.

    Parameters
    ----------
    sigma_m, samples : (M,) of the markers of all experiments
    fitted : float
        p, the number of parameters that the data determine.
    """
    if not samples.sum():
        return 0.0
    total = float(samples.sum())
    left = max(0.0, 1 - fitted / (3 * total))
    return float(np.sqrt(3 * left * (samples @ sigma_m**2) / total))
