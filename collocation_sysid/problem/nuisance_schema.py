"""The nuisance keys of a recording, made from one table of what may be estimated.

A row is a key of the file, the fields of `Nuisance` that it gives with the key of each one's
prior, and what is said of it.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import Discriminator, Field, Tag, create_model, model_validator

from ..checked import Positive
from ..experiment import Nuisance
from .section import Section, given_keys


class Row(NamedTuple):
    """One key."""

    key: str
    priors: dict[str, str]
    said: str


ROWS = (
    Row(
        "marker_offsets",
        {"marker_offset_m": "prior_m"},
        "Errors of the places given in reference_m, which turn with the body: prior_m, 1 mm by "
        "default.",
    ),
    Row(
        "time_shift",
        {"time_shift_s": "prior_s"},
        "How much later than their times say markers were seen, on the grasps' clock: prior_s, "
        "5 ms by default.",
    ),
    Row(
        "gravity",
        {"gravity_rad": "prior_rad"},
        "A tilt of the direction of gravity: prior_rad, 1 degree by default.",
    ),
    Row(
        "hand_eye",
        {"hand_eye_rad": "prior_rad", "hand_eye_m": "prior_m"},
        "A constant motion of the body in its grasps: prior_rad, prior_m; 0.5 degrees and 1 mm by "
        "default.",
    ),
    Row(
        "joining",
        {"joining_s": "prior_s"},
        "How much later than stated each point mass or force joins or leaves, where it does so "
        "within the recording: prior_s, 10 ms by default.",
    ),
    Row(
        "pose",
        {"pose_turn_rad": "prior_rad", "pose_shift_m": "prior_m"},
        "A constant rigid correction of grasps and body in the cameras' frame: prior_rad, prior_m.",
    ),
    Row(
        "displacement_zero",
        {"displacement_zero_m": "prior_m"},
        "A constant offset of each displacement along each of its axes: prior_m, 0.1 mm by "
        "default.",
    ),
    Row(
        "camera_offsets",
        {"camera_offset_m": "prior_m"},
        "A constant offset of every marker in the cameras' frame: prior_m.",
    ),
    Row(
        "tare",
        {"tare": "prior_sigmas"},
        "A constant offset of every component of a wrench: prior_sigmas, 10 by default.",
    ),
    Row(
        "sensor_time",
        {"sensor_time_s": "prior_s"},
        "How much later than their times say wrenches were measured: prior_s, 5 ms by default.",
    ),
    Row(
        "sensor_lag",
        {"sensor_lag_s": "prior_s"},
        "Time constant of a first-order low-pass in the sensor: prior_s.",
    ),
    Row(
        "tool",
        {"tool_kg": "prior_kg", "tool_m": "prior_m"},
        "A mass between sensor and body, and its centre about point_m: prior_kg, prior_m.",
    ),
    Row(
        "tension_factor",
        {"tension_factor": "prior"},
        "A factor on the tension of each tendon, about one: prior.",
    ),
    Row(
        "tension_lost",
        {"tension_lost_n": "prior_n"},
        "Tension of each tendon that friction takes: prior_n.",
    ),
    Row(
        "pressure_factor",
        {"pressure_factor": "prior"},
        "A factor on each pressure, about one: prior.",
    ),
    Row(
        "pressure_lost",
        {"pressure_lost_pa": "prior_pa"},
        "An offset that each pressure lacks: prior_pa.",
    ),
)

# Priors of one number: what they are called, what they tell, and what the number is.
PRIORS = {
    "prior_m": ("Length", "a length is known", "Standard deviation [m]."),
    "prior_s": ("Time", "a time is known", "Standard deviation [s]."),
    "prior_rad": ("Angle", "a direction is known", "Standard deviation [rad]."),
    "prior_sigmas": (
        "Tare",
        "the zero of a sensor is known",
        "Standard deviation, in sigma_n and sigma_nm.",
    ),
    "prior": ("Share", "a factor near one is known", "Standard deviation, such as 0.05."),
    "prior_n": (
        "Tension",
        "it is known what friction takes of a tension",
        "Standard deviation [N].",
    ),
    "prior_pa": ("Pressure", "the zero of a pressure is known", "Standard deviation [Pa]."),
}


class ToolPrior(Section):
    """How well it is known what a sensor carries beside the body."""

    prior_kg: Positive = Field(description="Standard deviation of its mass, about zero [kg].")
    prior_m: Positive = Field(
        0.05, description="Standard deviation of each coordinate of its centre [m]."
    )


class PosePrior(Section):
    """How well a pose is known; what is left out is taken as exact."""

    prior_rad: Positive | None = Field(None, description="Standard deviation of a turn [rad].")
    prior_m: Positive | None = Field(None, description="Standard deviation of a shift [m].")

    @model_validator(mode="after")
    def _some(self) -> PosePrior:
        if not given_keys(self, "prior_rad", "prior_m"):
            raise ValueError("found neither prior_rad nor prior_m; expected one or both")
        return self


def or_none(section: Any) -> Any:
    """The type of a key that is a table, or "none"."""
    return Annotated[
        Annotated[Literal["none"], Tag("<none>")] | Annotated[section, Tag("<table>")],
        Discriminator(_form),
    ]


def _form(value: Any) -> str:
    return "<none>" if isinstance(value, str) else "<table>"


@cache
def _prior(key: str, *others: str) -> type[Section]:
    if others:
        return ToolPrior if key == "prior_kg" else PosePrior
    name, known, what = PRIORS[key]
    fields: dict[str, Any] = {key: (Positive, Field(description=what))}
    return create_model(f"{name}Prior", __base__=Section, __doc__=f"How well {known}.", **fields)


def _section() -> type[Section]:
    fields: dict[str, Any] = {
        row.key: (
            or_none(_prior(*row.priors.values())) | None,
            Field(None, description=row.said),
        )
        for row in ROWS
    }
    said = (
        "What is estimated of this recording alone, each with a prior around zero.\n\n"
        'The first five are estimated unless they are "none", and where a wrench is measured '
        "tare and\nsensor_time."
    )
    return create_model("NuisanceSection", __base__=Section, __doc__=said, **fields)


NuisanceSection = _section()
if TYPE_CHECKING:
    NuisanceOrNone = Section | Literal["none"]
else:
    NuisanceOrNone = or_none(NuisanceSection)


def nuisance_of(section: Section | Literal["none"]) -> Nuisance:
    """The defaults, with what the table says otherwise."""
    if section == "none":
        return Nuisance.none()
    found: dict[str, float | None] = {}
    for row in ROWS:
        given = getattr(section, row.key)
        if given == "none":
            found |= dict.fromkeys(row.priors)
        elif given is not None:
            found |= {field: getattr(given, prior) for field, prior in row.priors.items()}
    return Nuisance(**found)
