"""``turbrestore register``: the frames of a video in one geometry, not stacked."""

from __future__ import annotations

import csv
import dataclasses
import io
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import require
from turbrestore.io.astronomy.fits_header import is_fits
from turbrestore.io.astronomy.fits_output import FITS_OUTPUT_SUFFIX, write_fits_cube
from turbrestore.io.npy import write_npz
from turbrestore.io.output import atomic_output, atomic_write, check_output, check_space
from turbrestore.io.source import FrameSource
from turbrestore.io.video import write_video
from turbrestore.known_geometry import settings_of_known_flows
from turbrestore.pipeline import restore
from turbrestore.results import Restoration
from turbrestore.runs.run_record import describe_run
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.scratch import drop_pages, new_stack
from turbrestore.settings import Preset, RestoreParams
from turbrestore.stacking.registered import RegisteredFrame, registered_frames

from .inputs import files_read, open_input
from .kept import check_room, kept_stages
from .options import Flag, Machine, Selection
from .output import check_distinct, check_keep, check_output_depth, save_stages, settings_record
from .progress import progress_bars, say

# What a registered video is written as: lossless, with 16 bits or more.
SUFFIXES = (".ser", ".tif", ".tiff", FITS_OUTPUT_SUFFIX, ".mkv", ".npy")
_RATE = 25.0
# Flows that take more than this are collected in a scratch file, bytes.
_LARGE = 1 << 28
_COLUMNS = ("frame", "seconds", "share", "sharpness", "quality")


def register(
    input: Path,
    output: Path,
    /,
    *,
    flows: Path | None = None,
    preset: Preset = "standard",
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    config: Path | None = None,
    keep: Path | None = None,
    resume: Flag = False,
    checkpoint_every: int = 50,
    bit_depth: int | None = None,
    memory_limit: MemorySize | None = None,
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    quiet: Flag = False,
    params: Annotated[RestoreParams, Parameter(name="*")] = RestoreParams(),
) -> None:
    """Write the frames of a video in the geometry of its restored image, to be stacked by another program.

    A table beside the output, of its name and .csv, has the share and the quality of every frame.

    Parameters
    ----------
    input : Path
        Video, SER, FITS, TIFF, .npy or folder of images.
    output : Path
        Registered frames to write: .ser, .tif, .fits (a cube), .mkv (lossless) or .npy.
    flows : Path
        File to write, .npz: the flow to every frame, pixels, and the numbers of the frames.
    preset : str
        Settings to start from, as in ``restore``.
    config : Path
        File with settings, .toml; options win over it.
    keep : Path
        Folder for the result of every stage, as in ``restore``; a run that is kept there is gone on with.
    resume : bool
        Continue the run in the folder of ``--keep``.
    checkpoint_every : int
        Frames between two checkpoints of the filter in the ``--keep`` folder.
    bit_depth : int
        Bits per channel: 8, 16 or 32.  32 is floating point, in TIFF, FITS and .npy only.  Those of the input by
        default.
    memory_limit : MemorySize
        Most memory to take, such as 2GB.  By default there is no limit.
    overwrite : bool
        Replace existing outputs.
    quiet : bool
        Print neither progress nor remarks.
    """
    require(keep is not None or not resume, "--resume: expected --keep with the folder of the run to go on with")
    table = output.with_suffix(".csv")
    inputs = files_read(selection, input, config, params=params)
    _check_outputs(inputs, output, table, flows, overwrite)
    check_keep(keep, [*inputs, output, table, *([] if flows is None else [flows])], overwrite, resume)
    check_output_depth(bit_depth, output.suffix)
    runtime = machine.runtime(memory_limit, keep)
    source = open_input(input, selection, quiet)
    params = settings_of_known_flows(params, len(source))
    check_room(source, params, runtime, output, keep)
    if flows is not None:
        check_space(flows, 8 * len(source) * source.shape[1] * source.shape[2])
    with kept_stages(keep, source, params, runtime, resume, checkpoint_every, quiet) as stages:
        # A kept run that has been deblurred stays complete.
        whole = stages is not None and stages.has("deblurred")
        ordered = dataclasses.replace(params, scale=1.0, until=params.until if whole else "filter")
        with progress_bars(quiet, {"centroid": 2, "filter": 3, "register": 1}) as progress:
            told = None if progress is None or whole else progress
            restoration = restore(source, ordered, runtime, stages, told)
            if stages is not None:
                record = settings_record(ordered, selection, bit_depth, machine, memory_limit, preset)
                save_stages(stages, restoration, describe_run(source, record), source.bit_depth)
            writer = _Writer(source, restoration, flows is not None, runtime)
            depth = source.bit_depth if bit_depth is None else bit_depth
            frames = writer.taken(registered_frames(source, restoration, ordered, runtime))
            counted = _counted(frames, len(source), progress)
            if is_fits(output):
                history = [f"turbrestore register {input}", *source.warnings]
                write_fits_cube(output, counted, len(source), depth, overwrite, history=history, levels=source.levels)
            else:
                write_video(output, counted, source.fps or _RATE, depth, overwrite)
    atomic_write(table, writer.table().encode(), overwrite)
    if flows is not None:
        with atomic_output(flows, overwrite) as temporary, temporary.open("wb") as stream:
            write_npz(stream, {"flows": writer.flows, "numbers": np.array(source.numbers)})
    say(f"{output}: {len(source)} frames registered, {restoration.motion:.2f} pixels of motion removed", quiet)


def _check_outputs(inputs: list[Path], output: Path, table: Path, flows: Path | None, overwrite: bool) -> None:
    check_distinct(path for path in (output, table, flows) if path is not None)
    check_output(output, inputs, overwrite, SUFFIXES)
    check_output(table, inputs, overwrite, (".csv",))
    if flows is not None:
        check_output(flows, inputs, overwrite, (".npz",))


class _Writer:
    """Takes what is told of each frame while the frames are written."""

    def __init__(self, source: FrameSource, restoration: Restoration, with_flows: bool, runtime: Runtime) -> None:
        shape = (*source.shape[:3], 2) if with_flows else (0,)
        folder = runtime.scratch or Path(tempfile.gettempdir())
        self.flows = new_stack(shape, folder if 4 * np.prod(shape, dtype=np.int64) > _LARGE else None)
        self._with_flows, self._times = with_flows, source.timestamps
        self._fps, self._rows = source.fps, list[tuple[object, ...]]()

    def taken(self, frames: Iterator[RegisteredFrame]) -> Iterator[FloatArray]:
        """Pass on the images."""
        for place, frame in enumerate(frames):
            if self._with_flows:
                self.flows[place] = frame.flow
                drop_pages(self.flows)
            seconds: float | str = "" if not self._fps else round(frame.number / self._fps, 6)
            if self._times is not None:
                seconds = round(float(self._times[place]), 6)
            figures = (f"{value:.6g}" for value in (frame.share, frame.sharpness, frame.quality))
            self._rows.append((frame.number, seconds, *figures))
            yield frame.image

    def table(self) -> str:
        """Return the table of the frames."""
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_COLUMNS)
        writer.writerows(self._rows)
        return text.getvalue()


def _counted(frames: Iterator[FloatArray], total: int, progress: object) -> Iterator[FloatArray]:
    for number, frame in enumerate(frames, 1):
        yield frame
        if callable(progress):
            progress("register", number, total)
