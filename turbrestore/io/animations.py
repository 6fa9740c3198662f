"""Animated PNG, WebP and GIF files, read and written by imageio through Pillow."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arrays import FloatArray, from_unit
from ..core.errors import DataError
from .images import image_errors, image_header, opened_images, read_file
from .limits import DEFAULT_LIMITS, Limits
from .output import atomic_write, frames_of_one_size
from .pixels import PixelArray, upright
from .source import FrameSource, check_cut_short

ANIMATION_SUFFIXES = (".png", ".apng", ".webp")
ANIMATION_OUTPUT_SUFFIXES = (".gif", ".webp")


def open_animation(
    path: Path, stop: int | None = None, limits: Limits = DEFAULT_LIMITS, skip_damaged: bool = False
) -> FrameSource:
    """Open an animated PNG or WebP file; all frames are decoded once to find out whether they are whole.

    Frames from ``stop`` on are not needed, so they may be missing. With ``skip_damaged`` the whole frames of a PNG file
    that is cut short are read. 16-bit colour is read as 8 bits. The errors are those of
    :func:`turbrestore.io.video.open_frames`.
    """
    data = read_file(path, limits)
    with image_header(path, data, limits, ("PNG", "WEBP")) as header:
        animation = _Animation(data, header.mode, bool(header.info.get("default_image")))
        count, kind = getattr(header, "n_frames", 1) - animation.skips_first, str(header.format).lower()
    if count < 2:
        raise DataError(f"{path}: a single image; name the folder that holds the frames")
    limits.check_count(count, str(path))
    shape, durations = _scan(path, animation)
    present = len(durations)
    if kind == "png" and present == count:
        with image_header(path, data, limits, ("PNG",)) as header:
            # Decoding does not compare the checksums.
            header.verify()
    deep = animation.mode == "I;16"
    notes: tuple[str, ...] = ("alpha channel ignored",) if animation.mode in ("LA", "RGBA") else ()
    notes += ("16-bit values read as 8 bits",) if kind == "png" and data[24] == 16 and not deep else ()
    notes += ("variable frame rate",) if len(set(durations[:-1])) > 1 else ()
    notes += check_cut_short(path, present, stop, skip_damaged, "damaged or cut short") if present < count else ()
    times = np.cumsum([0.0, *durations[:-1]]) / 1000
    return FrameSource(
        name=path.name,
        format=f"{kind}/{animation.mode}",
        file_shape=(present, *shape),
        full_scale=65535 if deep else 255,
        bit_depth=16 if deep else 8,
        pixels=lambda chosen: _chosen_frames(path, animation, chosen),
        path=path,
        fps=(present - 1) / float(times[-1]) if times[-1] > 0 else None,
        timestamps=times if times[-1] > 0 else None,
        warnings=notes,
    )


def write_animation(path: Path, frames: Iterable[FloatArray], fps: float, overwrite: bool = False) -> None:
    """Write frames for viewing as GIF of 256 colours or lossless WebP of 8 bits, repeated without end.

    All frames are in memory at 8 bits until the end. GIF counts hundredths of a second, WebP thousandths.
    """
    import imageio.v3 as iio

    suffix = path.suffix.lower()
    buffer = io.BytesIO()
    writer: Any = iio.imopen(buffer, "w", plugin="pillow", extension=suffix)
    with writer as output:
        for frame in frames_of_one_size(frames, path):
            output.write(from_unit(frame, 8), is_batch=False, duration=1000 / fps, loop=0, lossless=True)
    atomic_write(path, buffer.getbuffer(), overwrite)


@dataclass(frozen=True, eq=False)
class _Animation:
    """Content of an animated file, its mode, and whether a still image that is no frame comes first."""

    data: bytes
    mode: str
    skips_first: bool

    def frames(self) -> Iterator[tuple[PixelArray, float]]:
        """Decode all frames: pixels, grey or RGB, and duration in milliseconds."""
        target = None if self.mode == "I;16" else "L" if self.mode in ("1", "L", "LA") else "RGB"
        with opened_images(self.data) as file:
            for index, pixels in enumerate(file.iter(mode=target)):
                if index >= self.skips_first:
                    facts = file.metadata(index=index, exclude_applied=False)
                    yield upright(pixels, facts.get("Orientation")), float(facts.get("duration", 0))


def _scan(path: Path, animation: _Animation) -> tuple[tuple[int, ...], list[float]]:
    """Shape of the frames, and duration of every frame up to the first that is damaged or missing."""
    shape: tuple[int, ...] = ()
    durations: list[float] = []
    with contextlib.suppress(DataError), image_errors(path):
        for pixels, duration in animation.frames():
            shape = pixels.shape
            durations.append(duration)
    return shape, durations


def _chosen_frames(path: Path, animation: _Animation, chosen: Sequence[int]) -> Iterator[PixelArray]:
    wanted, frames = frozenset(chosen), animation.frames()
    for number in range(chosen[-1] + 1):
        with image_errors(path):
            pixels, _ = next(frames)
        if number in wanted:
            yield pixels
