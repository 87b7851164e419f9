"""Orders and signs of coordinate axes, for hypotheses about exchanged or reversed axes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np

from ..common.array_types import Array


def with_other_axes(values: Array) -> Iterator[tuple[str, Array]]:
    """Yield vectors, (…, 3), with their axes in every other order and of every other sign, mirror
    images included, after a description such as "x, −z, y".
    """
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            if order == (0, 1, 2) and signs == (1, 1, 1):
                continue
            shown = ("−" * (sign < 0) + "xyz"[k] for k, sign in zip(order, signs, strict=True))
            yield ", ".join(shown), np.array(signs) * values[..., [*order]]
