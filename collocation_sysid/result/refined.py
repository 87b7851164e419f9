"""A finished run and its numerical error: the run's folder gets what `refine` finds."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from ..errors import InputError
from ..files import RESULT_FILE, require_own, whole_file
from ..problem import Problem
from ..runs.refine import refinement_of
from ..runs.result import FoundValue, Result
from ..runs.warm_start import Earlier
from ..statistics.numerical import Level, Refinement
from ..statistics.trust import NUMERICAL, Trust, numerical_concerns
from ..tree import as_json, read
from .record import REFINEMENT_FILE
from .replay import reading_run


def refine_run(
    folder: str | Path,
    levels: int = 2,
    allow_code: bool = False,
    say: Callable[[str], None] | None = None,
) -> tuple[Refinement, Result]:
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
    run, before = Path(folder), Result.read(folder)
    file, beside = run / RESULT_FILE, run / REFINEMENT_FILE
    home = before.home(file, "use collocation_sysid.refine")
    if not before.converged:
        raise InputError("the run did not converge: there is no answer to refine", file)
    estimates = {name: each.by_noise for name, each in before.values.items()}
    with reading_run(run):
        known = _known_levels(beside, estimates)
        answer = Earlier.of_result(before, run)
    problem = Problem.read(run / "problem.toml", allow_code=allow_code, folder=home)
    problem = replace(problem, substeps=before.problem.substeps)

    def keep(refinement: Refinement) -> Result:
        after = refined(before, refinement)
        with whole_file(beside) as levels, whole_file(file) as draft:
            levels.write_text(as_json(refinement) + "\n", encoding="utf-8")
            draft.write_text(as_json(after) + "\n", encoding="utf-8")
        return after

    refinement = refinement_of(problem, answer, estimates, levels, say, known, keep)
    return refinement, keep(refinement)


def refined(before: Result, refinement: Refinement) -> Result:
    """A result with what was measured of the numerical error in place of what was estimated."""

    def allowing(values: Mapping[str, FoundValue]) -> dict[str, FoundValue]:
        after = dict(values)
        for name in values.keys() & refinement.errors.keys():
            error = refinement.errors[name]
            holds = () if error.ci95 is None else refinement.holds
            after[name] = replace(
                values[name], numerical_error=error, ci95=error.ci95, ci95_holds=holds
            )
        return after

    estimates = {name: each.by_noise for name, each in before.values.items()}
    kept = [each for each in before.trust.concerns if each.code not in NUMERICAL]
    return replace(
        before,
        parameters=allowing(before.parameters),
        derived=allowing(before.derived),
        trust=Trust.of((*kept, *numerical_concerns(estimates, refinement))),
    )


def _known_levels(file: Path, names: Iterable[str]) -> list[Level]:
    """The levels that an earlier call has finished."""
    if not file.is_file():
        return []
    require_own(file)
    levels = read(Refinement, json.loads(file.read_text(encoding="utf-8"))).levels
    return [replace(each, values={name: each.values[name] for name in names}) for each in levels]
