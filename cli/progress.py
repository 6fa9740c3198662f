"""Progress on standard error: one bar for the whole command with the time left, on terminals only."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from .streams import tell

TITLES = {
    "read": "reading",
    "flow": "optical flow",
    "centroid": "centroid",
    "filter": "alternating filter",
    "witnesses": "blur of the frames",
    "width": "width of the blur",
    "deconvolve": "deconvolution",
    "register": "registered frames",
    "steady": "frames",
    "synthesize": "frames",
    "batch": "clips",
}

# What the stages of a restoration take, s a megapixel on two cores: reading and the filter for each frame, centroid and
# blur for each training frame, and once the search for the width and the deconvolution.  ``python benchmarks/speed.py
# --stages`` prints the table.
_COSTS = {
    "standard": {"read": 0.47, "centroid": 1.9, "filter": 1.7, "witnesses": 0.47, "width": 33.0, "deconvolve": 11.0},
    "fast": {"read": 0.17, "centroid": 0.55, "filter": 0.95, "witnesses": 0.48, "width": 38.0, "deconvolve": 12.0},
    "paper": {"read": 0.13, "centroid": 2.8, "filter": 1.9, "witnesses": 0.6, "width": 33.0, "deconvolve": 100.0},
}
# Passes after which a centroid has usually converged, and the share of the iterations that a deconvolution takes.
USUAL_PASSES, USUAL_ITERATIONS = 2, 0.4


def expected_times(preset: str, frames: int, train: int) -> dict[str, float]:
    """Expect times of the stages of a restoration in their order, in any unit."""
    times = {"read": frames, "centroid": train, "filter": frames, "witnesses": train, "width": 1, "deconvolve": 1}
    return {stage: times[stage] * cost for stage, cost in _COSTS[preset].items()}


@contextmanager
def progress_bars(
    quiet: bool, weights: Mapping[str, float] | None = None, usual: Mapping[str, float] | None = None
) -> Iterator[Callable[[str, int, int], None] | None]:
    """Give a callback ``(stage, done, total)`` that moves the bar, or None where nobody watches.

    ``weights`` has the stages of a command in order, with the times that they are expected to take, in any unit;
    ``usual`` has the share of its steps after which a stage usually ends.
    """
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    left = TimeLeft()
    remaining = TextColumn("{task.fields[left]}")
    columns = (TextColumn("{task.description:<20}"), BarColumn(), TaskProgressColumn(), remaining)
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("reading", total=1, left="")

        def report(stage: str, done: int, total: int) -> None:
            place = share_done(weights or {stage: 1.0}, stage, done, total, (usual or {}).get(stage, 1.0))
            if place is None:
                bar.update(task, description=f"{TITLES[stage]}: {done}", total=None)
            else:
                place = max(place, bar.tasks[0].completed)
                bar.update(task, description=TITLES[stage], completed=place, left=left.text(place))

        yield report
        bar.update(task, total=1, completed=1, left="")


class TimeLeft:
    """Time that is left of a command, which never rises: where it would, it waits."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._begun, self._least = clock, clock(), math.inf

    def text(self, share: float) -> str:
        """Minutes and seconds, if the time so far was this share of the whole; empty before anything is done."""
        if share <= 0:
            return ""
        self._least = min(self._least, (self._clock() - self._begun) * (1 - share) / share)
        minutes, seconds = divmod(round(self._least), 60)
        return f"{minutes}:{seconds:02}"


def share_done(weights: Mapping[str, float], stage: str, done: int, total: int, usual: float = 1.0) -> float | None:
    """Share of a command that is done, 0 to 1; None where its only stage does not know how long it is."""
    if total == 0 and len(weights) == 1:
        return None
    # Stages before this one are over, also where they took fewer steps than they might have.
    before = sum(list(weights.values())[: list(weights).index(stage)])
    here = min(done / (usual * total), 1.0) if total > 0 else 1.0
    return (before + here * weights[stage]) / sum(weights.values())


def say(message: str, quiet: bool) -> None:
    """Write one line for a person to standard error."""
    if not quiet:
        tell(f"turbrestore: {message}")
