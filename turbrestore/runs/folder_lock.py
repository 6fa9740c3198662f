"""One run at a time in a folder: a lock that dies with the process that holds it."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

from ..core.errors import OutputError

LOCK = ".lock"


@contextmanager
def lock_folder(folder: str | os.PathLike[str]) -> Iterator[bool]:
    """Hold a folder for one run; it is created if its parent is there, and removed again if it stays empty.

    The operating system releases the lock when the process ends, however it ends. The lock is one of ``flock`` on a
    file in the folder, on Windows one of ``LockFile``. Network file systems lock across machines as far as their server
    does.
    """
    place, is_new = Path(folder), False
    try:
        is_new = not place.exists()
        place.mkdir(exist_ok=True)
        descriptor, locks = _acquire(place / LOCK)
    except BlockingIOError as error:
        message = f"{place}: another run is at work in this folder; wait for it or name another one"
        raise OutputError(message) from error
    except OSError as error:
        raise OutputError(f"{place}: cannot be written to ({error.strerror or error})") from error
    except BaseException:
        # A signal came before the folder was held.
        with suppress(OSError):
            descriptor, _ = _acquire(place / LOCK)
            _release(place, descriptor, is_new)
        raise
    try:
        yield locks
    finally:
        _release(place, descriptor, is_new)


def _release(place: Path, descriptor: int, is_new: bool) -> None:
    """Remove and close the file that is locked, and a new folder if it is empty."""
    # Others must not see it free before it is gone.
    removed = _remove(place / LOCK)
    os.close(descriptor)
    if not removed:
        # Windows removes no file that is open, neither this one before nor that of another run now.
        _remove(place / LOCK)
    if is_new:
        with suppress(OSError):
            place.rmdir()


def _remove(path: Path) -> bool:
    with suppress(OSError):
        path.unlink()
        return True
    return False


def _acquire(path: Path) -> tuple[int, bool]:
    """Open and lock a file; whether the file system locks."""
    while True:
        # A link would have a file made or locked somewhere else.
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            locks = _lock(descriptor)
            # The holder before may have removed the file between our opening and our locking it.
            if _is_at(descriptor, path):
                return descriptor, locks
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _lock(descriptor: int) -> bool:
    """Lock a file, or raise BlockingIOError; whether the system and the file system lock at all."""
    try:
        import fcntl
    except ImportError:
        return _lock_on_windows(descriptor)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError as error:
        if error.errno in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
            return False
        raise
    return True


def _lock_on_windows(descriptor: int) -> bool:
    try:
        # Type checkers know it on Windows alone.
        msvcrt: Any = import_module("msvcrt")
    except ImportError:
        return False
    try:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    except PermissionError as error:
        raise BlockingIOError from error
    return True
