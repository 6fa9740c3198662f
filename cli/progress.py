"""Progress on standard error: one bar for the whole command with the time left, on terminals only."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from .streams import tell

TITLES = {
    "flow": "optical flow",
    "centroid": "centroid",
    "filter": "alternating filter",
    "deconvolve": "deconvolution",
    "register": "registered frames",
    "steady": "frames",
    "synthesize": "frames",
    "batch": "clips",
}


@contextmanager
def progress_bars(
    quiet: bool, weights: Mapping[str, float] | None = None
) -> Iterator[Callable[[str, int, int], None] | None]:
    """Give a callback ``(stage, done, total)`` that moves the bar, or None where nobody watches.

    ``weights`` has the stages of a command in order, with the times that they are expected to take, in any unit.
    """
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:<20}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("reading", total=1)

        def report(stage: str, done: int, total: int) -> None:
            place = share_done(weights or {stage: 1.0}, stage, done, total)
            if place is None:
                bar.update(task, description=f"{TITLES[stage]}: {done}", total=None)
            else:
                bar.update(task, description=TITLES[stage], completed=max(place, bar.tasks[0].completed))

        yield report
        bar.update(task, total=1, completed=1)


def share_done(weights: Mapping[str, float], stage: str, done: int, total: int) -> float | None:
    """Share of a command that is done, 0 to 1; None where its only stage does not know how long it is."""
    if total == 0 and len(weights) == 1:
        return None
    # Stages before this one are over, also where they took fewer steps than they might have.
    before = sum(list(weights.values())[: list(weights).index(stage)])
    here = min(done / total, 1.0) if total > 0 else 1.0
    return (before + here * weights[stage]) / sum(weights.values())


def say(message: str, quiet: bool) -> None:
    """Write one line for a person to standard error."""
    if not quiet:
        tell(f"turbrestore: {message}")
