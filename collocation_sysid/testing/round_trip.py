"""Round trips of an extension: pickling, and a problem file that names its Python file."""

from __future__ import annotations

import pickle
import tomllib
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import tomli_w
from numpy.typing import ArrayLike

from ..problem.code_loader import CodeLoader
from .property_check import PropertyCheck

T = TypeVar("T")


def check_pickling(check: PropertyCheck, extension: T, evaluate: Callable[[T], ArrayLike]) -> None:
    """Require that a copy of an extension, as a worker of a cluster gets it, has the same values.

    Functions without a name in a module are pickled with cloudpickle, as on a Dask cluster. Where
    cloudpickle is not installed, the standard pickler is tried, and an extension that it cannot
    pickle is not checked.

    Parameters
    ----------
    evaluate : callable
        Values of the extension at a state.

    Raises
    ------
    AssertionError
        If the extension cannot be pickled, or its copy has other values.
    """
    has_cloudpickle = find_spec("cloudpickle") is not None
    pickler = import_module("cloudpickle") if has_cloudpickle else pickle
    try:
        copy = pickle.loads(pickler.dumps(extension))
    except Exception as error:  # picklers raise errors of many types
        if not has_cloudpickle:
            return
        check.fail(
            "pickling fails, so that no cluster can evaluate it",
            f"{type(error).__name__}: {error}",
            expected="a function that refers to no open file, lock or CasADi symbol",
        )
    check.require_equal(
        evaluate(copy), evaluate(extension), statement="the pickled copy has other values"
    )


def check_problem_file(
    check: PropertyCheck,
    file: str | Path,
    table: Mapping[str, Any],
    *,
    load: Callable[[CodeLoader, Mapping[str, Any]], T],
    extension: T,
    evaluate: Callable[[T], ArrayLike],
    key: str = "function",
) -> None:
    """Require that a problem file with the table of an extension gives the same extension.

    The table is written as TOML, read again, and its Python file is run, as with ``--allow-code``.

    Parameters
    ----------
    file : str or Path
        Python file of the extension.
    table : mapping
        Table of the problem file, in which the Python file is named without its folder.
    load : callable
        ``load(loader, table)`` → the extension that the problem file gives.
    extension : object
        Extension that is checked.
    evaluate : callable
        Values of an extension at a state.
    key : str
        Key of the table with the name of the function or row in the file.

    Raises
    ------
    AssertionError
        If the file gives another extension, or a wrong name in it is not refused.

    Notes
    -----
    `InputError`, if the table or the file is refused, is not caught. The file is run once for each
    of the two loads.
    """
    loader = CodeLoader(Path(file).parent, is_allowed=True)
    written = tomllib.loads(tomli_w.dumps(table))
    check.require_equal(
        evaluate(load(loader, written)),
        evaluate(extension),
        statement=f"the one that a problem file reads from {Path(file).name} has other values",
    )
    misspelt = f"no_{table[key]}"
    check.require_refusal(
        lambda: load(loader, {**table, key: misspelt}),
        naming=misspelt,
        statement=f"the {key} {misspelt!r} in a problem file",
    )
