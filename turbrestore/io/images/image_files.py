"""Still images, and animated PNG, WebP and GIF files, by Pillow and imageio.

Pillow reduces 16-bit colour to 8 bits, so OpenCV decodes those images once Pillow has found them whole; TIFF is read by
:mod:`turbrestore.io.images.tiff`. The size in the header is checked before anything is decoded.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ...core.arrays import FloatArray, check_image, from_unit, from_unit_to_type
from ...core.errors import DataError, StorageError, TurbrestoreError
from ...core.remarks import Doubt
from ..astronomy.fits import read_fits
from ..astronomy.fits_header import FITS_SUFFIXES, is_fits
from ..astronomy.fits_output import write_fits
from ..counts import holds_counts, range_of_counts
from ..limits import DEFAULT_LIMITS, Limits, check_input, content_suffix, first_line, input_errors
from ..output import atomic_output, atomic_write, check_output, check_space, frames_of_one_size
from ..pixels import (
    ORIENTATION_TAG,
    PixelArray,
    at_full_range,
    at_levels,
    check_depth,
    depth_of,
    full_scale_of,
    to_unit,
    upright,
    without_alpha,
)
from ..source import FrameSource, check_cut_short
from .coded_images import CODED_SUFFIXES, decode_coded
from .raw_files import RAW_SUFFIXES, read_raw_file
from .tiff import TIFF_SUFFIXES, read_tiff

if TYPE_CHECKING:
    import PIL.Image

IMAGE_SUFFIXES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".tif",
    ".tiff",
    ".bmp",
    ".pgm",
    ".ppm",
    ".webp",
    *CODED_SUFFIXES,
    *RAW_SUFFIXES,
)
ANIMATION_SUFFIXES = (".png", ".apng", ".webp")
ANIMATION_OUTPUT_SUFFIXES = (".gif", ".webp")
# Bytes of a PNG file that state its bits a channel and its type of colour; that of grey with alpha.
_PNG_DEPTH, _PNG_COLOUR, _GREY_ALPHA = 24, 25, 4
# Pillow knows many more formats, some of which run other programs.
_FORMATS, _ANIMATED = ("PNG", "JPEG", "BMP", "PPM", "WEBP"), ("PNG", "WEBP")
# Modes of Pillow that become RGB, or RGBA where a palette has transparent colours.
_OTHER_COLOURS = ("P", "CMYK", "YCbCr", "LAB", "HSV", "RGBX", "RGBa")


@dataclass(frozen=True, eq=False)
class ImageFile:
    """A still image, float32 in [0, 1], the bit depth of its file, and what was left out, such as an alpha channel."""

    image: FloatArray
    bit_depth: int
    warnings: tuple[str, ...] = ()


def read_image(path: str | os.PathLike[str], limits: Limits = DEFAULT_LIMITS) -> ImageFile:
    """Read a still image, turned upright as its orientation tag demands.

    Parameters
    ----------
    path : path-like
        PNG, JPEG, TIFF (one page), BMP, PGM, PPM, WebP, AVIF, HEIC, JPEG 2000, JPEG XL, DPX, EXR, raw or FITS file.
        Of an animation the first frame is read.
    limits : Limits
        Largest image that is read.

    Returns
    -------
    ImageFile

    Raises
    ------
    InputNotFoundError
        The file does not exist.
    DataError
        Not an image, damaged, too large, a TIFF file of several pages, or values outside [0, 1].
    ConfigurationError
        A raw, HEIC or FITS file, and rawpy, pillow-heif or Astropy is not installed.
    StorageError
        The file cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_image(folder + "/a.png", np.array([[0.0, 1.0]], np.float32), bit_depth=8)
    ...     read_image(folder + "/a.png")
    ImageFile(image=array([[0., 1.]], dtype=float32), bit_depth=8, warnings=())
    """
    path = Path(path)
    pixels, notes = read_pixels(path, limits)
    counts = range_of_counts([pixels], str(path)) if holds_counts(pixels.dtype) else None
    if counts is not None:
        return ImageFile(counts.unit(pixels), 32, (counts.remark, *notes))
    return ImageFile(to_unit(pixels, full_scale_of(pixels.dtype, str(path)), str(path)), depth_of(pixels.dtype), notes)


def read_pixels(
    path: Path, limits: Limits = DEFAULT_LIMITS, like: Path | None = None
) -> tuple[PixelArray, tuple[str, ...]]:
    """Read a still image as :func:`read_image` does, but in the type of its file; return warnings too.

    A raw file takes its white balance from the file ``like``, if that is given.
    """
    if is_fits(path):
        return read_fits(path, limits)
    suffix = path.suffix.lower()
    if suffix not in IMAGE_SUFFIXES:
        names = ", ".join((*IMAGE_SUFFIXES, *FITS_SUFFIXES))
        raise DataError(f"{path}: expected an image ({names}), found {suffix or 'no suffix'}")
    if suffix in RAW_SUFFIXES:
        return read_raw_file(path, limits, like), ()
    data = _read_file(path, limits)
    kind = content_suffix(data) or suffix
    if kind in CODED_SUFFIXES:
        return without_alpha(decode_coded(path, kind, data, limits))
    if kind in TIFF_SUFFIXES:
        pixels, notes = read_tiff(path, data, limits)
        return (pixels, notes) if pixels is not None else without_alpha(_opencv_pixels(path, data))
    return without_alpha(_decoded(path, data, limits))


def open_animation(path: Path, stop: int | None, limits: Limits, skip_damaged: bool) -> FrameSource:
    """Open an animated PNG or WebP file; all frames are decoded once to find out whether they are whole.

    Frames from ``stop`` on are not needed, so they may be missing. With ``skip_damaged`` the whole frames of a PNG file
    that is cut short are read. 16-bit colour is read as 8 bits. The errors are those of
    :func:`turbrestore.io.video.open_frames`.
    """
    data = _read_file(path, limits)
    with _opened_image(path, data, limits, _ANIMATED) as image:
        # A still image that is no frame may come first.
        skipped = int(bool(image.info.get("default_image")))
        count, kind, mode = getattr(image, "n_frames", 1) - skipped, str(image.format).lower(), image.mode
    if count < 2:
        raise DataError(f"{path}: a single image; name a video, or the folder that holds the frames")
    limits.check_count(count, str(path))
    shape: tuple[int, ...] = ()
    durations: list[float] = []
    with contextlib.suppress(DataError):
        for pixels, duration in _animation_frames(path, data, range(skipped, skipped + count)):
            shape = pixels.shape
            durations.append(duration)
    present = len(durations)
    if kind == "png" and present == count:
        with _opened_image(path, data, limits, _ANIMATED) as image:
            # Decoding does not compare the checksums.
            image.verify()
    is_16_bit = mode == "I;16"
    notes: tuple[str, ...] = ("alpha channel ignored",) if mode in ("LA", "RGBA") else ()
    halved = kind == "png" and data[_PNG_DEPTH] == 16 and not is_16_bit
    notes += (Doubt("16-bit values read as 8 bits"),) if halved else ()
    notes += ("variable frame rate",) if len(set(durations[:-1])) > 1 else ()
    notes += check_cut_short(path, present, stop, skip_damaged, "damaged or cut short") if present < count else ()
    times = np.cumsum([0.0, *durations[:-1]]) / 1000
    return FrameSource(
        name=path.name,
        format=f"{kind}/{mode}",
        file_shape=(present, *shape),
        full_scale=65535 if is_16_bit else 255,
        bit_depth=16 if is_16_bit else 8,
        pixels=lambda chosen: (
            frame for frame, _ in _animation_frames(path, data, [skipped + number for number in chosen])
        ),
        path=path,
        fps=(present - 1) / float(times[-1]) if times[-1] > 0 else None,
        timestamps=times if times[-1] > 0 else None,
        warnings=notes,
    )


def write_image(
    path: str | os.PathLike[str],
    image: ArrayLike,
    bit_depth: int | None = None,
    overwrite: bool = False,
    levels: tuple[float, float] | None = None,
) -> None:
    """Write a still image as PNG, TIFF or FITS, chosen by the suffix.

    Parameters
    ----------
    path : path-like
        Ends in ``.png``, ``.tif``, ``.tiff`` or ``.fits``.
    image : array_like, shape (H, W) or (H, W, 3)
        Intensities; values outside [0, 1] are clipped.
    bit_depth : int, optional
        1 to 8 gives 8 bits, 9 to 16 gives 16 bits (always scaled to the full range of the file), 32 gives
        floating point in TIFF and FITS and 16 bits in PNG. By default 32.
    overwrite : bool
        Replace an existing file.
    levels : tuple of float, optional
        Numbers that 0 and 1 become in floating point, as ``FrameSource.levels`` has them.

    Raises
    ------
    ConfigurationError
        Unsupported suffix or bit depth.
    DataError
        The image has the wrong shape or is not finite.
    OutputError
        The file exists, or its folder is missing or not writable.
    StorageError
        Writing failed; nothing is left behind.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_image(folder + "/a.tif", np.full((2, 2), 0.3, np.float32))
    ...     read_image(folder + "/a.tif").image[0]
    array([0.3, 0.3], dtype=float32)
    """
    path = Path(path)
    check_output(path, overwrite=overwrite)
    if is_fits(path):
        write_fits(path, image, bit_depth, overwrite, levels=levels)
        return
    depth = check_depth(32 if bit_depth is None else bit_depth)
    is_png = path.suffix.lower() == ".png"
    pixels = from_unit_to_type(check_image(image, "image"), min(depth, 16) if is_png else depth)
    if is_png:
        done, data = cv2.imencode(".png", pixels if pixels.ndim == 2 else pixels[..., ::-1])
        if not done:
            raise StorageError(f"{path}: the PNG encoder failed on an image of shape {pixels.shape}")
        atomic_write(path, data.data, overwrite)
        return
    _write_page(path, at_levels(pixels, levels), overwrite)


def write_map(path: str | os.PathLike[str], values: FloatArray, overwrite: bool = False) -> None:
    """Write numbers that are no intensities as TIFF in floating point; infinite ones stay so.

    ``values`` (H, W).
    """
    check_output(path, overwrite=overwrite, suffixes=(".tif", ".tiff"))
    _write_page(path, values.astype(np.float32), overwrite)


def _write_page(path: str | os.PathLike[str], pixels: PixelArray, overwrite: bool) -> None:
    import tifffile

    check_space(path, pixels.nbytes)
    with atomic_output(path, overwrite) as temporary:
        tifffile.imwrite(temporary, pixels, photometric="minisblack" if pixels.ndim == 2 else "rgb", metadata=None)


def write_animation(path: Path, frames: Iterable[FloatArray], fps: float, overwrite: bool = False) -> None:
    """Write frames for viewing as GIF of 256 colours or lossless WebP of 8 bits, repeated without end.

    All frames are in memory at 8 bits until the end. GIF counts hundredths of a second, WebP thousandths.
    """
    import imageio.v3 as iio

    images = [from_unit(frame, 8) for frame in frames_of_one_size(frames, path)]
    kind = {"extension": path.suffix.lower(), "plugin": "pillow"}
    data = iio.imwrite("<bytes>", images, **kind, duration=1000 / fps, loop=0, lossless=True)
    atomic_write(path, data, overwrite)


def _read_file(path: Path, limits: Limits) -> bytes:
    """Read a whole file that is not empty."""
    limits.check_bytes(check_input(path).st_size, str(path))
    with input_errors(path):
        data = path.read_bytes()
    if not data:
        raise DataError(f"{path}: the file is empty")
    return data


def _decoded(path: Path, data: bytes, limits: Limits) -> PixelArray:
    """Upright pixels of the only or first image, with all channels."""
    with _opened_image(path, data, limits, _FORMATS) as image:
        if image.format == "PNG":
            # Decoding does not compare the checksums.
            image.verify()
    with _opened_image(path, data, limits, _FORMATS) as image:
        kind, orientation = image.format, image.getexif().get(ORIENTATION_TAG)
        target = "RGBA" if image.mode == "P" and "transparency" in image.info else "RGB"
        pixels = np.array(image.convert(target) if image.mode in _OTHER_COLOURS else image)
    white = _netpbm_white(data) if kind == "PPM" else 0
    if white > np.iinfo(np.uint8).max:
        # OpenCV does not end a number that the file ends with.
        pixels = at_full_range(_opencv_pixels(path, data + b"\n"), white)
    elif kind == "PNG" and data[_PNG_DEPTH] == 16:
        pixels = _opencv_pixels(path, data)
        # OpenCV returns grey with alpha as RGBA.
        pixels = pixels[..., [0, 3]] if data[_PNG_COLOUR] == _GREY_ALPHA else pixels
    if pixels.dtype == bool:
        pixels = np.uint8(255) * pixels
    return upright(pixels, orientation)


def _animation_frames(path: Path, data: bytes, places: Iterable[int]) -> Iterator[tuple[PixelArray, float]]:
    """Decode the images at these places: pixels, grey or RGB, and duration in milliseconds."""
    import PIL.Image

    with PIL.Image.open(io.BytesIO(data), formats=_ANIMATED) as image:
        target = image.mode if image.mode == "I;16" else "L" if image.mode in ("1", "L", "LA") else "RGB"
        for place in places:
            with _image_errors(path):
                image.seek(place)
                pixels = upright(np.array(image.convert(target)), image.getexif().get(ORIENTATION_TAG))
            yield pixels, float(image.info.get("duration", 0))


def _netpbm_white(data: bytes) -> int:
    """Value of white in the header of a PGM or PPM file, of which Pillow reads those up to 255 at full range."""
    header = re.match(rb"P[2356]\s+" + rb"(?:#[^\n]*\n\s*)*\d+\s+" * 2 + rb"(?:#[^\n]*\n\s*)*(\d+)", data)
    return int(header[1]) if header else 0


def _opencv_pixels(path: Path, data: bytes) -> PixelArray:
    """Grey, RGB or RGBA pixels."""
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise DataError(f"{path}: cannot be decoded as an image; the file is damaged or of an unsupported kind")
    return pixels if pixels.ndim == 2 else pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]


@contextlib.contextmanager
def _opened_image(path: Path, data: bytes, limits: Limits, formats: tuple[str, ...]) -> Iterator[PIL.Image.Image]:
    """Image of Pillow that is not decoded yet and has no more pixels than allowed."""
    import PIL.Image

    with _image_errors(path), PIL.Image.open(io.BytesIO(data), formats=formats) as image:
        limits.check_size(*image.size, str(path))
        yield image


@contextlib.contextmanager
def _image_errors(path: Path) -> Iterator[None]:
    """Turn the exceptions of Pillow into DataError, and silence its warnings."""
    import PIL.Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except TurbrestoreError:
        raise
    except PIL.Image.DecompressionBombError as error:
        raise DataError(f"{path}: has far more pixels than can be read") from error
    except PIL.UnidentifiedImageError as error:
        raise DataError(f"{path}: not an image of a known format") from error
    except Exception as error:  # Pillow raises SyntaxError, ValueError, struct.error and others, by the format
        raise DataError(f"{path}: not an image, or damaged ({first_line(error)})") from error
