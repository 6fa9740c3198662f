"""Path of the camera through a scene, and the smooth path that the steadied video takes.

Symbols
-------
k : the frame; j a frame before it or after it, at time t_j, frames after k
G_j : affine map from the first frame of the scene to frame j, homogeneous, pixels about the centre of the image
P_j : motion of the camera from frame k to frame j, ``G_j G_k⁻¹ − 1``, of shape (2, 3)
y : one of the six coefficients of all P_j, scaled to the root mean square of what it moves, pixels; ``y = c + a``
c, a : the part of the camera, and that of turbulence, which moves whole frames as well
s², τ : variance of a, and its correlation time, frames: covariance ``s² R``, ``R_ij = exp(−|t_i − t_j| / τ)``
s² C : covariance of c about a constant that is not known
V : ``R + C``; Q : ``V⁻¹ − V⁻¹ 1 1ᵀ V⁻¹ / 1ᵀ V⁻¹ 1``
e : by what turbulence moves whole frames, pixels
T : map from frame k to the steadied frame, ``1 +`` the mean of c_k, given the P_j

A camera rests (C = 0), moves at constant velocity (``C = v² t tᵀ``), turns once (``C = v² (t tᵀ + h hᵀ)``, h the
distance in time from the turn on, zero at frame k), or changes its velocity at random by a variance of ρ s² a frame
(``C = v² t tᵀ + ρ W``, W the covariance of an integrated random walk from frame k on).  The evidence for such a model,
with s² integrated out by the prior 1/s², is::

    |V|^(−1/2) (1ᵀ V⁻¹ 1)^(−1/2) (yᵀ Q y)^(−(n − 1)/2)

(Rasmussen and Williams 2006, ch. 2.7 and 5.4; Wahba 1978 for W), and under it the mean of c_k is
``1ᵀ V⁻¹ y / 1ᵀ V⁻¹ 1``, since C is zero at frame k.  T is the mean over models and correlation times by their
probability.  Each coefficient has its own, and the others have a say on the correlation time.  A model is less
probable, and moves frames less, by the share ``1 / (1 + (s / e)⁸)``, with ``s² = yᵀ Q y / (n − 1)``: what moves frames
further than turbulence does is a camera that shakes, and stays as it is.  Positions have an error ε at random, which
adds ``ε² tr Q`` to ``yᵀ Q y``.

G_j is the median over the earlier neighbours of frame j of the map to them and on to frame j; those far away keep
errors from adding up with every frame.  Where the frames can be read twice, they are placed in the mean of the scene
instead (:mod:`turbrestore.steady.scene_mean`).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np

from .camera import Matrix, camera_size

# Frames before k, and after it, that are kept, chosen.
LONGEST = 48
# Correlation times τ, frames, and ρ of the models: closer and wider grids give the same paths.
_TIMES, _WALKS = (1.0, 3.0, 9.0), (1e-6, 1e-4, 1e-2, 1.0)
# v, a frame: velocities and their changes are of this order times s.  Three times as much or a third changes paths by
# 4 %, less rounds a sudden stop.
_VELOCITY = 5.0
# Every how many frames count where all are known, further away than four times as many: successive ones are alike.
# Up to twice as many from k a camera may turn.  Chosen.
_EVERY = 3
# Fewest times that a path is smoothed over, chosen.
_FEWEST = 4
# Error ε of a position, and the least e, pixels, chosen.
_ERROR = 0.03


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
    """Motion T − 1 from a frame to where it is on the smooth path, given e as the tolerance.

    ``path`` (2, 3); returns (2, 3).
    """
    known = {*path, 0}
    times = tuple(sorted(time for time in known if not _is_dense(time, known) or time % _EVERY == 0))
    if len(times) < _FEWEST:
        return np.zeros((2, 3))
    seen = np.stack([path[time] if time else np.zeros((2, 3)) for time in times])
    sizes = np.array([camera_size(np.outer([1, 0], unit), shape) for unit in np.eye(3)])
    seen = (seen * sizes).reshape(-1, 6)
    models = _models(times)
    squares = np.einsum("tc,mtu,uc->mc", seen, models.left, seen)
    squares += _ERROR**2 * np.trace(models.left, axis1=1, axis2=2)[:, None]
    variance = squares / (len(times) - 1)
    share = 1 / (1 + (variance / max(tolerance, _ERROR) ** 2) ** 4)
    evidence = models.evidence[:, None] - (len(times) - 1) / 2 * np.log(variance) + np.log(share)
    evidence = evidence.reshape(len(_TIMES), -1, seen.shape[1])
    # Turbulence has one correlation time, of which the other coefficients on average tell as much as this one.
    of_time = np.logaddexp.reduce(evidence, axis=1)
    others = (of_time.sum(1, keepdims=True) - of_time) / (seen.shape[1] - 1)
    likely = np.exp(evidence + others[:, None] - np.max(of_time + others, axis=0)).reshape(variance.shape)
    smooth = np.einsum("mc,mc->c", likely / likely.sum(0) * share, models.here @ seen)
    return np.asarray(smooth.reshape(2, 3) / sizes, np.float64)


def _is_dense(time: int, known: Set[int]) -> bool:
    """Whether a time is far from the frame, and those beside it are known as well."""
    return abs(time) > 4 * _EVERY and {time - 1, time + 1} <= known


def without_shake(path: Mapping[int, Matrix], order: int) -> Matrix:
    """Motion from a frame to where it is on the line, or at the point, that fits the path best.

    ``path`` (2, 3); returns (2, 3).
    """
    times = np.array(sorted({*path, 0}))
    seen = np.stack([path[time] if time else np.zeros((2, 3)) for time in times.tolist()]).reshape(-1, 6)
    # With one neighbour a line fits both: the frame stays.
    return np.polynomial.polynomial.polyfit(times, seen, order)[0].reshape(2, 3)


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


@dataclass(frozen=True, eq=False)
class _Models:
    """Models of a path at given times."""

    evidence: Matrix  # (M,): logarithm of the probability a priori, and of what the evidence does not have of y
    left: Matrix  # (M, n, n): Q
    here: Matrix  # (M, n): weights of y in the mean of c_k


@functools.lru_cache(maxsize=8)
def _models(times: tuple[int, ...]) -> _Models:
    time = np.array(times, np.float64)
    apart, ahead = np.abs(time[:, None] - time), np.abs(time)
    sooner, later = np.minimum(ahead[:, None], ahead), np.maximum(ahead[:, None], ahead)
    walk = np.where(np.sign(time[:, None]) == np.sign(time), sooner**2 * (3 * later - sooner) / 6, 0.0)
    line = _VELOCITY**2 * np.outer(time, time)
    air = np.stack([np.exp(-apart / correlated) for correlated in _TIMES])
    smooth = np.stack([0 * line, line, *(line + diffusion * walk for diffusion in _WALKS)])
    total = air[:, None] + smooth
    inverse, logarithm = np.linalg.inv(total), np.linalg.slogdet(total)[1]
    # A turn adds a product of vectors to the covariance of the line (Sherman and Morrison 1950).
    bends = range(-2 * _EVERY, 2 * _EVERY + 1)
    turns = np.stack([np.clip((time - bend) * (1 if bend >= 0 else -1), 0, None) for bend in bends])
    along = np.einsum("atu,bu->abt", inverse[:, 1], _VELOCITY * turns)
    growth = 1 + np.einsum("abt,bt->ab", along, _VELOCITY * turns)
    turned = inverse[:, 1, None] - along[..., None] * along[:, :, None] / growth[..., None, None]
    inverse = np.concatenate([inverse, turned], 1).reshape(-1, *line.shape)
    logarithm = np.concatenate([logarithm, logarithm[:, 1, None] + np.log(growth)], 1).ravel()
    # Resting, constant velocity, all walks and all turns are as probable a priori.
    counts = [1, 1, *[len(_WALKS)] * len(_WALKS), *[len(turns)] * len(turns)]
    ones = inverse.sum(2)
    left = inverse - ones[:, :, None] * ones[:, None] / ones.sum(1)[:, None, None]
    evidence = -np.tile(np.log(counts), len(_TIMES)) - (logarithm + np.log(ones.sum(1))) / 2
    return _Models(evidence, left, ones / ones.sum(1)[:, None])
