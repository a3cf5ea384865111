"""Ctrl-C between steps: a fit that stops in the middle of one could not be resumed to the same result."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupt:
    """Whether the user asked to stop."""

    requested = False


_current = Interrupt()                     # of the fit in the main thread, if there is one


def interrupt_requested() -> bool:
    """Whether Ctrl-C was pressed during the fit that runs in the main thread: callbacks that wait must return then."""
    return _current.requested


@contextmanager
def deferred_interrupt() -> Iterator[Interrupt]:
    """Within the block a first Ctrl-C only sets `requested`, and a second raises KeyboardInterrupt as ever.

    Outside the main thread, where Python delivers no signals, nothing changes.
    """
    global _current
    interrupt = Interrupt()
    if threading.current_thread() is not threading.main_thread():
        yield interrupt
        return
    _current = interrupt

    def request(_signal: int, _frame: FrameType | None) -> None:
        if interrupt.requested:
            raise KeyboardInterrupt
        interrupt.requested = True

    previous = signal.signal(signal.SIGINT, request)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, previous)
        _current = Interrupt()
