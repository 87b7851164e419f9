"""Tables of [experiment.nuisance] that state priors of nuisance parameters.

The description of each table is that of its first parameter in `recording.nuisance.KINDS`.
"""

from __future__ import annotations

import re
from typing import Annotated, ClassVar

from pydantic import AfterValidator, model_validator

from ..common.schema_tables import Section, used_keys
from ..common.validated_types import Positive
from ..recording.nuisance import SCOPE, SCOPE_TEXT


def _require_scope(word: str) -> str:
    """Return a scope unchanged if it is "recording" or matches `SCOPE` ("shared", or "shared" and a
    word); raise `ValueError` otherwise.
    """
    if word != "recording" and not re.fullmatch(SCOPE, word):
        raise ValueError(f'found {word!r}; expected "recording", {SCOPE_TEXT}')
    return word


class Scoped(Section):
    """Something of a recording, or of several.

    Attributes
    ----------
    scope : str
        Which recordings have the same value. "recording": each recording has its own value.
        "shared": all recordings with "shared" have one value. "shared" and a word: all recordings
        with the same word have one value.
    """

    scope: Annotated[str, AfterValidator(_require_scope)] = "recording"


class NuisancePriorSection(Scoped):
    """Standard deviations of nuisance parameters; of several, those that are missing mean
    exact values.
    """

    # Whether the parameter has a default prior, so that a scope alone is sufficient.
    has_default: ClassVar[bool] = False

    @model_validator(mode="after")
    def _require_one_prior(self) -> NuisancePriorSection:
        """Return the section itself; raise `ValueError` if no standard deviation is given, unless
        the parameter has a default and another scope than "recording" is stated.
        """
        priors = [key for key in type(self).model_fields if key != "scope"]
        if not used_keys(self, *priors) and (self.scope == "recording" or not self.has_default):
            expected = "one or both" if len(priors) > 1 else "it"
            raise ValueError(f"found no {' and no '.join(priors)}; expected {expected}")
        return self


class MarkerOffsetsPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: errors of the positions in reference_m without a
    reference_sigma_m; they rotate with the body.

    Attributes
    ----------
    prior_m : float, optional
        Standard deviation [m].
    """

    has_default: ClassVar[bool] = True

    prior_m: Positive | None = None


class CameraOffsetsPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: a constant offset of each marker in the cameras' frame.

    Attributes
    ----------
    prior_m : float, optional
        Standard deviation [m].
    """

    prior_m: Positive | None = None


class CalibrationScalePrior(NuisancePriorSection):
    """Prior of a nuisance parameter: scale error of all lengths that the cameras measure: the
    factor minus one.

    Attributes
    ----------
    prior : float, optional
        Standard deviation [1].
    """

    prior: Positive | None = None


class CalibrationDistortionPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: coefficient k of a radial distortion by the cameras: distances
    r from the middle of the body are multiplied by 1 + k r².

    Attributes
    ----------
    prior_1_m2 : float, optional
        Standard deviation [1/m²].
    """

    prior_1_m2: Positive | None = None


class TimeShiftPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: how much later than stated the markers were measured, by the
    clock of the grasps.

    Attributes
    ----------
    prior_s : float, optional
        Standard deviation [s].
    """

    has_default: ClassVar[bool] = True

    prior_s: Positive | None = None


class ClockRatePrior(NuisancePriorSection):
    """Prior of a nuisance parameter: how much slower the clock of the markers runs than the clock
    of the grasps.

    Attributes
    ----------
    prior : float, optional
        Standard deviation [1].
    """

    prior: Positive | None = None


class PosePrior(NuisancePriorSection):
    """Prior of a nuisance parameter: a constant rotation of grasps and body in the cameras' frame,
    which rotates gravity in the body's frame.

    Attributes
    ----------
    prior_rad : float, optional
        Standard deviation [rad].
    prior_m : float, optional
        Standard deviation [m].
    """

    prior_rad: Positive | None = None
    prior_m: Positive | None = None


class GravityPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: a tilt of the direction of gravity.

    Attributes
    ----------
    prior_rad : float, optional
        Standard deviation [rad].
    """

    has_default: ClassVar[bool] = True

    prior_rad: Positive | None = None


class HandEyePrior(NuisancePriorSection):
    """Prior of a nuisance parameter: a constant rotation of the body in its grasps.

    Attributes
    ----------
    prior_rad : float, optional
        Standard deviation [rad].
    prior_m : float, optional
        Standard deviation [m].
    """

    has_default: ClassVar[bool] = True

    prior_rad: Positive | None = None
    prior_m: Positive | None = None


class StrainZeroPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: a constant offset of the strains of a specimen.

    Attributes
    ----------
    prior : float, optional
        Standard deviation [1].
    """

    prior: Positive | None = None


class DisplacementZeroPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: a constant offset of each prescribed displacement along each
    of its axes.

    Attributes
    ----------
    prior_m : float, optional
        Standard deviation [m].
    """

    has_default: ClassVar[bool] = True

    prior_m: Positive | None = None


class ObstaclePrior(NuisancePriorSection):
    """Prior of a nuisance parameter: a constant offset of each obstacle along its normal, or along
    the axis of its displacement; it changes the time at which the obstacle touches the body.

    Attributes
    ----------
    prior_m : float, optional
        Standard deviation [m].
    prior_rad : float, optional
        Standard deviation [rad].
    prior_s : float, optional
        Standard deviation [s].
    """

    has_default: ClassVar[bool] = True

    prior_m: Positive | None = None
    prior_rad: Positive | None = None
    prior_s: Positive | None = None


class TensionFactorPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: scale error of the tension of each tendon: the factor minus
    one.

    Attributes
    ----------
    prior : float, optional
        Standard deviation [1].
    """

    prior: Positive | None = None


class TensionLostPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: tension of each tendon that is lost by friction.

    Attributes
    ----------
    prior_n : float, optional
        Standard deviation [N].
    """

    prior_n: Positive | None = None


class PressureFactorPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: scale error of each pressure: the factor minus one.

    Attributes
    ----------
    prior : float, optional
        Standard deviation [1].
    """

    prior: Positive | None = None


class PressureLostPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: amount by which each pressure is lower than stated.

    Attributes
    ----------
    prior_pa : float, optional
        Standard deviation [Pa].
    """

    prior_pa: Positive | None = None


class PressureLagPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: logarithm of the ratio of the true lag of each pressure to the
    stated lag_s.

    Attributes
    ----------
    prior : float, optional
        Standard deviation [1].
    """

    prior: Positive | None = None


class JoiningPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: delay of the time at which each point mass or force begins or
    ends, if this time is within the recording.

    Attributes
    ----------
    prior_s : float, optional
        Standard deviation [s].
    """

    has_default: ClassVar[bool] = True

    prior_s: Positive | None = None


class TarePrior(NuisancePriorSection):
    """Prior of a nuisance parameter: a constant offset of each component of a force sensor, in
    multiples of its sigma.

    Attributes
    ----------
    prior_sigmas : float, optional
        Standard deviation [σ].
    """

    has_default: ClassVar[bool] = True

    prior_sigmas: Positive | None = None


class SensorTimePrior(NuisancePriorSection):
    """Prior of a nuisance parameter: delay of the force sensors, limited to three standard
    deviations of its prior.

    Attributes
    ----------
    prior_s : float, optional
        Standard deviation [s].
    """

    has_default: ClassVar[bool] = True

    prior_s: Positive | None = None


class SensorLagPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: time constant of a first-order low-pass in the sensor, limited
    to values between zero and three standard deviations of its prior.

    Attributes
    ----------
    prior_s : float, optional
        Standard deviation [s].
    """

    prior_s: Positive | None = None


class ToolPrior(NuisancePriorSection):
    """Prior of a nuisance parameter: mass of the tool between a sensor and the body.

    Attributes
    ----------
    prior_kg : float
        Standard deviation [kg].
    prior_m : float
        Standard deviation [m].
    """

    prior_kg: Positive
    prior_m: Positive = 0.05
