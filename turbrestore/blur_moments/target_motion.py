"""Motions that a tracked target may follow, and what they become at the rate of the frames.

Each motion describes one axis by ``ẋ = A x + w`` with a random force w of the covariance ``q δ(t − s)``.

Symbols
-------
A, q : matrices of the motion in continuous time, method ``dynamics``.
Q : covariance of what the random force adds in a frame period.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from ..core.errors import require
from .kernels import Float64Array
from .lifting import FastSystem, LiftedSystem, lift
from .sensor import ExposureTiming


@dataclass(frozen=True)
class RandomWalk:
    """A target that wanders.

    Parameters
    ----------
    diffusion : float
        Growth of the variance of each coordinate, squared pixels per second.

    Raises
    ------
    ConfigurationError
        Not above 0.

    Examples
    --------
    >>> RandomWalk(3.0).smear(exposure=2.0)
    1.0
    """

    diffusion: float

    def __post_init__(self) -> None:
        _check_positive("diffusion", self.diffusion)

    def dynamics(self) -> tuple[Float64Array, Float64Array]:
        """Position only."""
        return np.zeros((1, 1)), np.array([[self.diffusion]])

    def prior(self, step: float, frame_period: float) -> Float64Array:
        """Around the first centroid."""
        return np.array([[step**2]])

    def smear(self, exposure: float) -> float:
        """Return a sixth of the variance gained: that of a Brownian path about its own mean."""
        return self.diffusion * exposure / 6


@dataclass(frozen=True)
class ConstantVelocity:
    """A target that moves on, with small changes of its velocity.

    Parameters
    ----------
    acceleration : float
        Growth of the variance of each velocity, pixels² per second³.

    Raises
    ------
    ConfigurationError
        Not above 0.

    Examples
    --------
    >>> ConstantVelocity(0.1).prior(step=1.0, frame_period=0.5).diagonal()
    array([ 1., 16.])
    """

    acceleration: float

    def __post_init__(self) -> None:
        _check_positive("acceleration", self.acceleration)

    def dynamics(self) -> tuple[Float64Array, Float64Array]:
        """Position and velocity."""
        return np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, self.acceleration])

    def prior(self, step: float, frame_period: float) -> Float64Array:
        """Any velocity that the displacements allow."""
        return np.diag([step**2, (2 * step / frame_period) ** 2])

    def smear(self, exposure: float) -> float:
        """Return 0: nothing worth mentioning."""
        return 0.0


@dataclass(frozen=True)
class Oscillation:
    """A target that vibrates about a centre, which may drift.

    Parameters
    ----------
    frequency : float
        Hz; with ``highest`` the lower end of the range to search.
    damping : float
        Damping ratio, 0 to below 1.
    drive : float
        Growth of the variance of each velocity by the random force, pixels² per second³.
    drift : float
        Growth of the variance of the centre, squared pixels per second.
    highest : float, optional
        Upper end of the range: the most likely frequency in it is used. Above half the frame rate centroids repeat
        themselves; the second moments tell the repetitions apart.

    Raises
    ------
    ConfigurationError
        A number is not above 0, the damping not below 1, or the range empty.

    Examples
    --------
    >>> len(Oscillation(frequency=12.0, damping=0.1, drive=1.0).dynamics()[0])
    3
    """

    frequency: float
    damping: float
    drive: float
    drift: float = 1e-4
    highest: float | None = None

    def __post_init__(self) -> None:
        _check_positive("frequency", self.frequency)
        _check_positive("drive", self.drive)
        _check_positive("drift", self.drift)
        require(0 <= self.damping < 1, f"damping: expected 0 to below 1, found {self.damping}")
        require(
            self.highest is None or self.frequency < self.highest < np.inf,
            f"highest: expected a frequency above {self.frequency:g} Hz, found {self.highest}",
        )

    def dynamics(self) -> tuple[Float64Array, Float64Array]:
        """Position, velocity and centre."""
        omega = 2 * np.pi * self.frequency
        A = np.array([[0.0, 1.0, 0.0], [-(omega**2), -2 * self.damping * omega, omega**2], [0.0, 0.0, 0.0]])
        return A, np.diag([0.0, self.drive, self.drift])

    def prior(self, step: float, frame_period: float) -> Float64Array:
        """Anywhere in an oscillation of the size of the displacements."""
        return np.diag([step**2, (2 * np.pi * self.frequency * step) ** 2, step**2])

    def smear(self, exposure: float) -> float:
        """Return 0: nothing worth mentioning."""
        return 0.0


TargetMotion = RandomWalk | ConstantVelocity | Oscillation


def lift_motion(motion: TargetMotion, timing: ExposureTiming) -> LiftedSystem:
    """Motion of one axis at the rate of the frames.

    The output is taken in the middle of the fast steps, and the random force of a frame period enters at its end,
    with the covariance ``∫ expm(A t) q expm(Aᵀ t) dt`` (Van Loan 1978).

    Parameters
    ----------
    motion : RandomWalk, ConstantVelocity or Oscillation
    timing : ExposureTiming

    Returns
    -------
    LiftedSystem

    Raises
    ------
    ConfigurationError
        The frames cannot show the state: an oscillation at a multiple of half the frame rate.

    Examples
    --------
    >>> timing = ExposureTiming(fast_period=0.25, exposure=1.0, readout=0.0, frame_period=1.0)
    >>> lift_motion(ConstantVelocity(3.0), timing).Q.round(6).tolist()
    [[1.0, 1.5], [1.5, 3.0]]
    """
    A, intensity = motion.dynamics()
    n = len(A)
    joint = expm(np.block([[-A, intensity], [np.zeros((n, n)), A.T]]) * timing.frame_period)
    Q = joint[n:, n:].T @ joint[:n, n:]
    fast = FastSystem(expm(A * timing.fast_period), np.zeros(n), expm(A * timing.fast_period / 2)[0])
    return lift(fast, timing, 0.5 * (Q + Q.T))


def _check_positive(name: str, value: float) -> None:
    require(0 < value < np.inf, f"{name}: expected a number above 0, found {value}")
