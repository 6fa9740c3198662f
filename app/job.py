"""Work in a thread of its own: the page watches it and may stop it."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Generic, Literal, TypeVar

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import TurbrestoreError
from turbrestore_cli.commands import explain

if TYPE_CHECKING:
    from turbrestore.core.decision import Decision

Result_co = TypeVar("Result_co", covariant=True)
Kind = Literal["restore", "steady", "several", "live"]


class Stopped(BaseException):
    """Raised in the thread of a job that was stopped; like KeyboardInterrupt, it is not caught where errors are."""


@dataclass
class Bar:
    """Progress of one stage.

    Attributes
    ----------
    done, total : int
        Steps.
    begun : float
        Time, seconds.
    """

    done: int
    total: int
    begun: float = field(default_factory=time.monotonic)

    @property
    def share(self) -> float:
        """Share that is done, 0 to 1."""
        return self.done / self.total if self.total else 1.0

    @property
    def left(self) -> float | None:
        """Estimated seconds that are left; None until there is something to tell from."""
        if self.done < 2:
            return None
        return (time.monotonic() - self.begun) * (self.total - self.done) / self.done


class Job(Generic[Result_co]):
    """Work in a thread of its own.

    Parameters
    ----------
    work : callable
        Takes the job, which it reports to, and returns its result.
    kind : {"restore", "steady", "several", "live"}

    Attributes
    ----------
    state : {"running", "done", "stopped", "failed"}
    message : str
        One line on how it ended: the verdict on an image, or why it failed.
    bars : dict of str to Bar
        Progress of every stage that has begun.
    decisions : list of Decision
    images : dict of str to ndarray
        Image of every stage that is done.
    result : object or None
        What the work returned, once it is done.
    seconds : float
        What it took, once it is done.
    """

    def __init__(self, work: Callable[[Job[Result_co]], Result_co], kind: Kind = "restore") -> None:
        self.kind = kind
        self.state, self.message = "running", ""
        self.bars: dict[str, Bar] = {}
        self.decisions: list[Decision] = []
        self.images: dict[str, FloatArray] = {}
        self.result: Result_co | None = None
        self.seconds = 0.0
        self._begun = time.monotonic()
        self._stop = threading.Event()
        # The end of the program does not wait for it.
        self._thread = threading.Thread(target=self._run, args=(work,), name="restoration", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ask the work to end; it does so at its next step."""
        self._stop.set()

    def join(self, seconds: float) -> None:
        """Wait for the end of the work, at most so long."""
        self._thread.join(seconds)

    def begin_next(self) -> None:
        """Forget what was reported, before the next of several clips; raises Stopped where the job was stopped."""
        self.check()
        self.bars, self.decisions, self.images = {}, [], {}

    def progress(self, stage: str, done: int, total: int) -> None:
        """Note the progress of a stage; raises Stopped where the job was stopped."""
        self.check()
        if stage not in self.bars:
            self._finish_bars()
            self.bars[stage] = Bar(done, total)
        self.bars[stage].done = done

    def decided(self, decision: Decision) -> None:
        """Note a decision; raises Stopped where the job was stopped."""
        self.check()
        self.decisions.append(decision)

    def show(self, name: str, image: FloatArray) -> None:
        """Note the image of a stage; raises Stopped where the job was stopped."""
        self.check()
        self.images[name] = image

    def check(self) -> None:
        """Raise Stopped where the job was stopped."""
        if self._stop.is_set():
            raise Stopped

    def _run(self, work: Callable[[Job[Result_co]], Result_co]) -> None:
        try:
            self.result = work(self)
            self.check()
            self._finish_bars()
            self.seconds = time.monotonic() - self._begun
            self.state = "done"
        except Stopped:
            self.result, self.state = None, "stopped"
        except BaseException as error:
            self.result, self.message, self.state = None, one_line(error), "failed"

    def _finish_bars(self) -> None:
        """Fill the bars: a stage may end before its largest number of steps."""
        for bar in self.bars.values():
            bar.done = bar.total


def one_line(error: BaseException) -> str:
    """Say in one line what went wrong; bugs leave their traceback on standard error.

    Parameters
    ----------
    error : BaseException

    Returns
    -------
    str

    Examples
    --------
    >>> one_line(TurbrestoreError("a.mkv: no such file"))
    'a.mkv: no such file'
    """
    if not isinstance(error, TurbrestoreError | OSError | MemoryError):
        traceback.print_exception(error, file=sys.stderr)
        return f"this is a bug ({type(error).__name__}: {' '.join(str(error).split())}); the terminal shows where"
    return " ".join(explain(error)[0].split())
