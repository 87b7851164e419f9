"""A ladder of horizons: growing first parts of every recording, solved one after another."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

from pydantic import AfterValidator

from ..checked import Positive

# Fewest samples, or rows of a grid, of a part.
FEWEST = 8


def part_of(count: int, share: float) -> int:
    """How many of `count` a share is."""
    return min(count, max(FEWEST, round(share * count)))


def _ascending(shares: tuple[float, ...]) -> tuple[float, ...]:
    ascending = all(a < b for a, b in pairwise(shares))
    if not ascending or shares[-1:] != (1.0,):
        raise ValueError(f"found {list(shares)}; expected numbers above 0 that ascend to 1")
    return shares


Shares = Annotated[tuple[Positive, ...], AfterValidator(_ascending)]
SHARES = (0.25, 0.5, 1.0)
