"""Motions of a target along one axis, driven by a random force: random walk, constant velocity, oscillation.

``ẋ = A x + w`` with a force w of the covariance ``q δ(t − s)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from ..core.errors import require
from .sensor import ExposureTiming, Float64Array
from .state_estimation.lifting import FastSystem, LiftedSystem, lift


@dataclass(frozen=True)
class RandomWalk:
    """A target that performs a random walk."""

    diffusion: float  # growth of the variance of each coordinate, squared pixels per second

    def __post_init__(self) -> None:
        _check_positive(diffusion=self.diffusion)

    def dynamics(self) -> tuple[Float64Array, Float64Array]:
        """Return A and q of the position."""
        return np.zeros((1, 1)), np.array([[self.diffusion]])

    def prior(self, step: float, frame_period: float) -> Float64Array:
        """Covariance around the first centroid."""
        return np.array([[step**2]])


@dataclass(frozen=True)
class ConstantVelocity:
    """A target whose velocity changes little."""

    acceleration: float  # growth of the variance of each velocity, pixels² per second³

    def __post_init__(self) -> None:
        _check_positive(acceleration=self.acceleration)

    def dynamics(self) -> tuple[Float64Array, Float64Array]:
        """Return A and q of position and velocity."""
        return np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, self.acceleration])

    def prior(self, step: float, frame_period: float) -> Float64Array:
        """Covariance that covers all velocities compatible with the displacements."""
        return np.diag([step**2, (2 * step / frame_period) ** 2])


@dataclass(frozen=True)
class Oscillation:
    """A target that vibrates about a centre, which may drift."""

    frequency: float  # Hz; with ``highest`` the lower end of the range to search
    damping: float  # damping ratio, 0 to below 1
    drive: float  # growth of the variance of each velocity by the random force, pixels² per second³
    drift: float = 1e-4  # growth of the variance of the centre, squared pixels per second
    # Upper end of the range; the most likely frequency in the range is used. Above half the frame rate the centroids
    # are aliased, and the second moments tell the aliases apart.
    highest: float | None = None

    def __post_init__(self) -> None:
        _check_positive(frequency=self.frequency, drive=self.drive, drift=self.drift)
        require(0 <= self.damping < 1, f"damping: expected 0 to below 1, found {self.damping}")
        require(
            self.highest is None or self.frequency < self.highest < np.inf,
            f"highest: expected a frequency above {self.frequency:g} Hz, found {self.highest}",
        )

    def dynamics(self) -> tuple[Float64Array, Float64Array]:
        """Return A and q of position, velocity and centre."""
        omega = 2 * np.pi * self.frequency
        A = np.array([[0.0, 1.0, 0.0], [-(omega**2), -2 * self.damping * omega, omega**2], [0.0, 0.0, 0.0]])
        return A, np.diag([0.0, self.drive, self.drift])

    def prior(self, step: float, frame_period: float) -> Float64Array:
        """Covariance of an oscillation of the size of the displacements, at any phase."""
        return np.diag([step**2, (2 * np.pi * self.frequency * step) ** 2, step**2])


TargetMotion = RandomWalk | ConstantVelocity | Oscillation


def lift_motion(motion: TargetMotion, timing: ExposureTiming) -> LiftedSystem:
    """Lift a motion to the rate of the frames.

    The output is taken in the middle of the fast steps. The random force of a frame period is added at its end, with
    the covariance ``∫ expm(A t) q expm(Aᵀ t) dt`` (Van Loan 1978).
    """
    A, intensity = motion.dynamics()
    n = len(A)
    joint = expm(np.block([[-A, intensity], [np.zeros((n, n)), A.T]]) * timing.frame_period)
    Q = joint[n:, n:].T @ joint[:n, n:]
    fast = FastSystem(expm(A * timing.fast_period), np.zeros(n), expm(A * timing.fast_period / 2)[0])
    return lift(fast, timing, 0.5 * (Q + Q.T))


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        require(0 < value < np.inf, f"{name}: expected a number above 0, found {value}")
