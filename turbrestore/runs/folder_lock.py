"""One run at a time in a folder: a lock that dies with the process that holds it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..core.errors import OutputError

LOCK = ".lock"


@contextmanager
def lock_folder(folder: str | os.PathLike[str]) -> Iterator[bool]:
    """Hold a folder for one run; it is created if its parent is there, and removed again if it stays empty.

    The operating system releases the lock when the process ends, however it ends. The lock is one of ``flock`` on a
    file in the folder, on Windows one of ``LockFile``. Network file systems lock across machines as far as their server
    does.
    """
    place = Path(folder)
    try:
        is_new = not place.exists()
        place.mkdir(exist_ok=True)
        descriptor, locks = _acquire(place / LOCK)
    except BlockingIOError as error:
        message = f"{place}: another run is at work in this folder; wait for it or name another one"
        raise OutputError(message) from error
    except OSError as error:
        raise OutputError(f"{place}: cannot be written to ({error.strerror or error})") from error
    try:
        yield locks
    finally:
        # Windows removes no file that is open, others must not see it free before it is gone.
        with suppress(OSError):
            (place / LOCK).unlink()
        os.close(descriptor)
        if is_new:
            with suppress(OSError):
                place.rmdir()


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
        except OSError:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


if sys.platform == "win32":
    import msvcrt

    def _lock(descriptor: int) -> bool:
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except PermissionError as error:
            raise BlockingIOError from error
        return True

else:
    import errno
    import fcntl

    def _lock(descriptor: int) -> bool:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError as error:
            if error.errno in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):
                return False
            raise
        return True
