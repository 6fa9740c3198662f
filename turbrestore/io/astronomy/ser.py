"""SER, the uncompressed video format of astronomy cameras (version 3 of its description).

======  ====================================================================================
bytes   content
======  ====================================================================================
0–13    ``LUCAM-RECORDER``
14–41   seven int32: camera, colour, endianness flag, width, height, bits per plane, frames
42–161  observer, instrument, telescope
162     two int64: date, date in UTC
178     frames, rows from the top
then    optionally one int64 per frame: time in units of 100 ns
======  ====================================================================================

The description says that an endianness flag of 1 means little endian. The first programs wrote 0 with little-endian
pixels and most later ones followed them, so 0 is read as little endian and every other value as big endian, unless the
pixels themselves say the opposite: with swapped bytes an image is noise, and values exceed its bit depth.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray, from_unit
from ...core.errors import DataError
from ..limits import DEFAULT_LIMITS, Limits, input_errors
from ..output import atomic_output, frames_of_one_size
from ..pixels import BAYER_REMARK, LEAST_SIDE, PixelArray, check_depth, looks_like_bayer
from ..source import FrameSource, check_cut_short

SIGNATURE = b"LUCAM-RECORDER"
HEADER_SIZE = 178
TICKS_PER_SECOND = 10_000_000
_MONO, _RGB, _BGR = 0, 100, 101
_BAYER = {8: "rggb", 9: "grbg", 10: "gbrg", 11: "bggr"}
_NAMES = {_MONO: "mono", _RGB: "rgb", _BGR: "bgr", **_BAYER}
# Share of the roughness in the order of the header that the other order may have, chosen.
_SMOOTHER = 0.6


@dataclass(frozen=True)
class SerHeader:
    """Header of a SER file: size in pixels, number of frames, bits per plane and colour code.

    The colour code is 0 for mono; 8 to 11 for Bayer RGGB, GRBG, GBRG, BGGR; 100 for RGB and 101 for BGR.
    ``little_endian`` is the byte order of two-byte pixels as written in practice.
    """

    colour: int
    little_endian: bool
    width: int
    height: int
    bit_depth: int
    frames: int

    @property
    def dtype(self) -> np.dtype[np.unsignedinteger]:
        """Type of a pixel value in the file."""
        if self.bit_depth <= 8:
            return np.dtype(np.uint8)
        return np.dtype("<u2" if self.little_endian else ">u2")

    @property
    def planes(self) -> int:
        """Values per pixel."""
        return 3 if self.colour in (_RGB, _BGR) else 1

    @property
    def frame_bytes(self) -> int:
        """Size of a frame in the file."""
        return self.width * self.height * self.planes * self.dtype.itemsize


def read_ser_header(path: Path, limits: Limits = DEFAULT_LIMITS) -> SerHeader:
    """Read and check the header of a SER file."""
    with input_errors(path), path.open("rb") as file:
        data = file.read(HEADER_SIZE)
    if len(data) < HEADER_SIZE or not data.startswith(SIGNATURE):
        raise DataError(f"{path}: not a SER file; it does not begin with {SIGNATURE.decode()} and a whole header")
    _, colour, flag, width, height, depth, frames = (int(value) for value in np.frombuffer(data, "<i4", 7, 14))
    if colour not in _NAMES:
        raise DataError(f"{path}: expected mono, Bayer RGB or RGB frames, found colour code {colour}")
    if not 1 <= depth <= 16:
        raise DataError(f"{path}: expected 1 to 16 bits per plane, found {depth}")
    limits.check_size(width, height, str(path))
    if frames < 1:
        raise DataError(f"{path}: expected at least one frame, found {frames}; the recording was not completed")
    return SerHeader(colour, flag == 0, width, height, depth, frames)


def open_ser(
    path: Path, stop: int | None = None, limits: Limits = DEFAULT_LIMITS, skip_damaged: bool = False
) -> FrameSource:
    """Open a SER file; Bayer mosaics become RGB by bilinear interpolation.

    Frames from ``stop`` on are not needed, so they may be missing. With ``skip_damaged`` the whole frames of a file
    that is cut short are read. The errors are those of :func:`turbrestore.io.video.open_frames`.
    """
    header = read_ser_header(path, limits)
    with input_errors(path):
        size = path.stat().st_size
    present = (size - HEADER_SIZE) // header.frame_bytes
    notes = check_cut_short(path, present, stop, skip_damaged) if present < header.frames else ()
    limits.check_count(min(header.frames, present), str(path))
    if present:
        header, remarks = _as_pixels_say(path, header)
        notes = (*notes, *remarks)
    pattern = _BAYER.get(header.colour)
    times = _timestamps(path, header, size)
    notes = (*(["variable frame rate"] if times is not None and _has_gaps(times) else []), *notes)
    channels = () if header.colour == _MONO else (3,)
    return FrameSource(
        name=path.name,
        format=f"ser/{_NAMES[header.colour]}{header.bit_depth}",
        file_shape=(min(header.frames, present), header.height, header.width, *channels),
        full_scale=2**header.bit_depth - 1,
        bit_depth=header.bit_depth,
        pixels=lambda chosen: _frames(path, header, chosen),
        path=path,
        fps=None if times is None else (len(times) - 1) / float(times[-1]),
        timestamps=times,
        warnings=notes,
        bayer=pattern,
    )


def write_ser(
    path: Path, frames: Iterable[FloatArray], bit_depth: int = 16, fps: float | None = None, overwrite: bool = False
) -> None:
    """Write frames as a SER file, mono or RGB, little endian; a depth of 32 is written as 16 bits.

    With ``fps`` the time of every frame is stored, beginning on 1 January 2000.
    """
    depth = min(check_depth(bit_depth), 16)
    with atomic_output(path, overwrite) as temporary, temporary.open("wb") as file:
        count = 0
        file.write(bytes(HEADER_SIZE))
        for frame in frames_of_one_size(frames, path):
            pixels = from_unit(frame, depth)
            file.write(pixels.astype(pixels.dtype.newbyteorder("<")).tobytes())
            count += 1
        if fps is not None:
            start = (np.datetime64("2000-01-01") - np.datetime64("0001-01-01")) // np.timedelta64(1, "s")
            ticks = start * TICKS_PER_SECOND + np.rint(np.arange(count) * (TICKS_PER_SECOND / fps)).astype("<i8")
            file.write(ticks.astype("<i8").tobytes())
        file.seek(0)
        colour = _MONO if pixels.ndim == 2 else _RGB
        fields = np.array([0, colour, 0, pixels.shape[1], pixels.shape[0], depth, count], "<i4")
        file.write(SIGNATURE + fields.tobytes())


def _as_pixels_say(path: Path, header: SerHeader) -> tuple[SerHeader, tuple[str, ...]]:
    """Correct the byte order in the header by the first frame; return remarks on it and on a mosaic."""
    frame, remarks = next(_frames(path, header, [0])), []
    if header.bit_depth > 8 and _is_swapped(frame, 2**header.bit_depth - 1):
        header = replace(header, little_endian=not header.little_endian)
        frame = next(_frames(path, header, [0]))
        orders = ("little", "big") if header.little_endian else ("big", "little")
        remarks.append(f"read as {orders[0]} endian by its pixels, which are noise as {orders[1]} endian")
    if header.colour == _MONO and looks_like_bayer(frame):
        remarks.append(BAYER_REMARK)
    return header, tuple(remarks)


def _is_swapped(frame: PixelArray, full_scale: int) -> bool:
    """Whether an image is an image only with its bytes swapped."""
    if min(frame.shape[:2]) < LEAST_SIDE:
        return False
    readings = (np.ascontiguousarray(frame), frame.byteswap())
    fits = [bool(values.max() <= full_scale) for values in readings]
    if fits[0] != fits[1]:
        return fits[1]
    given, other = (_roughness(values) for values in readings)
    return other < _SMOOTHER * given


def _roughness(frame: PixelArray) -> float:
    """Mean difference of pixels of one colour side by side, relative to the mean deviation; 1.4 for noise."""
    values = frame.astype(np.float32)
    deviation = float(np.abs(values - values.mean()).mean())
    return float(np.abs(values[:, 2:] - values[:, :-2]).mean()) / deviation if deviation else 0.0


def _frames(path: Path, header: SerHeader, chosen: Sequence[int]) -> Iterator[PixelArray]:
    shape = (header.height, header.width) if header.planes == 1 else (header.height, header.width, 3)
    for number in chosen:
        with input_errors(path):
            # Frames are mapped one by one, so the pages of earlier frames are no memory of this process.
            offset = HEADER_SIZE + number * header.frame_bytes
            frame = np.memmap(path, header.dtype, "r", offset, shape)
        yield frame[..., ::-1] if header.colour == _BGR else frame


def _timestamps(path: Path, header: SerHeader, size: int) -> NDArray[np.float64] | None:
    start = HEADER_SIZE + header.frames * header.frame_bytes
    if header.frames < 2 or size < start + 8 * header.frames:
        return None
    with input_errors(path):
        ticks = np.fromfile(path, "<i8", header.frames, offset=start)
    # Recorders without a clock write zeros; a clock that was set back during the recording gives no frame rate.
    return (ticks - ticks[0]) / TICKS_PER_SECOND if np.all(np.diff(ticks) >= 0) and ticks[-1] > ticks[0] else None


def _has_gaps(times: NDArray[np.float64]) -> bool:
    """Whether frames are missing in time; the jitter of cameras is much smaller."""
    intervals = np.diff(times)
    return len(times) > 2 and bool(intervals.max() > 1.5 * np.median(intervals))
