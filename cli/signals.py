"""A request to end, from the system or a closed terminal, ends a command the way Ctrl-C does."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

# Windows knows no SIGHUP.
NAMES = ("SIGTERM", "SIGHUP")
# Shells add the number of the signal to this.
ENDED_BY_SIGNAL = 128


class Terminated(KeyboardInterrupt):
    """Raised where a signal arrives, so that temporary files go and checkpoints are kept."""

    def __init__(self, number: int) -> None:
        super().__init__("terminated")
        self.exit_code = ENDED_BY_SIGNAL + number


@contextmanager
def termination_raises() -> Iterator[None]:
    """Raise :class:`Terminated` on SIGTERM and SIGHUP within the block; what is ignored (``nohup``) stays ignored."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    heard = [number for number in numbers if before[number] is not signal.SIG_IGN]
    for number in heard:
        signal.signal(number, _stop)
    try:
        yield
    finally:
        for number in heard:
            signal.signal(number, before[number])


def _stop(number: int, _: FrameType | None) -> None:
    raise Terminated(number)
