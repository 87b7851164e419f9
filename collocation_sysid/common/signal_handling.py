"""Handling of Ctrl-C and SIGTERM by the command line."""

from __future__ import annotations

import _thread
import atexit
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn

from .starting import leave_at_once

# Name of a thread that is left in a library's code, which no signal reaches.
ABANDONED_THREAD = "left behind"
# Files in whose functions an exception may be lost: the importer, the wrappers of CasADi and the
# transforms of matplotlib. Conversions of arguments in C++ call functions of Python and clear their
# errors. A pool of threads that an exception leaves while it starts one never ends that thread, for
# which the interpreter then waits.
LOSING = (
    "<frozen importlib._bootstrap>",
    os.path.join("casadi", "casadi.py"),
    os.path.join("matplotlib", "transforms.py"),
    os.path.join("concurrent", "futures", "thread.py"),
)
# Time after which a deferred signal tries again [s]: a person does not notice it.
RETRY_S = 0.05


class Interrupts:
    """Handler of signals that raises `KeyboardInterrupt`, but not within functions of `LOSING` and
    `deferred`.

    Libraries convert an exception within their imports into an error of their own, and others drop
    one within their conversions. There the first signal is deferred until the import or the function
    has ended: it is sent again every `RETRY_S`. A second signal in this time raises at once. At the
    end of a `deferred` block `KeyboardInterrupt` is raised if a signal came meanwhile. The last signal
    is `number`.
    """

    def __init__(self) -> None:
        self._deferring = 0
        self._timer: threading.Timer | None = None
        self._tries_again = False
        self.number = int(signal.SIGINT)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Defer the signal within a function of `LOSING` or a `deferred` block."""
        self.number = number
        is_second = self._timer is not None and not self._tries_again
        self._tries_again = False
        if not is_second and (self._deferring or _is_losing(frame)):
            self._repeat(number)
            return
        self.forget()
        raise KeyboardInterrupt

    @contextmanager
    def deferred(self) -> Iterator[None]:
        """Defer the first signal to the end of the block; blocks may be nested."""
        self._deferring += 1
        try:
            yield
        finally:
            self._deferring -= 1
        if not self._deferring:
            self.raise_deferred()

    def raise_deferred(self) -> None:
        """Raise `KeyboardInterrupt` if a signal is deferred."""
        if self._timer is not None:
            self.forget()
            raise KeyboardInterrupt

    def note_unraisable(self, failure: sys.UnraisableHookArgs) -> None:
        """Repeat a signal whose `KeyboardInterrupt` was raised where Python can only report it, as in
        a callback of the garbage collector; report other errors.
        """
        if failure.exc_type is KeyboardInterrupt:
            self._repeat(self.number)
        else:
            sys.__unraisablehook__(failure)

    def forget(self) -> None:
        """Drop a signal that is deferred; no effect without one."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None

    def _repeat(self, number: int) -> None:
        """Send the signal `number` once more after `RETRY_S`."""
        self._timer = threading.Timer(RETRY_S, self._try_again, (number,))
        self._timer.daemon = True
        self._timer.start()

    def _try_again(self, number: int) -> None:
        """Send the signal `number` to the main thread once more, marked as a repetition."""
        self._tries_again = True
        if os.name == "posix":  # also wakes a main thread that waits
            signal.pthread_kill(threading.main_thread().ident or 0, number)
        else:
            _thread.interrupt_main(number)


INTERRUPTS = Interrupts()


def _handle(handler: Any, replaced: tuple[object, ...]) -> None:
    """Set the handler of Ctrl-C and SIGTERM where it is one of the replaced ones."""
    if threading.current_thread() is threading.main_thread():  # others may set none
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) in replaced:
                signal.signal(number, handler)


def heed_interrupts() -> None:
    """Let Ctrl-C and SIGTERM raise `KeyboardInterrupt` as `Interrupts` does.

    A signal that is ignored or that has a handler of its own keeps it; outside of the main thread
    nothing is changed.
    """
    INTERRUPTS.number = int(signal.SIGINT)
    ENDED.status = None
    if threading.current_thread() is threading.main_thread():
        sys.unraisablehook = INTERRUPTS.note_unraisable
    _handle(INTERRUPTS, (signal.SIG_DFL, signal.default_int_handler, leave_at_once))


def ignore_interrupts() -> None:
    """Ignore the signals that `INTERRUPTS` has handled, until `leave`. `KeyboardInterrupt` is raised if
    a signal is deferred.
    """
    _handle(ENDED, (INTERRUPTS,))
    INTERRUPTS.raise_deferred()


class Ended:
    """Handler of signals after the end of a command: the process ends at once with the exit code that
    is known, for example where it waits for a thread.
    """

    status: int | None = None

    def __call__(self, _number: int, _frame: FrameType | None) -> None:
        if self.status is not None:
            os._exit(self.status)


ENDED = Ended()


def raises_interrupt(handler: object) -> bool:
    """Return whether a handler of signals is one that raises `KeyboardInterrupt`: Python's own or
    `INTERRUPTS`.
    """
    return handler is signal.default_int_handler or handler is INTERRUPTS


def leave(code: object) -> NoReturn:
    """End the process with an exit code: `code` if it is an integer, else 1 (also for None).

    If a thread with the name `ABANDONED_THREAD` is still inside library code that would crash at
    exit, the process ends without cleaning up; otherwise by `SystemExit`, and a signal until then ends
    it with the same code.
    """
    status = code if isinstance(code, int) else 1
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):
            stream.flush()
    if any(thread.name == ABANDONED_THREAD for thread in threading.enumerate()):
        os._exit(status)
    ENDED.status = status
    sys.exit(status)


def _is_losing(frame: FrameType | None) -> bool:
    """Return whether a frame, or one that called it, is of the files `LOSING`."""
    while frame is not None:
        if frame.f_code.co_filename.endswith(LOSING):
            return True
        frame = frame.f_back
    return False


# While the interpreter clears its modules, it sets other handlers to the default. What is registered
# first is called last.
atexit.register(_handle, signal.SIG_IGN, (ENDED,))
