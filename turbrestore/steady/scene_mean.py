"""Mean of the frames before and after a frame, along the path of the camera: turbulence averages out of it.

Symbols
-------
k : the frame; j a frame of the same scene, about ``LONGEST`` frames before or after it, by whole runs
B : running mean of the frames of the scene so far, at the position of one of them
G_j : position of frame j, the affine map from the first frame of the scene to it, homogeneous, pixels about the centre
C_c, n_c : sum of the frames of a run of successive frames at the position G_c of the first of them, and how many of
    them show a pixel
M : mean at the position of frame k, ``Σ C_c ∘ (G_c G_k⁻¹) / Σ n_c ∘ (G_c G_k⁻¹)``

G_j is the affine part of the flow from B to frame j, where B has texture: flow is arbitrary elsewhere.  B averages
turbulence and objects that move, and errors do not add up from frame to frame.  Luminance on the grid of the frames is
enough, since only flow is measured from it.

The frames are read once more for this, ahead of those that are steadied.  Memory holds the runs around a frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass
from itertools import groupby

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, luminance
from ..core.gradient import sobel_gradient
from ..registration.camera.global_shift import ShiftReference, prepare_shift_reference
from .camera_path.camera import Matrix, camera_flow, corner_motion, fit_camera
from .camera_path.path import LONGEST, homogeneous, motion
from .dewarping import first_guess, measure_flow
from .grid import grid_of, reduced
from .windows import iter_scenes

# Frames of a run, chosen.
_RUN = 12
# Window in which the square of the gradient is averaged, pixels of the grid, chosen, and gradient, intensity a pixel,
# at which a place counts half: half or twice as much does as well, four times leaves out too much.
_TEXTURE_WINDOW, _FLAT = 3.0, 0.004


@dataclass(frozen=True, eq=False)
class SceneMean:
    """Mean of the frames around a frame."""

    position: Matrix  # (3, 3): G_k
    path: Mapping[int, Matrix]  # (2, 3): motion of the camera to the frames around it, by their distance in frames
    runs: tuple[_Run, ...]
    shape: tuple[int, ...]  # of the frame

    def seen_from(self, pose: Matrix) -> tuple[FloatArray, FloatArray]:
        """Return luminance (h, w) as seen from another place, and how far it is known, 0 to 1.

        ``pose`` (3, 3) maps that place to the frame.  As many frames as a run has make a pixel known.
        """
        back = np.linalg.inv(self.position) @ pose
        total, count = cv2.split(
            np.add.reduce([_moved(one.sums, one.position @ back, self.shape) for one in self.runs])
        )
        return total / np.maximum(count, 1), np.minimum(count / _RUN, 1)


def iter_scene_means(frames: Iterable[ArrayLike]) -> Iterator[SceneMean]:
    """Yield the mean around every frame, in order, ``LONGEST`` frames and a run behind the input.

    ``frames`` (H, W) or (H, W, 3) each.
    """
    for _, scene in groupby(iter_scenes(frames), lambda numbered: numbered[1]):
        yield from _means_of_scene((image, blank) for image, _, blank in scene)


def _means_of_scene(images: Iterable[tuple[FloatArray, bool]]) -> Iterator[SceneMean]:
    positions: dict[int, Matrix] = {}
    blanks: set[int] = set()
    runs: deque[_Run] = deque()
    camera, due, shape = _Camera(), 0, (0, 0)
    for number, (image, blank) in enumerate(images):
        shape = image.shape[:2]
        seen = cv2.merge([luminance(reduced(image)), np.ones(grid_of(shape), np.float32)])
        # A blank frame, which never is the first of a scene, tells no place and adds nothing.
        if blank:
            positions[number] = positions[number - 1]
            blanks.add(number)
            seen *= 0
        else:
            positions[number] = camera.follow(image, seen)
        if number % _RUN == 0:
            runs.append(_Run(number, positions[number], np.zeros_like(seen)))
        runs[-1].add(seen, positions[number], shape)
        while (number + 1) % _RUN == 0 and due + LONGEST <= number:
            yield _mean_around(due, positions, blanks, runs, shape)
            due += 1
    for last in range(due, max(positions, default=-1) + 1):
        yield _mean_around(last, positions, blanks, runs, shape)


@dataclass(frozen=True, eq=False)
class _Run:
    """Sum of successive frames at the position of the first of them."""

    start: int  # number of its first frame
    position: Matrix  # (3, 3): G_c
    sums: FloatArray  # (h, w, 2): C_c and n_c

    def add(self, seen: FloatArray, position: Matrix, shape: tuple[int, ...]) -> None:
        """Add a frame and a count of one (h, w, 2) on its grid."""
        self.sums[...] += _moved(seen, position @ np.linalg.inv(self.position), shape)


class _Camera:
    """Follows the camera through a scene by how far frames lie away from their running mean."""

    def __init__(self) -> None:
        # Sum and count of the frames (h, w, 2).
        self._sums = np.zeros((0, 0, 2), np.float32)
        # G of the sum, the map from the sum to the last frame, and that frame.
        self._start = self._pose = np.eye(3)
        self._last: ShiftReference | None = None

    def follow(self, image: FloatArray, seen: FloatArray) -> Matrix:
        """Return the position of the next frame, whose luminance and a count of one (h, w, 2) are given as well."""
        shape, prepared = image.shape[:2], prepare_shift_reference(image)
        if self._last is None:
            self._sums = seen.copy()
        else:
            expected = homogeneous(first_guess(self._last, prepared, image)) @ self._pose
            mean = self._sums[..., 0] / self._sums[..., 1]
            flow = measure_flow(mean, seen[..., 0], camera_flow(motion(expected), shape, mean.shape), shape)
            self._pose = homogeneous(fit_camera(flow, shape, _texture(mean)))
            self._sums += _moved(seen, self._pose, shape)
            self._sums *= np.minimum(LONGEST / self._sums[..., 1:], 1)
        self._last = prepared
        position = self._pose @ self._start
        # Before a tenth of the frame is out of sight.
        if corner_motion(motion(self._pose), shape) > min(shape) / _RUN:
            self._move_to(seen, shape)
        return position

    def _move_to(self, seen: FloatArray, shape: tuple[int, ...]) -> None:
        """Bring the sum to the position of the last frame, which fills what comes into sight."""
        moved = _moved(self._sums, np.asarray(np.linalg.inv(self._pose), np.float64), shape)
        self._sums = np.where(moved[..., 1:] < 1, seen, moved)
        self._start, self._pose = self._pose @ self._start, np.eye(3)


def _mean_around(
    number: int, positions: dict[int, Matrix], blanks: Set[int], runs: deque[_Run], shape: tuple[int, ...]
) -> SceneMean:
    """Mean around the next frame; what lies too far back is dropped."""
    positions.pop(number - LONGEST - 1, None)
    while runs[0].start + _RUN <= number - LONGEST:
        runs.popleft()
    back = np.linalg.inv(positions[number])
    path = {
        other - number: motion(position @ back)
        for other, position in positions.items()
        if 0 < abs(other - number) <= LONGEST and other not in blanks
    }
    return SceneMean(positions[number], path, tuple(runs), shape)


def _texture(grey: FloatArray) -> FloatArray:
    """Weight (h, w) of the flow of an image, which is arbitrary where the image is flat."""
    along_x, along_y = sobel_gradient(grey)
    square = cv2.GaussianBlur(along_x**2 + along_y**2, (0, 0), _TEXTURE_WINDOW) + np.finfo(np.float32).eps
    return np.asarray(square / (square + _FLAT**2), np.float32)


def _moved(sums: FloatArray, pose: Matrix, shape: tuple[int, ...]) -> FloatArray:
    """Sum and count (h, w, 2) on the grid where a map leads, zero outside."""
    grid = sums.shape[:2]
    to = camera_flow(motion(pose), shape, grid) * np.array([grid[1] / shape[1], grid[0] / shape[0]], np.float32)
    x = np.arange(grid[1], dtype=np.float32) + to[..., 0]
    y = np.arange(grid[0], dtype=np.float32)[:, None] + to[..., 1]
    # OpenCV rounds positions in an image of two channels to 1/32 pixel.
    planes = cv2.split(sums)
    return cv2.merge([cv2.remap(one, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT) for one in planes])
