"""One run of a restoration, as its stages share it: frames, settings, plan, store, decisions, times and progress."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

from .core.decision import Decision
from .filtering.alternating import FilterStep
from .io.source import FrameSource
from .memory_plan import MemoryPlan
from .preparation import Prepared
from .results import Store
from .runtime.steps import Progress, step_counter
from .runtime.tiling import HaloTile, halo_tiles
from .settings import RestoreParams

# As ``map`` does, applies a function to every task and yields the results in order; it may do so in other processes,
# to which it has to pickle closures too.  The tasks should be taken as they are needed, because those of the filter
# hold arrays.
TileMap = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]
# Stages that take a while and have no steps to count.
_WITHOUT_STEPS = ("witnesses", "width")

Result = TypeVar("Result")


@dataclass(frozen=True)
class Run:
    """Arguments that every stage shares, what was decided, and the wall time of the stages that have run."""

    prepared: Prepared
    params: RestoreParams  # at the levels of the prepared frames
    plan: MemoryPlan
    store: Store | None
    progress: Progress | None
    on_decision: Callable[[Decision], None] | None
    map_tiles: TileMap | None = None
    decisions: list[Decision] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def source(self) -> FrameSource:
        """Frames as the stages take them."""
        return self.prepared.source

    @property
    def tiles(self) -> tuple[HaloTile, ...]:
        """Tiles in which frames are processed; none for whole frames."""
        _, height, width = self.source.shape[:3]
        return () if self.plan.tile is None else halo_tiles((height, width), self.plan.tile)

    def decide(self, *decisions: Decision) -> None:
        """Record decisions, and call ``on_decision``."""
        self.decisions.extend(decisions)
        if self.on_decision is not None:
            for decision in decisions:
                self.on_decision(decision)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time that something takes to that of a stage."""
        begun, told = time.perf_counter(), self.progress if stage in _WITHOUT_STEPS else None
        if told is not None:
            told(stage, 0, 1)
        yield
        if told is not None:
            told(stage, 1, 1)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - begun

    def stage(self, stage: str, name: str, compute: Callable[[], Result]) -> Result:
        """Return a result from the store, or compute it."""
        with self.timed(stage):
            return self.from_store(name, compute)

    def from_store(self, name: str, compute: Callable[[], Result]) -> Result:
        """Like :meth:`stage`, untimed."""
        return compute() if self.store is None else self.store.get(name, compute)

    def counter(self, stage: str, total: int) -> Callable[[object], None]:
        """Return the observer of the steps of one stage, which reports progress."""
        return step_counter(self.progress, stage, total)

    def observe_filter(self, tile: int, step: FilterStep) -> None:
        """Report progress, and give the store the checkpoints, unless the frames are filtered in tiles."""
        flows = len(self.source) * self.params.filter.inner_iterations - self.plan.train
        if self.progress is not None:
            self.progress("filter", tile * flows + step.flows_measured, max(len(self.tiles), 1) * flows)
        if self.store is not None and step.checkpoint is not None and not self.tiles:
            self.store.checkpoint(step.checkpoint)
