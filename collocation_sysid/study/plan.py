"""What a study runs: every run is a problem file, overrides and a method.

So any of them can be repeated with ``collocation-sysid solve PROBLEM --method M --set …``.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..problem import Problem
from ..problem.reading import read_problem_file
from ..problem.schema import ParameterSection, ProblemFile
from .arguments import require_few
from .prediction import recordings
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


def plan_comparison(
    problem: Problem,
    methods: Sequence[str],
    overrides: Sequence[str] = (),
    starts: int = 1,
    spread: float = 10.0,
    seed: int = 0,
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
    starts : int
        Start 0 is the file's guess. The others are log-uniform within a factor `spread` of the
        truth, or of the guess where there is none, and clipped to the bounds. A start depends on
        the seed and its number alone, so that more of them can be asked for later.
    spread : float
    seed : int
    truth : mapping of name to value, optional
    allow_code : bool

    Raises
    ------
    InputError
        For a number of starts, spread or seed that cannot be, starts about a parameter that has
        neither guess nor truth, and a problem without a file.
    """
    _refuse_options(starts, spread, seed)
    path = _path_of(problem)
    if problem.substeps == "auto":  # or each method would choose for itself
        overrides = [*overrides, f"transcription.substeps={problem.first_substeps}"]
    planned = []
    for start in range(starts):
        moved = list(overrides) + _start_overrides(problem, truth or {}, start, spread, seed)
        file, _ = read_problem_file(path, moved)
        planned += [_planned(path, file, method, moved, start) for method in methods]
    return [replace(run, allow_code=allow_code) for run in planned]


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
        planned.append(_planned(path, file, method or file.solver.method, moved, swept=swept))
    return [replace(run, allow_code=allow_code) for run in planned]


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
        For a model that its problem file cannot have.
    """
    planned = []
    for held_out in ("", *recordings(problem)):
        for variant in variants:
            file, _ = read_problem_file(variant.path, variant.overrides)
            solver, swept = method or file.solver.method, {"model": variant.label}
            run = _planned(variant.path, file, solver, variant.overrides, 0, swept, held_out)
            planned.append(replace(run, allow_code=allow_code))
    return planned


def _path_of(problem: Problem) -> Path:
    if problem.path is None:
        raise InputError(
            "this problem has no file, which a study's processes read; write one, and take "
            "Problem.read"
        )
    return problem.path


def _refuse_options(starts: int, spread: float, seed: int) -> None:
    if starts < 1:
        raise InputError(f"found {starts}; expected 1 or more", None, "--starts")
    require_few(starts, "--starts", "starts")
    if not 1 <= spread < np.inf:
        raise InputError(f"found {spread:g}; expected a factor of 1 or more", None, "--spread")
    if seed < 0:
        raise InputError(f"found {seed}; expected a whole number, 0 or more", None, "--seed")


def _start_overrides(
    problem: Problem, truth: Mapping[str, float], start: int, spread: float, seed: int
) -> list[str]:
    if start == 0:
        return []
    free = problem.parameters.free
    exponents = np.random.default_rng([seed, start]).uniform(-1, 1, len(free))
    moved = []
    for item, exponent in zip(free, exponents, strict=True):
        centre = truth.get(item.name, item.guess)
        if centre is None:
            raise InputError(
                "has neither a guess nor a truth that starts could be spread about; expected one, "
                "or --starts 1",
                problem.path,
                f"parameters.{item.name}",
            )
        inside = float(np.clip(centre * spread**exponent, item.lower, item.upper))
        moved.append(f"parameters.{item.name}.guess={inside!r}")
    return moved


def _planned(
    path: Path,
    file: ProblemFile,
    method: str,
    overrides: Sequence[str],
    start: int = 0,
    swept: Mapping[str, str] | None = None,
    held_out: str | None = None,
) -> PlannedRun:
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
    of_study = start if held_out is None else f"without {held_out}"
    decisive = [content, of_study, _hashes_of_files(content, path.parent), _version()]
    text = json.dumps(decisive, sort_keys=True)
    key = hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]
    whole = str(path.resolve())
    changed, varied = tuple(overrides), dict(swept or {})
    return PlannedRun(key, whole, method, start, changed, guess, varied, held_out=held_out)


def _version() -> str:
    return version("collocation-sysid")


def _hashes_of_files(content: Any, folder: Path) -> dict[str, str]:
    """Hashes of the files that a problem names: other data is another run."""
    found = {}
    for text in _texts(content):
        try:
            if not (folder / text).is_file():
                continue
            data = (folder / text).read_bytes()
        except (OSError, ValueError):  # a text that is no file's name
            continue
        found[text] = hashlib.sha256(data).hexdigest()
    return found


def _texts(content: Any) -> Iterator[str]:
    if isinstance(content, str):
        yield content
    elif isinstance(content, Mapping):
        yield from itertools.chain.from_iterable(map(_texts, content.values()))
    elif isinstance(content, (list, tuple)):
        yield from itertools.chain.from_iterable(map(_texts, content))
