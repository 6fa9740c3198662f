"""Progress on standard error: one bar a stage with the time left, on terminals only."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from .streams import tell

TITLES = {
    "flow": "optical flow",
    "centroid": "centroid",
    "filter": "alternating filter",
    "deconvolve": "deconvolution",
    "steady": "frames",
    "synthesize": "frames",
    "batch": "clips",
}


@contextmanager
def progress_bars(quiet: bool) -> Iterator[Callable[[str, int, int], None] | None]:
    """Give a callback ``(stage, done, total)`` that draws bars, or None where nobody watches."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:<20}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    tasks: dict[str, tuple[TaskID, int]] = {}
    with Progress(*columns, console=Console(stderr=True)) as bars:

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                # A stage may stop before its largest number of steps; the next one starting means it is done.
                for task, steps in tasks.values():
                    bars.update(task, completed=steps)
                tasks[stage] = (bars.add_task(TITLES[stage], total=total), total)
            bars.update(tasks[stage][0], completed=done)

        yield report
        for task, steps in tasks.values():
            bars.update(task, completed=steps)


def say(message: str, quiet: bool) -> None:
    """Write one line for a person to standard error."""
    if not quiet:
        tell(f"turbrestore: {message}")
