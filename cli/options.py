"""Options that several commands share, and how they are read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from turbrestore.core.errors import ConfigurationError

if TYPE_CHECKING:
    from pathlib import Path

    from turbrestore.deconvolution.deconvolve import DeconvolutionParams
    from turbrestore.io.limits import Limits
    from turbrestore.io.source import FrameRange, Roi
    from turbrestore.runtime.memory_size import MemorySize
    from turbrestore.runtime.runtime import Runtime

# A switch without a "--no-" twin.
Flag = Annotated[bool, Parameter(negative="")]


@dataclass(frozen=True)
class Selection:
    """Which part of a video to read.

    Parameters
    ----------
    frames : str, optional
        Range of frames, such as ``0:200``.  ``start:stop`` or ``start:stop:step``; either end may be left out.
    roi : str, optional
        Region: ``x,y,width,height``, pixels.
    strict : bool
        Refuse what is otherwise repaired or left out: NaN, stuck pixels, duplicated and blank frames, cuts.
    skip_damaged : bool
        Read a file that is cut short or damaged as far as possible, instead of refusing it.
    max_pixels : int, optional
        Largest frame or image to read, pixels; by default 67 million.
    bayer : {"rggb", "grbg", "gbrg", "bggr"}, optional
        Bayer pattern of raw frames, from the upper left, in place of none or of the one that the file names.
    hdr : {"sdr", "keep"}
        Read HDR video as SDR, or keep its codes.  HLG and PQ are meant; ``steady`` writes kept codes as tagged HDR.
    dark : str, optional
        Frames taken with the lens covered.  A video, an image or a folder; their mean is subtracted, and hot pixels
        are filled.
    flat : str, optional
        Frames of an evenly lit surface.  A video, an image or a folder; their mean is divided out.
    crop_to_object : bool
        Follow a planet on a dark field.  Any bright object there will do; the window just holds it.
    axes : str, optional
        Order of the axes of a .npy array: thw, hwt, thwc, tchw or hwct.  By default the array tells.
    derotate : str, optional
        Turn the surface of a planet back to the middle of the clip: jupiter, mars, saturn or a period in hours, and
        perhaps the angle of the equator in the image and the latitude of the middle of the disc in degrees, such as
        mars,-20,8.  By default the flattening of the disc tells the angle.  Saturn's rings must not cross the globe.
    """

    frames: str | None = None
    roi: str | None = None
    strict: Flag = False
    skip_damaged: Flag = False
    max_pixels: int | None = None
    bayer: Literal["rggb", "grbg", "gbrg", "bggr"] | None = None
    hdr: Literal["sdr", "keep"] = "sdr"
    dark: str | None = None
    flat: str | None = None
    crop_to_object: Flag = False
    axes: str | None = None
    derotate: str | None = None

    def frame_range(self) -> FrameRange | None:
        """Return (start, stop, step), None where left out."""
        if self.frames is None:
            return None
        parts = self.frames.split(":")
        if len(parts) not in (2, 3):
            raise ConfigurationError(f"--frames: expected start:stop or start:stop:step, found {self.frames!r}")
        start, stop, step = (_whole_number("--frames", part) if part else None for part in [*parts, ""][:3])
        return start, stop, step

    def region(self) -> Roi | None:
        """Return (x, y, width, height)."""
        if self.roi is None:
            return None
        parts = self.roi.split(",")
        if len(parts) != 4:
            raise ConfigurationError(f"--roi: expected x,y,width,height, found {self.roi!r}")
        x, y, width, height = (_whole_number("--roi", part) for part in parts)
        return x, y, width, height

    def limits(self) -> Limits:
        """Return how large an input may be."""
        return limits_of(self.max_pixels)


@dataclass(frozen=True)
class Machine:
    """What a command may use of the machine.

    Parameters
    ----------
    threads : int
        Frames that are worked on side by side; 0 means one for each core.
    device : str
        Where to compute: cpu, cuda or auto.  auto takes a GPU where torch sees one.  A GPU computes flow by tvl1,
        warps, fusion and deconvolution.
    """

    threads: int = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        self.runtime()

    def runtime(self, memory_limit: MemorySize | None = None, scratch: Path | None = None) -> Runtime:
        """Return the record that the stages take."""
        from turbrestore.runtime.runtime import Runtime

        return Runtime(self.threads, memory_limit, self.device, scratch)


def limits_of(max_pixels: int | None) -> Limits:
    """Turn ``--max-pixels`` into limits."""
    from turbrestore.io.limits import DEFAULT_LIMITS

    return DEFAULT_LIMITS if max_pixels is None else replace(DEFAULT_LIMITS, max_pixels=max_pixels)


def known_sigma(sigma: float | None, deconvolution: DeconvolutionParams) -> DeconvolutionParams:
    """Put ``--sigma`` into the settings; it is short for ``--deconvolution.sigma``."""
    if sigma is None:
        return deconvolution
    if deconvolution.sigma not in (None, sigma):
        raise ConfigurationError(
            f"--sigma: {sigma} contradicts deconvolution.sigma = {deconvolution.sigma}; leave one of them out"
        )
    return replace(deconvolution, sigma=sigma)


def _whole_number(option: str, text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise ConfigurationError(f"{option}: expected whole numbers, found {text!r}") from None
    if value < 0:
        raise ConfigurationError(f"{option}: expected numbers from 0, found {value}")
    return value
