"""Alternating-estimation Kalman filter over the image and the state of its flow (paper 3, section 4).

Symbols
-------
ρ, Σ : image and its variance per pixel; S drift of the image, Z noise of a registered frame (eqs. 13a, 15)
ξ, P : state of the flow and its covariance; A, C, Q, R from :mod:`turbrestore.dynamics.dynamic_texture` (eqs. 10, 13b)
W^meas : measured flow (eq. 17); Ŵ estimated flow
L, M : gains of the image (eq. 16) and of the flow state (eq. 19)
G : share of the flow outside the subspace of C that is motion and not noise
β : weight of sharpness

Given Ŵ the image is a linear state, given ρ the flow is, so each frame updates one after the other:

1. predict ρ and ξ (eq. 14);
2. measure W^meas from the image to the frame and update ξ (eqs. 17, 19);
3. warp the frame by Ŵ and update ρ (eqs. 15, 16);
4. return to 2 with the new image, ``inner_iterations`` times in all.

Departures from the paper, each with its reason:

* The flow outside the subspace is kept (``residual="keep"``): by eq. 10 the flow is ``C ξ + r``, and where r is
  motion its mean is ``Ŵ = C ξ̂ + G (W^meas − C ξ̂)``.  With ``Ŵ = C ξ̂`` alone (``"drop"``, as printed) that motion
  stays in the frames and blurs the image, below the centroid that the filter starts from.
* Frames are handled in blocks, whose flows are measured side by side; the inner iteration repeats a block from the same
  prior.  The last iteration of a block and the first of the next measure from the same image, and run as one: the
  image holds the earlier block then as its last iteration but one has left it.  A block of one frame is the paper's
  scheme but for that, and but for the frame itself, which the image does not contain when its flow is first measured.
* Every inner iteration starts from the prediction, not from its own result, so a frame counts once; on a linear
  model the iteration then changes nothing.
* Z may vary from pixel to pixel: it falls where a frame is locally sharper than usual, by ``exp(−β z)`` with z the
  standardised local sharpness, the gradient of the frame projected on that of the reference; and it rises where the
  frame shows what the others do not (a bird, a flash), where it was not seen, and where the flow folds, which a
  diffeomorphism does not.  β = 0 is the paper's scalar gain.
* The image starts from a diffuse prior (``prior_frames=0``) and takes the training frames in first; the paper starts
  from the centroid.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray, check_flow, check_image
from ..core.errors import DataError, require, require_between
from ..display.plots import plot_frames
from ..display.preview import preview
from ..dynamics.flow_model import FlowDynamics, flow_of
from ..registration.flow import FlowFrame, FlowParams, iterate_flows
from ..runtime.device import PROCESSOR, check_device, find_device
from ..runtime.threads import one_thread_each
from .flow_tracking import Frames, TrackedFrame, Tracking, state_covariances, track_known, track_measured
from .frame_noise import FrameNoise, measure_frame_noise
from .kalman import Gaussian, PixelGaussian
from .pixel_fusion import PixelFusion
from .torch_fusion import DeviceFusion, fuse_frame, load_fusion, load_pixels, store_pixels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESIDUALS = ("keep", "drop")
FRAME_NOISES = ("sharpness",)
# Variance of an image nothing is known of: full scale, squared.
_DIFFUSE = 1.0


@dataclass(frozen=True)
class FilterParams:
    """How frames are filtered.

    Parameters
    ----------
    residual : {"keep", "drop"}
        What becomes of measured flow outside the subspace of the flow model; ``"drop"`` is the paper as printed.
    inner_iterations : int
        Times that flow is measured, and image and flow updated, for each block of frames.
    block : int
        Frames whose flows are measured against the same image; 1 is closest to the paper, more run side by side.
    frame_noise : {"sharpness"}
        What distinguishes good frames from bad ones: local sharpness.
    sharpness : float
        β: how strongly locally sharp frames are preferred; 0 gives every frame the same scalar gain.
    sharpness_window : float
        Standard deviation of the window in which sharpness is measured, pixels.
    image_noise : float, optional
        Z: variance of a registered frame about the image, squared intensity; by default measured on the first block.
    image_drift : float
        S: variance by which the image may drift from one frame to the next, squared intensity.
    prior_frames : float
        How many frames' worth of information the starting image carries; 0 lets the first frames replace it.
    device : str, optional
        Where frames are warped and fused: cpu, cuda or auto.  By default where the whole chain is
        computed, and cpu for this stage alone.
    """

    residual: Literal["keep", "drop"] = "keep"
    inner_iterations: int = 2
    block: int = 24
    frame_noise: Literal["sharpness"] = "sharpness"
    sharpness: float = 2.0
    sharpness_window: float = 3.0
    image_noise: float | None = None
    image_drift: float = 0.0
    prior_frames: float = 0.0
    device: str | None = None

    def __post_init__(self) -> None:
        require(
            self.residual in RESIDUALS,
            f"residual: expected one of {', '.join(RESIDUALS)}, found {self.residual!r}",
        )
        require(
            self.frame_noise in FRAME_NOISES,
            f"frame_noise: expected one of {', '.join(FRAME_NOISES)}, found {self.frame_noise!r}",
        )
        require_between("inner_iterations", self.inner_iterations, 1, 100)
        require_between("block", self.block, 1, 10_000, "frames")
        require_between("sharpness", self.sharpness, 0, 10)
        require_between("sharpness_window", self.sharpness_window, 0.3, 100, "pixels")
        if self.image_noise is not None:
            require_between("image_noise", self.image_noise, 1e-12, 1)
        require_between("image_drift", self.image_drift, 0, 1)
        require_between("prior_frames", self.prior_frames, 0, 1e6)
        if self.device is not None:
            check_device(self.device)


@dataclass(frozen=True)
class FilterState:
    """What the filter knows between two frames.

    Attributes
    ----------
    image : PixelGaussian
        ρ̂ and Σ.
    flow : Gaussian
        ξ̂ and P.
    """

    image: PixelGaussian
    flow: Gaussian


@dataclass(frozen=True)
class FrameRecord:
    """What the filter notes of one frame; :class:`Filtered` says what each figure means.

    Attributes
    ----------
    flow_state : ndarray, float64, shape (n,)
    gain, innovation, sharpness : float
    information : float
        Mean of 1 / Z over the pixels, before it becomes a share.
    """

    flow_state: np.ndarray
    gain: float
    innovation: float
    sharpness: float
    information: float


@dataclass(frozen=True)
class FilterCheckpoint:
    """Where the filter stands between two blocks of frames; with the same frames it can go on from there.

    Attributes
    ----------
    state : FilterState
        After the frames that have been filtered.
    records : tuple of FrameRecord
        One for each of them.
    reference : ndarray, float32, shape (H, W) or (H, W, 3)
        Image that the flows of the next block are first measured from.
    """

    state: FilterState
    records: tuple[FrameRecord, ...]
    reference: FloatArray


@dataclass(frozen=True)
class Filtered:
    """The filtered image and the record of the run.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        ρ̂ after the last frame, still blurred by Kρ.
    variance : ndarray, float32, shape (H, W)
        Σ after the last frame, squared intensity.
    flow_states : ndarray, float64, shape (N, n)
        ξ̂ after each frame.
    gains : ndarray, float64, shape (N,)
        L of each frame, mean over the pixels.
    innovations : ndarray, float64, shape (N,)
        Root mean square of W^meas − W̄ − C A ξ̂ for each frame, pixels: what the prediction did not foresee; NaN where
        the frame does not count.
    sharpness : ndarray, float64, shape (N,)
        Gradient of each registered frame, projected on that of the image that the filter started from; 1 if they are
        equal, NaN where the frame does not count.
    shares : ndarray, float64, shape (N,)
        Share of the information that each frame brought, mean over the pixels; they sum to 1.
    image_noise : float
        Z, squared intensity.
    motion_share : float
        G, mean over the pixels; 0 with ``residual="drop"``.
    """

    image: FloatArray
    variance: FloatArray
    flow_states: np.ndarray
    gains: np.ndarray
    innovations: np.ndarray
    sharpness: np.ndarray
    shares: np.ndarray
    image_noise: float
    motion_share: float

    def plot(self) -> Figure:
        """Draw how sharp each frame is and how much it counts.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ConfigurationError
            Matplotlib is not installed.
        """
        return plot_frames(self.sharpness, self.shares)

    def _repr_html_(self) -> str:
        facts = [
            ("frames", str(self.gains.size)),
            ("innovation", f"{np.nanmean(self.innovations):.2f} pixels"),
            ("noise of a frame", f"{100 * self.image_noise**0.5:.2f} % of full scale"),
        ]
        return preview("Filtered image", facts, self.image)


@dataclass(frozen=True)
class _Standing:
    """State and records after the frames that are done, and the image that flows are measured from next."""

    state: FilterState
    records: tuple[FrameRecord, ...]
    image: FloatArray


@dataclass(frozen=True)
class _Setting:
    """What stays the same from frame to frame."""

    tracking: Tracking
    params: FilterParams
    fusion: DeviceFusion | None
    marks: NDArray[np.bool_] | None
    known: FloatArray


def filter_frames(
    frames: Iterable[ArrayLike],
    reference: ArrayLike,
    dynamics: FlowDynamics,
    params: FilterParams | None = None,
    flow_params: FlowParams | None = None,
    known_flows: ArrayLike | None = None,
    progress: Callable[[int], None] | None = None,
    counted: ArrayLike | None = None,
    start: FilterCheckpoint | None = None,
    on_checkpoint: Callable[[FilterCheckpoint], None] | None = None,
    prepared: dict[int, FlowFrame] | None = None,
) -> Filtered:
    """Run the alternating-estimation filter over ``frames``.

    Memory is bounded by the first block (as many frames as there are known flows) and does not grow with the number
    of frames.

    Parameters
    ----------
    frames : iterable of array_like, shape (H, W) or (H, W, 3)
        Consumed lazily, once.
    reference : array_like, shape (H, W) or (H, W, 3)
        Image to start from, usually the centroid.
    dynamics : FlowDynamics
        Model of the flow, identified on flows from ``reference``.
    params : FilterParams, optional
        Settings of the filter.
    flow_params : FlowParams, optional
        How flow is measured.
    known_flows : array_like, shape (K, H, W, 2), optional
        Flows already measured from ``reference`` to the first K frames, pixels; they form the first block.
    progress : callable, optional
        Called with 1 after each measured flow.
    counted : array_like, bool, shape (N,), optional
        Frames that the image is made of; from the others nothing is measured, and the flow state is predicted through
        them.  By default all.
    start : FilterCheckpoint, optional
        Where an earlier run with the same arguments stood.  The frames filtered before it are read and passed over, and
        the result is that of one run, bit for bit.
    on_checkpoint : callable, optional
        Called with a FilterCheckpoint after each block of frames.
    prepared : dict, optional
        What :func:`turbrestore.registration.centroid.find_centroid` has prepared of the first frames with the same
        settings; emptied.

    Returns
    -------
    Filtered

    Raises
    ------
    DataError
        No frames, fewer frames than known flows, shapes that do not agree, or values that are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.registration.centroid import find_centroid
    >>> from turbrestore.dynamics.dynamic_texture import identify
    >>> y, x = np.mgrid[:48, :48]
    >>> frames = [0.5 + 0.2 * np.sin((x + np.sin(k)) / 3.0) * np.cos(y / 4.0) for k in range(6)]
    >>> centroid = find_centroid(np.array(frames, np.float32))
    >>> filtered = filter_frames(frames, centroid.image, identify(centroid.flows), known_flows=centroid.flows)
    >>> filtered.image.shape, len(filtered.gains)
    ((48, 48), 6)
    """
    params, flow_params = params or FilterParams(), flow_params or FlowParams()
    image = check_image(reference, "reference")
    flows = _check_flows(image, dynamics, known_flows)
    marks = None if counted is None else np.asarray(counted, bool)
    if marks is not None and not marks.any():
        raise DataError("counted: expected at least one frame to count, found none")
    stream = _checked(frames, image.shape)
    first = _first_block(stream, params.block, flows)
    if flows is None:
        flows = np.stack([flow for _, flow in iterate_flows(image, first, flow_params)])
    model = _noise_model(first, flows, image, dynamics, params, flow_params.threads)
    fusion, share = _fusion(model, params), cv2.merge([model.motion_share] * 2)
    tracking = Tracking(dynamics, model, share, params.sharpness, flow_params, fusion is None, progress)
    setting = _Setting(tracking, params, fusion, marks, flows)
    begun = deque(first if params.inner_iterations > 1 else [])
    prepared = {} if prepared is None else prepared
    with one_thread_each():
        if start is None:
            at = _Standing(_prior(image, setting), (), image)
            at = _filter_window(at, first, len(first) - len(begun), setting, prepared, from_known=True)
            if on_checkpoint is not None and at.records:
                on_checkpoint(FilterCheckpoint(at.state, at.records, at.image))
        else:
            at, begun = _pass_over(start, stream, len(first), setting)
            prepared.clear()
        for passed, checkpoint in _windows(at, begun, stream, setting, prepared):
            at = passed
            if on_checkpoint is not None:
                on_checkpoint(checkpoint)
    if marks is not None and marks.size != len(at.records):
        found = f"{marks.size} marks, {len(at.records)} frames"
        raise DataError(f"counted: expected one mark for each frame, found {found}")
    return _filtered(at, model)


def _check_flows(image: FloatArray, dynamics: FlowDynamics, known_flows: ArrayLike | None) -> FloatArray | None:
    if image.shape[:2] != dynamics.shape:
        raise DataError(f"dynamics: expected flows of {image.shape[:2]} pixels, found {dynamics.shape}")
    flows = None if known_flows is None else check_flow(known_flows, "known_flows")
    if flows is not None and (flows.ndim != 4 or flows.shape[1:3] != dynamics.shape):
        raise DataError(f"known_flows: expected shape (K, {image.shape[0]}, {image.shape[1]}, 2), found {flows.shape}")
    return flows


def _first_block(stream: Iterator[FloatArray], block: int, flows: FloatArray | None) -> list[FloatArray]:
    """Frames with known flows, else as many as any block has."""
    first = list(islice(stream, block if flows is None else len(flows)))
    if not first or (flows is not None and len(first) < len(flows)):
        wanted = 1 if flows is None else len(flows)
        raise DataError(f"frames: expected at least {wanted}, found {len(first)}")
    return first


def _prior(image: FloatArray, setting: _Setting) -> FilterState:
    """State before the first frame."""
    frames, dynamics = setting.params.prior_frames, setting.tracking.dynamics
    variance = setting.tracking.model.image_noise / frames if frames else _DIFFUSE
    return FilterState(
        PixelGaussian(image, np.full(image.shape[:2], variance, np.float32)),
        Gaussian(np.zeros(dynamics.rank), dynamics.state_covariance),
    )


def _pass_over(
    start: FilterCheckpoint, stream: Iterator[FloatArray], read: int, setting: _Setting
) -> tuple[_Standing, deque[FloatArray]]:
    """Read the frames up to a checkpoint, of which the first ``read`` have been; the next block begins anew."""
    done, dynamics, params = len(start.records), setting.tracking.dynamics, setting.params
    shapes = start.state.image.variance.shape, start.state.flow.mean.shape, start.reference.shape
    if done < read or shapes != (dynamics.shape, (dynamics.rank,), start.state.image.mean.shape):
        raise DataError(f"start: expected a checkpoint of these frames, found one of {done} frames and shapes {shapes}")
    for _ in islice(stream, done - read):
        pass
    if setting.tracking.progress is not None:
        setting.tracking.progress(done * params.inner_iterations - read)
    return _Standing(start.state, start.records, start.reference), deque()


def _filtered(at: _Standing, model: FrameNoise) -> Filtered:
    state, records = at.state, at.records
    information = np.array([record.information for record in records])
    return Filtered(
        image=state.image.mean.astype(np.float32),
        variance=state.image.variance.astype(np.float32),
        flow_states=np.array([record.flow_state for record in records]),
        gains=np.array([record.gain for record in records]),
        innovations=np.array([record.innovation for record in records]),
        sharpness=np.array([record.sharpness for record in records]),
        shares=information / information.sum(),
        image_noise=model.image_noise,
        motion_share=float(model.motion_share.mean()),
    )


def _checked(frames: Iterable[ArrayLike], shape: tuple[int, ...]) -> Iterator[FloatArray]:
    for index, frame in enumerate(frames):
        image = check_image(frame, f"frame {index}")
        if image.shape != shape:
            raise DataError(f"frame {index}: expected shape {shape} as the reference has, found {image.shape}")
        yield image


def _left_out(frames: Iterable[FloatArray], marks: NDArray[np.bool_] | None, number: int) -> Frames:
    """Put None for the frames that do not count; ``number`` is that of the first."""
    for index, frame in enumerate(frames, number):
        if marks is not None and index >= marks.size:
            raise DataError(f"counted: expected one mark for each frame, found {marks.size} marks and more frames")
        yield frame if marks is None or marks[index] else None


def _noise_model(
    frames: list[FloatArray],
    flows: FloatArray,
    image: FloatArray,
    dynamics: FlowDynamics,
    params: FilterParams,
    threads: int,
) -> FrameNoise:
    """Read off the first block what holds for all frames."""
    model = measure_frame_noise(
        frames,
        flows,
        image,
        dynamics.residual_variance,
        params.sharpness_window,
        params.image_noise,
        threads,
    )
    largest = np.float32(0) if params.residual == "drop" else dynamics.motion_factor
    return replace(model, motion_share=np.minimum(model.motion_share, largest))


def _windows(
    at: _Standing,
    begun: deque[FloatArray],
    stream: Iterator[FloatArray],
    setting: _Setting,
    prepared: dict[int, FlowFrame],
) -> Iterator[tuple[_Standing, FilterCheckpoint]]:
    """Finish the block that has begun while the next begins, until no frames are left."""
    iterations, size = setting.params.inner_iterations, setting.params.block
    if not begun:
        begun = deque(islice(stream, size))
        # After a checkpoint: begin the block as the run before has done.
        at = _filter_window(at, begun, 0, setting, prepared) if iterations > 1 and begun else at
    while begun:
        for _ in range(iterations - 2):
            at = _filter_window(at, begun, 0, setting, prepared)
        # Both in one stream, because threads stand still where one ends.
        following, first_seen_from = deque[FloatArray](), at.image
        frames = _turn_over(begun, islice(stream, 0 if iterations == 1 else size), following)
        at = _filter_window(at, frames, len(begun), setting, prepared)
        yield at, FilterCheckpoint(at.state, at.records, at.image if iterations == 1 else first_seen_from)
        begun = deque(islice(stream, size)) if iterations == 1 else following


def _turn_over(
    done: deque[FloatArray], stream: Iterable[FloatArray], following: deque[FloatArray]
) -> Iterator[FloatArray]:
    """Give away the frames of one block, and keep those of the next, so that no two blocks are in memory."""
    while done:
        yield done.popleft()
    for frame in stream:
        following.append(frame)
        yield frame


def _filter_window(
    at: _Standing,
    frames: Iterable[FloatArray],
    done: int,
    setting: _Setting,
    prepared: dict[int, FlowFrame],
    from_known: bool = False,
) -> _Standing:
    """One iteration over frames that follow ``at``, the last over the first ``done`` of them."""
    number, marks, known, state = len(at.records), setting.marks, setting.known, at.state
    most = done + (max(setting.params.block, len(known)) if number == 0 else setting.params.block)
    counted = [marks is None or k >= marks.size or bool(marks[k]) for k in range(number, number + most)]
    covariances = state_covariances(state.flow, counted, setting.tracking.dynamics)
    start = state.flow.mean, covariances, _left_out(frames, marks, number)
    if from_known:
        tracked = track_known(*start, known, setting.tracking)
    else:
        tracked = track_measured(*start, at.image, number, done, prepared, known, setting.tracking)
    records = at.records
    if done:
        image, found = _fuse(state.image, islice(tracked, done), setting)
        state = FilterState(image, Gaussian(found[-1].flow_state, covariances[done - 1]))
        records += tuple(found)
    newest = _fuse(state.image, tracked, setting)[0].mean
    # Of frames that do not count, no last flow was measured.
    for index in range(number, number + done):
        prepared.pop(index, None)
    return _Standing(state, records, newest)


def _fusion(model: FrameNoise, params: FilterParams) -> DeviceFusion | None:
    """Bring to a device what fusion needs; None for the processor, where alone blur is measured."""
    device = find_device(params.device or PROCESSOR)
    if device == PROCESSOR:
        return None
    return load_fusion(model, params.sharpness, params.image_drift, device)


def _fuse(
    prior: PixelGaussian, frames: Iterable[TrackedFrame], setting: _Setting
) -> tuple[PixelGaussian, list[FrameRecord]]:
    """Take frame after frame into the image (eqs. 14 and 16)."""
    if setting.fusion is not None:
        return _fuse_on_device(prior, frames, setting.tracking.dynamics, setting.fusion)
    fusion, records = PixelFusion(prior, setting.params.image_drift), list[FrameRecord]()
    for tracked in frames:
        one = tracked.registered
        if one is None:
            records.append(_left_out_record(tracked))
            continue
        gain, information = fusion.take_in(one.frame, one.noise)
        records.append(FrameRecord(tracked.state, gain, tracked.innovation, one.sharpness, information))
    return fusion.image, records


def _fuse_on_device(
    prior: PixelGaussian, frames: Iterable[TrackedFrame], dynamics: FlowDynamics, fusion: DeviceFusion
) -> tuple[PixelGaussian, list[FrameRecord]]:
    """:func:`_fuse`, and what comes before it from the warp on, with the image on a device all the time."""
    pixels = load_pixels(prior, fusion)
    records: list[FrameRecord] = []
    for tracked in frames:
        if tracked.frame is None or tracked.measured is None:
            records.append(_left_out_record(tracked))
            continue
        flow = flow_of(dynamics, tracked.state)
        pixels, fused = fuse_frame(pixels, tracked.frame, flow, tracked.measured, fusion)
        figures = fused.gain, tracked.innovation, fused.sharpness, fused.information
        records.append(FrameRecord(tracked.state, *figures))
    return store_pixels(pixels, fusion), records


def _left_out_record(tracked: TrackedFrame) -> FrameRecord:
    return FrameRecord(tracked.state, gain=0.0, innovation=np.nan, sharpness=np.nan, information=0.0)
