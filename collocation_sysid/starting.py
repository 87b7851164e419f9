"""Handling of Ctrl-C and SIGTERM by the command line.

This module is imported before all others and imports almost nothing, so that an interrupt during
the imports ends the program without a traceback.
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
    """Restore the default action of Ctrl-C, if this process is the command line and nothing else
    was set.
    """
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    command = os.path.splitext(os.path.basename(sys.argv[0]))[0]
    if command == COMMAND and handled and _in_main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def heed_interrupts() -> Callable[[], None]:
    """Let Ctrl-C and SIGTERM raise `KeyboardInterrupt`, so that results are kept.

    Returns
    -------
    callable
        Function that restores the previous signal handlers.
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
    """End the process with an exit code.

    If a thread is still inside library code that would crash at exit, streams are flushed and the
    process ends without cleaning up.
    """
    if not any(thread.name == LEFT for thread in threading.enumerate()):
        sys.exit(code if isinstance(code, int) else 1)
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):
            stream.flush()
    os._exit(code if isinstance(code, int) else 1)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


_end_quietly()
