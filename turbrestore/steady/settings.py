"""Settings of steadied video."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..core.errors import require, require_between

CAMERAS = ("keep", "steady", "lock")
# Frames that a live stream may lag behind: what docs/steady.md promises, chosen.
_LAG = 2


@dataclass(frozen=True)
class SteadyParams:
    """How a video is steadied.

    Parameters
    ----------
    camera : {"keep", "steady", "lock"}
        What becomes of the motion of the camera: kept, smoothed, or removed, so that every frame of a scene shows what
        its first frame shows.
    sigma : float, optional
        Standard deviation of the blur to remove, pixels; 0 removes none.  Estimated by default.
    reach : int
        Distance of the furthest neighbours of a frame, frames: the delay of a stream.
    live : bool
        Lag two frames behind the input instead of ``reach``.  Neighbours after a frame are at most two frames away, and
        no blur is removed until it has been estimated.
    largest : float, optional
        Largest displacement by turbulence, pixels; larger ones count as motion and are kept.  By default it is measured
        while the camera rests or moves evenly, and falls towards 1 while it shakes.

    Raises
    ------
    ConfigurationError
        A setting is out of range.

    Examples
    --------
    >>> SteadyParams(reach=6).distances
    (1, 3, 4, 6)
    """

    camera: Literal["keep", "steady", "lock"] = "keep"
    sigma: float | None = None
    reach: int = 12
    live: bool = False
    largest: float | None = None

    def __post_init__(self) -> None:
        require(self.camera in CAMERAS, f"camera: expected one of {', '.join(CAMERAS)}, found {self.camera!r}")
        require_between("reach", self.reach, 1, 60, "frames")
        if self.largest is not None:
            require_between("largest", self.largest, 0.1, 100, "pixels")
        if self.sigma is not None:
            require_between("sigma", self.sigma, 0, 20, "pixels")

    @property
    def later(self) -> tuple[int, ...]:
        """Distances of the neighbours after a frame, frames."""
        return tuple(range(1, min(self.reach, _LAG) + 1)) if self.live else self.distances

    @property
    def distances(self) -> tuple[int, ...]:
        """Distances of the neighbours before a frame, and after it, frames: 1, and the quarters of ``reach``."""
        return tuple(sorted({1, *(max(self.reach * quarter // 4, 1) for quarter in (1, 2, 3, 4))}))
