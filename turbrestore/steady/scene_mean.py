"""Mean of the frames before and after a frame, along the path of the camera: turbulence averages out of it.

Symbols
-------
k : the frame; j a frame of the same scene, at most ``LONGEST`` frames before or after it
B : running mean of the frames of the scene so far, at the position of one of them
G_j : position of frame j, the affine map from the first frame of the scene to it, homogeneous, pixels about the centre
C_c, n_c : sum of the frames of a run of successive frames at the position G_c of the first of them, and how many of
    them show a pixel
M : mean at the position of frame k, ``Σ C_c ∘ (G_c G_k⁻¹) / Σ n_c ∘ (G_c G_k⁻¹)``

G_j is the affine part of the flow from B to frame j.  B averages turbulence and objects that move, and errors do not
add up from frame to frame.  Luminance on the grid of the frames is enough, since only flow is measured from it.

The frames are read once more for this, ahead of those that are steadied.  Memory holds the runs around a frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, luminance
from ..registration.camera.global_shift import ShiftReference, prepare_shift_reference
from ..registration.warp import inside
from .camera_path.camera import Matrix, camera_flow, fit_camera
from .camera_path.path import LONGEST, homogeneous, motion
from .dewarping import first_guess, measure_flow
from .grid import follow, grid_of, pixel_of, reduced
from .windows import iter_scenes

# Frames of a run, and frames that the running mean remembers.
_RUN, _REMEMBERED = 12, LONGEST
# Share of the shorter side by which the camera moves before the running mean follows it.
_FOLLOWED = 1 / 16


@dataclass(frozen=True, eq=False)
class SceneMean:
    """Mean of the frames around a frame."""

    position: Matrix  # (3, 3): G_k
    path: Mapping[int, Matrix]  # (2, 3): motion of the camera to the frames around it, by their distance in frames
    image: FloatArray  # (h, w): M, luminance on the grid, at the position of the frame
    share: FloatArray  # (h, w): how far it is known, 0 where no frame around shows it and 1 where a run of them does


def iter_scene_means(frames: Iterable[ArrayLike]) -> Iterator[SceneMean]:
    """Yield the mean around every frame, in order, ``LONGEST`` frames and a run behind the input.

    ``frames`` (H, W) or (H, W, 3) each.
    """
    for _, scene in groupby(iter_scenes(frames), lambda numbered: numbered[1]):
        yield from _means_of_scene(image for image, _ in scene)


def _means_of_scene(images: Iterable[FloatArray]) -> Iterator[SceneMean]:
    positions: dict[int, Matrix] = {}
    runs: deque[_Run] = deque()
    camera, due, shape = _Camera(), 0, (0, 0)
    for number, image in enumerate(images):
        shape = image.shape[:2]
        grey = luminance(reduced(image))
        positions[number] = camera.follow(image, grey)
        if number % _RUN == 0:
            runs.append(_Run(number, positions[number], np.zeros_like(grey), np.zeros_like(grey)))
        runs[-1].add(grey, positions[number], shape)
        if (number + 1) % _RUN:
            continue
        while due + LONGEST <= number:
            yield _mean_around(due, positions, runs, shape)
            positions.pop(due - LONGEST, None)
            due += 1
            if runs[0].start + _RUN <= due - LONGEST:
                runs.popleft()
    for last in range(due, max(positions, default=-1) + 1):
        yield _mean_around(last, positions, runs, shape)


@dataclass(frozen=True, eq=False)
class _Run:
    """Sum of successive frames at the position of the first of them."""

    start: int  # number of its first frame
    position: Matrix  # (3, 3): G_c
    total: FloatArray  # (h, w): C_c
    count: FloatArray  # (h, w): n_c

    def add(self, grey: FloatArray, position: Matrix, shape: tuple[int, ...]) -> None:
        """Add a frame on its grid."""
        placed, seen = _moved(grey, position @ np.linalg.inv(self.position), shape)
        self.total[...] += seen * placed
        self.count[...] += seen


class _Camera:
    """Follows the camera through a scene by what frames lie away from their running mean."""

    def __init__(self) -> None:
        self._mean = self._count = np.zeros((0, 0), np.float32)
        # G of the mean, the map from the mean to the last frame, and that frame.
        self._start = self._pose = np.eye(3)
        self._last: ShiftReference | None = None

    def follow(self, image: FloatArray, grey: FloatArray) -> Matrix:
        """Return the position of the next frame, whose luminance on the grid is given as well."""
        shape, prepared = image.shape[:2], prepare_shift_reference(image)
        if self._last is None:
            self._mean, self._count = grey.copy(), np.ones_like(grey)
        else:
            start = motion(homogeneous(first_guess(self._last, prepared, image)) @ self._pose)
            flow = measure_flow(self._mean, grey, camera_flow(start, shape, grey.shape), shape)
            self._pose = homogeneous(fit_camera(flow, shape))
            placed, seen = _moved(grey, self._pose, shape)
            self._count = np.minimum(self._count + seen, _REMEMBERED)
            self._mean += seen * (placed - self._mean) / self._count
        self._last = prepared
        position = self._pose @ self._start
        if np.abs(motion(self._pose) @ [shape[1] / 2, shape[0] / 2, 1.0]).max() > _FOLLOWED * min(shape):
            self._move_to(grey, shape)
        return position

    def _move_to(self, grey: FloatArray, shape: tuple[int, ...]) -> None:
        """Bring the mean to the position of the last frame, which fills what comes into sight."""
        back = np.asarray(np.linalg.inv(self._pose), np.float64)
        placed, seen = _moved(self._mean, back, shape)
        count = _moved(self._count, back, shape)[0]
        self._mean, self._count = grey + seen * (placed - grey), 1 + seen * (count - 1)
        self._start, self._pose = self._pose @ self._start, np.eye(3)


def _mean_around(
    number: int, positions: Mapping[int, Matrix], runs: Iterable[_Run], shape: tuple[int, ...]
) -> SceneMean:
    back = np.asarray(np.linalg.inv(positions[number]), np.float64)
    sums = []
    for run in runs:
        total, seen = _moved(run.total, run.position @ back, shape)
        count, _ = _moved(run.count, run.position @ back, shape)
        sums.append(seen * np.stack([total, count]))
    total, count = np.add.reduce(sums)
    path = {
        other - number: motion(position @ back)
        for other, position in positions.items()
        if 0 < abs(other - number) <= LONGEST
    }
    share = np.minimum(count / _RUN, 1)
    return SceneMean(positions[number], path, np.asarray(total / np.maximum(count, 1), np.float32), share)


def _moved(field: FloatArray, pose: Matrix, shape: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """Field on the grid where a map leads, and where it lies inside."""
    flow = camera_flow(motion(pose), shape, grid_of(shape))
    return follow(field, flow, shape), inside(flow / np.float32(pixel_of(shape)))
