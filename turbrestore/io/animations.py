"""Animated PNG, WebP and GIF files, read and written by Pillow."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from ..core.arrays import FloatArray, from_unit
from ..core.errors import DataError
from .images import ORIENTATION, image_errors, opened_image, read_file
from .limits import DEFAULT_LIMITS, Limits
from .output import atomic_write, frames_of_one_size
from .pixels import PixelArray, upright
from .source import FrameSource, check_cut_short

ANIMATION_SUFFIXES = (".png", ".apng", ".webp")
ANIMATION_OUTPUT_SUFFIXES = (".gif", ".webp")
_FORMATS = ("PNG", "WEBP")


def open_animation(
    path: Path, stop: int | None = None, limits: Limits = DEFAULT_LIMITS, skip_damaged: bool = False
) -> FrameSource:
    """Open an animated PNG or WebP file; all frames are decoded once to find out whether they are whole.

    Frames from ``stop`` on are not needed, so they may be missing. With ``skip_damaged`` the whole frames of a PNG file
    that is cut short are read. 16-bit colour is read as 8 bits. The errors are those of
    :func:`turbrestore.io.video.open_frames`.
    """
    data = read_file(path, limits)
    with opened_image(path, data, limits, _FORMATS) as image:
        # A still image that is no frame may come first.
        skipped = int(bool(image.info.get("default_image")))
        count, kind, mode = getattr(image, "n_frames", 1) - skipped, str(image.format).lower(), image.mode
    if count < 2:
        raise DataError(f"{path}: a single image; name the folder that holds the frames")
    limits.check_count(count, str(path))
    shape: tuple[int, ...] = ()
    durations: list[float] = []
    with contextlib.suppress(DataError):
        for pixels, duration in _frames(path, data, range(skipped, skipped + count)):
            shape = pixels.shape
            durations.append(duration)
    present = len(durations)
    if kind == "png" and present == count:
        with opened_image(path, data, limits, _FORMATS) as image:
            # Decoding does not compare the checksums.
            image.verify()
    deep = mode == "I;16"
    notes: tuple[str, ...] = ("alpha channel ignored",) if mode in ("LA", "RGBA") else ()
    notes += ("16-bit values read as 8 bits",) if kind == "png" and data[24] == 16 and not deep else ()
    notes += ("variable frame rate",) if len(set(durations[:-1])) > 1 else ()
    notes += check_cut_short(path, present, stop, skip_damaged, "damaged or cut short") if present < count else ()
    times = np.cumsum([0.0, *durations[:-1]]) / 1000
    return FrameSource(
        name=path.name,
        format=f"{kind}/{mode}",
        file_shape=(present, *shape),
        full_scale=65535 if deep else 255,
        bit_depth=16 if deep else 8,
        pixels=lambda chosen: (frame for frame, _ in _frames(path, data, [skipped + number for number in chosen])),
        path=path,
        fps=(present - 1) / float(times[-1]) if times[-1] > 0 else None,
        timestamps=times if times[-1] > 0 else None,
        warnings=notes,
    )


def write_animation(path: Path, frames: Iterable[FloatArray], fps: float, overwrite: bool = False) -> None:
    """Write frames for viewing as GIF of 256 colours or lossless WebP of 8 bits, repeated without end.

    All frames are in memory at 8 bits until the end. GIF counts hundredths of a second, WebP thousandths.
    """
    import PIL.Image

    images = [PIL.Image.fromarray(from_unit(frame, 8)) for frame in frames_of_one_size(frames, path)]
    buffer = io.BytesIO()
    kind, rest = path.suffix[1:].upper(), images[1:]
    images[0].save(buffer, kind, save_all=True, append_images=rest, duration=1000 / fps, loop=0, lossless=True)
    atomic_write(path, buffer.getbuffer(), overwrite)


def _frames(path: Path, data: bytes, places: Iterable[int]) -> Iterator[tuple[PixelArray, float]]:
    """Decode the images at these places: pixels, grey or RGB, and duration in milliseconds."""
    import PIL.Image

    with PIL.Image.open(io.BytesIO(data), formats=_FORMATS) as image:
        target = image.mode if image.mode == "I;16" else "L" if image.mode in ("1", "L", "LA") else "RGB"
        for place in places:
            with image_errors(path):
                image.seek(place)
                pixels = upright(np.array(image.convert(target)), image.getexif().get(ORIENTATION))
            yield pixels, float(image.info.get("duration", 0))
