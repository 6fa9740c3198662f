"""Sizes of memory as people write them."""

from __future__ import annotations

import difflib
from typing import Self

from ..core.errors import ConfigurationError, require

_UNITS = {"": 1, "b": 1, "kb": 1e3, "mb": 1e6, "gb": 1e9, "tb": 1e12, "kib": 2**10, "mib": 2**20, "gib": 2**30}
_SPELT = {"kb": "kB", "mb": "MB", "gb": "GB", "tb": "TB", "kib": "KiB", "mib": "MiB", "gib": "GiB"}
# As close as GBB is to GB and G to it, but not as QB is to four of them.
_CLOSE = 0.65


class MemorySize(float):
    """Number of bytes; text such as ``"2GB"`` or ``"1.5 GiB"`` is understood, with a unit of kB to TB or KiB to GiB."""

    def __new__(cls, value: float | str) -> Self:
        """Read number and unit."""
        expected = "memory_limit: expected a size such as 2GB, 800MB or 1.5GiB"
        text = str(value).strip()
        digits = text.rstrip("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ ")
        unit = text[len(digits) :].strip().lower()
        try:
            size = float(digits) * _UNITS[unit]
        except (KeyError, ValueError):
            # Who writes a unit wrong does not mean single bytes.
            close = difflib.get_close_matches(unit, _SPELT, n=1, cutoff=_CLOSE)
            meant = f"; did you mean {digits}{_SPELT[close[0]]}?" if digits and close else ""
            raise ConfigurationError(f"{expected}, found {value!r}{meant}") from None
        require(0 < size < float("inf"), f"{expected}, found {value!r}")
        # Nobody who writes a few bytes means bytes.
        is_short = isinstance(value, str) and unit == "" and size < _UNITS["kb"]
        require(not is_short, f"{expected}, found {value!r}; did you mean {text}GB?")
        return super().__new__(cls, size)


def size_text(size: float) -> str:
    """Write a number of bytes with a unit in which it is no less than one."""
    if size >= _UNITS["gb"]:
        return f"{size / _UNITS['gb']:.2f} GB"
    if size >= _UNITS["mb"]:
        return f"{-(-size // _UNITS['mb']):.0f} MB"
    return f"{size / _UNITS['kb']:.1f} kB" if size >= _UNITS["kb"] else f"{size:g} bytes"
