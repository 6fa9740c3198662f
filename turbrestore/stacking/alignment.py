"""Alignment of a result to an image of the same scene: shift, rotation and scale, and the smooth flow that remains.

Symbols
-------
r, q : reference and image
A : similarity from the reference to the image, ``A x = c (cos φ, −sin φ; sin φ, cos φ) x + s``
F : the whole alignment, ``q ∘ (id + F) ≈ r``; d : what it still lacks, pixels
α, β : contrast and brightness of q relative to r, in a Gaussian window about every pixel

Results of other clips have another brightness and contrast, perhaps another sign of it: bands of Jupiter in methane,
leaves in the infrared.  So neither image is compared by its intensities.

A maximises the enhanced correlation coefficient (Evangelidis and Psarakis 2008) on three levels of a pyramid, from the
shift that phase correlation finds.  There both images are reduced to their deviation from a local mean in units of the
local spread; where that does not correlate, to its negative, and to the length of its gradient, which has no sign.

F starts from A.  With ``q' = q ∘ (id + F)``, d minimises ``Σ ρ (q' + ∇q' · d − α r − β)²``, where every pixel has the α
and β that fit its own window best (as in Lucas and Kanade 1981, whose windows share one), and ρ is the squared
correlation there over the spread of q'.  The windows of α and β are hardly wider than an edge, so that edges side by
side may change their contrast by different factors.  Those of d are wide, because what remains between two results is
the mean displacement by air, which is smooth; where one has little gradient, a wider one takes its place.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import ROUNDING, FloatArray, luminance
from ..core.errors import DataError
from ..registration.camera.global_shift import correlation, measure_shift, prepare_shift_reference
from ..registration.camera.stabilisation import find_similarity
from ..registration.flow_algebra import compose_flows
from ..registration.warp import inside, warp
from ..steady.camera_path.camera import camera_flow, fit_camera

Matrix = NDArray[np.float64]
# What reference and image are reduced to before they are compared.
_Features = tuple[Callable[[FloatArray], FloatArray], Callable[[FloatArray], FloatArray]]

# Longest sides of the levels on which the similarity is found, pixels, chosen.
_LEVELS = (64, 160, 640)
# Least blur that images are compared at, the window of their local mean and spread, pixels, and the spread, as a share
# of the range, below which a window is flat; all chosen.
_LEAST_BLUR, _WINDOW, _FLOOR = 0.5, 8.0, 0.02
# Blurs that are tried on the sharper image, pixels, chosen.
_BLURS = np.arange(0.0, 3.01, 0.25)
# Correlation below which features say nothing, and above which no other features are tried; both chosen.
_ALIKE, _CLEARLY = 0.2, 0.6
# Iterations of the correlation and the change that ends them, both chosen.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-6)
# Deviation of the windows of contrast and brightness, pixels: at first wide, because A is only nearly right; and the
# largest displacement of a step; all chosen.
_LOCAL, _LARGEST = (4.0, 4.0, 2.0, 2.0, 1.5, 1.5, 1.5, 1.5), 1.0
# Reduction of the image for the windows of d, their deviations, pixels, and the share of the usual weight below which
# one holds little; all chosen.
_REDUCED, _WIDE, _LITTLE = 4, (32.0, 12.0), 0.03
# How much detail is raised, and below which size, pixels; both chosen.
_RAISED, _FINE = np.float32(4), 1.2
# Spread, as a share of the range of an image, below which a window of contrast and brightness is flat, chosen.
_FLAT = 0.003


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where an image lies against a reference.

    Attributes
    ----------
    shift : tuple of float
        Of the centre of the reference, pixels to the right and down.
    rotation : float
        Degrees, from the x axis towards the y axis.
    scale : float
        Of the image relative to the reference.
    flow : ndarray, float32, shape (H, W, 2)
        F, from the reference to the image, pixels.
    residual : float
        Root mean square of what F has beyond shift, rotation and scale, pixels.
    likeness : float
        Correlation of reference and aligned image, after their local contrast is made equal.
    """

    shift: tuple[float, float]
    rotation: float
    scale: float
    flow: FloatArray
    residual: float
    likeness: float


def align_to(image: FloatArray, reference: FloatArray) -> Alignment:
    """Find where an image of the same scene lies against a reference.

    ``image``, ``reference`` (H, W) or (H, W, 3) of one size; DataError where they are not alike.
    """
    if image.shape[:2] != reference.shape[:2]:
        raise DataError(f"image: expected the size of the reference {reference.shape[:2]}, found {image.shape[:2]}")
    a, b = _equally_sharp(luminance(reference), luminance(image))
    best, A, features = -1.0, np.eye(3), _FEATURES[0]
    for tried in _FEATURES:
        likeness, found = _similarity(a, b, tried)
        if likeness > best:
            best, A, features = likeness, found, tried
        if best > _CLEARLY:
            break
    if best < _ALIKE:
        raise DataError(f"image: expected the scene of the reference, found a likeness of {max(best, 0):.2f} with it")
    F, r, q = _joined(A, a.shape), _sharpened(a), _sharpened(b)
    for local in _LOCAL:
        F = compose_flows(F, np.clip(_lacking(r, q, F, local), -_LARGEST, _LARGEST))
    first, second = (feature(image) for feature, image in zip(features, (a, b), strict=True))
    return _described(F, correlation(first, warp(second, F)))


def _sharpened(image: FloatArray) -> FloatArray:
    """Raise fine detail, so that edges side by side blend less."""
    return image + _RAISED * (image - cv2.GaussianBlur(image, (0, 0), _FINE))


def _lacking(r: FloatArray, q: FloatArray, F: FloatArray, local: float) -> FloatArray:
    """Return the displacement d that an alignment lacks; ``r`` and ``q`` have a range of 1."""
    moved, least = warp(q, F), np.float32(_FLAT**2)

    def mean(image: FloatArray) -> FloatArray:
        return cv2.GaussianBlur(image, (0, 0), local)

    level = mean(r)
    spread = mean(r * r) - np.square(level) + least

    def unexplained(image: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what brightness and contrast leave of an image, and its contrast."""
        about = mean(image)
        contrast = (mean(r * image) - level * about) / spread
        return image - about - contrast * (r - level), contrast

    rest, contrast = unexplained(moved)
    own = mean(moved * moved) - np.square(mean(moved)) + least
    along, across = (unexplained(cv2.Sobel(moved, cv2.CV_32F, *axis, scale=1 / 8))[0] for axis in ((1, 0), (0, 1)))
    # The squared correlation, over the spread of q'.
    weight = np.square(contrast) * spread / np.square(own) * inside(F)
    products = along * along, along * across, across * across, along * rest, across * rest
    size = tuple(max(length // _REDUCED, 1) for length in r.shape[::-1])
    small = [cv2.resize(weight * product, size, interpolation=cv2.INTER_AREA) for product in products]
    d = np.zeros((*size[::-1], 2), np.float32)
    usual = np.float32(_LITTLE * (small[0] + small[2]).mean() / 2 + 1e-30)
    for width in _WIDE:
        xx, xy, yy, x, y = (cv2.GaussianBlur(one, (0, 0), width / _REDUCED) for one in small)
        xx, yy, x, y = xx + usual, yy + usual, x - usual * d[..., 0], y - usual * d[..., 1]
        d = np.stack([xy * y - yy * x, xy * x - xx * y], -1) / (xx * yy - xy * xy)[..., None]
    return cv2.resize(d, r.shape[::-1], interpolation=cv2.INTER_LINEAR)


def _described(F: FloatArray, likeness: float) -> Alignment:
    """Take shift, rotation and scale off a flow, by the similarity that fits it best."""
    fitted = fit_camera(F)
    along, across = 1 + (fitted[0, 0] + fitted[1, 1]) / 2, (fitted[1, 0] - fitted[0, 1]) / 2
    matrix = np.array([[along - 1, -across, fitted[0, 2]], [across, along - 1, fitted[1, 2]]])
    rest = F - camera_flow(matrix, F.shape)
    return Alignment(
        shift=(float(fitted[0, 2]), float(fitted[1, 2])),
        rotation=math.degrees(math.atan2(across, along)),
        scale=math.hypot(along, across),
        flow=F,
        residual=float(np.sqrt(np.square(rest).sum(axis=-1).mean())),
        likeness=likeness,
    )


def _equally_sharp(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bring both images to a range of 1, and blur them until both have the same share of fine detail."""
    a, b = (cv2.GaussianBlur(_at_unit_range(image), (0, 0), _LEAST_BLUR) for image in (a, b))
    sharper, other = (a, b) if _fineness(a) > _fineness(b) else (b, a)
    wanted = _fineness(other)
    tried = [sharper, *(cv2.GaussianBlur(sharper, (0, 0), blur) for blur in _BLURS[1:])]
    softened = min(tried, key=lambda image: abs(_fineness(image) - wanted))
    return (softened, b) if sharper is a else (a, softened)


def _fineness(image: FloatArray) -> float:
    """Energy of the second derivative over that of the first: the squared frequency that carries the gradient."""
    gradient = sum(float(np.square(cv2.Sobel(image, cv2.CV_32F, *axis)).mean()) for axis in ((1, 0), (0, 1)))
    return float(np.square(cv2.Laplacian(image, cv2.CV_32F)).mean()) / max(gradient, ROUNDING**2)


def _at_unit_range(image: FloatArray) -> FloatArray:
    return image / np.float32(max(float(np.ptp(image)), ROUNDING))


def _levels(image: FloatArray) -> FloatArray:
    """Deviation from the local mean in units of the local spread."""
    image = _at_unit_range(image)
    centred = image - cv2.GaussianBlur(image, (0, 0), _WINDOW)
    return centred / np.sqrt(cv2.GaussianBlur(centred * centred, (0, 0), _WINDOW) + np.float32(_FLOOR**2))


def _edges(image: FloatArray) -> FloatArray:
    """Length of the gradient, without its local mean."""
    levels = _levels(image)
    length = cv2.magnitude(*(cv2.Sobel(levels, cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1))))
    return _levels(cv2.GaussianBlur(length, (0, 0), 1.0))


def _unit(feature: FloatArray) -> FloatArray:
    return np.clip(0.5 + feature / 8, 0, 1)


def _similarity(a: FloatArray, b: FloatArray, features: _Features) -> tuple[float, Matrix]:
    """Similarity A, with the correlation that it reaches."""
    first, second = features
    coarse = [function(_reduced(image, _LEVELS[1])) for function, image in ((first, a), (second, b))]
    shift = measure_shift(_unit(coarse[1]), prepare_shift_reference(_unit(coarse[0])))
    found = np.zeros(2) if shift is None else shift * (a.shape[1] / coarse[0].shape[1])
    warped = np.vstack([np.column_stack([np.eye(2), found]), (0, 0, 1)])
    for side in _LEVELS:
        pair = first(_reduced(a, side)), second(_reduced(b, side))
        _, warped = find_similarity(*pair, a.shape, warped, _CRITERIA, 5)
    alike = correlation(first(a), warp(second(b), _joined(warped, a.shape)))
    return alike, warped


_FEATURES: tuple[_Features, ...] = (
    (_levels, _levels),
    (_levels, lambda image: -_levels(image)),
    (_edges, _edges),
)


def _reduced(image: FloatArray, side: int) -> FloatArray:
    factor = max(1.0, max(image.shape) / side)
    size = round(image.shape[1] / factor), round(image.shape[0] / factor)
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _joined(A: Matrix, shape: tuple[int, ...]) -> FloatArray:
    """Flow of a similarity."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    return np.stack([A[0, 0] * x + A[0, 1] * y + A[0, 2] - x, A[1, 0] * x + A[1, 1] * y + A[1, 2] - y], -1).astype(
        np.float32
    )
