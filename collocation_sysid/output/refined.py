"""A finished run and its numerical error: the run's folder gets what `refine` finds."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, get_args

from ..earlier import Earlier
from ..errors import InputError
from ..files import RESULT_FILE, read_json, require_own, whole_file
from ..problem import Problem
from ..refine import refinement_of
from ..statistics.estimates import Estimate
from ..statistics.numerical import Refinement
from ..statistics.trust import STEP_MOVES, Verdict, numerical_concerns
from .record import REFINEMENT_FILE, as_json
from .replay import reading_run


def refine_run(
    folder: str | Path,
    levels: int = 2,
    allow_code: bool = False,
    say: Callable[[str], None] | None = None,
) -> tuple[Refinement, dict[str, Any]]:
    """Solve the problem of a run folder again at finer discretisations, and write what that tells.

    ``refinement.json`` holds the levels, and those that it holds already are not solved again; in
    ``result.json`` parameters and moduli get their ``numerical_error`` and intervals that hold it,
    and the verdict takes it into account.

    Returns
    -------
    The refinement, and the content of ``result.json``

    Raises
    ------
    InputError
        If the folder holds no converged run of a problem file, or its files are gone.
    KeyboardInterrupt
        Where it was interrupted: the levels that were finished are in the folder.
    """
    file = Path(folder) / RESULT_FILE
    answer = Earlier.read(folder)
    result = read_json(file, "a run folder")
    with reading_run(file.parent):
        problem_file = result["provenance"]["problem_file"]
        if problem_file is None:
            raise InputError("the run is of no problem file; use collocation_sysid.refine", file)
        if not result["converged"]:
            raise InputError("the run did not converge: there is no answer to refine", file)
        home = Path(problem_file).parent
        groups = [result[key] for key in ("parameters", "derived")]
        estimates = {name: _estimate(each) for group in groups for name, each in group.items()}
        before, substeps = _trust(result["trust"]), int(result["problem"]["substeps"])
        known = _known_levels(file.parent, list(estimates))
    problem = Problem.read(file.parent / "problem.toml", allow_code=allow_code, folder=home)
    problem = replace(problem, substeps=substeps)

    def keep(found: Refinement) -> None:
        for group in groups:
            for name in set(group) & set(found.errors):
                error = found.errors[name]
                group[name] |= {"numerical_error": asdict(error), "ci95": error.ci95}
                group[name]["ci95_holds"] = [] if error.ci95 is None else list(found.holds)
        result["trust"] = _judged(before, estimates, found)
        with whole_file(file.parent / REFINEMENT_FILE) as beside, whole_file(file) as draft:
            beside.write_text(as_json(found.as_dict()) + "\n", encoding="utf-8")
            draft.write_text(as_json(result) + "\n", encoding="utf-8")

    found = refinement_of(problem, answer, estimates, levels, say, known, keep)
    keep(found)
    return found, result


def _known_levels(folder: Path, names: Sequence[str]) -> list[dict[str, Any]]:
    """The levels that an earlier call has finished."""
    file = folder / REFINEMENT_FILE
    if not file.is_file():
        return []
    require_own(file)
    levels = json.loads(file.read_text(encoding="utf-8"))["levels"]
    return [
        {**each, "values": {name: float(each["values"][name]) for name in names}} for each in levels
    ]


def _estimate(found: dict[str, Any]) -> Estimate:
    interval = found["ci95_noise"]
    return Estimate(
        found["value"],
        found["std_error"],
        None if interval is None else (interval[0], interval[1]),
        found["at_bound"],
        found["reason"],
    )


def _trust(found: dict[str, Any]) -> dict[str, Any]:
    verdict, reasons = found["verdict"], [str(reason) for reason in found["reasons"]]
    if verdict not in get_args(Verdict):
        raise ValueError(f"a verdict {verdict!r}")
    return {"verdict": verdict, "reasons": reasons}


def _judged(
    trust: dict[str, Any], estimates: dict[str, Estimate], found: Refinement
) -> dict[str, Any]:
    """The verdict with what was measured in place of what was estimated."""
    kept = [reason for reason in trust["reasons"] if not reason.startswith(STEP_MOVES)]
    reasons = [*kept, *(said for said, _ in numerical_concerns(estimates, found))]
    verdict = trust["verdict"]
    if verdict != "doubtful":
        verdict = "check" if reasons else "good"
    return {"verdict": verdict, "reasons": reasons}
