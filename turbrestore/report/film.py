"""One film of several panels, which a page shows through a divider: they cannot get out of step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, from_unit
from ..display.preview import shrink
from ..io.containers.encoding import Encoding, write_container
from .pictures import Stretch, stretch_of

# Longest side of a panel, pixels: players decode films of twice that.  Most pixels of one panel in all frames, which
# take about 15 MB, and most frames, half a minute of 25 a second; all chosen.
_LONGEST, _MOST_PIXELS, _MOST_FRAMES = 1920, 5e8, 750
_TITLES = {"input": "Input", "output": "Output", "difference": "Difference, doubled", "moving": "What moves"}
# The difference is shown so many times enlarged, around grey; what does not move is shown so bright; both chosen.
_ENLARGED, _DIMMED = 2.0, 0.3


@dataclass(frozen=True)
class Film:
    """What a page has to know of a film."""

    panels: tuple[str, ...]  # what is shown, two in a row
    # Size of a panel, pixels.
    width: int
    height: int
    count: int  # frames
    fps: float  # frames per second
    stretch: Stretch  # of the first frame of the output

    @property
    def layers(self) -> list[Layer]:
        """The panels with their places."""
        return [
            Layer(key, _TITLES[key], self.width, self.height, number % 2 * self.width, number // 2 * self.height)
            for number, key in enumerate(self.panels)
        ]


@dataclass(frozen=True)
class Layer:
    """One panel in the film: its name, its size, and its corner, pixels."""

    key: str
    title: str
    width: int
    height: int
    x: int
    y: int


def film_length(count: int, height: int, width: int) -> int:
    """Return how many frames of a video its film has: its length in memory and on the page is bounded."""
    scale = min(_LONGEST / max(height, width), 1.0) ** 2
    return min(count, _MOST_FRAMES, max(int(_MOST_PIXELS / (height * width * scale)), 1))


def write_film(
    path: Path,
    pairs: Iterable[tuple[FloatArray, FloatArray]],
    count: int,
    fps: float,
    rate_factor: int,
    masks: Iterable[NDArray[np.bool_]] | None = None,
) -> Film:
    """Write input and output as a film, with their difference and what moves if masks are given."""
    shown: list[FloatArray] = []
    written = 0
    panels = ("input", "output") if masks is None else tuple(_TITLES)

    def frames() -> Iterator[FloatArray]:
        nonlocal written
        moving = iter(masks) if masks is not None else None
        for number, pair in enumerate(pairs):
            mask = None if moving is None else next(moving)
            if number < count:
                seen, ours = (_panel(frame) for frame in pair)
                written += 1
                shown[:] = shown or [ours]
                yield _arranged(seen, ours, mask)

    write_container(path, frames(), fps, encoding=Encoding("h264", rate_factor))
    height, width = shown[0].shape[:2]
    return Film(panels, width, height, written, fps, stretch_of(from_unit(shown[0], 8)))


def _panel(frame: FloatArray) -> FloatArray:
    """Colour frame of at most the size of a panel, of even sides, which H.264 needs."""
    small = shrink(frame if frame.ndim == 3 else frame[..., None].repeat(3, -1), _LONGEST)
    height, width = small.shape[:2]
    return np.pad(small, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _arranged(seen: FloatArray, ours: FloatArray, mask: NDArray[np.bool_] | None) -> FloatArray:
    above = np.concatenate([seen, ours], axis=1)
    if mask is None:
        return above
    share = _panel(mask.astype(np.float32))
    below = np.concatenate([0.5 + _ENLARGED * (ours - seen), (_DIMMED + (1 - _DIMMED) * share) * ours], axis=1)
    return np.concatenate([above, below])
