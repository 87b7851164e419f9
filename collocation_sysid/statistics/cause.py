"""A likely cause of a misfit: what may be described wrongly, and how sure that is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Cause:
    """Something of the description that fits far better otherwise.

    Attributes
    ----------
    cause : str
        Short name such as "poses-inverted".
    sentence : str
        What is likely wrong, and the remedy.
    strength : float
        Factor by which the misfit falls if this is assumed.
    """

    cause: str
    sentence: str
    strength: float


def ranked(causes: Iterable[Cause]) -> tuple[Cause, ...]:
    """Each cause once, likeliest first."""
    strongest: dict[str, Cause] = {}
    for cause in sorted(causes, key=lambda each: -each.strength):
        strongest.setdefault(cause.cause, cause)
    return tuple(strongest.values())
