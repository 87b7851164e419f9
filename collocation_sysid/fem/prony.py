"""Branches of a material's memory, by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ..errors import InputError
from .constants import SHARE, TAU, Constant


@dataclass(frozen=True)
class Prony:
    """A branch of the memory: a spring of `share` times the stiffness, behind a dashpot.

    Attributes
    ----------
    name : str
        Stands before the names of its constants: ``prony_1.share``, ``prony_1.tau_s``.
    """

    name: str

    def __post_init__(self) -> None:
        if not self.name or not self.name.replace("_", "").replace("-", "").isalnum():
            raise InputError(
                f"the branch's name is {self.name!r}; expected letters, digits, - and _, which "
                "stand before the names of its parameters"
            )

    @property
    def constants(self) -> tuple[Constant, Constant]:
        """Its share g and its relaxation time τ."""
        share, tau = (replace(c, name=f"{self.name}.{c.name}") for c in (SHARE, TAU))
        return share, tau


def as_branches(given: Sequence[str | Prony]) -> tuple[Prony, ...]:
    """Branches from their names, or themselves.

    Raises
    ------
    InputError
        For a name that cannot be one, or is there twice.
    """
    if isinstance(given, str):
        raise InputError(f"prony is {given!r}; expected a sequence of names")
    branches = tuple(b if isinstance(b, Prony) else Prony(b) for b in given)
    names = [branch.name for branch in branches]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two branches of a part are named {name!r}; names must differ")
    return branches
