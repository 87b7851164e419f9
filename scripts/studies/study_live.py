"""Coverage of the intervals of live estimates while a recording is made.

Twins of a small block are moved at random and simulated with the scheme of the estimator, so that
the noise of 0.5 mm is the only error. They are streamed frame by frame, starting from the guess.
With each frame a fixed number of rows is linearised again, so that the load of the machine changes
the times only, not the estimates.

    python scripts study_live                       # 200 twins
    python scripts study_live --twins 20 --rows 6 --batch 5
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np
from twins import SOFT, twin

from collocation_sysid.extras.live import LiveEstimator, LiveOptions, LiveUpdate
from collocation_sysid.extras.live.sources import frames_of_recording
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.pipeline import solve
from collocation_sysid.problem import Problem
from collocation_sysid.statistics.curved_intervals import uncertainty_at

# Number of samples at intervals of 10 ms.
SAMPLES = 101
# Times at which intervals and verdicts are counted [s]; the motion rises from 0 s on.
EVALUATED_S = (0.25, 0.5, 1.0)
# Time at which the errors of the estimates are counted [s], and the relative error that is small
# enough.
EARLY_S = 0.3
CLOSE_SHARE = 0.1
# Number of twins after which the counts are printed.
TWINS_PER_PRINT = 10


class LiveCounts:
    """Counts of intervals that contain the true value, verdicts, errors and latencies of all twins."""

    def __init__(self) -> None:
        self.contains_truth: Counter[tuple[float, str]] = Counter()
        self.has_interval: Counter[tuple[float, str]] = Counter()
        self.verdicts: Counter[tuple[float, str]] = Counter()
        self.errors: list[list[float]] = []
        self.batch_differences: list[float] = []
        self.latency_s: list[float] = []

    def stream(self, problem: Problem, rows: int, batch: bool) -> None:
        """Stream a twin to a new estimator, and add its results to the counts.

        Parameters
        ----------
        problem : Problem
            The twin.
        rows : int
            Rows that are linearised again with each frame.
        batch : bool
            Whether the twin is also solved as a whole, to compare the last live estimate.
        """
        live = LiveEstimator(problem, LiveOptions(rows=rows), time.thread_time)
        for frame in frames_of_recording(problem.experiments[0], live.model):
            update = live.process_frame(frame)
            self.latency_s.append(update.latency_s)
            for time_s in EVALUATED_S:
                if abs(frame.t_s - time_s) < 1e-6:
                    self._count(time_s, update)
            if abs(frame.t_s - EARLY_S) < 1e-6:
                estimates = update.estimates
                self.errors.append([abs(estimates[n].value / SOFT[n] - 1) for n in SOFT])
        if batch:
            solution = solve(problem, ReducedSpace())
            batch_estimates = uncertainty_at(solution.collocation, solution.z).estimates
            self.batch_differences += [
                abs(update.estimates[n].value - batch_estimates[n].value)
                / (batch_estimates[n].statistical_std_error or np.inf)
                for n in SOFT
            ]

    def _count(self, time_s: float, update: LiveUpdate) -> None:
        self.verdicts[time_s, update.trust.verdict] += 1
        for name, estimate in update.estimates.items():
            if estimate.statistical95 is not None:
                low, high = estimate.statistical95
                self.has_interval[time_s, name] += 1
                self.contains_truth[time_s, name] += low <= SOFT[name] <= high

    def show(self) -> None:
        """Print the coverage at each time, errors and latencies."""
        print(f"{len(self.errors)} twins")
        for time_s in EVALUATED_S:
            shares = (
                f"{n} {self.contains_truth[time_s, n] / max(1, self.has_interval[time_s, n]):.3f}"
                for n in SOFT
            )
            covered, intervals = (
                sum(each[time_s, n] for n in SOFT)
                for each in (self.contains_truth, self.has_interval)
            )
            print(
                f"coverage at {time_s:g} s: {', '.join(shares)}; "
                f"all parameters {covered / max(1, intervals):.3f} of {intervals} intervals"
            )
            verdict_counts = (
                f"{v} {self.verdicts[time_s, v]}" for v in ("good", "check", "doubtful")
            )
            print(f"    verdicts: {', '.join(verdict_counts)}")
        close_shares = np.mean(np.array(self.errors) <= CLOSE_SHARE, axis=0)
        shares = (f"{n} {share:.2f}" for n, share in zip(SOFT, close_shares, strict=True))
        print(
            f"share of twins with an error of at most {CLOSE_SHARE:.0%} at {EARLY_S:g} s: {', '.join(shares)}"
        )
        median, upper = 1e3 * np.percentile(self.latency_s, [50, 99])
        print(f"processor time per frame: median {median:.2f} ms, 99 % below {upper:.2f} ms")
        if self.batch_differences:
            print(
                "largest difference from the batch solution, in standard errors: "
                f"{max(self.batch_differences):.3f}"
            )


def main() -> None:
    """Stream the twins, and print the counts after every ten twins."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first twin")
    parser.add_argument("--body", default="block")
    parser.add_argument(
        "--rows", type=int, default=6, help="rows that are linearised again with each frame"
    )
    parser.add_argument(
        "--batch", type=int, default=0, help="number of twins that are also solved as a whole"
    )
    arguments = parser.parse_args()
    counts = LiveCounts()
    for number in range(arguments.twins):
        problem = twin(arguments.body, SOFT, arguments.first + number, SAMPLES, "midpoint")
        counts.stream(problem, arguments.rows, number < arguments.batch)
        if (number + 1) % TWINS_PER_PRINT == 0 or number + 1 == arguments.twins:
            counts.show()


if __name__ == "__main__":
    main()
