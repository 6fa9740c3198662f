"""Optical flow from one common reference to every frame.

The contract of every method: ``reference(x, y) ≈ frame(x + dx, y + dy)``, flow in pixels, shape (H, W, 2),
so that ``warp(frame, flow)`` lies on the reference (W_k of paper 3, eq. 6: ``I_k ∘ w_k = Kρ``).

Three methods share one driver: ``dis`` (dense inverse search with variational refinement, Kroeger et al. 2016, the
default), ``tvl1`` (Zach, Pock and Bischof 2007, in :mod:`turbrestore.registration.tvl1`) and ``farneback`` (2003).
Paper 3 uses Black–Anandan flow, which these supersede.

Local contrast is normalised first (zero mean, unit deviation in a Gaussian window), so that dark and low-contrast
regions register as well as bright ones; ``contrast_floor`` keeps noise in flat regions from being blown up.

A shift of the whole frame beyond two pixels is measured first (:mod:`turbrestore.registration.global_shift`) and taken
out by whole
pixels, which interpolates nothing: the flow is that shift plus the flow of the shifted frame.  Beyond the edge of the
shifted frame the reference stands in, so that what nobody saw moves with the shift.

A flow may start from an earlier one of the same frame: dense inverse search then leaves out the coarse levels of its
pyramid, whose only use is to find a start, and half of its refinements, for what it starts from is smooth; it takes two
thirds of the time.  Where the start was measured from an image much less sharp, the level above the finest has to mend
it first (``start_level``).  TV-L1 leaves out all levels but two, the coarser of which makes its dual variable too.  The
shift is that of the start, if the frame moved as one.  Farneback's method begins anew.

Where the texture of the reference tells little of the motion, the flow is drawn towards its neighbourhood
(:mod:`turbrestore.registration.confidence`); flat regions move as what surrounds them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray, check_frames, check_image, luminance
from ..core.errors import DataError, require, require_between
from ..core.noise import estimate_noise
from ..runtime.device import PROCESSOR, find_device, memory_of
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import drop_pages, new_stack
from ..runtime.threads import in_batches, map_ahead
from .confidence import flow_confidence, regularise_flow
from .global_shift import DEAD_ZONE, ShiftReference, overlap, refer_shift, shift_against
from .tvl1 import TvL1Params, refer_tvl1, tvl1_flows

MIN_SIDE = 16
# Grey levels per local standard deviation in the 8-bit image that the solvers see: ±4 deviations fit.
_LEVELS_PER_DEVIATION = 32.0
# A frame is shifted as a whole where this share of its flow is no further than the dead zone from the median; both are
# those of so many rows and columns.
_TOGETHER, _SAMPLE = 0.75, 64
# Finest levels that TV-L1 goes through from a start.  One alone loses 0.1 dB on some clips, three save half as much.
_STARTED_LEVELS = 2

GreyBytes = NDArray[np.uint8]
# From a frame (H, W) and a flow to start from, or None, to the flow (H, W, 2); threads share it.
FrameSolver = Callable[[GreyBytes, FloatArray | None], FloatArray]
# From frames (B, H, W) and their starts to flows (B, H, W, 2).
Solver = Callable[[GreyBytes, list[FloatArray | None]], FloatArray]


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
        Distance between patches, pixels.
    refinements : int
        Iterations of the variational refinement; half as many where a flow starts from an earlier one.
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


@dataclass(frozen=True)
class FlowParams:
    """How flow is estimated.

    Parameters
    ----------
    method : {"dis", "tvl1", "farneback"}
        Dense inverse search, TV-L1 or Farneback.
    contrast_window : float
        Standard deviation of the Gaussian window of the local contrast normalisation, pixels; 0 switches the
        normalisation off.
    contrast_floor : float
        Intensity deviation (0 to 1) below which a region counts as flat.
    global_shift : bool
        Take large shifts of whole frames out first.
    confidence : bool
        Draw the flow of flat regions, and along edges, towards its neighbourhood.
    dis : DisParams
        Settings of dense inverse search.
    tvl1 : TvL1Params
        Settings of TV-L1.
    farneback : FarnebackParams
        Settings of Farneback's method.
    """

    method: Literal["dis", "tvl1", "farneback"] = "dis"
    contrast_window: float = 10.0
    contrast_floor: float = 0.01
    global_shift: bool = True
    confidence: bool = True
    dis: DisParams = field(default_factory=DisParams)
    tvl1: TvL1Params = field(default_factory=TvL1Params)
    farneback: FarnebackParams = field(default_factory=FarnebackParams)

    def __post_init__(self) -> None:
        require(
            self.method in FLOW_METHODS,
            f"method: expected one of {', '.join(FLOW_METHODS)}, found {self.method!r}",
        )
        require_between("contrast_window", self.contrast_window, 0, 1000, "pixels")
        require_between("contrast_floor", self.contrast_floor, 1e-6, 1)


@dataclass(frozen=True)
class FlowFrame:
    """A frame with all that is computed once for it, whatever it is compared with.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
    levels : ndarray, uint8, shape (H, W)
        What the solvers see.
    noise : float
        σ of the frame, intensity; 0 where nothing asks for it.
    start : ndarray, shape (H, W, 2) or on a coarser grid, or None
        Flow to it from a reference much like the next, pixels, that its flow can start from.
    """

    image: FloatArray
    levels: GreyBytes
    noise: float
    start: NDArray[np.floating] | None = None


@dataclass(frozen=True)
class FlowReference:
    """An image that flows start from, with all that is computed once for it.

    Attributes
    ----------
    prepare : callable
        From an image of the size of the reference to a FlowFrame; the same for every reference with these settings.
    solve : callable
        From a list of FlowFrame to the list of their flows, pixels.
    shape : tuple of int
        Height and width.
    batch : int
        Frames that are best solved at once.
    threads : int
        Batches that are best solved side by side; 0 means one per available core.
    """

    prepare: Callable[[FloatArray], FlowFrame]
    solve: Callable[[list[FlowFrame]], list[FloatArray]]
    shape: tuple[int, int]
    batch: int
    threads: int

    def frame(
        self, number: int, image: FloatArray, prepared: dict[int, FlowFrame] | None, last: bool = False
    ) -> FlowFrame:
        """Take a frame from those prepared already, or prepare it; it is kept for the next reference unless last."""
        found = (prepared or {}).pop(number, None) or self.prepare(image)
        if prepared is not None and not last:
            prepared[number] = found
        return found


def estimate_flow(
    reference: ArrayLike,
    frames: ArrayLike,
    params: FlowParams | None = None,
    runtime: Runtime = DEFAULT,
) -> FloatArray:
    """Flows from ``reference`` to each of ``frames``.

    Parameters
    ----------
    reference : array_like, shape (H, W) or (H, W, 3)
        Image that every frame is compared with.
    frames : array_like, shape (T, H, W) or (T, H, W, 3)
        Frames; colour is reduced to luminance.
    params : FlowParams, optional
        Method and settings.
    runtime : Runtime
        Threads, device of ``tvl1`` (the other methods are OpenCV's and run on the CPU), and a folder for the flows.

    Returns
    -------
    ndarray, float32, shape (T, H, W, 2)
        Displacements (dx, dy) in pixels with ``reference(x, y) ≈ frame(x + dx, y + dy)``.

    Raises
    ------
    DataError
        Shapes do not agree, an image is smaller than 16×16, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.registration.warp import warp
    >>> y, x = np.mgrid[:64, :64]
    >>> frame = (0.5 + 0.2 * np.sin(x / 3.0) * np.cos(y / 4.0)).astype(np.float32)
    >>> reference = warp(frame, np.full((64, 64, 2), (0.7, 0.0), np.float32))
    >>> flow = estimate_flow(reference, frame[None])[0]
    >>> bool(abs(np.median(flow[..., 0]) - 0.7) < 0.05)
    True
    """
    stack = check_frames(frames)
    flows = new_stack((*stack.shape[:3], 2), runtime.scratch)
    fill_flows(prepare_reference(reference, params, runtime), stack, flows)
    return flows


def fill_flows(
    reference: FlowReference,
    stack: FloatArray,
    flows: FloatArray,
    prepared: dict[int, FlowFrame] | None = None,
    progress: Callable[[int], None] | None = None,
    again: bool = False,
) -> None:
    """Measure the flow to each of ``stack``, put it into ``flows``, and keep what was prepared of a frame.

    Parameters
    ----------
    reference : FlowReference
    stack : ndarray, float32, shape (T, H, W) or (T, H, W, 3)
    flows : ndarray, float32, shape (T, H, W, 2)
        In memory or in a mapped file.
    prepared : dict, optional
        From number to frame, for the next reference; nothing is kept by default.  A byte a pixel of every frame.
    progress : callable, optional
        Called with 1 after each frame, in the calling thread.
    again : bool
        Start from ``flows``, which are those from a reference much like this one.

    Raises
    ------
    DataError
        The frames have another size than the reference.

    Examples
    --------
    >>> import numpy as np
    >>> stack, flows, prepared = np.ones((2, 16, 16), np.float32), np.ones((2, 16, 16, 2), np.float32), {}
    >>> fill_flows(prepare_reference(stack[0]), stack, flows, prepared)
    >>> float(flows.max()), sorted(prepared)
    (0.0, [0, 1])
    """
    if stack.shape[1:3] != reference.shape:
        raise DataError(f"frames: expected {reference.shape} pixels, found {stack.shape[1:3]}")

    def fill(numbers: list[int]) -> None:
        frames = [reference.frame(number, stack[number], prepared) for number in numbers]
        if again:
            frames = [replace(frame, start=flows[number]) for number, frame in zip(numbers, frames, strict=True)]
        for number, flow in zip(numbers, reference.solve(frames), strict=True):
            flows[number] = flow
        drop_pages(flows)
        drop_pages(stack)

    for numbers, _ in map_ahead(fill, in_batches(range(len(stack)), reference.batch), reference.threads):
        if progress is not None:
            for _ in numbers:
                progress(1)


def iterate_flows(
    reference: ArrayLike,
    frames: Iterable[ArrayLike],
    params: FlowParams | None = None,
    runtime: Runtime = DEFAULT,
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield ``(frame, flow)`` in order while a pool of threads solves a few frames ahead.

    Memory is bounded by a handful of frames, however long ``frames`` is.

    Parameters
    ----------
    reference : array_like, shape (H, W) or (H, W, 3)
        Image that every frame is compared with.
    frames : iterable of array_like, shape (H, W) or (H, W, 3)
        Consumed lazily.
    params : FlowParams, optional
        Method and settings.
    runtime : Runtime
        Threads, and the device of ``tvl1``.

    Yields
    ------
    frame : ndarray, float32, shape (H, W) or (H, W, 3)
    flow : ndarray, float32, shape (H, W, 2)
        Displacements (dx, dy) in pixels.

    Raises
    ------
    DataError
        As :func:`estimate_flow`.

    Examples
    --------
    >>> import numpy as np
    >>> y, x = np.mgrid[:32, :32]
    >>> image = (0.5 + 0.2 * np.sin(x / 3.0) * np.cos(y / 4.0)).astype(np.float32)
    >>> [float(abs(flow).max()) for _, flow in iterate_flows(image, [image, image])]
    [0.0, 0.0]
    """
    target = prepare_reference(reference, params, runtime)

    def checked() -> Iterator[FloatArray]:
        for index, frame in enumerate(frames):
            image = check_image(frame, f"frame {index}")
            if image.shape[:2] != target.shape:
                raise DataError(f"frame {index}: expected {target.shape} pixels, found {image.shape[:2]}")
            yield image

    def solve(batch: list[FloatArray]) -> list[FloatArray]:
        return target.solve([target.prepare(frame) for frame in batch])

    for batch, flows in map_ahead(solve, in_batches(checked(), target.batch), target.threads):
        yield from zip(batch, flows, strict=True)


def prepare_reference(
    reference: ArrayLike,
    params: FlowParams | None = None,
    runtime: Runtime = DEFAULT,
    start_level: int = 0,
) -> FlowReference:
    """Prepare the image that flows start from.

    Parameters
    ----------
    reference : array_like, shape (H, W) or (H, W, 3)
    params : FlowParams, optional
        Method and settings.
    runtime : Runtime
        Threads, and the device of ``tvl1``.
    start_level : int
        Level of the pyramid of dense inverse search, counted from the finest that is used, at which flows that have a
        start begin.

    Returns
    -------
    FlowReference

    Raises
    ------
    DataError
        The image is smaller than 16×16, or values are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> y, x = np.mgrid[:32, :32].astype(np.float32)
    >>> reference = prepare_reference(y * x / 1024)
    >>> float(abs(reference.solve([reference.prepare(y * x / 1024)])[0]).max())
    0.0
    """
    params = params or FlowParams()
    target = check_image(reference, "reference")
    if min(target.shape[:2]) < MIN_SIDE:
        raise DataError(
            f"reference: expected at least {MIN_SIDE}×{MIN_SIDE} pixels for optical flow, found "
            f"{target.shape[1]}×{target.shape[0]}"
        )
    prepared = _levels(target, params)
    position = refer_shift(target) if params.global_shift else None
    confidence = flow_confidence(target) if params.confidence else None
    device = find_device(runtime.device) if params.method == "tvl1" else PROCESSOR
    solver = FLOW_METHODS[params.method](params, prepared, start_level, device)

    def prepare(image: FloatArray) -> FlowFrame:
        return FlowFrame(image, _levels(image, params), estimate_noise(image) if confidence is not None else 0.0)

    def solve(batch: list[FlowFrame]) -> list[FloatArray]:
        starts = [None if params.method == "farneback" else _start(frame) for frame in batch]
        shifts = [_whole_shift(frame, start, position) for frame, start in zip(batch, starts, strict=True)]
        levels = [_shifted(frame.levels, s, prepared) for frame, s in zip(batch, shifts, strict=True)]
        pairs = zip(starts, shifts, strict=True)
        starts = [start - shift if start is not None and shift.any() else start for start, shift in pairs]
        flows = list(solver(np.stack(levels), starts))
        if confidence is not None:
            flows = [regularise_flow(f, confidence, frame.noise) for f, frame in zip(flows, batch, strict=True)]
        return [flow + shift if shift.any() else flow for shift, flow in zip(shifts, flows, strict=True)]

    # A device solves a batch at once, while the next is prepared; on the processor every frame has a thread.
    batch, threads = (1, runtime.threads) if device == PROCESSOR else (params.tvl1.batch, 2)
    return FlowReference(prepare, solve, target.shape[:2], batch, threads)


def normalise_contrast(image: ArrayLike, window: float, floor: float = 0.01) -> FloatArray:
    """Zero mean and unit deviation in a Gaussian window.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Intensities; colour is reduced to luminance.
    window : float
        Standard deviation of the window, pixels.
    floor : float
        Deviation that is added in quadrature, so that flat regions stay flat.

    Returns
    -------
    ndarray, float32, shape (H, W)
        Dimensionless.

    Examples
    --------
    >>> import numpy as np
    >>> normalise_contrast(np.full((4, 4), 0.3, np.float32), window=2.0).max().item()
    0.0
    """
    grey = luminance(check_image(image))
    # Centred first: E[x²] − E[x]² loses all digits of a faint texture on a bright ground.
    centred = grey - cv2.GaussianBlur(grey, (0, 0), window)
    deviation = cv2.GaussianBlur(centred * centred, (0, 0), window)
    deviation += np.float32(floor) ** 2
    centred /= np.sqrt(deviation, out=deviation)
    return centred


def _levels(image: FloatArray, params: FlowParams) -> GreyBytes:
    """8-bit image for the solvers: DIS takes nothing else, and the others lose nothing measurable."""
    if params.contrast_window > 0:
        normalised = normalise_contrast(image, params.contrast_window, params.contrast_floor)
        normalised *= _LEVELS_PER_DEVIATION
        normalised += 128.0
        levels = normalised
    else:
        levels = luminance(image) * 255.0
    return np.clip(np.rint(levels, out=levels), 0, 255, out=levels).astype(np.uint8)


def _whole_shift(frame: FlowFrame, start: FloatArray | None, position: ShiftReference | None) -> FloatArray:
    """Shift of the frame in whole pixels, zero where dense flow needs no help."""
    none = np.zeros(2, np.float32)
    if position is None:
        return none
    known = None if start is None else _common_shift(start)
    shift = shift_against(frame.image, position) if known is None else known
    return none if shift is None or np.abs(shift).max() <= DEAD_ZONE else np.rint(shift).astype(np.float32)


def _common_shift(flow: FloatArray) -> FloatArray | None:
    """Median of a flow, none where a part of the scene moves by itself: what it leaves is no border of the frame."""
    sample = flow[:: -(-len(flow) // _SAMPLE), :: -(-flow.shape[1] // _SAMPLE)].reshape(-1, 2)
    shift = np.median(sample, axis=0).astype(np.float32)
    together = (np.abs(sample - shift) <= DEAD_ZONE).all(axis=1).mean()
    return shift if together >= _TOGETHER else None


def _start(frame: FlowFrame) -> FloatArray | None:
    """Flow to start from, on the grid of the frame."""
    if frame.start is None:
        return None
    height, width = frame.levels.shape
    return cv2.resize(frame.start.astype(np.float32, copy=False), (width, height), interpolation=cv2.INTER_LINEAR)


def _shifted(frame: GreyBytes, shift: FloatArray, outside: GreyBytes) -> GreyBytes:
    """Frame on the grid of the reference, which shows where the frame does not reach."""
    if not shift.any():
        return frame
    to, origin = overlap(frame.shape, shift)
    result = outside.copy()
    result[to] = frame[origin]
    return result


def _dis(params: FlowParams, reference: GreyBytes, start_level: int, _device: str) -> Solver:
    def solve(frame: GreyBytes, start: FloatArray | None) -> FloatArray:
        # A solver object keeps buffers that must not be shared between threads, and is cheap beside a flow.
        solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        solver.setFinestScale(params.dis.finest_scale)
        refinements = params.dis.refinements
        if start is not None:
            # Images made of such flows differ by hundredths of a dB from those of all refinements.
            refinements -= refinements // 2
            solver.setCoarsestScale(params.dis.finest_scale + start_level)
        solver.setPatchSize(params.dis.patch_size)
        solver.setPatchStride(params.dis.patch_stride)
        solver.setVariationalRefinementIterations(refinements)
        solver.setVariationalRefinementAlpha(params.dis.smoothness)
        return solver.calc(reference, frame, start)

    return _one_by_one(solve)


def _tvl1(params: FlowParams, reference: GreyBytes, _start_level: int, device: str) -> Solver:
    def solve(frames: GreyBytes, starts: list[FloatArray | None]) -> FloatArray:
        flows = np.empty((*frames.shape, 2), np.float32)
        started = {number: start for number, start in enumerate(starts) if start is not None}
        anew = [number for number in range(len(frames)) if number not in started]
        with memory_of(device, "lower --flow.tvl1.batch"):
            if anew:
                flows[anew] = tvl1_flows(frames[anew].astype(np.float32), referred).flows
            if started:
                known, grey = np.stack(list(started.values())), frames[list(started)].astype(np.float32)
                flows[list(started)] = tvl1_flows(grey, referred, known, _STARTED_LEVELS).flows
        return flows

    with memory_of(device, "take a smaller --roi"):
        referred = refer_tvl1(reference.astype(np.float32), params.tvl1, device)
    return solve


def _farneback(params: FlowParams, reference: GreyBytes, _start_level: int, _device: str) -> Solver:
    settings = params.farneback
    spread = {5: 1.1, 7: 1.5}[settings.neighbourhood]

    def solve(frame: GreyBytes, _: FloatArray | None) -> FloatArray:
        return cv2.calcOpticalFlowFarneback(
            reference,
            frame,
            None,
            0.5,
            settings.levels,
            settings.window,
            settings.iterations,
            settings.neighbourhood,
            spread,
            cv2.OPTFLOW_FARNEBACK_GAUSSIAN,
        )

    return _one_by_one(solve)


def _one_by_one(solve: FrameSolver) -> Solver:
    return lambda frames, starts: np.stack([solve(*pair) for pair in zip(frames, starts, strict=True)])


FLOW_METHODS: dict[str, Callable[[FlowParams, GreyBytes, int, str], Solver]] = {
    "dis": _dis,
    "tvl1": _tvl1,
    "farneback": _farneback,
}
