"""How files are written: checks before the work begins, and files that are complete or not there.

Every file is written under a temporary name in its folder and renamed when it is complete (:func:`atomic_output`), so a
failure leaves nothing behind.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path

from ..core.arrays import FloatArray
from ..core.errors import ConfigurationError, DataError, OutputError, StorageError
from ..core.extras import missing_package

IMAGE_OUTPUT_SUFFIXES = (".png", ".tif", ".tiff", ".fits")
# Bytes that must stay free beside the file, chosen.
_SPARE = 1 << 20


def check_output(
    path: str | os.PathLike[str],
    inputs: Iterable[str | os.PathLike[str]] = (),
    overwrite: bool = False,
    suffixes: Collection[str] | None = IMAGE_OUTPUT_SUFFIXES,
) -> None:
    """Refuse an output that cannot be created, before any work begins.

    The output must be none of the ``inputs``, files or folders, under any name, and in none of the folders. Its suffix
    must be one of ``suffixes``, in lower case with the dot; None allows any.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffixes is not None and suffix not in suffixes:
        *others, last = suffixes
        names = f"{', '.join(others)} or {last}" if others else last
        raise ConfigurationError(f"{path}: expected a name that ends in {names}, found {suffix or 'no suffix'}")
    if suffixes is not None and suffix == ".fits" and find_spec("astropy") is None:
        raise missing_package(str(path), "astropy", "fits")
    try:
        folder = Path(os.path.realpath(path)).parent
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; name a file in it")
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is a device or a pipe, which is not written to; name a file")
        if not folder.is_dir():
            raise OutputError(f"{path}: the folder {folder} does not exist; create it first")
        for source in map(Path, inputs):
            if source.is_dir() and source.samefile(folder):
                raise OutputError(f"{path}: lies in the input folder {source}; choose another folder")
            if path.exists() and source.exists() and path.samefile(source):
                raise OutputError(f"{path}: is the input {source}; choose another name")
        if path.exists() and not overwrite:
            raise OutputError(f"{path}: exists already; choose another name or pass overwrite=True")
        if not os.access(folder, os.W_OK):
            raise OutputError(f"{path}: the folder {folder} is not writable")
    except OSError as error:
        raise OutputError(f"{path}: cannot be created ({error.strerror or error})") from error


def check_space(path: str | os.PathLike[str], size: int) -> None:
    """Raise StorageError unless ``size`` bytes, a tenth and a megabyte more are free where ``path`` lies."""
    place, needed = Path(os.path.realpath(path)), size + size // 10 + _SPARE
    try:
        total, _, free = shutil.disk_usage(place if place.is_dir() else place.parent)
    except OSError:
        return
    # Some file systems report no size.
    if total > 0 and free < needed:
        raise StorageError(f"{path}: needs {needed >> 20} MiB, found {free >> 20} MiB free; make room on the disk")


@contextmanager
def atomic_output(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """Provide a temporary file in the folder of ``path``, and rename it to ``path`` when the block has succeeded.

    Any exception in the block, Ctrl-C included, removes the temporary file and leaves ``path`` as it was. A symbolic
    link is followed. OutputError is raised where no file can be created, StorageError where writing fails.
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
        # fsync through a new descriptor flushes what any library has written to the file.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(target)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror or error}); nothing was saved") from error
    finally:
        # Windows removes no file that a library has left open after an error, which is the one to be told.
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def atomic_write(path: str | os.PathLike[str], data: bytes | memoryview, overwrite: bool = False) -> None:
    """Write ``data`` to a file completely or not at all; the errors are those of :func:`atomic_output`."""
    check_space(path, len(data))
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(data)


def size_text(shape: tuple[int, ...]) -> str:
    """Size and kind of a frame of shape (H, W) or (H, W, C), for messages, such as 640×480 RGB."""
    kind = "grey" if len(shape) == 2 else "RGB" if shape[2] == 3 else f"{shape[2]} channels"
    return f"{shape[1]}×{shape[0]} {kind}"


def frames_of_one_size(frames: Iterable[FloatArray], path: str | os.PathLike[str]) -> Iterator[FloatArray]:
    """Yield the frames of a video that is written to ``path``; raise DataError for none or for two sizes."""
    shape = None
    for number, frame in enumerate(frames):
        shape = shape or frame.shape
        if frame.shape != shape:
            expected, found = size_text(shape), size_text(frame.shape)
            raise DataError(f"{path}: frame {number}: expected {expected} as the first frame, found {found}")
        yield frame
    if shape is None:
        raise DataError(f"{path}: expected at least one frame, found none")
