"""Horizon continuation: any method, on growing parts of every recording.

The loss of a long recording has many local minima, in which oscillations are matched with the wrong
period, and a simulation at a wrong guess may fail before its end; that of a short recording has
few. So the first samples are solved first, and each solution starts the next part: its parameters,
and its positions continued by a simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field, replace
from functools import cached_property
from typing import ClassVar

from ...common.array_types import Array
from ...common.validated_classes import validated
from ...common.validated_types import Shares
from ...errors import InputError, hint_at
from ...program.collocation import Collocation
from ...recording.experiment import Experiment
from ...recording.measurement_selection import shortened_experiment
from ...recording.time_tables import FEWEST_SHARED_SAMPLES
from ..comparison.casadi_nlp import Sleqp, SqpMethod
from ..comparison.penalty import AugmentedLagrangian, Penalty
from ..comparison.shooting import Shooting
from ..horizon import motion_shares, rows_of_share
from ..interior_point import InteriorPoint
from ..options import SHARES, MethodOptions, method_from_options
from ..reduced_space import ReducedSpace
from ..solution import Iteration, Method, Solution, Status, Watch
from ..solve_recorder import Recorder, best_iterate
from .initial_trajectories import complete_variables, simulate_trajectories

_ONE_HORIZON = (
    InteriorPoint,
    ReducedSpace,
    Penalty,
    AugmentedLagrangian,
    Shooting,
    SqpMethod,
    Sleqp,
)
# Methods that solve a horizon at once, by name.
STAGES: dict[str, type] = {kind.name: kind for kind in _ONE_HORIZON}


@validated
class Continuation(MethodOptions):
    """Continuation over the horizon: another method on growing parts of every recording.

    Attributes
    ----------
    shares : tuple of float
        Shares of the motion solved one after another, ending with 1.
    stage : mapping or Method
        Method that solves each part: its `method`, "interior-point" by default, and options of that
        method by name, as in the problem file; from Python any method.
    """

    name: ClassVar[str] = "continuation"

    shares: Shares = SHARES
    stage: Mapping[str, object] | Callable[..., Solution] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.method  # noqa: B018 - refuses a stage that makes no sense

    @cached_property
    def method(self) -> Method:
        """Method that solves the parts: `stage` itself unless that is a mapping of options.

        Raises
        ------
        InputError
            For an unknown method, or an option that it does not have.
        """
        if not isinstance(self.stage, Mapping):
            return self.stage
        options = dict(self.stage)
        name = options.pop("method", InteriorPoint.name)
        if name not in STAGES:
            known = f"expected one of {', '.join(STAGES)}{hint_at(str(name), STAGES)}"
            raise InputError(f"found {name!r}; {known}", None, where="stage.method")
        return method_from_options(STAGES[str(name)], options, key="stage")

    def __call__(
        self, collocation: Collocation, watch: Watch | None = None, start: Array | None = None
    ) -> Solution:
        """Solve the NLP on growing parts of the recordings, see `Method`.

        Numbers and times of the history continue from part to part. The solve ends with a part that
        was interrupted or refused; the notes contain the result of each part. A part that does not
        converge otherwise is followed by the next one. Exceptions of the method are not caught.
        """
        climb = _ContinuationState(self.method, Recorder(self.name, collocation, watch=watch))
        if start is not None:
            climb.known = collocation.unpack(start)
        for share in self.shares:
            if not climb.solve(share):
                break
        return climb.solution()


def first_samples(experiment: Experiment, count: int) -> Experiment:
    """Return the experiment with its first samples, see `shortened_experiment`.

    Parameters
    ----------
    count : int
        Number of samples; it is increased to three and to the first sample with a marker, and as in
        `shortened_experiment`, but not beyond the recording.
    """
    first_visible = experiment.markers.first_visible_sample
    count = max(count, first_visible + 1, FEWEST_SHARED_SAMPLES)
    return shortened_experiment(experiment, min(len(experiment.t_s), count))


def first_share(collocation: Collocation, share: float) -> Collocation:
    """Return the problem with the first share, from 0 to 1, of the motion in every fitted experiment,
    see `motion_shares`; validation recordings are left out.
    """
    pairs = zip(collocation.transcriptions, motion_shares(collocation), strict=True)
    shorter = [
        first_samples(each.experiment, (rows_of_share(motion, share) - 1) // each.substeps + 1)
        for each, motion in pairs
    ]
    return replace(collocation, experiments=shorter)


class _ContinuationState:
    """State between the parts: known positions, the last solution, and counts."""

    def __init__(self, method: Method, recorder: Recorder) -> None:
        self.method = method
        self.recorder = recorder
        # Parameters p, and positions as far as they were solved.
        self.known: tuple[Array, list[Array]] | None = None
        self.last: Solution | None = None
        self.iterations = self.evaluations = 0

    def solve(self, share: float) -> bool:
        """Solve the first share of the samples; return whether to continue."""
        recorder = self.recorder
        part = recorder.collocation if share == 1 else first_share(recorder.collocation, share)
        start = None if self.known is None else _continue_variables(part, *self.known)
        before = max([self.iterations, *(line.number for line in recorder.history[-1:])])
        elapsed_s = recorder.measure_elapsed_s()

        def record(line: Iteration) -> None:
            number = line.number + before
            time_s = line.time_s + elapsed_s
            recorder.add(replace(line, number=number, time_s=time_s, share=share * line.share))

        with best_iterate():  # an iterate of a part is none of the whole
            solution = self.method(part, record, start)
        self._add(solution, share)
        return solution.status not in (Status.INTERRUPTED, Status.REFUSED)

    def solution(self) -> Solution:
        """Return the solution of all; missing positions are simulated or move rigidly."""
        assert self.last is not None
        assert self.known is not None
        last = self.last
        recorder = self.recorder
        z = last.z
        multipliers = last.initial_multipliers
        if last.collocation is not recorder.collocation:
            z = _continue_variables(recorder.collocation, *self.known)
            multipliers = None
        recorder.notes += last.notes
        return recorder.solution(
            last.status,
            last.message,
            z=z,
            multipliers=multipliers,
            iterations=self.iterations,
            evaluations=self.evaluations,
        )

    def _add(self, solution: Solution, share: float) -> None:
        """Store a part as the last one, and add its counts, its times and a note."""
        self.last = solution
        part = solution.collocation
        self.known = part.unpack(solution.z)
        self.iterations += solution.iterations
        self.evaluations += solution.evaluations
        spent = solution.timing
        self.recorder.stopwatch.add(
            spent.build, spent.evaluations, linear_algebra=spent.linear_algebra
        )
        values = ", ".join(
            f"{name} = {value:.4g}"
            for name, value in part.parameters.scalar_values(solution.q).items()
        )
        self.recorder.notes.append(
            f"{100 * share:.3g} % of the samples by {solution.method}: {solution.status.value} "
            "after "
            f"{solution.iterations} iterations, {values}"
        )


def _continue_variables(collocation: Collocation, p: Array, positions: list[Array]) -> Array:
    """Return z; missing rows are simulated or, where that fails, move with the grasp."""
    parts = collocation.iterates_at(p, positions)
    known, _ = simulate_trajectories(
        collocation, p, known_rows=[part.x[: part.transcription.grid_times] for part in parts]
    )
    return complete_variables(collocation, p, known_rows=known)
