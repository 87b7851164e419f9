"""Ctrl-C and SIGTERM for the command line, from its first moment.

Until all modules are there an interrupt ends the program as it ends any other, without a traceback
of imports.
"""

from __future__ import annotations

import signal
import sys
import threading
from pathlib import Path

COMMAND = "collocation-sysid"


def _end_quietly() -> None:
    """Let Ctrl-C end the process at once, if it is the command line's and not told otherwise."""
    handled = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if Path(sys.argv[0]).stem == COMMAND and handled and _in_main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def heed_interrupts() -> None:
    """From here on Ctrl-C and SIGTERM raise `KeyboardInterrupt`: results are kept, both times."""
    if not _in_main_thread():
        return
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


_end_quietly()
