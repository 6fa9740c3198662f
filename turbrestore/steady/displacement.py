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
all are large the frame stays as it is.  Without a neighbour on the other side motion does not cancel, so such an S_i
counts less where something moves.  The ½ is the share of the frame itself, whose flow to itself is zero.

Curved motion and turbulence cannot be told apart in a few frames.  While the camera is static, so is most of a scene,
and c follows the median of |S_i| between 1 and 8 pixels; while it shakes, c is 1 pixel.  Strong turbulence moves whole
frames too, which is no shake: |S_1| tells how far, since flows to the nearest frames do not fail while a camera shakes.

What moves
----------
G_i : F_i − A_i, the flow without the motion of the camera
v : velocity, pixels a frame: ``Σ i G_i / Σ i²``, the least squares fit
I, I_i : the frame; a neighbour, brought onto it by the motion of the camera alone

A point moves where its path is longer than turbulence displaces, ``|v| i > 2 c`` for the furthest neighbour, and where
two neighbours, one on either side if there are, both differ from I: in flat regions a flow is arbitrary, but the images
are alike.  A point moves as well where the registered neighbours show something else than the frame
(:mod:`turbrestore.steady.fusion`), as beside an object that covers the background.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from .camera_path.camera import Matrix, camera_flow, camera_size

# Window in which |S|² is averaged, pixels; share of the frame itself; both chosen.
_WINDOW, _OWN_SHARE = 4.0, 0.5
# c over the median of |S_i| while the camera is static; smallest and largest c, pixels; all chosen: with a
# largest c of 4, strong air was not taken out.
_SIZES, _LEAST, _MOST = 2.5, 1.0, 8.0
# Distance of the camera from motion at constant velocity, pixels, at which it counts as half shaking; what turbulence
# moves whole frames by comes on top.  With half or twice as much, strong air is not told from a shake in test_path.py.
_SHAKE = 2.0
# Path, in units of c, at which an S_i of one neighbour counts half, chosen.
_PATH = 1.5
# Agreement of the neighbours below which a point moves; longest path of turbulence, in units of c; both chosen.
_AGREEMENT, _LONGEST_PATH = 0.5, 2.0
# Window of the differences of images, pixels, and the smallest that counts, intensity; both chosen.
_IMAGE_WINDOW, _DIFFERENCE = 2.0, 0.04
# Every so many pixels of the grid enter the median, for its cost.
_SAMPLE = 3
# Mean of |S_i| over |S_1| at which turbulence is half likely: most air has 1.3 to 2.5, a camera that advances 4 to 6.
_GROWTH = 4.0
# What turbulence moves whole frames by, in medians of |S_i|, chosen.
_WHOLE = 1.4


def mean_displacement(flows: Mapping[int, FloatArray], largest: float, path: FloatArray, pixel: float) -> FloatArray:
    """Weighted mean D of flows without the motion of the camera.

    ``flows`` (h, w, 2) on a grid whose pixel is so many of the image wide; ``path`` (h, w) of :func:`path_length`;
    returns (h, w, 2).
    """
    static = 1 / (1 + (path / (_PATH * largest)) ** 4)
    total = np.zeros((*path.shape, 2), np.float32)
    weights = np.full((*path.shape, 1), _OWN_SHARE, np.float32)
    for offset in sorted({abs(offset) for offset in flows}):
        mean = _symmetric(flows, offset)
        weight = turbulent_weight(mean, largest, pixel)[..., None]
        if offset not in flows or -offset not in flows:
            weight *= static[..., None]
        total += weight * mean
        weights += weight
    return np.asarray(total / weights, np.float32)


def turbulent_weight(flow: FloatArray, largest: float, pixel: float) -> FloatArray:
    """Weight (h, w) of a flow (h, w, 2), less where it is longer than turbulence displaces."""
    square = cv2.GaussianBlur(np.einsum("yxc,yxc->yx", flow, flow), (0, 0), _WINDOW / pixel)
    return np.asarray(1 / (1 + (square / largest**2) ** 2), np.float32)


def displacement_sizes(flows: Mapping[int, FloatArray]) -> list[float]:
    """Medians of |S_i| over the image, from the nearest neighbours to the furthest.

    ``flows`` (H, W, 2).
    """
    distances = sorted({abs(offset) for offset in flows})
    means = (_symmetric(flows, distance)[::_SAMPLE, ::_SAMPLE] for distance in distances)
    return [float(np.median(np.hypot(mean[..., 0], mean[..., 1]))) for mean in means]


def likely_turbulence(sizes: Sequence[float]) -> float:
    """Tell whether |S_i|, from the nearest neighbours to the furthest, may be those of turbulence, 0 to 1.

    A correlation time of 9 frames gives a mean of 2.2 |S_1|.  What lies at different distances from a camera that moves
    gives more, as its motion goes on growing with i.
    """
    return float(1 / (1 + (np.mean(sizes) / (_GROWTH * sizes[0] + np.finfo(float).eps)) ** 8))


def largest_displacement(size: float, steadiness: float) -> float:
    """Tell what turbulence displaces at most."""
    return _LEAST + (float(np.clip(_SIZES * size, _LEAST, _MOST)) - _LEAST) * steadiness


def whole_displacement(size: float, largest: float = np.inf) -> float:
    """Tell by what turbulence moves whole frames."""
    return _WHOLE * min(size, largest / _SIZES)


def expected_motion(cameras: Mapping[int, Matrix], offset: int) -> Matrix:
    """Motion of the camera to a neighbour if it goes on as to the others.

    ``cameras`` (2, 3); returns (2, 3).
    """
    line = _straight_path(cameras)[2]
    return (line[0] + offset * line[1]).reshape(2, 3)


def camera_steadiness(cameras: Mapping[int, Matrix], shape: tuple[int, ...], whole: float) -> float:
    """Tell whether the camera moves at constant velocity within the window, apart from what turbulence makes of it.

    ``cameras`` (2, 3); turbulence moves whole frames by ``whole`` pixels.
    """
    if not cameras:
        return 1.0
    offsets, path, line = _straight_path(cameras)
    left = path - np.stack([np.ones(len(offsets)), offsets], 1) @ line
    square = np.mean([camera_size(one, shape) ** 2 for one in left.reshape(-1, 2, 3)])
    return float(1 / (1 + (square / (_SHAKE**2 + whole**2)) ** 4))


def without_camera(
    flows: Mapping[int, FloatArray], cameras: Mapping[int, Matrix], shape: tuple[int, ...]
) -> dict[int, FloatArray]:
    """Flows less the motion of the camera.

    ``flows`` (h, w, 2) on a grid over an image of this shape; ``cameras`` (2, 3).
    """
    return {offset: flow - camera_flow(cameras[offset], shape, flow.shape) for offset, flow in flows.items()}


def moving_mask(
    path: FloatArray, image: FloatArray, placed: Sequence[FloatArray], agreement: FloatArray, pixel: float
) -> NDArray[np.bool_]:
    """Mark the points that move, on a grid whose pixel is so many of the image wide.

    ``path`` (h, w), in units of what turbulence displaces at most; ``image`` (h, w); ``placed`` (h, w) each;
    ``agreement`` (h, w); returns (h, w).
    """
    moving = agreement < _AGREEMENT
    if not placed:
        return moving
    squares = [cv2.GaussianBlur((other - image) ** 2, (0, 0), _IMAGE_WINDOW / pixel) for other in placed]
    return moving | ((path > _LONGEST_PATH) & np.logical_and.reduce([square > _DIFFERENCE**2 for square in squares]))


def path_length(flows: Mapping[int, FloatArray]) -> FloatArray:
    """Length of the path to the furthest neighbour at constant velocity.

    ``flows`` (h, w, 2), at least one; returns (h, w).
    """
    pairs = {offset: flow for offset, flow in flows.items() if -offset in flows}
    if 3 * max(pairs, default=0) >= max(map(abs, flows)):
        # The displacement of the frame itself cancels in pairs.
        flows = pairs
    moments = [np.float32(offset) * flow for offset, flow in flows.items()]
    velocity = np.add.reduce(moments)
    furthest, squares = max(map(abs, flows)), sum(offset**2 for offset in flows)
    return np.hypot(velocity[..., 0], velocity[..., 1]) * np.float32(furthest / squares)


def witnesses(offsets: Iterable[int]) -> tuple[int, ...]:
    """Choose the neighbours that show whether something moved: the furthest, and one like it on the other side.

    Where the other side is shorter than half, it is one half as far on the same side.
    """
    offsets = sorted(offsets, key=abs)
    if len(offsets) < 2:
        return ()
    furthest = offsets[-1]
    others = sorted(offsets[:-1], key=lambda offset: abs(offset + furthest))
    if 2 * abs(others[0] + furthest) > abs(furthest):
        others = sorted(offsets[:-1], key=lambda offset: abs(2 * offset - furthest))
    return furthest, others[0]


def _straight_path(cameras: Mapping[int, Matrix]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames of the window, the path of the camera, and the line that fits it best."""
    offsets = np.array([0, *cameras])
    path = np.stack([np.zeros((2, 3)), *cameras.values()]).reshape(-1, 6)
    return offsets, path, np.linalg.lstsq(np.stack([np.ones(len(offsets)), offsets], 1), path, rcond=None)[0]


def _symmetric(values: Mapping[int, np.ndarray], offset: int) -> np.ndarray:
    if offset in values and -offset in values:
        return (values[offset] + values[-offset]) / 2
    return values[offset] if offset in values else values[-offset]
