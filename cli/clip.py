"""What ``turbrestore restore`` does with one clip, and ``turbrestore batch`` with each of many."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from turbrestore.core.decision import Decision
from turbrestore.core.errors import require
from turbrestore.io.images.image_files import write_map
from turbrestore.io.output import check_output
from turbrestore.io.source import FrameSource
from turbrestore.known_geometry import settings_of_known_flows
from turbrestore.memory_plan import training_share
from turbrestore.metrics import comparable
from turbrestore.pipeline import restore as run_pipeline
from turbrestore.restoration_run import TileMap
from turbrestore.results import Restoration
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.settings import Preset, RestoreParams

from .inputs import files_read, open_input, read_input_image
from .kept import check_room, kept_stages, own_outputs
from .options import Machine, Selection
from .output import (
    check_distinct,
    check_keep,
    check_output_depth,
    repeating_command,
    save_stages,
    settings_record,
    write_result,
    write_settings,
)
from .progress import USUAL_ITERATIONS, USUAL_PASSES, expected_times, progress_bars, say


@dataclass(frozen=True)
class Order:
    """What to restore, how, and what to write; the fields are the options of ``turbrestore restore``."""

    input: Path
    output: Path
    selection: Selection
    params: RestoreParams
    machine: Machine
    bit_depth: int | None = None
    memory_limit: MemorySize | None = None
    preset: Preset = "standard"
    config: Path | None = None
    keep: Path | None = None
    resume: bool = False
    checkpoint_every: int = 50
    report: Path | None = None
    uncertainty: Path | None = None
    truth: Path | None = None
    overwrite: bool = False
    quiet: bool = False
    verbose: bool = False
    tile: int | None = None
    scheduler: str | None = None
    workers: int | None = None

    @property
    def settings_path(self) -> Path:
        """File for the effective settings."""
        return self.output.with_name(self.output.name + ".toml")

    @property
    def process_limit(self) -> MemorySize | None:
        """Most memory that one process takes: this one has its share of the limit, as have the workers."""
        if self.memory_limit is None or self.workers is None:
            return self.memory_limit
        return MemorySize(self.memory_limit / (self.workers + 1))

    @property
    def inputs(self) -> list[Path]:
        """Files and folders to read."""
        return files_read(self.selection, self.input, self.config, self.truth, params=self.params)

    @property
    def outputs(self) -> list[Path]:
        """Files to write."""
        return [path for path in (self.output, self.settings_path, self.report, self.uncertainty) if path is not None]


def restore_clip(order: Order) -> tuple[Restoration, FrameSource]:
    """Restore one clip and write what was ordered; ``turbrestore batch`` calls this in every process."""
    check_output_depth(order.bit_depth, order.output.suffix)
    may_replace = _check_outputs(order)
    runtime = dataclasses.replace(order.machine.runtime(order.process_limit, order.keep), tile=order.tile)
    if order.truth is not None:
        comparable(read_input_image(order.truth, order.selection.limits()), "truth")
    # A worker of another machine has another folder to work in.
    place = order.input if order.scheduler is None else order.input.absolute()
    source = open_input(place, order.selection, order.quiet)
    if order.truth is not None:
        comparable(source.read(0, 1)[0], source.name)
    params = settings_of_known_flows(order.params, len(source))
    check_room(source, params, runtime, order.output, order.keep)
    with kept_stages(order.keep, source, params, runtime, order.resume, order.checkpoint_every, order.quiet) as stages:
        with (
            _tile_workers(order, source) as map_tiles,
            progress_bars(order.quiet, *_expected_times(source, params, order.preset)) as progress,
        ):
            tell_decision = _say_decision if order.verbose else None
            restoration = run_pipeline(source, params, runtime, stages, progress, tell_decision, map_tiles)
        record = settings_record(
            order.params, order.selection, order.bit_depth, order.machine, order.memory_limit, order.preset, order.tile
        )
        command = repeating_command(order.input, order.output, record)
        run = None
        if order.keep or order.report:
            from turbrestore.runs.run_record import describe_run

            run = describe_run(source, record, command)
        depth = source.bit_depth if order.bit_depth is None else order.bit_depth
        if stages is not None and run is not None:
            save_stages(stages, restoration, run, depth)
            stages.announce_outputs(*order.outputs)
        write_result(order.output, restoration, source, depth, command, may_replace(order.output))
        write_settings(order.settings_path, record)
        if order.uncertainty is not None and restoration.uncertainty is not None:
            write_map(order.uncertainty, restoration.uncertainty, may_replace(order.uncertainty))
        if order.report is not None and run is not None:
            from turbrestore.report import write_report

            write_report(order.report, restoration, run, overwrite=may_replace(order.report))
        if stages is not None:
            stages.announce_outputs()
    return restoration, source


def _say_decision(decision: Decision) -> None:
    say(str(decision), quiet=False)


def _expected_times(
    source: FrameSource, params: RestoreParams, preset: Preset
) -> tuple[dict[str, float], dict[str, float]]:
    """Expect times of the stages that a run has, and the share of its steps that a stage takes."""
    train = training_share(len(source), source.shape[1:], params.train, params.filter.training == "skip")
    found = {"read": True, "witnesses": params.finds_blur, "width": params.finds_blur}
    times = {
        stage: time
        for stage, time in expected_times(preset, len(source), train).items()
        if (found[stage] if stage in found else params.runs(stage))
    }
    return times, {"centroid": min(USUAL_PASSES / params.centroid.iterations, 1.0), "deconvolve": USUAL_ITERATIONS}


@contextmanager
def _tile_workers(order: Order, source: FrameSource) -> Iterator[TileMap | None]:
    """Connect to the processes that work on the tiles, if there are to be any."""
    if order.scheduler is None and order.workers is None:
        yield None
    elif order.tile is None or max(source.shape[1:3]) <= order.tile:
        say(
            f"frames of {source.shape[2]}×{source.shape[1]} are one tile, so no other process works on them",
            order.quiet,
        )
        yield None
    else:
        from .cluster import connected, over_workers

        with connected(order.scheduler, order.workers or 1, order.quiet) as client:
            yield over_workers(client)


def _check_outputs(order: Order) -> Callable[[Path], bool]:
    """Refuse outputs that cannot be written; return a function that tells which of them may replace a file."""
    require(
        order.keep is not None or not order.resume, "--resume: expected --keep with the folder of the run to go on with"
    )
    check_distinct(order.outputs)
    inputs = order.inputs
    leftovers = own_outputs(order.keep) if order.resume and order.keep is not None else set()

    def may_replace(path: Path) -> bool:
        # A run that died has left outputs of its own.
        return order.overwrite or path.absolute() in leftovers

    check_output(order.output, inputs, may_replace(order.output))
    others = [path for path in inputs if path != order.config]
    replaces_settings = may_replace(order.settings_path) or order.config == order.settings_path
    check_output(order.settings_path, others, replaces_settings, suffixes=None)
    if order.uncertainty is not None:
        require(
            order.params.runs("filter"),
            f"--uncertainty: expected a run of the filter, found until = {order.params.until}",
        )
        check_output(order.uncertainty, inputs, may_replace(order.uncertainty), (".tif", ".tiff"))
    if order.report is not None:
        from turbrestore.report import check_report

        check_report(order.report, inputs, may_replace(order.report))
    check_keep(order.keep, [*inputs, *order.outputs], order.overwrite, order.resume)
    return may_replace
