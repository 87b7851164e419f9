"""The motion whose recording makes the error bars smallest, within limits and over a prior of θ."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...arrays import Array
from ...checked import AboveOne, AtLeastOne, Count, Options
from ...errors import InputError, SimulationError, require_among
from ...model.parameters import ThetaMap
from ...problem import Problem
from ...program.simulation import Trajectory, simulate, with_markers
from ...recording import Experiment, PoseSequence
from ...runs.solving import solve
from ...statistics.linearised import linearised_fit
from .information import (
    Criterion,
    Errors,
    FutureRecording,
    LinearRecording,
    SimulatedMotion,
    both_sides,
    draws_about,
    shared_information,
)
from .limits import REACHED, Bounds, Limits
from .motion import HandMotion
from .search import Best, Watch, search

Say = Callable[[str], None]

# Beyond any logarithm of an error bar: of motions that break a rule, those come first that break
# it least.
FORBIDDEN = 1e3
# Motions that are tried to first order, which takes milliseconds each, for each simulated one.
TO_FIRST_ORDER, NEWS = 10, 500
MOST_GIGABYTES = 1.0


@dataclass(frozen=True)
class DesignOptions(Options):
    """How a motion is sought.

    Attributes
    ----------
    evaluations : int
        How many motions are simulated; ten times as many are tried to first order before.
    pairs : int
        How many pairs of draws from the prior.
    spread : float
        Factor by which guesses without a prior may be wrong.
    waves : int
        How many waves each of the six coordinates has.
    seed : int
        Seed of the search and of the draws.
    """

    evaluations: AtLeastOne = 300
    pairs: Count = 1
    spread: AboveOne = 1.5
    waves: AtLeastOne = 1
    seed: Count = 0


WORST, USUAL = Criterion(), DesignOptions()


@dataclass(frozen=True, eq=False)
class Bars:
    """Relative error bars, by name.

    Attributes
    ----------
    values : of parameters and moduli at the middle of the prior
    relative : their standard errors over these
    lowest, highest : of the relative errors over the draws of θ
    """

    values: Mapping[str, float]
    relative: Mapping[str, float]
    lowest: Mapping[str, float]
    highest: Mapping[str, float]

    @classmethod
    def of(cls, errors: list[Errors]) -> Bars:
        """From those at the draws, the middle first."""
        each = [error.relative for error in errors]
        lowest, highest = ({n: pick(e[n] for e in each) for n in each[0]} for pick in (min, max))
        return cls(errors[0].values, each[0], lowest, highest)


@dataclass(frozen=True, eq=False)
class Design:
    """A motion with what it is predicted to tell.

    Attributes
    ----------
    recording : FutureRecording
    motion : HandMotion
    experiment : Experiment
        What is to be recorded, with the simulated markers in place of measured ones.
    predicted : Trajectory
        Simulated at the middle of the prior.
    criterion : Criterion
    before : Bars or None
        Of the recordings there are, where they count, else of the problem's own motion.
    after : Bars
        Of the new recording, and those there are where they count.
    added : bool
        Whether the recordings there are count.
    limits : Limits
    shares : by name of a limit, largest value over what is allowed
    best : Best
        How the search went.
    draws : number of θ
    """

    recording: FutureRecording
    motion: HandMotion
    experiment: Experiment
    predicted: Trajectory
    criterion: Criterion
    before: Bars | None
    after: Bars
    added: bool
    limits: Limits
    shares: Mapping[str, float]
    best: Best
    draws: int

    @property
    def poses(self) -> PoseSequence:
        """Those of the hand."""
        return self.experiment.grasps[0].poses

    @property
    def reached(self) -> list[str]:
        """Names of the limits that hold the motion back."""
        return [name for name, share in self.shares.items() if share > REACHED]

    @property
    def size(self) -> float:
        """The error bar that was made small."""
        return float(np.exp(self.best.value))


@dataclass(frozen=True, eq=False)
class Judge:
    """How good a motion is.

    Attributes
    ----------
    recording : FutureRecording
    limits : Limits
    criterion : Criterion
    draws : list of (nq,) q, the middle of the prior first
    known : (nq, nq) information of the recordings there are
    """

    recording: FutureRecording
    limits: Limits
    criterion: Criterion
    draws: list[Array]
    known: Array

    @cached_property
    def bounds(self) -> Bounds:
        """The limits about the start."""
        return self.recording.bounds(self.limits)

    @cached_property
    def constants(self) -> ThetaMap:
        """Of the body."""
        recording = self.recording
        return ThetaMap(recording.problem.parameters, recording.template.body)

    def motion(self, coefficients: Array) -> HandMotion:
        """The motion of any coefficients, within the limits."""
        recording = self.recording
        free = HandMotion.of(
            coefficients,
            float(recording.since_start_s[-1]),
            recording.highest_hz(self.limits),
            self.bounds.reach,
        )
        return self.bounds.within(free)

    def errors(self, information: Array | float, q: Array) -> Errors:
        """Of the recordings there are, and of one more."""
        parameters = self.recording.problem.parameters
        return Errors.of(self.known + information, parameters, self.constants, q)

    def first_guess(self, options: DesignOptions, say: Say) -> Best:
        """Where to begin: the best to first order.

        Nowhere where a wrench is measured too, or that would take too much memory.
        """
        sensed = self.recording.template.grasps[0].wrench is not None
        if sensed or LinearRecording.gigabytes(self.recording) > MOST_GIGABYTES:
            return Best()
        middle, count = self.draws[0], TO_FIRST_ORDER * options.evaluations
        try:
            linear = LinearRecording.of(self.recording, middle)
        except SimulationError:
            return Best()

        def told(number: int, size: float) -> None:
            if number % NEWS == 0:
                size = 100 * np.exp(size)
                say(f"to first order: {number} of {count} motions, {size:.3g} %")

        def value(coefficients: Array, _: float) -> float:
            information = linear.information(self.motion(coefficients))
            return self.criterion.log_size(self.errors(information, middle))

        size = HandMotion.size(options.waves)
        return search(value, size, count, options.seed, told)

    def value(self, coefficients: Array, bar: float) -> float:
        """The logarithm of the error bar, or `FORBIDDEN` and more where a rule is broken.

        A motion that is beyond the bar at the middle of the prior is judged by that alone.
        """
        experiment = self.recording.experiment(self.recording.poses(self.motion(coefficients)))
        sizes = []
        for q in self.draws:
            try:
                told = self.recording.told(experiment, q)
            except SimulationError as failure:
                gone = (failure.time_s - experiment.t_s[0]) / experiment.duration_s
                return FORBIDDEN * (3 - min(1.0, gone))
            if (beyond := self.limits.out_of_view(told.markers_m)) > 0:
                return FORBIDDEN * (1 + beyond / (1 + beyond))
            sizes.append(self.criterion.log_size(self.errors(told.information, q)))
            if len(sizes) == 1 and sizes[0] > bar:
                break
        return self.criterion.over_draws(sizes)


def design(
    problem: Problem,
    limits: Limits,
    duration_s: float,
    criterion: Criterion = WORST,
    options: DesignOptions = USUAL,
    *,
    experiment: str | None = None,
    add: bool = False,
    watch: Watch | None = None,
    say: Say = lambda _: None,
) -> Design:
    """Find the motion of the grasp that makes the error bars smallest.

    Parameters
    ----------
    problem : Problem
        Whose experiment says body, grasp, markers, noise and nuisance parameters, and where the
        hand starts: at its first pose.
    limits : Limits
    duration_s : float
    criterion, options
    experiment : str, optional
        Its name; the first that is not static by default.
    add : bool
        Identify the parameters from the recordings there are first; the new one is to complete
        them, and θ is drawn about the answer as its error bars say. Otherwise they do not count,
        and θ is drawn about the guesses.
    watch : callable, optional
        Called with the number of motions tried and the logarithm of the smallest error bar.
    say : callable, optional
        Called with what is being done now.

    Raises
    ------
    InputError
        For a problem without guesses, an experiment that cannot be designed, limits that exclude
        the start, unknown names, where the recordings cannot be fitted, and where no motion that
        was tried keeps the body simulable and the markers in view.
    """
    if not 0 < duration_s < np.inf:
        raise InputError(
            f"found {duration_s:g}; expected a number of seconds above 0", None, "--duration"
        )
    recording = FutureRecording(problem, _chosen(problem, experiment), duration_s)
    recording.bounds(limits)
    recording.highest_hz(limits)
    if not problem.parameters.free:
        raise InputError("every parameter is fixed; expected one to estimate", problem.path)
    if add:
        say("identifying the parameters from the recordings there are")
        draws, known = _from_recordings(problem, options)
    else:
        _require_guesses(problem)
        draws = draws_about(problem.parameters, options.spread, options.pairs, options.seed)
        known = np.zeros((len(draws[0]),) * 2)
    judge = Judge(recording, limits, criterion, draws, known)
    criterion.require_known(judge.errors(0.0, draws[0]))
    first = judge.first_guess(options, say)
    say("seeking a motion")
    tried = 1 if first.interrupted else options.evaluations
    best = search(judge.value, HandMotion.size(options.waves), tried, options.seed, watch, first.at)
    best.interrupted |= first.interrupted
    if best.at is None or best.value >= FORBIDDEN:
        raise InputError(_no_motion(best), problem.path)
    say("simulating the best motion")
    return _designed(judge, best, add)


def _designed(judge: Judge, best: Best, add: bool) -> Design:
    """The best motion with its error bars."""
    assert best.at is not None
    recording, motion = judge.recording, judge.motion(best.at)
    experiment = recording.experiment(recording.poses(motion))
    told = [recording.told(experiment, q) for q in judge.draws]
    after = _bars(judge, told)
    problem = recording.problem
    values = problem.parameters.values(judge.draws[0])
    predicted = simulate(experiment, values, problem.scheme, substeps=problem.first_substeps)
    return Design(
        recording,
        motion,
        with_markers(experiment, predicted.markers_m),
        predicted,
        judge.criterion,
        _before(judge, add),
        after,
        add,
        judge.limits,
        judge.bounds.shares(motion),
        best,
        len(judge.draws),
    )


def _before(judge: Judge, add: bool) -> Bars | None:
    """Error bars of the recordings there are, or of the motion that the problem has."""
    if add:
        return Bars.of([judge.errors(0.0, q) for q in judge.draws])
    recording = judge.recording
    template = recording.template
    if len(template.grasps[0].poses.t_s) < 2:
        return None
    shipped = replace(recording, duration_s=template.duration_s)
    try:
        told = [shipped.told(template, q) for q in judge.draws]
    except SimulationError:
        return None
    return _bars(judge, told)


def _bars(judge: Judge, told: list[SimulatedMotion]) -> Bars:
    pairs = zip(told, judge.draws, strict=True)
    return Bars.of([judge.errors(each.information, q) for each, q in pairs])


def _from_recordings(problem: Problem, options: DesignOptions) -> tuple[list[Array], Array]:
    """Draws of q about the answer, and the information of the recordings."""
    solution = solve(problem)
    solution.unless_interrupted()
    if not solution.status.converged:
        raise InputError(
            f"the recordings there are could not be fitted ({solution.status.value}), so that "
            "there is nothing to add to; solve the problem first, or leave out --add",
            problem.path,
        )
    known = shared_information(linearised_fit(solution.collocation, solution.z))
    constants = ThetaMap(problem.parameters, problem.experiments[0].body)
    errors = Errors.of(known, problem.parameters, constants, solution.q)
    # Where they tell next to nothing of a parameter, as far about the answer as about a guess.
    most = np.log(options.spread)
    deviations = np.sqrt(np.diag(errors.covariance))
    shrunk = np.minimum(1.0, most / deviations)
    root = shrunk[:, None] * np.linalg.cholesky(errors.covariance)
    return both_sides(problem.parameters, solution.q, root, options.pairs, options.seed), known


def _chosen(problem: Problem, name: str | None) -> Experiment:
    moving = [each for each in problem.experiments if not each.static]
    if not moving:
        raise InputError("every experiment is static; expected one that moves", problem.path)
    if name is None:
        return moving[0]
    named = {each.name: each for each in moving}
    require_among(name, named, problem.path, "--experiment")
    return named[name]


def _require_guesses(problem: Problem) -> None:
    if names := problem.parameters.unguessed:
        key = f"parameters.{names[0]}"
        raise InputError(
            "has no guess, and a motion is designed about a value; expected --set "
            f"{key}.guess=VALUE, or --add to identify it first",
            problem.path,
            key,
        )


def _no_motion(best: Best) -> str:
    tried = f"none of the {len(best.history)} motions that were tried"
    if best.value >= 2 * FORBIDDEN:
        return (
            f"{tried} could be simulated to its end; lower acceleration and speed in the limits, "
            "or raise transcription.substeps"
        )
    return (
        f"{tried} keeps the markers in view; widen markers_box_m or the cameras' "
        "field_of_view_deg, or narrow workspace_m"
    )
