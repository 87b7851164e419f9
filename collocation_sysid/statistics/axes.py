"""Orders and signs of coordinate axes, for hypotheses about exchanged or reversed axes."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

AxesOrder = tuple[tuple[int, ...], tuple[int, ...]]


def _other_axes() -> Iterator[tuple[str, AxesOrder]]:
    """Yield every order and signs of three axes except the identity, mirror images included, with
    their description; the order has indices of axes, the signs are 1 or −1.
    """
    for order in permutations(range(3)):
        for signs in product((1, -1), repeat=3):
            if order != (0, 1, 2) or min(signs) < 0:
                shown = ("−" * (sign < 0) + "xyz"[k] for k, sign in zip(order, signs, strict=True))
                yield ", ".join(shown), (order, signs)


# By a description such as "x, −z, y": the column of each axis, and its sign.
OTHER_AXES = dict(_other_axes())
