"""The standard streams, which may be closed, full or read by nobody."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from typing import TextIO

from turbrestore.core.errors import StorageError


def open_closed() -> None:
    """Redirect closed streams to the null device, so that no file that is opened later takes their place."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            # The lowest number that is free is taken: this one.
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            # It stays open until the end of the process.
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", encoding="utf-8", closefd=False))


def put(text: str) -> None:
    """Write lines to standard output.

    Raises
    ------
    StorageError
        It takes no more, as on a full disk.
    BrokenPipeError
        Its reader has gone.
    """
    flush(f"{text}\n")


def flush(text: str = "") -> None:
    """Write out what standard output still holds back, and more; see :func:`put`."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        silence(sys.stdout)
        raise StorageError(f"standard output: cannot be written to ({error.strerror or error})") from error


def tell(text: str) -> None:
    """Write one line to standard error; nobody can be told where that fails, and the work goes on."""
    try:
        sys.stderr.write(f"{text}\n")
        sys.stderr.flush()
    except OSError:
        silence(sys.stderr)


def silence(stream: TextIO) -> None:
    """Redirect a stream to the null device: what it still holds back would fail again at the end of the process."""
    # Streams that are no files hold nothing back.
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
