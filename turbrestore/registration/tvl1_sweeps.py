"""The inner loop of TV-L1 flow: primal-dual sweeps.

Symbols
-------
u : flow, pixels; u⁺ after a sweep; ū : extrapolated flow ``2u⁺ − u``
p : dual variable, one vector (x, y) for each component of the flow, ``|p| ≤ 1``
ρ(u) = ρ₀ + g·u : linearised difference of frame and reference; g its gradient, ``ĝ = g/|g|``
λ : weight of the data term; α : Huber threshold
τ, σ : step sizes of u and p, ``8 τ σ = 1``; 8 bounds the squared norm of the discrete gradient

The problem is ``min_u Σ λ|ρ(u)| + h_α(∇u₁) + h_α(∇u₂)`` with Huber's ``h_α(v) = |v|²/2α`` up to ``|v| = α`` and
``|v| − α/2`` above, which is ``max_{|p|≤1} p·v − α|p|²/2``; α = 0 is the total variation.  A sweep of Chambolle and
Pock (2011) is

- dual: ``p ← q / max(1, |q|)``, ``q = (p + σ∇ū) / (1 + σα)``
- primal: ``u⁺ = v − clip(ρ(v)/|g|, ±τλ|g|) ĝ``, ``v = u + τ div p``

The primal step is the exact proximal map of ``τλ|ρ|``: v moves along g until ρ vanishes, but no further than τλ|g|.
These are the three cases of the thresholding of Zach, Pock and Bischof (2007), who put it beside a second flow that is
coupled by ``|u − v|²/2θ``; here nothing is coupled and θ does not exist.

∇ takes forward differences, zero across the last row and column; div is its negative adjoint.

A sweep of array operations goes through memory thirty times.  Compiled, it goes through it once: a row of p asks for ū
in it and in the row below, and a row of u for p in it and in the row above, so both steps go down the image together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.arrays import FloatArray
from ..runtime.image_stacks import Shape, Stack, StackOps
from ..runtime.jit import compiled

# Bound of the squared norm of the gradient by forward differences.
_SQUARED_NORM = 8.0


@dataclass(frozen=True, eq=False)
class FlowProblem:
    """Data term of B frames, divided by |g|.

    Attributes
    ----------
    direction : stack, shape (B, 2, H, W)
        ĝ.
    offset : stack, shape (B, H, W)
        ρ₀/|g|, pixels.
    bound : stack, shape (B, H, W)
        λ|g|.
    """

    direction: Stack
    offset: Stack
    bound: Stack


@dataclass(frozen=True)
class SweepParams:
    """Step and count of sweeps.

    Parameters
    ----------
    count : int
        Sweeps.
    step : float
        τ, pixels.
    huber : float
        α, pixels per pixel.
    """

    count: int
    step: float
    huber: float

    @property
    def dual_step(self) -> float:
        """σ."""
        return 1 / (_SQUARED_NORM * self.step)

    @property
    def shrink(self) -> float:
        """``1 / (1 + σα)``."""
        return 1 / (1 + self.dual_step * self.huber)


def sweep(problem: FlowProblem, flow: Stack, dual: Stack, params: SweepParams, arrays: Any) -> Stack:
    """Sweep the flows of a batch.

    Parameters
    ----------
    problem : FlowProblem
        Data term.
    flow : stack, shape (B, 2, H, W)
        u to begin with; overwritten.
    dual : stack, shape (B, 2, 2, H, W)
        p: axis (x, y), component; overwritten by what it ends as.  Its x vanishes in the last column, its y in the
        last row.
    params : SweepParams
        Step and count.
    arrays : module
        ``numpy`` or ``torch``.

    Returns
    -------
    stack, shape (B, 2, H, W)
        u; perhaps ``flow`` itself.

    Examples
    --------
    >>> import numpy as np
    >>> one = np.ones((1, 4, 4), np.float32)
    >>> along_x = np.stack([one, 0 * one], axis=1)
    >>> u, p = np.zeros((1, 2, 4, 4), np.float32), np.zeros((1, 2, 2, 4, 4), np.float32)
    >>> sweep(FlowProblem(along_x, -2 * one, 5 * one), u, p, SweepParams(10, 0.7, 0.3), np)[0, :, 0, 0]
    array([2., 0.], dtype=float32)
    """
    if arrays is np and (loops := compiled(sweep_frame)):
        steps = np.array([params.step, params.dual_step, params.shrink, params.count], flow.dtype)
        for frame in zip(problem.direction, problem.offset, problem.bound, flow, flow.copy(), dual, strict=True):
            loops(*frame, steps)
        return flow
    px, py = dual[:, 0], dual[:, 1]
    upper = problem.bound * params.step
    lower = -upper
    # Scaled at once, so that the dual step only adds.
    scale = params.dual_step * params.shrink
    ahead = flow * scale
    u, v, work, clipped = flow, arrays.empty_like(flow), arrays.empty_like(flow), arrays.empty_like(upper)
    one = arrays.ones_like(upper[:1, :1, :1])
    for _ in range(params.count):
        dual *= params.shrink
        add_differences(ahead, px, py)
        arrays.multiply(px, px, out=v)
        arrays.multiply(py, py, out=work)
        v += work
        arrays.sqrt(v, out=v)
        arrays.maximum(v, one, out=v)
        px /= v
        py /= v
        divergence(px, py, v, arrays)
        v *= params.step
        v += u
        arrays.multiply(v, problem.direction, out=work)
        arrays.add(work[:, 0], work[:, 1], out=clipped)
        clipped += problem.offset
        arrays.minimum(clipped, upper, out=clipped)
        arrays.maximum(clipped, lower, out=clipped)
        arrays.multiply(problem.direction, clipped[:, None], out=work)
        v -= work
        arrays.multiply(v, 2 * scale, out=ahead)
        u *= scale
        ahead -= u
        u, v = v, u
    return u


def sweep_frame(
    direction: FloatArray,
    offset: FloatArray,
    bound: FloatArray,
    flow: FloatArray,
    ahead: FloatArray,
    dual: FloatArray,
    steps: FloatArray,
) -> None:
    """Sweep the flow of one frame; to be compiled.

    Parameters
    ----------
    direction : ndarray, float32, shape (2, H, W)
    offset, bound : ndarray, float32, shape (H, W)
        Of a :class:`FlowProblem`.
    flow, ahead : ndarray, float32, shape (2, H, W)
        u and ū; overwritten.
    dual : ndarray, float32, shape (2, 2, H, W)
        p, as for :func:`sweep`; overwritten.
    steps : ndarray, float32, shape (4,)
        τ, σ, ``1 / (1 + σα)`` and the number of sweeps.

    Examples
    --------
    >>> one, u, p = np.ones((4, 4), np.float32), np.zeros((2, 4, 4), np.float32), np.zeros((2, 2, 4, 4), np.float32)
    >>> sweep_frame(np.stack([one, 0 * one]), -2 * one, 5 * one, u, u.copy(), p, np.float32([0.7, 0.2, 0.9, 10]))
    >>> u[:, 0, 0]
    array([2., 0.], dtype=float32)
    """
    height, width = offset.shape
    step, dual_step, shrink, one = steps[0], steps[1], steps[2], np.float32(1)
    for _ in range(int(steps[3])):
        for row in range(height):
            below = min(row + 1, height - 1)
            for part in range(2):
                px, py, here, under = dual[0, part, row], dual[1, part, row], ahead[part, row], ahead[part, below]
                for column in range(width - 1):
                    x = (px[column] + dual_step * (here[column + 1] - here[column])) * shrink
                    y = (py[column] + dual_step * (under[column] - here[column])) * shrink
                    length = max(np.sqrt(x * x + y * y), one)
                    px[column] = x / length
                    py[column] = y / length
                y = (py[width - 1] + dual_step * (under[width - 1] - here[width - 1])) * shrink
                py[width - 1] = y / max(abs(y), one)
            # Above the first row p is 0.
            above, inside = max(row - 1, 0), np.float32(row > 0)
            px0, px1, py0, py1 = dual[0, 0, row], dual[0, 1, row], dual[1, 0, row], dual[1, 1, row]
            up0, up1 = dual[1, 0, above], dual[1, 1, above]
            u0, u1, ahead0, ahead1 = flow[0, row], flow[1, row], ahead[0, row], ahead[1, row]
            g0, g1, rho, most = direction[0, row], direction[1, row], offset[row], bound[row]
            left0, left1 = np.float32(0), np.float32(0)
            for column in range(width):
                v0 = u0[column] + step * (px0[column] - left0 + py0[column] - inside * up0[column])
                v1 = u1[column] + step * (px1[column] - left1 + py1[column] - inside * up1[column])
                left0, left1 = px0[column], px1[column]
                limit = step * most[column]
                push = min(max(g0[column] * v0 + g1[column] * v1 + rho[column], -limit), limit)
                v0 -= push * g0[column]
                v1 -= push * g1[column]
                ahead0[column] = v0 + v0 - u0[column]
                ahead1[column] = v1 + v1 - u1[column]
                u0[column] = v0
                u1[column] = v1


def add_differences(u: Stack, px: Stack, py: Stack) -> None:
    """Add ∇u to p."""
    px[..., :-1] += u[..., 1:]
    px[..., :-1] -= u[..., :-1]
    py[..., :-1, :] += u[..., 1:, :]
    py[..., :-1, :] -= u[..., :-1, :]


def divergence(px: Stack, py: Stack, out: Stack, arrays: Any) -> None:
    """Negative adjoint of the forward differences, for p that vanishes across the last column and row.

    Parameters
    ----------
    px, py : stack, shape (..., H, W)
        Components of p.
    out : stack, shape (..., H, W)
        Receives div p.
    arrays : module
        ``numpy`` or ``torch``.

    Examples
    --------
    >>> import numpy as np
    >>> px, out = np.array([[1.0, 2.0, 0.0]]), np.empty((1, 3))
    >>> divergence(px, np.zeros((1, 3)), out, np)
    >>> out
    array([[ 1.,  1., -2.]])
    """
    arrays.add(px, py, out=out)
    out[..., 1:] -= px[..., :-1]
    out[..., 1:, :] -= py[..., :-1, :]


def resize_dual(dual: Stack, shape: Shape, ops: StackOps) -> Stack:
    """Dual variable on another grid.

    Parameters
    ----------
    dual : stack, shape (B, 2, 2, h, w)
    shape : tuple of int
        (H, W).
    ops : StackOps

    Returns
    -------
    stack, shape (B, 2, 2, H, W)

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.runtime.image_stacks import numpy_ops
    >>> resize_dual(np.ones((1, 2, 2, 2, 2), np.float32), (3, 3), numpy_ops())[0, :, 0, 1]
    array([[1., 1., 0.],
           [1., 1., 1.]], dtype=float32)
    """
    result = ops.resize(dual, shape)
    # No differences are taken across the border.
    result[:, 0, :, :, -1] = 0
    result[:, 1, :, -1, :] = 0
    return result
