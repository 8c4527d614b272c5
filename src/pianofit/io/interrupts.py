"""Interrupts end a command at once, with one line, and leave no unfinished file. This module imports nothing large."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

# Signals that end a command. Windows has no SIGHUP.
_ENDS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_CLEANUPS: list[Callable[[], None]] = []  # of all blocks of `cleanup_on_interrupt`, the innermost last
UNFINISHED: set[Path] = set()  # temporary files that an interrupt removes


@contextlib.contextmanager
def cleanup_on_interrupt(cleanup: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Make Ctrl-C, SIGTERM and SIGHUP call `cleanup`, and that of each enclosing block, and exit immediately.

    The exit status is 128 and the number of the signal. A SIGHUP or SIGTERM that is ignored, as by nohup, stays so, and
    so does a handler that is not Python's. Shells ignore SIGINT in background jobs, but a SIGINT that is sent to one is
    meant.

    An exception would unwind through the compiler, or end Python while the compiler runs in another thread. Both crash
    the process. An exception during an import is sometimes ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _CLEANUPS.append(cleanup)
    before = {number: handler for number in _ENDS if (handler := signal.getsignal(number)) is not None}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN or number == signal.SIGINT:
            signal.signal(number, _stop)
    try:
        yield
    finally:
        _CLEANUPS.pop()
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop(number: int, *_: object) -> None:
    """Clean up and exit."""
    for cleanup in reversed(_CLEANUPS):
        cleanup()
    for file in [*UNFINISHED]:
        with contextlib.suppress(OSError):
            file.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # standard error can be closed
        cursor = "\x1b[?25h" if os.isatty(2) else ""  # a progress bar hides the cursor
        os.write(2, f"{cursor}pianofit: interrupted; nothing more is written\n".encode())
    os._exit(128 + number)
