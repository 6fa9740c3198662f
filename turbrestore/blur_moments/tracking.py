"""Tip-tilt and tracking: the motion of a point or a small target in a video, also within the exposures.

A moving target leaves a streak.  Its centroid is its mean position, its second moments show how far it moved during the
exposure, and a model of the motion (:mod:`.targets`) connects the frames.  Both axes follow the same motion
independently of each other.  The sums over the rows of a window around the target are the image of a line sensor along
x, those over its columns of one along y, so each axis has an observer of papers 1 and 2.

x counts columns and y rows, both in pixels, with pixel centres at whole numbers.

Departure from the papers
-------------------------
Second moments are quadratic in the state.  The extended filter of the papers leaves out what the covariance of the
state adds to their mean and covariance, which matters as long as the velocity is unknown; the unscented one counts it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm
from scipy.optimize import minimize_scalar

from ..core.arrays import check_frames, luminance
from ..core.errors import ConfigurationError, DataError, require, require_between
from ..filtering.estimates import Gaussian
from ..filtering.kalman import Innovation
from .moments import BlurModel
from .sensor import ExposureTiming, Float64Array, GaussianKernel, LineSensor, PixelGrid
from .state_estimation.lifting import LiftedSystem
from .state_estimation.observers import MomentFilter
from .targets import Oscillation, RandomWalk, TargetMotion, lift_motion

# Width of the rim of the window that is taken to be background, pixels.
_RIM = 2
# A pixel counts as light of the target above this many standard deviations of the noise.
_LIT = 3.0
# Frequencies tried per resolvable step of 1 / duration.
_FINENESS, _MOST_TRIED = 2.0, 400
# Accuracy of the first window, pixels; most shifts of a window; smallest window.
_PLACED, _PLACINGS, _SMALLEST = 1.0, 8, 2 * _RIM + 3
# Smallest noise as a share of the brightest pixel.
_LEAST_NOISE = 1e-5


@dataclass(frozen=True)
class TrackParams:
    """Settings of the tracking of a target.

    Parameters
    ----------
    motion : RandomWalk, ConstantVelocity or Oscillation
    sigma : float
        Standard deviation of the image of the still target, including the blur of the optics, pixels.
    exposure : float
        Share of the frame period during which the shutter is open, a whole multiple of 1 / ``steps``.
    frame_period : float
        Seconds.
    steps : int
        Fast steps in a frame period.
    order : {1, 2}
        Centroids only, or second moments as well; for a random walk always centroids.

    Raises
    ------
    ConfigurationError
        A setting is out of range, or the exposure is not a whole number of steps.

    Examples
    --------
    >>> from turbrestore.blur_moments.targets import ConstantVelocity
    >>> TrackParams(ConstantVelocity(0.1), sigma=1.2).timing().exposure_steps
    16
    """

    motion: TargetMotion
    sigma: float
    exposure: float = 1.0
    frame_period: float = 1.0
    steps: int = 16
    order: int = 2

    def __post_init__(self) -> None:
        require(0 < self.frame_period < np.inf, f"frame_period: expected a number above 0, found {self.frame_period}")
        require_between("sigma", self.sigma, 0, 1000, "pixels")
        require_between("steps", self.steps, 2, 10000)
        require(self.order in (1, 2), f"order: expected 1 or 2, found {self.order}")
        self.timing()

    def timing(self) -> ExposureTiming:
        """Return the timing of the camera."""
        period = self.frame_period
        return ExposureTiming(period / self.steps, self.exposure * period, 0.0, period)


@dataclass(frozen=True, eq=False)
class Track:
    """Motion of a target; the last axis is (x, y) unless said otherwise."""

    # (T, 2): in the middle of the exposures, estimated from this and all earlier frames, pixels.
    positions: Float64Array
    position_variances: Float64Array  # (T, 2): of ``positions``, squared pixels
    velocities: Float64Array  # (T, 2): in the middle of the exposures, pixels per second; NaN for a random walk
    paths: Float64Array  # (T, steps, 2): in the middle of the fast steps of each frame period, pixels
    states: Gaussian  # (T, 2, n): of each axis at the start of every exposure, after its frame
    # (T, 2): squared innovation in units of its covariance; its mean is the number of moments if the model is right.
    misfits: Float64Array
    log_likelihood: float  # of all frames
    frequency: float | None  # frequency of an oscillation, Hz; the most likely one if a range was searched
    centroids: Float64Array  # (T, 2): first moments of the frames alone, pixels
    # (T, 2, 2): central second moments of the frames alone, which contain still target and motion, squared pixels.
    spreads: Float64Array
    # Measured intensity beside the target, standard deviation of a pixel, and total light of the target.
    background: float
    noise: float
    total: float


@dataclass(frozen=True, eq=False)
class _Windows:
    """The target cut out of every frame, without its background."""

    images: Float64Array  # (T, h, w)
    centres: Float64Array  # (T, 2): of the windows, pixels
    centroids: Float64Array  # (T, 2)
    spreads: Float64Array  # (T, 2, 2)
    background: float
    noise: float
    total: float


def track_blur(frames: ArrayLike, roi: tuple[int, int, int, int], params: TrackParams) -> Track:
    """Track a point or a small target by centroid and second moments, also within the exposures.

    A window of the size of ``roi`` follows the target.  Background and noise are measured on the rim of the windows,
    and the light of the target is assumed to be the same in all frames.  There must be one target on an even
    background, and the window must contain its whole streak.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3), at least two
        Colour is reduced to luminance.
    roi : tuple of four ints
        Left column, top row, width and height of the window around the target in the first frame, pixels.
    params : TrackParams

    Returns
    -------
    Track

    Raises
    ------
    DataError
        Fewer than two frames, a frame without light, or a target that leaves the frame.
    ConfigurationError
        The window lies outside the frame or is too small, or the frame rate does not determine the motion.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.blur_moments.targets import ConstantVelocity
    >>> path = 10 + 2.0 * (np.arange(160) + 0.5).reshape(10, 16, 1) / 16
    >>> profile = np.exp(-((np.arange(48) - path) ** 2) / 2) / np.sqrt(2 * np.pi)
    >>> rng = np.random.default_rng(0)
    >>> frames = 20 * np.swapaxes(profile, 1, 2) @ profile / 16
    >>> frames += rng.normal(0, 0.01, frames.shape)
    >>> track = track_blur(frames, (3, 3, 16, 16), TrackParams(ConstantVelocity(1e-3), sigma=1.0))
    >>> track.velocities[-1].round(1), track.paths[-1, 0].round(0)
    (array([2., 2.]), array([28., 28.]))
    """
    stack = luminance(check_frames(frames, at_least=2)).astype(np.float64)
    windows = _cut_windows(stack, roi)
    if isinstance(params.motion, Oscillation) and params.motion.highest is not None:
        params = replace(params, motion=_most_likely(windows, params, params.motion))
    states, misfits, log_likelihood = _run(windows, params)
    motion, (A, _) = lift_motion(params.motion, params.timing()), params.motion.dynamics()
    # A random walk has no velocity among its states.
    rate = np.full(1, np.nan) if len(A) == 1 else expm(A * params.timing().exposure / 2)[1]
    return Track(
        positions=states.mean @ motion.C,
        position_variances=motion.C @ states.cov @ motion.C,
        velocities=states.mean @ rate,
        paths=motion.free @ np.swapaxes(states.mean, 1, 2),
        states=states,
        misfits=misfits,
        log_likelihood=log_likelihood,
        frequency=params.motion.frequency if isinstance(params.motion, Oscillation) else None,
        centroids=windows.centroids,
        spreads=windows.spreads,
        background=windows.background,
        noise=windows.noise,
        total=windows.total,
    )


def _run(windows: _Windows, params: TrackParams) -> tuple[Gaussian, Float64Array, float]:
    """States (T, 2, n) at the start of the exposures, after their frames; misfits (T, 2); log-likelihood of all."""
    motion = lift_motion(params.motion, params.timing())
    # The spread of a random walk within an exposure says nothing about where it leads.
    orders = (1,) if isinstance(params.motion, RandomWalk) else (1, 2)[: params.order]
    observer, kernel = MomentFilter(orders, "legendre", "unscented"), GaussianKernel(params.sigma)
    starts = _start(windows, params)
    axes = [_follow(windows, axis, starts[axis], motion, kernel, observer) for axis in range(2)]
    means, covs = (
        np.stack([[getattr(state, name) for state, _ in steps] for steps in axes], axis=1) for name in ("mean", "cov")
    )
    misfits = np.stack([[innovation.normalised_squared for _, innovation in steps] for steps in axes], axis=1)
    return Gaussian(means, covs), misfits, float(sum(found.log_likelihood for steps in axes for _, found in steps))


def _follow(
    windows: _Windows, axis: int, start: Gaussian, motion: LiftedSystem, kernel: GaussianKernel, observer: MomentFilter
) -> list[tuple[Gaussian, Innovation]]:
    """States of one axis after each frame, and innovations."""
    lines, summed = windows.images.sum(axis=1 + axis), windows.images.shape[1 + axis]
    half, still = lines.shape[1] / 2, np.zeros(motion.timing.frame_steps)
    steps, state = [], start
    # The window moves with the target, so every frame has its own sensor.
    for line, centre in zip(lines, windows.centres[:, axis], strict=True):
        pixels = PixelGrid(centre - half, centre + half, len(line))
        sensor = LineSensor(kernel, pixels, summed * windows.noise**2, windows.total)
        steps.append(observer.step(BlurModel(motion, sensor), state, line, still))
        state = motion.advance(steps[-1][0], still)
    return steps


def _start(windows: _Windows, params: TrackParams) -> list[Gaussian]:
    """Rough state of each axis before the first frame: at rest in the first window, with a spread from the frames."""
    moved = np.mean(np.diff(windows.centroids, axis=0) ** 2)
    streak = np.mean(windows.spreads[:, [0, 1], [0, 1]]) - params.sigma**2 - 1 / 12
    step = float(np.sqrt(moved + np.maximum(streak, 0.0) + _PLACED**2))
    prior = params.motion.prior(step, params.frame_period)
    means = np.zeros((2, len(prior)))
    means[:, 0] = windows.centres[0]
    # The third state, if any, is the centre of an oscillation.
    means[:, 2:] = windows.centroids.mean(axis=0)[:, None]
    return [Gaussian(mean, prior) for mean in means]


def _most_likely(windows: _Windows, params: TrackParams, motion: Oscillation) -> Oscillation:
    """Oscillation with the frequency of the largest likelihood."""
    assert motion.highest is not None

    def cost(frequency: float) -> float:
        candidate = replace(motion, frequency=float(frequency), highest=None)
        try:
            return -_run(windows, replace(params, motion=candidate))[2]
        except ConfigurationError:
            # The frames do not determine the state, for example at half the frame rate.
            return np.inf

    duration = len(windows.images) * params.frame_period
    count = int(np.clip(np.ceil((motion.highest - motion.frequency) * duration * _FINENESS), 2, _MOST_TRIED)) + 1
    tried = np.linspace(motion.frequency, motion.highest, count)
    best = int(np.argmin([cost(frequency) for frequency in tried]))
    around = tried[max(best - 1, 0)], tried[min(best + 1, count - 1)]
    found = minimize_scalar(cost, bounds=around, method="bounded", options={"xatol": 1e-3 / duration})
    return replace(motion, frequency=float(found.x), highest=None)


def _cut_windows(stack: Float64Array, roi: tuple[int, int, int, int]) -> _Windows:
    """Follow the target and cut it out of every frame."""
    left, top, width, height = _check_roi(roi, stack.shape[1:])
    parts, corners, corner = [], [], np.array([left, top])
    for number, frame in enumerate(stack):
        light, corner = _place(frame, corner, (width, height))
        if light <= 0:
            raise DataError(f"frame {number}: expected light in the window, found none; check roi")
        corners.append(corner)
        parts.append(frame[corner[1] : corner[1] + height, corner[0] : corner[0] + width])
    cut = np.stack(parts)
    rim = cut[:, _rim(height, width)]
    background = float(np.median(rim))
    noise = 1.4826 * float(np.median(np.abs(rim - background)))
    images = cut - background
    total = float(np.median(images.sum((1, 2))))
    if total <= 0:
        raise DataError(f"roi: expected a target brighter than its background, found a total of {total:g}; check roi")
    x, y = (np.arange(size) - (size - 1) / 2 for size in (width, height))
    along_x, along_y = images.sum(axis=1) / total, images.sum(axis=2) / total
    first = np.stack([along_x @ x, along_y @ y], axis=-1)
    mixed = images @ x @ y / total
    second = np.stack([along_x @ x**2, mixed, mixed, along_y @ y**2], axis=-1).reshape(-1, 2, 2)
    centres = np.stack(corners) + np.array([(width - 1) / 2, (height - 1) / 2])
    return _Windows(
        images=images,
        centres=centres,
        centroids=first + centres,
        spreads=second - first[:, :, None] * first[:, None, :],
        background=background,
        # The lower limit keeps the filter defined for noise-free synthetic frames.
        noise=max(noise, _LEAST_NOISE * float(images.max())),
        total=total,
    )


def _place(frame: Float64Array, guess: NDArray[np.intp], size: tuple[int, int]) -> tuple[float, NDArray[np.intp]]:
    """Centre a window on the light in it; return the amount of light and the corner (left, top)."""
    width, height = size
    limit = np.array([frame.shape[1] - width, frame.shape[0] - height])
    corner, light = np.clip(guess, 0, limit), 0.0
    for _ in range(_PLACINGS):
        image = frame[corner[1] : corner[1] + height, corner[0] : corner[0] + width]
        rim = image[_rim(height, width)]
        level = np.median(rim)
        noise = 1.4826 * np.median(np.abs(rim - level))
        lit = np.where(image - level > _LIT * noise + 1e-9, image - level, 0.0)
        light = float(lit.sum())
        if light <= 0:
            break
        centroid = np.array([lit.sum(axis=0) @ np.arange(width), lit.sum(axis=1) @ np.arange(height)]) / light
        moved = np.clip(np.rint(corner + centroid - (np.array(size) - 1) / 2).astype(np.intp), 0, limit)
        if (moved == corner).all():
            break
        corner = moved
    return light, corner


def _rim(height: int, width: int) -> NDArray[np.bool_]:
    rim = np.ones((height, width), bool)
    rim[_RIM:-_RIM, _RIM:-_RIM] = False
    return rim


def _check_roi(roi: tuple[int, int, int, int], shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    require(len(roi) == 4, f"roi: expected left, top, width and height, found {len(roi)} numbers")
    left, top, width, height = (int(value) for value in roi)
    require(
        min(width, height) >= _SMALLEST, f"roi: expected at least {_SMALLEST} pixels a side, found {width}×{height}"
    )
    inside = 0 <= left <= shape[1] - width and 0 <= top <= shape[0] - height
    require(inside, f"roi: expected a window inside {shape[1]}×{shape[0]} pixels, found {tuple(roi)}")
    return left, top, width, height
