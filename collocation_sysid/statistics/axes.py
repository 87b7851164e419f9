"""Orders and signs of coordinate axes, for hypotheses about exchanged or reversed axes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np

from ..common.array_types import Array


def with_other_axes(values: Array, *, has_sign: bool = True) -> Iterator[tuple[str, Array]]:
    """Yield vectors, (…, 3k), with their axes in every other order and of every other sign, mirror
    images included, after a description such as "x, −z, y"; the opposite sign of all three axes
    only with `has_sign`.
    """
    vectors = values.reshape(*values.shape[:-1], -1, 3)
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            is_sign = order == (0, 1, 2) and len({*signs}) == 1
            if is_sign and (signs[0] > 0 or not has_sign):
                continue
            shown = ("−" * (sign < 0) + "xyz"[k] for k, sign in zip(order, signs, strict=True))
            turned = np.array(signs) * vectors[..., [*order]]
            yield ", ".join(shown), turned.reshape(values.shape)
