"""Ctrl-C, a request to end from the system and a closed terminal all end a command in the same way, once."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TypeVar

Item = TypeVar("Item")

# Windows knows no SIGHUP, and alone a SIGBREAK, that of Ctrl-Break.
NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
# Shells add the number of the signal to this.
ENDED_BY_SIGNAL = 128
INTERRUPTED = 130
# Seconds for which more signals after one change nothing; a saving that hangs can be ended after that.
PATIENCE = 5.0


class Terminated(KeyboardInterrupt):
    """Raised where a signal arrives, so that temporary files go and checkpoints are kept."""

    def __init__(self, number: int) -> None:
        super().__init__("interrupted" if number == signal.SIGINT else "terminated")
        self.exit_code = ENDED_BY_SIGNAL + number


@contextmanager
def termination_raises(heard: list[KeyboardInterrupt], ends_process: bool = False) -> Iterator[None]:
    """Raise :class:`Terminated` on the first signal within the block, and note it in ``heard``.

    Those that follow within a few seconds would disturb the saving that the first one has set off, and are ignored.
    So are those after an interrupted block that ends the process: they would disturb the end of the interpreter.  Any
    other block leaves the handlers as they were.  What is ignored from the start (``nohup``) stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    caught = [number for number in numbers if before[number] is not signal.SIG_IGN]
    last = -math.inf

    def stop(number: int, _: FrameType | None) -> None:
        nonlocal last
        if time.monotonic() - last > PATIENCE:
            last = time.monotonic()
            heard.append(Terminated(number))
            raise heard[-1]

    for number in caught:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number in caught:
            signal.signal(number, signal.SIG_IGN if heard and ends_process else before[number])


def until_interrupted(items: Iterable[Item]) -> Iterator[Item]:
    """Yield items until Ctrl-C, which ends a camera as its end does a file; the second one interrupts."""
    before, stopped = signal.getsignal(signal.SIGINT), threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopped.set()
        signal.signal(number, before)

    signal.signal(signal.SIGINT, stop)
    try:
        for item in items:
            if stopped.is_set():
                return
            yield item
    finally:
        signal.signal(signal.SIGINT, before)
