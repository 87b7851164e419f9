"""One word on how far an answer can be trusted, with its reasons.

Every function here that ends in "concerns" looks at one thing and returns what gives concern. The
levels are strict: of answers to faultless data at least 95 % are to be called good, however many
markers and nuisance parameters there are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, get_args

import numpy as np

from ..arrays import Array
from ..display import short
from ..errors import listed
from ..fem.constants import symbol_of, unit_of
from ..program.stability import Instability
from ..program.touches import Touch
from ..recording.experiment import Experiment
from ..recording.turning import FAST, fastest_turn
from .budget import worded
from .concern import Concern, concerned
from .diagnostics import MOST_WILD, MarkerDiagnosis
from .distributions import chi2_sf, normal_isf
from .estimates import Estimate, told_of
from .hypothesis import Hypothesis
from .noise import NoiseLevel
from .numerical import Refinement
from .relaxation import Probe
from .routine_probes import is_alarming
from .uncertainty import Uncertainty

Verdict = Literal["good", "check", "doubtful"]

# A cause without which the misfit falls by more than this is as good as certain.
CERTAIN = 2.0
# Probability of a false alarm, of each test.
RARE = 1e-4
# Residuals over sigma, or sigma over residuals: from here on "check". The noise of
# cameras is known to about this factor.
MISFIT = 1.5
# Residuals over sigma: from here on "doubtful" if they are not white, or are those of a prediction.
# The only threshold for doubtful residuals; docs/howto/verdict.md states its value.
GROSS_MISFIT = 3.0
# One marker alone may differ by more.
MARKER_MISFIT = 2.0
# Autocorrelation that matters.
PERSISTENT = 0.2
# What a forward simulation misses more than the fit, over the fit's own RMS or that of the noise.
ROLLOUT = 0.35
GROSS_ROLLOUT = 2.0
# A prediction this many times worse than the fit.
PREDICTION = 3.0
GROSS_PREDICTION = 10.0
# Nuisance parameters this many deviations of their priors away.
FAR = 3.0
ABSURD = 6.0
# Deviations of its prior that the pose of a depth camera may be off: it trades for the shape.
CAMERA_FAR = 2.0
# Points of an outline may be so many pixels off the edge in the image, but for this share of them:
# edges of pixels scatter by 0.3, lenses and wrong depths at edges by one.
OUTLINE_FAR_PX = 3.0
OUTLINE_SHARE = 0.1
LATE = 1.8
# Share of the samples beyond Huber's threshold, of all.
WILD = MOST_WILD
HARDLY_TAME = 0.2
# What a scheme adds to the damping ratio, over it; and by how much it may lengthen a period.
DAMPING_SHARE = 0.2
GROSS_DAMPING_SHARE = 1.0
LITTLE_DAMPING = 0.005
PERIOD_ERROR = 0.02
GROSS_PERIOD_ERROR = 0.1
# Powers of e by which a disturbance may grow in a recording.
E_FOLDINGS = 1.0
GROSS_E_FOLDINGS = 7.0
# A contact of fewer faces is as wide as the mesh makes it.
FEWEST_FACES = 4.0
# Combined standard uncertainties by which step and mesh may change a parameter: the half width of
# its 95 % interval.
MOVED = 2.0
# What is said of the numerical error: estimated, and measured.
NUMERICAL = "scheme/step", "mesh/refined"


@dataclass(frozen=True)
class Trust:
    """What gives concern, the gravest first, and the verdict that this brings.

    Attributes
    ----------
    concerns : tuple of Concern
        Empty if the verdict is good.
    """

    concerns: tuple[Concern, ...] = ()
    TOLD: ClassVar = ("verdict", "reasons")

    @classmethod
    def of(cls, concerns: Iterable[Concern]) -> Trust:
        """Each concern once, the gravest first."""
        found = {concern.sentence: concern for concern in reversed([*concerns])}
        gravest = sorted(reversed(found.values()), key=lambda each: each.grade == "check")
        return cls(tuple(gravest))

    @property
    def verdict(self) -> Verdict:
        """In one word how far the answer can be trusted.

        "good": nothing speaks against the answer and its error bars. "check": usable, after a
        look at the reasons. "doubtful": something is wrong with data, model or solve.
        """
        return self.concerns[0].grade if self.concerns else "good"

    @property
    def reasons(self) -> tuple[str, ...]:
        """The sentences that it rests on."""
        return tuple(concern.sentence for concern in self.concerns)

    def joined(self, other: Trust) -> Trust:
        """The graver of two verdicts, with the reasons of both."""
        light, grave = sorted((other, self), key=lambda t: get_args(Verdict).index(t.verdict))
        return Trust.of((*grave.concerns, *light.concerns))


def cause_concerns(causes: Iterable[Hypothesis]) -> list[Concern]:
    """What is likely described wrongly."""
    return [
        replace(cause, of=f"likely: {cause.of}").concern(
            "doubtful" if cause.strength > CERTAIN else "check"
        )
        for cause in causes
    ]


def fit_concerns(uncertainty: Uncertainty) -> list[Concern]:
    """The residuals against sigma_m and against white noise."""
    level = uncertainty.level
    found = uncertainty.dependence
    factor = float(np.sqrt(level.pooled))
    limit = float(normal_isf(RARE / 2)) * found.lag1_deviation
    persistent = abs(found.lag1) > max(PERSISTENT, limit)
    shared = found.shared_p < RARE
    matters = uncertainty.errors == "autocorrelated" and (persistent or shared)
    larger = factor > MISFIT and level.larger_p < RARE
    # Of single samples nothing tells that it is noise.
    no_noise = persistent or shared or not np.isfinite(found.lag1_deviation)
    # Residuals of exactly zero are those of no measurement at all.
    smaller = not larger and 0 < factor < 1 / MISFIT and level.smaller_p < RARE and not matters
    stated = level.stated
    return [
        *(outlier.concern for outlier in uncertainty.outliers),
        *concerned(
            matters and persistent,
            factor > GROSS_MISFIT,
            "residuals/persist",
            autocorrelation=found.lag1,
        ),
        *concerned(matters and not persistent, False, "residuals/shared"),
        *concerned(
            larger, factor > GROSS_MISFIT and no_noise, "noise/larger", factor=factor, stated=stated
        ),
        *concerned(smaller, False, "noise/smaller", factor=1 / (factor or 1.0), stated=stated),
        *_uneven_concerns(level),
        *_scatter_concerns(uncertainty),
    ]


def _scatter_concerns(uncertainty: Uncertainty) -> list[Concern]:
    """Recordings that disagree on what they share."""
    scatter = uncertainty.scatter
    disagreeing = [] if scatter is None else np.flatnonzero(scatter.disagreeing).tolist()
    names = [told_of(uncertainty.names[k]) for k in disagreeing]
    return concerned(bool(names), False, "residuals/recordings", names=names)


def _uneven_concerns(level: NoiseLevel) -> list[Concern]:
    """Markers that are noisier than the others."""
    if not level.unequal_p < RARE:
        return []
    usual = float(np.median([*level.factors.values()]))
    noisy = [n for n, f in level.factors.items() if f > MARKER_MISFIT * max(1.0, usual)]
    if not noisy:
        return []
    worst = max(noisy, key=level.factors.__getitem__)
    code = "noise/marker" if len(noisy) == 1 else "noise/markers"
    data = {"marker": worst, "factor": level.factors[worst], "count": len(noisy)}
    return [Concern(code, data=data)]


def parameter_concerns(uncertainty: Uncertainty) -> list[Concern]:
    """Parameters at their bounds, and those that the data do not tell."""
    known = uncertainty.estimates
    estimates = {name: known[name] for name in uncertainty.names if name in known}
    bounded = [name for name, found in estimates.items() if found.at_bound]
    vague = [
        name
        for name, found in estimates.items()
        if not found.at_bound and found.statistical_std_error is None
    ]
    several = len(bounded) > 1
    code = "information/bounds" if several else "information/bound"
    return [
        *concerned(bool(bounded), several, code, names=bounded),
        *concerned(bool(vague), len(vague) == len(estimates), "information/none", names=vague),
    ]


def numerical_concerns(
    optimum: Mapping[str, Estimate],
    combined_std_errors: Mapping[str, float | None],
    refinement: Refinement | None,
) -> list[Concern]:
    """Return a concern if step or mesh dominate the uncertainty of a parameter.

    Parameters
    ----------
    optimum : mapping of name to Estimate
        Estimates before the correction of the discretisation error.
    combined_std_errors : mapping of name to float or None
        Combined standard uncertainties; None if unknown.
    refinement : Refinement or None
        Discretisation errors; None if they are unknown, which is no concern.
    """
    if refinement is None:
        return []
    worst, largest = refinement.worst(optimum, combined_std_errors)
    if largest <= MOVED:
        return []
    value = optimum[worst].value
    percent = 100 * (refinement.errors[worst].extrapolated - value) / abs(value)
    code = NUMERICAL[1] if refinement.levels else NUMERICAL[0]
    return [Concern(code, data={"name": worst, "percent": percent, "errors": largest})]


# What a relaxed assumption says of a body or a recording, by its name.
RELAXED = {
    "stiffness_drift": "the stiffness is constant during a recording",
    "clock_rate": "the clocks of cameras and robot run at the same rate",
    "time_scale": "all clocks run at the right rate",
}


def probe_concerns(probes: Iterable[Probe], corrections: Mapping[str, float]) -> list[Concern]:
    """The assumption that the data contradict most, with the estimates without it.

    Other assumptions that would explain the data less well are named in the same concern: relaxing
    one is mostly a substitute for relaxing another.

    Parameters
    ----------
    probes : iterable of Probe
    corrections : mapping of parameter to float
        The estimated parameters, in the order in which they are reported, each with the factor that
        corrects its optimum for the known discretisation error.
    """
    alarming = sorted(filter(is_alarming, probes), key=lambda each: -each.chi_squared)
    if not alarming:
        return []
    worst, *others = alarming
    instead = listed(f"{worded(p.name)} ({p.chi_squared:.3g})" for p in others)
    data = {
        "assumption": RELAXED.get(worst.name, f"{worded(worst.name)} is as stated"),
        "name": worded(worst.name),
        "size": short(worst.size or 0.0),
        "size_error": short(worst.size_error or 0.0),
        "chi_squared": worst.chi_squared,
        "estimates": [_relaxed_estimate(worst, *each) for each in corrections.items()],
        "instead": f"; less well also by {instead}" if others else "",
    }
    return [Concern("assumption/contradicted", data=data)]


def _relaxed_estimate(probe: Probe, name: str, correction: float) -> str:
    """Return the estimate of a parameter with an assumption relaxed, in words."""
    move = probe.moves.get(name)
    if move is None:
        return f"{symbol_of(name)} not determined"
    value = correction * move.value
    return f"{symbol_of(name)} = {value:.4g} ± {move.std_error:.2g} {unit_of(name)}".strip()


def marker_concerns(diagnoses: Iterable[MarkerDiagnosis]) -> list[Concern]:
    """Samples that Huber's loss takes for wild."""
    found = tuple(diagnoses)
    share = sum(d.wild for d in found) / max(1, sum(d.samples for d in found))
    return concerned(share > WILD, share > HARDLY_TAME, "residuals/wild", percent=100 * share)


def nuisance_concerns(
    names: Iterable[str], deviations: Iterable[float], low: Iterable[float], high: Iterable[float]
) -> list[Concern]:
    """Nuisance parameters φ in deviations of their priors: far from these, or at their limits."""
    items = [*zip(names, deviations, low, high, strict=True)]
    far = max(FAR, float(normal_isf(RARE / 2 / max(1, len(items))))) if items else FAR
    concerns: list[Concern] = []
    for name, phi, lowest, highest in items:
        away = abs(float(phi))
        limited = not lowest + 1e-3 < phi < highest - 1e-3
        concerns += concerned(limited, True, "nuisance/limit", name=name)
        concerns += concerned(
            away > far and not limited, away > ABSURD, "nuisance/far", name=name, deviations=away
        )
    return concerns


def camera_pose_concerns(names: Sequence[str], deviations: Sequence[float]) -> list[Concern]:
    """Return a concern if a depth camera is farther from its stated pose than expected.

    A wrong shape of the body often fits with a camera that is turned and shifted to match.

    Parameters
    ----------
    names : (k,) sequence of str
        Of the turns and shifts of one camera.
    deviations : (k,) sequence of float
        Their values in standard deviations of their priors.
    """
    if not len(names):
        return []
    worst = int(np.argmax(np.abs(deviations)))
    away = abs(float(deviations[worst]))
    return concerned(
        away > CAMERA_FAR, False, "nuisance/camera", name=names[worst], deviations=away
    )


def outline_concerns(camera: str, apart_px: Array) -> list[Concern]:
    """Return a concern if the outline of the body is elsewhere than a camera's images show.

    Parameters
    ----------
    camera : str
        Name of the depth camera, and of its experiment.
    apart_px : (n,) array
        Distances of outline points from the edges in the images [pixels].
    """
    share = float(np.mean(np.abs(apart_px) > OUTLINE_FAR_PX)) if len(apart_px) else 0.0
    return concerned(
        share > OUTLINE_SHARE,
        False,
        "residuals/outline",
        camera=camera,
        pixels=OUTLINE_FAR_PX,
        percent=100 * share,
    )


def clock_concerns(name: str, shift_s: float, prior_s: float) -> list[Concern]:
    """A time shift that is unusual for its prior, though it is estimated and allowed for."""
    return concerned(
        abs(shift_s) > LATE * prior_s,
        False,
        "nuisance/clock",
        experiment=name,
        shift_ms=1e3 * abs(shift_s),
        when="later" if shift_s > 0 else "earlier",
    )


def rollout_concerns(
    name: str, rms_m: float, fit_rms_m: float, noise_rms_m: float, fitted: bool
) -> list[Concern]:
    """The forward simulation of an experiment against its fit, or its prediction."""
    yardstick_m = max(fit_rms_m, noise_rms_m)
    if not yardstick_m:  # nothing of the kind is measured
        return []
    if not fitted:
        times = rms_m / yardstick_m
        gross = times > GROSS_PREDICTION
        return concerned(
            times > PREDICTION, gross, "roll-out/predicted", experiment=name, times=times
        )
    missed = float(np.sqrt(max(0.0, rms_m**2 - fit_rms_m**2))) / yardstick_m
    return concerned(
        missed > ROLLOUT,
        missed > GROSS_ROLLOUT,
        "roll-out/misses",
        experiment=name,
        rms_mm=1e3 * rms_m,
        fit_mm=1e3 * fit_rms_m,
    )


def prediction_concerns(
    name: str,
    what: str,
    stated: str,
    sigmas: float,
    tame_sigmas: float,
    numbers: int,
    size: str = "",
) -> list[Concern]:
    """Return whether a prediction, of which nothing was fitted, misses the measurements.

    Parameters
    ----------
    name : str
        Of the experiment.
    what, stated : str
        What was measured, and what states its σ.
    sigmas : float
        Root mean square of the differences over σ.
    tame_sigmas : float
        The same without wild samples, by which the prediction is judged.
    numbers : int
        How many numbers were measured.
    size : str
        The root mean square in a unit, for people.
    """
    is_chance = float(chi2_sf(numbers * tame_sigmas**2, numbers)) > RARE
    return concerned(
        tame_sigmas > MISFIT and not is_chance,
        tame_sigmas > GROSS_MISFIT,
        "prediction/misses",
        experiment=name,
        what=what,
        stated=stated,
        sigmas=sigmas,
        size=f"{size}, " if size else "",
    )


def stability_concerns(found: Iterable[Instability]) -> list[Concern]:
    """States of the answer in which disturbances grow."""
    concerns: list[Concern] = []
    for each in found:
        grows = each.e_foldings > E_FOLDINGS
        grossly = each.e_foldings > GROSS_E_FOLDINGS
        concerns += concerned(grows, grossly, "stability/grows", **vars(each))
    return concerns


def contact_concerns(found: Iterable[Touch], guess: str = "") -> list[Concern]:
    """Obstacles that are never touched, or by too few faces to tell the shape of a contact.

    Where a guess was simulated, and `guess` says so, also those that are left, or touched already
    at the first sample. What several experiments share is said once, of the worst.
    """
    concerns: dict[tuple[str, str], list[Concern]] = {}
    for each in sorted(found, key=lambda touch: touch.faces):
        data = {"experiment": each.experiment, "obstacle": each.obstacle, "guess": guess}
        coarse = 0 < each.faces < FEWEST_FACES
        numbers = {"faces": each.faces, "face_mm": each.face_mm}
        for one in (
            *concerned(not each.faces, not guess, "contact/never", mm=1e3 * each.gap_m, **data),
            *concerned(coarse, False, "contact/coarse", **numbers, **data),
            *concerned(bool(guess) and each.pressed, False, "contact/pressed", **data),
            *concerned(bool(guess and each.lost_s), False, "contact/lost", t_s=each.lost_s, **data),
        ):
            concerns.setdefault((one.code, each.obstacle), []).append(one)
    return [
        replace(first, data={**first.data, "more": f" and {len(others)} more" if others else ""})
        for first, *others in concerns.values()
    ]


def turn_concerns(
    experiment: Experiment, substeps: int, far: float = FAST, code: str = "scheme/turns"
) -> list[Concern]:
    """A grasp that turns farther within a step of the grid than `far` [rad]."""
    turn = fastest_turn(experiment, substeps)
    numbers = {"step_ms": 1e3 * turn.step_s, "rate_rad_s": turn.rate_rad_s}
    return concerned(turn.angle_rad > far, False, code, **vars(turn), **numbers)


def scheme_concerns(
    name: str, damping_ratio: float, added_ratio: float, period_error: float
) -> list[Concern]:
    """What the scheme does to the first mode of an experiment, with the answer's parameters."""
    return [
        *concerned(
            added_ratio > max(DAMPING_SHARE * damping_ratio, LITTLE_DAMPING),
            added_ratio > GROSS_DAMPING_SHARE * damping_ratio,
            "scheme/damping",
            experiment=name,
            added=added_ratio,
            damping=damping_ratio,
        ),
        *concerned(
            abs(period_error) > PERIOD_ERROR,
            abs(period_error) > GROSS_PERIOD_ERROR,
            "scheme/period",
            experiment=name,
            change=period_error,
        ),
    ]


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
