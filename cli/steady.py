"""``turbrestore steady``: video in, video out."""

from __future__ import annotations

import dataclasses
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

import numpy as np
from cyclopts import Parameter

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import ConfigurationError, require
from turbrestore.footage.checks.content import clean_source, keep_all
from turbrestore.io.containers.encoding import BY_SUFFIX, Encoding, write_pipe
from turbrestore.io.containers.stream import open_camera, open_pipe, read_raw, write_raw
from turbrestore.io.containers.transfer_curves import CURVES
from turbrestore.io.output import check_output
from turbrestore.io.pixels import check_depth
from turbrestore.io.source import FrameSource
from turbrestore.io.video import VIDEO_OUTPUT_SUFFIXES, open_frames, write_video
from turbrestore.report import SteadyFigures, check_report, write_steady_report
from turbrestore.runs.run_record import describe_run
from turbrestore.steady.settings import SteadyParams
from turbrestore.steady.video import SteadyFrame, steady_frames

from .inputs import files_read, open_checked
from .options import Flag, Machine, Selection
from .output import check_distinct, print_json, write_settings
from .progress import progress_bars, say
from .signals import until_interrupted

# Frames per second of inputs that do not say.
USUAL_RATE = 25.0
_MOST_BITS = {"h264": 8, "hevc": 10, ".gif": 8, ".webp": 8}


@dataclasses.dataclass(frozen=True)
class Output:
    """How the video is written.

    Parameters
    ----------
    codec : {"h264", "hevc", "ffv1"}, optional
        Codec of the video.  By default H.264 for .mp4 and FFV1, which is lossless, for .mkv.
    crf : int, optional
        Quality of H.264 and HEVC, 0 to 51, smaller is better; 14 and 18 by default.  With it .mkv has H.264.
    bit_depth : int, optional
        Bits per channel: 8 to 16, or 32.  32 is floating point, in TIFF and .npy only; at most 8 in H.264, .gif and
        .webp, 10 in HEVC.  Those of the input by default, as far as the output holds them.
    """

    codec: Literal["h264", "hevc", "ffv1"] | None = None
    crf: int | None = None
    bit_depth: int | None = None

    def encoding(self) -> Encoding:
        """Codec and quality."""
        return Encoding(self.codec, self.crf)


def steady(
    input: Path,
    output: Path,
    /,
    *,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    config: Path | None = None,
    mask: Path | None = None,
    report: Path | None = None,
    raw: str | None = None,
    written: Annotated[Output, Parameter(name="*")] = Output(),
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    overwrite: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
    verbose: Flag = False,
    params: Annotated[SteadyParams, Parameter(name="*")] = SteadyParams(),
) -> None:
    """Steady and sharpen a video; what moves keeps moving.

    Parameters
    ----------
    input : Path
        Video, SER, FITS, TIFF, .npy or folder of images.  A video is what FFmpeg reads (mp4, mkv, mov, avi, mts, wmv,
        …) or an animated PNG or WebP; a folder may hold FITS files; ``-`` for Matroska or YUV4MPEG2 on standard input;
        or ``/dev/video0`` and alike for a camera, until Ctrl-C.
    output : Path
        Video to write, of the same length.  .mp4 (H.264), .mkv (lossless), .ser, .tif, .npy, .gif or .webp; or ``-``
        for lossless Matroska on standard output.  .mp4 and .mkv take over audio and time stamps of a video file.
    config : Path
        File with settings, .toml; options win over it.
    mask : Path
        Video to write, white where something moves.  Against the scene; of the same kinds as the output.
    report : Path
        Page to write, .html: a film and plots.  The film shows input, output, their difference and what moves.
    raw : str
        Size of raw frames in a pipe.  ``WIDTHxHEIGHT`` or ``WIDTHxHEIGHT:gray``: frames on standard input and output
        have 8 bits and no container,
        ``rgb24`` or ``gray`` in FFmpeg's words.
    written : Output
        How the video is written.
    overwrite : bool
        Replace existing outputs.
    json : bool
        Print the facts of the run as JSON.  They go to standard output.
    quiet : bool
        Print neither progress nor remarks.
    verbose : bool
        Say where scenes begin and how much blur is removed from then on.
    """
    piped_in, piped_out = str(input) == "-", str(output) == "-"
    is_camera = re.fullmatch(r"/dev/video\d+", str(input)) is not None
    streamed = piped_in or is_camera
    encoding, shape = written.encoding(), _raw_shape(raw)
    require(raw is None or piped_in, "--raw: has no effect unless the input is -; leave it out")
    require(
        not (report and (streamed or piped_out)), "--report: compares two files, and a stream is none; leave it out"
    )
    _check_printed(encoding, json, quiet and verbose, piped_out)
    _check_depth(written, output, piped_out and raw is not None)
    inputs = files_read(selection, None if streamed else input, config)
    settings_path = output.with_name(output.name + ".toml")
    if not piped_out:
        check_output(output, inputs, overwrite, VIDEO_OUTPUT_SUFFIXES)
        others = [path for path in inputs if path != config]
        check_output(settings_path, others, overwrite or config == settings_path, suffixes=None)
    _check_companions(mask, report, None if piped_out else output, inputs, overwrite)
    source = _from_stream(input, selection, shape) if streamed else _from_file(input, selection, quiet)
    fps, depth = source.fps or USUAL_RATE, source.bit_depth if written.bit_depth is None else written.bit_depth
    companion = source.frames if isinstance(source.frames, FrameSource) else None
    encoding = _encoding_for(companion, encoding, output)
    _tell_lost_bits(source, written, encoding, output, quiet or piped_out)
    facts, started = _Facts(verbose, () if companion is None else companion.warnings), time.monotonic()
    with tempfile.TemporaryFile() as masks:
        with progress_bars(quiet) as progress:
            total = len(companion) if companion is not None else 0
            frames = facts.watch(steady_frames(source.frames, params, machine.runtime()), total, progress)
            images = _images(frames, None if mask is None and report is None else masks)
            if not piped_out:
                write_video(output, images, fps, depth, overwrite, encoding, companion)
            elif shape is not None:
                write_raw(sys.stdout.buffer, images)
            else:
                write_pipe(sys.stdout.buffer, images, fps, depth)
        if mask is not None:
            write_video(mask, _stored_masks(masks, source.shape[:2]), fps, 8, overwrite)
        facts.figures.seconds = time.monotonic() - started
        if report is not None and companion is not None:
            command = ("turbrestore", "steady", str(input), str(output), "--config", str(settings_path))
            run = describe_run(companion, dataclasses.asdict(params), command)
            moving = (image > 0 for image in _stored_masks(masks, source.shape[:2]))
            write_steady_report(report, (companion, open_frames(output)), moving, facts.figures, run, overwrite)
    if piped_out:
        say(f"{source.name} {facts.text()}", quiet)
        return
    write_settings(settings_path, settings_record(machine, selection, params, written))
    if json:
        paths = {"input": str(input), "output": str(output), "settings": str(settings_path)}
        print_json({**paths, **facts.record()})
    else:
        say(f"{output} {facts.text()}", quiet)


def _check_printed(encoding: Encoding, json: bool, is_torn: bool, piped: bool) -> None:
    """Refuse options about what is printed that contradict each other, or a video on standard output."""
    require(not is_torn, "--verbose: contradicts --quiet; leave one of them out")
    require(not (piped and json), "--json: contradicts the output -, which is standard output; leave it out")
    require(not piped or encoding == BY_SUFFIX, "--codec, --crf: have no effect on the output -; leave them out")


def settings_record(machine: Machine, selection: Selection, params: SteadyParams, written: Output) -> dict[str, Any]:
    """All settings of a run, as in a settings file; None where they are left to be measured."""
    records = (machine, selection, params, written)
    return {name: value for record in records for name, value in dataclasses.asdict(record).items()}


def _encoding_for(source: FrameSource | None, encoding: Encoding, output: Path) -> Encoding:
    """Choose HEVC of 10 bits for HDR in .mp4: H.264 has 8 bits, in which codes of HLG and PQ show bands."""
    if source is None or source.colour is None or source.colour[1] not in CURVES:
        return encoding
    suffix = output.suffix.lower()
    is_h264 = suffix in (".mp4", ".mkv") and encoding.codec is None and encoding.codec_of(suffix) == "h264"
    return dataclasses.replace(encoding, codec="hevc") if is_h264 else encoding


def _check_companions(
    mask: Path | None, report: Path | None, output: Path | None, inputs: list[Path], overwrite: bool
) -> None:
    """Refuse a mask or a report that could not be written, before any work begins."""
    check_distinct([path for path in (output, mask, report) if path is not None])
    if mask is not None:
        check_output(mask, inputs, overwrite, VIDEO_OUTPUT_SUFFIXES)
    if report is not None:
        check_report(report, inputs, overwrite)


@dataclasses.dataclass(frozen=True, eq=False)
class _Source:
    """Frames of a file or a pipe, and what is known about them."""

    name: str
    shape: tuple[int, ...]
    bit_depth: int
    fps: float | None
    frames: FrameSource | Iterator[FloatArray]


def _from_file(input: Path, selection: Selection, quiet: bool) -> _Source:
    source, report = open_checked(input, selection)
    source = clean_source(source, keep_all(report))
    for warning in source.warnings:
        say(f"{source.name}: {warning}", quiet)
    return _Source(source.name, source.shape[1:], source.bit_depth, source.fps, source)


def _from_stream(input: Path, selection: Selection, shape: tuple[int, ...] | None) -> _Source:
    idle = dataclasses.replace(selection, max_pixels=None) == Selection()
    require(idle, f"{input}: a stream is read as it comes; leave out the options that select or repair frames")
    if str(input) != "-":
        camera = open_camera(str(input), selection.limits())
        return _Source(camera.name, camera.shape, 8, camera.fps, until_interrupted(camera.frames))
    if shape is not None:
        limits = selection.limits()
        limits.check_size(shape[1], shape[0], "--raw")
        return _Source("standard input", shape, 8, None, read_raw(sys.stdin.buffer, shape))
    stream = open_pipe(sys.stdin.buffer, limits=selection.limits())
    return _Source(stream.name, stream.shape, stream.bit_depth, stream.fps, stream.frames)


def _check_depth(written: Output, output: Path, raw: bool) -> None:
    """Refuse a depth that the output does not hold, instead of writing another."""
    depth, suffix = written.bit_depth, output.suffix.lower()
    if depth is None:
        return
    check_depth(depth)
    require(not raw, "--bit-depth: has no effect on raw frames, which have 8 bits; leave it out")
    kind = _kind(written.encoding(), suffix)
    most = _MOST_BITS.get(kind, depth)
    require(
        depth <= most, f"--bit-depth: expected at most {most}, as {kind} has, found {depth}; .mkv by default has 16"
    )


def _kind(encoding: Encoding, suffix: str) -> str:
    """Codec of an output, or its suffix where that is its format."""
    return encoding.codec_of(suffix) if suffix in (".mkv", ".mp4") else suffix


def _tell_lost_bits(source: _Source, written: Output, encoding: Encoding, output: Path, quiet: bool) -> None:
    """Say that the output holds fewer bits than the input, where nobody has asked for that."""
    kind = _kind(encoding, output.suffix.lower())
    most = _MOST_BITS.get(kind, source.bit_depth)
    if written.bit_depth is None and source.bit_depth > most:
        say(f"{output}: {kind} holds {most} of the {source.bit_depth} bits of the input; .mkv by default has 16", quiet)


def _raw_shape(raw: str | None) -> tuple[int, ...] | None:
    if raw is None:
        return None
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})(?::(gray|rgb24))?", raw)
    if found is None:
        raise ConfigurationError(f"--raw: expected WIDTHxHEIGHT or WIDTHxHEIGHT:gray, found {raw!r}")
    size = int(found[2]), int(found[1])
    return size if found[3] == "gray" else (*size, 3)


class _Facts:
    """What is worth saying about a run."""

    def __init__(self, verbose: bool, remarks: tuple[str, ...]) -> None:
        self.verbose = verbose
        self.figures = SteadyFigures(remarks=remarks)

    def watch(
        self, frames: Iterable[SteadyFrame], total: int, progress: Callable[[str, int, int], None] | None
    ) -> Iterator[SteadyFrame]:
        """Pass frames on, take note of them, and show progress."""
        for frame in frames:
            if self.verbose and (frame.starts_scene or frame.sigma != self.figures.sigma):
                what = "a scene begins; " if frame.starts_scene else ""
                say(f"frame {frame.number}: {what}{frame.sigma:.2f} pixels of blur are removed", quiet=False)
            self.figures.note(frame)
            if progress is not None:
                progress("steady", len(self.figures.moving), total)
            yield frame

    def record(self) -> dict[str, Any]:
        """Facts that a script may want: frames, scenes, seconds, pixels, and shares of the image."""
        return {
            "frames": len(self.figures.moving),
            "scenes": self.figures.scenes,
            "seconds": self.figures.seconds,
            "sigma": self.figures.sigma,
            "mean_displacement": float(np.mean(self.figures.displacement)),
            "moving_share": float(np.mean(self.figures.moving)),
            "replaced_share": float(np.mean(self.figures.replaced)),
            "verdict": dataclasses.asdict(self.figures.verdict),
        }

    def text(self) -> str:
        """One line for a person."""
        return f"({self.figures.seconds:.1f} s): {self.figures.verdict}"


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
