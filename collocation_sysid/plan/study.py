"""What a study runs: every run is a problem file, overrides and a method.

So any of them can be repeated with ``collocation-sysid solve PROBLEM --method M --set …``.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ..checked import AtLeastOne, Count, OneOrMore, Options
from ..errors import InputError
from ..problem import Problem
from ..problem.reading import read_problem_file
from ..problem.schema import ParameterSection, ProblemFile
from ..recording.formats.logs import stored_files
from .arguments import require_few
from .variants import Variant

KEY_LENGTH = 20


@dataclass(frozen=True)
class PlannedRun:
    """One run of a study.

    Attributes
    ----------
    key : str
        Hash of all that decides the result: problem, data files, method, start, options, version.
    problem : str, the problem file's whole path
    method : str
    start : int, 0 is the file's guess
    overrides : tuple of "key=value"
    guess : mapping of the estimated parameters to their guesses, None where there is none
    swept : mapping of swept keys to their values as text
    allow_code : bool, run the Python files that the problem names
    held_out : str or None
        Where models are compared: the recording that is predicted, "" if all are fitted.
    """

    key: str
    problem: str
    method: str
    start: int = 0
    overrides: tuple[str, ...] = ()
    guess: Mapping[str, float | None] = field(default_factory=dict)
    swept: Mapping[str, str] = field(default_factory=dict)
    allow_code: bool = False
    held_out: str | None = None

    @property
    def label(self) -> str:
        """The run in a few words."""
        if self.held_out is not None:
            what = f" without '{self.held_out}'" if self.held_out else ""
            return f"{self.swept['model']}{what}"
        if not self.swept:
            return f"{self.method}, start {self.start}"
        return ", ".join(f"{short}={self.swept[key]}" for key, short in short_keys(self.swept))

    def as_dict(self) -> dict[str, Any]:
        """Content for JSON."""
        return asdict(self)


def short_keys(keys: Sequence[str] | Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Each dotted key with as much of its end as tells it from the others, and what it is of."""
    for key in keys:
        parts = key.split(".")
        least = 2 if parts[0] == "parameters" else 1
        ends = [".".join(parts[-count:]) for count in range(least, len(parts) + 1)]
        alone = (e for e in ends if sum(f".{other}".endswith(f".{e}") for other in keys) == 1)
        yield key, next(alone, key)


@dataclass(frozen=True)
class Starts(Options):
    """Where runs start: first at the file's guess, then about the truth, or the guess without one.

    A start depends on the seed and its number alone, so that more of them can be asked for later.

    Attributes
    ----------
    starts : int
        How many starts; the first is the file's guess.
    spread : float
        Starts lie within this factor of the guess.
    seed : int
        Seed by which starts are drawn.

    Raises
    ------
    InputError
        For a number, spread or seed that cannot be.
    """

    starts: AtLeastOne = 1
    spread: OneOrMore = 10.0
    seed: Count = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_few(self.starts, "starts", "starts")

    def overrides(self, problem: Problem, truth: Mapping[str, float], start: int) -> Iterator[str]:
        """Those of a start: log-uniform about truth or guess, and clipped to the bounds."""
        free = problem.parameters.free if start else ()
        exponents = np.random.default_rng([self.seed, start]).uniform(-1, 1, len(free))
        for item, exponent in zip(free, exponents, strict=True):
            centre = truth.get(item.name, item.guess)
            if centre is None:
                raise InputError(
                    "has neither a guess nor a truth that starts could be spread about; expected "
                    "one, or --starts 1",
                    problem.path,
                    f"parameters.{item.name}",
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
    """Every method from every start; all methods get the same starts, and the same time grid.

    Parameters
    ----------
    problem : Problem
        Read from its file with the same overrides.
    methods : sequence of str
    overrides : sequence of "key=value"
    starts : Starts, optional
        The file's guess alone by default.
    truth : mapping of name to value, optional
    allow_code : bool

    Raises
    ------
    InputError
        For starts about a parameter that has neither guess nor truth, and a problem without a file.
    """
    starts = starts or Starts()
    if problem.path is None:
        raise InputError(
            "this problem has no file, which a study's processes read; write one, and take "
            "Problem.read"
        )
    if problem.substeps == "auto":  # or each method would choose for itself
        overrides = [*overrides, f"transcription.substeps={problem.first_substeps}"]
    planned = []
    for start in range(starts.starts):
        moved = [*overrides, *starts.overrides(problem, truth or {}, start)]
        file, _ = read_problem_file(problem.path, moved)
        more = {"start": start, "allow_code": allow_code}
        planned += [_planned(problem.path, file, method, moved, **more) for method in methods]
    return planned


def plan_sweep(
    path: Path,
    over: Mapping[str, Sequence[str]],
    overrides: Sequence[str] = (),
    method: str | None = None,
    allow_code: bool = False,
) -> list[PlannedRun]:
    """Every combination of the swept values; the last key changes fastest.

    Raises
    ------
    InputError
        For a key or value that the problem file cannot have.
    """
    read_problem_file(path, overrides)
    planned = []
    for values in itertools.product(*over.values()):
        swept = dict(zip(over, values, strict=True))
        moved = [*overrides, *(f"{key}={value}" for key, value in swept.items())]
        try:
            file, _ = read_problem_file(path, moved)
        except InputError as error:
            where = "--over" if error.source == "--set" else error.source
            raise InputError(error.message, where, error.where) from error
        more = {"swept": swept, "allow_code": allow_code}
        planned.append(_planned(path, file, method, moved, **more))
    return planned


def plan_models(
    problem: Problem,
    variants: Sequence[Variant],
    method: str | None = None,
    allow_code: bool = False,
) -> list[PlannedRun]:
    """Every model fitted to all recordings, and to all but each; of one recording, its last third.

    Raises
    ------
    InputError
        For a model that its problem file cannot have, and a recording that has nothing to compare
        predictions with.
    """
    for each in problem.experiments:
        if not (each.validation or each.markers.samples or each.wrenches):
            raise InputError(
                f"'{each.name}' has neither markers nor a measured wrench; expected one of these, "
                "by which models are told apart: predictions are not compared with depth images or "
                "readings"
            )
    planned = []
    for held_out in ("", *recordings(problem)):
        for variant in variants:
            file, _ = read_problem_file(variant.path, variant.overrides)
            more = {"swept": {"model": variant.label}, "held_out": held_out}
            more |= {"allow_code": allow_code}
            planned.append(_planned(variant.path, file, method, variant.overrides, **more))
    return planned


def recordings(problem: Problem) -> list[str]:
    """Names of the recordings that are fitted."""
    return [e.name for e in problem.experiments if not e.validation]


def _planned(
    path: Path, file: ProblemFile, method: str | None, overrides: Sequence[str], **more: Any
) -> PlannedRun:
    """A run of a file as its overrides make it, by its own method if there is no other."""
    method, start = method or file.solver.method, more.get("start", 0)
    guess = {
        name: section.guess
        for name, section in file.parameters.items()
        if isinstance(section, ParameterSection)
        and section.fixed is None
        and section.tied_to is None
    }
    content = file.model_dump(mode="json", exclude_unset=True)
    solver = content.get("solver", {})
    content["solver"] = {key: solver[key] for key in ("huber", method) if key in solver}
    content["solver"]["method"] = method
    of_study = start if more.get("held_out") is None else f"without {more['held_out']}"
    hashes = _hashes_of_files(content, path.parent)
    decisive = [content, of_study, hashes, version("collocation-sysid")]
    text = json.dumps(decisive, sort_keys=True)
    key = hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]
    return PlannedRun(
        key, str(path.resolve()), method, overrides=tuple(overrides), guess=guess, **more
    )


def _hashes_of_files(content: Any, folder: Path) -> dict[str, str]:
    """Hashes of the files that a problem names: other data is another run."""
    hashes = {}
    for text in _texts(content):
        with suppress(OSError, ValueError):  # a text that is no file's name
            if files := stored_files(folder / text):
                each = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
                hashes[text] = " ".join(each)
    return hashes


def _texts(content: Any) -> Iterator[str]:
    if isinstance(content, str):
        yield content
    elif isinstance(content, Mapping):
        yield from itertools.chain.from_iterable(map(_texts, content.values()))
    elif isinstance(content, (list, tuple)):
        yield from itertools.chain.from_iterable(map(_texts, content))
