"""Keys of [experiment.nuisance], each for the priors of one or more nuisance parameters."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from typing import Annotated, Literal, TypeVar

from pydantic import Field

from ..common.schema_tables import ByForm, Section
from ..common.validated_types import Text
from ..recording import Nuisance
from ..recording.nuisance import KINDS, NuisanceRow
from .camera_section import (
    DepthBiasPrior,
    DepthEdgePrior,
    DepthPosePrior,
    DepthScalePrior,
    DepthTimePrior,
)
from .nuisance_priors import (
    CalibrationDistortionPrior,
    CalibrationScalePrior,
    CameraOffsetsPrior,
    ClockRatePrior,
    DisplacementZeroPrior,
    GravityPrior,
    HandEyePrior,
    JoiningPrior,
    MarkerOffsetsPrior,
    NuisancePriorSection,
    ObstaclePrior,
    PosePrior,
    PressureFactorPrior,
    PressureLagPrior,
    PressureLostPrior,
    Scoped,
    SensorLagPrior,
    SensorTimePrior,
    StrainZeroPrior,
    TarePrior,
    TensionFactorPrior,
    TensionLostPrior,
    TimeShiftPrior,
    ToolPrior,
)

KEYS = {key: list(rows) for key, rows in groupby(KINDS, key=lambda row: row.key)}


class CustomNuisanceSection(Scoped):
    """A custom nuisance parameter: a NuisanceRow in a Python file.

    Attributes
    ----------
    file : str
        Python file; it is executed, for which commands need the option --allow-code.
    row : str
        Name of the NuisanceRow in the file.
    """

    file: Text
    row: Text


T = TypeVar("T", bound=NuisancePriorSection)
PriorOrNone = Annotated[Literal["none"] | T, ByForm(str)]


class NuisanceSection(Section):
    """Nuisance parameters of this recording, each with a prior whose mean is zero.

    A parameter that has a default prior is estimated unless it is "none".

    Attributes
    ----------
    marker_offsets : MarkerOffsetsPrior or "none", optional
        Errors of the positions in reference_m without a reference_sigma_m; they rotate with the
        body: prior_m, 1 mm by default.
    camera_offsets : CameraOffsetsPrior or "none", optional
        A constant offset of each marker in the cameras' frame: prior_m.
    calibration_scale : CalibrationScalePrior or "none", optional
        Scale error of all lengths that the cameras measure: the factor minus one: prior.
    calibration_distortion : CalibrationDistortionPrior or "none", optional
        Coefficient k of a radial distortion by the cameras: distances r from the middle of the body
        are multiplied by 1 + k r²: prior_1_m2.
    time_shift : TimeShiftPrior or "none", optional
        How much later than stated the markers were measured, by the clock of the grasps: prior_s, 5
        ms by default.
    clock_rate : ClockRatePrior or "none", optional
        How much slower the clock of the markers runs than the clock of the grasps: prior.
    pose : PosePrior or "none", optional
        A constant rotation of grasps and body in the cameras' frame, which rotates gravity in the
        body's frame: prior_rad. A constant translation of grasps and body in the cameras' frame:
        prior_m.
    gravity : GravityPrior or "none", optional
        A tilt of the direction of gravity: prior_rad, 1° by default.
    hand_eye : HandEyePrior or "none", optional
        A constant rotation of the body in its grasps: prior_rad, 0.5° by default. A constant
        translation of the body in its grasps; rotation and translation are estimated if the start
        is an equilibrium and there are markers: prior_m, 1 mm by default.
    strain_zero : StrainZeroPrior or "none", optional
        A constant offset of the strains of a specimen: prior.
    displacement_zero : DisplacementZeroPrior or "none", optional
        A constant offset of each prescribed displacement along each of its axes: prior_m, 0.1 mm by
        default.
    obstacle : ObstaclePrior or "none", optional
        A constant offset of each obstacle along its normal, or along the axis of its displacement;
        it changes the time at which the obstacle touches the body: prior_m, 0.1 mm by default. A
        constant tilt of each obstacle that is a plane or a box, about the point of the plane or the
        middle of the box: prior_rad. Delay of each obstacle's motion, to first order: prior_s.
    tension_factor : TensionFactorPrior or "none", optional
        Scale error of the tension of each tendon: the factor minus one: prior.
    tension_lost : TensionLostPrior or "none", optional
        Tension of each tendon that is lost by friction: prior_n.
    pressure_factor : PressureFactorPrior or "none", optional
        Scale error of each pressure: the factor minus one: prior.
    pressure_lost : PressureLostPrior or "none", optional
        Amount by which each pressure is lower than stated: prior_pa.
    pressure_lag : PressureLagPrior or "none", optional
        Logarithm of the ratio of the true lag of each pressure to the stated lag_s: prior.
    joining : JoiningPrior or "none", optional
        Delay of the time at which each point mass or force begins or ends, if this time is within
        the recording: prior_s, 10 ms by default.
    tare : TarePrior or "none", optional
        A constant offset of each component of a force sensor, in multiples of its sigma:
        prior_sigmas, 10 by default.
    sensor_time : SensorTimePrior or "none", optional
        Delay of the force sensors, limited to three standard deviations of its prior: prior_s, 5 ms
        by default.
    sensor_lag : SensorLagPrior or "none", optional
        Time constant of a first-order low-pass in the sensor, limited to values between zero and
        three standard deviations of its prior: prior_s.
    tool : ToolPrior or "none", optional
        Mass of the tool between a sensor and the body: prior_kg. Centre of the tool relative to the
        point of the sensor; in the frame of the world, relative to the centre of the grasped nodes:
        prior_m.
    depth_pose : DepthPosePrior or "none", optional
        Rotation of each depth camera about the middle of the body, stated along the axes of the
        camera: prior_rad, 5° by default. Translation of each depth camera; if neither prior is
        stated, the search begins by aligning the first image with the body: prior_m, 20 mm by
        default.
    depth_bias : DepthBiasPrior or "none", optional
        Offset that is added to each depth of an image: prior_m, 5 mm by default.
    depth_scale : DepthScalePrior or "none", optional
        Scale error of each depth of an image: the factor minus one: prior, 0.5 % by default.
    depth_time : DepthTimePrior or "none", optional
        Delay of a depth camera, limited to three standard deviations of its prior: prior_s, 5 ms by
        default.
    depth_edge : DepthEdgePrior or "none", optional
        Distance by which silhouettes in the images of each depth camera end inside the outline of
        the body, in pixels: prior_px, 2 px by default.
    own : list of CustomNuisanceSection
        [[experiment.nuisance.own]] tables: custom nuisance parameters, defined in Python files.
    """

    marker_offsets: PriorOrNone[MarkerOffsetsPrior] | None = None
    camera_offsets: PriorOrNone[CameraOffsetsPrior] | None = None
    calibration_scale: PriorOrNone[CalibrationScalePrior] | None = None
    calibration_distortion: PriorOrNone[CalibrationDistortionPrior] | None = None
    time_shift: PriorOrNone[TimeShiftPrior] | None = None
    clock_rate: PriorOrNone[ClockRatePrior] | None = None
    pose: PriorOrNone[PosePrior] | None = None
    gravity: PriorOrNone[GravityPrior] | None = None
    hand_eye: PriorOrNone[HandEyePrior] | None = None
    strain_zero: PriorOrNone[StrainZeroPrior] | None = None
    displacement_zero: PriorOrNone[DisplacementZeroPrior] | None = None
    obstacle: PriorOrNone[ObstaclePrior] | None = None
    tension_factor: PriorOrNone[TensionFactorPrior] | None = None
    tension_lost: PriorOrNone[TensionLostPrior] | None = None
    pressure_factor: PriorOrNone[PressureFactorPrior] | None = None
    pressure_lost: PriorOrNone[PressureLostPrior] | None = None
    pressure_lag: PriorOrNone[PressureLagPrior] | None = None
    joining: PriorOrNone[JoiningPrior] | None = None
    tare: PriorOrNone[TarePrior] | None = None
    sensor_time: PriorOrNone[SensorTimePrior] | None = None
    sensor_lag: PriorOrNone[SensorLagPrior] | None = None
    tool: PriorOrNone[ToolPrior] | None = None
    depth_pose: PriorOrNone[DepthPosePrior] | None = None
    depth_bias: PriorOrNone[DepthBiasPrior] | None = None
    depth_scale: PriorOrNone[DepthScalePrior] | None = None
    depth_time: PriorOrNone[DepthTimePrior] | None = None
    depth_edge: PriorOrNone[DepthEdgePrior] | None = None
    own: list[CustomNuisanceSection] = Field(default_factory=list)


NuisanceOrNone = Annotated[Literal["none"] | NuisanceSection, ByForm(str)]


def nuisance_from_section(
    section: NuisanceSection | Literal["none"],
    row_of: Callable[[CustomNuisanceSection], NuisanceRow],
) -> Nuisance:
    """Return the nuisance parameters of a recording: the defaults with the changes of the table.

    Parameters
    ----------
    section : NuisanceSection or "none"
        Table; "none" means no nuisance parameters.
    row_of : callable
        Function that returns the custom nuisance parameter of a table; what it raises is raised.

    Notes
    -----
    A key without a table leaves its parameters at their defaults; "none" removes all of them. Of a
    table that states a deviation, those that it does not state are removed (exact values); a table
    with a scope alone leaves the deviations as they are.
    """
    if section == "none":
        return Nuisance.none()
    deviations: dict[str, float | None] = {}
    scope: dict[str, str] = {}
    for key, rows in KEYS.items():
        prior = getattr(section, key)
        if prior == "none":
            deviations |= {row.name: None for row in rows}
        elif prior is not None:
            known = {row.name: getattr(prior, row.prior_key()) for row in rows}
            # A scope alone leaves the deviations as they are.
            deviations |= known if any(known.values()) else {}
            if prior.scope != "recording":
                scope |= {row.name: prior.scope for row in rows}
    custom_rows = [row_of(each) for each in section.own]
    scopes_by_name = {
        row.name: each.scope for row, each in zip(custom_rows, section.own, strict=True)
    }
    scope |= {name: word for name, word in scopes_by_name.items() if word != "recording"}
    return Nuisance(**deviations, scope=scope, own=custom_rows)
