"""Alternating-estimation Kalman filter over the image and the state of its flow (paper 3, section 4).

Symbols
-------
ρ, Σ : image and its variance per pixel; S drift of the image, Z noise of a registered frame (eqs. 13a, 15)
ξ, P : state of the flow and its covariance; A, C, Q, R from :mod:`turbrestore.dynamics` (eqs. 10, 13b)
W^meas : measured flow (eq. 17); Ŵ estimated flow
L, M : gains of the image (eq. 16) and of the flow state (eq. 19)
G : share of the flow outside the subspace of C that is motion and not noise
β : weight of sharpness

Given Ŵ the image is a linear state, given ρ the flow is, so each frame updates one after the other:

1. predict ρ and ξ (eq. 14);
2. measure W^meas from the image to the frame and update ξ (eqs. 17, 19);
3. warp the frame by Ŵ and update ρ (eqs. 15, 16);
4. return to 2 with the new image, ``inner_iterations`` times in all.

Departures from the paper, each with its reason:

* The flow outside the subspace is kept (``residual="keep"``): by eq. 10 the flow is ``C ξ + r``, and where r is
  motion its mean is ``Ŵ = C ξ̂ + G (W^meas − C ξ̂)``.  With ``Ŵ = C ξ̂`` alone (``"drop"``, as printed) that motion
  stays in the frames and blurs the image, below the centroid that the filter starts from.
* Frames are handled in blocks: their flows are measured against the image before the block, side by side, and the
  inner iteration repeats the block from the same prior.  A block of one frame is the paper's scheme, except that the
  image the flow is first measured from does not contain the frame itself.
* Every inner iteration starts from the prediction, not from its own result, so a frame counts once; on a linear
  model the iteration then changes nothing.
* Z may vary from pixel to pixel: it falls where a frame is locally sharper than usual, by ``exp(−β z)`` with z the
  standardised local sharpness, the gradient of the frame projected on that of the reference; and it rises where the
  flow folds, which a diffeomorphism does not.  β = 0 is the paper's scalar gain.
* The image starts from a diffuse prior (``prior_frames=0``) and takes the training frames in first; the paper starts
  from the centroid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from .arrays import FloatArray, check_flow, check_image, luminance
from .dynamics import FlowDynamics, flow_of
from .errors import DataError, require, require_between
from .flow import FlowParams, iterate_flows
from .kalman import Gaussian, PixelGaussian, predict, predict_pixels, update_information, update_pixels
from .parallel import map_ahead, one_thread_each
from .warp import warp

RESIDUALS = ("keep", "drop")
# Variance of an image nothing is known of: full scale, squared.
_DIFFUSE = 1.0
# Smallest variances, so that noise-free synthetic data keep every gain defined: (1/4096 of full scale)², (0.001 px)².
_IMAGE_NOISE_FLOOR = 6e-8
_FLOW_NOISE_FLOOR = 1e-6
# Standardised sharpness beyond this is an outlier, not a better frame.
_LARGEST_SCORE = 3.0
# Sharpness that differs by less than this share is not worth averaging fewer frames.
_LEAST_SPREAD = 0.03
# Z is so many times larger where a map folds.
_DISTRUST = 1e3
# Variance of a Sobel derivative (divided by 8) of white noise of unit variance, and the pixels it correlates over.
_SOBEL_NOISE, _SOBEL_AREA = 12 / 64, 3.0


@dataclass(frozen=True)
class FilterParams:
    """How frames are filtered.

    Parameters
    ----------
    residual : {"keep", "drop"}
        What becomes of measured flow outside the subspace of the flow model; ``"drop"`` is the paper as printed.
    inner_iterations : int
        Times that flow is measured, and image and flow updated, for each block of frames.
    block : int
        Frames whose flows are measured against the same image; 1 follows the paper, more run side by side.
    sharpness : float
        β: how strongly locally sharp frames are preferred; 0 gives every frame the same scalar gain.
    sharpness_window : float
        Standard deviation of the window in which sharpness is measured, pixels.
    image_noise : float, optional
        Z: variance of a registered frame about the image, squared intensity; by default measured on the first block.
    image_drift : float
        S: variance by which the image may drift from one frame to the next, squared intensity.
    prior_frames : float
        How many frames' worth of information the starting image carries; 0 lets the first frames replace it.
    """

    residual: Literal["keep", "drop"] = "keep"
    inner_iterations: int = 2
    block: int = 8
    sharpness: float = 2.0
    sharpness_window: float = 3.0
    image_noise: float | None = None
    image_drift: float = 0.0
    prior_frames: float = 0.0

    def __post_init__(self) -> None:
        require(
            self.residual in RESIDUALS,
            f"residual: expected one of {', '.join(RESIDUALS)}, found {self.residual!r}",
        )
        require_between("inner_iterations", self.inner_iterations, 1, 100)
        require_between("block", self.block, 1, 10_000, "frames")
        require_between("sharpness", self.sharpness, 0, 10)
        require_between("sharpness_window", self.sharpness_window, 0.3, 100, "pixels")
        if self.image_noise is not None:
            require_between("image_noise", self.image_noise, 1e-12, 1)
        require_between("image_drift", self.image_drift, 0, 1)
        require_between("prior_frames", self.prior_frames, 0, 1e6)


@dataclass(frozen=True)
class FilterState:
    """What the filter knows between two frames.

    Attributes
    ----------
    image : PixelGaussian
        ρ̂ and Σ.
    flow : Gaussian
        ξ̂ and P.
    """

    image: PixelGaussian
    flow: Gaussian


@dataclass(frozen=True)
class Filtered:
    """The filtered image and the record of the run.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        ρ̂ after the last frame, still blurred by Kρ.
    variance : ndarray, float32, shape (H, W)
        Σ after the last frame, squared intensity.
    flow_states : ndarray, float64, shape (N, n)
        ξ̂ after each frame.
    gains : ndarray, float64, shape (N,)
        L of each frame, mean over the pixels.
    innovations : ndarray, float64, shape (N,)
        Root mean square of W^meas − W̄ − C A ξ̂ for each frame, pixels: what the prediction did not foresee.
    image_noise : float
        Z, squared intensity.
    motion_share : float
        G, mean over the pixels; 0 with ``residual="drop"``.
    """

    image: FloatArray
    variance: FloatArray
    flow_states: np.ndarray
    gains: np.ndarray
    innovations: np.ndarray
    image_noise: float
    motion_share: float


@dataclass(frozen=True)
class _NoiseModel:
    """What the first block says of the frames.

    Z, the gradient of the starting image, the usual sharpness per pixel, the factor that turns a deviation from it
    into a score, the variance of that score over the frames, and G.
    """

    image_noise: float
    template: tuple[FloatArray, FloatArray]
    usual: FloatArray
    score_scale: FloatArray
    score_variance: FloatArray
    motion_share: FloatArray


@dataclass(frozen=True)
class _Setting:
    """What stays the same from frame to frame."""

    dynamics: FlowDynamics
    model: _NoiseModel
    params: FilterParams
    flow_params: FlowParams
    progress: Callable[[int], None] | None


@dataclass(frozen=True)
class _Motion:
    """One frame with its measured flow, the flow state after it, and the innovation."""

    frame: FloatArray
    measured: FloatArray
    state: Gaussian
    innovation: float


@dataclass(frozen=True)
class _Record:
    flow_state: np.ndarray
    gain: float
    innovation: float


def filter_frames(
    frames: Iterable[ArrayLike],
    reference: ArrayLike,
    dynamics: FlowDynamics,
    params: FilterParams | None = None,
    flow_params: FlowParams | None = None,
    known_flows: ArrayLike | None = None,
    progress: Callable[[int], None] | None = None,
) -> Filtered:
    """Run the alternating-estimation filter over ``frames``.

    Memory is bounded by the first block (as many frames as there are known flows) and does not grow with the number
    of frames.

    Parameters
    ----------
    frames : iterable of array_like, shape (H, W) or (H, W, 3)
        Consumed lazily, once.
    reference : array_like, shape (H, W) or (H, W, 3)
        Image to start from, usually the centroid.
    dynamics : FlowDynamics
        Model of the flow, identified on flows from ``reference``.
    params : FilterParams, optional
        Settings of the filter.
    flow_params : FlowParams, optional
        How flow is measured.
    known_flows : array_like, shape (K, H, W, 2), optional
        Flows already measured from ``reference`` to the first K frames, pixels; they form the first block.
    progress : callable, optional
        Called with 1 after each measured flow.

    Returns
    -------
    Filtered

    Raises
    ------
    DataError
        No frames, fewer frames than known flows, shapes that do not agree, or values that are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.centroid import find_centroid
    >>> from turbrestore.dynamics import identify
    >>> y, x = np.mgrid[:48, :48]
    >>> frames = [0.5 + 0.2 * np.sin((x + np.sin(k)) / 3.0) * np.cos(y / 4.0) for k in range(6)]
    >>> centroid = find_centroid(np.array(frames, np.float32))
    >>> filtered = filter_frames(frames, centroid.image, identify(centroid.flows), known_flows=centroid.flows)
    >>> filtered.image.shape, len(filtered.gains)
    ((48, 48), 6)
    """
    params, flow_params = params or FilterParams(), flow_params or FlowParams()
    image = check_image(reference, "reference")
    if image.shape[:2] != dynamics.shape:
        raise DataError(f"dynamics: expected flows of {image.shape[:2]} pixels, found {dynamics.shape}")
    flows = None if known_flows is None else check_flow(known_flows, "known_flows")
    if flows is not None and (flows.ndim != 4 or flows.shape[1:3] != dynamics.shape):
        raise DataError(f"known_flows: expected shape (K, {image.shape[0]}, {image.shape[1]}, 2), found {flows.shape}")
    stream = _checked(frames, image.shape)
    first = list(islice(stream, params.block if flows is None else len(flows)))
    if not first or (flows is not None and len(first) < len(flows)):
        wanted = 1 if flows is None else len(flows)
        raise DataError(f"frames: expected at least {wanted}, found {len(first)}")
    if flows is None:
        flows = np.stack([flow for _, flow in iterate_flows(image, first, flow_params)])
    model = _noise_model(first, flows, image, dynamics, params, flow_params.threads)
    prior_variance = model.image_noise / params.prior_frames if params.prior_frames else _DIFFUSE
    state = FilterState(
        PixelGaussian(image, np.full(image.shape[:2], prior_variance, np.float32)),
        Gaussian(np.zeros(dynamics.rank), dynamics.state_covariance),
    )
    setting = _Setting(dynamics, model, params, flow_params, progress)
    with one_thread_each():
        state, records = _filter_block(state, first, flows, setting)
        while block := list(islice(stream, params.block)):
            state, done = _filter_block(state, block, None, setting)
            records += done
    return Filtered(
        image=state.image.mean.astype(np.float32),
        variance=state.image.variance.astype(np.float32),
        flow_states=np.array([record.flow_state for record in records]),
        gains=np.array([record.gain for record in records]),
        innovations=np.array([record.innovation for record in records]),
        image_noise=model.image_noise,
        motion_share=float(model.motion_share.mean()),
    )


def _checked(frames: Iterable[ArrayLike], shape: tuple[int, ...]) -> Iterator[FloatArray]:
    for index, frame in enumerate(frames):
        image = check_image(frame, f"frame {index}")
        if image.shape != shape:
            raise DataError(f"frame {index}: expected shape {shape} as the reference has, found {image.shape}")
        yield image


def _filter_block(
    prior: FilterState, frames: list[FloatArray], known: FloatArray | None, setting: _Setting
) -> tuple[FilterState, list[_Record]]:
    """Inner iterations over one block, each from the same prior with flows measured from the newest image."""
    state, records = prior, list[_Record]()
    for iteration in range(setting.params.inner_iterations):
        if iteration == 0 and known is not None:
            state, records = _filter_pass(prior, zip(frames, known, strict=True), setting)
        else:
            state, records = _filter_pass(prior, _measure(state.image.mean, frames, setting), setting)
    return state, records


def _filter_pass(
    prior: FilterState, pairs: Iterable[tuple[FloatArray, FloatArray]], setting: _Setting
) -> tuple[FilterState, list[_Record]]:
    """Update the flow state and the image by each frame and its flow (eqs. 14 to 19)."""
    image, flow, drift = prior.image, prior.flow, setting.params.image_drift
    records: list[_Record] = []
    motions = _update_motion(prior.flow, pairs, setting.dynamics)
    for motion, (registered, noise) in map_ahead(partial(_register, setting), motions, setting.flow_params.threads):
        flow = motion.state
        image, gain = update_pixels(predict_pixels(image, drift) if drift else image, registered, noise)
        records.append(_Record(flow.mean, float(gain.mean()), motion.innovation))
    return FilterState(image, flow), records


def _measure(image: np.ndarray, frames: list[FloatArray], setting: _Setting) -> Iterator[tuple[FloatArray, FloatArray]]:
    for pair in iterate_flows(image, frames, setting.flow_params):
        if setting.progress is not None:
            setting.progress(1)
        yield pair


def _update_motion(
    prior: Gaussian, pairs: Iterable[tuple[FloatArray, FloatArray]], dynamics: FlowDynamics
) -> Iterator[_Motion]:
    """Prediction and update of ξ for each frame (eqs. 14b, 14d, 17, 19).

    It needs no image, so that frames can be warped side by side afterwards.
    """
    state, noise = prior, max(dynamics.R, _FLOW_NOISE_FLOOR)
    for frame, measured in pairs:
        prediction = predict(state, dynamics.A, dynamics.Q)
        deviation = (measured - dynamics.mean_flow).reshape(-1)
        state, _ = update_information(prediction, deviation, dynamics.C, noise, orthonormal=True)
        unforeseen = measured - flow_of(dynamics, prediction.mean)
        yield _Motion(frame, measured, state, float(np.sqrt(np.mean(np.square(unforeseen)))))


def _register(setting: _Setting, motion: _Motion) -> tuple[FloatArray, float | FloatArray]:
    """Frame on the image by Ŵ, and its noise Z (eq. 15)."""
    modelled = flow_of(setting.dynamics, motion.state.mean)
    share = setting.model.motion_share[..., None]
    estimate = modelled + share * (motion.measured - modelled)
    registered = warp(motion.frame, estimate)
    return registered, _frame_noise(registered, estimate, setting.model, setting.params)


def _distrust(flow: FloatArray) -> FloatArray:
    """Factor on Z: large where the map id + Ŵ folds.

    Paper 3 takes the maps to be diffeomorphisms.  Where the estimate is none, the flow has lost its way, and what it
    brings there may have more contrast than the scene.
    """
    (ux, uy), (vx, vy) = (
        (cv2.Sobel(part, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(part, cv2.CV_32F, 0, 1, scale=1 / 8))
        for part in (np.ascontiguousarray(flow[..., 0]), np.ascontiguousarray(flow[..., 1]))
    )
    stretch = (1 + ux) * (1 + vy) - uy * vx
    folded = (stretch <= 0).astype(np.float32)
    # Faded out: an abrupt change of weights would show as an edge.
    return np.power(np.float32(_DISTRUST), _smooth(cv2.dilate(folded, np.ones((7, 7), np.uint8)), 2.0))


def _noise_model(
    frames: list[FloatArray],
    flows: FloatArray,
    image: FloatArray,
    dynamics: FlowDynamics,
    params: FilterParams,
    threads: int,
) -> _NoiseModel:
    """Temporal statistics of the first block, registered by its flows."""
    template = _gradient(luminance(image))

    def measure(pair: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        registered = luminance(warp(*pair))
        return registered, _sharpness(registered, template, params.sharpness_window)

    shape = image.shape[:2]
    total, squares, sharp, sharp_squares = (np.zeros(shape) for _ in range(4))
    for _, (registered, sharpness) in map_ahead(measure, zip(frames, flows, strict=True), threads):
        total += registered
        squares += np.square(registered, dtype=np.float64)
        sharp += sharpness
        sharp_squares += np.square(sharpness, dtype=np.float64)
    count = len(frames)
    variance = np.maximum(squares / count - (total / count) ** 2, 0.0) * count / max(count - 1, 1)
    usual = sharp / count
    # The flattest fifth of the image varies by sensor noise alone; elsewhere blur and misregistration add to it.
    energy = _smooth(template[0] ** 2 + template[1] ** 2, params.sharpness_window)
    sensor_noise = float(variance[energy <= np.quantile(energy, 0.2)].mean())
    spread = np.maximum(sharp_squares / count - usual**2, 0.0)
    measured = params.image_noise if params.image_noise is not None else float(variance.mean())
    share = np.zeros(shape, np.float32)
    if params.residual == "keep":
        share = _motion_share(energy, sensor_noise, dynamics, params.sharpness_window)
    scale = _score_scale(usual, spread, energy * _SOBEL_NOISE * sensor_noise, params.sharpness_window)
    return _NoiseModel(
        max(measured, _IMAGE_NOISE_FLOOR),
        template,
        usual.astype(np.float32),
        scale,
        (scale**2 * spread).astype(np.float32),
        share,
    )


def _score_scale(usual: np.ndarray, spread: np.ndarray, noise: np.ndarray, window: float) -> FloatArray:
    """Factor from a deviation of the sharpness to the best estimate of its standardised noise-free part.

    Noise of the gradient, projected on the template, explains ``noise`` over the number of independent pixels in the
    window of the variance ``spread``; what is left is sharpness.
    """
    explained = noise / (4 * np.pi * window**2 / _SOBEL_AREA)
    deviation = np.sqrt(np.maximum(spread - explained, 0.0))
    return (deviation / np.maximum(spread + (_LEAST_SPREAD * usual) ** 2, 1e-18)).astype(np.float32)


def _motion_share(energy: FloatArray, noise: float, dynamics: FlowDynamics, window: float) -> FloatArray:
    """G = R_motion / (R_motion + R_noise), with R_noise the Cramér–Rao bound of a shift seen through the window.

    A shift of a patch with gradients ∇ρ in noise of variance σ² cannot be measured better than
    σ² / (½ Σ |∇ρ|²) per axis; what the residual varies beyond that is motion.
    """
    area = 4 * np.pi * window**2
    noise_variance = noise / np.maximum(area * 0.5 * energy, 1e-12)
    total = np.maximum(dynamics.residual_variance, 0.0)
    return (1.0 - np.minimum(noise_variance / np.maximum(total, 1e-12), 1.0)).astype(np.float32)


def _frame_noise(
    registered: FloatArray, flow: FloatArray, model: _NoiseModel, params: FilterParams
) -> float | FloatArray:
    """Z of one frame: lower where it is sharper than usual, much higher where its flow folds."""
    if params.sharpness == 0:
        return model.image_noise
    sharpness = _sharpness(luminance(registered), model.template, params.sharpness_window)
    score = np.clip(model.score_scale * (sharpness - model.usual), -_LARGEST_SCORE, _LARGEST_SCORE)
    # For a normal score of variance s² the mean of exp(β z − β² s² / 2) is one: the information per frame stays 1/Z.
    exponent = 0.5 * params.sharpness**2 * model.score_variance - params.sharpness * score
    return np.float32(model.image_noise) * np.exp(exponent) * _distrust(flow)


def _sharpness(registered: FloatArray, template: tuple[FloatArray, FloatArray], window: float) -> FloatArray:
    """Gradient of a frame projected on that of the template, in a Gaussian window.

    A blurred frame has a smaller projection.  So has one that is torn, misregistered or covered, though its gradient
    may be large: plain gradient energy would prefer it.  And noise, being linear here, does not add up.
    """
    dx, dy = _gradient(registered)
    return _smooth(dx * template[0] + dy * template[1], window)


def _gradient(image: FloatArray) -> tuple[FloatArray, FloatArray]:
    return cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(image, cv2.CV_32F, 0, 1, scale=1 / 8)


def _smooth(image: FloatArray, window: float) -> FloatArray:
    return cv2.GaussianBlur(image, (0, 0), window)
