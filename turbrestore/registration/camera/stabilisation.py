"""Temporal mean of frames at the mean position of the camera: the first reference of a clip.

Symbols
-------
A_k : similarity from the mean position to frame k, ``mean(x) ≈ frame_k(A_k x)``, homogeneous, pixels
Ā : mean of the A_k against one frame, so that they are counted from the mean position, ``A_k ← A_k Ā⁻¹``

Frames of a camera that only shifts are moved by whole pixels, which needs no interpolation.  Where it turns or zooms as
well, so that corners move by more than turbulence moves them, affine maps of reduced images are found that maximise the
enhanced correlation coefficient (Evangelidis and Psarakis 2008), and A_k is the similarity in each.  Frames are
interpolated for this mean alone.  Flows are measured from it to the frames as they are, so that the motion of the
camera is part of the flow, and a frame is sampled once.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arrays import FloatArray, check_frames
from ...core.robust import spread
from ...runtime.scratch import iter_frames, mean_of
from ...runtime.threads import map_ahead
from .global_shift import DEAD_ZONE, LEAST_CORRELATION, Shift, known_shifts, overlap, reduce_image

Matrix = NDArray[np.float64]

# Frames that tell whether the camera turns, chosen: in most of them the corners then move by more than the dead zone.
_SAMPLES = 9
# Iterations of the correlation, and the change of it that ends them, chosen.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)


def mean_stabilised(frames: ArrayLike, threads: int = 0) -> FloatArray:
    """Temporal mean of frames (T, H, W[, 3]), each moved to the mean position of the camera.

    If all frames lie within two pixels of it they are averaged as they are; otherwise frames whose position is unknown
    are left out.
    """
    stack = check_frames(frames)
    mean = mean_of(stack)
    shifts, known = known_shifts(stack, threads)
    found = np.flatnonzero(known)
    poses = _poses(stack, shifts, found, threads)
    if not poses and np.abs(shifts).max() <= DEAD_ZONE:
        return mean
    total = np.zeros(mean.shape)
    count = np.zeros(mean.shape[:2])
    numbers = list(poses) if poses else found.tolist()
    for number, frame in zip(numbers, iter_frames(map(stack.__getitem__, numbers)), strict=True):
        if poses:
            placed = _placed(frame, poses[number])
            seen = np.isfinite(placed if placed.ndim == 2 else placed[..., 0])
            total[seen] += placed[seen]
            count += seen
        else:
            to, origin = overlap(count.shape, np.rint(shifts[number]))
            total[to] += frame[origin]
            count[to] += 1
    seen = count > 0
    mean[seen] = (total[seen].T / count[seen]).T
    return mean


def _poses(stack: FloatArray, shifts: Shift, found: NDArray[np.int64], threads: int) -> dict[int, Matrix]:
    """A_k by the number of the frame; empty if the camera neither turns nor zooms."""
    anchor = found[len(found) // 2]
    reference = reduce_image(stack[anchor])
    sample = found[np.unique(spread(len(found), _SAMPLES))]
    if not _turns(_measure(stack, reference, shifts - shifts[anchor], sample.tolist(), threads), stack.shape):
        return {}
    poses = _measure(stack, reference, shifts - shifts[anchor], found.tolist(), threads)
    from_mean = np.linalg.inv(np.mean(list(poses.values()), axis=0))
    return {number: pose @ from_mean for number, pose in poses.items()}


def _measure(
    stack: FloatArray, reference: FloatArray, shifts: Shift, numbers: Sequence[int], threads: int
) -> dict[int, Matrix]:
    """Similarities from the frame of the reference to others; none for frames that are unlike it."""

    def pose(pair: tuple[FloatArray, NDArray[np.float64]]) -> Matrix | None:
        frame, shift = pair
        start = np.vstack([np.column_stack([np.eye(2), shift]), (0, 0, 1)])
        alike, found = find_similarity(reference, reduce_image(frame), stack.shape[1:3], start, _CRITERIA, 3)
        return None if alike < LEAST_CORRELATION else found

    pairs = zip(iter_frames(map(stack.__getitem__, numbers)), shifts[np.asarray(numbers)], strict=True)
    measured = zip(numbers, map_ahead(pose, pairs, threads), strict=True)
    return {number: found for number, (_, found) in measured if found is not None}


def find_similarity(
    reference: FloatArray,
    image: FloatArray,
    shape: tuple[int, ...],
    start: Matrix,
    criteria: tuple[int, int, float],
    window: int,
) -> tuple[float, Matrix]:
    """Return the enhanced correlation coefficient of two reduced images and the similarity that maximises it.

    ``start`` and similarity (3, 3) are those of the whole images, (H, W).  Where nothing is alike, -1 and the start.
    """
    x, y = shape[1] / reference.shape[1], shape[0] / reference.shape[0]
    # Centres of pixels lie at half of their side.
    enlarged = np.array([[x, 0, (x - 1) / 2], [0, y, (y - 1) / 2], [0, 0, 1]])
    reduced = (np.linalg.inv(enlarged) @ start @ enlarged)[:2].astype(np.float32)
    try:
        alike, affine = cv2.findTransformECC(reference, image, reduced, cv2.MOTION_AFFINE, criteria, None, window)
    except cv2.error:
        return -1.0, start
    whole = np.vstack([np.asarray(affine, np.float64), (0.0, 0.0, 1.0)])
    return alike, _similarity(enlarged @ whole @ np.linalg.inv(enlarged), shape)


def _similarity(affine: Matrix, shape: tuple[int, ...]) -> Matrix:
    """Turn and zoom of an affine map, which agrees with it at the centre of the image."""
    centre = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    along, across = (affine[0, 0] + affine[1, 1]) / 2, (affine[1, 0] - affine[0, 1]) / 2
    linear = np.array([[along, -across], [across, along]])
    step = affine[:2, :2] @ centre + affine[:2, 2] - linear @ centre
    return np.vstack([np.column_stack([linear, step]), (0, 0, 1)])


def _turns(poses: dict[int, Matrix], shape: tuple[int, ...]) -> bool:
    """Whether corners of most frames lie far from where the shift alone would put them."""
    if len(poses) < 2:
        return False
    linear = np.array([pose[:2, 0] for pose in poses.values()])
    turned = np.linalg.norm(linear - linear.mean(axis=0), axis=1) * np.hypot(shape[1], shape[2]) / 2
    return float(np.median(turned)) > DEAD_ZONE


def _placed(frame: FloatArray, pose: Matrix) -> FloatArray:
    """Frame at the mean position, NaN where it shows nothing."""
    size, flags = frame.shape[1::-1], cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(frame, pose[:2], size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=[np.nan] * 4)
