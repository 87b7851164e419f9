"""Deviation: one way in which reality may deviate from the description of a recording.

A row of the tables `nuisance.KINDS` and `systematic_effects.ASSUMPTIONS` declares a deviation once:
name, unit, priors, effect and texts. It is estimated with a prior (`Nuisance`), or an effect of the
uncertainty budget (`Assumptions`), whose posterior follows from one linear step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Literal

import casadi as ca
import numpy as np

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..common.validated_types import Finite, Positive

Component = Literal[
    "recording",
    "place",
    "marker",
    "grasp",
    "obstacle",
    "tendon",
    "pressure",
    "load",
    "sensor",
    "camera",
    "images",
    "gauge",
]
ModelPart = Literal[
    "reading", "clock", "sensor", "gravity", "grasps", "loads", "drives", "depth", "stiffness"
]
# Parts of which a change affects the motion, not only the measurements.
OF_MOTION = {"gravity", "grasps", "loads", "drives", "stiffness"}
# Readable units: factor and text by SI unit.
READABLE_UNITS = {
    "m": (1e3, " mm"),
    "s": (1e3, " ms"),
    "rad": (180 / np.pi, "°"),
    "kg": (1e3, " g"),
}
READABLE_UNITS |= {"N m": (1e3, " mN m"), "1": (1e2, " %"), "σ": (1.0, ""), "": (1.0, "")}


@dataclass(frozen=True, eq=False)
class RecordingQuantities:
    """Quantities of a recording on which nuisance parameters may depend."""

    recorded_s: tuple[float, float]  # (float, float): first and last time of the recording
    interval_s: float  # time between samples
    duration_s: float
    gravity_m_s2: Array  # (3,): gravity as stated
    pivot_m: Array  # (3,): pivot c of the rigid motion in the frame of the markers


@validated
@dataclass(frozen=True)
class Deviation:
    """One way in which reality may deviate from the description; zero is as described.

    A recording has one value for each component (marker, grasp, …) and axis; values are independent
    and have normal priors with mean zero. A deviation is estimated with the prior `sigma` of the
    experiment's `Nuisance`, or else an effect of the uncertainty budget with the deviation
    `considered` of `Assumptions`.

    Custom deviations state what they do to a marker's predicted position (`reading`), to its time
    (`clock`) or to the stiffness of the body (`stiffness`), and go into `Nuisance(own=[…])`.

    Attributes
    ----------
    name : str
        Field of `Nuisance` and `Assumptions`; free choice for a custom deviation.
    unit : str
        Unit of the values: "m", "s", "rad", …
    sigma : float or None
        Standard deviation of the prior of an estimate; None where it is not estimated by default.
    description : str
        Description, for documentation.
    label : str
        Name in tables of results, with {which} for the component and {axis}; the name by default.
    considered : float or None
        Standard deviation in the uncertainty budget where it is not estimated; None if it counts
        only where a problem states a deviation.
    by_origin : mapping of str to float
        Deviations in place of `considered`, by `Body.made` or `Body.mesh_from`.
    wide : float or None
        Standard deviation with which it is sought where the residuals contradict the description, of
        a deviation that the budget does not contain.
    typical : mapping of str to float
        Standard deviations of right descriptions, by component, that are smaller than `considered`:
        larger estimates are surprises. The data correct such a deviation in static tests too.
    remedy : str
        What to measure or state in order to reduce it, as an imperative phrase without full stop.
    of : str
        Component that has values of its own: the recording, or each marker, grasp, …; "recording"
        or "marker" for a custom deviation.
    axes : str
        Names of the components of a vector, separated by blanks; empty for a single number.
    effect : callable, optional
        ``effect(at, index)``, the linear change of the equations of motion (`systematic_effects.
        Effect`) by one unit along the axis with this index, for an experiment `at` the answer; None
        where it has none. A deviation with such an effect is never estimated.
    of_specimens : bool
        Whether `effect` concerns homogeneous specimens too, which have neither a mesh nor grips.
    is_one_sided : bool
        Whether it is never negative, so that a known mean may be stated.
    redefines : tuple of str
        Constants, without a region, that the deviation would define differently: they are those of
        the stated definition.
    key : str
        Key of [experiment.nuisance] in the problem file.
    reference : float or None
        Standard deviation if the key's table states other priors only.
    changes : tuple of str
        Parts of the model that depend on the values.
    applies : callable
        ``applies(experiment)``, whether the experiment has such parameters.
    applies_to : callable
        ``applies_to(experiment, index)``, whether the component with this index has such
        parameters, in an experiment that has them; see `of`.
    low, high : float
        Limits, in prior standard deviations.
    reach : float
        Largest change in a step of the solver, in prior standard deviations.
    step : callable, optional
        ``step(experiment)``, largest change in a step of the solver, in `unit`.
    sentence : str
        Sentence in the terminal, with {size}, {way} and {which}.
    by : {"length", "worst", "each"}
        Values that the terminal shows: the longest vector, the value farthest from its prior, or
        each value.
    same : callable
        ``same(experiment)``, what must agree in recordings that share the values, by its name.
    reading : callable, optional
        ``reading(y, values, t_s, data) -> y``, the corrected position of a marker from its
        predicted position y (3,) [m], as CasADi expressions. `values` are one or as many as `axes`,
        `t_s` is the time, and `data` has `pivot_m`, the middle of the undeformed body in its first
        pose, `gravity_m_s2`, `interval_s` and `duration_s` of the recording.
    clock : callable, optional
        ``clock(values, t_s, data)``, by how much later than `t_s` a marker was seen [s]; samples up
        to two away are interpolated.
    stiffness : callable, optional
        ``stiffness(experiment, t_s)``, the relative change (T,) of the stiffness of the body by one
        unit at times (T,), for a body without memory.
    largest : float
        Largest absolute value that is possible in a laboratory, in `unit`.
    """

    # Functions of an `Experiment`, which has deviations itself: the module of its class imports
    # this one, so that their argument has no type here.
    name: str
    unit: str
    sigma: Positive | None = None
    description: str = ""
    label: str = ""
    _: KW_ONLY
    considered: Positive | None = None
    by_origin: Mapping[str, Positive] = field(default_factory=dict, hash=False)
    wide: Positive | None = None
    typical: Mapping[str, Positive] = field(default_factory=dict, hash=False)
    remedy: str = ""
    of: Component = "recording"
    axes: str = ""
    effect: Callable[..., Any] | None = None
    of_specimens: bool = False
    is_one_sided: bool = False
    redefines: tuple[str, ...] = ()
    key: str = ""
    reference: Finite | None = None
    changes: tuple[ModelPart, ...] = ("reading",)
    applies: Callable[..., bool] = lambda experiment: True
    applies_to: Callable[..., bool] = lambda experiment, index: True
    low: float = -np.inf
    high: float = np.inf
    reach: Positive = 1.0
    step: Callable[..., float] | None = None
    sentence: str = ""
    by: Literal["length", "worst", "each"] = "each"
    same: Callable[..., dict[str, object]] = lambda experiment: {}
    reading: Callable[[ca.SX, ca.SX, ca.SX, RecordingQuantities], ca.SX] | None = None
    clock: Callable[[ca.SX, ca.SX, RecordingQuantities], ca.SX] | None = None
    stiffness: Callable[..., Array] | None = None
    largest: float = np.inf

    def __post_init__(self) -> None:
        if self.stiffness:
            vars(self)["changes"] = ("stiffness",)
        if not self.label:
            which = " of {which}" * (self.of == "marker")
            axis = ", {axis}" * bool(self.axes)
            vars(self)["label"] = self.name.replace("_", " ") + which + axis

    @property
    def components(self) -> tuple[str, ...]:
        """Names of the axes, each after that of the deviation and a space; the name
        alone without axes.
        """
        return tuple(f"{self.name} {axis}" for axis in self.axes.split()) or (self.name,)

    @property
    def changes_motion(self) -> bool:
        """Whether a nuisance parameter of this kind changes the motion."""
        return not OF_MOTION.isdisjoint(self.changes)

    def usual_considered(self, *origins: str | None) -> float | None:
        """Return the deviation in the budget for a body of some origins (`Body.made` and
        `Body.mesh_from`), of which the first that `by_origin` contains counts.
        """
        known = (self.by_origin[each] for each in origins if each and each in self.by_origin)
        return next(known, self.considered)

    def prior_key(self) -> str:
        """Return the key of the prior standard deviation in the problem file: "prior", an
        underscore and the unit in lower case, such as "prior_m".

        It is "prior" for the unit "1", "prior_sigmas" for "σ" and "prior_1_m2" for "1/m²".
        """
        unit = {"1": "", "σ": "_sigmas"}.get(self.unit, f"_{self.unit.lower()}")
        return f"prior{unit.replace('/', '_').replace('²', '2')}"

    @property
    def usual(self) -> str:
        """Default standard deviation as text in a readable unit, such as "5 ms"; zero where `sigma`
        is None.
        """
        size, unit = in_readable_unit(self.sigma or 0.0, self.unit)
        return f"{size:.4g}{unit}"


# Name of the class in earlier releases.
NuisanceRow = Deviation


def in_readable_unit(value: float, unit: str) -> tuple[float, str]:
    """Return a value in a readable unit, and that unit as text to print directly behind the value.

    Units of `READABLE_UNITS` are converted (m to " mm", s to " ms", rad to "°", kg to " g", N m to
    " mN m", 1 to " %"), and "σ" is not printed (""). Another unit is kept, with a blank in front.
    """
    factor, shown = READABLE_UNITS.get(unit, (1.0, f" {unit}"))
    return factor * value, shown
