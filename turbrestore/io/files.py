"""Files that are read: their size, and the errors that reading them raises."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..core.errors import DataError, InputNotFoundError, StorageError

_KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


@contextmanager
def input_errors(path: Path) -> Iterator[None]:
    """Turn the system's errors while reading ``path`` into turbrestore's.

    Parameters
    ----------
    path : Path
        The file or folder that is read.

    Raises
    ------
    InputNotFoundError
        It does not exist.
    StorageError
        It cannot be read, for example for want of permission.

    Examples
    --------
    >>> with input_errors(Path("missing.mkv")):
    ...     Path("missing.mkv").read_bytes()
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.InputNotFoundError: missing.mkv: no such file or folder
    """
    try:
        yield
    except FileNotFoundError as error:
        raise InputNotFoundError(f"{path}: no such file or folder") from error
    except OSError as error:
        raise StorageError(f"{path}: cannot be read ({error.strerror or error})") from error


def check_input(path: Path) -> os.stat_result:
    """Refuse what is neither a file nor a folder: a pipe waits for a writer, and a device may have no end.

    Parameters
    ----------
    path : Path
        What is read; a symbolic link is followed.

    Returns
    -------
    os.stat_result
        What the system knows of it, such as its size.

    Raises
    ------
    InputNotFoundError, StorageError
        As :func:`input_errors`.
    DataError
        A pipe, a socket or a device.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "a.npy").write_bytes(bytes(9))
    ...     check_input(Path(folder, "a.npy")).st_size
    9
    """
    with input_errors(path):
        found = path.stat()
    kind = _KINDS.get(stat.S_IFMT(found.st_mode))
    if kind is not None:
        raise DataError(f"{path}: expected a file, found {kind}; copy what it gives to a file")
    return found


def first_line(error: BaseException) -> str:
    r"""First line of an error's message, for messages of one line.

    Parameters
    ----------
    error : BaseException
        Any error.

    Returns
    -------
    str

    Examples
    --------
    >>> first_line(ValueError("too short\nmore"))
    'too short'
    """
    # A failed look-up says no more than its key.
    lines = [] if isinstance(error, LookupError) else str(error).splitlines()
    return (lines or [type(error).__name__])[0]
