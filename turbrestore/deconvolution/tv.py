"""Total variation by differences of neighbouring pixels, periodic, as a penalty of the primal-dual splitting.

``J(u) = Σ_x |∇u|(x)`` is the penalty of the energy ``F(u) = λ/2 ∫ (f − k∗u)² + μ ∫ |∇u|`` of paper 3, section 5.  The
paper descends its gradient,

    ∂u/∂t = λ k*∗(f − k∗u) + μ div(∇u / |∇u|),    (22)

which comes to rest at the minimum that :mod:`turbrestore.deconvolution.primal_dual` finds.  Symbols as there:
``K = ∇``, ``Kᵀ = −div``; μ is 1.  The paper has a Neumann border; here the margin of
:mod:`turbrestore.deconvolution.problem` takes its place.
"""

from __future__ import annotations

from ..runtime.image_stacks import Stack, namespace
from .problem import total


def local_gradient(u: Stack) -> Stack:
    """Periodic forward differences ∇u, (2, H, W), of an image (H, W)."""
    xp = namespace(u)
    return xp.stack([xp.roll(u, -1, axis) - u for axis in (0, 1)])


def local_divergence(v: Stack) -> Stack:
    """Negative adjoint (H, W) of :func:`local_gradient`, for v (2, H, W)."""
    xp = namespace(v)
    return v[0] - xp.roll(v[0], 1, 0) + v[1] - xp.roll(v[1], 1, 1)


def length(v: Stack) -> Stack:
    """|v| at every pixel."""
    return namespace(v).sqrt((v * v).sum(0))


class LocalPenalty:
    """J(u) = Σ|∇u|."""

    norm_squared = 8.0  # upper bound of ‖∇‖²

    def ascend(self, p: Stack | None, u: Stack, step: float, relaxation: float) -> tuple[Stack, Stack]:
        """``p + ρ(p' − p)`` with p' the projection of ``p + s∇u`` on |p|(x) ≤ 1, and −div of it."""
        gradient = local_gradient(u)
        p = 0 * gradient if p is None else p
        ascent = p + step * gradient
        p = p + relaxation * (ascent / length(ascent).clip(1) - p)
        return p, -local_divergence(p)

    def value(self, u: Stack) -> float:
        """J(u)."""
        return total(length(local_gradient(u)))
