"""Check of natural modes: oscillation of the body in its grasps, and its resolution by the time
grid.

Numerical damping and period error of a scheme: for x″ = −ω² x − 2 ζ ω x′ with step Δt, a row of a
scheme (see `fem.schemes`) is a linear recurrence whose solutions are powers zᵏ. With h = ωΔt and
u = 1/z they are the roots of

    Σ_j w_j uʲ · (h² Σ_i p_i uⁱ + 2 ζ h Σ_i q_i uⁱ) + Σ_i s_i uⁱ = 0.

The largest root, the principal one, corresponds to z = exp(h (−ζ + i √(1 − ζ²))) of the exact
solution (Hairer, Lubich & Wanner, Geometric Numerical Integration, 2006, ch. XV, do the same for
multistep methods). Its damping ratio is −ln|z| / |ln z|, its angular frequency arg(z) / Δt.
Without physical damping backward Euler damps by ωΔt / 2 to leading order, midpoint not at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array
from ...errors import InputError, SimulationError
from ...fem.schemes import Scheme, Stencil
from ...model.forces import Forces
from ...program.forward.initial_equilibrium import equilibrium
from ...program.forward.newton_solver import NewtonSolver
from ...program.modes.natural import Modes, natural_modes
from ...recording.experiment import Experiment
from ...statistics.concerns import Concern, concern_if

# Number of modes.
MODE_COUNT = 6
# Largest numerical damping ratio, as a share of the material's.
DAMPING_SHARE = 0.1
# Largest numerical damping ratio of a mode with little damping.
LEAST_DAMPING_LIMIT = 0.005
# Fewest grid steps per period with which the motion of a mode is computed well.
FEW_STEPS = 8
# Fewest samples per period with which the motion of a mode is measured well.
FEW_SAMPLES = 3
# Scheme without numerical damping.
UNDAMPED = "midpoint"
# Decimals of numerical damping ratios: further ones are rounding.
ROUNDING = 12


@dataclass(frozen=True)
class ModeCheck:
    """One natural mode."""

    frequency_hz: float  # undamped natural frequency
    # Samples of the recording, and steps of the time grid.
    samples_per_period: float
    steps_per_period: float
    damping_ratio: float  # damping ratio of the mode by the material; 1 or more if it is overdamped
    # Damping ratio that the scheme adds; negative where it takes some away.
    numerical_damping_ratio: float
    period_error: float  # relative lengthening of the undamped period by the scheme


@dataclass(frozen=True)
class ModesCheck:
    """Natural modes of the body in one experiment, and errors of the time scheme."""

    experiment: str
    about: str  # state about which the body oscillates: "rest state" or "undeformed shape"
    modes: tuple[ModeCheck, ...]
    scheme: str  # name of the time scheme
    timestep_s: float  # step of the time grid
    duration_s: float  # duration of the recording
    # The fewest with which the scheme damps and slows the first mode little; None if too many.
    substeps_needed: int | None
    not_oscillating: int  # number of rigid modes that were left out

    @property
    def first_mode(self) -> ModeCheck | None:
        """Mode of the lowest frequency; None if there is none."""
        return self.modes[0] if self.modes else None


def check_modes(experiment: Experiment, scheme: Scheme, step_s: float, theta: Array) -> ModesCheck:
    """Return the natural modes of an experiment about the sample with fewest prescribed dofs, and
    the errors of the scheme.

    Of several such samples the last counts, when all point masses have joined. The state is the
    equilibrium if it can be found, else the undeformed shape.

    Parameters
    ----------
    scheme : Scheme
        Time scheme of the solve.
    step_s : float
        Step of the time grid [s].
    theta : array
        Constants θ of the body.

    Raises
    ------
    SimulationError
        If the body has no stress-free shape at θ, or a factorisation fails.
    """
    is_prescribed = experiment.is_prescribed(experiment.t_s)
    count = is_prescribed.sum(axis=(1, 2))
    least = int(np.flatnonzero(count == count.min())[-1])
    time_s = float(experiment.t_s[least])
    x, about = _reference_state(experiment, is_prescribed[least], time_s=time_s, theta=theta)
    free = np.flatnonzero(~is_prescribed[least])
    modes = natural_modes(
        Forces.from_experiment(experiment, time_s, theta=theta), x, free_dofs=free, count=MODE_COUNT
    )
    findings = _mode_findings(modes, experiment, scheme=scheme, step_s=step_s)
    needed = None
    if findings:
        omega = float(modes.angular_frequencies_rad_s[0])
        limit = _damping_limit(findings[0])
        ratio = _oscillating_damping_ratio(findings[0].damping_ratio)
        needed = substeps_needed(
            scheme,
            omega,
            timestep_s=experiment.timestep_s,
            damping_limit=limit,
            damping_ratio=ratio,
        )
    return ModesCheck(
        experiment.name,
        about,
        modes=findings,
        scheme=scheme.name,
        timestep_s=step_s,
        duration_s=experiment.duration_s,
        substeps_needed=needed,
        not_oscillating=modes.omitted_count,
    )


def _reference_state(
    experiment: Experiment, is_prescribed: NDArray[np.bool_], time_s: float, theta: Array
) -> tuple[Array, str]:
    """Return the equilibrium if nodes are held and it can be found, else the placed shape."""
    if is_prescribed.any():
        try:
            solver = NewtonSolver(experiment, prescribed=is_prescribed)
            return equilibrium(experiment, theta, time_s=time_s, solver=solver), "rest state"
        except SimulationError:
            pass
    return experiment.rigid_positions([time_s])[0], "undeformed shape"


def _mode_findings(
    modes: Modes, experiment: Experiment, scheme: Scheme, step_s: float
) -> tuple[ModeCheck, ...]:
    """Return errors of the scheme in period and damping, for each mode, lowest first."""
    findings = []
    for frequency, ratio in zip(modes.frequencies_hz, modes.damping_ratios, strict=True):
        omega = 2 * np.pi * frequency
        undamped = numerical_mode(scheme, omega, timestep_s=step_s)
        damped = numerical_mode(
            scheme, omega, timestep_s=step_s, damping_ratio=_oscillating_damping_ratio(float(ratio))
        )
        findings.append(
            ModeCheck(
                float(frequency),
                float(1 / frequency / experiment.timestep_s),
                steps_per_period=float(1 / frequency / step_s),
                damping_ratio=float(ratio),
                numerical_damping_ratio=round(damped.damping_ratio, ROUNDING) + 0.0,  # no −0
                period_error=undamped.period_error,
            )
        )
    return tuple(findings)


def _oscillating_damping_ratio(damping_ratio: float) -> float:
    """Return 0 for an overdamped mode, whose numerical damping does not matter."""
    return damping_ratio if damping_ratio < 1 else 0.0


def _damping_limit(mode: ModeCheck) -> float:
    """Return a share of the mode's damping ratio, or a small absolute value if that is larger."""
    return max(DAMPING_SHARE * mode.damping_ratio, LEAST_DAMPING_LIMIT)


def mode_concerns(motion: ModesCheck) -> list[Concern]:
    """Return concerns about the time grid and the recording at the first mode; none without a mode.

    There is at most one about the grid (numerical damping, or too few steps per period), one if the
    period has too few samples, and one if the recording is shorter than the period.
    """
    mode = motion.first_mode
    if mode is None:
        return []
    first = _first_mode_data(motion, mode)
    samples = mode.samples_per_period
    rate_data = {"samples": samples, "needed_hz": FEW_STEPS * mode.frequency_hz}
    is_short = motion.duration_s * mode.frequency_hz < 1
    duration_data = {"duration_s": motion.duration_s}
    return [
        *_grid_concerns(motion, mode),
        *concern_if(samples < FEW_SAMPLES, False, code="information/rate", **first, **rate_data),
        *concern_if(is_short, False, code="information/short", **first, **duration_data),
    ]


def _grid_concerns(motion: ModesCheck, mode: ModeCheck) -> list[Concern]:
    """Too much damping, or else too few steps per period (`FEW_STEPS`)."""
    first = _first_mode_data(motion, mode)
    added = mode.numerical_damping_ratio
    if abs(added) > _damping_limit(mode):
        remedy = _step_remedy(motion)
        if motion.scheme != UNDAMPED:
            or_finer = "" if motion.substeps_needed is None else f", or {_substeps_setting(motion)}"
            remedy = f'set transcription.scheme = "{UNDAMPED}"{or_finer}'
        grid = {"scheme": motion.scheme, "step_ms": 1e3 * motion.timestep_s, "ratio": abs(added)}
        code = "scheme/adds" if added > 0 else "scheme/takes"
        return [Concern(code, data=first | grid | {"remedy": remedy})]
    steps = {
        "steps": mode.steps_per_period,
        "error": mode.period_error,
        "remedy": _step_remedy(motion),
    }
    few = mode.steps_per_period < FEW_STEPS
    return concern_if(few, False, code="scheme/coarse", **first, **steps)


def _first_mode_data(motion: ModesCheck, mode: ModeCheck) -> dict[str, Any]:
    return {"experiment": motion.experiment, "frequency_hz": mode.frequency_hz}


def mode_notes(motion: ModesCheck) -> list[str]:
    """Return notes on the modes of a recording; empty if there is nothing to note.

    There may be one on rigid modes, one if the first mode is overdamped at the guess, and one if
    the scheme lengthens the first period by more than `PERIOD_ERROR`, unless a concern about the
    grid says more.
    """
    notes = []
    mode = motion.first_mode
    name = motion.experiment
    if motion.not_oscillating:
        notes.append(
            f"{motion.not_oscillating} modes of '{name}' are rigid motions that no grasp "
            "prevents; they do not oscillate and are not listed"
        )
    if mode is None:
        return notes
    if mode.damping_ratio >= 1:
        notes.append(
            f"the first mode of '{name}' is overdamped at the guess (damping ratio "
            f"{mode.damping_ratio:.2g}): if the recording oscillates, state a guess with less "
            "damping"
        )
    if mode.period_error > PERIOD_ERROR and not _grid_concerns(motion, mode):
        notes.append(
            f"{motion.scheme} lengthens the first period of '{name}' by {mode.period_error:.1%}, "
            f"so that the estimated stiffness will be about {2 * mode.period_error:.1%} too high: "
            f"{_step_remedy(motion)}"
        )
    return notes


def _step_remedy(motion: ModesCheck) -> str:
    if motion.substeps_needed is None:
        return "record at a higher rate"
    return f"set transcription.{_substeps_setting(motion)}"


def _substeps_setting(motion: ModesCheck) -> str:
    """Return for example "substeps = 4"; `motion.substeps_needed` must not be None."""
    return f"substeps = {motion.substeps_needed}"


# Largest number of substeps tried by `substeps_needed`; more would be too slow to be useful.
MAX_SUBSTEPS = 4096
# Largest absolute relative error of the period in `substeps_needed`.
PERIOD_ERROR = 0.01


@dataclass(frozen=True)
class NumericalMode:
    """Numerical damping and period error of one mode."""

    # Damping ratio of the computed oscillation minus the physical damping ratio.
    damping_ratio: float
    # Relative lengthening of the period; infinite where the computed mode does not oscillate.
    period_error: float


def numerical_mode(
    scheme: Scheme, angular_frequency_rad_s: float, timestep_s: float, damping_ratio: float = 0.0
) -> NumericalMode:
    """Return damping and period error of the regular rows of a scheme.

    Parameters
    ----------
    angular_frequency_rad_s : float
        Angular frequency ω of the undamped oscillation, positive.
    timestep_s : float
        Time step Δt of the grid, i.e. the time between samples divided by the number of substeps.
    damping_ratio : float
        Physical damping ratio ζ, 0 ≤ ζ < 1. The period error is relative to the damped period.

    Raises
    ------
    InputError
        For a damping ratio outside [0, 1): a critically damped mode does not oscillate.
    """
    if not 0 <= damping_ratio < 1:
        raise InputError(f"damping_ratio = {damping_ratio:g}, expected 0 <= damping_ratio < 1")
    h = angular_frequency_rad_s * timestep_s
    z = principal_root(scheme.regular, h, damping_ratio=damping_ratio)
    rate = -float(np.log(abs(z)))
    angle = float(np.angle(z))
    exact = h * float(np.sqrt(1 - damping_ratio**2))
    period_error = float(exact / angle - 1) if angle > 0 else np.inf
    return NumericalMode(rate / float(np.hypot(rate, angle)) - float(damping_ratio), period_error)


def principal_root(stencil: Stencil, h: float, damping_ratio: float = 0.0) -> complex:
    """Return the root z of the characteristic polynomial that corresponds to the exact solution.

    The principal root has the largest modulus of all roots with a non-negative imaginary part.

    Parameters
    ----------
    stencil : Stencil
        Regular stencil of a scheme.
    h : float
        Dimensionless time step ωΔt, positive.
    damping_ratio : float
        Physical damping ratio ζ.
    """
    force = _polynomial_sum(h**2 * np.array(stencil.p), 2 * damping_ratio * h * np.array(stencil.q))
    in_u = _polynomial_sum(np.convolve(stencil.w, force), np.array(stencil.s))
    roots = np.roots(in_u)  # of z: the coefficient of u⁰ leads
    upper = roots[roots.imag >= -1e-12 * np.abs(roots)]
    return complex(upper[np.argmax(np.abs(upper))])


def substeps_needed(
    scheme: Scheme,
    angular_frequency_rad_s: float,
    timestep_s: float,
    damping_limit: float,
    damping_ratio: float = 0.0,
) -> int | None:
    """Return the fewest substeps that keep numerical damping and period error within limits, by
    bisection: both are assumed to decrease with the step. The period error is at most
    `PERIOD_ERROR`, evaluated without physical damping.

    Parameters
    ----------
    angular_frequency_rad_s : float
        Angular frequency ω of the undamped mode, positive.
    timestep_s : float
        Time between samples.
    damping_limit : float
        Largest absolute numerical damping ratio.
    damping_ratio : float
        Physical damping ratio ζ, below 1.

    Returns
    -------
    int or None
        None where `MAX_SUBSTEPS` substeps do not suffice.

    Raises
    ------
    InputError
        For a damping ratio outside [0, 1).
    """

    def suffices(substeps: int) -> bool:
        mode, damped = (
            numerical_mode(
                scheme,
                angular_frequency_rad_s,
                timestep_s=timestep_s / substeps,
                damping_ratio=ratio,
            )
            for ratio in (0.0, damping_ratio)
        )
        return abs(damped.damping_ratio) <= damping_limit and abs(mode.period_error) <= PERIOD_ERROR

    high = 1
    while not suffices(high):
        high *= 2
        if high > MAX_SUBSTEPS:
            return None
    low = high // 2  # does not suffice, or is zero
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if suffices(middle) else (middle, high)
    return high


def _polynomial_sum(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sum of two polynomials, given by their coefficients from the lowest power on."""
    total = np.zeros(max(len(a), len(b)))
    total[: len(a)] += a
    total[: len(b)] += b
    return total
