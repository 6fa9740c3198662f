"""The centroid: the image at the mean geometry of the frames (paper 3, §3.2).

Symbols
-------
q : current estimate of the centroid
W_i : flow from q to frame I_i; ``W̄ = (1/N) Σ W_i`` (eq. 12), which vanishes at the centroid
V : inverse flow, ``(id + V) = (id + W̄)^{-1}``

The paper warps q by the mean flow, and repeats.  The image moves *with* the mean flow, so backward warping needs the
inverse, which the paper leaves open: ``q ← q ∘ (id + W̄)^{-1}``.  There are three departures from the paper: flows are
composed and frames are interpolated once, where the paper warps the warped image again in every iteration; ``fused``
(the default) averages all registered frames, where the paper (``single``) keeps one warped frame with all of its noise;
and where displacements are large, flows are also searched for anew.  A flow to a blurred reference is wrong in places,
and one that starts from it stays wrong there.  So every other iteration measures draft flows from scratch, and each
frame keeps them where they fit better than its current flow.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import dataclass
from itertools import repeat
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import ROUNDING, FloatArray, check_frames, check_unit_frames, luminance
from ..core.errors import require, require_between, settings_of
from ..display.maps import plot_displacements
from ..display.preview import preview, summary
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import drop_pages, iter_frames, mean_of, new_stack
from ..runtime.steps import finish
from ..runtime.threads import map_ahead, sum_in_threads
from .camera.stabilisation import mean_stabilised
from .flow import FlowFrame, FlowParams, measure_flows, normalise_contrast, prepare_reference
from .flow_algebra import compose_flows, invert_flow
from .registered_noise import noise_of_frames
from .warp import inside, warp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MODES = ("fused", "single")
# If the mean flow keeps this share of its length, chosen, from one iteration to the next, it is the method's bias.  If
# it grows by more than the reciprocal, registration has failed.
_STALLED = 0.8
# Weight of a sample of the repeated border, where a sample inside the frame has 1.  It is to count
# where no frame shows a pixel; chosen.
_UNSEEN = 1e-3
# Root mean square of one component of the displacement above which flows are searched for anew: a quarter of the side
# of a matched patch, pixels, and half the distance over which the detail of the image changes by its deviation.  Within
# either distance, a search at full resolution recovers.  Both chosen.
_FAR, _FAR_OF_DETAIL = 2.0, 0.5
# Share of the variance of the frames, without the motion of whole frames, that flows leave at most where displacement
# makes it: on water whose waves shine they leave more than half, in turbulence less than a third.
_LEFT = 0.4
# New flows that leave more than this share of the misfit of the frames are the last ones; chosen.
_EXHAUSTED = 0.97
# Deviation of the window in which two flows of a frame are compared, pixels, chosen.
_COMPARED = 4.0


@dataclass(frozen=True)
class CentroidParams:
    """How the centroid is iterated.

    Parameters
    ----------
    mode : {"fused", "single"}
        Average of the registered frames, or one warped frame as in the paper.
    iterations : int
        Largest number of iterations; each costs one flow per frame.  The paper runs 10.
    tolerance : float
        Stop when the mean flow is shorter than this, pixels (mean over the image), or shrinks by less than a fifth;
        stop without convergence when it grows by more than a quarter.  ``fused`` runs at least two iterations, because
        it starts from the temporal mean, which is a blurred reference; where displacements are large, it runs until the
        misfit of the registered frames falls by less than 3 %.
        The mean flow that remains is the bias of the flow method; correcting it would bend the image.
    start : int
        Frame that ``single`` warps; ``fused`` starts from the temporal mean, of stabilised frames if
        large shifts are removed first.
    """

    mode: Literal["fused", "single"] = "fused"
    iterations: int = 8
    tolerance: float = 0.15
    start: int = 0

    def __post_init__(self) -> None:
        require(self.mode in MODES, f"mode: expected one of {', '.join(MODES)}, found {self.mode!r}")
        require_between("iterations", self.iterations, 1, 1000)
        require_between("tolerance", self.tolerance, 0, 1000, "pixels")
        require(self.start >= 0, f"start: expected a frame number from 0, found {self.start}")


@dataclass(frozen=True)
class Centroid:
    """The centroid of a stack of frames.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        The centroid (ρ̃ in the paper).
    flows : ndarray, float32, shape (T, H, W, 2)
        Flows from the centroid to each frame, pixels.
    mean_flow_sizes : ndarray, float64, shape (iterations,)
        Mean length of W̄ in each iteration, pixels.  All but the last have been corrected, and the last too if the
        iteration has not converged, or if flows were searched for anew.
    converged : bool
        Whether the last length is below the tolerance, or neither shrank nor grew; where flows were searched for anew,
        whether this found nothing more.
    """

    image: FloatArray
    flows: FloatArray
    mean_flow_sizes: np.ndarray
    converged: bool

    def plot(self) -> Figure:
        """Draw how far every pixel moves over the frames; ConfigurationError without Matplotlib."""
        return plot_displacements(self.flows, self.image)

    def __repr__(self) -> str:
        return summary("Centroid", self._facts(), self.image.shape)

    def _repr_html_(self) -> str:
        return preview("Centroid", self._facts(), self.image)

    def _facts(self) -> list[tuple[str, str]]:
        return [
            ("frames", str(len(self.flows))),
            ("mean flow left", f"{self.mean_flow_sizes[-1]:.2f} pixels"),
            ("iterations", f"{self.mean_flow_sizes.size}, {'' if self.converged else 'not '}converged"),
        ]


@dataclass(frozen=True)
class CentroidState:
    """How far the iteration is."""

    iteration: int  # from 1
    measured: int  # flows measured so far in this iteration


def find_centroid(
    frames: ArrayLike,
    params: CentroidParams | None = None,
    flow_params: FlowParams | None = None,
    runtime: Runtime = DEFAULT,
) -> Centroid:
    """Iterate to the centroid of ``frames``.

    Parameters
    ----------
    frames : array_like, shape (T, H, W) or (T, H, W, 3)
        At least two frames.
    params : CentroidParams, optional
        Mode and stopping.
    flow_params : FlowParams, optional
        How flow is measured.
    runtime : Runtime
        Threads, device, and a folder for the flows; without one they stay in memory.

    Returns
    -------
    Centroid

    Raises
    ------
    DataError
        Fewer than two frames, wrong shapes, values that are not finite or on another scale than 0 to 1.
    ConfigurationError
        ``start`` is not a frame, or settings are of another kind.

    Examples
    --------
    >>> import numpy as np
    >>> y, x = np.mgrid[:48, :48]
    >>> left, right = (0.5 + 0.2 * np.sin((x + s) / 3.0) * np.cos(y / 4.0) for s in (-0.5, 0.5))
    >>> centroid = find_centroid(np.stack([left, right]).astype(np.float32))
    >>> centroid.converged, centroid.image.shape
    (True, (48, 48))
    """
    return finish(centroid_steps(check_unit_frames(frames, at_least=2), params, flow_params, runtime))


def centroid_steps(
    frames: ArrayLike,
    params: CentroidParams | None = None,
    flow_params: FlowParams | None = None,
    runtime: Runtime = DEFAULT,
) -> Generator[CentroidState, None, Centroid]:
    """Iterate to the centroid of ``frames`` flow by flow."""
    params, flow_params = settings_of(CentroidParams, params), settings_of(FlowParams, flow_params, "flow_params")
    stack = check_frames(frames, at_least=2)
    require(params.start < len(stack), f"start: expected a frame below {len(stack)}, found {params.start}")
    if params.mode == "single":
        image = stack[params.start]
    else:
        image = mean_stabilised(stack, runtime.threads) if flow_params.global_shift else mean_of(stack)
    total = np.zeros((*stack.shape[1:3], 2), np.float32)
    flows = new_stack((*stack.shape[:3], 2), runtime.scratch)
    prepared: list[FlowFrame] = []
    sizes: list[float] = []
    misfits: list[float] = []
    fused, far = params.mode == "fused", False
    while True:
        # The first image is a blurred mean, and does not deserve flows at full resolution.
        last = len(sizes) + 1 == params.iterations
        draft = fused and not last and (not sizes or (far and len(sizes) % 2 == 0))
        starts = repeat(None) if draft or not sizes else iter_frames(flows)
        # Only frames that are registered tell smooth noise from detail.
        noise = noise_of_frames(stack, flows, image, fused).deviation if sizes else 0.0
        reference = prepare_reference(image, flow_params, runtime, noise)
        solved = measure_flows(reference, prepared or iter_frames(stack), starts, draft)
        if draft and sizes:
            solved = _better_flows(image, solved, iter_frames(flows), runtime.threads)
        # Prepared frames are kept for the next iteration, unless memory is so short that stacks are in files.
        keep = runtime.scratch is None and not prepared
        for number, (frame, flow) in enumerate(solved):
            flows[number] = flow
            drop_pages(flows)
            if keep:
                prepared.append(frame)
            yield CentroidState(len(sizes) + 1, number + 1)
        mean_flow = mean_of(flows)  # W̄, eq. 12
        sizes.append(float(np.hypot(mean_flow[..., 0], mean_flow[..., 1]).mean()))
        change = sizes[-1] / max(sizes[-2], ROUNDING) if len(sizes) > 1 else 0.0
        # The temporal mean is a blurred reference, so flow is measured from the first registered mean in any case.
        settled = not far and (len(sizes) > 1 or not fused or params.iterations == 1)
        converged = settled and (sizes[-1] <= params.tolerance or _STALLED < change <= 1 / _STALLED)
        if not converged:
            recentre = invert_flow(mean_flow)  # V
            total = total if fused else compose_flows(total, recentre)
            _recentre(flows, recentre, runtime.threads)
        # q ← q ∘ (id + W̄)⁻¹.
        image = mean_registered(stack, flows, runtime) if fused else warp(stack[params.start], total)
        if far and not draft:
            misfits.append(_mean_misfit(image, stack, flows, runtime.threads))
            converged = len(misfits) > 1 and misfits[-1] > _EXHAUSTED * misfits[-2]
        elif fused and len(sizes) == 2 and not last and _is_displaced_far(image, flows, flow_params.contrast_window):
            misfits.append(_mean_misfit(image, stack, flows, runtime.threads))
            far = misfits[0] < _LEFT * _misfit_of_shifts(stack, flows, runtime)
            converged = converged and not far
        if converged or (change > 1 / _STALLED and not far) or last:
            return Centroid(image, flows, np.array(sizes), converged)


def _is_displaced_far(image: FloatArray, flows: FloatArray, window: float) -> bool:
    """Tell whether flows lead so far, without the motion of whole frames, that some of them may be wrong."""
    displacement = np.sqrt(np.mean([np.square(cv2.meanStdDev(flow)[1]).mean() for flow in iter_frames(flows)]))
    return bool(displacement > max(_FAR, _FAR_OF_DETAIL * _detail_length(image, window)))


def _detail_length(image: FloatArray, window: float) -> float:
    """Return the distance, pixels, over which an image, as the flow sees it, changes by its standard deviation."""
    contrast = normalise_contrast(image, window) if window > 0 else luminance(image)
    slope = float(np.square(np.gradient(contrast)).sum(axis=0).mean())
    return float(np.sqrt(2 * contrast.var() / slope)) if slope > 0 else np.inf


def _better_flows(
    image: FloatArray, solved: Iterator[tuple[FlowFrame, FloatArray]], flows: Iterator[FloatArray], threads: int
) -> Iterator[tuple[FlowFrame, FloatArray]]:
    """Take new flows in those parts of a frame that they bring closer to the image than the flows so far."""
    grey = luminance(image)

    def merge(pair: tuple[tuple[FlowFrame, FloatArray], FloatArray]) -> tuple[FlowFrame, FloatArray]:
        (frame, new), old = pair
        seen = luminance(frame.image)
        squares = (np.square(warp(seen, flow) - grey) for flow in (new, old))
        misfit, former = (cv2.GaussianBlur(square, (0, 0), _COMPARED) for square in squares)
        share = cv2.GaussianBlur((misfit < former).astype(np.float32), (0, 0), _COMPARED)[..., None]
        return frame, old + share * (new - old)

    return (merged for _, merged in map_ahead(merge, zip(solved, flows, strict=True), threads))


def _mean_misfit(image: FloatArray, frames: FloatArray, flows: FloatArray, threads: int) -> float:
    """Return the mean squared difference of the registered frames from the image."""

    def misfit(pair: tuple[FloatArray, FloatArray]) -> float:
        return float(np.square(warp(*pair) - image).mean())

    pairs = zip(iter_frames(frames), iter_frames(flows), strict=True)
    return float(np.mean([found for _, found in map_ahead(misfit, pairs, threads)]))


def _misfit_of_shifts(frames: FloatArray, flows: FloatArray, runtime: Runtime) -> float:
    """Return the mean squared difference of the frames from their mean, without the motion of whole frames."""
    shifts = np.array([flow.mean(axis=(0, 1)) for flow in iter_frames(flows)])[:, None, None]
    shifts = np.broadcast_to(shifts, flows.shape)
    return _mean_misfit(mean_registered(frames, shifts, runtime), frames, shifts, runtime.threads)


def _recentre(flows: FloatArray, recentre: FloatArray, threads: int) -> None:
    """Compose flows with ``recentre``, in place, so that they start from the recentred image."""
    for flow, moved in map_ahead(lambda flow: compose_flows(flow, recentre), iter_frames(flows), threads):
        flow[...] = moved
        drop_pages(flows)


def mean_registered(frames: FloatArray, flows: FloatArray, runtime: Runtime = DEFAULT) -> FloatArray:
    """Average of frames (T, H, W[, 3]) warped onto the reference that their flows (T, H, W, 2) start from.

    Each pixel is averaged over the frames that show it; if none does, over all of them, with their borders repeated.
    """

    def add(pairs: list[tuple[FloatArray, FloatArray]]) -> tuple[np.ndarray, np.ndarray]:
        total, weight = np.zeros(frames.shape[1:]), np.zeros(frames.shape[1:3])
        for frame, flow in pairs:
            registered, seen = warp(frame, flow, device=runtime.device), np.maximum(inside(flow), _UNSEEN)
            registered *= seen if registered.ndim == seen.ndim else seen[..., None]
            cv2.accumulate(registered, total)
            cv2.accumulate(seen, weight)
        return total, weight

    total, weight = sum_in_threads(add, zip(iter_frames(frames), iter_frames(flows), strict=True), runtime.threads)
    return (total.T / weight.T).T.astype(np.float32)
