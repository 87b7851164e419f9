"""Measured discretisation error of a finished run, added to its folder.

`refine_run` solves the problem of a run folder again at finer steps and meshes, and updates
``result.json``; `with_refinement` does the update alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from ..common.files import RESULT_FILE, replaced_file, require_own
from ..common.serialisation import as_json, read
from ..errors import InputError
from ..methods.solution import Watch
from ..model.parameters import Parameters
from ..problem import Problem
from ..runs.mesh_resolution import MESH_ERROR
from ..runs.numerical_error import solve_refined
from ..runs.result_content import Result
from ..runs.warm_start import WarmStart
from ..statistics.assessment import NUMERICAL, Assessment, numerical_concerns
from ..statistics.budget.combined_intervals import ReportedEstimate, combine
from ..statistics.budget.discretisation_error import (
    DiscretisationError,
    Refinement,
    RefinementLevel,
)
from ..statistics.budget.systematic_effects import DISCRETISATION
from ..statistics.estimates import Estimate
from .replay import damaged_run_refused
from .run_record import REFINEMENT_FILE

# Source of variance that a refinement measures.
REFINED = "step and mesh"


def refine_run(
    folder: str | Path,
    levels: int = 2,
    allow_code: bool = False,
    say: Callable[[str], None] | None = None,
    watch: Watch | None = None,
) -> tuple[Refinement, Result]:
    """Solve the problem of a run folder again at finer discretisations, and update the folder.

    ``refinement.json`` holds the levels; levels that it holds already are not solved again. In
    ``result.json`` the values of parameters and moduli are corrected for the measured error, their
    combined intervals and the budget contain it, and the verdict takes it into account. Both files
    are updated after each level. Pictures are not drawn again.

    Parameters
    ----------
    levels : int
        Number of discretisations, with that of the run: 2, or 3 to observe the orders of
        convergence.
    allow_code : bool
        Whether Python files that the problem names may run.
    say : callable, optional
        Called with a sentence about what is being done.
    watch : callable, optional
        Called with each iteration of the solves.

    Returns
    -------
    Refinement, Result
        The measured errors, and the content of ``result.json``.

    Raises
    ------
    InputError
        If the folder holds no converged run of a problem file, files of the problem are missing,
        `levels` is out of range, or a finer problem cannot be solved.
    KeyboardInterrupt
        After an interrupt; the levels that were finished are in the folder.
    """
    run = Path(folder)
    before = Result.read(folder)
    file = run / RESULT_FILE
    levels_file = run / REFINEMENT_FILE
    home = before.problem_folder(
        file, "which refine needs: in Python, use collocation_sysid.refine"
    )
    if not before.converged:
        raise InputError(
            "the run did not converge, so that there is no result to refine; solve the problem "
            "again first",
            file,
        )
    problem = Problem.read(run / "problem.toml", allow_code=allow_code, folder=home)
    problem = replace(problem, substeps=before.problem.substeps)
    estimates = _estimates_at_optimum(before, problem.parameters)
    with damaged_run_refused(run):
        known = _known_levels(levels_file, estimates)
        answer = WarmStart.from_result(before, run)

    def keep(refinement: Refinement) -> Result:
        after = with_refinement(before, refinement, parameters=problem.parameters)
        with replaced_file(levels_file) as levels, replaced_file(file) as draft:
            levels.write_text(as_json(refinement) + "\n", encoding="utf-8")
            draft.write_text(as_json(after) + "\n", encoding="utf-8")
        return after

    refinement = solve_refined(
        problem,
        answer,
        estimates=estimates,
        levels=levels,
        report_progress=say,
        solved_levels=known,
        save_progress=keep,
        watch=watch,
    )
    return refinement, keep(refinement)


def with_refinement(before: Result, refinement: Refinement, parameters: Parameters) -> Result:
    """Return a result with the measured discretisation error in place of the estimated one; nothing
    is written.

    Values, intervals and budget of the estimates whose error was measured are updated, and so is
    the verdict with its concerns; other estimates are unchanged.

    Parameters
    ----------
    before : Result
        Content of ``result.json`` after the solve; not modified.
    parameters : Parameters
        Parameters of the problem, with their coordinates and bounds.
    """
    optimum = _estimates_at_optimum(before, parameters)

    def corrected(values: Mapping[str, ReportedEstimate]) -> dict[str, ReportedEstimate]:
        return {
            name: _corrected_estimate(
                name,
                each,
                optimum=optimum[name],
                error=refinement.errors[name],
                parameters=parameters,
            )
            if name in optimum and name in refinement.errors
            else each
            for name, each in values.items()
        }

    after = replace(
        before, parameters=corrected(before.parameters), derived=corrected(before.derived)
    )
    budget = {
        name: _updated_shares(shares, before.estimates[name], after=after.estimates[name])
        for name, shares in before.budget.items()
    }
    uncertainties = {name: each.combined_std_error for name, each in after.estimates.items()}
    others = [each for each in before.trust.concerns if each.code not in (NUMERICAL, MESH_ERROR)]
    concerns = (*others, *numerical_concerns(optimum, uncertainties, refinement=refinement))
    return replace(after, budget=budget, trust=Assessment.from_concerns(concerns))


def _estimates_at_optimum(result: Result, parameters: Parameters) -> dict[str, Estimate]:
    return {
        name: each.at_optimum(name, linear=name in parameters.linear_names)
        for name, each in result.estimates.items()
    }


def _corrected_estimate(
    name: str,
    before: ReportedEstimate,
    optimum: Estimate,
    error: DiscretisationError,
    parameters: Parameters,
) -> ReportedEstimate:
    """Statistical and combined intervals change, everything else stays as before."""
    linear, bounds = parameters.scale_and_bounds(name)
    combined = combine(
        name,
        optimum,
        error=error,
        systematic=before.systematic,
        known_effect=before.known_effect or 0.0,
        linear=linear,
        bounds=bounds,
    )
    return replace(combined, guess=before.guess, fixed=before.fixed, tied=before.tied)


def _updated_shares(
    shares: Mapping[str, float], before: ReportedEstimate, after: ReportedEstimate
) -> dict[str, float]:
    """Shares sum to one, largest first."""
    if not before.combined_std_error or not after.combined_std_error:
        return dict(shares)
    ratio = (before.combined_std_error / after.combined_std_error) ** 2
    # Standard errors are relative to their values, see `IntervalCoordinate`.
    ratio *= (after.value / before.value) ** 2 if before.value else 1.0
    replaced = {REFINED, *(row.name for row in DISCRETISATION)}
    others = {name: share * ratio for name, share in shares.items() if name not in replaced}
    total = max(1.0, sum(others.values()))
    corrected = {name: share / total for name, share in others.items()}
    corrected[REFINED] = 1.0 - sum(corrected.values())
    return dict(sorted(corrected.items(), key=lambda item: -item[1]))


def _known_levels(file: Path, names: Iterable[str]) -> list[RefinementLevel]:
    """Return levels of an earlier call, with values of `names` alone."""
    if not file.is_file():
        return []
    require_own(file)
    levels = read(Refinement, json.loads(file.read_text(encoding="utf-8"))).levels
    return [replace(each, values={name: each.values[name] for name in names}) for each in levels]
