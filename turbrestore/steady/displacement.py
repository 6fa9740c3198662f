"""Turbulent displacement of a frame from its flows to its neighbours.

Symbols
-------
k : the frame; k ± i its neighbours
d : turbulent displacement of a frame, pixels
F_i : flow from frame k to frame k + i; A_i its affine part, the camera
S_i : mean of F_i − A_i and F_{−i} − A_{−i}; at the ends of a scene, where one of them is missing, the other
c : what turbulence displaces at most, pixels
w_i : weight of S_i

A point of frame k that turbulence has displaced by d_k appears in frame k + i where the motion of scene and camera and
d_{k+i} put it.  Motion at constant velocity cancels in S_i, so that ``S_i = −d_k + (d_{k+i} + d_{k−i}) / 2 + a i² / 2``
with a the acceleration of the point.  Over several i the displacements of the neighbours average out::

    D = Σ w_i S_i / (½ + Σ w_i) ≈ −d_k,      w_i = 1 / (1 + (|S_i|² / c²)²)

with |S_i|² averaged in a small window.  A large S_i is motion rather than turbulence: it has little weight, and where
all are large the frame passes as it is.  The ½ is the share of the frame itself, whose flow to itself is zero.

Curved motion and turbulence cannot be told apart in a few frames.  While the camera stands still, most of a scene does,
and c follows the median of |S_i| between 1 and 4 pixels; while it moves, c is 1 pixel.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from ..core.arrays import FloatArray
from .camera import Matrix, camera_flow, camera_size

# Window in which |S|² is averaged, pixels; share of the frame itself.
_WINDOW, _OWN_SHARE = 4.0, 0.5
# c over the median of |S_i| while the camera stands still; smallest and largest c, pixels.
_SIZES, _LEAST, _MOST = 2.5, 1.0, 4.0
# Distance of the camera from motion at constant velocity, pixels, at which it counts as half shaking.
_SHAKE = 2.0
# Every so many pixels enter the median.
_SAMPLE = 4
# What turbulence moves whole frames by, in medians of |S_i|.
_WHOLE = 1.4


def mean_displacement(flows: Mapping[int, FloatArray], largest: float) -> FloatArray:
    """Weighted mean D of flows without the motion of the camera.

    Parameters
    ----------
    flows : mapping of int to ndarray, float32, shape (H, W, 2)
        F_i − A_i by i, pixels; not empty.
    largest : float
        c, pixels.

    Returns
    -------
    ndarray, float32, shape (H, W, 2)
        D, pixels.

    Examples
    --------
    >>> still, steady = np.zeros((8, 8, 2), np.float32), np.full((8, 8, 2), 5.0, np.float32)
    >>> float(mean_displacement({1: steady, -1: -steady}, 1.0).max())
    0.0
    >>> jolt = np.full((8, 8, 2), 0.2, np.float32)
    >>> round(float(mean_displacement({1: jolt, -1: jolt}, 1.0).max()), 2)
    0.13
    """
    total, weights = 0.0, _OWN_SHARE
    for offset in sorted({abs(offset) for offset in flows}):
        mean = _symmetric(flows, offset)
        size = cv2.GaussianBlur(np.einsum("yxc,yxc->yx", mean, mean), (0, 0), _WINDOW)
        weight = (1 / (1 + (size / largest**2) ** 2))[..., None]
        total, weights = total + weight * mean, weights + weight
    return np.asarray(total / weights, np.float32)


def displacement_size(flows: Mapping[int, FloatArray]) -> float:
    """Median of |S_i| over the image, mean over i.

    Parameters
    ----------
    flows : mapping of int to ndarray, float32, shape (H, W, 2)
        F_i − A_i by i, pixels; not empty.

    Returns
    -------
    float
        Pixels.

    Examples
    --------
    >>> jolt = np.full((8, 8, 2), (0.6, 0.8), np.float32)
    >>> round(displacement_size({-1: jolt, 1: jolt}), 3)
    1.0
    """
    means = [_symmetric(flows, distance)[::_SAMPLE, ::_SAMPLE] for distance in {abs(offset) for offset in flows}]
    return float(np.mean([np.median(np.hypot(mean[..., 0], mean[..., 1])) for mean in means]))


def largest_displacement(size: float, steadiness: float) -> float:
    """Tell what turbulence displaces at most.

    Parameters
    ----------
    size : float
        Median of |S_i|, pixels.
    steadiness : float
        Of the camera, 0 to 1.

    Returns
    -------
    float
        c, pixels.

    Examples
    --------
    >>> largest_displacement(1.0, 1.0), largest_displacement(1.0, 0.0)
    (2.5, 1.0)
    """
    return _LEAST + (float(np.clip(_SIZES * size, _LEAST, _MOST)) - _LEAST) * steadiness


def whole_displacement(size: float, largest: float) -> float:
    """Tell by what turbulence moves whole frames.

    Parameters
    ----------
    size : float
        Median of |S_i|, pixels.
    largest : float
        c, pixels.

    Returns
    -------
    float
        Pixels.

    Examples
    --------
    >>> whole_displacement(1.0, 2.5)
    1.4
    """
    return _WHOLE * min(size, largest / _SIZES)


def expected_motion(cameras: Mapping[int, Matrix], offset: int) -> Matrix:
    """Motion of the camera to a neighbour if it goes on as to the others.

    Parameters
    ----------
    cameras : mapping of int to ndarray, float64, shape (2, 3)
        M of A_i by i.
    offset : int
        The neighbour.

    Returns
    -------
    ndarray, float64, shape (2, 3)

    Examples
    --------
    >>> expected_motion({1: np.array([[0, 0, 2.0], [0, 0, 0]])}, 3)[0, 2].round(6)
    np.float64(6.0)
    """
    line = _straight_path(cameras)[2]
    return (line[0] + offset * line[1]).reshape(2, 3)


def camera_steadiness(cameras: Mapping[int, Matrix], shape: tuple[int, ...]) -> float:
    """Tell whether the camera moves at constant velocity within the window.

    Parameters
    ----------
    cameras : mapping of int to ndarray, float64, shape (2, 3)
        M of A_i by i; empty if the camera is known to stand still.
    shape : tuple of int
        (H, W) of the frames.

    Returns
    -------
    float
        1 for a camera that stands still or pans evenly, near 0 for one that shakes.

    Examples
    --------
    >>> pan, jolt = np.array([[0, 0, 7.0], [0, 0, 0]]), np.array([[0, 0, 9.0], [0, 0, 0]])
    >>> camera_steadiness({-1: -pan, 1: pan}, (8, 8))
    1.0
    >>> camera_steadiness({-1: jolt, 1: jolt}, (8, 8)) < 0.01
    True
    """
    if not cameras:
        return 1.0
    offsets, path, line = _straight_path(cameras)
    left = path - np.stack([np.ones(len(offsets)), offsets], 1) @ line
    size = np.sqrt(np.mean([camera_size(one, shape) ** 2 for one in left.reshape(-1, 2, 3)]))
    return float(1 / (1 + (size / _SHAKE) ** 8))


def without_camera(flows: Mapping[int, FloatArray], cameras: Mapping[int, Matrix]) -> dict[int, FloatArray]:
    """Flows less the motion of the camera.

    Parameters
    ----------
    flows : mapping of int to ndarray, float32, shape (H, W, 2)
    cameras : mapping of int to ndarray, float64, shape (2, 3)

    Returns
    -------
    dict of int to ndarray

    Examples
    --------
    >>> flow = np.ones((4, 4, 2), np.float32)
    >>> float(without_camera({1: flow}, {1: np.array([[0, 0, 1.0], [0, 0, 1.0]])})[1].max())
    0.0
    """
    return {offset: flow - camera_flow(cameras[offset], flow.shape) for offset, flow in flows.items()}


def _straight_path(cameras: Mapping[int, Matrix]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames of the window, the path of the camera, and the line that fits it best."""
    offsets = np.array([0, *cameras])
    path = np.stack([np.zeros((2, 3)), *cameras.values()]).reshape(-1, 6)
    return offsets, path, np.linalg.lstsq(np.stack([np.ones(len(offsets)), offsets], 1), path, rcond=None)[0]


def _symmetric(values: Mapping[int, np.ndarray], offset: int) -> np.ndarray:
    if offset in values and -offset in values:
        return (values[offset] + values[-offset]) / 2
    return values[offset] if offset in values else values[-offset]
