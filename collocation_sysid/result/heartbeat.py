"""A line now and then about long work, where no terminal shows it live."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

# The first line comes after this time, the next ones when it has grown by this share.
FIRST_S, SHARE = 10.0, 0.5


class Heartbeat:
    """Tells what is being done, from a thread of its own: also while one call takes minutes.

    Parameters
    ----------
    doing : callable that returns what is being done now
    tell : callable that shows a line
    first_s : float, optional
        When the first line comes.
    """

    NAME = "heartbeat"

    def __init__(
        self, doing: Callable[[], str], tell: Callable[[str], None], first_s: float | None = None
    ) -> None:
        self._doing, self._tell = doing, tell
        self._first_s = FIRST_S if first_s is None else first_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, name=self.NAME, daemon=True)

    def start(self) -> None:
        """Begin to count."""
        self._thread.start()

    def stop(self) -> None:
        """No line comes after this."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _beat(self) -> None:
        began, passed_s = time.monotonic(), 0.0
        while not self._ended.wait(max(self._first_s, SHARE * passed_s)):
            passed_s = time.monotonic() - began
            self._tell(f"{self._doing()} ({passed_s:.3g} s so far)")
