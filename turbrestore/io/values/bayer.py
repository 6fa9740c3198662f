"""Frames of a Bayer sensor whose files do not say so."""

from __future__ import annotations

import dataclasses

from ...core.errors import DataError, require
from ..pixels import BAYER_CODES, demosaic
from ..source import FrameSource


def as_bayer(source: FrameSource, pattern: str) -> FrameSource:
    """Take grey frames for mosaics of a Bayer sensor."""
    require(pattern in BAYER_CODES, f"bayer: expected one of {', '.join(BAYER_CODES)}, found {pattern!r}")
    if len(source.file_shape) != 3 or source.bit_depth > 16:
        kind = "floating point" if len(source.file_shape) == 3 else "colours"
        raise DataError(f"{source.name}: --bayer: expected grey frames of 8 or 16 bits, found {kind}; leave it out")
    return dataclasses.replace(
        source,
        file_shape=(*source.file_shape, 3),
        format=f"{source.format} as {pattern}",
        develop=lambda pixels: demosaic(pixels, pattern),
    )
