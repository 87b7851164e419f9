"""Predictions of held-out recordings of the pneumatic arm, and the influence of assumptions.

Material and reinforcement of problems/pneumatic_arm are estimated from 100, 200 and 300 mbar. Other
recordings are predicted without any of their measurements: delay and lag of their pressure are the
means of the fitted recordings. The tip is the mean of its three markers, relative to its rest.

    python scripts study_pneumatic_arm                              # as shipped
    python scripts study_pneumatic_arm --variants statics wall_32
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from get_pneumatic_arm import FOLDER, ArmShape, arm_mesh
from numpy.typing import NDArray
from script_arguments import make_parser

from collocation_sysid import Nuisance, Problem, SimulationError, Solution, simulate, solve
from collocation_sysid.recording import Experiment
from collocation_sysid.runs.warm_start import WarmStart
from collocation_sysid.statistics.pose_noise import uncertainty_at
from collocation_sysid.statistics.uncertainty import Uncertainty

# Duration at the end of a recording over which the final travel is averaged [s]: two oscillations.
FINAL_S = 0.25
# Thickness of the outer wall that differs from that of the shipped problem [m].
WALLS_M = {"wall_32": 0.0032}
# Modulus of the silicone that the authors state, and one so small that the threads have no effect
# [Pa].
AUTHORS_YOUNG_PA = 263824.0
NO_THREADS_PA = 1.0
# Files of the largest pressure, in place of those of the last recording in the problem.
LARGEST = [
    "experiment.350mbar.markers.file=450mbar.csv",
    "experiment.350mbar.pressure.0.pressure=450mbar_step.csv",
]
VARIANTS = ("statics", "shipped", *WALLS_M)


@dataclass(frozen=True)
class TravelError:
    """Measured and predicted motion of the tip in one recording."""

    # Final travel of the tip.
    measured_m: float
    predicted_m: float
    final_m: float  # distance of predicted and measured tip at the end, of means over FINAL_S
    rms_m: float  # RMS distance of the tip over the recording


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["shipped"])
    start = None
    for variant in parser.parse_args().variants:
        print(f"\n== {variant} ==\n", flush=True)
        if variant == "statics":
            print_statics()
        else:
            start = WarmStart.of(print_fit(variant, start))


def print_statics() -> None:
    """Print the static travel of the tip with and without threads, at the authors' modulus."""
    problem = variant_of_problem("shipped")
    for experiment in problem.experiments:
        travels = []
        for fibre_pa in (NO_THREADS_PA, 1e6):
            try:
                travel_m = static_travel_m(problem, fibre_pa, pressure_mbar(experiment))
                travels.append(f"{1e3 * travel_m:.2f} mm")
            except SimulationError:
                travels.append("no equilibrium found")
        print(
            f"{experiment.name:9} without threads {travels[0]}, with 1 MPa {travels[1]}", flush=True
        )


def static_travel_m(problem: Problem, fibre_pa: float, mbar: float) -> float:
    """Return the static travel of the tip without memory, at the authors' modulus."""
    experiment = problem.experiments[0]
    (pressure,) = experiment.pressures
    assert experiment.markers is not None
    t_s = np.array([0.0, 1.0])
    inflated = replace(
        pressure, pressure_pa=[0.0, 100 * mbar], t_s=t_s, lag_s=0.0, body_measure=None
    )
    markers = replace(experiment.markers, t_s=t_s, positions_m=experiment.markers.positions_m[:2])
    static_experiment = replace(
        experiment,
        kind="static",
        t_s=t_s,
        markers=markers,
        pressures=[inflated],
        nuisance=Nuisance.none(),
    )
    items = problem.parameters.scalars
    values = {item.name: float(item.guess) for item in items if item.guess is not None}
    values |= {"young_pa": AUTHORS_YOUNG_PA, "fibre_pa": fibre_pa, "prony_1.share": 0.0}
    tip_m = tip_motion(simulate(static_experiment, values).markers_m)
    return float(np.linalg.norm(tip_m[-1]))


def print_fit(variant: str, start: WarmStart | None) -> Solution:
    """Fit a variant of the problem, from an earlier answer if there is one, and print parameters,
    misfits and predictions.
    """
    problem = variant_of_problem(variant)
    fitted_recordings = [each for each in problem.experiments if not each.validation]
    solution = solve(replace(problem, experiments=fitted_recordings), start=start)
    print(f"{solution.message} {solution.iterations} sweeps, {solution.timing.total:.0f} s")
    print_estimates(problem, solution)
    misfits = (f"{name} {1e3 * rms:.2f}" for name, rms in solution.rms_by_experiment_m.items())
    print("RMS [mm]:", ", ".join(misfits))
    delays_s, log_lags = pressure_timing(solution)
    print(
        "delay [ms]:",
        np.round(1e3 * delays_s, 1),
        "lag [ms]:",
        timing_text(fitted_recordings, log_lags),
    )
    columns = f"{'measured':>10}{'predicted':>11}{'error':>8}{'% of travel':>13}{'RMS':>7}"
    print(f"\n{'[mm]':9}{columns}{'polynomial':>12}")
    for experiment in problem.experiments:
        measured_m = measured_tip(experiment)
        polynomial_m = polynomial_position(fitted_recordings, pressure_mbar(experiment))
        without_model_mm = 1e3 * np.linalg.norm(polynomial_m - final_position(measured_m))
        try:
            error = travel_error(experiment, solution, delays_s.mean(), log_lags.mean())
        except SimulationError as failure:
            print(f"{experiment.name:9}{1e3 * final_travel(measured_m):10.2f} fails: {failure}")
            print(f"{'':9}polynomial {without_model_mm:.2f}", flush=True)
            continue
        print(
            f"{experiment.name:9}{1e3 * error.measured_m:10.2f}{1e3 * error.predicted_m:11.2f}"
            f"{1e3 * error.final_m:8.2f}{100 * error.final_m / error.measured_m:13.1f}"
            f"{1e3 * error.rms_m:7.2f}{without_model_mm:12.2f}",
            flush=True,
        )
    return solution


def variant_of_problem(variant: str) -> Problem:
    """Return the shipped problem with one assumption changed, and with the largest pressure."""
    file = FOLDER / "problem.toml"
    with tempfile.TemporaryDirectory() as folder:
        keys = []
        if variant in WALLS_M:
            mesh = Path(folder) / "arm.vtu"
            arm_mesh(ArmShape(wall_m=WALLS_M[variant])).write(mesh)
            keys.append(f"object.mesh={mesh}")
        problem = Problem.read(file, keys, allow_code=True)
        largest = Problem.read(file, [*keys, *LARGEST], allow_code=True).experiments[-1]
    return replace(problem, experiments=[*problem.experiments, replace(largest, name="450mbar")])


# Estimates --------------------------------------------------------------------------------------


def print_estimates(problem: Problem, solution: Solution) -> None:
    """Print the estimated parameters with their statistical intervals."""
    uncertainty: Uncertainty = uncertainty_at(solution.collocation, solution.z)
    for item in problem.parameters.scalars:
        if item.is_fixed:
            continue
        estimate = uncertainty.estimates[item.name]
        interval = estimate.statistical95
        text = "not determined" if interval is None else f"{interval[0]:.4g} to {interval[1]:.4g}"
        print(f"{item.name:16}{estimate.value:12.5g}   {text}")


def pressure_timing(solution: Solution) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return delay of the markers [s] and logarithm of the lag over the stated lag, one for each
    fitted recording.
    """
    delays_s = []
    log_lags = []
    for part in solution.collocation.iterates(solution.z):
        for entry, _, value in part.transcription.nuisance.iterate_values(part.phi):
            if entry.row.name == "time_shift_s":
                delays_s.append(value)
            if entry.row.name == "pressure_lag":
                log_lags.append(value)
    return np.array(delays_s), np.array(log_lags)


def timing_text(
    fitted_recordings: Sequence[Experiment], log_lags: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the lags of the fitted recordings [ms], rounded."""
    stated_lags_s = np.array([each.pressures[0].lag_s for each in fitted_recordings])
    return np.round(1e3 * stated_lags_s * np.exp(log_lags), 1)


# Motion of the tip ------------------------------------------------------------------------------


def travel_error(
    experiment: Experiment, solution: Solution, delay_s: float, log_lag: float
) -> TravelError:
    """Compare a recording with a simulation at the estimates, for a delay and a lag."""
    (pressure,) = experiment.pressures
    assert pressure.t_s is not None
    shifted_pressure = replace(
        pressure,
        t_s=pressure.t_s - delay_s,
        lag_s=pressure.lag_s * float(np.exp(log_lag)),
        body_measure=None,
    )
    single_recording = replace(
        experiment, pressures=[shifted_pressure], nuisance=Nuisance.none(), validation=False
    )
    simulated = simulate(single_recording, solution.parameters, "midpoint", substeps=1).markers_m
    predicted_m = tip_motion(simulated)
    measured_m = measured_tip(experiment)
    distance_m = np.linalg.norm(predicted_m - measured_m, axis=1)
    return TravelError(
        measured_m=final_travel(measured_m),
        predicted_m=final_travel(predicted_m),
        final_m=float(np.linalg.norm(final_position(predicted_m) - final_position(measured_m))),
        rms_m=float(np.sqrt(np.mean(distance_m**2))),
    )


def tip_motion(markers_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the motion (T, 2) of the mean of markers (T, M, 3) in the plane of symmetry, from its
    first position.
    """
    middle_m = markers_m.mean(axis=1)[:, [0, 2]]
    return middle_m - middle_m[0]


def measured_tip(experiment: Experiment) -> NDArray[np.float64]:
    """Return the measured motion (T, 2) of the tip."""
    assert experiment.markers is not None
    return tip_motion(experiment.markers.positions_m)


def final_position(motion_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean (2,) of a motion over its last FINAL_S, at 100 Hz."""
    return motion_m[-round(100 * FINAL_S) :].mean(axis=0)


def final_travel(motion_m: NDArray[np.float64]) -> float:
    """Return the distance of the final position from the first one."""
    return float(np.linalg.norm(final_position(motion_m)))


def pressure_mbar(experiment: Experiment) -> float:
    """Return the pressure of a recording after the step."""
    return float(experiment.pressures[0].pressure_pa[-1]) / 100


def polynomial_position(
    fitted_recordings: Sequence[Experiment], mbar: float
) -> NDArray[np.float64]:
    """Return the final position (2,) by a polynomial of the pressure, zero at zero, through the
    fitted recordings: a prediction without a model.
    """
    known_m = np.array([final_position(measured_tip(each)) for each in fitted_recordings])
    powers = np.arange(1, len(fitted_recordings) + 1)
    known_mbar = np.array([pressure_mbar(each) for each in fitted_recordings])
    coefficients = np.linalg.solve(known_mbar[:, None] ** powers, known_m)
    return float(mbar) ** powers @ coefficients


if __name__ == "__main__":
    main()
