"""Horizon continuation: any method, on growing parts of every recording.

A long recording's loss has many local minima, of swings matched with the wrong period, and a wrong
guess may not survive it as a simulation; a short one's has few. So the first samples are solved
first, and every answer starts the next part: its parameters as the guess, and its positions too,
continued by a simulation, where the method takes a start.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import InputError, SimulationError
from ..experiment.experiment import Experiment
from ..nlp.collocation import Collocation
from ..nlp.marching import march_on
from ..nlp.parameters import Parameters
from .method import Method
from .multipliers import constraint_multipliers
from .solution import Iteration, Solution, Status, Timing
from .start import carried_rigidly

Watch = Callable[[Iteration], None]

# Fewest samples of a part.
MIN_SAMPLES = 8
NAME = "continuation"


@dataclass(frozen=True)
class ContinuationOptions:
    """Options of horizon continuation.

    Attributes
    ----------
    shares : tuple of float
        Shares of the samples solved one after another, ending with 1.
    stage : mapping
        What solves each: its `method`, "interior-point" by default, and options of that method by
        name, as in [solver] of a problem file.
    """

    shares: tuple[float, ...] = (0.25, 0.5, 1.0)
    stage: Mapping[str, Any] = field(default_factory=dict)


def solve(
    collocation: Collocation,
    options: ContinuationOptions | None = None,
    watch: Watch | None = None,
    start: Array | None = None,
    *,
    methods: Mapping[str, Method],
) -> Solution:
    """Solve growing parts of a problem with another method.

    Parameters
    ----------
    collocation : Collocation
    options : ContinuationOptions, optional
    watch : callable, optional
        Called with every `Iteration` of every stage; numbers and times go on.
    start : (variables,) ndarray, optional
        Variables of the whole problem that the first stage starts from.
    methods : mapping
        The methods to choose from, by name.

    Returns
    -------
    Solution
        Of the whole problem, also when a stage was interrupted or refused; the notes tell what
        each stage found.

    Raises
    ------
    InputError
        For shares that do not ascend to 1, an unknown method, or an option it does not have.
    """
    options = options or ContinuationOptions()
    _check_shares(options.shares)
    climb = _Climb(collocation, *_chosen(options.stage, methods), watch)
    if start is not None:
        q, positions = collocation.unpack(start)
        climb.known = (q, positions, collocation.unpack_own(start))
    for share in options.shares:
        if not climb.solve(share):
            break
    return climb.answer()


def first_samples(experiment: Experiment, count: int) -> Experiment:
    """The first samples of a recording, as many as wanted and needed to see a marker."""
    seen = int(np.flatnonzero(experiment.markers.present.any(axis=1))[0])
    stop = min(len(experiment.t_s), max(count, seen + 1, 3))
    markers = experiment.markers
    shorter = replace(markers, t_s=markers.t_s[:stop], positions_m=markers.positions_m[:stop])
    return replace(experiment, t_s=experiment.t_s[:stop], markers=shorter)


def first_part(collocation: Collocation, share: float, parameters: Parameters) -> Collocation:
    """The problem on a share of every experiment's samples, with a guess of its own."""
    experiments = [segment.experiment for segment in collocation.segments]
    counts = [max(MIN_SAMPLES, round(share * len(e.t_s))) for e in experiments]
    return Collocation(
        [first_samples(e, count) for e, count in zip(experiments, counts, strict=True)],
        parameters,
        collocation.scheme,
        collocation.substeps,
        collocation.segments[0].explicit_grasps,
        collocation.huber,
    )


class _Climb:
    """The state between stages: what is known, and what is to be reported."""

    def __init__(
        self,
        collocation: Collocation,
        name: str,
        method: Method,
        options: Any,
        watch: Watch | None,
    ) -> None:
        self.collocation, self.name, self.method, self.options = collocation, name, method, options
        self.takes_start = "start" in inspect.signature(method.solve).parameters
        self.watch = watch
        self.began = time.perf_counter()
        # q, positions as far as they were solved, and each experiment's own unknowns.
        self.known: tuple[Array, list[Array], list[Array]] | None = None
        self.last: Solution | None = None
        self.iterations = self.evaluations = 0
        self.history: list[Iteration] = []
        self.timing = Timing()
        self.notes: list[str] = []

    def solve(self, share: float) -> bool:
        """Solve one part; whether to go on."""
        whole = share == 1 and self.takes_start
        part = self.collocation if whole else first_part(self.collocation, share, self._guess())
        given = {}
        if self.takes_start and self.known is not None:
            given = {"start": _continued(part, *self.known)}
        before, elapsed = self.iterations, self._elapsed()

        def follow(line: Iteration) -> None:
            moved = replace(line, number=line.number + before, time_s=line.time_s + elapsed)
            self.history.append(moved)
            if self.watch is not None:
                self.watch(moved)

        found = self.method.solve(part, self.options, follow, **given)
        self._learn(found, share)
        return found.status not in (Status.INTERRUPTED, Status.REFUSED)

    def answer(self) -> Solution:
        """The last stage's answer as one of the whole problem."""
        assert self.last is not None
        last, collocation = self.last, self.collocation
        z, multipliers = last.z, last.multipliers
        if last.collocation is not collocation:
            z, multipliers = self._whole()
        return Solution(
            status=last.status,
            message=last.message,
            method=NAME,
            collocation=collocation,
            z=z,
            multipliers=multipliers,
            iterations=self.iterations,
            history=tuple(self.history),
            timing=replace(self.timing, total=self._elapsed()),
            notes=(*self.notes, *last.notes),
            evaluations=self.evaluations,
        )

    def _learn(self, found: Solution, share: float) -> None:
        self.last = found
        _, positions = found.collocation.unpack(found.z)
        self.known = (found.q, positions, found.collocation.unpack_own(found.z))
        self.iterations += found.iterations
        self.evaluations += found.evaluations
        spent, more = self.timing, found.timing
        self.timing = Timing(
            spent.build + more.build,
            spent.evaluations + more.evaluations,
            spent.linear_algebra + more.linear_algebra,
        )
        values = ", ".join(f"{name} = {value:.4g}" for name, value in found.parameters.items())
        self.notes.append(
            f"{100 * share:.3g} % of the samples by {self.name}: {found.status.value} after "
            f"{found.iterations} iterations, {values}"
        )

    def _guess(self) -> Parameters:
        """The problem's parameters with what is known as their guess."""
        parameters = self.collocation.parameters
        if self.known is None:
            return parameters
        values = parameters.values(self.known[0])
        return parameters.with_guess(
            {i.name: float(np.clip(values[i.name], i.lower, i.upper)) for i in parameters.free}
        )

    def _whole(self) -> tuple[Array, Array]:
        """Variables and multipliers of the whole problem."""
        assert self.known is not None
        collocation = self.collocation
        z = _continued(collocation, *self.known)
        try:
            return z, constraint_multipliers(collocation, z)
        except SimulationError:
            return z, np.zeros(collocation.constraints)

    def _elapsed(self) -> float:
        return time.perf_counter() - self.began


def _continued(
    collocation: Collocation, q: Array, positions: list[Array], own: list[Array]
) -> Array:
    """Variables z from the first rows of positions: simulated on, or carried by the grasp."""
    settings = collocation.settings(np.concatenate([q, *own]))
    whole = []
    for segment, setting, x, phi in zip(
        collocation.segments, settings, positions, own, strict=True
    ):
        known = x[: segment.grid_rows]
        if len(known) < segment.grid_rows:
            carried = carried_rigidly(segment, setting.theta)
            known, _ = march_on(segment.corrected(phi), setting.dynamics, setting.theta, known)
            known = np.concatenate([known, carried[len(known) :]])
        whole.append(known)
    return collocation.pack(q, whole, own)


def _check_shares(shares: tuple[float, ...]) -> None:
    ascending = all(a < b for a, b in zip((0.0, *shares), shares, strict=False))
    if not shares or not ascending or shares[-1] != 1:
        raise InputError(
            f"shares are {list(shares)}; expected numbers above 0 that ascend to 1", None, "solver"
        )


def _chosen(stage: Mapping[str, Any], methods: Mapping[str, Method]) -> tuple[str, Method, Any]:
    """Name, method and options of the stages."""
    given = dict(stage)
    name = given.pop("method", "interior-point")
    others = [known for known in methods if known != NAME]
    if name not in others:
        raise InputError(
            f"found {name!r}; expected one of {', '.join(others)}", None, "solver.stage.method"
        )
    method = methods[name]
    unknown = sorted(set(given) - method.option_names)
    if unknown:
        raise InputError(
            f"method {name!r} has no option {unknown[0]!r}; it has "
            f"{', '.join(sorted(method.option_names))}",
            None,
            "solver.stage",
        )
    return name, method, method.options(**given)
