"""TV-L1 optical flow from one reference to many frames.

Symbols
-------
r : reference; f : frame; both of any intensity unit
u : flow, pixels, ``r(x) ≈ f(x + u(x))``; u₀ : flow about which the frame is linearised; ``f_w(x) = f(x + u₀(x))``
ρ(u) = f_w − r + g·(u − u₀) : linearised difference; g : gradient
λ : weight of the data term (``attachment``); α : Huber threshold (``huber``), pixels per pixel

Energy
------
``E(u) = Σ λ|f(x + u) − r(x)| + h_α(∇u₁) + h_α(∇u₂)``.  The absolute value forgives outliers; h_α is quadratic for
gradients below α and linear above.  α = 0 is the total variation of Zach, Pock and Bischof (2007), which makes flows
of flat patches; the flow of turbulence is smooth, and α > 0 (Werlberger et al. 2009) takes the patches away.

Algorithm
---------
From the coarsest level of a pyramid (factor 2) to the image: warp the frame by the present flow, linearise, minimise
the convex problem by a few primal-dual sweeps (:mod:`turbrestore.registration.flow_methods.tvl1_sweeps`), filter
the flow by a median of 5×5, which removes outliers (Wedel et al. 2009), and repeat until half of the pixels move by
less than a tolerance.  A flow that starts from an earlier one goes through the two finest levels only, the coarser of
which also builds up its dual variable.

Departures from Zach et al. and OpenCV's DualTVL1
--------------------------------------------------
- All frames share one reference: its pyramid and gradients are computed once.
- g is the mean of the gradients of the reference and the warped frame.  Both are equal where the flow is right; their
  mean makes the linearisation exact to second order (Malis 2004) and halves the variance of the noise in g.  The
  gradient of the reference alone (inverse compositional: Baker and Matthews 2004) saves a twentieth of the time and
  makes the end-point error 2 to 8 % larger.
- There is no second flow coupled by θ: the proximal map of the data term is known, so the problem itself is solved.
- The dual variable is kept from warp to warp and from level to level: p is a field of directions, which a finer grid
  changes little.  Half of the sweeps then come as near to the minimum.
- Frames are sampled by cubic B-splines.  Where a sample falls outside the frame there is no data term.

Everything but the sweeps is written once for the CPU and for devices (:mod:`turbrestore.runtime.image_stacks`).
"""

from __future__ import annotations

import threading
from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arrays import FloatArray, check_flow, check_frames, check_grey, luminance
from ...core.errors import DataError, require, require_between
from ...runtime.device import CPU, find_device, memory_of
from ...runtime.image_stacks import (
    Shape,
    Stack,
    correlate,
    load,
    median,
    namespace,
    resize,
    sample,
    spline_coefficients,
    store,
)
from .opencv_flow import FlowSolver, GreyImage
from .tvl1_sweeps import FlowProblem, SweepParams, resize_dual, sweep

MEDIANS = (1, 3, 5)
# An image with a shorter side is not reduced further, so levels have at least half of it, as images must.
_LEAST_SIDE = 32
# Gradient, intensity per pixel, that regularises the division by |g|.
_FLAT = 1e-6
# Finest levels that a flow with a start goes through.  One alone loses 0.1 dB on some clips, three save half as much.
_STARTED_LEVELS = 2
# Batches that a device works on at a time: one computes while the next comes and the last goes.
_BATCHES_AT_A_TIME = 2
_ONE = np.ones(1, np.float32)
# Exact for polynomials of degree four.
_DERIVATIVE = (np.array([1, -8, 0, 8, -1]) / 12).astype(np.float32)
# Gaussian of 0.8 pixels, chosen, before every second pixel is dropped.
_BLUR = np.exp(-(np.arange(-2, 3) ** 2) / (2 * 0.8**2))
_REDUCTION = (_BLUR / _BLUR.sum()).astype(np.float32)


@dataclass(frozen=True)
class TvL1Params:
    """Settings of TV-L1 flow.

    Parameters
    ----------
    attachment : float
        Weight of the data term (λ), per unit of intensity; smaller is smoother.  The default is for 8-bit grey levels
        with 32 of them for each local standard deviation.
    huber : float
        Gradient of the flow (α), pixels per pixel, up to which smoothness is quadratic; 0 is the total variation.
    warps : int
        Most warps per level.
    sweeps : int
        Primal-dual sweeps per warp.
    step : float
        Step of the flow in a sweep (τ), pixels: it changes how fast sweeps converge, not to what.  The default was
        chosen on other clips than those of the benchmark.
    median : int
        Side of the median filter after each warp; 1 switches it off, else 3 or 5.
    levels : int
        Most levels of the pyramid; fewer where the image is small.
    tolerance : float
        A level ends when half of its pixels move by less than this in a warp, pixels.
    batch : int
        Frames that a device solves together; memory grows with it.  The CPU solves one after the other.
    """

    attachment: float = 0.08
    huber: float = 0.3
    warps: int = 5
    sweeps: int = 15
    step: float = 0.7
    median: int = 5
    levels: int = 5
    tolerance: float = 0.1
    batch: int = 4

    def __post_init__(self) -> None:
        require_between("attachment", self.attachment, 1e-4, 1e3)
        require_between("huber", self.huber, 0, 10, "pixels per pixel")
        for name in ("warps", "sweeps", "levels", "batch"):
            require_between(name, getattr(self, name), 1, 10_000)
        require_between("step", self.step, 1e-3, 1e3, "pixels")
        require(self.median in MEDIANS, f"median: expected 1 (off), 3 or 5, found {self.median}")
        require_between("tolerance", self.tolerance, 0, 10, "pixels")


@dataclass(frozen=True, eq=False)
class ReferenceLevel:
    """One level of the pyramid of a reference."""

    image: Stack  # (1, H, W)
    gradient: Stack  # (1, 2, H, W)
    # (H, W): pixel coordinates.
    x: Stack
    y: Stack


@dataclass(frozen=True, eq=False)
class TvL1Reference:
    """A reference and everything that is computed from it once for all frames; threads may share it."""

    levels: tuple[ReferenceLevel, ...]  # from the image to the coarsest
    params: TvL1Params


@dataclass(frozen=True, eq=False)
class TvL1Flows:
    """Flows of frames."""

    flows: FloatArray  # (T, H, W, 2): (dx, dy), pixels
    warps: NDArray[np.intp]  # (T,): warps of each frame at full resolution
    settled: NDArray[np.bool_]  # (T,): whether the last of them moved half of the pixels by less than the tolerance


def prepare_tvl1(reference: ArrayLike, params: TvL1Params | None = None, device: str = CPU) -> TvL1Reference:
    """Prepare the reference (H, W[, 3]) of many flows."""
    params = params or TvL1Params()
    image = check_grey(reference, "reference")
    if min(image.shape) < _LEAST_SIDE // 2:
        raise DataError(f"reference: expected at least 16×16 pixels, found {image.shape[1]}×{image.shape[0]}")
    levels = tuple(map(_prepare_level, _pyramid(load(image[None], find_device(device)), params.levels)))
    return TvL1Reference(levels, params)


def tvl1_flows(
    frames: ArrayLike,
    reference: TvL1Reference,
    start: ArrayLike | None = None,
    levels: int | None = None,
    draft: bool = False,
) -> TvL1Flows:
    """Flows from the reference to each of some frames, in the calling thread; a draft leaves out the finest level.

    ``frames`` (T, H, W) or (T, H, W, 3); ``start`` (T, H, W, 2).
    """
    stack = luminance(check_frames(frames))
    shape = tuple(reference.levels[0].image.shape[-2:])
    if stack.shape[1:] != shape:
        raise DataError(f"frames: expected {shape} pixels as the reference has, found {stack.shape[1:]}")
    flows = None if start is None else check_flow(start, "start")
    if flows is not None and flows.shape != (*stack.shape, 2):
        raise DataError(f"start: expected shape {(*stack.shape, 2)}, found {flows.shape}")
    if levels is not None:
        require_between("levels", levels, 1, 10_000)
        reference = replace(reference, levels=reference.levels[:levels])
    # On the CPU a single frame stays in the cache.
    size = 1 if isinstance(reference.levels[0].image, np.ndarray) else len(stack)
    groups = [slice(first, first + size) for first in range(0, len(stack), size)]
    parts = [_solve(stack[group], reference, None if flows is None else flows[group], draft) for group in groups]
    return TvL1Flows(*(np.concatenate([getattr(p, name) for p in parts]) for name in ("flows", "warps", "settled")))


def tvl1_solver(params: TvL1Params, reference: GreyImage, device: str) -> FlowSolver:
    """Prepare TV-L1 from a reference (H, W) as a method of :mod:`turbrestore.registration.flow`."""
    with memory_of(device):
        prepared = prepare_tvl1(reference.astype(np.float32), params, device)
    admitted = threading.Semaphore(_BATCHES_AT_A_TIME) if device != CPU else nullcontext()

    def solve(frames: GreyImage, starts: list[FloatArray | None], draft: bool) -> FloatArray:
        flows = np.empty((*frames.shape, 2), np.float32)
        started = [number for number, start in enumerate(starts) if start is not None]
        others = [number for number, start in enumerate(starts) if start is None]
        with admitted, memory_of(device, "lower flow.tvl1.batch"):
            if others:
                flows[others] = tvl1_flows(frames[others].astype(np.float32), prepared, draft=draft).flows
            if started:
                known = np.stack([start for start in starts if start is not None])
                grey = frames[started].astype(np.float32)
                flows[started] = tvl1_flows(grey, prepared, known, _STARTED_LEVELS).flows
        return flows

    return solve


def _prepare_level(image: Stack) -> ReferenceLevel:
    y, x = (load(axis, image.device) for axis in np.mgrid[: image.shape[-2], : image.shape[-1]].astype(np.float32))
    return ReferenceLevel(image, _gradient(image), x, y)


def _gradient(images: Stack) -> Stack:
    return namespace(images).stack([correlate(images, _DERIVATIVE, _ONE), correlate(images, _ONE, _DERIVATIVE)], 1)


def _pyramid(images: Stack, levels: int) -> list[Stack]:
    pyramid = [images]
    while len(pyramid) < levels and min(pyramid[-1].shape[-2:]) >= _LEAST_SIDE:
        height, width = pyramid[-1].shape[-2:]
        smooth = correlate(pyramid[-1], _REDUCTION, _REDUCTION)
        pyramid.append(resize(smooth, ((height + 1) // 2, (width + 1) // 2)))
    return pyramid


def _solve(frames: FloatArray, reference: TvL1Reference, start: FloatArray | None, draft: bool) -> TvL1Flows:
    """Flows of a batch, from the coarsest level to the finest."""
    device = reference.levels[0].image.device
    pyramid = _pyramid(load(frames, device), len(reference.levels))
    count, *size = pyramid[-1].shape
    flow, dual = (load(np.zeros((count, *axes, *size), np.float32), device) for axes in ((2,), (2, 2)))
    if start is not None:
        flow = _resized(load(np.moveaxis(start, -1, 1), device), tuple(size))
    finest = int(draft and len(pyramid) > 1)
    for level, images in zip(reference.levels[finest:][::-1], pyramid[finest:][::-1], strict=True):
        shape = tuple(images.shape[-2:])
        if tuple(flow.shape[-2:]) != shape:
            flow, dual = _resized(flow, shape), resize_dual(dual, shape)
        warps, settled = _settle(level, spline_coefficients(images), flow, dual, reference)
    flow = _resized(flow, tuple(pyramid[0].shape[-2:])) if finest else flow
    return TvL1Flows(np.moveaxis(store(flow), 1, -1), warps, settled)


def _resized(flow: Stack, shape: Shape) -> Stack:
    """Flow on another grid; displacements scale with it."""
    height, width = flow.shape[-2:]
    result = resize(flow, shape)
    result[:, 0] *= shape[1] / width
    result[:, 1] *= shape[0] / height
    return result


def _settle(
    level: ReferenceLevel, frames: Stack, flow: Stack, dual: Stack, reference: TvL1Reference
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Warp and minimise until the flow of each frame, given as spline coefficients, has settled.

    ``flow`` and ``dual`` are overwritten.
    """
    params, xp = reference.params, namespace(flow)
    sweeps = SweepParams(params.sweeps, params.step, params.huber)
    warps, settled = np.zeros(len(frames), np.intp), np.zeros(len(frames), np.bool_)
    for _ in range(params.warps):
        running = np.flatnonzero(~settled)
        if not len(running):
            break
        before, p = flow[running], dual[running]
        problem = _linearise(level, frames[running], before, reference)
        after = sweep(problem, before, p, sweeps)
        if params.median > 1:
            after = median(after, params.median)
        unchanged = xp.square(after - before).sum(1) < params.tolerance**2
        # Counted where the flow is, so that a device gives back one number for each frame.
        still = store(unchanged.reshape(len(running), -1).sum(1))
        flow[running], dual[running] = after, p
        warps[running] += 1
        settled[running] = 2 * still > unchanged.shape[-2] * unchanged.shape[-1]
    return warps, settled


def _linearise(level: ReferenceLevel, frames: Stack, flow: Stack, reference: TvL1Reference) -> FlowProblem:
    """Linearise the data term about a flow u₀: ``ρ(u) = f_w − r + g·(u − u₀)``, divided by |g|."""
    xp = namespace(flow)
    x, y = level.x + flow[:, 0], level.y + flow[:, 1]
    height, width = x.shape[-2:]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    warped = sample(frames, flow)  # f_w
    g = _gradient(warped)
    g += level.gradient
    # Outside the frame g vanishes, and with it the largest step that the data term can make.
    g *= 0.5 * inside[:, None]
    offset = warped - level.image
    offset -= (g * flow).sum(1)
    length = xp.sqrt(xp.square(g).sum(1) + _FLAT**2)
    offset /= length
    g /= length[:, None]
    return FlowProblem(g, offset, length * reference.params.attachment)
