"""How the body oscillates in its grasp at the guess, and what the time grid makes of that."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...arrays import Array
from ...errors import SimulationError
from ...model.forces import Forces
from ...model.numerical_damping import PERIOD_ERROR, numerical_mode, substeps_needed
from ...model.schemes import Scheme
from ...program.modes import Modes, natural_modes
from ...program.newton import Solver
from ...program.rest import rest_state
from ...recording.experiment import Experiment
from ...statistics.concern import Concern, concerned

COUNT = 6
# A scheme may add this share of the physical damping ratio, or this ratio where there is little.
DAMPING_SHARE, LITTLE_DAMPING = 0.1, 0.005
# Fewer grid steps a period than this, and a mode's motion is badly computed; with fewer samples
# than the second, it is badly seen.
FEW_STEPS, FEW_SAMPLES = 8, 3
UNDAMPED = "midpoint"
ROUNDING = 12


@dataclass(frozen=True)
class ModeFinding:
    """One natural mode at the guess.

    Attributes
    ----------
    frequency_hz : float
    samples_per_period, steps_per_period : float
        Of the recording, and of the time grid.
    damping_ratio : float
        Of the material, at the guess.
    numerical_damping_ratio : float
        What the scheme adds at that damping; negative where it takes some away.
    period_error : float
        By how much the scheme lengthens the undamped period, relatively.
    """

    frequency_hz: float
    samples_per_period: float
    steps_per_period: float
    damping_ratio: float
    numerical_damping_ratio: float
    period_error: float


@dataclass(frozen=True)
class Motion:
    """How the body oscillates in one experiment at the guess.

    Attributes
    ----------
    experiment : str
    about : str
        The state it oscillates about: "rest state" or "undeformed shape".
    modes : tuple of ModeFinding, by frequency
    scheme : str
    timestep_s : float
        Step of the time grid.
    duration_s : float
    substeps_needed : int or None
        The fewest with which the scheme damps and slows the first mode little; None if too many.
    not_oscillating : int
        Rigid modes left out.
    """

    experiment: str
    about: str
    modes: tuple[ModeFinding, ...]
    scheme: str
    timestep_s: float
    duration_s: float
    substeps_needed: int | None
    not_oscillating: int

    @property
    def first(self) -> ModeFinding | None:
        """The slowest mode."""
        return self.modes[0] if self.modes else None


def motion_of(experiment: Experiment, scheme: Scheme, step_s: float, theta: Array) -> Motion:
    """Modes of one experiment at θ while it is held least, and what the scheme does to them.

    Of those times the last counts, when all point masses have joined.
    """
    held = experiment.held(experiment.t_s)
    count = held.sum(axis=(1, 2))
    least = int(np.flatnonzero(count == count.min())[-1])
    time_s = float(experiment.t_s[least])
    x, about = _state(experiment, held[least], time_s, theta)
    free = np.flatnonzero(~held[least])
    modes = natural_modes(Forces.of(experiment, time_s, theta), x, free, COUNT)
    findings = _mode_findings(modes, experiment, scheme, step_s)
    needed = None
    if findings:
        omega = float(modes.angular_frequencies_rad_s[0])
        limit = _damping_limit(findings[0])
        ratio = _oscillating(findings[0].damping_ratio)
        needed = substeps_needed(scheme, omega, experiment.timestep_s, limit, damping_ratio=ratio)
    return Motion(
        experiment.name,
        about,
        findings,
        scheme.name,
        step_s,
        experiment.duration_s,
        needed,
        modes.not_oscillating,
    )


def _state(
    experiment: Experiment, held: NDArray[np.bool_], time_s: float, theta: Array
) -> tuple[Array, str]:
    if held.any():
        try:
            solver = Solver(experiment, held=held)
            return rest_state(experiment, theta, time_s, solver=solver), "rest state"
        except SimulationError:
            pass
    return experiment.rigid_positions([time_s])[0], "undeformed shape"


def _mode_findings(
    modes: Modes, experiment: Experiment, scheme: Scheme, step_s: float
) -> tuple[ModeFinding, ...]:
    findings = []
    for frequency, ratio in zip(modes.frequencies_hz, modes.damping_ratios, strict=True):
        omega = 2 * np.pi * frequency
        undamped = numerical_mode(scheme, omega, step_s)
        damped = numerical_mode(scheme, omega, step_s, _oscillating(float(ratio)))
        findings.append(
            ModeFinding(
                float(frequency),
                float(1 / frequency / experiment.timestep_s),
                float(1 / frequency / step_s),
                float(ratio),
                round(damped.damping_ratio, ROUNDING) + 0.0,  # no −0
                undamped.period_error,
            )
        )
    return tuple(findings)


def _oscillating(damping_ratio: float) -> float:
    """The damping ratio, or none where nothing oscillates whose damping a scheme could change."""
    return damping_ratio if damping_ratio < 1 else 0.0


def _damping_limit(mode: ModeFinding) -> float:
    return max(DAMPING_SHARE * mode.damping_ratio, LITTLE_DAMPING)


def motion_concerns(motion: Motion) -> list[Concern]:
    """What the time grid and the length of the recording will spoil."""
    mode = motion.first
    if mode is None:
        return []
    first, samples = _first_mode(motion, mode), mode.samples_per_period
    seen = {"samples": samples, "needed_hz": FEW_STEPS * mode.frequency_hz}
    cut, length = motion.duration_s * mode.frequency_hz < 1, {"duration_s": motion.duration_s}
    return [
        *_grid_concerns(motion, mode),
        *concerned(samples < FEW_SAMPLES, False, "information/rate", **first, **seen),
        *concerned(cut, False, "information/short", **first, **length),
    ]


def _grid_concerns(motion: Motion, mode: ModeFinding) -> list[Concern]:
    """What the scheme and its step spoil."""
    first, added = _first_mode(motion, mode), mode.numerical_damping_ratio
    if abs(added) > _damping_limit(mode):
        remedy = _finer(motion)
        if motion.scheme != UNDAMPED:
            or_finer = "" if motion.substeps_needed is None else f", or {_bare(motion)}"
            remedy = f'set transcription.scheme = "{UNDAMPED}"{or_finer}'
        grid = {"scheme": motion.scheme, "step_ms": 1e3 * motion.timestep_s, "ratio": abs(added)}
        code = "scheme/adds" if added > 0 else "scheme/takes"
        return [Concern(code, data=first | grid | {"remedy": remedy})]
    steps = {"steps": mode.steps_per_period, "error": mode.period_error, "remedy": _finer(motion)}
    few = mode.steps_per_period < FEW_STEPS
    return concerned(few, False, "scheme/coarse", **first, **steps)


def _first_mode(motion: Motion, mode: ModeFinding) -> dict[str, Any]:
    return {"experiment": motion.experiment, "frequency_hz": mode.frequency_hz}


def motion_notes(motion: Motion) -> list[str]:
    """What is worth knowing about the modes."""
    notes = []
    mode, name = motion.first, motion.experiment
    if motion.not_oscillating:
        notes.append(
            f"{motion.not_oscillating} modes of '{name}' do not oscillate (rigid motions that no "
            "grasp holds) and are left out"
        )
    if mode is None:
        return notes
    if mode.damping_ratio >= 1:
        notes.append(
            f"the first mode of '{name}' creeps at the guess (damping ratio "
            f"{mode.damping_ratio:.2g}): if the recording swings, guess less damping"
        )
    if mode.period_error > PERIOD_ERROR and not _grid_concerns(motion, mode):
        notes.append(
            f"{motion.scheme} lengthens the first period of '{name}' by {mode.period_error:.1%}, "
            f"and the stiffness found will be about {2 * mode.period_error:.1%} too high: "
            f"{_finer(motion)}"
        )
    return notes


def _finer(motion: Motion) -> str:
    if motion.substeps_needed is None:
        return "record at a higher rate"
    return f"set transcription.{_bare(motion)}"


def _bare(motion: Motion) -> str:
    return f"substeps = {motion.substeps_needed}"
