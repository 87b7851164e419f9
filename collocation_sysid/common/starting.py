"""Ctrl-C and SIGTERM while the command line starts.

This module is imported before all others and imports only what Python itself has imported, so that
an interrupt during the imports ends the program without a traceback.
"""

from __future__ import annotations

import _signal  # `signal` imports others
import os
import sys

COMMAND = "collocation-sysid"


def leave_at_once(number: int, _: object) -> None:
    """End the process with the exit code of a signal."""
    os._exit(128 + number)


# Ctrl-C and SIGTERM end the command line during its imports with its own exit codes.
try:
    if os.path.splitext(os.path.basename(sys.argv[0]))[0] == COMMAND:
        for _number in (_signal.SIGINT, _signal.SIGTERM):
            if _signal.getsignal(_number) in (_signal.SIG_DFL, _signal.default_int_handler):
                _signal.signal(_number, leave_at_once)
except ValueError:  # handlers can be set in the main thread alone
    pass
