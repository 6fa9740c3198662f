"""How far a registered frame can be trusted: the measurement noise of the image in the alternating filter.

Symbols
-------
Z : variance of a registered frame about the image (paper 3, eq. 15)
z : sharpness of a frame at a pixel, standardised over the frames; β its weight, ``Z ∝ exp(−β z)``
G : share of the flow outside the model's subspace that is motion and not noise
R : variance of that flow

The paper takes Z to be one number.  Here it falls where a frame is locally sharper than usual, which is the idea of
lucky imaging inside the Kalman gain, and rises where a frame shows something that the others do not, and where its
flow folds or leaves the frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..core.errors import DataError
from ..registration.warp import inside, mirror, strips, warp
from ..runtime.jit import compiled
from ..runtime.scratch import iter_frames
from ..runtime.threads import map_ahead, sum_in_threads

# Smallest variance, so that noise-free synthetic data keep every gain defined: (1/4096 of full scale)².
_IMAGE_NOISE_FLOOR = 6e-8
# Standardised sharpness beyond this is an outlier, not a better frame.
LARGEST_SCORE = 3.0
# Most that sharpness and folds together raise the logarithm of Z by.  Z is then beyond any variance of the image, and
# times the largest excess of deviation still a number in single precision.
LARGEST_EXPONENT = 40.0
# Sharpness that differs by less than this share is not worth averaging fewer frames.
_LEAST_SPREAD = 0.03
# Z is so many times larger where a map folds.
LOG_DISTRUST = np.log(np.float32(1e3))
# Pixels around a fold that are lost with it, on each side, and standard deviation of how that fades.
AROUND_FOLD, FOLD_FADE = 3, 2.0
# A frame that deviates from the usual by more than this many variances shows something that is not the scene.
OUTLIER, OUTLIER_WINDOW = 6.0, 3.0
# Share of the mean variance that every pixel varies by at least.
_LEAST_DEVIATION = 0.1
# Variance of a Sobel derivative (divided by 8) of white noise of unit variance, and the pixels it correlates over.
_SOBEL_NOISE, _SOBEL_AREA = 12 / 64, 3.0


@dataclass(frozen=True)
class FrameNoise:
    """What a block of registered frames says of all frames.

    Attributes
    ----------
    image_noise : float
        Z before sharpness, squared intensity.
    template : tuple of two ndarrays, float32, shape (H, W)
        Gradient of the image that the frames are registered to, along x and y, intensity per pixel.
    template_energy : float
        Sum of its square.
    usual : ndarray, float32, shape (H, W)
        Mean sharpness over the frames.
    score_scale : ndarray, float32, shape (H, W)
        Factor from a deviation of the sharpness to z.
    score_variance : ndarray, float32, shape (H, W)
        Variance of z over the frames.
    motion_share : ndarray, float32, shape (H, W)
        G, 0 to 1.
    window : float
        Standard deviation of the window in which sharpness is measured, pixels.
    usual_frame : ndarray, float32, shape (H, W)
        Mean of the registered frames, without what deviates from the rest.
    deviation : ndarray, float32, shape (H, W)
        Variance of the registered frames about it, locally averaged, squared intensity.
    """

    image_noise: float
    template: tuple[FloatArray, FloatArray]
    template_energy: float
    usual: FloatArray
    score_scale: FloatArray
    score_variance: FloatArray
    motion_share: FloatArray
    window: float
    usual_frame: FloatArray
    deviation: FloatArray


def measure_frame_noise(
    frames: list[FloatArray],
    flows: FloatArray,
    image: FloatArray,
    residual_variance: FloatArray,
    window: float = 3.0,
    image_noise: float | None = None,
    threads: int = 0,
) -> FrameNoise:
    """Temporal statistics of frames registered by their flows.

    Parameters
    ----------
    frames : list of ndarray, float32, shape (H, W) or (H, W, 3)
    flows : ndarray, float32, shape (T, H, W, 2)
        From the image to each frame, pixels.
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        What the frames are registered to.
    residual_variance : ndarray, shape (H, W)
        R, squared pixels.
    window : float
        Standard deviation of the window in which sharpness is measured, pixels.
    image_noise : float, optional
        Z, squared intensity; by default the mean temporal variance of the registered frames.
    threads : int
        Frames warped side by side; 0 means one per available core.

    Returns
    -------
    FrameNoise

    Raises
    ------
    DataError
        Shapes do not agree.

    Examples
    --------
    >>> import numpy as np
    >>> frames = list(np.random.default_rng(0).normal(0.5, 0.1, (50, 16, 16)).astype(np.float32))
    >>> still = np.zeros((50, 16, 16, 2), np.float32)
    >>> model = measure_frame_noise(frames, still, np.full((16, 16), 0.5, np.float32), np.ones((16, 16), np.float32))
    >>> round(model.image_noise, 3)
    0.01
    """
    if residual_variance.shape != image.shape[:2]:
        raise DataError(f"residual_variance: expected shape {image.shape[:2]}, found {residual_variance.shape}")
    template = _gradient(luminance(image))

    def measure(batch: list[tuple[FloatArray, FloatArray]]) -> tuple[np.ndarray, ...]:
        sums = tuple(np.zeros(image.shape[:2]) for _ in range(4))
        for pair in batch:
            registered = luminance(warp(*pair))
            _add_moments(registered, *sums[:2])
            _add_moments(_smooth(_product(registered, template), window), *sums[2:])
        return sums

    pairs, count = zip(iter_frames(frames), iter_frames(flows), strict=True), len(frames)
    mean, variance, usual, spread = sum_in_threads(measure, pairs, threads)

    def average(rows: slice) -> None:
        for total, squares in ((mean, variance), (usual, spread)):
            total[rows] /= count
            squares[rows] = np.maximum(squares[rows] / count - total[rows] ** 2, 0.0)
        variance[rows] *= count / max(count - 1, 1)

    _in_strips(average, variance.shape, threads)
    # The flattest fifth of the image varies by sensor noise alone; elsewhere blur and misregistration add to it.
    square = template[0] ** 2 + template[1] ** 2
    energy = _smooth(square, window)
    usual_frame, deviation = _without_outliers(frames, flows, mean, variance, threads)
    sensor_noise = float(variance[energy <= np.quantile(energy, 0.2)].mean())
    scale, score_variance, motion_share = (np.empty(energy.shape, np.float32) for _ in range(3))

    def scores(rows: slice) -> None:
        explained = energy[rows] * _SOBEL_NOISE * sensor_noise
        scale[rows] = _score_scale(usual[rows], spread[rows], explained, window)
        score_variance[rows] = scale[rows] ** 2 * spread[rows]
        motion_share[rows] = _motion_share(energy[rows], sensor_noise, residual_variance[rows], window)

    _in_strips(scores, energy.shape, threads)
    return FrameNoise(
        image_noise=max(float(variance.mean()) if image_noise is None else image_noise, _IMAGE_NOISE_FLOOR),
        template=template,
        template_energy=float(square.sum(dtype=np.float64)),
        usual=usual.astype(np.float32),
        score_scale=scale,
        score_variance=score_variance,
        motion_share=motion_share,
        window=window,
        usual_frame=usual_frame,
        deviation=deviation,
    )


def judge_frame(
    registered: FloatArray, flow: FloatArray, model: FrameNoise, sharpness: float
) -> tuple[float | FloatArray, float]:
    """Z of one frame, and how sharp it is.

    Z is lower where the frame is sharper than usual, higher where it shows something else or its flow errs.  A frame
    shows something else, a bird or a flash, where it deviates from the usual by far more than frames do; its flow errs
    where it folds or leaves the frame.

    Parameters
    ----------
    registered : ndarray, float32, shape (H, W) or (H, W, 3)
        The frame, warped onto the image.
    flow : ndarray, float32, shape (H, W, 2)
        The flow it was warped by, pixels.
    model : FrameNoise
    sharpness : float
        β; 0 gives the same Z for every frame and pixel, as in the paper.

    Returns
    -------
    noise : float or ndarray, float32, shape (H, W)
        Squared intensity.
    sharpness : float
        Gradient of the frame projected on that of the image the model was measured with: 1 for the image itself, less
        for a blurred, torn or misregistered frame.

    Examples
    --------
    >>> import numpy as np
    >>> image = np.tile(np.sin(np.arange(16.0)), (16, 1)).astype(np.float32)
    >>> still = np.zeros((2, 16, 16, 2), np.float32)
    >>> model = measure_frame_noise([image, image], still, image, np.ones((16, 16), np.float32))
    >>> noise, sharp = judge_frame(0.5 * image, still[0], model, sharpness=0.0)
    >>> noise == model.image_noise, round(sharp, 3)
    (True, 0.5)
    """
    grey = luminance(registered)
    product = _product(grey, model.template)
    # Sums and norms of OpenCV depend on where an array lies in memory, in the last bit.
    sharp = float(product.sum(dtype=np.float64)) / max(model.template_energy, 1e-12)
    if sharpness == 0:
        return model.image_noise, sharp
    noise = _deviates(grey, model.usual_frame, model.deviation)
    _weigh(noise, _smooth(product, model.window), _lost(flow), model, sharpness)
    return noise, sharp


def _add_moments(plane: FloatArray, total: np.ndarray, squares: np.ndarray) -> None:
    cv2.accumulate(plane, total)
    cv2.accumulateSquare(plane, squares)


def _weigh(noise: FloatArray, seen: FloatArray, lost: FloatArray, model: FrameNoise, sharpness: float) -> None:
    """Turn the deviation of a frame into its Z, in place, by its local sharpness ``seen`` and where it is lost."""
    usual, scale, variance = model.usual, model.score_scale, model.score_variance
    weigh = compiled(weigh_pixels)
    if weigh is not None:
        beta, image_noise = np.float32(sharpness), np.float32(model.image_noise)
        # What was lost becomes the exponent.
        weigh(beta, image_noise, *(plane.ravel() for plane in (seen, usual, scale, variance, noise, lost)))
        noise *= np.exp(lost, out=lost)
        return
    for rows in strips(noise.shape):
        excess = np.maximum(noise[rows] / OUTLIER, 1)
        squared = excess * excess
        exponent = lost[rows] * LOG_DISTRUST
        exponent += _exponent(seen[rows], squared, model, rows, sharpness)
        np.minimum(exponent, LARGEST_EXPONENT, out=exponent)
        # The third power: what deviates twice as much as is tolerated counts an eighth.
        excess *= squared
        excess *= np.float32(model.image_noise)
        np.multiply(excess, np.exp(exponent, out=exponent), out=noise[rows])


def weigh_pixels(
    beta: np.float32,
    image_noise: np.float32,
    seen: FloatArray,
    usual: FloatArray,
    scale: FloatArray,
    variance: FloatArray,
    noise: FloatArray,
    lost: FloatArray,
) -> None:
    """Z of each pixel without its exponential factor, and the exponent of that; to be compiled.

    Parameters
    ----------
    beta, image_noise : float32
        β, and Z before sharpness.
    seen, usual, scale, variance : ndarray, float32, shape (P,)
        Sharpness, and what is usual; see :class:`FrameNoise`.
    noise : ndarray, float32, shape (P,)
        Squared deviation in units of the usual one; becomes Z.
    lost : ndarray, float32, shape (P,)
        1 where the flow errs; becomes the exponent.

    Examples
    --------
    >>> one, lost = np.ones(1, np.float32), np.zeros(1, np.float32)
    >>> noise = np.array([12.0], np.float32)
    >>> weigh_pixels(np.float32(0.5), np.float32(0.1), 3 * one, one, one, 0 * one, noise, lost)
    >>> noise, lost
    (array([0.8], dtype=float32), array([-0.25], dtype=float32))
    """
    one, outlier, largest = np.float32(1), np.float32(OUTLIER), np.float32(LARGEST_SCORE)
    balance, distrust, most = np.float32(0.5) * beta * beta, np.float32(LOG_DISTRUST), np.float32(LARGEST_EXPONENT)
    for pixel in range(noise.size):
        excess = max(noise[pixel] / outlier, one)
        score = min(max((seen[pixel] - usual[pixel]) * scale[pixel], -largest), largest)
        if score > 0:
            score /= excess * excess
        exponent = balance * variance[pixel] - beta * score + distrust * lost[pixel]
        lost[pixel] = min(exponent, most)
        noise[pixel] = excess * excess * excess * image_noise


def _exponent(seen: FloatArray, excess: FloatArray, model: FrameNoise, rows: slice, sharpness: float) -> FloatArray:
    """Logarithm of the factor on Z by which a frame of the local sharpness ``seen`` differs."""
    score = seen - model.usual[rows]
    score *= model.score_scale[rows]
    np.clip(score, -LARGEST_SCORE, LARGEST_SCORE, out=score)
    # What is not the scene may well have more contrast than the scene.
    better = np.maximum(score, 0)
    better /= excess
    score = np.minimum(score, 0, out=score)
    score += better
    # For a normal score of variance s² the mean of exp(β z − β² s² / 2) is one: the information per frame stays 1/Z.
    score *= np.float32(-sharpness)
    score += np.float32(0.5 * sharpness**2) * model.score_variance[rows]
    return score


def _without_outliers(
    frames: list[FloatArray], flows: FloatArray, mean: np.ndarray, variance: np.ndarray, threads: int
) -> tuple[FloatArray, FloatArray]:
    """Mean of the registered frames and their variance about it, once what deviates from all of them is left out."""

    def trim(pairs: list[tuple[FloatArray, FloatArray]]) -> tuple[np.ndarray, ...]:
        counted, total, squares = (np.zeros(mean.shape) for _ in range(3))
        for frame, flow in pairs:
            registered = luminance(warp(frame, flow))
            kept = (_deviates(registered, centre, spread) <= OUTLIER).view(np.uint8)
            cv2.accumulate(kept, counted)
            cv2.accumulate(registered, total, kept)
            cv2.accumulateSquare(registered - centre, squares, kept)
        return counted, total, squares

    centre, spread = mean.astype(np.float32), _deviation(variance)
    counted, total, squares = sum_in_threads(trim, zip(iter_frames(frames), iter_frames(flows), strict=True), threads)
    usual = np.empty_like(centre)

    def average(rows: slice) -> None:
        some = np.maximum(counted[rows], 1)
        trimmed = np.where(counted[rows] > 0, total[rows] / some, mean[rows])
        squares[rows] = np.maximum(squares[rows] / some - (trimmed - centre[rows]) ** 2, 0.0)
        usual[rows] = trimmed

    _in_strips(average, usual.shape, threads)
    return usual, _deviation(squares)


def _in_strips(work: Callable[[slice], None], shape: tuple[int, ...], threads: int) -> None:
    """Work on images of this shape in strips of rows, side by side where there is more than one."""
    parts = list(strips(shape))
    for _ in map_ahead(work, parts, threads) if len(parts) > 1 else map(work, parts):
        pass


def _deviation(variance: np.ndarray) -> FloatArray:
    floor = max(_LEAST_DEVIATION * float(variance.mean()), _IMAGE_NOISE_FLOOR)
    return _smooth(variance.astype(np.float32), OUTLIER_WINDOW) + np.float32(floor)


def _deviates(registered: FloatArray, usual: FloatArray, deviation: FloatArray) -> FloatArray:
    """Squared deviation of a frame in units of the usual one; about 1 for most."""
    difference = registered - usual
    difference *= difference
    difference = _smooth(difference, OUTLIER_WINDOW)
    difference /= deviation
    return difference


def _lost(flow: FloatArray) -> FloatArray:
    """1 where the map id + Ŵ folds, and where it leaves the frame; fading to 0 around it.

    Beyond the frame its border is repeated, which is no measurement.  Paper 3 takes the maps to be diffeomorphisms:
    where the estimate is none, the flow has lost its way, and what it brings there may have more contrast than the
    scene.
    """
    lost = inside(flow)
    np.subtract(1, lost, out=lost)
    folded = _folded(flow)
    if not folded.any():
        return lost
    # Faded out: an abrupt change of weights would show as an edge.
    side = 2 * AROUND_FOLD + 1
    around = cv2.dilate(folded.view(np.uint8), np.ones((side, side), np.uint8))
    fade = _smooth(around.astype(np.float32), FOLD_FADE)
    return np.maximum(fade, lost, out=lost)


def _folded(flow: FloatArray) -> NDArray[np.bool_]:
    """Where the map id + Ŵ has a Jacobian of zero or less."""
    mark = compiled(mark_folds)
    if mark is None:
        return np.concatenate([_folded_strip(flow, rows) for rows in strips(flow.shape)])
    folded = np.empty(flow.shape[:2], np.bool_)
    mark(mirror(flow, 1, 1), folded)
    return folded


def mark_folds(flow: FloatArray, folded: NDArray[np.bool_]) -> None:
    """Find where a map has a Jacobian of zero or less, by Sobel's derivatives; to be compiled.

    Parameters
    ----------
    flow : ndarray, float32, shape (H + 2, W + 2, 2)
        Pixels, with a border of one.
    folded : ndarray, bool, shape (H, W)
        Filled.

    Examples
    --------
    >>> flow, folded = np.zeros((3, 6, 2), np.float32), np.empty((1, 4), bool)
    >>> flow[..., 0] = [0, 0, 0, -3, -3, -3]
    >>> mark_folds(flow, folded)
    >>> folded[0].tolist()
    [False, True, True, False]
    """
    two, eight = np.float32(2), np.float32(8)
    for row in range(folded.shape[0]):
        above, level, below = flow[row], flow[row + 1], flow[row + 2]
        for column in range(folded.shape[1]):
            ux = above[column + 2, 0] - above[column, 0] + two * (level[column + 2, 0] - level[column, 0])
            vx = above[column + 2, 1] - above[column, 1] + two * (level[column + 2, 1] - level[column, 1])
            uy = below[column, 0] - above[column, 0] + two * (below[column + 1, 0] - above[column + 1, 0])
            vy = below[column, 1] - above[column, 1] + two * (below[column + 1, 1] - above[column + 1, 1])
            ux += below[column + 2, 0] - below[column, 0]
            vx += below[column + 2, 1] - below[column, 1]
            uy += below[column + 2, 0] - above[column + 2, 0]
            vy += below[column + 2, 1] - above[column + 2, 1]
            folded[row, column] = (eight + ux) * (eight + vy) <= uy * vx


def _folded_strip(flow: FloatArray, rows: slice) -> NDArray[np.bool_]:
    start, stop = max(rows.start - 1, 0), rows.stop + 1
    inner = slice(rows.start - start, rows.stop - start)
    (ux, uy), (vx, vy) = (_gradient(plane) for plane in cv2.split(flow[start:stop]))
    ux += 1
    vy += 1
    ux *= vy
    uy *= vx
    return ux[inner] <= uy[inner]


def _score_scale(usual: np.ndarray, spread: np.ndarray, noise: np.ndarray, window: float) -> FloatArray:
    """Factor from a deviation of the sharpness to the best estimate of its standardised noise-free part.

    Noise of the gradient, projected on the template, explains ``noise`` over the number of independent pixels in the
    window of the variance ``spread``; what is left is sharpness.
    """
    explained = noise / (4 * np.pi * window**2 / _SOBEL_AREA)
    deviation = np.sqrt(np.maximum(spread - explained, 0.0))
    return (deviation / np.maximum(spread + (_LEAST_SPREAD * usual) ** 2, 1e-18)).astype(np.float32)


def _motion_share(energy: FloatArray, noise: float, residual_variance: np.ndarray, window: float) -> FloatArray:
    """G = R_motion / (R_motion + R_noise), with R_noise the Cramér–Rao bound of a shift seen through the window.

    A shift of a patch with gradients ∇ρ in noise of variance σ² cannot be measured better than
    σ² / (½ Σ |∇ρ|²) per axis; what the residual varies beyond that is motion.
    """
    area = 4 * np.pi * window**2
    noise_variance = noise / np.maximum(area * 0.5 * energy, 1e-12)
    total = np.maximum(residual_variance, 0.0)
    return (1.0 - np.minimum(noise_variance / np.maximum(total, 1e-12), 1.0)).astype(np.float32)


def _product(registered: FloatArray, template: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Gradient of a frame projected on that of the template; in a Gaussian window this is sharpness.

    A blurred frame has a smaller projection.  So has one that is torn, misregistered or covered, though its gradient
    may be large: plain gradient energy would prefer it.  And noise, being linear here, does not add up.
    """
    dx, dy = _gradient(registered)
    dx *= template[0]
    dy *= template[1]
    dx += dy
    return dx


def _gradient(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    return cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8)


def _smooth(image: FloatArray, window: float) -> FloatArray:
    return cv2.GaussianBlur(image, (0, 0), window)
