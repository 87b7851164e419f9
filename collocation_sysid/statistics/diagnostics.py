"""What the residuals of each marker look like, and what that suggests.

A single sample may have more of the residuals' power than all others of its marker together. It
spoils what the residuals tell: beside it all others look like white noise, however
much they hang together. It is named, and tests of correlation look at the others, as the fit has
left them.

Of n independent normal samples in k coordinates the share of one in the power is a Beta variable
with the parameters k/2 and (n − 1) k/2; the largest of n exceeds a share with n times the
probability of one at most (Cochran 1941, Grubbs 1950). Samples are set apart one by one as long as
one of the others spoils the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from .concern import Concern
from .distributions import beta_sf, chi2_isf, normal_isf
from .linearised import FitBlock, LinearisedFit, Mask, information
from .noise import NoiseLevel, noise_level

SIGNIFICANCE = 0.01
# A pattern with this share of the residuals' power is worth naming.
DOMINANT = 0.5
EARLY_TIME = 0.1
# Bins of the periodogram on both sides of its peak that belong to a damped oscillation.
PEAK_BINS = 2
# Fewer periods than this within the record are a drift.
FEWEST_PERIODS = 3
SAME_FREQUENCY = 0.2
ROUNDING_M = 1e-9
# Share of the samples beyond Huber's threshold that noise alone may explain.
MOST_WILD = 0.05
# White residuals within this factor of σ are as they should be.
AS_STATED = 1.25


@dataclass(frozen=True, eq=False)
class MarkerDiagnosis:
    """The residuals h(x) − ŷ of one marker in one experiment.

    Shares are of the residuals' power, the sum of their squares over axes and present samples.

    Attributes
    ----------
    experiment, marker : str
    samples : int
    wild : int
        Samples beyond Huber's threshold.
    rms_m : float
        Of the distance between fitted and measured marker, wild samples included.
    noise_factor : float
        How many times σ its errors are, allowing for what the fit takes out of the residuals.
    offset_m : (3,) mean of h(x) − ŷ
    constant_share : float
        Power of the mean.
    lag1 : float
        Autocorrelation of consecutive present samples about the mean, pooled over the axes.
    frequency_hz, oscillating_share : float
        Largest peak of the periodogram, and the power in it.
    early_share : float
        Power within the first tenth of the time.
    sentence : str
        What this suggests.
    """

    experiment: str
    marker: str
    samples: int
    wild: int
    rms_m: float
    noise_factor: float
    offset_m: Array
    constant_share: float
    lag1: float
    frequency_hz: float
    oscillating_share: float
    early_share: float
    sentence: str


def diagnose(fit: LinearisedFit) -> tuple[MarkerDiagnosis, ...]:
    """Diagnose every marker that was seen, experiment by experiment."""
    level = noise_level(fit, information(fit))
    alone = {outlier.series: outlier for outlier in reversed(set_apart(fit)[1])}
    return tuple(
        _diagnose(block, marker, fit.shared, _estimated(fit, block), level, alone)
        for block in fit.blocks
        if block.stated == "sigma_m"
        for marker in np.flatnonzero(block.present.any(axis=0)).tolist()
    )


def _estimated(fit: LinearisedFit, block: FitBlock) -> tuple[bool, bool]:
    """Whether marker offsets and a time shift of the experiment are estimated already."""
    kinds = [name.removeprefix(f"{block.name}: ") for name in fit.names[fit.shared :]]
    return any(k.startswith("offset") for k in kinds), any(k.startswith("time") for k in kinds)


def _diagnose(
    block: FitBlock,
    marker: int,
    shared: int,
    estimated: tuple[bool, bool],
    level: NoiseLevel,
    alone: Mapping[str, Outlier],
) -> MarkerDiagnosis:
    present = block.present[:, marker]
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
    if not block.static:
        frequency, peak = _largest_peak(varying, block.t_s)
        early = block.t_s <= block.t_s[0] + EARLY_TIME * (block.t_s[-1] - block.t_s[0])
    found = MarkerDiagnosis(
        experiment=block.name,
        marker=block.marker_names[marker],
        samples=samples,
        wild=int(block.wild[:, marker].sum()),
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
    if name in alone:
        said = alone[name].concern.sentence.removeprefix(f"{name}: ")
        return replace(found, sentence=f"{name}: {1e3 * found.rms_m:.2g} mm RMS; {said}")
    pairs = int(np.sum(present[1:] & present[:-1]))
    motion = block.slope[:, marker, :, :shared].reshape(len(residual), -1)
    said = _suggestion(found, pairs, block, motion, estimated)
    if found.wild > MOST_WILD * samples:
        said += (
            f"; {found.wild} samples are beyond Huber's threshold: exchanged labels, or "
            "reflections taken for the marker"
        )
    return replace(found, sentence=said)


def _rms_m(block: FitBlock, marker: int) -> float:
    misfit = block.residual if block.misfit is None else block.misfit
    squares = np.sum(misfit[:, marker] ** 2) / block.present[:, marker].sum()
    return float(block.sigma_m[marker] * np.sqrt(squares))


def _lag1(varying: Array, present: NDArray[np.bool_]) -> float:
    pairs = np.sum(present[1:] & present[:-1])
    samples = present.sum()
    power = np.sum(varying**2)
    if not pairs or not power > 0:
        return 0.0
    return float(np.sum(varying[1:] * varying[:-1]) / pairs / (power / samples))


def _largest_peak(varying: Array, t_s: Array) -> tuple[float, float]:
    """Frequency [Hz] of the largest peak, zero if none, and its share of the power."""
    if len(t_s) < 4:
        return 0.0, 0.0
    # Gaps count as zeros: they spread some power, but move no peak.
    spectrum = np.sum(np.abs(np.fft.rfft(varying, axis=0)) ** 2, axis=1)
    spectrum[1 : (len(t_s) + 1) // 2] *= 2
    total = spectrum.sum()
    if not total > 0:
        return 0.0, 0.0
    peak = 1 + int(np.argmax(spectrum[1:]))
    around = slice(max(1, peak - PEAK_BINS), peak + PEAK_BINS + 1)
    weights = spectrum[around]
    bins = np.arange(len(spectrum))[around]
    record_s = (t_s[1] - t_s[0]) * len(t_s)
    centre = float(weights @ bins / weights.sum())
    return centre / record_s, float(weights.sum() / total)


def _suggestion(
    found: MarkerDiagnosis, pairs: int, block: FitBlock, motion: Array, estimated: tuple[bool, bool]
) -> str:
    t_s = block.t_s
    name = f"{found.experiment}/{found.marker}"
    size = f"{1e3 * found.rms_m:.2g} mm RMS"
    if found.rms_m < ROUNDING_M:
        return f"{name}: fits to rounding"
    persistent = pairs > 0 and abs(found.lag1) > normal_isf(SIGNIFICANCE / 2) / np.sqrt(3 * pairs)
    shifted = found.constant_share > chi2_isf(SIGNIFICANCE, 3) / (3 * found.samples)
    if not persistent and not shifted:
        return f"{name}: {size}, {_white(found)}"
    if found.constant_share > DOMINANT:
        offset = 1e3 * np.linalg.norm(found.offset_m)
        said = (
            f"{100 * found.constant_share:.0f} % of its power is constant: its place on the body "
            f"is off by {offset:.2g} mm; {'widen the prior of' if estimated[0] else 'estimate'} "
            "marker_offsets"
        )
    elif found.early_share > DOMINANT:
        end_s = EARLY_TIME * (t_s[-1] - t_s[0])
        said = (
            f"{100 * found.early_share:.0f} % of its power is in the first {end_s:.2g} s: the "
            "start state or the release time is off"
        )
        said += "" if estimated[1] else "; estimate time_shift"
    elif found.oscillating_share > DOMINANT:
        said = _oscillation(found, t_s, motion)
    elif persistent and found.lag1 > DOMINANT:
        said = "it wanders slowly: creep of the material, or a grasp that gives, is not modelled"
        if block.static:
            said = (
                "it changes with the load: the material's law, or how the grasps hold, is another"
            )
    else:
        said = "a mixture, little of which is white noise"
    return f"{name}: {size}; {said}"


def _white(found: MarkerDiagnosis) -> str:
    """White residuals, by their size; a few samples may differ from σ by chance."""
    factor = found.noise_factor
    chance = normal_isf(SIGNIFICANCE / 2) / np.sqrt(6 * found.samples)
    if factor > max(AS_STATED, 1 + chance):
        return f"white, but {factor:.2g} times as large as sigma_m says"
    if factor < min(1 / AS_STATED, 1 - chance):
        return f"white, and only {factor:.2g} times as large as sigma_m says"
    return "white, as noise should be"


def _oscillation(found: MarkerDiagnosis, t_s: Array, motion: Array) -> str:
    share = f"{100 * found.oscillating_share:.0f} % of its power"
    record_s = (t_s[1] - t_s[0]) * len(t_s)
    if found.frequency_hz * record_s < FEWEST_PERIODS:
        return (
            f"{share} is a slow drift: creep of the material, or a grasp that gives, is not in "
            "the model"
        )
    said = f"{share} oscillates at {found.frequency_hz:.3g} Hz"
    of_motion, _ = _largest_peak(motion - motion.mean(axis=0), t_s)
    if abs(found.frequency_hz - of_motion) <= SAME_FREQUENCY * of_motion:
        return f"{said}, with the motion: the model's stiffness, damping or mass differ"
    return f"{said}, unlike the motion: a vibration or a mode that the model lacks"


# Probability that a sample of noise is named, of all of them.
RARE = 1e-4
# Share of its marker's power that a sample has at least.
MOST = 0.5
# More of a marker's samples than this share are no exceptions; of few samples none stands out.
EXCEPTIONS = 0.1
FEWEST_SAMPLES = 4


@dataclass(frozen=True)
class Outlier:
    """One sample that spoils the rest.

    Attributes
    ----------
    series : str
        "swing/tip", the marker, or "press/force".
    sample : int
    t_s : float
    share : float
        Of the power of its marker's residuals.
    deviations : float
        Its residual over σ.
    first_relaxed : bool
        The first sample of a body with memory, which counts as relaxed there.
    """

    series: str
    sample: int
    t_s: float
    share: float
    deviations: float
    first_relaxed: bool

    @property
    def concern(self) -> Concern:
        """What it does, and the remedy."""
        code = "residuals/first" if self.first_relaxed else "residuals/outlier"
        data = {"t_s": self.t_s, "deviations": self.deviations, "percent": 100 * self.share}
        return Concern(code, data={"of": self.series, **data})


def set_apart(fit: LinearisedFit) -> tuple[LinearisedFit, tuple[Outlier, ...]]:
    """The fit without the samples that spoil the rest, and these; the same fit where none does."""
    blocks = []
    found = []
    for block in fit.blocks:
        for marker in np.flatnonzero(block.present.any(axis=0)).tolist():
            allowed = max(1, int(EXCEPTIONS * block.present[:, marker].sum()))
            while allowed and (outlier := _outlier(block, marker, RARE / len(fit.blocks))):
                found.append(outlier)
                block = _without(block, marker, outlier.sample)
                allowed = allowed - 1
        blocks.append(block)
    return (replace(fit, blocks=tuple(blocks)), tuple(found)) if found else (fit, ())


def _outlier(block: FitBlock, marker: int, rare: float) -> Outlier | None:
    """The sample of a marker that spoils the rest; None where none does."""
    power = np.sum(block.residual[:, marker] ** 2, axis=1)
    count = int(block.present[:, marker].sum())
    sample = int(power.argmax())
    share = float(power[sample] / max(power.sum(), 1e-300))
    freedom = int(block.seen[:, marker].sum()) / count / 2  # half the coordinates of a sample
    chance = count * block.present.shape[1] * beta_sf(share, freedom, (count - 1) * freedom)
    if count < FEWEST_SAMPLES or share < MOST or chance > rare:
        return None
    return Outlier(
        f"{block.name}/{block.marker_names[marker]}",
        sample,
        float(block.t_s[sample]),
        share,
        float(np.sqrt(power[sample])),
        block.relaxed_first and sample == 0,
    )


def _without(block: FitBlock, marker: int, sample: int) -> FitBlock:
    kept: Mask = np.ones(block.present.shape, dtype=bool)
    kept[sample, marker] = False
    each = kept[..., None]
    return replace(
        block,
        present=block.present & kept,
        residual=block.residual * each,
        slope=block.slope * each[..., None],
        misfit=None if block.misfit is None else block.misfit * each,
        components=block.seen & each,
    )
