"""One run: solve a problem, verify the answer by simulating forward, and find the error bars."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .display import plain_text
from .errors import InputError, SimulationError
from .fem.two_phase import TwoPhaseModes
from .methods.solution import Method, Solution, Status, Watch
from .methods.start import marched
from .methods.workers import workers_of
from .model.schemes import as_scheme
from .problem import Problem
from .runs.answer import Answer
from .runs.check.cost import require_memory
from .runs.forward_simulation import roll_outs, step_error
from .runs.refine import refine
from .runs.result import Elapsed, Result
from .runs.solving import read_where_found, shared, solve
from .runs.told import result_of
from .runs.warm_start import Earlier
from .statistics.budget import Sources
from .statistics.causes import likely_causes
from .statistics.considered import Changes, assumed
from .statistics.diagnostics import diagnose
from .statistics.linearised import LinearisedFit, linearised_fit
from .statistics.numerical import MOST_SUBSTEPS
from .statistics.pose_noise import with_pose_noise
from .statistics.probes import probes, probes_of_every_solve
from .statistics.profile import Profile, profile_of
from .statistics.relaxation import Answered, Probe, probed_changes
from .statistics.routine_probes import probed_deviations
from .statistics.trust import turn_concerns
from .statistics.uncertainty import Uncertainty, uncertainty_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure  # which takes a while to import

Log = Callable[[str], None]


class Run(Answer):
    """A solved problem with its checks, as it is looked at and kept; see `Answer`."""

    def __str__(self) -> str:
        from .result.run_sections import summary  # how it looks is no part of a run

        return plain_text(summary(self.result))

    @cached_property
    def result(self) -> Result:
        """All that is known of it, as ``result.json`` holds it."""
        return result_of(self)

    def table(self) -> str:
        """Parameters, intervals, what these hold, and the verdict, as the terminal shows them."""
        from .result.run_sections import answer  # how it looks is no part of a run

        return plain_text(answer(self.result))

    def plot(
        self, experiment: str | None = None, field: str | None = "von_mises_pa", count: int = 6
    ) -> Figure:
        """Draw the body as it moved, fitted or else simulated with the answer, and its markers.

        Parameters
        ----------
        experiment : str, optional
            By default the first.
        field : {"von_mises_pa", "energy_density_j_m3", "det_f"} or None
            What colours it, element by element; None for its regions.
        count : int
            How many shapes, from the first sample to the last; 20 at most.

        Returns
        -------
        Figure
            Of matplotlib. A notebook shows it, ``savefig`` writes it.

        Raises
        ------
        InputError
            For an unknown experiment or field, a count that cannot be, or a run without motion.
        """
        from .result.animation import chosen  # how it looks is no part of a run
        from .result.pictures.shapes import portrait
        from .result.record import replays

        replay = chosen(replays(self), experiment)
        bodies = {each.name: each.body for each in self.problem.experiments}
        return portrait(replay, bodies[replay.name], self.parameters, field, count)

    def save(self, folder: str | Path, frames: bool = True, pictures: bool = True) -> Path:
        """Write the run folder, whole or not at all, and return it.

        The pictures are drawn after the folder is in its place.

        Parameters
        ----------
        folder : str or Path
        frames : bool
            Whether frames for ParaView are written.
        pictures : bool
            Whether pictures are drawn, which may take as long as the search.

        Raises
        ------
        InputError
            If there is anything but an earlier run.
        """
        from .result.record import write_run  # what files hold is no part of a run

        return write_run(self, folder, frames=frames, pictures=pictures)


def run(
    problem: Problem,
    method: str | Method | None = None,
    watch: Watch | None = None,
    log: Log | None = None,
    start: str | Path | Earlier | None = None,
    seek_causes: bool = True,
    scheduler: str | None = None,
    probe: bool = False,
) -> Run:
    """Solve a problem, simulate every experiment with the answer, and find the error bars.

    Once there is an answer, Ctrl-C ends what comes after it: `Run.missing` says what is left out.

    Parameters
    ----------
    problem : Problem
    method, watch, start, scheduler
        See `solve`.
    log : callable, optional
        Called with what is being done now, a text.
    seek_causes : bool
        Whether a misfit's cause is looked for, see `likely_causes`.
    probe : bool
        Whether the data are refitted in parts, and with each assumption freed, see `probes`.

    Raises
    ------
    InputError
        As `solve` does.
    """
    say = log or (lambda _: None)
    began_s = time.perf_counter()
    solution = solve(problem, method, watch, start, scheduler)
    searched_s = time.perf_counter()

    def timed(answer: Run) -> Run:
        """Return the answer with the time until now; a search with finer steps is no check."""
        finer_s = answer.solution.timing.total - solution.timing.total
        checks_s = time.perf_counter() - searched_s - finer_s
        return replace(answer, elapsed_s=Elapsed(searched_s - began_s + finer_s, checks_s))

    bodies = (segment.body for segment in solution.collocation.segments)
    fields = {part.field_name: part.field for b in bodies for part in b.parts if part.field}
    problem = problem.with_lengths({name: field.length_m for name, field in fields.items()})
    phases = {n: f for n, f in fields.items() if isinstance(f, TwoPhaseModes)}
    problem = problem.with_fields(phases) if phases else problem
    answer = Run(problem, solution, {}, None)
    missing = "no forward simulation has checked the answer, and there are no error bars"
    try:
        answer, fit = _checked(problem, answer.solution, say)
        missing = "what comes after the error bars is left out: finer steps, causes of the misfit"
        if problem.substeps == "auto":
            answer, fit = _fine_enough(answer, fit, problem.solver(method), watch, say, scheduler)
        substeps = answer.solution.collocation.substeps
        turns = (c.sentence for e in problem.experiments for c in turn_concerns(e, substeps))
        answer = replace(answer, notes=(*turns, *answer.notes))
        if answer.uncertainty is not None and fit is not None:
            profiles = _profiles(answer, fit, say)
            changes = _changes(answer, say)
            sources = _sources(answer, fit, answer.uncertainty, changes)
            answer = replace(answer, profiles=profiles, sources=sources)
            answer = replace(answer, probes=_probes(answer, fit, changes, say, deep=probe))
        if not seek_causes or answer.solution.status is Status.INTERRUPTED:
            return timed(answer)
        say("looking for causes of the misfit")
        answer = replace(answer, causes=likely_causes(answer.solution))
        if problem.uncertainty.numerical and answer.uncertainty is not None:
            answer = refine(answer, say=say)
        return timed(answer)
    except KeyboardInterrupt:
        unsimulated = dict.fromkeys((e.name for e in problem.experiments), "interrupted")
        rollouts = unsimulated | dict(answer.rollouts)
        return timed(replace(answer, rollouts=rollouts, missing=missing))


def _checked(problem: Problem, solution: Solution, say: Log) -> tuple[Run, LinearisedFit | None]:
    """A solution simulated forward, with its error bars and the fit they are of, where any."""
    say("checking the answer by a forward simulation")
    rollouts = roll_outs(problem, solution)
    if not solution.status.converged:
        return Run(problem, solution, rollouts, None), None
    say("finding the error bars")
    try:
        fit = linearised_fit(solution.collocation, solution.z)
        say("finding what noise of the poses does")
        fit, noises = with_pose_noise(fit, solution.collocation, solution.z)
    except SimulationError as error:
        return Run(problem, solution, rollouts, None, notes=(f"no error bars: {error}",)), None
    answer = Run(problem, solution, rollouts, None, diagnose(fit))
    if not solution.collocation.nq:
        return answer, fit
    parameters = solution.collocation.parameters
    try:
        uncertainty = uncertainty_of(fit, parameters, solution.q, problem.uncertainty)
    except InputError as error:
        raise error.located(problem.path) from error
    answer = replace(answer, uncertainty=uncertainty, notes=tuple(n.sentence for n in noises))
    error = step_error(problem, solution, fit, rollouts, answer.optimum)
    return replace(answer, refinement=error), fit


def _changes(answer: Run, say: Log) -> Changes:
    """Return how the residuals change by what is assumed, and by what every solve probes."""
    say("finding what is assumed is worth")
    solution = answer.solution
    deviations = probed_deviations(answer.problem.uncertainty.considered)
    return assumed(solution.collocation, solution.z, deviations)


def _sources(answer: Run, fit: LinearisedFit, known: Uncertainty, changes: Changes) -> Sources:
    """Return what moves the estimates beside the noise; what is stated as exact does not."""
    solution, stated = answer.solution, answer.problem.uncertainty.assumptions.deviations
    parameters = solution.collocation.parameters
    budgeted = changes.without(name for name, deviation in stated.items() if deviation is None)
    means = answer.problem.uncertainty.assumptions.means
    return Sources.of(fit, budgeted, parameters, solution.q, known, means)


def _probes(
    answer: Run, fit: LinearisedFit, changes: Changes, say: Log, deep: bool
) -> tuple[Probe, ...]:
    """Return the probes of every solve; of a deep check those of parts and assumptions instead."""
    solution, options = answer.solution, answer.problem.uncertainty
    deviations = probed_deviations(options.considered)
    collocation, z = solution.collocation, solution.z
    answered = Answered(
        collocation=collocation,
        z=z,
        fit=fit,
        errors=options,
        statistical=answer.optimum,
        budget=answer.budget,
        deviations=deviations,
        changes=probed_changes(collocation, z, deviations, changes),
    )
    if not deep:
        return probes_of_every_solve(answered)
    say("refitting parts of the data, and with assumptions relaxed")
    return probes(answered)


def _profiles(answer: Run, fit: LinearisedFit, say: Log) -> tuple[Profile, ...]:
    """The profile likelihoods that are asked for."""
    profiles = []
    assert answer.uncertainty is not None
    for name in answer.problem.uncertainty.profile:
        say(f"profile likelihood of {name}")
        try:
            profiles.append(profile_of(answer.solution, fit, answer.uncertainty, name))
        except InputError as error:
            raise error.located(answer.problem.path) from error
    return tuple(profiles)


def _fine_enough(
    coarse: Run,
    fit: LinearisedFit | None,
    solver: Method,
    watch: Watch | None,
    say: Log,
    scheduler: str | None,
) -> tuple[Run, LinearisedFit | None]:
    """Return the run solved again from its answer, with as many substeps as its error bars ask for.

    The answer may have several steps a sample already, where it was started from such a run. A
    parameter that ended at a bound has no error bar, and coarse steps may have driven it there: it
    starts from its guess again. Where all of them ended so, the most substeps are taken.
    """
    if coarse.refinement is None or fit is None:
        return coarse, fit
    first, problem = coarse.solution, coarse.problem
    before = first.collocation.substeps
    factor = coarse.refinement.substeps(coarse.optimum, as_scheme(problem.scheme).order)
    substeps = min(before * factor, MOST_SUBSTEPS)
    steps = "one step" if before == 1 else f"{before} steps"
    worst, many = coarse.refinement.worst(coarse.optimum)
    why = f"with {steps} a sample, the step moves {worst} by {many:.2g} standard errors"
    if fit.at_bound[: fit.shared].all():
        substeps = MOST_SUBSTEPS
        why = f"with {steps} a sample, every parameter ends at a bound"
    if substeps <= before:
        return coarse, fit
    say(f"solving again with {substeps} steps a sample")
    again = replace(first.collocation, substeps=substeps)
    p, _ = first.collocation.unpack(first.z)
    p = np.where(fit.at_bound, again.guess_p, p)
    try:
        require_memory(problem, again, solver)
        positions, failure = marched(again, p)
        if failure is not None:
            raise failure
        with workers_of(scheduler) as workers:
            finer = read_where_found(
                shared(solver, workers), again, watch, again.pack(p, positions)
            )
        message = finer.message
    except (InputError, SimulationError) as error:
        finer, message = None, str(error)
    if finer is not None and finer.status is Status.INTERRUPTED:
        raise KeyboardInterrupt  # the first answer is whole
    if finer is None or not finer.status.converged:
        note = f"{why}; with {substeps} it was not solved: {message}"
        return replace(coarse, notes=(note, *coarse.notes)), fit
    most = ", the most that are chosen" if substeps == MOST_SUBSTEPS else ""
    said = f"{why}; so it was solved again with {substeps}{most}"
    return _checked(problem, finer.after(first, said), say)
