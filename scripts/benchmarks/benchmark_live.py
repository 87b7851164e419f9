"""Latency of live estimates, and their difference from the answer of the batch.

Streams table1 (171 nodes, with noise of sigma_m) and foam_cylinder at 100 Hz. Times are processor
times of this process, which other work on the machine changes little; they are compared with the
time of one row in a sweep over the complete recording.

    python scripts benchmark_live
    python scripts benchmark_live --frames 360000 --problem block --rows 1   # an hour
    python scripts benchmark_live --recorded 60000 --budget-ms 8   # ten minutes, then the batch
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
from twins import SOFT, twin

from collocation_sysid.extras.live import Frame, LiveEstimator, LiveOptions
from collocation_sysid.extras.live.sources import frames_of_recording, without_garbage_of_startup
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.pipeline import run, solve
from collocation_sysid.problem import Problem
from collocation_sysid.statistics.curved_intervals import uncertainty_at

PROBLEMS = Path(__file__).parents[2] / "problems"
# Standard deviation of the noise that is added to the tracks [m]; foam_cylinder has noise already.
NOISE_M = {"table1": 1e-3, "foam_cylinder": 0.0}
TRUTH = {
    "table1": {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0},
    "foam_cylinder": {"lambda_pa": 800.0, "mu_pa": 600.0, "gamma_r_s": 0.006, "gamma_m_1_s": 1.5},
    "block": SOFT,
}
# Time at which the errors of the estimates are printed [s].
EARLY_S = 0.3
# Time between frames at 100 Hz [s].
FRAME_S = 0.01
# Number of sweeps, of which the shortest counts.
TIMED_SWEEPS = 5


def main() -> None:
    """Stream the problems that the command line names, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problem", choices=[*TRUTH], action="append")
    parser.add_argument(
        "--rows",
        type=int,
        help="rows that are linearised again with each frame, in place of a time budget",
    )
    parser.add_argument("--budget-ms", type=float)
    parser.add_argument(
        "--frames", type=int, help="stream the recording to and fro for this number of frames"
    )
    parser.add_argument(
        "--recorded",
        type=int,
        help="number of samples of a block that moves at random; compare with the batch",
    )
    arguments = parser.parse_args()
    budget_s = None if arguments.budget_ms is None else 1e-3 * arguments.budget_ms
    options = LiveOptions(budget_s=budget_s, rows=arguments.rows)
    if arguments.recorded:
        compare_long_recording(arguments.recorded, options)
        return
    for name in arguments.problem or NOISE_M:
        problem = noisy_problem(name)
        live = LiveEstimator(problem, options, time.thread_time)
        frames = list(frames_of_recording(problem.experiments[0], live.model))
        if arguments.frames:
            stream_repeatedly(name, live, frames, arguments.frames)
        else:
            print_comparison(name, problem, live, frames)


def noisy_problem(name: str) -> Problem:
    """Return a problem of `TRUTH` with the noise of `NOISE_M`."""
    if name == "block":
        return twin(name, SOFT, seed=0, samples=101, integrator="midpoint")
    problem = Problem.read(PROBLEMS / name / "problem.toml")
    (experiment,) = problem.experiments
    tracks = experiment.markers.positions_m
    noise = np.random.default_rng(0).normal(scale=NOISE_M[name] or 1.0, size=tracks.shape)
    tracks = tracks + noise * bool(NOISE_M[name])
    noisy_recording = replace(experiment, markers=replace(experiment.markers, positions_m=tracks))
    return Problem(
        [noisy_recording], problem.parameters, scheme=problem.scheme, substeps=problem.substeps
    )


def print_comparison(name: str, problem: Problem, live: LiveEstimator, frames: list[Frame]) -> None:
    """Stream a recording, solve it as a batch, and print latencies and differences of the
    estimates.
    """
    latencies_s = []
    relinearised_rows = []
    with without_garbage_of_startup():
        for frame in frames:
            update = live.process_frame(frame)
            latencies_s.append(update.latency_s)
            relinearised_rows.append(update.relinearised)
            if abs(frame.t_s - EARLY_S) < 1e-6:
                early = update
    settled = live.finish() or update
    row_s = row_time_s(problem)
    median, upper = 1e3 * np.percentile(latencies_s, [50, 99])
    print(
        f"{name}: {len(frames)} frames of {live.model.collocation.substeps} rows, "
        f"{np.mean(relinearised_rows):.1f} rows linearised again per frame"
    )
    print(
        f"    median {median:.2f} ms, 99 % below {upper:.2f} ms, first {1e3 * latencies_s[0]:.2f} ms"
    )
    print(
        f"    a row in a sweep of the batch {1e3 * row_s:.2f} ms; "
        f"median latency over this time {1e-3 * median / row_s:.1f}"
    )
    solution = solve(problem, ReducedSpace())
    batch = uncertainty_at(solution.collocation, solution.z).estimates
    # The result after the last frame may have finer steps than the frames, as that of a run.
    complete = run(problem, seek_causes=False).estimates
    for key, true_value in TRUTH[name].items():
        live_estimate = update.estimates[key]
        batch_estimate = batch[key]
        difference, settled_difference = (
            abs(each.value - reference.value) / (reference.statistical_std_error or np.nan)
            for each, reference in (
                (live_estimate, batch_estimate),
                (settled.estimates[key], complete[key]),
            )
        )
        error_percent = 100 * (early.estimates[key].value / true_value - 1)
        error = batch_estimate.statistical_std_error or np.nan
        print(
            f"    {key}: {live_estimate.value:.5g}, batch {batch_estimate.value:.5g} ± {error:.2g}: "
            f"difference {difference:.3f} standard errors, at the end "
            f"from a complete run {settled_difference:.3f}; "
            f"error {error_percent:+.1f} % at {EARLY_S:g} s"
        )
    print(f"    verdict: {update.trust.verdict} {update.trust.reasons}")
    print(f"    settled in {1e3 * settled.latency_s:.0f} ms: {settled.trust.verdict}")


def row_time_s(problem: Problem) -> float:
    """Return the processor time of a row in a sweep over the complete recording [s]."""
    collocation = problem.collocation()
    rows = collocation.transcriptions[0].grid_times
    horizon = Horizon(collocation, [rows])
    times_s = []
    x, _ = horizon.simulate(collocation.guess_p)
    for _ in range(TIMED_SWEEPS):
        began = time.thread_time()
        horizon.evaluate(collocation.guess_p, x)
        times_s.append((time.thread_time() - began) / rows)
    return min(times_s)


def _frames_to_and_fro(frames: list[Frame]) -> Iterator[Frame]:
    """Yield the frames forward and backward without end, with increasing times."""
    there_and_back = [*frames, *frames[-2:0:-1]]
    interval_s = frames[1].t_s - frames[0].t_s
    for k in count():
        yield replace(there_and_back[k % len(there_and_back)], t_s=k * interval_s)


def stream_repeatedly(
    name: str, live: LiveEstimator, frames: list[Frame], frame_count: int
) -> None:
    """Stream the recording to and fro, and print the memory; estimates have no meaning here.

    `frame_count` is the number of frames.
    """
    for k, frame in zip(range(frame_count), _frames_to_and_fro(frames), strict=False):
        live.process_frame(frame)
        if k in (999, frame_count - 1) or (k + 1) % max(1, frame_count // 10) == 0:
            used_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(
                f"{name}: {k + 1} frames, {len(live.log)} rows kept, peak memory {used_mb:.0f} MB"
            )


def compare_long_recording(samples: int, options: LiveOptions) -> None:
    """Stream a long recording, then solve it as a batch, and print latency, memory and differences.

    The block moves at random from beginning to end, so that all frames contain information, and is
    simulated with the scheme and the steps of the estimator. The recording and its frames exist
    before the first frame; the growth of memory from frame 1,000 to the last is that of the
    estimator.

    Parameters
    ----------
    samples : int
        Camera frames at 100 Hz, above 1,000.
    options : LiveOptions
    """
    short_estimator = LiveEstimator(twin("block", SOFT, seed=0), options)
    problem = twin(
        "block",
        SOFT,
        seed=0,
        samples=samples,
        integrator="midpoint",
        substeps=short_estimator.model.collocation.substeps,
    )
    live = LiveEstimator(problem, options, time.thread_time)
    frames = list(frames_of_recording(problem.experiments[0], live.model))
    latencies_s = np.zeros(len(frames))
    with without_garbage_of_startup():
        for k, frame in enumerate(frames):
            update = live.process_frame(frame)
            latencies_s[k] = update.latency_s
            if k in (999, len(frames) - 1):
                print(f"block: {k + 1} frames, {peak_memory_mb():.0f} MB")
    median_ms, upper_ms, worst_ms = 1e3 * np.percentile(latencies_s, [50, 99, 100])
    print(
        f"    median {median_ms:.2f} ms, 99 % below {upper_ms:.2f} ms, longest {worst_ms:.2f} ms; "
        f"{100 * np.mean(latencies_s < FRAME_S):.2f} % within {1e3 * FRAME_S:g} ms"
    )
    began_s = time.process_time()
    batch_problem = replace(problem, substeps=live.model.collocation.substeps)
    solution = solve(batch_problem, ReducedSpace())
    print(
        f"    batch: {len(solution.history)} sweeps, {time.process_time() - began_s:.0f} s, "
        f"{peak_memory_mb():.0f} MB"
    )
    batch = uncertainty_at(solution.collocation, solution.z).estimates
    for key, true_value in SOFT.items():
        live_estimate = update.estimates[key]
        batch_estimate = batch[key]
        error = batch_estimate.statistical_std_error or np.nan
        print(
            f"    {key}: live {live_estimate.value:.6g} "
            f"± {live_estimate.statistical_std_error or np.nan:.2g}, "
            f"batch {batch_estimate.value:.6g} ± {error:.2g}, truth {true_value:g}: "
            f"{abs(live_estimate.value - batch_estimate.value) / error:.2f} standard errors of difference"
        )
    print(f"    verdict: {update.trust.verdict} {update.trust.reasons}")


def peak_memory_mb() -> float:
    """Return the largest memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
