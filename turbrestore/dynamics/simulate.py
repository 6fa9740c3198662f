"""Simulation of flows that move like the training flows: the system is made stationary and driven by noise.

Paper 3, section 3.2 and Figure 6.

Symbols
-------
A, C, Q, W̄, ξ, n : as in :mod:`turbrestore.dynamics.flow_model`
P : covariance of the state
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from ..core.arrays import FloatArray
from ..core.errors import ConfigurationError
from .flow_model import Float64Array, FlowDynamics, check_state, flow_of


@dataclass(frozen=True, eq=False)
class SimulatedFlows:
    """Sequence of simulated flows, each computed on access."""

    dynamics: FlowDynamics  # has C and W̄
    states: Float64Array  # (n, length): one state in each column

    def __len__(self) -> int:
        return self.states.shape[1]

    def __getitem__(self, index: int) -> FloatArray:
        return flow_of(self.dynamics, self.states[:, index])

    def __iter__(self) -> Iterator[FloatArray]:
        return (self[k] for k in range(len(self)))


def stable_system(dynamics: FlowDynamics, largest_modulus: float = 0.99) -> tuple[Float64Array, Float64Array]:
    """Return A and Q (n, n) of a stationary process: A inside the unit circle, P = A P Aᵀ + Q for the training P.

    Eigenvalues of larger modulus are scaled to ``largest_modulus`` and keep their angle; the others do not change. For
    that the blocks on the diagonal of A's real Schur form are scaled, which is well conditioned even if A has no basis
    of eigenvectors. Q is ``P − A P Aᵀ`` with its negative eigenvalues set to zero.
    """
    if not 0 < largest_modulus < 1:
        raise ConfigurationError(f"largest_modulus: expected above 0 and below 1, found {largest_modulus}")
    if dynamics.rank == 0:
        return dynamics.A, dynamics.Q
    deviation = np.sqrt(np.diag(dynamics.state_covariance))
    A = _pull_inside(dynamics.A * deviation / deviation[:, None], largest_modulus)
    values, vectors = np.linalg.eigh(np.eye(len(A)) - A @ A.T)
    Q = (vectors * np.maximum(values, 0.0)) @ vectors.T
    # The stationary covariance is at least the identity, because setting eigenvalues to zero only added to Q.
    stationary, vectors = np.linalg.eigh(linalg.solve_discrete_lyapunov(A, Q))
    shrink = (vectors / np.sqrt(stationary)) @ vectors.T
    grow = (vectors * np.sqrt(stationary)) @ vectors.T
    A, Q = shrink @ A @ grow, shrink @ Q @ shrink
    return A * deviation[:, None] / deviation, 0.5 * (Q + Q.T) * np.outer(deviation, deviation)


def simulate(
    dynamics: FlowDynamics,
    length: int,
    rng: np.random.Generator,
    initial: ArrayLike | None = None,
    largest_modulus: float = 0.99,
) -> SimulatedFlows:
    """Synthesise flows that move like the training flows (paper 3, section 3.2 and Figure 6).

    The paper simulates with A and Q as fitted; here they are those of :func:`stable_system`, so that the simulation
    neither grows nor fades. As in the paper the flows are W̄ + C ξ, without the residual r.

    Parameters
    ----------
    dynamics : FlowDynamics
    length : int
        Number of flows, at least 1.
    rng : numpy.random.Generator
        Source of q; the same state of the generator gives the same flows.
    initial : array_like, shape (n,), optional
        State of the first flow. By default drawn from the stationary distribution.
    largest_modulus : float
        As in :func:`stable_system`.

    Returns
    -------
    SimulatedFlows

    Raises
    ------
    ConfigurationError
        ``length`` or ``largest_modulus`` is out of range.
    DataError
        ``initial`` has another shape, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.dynamics.dynamic_texture import identify
    >>> dynamics = identify(np.random.default_rng(0).standard_normal((9, 4, 4, 2)).astype(np.float32))
    >>> flows = simulate(dynamics, 50, np.random.default_rng(1))
    >>> len(flows), flows[49].shape
    (50, (4, 4, 2))
    """
    if length < 1:
        raise ConfigurationError(f"length: expected at least 1 flow, found {length}")
    A, Q = stable_system(dynamics, largest_modulus)
    values, vectors = np.linalg.eigh(Q)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    states = np.empty((dynamics.rank, length))
    if initial is None:
        states[:, 0] = np.sqrt(np.diag(dynamics.state_covariance)) * rng.standard_normal(dynamics.rank)
    else:
        states[:, 0] = check_state(dynamics, initial)
    noise = root @ rng.standard_normal((dynamics.rank, length - 1))
    for k in range(length - 1):
        states[:, k + 1] = A @ states[:, k] + noise[:, k]
    return SimulatedFlows(dynamics, states)


def _pull_inside(A: Float64Array, largest: float) -> Float64Array:
    """Scale eigenvalues of A whose modulus exceeds ``largest`` to that modulus."""
    T, Z = linalg.schur(A, output="real")
    start = 0
    while start < len(T):
        size = 2 if start + 1 < len(T) and T[start + 1, start] != 0 else 1
        block = slice(start, start + size)
        modulus = np.abs(np.linalg.eigvals(T[block, block])).max()
        if modulus > largest:
            T[block, block] *= largest / modulus
        start += size
    return Z @ T @ Z.T
