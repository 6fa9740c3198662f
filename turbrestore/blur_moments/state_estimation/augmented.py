"""An oscillator whose gain, frequency and damping are estimated along with its state.

Paper 2 finds that the error of the model dominates: its plant is known to ±7 dB only.  With the parameters of the plant
in the state, the same observers correct them as well, because they shape the blur.

Symbols
-------
y, ẏ : output and its rate; the first two states.
g, ω, ζ : gain at rest, natural frequency in rad/s and damping ratio of ``ÿ + 2ζω ẏ + ω² y = g ω² u``.  The last three
    states are the logarithms of their ratios to the nominal values, which keeps the parameters positive.
σ, v : decay rate ζω and ω² − σ², the squared frequency of the damped oscillation, negative for strong damping.
c, s : the two damped waves of which all responses consist, :func:`_damped_waves`.

With ``x₂ = y`` and ``x₁ = ẏ + 2ζω y`` this is the system printed in paper 2 (ω = 34 rad/s, ζ = 0.2, g = 1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from ...core.errors import require
from ...filtering.estimates import Gaussian
from ...filtering.kalman import predict
from ..sensor import ExposureTiming, Float64Array


@dataclass(frozen=True)
class Oscillator:
    """Second-order system ``ÿ + 2ζω ẏ + ω² y = g ω² u``."""

    gain: float  # g
    frequency: float  # ω, rad/s, above 0
    damping: float  # ζ, above 0

    def __post_init__(self) -> None:
        for name in ("gain", "frequency", "damping"):
            value = getattr(self, name)
            require(0 < value < np.inf, f"{name}: expected a number above 0, found {value:g}")


@dataclass(frozen=True, eq=False)
class OscillatorMotion:
    """Motion with the state (y, ẏ, ln g/g₀, ln ω/ω₀, ln ζ/ζ₀), in place of a :class:`.lifting.LiftedSystem`."""

    nominal: Oscillator  # g₀, ω₀ and ζ₀
    timing: ExposureTiming
    # (5, 5): covariance of the disturbance between two exposures; its last three variances allow the plant to change.
    Q: Float64Array

    def __post_init__(self) -> None:
        require(np.shape(self.Q) == (5, 5), f"Q: expected shape (5, 5), found {np.shape(self.Q)}")
        object.__setattr__(self, "Q", np.asarray(self.Q, np.float64))

    @property
    def order(self) -> int:
        """Number n of states."""
        return 5

    def path_and_jacobian(
        self, mean: Float64Array, inputs: Float64Array, steps: int | None = None
    ) -> tuple[Float64Array, Float64Array]:
        """Output and its derivative; see :meth:`.lifting.LiftedSystem.path_and_jacobian`."""
        steps = steps or self.timing.exposure_steps
        response = self._responses(mean, steps)
        slopes = response.y[..., :-1].copy()
        forced = _convolve(np.diff(response.step, axis=-1), inputs[..., :steps])
        slopes[..., 2:, :] += forced
        path = np.einsum("...ki,...k->...i", slopes[..., :2, :], mean[..., :2]) + forced[..., 0, :]
        return path, np.swapaxes(slopes, -1, -2)

    def advance(self, state: Gaussian, inputs: Float64Array) -> Gaussian:
        """Predict the state at the start of the next exposure, linearised at the mean."""
        steps = self.timing.frame_steps
        response = self._responses(state.mean, steps)
        backwards = inputs[..., None, steps - 1 :: -1]
        F = np.zeros((*state.mean.shape, 5))
        F[..., 0, :] = response.y[..., -1]
        F[..., 1, :] = response.rate[..., -1]
        held = [(np.diff(part, axis=-1) * backwards).sum(-1) for part in (response.step, response.step_rate)]
        F[..., :2, 2:] += np.stack(held, -2)
        F[..., 2:, 2:] = np.eye(3)
        moved = np.concatenate(
            [np.einsum("...kl,...l->...k", F[..., :2, :2], state.mean[..., :2]), state.mean[..., 2:]], -1
        )
        # The forced response is proportional to the gain, so it equals its derivative with respect to ln g.
        moved[..., :2] += F[..., :2, 2]
        return Gaussian(moved, predict(state, F, self.Q).cov)

    def _responses(self, mean: Float64Array, steps: int) -> _Responses:
        """Responses at the times 0, T_f, …, steps · T_f."""
        # Factors beyond e⁴ occur only in a search that diverges; clipping keeps them from overflowing.
        ratios = np.exp(np.clip(mean[..., 2:, None], -4.0, 4.0))
        g = self.nominal.gain * ratios[..., 0, :]
        omega = self.nominal.frequency * ratios[..., 1, :]
        sigma = self.nominal.damping * ratios[..., 2, :] * omega
        t = self.timing.fast_period * np.arange(steps + 1, dtype=np.float64)
        v = omega**2 - sigma**2
        # The formulas of c and s are singular at critical damping, although c and s are not.
        v = np.where(np.abs(v) < 1e-6 * omega**2, 1e-6 * omega**2, v)
        c, s = _damped_waves(sigma, v, t)
        by_omega = -v * t * s - sigma * t * c, t * c - s - sigma * t * s
        by_zeta = sigma**2 * t * s - sigma * t * c, -(sigma**2) * (t * c - s) / v - sigma * t * s
        y, step, step_rate = mean[..., 0, None], [g * (1 - c - sigma * s)], [g * omega**2 * s]
        rate = mean[..., 1, None]
        columns = [c + sigma * s, s, np.zeros_like(s)]
        rates = [-(omega**2) * s, c - sigma * s, np.zeros_like(s)]
        for (dc, ds), dw in ((by_omega, 2.0), (by_zeta, 0.0)):
            da = dc + sigma * (ds + s)
            columns.append(y * da + rate * ds)
            rates.append(-(omega**2) * (dw * s + ds) * y + rate * (dc - sigma * (ds + s)))
            step.append(-g * da)
            step_rate.append(g * omega**2 * (dw * s + ds))
        return _Responses(*(np.stack(part, -2) for part in (columns, rates, step, step_rate)))


class _Responses(NamedTuple):
    """Responses at the times 0 … steps · T_f, shapes (..., 5, steps + 1) and (..., 3, steps + 1).

    ``y`` and ``rate`` hold the derivatives of the free output and of its rate with respect to the five states.
    ``step`` and ``step_rate`` hold the output and its rate after a unit step of the input, which equal their own
    derivatives with respect to ln g, followed by their derivatives with respect to ln ω and ln ζ.
    """

    y: Float64Array
    rate: Float64Array
    step: Float64Array
    step_rate: Float64Array


def _damped_waves(sigma: Float64Array, v: Float64Array, t: Float64Array) -> tuple[Float64Array, Float64Array]:
    """``e^(−σt) cos(√v t)`` and ``e^(−σt) sin(√v t) / √v``; for v < 0 with cosh and sinh."""
    root = np.sqrt(np.abs(v))
    decay = np.exp(-sigma * t)
    c, s = decay * np.cos(root * t), decay * np.sin(root * t) / root
    strong = v[..., 0] < 0
    if strong.any():
        slow, fast = (np.exp((sign * root - sigma)[strong] * t) for sign in (1, -1))
        c[strong], s[strong] = (slow + fast) / 2, (slow - fast) / (2 * root[strong])
    return c, s


def _convolve(pulse: Float64Array, inputs: Float64Array) -> Float64Array:
    """Convolve the inputs, shape (..., steps), with three pulses, (..., 3, steps); an input acts one step later."""
    steps = pulse.shape[-1]
    size = next_fast_len(2 * steps - 1, real=True)
    response = irfft(rfft(pulse, size) * rfft(inputs, size)[..., None, :], size)[..., : steps - 1]
    return np.concatenate([np.zeros((*response.shape[:-1], 1)), response], -1)
