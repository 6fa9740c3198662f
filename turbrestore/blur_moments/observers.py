"""Observers of a fast system behind a slow integrative sensor: fixed gains and filters on moments.

Every observer has one method, ``step(model, state, frame, inputs) -> (state, innovation)``: from the state at the start
of an exposure, predicted, to the same state after its frame.  ``model.motion.advance`` then leads to the next
exposure, so one loop, :func:`run_observer`, runs any of them; those on the whole image are in
:mod:`.image_prediction`.  Leading axes are batches.

Symbols (paper 1, section V; paper 2, section IV)
-------------------------------------------------
x̂, P : mean and covariance of the state, :class:`~turbrestore.filtering.kalman.Gaussian`.
y^(p), h : moments of the frame and what the state makes them, :func:`.blur_model.predicted_moments`.
C_s, H : derivative of the moments with respect to the state.
L : gain of the Luenberger observer; K of the Kalman filter.
V, R : density of the pixel noise, covariance of the moments' noise.

Departures from the papers
--------------------------
The innovation is ``y − h(x̂)``.  Equation 20 of paper 1 subtracts ``H x̂``, which is ``2 h(x̂)`` for a quadratic output
and costs most of the gain.  The gain acts on the state at the start of the exposure that was seen; paper 2 applies
it one slow step later, ``A_s L`` here being its L.  The second moment alone cannot tell y from −y and has H = 0 at
rest: input or noise breaks the tie, or the unscented form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_discrete_are
from scipy.signal import place_poles

from ..core.errors import ConfigurationError, DataError, require
from ..filtering.kalman import Gaussian, Innovation, predict, update
from .blur_model import BlurModel, predicted_moments
from .exposure_table import ExposureTable
from .kernels import Float64Array
from .lifting import LiftedSystem, check_inputs, check_state
from .moments import BASES, image_moments, moment_noise

METHODS = ("extended", "iterated", "unscented")


class Observer(Protocol):
    """What :func:`run_observer` runs."""

    def step(
        self, model: BlurModel, state: Gaussian, frame: Float64Array, inputs: Float64Array
    ) -> tuple[Gaussian, Innovation]:
        """Correct the state at the start of an exposure by its frame."""
        ...


@dataclass(frozen=True, eq=False)
class FixedGain:
    """Luenberger observer on the first moment (paper 2, O1), made by :func:`luenberger` or :func:`steady_kalman`.

    The covariance follows the gain, whatever the gain: ``(I − L C) P (I − L C)ᵀ + L R Lᵀ``.

    Parameters
    ----------
    gain : ndarray, float64, shape (n,)
        L.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.blur_moments.experiments.scenarios import wavefront_model
    >>> start, inputs = Gaussian(np.zeros(2), np.eye(2)), np.zeros(200)
    >>> FixedGain(np.zeros(2)).step(wavefront_model(), start, np.ones(100), inputs)[0].mean
    array([0., 0.])
    """

    gain: Float64Array

    def step(
        self, model: BlurModel, state: Gaussian, frame: ArrayLike, inputs: ArrayLike
    ) -> tuple[Gaussian, Innovation]:
        """Correct the state at the start of an exposure by its frame.

        Parameters
        ----------
        model : BlurModel
        state : Gaussian
            Prediction, shape (..., n).
        frame : array_like, shape (..., count)
        inputs : array_like, shape (..., N)

        Returns
        -------
        state : Gaussian
        innovation : Innovation

        Raises
        ------
        DataError
            Shapes do not agree or values are not finite.
        ConfigurationError
            The gain belongs to another system.
        """
        order, size = model.motion.order, np.shape(self.gain)
        require(size == (order,), f"gain: expected shape {(order,)}, found {size}")
        measured, expected, H, R = _moment_terms(model, state, frame, inputs, (1,), "monomial", None)
        # The covariances of the innovation are those of the Kalman update; only the gain differs.
        _, innovation = update(state, measured, H, R, expected)
        F = np.eye(model.motion.order) - self.gain[:, None] * H
        cov = F @ state.cov @ np.swapaxes(F, -1, -2) + np.outer(self.gain, self.gain) * R
        mean = state.mean + (measured - expected) * self.gain
        return Gaussian(mean, 0.5 * (cov + np.swapaxes(cov, -1, -2))), innovation


@dataclass(frozen=True)
class MomentFilter:
    """Kalman filter on moments of the frame (paper 1, O1 to O3; paper 2, O1 and O2).

    Parameters
    ----------
    orders : tuple of int
        Moments to use: (1,) is the linear Kalman filter, (2,) the second only, (1, 2) both.
    basis : {"monomial", "legendre"}
        Legendre moments have less noise, see :mod:`.moments`.
    method : {"extended", "iterated", "unscented"}
        Linearised at the prediction; linearised again at its own result; or by sigma points.
    border : bool
        Take into account what falls beside the pixels, by the image of the predicted path; otherwise the moments
        follow from the binomial relation.
    iterations : int
        Of the iterated method.

    Raises
    ------
    ConfigurationError
        No orders, orders below 1 or not ascending, unknown basis or method.

    Examples
    --------
    >>> MomentFilter(orders=(1,)).method
    'extended'
    """

    orders: tuple[int, ...] = (1, 2)
    basis: str = "monomial"
    method: str = "extended"
    border: bool = False
    iterations: int = 5

    def __post_init__(self) -> None:
        ascending = all(a < b for a, b in zip((0, *self.orders), self.orders, strict=False))
        require(bool(self.orders) and ascending, f"orders: expected ascending orders from 1, found {self.orders}")
        require(self.basis in BASES, f"basis: expected one of {', '.join(BASES)}, found {self.basis!r}")
        require(self.method in METHODS, f"method: expected one of {', '.join(METHODS)}, found {self.method!r}")
        require(self.iterations >= 1, f"iterations: expected at least 1, found {self.iterations}")

    def step(
        self, model: BlurModel, state: Gaussian, frame: ArrayLike, inputs: ArrayLike
    ) -> tuple[Gaussian, Innovation]:
        """Correct the state at the start of an exposure by its frame.

        Parameters
        ----------
        model : BlurModel
        state : Gaussian
            Prediction, shape (..., n).
        frame : array_like, shape (..., count)
        inputs : array_like, shape (..., N)

        Returns
        -------
        state : Gaussian
        innovation : Innovation

        Raises
        ------
        DataError
            Shapes do not agree or values are not finite.
        """
        table = model.table if self.border else None
        terms = (model, state, frame, inputs, self.orders, self.basis, table)
        if self.method == "unscented":
            measured, expected, H, R = _sigma_point_terms(*terms)
            return update(state, measured, H, R, expected)
        measured, expected, H, R = _moment_terms(*terms)
        after, innovation = update(state, measured, H, R, expected)
        for _ in range(self.iterations if self.method == "iterated" else 0):
            h, H, _ = predicted_moments(model, after.mean, np.asarray(inputs), self.orders, self.basis, table)
            expected = h + np.einsum("...mn,...n->...m", H, state.mean - after.mean)
            after, innovation = update(state, measured, H, R, expected)
        return after, innovation


def run_observer(
    observer: Observer,
    model: BlurModel,
    start: Gaussian,
    frames: ArrayLike,
    inputs: ArrayLike,
    callback: Callable[[int, Gaussian, Innovation], None] | None = None,
) -> list[tuple[Gaussian, Innovation]]:
    """Run an observer over frames.

    Parameters
    ----------
    observer : Observer
    model : BlurModel
    start : Gaussian
        State at the start of the first exposure, shape (..., n).
    frames : array_like, shape (T, ..., count)
    inputs : array_like, shape (T, ..., N)
    callback : callable, optional
        Told the number of the frame, its state and its innovation.

    Returns
    -------
    list of (Gaussian, Innovation)
        State at the start of every exposure, after its frame.

    Raises
    ------
    DataError
        As many inputs as frames are needed; and what ``step`` raises.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.blur_moments.kernels import PixelGrid, gaussian_kernel
    >>> from turbrestore.blur_moments.lifting import FastSystem, lift
    >>> from turbrestore.blur_moments.sensor import ExposureTiming, LineSensor
    >>> timing = ExposureTiming(fast_period=1.0, exposure=2.0, readout=0.0, frame_period=2.0)
    >>> motion = lift(FastSystem([[0.9]], [0.1], [1.0]), timing, [[0.01]])
    >>> model = BlurModel(motion, LineSensor(gaussian_kernel(0.1), PixelGrid(-1.0, 1.0, 20), noise=0.1))
    >>> start = Gaussian(np.zeros(1), np.eye(1))
    >>> len(run_observer(MomentFilter(), model, start, np.full((3, 20), 0.5), np.zeros((3, 2))))
    3
    """
    if len(np.asarray(frames)) != len(np.asarray(inputs)):
        raise DataError(
            f"inputs: expected one for each of {len(np.asarray(frames))} frames, found {len(np.asarray(inputs))}"
        )
    results, state = [], start
    for number, (frame, given) in enumerate(zip(np.asarray(frames), np.asarray(inputs), strict=True)):
        held = check_inputs(given, model.motion.timing.frame_steps)
        after, innovation = observer.step(model, state, frame, held)
        if callback is not None:
            callback(number, after, innovation)
        results.append((after, innovation))
        state = model.motion.advance(after, held)
    return results


def luenberger(motion: LiftedSystem, poles: ArrayLike) -> FixedGain:
    """Luenberger observer with the given poles of ``A_s − L C_s A_s`` (paper 2, O1).

    Parameters
    ----------
    motion : LiftedSystem
    poles : array_like, shape (n,)
        Inside the unit circle, each no more often than there are outputs: once.

    Returns
    -------
    FixedGain

    Raises
    ------
    ConfigurationError
        A pole outside the unit circle, or poles that cannot be placed.

    Examples
    --------
    >>> from turbrestore.blur_moments.lifting import FastSystem, lift
    >>> from turbrestore.blur_moments.sensor import ExposureTiming, LineSensor
    >>> timing = ExposureTiming(fast_period=1.0, exposure=1.0, readout=0.0, frame_period=1.0)
    >>> luenberger(lift(FastSystem([[0.8]], [1.0], [1.0]), timing, [[0.1]]), [0.2]).gain
    array([0.75])
    """
    wanted = np.atleast_1d(np.asarray(poles))
    require(
        wanted.shape == (motion.order,) and bool((np.abs(wanted) < 1).all()),
        f"poles: expected {motion.order} inside the unit circle, found {wanted.tolist()}",
    )
    try:
        placed = place_poles(motion.A.T, (motion.C @ motion.A)[:, None], wanted)
    except ValueError as error:
        raise ConfigurationError(f"poles: expected some that one output can place, found {error}") from error
    return FixedGain(np.asarray(placed.gain_matrix[0], np.float64))


def steady_kalman(model: BlurModel) -> tuple[FixedGain, Float64Array]:
    """Observer with the gain that the Kalman filter on the first moment settles at (paper 1, O1).

    Parameters
    ----------
    model : BlurModel
        With a :class:`~.lifted.LiftedSystem`.

    Returns
    -------
    observer : FixedGain
    cov : ndarray, float64, shape (n, n)
        P, covariance of the settled prediction.

    Raises
    ------
    ConfigurationError
        The motion is not linear.
    DataError
        The Riccati equation has no stabilising solution: Q is no covariance, or zero where the system does not decay.

    Examples
    --------
    >>> from turbrestore.blur_moments.kernels import PixelGrid, gaussian_kernel
    >>> from turbrestore.blur_moments.lifting import FastSystem, lift
    >>> from turbrestore.blur_moments.sensor import ExposureTiming, LineSensor
    >>> timing = ExposureTiming(fast_period=1.0, exposure=1.0, readout=0.0, frame_period=1.0)
    >>> motion = lift(FastSystem([[1.0]], [1.0], [1.0]), timing, [[0.5]])
    >>> pixels = PixelGrid(-1.0, 1.0, 1000)
    >>> observer, cov = steady_kalman(BlurModel(motion, LineSensor(gaussian_kernel(0.05), pixels, noise=1.5)))
    >>> cov.round(4), observer.gain.round(4)
    (array([[1.]]), array([0.5]))
    """
    motion, sensor = model.motion, model.sensor
    if not isinstance(motion, LiftedSystem):
        raise ConfigurationError(f"motion: expected a linear system, found {type(motion).__name__}")
    R = moment_noise(sensor.pixels, 1, sensor.noise)[1, 1] / sensor.total**2
    # predict() says what is wrong with Q before the solver does so in its own words.
    predict(Gaussian(np.zeros(motion.order), np.zeros_like(motion.Q)), motion.A, motion.Q)
    try:
        cov = solve_discrete_are(motion.A.T, motion.C[:, None], motion.Q, np.array([[R]]))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DataError(f"Q: expected covariances for which a Kalman filter settles, found {error}") from error
    gain = cov @ motion.C / (motion.C @ cov @ motion.C + R)
    radius = np.abs(np.linalg.eigvals(motion.A - np.outer(motion.A @ gain, motion.C))).max()
    if not radius < 1 - 1e-9:
        raise DataError(
            f"Q: expected covariances for which a Kalman filter settles, found errors that keep {radius:.6g} of "
            "themselves from frame to frame; let every state be disturbed"
        )
    return FixedGain(gain), np.asarray(cov, np.float64)


def _moment_terms(
    model: BlurModel,
    state: Gaussian,
    frame: ArrayLike,
    inputs: ArrayLike,
    orders: tuple[int, ...],
    basis: str,
    table: ExposureTable | None,
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Measured and expected moments, H and R at the prediction."""
    check_state(state, model.motion.order)
    held = check_inputs(inputs, model.motion.timing.frame_steps)
    expected, H, R = predicted_moments(model, state.mean, held, orders, basis, table)
    return _measured(model, frame, orders, basis), expected, H, R


def _sigma_point_terms(
    model: BlurModel,
    state: Gaussian,
    frame: ArrayLike,
    inputs: ArrayLike,
    orders: tuple[int, ...],
    basis: str,
    table: ExposureTable | None,
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Statistical linearisation: the regression of the moments on sigma points; what it leaves goes into R."""
    check_state(state, model.motion.order)
    held = check_inputs(inputs, model.motion.timing.frame_steps)
    n = model.motion.order
    # n + κ = 3 fits the fourth moments of a Gaussian; κ stays non-negative, so that no weight is.
    kappa = max(3 - n, 0)
    try:
        root = np.sqrt(n + kappa) * np.linalg.cholesky(state.cov)
    except np.linalg.LinAlgError as error:
        raise DataError("cov: expected a covariance that can be inverted, found a singular one") from error
    offsets = np.concatenate([np.zeros_like(root[..., :1]), root, -root], -1)
    weights = np.full(2 * n + 1, 0.5 / (n + kappa))
    weights[0] = kappa / (n + kappa)
    points = state.mean[..., None, :] + np.swapaxes(offsets, -1, -2)
    values, _, R = predicted_moments(model, points, held[..., None, :], orders, basis, table)
    if R.ndim > 2:
        R = np.einsum("i,...iab->...ab", weights, R)
    expected = np.einsum("i,...im->...m", weights, values)
    spread = values - expected[..., None, :]
    cross = np.einsum("i,...im,...ni->...mn", weights, spread, offsets)
    H = np.swapaxes(np.linalg.solve(state.cov, np.swapaxes(cross, -1, -2)), -1, -2)
    left = np.einsum("i,...ia,...ib->...ab", weights, spread, spread) - H @ np.swapaxes(cross, -1, -2)
    R = R + 0.5 * (left + np.swapaxes(left, -1, -2))
    return _measured(model, frame, orders, basis), expected, H, R


def _measured(model: BlurModel, frame: ArrayLike, orders: tuple[int, ...], basis: str) -> Float64Array:
    sensor = model.sensor
    return image_moments(frame, sensor.pixels, max(orders), basis, sensor.total)[..., list(orders)]
