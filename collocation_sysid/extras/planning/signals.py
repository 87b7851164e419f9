"""Tensions of tendons and pressures that a plan chooses, as coordinates beside those of the hand.

A coordinate is the tension at the tendon, or the pressure in the chamber, less that before the
motion. A pressure that lags behind its command by the time constant τ has the command p + τ dp/dt,
which the limits apply to: the splines have the continuous derivatives that this needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...errors import InputError, hint_at, listed
from ...recording import Experiment, Pressure, Tendon
from .hand_limits import WITHIN
from .task import SignalSection, Task, TendonSection

# Commands over times, by name of the tendon or pressure.
Commands = Mapping[str, tuple[Array, Array]]
# Share of its range by which a signal may leave the range during the search, so that a signal that
# begins at its limit has a neighbourhood; what is written is within the range.
SLACK = 1e-4


@dataclass(frozen=True, eq=False)
class Signal:
    """Tension or pressure that a plan chooses."""

    section: SignalSection  # what the task states
    number: int  # index of the actuator among those of the recording: tendons, then pressures
    # The amplitude of the actuator's energy is slope · (value − offset).
    slope: float
    offset: float
    lag_s: float  # time constant with which the value follows the command [s]
    initial: float  # value before the motion [N, Pa]
    # Limits of the command [N, Pa].
    lowest: float
    highest: float

    @property
    def name(self) -> str:
        """Name of the tendon or pressure."""
        return self.section.name

    @property
    def unit(self) -> str:
        """Unit of the value, "N" or "Pa"."""
        return "N" if isinstance(self.section, TendonSection) else "Pa"

    @property
    def span(self) -> float:
        """Difference of the limits [N, Pa], the unit of the coordinate."""
        return self.highest - self.lowest

    @property
    def end(self) -> float:
        """Given coordinate at the end [N, Pa]; NaN if it is free."""
        end = self.section.end
        return np.nan if end is None else end - self.initial

    def command(self, value: Any, rate: Any) -> Any:
        """Return the command for a coordinate and its rate: numbers or expressions."""
        return self.initial + value + self.lag_s * rate

    def limit_rows(self, value: Any, first: Any, second: Any) -> list[tuple[str, Any]]:
        """Return the limits of the command by name, as expressions that must not be positive."""
        middle, half = (self.lowest + self.highest) / 2, self.span / 2
        place = (self.command(value, first) - middle) / half
        rate = (first + self.lag_s * second) / (WITHIN * self.section.rate)
        names = [f"{key} of {self.name}" for key in (self.section.range_key, self.section.rate_key)]
        return [
            (name, sign * share - most)
            for name, share, most in ((names[0], place, 1 + SLACK), (names[1], rate, 1.0))
            for sign in (1, -1)
        ]


def task_signals(task: Task, template: Experiment) -> tuple[Signal, ...]:
    """Return the signals of a task, in its order: tendons, then pressures.

    Raises
    ------
    InputError
        For a name that the recording does not have, and limits without the value before the motion.
    """
    names = [each.name for each in template.actuators]
    kinds = {"tendon": template.tendons, "pressure": template.pressures}
    found = []
    for kind, number, section in task.signals:
        where = f"{kind} {number}"
        known = [each.name for each in kinds[kind]]
        if section.name not in known:
            expected = f"one of {listed(known)}" if known else "a recording that has one"
            raise InputError(
                f"the recording has no {kind} {section.name!r}{hint_at(section.name, known)}; "
                f"expected {expected}",
                None,
                where=f"{where}: name",
            )
        actuator = kinds[kind][known.index(section.name)]
        slope, offset = _amplitude_line(actuator)
        initial = standing_value(actuator, template.t_s[0])
        lowest, highest = section.range
        if kind == "tendon":  # a slack tendon exerts no force
            lowest = max(lowest, offset)
        if not lowest - 1e-9 * (highest - lowest) <= initial <= highest:
            unit = actuator.unit
            raise InputError(
                f"found [{lowest:g}, {highest:g}], but it is {initial:g} {unit} before the motion; "
                "expected limits that contain this value",
                None,
                where=f"{where}: {section.range_key}",
            )
        has_lag = isinstance(actuator, Pressure) and not template.is_static
        lag_s = actuator.lag_s if has_lag else 0.0
        found.append(
            Signal(
                section, names.index(section.name), slope, offset, lag_s, initial, lowest, highest
            )
        )
    return tuple(found)


def standing_value(actuator: Tendon | Pressure, t_s: float) -> float:
    """Return the tension or pressure at a time of the recording, before factor and loss; of a slack
    tendon, the largest with which it is slack.
    """
    slope, offset = _amplitude_line(actuator)
    (amplitude,) = actuator.energy_amplitude_at(np.array([t_s]))
    return float(amplitude / slope + offset)


def _amplitude_line(actuator: Tendon | Pressure) -> tuple[float, float]:
    """Return slope and offset of the amplitude, see `Signal`."""
    slope = float(actuator.energy_amplitude(1.0, actuator.factor, 0.0))
    return slope, getattr(actuator, actuator.offset_field) / actuator.factor


def commanded(
    actuators: tuple[Any, ...], start_s: float, commands: Commands, *, is_static: bool = False
) -> tuple[Tendon | Pressure, ...]:
    """Return tendons or pressures with commands; the others keep their values at `start_s`. In
    equilibria, nothing lags.
    """
    changed = []
    for each in actuators:
        key = "tension_n" if isinstance(each, Tendon) else "pressure_pa"
        without = {"lag_s": 0.0} if isinstance(each, Pressure) else {}
        if each.name in commands:
            t_s, values = commands[each.name]
            lag = without if is_static else {}
            changed.append(replace(each, **{key: values, "t_s": t_s}, **lag))
        else:
            value = standing_value(each, start_s)
            changed.append(replace(each, **{key: np.array([value]), "t_s": None}, **without))
    return tuple(changed)
