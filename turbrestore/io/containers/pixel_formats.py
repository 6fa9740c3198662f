"""Pixel formats of video: how a decoded frame becomes grey or RGB pixels of its depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.errors import DataError
from ..pixels import PixelArray
from .transfer_curves import BT709, CURVES, UNKNOWN, sdr_of

if TYPE_CHECKING:
    import av

# Matrices of ITU-T H.273 and ranges of FFmpeg.
RGB = 0
VIDEO_RANGE, FULL_RANGE = 1, 2
# Rows from which video is of high definition.
HD_HEIGHT = 720


@dataclass(frozen=True)
class PixelFormat:
    """Native pixel format, and the format to which its frames are converted."""

    name: str
    target: str
    bit_depth: int
    full_scale: int
    channels: tuple[int, ...]
    alpha: bool
    orientation: int = 1
    ramp: bool = False
    transfer: int | None = None


def native_format(path: Path | str, native: av.VideoFormat) -> PixelFormat:
    """Tell how frames of a pixel format are decoded; DataError for formats of more than 16 bits."""
    name = native.name
    alpha = any(component.is_alpha for component in native.components)
    values = [component for component in native.components if not component.is_alpha]
    depth = max(component.bits for component in values)
    if depth > 16 or "f16" in name or "f32" in name:
        raise DataError(f"{path}: expected up to 16 bits, found {name}; store such frames as TIFF or .npy")
    if name.startswith("bayer"):
        depth = 8 if name.endswith("8") else 16
    if len(values) == 1 and not native.has_palette and not native.is_rgb:
        depth = max(depth, 8)
        target = "gray" if depth == 8 else f"gray{depth}le"
        return PixelFormat(name, target, depth, 2**depth - 1, (), alpha)
    if name.startswith("gbrp") and depth > 8:
        return PixelFormat(name, f"gbrp{depth}le", depth, 2**depth - 1, (3,), False)
    if depth > 8:
        return PixelFormat(name, "rgb48le", depth, 65535, (3,), alpha)
    return PixelFormat(name, "rgb24", 8, 255, (3,), alpha)


def has_grey_palette(frame: av.VideoFrame) -> bool:
    """Whether the palette of a frame is black to white, as programs write it beside grey frames in AVI."""
    if frame.format.name != "pal8":
        return False
    _, palette = frame.to_ndarray()
    return bool((palette[:, 1:] == np.arange(256)[:, None]).all())


def layout_of(path: Path, frame: av.VideoFrame, keep_hdr: bool) -> PixelFormat:
    """Tell how frames like the first are decoded; HDR ones become SDR at 16 bits unless they are kept."""
    layout = replace(native_format(path, frame.format), orientation=orientation_of(frame))
    if has_grey_palette(frame):
        return replace(layout, channels=(), ramp=True)
    if int(frame.color_trc) in CURVES and layout.channels and not keep_hdr:
        return replace(layout, target="rgb48le", full_scale=65535, transfer=int(frame.color_trc))
    return layout


def frame_pixels(frame: av.VideoFrame, layout: PixelFormat) -> PixelArray:
    """Pixels of a frame; converted from a palette FFmpeg's grey is off by one."""
    if not layout.ramp:
        pixels = convert(frame, layout.target).to_ndarray()
        return pixels if layout.transfer is None else sdr_of(layout.transfer)(pixels)
    indices, _ = frame.to_ndarray()
    return indices


def orientation_of(frame: av.VideoFrame) -> int:
    """Turn and reflection of the display matrix as an EXIF orientation; 1 where they are not multiples of 90°."""
    data: Any = frame.side_data.get("DISPLAYMATRIX")
    if data is None:
        return 1
    matrix = np.sign(np.frombuffer(bytes(data), np.int32).reshape(3, 3)[:2, :2])
    if frame.rotation % 90 or np.count_nonzero(matrix) != 2:
        return 1
    transposed = matrix[0, 0] == 0
    flips = (matrix[1, 0], matrix[0, 1]) if transposed else (matrix[0, 0], matrix[1, 1])
    return 1 + 4 * int(transposed) + [(1, 1), (-1, 1), (-1, -1), (1, -1)].index((int(flips[0]), int(flips[1])))


def convert(
    frame: av.VideoFrame, target: str, matrix: int | None = None, colour_range: int | None = None
) -> av.VideoFrame:
    """Convert a frame to the pixel format that FFmpeg calls ``target``, rounding to nearest.

    The matrix and range of YUV, numbers of ITU-T H.273 and of FFmpeg, are those of the frame if they are not given.
    """
    from av.video.reformatter import Interpolation

    if frame.format.name == target:
        return frame
    # By default FFmpeg rounds YUV down, by half a grey level on average.
    exact = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT
    # Players take video that does not say its matrix for BT.709 if it is high, and FFmpeg for BT.601.
    unsaid = frame.height >= HD_HEIGHT and int(frame.colorspace) == UNKNOWN and not frame.format.is_rgb
    return frame.reformat(
        format=target,
        interpolation=exact,
        src_colorspace=BT709 if unsaid else None,
        dst_colorspace=matrix or None,
        dst_color_range=colour_range,
    )
