"""Planning of studies: every run is a problem file with overrides and a method.

Each run can therefore be repeated with ``collocation-sysid solve PROBLEM --method M --set …``. Use
`plan_comparison` for methods and starts, and `plan_models` for models.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...common.validated_classes import validated
from ...common.validated_types import AtLeastOne, Count, OneOrMore
from ...errors import InputError
from ...problem import Problem
from ...problem.loading import read_problem_file
from ...problem.schema import ParameterSection, ProblemFile
from .model_variants import ModelVariant

# Kinds of studies: the names of their commands, which are in JSON and in folder names.
METHOD_STUDY = "compare-methods"
MODEL_STUDY = "compare-models"
STUDY_TITLES = {METHOD_STUDY: "Comparison of methods", MODEL_STUDY: "Comparison of models"}
# Methods that are compared by default: that of the paper, those of the literature, and those that the
# package recommends.
COMPARED_METHODS = (
    "penalty schedule=constant,penalty,penalty inner=levenberg-marquardt,augmented-lagrangian,shooting,"
    "casadi:sqpmethod,interior-point,reduced-space"
)
# Largest number of starts: more would be a mistake.
MOST_STARTS = 10_000


@dataclass(frozen=True)
class PlannedRun:
    """One run of a study."""

    problem: str  # absolute path of the problem file
    method: str  # name, and in a comparison of methods options KEY=VALUE, separated by spaces
    start: int = 0  # number of the start; 0 is the file's guess
    overrides: tuple[str, ...] = ()  # overrides "key=value"
    # mapping of str to float or None: guesses of the estimated parameters; None where there is
    # none.
    guess: Mapping[str, float | None] = field(default_factory=dict)
    model_name: str = ""  # label of the model, in a comparison of models
    allow_code: bool = False  # whether to run the Python files that the problem names
    # In a comparison of models, the recording that is predicted; "" if all are fitted. None in one
    # of methods.
    test_name: str | None = None

    @property
    def label(self) -> str:
        """Short description of the run for the user: model and held-out recording, or method and
        start; the runs of a study have different ones.
        """
        if self.test_name is None:
            return f"{self.method}, start {self.start}"
        return self.model_name + (f" without '{self.test_name}'" if self.test_name else "")

    def as_dict(self) -> dict[str, Any]:
        """Return the fields of the run as a dictionary, which JSON can represent."""
        return asdict(self)


@validated
class Starts:
    """Starts of the runs: the first at the file's guess, the others around the truth, or the guess
    without one.

    A start depends only on the seed, its number and the estimated parameters.

    Attributes
    ----------
    starts : int
        Number of initial guesses; the first is that of the problem file.
    spread : float
        Largest factor between an initial guess and the guess of the problem file.
    seed : int
        Seed of the random initial guesses.
    """

    starts: AtLeastOne = 1
    spread: OneOrMore = 10.0
    seed: Count = 0

    def __post_init__(self) -> None:
        if self.starts > MOST_STARTS:
            raise InputError(
                f"found {self.starts:,} starts; expected at most {MOST_STARTS:,}: give fewer values",
                None,
                where="starts",
            )

    def overrides(self, problem: Problem, truth: Mapping[str, float], start: int) -> Iterator[str]:
        """Yield the overrides "parameters.NAME.guess=VALUE" of one start: guesses of the estimated
        parameters, log-uniform around truth or guess within the factor `spread`, limited to the
        bounds.

        Parameters
        ----------
        truth : mapping of str to float
            True values by name; parameters that it lacks are distributed around their guess.
        start : int
            Number of the start; 0 yields nothing.

        Raises
        ------
        InputError
            For a parameter with neither a guess nor a true value.
        """
        free = problem.parameters.free if start else ()
        exponents = np.random.default_rng([self.seed, start]).uniform(-1, 1, len(free))
        for item, exponent in zip(free, exponents, strict=True):
            centre = truth.get(item.name, item.guess)
            if centre is None:
                raise InputError(
                    "this parameter has neither a guess nor a true value around which initial guesses "
                    "could be distributed; expected one of them, or --starts 1",
                    problem.path,
                    where=f"parameters.{item.name}",
                )
            inside = float(np.clip(centre * self.spread**exponent, item.lower, item.upper))
            yield f"parameters.{item.name}.guess={inside!r}"


def plan_comparison(
    problem: Problem,
    methods: Sequence[str],
    overrides: Sequence[str] = (),
    starts: Starts | None = None,
    truth: Mapping[str, float] | None = None,
    allow_code: bool = False,
) -> list[PlannedRun]:
    """Return a run of every method from every start; all methods have the same starts and time
    grid. `methods` are those of `parse_methods`; unless an option states it otherwise, interior
    point starts from a simulation too, not at the answer of reduced space.

    An automatic number of substeps is replaced by the problem's first one, so that the methods do
    not choose their own. Runs are ordered by start, then by method.

    Parameters
    ----------
    problem : Problem
        Problem read from its file with the same overrides.
    overrides : sequence of str
        Overrides "key=value".
    starts : Starts, optional
        Starts; the file's guess alone by default.
    truth : mapping of str to float, optional
        True values by name.
    allow_code : bool
        Whether to run the Python files that the problem names.

    Raises
    ------
    InputError
        For starts around a parameter without guess and true value, and for a problem without a
        file.
    """
    starts = starts or Starts()
    if problem.path is None:
        raise InputError(
            "this problem has no file, but the processes of a study read the problem from a "
            "file; write one, and use Problem.read"
        )
    if problem.substeps == "auto":  # or each method would choose for itself
        overrides = [*overrides, f"transcription.substeps={problem.choose_first_substeps()}"]
    planned = []
    for start in range(starts.starts):
        start_overrides = [*overrides, *starts.overrides(problem, truth or {}, start=start)]
        for method in dict.fromkeys(map(_from_guess, methods)):
            name, *options = method.split()
            own = [*start_overrides, *(f"solver.{name}.{option}" for option in options)]
            file, _ = read_problem_file(problem.path, own)
            details = {"start": start, "allow_code": allow_code}
            planned.append(_planned_run(problem.path, file, method, own, **details))
    return planned


def _from_guess(method: str) -> str:
    """At the answer of reduced space IPOPT makes no iteration: there would be nothing to compare."""
    is_warm = method.startswith("interior-point") and " initial=" not in method
    return method + " initial=simulation" * is_warm


def plan_models(
    problem: Problem,
    variants: Sequence[ModelVariant],
    method: str | None = None,
    allow_code: bool = False,
) -> list[PlannedRun]:
    """Return runs that fit every model to all recordings, and to all but each one.

    Of a single recording, the last third is held out.

    Runs are ordered by the held-out recording, first "" (all are fitted), then by model.

    Parameters
    ----------
    method : str, optional
        Name of the method; the file's own by default.
    allow_code : bool
        Whether to run the Python files that the problem names.

    Raises
    ------
    InputError
        For a model that its problem file does not accept, and for a fitted recording that has
        neither markers nor a measured force, and is no test of a specimen.
    """
    require_predictable(problem)
    planned = []
    for test_name in ("", *fitted_recordings(problem)):
        for variant in variants:
            file, _ = read_problem_file(variant.path, variant.overrides)
            details = {
                "model_name": variant.label,
                "test_name": test_name,
                "allow_code": allow_code,
            }
            planned.append(
                _planned_run(
                    variant.path, file, method=method, overrides=variant.overrides, **details
                )
            )
    return planned


def require_predictable(problem: Problem) -> None:
    """Raise an `InputError` for a fitted recording that has neither markers nor a measured force,
    and is no test of a specimen: models are compared by their predictions of these.
    """
    for each in problem.experiments:
        is_compared = (
            each.markers.sample_count or each.sensors_by_grasp or each.specimen is not None
        )
        if not (each.validation or is_compared):
            raise InputError(
                f"'{each.name}' has neither markers nor a measured force; expected one of these, "
                "because models are compared by their predictions of these, not of images "
                "or readings"
            )


def fitted_recordings(problem: Problem) -> list[str]:
    """Return the names of the experiments of a problem that are fitted, in its order; those for
    validation are left out.
    """
    return [e.name for e in problem.experiments if not e.validation]


def _planned_run(
    path: Path, file: ProblemFile, method: str | None, overrides: Sequence[str], **more: Any
) -> PlannedRun:
    """Return the run of a file with its overrides."""
    guess = {
        name: section.guess
        for name, section in file.parameters.items()
        if isinstance(section, ParameterSection)
        and section.fixed is None
        and section.tied_to is None
    }
    return PlannedRun(
        str(path.resolve()),
        method=method or file.solver.method,
        overrides=tuple(overrides),
        guess=guess,
        **more,
    )
