"""Observers of a fast system behind a slow integrative sensor: fixed gains and filters on moments.

Every observer has one method, ``step(model, state, frame, inputs) -> (state, innovation)``: it corrects the predicted
state at the start of an exposure by the frame of that exposure, ``frame`` (..., count) and ``inputs`` (..., N).
``model.motion.advance`` then predicts the state at the start of the next exposure, so one loop, :func:`run_observer`,
runs all of them.  The observers on the whole image are in :mod:`.image_observer`.  Leading axes are batches.

Symbols (paper 1, section V; paper 2, section IV)
-------------------------------------------------
x̂, P : mean and covariance of the state, :class:`~turbrestore.filtering.estimates.Gaussian`.
y^(p), h : measured and predicted moments of the frame, :func:`.moments.predicted_moments`.
C_s, H : derivative of the moments with respect to the state.
L : gain of the Luenberger observer; K : gain of the Kalman filter.
V, R : density of the pixel noise; covariance of the noise of the moments.

Departures from the papers
--------------------------
The innovation is ``y − h(x̂)``.  Equation 20 of paper 1 subtracts ``H x̂``, which is ``2 h(x̂)`` for a quadratic output
and costs most of the gain in accuracy.  The gain corrects the state at the start of the observed exposure; paper 2
applies it one frame period later, so its L is ``A_s L`` here.  The second moment alone cannot distinguish y from −y and
has H = 0 at rest: only an input, noise or the unscented form resolves the ambiguity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_discrete_are

from ...core.errors import ConfigurationError, DataError, require
from ...filtering.estimates import Gaussian
from ...filtering.kalman import predict
from ..moments import BASES, BlurModel, image_moments, moment_noise, predicted_moments
from ..sensor import Float64Array
from .image_observer import ImageFilter
from .innovation import Innovation, correct
from .lifting import LiftedSystem

METHODS = ("extended", "unscented")


@dataclass(frozen=True, eq=False)
class FixedGain:
    """Luenberger observer on the first moment (paper 2, O1); :func:`steady_kalman` makes the best one.

    The covariance is that of the error for any gain: ``(I − L C) P (I − L C)ᵀ + L R Lᵀ``.
    """

    gain: Float64Array  # (n,): L

    def step(
        self, model: BlurModel, state: Gaussian, frame: ArrayLike, inputs: ArrayLike
    ) -> tuple[Gaussian, Innovation]:
        """Correct the predicted state by its frame."""
        order, size = model.motion.order, np.shape(self.gain)
        require(size == (order,), f"gain: expected shape {(order,)}, found {size}")
        expected, H, R = predicted_moments(model, state.mean, model.check_inputs(state, inputs), (1,))
        measured = image_moments(frame, model.sensor.pixels, 1, total=model.sensor.total)[..., 1:]
        # The covariance of the innovation is that of the Kalman update; only the gain differs.
        _, innovation = correct(state, measured - expected, H, R)
        F = np.eye(order) - self.gain[:, None] * H
        cov = F @ state.cov @ np.swapaxes(F, -1, -2) + np.outer(self.gain, self.gain) * R
        mean = state.mean + (measured - expected) * self.gain
        return Gaussian(mean, 0.5 * (cov + np.swapaxes(cov, -1, -2))), innovation


@dataclass(frozen=True)
class MomentFilter:
    """Kalman filter on moments of the frame (paper 1, O1 to O3; paper 2, O1 and O2)."""

    # Moments to use: (1,) is the linear Kalman filter, (2,) the second moment only, (1, 2) both.
    orders: tuple[int, ...] = (1, 2)
    basis: str = "monomial"  # or "legendre", whose moments have less noise, see :mod:`.moments`
    method: str = "extended"  # linearisation at the prediction, or sigma points ("unscented")

    def __post_init__(self) -> None:
        ascending = all(a < b for a, b in zip((0, *self.orders), self.orders, strict=False))
        require(bool(self.orders) and ascending, f"orders: expected ascending orders from 1, found {self.orders}")
        require(self.basis in BASES, f"basis: expected one of {', '.join(BASES)}, found {self.basis!r}")
        require(self.method in METHODS, f"method: expected one of {', '.join(METHODS)}, found {self.method!r}")

    def step(
        self, model: BlurModel, state: Gaussian, frame: ArrayLike, inputs: ArrayLike
    ) -> tuple[Gaussian, Innovation]:
        """Correct the predicted state by its frame."""
        values, pixels, total = model.check_inputs(state, inputs), model.sensor.pixels, model.sensor.total
        if self.method == "unscented":
            expected, H, R = regressed_moments(model, state, values, self.orders, self.basis)
        else:
            expected, H, R = predicted_moments(model, state.mean, values, self.orders, self.basis)
        measured = image_moments(frame, pixels, max(self.orders), self.basis, total)[..., list(self.orders)]
        return correct(state, measured - expected, H, R)


Observer = FixedGain | MomentFilter | ImageFilter


def run_observer(
    observer: Observer, model: BlurModel, start: Gaussian, frames: ArrayLike, inputs: ArrayLike
) -> list[tuple[Gaussian, Innovation]]:
    """Run an observer over frames.

    ``frames`` (T, ..., count); ``inputs`` (T, ..., N).
    """
    images, all_inputs = np.asarray(frames), np.asarray(inputs)
    if len(images) != len(all_inputs):
        raise DataError(f"inputs: expected one for each of {len(images)} frames, found {len(all_inputs)}")
    results, state = [], start
    for frame, given in zip(images, all_inputs, strict=True):
        results.append(observer.step(model, state, frame, given))
        state = model.motion.advance(results[-1][0], given)
    return results


def steady_kalman(model: BlurModel) -> tuple[FixedGain, Float64Array]:
    """Observer with the steady-state gain of the Kalman filter on the first moment (paper 1, O1).

    Returns ``cov`` (n, n).
    """
    motion, sensor = model.motion, model.sensor
    if not isinstance(motion, LiftedSystem):
        raise ConfigurationError(f"motion: expected a linear system, found {type(motion).__name__}")
    R = moment_noise(sensor.pixels, 1, sensor.noise)[1, 1] / sensor.total**2
    # predict() explains what is wrong with Q; the error of the solver would not name it.
    predict(Gaussian(np.zeros(motion.order), np.zeros_like(motion.Q)), motion.A, motion.Q)
    try:
        cov = solve_discrete_are(motion.A.T, motion.C[:, None], motion.Q, np.array([[R]]))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise DataError(f"Q: expected a covariance for which the Kalman filter settles, found {error}") from error
    gain = cov @ motion.C / (motion.C @ cov @ motion.C + R)
    radius = np.abs(np.linalg.eigvals(motion.A - np.outer(motion.A @ gain, motion.C))).max()
    if not radius < 1 - 1e-9:
        raise DataError(
            f"Q: expected a covariance for which the Kalman filter settles, found an error that decays by {radius:.6g} "
            "per frame only; let the disturbance act on every state"
        )
    return FixedGain(gain), np.asarray(cov, np.float64)


def regressed_moments(
    model: BlurModel, state: Gaussian, inputs: Float64Array, orders: tuple[int, ...], basis: str
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Moments, H and R by regression of the moments on sigma points; R includes the residual of the regression."""
    n = model.motion.order
    # n + κ = 3 matches the fourth moments of a Gaussian; κ ≥ 0 keeps the weights non-negative.
    kappa = max(3 - n, 0)
    try:
        root = np.sqrt(n + kappa) * np.linalg.cholesky(state.cov)
    except np.linalg.LinAlgError as error:
        raise DataError("cov: expected a covariance that can be inverted, found a singular one") from error
    offsets = np.concatenate([np.zeros_like(root[..., :1]), root, -root], -1)
    weights = np.full(2 * n + 1, 0.5 / (n + kappa))
    weights[0] = kappa / (n + kappa)
    points = state.mean[..., None, :] + np.swapaxes(offsets, -1, -2)
    predictions, _, R = predicted_moments(model, points, inputs[..., None, :], orders, basis)
    expected = np.einsum("i,...im->...m", weights, predictions)
    spread = predictions - expected[..., None, :]
    cross = np.einsum("i,...im,...ni->...mn", weights, spread, offsets)
    H = np.swapaxes(np.linalg.solve(state.cov, np.swapaxes(cross, -1, -2)), -1, -2)
    residual = np.einsum("i,...ia,...ib->...ab", weights, spread, spread) - H @ np.swapaxes(cross, -1, -2)
    return expected, H, R + 0.5 * (residual + np.swapaxes(residual, -1, -2))
