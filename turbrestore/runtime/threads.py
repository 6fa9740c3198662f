"""Work on a stream of items in threads, a few items ahead, results in order."""

from __future__ import annotations

import functools
import math
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, ContextDecorator, ExitStack, contextmanager
from itertools import islice
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

# Freeing an array of this size raises the threshold of glibc from which it maps arrays one by one; bytes, just below
# the largest, 32 MiB, that it follows.
_THRESHOLD_BYTES = 31 << 20
# Items that one thread sums before it hands the sum over, chosen.
_SUMMED = 4

Item = TypeVar("Item")
Early = TypeVar("Early")
Middle = TypeVar("Middle")
Result = TypeVar("Result")


def map_ahead(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    threads: int = 0,
    on_end: Callable[[], None] | None = None,
) -> Iterator[tuple[Item, Result]]:
    """Yield ``(item, function(item))`` in order while threads work a few items ahead.

    Memory is bounded by a handful of items and results, however many there are. The threads of OpenCV and BLAS are
    switched off meanwhile: items run side by side already.
    """
    workers = threads or available_cores()
    _keep_freed_memory()
    with one_thread_each(), ThreadPoolExecutor(workers) as pool:
        pending: deque[tuple[Item, Future[Result]]] = deque()
        try:
            for item in items:
                pending.append((item, pool.submit(function, item)))
                if len(pending) > 2 * workers:
                    done, future = pending.popleft()
                    yield done, future.result()
            while pending:
                done, future = pending.popleft()
                yield done, future.result()
        finally:
            if on_end is not None:
                on_end()
            # After an error or an early end nobody asks for the rest.
            for _, future in pending:
                future.cancel()


def map_in_turns(
    early: Callable[[Item], Early],
    in_turn: Callable[[Early], Middle],
    late: Callable[[Middle], Result],
    items: Iterable[Item],
    threads: int = 0,
) -> Iterator[Result]:
    """Yield ``late(in_turn(early(item)))`` in order, one thread from an item's first step to its last.

    ``early`` and ``late`` run side by side, ``in_turn`` for one item after the other in their order, so that it may
    carry a state along. An item's data stay in the cache of one core, and no more threads run than there are cores.
    """
    turns, due, broken = threading.Condition(), 0, math.inf

    def break_at(number: float) -> None:
        nonlocal broken
        with turns:
            broken = min(broken, number)
            turns.notify_all()

    def work(numbered: tuple[int, Item]) -> Result:
        nonlocal due
        number, item = numbered
        try:
            begun = early(item)
            with turns:
                turns.wait_for(lambda: due == number or broken < number)
                if broken < number:
                    raise RuntimeError("an earlier item failed, or nobody asks for this one any more")
                middle = in_turn(begun)
                due += 1
                turns.notify_all()
        except BaseException:
            break_at(number)
            raise
        return late(middle)

    # An item that is given up before it begins never has its turn, so those that have begun must not wait for it.
    for _, result in map_ahead(work, enumerate(items), threads, on_end=lambda: break_at(-1)):
        yield result


def sum_in_threads(
    add: Callable[[list[Item]], tuple[NDArray[np.float64], ...]], items: Iterable[Item], threads: int = 0
) -> tuple[NDArray[np.float64], ...]:
    """Sum arrays over items: those of a few items in one thread, then those sums in order.

    Which items go together does not depend on the number of threads, so neither do the bytes of the result.
    """
    totals: tuple[NDArray[np.float64], ...] = ()
    for _, sums in map_ahead(add, in_batches(items, _SUMMED), threads):
        totals = tuple(np.add(*pair, out=pair[0]) for pair in zip(totals, sums, strict=True)) if totals else sums
    return totals


class ThreadTeam:
    """Threads that share out some work, the calling thread among them.

    Handing an item to a sleeping thread takes as long as a pass over a small image, so the caller does not sleep
    meanwhile.  ``threads``, at least 1, count the caller, who works alone where there is one.
    """

    def __init__(self, threads: int) -> None:
        self._count = threads - 1
        # It starts no thread before there is something for it to do.
        self._others = ThreadPoolExecutor(max(self._count, 1))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._others.shutdown()

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Yield ``function(item)`` in order; nothing begins before the first is asked for.

        All have ended when this has, also after an error or where it is left early; it may be called within itself.
        """
        left, found, due = deque(enumerate(items)), dict[int, Result](), 0

        def take_one() -> bool:
            try:
                number, item = left.popleft()
            except IndexError:
                return False
            found[number] = function(item)
            return True

        def help_out() -> None:
            try:
                while take_one():
                    pass
            finally:
                # After an error nobody asks for the rest.
                left.clear()

        others: list[Future[None]] = []
        try:
            others.extend(self._others.submit(help_out) for _ in range(min(self._count, len(left) - 1)))
            while take_one():
                while due in found:
                    yield found.pop(due)
                    due += 1
            # One that has not begun may be queued behind a thread that waits for this one.
            for other in others:
                if not other.cancel():
                    other.result()
            while due in found:
                yield found.pop(due)
                due += 1
        finally:
            left.clear()
            wait(other for other in others if not other.cancel())


def in_batches(items: Iterable[Item], size: int) -> Iterator[list[Item]]:
    """Yield lists of ``size`` consecutive items, the last perhaps shorter."""
    stream = iter(items)
    return iter(lambda: list(islice(stream, size)), [])


def available_cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WhileInside(ContextDecorator):
    """Settings of the process, in force while anybody is inside: the first one in makes them, the last undoes them.

    Two streams that are worked on in turns do not end in the order in which they began.
    """

    def __init__(self, settings: Callable[[], AbstractContextManager[object]]) -> None:
        # Reentrant: memory that is collected meanwhile may end a stream in this very thread.
        self._settings, self._lock, self._inside, self._restore = settings, threading.RLock(), 0, ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            if self._inside == 0:
                self._restore.enter_context(self._settings())
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._restore.close()


@functools.cache
def one_thread_each() -> WhileInside:
    """Keep OpenCV and BLAS from starting threads of their own, and give them back what they had afterwards.

    Beside busy threads a BLAS call on two threads is not twice as fast but tens of times slower: each waits for the
    other to be scheduled. Uses may overlap, in one thread or in several: what they had comes back after the last.
    """

    @contextmanager
    def settings() -> Iterator[None]:
        before = cv2.getNumThreads()
        with _controller().limit(limits=1, user_api="blas"):
            cv2.setNumThreads(1)
            try:
                yield
            finally:
                cv2.setNumThreads(before)

    return WhileInside(settings)


@functools.cache
def _controller() -> ThreadpoolController:
    """Libraries with threads of their own; finding them takes a millisecond, as long as a small frame."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def _keep_freed_memory() -> None:
    """Let the C library keep what arrays of a frame give back for the next ones.

    By default glibc gives every array of a megabyte back to the system, and filling the pages of the next one with
    zeros takes a seventh of the time of optical flow at 512×512.  It keeps what is smaller than the largest array that
    it has seen given back (mallopt(3), M_MMAP_THRESHOLD), so one that is never filled is all it takes.
    """
    np.empty(_THRESHOLD_BYTES, np.uint8)
