"""``turbrestore batch``: many clips, side by side in processes of Dask, or one after the other where it is missing."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from turbrestore.core.errors import TurbrestoreError, require
from turbrestore.core.extras import install_command
from turbrestore.core.remarks import counted
from turbrestore.core.verdict import RIGHT
from turbrestore.io.limits import first_line
from turbrestore.io.output import IMAGE_OUTPUT_SUFFIXES
from turbrestore.report.batch_page import ClipRow, thumbnail_uri
from turbrestore.runs.folder_lock import lock_folder
from turbrestore.runs.run_folder import is_part
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.runtime.threads import available_cores
from turbrestore.settings import Preset, RestoreParams

from .batch_plan import (
    JOURNAL,
    PAGE,
    TABLE,
    figures,
    find_clips,
    journal_line,
    key_of,
    name_outputs,
    plan,
    write_summary,
    writes_page,
)
from .clip import Order, restore_clip
from .cluster import check_cluster, connected
from .inputs import with_absolute_paths
from .options import Flag, Machine, Selection, known_sigma
from .output import check_output_depth, print_json
from .progress import progress_bars, say

if TYPE_CHECKING:
    from distributed import Client, Future

# Least memory for a process, bytes.
_LEAST_MEMORY = 1e9


def batch(
    *inputs: Path,
    out: Annotated[Path | None, Parameter(show=False)] = None,
    preset: Preset = "standard",
    sigma: float | None = None,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    config: Path | None = None,
    format: Literal["png", "tif", "fits"] = "png",
    bit_depth: int | None = None,
    reports: Flag = False,
    resume: Flag = False,
    scheduler: str | None = None,
    workers: int | None = None,
    memory_limit: MemorySize | None = None,
    tile: int | None = None,
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
    params: Annotated[RestoreParams, Parameter(name="*")] = RestoreParams(),
) -> None:
    """Restore many clips side by side; a clip that fails is a row of the summary with its reason.

    Ends with 1 if any clip failed.  Without the extra ``distributed`` clips are restored one after the other.

    Parameters
    ----------
    inputs : Path
        Clips, and last the folder for the results.  Clips are videos, folders and patterns such as 'night/*.ser'.
        Every video in a folder is a clip; a folder of images or FITS files is one clip.  The results are an image and
        its settings for each clip, summary.csv, and index.html with pictures.
    out : Path
        The folder for the results, in place of the last word.
    preset : str
        Settings to start from.  fast measures flow once a frame and at a quarter of the size, in three quarters of the
        time; paper is the method as published.  Any other setting given wins over those of the preset.
    sigma : float
        Width of the blur to remove, pixels.  Its standard deviation; 0 removes none.  Estimated by default.
    config : Path
        File with settings, .toml; options win over it.
    format : str
        Kind of the images to write.
    bit_depth : int
        Bits per channel of the results: 8, 16 or 32.  32 is floating point, in TIFF and FITS only.  Those of the input
        by default.
    reports : bool
        Write an HTML report for each clip as well.
    resume : bool
        Do what an earlier batch has not done.  And what has failed in this folder, or has changed since.
    scheduler : str
        Address of a running Dask scheduler, tcp://host:port.  Its workers process the clips and must see the same
        files.  By default processes are started on this machine.
    workers : int
        Processes to start; by default one for each core, and no more than clips or than --memory-limit has gigabytes.
    memory_limit : MemorySize
        Most memory that all processes together take, such as 8GB; with --scheduler, that each clip takes.
    tile : int
        Longest side of the tiles that larger frames are processed in, pixels.  By default frames are processed as a
        whole.
    overwrite : bool
        Replace existing outputs.
    json : bool
        Print the facts of the run as JSON.  They go to standard output.
    quiet : bool
        Print neither progress nor remarks.
    """
    parallel = check_cluster("batch", scheduler, workers)
    inputs, out = _folder_last(inputs, out)
    require(
        out.is_dir() or out.suffix.lower() not in IMAGE_OUTPUT_SUFFIXES,
        f"{out}: expected a folder for the results, found the name of an image; restore writes one image",
    )
    check_output_depth(bit_depth, f".{format}")
    clips = find_clips(inputs)
    outputs = name_outputs(clips, out, f".{format}")
    count = 1 if scheduler or not parallel else processes(len(clips), memory_limit, workers)
    each = MemorySize(memory_limit / count) if memory_limit is not None else None
    settings = dataclasses.replace(params, deconvolution=known_sigma(sigma, params.deconvolution))
    # A worker of another machine has another folder to work in.
    selection, settings = with_absolute_paths(selection, settings)
    shared = Machine(machine.threads or max(1, available_cores() // count), machine.device)
    orders = [
        Order(
            input=clip,
            output=output,
            selection=selection,
            params=settings,
            machine=machine if scheduler else shared,
            bit_depth=bit_depth,
            memory_limit=each,
            preset=preset,
            report=output.with_suffix(".html") if reports else None,
            tile=tile,
        )
        for clip, output in zip(clips, outputs, strict=True)
    ]
    with lock_folder(out):
        rows, missing = plan(orders, out, resume, overwrite)
        if missing and not parallel:
            say(f"one clip after the other; {install_command('distributed')} lets them run side by side", quiet)
        _do(rows, missing, out, scheduler, count if parallel else 0, quiet)
    if not writes_page():
        say(f"{out / PAGE}: not written; {install_command('report')} installs what it needs", quiet)
    failed = [row for row in rows if row.state != "done"]
    if json:
        print_json({"out": str(out), "clips": [figures(row) for row in rows]})
    say(f"{out}: {len(rows) - len(failed)} of {counted(len(rows), 'clip')} restored", quiet)
    if failed:
        raise TurbrestoreError(f"batch: {len(failed)} of {counted(len(rows), 'clip')} failed; {out / TABLE} says why")


def _folder_last(paths: tuple[Path, ...], out: Path | None) -> tuple[tuple[Path, ...], Path]:
    """Split the words of the command into the clips and the folder for the results."""
    if out is not None:
        return paths, out
    require(len(paths) >= 2, "batch: expected clips, and last the folder for the results")
    *clips, folder = paths
    require(not folder.is_file(), f"batch: expected the folder for the results last, found the file {folder}")
    return tuple(clips), folder


def processes(clips: int, memory_limit: float | None, workers: int | None) -> int:
    """Count the processes to start: no more than cores, clips, or gigabytes."""
    if workers is not None:
        return min(workers, clips)
    by_memory = clips if memory_limit is None else max(1, int(memory_limit // _LEAST_MEMORY))
    return min(available_cores(), clips, by_memory)


def work(order: Order) -> ClipRow:
    """Restore one clip in a process of its own; a failure is a row, too."""
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    row = ClipRow(str(order.input), str(order.output), key=key_of(order))
    try:
        # A process that was killed while it did the same may have left a result.
        restoration, source = restore_clip(dataclasses.replace(order, overwrite=True, quiet=True))
        height, width = restoration.image.shape[:2]
        checks = restoration.verdict.checks
        known = {check.text for check in checks}
        middle = len(source) // 2
        return dataclasses.replace(
            row,
            state="done",
            frames=restoration.frame_count,
            width=width,
            height=height,
            blur=0.0 if restoration.deconvolution is None else float(restoration.deconvolution.sigma),
            seconds=float(sum(restoration.seconds.values())),
            checks="; ".join(map(str, checks)),
            remarks="; ".join(remark for remark in source.warnings if remark not in known),
            before=thumbnail_uri(source.read(middle, middle + 1)[0][restoration.shown]),
            after=thumbnail_uri(restoration.image),
        )
    except Exception as error:  # whatever happens to one clip, the others are restored
        return dataclasses.replace(row, state="failed", reason=_reason(error))


def _reason(error: BaseException) -> str:
    if isinstance(error, TurbrestoreError):
        return first_line(error)
    if isinstance(error, MemoryError):
        return "out of memory; fewer --workers or a --memory-limit take less"
    return f"{type(error).__name__}: {first_line(error)}"


def _do(
    rows: list[ClipRow], orders: Sequence[Order], out: Path, scheduler: str | None, count: int, quiet: bool
) -> None:
    """Restore what is missing; ``rows`` get what comes of it, and the journal each at once.

    ``count`` is the number of processes to start; 0 restores one clip after the other in this one.
    """
    places = {row.output: place for place, row in enumerate(rows)}
    try:
        with (out / JOURNAL).open("w", encoding="utf-8") as journal:
            journal.writelines(map(journal_line, rows))
            journal.flush()
            if orders:
                with nullcontext() if count == 0 else connected(scheduler, min(count, len(orders)), quiet) as client:
                    finished = _one_by_one(orders) if client is None else _side_by_side(client, orders)
                    for row in _told(finished, len(orders), quiet):
                        rows[places[row.output]] = row
                        journal.write(journal_line(row))
                        journal.flush()
    except KeyboardInterrupt as stop:
        done = sum(row.state == "done" for row in rows)
        stop.args = (f"{str(stop) or 'interrupted'}; {done} of {len(rows)} clips are done, --resume does the others",)
        raise
    finally:
        # Processes that were killed leave their unfinished files.
        for path in filter(is_part, out.iterdir()):
            path.unlink(missing_ok=True)
        write_summary(out, rows)


def _one_by_one(orders: Sequence[Order]) -> Iterator[ClipRow]:
    """Restore one clip after the other, and yield the row of each."""
    for order in orders:
        yield _as_named(work(_placed(order)), order)


def _side_by_side(client: Client, orders: Sequence[Order]) -> Iterator[ClipRow]:
    """Hand out all clips, and yield the row of each when it is done."""
    from distributed import as_completed

    futures = dict(zip(client.map(work, list(map(_placed, orders)), pure=False), orders, strict=True))
    for future in as_completed(list(futures)):
        order = futures.pop(future)
        yield _as_named(_row_of(future, order), order)


def _placed(order: Order) -> Order:
    """Name files independently of the folder that a process works in."""
    report = None if order.report is None else order.report.absolute()
    return dataclasses.replace(order, input=order.input.absolute(), output=order.output.absolute(), report=report)


def _told(finished: Iterable[ClipRow], count: int, quiet: bool) -> Iterator[ClipRow]:
    """Pass rows on, and show progress."""
    with progress_bars(quiet) as progress:
        for number, row in enumerate(finished, 1):
            # The journal has a clip before anybody is told that it is done.
            yield row
            if progress is not None:
                progress("batch", number, count)
            if progress is None or row.state == "failed":
                verdict = f"check: {row.checks}" if row.checks else RIGHT
                done = f"{row.frames} frames in {row.seconds:.1f} s; {verdict}"
                say(f"{number} of {count}: {row.input}: {row.reason if row.state == 'failed' else done}", quiet)


def _as_named(row: ClipRow, order: Order) -> ClipRow:
    """Say paths as they were given, and the input once."""
    reason = row.reason.removeprefix(f"{order.input.absolute()}: ").removeprefix(f"{order.input.name}: ")
    return dataclasses.replace(row, input=str(order.input), output=str(order.output), reason=reason)


def _row_of(future: Future[ClipRow], order: Order) -> ClipRow:
    """Return the row of a clip, also where its process was killed again and again or its scheduler has gone."""
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker:
        reason = "its process was killed again and again, perhaps for want of memory; --memory-limit takes less"
    except Exception as error:  # the errors of a connection, of other versions on the workers, and so on
        reason = f"it was lost ({first_line(error) or type(error).__name__}); --resume does it"
    return ClipRow(str(order.input), str(order.output), "failed", reason)
