"""Coverage of the intervals of live estimates while a recording is made.

Twins of a small block are moved at random and simulated with the scheme of the estimator, so that
the noise of 0.5 mm is the only error. They are streamed frame by frame, starting from the guess. With
each frame a fixed number of rows is linearised again, so that the load of the machine changes the
times only, not the estimates.

    python scripts/study_live.py                       # 200 twins
    python scripts/study_live.py --twins 20 --rows 6 --batch 5
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
from collocation_sysid.statistics.uncertainty import uncertainty_at

SAMPLES = 101
# Frames come from 0 s on; the motion rises from there.
LOOKED_AT_S = (0.25, 0.5, 1.0)
EARLY_S = 0.3
NEAR = 0.1
SHOWN_EVERY = 10


class Tally:
    """Counts of intervals that contain the true value, verdicts, errors and latencies of all twins."""

    def __init__(self) -> None:
        self.held: Counter[tuple[float, str]] = Counter()
        self.told: Counter[tuple[float, str]] = Counter()
        self.verdicts: Counter[tuple[float, str]] = Counter()
        self.errors: list[list[float]] = []
        self.apart: list[float] = []
        self.latency_s: list[float] = []

    def stream(self, problem: Problem, rows: int, batch: bool) -> None:
        """Stream a twin to a new estimator, and add its results to the counts."""
        live = LiveEstimator(problem, LiveOptions(rows=rows), time.thread_time)
        for frame in frames_of_recording(problem.experiments[0], live.model):
            update = live.process_frame(frame)
            self.latency_s.append(update.latency_s)
            for at_s in LOOKED_AT_S:
                if abs(frame.t_s - at_s) < 1e-6:
                    self._count(at_s, update)
            if abs(frame.t_s - EARLY_S) < 1e-6:
                found = update.estimates
                self.errors.append(
                    [abs(found[n].value / SOFT[n] - 1) for n in SOFT]
                )
        if batch:
            solution = solve(problem, ReducedSpace())
            known = uncertainty_at(solution.collocation, solution.z).estimates
            self.apart += [
                abs(update.estimates[n].value - known[n].value)
                / (known[n].statistical_std_error or np.inf)
                for n in SOFT
            ]

    def _count(self, at_s: float, update: LiveUpdate) -> None:
        self.verdicts[at_s, update.trust.verdict] += 1
        for name, estimate in update.estimates.items():
            if estimate.statistical95 is not None:
                low, high = estimate.statistical95
                self.told[at_s, name] += 1
                self.held[at_s, name] += low <= SOFT[name] <= high

    def show(self) -> None:
        """Print the coverage at each time, errors and latencies."""
        print(f"{len(self.errors)} twins")
        for at_s in LOOKED_AT_S:
            shares = (
                f"{n} {self.held[at_s, n] / max(1, self.told[at_s, n]):.3f}"
                for n in SOFT
            )
            held, told = (
                sum(each[at_s, n] for n in SOFT)
                for each in (self.held, self.told)
            )
            print(
                f"t = {at_s:g} s: {', '.join(shares)}; all {held / max(1, told):.3f} of {told}"
            )
            said = (
                f"{v} {self.verdicts[at_s, v]}"
                for v in ("good", "check", "doubtful")
            )
            print(f"    verdicts: {', '.join(said)}")
        near = np.mean(np.array(self.errors) <= NEAR, axis=0)
        shares = (
            f"{n} {share:.2f}" for n, share in zip(SOFT, near, strict=True)
        )
        print(
            f"within {NEAR:.0%} of the truth after {EARLY_S:g} s: {', '.join(shares)}"
        )
        median, late = 1e3 * np.percentile(self.latency_s, [50, 99])
        print(
            f"processor time of a frame: median {median:.2f} ms, 99 % below {late:.2f} ms"
        )
        if self.apart:
            print(
                f"from the batch's answer in its standard errors: largest {max(self.apart):.3f}"
            )


def main() -> None:
    """Stream the twins and print a table now and then."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=200)
    parser.add_argument(
        "--first", type=int, default=0, help="seed of the first"
    )
    parser.add_argument("--body", default="block")
    parser.add_argument(
        "--rows", type=int, default=6, help="passed again with each frame"
    )
    parser.add_argument(
        "--batch", type=int, default=0, help="so many are solved as a whole too"
    )
    arguments = parser.parse_args()
    tally = Tally()
    for number in range(arguments.twins):
        problem = twin(
            arguments.body, SOFT, arguments.first + number, SAMPLES, "midpoint"
        )
        tally.stream(problem, arguments.rows, number < arguments.batch)
        if (number + 1) % SHOWN_EVERY == 0 or number + 1 == arguments.twins:
            tally.show()


if __name__ == "__main__":
    main()
