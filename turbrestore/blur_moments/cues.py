"""Cues from blur: how much wider one image is smeared than another, read from spectra without knowing the scene.

A temporal mean is one long exposure of an integrative sensor (papers 1 and 2), and second moments of blur add:
``cov(blur of the mean) = cov(blur of a frame) + cov(displacement)``.  Two images of one scene differ at low frequency
by ``−log(P₁ / P₂) = kᵀ(Σ₁ − Σ₂)k``, whatever the scene is and wherever it has moved to.

Symbols
-------
P₁, P₂ : power spectra of two images, tile by tile; n₁, n₂ : their noise floors, squared intensity.
k : frequency, radians per pixel.
Σ : covariance of a blur (its central second moment), squared pixels.
D : Σ₁ − Σ₂; q = kᵀDk, the exponent.
s : relative blur variance of a frame, squared pixels: ``log(P_t / P̄) = −s k²``.
c : mean squared Laplacian of the image around a pixel.
w : share of a frame in the fused image.
τ : blur variance from which on a frame gets no share.

The papers observe moments of a known point or edge; the scene here is unknown, and the equations are those of the
logarithm of the transfer function, whose second derivatives at 0 are the second moments of the blur.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from ..arrays import FloatArray, check_frames, check_image, luminance
from ..errors import DataError, require, require_between

Float64Array = NDArray[np.float64]

# Neighbouring values of the spectrum of a tile under a Hann window are correlated: power by 4/9 and 1/36 per axis.
_CORRELATED = 1 + 2 * (4 / 9 + 1 / 36)
# Newton steps, and squared pixels that each may go.
_STEPS, _LARGEST_STEP = 12, 4.0
# Noise below this drowns in the rounding of float32, intensity.
_LEAST_NOISE = 1e-6
# Variance of an estimate, pixels to the fourth, from which on nothing is seen.
_NOTHING_SEEN = 100.0
# Exponents beyond this say "blurred away" and no more.
_LARGEST_EXPONENT = 8.0
# Directions that are told apart in the spectrum of a tile.
_SECTORS = 6
# Rounds of frames against reference, reference from frames.
_ROUNDS = 3
# What is known of a frame before it is seen: standard deviation of its relative blur variance, squared pixels.
_PRIOR = 2.0
# Rings that fit worse than expected count less, within these limits.
_SMALLEST_MISFIT, _LARGEST_MISFIT = 0.3, 100.0
# Share of s by which the correction for the window may be wrong.
_WINDOW_ERROR = 0.05
# Rows of the fused image at a time: sorting 500 frames of 1024 columns takes 16 MB.
_STRIP = 8


@dataclass(frozen=True)
class CueParams:
    """How spectra are compared.

    Parameters
    ----------
    tile : int
        Side of the square tiles, pixels; half of it is the distance between them.  Images smaller than a tile are
        one tile.
    lowest : float
        Lowest frequency that is used, periods in a tile; below 1.5 the brightness of the tile leaks in.
    highest : float
        Highest frequency that is used, cycles per pixel.
    misfit : float
        Relative error of the spectrum of a tile besides noise: what a blur carries over its border.
    departure : float
        Error of an exponent as a share of its square: blur is a Gaussian at low frequency only.
    """

    tile: int = 48
    lowest: float = 1.5
    highest: float = 0.35
    misfit: float = 0.2
    departure: float = 0.1

    def __post_init__(self) -> None:
        require(int(self.tile) == self.tile, f"tile: expected a whole number of pixels, found {self.tile}")
        require_between("tile", self.tile, 16, 4096, "pixels")
        require_between("lowest", self.lowest, 1.5, 8, "periods in a tile")
        require_between("highest", self.highest, 0.1, 0.5, "cycles per pixel")
        require_between("misfit", self.misfit, 0.01, 1)
        require_between("departure", self.departure, 0, 10)


@dataclass(frozen=True, eq=False)
class TileGrid:
    """Where the tiles of an image lie.

    Attributes
    ----------
    rows, columns : ndarray, int, shapes (m,) and (n,)
        First row and first column of the tiles.
    size : tuple of int
        Height and width of a tile, pixels.
    shape : tuple of int
        Height and width of the image, pixels.
    """

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    size: tuple[int, int]
    shape: tuple[int, int]


@dataclass(frozen=True, eq=False)
class RelativeBlur:
    """How much wider the first of two images is blurred than the second; negative where it is sharper.

    Attributes
    ----------
    variance, deviation : float
        Σ₁ − Σ₂ per axis if it is the same in all directions, and its standard deviation, squared pixels. Where it
        is not, directions count by what is to be seen in them, and ``matrix`` is to be taken.
    matrix, matrix_deviation : ndarray, float64, shape (2, 2)
        Σ₁ − Σ₂ with axes (x, y), and the standard deviation of each entry, squared pixels.
    tile_variance, tile_deviation : ndarray, float64, shape (m, n)
        The same for every tile; 0 with an infinite deviation where nothing is to be seen.
    tile_matrix, tile_matrix_deviation : ndarray, float64, shape (m, n, 2, 2)
    grid : TileGrid
    """

    variance: float
    deviation: float
    matrix: Float64Array
    matrix_deviation: Float64Array
    tile_variance: Float64Array
    tile_deviation: Float64Array
    tile_matrix: Float64Array
    tile_matrix_deviation: Float64Array
    grid: TileGrid


@dataclass(frozen=True, eq=False)
class FrameBlur:
    """Blur variance of every frame in every tile, relative to the other frames.

    Attributes
    ----------
    relative : ndarray, float32, shape (T, m, n)
        s, squared pixels; the mean over the frames is 0.
    deviation : ndarray, float32, shape (T, m, n)
        Standard deviation of ``relative``; 2 squared pixels, what is assumed beforehand, where nothing is to be seen.
    extra : ndarray, float32, shape (T, m, n)
        Best estimate of s above that of the sharpest frame, at least 0: ``relative`` drawn to 0 as far as noise
        explains it, less its minimum over the frames.
    grid : TileGrid
    """

    relative: FloatArray
    deviation: FloatArray
    extra: FloatArray
    grid: TileGrid


@dataclass(frozen=True, eq=False)
class BlurReference:
    """What the frames of a sequence have in common, so that other frames of it can be held against them.

    Attributes
    ----------
    spectrum : ndarray, float64, shape (tiles, rings)
        P̄ above the noise, squared intensity.
    misfit : ndarray, float64, shape (tiles, rings)
        Factor on the expected squared error of each ring, by which the fit weighs it less.
    size : ndarray, float64, shape (tiles, rings)
        Mean squared residual of each ring, in units of what is expected.
    offset : ndarray, float64, shape (tiles,)
        Mean of s before it is made 0, squared pixels.
    spread : ndarray, float64, shape (tiles,)
        Variance of s over the frames that noise does not explain, pixels to the fourth.
    least : ndarray, float64, shape (tiles,)
        Best estimate of s of the sharpest frame, squared pixels.
    noise : float
        Standard deviation of the white noise of a frame, intensity.
    shape : tuple of int
        Height and width of a frame, pixels.
    params : CueParams
    """

    spectrum: Float64Array
    misfit: Float64Array
    size: Float64Array
    offset: Float64Array
    spread: Float64Array
    least: Float64Array
    noise: float
    shape: tuple[int, int]
    params: CueParams


@dataclass(frozen=True, eq=False)
class FusionRule:
    """Share of every frame in every pixel, ``w = scale · max(threshold − extra, 0)``; see :func:`fusion_rule`.

    Attributes
    ----------
    threshold : ndarray, float32, shape (H, W)
        τ, squared pixels.
    scale : ndarray, float32, shape (H, W)
        Makes the shares sum to 1, per squared pixel.
    blur : FrameBlur
    """

    threshold: FloatArray
    scale: FloatArray
    blur: FrameBlur


def relative_blur(
    first: ArrayLike, second: ArrayLike, noise: float | tuple[float, float], params: CueParams | None = None
) -> RelativeBlur:
    """Difference of the second moments of the blurs of two images of one scene.

    ``−log(P₁ / P₂) = kᵀ(Σ₁ − Σ₂)k`` is fitted by weighted least squares to windowed tiles, each and all together.
    Both sides are multiplied out, ``(P₁ − n₁) e^{q/2} = (P₂ − n₂) e^{−q/2}``, so that noise does not go through the
    logarithm and the estimate has no bias at low signal. Weights follow from the noise floors, from
    ``params.misfit`` and, where the exponent q is large, from ``params.departure``: only the low frequencies of a blur
    are a matter of its second moment. The smear of a spectrum by the window, which makes differences look smaller
    (5 % for σ = 1 and 1.5 in tiles of 48 pixels), is corrected to first order. The uncertainty comes from the
    residuals themselves and holds for whatever causes them.

    Parameters
    ----------
    first, second : array_like, shape (H, W) or (H, W, 3)
        Colour is reduced to luminance.
    noise : float or tuple of two floats
        Standard deviation of the white noise in both images, or in each, intensity.
    params : CueParams, optional

    Returns
    -------
    RelativeBlur

    Raises
    ------
    DataError
        Shapes do not agree, or an image is smaller than 16 pixels.
    ConfigurationError
        A noise is negative.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> scene = np.random.default_rng(0).normal(0.5, 0.1, (128, 128)).cumsum(0).cumsum(1).astype(np.float32) % 1
    >>> soft, softer = (cv2.GaussianBlur(scene, (0, 0), sigma) for sigma in (1.0, 1.414))
    >>> blur = relative_blur(softer, soft, noise=1e-4)
    >>> round(blur.variance, 1), np.abs(blur.matrix).round(1).tolist()
    (1.0, [[1.0, 0.0], [0.0, 1.0]])
    """
    params = params or CueParams()
    one, two = (luminance(check_image(image, name)) for image, name in ((first, "first"), (second, "second")))
    if one.shape != two.shape:
        raise DataError(f"second: expected the shape of first {one.shape}, found {two.shape}")
    noises = noise if isinstance(noise, tuple) else (noise, noise)
    spectra = _Spectra.of(one.shape, params)
    return _compare(spectra.power(one), spectra.power(two), noises, spectra, params)


def displacement_variance(frames: ArrayLike, noise: float, params: CueParams | None = None) -> RelativeBlur:
    """Covariance of the displacement over a sequence, from the blur of its temporal mean against its frames.

    ``cov(blur of the mean) = cov(blur of a frame) + cov(displacement)``: the spectrum of the mean, P₁, is compared
    with the mean of the spectra, P₂. Of P₁ a share P₂/T is what independent frames leave however far they move, and
    is taken off first; the result is the variance about the mean with divisor T − 1. Blur that changes from frame to
    frame hardly matters; rotation and scaling within a tile do not count. The deviations say how well the spectra
    fit, not how well T frames stand for others.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3), at least two
    noise : float
        Standard deviation of the white noise of a frame, intensity.
    params : CueParams, optional
        By default tiles of 64 pixels and a departure of 1: the displacements of few frames are far from Gaussian, and
        those of 2 pixels are seen at the lowest frequencies only.

    Returns
    -------
    RelativeBlur
        ``matrix`` is the covariance of (dx, dy), ``variance`` the mean of their variances.

    Raises
    ------
    DataError
        Fewer than two frames, or frames smaller than 16 pixels.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> scene = np.random.default_rng(0).normal(0.5, 0.1, (128, 128)).cumsum(0).cumsum(1) % 1
    >>> scene = cv2.GaussianBlur(scene, (0, 0), 1.5)
    >>> shifts = [-2, -1, -1, -1, -1, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 2]
    >>> frames = np.stack([np.roll(scene, shift, axis=1) for shift in 3 * shifts])
    >>> np.abs(displacement_variance(frames, noise=1e-4).matrix).round().tolist()
    [[1.0, 0.0], [0.0, 0.0]]
    """
    params = params or CueParams(tile=64, departure=1.0)
    stack = check_frames(frames, at_least=2)
    count = len(stack)
    spectra = _Spectra.of(stack.shape[1:3], params)
    mean, power = np.zeros(stack.shape[1:3]), np.zeros(1)
    for frame in stack:
        grey = luminance(frame)
        mean += grey / np.float64(count)
        power = power + spectra.power(grey) / np.float64(count)
    # This takes the noise of the mean, n²/T, off as well.
    coherent = (spectra.power(mean.astype(np.float32)) - power / count) / (1 - 1 / count)
    return _compare(coherent, power, (0.0, noise), spectra, params)


def frame_blur(frames: ArrayLike, noise: float, params: CueParams | None = None) -> FrameBlur:
    """Blur of every frame in every tile, relative to the other frames: ``log(P_t / P̄) = −s_t k²``.

    Spectra are averaged over rings. The reference P̄ starts as the mean over the frames; as a mean of Gaussians of
    different widths is none, it is then refitted as the spectrum of which the frames are blurred versions. Motion
    does not change a spectrum, so the frames need not be registered, as long as what a tile shows stays in it; where
    structure of another kind moves in and out, errors are up to three times the deviation.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3), at least two
    noise : float
        Standard deviation of the white noise of a frame, intensity. Interpolation smooths noise: for registered
        frames this is an upper bound at high frequency.
    params : CueParams, optional

    Returns
    -------
    FrameBlur

    Raises
    ------
    DataError
        Fewer than two frames, or frames smaller than 16 pixels.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> scene = np.random.default_rng(0).normal(0.5, 0.1, (48, 48)).cumsum(0).cumsum(1).astype(np.float32) % 1
    >>> frames = np.stack([cv2.GaussianBlur(scene, (0, 0), sigma) for sigma in (1.0, 1.414, 1.0)])
    >>> frame_blur(frames, noise=1e-4).extra.ravel().astype(float).round(1).tolist()
    [0.0, 1.0, 0.0]
    """
    return refer_blur(frames, noise, params)[1]


def refer_blur(frames: ArrayLike, noise: float, params: CueParams | None = None) -> tuple[BlurReference, FrameBlur]:
    """Blur of every frame, as :func:`frame_blur` gives it, and the reference that other frames are held against.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3), at least two
    noise : float
        Standard deviation of the white noise of a frame, intensity.
    params : CueParams, optional

    Returns
    -------
    reference : BlurReference
    blur : FrameBlur

    Raises
    ------
    DataError
        Fewer than two frames, or frames smaller than 16 pixels.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    See :func:`blur_against`.
    """
    params = params or CueParams()
    stack = check_frames(frames, at_least=2)
    floor = _floor(noise)
    spectra = _Spectra.of(stack.shape[1:3], params)
    averaging, k2, counts = spectra.cells()
    power = _ring_power(stack, spectra, averaging)
    spectrum, misfit = _common_spectrum(power, floor, k2, counts, spectra, params)
    s, gathered, residual = _score(power, spectrum, misfit, floor, (k2, counts), spectra, params)
    size, offset = residual.mean(axis=0), s.mean(axis=0)
    s = s - offset
    deviation = _deviation(s, gathered, size)
    spread = np.maximum((s**2 - deviation**2).mean(axis=0), 0.0)
    estimate = _posterior(s, deviation, spread)
    least = estimate.min(axis=0)
    reference = BlurReference(spectrum, misfit, size, offset, spread, least, noise, spectra.grid.shape, params)
    return reference, _frame_blur(s, deviation, estimate - least, spectra.grid)


def blur_against(frames: ArrayLike, reference: BlurReference, noise: float | None = None) -> FrameBlur:
    """Blur of frames, or of an image fused from them, relative to the frames of a reference.

    Each is judged by itself, so that frames can come one by one.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3)
        Of the same scene.
    reference : BlurReference
        From :func:`refer_blur`.
    noise : float, optional
        Standard deviation of the white noise of these frames, intensity; by default that of the reference.

    Returns
    -------
    FrameBlur
        ``relative`` to the mean of the frames of the reference, ``extra`` above the sharpest of them, at least 0.

    Raises
    ------
    DataError
        Frames of another size than those of the reference.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> scene = np.random.default_rng(0).normal(0.5, 0.1, (48, 48)).cumsum(0).cumsum(1).astype(np.float32) % 1
    >>> frames = np.stack([cv2.GaussianBlur(scene, (0, 0), sigma) for sigma in (1.0, 1.414, 1.0)])
    >>> reference, _ = refer_blur(frames, noise=1e-4)
    >>> soft = cv2.GaussianBlur(scene, (0, 0), 1.225)
    >>> blur_against(soft[None], reference).extra.ravel().astype(float).round(1).tolist()
    [0.5]
    """
    stack = check_frames(frames)
    if stack.shape[1:3] != reference.shape:
        raise DataError(f"frames: expected the size {reference.shape} of the reference, found {stack.shape[1:3]}")
    floor = _floor(reference.noise if noise is None else noise)
    spectra = _Spectra.of(reference.shape, reference.params)
    averaging, k2, counts = spectra.cells()
    power = _ring_power(stack, spectra, averaging)
    s, gathered, _ = _score(power, reference.spectrum, reference.misfit, floor, (k2, counts), spectra, reference.params)
    s = s - reference.offset
    deviation = _deviation(s, gathered, reference.size)
    estimate = _posterior(s, deviation, reference.spread)
    return _frame_blur(s, deviation, np.maximum(estimate - reference.least, 0.0), spectra.grid)


def tile_map(values: ArrayLike, grid: TileGrid) -> FloatArray:
    """Values of the tiles at every pixel: bilinear between the centres of the tiles, constant beyond.

    Parameters
    ----------
    values : array_like, shape (m, n)
    grid : TileGrid

    Returns
    -------
    ndarray, float32, shape (H, W)

    Examples
    --------
    >>> import numpy as np
    >>> grid = TileGrid(np.array([0]), np.array([0, 2]), (2, 2), (2, 4))
    >>> tile_map([[0.0, 1.0]], grid)[0]
    array([0.  , 0.25, 0.75, 1.  ], dtype=float32)
    """
    tiles = np.asarray(values, np.float32)
    positions = []
    for first, size, length in zip((grid.rows, grid.columns), grid.size, grid.shape, strict=True):
        centres = first + (size - 1) / 2
        positions.append(np.interp(np.arange(length), centres, np.arange(len(first))).astype(np.float32))
    map_y, map_x = np.meshgrid(*positions, indexing="ij")
    return cv2.remap(tiles, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def laplacian_energy(image: ArrayLike, noise: float = 0.0, window: float = 3.0) -> FloatArray:
    """Mean squared Laplacian around every pixel, less what noise adds to it.

    A blur of variance s changes an image u by s/2 Δu to first order: s²/4 times this energy is the squared error.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Colour is reduced to luminance.
    noise : float
        Standard deviation of the white noise in the image, intensity.
    window : float
        Standard deviation of the Gaussian window, pixels.

    Returns
    -------
    ndarray, float32, shape (H, W)
        c, squared intensity over pixels to the fourth.

    Raises
    ------
    ConfigurationError
        The noise is negative, or the window outside 0.5 to 100 pixels.

    Examples
    --------
    >>> import numpy as np
    >>> parabola = np.tile(np.arange(9.0) ** 2 / 2, (9, 1))
    >>> round(float(laplacian_energy(parabola, window=0.5)[4, 4]), 3)
    1.0
    """
    _check_noise(noise)
    require_between("window", window, 0.5, 100, "pixels")
    squared = cv2.Laplacian(luminance(check_image(image)), cv2.CV_32F) ** 2
    # The mask (1, 1, −4, 1, 1) multiplies the variance of white noise by 20.
    smoothed: FloatArray = cv2.GaussianBlur(squared, (0, 0), window)
    return np.maximum(smoothed - 20 * noise**2, 0).astype(np.float32, copy=False)


def fusion_weights(blur: ArrayLike, energy: ArrayLike, noise: float) -> FloatArray:
    """Shares that make squared blur plus noise smallest: min c/4 (Σ w s)² + n² Σ w² with Σ w = 1, w ≥ 0.

    The optimum is ``w_t ∝ max(τ − s_t, 0)``, with τ where ``Σ s_t max(τ − s_t, 0) = 4 n²/c``: sorting and two running
    sums give it exactly. Flat regions average all frames, edges only the sharpest.

    Parameters
    ----------
    blur : array_like, shape (T, ...)
        s, at least 0: blur variance above that of the sharpest frame, squared pixels.
    energy : array_like, shape (...)
        c, from :func:`laplacian_energy`.
    noise : float
        Standard deviation of the noise of a frame, intensity.

    Returns
    -------
    ndarray, float32, shape (T, ...)
        w, sums to 1 over the first axis.

    Raises
    ------
    DataError
        Shapes do not agree, a value is negative or not finite.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    >>> fusion_weights([[0.0, 0.0], [1.0, 1.0]], [0.0, 4.0], noise=1.0)[:, 1].astype(float).round(2).tolist()
    [0.67, 0.33]
    """
    s, c = np.asarray(blur, np.float32), np.asarray(energy, np.float32)
    _check_noise(noise)
    if s.ndim < 1 or s.shape[1:] != c.shape:
        raise DataError(f"energy: expected the shape {s.shape[1:]} of one frame of blur, found {c.shape}")
    if not (np.isfinite(s).all() and np.isfinite(c).all() and s.min() >= 0 and c.min() >= 0):
        raise DataError("blur, energy: expected finite values of 0 or more, found others; subtract the sharpest frame")
    threshold, scale = _waterline(s, c, noise)
    return scale * np.maximum(threshold - s, 0)


def fusion_rule(blur: FrameBlur, energy: ArrayLike, noise: float) -> FusionRule:
    """Fusion weights of a sequence in a form that takes two images instead of one per frame.

    Parameters
    ----------
    blur : FrameBlur
    energy : array_like, shape (H, W)
        c, from :func:`laplacian_energy` of the best image there is.
    noise : float
        Standard deviation of the noise of a frame, intensity.

    Returns
    -------
    FusionRule

    Raises
    ------
    DataError
        The energy has another shape than the frames, is negative or not finite.
    ConfigurationError
        The noise is negative.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.random.default_rng(0).normal(0.5, 0.1, (5, 48, 48)).astype(np.float32)
    >>> rule = fusion_rule(frame_blur(frames, noise=0.1), np.zeros((48, 48)), noise=0.1)
    >>> round(float(frame_weight(rule, 0)[0, 0]), 3)
    0.2
    """
    c = np.asarray(energy, np.float32)
    _check_noise(noise)
    if c.shape != blur.grid.shape:
        raise DataError(f"energy: expected the shape of a frame {blur.grid.shape}, found {c.shape}")
    if not (np.isfinite(c).all() and c.min() >= 0):
        raise DataError("energy: expected finite values of 0 or more, found others")
    s = np.stack([tile_map(frame, blur.grid) for frame in blur.extra])
    strips = [slice(top, top + _STRIP) for top in range(0, len(c), _STRIP)]
    lines = [_waterline(s[:, strip], c[strip], noise) for strip in strips]
    threshold, scale = (np.concatenate(parts) for parts in zip(*lines, strict=True))
    return FusionRule(threshold, scale, blur)


def frame_weight(rule: FusionRule, index: int) -> FloatArray:
    """Share of one frame in every pixel of the fused image.

    Parameters
    ----------
    rule : FusionRule
    index : int
        Which frame.

    Returns
    -------
    ndarray, float32, shape (H, W)
        w, 0 to 1; over all frames it sums to 1.

    Examples
    --------
    See :func:`fusion_rule`.
    """
    return rule.scale * np.maximum(rule.threshold - tile_map(rule.blur.extra[index], rule.blur.grid), 0)


def frame_noise_factor(rule: FusionRule, index: int, largest: float = 100.0) -> FloatArray:
    """Measurement noise of a frame relative to an average one: 1 / (T w), for a filter that weighs by 1 / noise.

    Parameters
    ----------
    rule : FusionRule
    index : int
        Which frame.
    largest : float
        Instead of infinity where the frame gets no share.

    Returns
    -------
    ndarray, float32, shape (H, W)
        Positive; the mean of its inverse over all frames is 1, but for the limit.

    Raises
    ------
    ConfigurationError
        ``largest`` is below 1.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.random.default_rng(0).normal(0.5, 0.1, (5, 48, 48)).astype(np.float32)
    >>> rule = fusion_rule(frame_blur(frames, noise=0.1), np.zeros((48, 48)), noise=0.1)
    >>> round(float(frame_noise_factor(rule, 0)[0, 0]), 2)
    1.0
    """
    return noise_factor(rule, rule.blur.extra[index], largest)


def noise_factor(rule: FusionRule, extra: FloatArray, largest: float = 100.0) -> FloatArray:
    """Measurement noise of a frame that the rule was not made from, as :func:`frame_noise_factor` gives it.

    Parameters
    ----------
    rule : FusionRule
    extra : ndarray, float32, shape (m, n)
        Blur of the frame in every tile, above that of the sharpest frame of the rule, squared pixels.
    largest : float
        Instead of infinity where the frame gets no share.

    Returns
    -------
    ndarray, float32, shape (H, W)

    Raises
    ------
    ConfigurationError
        ``largest`` is below 1.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.random.default_rng(0).normal(0.5, 0.1, (5, 48, 48)).astype(np.float32)
    >>> reference, blur = refer_blur(frames, noise=0.1)
    >>> rule = fusion_rule(blur, np.zeros((48, 48)), noise=0.1)
    >>> round(float(noise_factor(rule, blur_against(frames[:1], reference).extra[0])[0, 0]), 2)
    1.0
    """
    require(largest >= 1, f"largest: expected 1 or more, found {largest}")
    weight = rule.scale * np.maximum(rule.threshold - tile_map(extra, rule.blur.grid), 0)
    return np.reciprocal(np.maximum(len(rule.blur.extra) * weight, np.float32(1 / largest)))


def fuse_frames(frames: ArrayLike, rule: FusionRule) -> FloatArray:
    """Weighted mean of registered frames.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3)
        Registered.
    rule : FusionRule

    Returns
    -------
    ndarray, float32, shape (H, W) or (H, W, 3)

    Raises
    ------
    DataError
        The frames do not fit the rule.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.random.default_rng(0).normal(0.5, 0.1, (5, 48, 48)).astype(np.float32)
    >>> rule = fusion_rule(frame_blur(frames, noise=0.1), np.zeros((48, 48)), noise=0.1)
    >>> bool(np.abs(fuse_frames(frames, rule) - frames.mean(axis=0)).max() < 1e-5)
    True
    """
    stack = check_frames(frames)
    expected = (len(rule.blur.extra), *rule.blur.grid.shape)
    if stack.shape[:3] != expected:
        raise DataError(f"frames: expected shape {expected} as the rule has, found {stack.shape}")
    image = np.zeros(stack.shape[1:], np.float32)
    for index, frame in enumerate(stack):
        weight = frame_weight(rule, index)
        image += (weight[..., None] if frame.ndim == 3 else weight) * frame
    return image


@dataclass(frozen=True, eq=False)
class _Spectra:
    """Power spectra of the windowed tiles of images of one size, at the frequencies that are used."""

    grid: TileGrid
    window: FloatArray
    used: NDArray[np.intp]
    kx: Float64Array
    ky: Float64Array

    @classmethod
    def of(cls, shape: tuple[int, ...], params: CueParams) -> _Spectra:
        if min(shape) < 16:
            raise DataError(f"image: expected at least 16 pixels a side, found shape {tuple(shape)}")
        height, width = (min(int(params.tile), length) for length in shape)
        rows, columns = (_starts(length, size) for length, size in zip(shape, (height, width), strict=True))
        grid = TileGrid(rows, columns, (height, width), (shape[0], shape[1]))
        window = np.outer(_hann(height), _hann(width))
        window /= np.sqrt(np.sum(window**2))
        ky, kx = np.meshgrid(fft.fftfreq(height), fft.rfftfreq(width), indexing="ij")
        radius = np.hypot(kx, ky)
        # Half of the plane says it all: the spectrum of an image is symmetric.
        half = (kx > 0) | (ky > 0)
        inside = half & (radius * min(height, width) >= params.lowest) & (radius <= params.highest)
        used = np.flatnonzero(inside)
        return cls(grid, window.astype(np.float32), used, 2 * np.pi * kx.flat[used], 2 * np.pi * ky.flat[used])

    def power(self, image: FloatArray) -> FloatArray:
        """Spectra of the tiles, shape (tiles, frequencies); white noise of variance 1 gives 1."""
        # The brightness is taken out first: float32 keeps seven digits of it.
        tiles = np.lib.stride_tricks.sliding_window_view(image - image.mean(), self.grid.size)
        tiles = tiles[np.ix_(self.grid.rows, self.grid.columns)].reshape(-1, *self.grid.size)
        spectrum = fft.rfft2(tiles * self.window).reshape(len(tiles), -1)[:, self.used]
        return spectrum.real**2 + spectrum.imag**2

    def cells(self, sectors: int = 1) -> tuple[FloatArray, Float64Array, Float64Array]:
        """Matrix that averages over rings cut into sectors, k² of each, and how many independent values it holds."""
        k = np.hypot(self.kx, self.ky)
        ring = np.rint(k / (2 * np.pi) * min(self.grid.size))
        sector = np.floor(np.arctan2(self.ky, self.kx) / np.pi * sectors) % sectors
        _, cell = np.unique(ring * sectors + sector, return_inverse=True)
        counts = np.bincount(cell).astype(np.float64)
        averaging = np.zeros((len(k), len(counts)), np.float32)
        averaging[np.arange(len(k)), cell] = 1 / counts[cell]
        return averaging, np.bincount(cell, k**2) / counts, np.maximum(counts / _CORRELATED**2, 1.0)

    @property
    def smear(self) -> float:
        """Variance per axis by which the window smears a spectrum, squared radians per pixel."""
        return float(4 / 3 * np.pi**2 / (self.grid.size[0] * self.grid.size[1]))

    def widening(self, powers: list[Float64Array], k2: Float64Array) -> Float64Array:
        """Factor by which k² of an exponent is seen through the window, from two spectra above the noise.

        A smear by a variance δ² per axis turns P into P + δ²/2 ΔP, and the logarithm of a ratio −D k² into
        −D (k² + δ²/2 (4 + 2 k d/dk log P₁P₂)).
        """
        slopes = sum(_log_slope(power, k2) for power in powers)
        return np.clip(1 + self.smear * (2 + slopes) / k2, 0.5, 1.5)


def _compare(
    first: NDArray[np.floating],
    second: NDArray[np.floating],
    noises: tuple[float, float],
    spectra: _Spectra,
    params: CueParams,
) -> RelativeBlur:
    """Fit spectra of tiles, shape (tiles, frequencies), one by one and pooled."""
    floors = (_floor(noises[0]), _floor(noises[1]))
    averaging, k2, _ = spectra.cells()
    one, two = (power.mean(axis=0, keepdims=True) for power in (first, second))
    factor = spectra.widening([(power[0] @ averaging) - n for power, n in zip((one, two), floors, strict=True)], k2)
    kx, ky = spectra.kx, spectra.ky
    spread = factor @ (averaging.T > 0)
    full = np.stack([kx**2, 2 * kx * ky, ky**2], axis=1) * spread[:, None]
    round_ = ((kx**2 + ky**2) * spread)[:, None]
    # Edges in one direction say nothing of blur along them: the signal is to be judged direction by direction.
    sectors = spectra.cells(_SECTORS)[0]
    shape = (len(spectra.grid.rows), len(spectra.grid.columns))
    variance, deviation = _fit(one, two, floors, round_, averaging, len(first), params)
    matrix, matrix_deviation = _fit(one, two, floors, full, sectors, len(first), params)
    tiles, tile_deviation = _fit(first, second, floors, round_, averaging, 1, params)
    matrices, matrix_deviations = _fit(first, second, floors, full, sectors, 1, params)
    return RelativeBlur(
        variance=float(variance[0, 0]),
        deviation=float(deviation[0, 0]),
        matrix=_symmetric(matrix)[0],
        matrix_deviation=_symmetric(matrix_deviation)[0],
        tile_variance=tiles.reshape(shape),
        tile_deviation=tile_deviation.reshape(shape),
        tile_matrix=_symmetric(matrices).reshape(*shape, 2, 2),
        tile_matrix_deviation=_symmetric(matrix_deviations).reshape(*shape, 2, 2),
        grid=spectra.grid,
    )


def _fit(
    first: NDArray[np.floating],
    second: NDArray[np.floating],
    floors: tuple[float, float],
    design: Float64Array,
    averaging: FloatArray,
    tiles: int,
    params: CueParams,
) -> tuple[Float64Array, Float64Array]:
    """D and its standard deviation from spectra (..., frequencies), means over ``tiles``; q = design · D."""
    one, two = first.astype(np.float64) - floors[0], second.astype(np.float64) - floors[1]
    D = np.zeros((*first.shape[:-1], design.shape[1]))
    spread = (averaging.T > 0).astype(np.float64)
    cell_size = np.maximum(spread.sum(axis=1) / _CORRELATED**2, 1.0)
    for _ in range(_STEPS):
        q = np.clip(D @ design.T, -_LARGEST_EXPONENT, _LARGEST_EXPONENT)
        grown, shrunk = one * np.exp(q / 2), two * np.exp(-q / 2)
        cells = (grown @ averaging, shrunk @ averaging, q @ averaging)
        weight, signal = (part @ spread for part in _weight(cells, floors, tiles, cell_size, params))
        information = np.einsum("...b,bi,bj->...ij", weight * signal, design, design)
        information += 1e-9 * np.eye(design.shape[1])
        pull = weight * (shrunk - grown)
        step = np.linalg.solve(information, (pull @ design)[..., None])[..., 0]
        D = D + np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
    scatter = np.einsum("...b,bi,bj->...ij", pull**2, design, design)
    inverse = np.linalg.inv(information)
    # The scatter of few values is itself uncertain, what is expected rests on assumptions: half of each.
    cov = _CORRELATED**2 * (inverse @ scatter @ inverse + inverse) / 2
    variances = np.diagonal(cov, axis1=-2, axis2=-1)
    seen = variances < _NOTHING_SEEN
    return np.where(seen, D, 0.0), np.where(seen, np.sqrt(variances), np.inf)


def _weight(
    cells: tuple[Float64Array, Float64Array, Float64Array],
    floors: tuple[float, float],
    repeats: float | Float64Array,
    cell_size: float | Float64Array,
    params: CueParams,
) -> tuple[Float64Array, Float64Array]:
    """Weight of ``grown − shrunk`` in a fit of q, given all three, and the signal, common to both.

    The weight is the inverse variance of ``log grown − log shrunk`` over the signal. Values are means over
    ``repeats`` independent ones, and the cells over ``cell_size`` such values.
    """
    grown, shrunk, q = cells
    noise_one, noise_two = floors[0] * np.exp(q / 2), floors[1] * np.exp(-q / 2)
    # The image with less noise shows the signal better.
    share = (noise_two + 1e-30) / (noise_one + noise_two + 2e-30)
    error = np.hypot(share * noise_one, (1 - share) * noise_two) / np.sqrt(repeats * cell_size)
    # A cell of noise shows some signal by chance.
    signal = np.maximum(share * grown + (1 - share) * shrunk - 2 * error, 1e-15)
    noise = 2 * signal * (noise_one + noise_two) + noise_one**2 + noise_two**2
    variance = (params.misfit**2 * signal**2 + noise) / repeats + (params.departure * q**2 * signal) ** 2
    return signal / variance, signal


def _ring_power(frames: FloatArray, spectra: _Spectra, averaging: FloatArray) -> Float64Array:
    """Power of frames in rings, shape (T, tiles, rings)."""
    return np.stack([spectra.power(luminance(frame)) @ averaging for frame in frames]).astype(np.float64)


def _common_spectrum(
    power: Float64Array,
    floor: float,
    k2: Float64Array,
    counts: Float64Array,
    spectra: _Spectra,
    params: CueParams,
) -> tuple[Float64Array, Float64Array]:
    """Spectrum that the frames are blurred versions of, and misfit of each ring, from power (T, tiles, rings)."""
    reference = np.maximum(power.mean(axis=0) - floor, 0.0)
    s = np.zeros(power.shape[:2])
    misfit = np.ones(power.shape[1:])
    for _ in range(_ROUNDS - 1):
        design = k2 * spectra.widening(2 * [reference.mean(axis=0)], k2)
        s, _, residual = _fit_frames(power - floor, reference, floor, design, counts, s, misfit, params)
        # The slope of the logarithm of a spectrum, and with it the smear by the window, depends on s itself.
        s = s + 2 * spectra.smear * s**2
        s -= s.mean(axis=0)
        decay = np.exp(-np.clip(s[..., None] * design, -_LARGEST_EXPONENT, _LARGEST_EXPONENT))
        reference = np.maximum(((power - floor) * decay).sum(axis=0) / (decay**2).sum(axis=0), 0.0)
        misfit = np.clip(misfit * residual.mean(axis=0), _SMALLEST_MISFIT, _LARGEST_MISFIT)
    return reference, misfit


def _score(
    power: Float64Array,
    spectrum: Float64Array,
    misfit: Float64Array,
    floor: float,
    rings: tuple[Float64Array, Float64Array],
    spectra: _Spectra,
    params: CueParams,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Fit s, shape (T, tiles), to a known spectrum; also information about s and squared residual of every ring."""
    k2, counts = rings
    design = k2 * spectra.widening(2 * [spectrum.mean(axis=0)], k2)
    s = np.zeros(power.shape[:2])
    for _ in range(2):
        s, information, residual = _fit_frames(power - floor, spectrum, floor, design, counts, s, misfit, params)
    gathered = information * design**2
    leverage = gathered / (gathered.sum(axis=-1, keepdims=True) + 1 / _PRIOR**2)
    return s + 2 * spectra.smear * s**2, gathered, residual / np.maximum(1 - leverage, 0.1)


def _deviation(s: Float64Array, gathered: Float64Array, size: Float64Array) -> Float64Array:
    """Combine what rings say of s, and the mean squared residual of each, to the standard deviation of s."""
    total = gathered.sum(axis=-1) + 1 / _PRIOR**2
    variance = (_CORRELATED * (gathered * np.maximum(size, 1.0)).sum(axis=-1) + 1 / _PRIOR**2) / total**2
    return np.hypot(np.sqrt(variance), _WINDOW_ERROR * s)


def _fit_frames(
    power: Float64Array,
    reference: Float64Array,
    floor: float,
    design: Float64Array,
    counts: Float64Array,
    s: Float64Array,
    misfit: Float64Array,
    params: CueParams,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Fit s to rings above the noise; also information about q and squared residual of every ring.

    The reference is known much better than a frame, so that the signal is taken from it alone.
    """
    for _ in range(_STEPS // 2):
        q = np.clip(s[..., None] * design, -_LARGEST_EXPONENT, _LARGEST_EXPONENT)
        grown, shrunk = power * np.exp(q / 2), reference * np.exp(-q / 2)
        weight, signal = _weight((grown, shrunk, q), (floor, 0.0), counts, 1.0, params)
        weight = weight / misfit
        difference, information = shrunk - grown, weight * signal
        step = ((weight * difference) @ design - s / _PRIOR**2) / (information @ design**2 + 1 / _PRIOR**2)
        s = s + np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
    return s, information, difference**2 * weight / signal


def _posterior(s: Float64Array, deviation: Float64Array, spread: Float64Array) -> Float64Array:
    """Posterior mean of s, whose variance over the frames, ``spread``, is what noise does not explain."""
    return s * spread / np.maximum(spread + deviation**2, 1e-30)


def _frame_blur(s: Float64Array, deviation: Float64Array, extra: Float64Array, grid: TileGrid) -> FrameBlur:
    shape = (len(s), len(grid.rows), len(grid.columns))
    relative, deviations, extras = (part.reshape(shape).astype(np.float32) for part in (s, deviation, extra))
    return FrameBlur(relative, deviations, extras, grid)


def _waterline(s: FloatArray, c: FloatArray, noise: float) -> tuple[FloatArray, FloatArray]:
    """Threshold τ and scale of the weights ``max(τ − s, 0)``.

    ``Σ s max(τ − s, 0)`` is piecewise linear in τ with corners at the s: the last corner below 4 n²/c tells which
    frames take part.
    """
    goal = np.clip(4 * noise**2 / np.maximum(c.astype(np.float64), 1e-12), 1e-12, 1e9)
    ordered = np.sort(s, axis=0).astype(np.float64)
    first, second = np.cumsum(ordered, axis=0), np.cumsum(ordered**2, axis=0)
    taking_part = np.maximum((ordered * first - second < goal).sum(axis=0), 1)
    last = taking_part[None] - 1
    sums, squares = (np.take_along_axis(part, last, axis=0)[0] for part in (first, second))
    threshold = (goal + squares) / np.maximum(sums, 1e-12)
    total = taking_part * threshold - sums
    return threshold.astype(np.float32), (1 / total).astype(np.float32)


def _log_slope(power: Float64Array, k2: Float64Array) -> Float64Array:
    """Logarithmic slope k d/dk of ``log P = a − β log k − v k²``, fitted up to where the signal ends; 0 if nowhere."""
    weak = np.flatnonzero(power <= 1e-4 * power.max(initial=0.0))
    end = weak[0] if len(weak) else len(power)
    if end < 4:
        return np.zeros_like(k2)
    terms = np.stack([np.ones_like(k2), -0.5 * np.log(k2), -k2], axis=1)[:end]
    # Rings hold values in proportion to k.
    weights = k2[:end] ** 0.25
    solution = np.linalg.lstsq(terms * weights[:, None], np.log(power[:end]) * weights, rcond=None)[0]
    return -solution[1] - 2 * solution[2] * k2


def _hann(size: int) -> Float64Array:
    return 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(size) / size)


def _starts(length: int, size: int) -> NDArray[np.intp]:
    count = 1 + int(np.ceil((length - size) / (size / 2)))
    return np.linspace(0, length - size, count).round().astype(np.intp)


def _symmetric(entries: Float64Array) -> Float64Array:
    """(…, 3) as xx, xy, yy to (…, 2, 2)."""
    return entries[..., [[0, 1], [1, 2]]]


def _floor(noise: float) -> float:
    _check_noise(noise)
    return max(noise, _LEAST_NOISE) ** 2


def _check_noise(noise: float) -> None:
    require(np.isfinite(noise) and noise >= 0, f"noise: expected a finite number of 0 or more, found {noise}")
