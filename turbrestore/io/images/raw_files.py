"""Raw files of cameras, such as DNG, CR3 and NEF, developed by LibRaw through rawpy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import DataError
from ...core.extras import missing_package
from ..limits import DEFAULT_LIMITS, Limits, check_input, first_line, input_errors
from ..pixels import PixelArray

RAW_SUFFIXES = (
    *(".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2", ".pef", ".srw", ".3fr"),
    *(".iiq", ".rwl", ".erf", ".mrw"),
)


def read_raw_file(path: Path, limits: Limits = DEFAULT_LIMITS, like: Path | None = None) -> PixelArray:
    """Develop a raw file to sRGB of 16 bits, (H, W, 3), upright, at the brightness of the file.

    The white balance is that of the camera, of the file ``like`` for the frames of one video: a camera that chooses it
    for every shot would make them differ.
    """
    try:
        import rawpy
    except ImportError as error:
        raise missing_package(str(path), "rawpy", "raw") from error
    limits.check_bytes(check_input(path).st_size, str(path))
    balance = _white_balance(rawpy, path if like is None else like)
    with input_errors(path):
        path.open("rb").close()
    try:
        with rawpy.imread(str(path)) as raw:
            limits.check_size(raw.sizes.width, raw.sizes.height, str(path))
            return np.asarray(
                raw.postprocess(
                    # Bilinear, as other mosaics: what looks for edges finds those of the noise.
                    demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
                    user_wb=balance,
                    use_camera_wb=balance is None,
                    no_auto_bright=True,
                    # LibRaw would take the brightest value of a bright file for white.
                    adjust_maximum_thr=0,
                    output_bps=16,
                )
            )
    except rawpy.LibRawError as error:
        reason = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else first_line(error)
        raise DataError(f"{path}: not a raw file that LibRaw reads, or damaged ({reason})") from error


def _white_balance(rawpy: Any, path: Path) -> list[float] | None:
    """Multipliers that the camera has stored; None where it has stored none."""
    try:
        with rawpy.imread(str(path)) as raw:
            found = [float(value) for value in raw.camera_whitebalance]
    except rawpy.LibRawError:
        return None
    return found if min(found[:3]) > 0 else None
