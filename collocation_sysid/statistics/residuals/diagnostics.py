"""Diagnosis of the residuals of each marker: outliers, offsets, oscillations and drifts.

A single sample may have more of the residuals' power than all others of its marker together. It
then hides the correlation of the others. Such samples are reported as outliers, and tests of
correlation use the others, as the fit has left them.

Of n independent normal samples in k coordinates the share of one in the power is a Beta variable
with the parameters k/2 and (n − 1) k/2; the largest of n exceeds a share with at most n times the
probability of one (Cochran 1941, Grubbs 1950). Outliers are removed one by one as long as one of
the others dominates the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array
from ..concerns import Concern
from ..distributions import beta_sf, chi2_isf, normal_isf
from ..linearised import LinearisedFit, Mask, ResidualBlock, factorise_information
from ..thresholds import MOST_WILD, RARE
from .noise_level import NoiseLevel, estimate_noise_level

# Level of the tests for patterns.
SIGNIFICANCE = 0.01
# Share of the residuals' power from which on a pattern is reported.
DOMINANT = 0.5
# Share of the time that counts as the beginning.
EARLY_TIME = 0.1
# Bins of the periodogram on both sides of its peak that belong to a damped oscillation.
PEAK_BINS = 2
# Fewer periods than this within the record are a drift.
FEWEST_PERIODS = 3
# Relative difference of frequencies that are taken as equal.
SAME_FREQUENCY = 0.2
# Possible causes of slow residuals, which the residuals alone do not distinguish.
DRIFT_CAUSES = (
    "the model lacks creep of the material or slip in the grasp, or the body was not at rest at the "
    "beginning"
)
# RMS residual that is rounding [m].
ROUNDING_M = 1e-9
# Factor within which uncorrelated residuals agree with σ.
LARGEST_AGREEING_RATIO = 1.25


@dataclass(frozen=True, eq=False)
class MarkerDiagnosis:
    """Residuals h(x) − ŷ of one marker in one experiment, and their likely cause.

    Shares are of the residuals' power, the sum of their squares over axes and present samples.
    """

    # Names.
    experiment: str
    marker: str
    samples: int  # number of samples
    wild: int  # number of samples beyond Huber's threshold
    # Root mean square distance between fitted and measured marker, including those samples [m].
    rms_m: float
    # Size of its errors over σ, corrected for the effect of the fit on the residuals.
    noise_factor: float
    offset_m: Array  # (3,): mean of h(x) − ŷ [m]
    constant_share: float  # share of the mean in the power
    # Autocorrelation of consecutive present samples about the mean, pooled over the axes.
    lag1: float
    frequency_hz: float  # frequency of the largest peak of the periodogram; 0 without one
    oscillating_share: float  # share of this peak in the power
    early_share: float  # share of the first tenth of the time in the power
    sentence: str  # message with the likely cause


def diagnose_markers(fit: LinearisedFit) -> tuple[MarkerDiagnosis, ...]:
    """Diagnose every marker that has a sample, experiment by experiment; sensors other than markers
    are left out.
    """
    level = estimate_noise_level(fit, factorise_information(fit))
    alone = {outlier.series: outlier for outlier in reversed(remove_outliers(fit)[1])}
    return tuple(
        _diagnose_marker(
            block,
            marker,
            shared=fit.shared_count,
            estimated_kinds=_estimated_kinds(fit, block),
            level=level,
            outliers=alone,
        )
        for block in fit.blocks
        if block.sigma_key == "sigma_m"
        for marker in np.flatnonzero(block.is_present.any(axis=0)).tolist()
    )


def _estimated_kinds(fit: LinearisedFit, block: ResidualBlock) -> tuple[bool, bool]:
    """Return whether marker offsets, and a time shift, of the block are estimated."""
    kinds = [name.removeprefix(f"{block.name}: ") for name in fit.names[fit.shared_count :]]
    return any(k.startswith("offset") for k in kinds), any(k.startswith("time") for k in kinds)


def _diagnose_marker(
    block: ResidualBlock,
    marker: int,
    shared: int,
    estimated_kinds: tuple[bool, bool],
    level: NoiseLevel,
    outliers: Mapping[str, Outlier],
) -> MarkerDiagnosis:
    present = block.is_present[:, marker]
    name = f"{block.name}/{block.marker_names[marker]}"
    residual = block.residual[:, marker] * block.sigma_m[marker]
    samples = int(present.sum())
    power = float(np.sum(residual**2))
    total = power if power > 0 else 1.0
    mean = residual.sum(axis=0) / samples
    varying = np.where(present[:, None], residual - mean, 0.0)
    frequency = 0.0
    peak = 0.0
    early = np.zeros(len(residual), dtype=bool)
    if not block.is_static:
        frequency, peak = _largest_peak(varying, block.t_s)
        early = block.t_s <= block.t_s[0] + EARLY_TIME * (block.t_s[-1] - block.t_s[0])
    diagnosis = MarkerDiagnosis(
        experiment=block.name,
        marker=block.marker_names[marker],
        samples=samples,
        wild=int(block.outliers[:, marker].sum()),
        rms_m=_rms_m(block, marker),
        noise_factor=level.factors[name],
        offset_m=mean,
        constant_share=float(samples * mean @ mean / total),
        lag1=_lag1(varying, present),
        frequency_hz=frequency,
        oscillating_share=peak * float(np.sum(varying**2)) / total,
        early_share=float(np.sum(residual[early] ** 2) / total),
        sentence="",
    )
    if name in outliers:
        message = outliers[name].to_concern().message.removeprefix(f"{name}: ")
        return replace(diagnosis, sentence=f"{name}: {1e3 * diagnosis.rms_m:.2g} mm RMS; {message}")
    pairs = int(np.sum(present[1:] & present[:-1]))
    motion = block.jacobian[:, marker, :, :shared].reshape(len(residual), -1)
    message = _message(diagnosis, pairs, block=block, motion=motion, estimated=estimated_kinds)
    if diagnosis.wild > MOST_WILD * samples:
        message += (
            f"; {diagnosis.wild} samples are outliers, beyond the threshold of the Huber "
            "loss: exchanged labels, or reflections mistaken for the marker"
        )
    return replace(diagnosis, sentence=message)


def _rms_m(block: ResidualBlock, marker: int) -> float:
    """Return the RMS distance [m], outliers included."""
    misfit = block.residual if block.misfit is None else block.misfit
    squares = np.sum(misfit[:, marker] ** 2) / block.is_present[:, marker].sum()
    return float(block.sigma_m[marker] * np.sqrt(squares))


def _lag1(varying: Array, present: NDArray[np.bool_]) -> float:
    """Return a mean over axes of residuals (T, 3) less their mean; 0 without pairs or power."""
    pairs = np.sum(present[1:] & present[:-1])
    samples = present.sum()
    power = np.sum(varying**2)
    if not pairs or not power > 0:
        return 0.0
    return float(np.sum(varying[1:] * varying[:-1]) / pairs / (power / samples))


def _largest_peak(varying: Array, t_s: Array) -> tuple[float, float]:
    """Return the frequency [Hz] of the largest peak in the periodogram of evenly sampled values (T,
    k), and the share of the power in it and `PEAK_BINS` bins on both sides; zeros for fewer than
    four samples or without power.

    The frequency is the mean of these bins, weighted by their power. The mean of the values must be
    zero.
    """
    if len(t_s) < 4:
        return 0.0, 0.0
    # Gaps count as zeros: they spread some power, but move no peak.
    spectrum = np.sum(np.abs(np.fft.rfft(varying, axis=0)) ** 2, axis=1)
    spectrum[1 : (len(t_s) + 1) // 2] *= 2
    total = spectrum.sum()
    if not total > 0:
        return 0.0, 0.0
    peak = 1 + int(np.argmax(spectrum[1:]))
    window = slice(max(1, peak - PEAK_BINS), peak + PEAK_BINS + 1)
    weights = spectrum[window]
    bins = np.arange(len(spectrum))[window]
    record_s = (t_s[1] - t_s[0]) * len(t_s)
    centre = float(weights @ bins / weights.sum())
    return centre / record_s, float(weights.sum() / total)


def _message(
    diagnosis: MarkerDiagnosis,
    pairs: int,
    block: ResidualBlock,
    motion: Array,
    estimated: tuple[bool, bool],
) -> str:
    t_s = block.t_s
    name = f"{diagnosis.experiment}/{diagnosis.marker}"
    size = f"{1e3 * diagnosis.rms_m:.2g} mm RMS"
    if diagnosis.rms_m < ROUNDING_M:
        return f"{name}: residuals are at the level of rounding errors"
    persistent = pairs > 0 and abs(diagnosis.lag1) > normal_isf(SIGNIFICANCE / 2) / np.sqrt(
        3 * pairs
    )
    shifted = diagnosis.constant_share > chi2_isf(SIGNIFICANCE, 3) / (3 * diagnosis.samples)
    if not persistent and not shifted:
        return f"{name}: {size}, {_white_noise_message(diagnosis)}"
    if diagnosis.constant_share > DOMINANT:
        offset = 1e3 * np.linalg.norm(diagnosis.offset_m)
        cause = (
            f"{100 * diagnosis.constant_share:.0f} % of the squared residuals is a constant "
            f"part: its position on the body is wrong by {offset:.2g} mm; "
            f"{'widen the prior of' if estimated[0] else 'estimate'} nuisance.marker_offsets"
        )
    elif diagnosis.early_share > DOMINANT:
        end_s = EARLY_TIME * (t_s[-1] - t_s[0])
        cause = (
            f"{100 * diagnosis.early_share:.0f} % of the squared residuals occurs in the "
            f"first {end_s:.2g} s: the initial state or the release time is wrong"
        )
        cause += "" if estimated[1] else "; estimate nuisance.time_shift"
    elif diagnosis.oscillating_share > DOMINANT:
        cause = _oscillation_message(diagnosis, t_s, motion=motion)
    elif persistent and diagnosis.lag1 > DOMINANT:
        cause = f"the residuals drift slowly: {DRIFT_CAUSES}"
        if block.is_static:
            cause = (
                "the residuals change with the load: the material law or the boundary "
                "conditions at the grasps are wrong"
            )
    else:
        cause = "the residuals are correlated in time, without a dominant cause"
    return f"{name}: {size}; {cause}"


def _white_noise_message(diagnosis: MarkerDiagnosis) -> str:
    factor = diagnosis.noise_factor
    chance = normal_isf(SIGNIFICANCE / 2) / np.sqrt(6 * diagnosis.samples)
    if factor > max(LARGEST_AGREEING_RATIO, 1 + chance):
        return f"uncorrelated, but {factor:.2g} times as large as expected from sigma_m"
    if factor < min(1 / LARGEST_AGREEING_RATIO, 1 - chance):
        return f"uncorrelated, and only {factor:.2g} times as large as expected from sigma_m"
    return "uncorrelated, consistent with noise"


def _oscillation_message(diagnosis: MarkerDiagnosis, t_s: Array, motion: Array) -> str:
    share = f"{100 * diagnosis.oscillating_share:.0f} % of the squared residuals"
    record_s = (t_s[1] - t_s[0]) * len(t_s)
    if diagnosis.frequency_hz * record_s < FEWEST_PERIODS:
        return f"{share} is a slow drift: {DRIFT_CAUSES}"
    message = f"{share} oscillates at {diagnosis.frequency_hz:.3g} Hz"
    of_motion, _ = _largest_peak(motion - motion.mean(axis=0), t_s)
    if abs(diagnosis.frequency_hz - of_motion) <= SAME_FREQUENCY * of_motion:
        return (
            f"{message}, the frequency of the motion: stiffness, damping or mass of the model "
            "are wrong"
        )
    return (
        f"{message}, which is not a frequency of the motion: the model lacks a vibration or a "
        "natural mode"
    )


# Smallest share of an outlier in its marker's power.
MOST = 0.5
# Largest share of a marker's samples that are outliers.
EXCEPTIONS = 0.1
# Fewest samples of a marker with outliers.
FEWEST_SAMPLES = 4


@dataclass(frozen=True)
class Outlier:
    """Single sample that dominates the residuals of its marker."""

    series: str  # experiment and marker, such as "swing/tip", or "press/force"
    sample: int  # index of the sample
    t_s: float  # its time [s]
    share: float  # its share in the power of its marker's residuals
    deviations: float  # its residual over σ
    # Whether it is the first sample of a body with memory, which is assumed relaxed there.
    is_relaxed_start: bool

    def to_concern(self) -> Concern:
        """Return the concern about this sample, of grade "check": "residuals/first" for a relaxed
        start, else "residuals/outlier".
        """
        code = "residuals/first" if self.is_relaxed_start else "residuals/outlier"
        data = {
            "t_s": self.t_s,
            "number": self.sample + 1,
            "deviations": self.deviations,
            "percent": 100 * self.share,
        }
        return Concern(code, data={"of": self.series, **data})


def remove_outliers(fit: LinearisedFit) -> tuple[LinearisedFit, tuple[Outlier, ...]]:
    """Return the fit without its outliers, which count as missing, and the outliers; the same fit
    and an empty tuple if there are none.

    Outliers of each marker are removed one after the other, at most a share `EXCEPTIONS` of its
    samples, but at least one is allowed. The parameters are not fitted again.
    """
    blocks = []
    outliers = []
    for block in fit.blocks:
        for marker in np.flatnonzero(block.is_present.any(axis=0)).tolist():
            allowed = max(1, int(EXCEPTIONS * block.is_present[:, marker].sum()))
            while allowed and (
                outlier := _find_outlier(block, marker, significance=RARE / len(fit.blocks))
            ):
                outliers.append(outlier)
                block = _without_sample(block, marker, sample=outlier.sample)
                allowed = allowed - 1
        blocks.append(block)
    return (replace(fit, blocks=tuple(blocks)), tuple(outliers)) if outliers else (fit, ())


def _find_outlier(block: ResidualBlock, marker: int, significance: float) -> Outlier | None:
    """Return the sample that dominates the residuals of a marker (index); None if none does.

    It has at least the share `MOST` of the marker's power, which by chance would occur with a
    probability of at most `significance` for any marker of the block; a marker with fewer than
    `FEWEST_SAMPLES` samples has none.
    """
    power = np.sum(block.residual[:, marker] ** 2, axis=1)
    count = int(block.is_present[:, marker].sum())
    sample = int(power.argmax())
    share = float(power[sample] / max(power.sum(), 1e-300))
    freedom = (
        int(block.is_measured[:, marker].sum()) / count / 2
    )  # half the coordinates of a sample
    chance = count * block.is_present.shape[1] * beta_sf(share, freedom, b=(count - 1) * freedom)
    if count < FEWEST_SAMPLES or share < MOST or chance > significance:
        return None
    return Outlier(
        f"{block.name}/{block.marker_names[marker]}",
        sample,
        t_s=float(block.t_s[sample]),
        share=share,
        deviations=float(np.sqrt(power[sample])),
        is_relaxed_start=block.is_relaxed_at_start and sample == 0,
    )


def _without_sample(block: ResidualBlock, marker: int, sample: int) -> ResidualBlock:
    is_included: Mask = np.ones(block.is_present.shape, dtype=bool)
    is_included[sample, marker] = False
    each = is_included[..., None]
    return replace(
        block,
        is_present=block.is_present & is_included,
        residual=block.residual * each,
        jacobian=block.jacobian * each[..., None],
        misfit=None if block.misfit is None else block.misfit * each,
        components=block.is_measured & each,
    )
