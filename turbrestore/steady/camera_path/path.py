"""Path of the camera through a scene, and the smooth path that the steadied video takes.

Symbols
-------
k : the frame; j a frame before it, or after it within the window
G_j : affine map from the first frame of the scene to frame j, homogeneous, pixels about the centre of the image
P_j : motion of the camera from frame k to frame j, ``G_j G_k⁻¹ − 1``, of shape (2, 3)
T : map from frame k to the steadied frame, ``1 +`` the value at k of a curve fitted to the P_j
e : by what turbulence moves whole frames, pixels
ε_i, σ_i : what fit i leaves, root mean square; standard deviation of its value at k, from ε_i and ρ_i
ρ_i : correlation of what fit i leaves in successive frames: a mean varies √((1 + ρ) / (1 − ρ)) times as much by it
n : number of frames of the first fit; S : sum of squares that one of its curves leaves

Turbulence moves whole frames as well, but at random about where the camera is, and a camera rests, pans and zooms at
constant velocity for a while.  A curve through a few frames follows whatever the camera does and averages little; a
line through many averages much, without a lag behind a pan; a mean of many is best while the camera rests.  The fits
are taken in this order, as long as each agrees with the one before (the intersection of confidence intervals of
Goldenshluger and Nemirovski 1997): fit i has the share ::

    Π_{l ≤ i} 1 / (1 + (ε_l / e)⁸) · 1 / (1 + (|value_l − value_{l−1}| / κ σ_{l−1})⁴)

of what those before leave, without the last factor for the first.  Where even the first leaves more than e, the camera
shakes, and T = 1.

The path of a camera that turns is a parabola, that of one which starts or stops at once two lines that meet, at any
frame with two others on either side.  The first fit is the mean of these curves by their probability, ε_1 that of the
parabola.  All have three coefficients along each axis, so where what they leave is independent and of unknown scatter,
their likelihoods are ``S^(3 − n)``; a priori, the parabola is as probable as all pairs of lines together.  σ_1 includes
by how much the curves differ at k.

G_j is the median over the earlier neighbours of frame j of the map to them and on to frame j; those far away keep
errors from adding up with every frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from .camera import Matrix, camera_size

# Frames before k that are kept.
LONGEST = 48
# Fits: frames on either side of k, and order of the polynomial, which of the second order has pairs of lines beside it;
# fewest frames of a fit.
_FITS = (6, 2), (6, 1), (12, 1), (24, 1), (LONGEST, 1), (LONGEST, 0)
_FEWEST = 4
# κ, less for a static camera, since that is the assumption that a slow pan breaks.
_DOUBT, _RESTING = 2.0, 1.5
_AT_ENDS = 0.5
# Frames from one to the next whose residuals are compared, and the greatest correlation ρ that they count for.
_SUCCESSIVE, _MOST_ALIKE = 2, 0.95
# Least e, ε and κ σ, pixels, so that an exact fit has a share.
_LEAST = 1e-3


def camera_position(before: Sequence[Matrix], cameras: Mapping[int, Matrix]) -> Matrix:
    """Position G_k of a frame from those of the frames before it.

    ``before`` (3, 3) each; ``cameras`` (2, 3); returns (3, 3).
    """
    known = [offset for offset in cameras if -len(before) <= offset < 0]
    if not known:
        return np.eye(3)
    return np.median([np.linalg.inv(homogeneous(cameras[offset])) @ before[offset] for offset in known], 0)


def longer_path(before: Sequence[Matrix], position: Matrix, cameras: Mapping[int, Matrix]) -> dict[int, Matrix]:
    """Motion from a frame to all frames that are known: those before it, and its later neighbours.

    ``before`` (3, 3) each; ``position`` (3, 3); ``cameras`` (2, 3); returns (2, 3) each.
    """
    inverse = np.linalg.inv(position)
    past = {number - len(before): motion(other @ inverse) for number, other in enumerate(before)}
    return past | {offset: camera for offset, camera in cameras.items() if offset > 0}


def smooth_motion(path: Mapping[int, Matrix], tolerance: float, shape: tuple[int, ...]) -> Matrix:
    """Motion T − 1 from a frame to where it is on the smooth path.

    ``path`` (2, 3); returns (2, 3).
    """
    times, seen, weights = _samples(path)
    smooth, share, value, doubt = np.zeros(6), 1.0, None, 0.0
    for span, order in _FITS:
        near = np.abs(times) <= span
        one_sided = min(np.sum(times[near] < 0), np.sum(times[near] > 0)) < 2
        if near.sum() < _FEWEST or (order == 2 and one_sided):
            continue
        if one_sided and value is None:
            # At the ends of a scene the first line is extrapolated.
            share *= _AT_ENDS
        curves, now = _curves(times[near], weights[near], order), int(np.sum(times[near] < 0))
        remains = seen[near] - curves @ seen[near]
        likely = _likelihoods(remains, weights[near], shape)
        left = np.tensordot(likely, remains, 1)
        before, value = value, -left[now]
        # Lines that meet also fit a camera that shakes.
        share *= 1 / (1 + (_size(remains[0], weights[near], shape) / max(tolerance, _LEAST)) ** 8)
        if before is not None:
            differs = camera_size((value - before).reshape(2, 3), shape)
            share *= 1 / (1 + (differs / max((_DOUBT if order else _RESTING) * doubt, _LEAST)) ** 4)
        smooth = smooth + share * (value - smooth)
        within = np.sqrt(likely @ np.square(curves[:, now]).sum(axis=1)) * _size(left, weights[near], shape)
        between = _size(left[now] - remains[:, now], likely, shape)
        doubt = float(np.hypot(within * _alikeness(times[near], left), between))
    return smooth.reshape(2, 3)


def without_shake(path: Mapping[int, Matrix], order: int) -> Matrix:
    """Motion from a frame to where it is on the line, or at the point, that fits the path best.

    ``path`` (2, 3); returns (2, 3).
    """
    times, seen, _ = _samples(path)
    # With one neighbour a line fits both: the frame stays.
    return (_curves(times, np.ones(len(times)), order)[0] @ seen)[times == 0].reshape(2, 3)


def homogeneous(matrix: Matrix) -> Matrix:
    """Map id + A as a matrix of homogeneous coordinates about the centre.

    ``matrix`` (2, 3); returns (3, 3).
    """
    return np.eye(3) + np.vstack([matrix, np.zeros(3)])


def motion(pose: Matrix) -> Matrix:
    """Undo :func:`homogeneous`.

    ``pose`` (3, 3); returns (2, 3).
    """
    return pose[:2] - np.eye(3)[:2]


def _samples(path: Mapping[int, Matrix]) -> tuple[Matrix, Matrix, Matrix]:
    """Arrange a path: times, motions as rows, and the number of frames that each counts for, as some are skipped."""
    times = np.array(sorted([*path, 0]), np.float64)
    seen = np.stack([path[int(time)] if time else np.zeros((2, 3)) for time in times]).reshape(-1, 6)
    return times, seen, np.gradient(times) if len(times) > 1 else np.ones(1)


def _alikeness(times: Matrix, left: Matrix) -> float:
    """By how much more the mean of residuals varies than that of independent ones: √((1 + ρ) / (1 − ρ))."""
    gaps = np.diff(times)
    near, shifts = gaps <= _SUCCESSIVE, left.reshape(-1, 2, 3)[..., 2]
    earlier, later = shifts[:-1][near], shifts[1:][near]
    alike = 2 * (earlier * later).sum() / max((earlier**2 + later**2).sum(), _LEAST**2)
    correlation = float(np.clip(alike, 0, _MOST_ALIKE)) ** (1 / gaps[near].mean())
    return float(np.sqrt((1 + correlation) / (1 - correlation)))


def _curves(times: Matrix, weights: Matrix, order: int) -> Matrix:
    """Projections of samples on a polynomial and, beside a parabola, on pairs of lines that meet at a frame."""
    line, root = times / LONGEST, np.sqrt(weights)
    bases = [line[:, None] ** np.arange(order + 1)]
    if order == 2:
        bases += [np.stack([line**0, line, np.abs(line - bend)], 1) for bend in line[2:-2]]
    basis = np.stack(bases)
    return np.asarray(basis @ (np.linalg.pinv(basis * root[:, None]) * root), np.float64)


def _likelihoods(left: Matrix, weights: Matrix, shape: tuple[int, ...]) -> Matrix:
    """Probability of a polynomial and of pairs of lines from what each leaves, their scatter not being known."""
    sizes = np.array([max(_size(one, weights, shape), _LEAST) for one in left])
    likely = (sizes.min() / sizes) ** (2 * (len(weights) - 3))
    likely[1:] /= max(len(left) - 1, 1)
    return np.asarray(likely / likely.sum(), np.float64)


def _size(left: Matrix, weights: Matrix, shape: tuple[int, ...]) -> float:
    """Root mean square of what a fit leaves, or of how far curves differ, pixels."""
    return camera_size(np.sqrt(np.average(left**2, axis=0, weights=weights)).reshape(2, 3), shape)
