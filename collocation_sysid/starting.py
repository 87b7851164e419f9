"""Ctrl-C and SIGTERM for the command line, from its first moment.

Until all modules are there an interrupt ends the program as it ends any other, without a traceback
of imports.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path

COMMAND = "collocation-sysid"


def _end_quietly() -> None:
    """Let Ctrl-C end the process at once, if it is the command line's and not told otherwise."""
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if Path(sys.argv[0]).stem == COMMAND and handled and _in_main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def heed_interrupts() -> Callable[[], None]:
    """From here on Ctrl-C and SIGTERM raise `KeyboardInterrupt`: results are kept, both times.

    Returns what makes it as it was.
    """
    numbers = (signal.SIGINT, signal.SIGTERM) if _in_main_thread() else ()
    changed = [number for number in numbers if signal.getsignal(number) is signal.SIG_DFL]
    for number in changed:
        signal.signal(number, signal.default_int_handler)

    def restore() -> None:
        for number in changed:
            signal.signal(number, signal.SIG_DFL)

    return restore


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


_end_quietly()
