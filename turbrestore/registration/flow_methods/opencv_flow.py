"""The two flow methods that come from OpenCV: dense inverse search and Farneback's polynomial expansion.

Dense inverse search with variational refinement (Kroeger et al. 2016) is the default method of
:mod:`turbrestore.registration.flow`.  It ends at half the resolution, where it takes an eighth of the time, because
displacements of air are smooth over ten pixels; steps at full resolution
(:mod:`turbrestore.registration.flow_methods.refinement_step`) find what is left.  Farneback's method (2003) takes no
start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...core.errors import require, require_between

GreyImage = NDArray[np.uint8]
# Takes frames (B, H, W), the flow that each starts from, or None, and whether drafts will do; returns flows
# (B, H, W, 2).  Threads share a solver.
FlowSolver = Callable[[GreyImage, list[FloatArray | None], bool], FloatArray]
# Lines above which the flow of air is smooth over so many pixels that a quarter of the resolution will do, chosen.
_LARGE = 1000
# Level, above the finest, at which a search that has a start begins, chosen.
_LEVELS_FROM_START = 1


@dataclass(frozen=True)
class DisParams:
    """Settings of dense inverse search.

    Parameters
    ----------
    finest_scale : int
        Pyramid level at which the search ends: 0 is full resolution, 1 half of it, and so on; one level more for frames
        of more than 1,000 lines.
    patch_size : int
        Side of the matched patches, pixels of that level.
    patch_stride : int
        Distance between patches, pixels of that level.
    refinements : int
        Iterations of the variational refinement.
    smoothness : float
        Weight of the smoothness term in the refinement.
    """

    finest_scale: int = 1
    patch_size: int = 8
    patch_stride: int = 4
    refinements: int = 2
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


def dis_solver(params: DisParams, reference: GreyImage) -> FlowSolver:
    """Prepare dense inverse search from a reference (H, W); a start is a guess, near which the search begins."""
    finest = params.finest_scale + (min(reference.shape) > _LARGE)

    def solve(frame: GreyImage, start: FloatArray | None) -> FloatArray:
        # A solver object keeps buffers that threads must not share; making one is cheap beside a flow.
        solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        if start is not None:
            solver.setCoarsestScale(finest + _LEVELS_FROM_START)
        solver.setFinestScale(finest)
        solver.setPatchSize(params.patch_size)
        solver.setPatchStride(params.patch_stride)
        solver.setVariationalRefinementIterations(params.refinements)
        solver.setVariationalRefinementAlpha(params.smoothness)
        return solver.calc(reference, frame, start)

    return lambda frames, starts, _: np.stack(
        [solve(frame, start) for frame, start in zip(frames, starts, strict=True)]
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
