"""Predictions of measurements and their errors, as simulations and `result.json` contain them.

The fields of each class name the kinds of measurements; `measurements` computes them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.display import quantity, short
from ..common.serialisation import optional
from ..model.contact.summary import FrictionSummary
from ..program.depth.surface_comparison import DepthError


@dataclass(frozen=True)
class PredictionErrors:
    """Differences between a prediction and the measurements; None for what is not measured."""

    # RMS and largest distance of the markers from their measurements.
    rms_m: float | None = None
    max_m: float | None = None
    # Root mean square of the components of force and torque.
    wrench_rms_n: float | None = None
    wrench_rms_nm: float | None = None
    # mapping of name to float, or None: RMS difference of custom sensors, in their units.
    reading_rms: Mapping[str, float] | None = None
    # mapping of the camera's name to DepthError, or None: distances of the points of depth cameras
    # from the predicted surface.
    depth: Mapping[str, DepthError] | None = None

    @property
    def main(self) -> float:
        """RMS distance of the markers [m], without markers the RMS difference of the forces [N];
        infinity if neither is compared.
        """
        return self.rms_m or self.wrench_rms_n or float("inf")

    def text(self, units: Mapping[str, str] | None) -> str:
        """Return the errors in words; "" if nothing is compared.

        Errors that are None, and errors of markers and forces that are zero, are left out. `units`
        are those of custom sensors by name.
        """
        texts = []
        if self.rms_m:
            largest = "" if self.max_m is None else f", at most {1e3 * self.max_m:.2f} mm"
            texts.append(f"{1e3 * self.rms_m:.3f} mm RMS{largest}")
        if forces := _forces_text(self.wrench_rms_n, self.wrench_rms_nm):
            texts.append(f"{forces} RMS")
        for reading, rms in (self.reading_rms or {}).items():
            texts.append(f"{reading} {quantity(rms, (units or {}).get(reading, ''))} RMS")
        for camera, distances in (self.depth or {}).items():
            whose = "" if camera == "depth" else f" of {camera}"  # which has no name of its own
            texts.append(f"depth{whose} {distances.text}")
        return "; ".join(texts)


def _forces_text(*sizes: float | None) -> str:
    """Zero and None are left out."""
    pairs = zip(sizes, ("N", "N m"), strict=True)
    return ", ".join(f"{short(size)} {unit}" for size, unit in pairs if size)


@dataclass(frozen=True)
class CopyError:
    """Differences between the measurements of a recording and those of a fitted one."""

    copied: str  # the name of the fitted recording that is nearest
    error: PredictionErrors  # errors of its measurements as a prediction


@dataclass(frozen=True, kw_only=True)
class FittedExperiment(PredictionErrors):
    """Residuals of the fit of an experiment; `rms_m` is 0 without markers, and `max_m` is None."""

    OMITS_NONE: ClassVar = True

    # Numbers of marker samples that are present, and that are missing.
    samples: int
    missing: int
    static: bool  # whether it is a series of equilibria
    notes: tuple[str, ...]  # sentences on the nuisance parameters of this recording
    # Stated standard deviations of the noise of forces [N] and torques [N m]; None if not measured.
    wrench_sigma_n: float | None = None
    wrench_sigma_nm: float | None = None
    # mapping of name to float, or None: stated standard deviations of the noise of custom sensors;
    # None without any.
    reading_sigma: Mapping[str, float] | None = None
    # mapping of name to str, or None: units of the custom sensors that state one; None if none
    # does.
    reading_unit: Mapping[str, str] | None = None
    # mapping of name to str, or None: kinds of the sensors that are images of a camera, such as
    # "image tracks"; None without any.
    reading_kind: Mapping[str, str] | None = None
    # mapping of obstacle to FrictionSummary, or None: friction of the obstacles that have some;
    # None without any.
    friction: Mapping[str, FrictionSummary] | None = None
    # Density of the air around the body in the model; zero in a vacuum.
    air_density_kg_m3: float = 0.0
    # Kind of material test of a specimen without a mesh; None for other experiments.
    test: str | None = None

    def lines(self, name: str, is_symmetric: bool) -> Iterator[str]:
        """Yield lines of a summary on the sensors and the friction of the experiment `name`; of a
        symmetric one the energy is that of the modelled part.
        """
        if sizes := _forces_text(self.wrench_rms_n, self.wrench_rms_nm):
            sigma = _forces_text(self.wrench_sigma_n, self.wrench_sigma_nm)
            yield f"wrench of '{name}': {sizes} RMS (sigma {sigma})"
        for reading, rms in (self.reading_rms or {}).items():
            unit = (self.reading_unit or {}).get(reading, "")
            sigma = quantity((self.reading_sigma or {})[reading], unit)
            kind = (self.reading_kind or {}).get(reading)
            what = f"{kind} {reading}" if kind else reading
            yield f"{what} of '{name}': {quantity(rms, unit)} RMS (sigma {sigma})"
        joules = "J in the modelled part" if is_symmetric else "J"
        for obstacle, friction in (self.friction or {}).items():
            yield (
                f"friction of {obstacle} in '{name}': at most {friction.used:.0%} of its limit, "
                f"slip during {friction.slipping:.0%} of the time, "
                f"{short(friction.dissipated_j)} {joules} dissipated"
            )
        for camera, error in (self.depth or {}).items():
            yield f"depth of {camera} in '{name}': {error.text}"


@dataclass(frozen=True)
class FitResult:
    """Residuals of the fit of all experiments."""

    # RMS distance of all markers, and that expected from the stated noise.
    rms_m: float
    noise_rms_m: float
    # mapping of name to FittedExperiment: residuals of each fitted experiment.
    experiments: Mapping[str, FittedExperiment]
    # RMS differences of all forces and torques.
    wrench_rms_n: float | None = optional()
    wrench_rms_nm: float | None = optional()
    # mapping of experiment to int: of experiments whose loads are reported for the whole specimen:
    # ratio of these to the loads of the modelled part. Energies of friction and nuisance parameters
    # are those of the modelled part.
    symmetry: Mapping[str, int] | None = optional()


@dataclass(frozen=True, kw_only=True)
class SimulatedExperiment(PredictionErrors):
    """Errors of the forward simulation of an experiment; if `failed` is set, all else but `fitted`
    is None. `rms_m` and `max_m` are 0 without markers.

    Attributes
    ----------
    fitted : bool
        Whether the experiment was fitted, not only predicted.
    failed : str or None
        Why there is no simulation; None if there is one.
    reading_unit : mapping of name to str, or None
        Units of the custom sensors that state one; None if none does.
    nuisance, places_m : mapping or None
        Nuisance parameters and marker places with which a recording for validation was predicted:
        those of the fitted recordings, and its own onsets where they are declared as unknown; empty
        for fitted experiments. Nuisance parameters of places are displacements from their start;
        places are on the undeformed body.
    own : PredictionErrors or None
        Of an experiment for validation, the errors that remain if its nuisance parameters are
        fitted to it, whatever they absorb; None without any, and for fitted experiments.
    own_deviations : mapping of name to float, or None
        These nuisance parameters less those of the prediction, in standard deviations of their
        priors.
    own_onsets : mapping of name to float, or None
        Times that the prediction takes from its own recording because they are declared as
        unknown, in standard deviations of their priors.
    copied : CopyError or None
        Of an experiment for validation, with the measurements of the nearest fitted recording as
        the prediction; None if there is no such copy.
    not_copied : str or None
        Why there is no such copy; empty for fitted experiments.
    """

    OMITS_NONE: ClassVar = True

    fitted: bool
    failed: str | None = None
    reading_unit: Mapping[str, str] | None = None
    nuisance: Mapping[str, float] | None = None
    places_m: Mapping[str, Sequence[float]] | None = None
    own: PredictionErrors | None = None
    own_deviations: Mapping[str, float] | None = None
    own_onsets: Mapping[str, float] | None = None
    copied: CopyError | None = None
    not_copied: str | None = None


@dataclass(frozen=True)
class ForwardResult:
    """Forward simulations with the estimates."""

    # RMS and largest distance of the markers of all fitted experiments; None without any.
    rms_m: float | None
    max_m: float | None
    # mapping of name to SimulatedExperiment: results of each experiment, also of those for
    # validation.
    experiments: Mapping[str, SimulatedExperiment]


@dataclass(frozen=True, eq=False)
class PredictionResiduals:
    """Differences by which a prediction of held-out measurements is judged, predicted less
    measured.
    """

    t_s: Array  # (S,): times [s], ascending
    values: Array  # (S, K, d): differences of K vectors or numbers
    is_counted: NDArray[np.bool_]  # (S, K) of bool: whether something was measured
    unit: str  # unit of the values

    @classmethod
    def in_order_of_time(cls, t_s: Array, values: Array, unit: str) -> PredictionResiduals:
        """Return the differences (S, K, d) of several sensors together, at times (S,) in any order;
        a vector counts if any of its numbers is finite.
        """
        order = np.argsort(t_s, kind="stable")
        in_order = values[order]
        return cls(
            t_s[order],
            in_order,
            is_counted=np.asarray(np.isfinite(in_order).any(axis=2)),
            unit=unit,
        )
