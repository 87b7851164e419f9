"""Ctrl-C and SIGTERM for the command line, from its first moment to its last.

Until all modules are there an interrupt ends the program as it ends any other, without a traceback
of imports. So this module is imported before all others and imports next to nothing.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn

COMMAND = "collocation-sysid"
# Name of a thread that is left in a library's code, which no signal reaches.
LEFT = "left behind"


def _end_quietly() -> None:
    """Let Ctrl-C end the process at once, if it is the command line's and not told otherwise."""
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    command = os.path.splitext(os.path.basename(sys.argv[0]))[0]
    if command == COMMAND and handled and _in_main_thread():
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


def leave(code: object) -> NoReturn:
    """End the process with a code; at once where a thread is left that would crash at its exit."""
    if not any(thread.name == LEFT for thread in threading.enumerate()):
        sys.exit(code if isinstance(code, int) else 1)
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):
            stream.flush()
    os._exit(code if isinstance(code, int) else 1)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


_end_quietly()
