"""Observers on the whole image: the state whose predicted frame fits the measured one best (paper 2, O3).

The search is a damped Gauss–Newton method (Levenberg–Marquardt) from several starts.  Blur shows neither the direction
of time nor the sign of a symmetric motion, so the misfit has several minima.  The search starts from the prediction,
from its negative, and from the prediction shifted both ways along the axes of its covariance.

Symbols (paper 2, section IV)
-----------------------------
Y, C_Ψ(ŷ) : measured frame; frame predicted from the path ŷ of a state.
x̂, P : prediction of the state and its covariance.
V / Δ : variance of a pixel.

Departures from the paper
-------------------------
Paper 2 minimises a squared 2-norm in the formula and an ∞-norm in the text; both are available.  The ∞-norm is
approached by p-norms with p = 2, 8, 32, which are differentiable.  Neither norm uses the prediction; they only reject
states that would leave the pixels dark, for which the ∞-norm can be small.  ``norm="map"`` adds the prior term
``(x − x̂)ᵀ P⁻¹ (x − x̂)``, which makes the whole image useful where one frame does not determine the state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import ConfigurationError, DataError, require
from ...filtering.estimates import Gaussian
from ...filtering.kalman import apply, update
from ..moments import BlurModel
from ..sensor import Float64Array
from .innovation import Innovation

NORMS = ("map", "two", "infinity")
_POWERS = {"map": (2,), "two": (2,), "infinity": (2, 8, 32)}
# Distance of the shifted starts from the prediction, in standard deviations, chosen.
_PERTURBED = 2.0
# Iterations from every start before only the best ones continue, and their number; both chosen.
_TRIAL, _KEPT = 2, 3
# Squared distances in units of the curvature: a step that the frame cannot resolve; two starts at the same minimum;
# both chosen.
_SETTLED = 1e-3
_SAME = 0.1
# Share of the light that must fall on the pixels where no prior keeps the search from leaving them, chosen.
_LIT = 0.5
# Share of the prior information that keeps the covariance finite in a search without a prior, chosen.
_WEAK = 1e-6


@dataclass(frozen=True)
class ImageFilter:
    """Observer on the whole image."""

    norm: str = "map"  # "map" misfit with the prior, "two" without it, "infinity" largest misfit of a pixel
    iterations: int = 20  # of the search

    def __post_init__(self) -> None:
        if self.norm not in NORMS:
            raise ConfigurationError(f"norm: expected one of {', '.join(NORMS)}, found {self.norm!r}")
        require(self.iterations >= 1, f"iterations: expected at least 1, found {self.iterations}")

    def step(
        self, model: BlurModel, state: Gaussian, frame: ArrayLike, inputs: ArrayLike
    ) -> tuple[Gaussian, Innovation]:
        """Correct the predicted state by its frame; see :mod:`.observers`."""
        problem = _Problem(model, state, frame, inputs, self.norm)
        x = _search(problem, _starts(problem.start, problem.cov), self)[:, 0]
        # One linear update with the derivative taken at the minimum.
        residual, derivative, _ = problem.residual(np.arange(len(x)), x)
        H = np.swapaxes(derivative, -1, -2)
        linear = residual + np.einsum("fpn,fn->fp", H, x)
        found, batch = x.reshape(state.mean.shape), state.mean.shape[:-1]
        prior = state if problem.has_prior else Gaussian(found, state.cov / _WEAK)
        linear, H = linear.reshape(*batch, -1), H.reshape(*batch, *H.shape[1:])
        after = update(prior, linear, H, 1.0)
        missed = linear - apply(H, prior.mean)
        # rᵀ(I + H P Hᵀ)⁻¹r, which is never below zero but by rounding.
        squared = (missed * (linear - apply(H, after.mean))).sum(-1)
        innovation = Innovation(np.maximum(squared, 0.0), linear.shape[-1])
        return (after if problem.has_prior else Gaussian(found, after.cov)), innovation


class _Problem:
    """One frame of every batch as a least-squares problem; rows of the batch are addressed by number."""

    def __init__(self, model: BlurModel, state: Gaussian, frame: ArrayLike, inputs: ArrayLike, norm: str) -> None:
        sensor, n, batch = model.sensor, model.motion.order, state.mean.shape[:-1]
        values = model.check_inputs(state, inputs)
        image = np.asarray(frame, np.float64)
        if image.shape != (*batch, sensor.pixels.count) or not np.isfinite(image).all():
            raise DataError(f"frame: expected finite {(*batch, sensor.pixels.count)}, found shape {image.shape}")
        self.model = model
        self.start = state.mean.reshape(-1, n)
        self.cov = np.broadcast_to(state.cov, (*state.mean.shape, n)).reshape(-1, n, n)
        self.image = image.reshape(-1, sensor.pixels.count)
        self.inputs = np.broadcast_to(values, (*batch, values.shape[-1])).reshape(len(self.start), -1)
        try:
            self.information = np.linalg.inv(self.cov)
        except np.linalg.LinAlgError as error:
            raise DataError("cov: expected a covariance that can be inverted, found a singular one") from error
        self.has_prior = norm == "map"
        self.least_light = _LIT * sensor.total / sensor.pixels.width

    def residual(self, rows: NDArray[np.intp], x: Float64Array) -> tuple[Float64Array, Float64Array, NDArray[np.bool_]]:
        """Misfit in units of the noise, (F, P), derivative of the predicted frame, (F, n, P), and whether it is lit."""
        image, derivative = self.model.image_and_jacobian(x, self.inputs[rows])
        deviation = self.model.sensor.deviation
        return (self.image[rows] - image) / deviation, derivative / deviation, image.sum(-1) > self.least_light

    def evaluate(
        self, rows: NDArray[np.intp], x: Float64Array, power: int
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Cost, right-hand side of the Gauss–Newton step, and curvature at x."""
        residual, derivative, lit = self.residual(rows, x)
        weighted = derivative
        if power == 2:
            cost = (residual**2).sum(-1)
        else:
            # The p-norm itself, whose size does not depend on p, and the weights of its curvature.
            top = np.abs(residual).max(-1, keepdims=True)
            cost = ((np.abs(residual) / top) ** power).sum(-1) ** (2 / power) * top[:, 0] ** 2
            ratio = (np.abs(residual) / np.sqrt(cost)[:, None]) ** (power - 2)
            weighted = derivative * ratio[:, None, :]
        right = np.einsum("fap,fp->fa", weighted, residual)
        curvature = (power - 1) * weighted @ np.swapaxes(derivative, -1, -2)
        if not self.has_prior:
            return np.where(lit, cost, np.inf), right, curvature
        away, information = self.start[rows] - x, self.information[rows]
        pull = np.einsum("fab,fb->fa", information, away)
        return cost + (away * pull).sum(-1), right + pull, curvature + information


def _starts(mean: Float64Array, cov: Float64Array) -> Float64Array:
    """Prediction, its negative, and shifts both ways along the axes of the covariance, shape (B, K, n)."""
    values, vectors = np.linalg.eigh(cov)
    axes = _PERTURBED * np.swapaxes(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :], -1, -2)
    here = mean[:, None, :]
    return np.concatenate([here, -here, here + axes, here - axes], 1)


def _search(problem: _Problem, starts: Float64Array, settings: ImageFilter) -> Float64Array:
    """Best minimum of every row, shape (B, 1, n)."""
    powers = _POWERS[settings.norm]
    x, cost, curvature = _descend(problem, starts, powers[0], min(_TRIAL, settings.iterations))
    order = np.argsort(cost, 1)[:, :_KEPT]
    x, cost = np.take_along_axis(x, order[..., None], 1), np.take_along_axis(cost, order, 1)
    distinct = _distinct(x, np.take_along_axis(curvature, order[..., None, None], 1))
    for power in powers:
        x, cost, _ = _descend(problem, x, power, settings.iterations, distinct)
    best = np.argmin(np.where(distinct, cost, np.inf), 1)
    return np.take_along_axis(x, best[:, None, None], 1)


def _distinct(x: Float64Array, curvature: Float64Array) -> NDArray[np.bool_]:
    """Mask of the starts, best first, that are not at the minimum of a better one, shape (B, K)."""
    distinct = np.ones(x.shape[:2], np.bool_)
    for k in range(1, x.shape[1]):
        away = x[:, k, None] - x[:, :k]
        far = np.einsum("bka,bkac,bkc->bk", away, curvature[:, :k], away) > _SAME
        distinct[:, k] = (far | ~distinct[:, :k]).all(1)
    return distinct


def _descend(
    problem: _Problem, starts: Float64Array, power: int, iterations: int, chosen: NDArray[np.bool_] | None = None
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Levenberg–Marquardt from every start separately; converged ones drop out of the batch."""
    batch, count, n = starts.shape
    rows = np.repeat(np.arange(batch), count)
    x = starts.reshape(-1, n).copy()
    active = np.arange(len(x)) if chosen is None else np.flatnonzero(chosen)
    cost, right, curvature = np.full(len(x), np.inf), np.zeros_like(x), np.zeros((len(x), n, n))
    cost[active], right[active], curvature[active] = problem.evaluate(rows[active], x[active], power)
    damping = np.full(len(x), 1e-3)
    for _ in range(iterations):
        a = active
        diagonal = np.einsum("fii->fi", curvature[a]) + 1e-12
        system = curvature[a] + (damping[a, None] * diagonal)[:, :, None] * np.eye(n)
        move = np.linalg.solve(system, right[a, :, None])[..., 0]
        new_cost, new_right, new_curvature = problem.evaluate(rows[a], x[a] + move, power)
        better = new_cost < cost[a]
        gained = a[better]
        x[gained] += move[better]
        cost[gained], right[gained], curvature[gained] = new_cost[better], new_right[better], new_curvature[better]
        damping[a] = np.where(better, 0.2 * damping[a], 10 * damping[a])
        settled = (move**2 * diagonal).max(-1) < _SETTLED
        active = a[~(settled | (damping[a] > 1e6))]
        if not len(active):
            break
    return x.reshape(batch, count, n), cost.reshape(batch, count), curvature.reshape(batch, count, n, n)
