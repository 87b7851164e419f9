"""How many rows there is time for: rows at once share what it takes to begin."""

from __future__ import annotations

from dataclasses import dataclass

# What is left after a frame of the longest delay: rows are not begun that might not end within the
# budget, and one that took long by chance is forgotten. What some frames take only, later.
FADING, SELDOM = 0.85, 0.97


@dataclass
class Budget:
    """Times of rows that are passed at once.

    Attributes
    ----------
    first_s, more_s : float
        Of the first, and of each more; zero where nothing is known yet.
    delay : float
        By how many times the last ones took longer.
    turn_s : float
        Of a pass to turn to another p.
    frame_s : float
        Of the last frame without rows that are passed again; its user sets it.
    after_s : float
        Of what follows the rows of a frame.
    """

    first_s: float = 0.0
    more_s: float = 0.0
    delay: float = 1.0
    turn_s: float = 0.0
    frame_s: float = 0.0
    after_s: float = 0.0

    @classmethod
    def of(cls, one_s: float, many_s: float, many: int) -> Budget:
        """From times of one row and of many."""
        more_s = (many_s - one_s) / (many - 1) if many > 1 else one_s
        return cls(one_s, min(max(more_s, 0.0), one_s))

    def rows(self, left_s: float) -> int:
        """How many there is time for."""
        left_s -= self.after_s
        spare_s = left_s / self.delay - self.first_s
        if left_s <= 0 or spare_s < 0:
            return 0
        return 1 + int(min(spare_s / self.more_s, 1e6)) if self.more_s else 1

    def took(self, rows: int, took_s: float) -> None:
        """Note how long some took."""
        expected_s = self.first_s + (rows - 1) * self.more_s
        if expected_s:
            self.delay = max(self.delay, took_s / expected_s)

    def turned(self, took_s: float) -> None:
        """Note how long a turn took."""
        self.turn_s = max(self.turn_s, took_s)

    def ended(self, took_s: float) -> None:
        """Note how long what followed the rows took; not every frame has all of it."""
        self.after_s = max(SELDOM * self.after_s, took_s)

    def forget(self) -> None:
        """Begin another frame."""
        self.delay = max(1.0, FADING * self.delay)
        self.turn_s *= FADING
