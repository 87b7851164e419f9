"""Mistakes in descriptions and data: table of the reports of `check` and `solve`.

Every mistake is made in a correct problem: in twins of a soft bar with markers (`twins`), also with
a force sensor, in twins with depth images (`depth_twins`), in twins that ordinary cameras film
(`filmed_twins`), and in twins with an obstacle (`contact_twins`). Correct problems of several seeds
stand first: a report there is a false alarm.

    python scripts study_mistakes [--groups tracks wrench depth video obstacle] [--only NAME]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import contact_twins
import depth_twins
import filmed_twins
import numpy as np
import record
from script_arguments import make_parser
from twins import BODIES, SOFT, STIFF, sensing_twin, twin
from wrong_cameras import DEPTH_FAULTS, MOVING_FAULTS
from wrong_obstacles import PLATE_FAULTS, POKING_FAULTS
from wrong_twins import FAULTS, TRACK_FAULTS, WRENCH_FAULTS, Fault
from wrong_videos import PAIR_FAULTS, PLACE_FAULTS, VIDEO_FAULTS

from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.pipeline import run
from collocation_sysid.problem import Problem
from collocation_sysid.runs.check import misspecification_hypotheses
from collocation_sysid.statistics.hypothesis import Hypothesis

# Seed of the random choices of a mistake, such as which markers are exchanged.
FAULT_SEED = 3
# Seed of the correct problem in which mistakes are made.
PROBLEM_SEED = 1
# Number of causes that a cell shows.
SHOWN_CAUSES = 2


@dataclass(frozen=True)
class ProblemFamily:
    """Correct problems of one kind, and the mistakes that are made in them."""

    # The group that `--groups` selects, and the name of the kind.
    group: str
    name: str
    make: Callable[[int], Problem]  # returns the correct problem of a seed
    faults: Mapping[str, Fault]
    parameter: str  # estimated parameter that is compared with the truth
    truth: float


@dataclass(frozen=True)
class MistakeRow:
    """One row of the table."""

    name: str
    # Reports of `check` and of `solve`; the second is empty if the problem was not solved.
    checked: str
    solved: str
    is_correct: bool
    is_reported: bool  # whether `check` names a cause, or refuses the problem
    is_good: bool  # whether `solve` rates the answer "good"
    right: tuple[str, ...]  # right causes
    named: tuple[str, ...]  # codes that `check` and `solve` name first


@dataclass(frozen=True)
class SolveReport:
    """Verdict of `solve` and its reasons as text, and whether the verdict is "good"."""

    text: str
    is_good: bool
    named: tuple[str, ...] = ()  # code that is named first


def main() -> None:
    options = _options()
    began_s = time.perf_counter()
    print(_line(["mistake", "`check`", "`solve`"]), _line(["---"] * 3), sep="\n")
    rows = []
    for row in table_rows(
        families(options.samples),
        groups=options.groups,
        seeds=options.seeds,
        only=options.only,
        is_solved=not options.check_only,
    ):
        print(_line([row.name, row.checked, row.solved]), flush=True)
        if options.json:
            record.append(options.json, row.name, row.right, row.named)
        rows.append(row)
    print(f"\n{summary(rows)}; {time.perf_counter() - began_s:.0f} s")


def _options() -> argparse.Namespace:
    """Return the options of the command line."""
    parser = make_parser(__doc__)
    groups = ["tracks", "wrench", "depth", "video", "obstacle"]
    parser.add_argument("--groups", nargs="+", choices=groups, default=groups)
    parser.add_argument("--samples", type=int, default=40)
    parser.add_argument(
        "--seeds", type=int, default=5, help="number of correct problems of each kind"
    )
    parser.add_argument("--only", default="", help="rows whose name contains this")
    parser.add_argument("--json", type=Path, help="file of results for the record of codes")
    parser.add_argument("--check-only", action="store_true", help="do not solve")
    return parser.parse_args()


def families(samples: int) -> list[ProblemFamily]:
    """Return all kinds of problems; the argument is the number of samples of those with markers."""
    bar_pa = depth_twins.TRUTH["young_pa"]
    block_pa = contact_twins.TRUTH["young_pa"]
    return [
        *(
            ProblemFamily(
                group,
                f"{kind}, {body}",
                partial(make, body, SOFT, samples=samples),
                {name if body == "bar" else f"{name} ({body})": fault for name, fault in faults},
                "mu_pa",
                SOFT["mu_pa"],
            )
            for group, kind, make, faults in (
                ("tracks", "markers", twin, {**FAULTS, **TRACK_FAULTS}.items()),
                ("wrench", "markers and sensor", sensing_twin, WRENCH_FAULTS.items()),
            )
            for body in BODIES
        ),
        ProblemFamily(
            "tracks",
            "markers, stiff bar",
            partial(twin, "bar", STIFF, samples=samples),
            {f"{name} (stiff)": fault for name, fault in FAULTS.items() if "clock" in name},
            "mu_pa",
            STIFF["mu_pa"],
        ),
        ProblemFamily(
            "depth", "one depth image", depth_twins.hanging_twin, DEPTH_FAULTS, "young_pa", bar_pa
        ),
        ProblemFamily(
            "depth",
            "depth images of a motion",
            depth_twins.swinging_twin,
            MOVING_FAULTS,
            "young_pa",
            bar_pa,
        ),
        ProblemFamily(
            "video",
            "video, known places",
            filmed_twins.filmed_twin,
            {**VIDEO_FAULTS, **PLACE_FAULTS},
            "young_pa",
            filmed_twins.TRUTH["young_pa"],
        ),
        ProblemFamily(
            "video",
            "video, unknown places",
            lambda seed: filmed_twins.filmed_twin(seed, are_places_known=False),
            {f"{name}, places unknown": fault for name, fault in VIDEO_FAULTS.items()},
            "young_pa",
            filmed_twins.TRUTH["young_pa"],
        ),
        ProblemFamily(
            "video",
            "two videos",
            lambda seed: filmed_twins.filmed_twin(seed, cameras=("front", "top")),
            PAIR_FAULTS,
            "young_pa",
            filmed_twins.TRUTH["young_pa"],
        ),
        ProblemFamily(
            "obstacle", "indentation", contact_twins.poked_twin, POKING_FAULTS, "young_pa", block_pa
        ),
        ProblemFamily(
            "obstacle",
            "block on a plate",
            contact_twins.sheared_twin,
            PLATE_FAULTS,
            "young_pa",
            block_pa,
        ),
    ]


def table_rows(
    kinds: Sequence[ProblemFamily], *, groups: Sequence[str], seeds: int, only: str, is_solved: bool
) -> Iterator[MistakeRow]:
    """Yield the rows of all correct problems, then those of all mistakes."""
    chosen = [family for family in kinds if family.group in groups]
    for family in chosen:
        for seed in range(1, seeds + 1):
            name = f"none: {family.name}, seed {seed}"
            if only in name:
                yield table_row(name, family, None, seed, is_solved=is_solved)
    for family in chosen:
        for name, fault in family.faults.items():
            if only in name:
                yield table_row(name, family, fault, PROBLEM_SEED, is_solved=is_solved)


def table_row(
    name: str, family: ProblemFamily, fault: Fault | None, seed: int, *, is_solved: bool
) -> MistakeRow:
    """Return the row of a problem with a mistake, or without one (None)."""
    described: Problem | None = None
    causes: tuple[Hypothesis, ...] = ()
    refusal = ""
    try:
        correct = family.make(seed)
        described = correct if fault is None else fault(correct, np.random.default_rng(FAULT_SEED))
        causes = misspecification_hypotheses(described)
    except (InputError, SimulationError) as error:
        refusal = f"refused: {error}"
    report = SolveReport("", False)
    if is_solved:
        # A description that cannot be built is refused by a solve too.
        report = (
            SolveReport(refusal, False) if described is None else solve_report(described, family)
        )
    return MistakeRow(
        name,
        refusal or causes_text(causes),
        solved=report.text,
        is_correct=fault is None,
        is_reported=bool(causes) or bool(refusal),
        is_good=report.is_good,
        right=() if fault is None else fault.causes,
        named=(*(each.code for each in causes[:1]), *report.named),
    )


def solve_report(problem: Problem, family: ProblemFamily) -> SolveReport:
    """Return the verdict of `solve` with the likely causes that it names, or with the status of
    the search; a "good" one also with the estimate over the truth.
    """
    try:
        answer = run(problem)
    except (InputError, SimulationError) as error:
        return SolveReport(f"refused: {error}", False)
    status = answer.solution.status.value
    reason = causes_text(answer.causes) if answer.causes else status
    verdict = answer.trust.verdict
    named = tuple(each.code for each in answer.causes[:1])
    if verdict != "good":
        return SolveReport(f"{verdict}: {reason}", False, named)
    ratio = answer.estimates[family.parameter].value / family.truth
    text = f"{verdict}: {reason}, {family.parameter} {ratio:.3g} of the truth"
    return SolveReport(text, True, named)


def causes_text(causes: Sequence[Hypothesis]) -> str:
    """Return the likeliest causes with the factors by which the misfit falls without them."""
    shown = (f"{each.code} ({each.strength:.2g})" for each in causes[:SHOWN_CAUSES])
    return ", ".join(shown) or "nothing"


def summary(rows: Sequence[MistakeRow]) -> str:
    """Return the numbers of mistakes that are reported or rated good, and of false alarms."""
    counts = Counter(
        (row.is_correct, key)
        for row in rows
        for key, counted in (("all", True), ("reported", row.is_reported), ("good", row.is_good))
        if counted
    )
    return (
        f"{counts[False, 'reported']} of {counts[False, 'all']} mistakes reported by check, "
        f"{counts[False, 'good']} rated good by solve; {counts[True, 'reported']} false alarms in "
        f"{counts[True, 'all']} correct problems, {counts[True, 'good']} rated good"
    )


def _line(cells: Sequence[str]) -> str:
    """Return one row of a Markdown table."""
    plain = (" ".join(cell.split()).replace("|", "/") for cell in cells)
    return f"| {' | '.join(plain)} |"


if __name__ == "__main__":
    sys.exit(main())
