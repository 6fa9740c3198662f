"""Still images in and out, and how any file is written.

Every file is written under a temporary name in its folder and takes its real name only when it is complete
(:func:`atomic_output`), so a failure leaves nothing behind.

OpenCV decodes the images, because imageio and Pillow cut 16-bit RGB down to 8 bits. What must not be decoded is refused
before (:mod:`turbrestore.io.image_headers`).
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_image, from_unit
from ..core.errors import ConfigurationError, DataError, OutputError, StorageError
from ..runtime.scratch import iter_parts
from .files import check_input, input_errors
from .image_headers import check_still
from .limits import DEFAULT_LIMITS, Limits
from .pixels import PixelArray, check_depth, depth_of, full_scale_of, to_unit

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp")
IMAGE_OUTPUT_SUFFIXES = (".png", ".tif", ".tiff")
# Bytes that must stay free beside what is written.
_SPARE = 1 << 20


@dataclass(frozen=True, eq=False)
class ImageFile:
    """A still image and what its file said about it.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        Intensities in [0, 1], RGB.
    bit_depth : int
        8, 16, or 32 for floating point files.
    warnings : tuple of str
        What was left out, such as an alpha channel.
    """

    image: FloatArray
    bit_depth: int
    warnings: tuple[str, ...] = ()


def read_image(path: str | os.PathLike[str], limits: Limits = DEFAULT_LIMITS) -> ImageFile:
    """Read a still image.

    Parameters
    ----------
    path : path-like
        PNG, JPEG, TIFF (one page), BMP, PGM, PPM or WebP file.
    limits : Limits
        Largest image that is read.

    Returns
    -------
    ImageFile

    Raises
    ------
    InputNotFoundError
        No such file.
    DataError
        Not an image, damaged, too large, more than one page, or values that are no intensities.
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
    return ImageFile(to_unit(pixels, full_scale_of(pixels.dtype, str(path)), str(path)), depth_of(pixels.dtype), notes)


def read_pixels(path: Path, limits: Limits = DEFAULT_LIMITS) -> tuple[PixelArray, tuple[str, ...]]:
    """Read a still image as its file has it: grey or RGB, alpha dropped, values not scaled.

    Parameters
    ----------
    path : Path
        See :func:`read_image`.
    limits : Limits
        Largest image that is read.

    Returns
    -------
    pixels : ndarray, shape (H, W) or (H, W, 3)
        In the type of the file.
    warnings : tuple of str
        What was left out.

    Raises
    ------
    InputNotFoundError, DataError, StorageError
        As :func:`read_image`.
    """
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        raise DataError(f"{path}: expected an image ({', '.join(IMAGE_SUFFIXES)}), found {path.suffix or 'no suffix'}")
    limits.check_bytes(check_input(path).st_size, str(path))
    with input_errors(path):
        data = path.read_bytes()
    if not data:
        raise DataError(f"{path}: the file is empty")
    check_still(path, data, limits)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise DataError(f"{path}: cannot be decoded as an image; the file is damaged or of an unsupported kind")
    if pixels.ndim == 2:
        return pixels, ()
    notes = ("alpha channel ignored",) if pixels.shape[2] == 4 else ()
    return np.ascontiguousarray(pixels[..., 2::-1]), notes


def write_image(
    path: str | os.PathLike[str], image: ArrayLike, bit_depth: int | None = None, overwrite: bool = False
) -> None:
    """Write a still image as PNG or TIFF, chosen by the suffix.

    Parameters
    ----------
    path : path-like
        Ends in ``.png``, ``.tif`` or ``.tiff``.
    image : array_like, shape (H, W) or (H, W, 3)
        Intensities; values outside [0, 1] are clipped.
    bit_depth : int, optional
        1 to 8 gives 8 bits, 9 to 16 gives 16 bits (always scaled to the full range of the file), 32 gives
        floating point in TIFF and 16 bits in PNG. By default 32.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    ConfigurationError
        Unsupported suffix or bit depth.
    DataError
        The image has the wrong shape or is not finite.
    OutputError
        The file exists, or its folder is missing or not writable.
    StorageError
        Writing failed half-way; nothing is left behind.

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
    depth = check_depth(32 if bit_depth is None else bit_depth)
    is_tiff = path.suffix.lower() != ".png"
    pixels = _stored(check_image(image, "image"), depth, is_tiff)
    if not is_tiff:
        atomic_write(path, _encode_png(path, pixels), overwrite)
        return
    import tifffile

    check_space(path, pixels.nbytes)
    with atomic_output(path, overwrite) as temporary:
        tifffile.imwrite(temporary, pixels, photometric="minisblack" if pixels.ndim == 2 else "rgb", metadata=None)


def check_output(
    path: str | os.PathLike[str],
    inputs: Iterable[str | os.PathLike[str]] = (),
    overwrite: bool = False,
    suffixes: Collection[str] | None = IMAGE_OUTPUT_SUFFIXES,
) -> None:
    """Refuse an output that cannot be created, before any work begins.

    Parameters
    ----------
    path : path-like
        The file to be written.
    inputs : iterable of path-like
        Files and folders that are read; the output is none of them, under any name, nor inside such a folder.
    overwrite : bool
        Whether an existing file may be replaced.
    suffixes : collection of str, optional
        Suffixes that the writer supports, lower case with the dot; None allows any.

    Raises
    ------
    ConfigurationError
        Unsupported suffix.
    OutputError
        The path is a folder, an input, exists already, or its folder is missing or not writable.

    Examples
    --------
    >>> check_output("result.xyz")
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.ConfigurationError: result.xyz: expected a name that ends in .png, .tif or .tiff, found .xyz
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffixes is not None and suffix not in suffixes:
        *others, last = suffixes
        names = f"{', '.join(others)} or {last}" if others else last
        raise ConfigurationError(f"{path}: expected a name that ends in {names}, found {suffix or 'no suffix'}")
    try:
        folder = Path(os.path.realpath(path)).parent
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; name a file in it")
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is a device or a pipe, which is not written to; name a file")
        if not folder.is_dir():
            raise OutputError(f"{path}: the folder {folder} does not exist; create it first")
        for source in map(Path, inputs):
            _check_not_input(path, folder, source)
        if path.exists() and not overwrite:
            raise OutputError(f"{path}: exists already; choose another name or allow overwriting")
        if not os.access(folder, os.W_OK):
            raise OutputError(f"{path}: the folder {folder} is not writable")
    except OSError as error:
        raise OutputError(f"{path}: cannot be created ({error.strerror or error})") from error


def check_space(path: str | os.PathLike[str], size: int) -> None:
    """Refuse to begin what does not fit on the disk.

    Parameters
    ----------
    path : path-like
        A file or folder to be written; its folder exists.
    size : int
        Bytes that are expected; a tenth and a megabyte more must be free.

    Raises
    ------
    StorageError
        There is less.

    Examples
    --------
    >>> check_space("result.png", 10**30)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.StorageError: result.png: needs ... MiB, found ... MiB free; make room on the disk
    """
    folder = Path(os.path.realpath(path)).parent
    needed = size + size // 10 + _SPARE
    try:
        total, _, free = shutil.disk_usage(folder)
    except OSError:
        return
    # Not every file system tells; those of the kernel have no size.
    if total > 0 and free < needed:
        raise StorageError(f"{path}: needs {needed >> 20} MiB, found {free >> 20} MiB free; make room on the disk")


@contextmanager
def atomic_output(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """Give a temporary file in the folder of ``path``, and rename it to ``path`` when the block has succeeded.

    Whatever ends the block early, Ctrl-C included, removes the temporary file and leaves ``path`` as it was.

    Parameters
    ----------
    path : path-like
        The file to be written; a symbolic link is followed.
    overwrite : bool
        Replace an existing file.

    Yields
    ------
    Path
        An empty file to write to.

    Raises
    ------
    OutputError
        The file exists, or no file can be created in its folder.
    StorageError
        Writing failed half-way.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_output(folder + "/a.txt") as temporary:
    ...         _ = temporary.write_text("complete")
    ...     Path(folder, "a.txt").read_text()
    'complete'
    """
    check_output(path, overwrite=overwrite, suffixes=None)
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{secrets.token_hex(8)}.part")
    try:
        temporary.open("xb").close()
    except OSError as error:
        raise OutputError(f"{path}: cannot be created ({error.strerror or error})") from error
    try:
        yield temporary
        # A new descriptor flushes what the writer left to the system, whoever wrote it.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(target)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror or error}); nothing was saved") from error
    finally:
        temporary.unlink(missing_ok=True)


def atomic_write(path: str | os.PathLike[str], data: bytes | memoryview, overwrite: bool = False) -> None:
    """Write a whole file or nothing.

    Parameters
    ----------
    path : path-like
        The file to be written.
    data : bytes or memoryview of bytes
        Its content.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputError, StorageError
        As :func:`atomic_output`.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     atomic_write(folder + "/a.json", b"{}")
    ...     Path(folder, "a.json").read_bytes()
    b'{}'
    """
    check_space(path, len(data))
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(data)


def _stored(image: FloatArray, depth: int, is_tiff: bool) -> PixelArray:
    """Pixels as they lie in the file."""
    if depth != 32 or not is_tiff:
        return from_unit(image, 8 if depth <= 8 else 16)
    pixels, done = np.empty(image.shape, np.float32), 0
    for part in iter_parts(image):
        np.clip(part, 0, 1, out=pixels[done : done + len(part)])
        done += len(part)
    return pixels


def _encode_png(path: Path, pixels: PixelArray) -> memoryview:
    done, data = cv2.imencode(".png", pixels if pixels.ndim == 2 else pixels[..., ::-1])
    if not done:
        raise StorageError(f"{path}: the PNG encoder failed on an image of shape {pixels.shape}")
    return data.data


def _check_not_input(path: Path, folder: Path, source: Path) -> None:
    if source.is_dir() and source.samefile(folder):
        raise OutputError(f"{path}: lies in the input folder {source}; choose another folder")
    if path.exists() and source.exists() and path.samefile(source):
        raise OutputError(f"{path}: is the input {source}; choose another name")
