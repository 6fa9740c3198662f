"""Total variation by differences of neighbouring pixels, periodic, as a penalty of the primal-dual splitting.

``J(u) = Σ_x |∇u|(x)`` is the penalty of the energy F_λ,μ of paper 3, section 5, whose gradient flow is eq. 22.  Symbols
as in :mod:`turbrestore.deconvolution.primal_dual`: ``K = ∇``, ``Kᵀ = −div``.
"""

from __future__ import annotations

from dataclasses import dataclass

from .problem import Array, ArrayOps


def local_gradient(u: Array, ops: ArrayOps) -> Array:
    """Periodic forward differences ∇u.

    ``u`` (H, W); returns (2, H, W).
    """
    return ops.arrays.stack([ops.arrays.roll(u, -1, axis) - u for axis in (0, 1)])


def local_divergence(v: Array, ops: ArrayOps) -> Array:
    """Negative adjoint of :func:`local_gradient`.

    ``v`` (2, H, W); returns (H, W).
    """
    return v[0] - ops.arrays.roll(v[0], 1, 0) + v[1] - ops.arrays.roll(v[1], 1, 1)


@dataclass(frozen=True, eq=False)
class LocalPenalty:
    """J(u) = Σ|∇u|."""

    ops: ArrayOps  # library of its images

    @property
    def norm_squared(self) -> float:
        """Upper bound of ‖∇‖²."""
        return 8.0

    def ascend(self, p: Array | None, u: Array, step: float, relaxation: float) -> tuple[Array, Array]:
        """``p + ρ(p' − p)`` with p' the projection of ``p + s∇u`` on |p|(x) ≤ 1, and −div of it."""
        gradient = local_gradient(u, self.ops)
        p = 0 * gradient if p is None else p
        ascent = p + step * gradient
        p = p + relaxation * (ascent / self._length(ascent).clip(1) - p)
        return p, -local_divergence(p, self.ops)

    def value(self, u: Array) -> float:
        """J(u)."""
        return self.ops.total(self._length(local_gradient(u, self.ops)))

    def _length(self, v: Array) -> Array:
        return self.ops.arrays.sqrt((v * v).sum(0))
