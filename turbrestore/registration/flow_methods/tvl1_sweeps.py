"""The inner loop of TV-L1 flow: primal-dual sweeps.

Symbols as in :mod:`turbrestore.registration.flow_methods.tvl1`, and

u⁺ : flow after a sweep; ū : extrapolated flow ``2u⁺ − u``; ``ρ(u) = ρ₀ + g·u``, ``ĝ = g/|g|``
p : dual variable, one vector (x, y) for each component of the flow, ``|p| ≤ 1``
τ, σ : step sizes of u and p, ``8 τ σ = 1``; 8 bounds the squared norm of the discrete gradient

The problem is ``min_u Σ λ|ρ(u)| + h_α(∇u₁) + h_α(∇u₂)`` with Huber's ``h_α(v) = |v|²/2α`` up to ``|v| = α`` and
``|v| − α/2`` above, which is ``max_{|p|≤1} p·v − α|p|²/2``; α = 0 is the total variation.  A sweep of Chambolle and
Pock (2011) is

- dual: ``p ← q / max(1, |q|)``, ``q = (p + σ∇ū) / (1 + σα)``
- primal: ``u⁺ = v − clip(ρ(v)/|g|, ±τλ|g|) ĝ``, ``v = u + τ div p``

The primal step is the exact proximal map of ``τλ|ρ|``: v moves along g until ρ vanishes, but no further than τλ|g|.
These are the three cases of the thresholding of Zach, Pock and Bischof (2007), who apply it to a second flow that is
coupled by ``|u − v|²/2θ``; here nothing is coupled and there is no θ.

∇ takes forward differences, zero across the last row and column; div is its negative adjoint.

On the CPU a compiled loop goes through memory once a sweep: a row of p needs ū in this row and the row below, and a row
of u needs p in this row and the row above, so both steps go down the image together.  A device sweeps a batch by
operations on whole arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import FloatArray
from ...runtime.image_stacks import Shape, Stack, namespace, resize
from ...runtime.jit import jit

# Bound of the squared norm of the gradient by forward differences.
_SQUARED_NORM = 8.0


@dataclass(frozen=True, eq=False)
class FlowProblem:
    """Data term of B frames, divided by |g|."""

    direction: Stack  # (B, 2, H, W): ĝ
    offset: Stack  # (B, H, W): ρ₀/|g|, pixels
    bound: Stack  # (B, H, W): λ|g|


@dataclass(frozen=True)
class SweepParams:
    """Step and count of sweeps."""

    count: int  # sweeps
    step: float  # τ, pixels
    huber: float  # α, pixels per pixel

    @property
    def dual_step(self) -> float:
        """σ."""
        return 1 / (_SQUARED_NORM * self.step)

    @property
    def shrink(self) -> float:
        """``1 / (1 + σα)``."""
        return 1 / (1 + self.dual_step * self.huber)


def sweep(problem: FlowProblem, flow: Stack, dual: Stack, params: SweepParams) -> Stack:
    """Sweep the flows (B, 2, H, W) of a batch; its dual variables (B, 2, 2, H, W) are overwritten."""
    if not isinstance(flow, np.ndarray):
        return _sweep_on_device(problem, flow, dual, params)
    steps = np.array([params.step, params.dual_step, params.shrink, params.count], flow.dtype)
    u, ahead = flow.copy(), flow.copy()
    for number, p in enumerate(dual):
        data_term = problem.direction[number], problem.offset[number], problem.bound[number]
        sweep_frame(*data_term, u[number], ahead[number], p, steps)
    return u


@jit
def sweep_frame(
    direction: FloatArray,
    offset: FloatArray,
    bound: FloatArray,
    flow: FloatArray,
    ahead: FloatArray,
    dual: FloatArray,
    steps: FloatArray,
) -> None:
    """Sweep the flow of one frame.

    ``direction`` (2, H, W); ``offset, bound`` (H, W); ``flow, ahead`` (2, H, W); ``dual`` (2, 2, H, W); ``steps`` (4,).
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


def _sweep_on_device(problem: FlowProblem, flow: Stack, dual: Stack, params: SweepParams) -> Stack:
    """Sweep a batch by operations of torch, in place as far as possible."""
    xp, px, py = namespace(flow), dual[:, 0], dual[:, 1]
    upper = problem.bound * params.step  # τλ|g|
    lower = -upper
    # σ ū / (1 + σα), so that the dual step only adds.
    scale = params.dual_step * params.shrink
    ahead = flow * scale
    u, v, work = flow.clone(), xp.empty_like(flow), xp.empty_like(flow)
    for _ in range(params.count):
        dual *= params.shrink
        add_differences(ahead, px, py)
        xp.hypot(px, py, out=v).clamp_(min=1)
        px /= v
        py /= v
        divergence(px, py, v)
        v *= params.step
        v += u
        xp.mul(v, problem.direction, out=work)
        push = (work.sum(1) + problem.offset).clamp_(lower, upper)
        v -= xp.mul(problem.direction, push[:, None], out=work)
        xp.mul(v, 2 * scale, out=ahead)
        ahead -= u.mul_(scale)
        u, v = v, u
    return u


def add_differences(u: Stack, px: Stack, py: Stack) -> None:
    """Add ∇u to p, arrays (..., H, W) of NumPy or torch."""
    px[..., :-1] += u[..., 1:]
    px[..., :-1] -= u[..., :-1]
    py[..., :-1, :] += u[..., 1:, :]
    py[..., :-1, :] -= u[..., :-1, :]


def divergence(px: Stack, py: Stack, out: Stack) -> None:
    """Negative adjoint of the forward differences, for p (..., H, W) that vanishes across the last column and row."""
    out[...] = px
    out += py
    out[..., 1:] -= px[..., :-1]
    out[..., 1:, :] -= py[..., :-1, :]


def resize_dual(dual: Stack, shape: Shape) -> Stack:
    """Dual variables (B, 2, 2, h, w) on another grid."""
    result = resize(dual, shape)
    # There are no differences across the border.
    result[:, 0, :, :, -1] = 0
    result[:, 1, :, -1, :] = 0
    return result
