"""Videos in and out: one function opens every supported input, one writes every supported output.

=====================================  ===========================  ===================================
input                                  module                       output
=====================================  ===========================  ===================================
.mkv .mp4 .mov .avi .gif and others    :mod:`.containers.decoding`  .mkv (FFV1, lossless), .mp4 (H.264)
.ser                                   :mod:`.astronomy.ser`        .ser
.tif .tiff (a stack)                   :mod:`.tiff`                 .tif .tiff
.npy, shape (T, H, W) or (T, H, W, 3)  :mod:`.npy`                  .npy
.png .apng .webp (an animation)        :mod:`.images`               .gif .webp (for viewing)
.fits .fit .fts (a cube), also .gz     :mod:`.astronomy.fits`
a folder of images, raw or FITS files  :mod:`.folders`
=====================================  ===========================  ===================================
"""

from __future__ import annotations

import dataclasses
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np

from ..core.arrays import FloatArray, check_image
from ..core.errors import DataError, require
from ..core.remarks import Doubt
from .astronomy.fits import open_fits
from .astronomy.fits_header import FITS_SUFFIXES, is_fits
from .astronomy.ser import open_ser, write_ser
from .containers.decoding import CONTAINER_SUFFIXES, is_container, open_container
from .containers.encoding import BY_SUFFIX, Encoding, Soundtrack, write_container
from .folders import open_folder
from .images.image_files import (
    ANIMATION_OUTPUT_SUFFIXES,
    ANIMATION_SUFFIXES,
    IMAGE_SUFFIXES,
    open_animation,
    write_animation,
)
from .images.raw_files import RAW_SUFFIXES
from .images.tiff import TIFF_SUFFIXES, open_tiff, write_tiff
from .limits import DEFAULT_LIMITS, Limits, check_input, content_suffix, input_errors
from .npy import open_npy, write_npy
from .output import check_output
from .pixels import BAYER_CODES, BAYER_REMARK, check_depth, doubted_pattern, to_unit
from .source import FrameRange, FrameSource, Roi, numbers_text, to_slice

VIDEO_SUFFIXES = (*CONTAINER_SUFFIXES, ".ser", *TIFF_SUFFIXES, ".npy", *ANIMATION_SUFFIXES, *FITS_SUFFIXES)
VIDEO_OUTPUT_SUFFIXES = (".mkv", ".mp4", ".ser", *TIFF_SUFFIXES, ".npy", *ANIMATION_OUTPUT_SUFFIXES)

__all__ = ["VIDEO_OUTPUT_SUFFIXES", "VIDEO_SUFFIXES", "FrameSource", "open_frames", "write_video"]


def open_frames(
    path: str | os.PathLike[str],
    *,
    frames: FrameRange | None = None,
    roi: Roi | None = None,
    limits: Limits = DEFAULT_LIMITS,
    skip_damaged: bool = False,
    bayer: str | None = None,
    hdr: Literal["sdr", "keep"] = "sdr",
    axes: str | None = None,
) -> FrameSource:
    """Open a video: read its headers, check that it is whole, and decode its first frame.

    The content of a file tells its format; its suffix does where the content does not.

    Parameters
    ----------
    path : path-like
        A video file, an animated image, a TIFF stack, a .npy array, a FITS cube or a folder of images or of FITS files.
        The images of a folder are sorted in natural order (frame2 before frame10); its other files are ignored.
    frames : tuple, optional
        (start, stop) or (start, stop, step), as in a slice; None as the stop is the end of the video. Damage outside
        the range is no error.
    roi : tuple of int, optional
        (x, y, width, height) in pixels.
    limits : Limits
        Largest video that is read.
    skip_damaged : bool
        Read a file that is cut short up to the cut, and leave out frames that are damaged, up to the next key frame
        where others depend on them, with a warning, instead of raising DataError.
    bayer : {"rggb", "grbg", "gbrg", "bggr"}, optional
        Take grey frames, and mosaics whose file names another pattern, for those of a Bayer sensor whose first pixels
        have these colours.
    hdr : {"sdr", "keep"}
        Turn HDR video (HLG, PQ) into the SDR picture, or keep its codes.
    axes : str, optional
        Order of the axes of a .npy array, such as ``thw``, ``hwt``, ``thwc`` or ``tchw``. By default the array tells.

    Returns
    -------
    FrameSource
        Decodes while iterating, with one frame at a time in memory. NaN and infinite values raise DataError there,
        unless :func:`turbrestore.clean_source` fills them.

    Raises
    ------
    InputNotFoundError
        The file or folder does not exist.
    DataError
        Not a video, damaged, cut short, empty, too large, or values outside [0, 1].
    ConfigurationError
        Range or rectangle outside the video, axes that do not fit, or FITS where Astropy is not installed.
    StorageError
        The file cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_video(folder + "/a.mkv", np.zeros((9, 4, 6), np.float32), fps=30)
    ...     source = open_frames(folder + "/a.mkv", frames=(2, 8), roi=(0, 0, 3, 2))
    ...     source.shape, len([frame for frame in source])
    ((6, 2, 3), 6)
    """
    require(hdr in ("sdr", "keep"), f"hdr: expected sdr or keep, found {hdr!r}")
    source = _open(Path(path), frames, limits, skip_damaged, hdr == "keep", axes)
    source = source if bayer is None else _as_bayer(source, bayer)
    source = source.select(frames, roi)
    source = source.without(source.damaged, Doubt(f"damaged: {numbers_text(source.damaged)} left out"))
    mosaic = next(source.select((0, 1)).mosaics())
    if source.bayer is not None and mosaic is not None:
        source = dataclasses.replace(source, warnings=(*source.warnings, *doubted_pattern(mosaic, source.bayer)))
    # Only the reader of a container sets a colour.  It has decoded the first frame of the file, and no frame of a video
    # is beyond full scale.
    if source.colour is None:
        _check_first(source)
    return source


def write_video(
    path: str | os.PathLike[str],
    frames: Iterable[FloatArray],
    fps: float,
    bit_depth: int = 8,
    overwrite: bool = False,
    encoding: Encoding = BY_SUFFIX,
    companion: FrameSource | None = None,
) -> None:
    """Write frames as a video, in the format given by the suffix.

    Parameters
    ----------
    path : path-like
        ``.mkv`` is lossless FFV1; ``.ser``, ``.tif`` and ``.npy`` are uncompressed; ``.mp4`` (H.264), ``.gif`` and
        ``.webp`` have 8 bits and are for viewing.
    frames : iterable of array_like, shape (H, W) or (H, W, 3)
        Intensities, all of one size; values outside [0, 1] are clipped. Taken one at a time.
    fps : float
        Frames per second; TIFF and .npy do not store it.
    bit_depth : int
        1 to 16, or 32 for floating point, which only TIFF and .npy support; .mkv and .ser write 16 bits instead. TIFF
        and .npy write 9 to 15 bits as 16, scaled to the full range.
    overwrite : bool
        Replace an existing file.
    encoding : Encoding
        Codec and quality of .mkv and .mp4.
    companion : FrameSource, optional
        Video file with a frame for each frame that is written, whose audio, time stamps and tags of colour .mkv and
        .mp4 take over.

    Raises
    ------
    ConfigurationError
        Unsupported suffix, bit depth, frame rate or codec.
    DataError
        No frames, frames of two sizes, or values that are not finite.
    OutputError, StorageError
        The file cannot be created or completed; nothing is left behind.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_video(folder + "/a.npy", np.zeros((2, 4, 6), np.float32), fps=30, bit_depth=32)
    ...     open_frames(folder + "/a.npy").format
    'npy/float32'
    """
    path = Path(path)
    check_output(path, overwrite=overwrite, suffixes=VIDEO_OUTPUT_SUFFIXES)
    check_depth(bit_depth)
    require(0 < fps < np.inf, f"fps: expected a positive number of frames per second, found {fps}")
    suffix = path.suffix.lower()
    checked = (check_image(frame, f"frame {number}") for number, frame in enumerate(frames))
    if suffix in (".mkv", ".mp4"):
        colour = None if companion is None else companion.colour
        write_container(path, checked, fps, bit_depth, overwrite, encoding, _soundtrack(companion), colour)
        return
    require(encoding == BY_SUFFIX, f"{path}: codec, crf: have an effect on .mkv and .mp4 only; leave them out")
    if suffix == ".ser":
        write_ser(path, checked, bit_depth, fps, overwrite)
    elif suffix == ".npy":
        write_npy(path, checked, bit_depth, overwrite)
    elif suffix in ANIMATION_OUTPUT_SUFFIXES:
        write_animation(path, checked, fps, overwrite)
    else:
        write_tiff(path, checked, bit_depth, overwrite)


def _soundtrack(companion: FrameSource | None) -> Soundtrack | None:
    """Audio and times of a video file; None for other sources."""
    if companion is None or companion.path is None or companion.timestamps is None:
        return None
    known = companion.path.is_file() and _suffix_of(companion.path) in CONTAINER_SUFFIXES
    return Soundtrack(companion.path, companion.timestamps) if known else None


def _open(
    path: Path, frames: FrameRange | None, limits: Limits, skip_damaged: bool, keep_hdr: bool, axes: str | None
) -> FrameSource:
    """Open a whole video by the reader of its format."""
    stop = to_slice(frames).stop
    is_folder = stat.S_ISDIR(check_input(path).st_mode)
    suffix = "" if is_folder else _suffix_of(path)
    require(axes is None or suffix == ".npy", "--axes: has an effect on .npy arrays alone; leave it out")
    if is_folder:
        source = open_folder(path, limits)
    elif suffix == ".ser":
        source = open_ser(path, stop, limits, skip_damaged)
    elif suffix in TIFF_SUFFIXES:
        source = open_tiff(path, limits)
    elif suffix == ".npy":
        source = open_npy(path, limits, axes)
    elif suffix == ".fits" or is_fits(path):
        source = open_fits(path, limits)
    elif suffix in ANIMATION_SUFFIXES:
        source = open_animation(path, stop, limits, skip_damaged)
    elif suffix in IMAGE_SUFFIXES:
        raise DataError(f"{path}: a single image; name a video, or the folder that holds the frames")
    elif suffix in CONTAINER_SUFFIXES or is_container(path):
        source = open_container(path, frames, limits, skip_damaged, keep_hdr)
    else:
        names, found = ", ".join(VIDEO_SUFFIXES), suffix or "no suffix"
        raise DataError(f"{path}: expected a folder of images or one of {names}, found {found}")
    return source


def _suffix_of(path: Path) -> str:
    """Suffix of the format of a file, which its content tells; raw files look like TIFF and others."""
    suffix = path.suffix.lower()
    if suffix in RAW_SUFFIXES:
        return suffix
    with input_errors(path), path.open("rb") as file:
        return content_suffix(file.read(64)) or suffix


def _as_bayer(source: FrameSource, pattern: str) -> FrameSource:
    """Take frames for mosaics of a Bayer sensor whose file does not say so, or names another pattern."""
    require(pattern in BAYER_CODES, f"bayer: expected one of {', '.join(BAYER_CODES)}, found {pattern!r}")
    if source.bayer is None and (len(source.file_shape) != 3 or source.bit_depth > 16):
        kind = "floating point" if len(source.file_shape) == 3 else "colours"
        raise DataError(f"{source.name}: --bayer: expected grey frames of 8 or 16 bits, found {kind}; leave it out")
    return dataclasses.replace(
        source,
        file_shape=(*source.file_shape[:3], 3),
        format=f"{source.format.split(' as ')[0]} as {pattern}",
        warnings=tuple(remark for remark in source.warnings if remark != BAYER_REMARK),
        bayer=pattern,
    )


def _check_first(source: FrameSource) -> None:
    """Refuse a wrong size or scale of the first frame when the video is opened."""
    (pixels,) = source.select((0, 1)).native()
    if np.issubdtype(pixels.dtype, np.floating):
        pixels = np.where(np.isfinite(pixels), pixels, 0)
    to_unit(pixels, source.full_scale, f"{source.name}: frame {source.numbers[0]}")
