"""Optical flow from one common reference to every frame.

The contract of every method: ``reference(x, y) ≈ frame(x + dx, y + dy)``, flow in pixels, shape (H, W, 2), so that
``warp(frame, flow)`` lies on the reference (W_k of paper 3, eq. 6: ``I_k ∘ w_k = Kρ``).  A frame may bring a start: an
earlier flow to it from a similar reference.

The three methods are ``dis``, the default, and ``farneback``
(:mod:`turbrestore.registration.flow_methods.opencv_flow`), and ``tvl1``
(:mod:`turbrestore.registration.flow_methods.tvl1`).  Paper 3 uses Black–Anandan flow, which these supersede.  One
driver surrounds them all:

1. Local contrast is normalised (zero mean, unit deviation in a Gaussian window), so that dark and low-contrast regions
   register as well as bright ones; ``contrast_floor`` keeps noise in flat regions from being amplified.  If much of the
   gradient of a frame is noise, the method sees frame and reference through a Gaussian of one pixel.
2. A shift of the whole frame by more than two pixels is measured
   (:mod:`turbrestore.registration.camera.global_shift`) and removed by whole pixels, which needs no interpolation.  The
   flow is that shift plus the flow to the shifted frame.
   Pixels beyond the edge of the shifted frame are filled from the reference, so that they move with the shift.  If a
   frame has a start that moves as a whole, the shift is taken from the start.
3. The method measures the flow.  That of dense inverse search is refined by steps at full resolution
   (:mod:`turbrestore.registration.flow_methods.refinement_step`).
4. Where the texture of the reference does not determine the motion, the flow is drawn towards its neighbourhood
   (:mod:`turbrestore.registration.confidence`), so that flat regions move as their surroundings do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import groupby, repeat
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray, check_grey, check_image, check_unit_frames, check_unit_image, luminance
from ..core.errors import DataError, require, require_between, settings_of
from ..core.noise import estimate_noise
from ..runtime.device import CPU, find_device
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import fill_frames, iter_frames, new_stack
from ..runtime.threads import in_batches, map_ahead
from .camera.global_shift import ShiftReference, frame_shift, prepare_shift_reference, shift_frame
from .confidence import flow_confidence, noise_share, regularise_flow
from .flow_methods.opencv_flow import DisParams, FarnebackParams, FlowSolver, GreyImage, dis_solver, farneback_solver
from .flow_methods.refinement_step import RefineFlow, flow_refinement, half_grid
from .flow_methods.tvl1 import TvL1Params, tvl1_solver

# Smallest side of an image, pixels: at half the resolution, that of one matched patch.
MIN_SIDE = 16
# Grey levels for each local standard deviation: ±4 deviations fit into 8 bits.
_LEVELS_PER_DEVIATION = 32.0
# Pixels of the grid, at least, on which averages of local contrast are computed, per deviation of the window; chosen.
_PIXELS_A_DEVIATION = 3
# Most batches that are prepared for a device side by side, chosen.
_BATCHES = 8
# Share of the gradients of a frame above which noise makes it one that is smoothed: at a noise of 0.05 a photograph
# exceeds it, and a chart, which would not gain, does not.  Width of the smoothing, pixels: more gains nothing.
_NOISY, _SMOOTHING = 0.08, 1.0


@dataclass(frozen=True)
class FlowParams:
    """How flow is measured.

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
        Remove large shifts of whole frames first.
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
            self.method in FLOW_METHODS, f"method: expected one of {', '.join(FLOW_METHODS)}, found {self.method!r}"
        )
        require_between("contrast_window", self.contrast_window, 0, 1000, "pixels")
        require_between("contrast_floor", self.contrast_floor, 1e-6, 1)


@dataclass(frozen=True)
class FlowFrame:
    """A frame and everything that is computed from it once, whatever reference it is compared with."""

    image: FloatArray  # (H, W) or (H, W, 3)
    normalised: GreyImage  # (H, W): the frame with its local contrast normalised, which the solvers see
    noise: float  # standard deviation of the noise, intensity
    noisy: bool = False  # whether the solvers see this frame and the reference smoothed
    # (H, W, 2) or on a coarser grid, or None; flow to this frame from a similar reference, pixels, from which the
    # solver starts.
    start: NDArray[np.floating] | None = None
    draft: bool = False  # whether a coarse flow will do, because another will start from it


@dataclass(frozen=True)
class FlowReference:
    """The image that flows start from, and everything that is computed from it once."""

    # From an image of the size of the reference to a FlowFrame; the same for all references with these settings.
    prepare: Callable[[FloatArray], FlowFrame]
    solve: Callable[[list[FlowFrame]], list[FloatArray]]  # from a list of FlowFrame to the list of their flows, pixels
    batch: int  # frames to hand to ``solve`` together
    threads: int  # batches to solve side by side; 0 means one for each available core


def estimate_flow(
    reference: ArrayLike, frames: ArrayLike, params: FlowParams | None = None, runtime: Runtime = DEFAULT
) -> FloatArray:
    """Measure the flow from ``reference`` to each of ``frames``.

    Parameters
    ----------
    reference : array_like, shape (H, W) or (H, W, 3)
        Image that every frame is compared with.
    frames : array_like, shape (T, H, W) or (T, H, W, 3)
        Frames; colour is reduced to luminance.
    params : FlowParams, optional
        Method and settings.
    runtime : Runtime
        Threads, device of ``tvl1`` (OpenCV's methods run on the CPU), and a folder for the flows.

    Returns
    -------
    ndarray, float32, shape (T, H, W, 2)
        Displacements (dx, dy) in pixels with ``reference(x, y) ≈ frame(x + dx, y + dy)``.

    Raises
    ------
    DataError
        Shapes do not agree, an image is smaller than 16×16, or values are not finite or on another scale than 0 to 1.
    ConfigurationError
        Settings are of another type.

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
    stack = check_unit_frames(frames)
    target = prepare_reference(check_unit_image(reference, "reference"), params, runtime)
    flows = new_stack((*stack.shape[:3], 2), runtime.scratch)
    for _ in fill_frames(flows, (flow for _, flow in measure_flows(target, iter_frames(stack)))):
        pass
    return flows


def iterate_flows(
    reference: ArrayLike, frames: Iterable[ArrayLike], params: FlowParams | None = None, runtime: Runtime = DEFAULT
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield frames (H, W[, 3]) and flows (H, W, 2) in order while threads solve a few frames ahead.

    A handful of frames are in memory at a time, however long ``frames`` is.
    """
    target = prepare_reference(reference, params, runtime)
    checked = (check_image(frame, f"frame {number}") for number, frame in enumerate(frames))
    return ((frame.image, flow) for frame, flow in measure_flows(target, checked))


def measure_flows(
    reference: FlowReference,
    frames: Iterable[FloatArray | FlowFrame],
    starts: Iterable[FloatArray | None] = repeat(None),
    draft: bool = False,
) -> Iterator[tuple[FlowFrame, FloatArray]]:
    """Measure flows (H, W, 2) from a prepared reference while threads solve a few frames ahead."""

    def solve(batch: list[tuple[FloatArray | FlowFrame, FloatArray | None]]) -> list[tuple[FlowFrame, FloatArray]]:
        prepared = [
            replace(frame if isinstance(frame, FlowFrame) else reference.prepare(frame), start=start, draft=draft)
            for frame, start in batch
        ]
        return list(zip(prepared, reference.solve(prepared), strict=True))

    batches = in_batches(zip(frames, starts, strict=False), reference.batch)
    for _, solved in map_ahead(solve, batches, reference.threads):
        yield from solved


def prepare_reference(
    reference: ArrayLike, params: FlowParams | None = None, runtime: Runtime = DEFAULT, least_noise: float = 0.0
) -> FlowReference:
    """Prepare the image (H, W[, 3]) that flows start from.

    Frames have at least the noise ``least_noise``, intensity: a single one does not tell smooth noise from detail.
    """
    params = settings_of(FlowParams, params)
    target = check_image(reference, "reference")
    if min(target.shape[:2]) < MIN_SIDE:
        raise DataError(
            f"reference: expected at least {MIN_SIDE}×{MIN_SIDE} pixels for optical flow, found "
            f"{target.shape[1]}×{target.shape[0]}"
        )
    shape, contrast = target.shape[:2], (params.contrast_window, params.contrast_floor)
    position = prepare_shift_reference(target) if params.global_shift else None
    confidence = flow_confidence(target) if params.confidence else None
    device = find_device(runtime.device) if params.method == "tvl1" else CPU

    def prepared(noisy: bool) -> tuple[GreyImage, FlowSolver, RefineFlow | None]:
        normalised = normalise_to_8_bits(target, *contrast, _SMOOTHING * noisy)
        refine = flow_refinement(normalised) if params.method == "dis" else None
        return normalised, FLOW_METHODS[params.method](params, normalised, device), refine

    solvers = {noisy: prepared(noisy) for noisy in (False, True)}

    def prepare(image: FloatArray) -> FlowFrame:
        if image.shape[:2] != shape:
            raise DataError(f"frames: expected {shape} pixels, found {image.shape[:2]}")
        noise = estimate_noise(image)
        noisy = noise_share(image, noise) > _NOISY
        return FlowFrame(image, normalise_to_8_bits(image, *contrast, _SMOOTHING * noisy), noise, noisy)

    def solve(batch: list[FlowFrame]) -> list[FloatArray]:
        alike = groupby(batch, lambda frame: (frame.noisy, frame.draft))
        return [flow for kind, frames in alike for flow in solve_alike(*kind, list(frames))]

    def solve_alike(noisy: bool, draft: bool, batch: list[FlowFrame]) -> list[FloatArray]:
        normalised, solver, refine = solvers[noisy]
        # Farneback's method takes no start.
        usable = [replace(frame, start=None) for frame in batch] if params.method == "farneback" else batch
        placed, starts, shifts = zip(*(_place(frame, normalised, position) for frame in usable), strict=True)
        flows = list(solver(np.stack(placed), list(starts), draft))
        if refine is not None:
            flows = [cv2.resize(flow, half_grid(shape)[::-1], interpolation=cv2.INTER_AREA) for flow in flows]
            if not draft:
                flows = [refine(*moved) for moved in zip(placed, flows, strict=True)]
        if confidence is not None:
            flows = [
                regularise_flow(f, confidence, max(frame.noise, least_noise))
                for f, frame in zip(flows, batch, strict=True)
            ]
        if refine is not None:
            flows = [cv2.resize(flow, shape[::-1], interpolation=cv2.INTER_LINEAR) for flow in flows]
        return [flow + shift if shift.any() else flow for flow, shift in zip(flows, shifts, strict=True)]

    # A device solves a batch at once while others are prepared; on the CPU every frame has a thread.
    batch, threads = (1, runtime.threads) if device == CPU else (params.tvl1.batch, min(runtime.workers, _BATCHES))
    return FlowReference(prepare, solve, batch, threads)


def normalise_contrast(image: ArrayLike, window: float, floor: float = 0.01) -> FloatArray:
    """Luminance (H, W) of an image (H, W[, 3]) with zero mean and unit deviation in a Gaussian window."""
    grey = check_grey(image)
    # Centred first, because E[x²] − E[x]² loses all digits of a faint texture on a bright ground.
    centred = grey - _average(grey, window)
    deviation = _average(centred * centred, window)
    deviation += np.float32(floor) ** 2
    centred /= np.sqrt(deviation, out=deviation)
    return centred


def _average(plane: FloatArray, window: float) -> FloatArray:
    """Average in a Gaussian window, on a grid that resolves it."""
    height, width = plane.shape
    step = max(int(window / _PIXELS_A_DEVIATION), 1)
    size = -(-width // step), -(-height // step)
    small = cv2.resize(plane, size, interpolation=cv2.INTER_AREA)
    sigmas = window * size[0] / width, window * size[1] / height
    small = cv2.GaussianBlur(small, (0, 0), *sigmas, borderType=cv2.BORDER_REFLECT)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR))


def normalise_to_8_bits(image: FloatArray, window: float, floor: float, smoothing: float = 0.0) -> NDArray[np.uint8]:
    """Image (H, W) of normalised local contrast in 8 bits, with 32 grey levels for each local standard deviation."""
    if smoothing > 0:
        image = cv2.GaussianBlur(luminance(image), (0, 0), smoothing)
    if window > 0:
        levels = normalise_contrast(image, window, floor)
        levels *= _LEVELS_PER_DEVIATION
        levels += 128.0
    else:
        levels = luminance(image) * 255.0
    return np.clip(np.rint(levels, out=levels), 0, 255, out=levels).astype(np.uint8)


def _place(
    frame: FlowFrame, outside: GreyImage, position: ShiftReference | None
) -> tuple[GreyImage, FloatArray | None, FloatArray]:
    """Move a frame onto the grid of the reference by whole pixels; ``outside`` supplies what the frame does not show.

    Returns its normalised image (H, W), its start (H, W, 2) from there, and the shift (2,).
    """
    start = None
    if frame.start is not None:
        size = frame.normalised.shape[::-1]
        start = cv2.resize(frame.start.astype(np.float32, copy=False), size, interpolation=cv2.INTER_LINEAR)
    shift = np.zeros(2, np.float32) if position is None else frame_shift(frame.image, start, position)
    if not shift.any():
        return frame.normalised, start, shift
    return shift_frame(frame.normalised, shift, outside), None if start is None else start - shift, shift


FLOW_METHODS: dict[str, Callable[[FlowParams, GreyImage, str], FlowSolver]] = {
    "dis": lambda params, reference, _: dis_solver(params.dis, reference),
    "tvl1": lambda params, reference, device: tvl1_solver(params.tvl1, reference, device),
    "farneback": lambda params, reference, *_: farneback_solver(params.farneback, reference),
}
