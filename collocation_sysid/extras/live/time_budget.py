"""Computing time of time steps, to decide how many of them fit into the rest of a frame.

Time steps that are computed together share a fixed cost, so the first one takes longer than each
further one.
"""

from __future__ import annotations

from dataclasses import dataclass

# Decay per frame of the longest observed delay: time steps that might exceed the budget are not
# started, and an occasional long one is forgotten.
DELAY_DECAY = 0.85
# Decay per frame of the time after the time steps, which contains work that only some frames need.
REMAINDER_DECAY = 0.97


@dataclass
class TimeBudget:
    """Computing times of time steps that are computed together [s]."""

    # Time of the first one, and of each further one; zero if not known yet.
    first_s: float = 0.0
    more_s: float = 0.0
    delay: float = 1.0  # largest recent ratio of measured to expected time
    turn_s: float = 0.0  # time to change the linearisation point of a pass
    # Time of the last frame without repeated time steps; set by the user of this class.
    frame_s: float = 0.0
    after_s: float = 0.0  # time of the work that follows the time steps of a frame

    @classmethod
    def from_times(cls, one_s: float, many_s: float, many: int) -> TimeBudget:
        """Return the budget from the times of one time step, `one_s`, and of `many` that are
        computed together, `many_s` [s].

        The time of a further step is limited to values from 0 to `one_s`, since measurements
        scatter; it is `one_s` if `many` is 1.
        """
        more_s = (many_s - one_s) / (many - 1) if many > 1 else one_s
        return cls(one_s, min(max(more_s, 0.0), one_s))

    def affordable_steps(self, remaining_s: float) -> int:
        """Return how many time steps fit into the remaining time [s] of a frame, after the time for
        the work that follows; 0 if none.

        Expected times are multiplied by `delay`. If the time of a further step is zero or not
        known, the number is at most 1.
        """
        remaining_s -= self.after_s
        spare_s = remaining_s / self.delay - self.first_s
        if remaining_s <= 0 or spare_s < 0:
            return 0
        return 1 + int(min(spare_s / self.more_s, 1e6)) if self.more_s else 1

    def record_steps(self, rows: int, took_s: float) -> None:
        """Raise `delay`, in place, to the ratio of measured to expected time of some time steps.

        A smaller ratio changes nothing, nor does an unknown expected time.

        Parameters
        ----------
        rows : int
            Number of time steps that were computed together.
        took_s : float
            Their measured time [s].
        """
        expected_s = self.first_s + (rows - 1) * self.more_s
        if expected_s:
            self.delay = max(self.delay, took_s / expected_s)

    def record_relinearisation(self, took_s: float) -> None:
        """Record the time `took_s` [s] of a change of the linearisation point in `turn_s`, if it is
        longer than that; a shorter one changes nothing.
        """
        self.turn_s = max(self.turn_s, took_s)

    def record_remainder(self, took_s: float) -> None:
        """Record the time `took_s` [s] of the work after the time steps of a frame in `after_s`.

        The largest one counts, but decays slowly, by `REMAINDER_DECAY` at each call, because not
        every frame needs all of that work.
        """
        self.after_s = max(REMAINDER_DECAY * self.after_s, took_s)

    def start_frame(self) -> None:
        """Start another frame: let `delay` (not below 1) and `turn_s` decay, in place."""
        self.delay = max(1.0, DELAY_DECAY * self.delay)
        self.turn_s *= DELAY_DECAY
