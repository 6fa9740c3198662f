"""Memory of what stands still: a recursive estimate of the scene, as long as it agrees with the frames.

Symbols
-------
F : frame k, dewarped and fused within its window
Z : memory; n : number of frames that it holds, for every pixel, so that its variance is that of a frame over n
R : flow from Z to F; A its affine part; r = R − A
w : agreement of ``F ∘ (id + R)`` with Z (:mod:`turbrestore.steady.fusion`), less where r is more than turbulence, 0 in
    objects that move (:mod:`turbrestore.steady.motion`)
g : gain, 1 over the number of frames since the memory began, at least 1/64
s : stillness, 0 to 1, of the camera, less where turbulence is weak: the window averages that out, and what is left
    is motion, of leaves or water

Z is a Kalman filter of one value for every pixel, whose image drift a pixel earns: where the innovation
``F ∘ (id + R) − Z`` is explained by misregistration and noise (w = 1), n grows and the frame has a weight of 1/n; where
it is not, the variance is opened, n falls to 1, and the frame passes::

    n ← 1 + w min(n, s (1 − g) / (1 − s (1 − g))),      Z ← Z + (F ∘ (id + R) − Z) / n

The geometry is estimated likewise.  R is what F lies away from the mean geometry of the frames before, so that the mean
moves by g R, and the memory with it: ``Z ← Z ∘ (id + V)`` with V the inverse flow of ``g_r r + g_A A``, and ::

    g_r = 1 − s (1 − g),      g_A = 1 − s (1 − g) / (1 + (|A| / 2c)⁸)

with c what turbulence displaces at most: a whole frame that lies far away has been moved by the camera, and the memory
follows.  Where r cannot be trusted (w small, an object or the background it uncovers) it is filled in from around.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..registration.flow_algebra import invert_flow
from ..registration.warp import sample_linear, warp
from .camera import camera_flow, camera_size, fit_camera
from .fusion import agreement_weight, explained_difference

# Longest memory, frames: a change of the light is followed as fast.
_LONGEST = 64
# Windows, pixels, in which |r|² is averaged, and from which r is filled in.
_WINDOW, _SURROUNDINGS = 4.0, 12.0
# Margin of what moves, and its soft edge, pixels.
_MARGIN, _MARGIN_EDGE = np.ones((5, 5), np.uint8), 1.5
# Window in which an object draws the flow of a flat background along.
_BESIDE = np.ones((25, 25), np.uint8)
# Least weight of the surroundings that a flow is filled in from; with less it fades.
_LEAST_WEIGHT = 0.05
# What weak turbulence displaces at most, which leaves nothing to the memory, and strong turbulence, pixels.
_WEAK, _STRONG = 1.2, 1.8
# Stillness below which nothing is remembered.
_LEAST_STILLNESS = 0.1


@dataclass(frozen=True, eq=False)
class Memory:
    """What is remembered of a scene.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        Z, at the mean geometry of the frames.
    held : ndarray, float32, shape (H, W)
        n, frames.
    frames : int
        Number of frames since the memory began, at most the longest memory.
    """

    image: FloatArray
    held: FloatArray
    frames: int


def remember(
    memory: Memory | None,
    image: FloatArray,
    flow_between: Callable[[FloatArray, FloatArray], FloatArray],
    noise: float,
    largest: float,
    stillness: float,
    moving: NDArray[np.bool_],
) -> Memory:
    """Take a frame into the memory; the image of the memory is then the estimate of this frame.

    Parameters
    ----------
    memory : Memory or None
        None at the start of a scene.
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        F.
    flow_between : callable
        From two images to the flow from the first to the second, float32, shape (H, W, 2), pixels.
    noise : float
        Standard deviation of the noise of a frame, intensity.
    largest : float
        c, pixels.
    stillness : float
        Stillness of the camera, 0 to 1.
    moving : ndarray, bool, shape (H, W)
        Where something moves against the scene.

    Returns
    -------
    Memory

    Examples
    --------
    >>> one, other = np.full((9, 9), 0.5, np.float32), np.full((9, 9), 0.51, np.float32)
    >>> none = lambda first, second: np.zeros((9, 9, 2), np.float32)
    >>> settings = none, 0.01, 2.0, 1.0, np.zeros((9, 9), bool)
    >>> memory = remember(remember(None, one, *settings), other, *settings)
    >>> round(float(memory.image[4, 4]), 4), round(float(memory.held[4, 4]), 1)
    (0.5053, 1.9)
    """
    shape = image.shape[:2]
    stillness *= float(np.clip((largest - _WEAK) / (_STRONG - _WEAK), 0, 1))
    if memory is None or stillness < _LEAST_STILLNESS:
        return Memory(image, np.ones(shape, np.float32), 1)
    flow = flow_between(memory.image, image)
    camera = fit_camera(flow)
    affine = camera_flow(camera, shape)
    own = flow - affine
    tolerance = explained_difference(memory.image, noise)
    weight = agreement_weight(sample_linear((image,), flow), memory.image, tolerance)
    weight /= 1 + (cv2.GaussianBlur(np.einsum("yxc,yxc->yx", own, own), (0, 0), _WINDOW) / largest**2) ** 2
    # R follows a slow object from frame to frame, and would hold it back, and with it the flat background beside it.
    near = cv2.dilate(moving.astype(np.uint8), _MARGIN) > 0
    weight *= 1 - cv2.GaussianBlur(near.astype(np.float32), (0, 0), _MARGIN_EDGE)
    trusted = np.where(cv2.dilate(near.astype(np.uint8), _BESIDE) > 0, 0, weight)
    own = _filled(own, trusted)
    frames = min(memory.frames + 1, _LONGEST)
    kept = stillness * (1 - 1 / frames)
    held = 1 + weight * np.minimum(memory.held, kept / (1 - kept))
    innovation = warp(image, own + affine) - memory.image
    estimate = memory.image + innovation / (held if image.ndim == 2 else held[..., None])
    trust = 1 / (1 + (camera_size(camera, shape) / (2 * largest)) ** 8)
    inverse = invert_flow((1 - kept) * own + (1 - kept * trust) * affine)
    return Memory(warp(estimate, inverse), sample_linear((held,), inverse), frames)


def _filled(flow: FloatArray, weight: FloatArray) -> FloatArray:
    """Replace a flow by that of its surroundings where its weight is small."""
    total = cv2.GaussianBlur(weight, (0, 0), _SURROUNDINGS) + _LEAST_WEIGHT
    around = cv2.GaussianBlur(flow * weight[..., None], (0, 0), _SURROUNDINGS) / total[..., None]
    return np.asarray(around + weight[..., None] * (flow - around), np.float32)
