"""Search for the motion with the smallest error bars, within limits and over a prior of θ.

Use `design_motion`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...common.array_types import Array
from ...common.validated_classes import validated
from ...common.validated_types import AboveOne, AtLeastOne, Count
from ...errors import InputError, SimulationError, require_among
from ...model.parameters import ThetaMap
from ...problem import Problem
from ...program.simulation import Trajectory, simulate, with_markers
from ...recording import Experiment, PoseSequence
from ...runs.solving import solve
from ...statistics.linearised import linearise_fit
from .evolution_search import SearchResult, Watch, minimise
from .hand_limits import REACHED, HandBounds, Limits
from .hand_motion import HandMotion
from .predicted_information import (
    DesignCriterion,
    FutureRecording,
    LinearRecording,
    PredictedErrors,
    prior_draws,
    shared_information,
    symmetric_draws,
)

Say = Callable[[str], None]

# Value of motions that are not feasible, larger than the logarithm of any error bar. It is
# multiplied by up to 3, and the less a motion violates a condition, the smaller it is.
FORBIDDEN = 1e3
# Number of first-order evaluations, which take milliseconds each, for each simulated motion.
TO_FIRST_ORDER = 10
# Motions evaluated to first order between two reports of the progress.
NEWS = 500
# Largest memory of the first-order prediction [GB]; with more, motions are simulated only.
MOST_GIGABYTES = 1.0


@validated
class DesignOptions:
    """Options of the search for a motion.

    Attributes
    ----------
    evaluations : int
        Number of motions that are simulated, after a first-order evaluation of ten times as many.
    pairs : int
        Number of pairs of draws of the parameters from their priors, in addition to the guess.
    spread : float
        Factor by which the guess of a parameter without a prior may be wrong.
    waves : int
        Number of waves in the motion of each of the six coordinates of the hand.
    seed : int
        Seed of the search and of the draws.
    """

    evaluations: AtLeastOne = 300
    pairs: Count = 1
    spread: AboveOne = 1.5
    waves: AtLeastOne = 1
    seed: Count = 0


# Default criterion: the largest error bar of the estimated parameters.
WORST = DesignCriterion()
# Default options.
USUAL = DesignOptions()


@dataclass(frozen=True, eq=False)
class ErrorBars:
    """Predicted relative standard errors (error bars), by name of the parameter or modulus."""

    # mapping of str to float: parameters and moduli at the middle of the prior.
    values: Mapping[str, float]
    # mapping of str to float: their standard errors, divided by these values.
    relative: Mapping[str, float]
    # mapping of str to float: smallest and largest relative errors over the draws of θ.
    lowest: Mapping[str, float]
    highest: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Design:
    """Designed motion with its predicted uncertainty."""

    recording: FutureRecording  # recording to be made
    motion: HandMotion
    # Experiment to be recorded, with simulated markers, without noise, instead of measured ones.
    experiment: Experiment
    predicted: Trajectory  # simulation at the middle of the prior
    criterion: DesignCriterion  # criterion that was minimised
    # Error bars of the existing recordings, if they are used, else of the problem's own motion;
    # None if that could not be simulated.
    before: ErrorBars | None
    # Error bars with the new recording, and with the existing ones if they are used.
    after: ErrorBars
    added: bool  # whether the existing recordings are used
    limits: Limits  # limits of the robot
    # mapping of str to float: largest value over the limit, by name of the limit.
    shares: Mapping[str, float]
    best: SearchResult
    draws: int  # number of draws of θ

    @property
    def poses(self) -> PoseSequence:
        """Poses of the designed motion over time, as grasps have them: a grasped node at X of the
        undeformed body is at R X + p.
        """
        return self.experiment.grasps[0].poses

    @property
    def active_limits(self) -> list[str]:
        """Names of the robot's limits of which the motion uses more than the share
        `REACHED`.
        """
        return [name for name, share in self.shares.items() if share > REACHED]

    @property
    def minimised_error(self) -> float:
        """Relative error bar that was minimised, 0.01 for 1 %, combined over parameters
        and draws by the criterion.
        """
        return float(np.exp(self.best.value))


@dataclass(frozen=True, eq=False)
class MotionObjective:
    """Objective of the search: size of the error bars of a motion."""

    recording: FutureRecording  # recording to be designed
    limits: Limits  # limits of the robot
    criterion: DesignCriterion  # criterion to minimise
    draws: list[Array]  # list of (nq,): draws of q, the middle of the prior first
    # (nq, nq): information of the existing recordings, without priors; zero if they are not used.
    known_information: Array

    @cached_property
    def bounds(self) -> HandBounds:
        """Limits of the hand relative to its initial position; `InputError` if that is outside the
        workspace.
        """
        return self.recording.bounds(self.limits)

    @cached_property
    def constants(self) -> ThetaMap:
        """Map from the parameters q, in the solver's coordinates, to the constants of the body."""
        recording = self.recording
        return ThetaMap(recording.problem.parameters, recording.template.body)

    def motion(self, coefficients: Array) -> HandMotion:
        """Return the motion of the hand for unbounded coefficients (d,), see
        `HandMotion.from_coefficients`, scaled so that it satisfies all limits of the robot; views
        of cameras are not considered.
        """
        recording = self.recording
        free = HandMotion.from_coefficients(
            coefficients,
            float(recording.since_start_s[-1]),
            highest_hz=recording.highest_hz(self.limits),
            reach=self.bounds.reach,
        )
        return self.bounds.scale_to_limits(free)

    def errors(self, information: Array | float, q: Array) -> PredictedErrors:
        """Return the error bars at the parameters q from existing recordings, priors, and a new
        recording. A parameter about which nothing is known has the error bar `UNDETERMINED` times
        its value, see `PredictedErrors.from_information`.

        Parameters
        ----------
        information : (nq, nq) array or 0
            Information of the new recording about q, without priors; 0 for none.
        q : (nq,) array
            Parameters in the solver's coordinates.
        """
        parameters = self.recording.problem.parameters
        return PredictedErrors.from_information(
            self.known_information + information, parameters, constants=self.constants, q=q
        )

    def error_bars(self, motion: Experiment | None, recording: FutureRecording) -> ErrorBars:
        """Return the error bars of existing recordings and priors, and of a recording of `motion`
        unless it is None: at the middle, with their range over the draws of θ.

        Raises
        ------
        SimulationError
            If the motion cannot be simulated at some draw.
        """
        known = [
            0.0 if motion is None else recording.simulate_motion(motion, q)[0] for q in self.draws
        ]
        errors = [self.errors(each, q) for each, q in zip(known, self.draws, strict=True)]
        each = [error.relative for error in errors]
        lowest, highest = ({n: pick(e[n] for e in each) for n in each[0]} for pick in (min, max))
        return ErrorBars(errors[0].values, each[0], lowest=lowest, highest=highest)

    def first_guess(self, options: DesignOptions, say: Say) -> SearchResult:
        """Return the motion with the smallest error bars at the first draw, to first order in the
        motion, as a start of the search.

        Views of cameras are not considered. The result has no coefficients, and an empty history,
        if a force is measured too, the memory would be too large, or the simulation fails. Ctrl-C
        ends the search with the best so far.

        Parameters
        ----------
        options : DesignOptions
            `TO_FIRST_ORDER` times its `evaluations` are made, with its waves and seed.
        say : callable
            Function that is called with the progress, a text.

        Raises
        ------
        KeyboardInterrupt
            If it is interrupted before the first evaluation.
        """
        sensed = self.recording.template.grasps[0].wrench is not None
        if sensed or LinearRecording.gigabytes(self.recording) > MOST_GIGABYTES:
            return SearchResult()
        middle = self.draws[0]
        count = TO_FIRST_ORDER * options.evaluations
        say("computing the effect of the motion to first order")
        try:
            linear = LinearRecording.from_simulations(self.recording, middle)
        except SimulationError:
            return SearchResult()

        def report(number: int, size: float) -> None:
            """Report every `NEWS` evaluations the smallest error bar, `size` as a logarithm."""
            if number % NEWS == 0:
                size = 100 * np.exp(size)
                say(
                    f"first-order evaluation: {number} of {count} motions, smallest error bar "
                    f"{size:.3g} %"
                )

        def value(coefficients: Array, _: float) -> float:
            """Return the logarithm of the error bar at the first draw, to first order; the bound is
            not used.
            """
            information = linear.information(self.motion(coefficients))
            return self.criterion.log_size(self.errors(information, middle))

        size = HandMotion.coefficient_count(options.waves)
        return minimise(value, size, evaluations=count, seed=options.seed, watch=report)

    def value(self, coefficients: Array, bound: float) -> float:
        """Return the logarithm of the relative error bar of a motion, combined over the draws;
        between one and two times `FORBIDDEN` if a marker leaves the views, between two and three
        times if a simulation fails.

        If the value at the middle of the prior exceeds `bound`, it is returned, and the other draws
        are not simulated.

        Parameters
        ----------
        coefficients : (d,) array
            Unbounded coefficients of the motion, which is scaled to the limits of the robot.
        bound : float
            Bound beyond which the value need not be exact; infinite for none.
        """
        experiment = self.recording.experiment(self.recording.poses(self.motion(coefficients)))
        sizes = []
        for q in self.draws:
            try:
                information, markers_m = self.recording.simulate_motion(experiment, q)
            except SimulationError as failure:
                simulated_share = (failure.time_s - experiment.t_s[0]) / experiment.duration_s
                return FORBIDDEN * (3 - min(1.0, simulated_share))
            if (excess := self.limits.out_of_view(markers_m)) > 0:
                return FORBIDDEN * (1 + excess / (1 + excess))
            sizes.append(self.criterion.log_size(self.errors(information, q)))
            if len(sizes) == 1 and sizes[0] > bound:
                break
        return self.criterion.combine_draws(sizes)


def design_motion(
    problem: Problem,
    limits: Limits,
    duration_s: float,
    criterion: DesignCriterion = WORST,
    options: DesignOptions = USUAL,
    *,
    experiment: str | None = None,
    add: bool = False,
    watch: Watch | None = None,
    say: Say = lambda _: None,
) -> Design:
    """Return the motion of the grasp that minimises the error bars, with its prediction.

    Ctrl-C ends the search, and the best motion so far is returned; before the first simulated
    motion, and while existing recordings are fitted, it raises `KeyboardInterrupt`.

    Parameters
    ----------
    problem : Problem
        Problem with an experiment that defines body, grasp, markers, noise, nuisance parameters and
        the initial pose of the hand; not modified.
    limits : Limits
        Limits of the robot.
    duration_s : float
        Duration of the motion [s].
    criterion : DesignCriterion
        Criterion to minimise.
    options : DesignOptions
        Options of the search.
    experiment : str, optional
        Name of the experiment; the first that is not static by default.
    add : bool
        Whether the new recording complements the existing ones: the parameters are then estimated
        from these first, and θ is drawn around the estimates according to their error bars.
        Otherwise the existing recordings are not used, and θ is drawn around the guesses.
    watch : callable, optional
        Function that is called with the number of motions and the logarithm of the smallest error
        bar.
    say : callable, optional
        Function that is called with the present activity, a text.

    Raises
    ------
    InputError
        For a duration that is not positive, a problem without guesses or without estimated
        parameters, an experiment that cannot be designed, limits that exclude the start, unknown
        names, recordings that cannot be fitted, and if no motion keeps the body simulable and the
        markers in view.
    SimulationError
        If the best motion cannot be simulated at some draw of θ.
    """
    if not 0 < duration_s < np.inf:
        raise InputError(
            f"found {duration_s:g}; expected a number of seconds above 0", None, where="--duration"
        )
    recording = FutureRecording(
        problem, _select_experiment(problem, experiment), duration_s=duration_s
    )
    recording.bounds(limits)
    recording.highest_hz(limits)
    if not problem.parameters.free:
        raise InputError(
            "every parameter is fixed; expected at least one that is estimated", problem.path
        )
    if add:
        say("identifying the parameters from the existing recordings")
        draws, known = _draws_from_recordings(problem, options)
    else:
        problem.require_guesses(
            "but a motion is designed for a value of each parameter",
            ", or --add to identify the parameter first",
        )
        draws = prior_draws(
            problem.parameters, options.spread, pairs=options.pairs, seed=options.seed
        )
        known = np.zeros((len(draws[0]),) * 2)
    objective = MotionObjective(
        recording, limits, criterion=criterion, draws=draws, known_information=known
    )
    criterion.require_known(objective.errors(0.0, draws[0]))
    first = objective.first_guess(options, say)
    say("searching for a motion")
    evaluations = 1 if first.is_interrupted else options.evaluations
    best = minimise(
        objective.value,
        HandMotion.coefficient_count(options.waves),
        evaluations=evaluations,
        seed=options.seed,
        watch=watch,
        start=first.coefficients,
    )
    best.is_interrupted |= first.is_interrupted
    if best.coefficients is None or best.value >= FORBIDDEN:
        raise InputError(_no_motion_message(best), problem.path)
    say("simulating the best motion")
    return _evaluate_design(objective, best, add=add)


def _evaluate_design(objective: MotionObjective, best: SearchResult, add: bool) -> Design:
    """Return the design with the best motion, its error bars and its simulation."""
    assert best.coefficients is not None
    recording = objective.recording
    motion = objective.motion(best.coefficients)
    experiment = recording.experiment(recording.poses(motion))
    after = objective.error_bars(experiment, recording)
    problem = recording.problem
    values = problem.parameters.values(objective.draws[0])
    predicted = simulate(
        experiment, values, integrator=problem.scheme, substeps=problem.choose_first_substeps()
    )
    return Design(
        recording,
        motion,
        experiment=with_markers(experiment, predicted.markers_m),
        predicted=predicted,
        criterion=objective.criterion,
        before=_before(objective, add),
        after=after,
        added=add,
        limits=objective.limits,
        shares=objective.bounds.shares(motion),
        best=best,
        draws=len(objective.draws),
    )


def _before(objective: MotionObjective, add: bool) -> ErrorBars | None:
    """Return the error bars to compare with, over all draws of `objective`.

    If the new recording is added (`add`) they are those of the existing recordings, else those of
    the motion of the template in the problem; None if that has a single pose or cannot be simulated
    at some draw.
    """
    if add:
        return objective.error_bars(None, objective.recording)
    recording = objective.recording
    template = recording.template
    if len(template.grasps[0].poses.t_s) < 2:
        return None
    shipped = replace(recording, duration_s=template.duration_s)
    try:
        return objective.error_bars(template, shipped)
    except SimulationError:
        return None


def _draws_from_recordings(problem: Problem, options: DesignOptions) -> tuple[list[Array], Array]:
    """Solve the recordings; return draws of q and their information."""
    solution = solve(problem)
    solution.unless_interrupted()
    if not solution.status.converged:
        raise InputError(
            f"the existing recordings could not be fitted ({solution.status.value}), so that a "
            "motion cannot be designed in addition to them; solve the problem first, or leave "
            "out --add",
            problem.path,
        )
    known = shared_information(linearise_fit(solution.collocation, solution.z))
    constants = ThetaMap(problem.parameters, problem.experiments[0].body)
    errors = PredictedErrors.from_information(
        known, problem.parameters, constants=constants, q=solution.q
    )
    # A poorly determined parameter is drawn as far around the estimate as around a guess.
    largest_deviation = np.log(options.spread)
    deviations = np.sqrt(np.diag(errors.covariance))
    factors = np.minimum(1.0, largest_deviation / deviations)
    root = factors[:, None] * np.linalg.cholesky(errors.covariance)
    return symmetric_draws(
        problem.parameters, solution.q, root=root, pairs=options.pairs, seed=options.seed
    ), known


def _select_experiment(problem: Problem, name: str | None) -> Experiment:
    """Return the experiment with a name, or the first that is not static if `name` is None."""
    moving = [each for each in problem.experiments if not each.is_static]
    if not moving:
        raise InputError(
            "every experiment is static; expected at least one that moves", problem.path
        )
    if name is None:
        return moving[0]
    named = {each.name: each for each in moving}
    require_among(name, named, source=problem.path, where="--experiment")
    return named[name]


def _no_motion_message(best: SearchResult) -> str:
    """Return a message that says why no motion was found, with a remedy: no simulation reached its
    end, or markers left the views. `best` is the result of the search, whose value is at least
    `FORBIDDEN`.
    """
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
