"""Detection of cuts: which frames of a video show the same scene.

Frames are compared as 32×32 thumbnails without slow shading, by the normalised cross-correlation at its best circular
shift. On eight simulated and twelve real clips, some with drift and shake, frames of one scene reach 0.69 or more, and
half of all pairs of different scenes stay below 0.23. Scenes that look alike at this size, such as two pages of text,
are taken for one. Where all frames differ, as under heavy noise, no cut is reported.

After the meridian flip of a telescope the picture is turned by 180°, which a banded planet resembles unturned as well.
Frames are therefore compared both ways, as smoothed thumbnails under shifts of a quarter of a pixel, without which a
round disc seems to turn when it moves.  On the same clips, and on moving points, discs, lines and grids with noise, a
frame that lies half as far from its scene the other way round, or less, is closer by 0.01 at most.  On two planets and
a landscape of the Moon that turn midway, frames lie a quarter as far and are closer by 0.05 or more.
"""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray, luminance
from ...io.pixels import PixelArray, unrepaired
from ...io.source import FrameSource, Window

# Side of the thumbnails, pixels, chosen.
_SIDE = 32
# Similarity, 0 to 1, below which two frames show different scenes.  See above.
ALIKE = 0.5
# The picture has turned since the frame before where the other way round is closer by as much and at most so many times
# as far; smoothing of the thumbnails that tell it, chosen, and parts of a pixel by which they are shifted.  See above.
_CLOSER, _TIMES_AS_FAR, _SMOOTHING, _PARTS = 0.03, 0.5, 1.0, 4
# Rate at which the reference of a scene follows slow changes such as drift and daylight, chosen.
_UPDATE_RATE = 0.1
# Number of scenes that are remembered, so that one that returns is recognised, chosen.
MOST_SCENES = 16


@dataclass(frozen=True)
class Scene:
    """Frames that show the same scene.

    Attributes
    ----------
    first, last : int
        Numbers, in the file, of the first and the last frame; frames of other scenes may lie between.
    count : int
        Number of frames.
    """

    first: int
    last: int
    count: int


class SceneDetector:
    """Assigns frames to scenes; a scene that returns is recognised."""

    def __init__(self) -> None:
        self._labels, self._turned = array("i"), array("b")
        self._alike = array("f")
        self._references: list[FloatArray] = []
        self._ways = list[bool]()  # whether the latest frame of each scene is turned
        self._current = -1

    def update(self, thumb: FloatArray) -> None:
        """Assign the next frame, given as its :func:`thumbnail`, to a scene."""
        detail = thumb - cv2.GaussianBlur(thumb, (0, 0), _SIDE / 6)
        others = [label for label in range(len(self._references)) if label != self._current]
        candidates = [self._current, *others] if self._current >= 0 else []
        best = -1.0
        for label in candidates:
            alike, shift, turned = _similarity_either_way(detail, self._references[label], self._ways[label])
            best = max(best, alike)
            if alike >= ALIKE:
                self._current, self._ways[label] = label, turned
                # The reference follows the frame, so that jumps of the camera do not smear it.
                moved = np.roll(self._references[label], shift, axis=(0, 1))
                self._references[label] = moved + _UPDATE_RATE * (_either_way(detail, turned) - moved)
                break
        else:
            if len(self._references) < MOST_SCENES:
                self._references.append(detail.copy())
                self._ways.append(False)
            self._current = len(self._references) - 1
        self._labels.append(self._current)
        self._turned.append(self._ways[self._current])
        self._alike.append(best if candidates else 1.0)

    def skip(self) -> None:
        """Count a blank frame, which belongs to no scene."""
        self._labels.append(-1)
        self._turned.append(False)

    def labels(self) -> NDArray[np.int32]:
        """Scene of every frame, -1 for blank ones; a single scene where all frames differ."""
        labels = np.array(self._labels, np.int32)
        return np.zeros_like(labels) if self._all_differ() else labels

    def turned(self) -> NDArray[np.bool_]:
        """Tell which frames are turned by 180° against most frames of their scene."""
        turned = np.array(self._turned, bool)
        if self._all_differ():
            return np.zeros_like(turned)
        labels = self.labels()
        for label in range(len(self._references)):
            members = labels == label
            turned[members] ^= bool(np.mean(turned[members]) > 0.5)
        return turned

    def _all_differ(self) -> bool:
        full = len(self._references) >= MOST_SCENES
        typical = float(np.median(np.array(self._alike))) if len(self._alike) else 1.0
        return full or typical < (1 + ALIKE) / 2 - 0.1


def group_scenes(numbers: NDArray[np.int64], labels: NDArray[np.int32]) -> tuple[tuple[Scene, ...], NDArray[np.bool_]]:
    """Group frames into scenes, in the order of their first frames, and mark the frames of the longest one.

    ``labels`` are from :meth:`SceneDetector.labels`. If no frame belongs to a scene, all frames are one scene.
    """
    scenes: dict[int, Scene] = {}
    for label in dict.fromkeys(labels.tolist()):
        members = numbers[labels == label]
        scenes[label] = Scene(int(members[0]), int(members[-1]), len(members))
    scenes.pop(-1, None)
    if not scenes:
        return (Scene(int(numbers[0]), int(numbers[-1]), len(numbers)),), np.ones(len(numbers), bool)
    longest = max(scenes, key=lambda label: scenes[label].count)
    return tuple(scenes.values()), labels == longest


def turned_back(source: FrameSource, turned: frozenset[int]) -> FrameSource:
    """Turn frames by 180° about the centre of the selected rows and columns, after they are repaired and developed."""
    rows, columns = (slice(0, length) for length in source.file_shape[1:3])
    whole = dataclasses.replace(source, window=(rows, columns))

    def pixels(chosen: Sequence[int]) -> Iterator[PixelArray]:
        for number, frame in zip(chosen, dataclasses.replace(whole, numbers=tuple(chosen)).native(), strict=True):
            yield _turn(frame, source.window) if number in turned else frame

    return dataclasses.replace(source, pixels=pixels, repair=source.repair and unrepaired, bayer=None)


def _turn(frame: PixelArray, window: Window) -> PixelArray:
    turned = frame.copy()
    turned[window] = frame[window][::-1, ::-1]
    return turned


def thumbnail(values: FloatArray) -> FloatArray:
    """Luminance without its mean, reduced to at most 32×32 pixels, of a frame of shape (H, W) or (H, W, 3)."""
    size = min(_SIDE, values.shape[1]), min(_SIDE, values.shape[0])
    thumb = luminance(cv2.resize(values, size, interpolation=cv2.INTER_AREA))
    return thumb - thumb.mean()


def _similarity_either_way(
    detail: FloatArray, reference: FloatArray, turned: bool
) -> tuple[float, tuple[int, int], bool]:
    """Similarity and shift as :func:`similarity_at`, the way the frame before was turned or the other, and which."""
    same, other = (similarity_at(_either_way(detail, way), reference) for way in (turned, not turned))
    if other[0] > same[0]:
        near, far = (_finer_similarity(_either_way(detail, way), reference) for way in (not turned, turned))
        if near - far >= _CLOSER and 1 - near <= _TIMES_AS_FAR * (1 - far):
            return *other, not turned
    return *same, turned


def _finer_similarity(a: FloatArray, b: FloatArray) -> float:
    """Similarity as :func:`similarity_at`, of smoothed thumbnails under shifts by parts of a pixel."""
    a, b = (cv2.GaussianBlur(thumb, (0, 0), _SMOOTHING) for thumb in (a, b))
    height, width = a.shape
    products = np.zeros((_PARTS * height, _PARTS * width // 2 + 1), np.complex128)
    rows = np.fft.fftfreq(height, 1 / height).astype(int)
    products[rows, : width // 2 + 1] = np.fft.rfft2(a) * np.conj(np.fft.rfft2(b))
    peak = _PARTS**2 * float(np.fft.irfft2(products, (_PARTS * height, _PARTS * width)).max())
    scale = float(np.linalg.norm(a)) * float(np.linalg.norm(b))
    return peak / scale if scale else 0.0


def _either_way(detail: FloatArray, turned: bool) -> FloatArray:
    return detail[::-1, ::-1] if turned else detail


def similarity_at(a: FloatArray, b: FloatArray) -> tuple[float, tuple[int, int]]:
    """Normalised cross-correlation at the best circular shift of b, 0 where a thumbnail has no detail; that shift."""
    scale = float(np.linalg.norm(a)) * float(np.linalg.norm(b))
    if scale == 0:
        return 0.0, (0, 0)
    products = np.fft.irfft2(np.fft.rfft2(a) * np.conj(np.fft.rfft2(b)), a.shape)
    row, column = np.unravel_index(int(np.argmax(products)), products.shape)
    return float(products[row, column]) / scale, (int(row), int(column))
