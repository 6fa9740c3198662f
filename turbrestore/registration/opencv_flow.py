"""The two flow methods that come from OpenCV: dense inverse search and Farneback's polynomial expansion.

Dense inverse search with variational refinement (Kroeger et al. 2016) is the default method of
:mod:`turbrestore.registration.flow`.  A flow that starts from an earlier one skips the coarse levels of the pyramid,
which only serve to find a start, and three quarters of the refinements, because the start is smooth already, and puts
patches further apart: a third of the time.  A draft, which a flow of the same frame will start from, ends at half the
resolution: a fifth of the time.  Farneback's method (2003) takes no start and makes no drafts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..core.errors import require, require_between

GreyImage = NDArray[np.uint8]
# Takes frames (B, H, W), the flow that each starts from, or None, and whether drafts will do; returns flows
# (B, H, W, 2).  Threads share a solver.
FlowSolver = Callable[[GreyImage, list[FloatArray | None], bool], FloatArray]
# Pixels by which the patches of a flow with a start lie further apart.
_WIDER_STRIDE = 2


@dataclass(frozen=True)
class DisParams:
    """Settings of dense inverse search.

    Parameters
    ----------
    finest_scale : int
        Pyramid level at which the search ends; 0 is full resolution, 1 is about five times faster.
    patch_size : int
        Side of the matched patches, pixels.
    patch_stride : int
        Distance between patches, pixels; two more where a flow starts from an earlier one.
    refinements : int
        Iterations of the variational refinement; half of them for a draft, and a quarter where a flow starts from an
        earlier one.
    smoothness : float
        Weight of the smoothness term in the refinement.
    """

    finest_scale: int = 0
    patch_size: int = 8
    patch_stride: int = 3
    refinements: int = 8
    smoothness: float = 6.0

    def __post_init__(self) -> None:
        require(0 <= self.finest_scale <= 4, f"finest_scale: expected 0 to 4, found {self.finest_scale}")
        require(4 <= self.patch_size <= 32, f"patch_size: expected 4 to 32 pixels, found {self.patch_size}")
        require(
            1 <= self.patch_stride <= self.patch_size,
            f"patch_stride: expected 1 to patch_size ({self.patch_size}), found {self.patch_stride}",
        )
        require_between("refinements", self.refinements, 0, 1000)
        require_between("smoothness", self.smoothness, 1e-3, 1e4)


@dataclass(frozen=True)
class FarnebackParams:
    """Settings of Farneback's polynomial expansion.

    Parameters
    ----------
    window : int
        Side of the averaging window, pixels.
    levels : int
        Pyramid levels.
    iterations : int
        Iterations per level.
    neighbourhood : int
        Side of the polynomial neighbourhood, pixels (5 or 7).
    """

    window: int = 15
    levels: int = 4
    iterations: int = 3
    neighbourhood: int = 5

    def __post_init__(self) -> None:
        require_between("window", self.window, 3, 255, "pixels")
        require_between("levels", self.levels, 1, 20)
        require_between("iterations", self.iterations, 1, 1000)
        require(self.neighbourhood in (5, 7), f"neighbourhood: expected 5 or 7 pixels, found {self.neighbourhood}")


def dis_solver(params: DisParams, reference: GreyImage, start_level: int | None = None) -> FlowSolver:
    """Prepare dense inverse search from a reference.

    With ``start_level`` a start is only a guess: the search begins that many levels above the finest, and is as
    thorough as without a start.  ``reference`` (H, W).
    """

    def solve(frame: GreyImage, start: FloatArray | None, draft: bool) -> FloatArray:
        # A solver object keeps buffers that threads must not share; making one is cheap beside a flow.
        solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        finest, stride, refinements = params.finest_scale + draft, params.patch_stride, params.refinements
        if draft:
            refinements -= refinements // 2
        if start is not None and start_level is not None:
            refinements -= refinements // 2
            solver.setCoarsestScale(finest + start_level)
        elif start is not None:
            refinements = -(-refinements // 4)
            stride = min(stride + _WIDER_STRIDE, params.patch_size)
            solver.setCoarsestScale(finest)
        solver.setFinestScale(finest)
        solver.setPatchSize(params.patch_size)
        solver.setPatchStride(stride)
        solver.setVariationalRefinementIterations(refinements)
        solver.setVariationalRefinementAlpha(params.smoothness)
        return solver.calc(reference, frame, start)

    return lambda frames, starts, draft: np.stack(
        [solve(frame, start, draft) for frame, start in zip(frames, starts, strict=True)]
    )


def farneback_solver(params: FarnebackParams, reference: GreyImage) -> FlowSolver:
    """Prepare Farneback's method from a reference (H, W); it ignores starts."""
    deviation = {5: 1.1, 7: 1.5}[params.neighbourhood]

    def solve(frame: GreyImage) -> FloatArray:
        return cv2.calcOpticalFlowFarneback(
            reference,
            frame,
            None,
            0.5,
            params.levels,
            params.window,
            params.iterations,
            params.neighbourhood,
            deviation,
            cv2.OPTFLOW_FARNEBACK_GAUSSIAN,
        )

    return lambda frames, *_: np.stack([solve(frame) for frame in frames])


def flow_memory(shape: tuple[int, ...], threads: int) -> float:
    """Memory that measuring flow takes beside the frames and their flows."""
    pixels, channels = shape[1] * shape[2], shape[3] if len(shape) > 3 else 1
    return float(pixels * (120 + 5 * channels + threads * (185 + 10 * channels)))
