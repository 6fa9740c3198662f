"""Cuts: which frames of a video show the same scene.

Frames are compared as 32×32 thumbnails without their slow shading, by the normalised cross-correlation at its best
circular shift.  On stored clips (eight simulated, twelve real, drift and shake among them) frames of one scene reach
0.69 or more; half of all pairs of different scenes stay below 0.23.  Scenes that look alike at this size, such as two
pages of text, pass for one.  Where frames are unlike throughout, as under heavy noise, no cut is claimed.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance

_SIDE = 32
# A scene follows slow changes, such as drift and daylight, at this rate.
_FORGETTING = 0.1
# Scenes that are remembered, to know one that comes back.
_MOST_SCENES = 16


@dataclass(frozen=True)
class Scene:
    """Frames that show the same.

    Attributes
    ----------
    first, last : int
        Numbers, in the file, of its first and its last frame; frames of other scenes may lie between.
    count : int
        How many frames it has.
    """

    first: int
    last: int
    count: int


class SceneWatch:
    """Which frames show the same; a scene that comes back is known again."""

    def __init__(self, similarity: float) -> None:
        self._similarity = similarity
        self._labels = array("i")
        self._alike = array("f")
        self._references: list[FloatArray] = []
        self._current = -1

    def look(self, thumb: FloatArray) -> None:
        """Assign the next frame to a scene.

        Parameters
        ----------
        thumb : (32, 32) or smaller float32 array
            Its :func:`thumbnail`.
        """
        detail = thumb - cv2.GaussianBlur(thumb, (0, 0), _SIDE / 6)
        others = [label for label in range(len(self._references)) if label != self._current]
        candidates = [self._current, *others] if self._current >= 0 else []
        best = -1.0
        for label in candidates:
            alike = _similarity(detail, self._references[label])
            best = max(best, alike)
            if alike >= self._similarity:
                self._current = label
                self._references[label] += _FORGETTING * (detail - self._references[label])
                break
        else:
            if len(self._references) < _MOST_SCENES:
                self._references.append(detail.copy())
            self._current = len(self._references) - 1
        self._labels.append(self._current)
        self._alike.append(best if candidates else 1.0)

    def skip(self) -> None:
        """Count a blank frame, which is of no scene."""
        self._labels.append(-1)

    def labels(self) -> NDArray[np.int32]:
        """Scene of every frame; one for all where frames are unlike throughout."""
        labels = np.array(self._labels, np.int32)
        full = len(self._references) >= _MOST_SCENES
        unlike = len(self._alike) > 0 and float(np.median(np.array(self._alike))) < (1 + self._similarity) / 2 - 0.1
        return np.zeros_like(labels) if full or unlike else labels


def divide(numbers: NDArray[np.int64], labels: NDArray[np.int32]) -> tuple[tuple[Scene, ...], NDArray[np.bool_]]:
    """Scenes by the labels of frames, and which frames belong to the longest.

    Parameters
    ----------
    numbers : (N,) int64 array
        Numbers of the frames in their file.
    labels : (N,) int32 array
        Scene of each, as :meth:`SceneWatch.labels` gives it; below 0 for frames of no scene.

    Returns
    -------
    scenes : tuple of Scene
        In order of appearance; without any, all frames make one.
    kept : (N,) bool array
        Frames of the longest scene.

    Examples
    --------
    >>> scenes, kept = divide(np.arange(4), np.array([0, 0, 0, 1], np.int32))
    >>> scenes[0], kept.tolist()
    (Scene(first=0, last=2, count=3), [True, True, True, False])
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


def thumbnail(values: FloatArray) -> FloatArray:
    """Reduce a frame to what scenes are compared by.

    Parameters
    ----------
    values : (H, W) or (H, W, 3) float32 array

    Returns
    -------
    (32, 32) float32 array
        Luminance without its mean; smaller where the frame is.

    Examples
    --------
    >>> thumbnail(np.ones((64, 48), np.float32)).shape
    (32, 32)
    """
    size = min(_SIDE, values.shape[1]), min(_SIDE, values.shape[0])
    thumb = luminance(cv2.resize(values, size, interpolation=cv2.INTER_AREA))
    return thumb - thumb.mean()


def _similarity(a: FloatArray, b: FloatArray) -> float:
    """Normalised cross-correlation at the best circular shift; 0 where one has no detail."""
    scale = float(np.linalg.norm(a)) * float(np.linalg.norm(b))
    if scale == 0:
        return 0.0
    peak = np.fft.irfft2(np.fft.rfft2(a) * np.conj(np.fft.rfft2(b)), a.shape).max()
    return float(peak) / scale
