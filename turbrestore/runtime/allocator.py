"""How the C library returns freed memory to the system."""

from __future__ import annotations

import contextlib
import ctypes
import platform
from collections.abc import Iterator

# M_MMAP_THRESHOLD of mallopt, and sizes from which arrays are mapped one by one: while memory is scarce, chosen, and
# by the time that glibc has adapted the threshold to large arrays; bytes.
_MMAP_THRESHOLD, _SCARCE, _ADAPTED = -3, 1 << 20, 32 << 20


@contextlib.contextmanager
def returning_freed_memory(wanted: bool = True) -> Iterator[None]:
    """Return arrays of a megabyte and more to the system as soon as they are freed.

    By default glibc keeps freed arrays of up to 32 MB for later ones, and what lies between those in use adds a third
    to the peak of a restoration at 1920×1080. The setting belongs to the process.
    """
    if not wanted or platform.libc_ver()[0] != "glibc":
        yield
        return
    library = ctypes.CDLL(None)
    library.mallopt(_MMAP_THRESHOLD, _SCARCE)
    try:
        yield
    finally:
        library.mallopt(_MMAP_THRESHOLD, _ADAPTED)
        library.malloc_trim(0)
