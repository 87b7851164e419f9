"""Table of mistakes in descriptions and data: what `check` reports, and what `solve` reports.

Every mistake of `wrong_twins` is made in a right problem: in twins of two small bodies seen by
markers, in twins that also have a force sensor, and, of obstacles, in two shipped problems. Right
problems of several seeds stand first: a report there is a false alarm.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from twins import BODIES, SOFT, sensing_twin, twin
from wrong_twins import (
    FAULTS,
    OBSTACLE_FAULTS,
    TRACK_FAULTS,
    WRENCH_FAULTS,
    Fault,
)

from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.pipeline import run
from collocation_sysid.problem import Problem
from collocation_sysid.runs.check import misspecification_hypotheses
from collocation_sysid.statistics.misspecification.misspecification_hypothesis import (
    rank,
)
from collocation_sysid.statistics.misspecification.wrench_causes import (
    wrench_mistakes,
)

PROBLEMS = Path(__file__).parents[1] / "problems"
# Of the twelve places of the poked block two are enough.
PLACES = 2
RIGHT = "none"
NOTHING = Fault(lambda experiment, rng: experiment, ())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--body", choices=list(BODIES), default="bar")
    parser.add_argument("--samples", type=int, default=40)
    parser.add_argument(
        "--seeds", type=int, default=5, help="of right problems"
    )
    parser.add_argument(
        "--only", default="", help="mistakes whose name contains this"
    )
    parser.add_argument(
        "--check-only", action="store_true", help="leave out what solve reports"
    )
    given = parser.parse_args()
    began, counts = time.perf_counter(), [0, 0, 0]
    print(
        _line(["mistake", "`check`", "`solve`"]),
        _line(["---"] * 3),
        sep="\n",
        flush=True,
    )
    for name, fault, problem in cases(given.body, given.samples, given.seeds):
        if given.only not in name:
            continue
        rng = np.random.default_rng(3)
        try:
            wrong = fault(problem, rng)
            checked = named(found := checked_causes(wrong))
        except (InputError, SimulationError) as error:
            found, checked = (), f"refused: {error}"
        right = name.startswith(RIGHT)
        counts[0] += not right
        counts[1] += not right and (
            bool(found) or checked.startswith("refused")
        )
        counts[2] += right and bool(found)
        solved = "" if given.check_only else solved_report(wrong)
        print(_line([name, checked, solved]), flush=True)
    of = f"{counts[1]} of {counts[0]} mistakes reported by check, {counts[2]} false alarms"
    print(f"\n{of}; {time.perf_counter() - began:.0f} s")


def cases(
    body: str, samples: int, seeds: int
) -> Iterator[tuple[str, Fault, Problem]]:
    """Yield every mistake with a right problem to make it in."""
    for seed in range(1, seeds + 1):
        yield f"{RIGHT}, seed {seed}", NOTHING, twin(body, SOFT, seed, samples)
        yield (
            f"{RIGHT}, with a sensor, seed {seed}",
            NOTHING,
            sensing_twin(body, SOFT, seed, samples),
        )
    seen, felt = (
        twin(body, SOFT, 1, samples),
        sensing_twin(body, SOFT, 1, samples),
    )
    yield from (
        (name, fault, seen)
        for name, fault in {**FAULTS, **TRACK_FAULTS}.items()
    )
    yield from ((name, fault, felt) for name, fault in WRENCH_FAULTS.items())
    laid = Problem.read(PROBLEMS / "laid_block" / "problem.toml")
    poked = Problem.read(PROBLEMS / "poked_block" / "problem.toml")
    poked = replace(poked, experiments=poked.experiments[:PLACES])
    for problem in (laid, poked):
        yield f"{RIGHT}, {problem.title}", NOTHING, problem
    yield (
        "obstacle: normal reversed",
        OBSTACLE_FAULTS["obstacle: normal reversed"],
        laid,
    )
    yield (
        "obstacle: load reversed",
        OBSTACLE_FAULTS["obstacle: load reversed"],
        poked,
    )


def checked_causes(problem: Problem) -> tuple:
    """Return the causes that `check` lists."""
    causes = misspecification_hypotheses(problem)
    return causes or rank(wrench_mistakes(problem.collocation()))


def solved_report(problem: Problem) -> str:
    """Return the verdict of `solve` and the likely causes that it names."""
    try:
        answer = run(problem)
    except (InputError, SimulationError) as error:
        return f"refused: {error}"
    causes = (
        named(answer.causes) if answer.causes else answer.solution.status.value
    )
    return f"{answer.trust.verdict}: {causes}"


def named(causes: Sequence) -> str:
    """Return the likeliest causes with the factors by which the misfit falls without them."""
    shown = (f"{each.code} ({each.strength:.2g})" for each in causes[:2])
    return ", ".join(shown) or "nothing"


def _line(cells: Sequence[str]) -> str:
    return (
        "| "
        + " | ".join(" ".join(cell.split()).replace("|", "/") for cell in cells)
        + " |"
    )


if __name__ == "__main__":
    sys.exit(main())
