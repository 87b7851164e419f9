"""Identify what a soft object is made of from how it moves in a robot's hand.

>>> import collocation_sysid as cs
>>> problem = cs.Problem.read("problem.toml")         # doctest: +SKIP
>>> run = cs.run(problem)                             # doctest: +SKIP
>>> run.parameters, run.interval("mu_pa")             # doctest: +SKIP
"""

from . import signal_handling as _starting  # noqa: F401  (before all that takes time to import)

# isort: split
import ast as _ast
from importlib import import_module as _import_module
from importlib.metadata import version as _version
from pathlib import Path as _Path
from typing import Any as _Any


def _homes() -> dict[str, str]:
    """The module of each name, as the stub beside this file imports them."""
    stub = _ast.parse(_Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    lines = (each for each in stub.body if isinstance(each, _ast.ImportFrom))
    return {a.name: f".{each.module or a.name}" for each in lines for a in each.names}


_HOMES = _homes()
__all__ = [*_HOMES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> _Any:
    if name == "__version__":
        return _version("collocation-sysid")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = _import_module(_HOMES[name], __name__)
    attribute = home if _HOMES[name] == f".{name}" else getattr(home, name)
    return globals().setdefault(name, attribute)


def __dir__() -> list[str]:
    return [*globals(), *__all__, "__version__"]
