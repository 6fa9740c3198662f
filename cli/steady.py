"""``turbrestore steady``: video in, video out."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import numpy as np
from cyclopts import Parameter

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import require
from turbrestore.footage.content import clean_source, keep_all
from turbrestore.io.output import check_output
from turbrestore.io.pixels import check_depth
from turbrestore.io.video import VIDEO_OUTPUT_SUFFIXES, write_video
from turbrestore.steady.settings import SteadyParams
from turbrestore.steady.video import SteadyFrame, steady_frames

from .inputs import open_checked
from .options import Flag, Machine, Selection
from .output import print_json, write_settings
from .progress import progress_bars, say

# Frames per second of inputs that do not say.
_USUAL_RATE = 25.0


def steady(
    input: Path,
    output: Path,
    /,
    *,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    config: Path | None = None,
    mask: Path | None = None,
    bit_depth: int | None = None,
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
    params: Annotated[SteadyParams, Parameter(name="*")] = SteadyParams(),
) -> None:
    """Steady and sharpen a video; what moves keeps moving.

    Parameters
    ----------
    input : Path
        Video (mp4, mkv, mov, avi, mts, wmv, …), animated PNG or WebP, TIFF stack, SER, FITS cube, .npy, or folder of
        images or FITS files.
    output : Path
        Video of the same length to write: .mp4 (H.264), .mkv (lossless), .ser, .tif, .npy, .gif or .webp.
    config : Path
        TOML file with settings; flags win over it.
    mask : Path
        Video to write, of the same kinds: white where something moves against the scene.
    bit_depth : int
        Bits per channel of the output, 8 to 16, or 32 (float, TIFF and .npy only).  Those of the input by default.
    overwrite : bool
        Replace existing outputs.
    json : bool
        Print what was done, as JSON, on standard output.
    quiet : bool
        Print neither progress nor remarks.
    """
    if bit_depth is not None:
        check_depth(bit_depth)
    inputs = [path for path in (input, config) if path is not None]
    check_output(output, inputs, overwrite, VIDEO_OUTPUT_SUFFIXES)
    settings_path = output.with_name(output.name + ".toml")
    check_output(settings_path, [input], overwrite or config == settings_path, suffixes=None)
    if mask is not None:
        require(mask.absolute() != output.absolute(), "--mask: is the output; choose another name")
        check_output(mask, inputs, overwrite, VIDEO_OUTPUT_SUFFIXES)
    source, report = open_checked(input, selection)
    source = clean_source(source, keep_all(report))
    for warning in source.warnings:
        say(f"{source.name}: {warning}", quiet)
    fps, depth = source.fps or _USUAL_RATE, source.bit_depth if bit_depth is None else bit_depth
    facts, started = _Facts(), time.monotonic()
    with tempfile.TemporaryFile() as masks:
        with progress_bars(quiet) as progress:
            frames = facts.watch(steady_frames(source, params, machine.runtime()), len(source), progress)
            write_video(output, _images(frames, None if mask is None else masks), fps, depth, overwrite)
        if mask is not None:
            write_video(mask, _stored_masks(masks, source.shape[1:3]), fps, 8, overwrite)
    facts.seconds = time.monotonic() - started
    records = (machine, selection, params)
    settings = {name: value for record in records for name, value in dataclasses.asdict(record).items()}
    write_settings(settings_path, {"bit_depth": bit_depth, **settings})
    if json:
        paths = {"input": str(input), "output": str(output), "settings": str(settings_path)}
        print_json({**paths, **facts.record()})
    else:
        say(f"{output}: {facts.text()}", quiet)


class _Facts:
    """What is worth saying about a run."""

    def __init__(self) -> None:
        self.frames, self.scenes, self.sigma, self.seconds = 0, 0, 0.0, 0.0
        self._displacement, self._moving = 0.0, 0.0

    def watch(
        self, frames: Iterable[SteadyFrame], total: int, progress: Callable[[str, int, int], None] | None
    ) -> Iterator[SteadyFrame]:
        """Pass frames on, take note of them, and show progress."""
        for frame in frames:
            self.frames += 1
            self.scenes += frame.starts_scene
            self.sigma = frame.sigma
            self._displacement += frame.displacement
            self._moving += float(frame.moving.mean())
            if progress is not None:
                progress("steady", self.frames, total)
            yield frame

    def record(self) -> dict[str, Any]:
        """Facts that a script may want: frames, scenes, seconds, pixels, and shares of the image."""
        return {
            "frames": self.frames,
            "scenes": self.scenes,
            "seconds": self.seconds,
            "sigma": self.sigma,
            "mean_displacement": self._displacement / self.frames,
            "moving_share": self._moving / self.frames,
        }

    def text(self) -> str:
        """One line for a person."""
        blur = f"blur of {self.sigma:.2f} pixels removed" if self.sigma > 0 else "no blur removed"
        return (
            f"{self.frames} frames in {self.seconds:.1f} s, displacements of {self._displacement / self.frames:.2f} "
            f"pixels and {blur}, {100 * self._moving / self.frames:.0f} % of the image moves"
        )


def _images(frames: Iterable[SteadyFrame], masks: BinaryIO | None) -> Iterator[FloatArray]:
    """Images of frames, whose masks go to a file if there is one: memory must not grow with the video."""
    for frame in frames:
        if masks is not None:
            masks.write(np.packbits(frame.moving).tobytes())
        yield frame.image


def _stored_masks(masks: BinaryIO, shape: tuple[int, ...]) -> Iterator[FloatArray]:
    """Read back what :func:`_images` has stored."""
    pixels = int(np.prod(shape))
    masks.seek(0)
    while data := masks.read((pixels + 7) // 8):
        yield np.unpackbits(np.frombuffer(data, np.uint8), count=pixels).reshape(shape).astype(np.float32)
