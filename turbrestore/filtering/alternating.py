"""Alternating-estimation Kalman filter over the image and the state of its flow (paper 3, section 4).

Symbols as in :mod:`turbrestore.filtering.image_state` (ρ̂, Σ, Z) and :mod:`turbrestore.filtering.flow_state` (ξ̂, P);
Ŵ is the flow that frames are registered by, and β the weight of sharpness.

Given Ŵ the image is a linear state, given ρ the flow is, so each frame updates one after the other:

1. predict ρ̂ (eqs. 14a, 14c: ``image_state.predict_image``) and ξ̂ (eqs. 14b, 14d: ``flow_state.advance_flow_state``);
2. measure W^meas from the image to the frame (eq. 17: ``frame_pass``) and update ξ̂ (eqs. 18, 19:
   ``flow_state.update_flow_state``);
3. warp the frame by Ŵ (eq. 15: ``frame_noise.register_frame``) and update ρ̂ (eq. 16: ``image_state.update_image``);
4. return to 2 with the new image, ``inner_iterations`` times in all.

Departures from the paper, each with its reason:

* Frames are registered by the measured flow, ``Ŵ = W^meas`` (``residual="keep"``): by eq. 10 the flow is ``C ξ + r``,
  and r is mostly motion.  With ``Ŵ = C ξ̂`` (``"drop"``, as printed) that motion stays in the frames and blurs the
  image, which becomes worse than the centroid that the filter starts from.  Taking a share of r for noise makes the
  image worse on average (``benchmarks/decisions/filter.md``).  So the flow state describes and predicts the
  motion, not the image.
* The measurement equation 13c is nonlinear in image and flow together.  Eqs. 15 and 17, with which the paper replaces
  it, are used alone.  The mean flow W̄ is part of eq. 17 here.
* The paper first updates the image by the predicted flow (its step 2).  Here the flow is measured first, because the
  image of the last frame is there to measure it from.
* Frames are processed in blocks, whose flows are measured in parallel from one image; the inner iteration repeats a
  block from the same prior.  The last iteration of a block and the first of the next block run as one pass, and measure
  their flows from the same image.  That image contains the earlier block in its state before the last iteration.
  Blocks of one frame are not joined: with ``block=1`` the image is that after the last frame, as in the paper.
* Every inner iteration starts from the prediction, not from its own result, so a frame counts once.
* Z varies from pixel to pixel: it is lower where a frame is locally sharper than usual, and higher where the frame
  shows what the others do not (a bird, a flash), where it was not seen, and where the flow folds.  β = 0 is the
  paper's scalar gain.
* The filter includes the training frames, from a diffuse image (``prior_frames=0``).  With ``training="skip"`` it
  starts after them as in the paper: from the centroid and the last of their states.  The mean of W^meas is kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, repeat

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_flow, check_image, check_stream, check_unit_image
from ..core.errors import DataError, require_type, settings_of
from ..dynamics.flow_model import FlowDynamics
from ..registration.flow import FlowParams, iterate_flows
from ..runtime.device import find_device, memory_of
from ..runtime.image_stacks import load, load_image, load_record, store, store_image
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.steps import finish
from .estimates import Gaussian, PixelGaussian, PixelStacks, first_estimates
from .filter_records import FilterCheckpoint, Filtered, FilterParams, FilterState, FilterStep, FrameRecord
from .flow_state import flow_noise
from .frame_pass import Frame, PassSettings, TrackedFrame, pass_over, register
from .frame_statistics import measure_frame_statistics
from .image_state import predict_image, update_image

# Variance of an image of which nothing is known: full scale, squared.
_DIFFUSE = 1.0
# Known flows of the first block; None for frames that do not count.
Flows = FloatArray | Sequence[FloatArray | None]


@dataclass(frozen=True, eq=False)
class _Position:
    """State after the blocks that are done, and the block that has begun."""

    state: FilterState
    records: tuple[FrameRecord, ...]
    reference: FloatArray  # image that flows are measured from next; it contains the block that has begun too
    block: deque[Frame]
    flows_measured: int
    flows_known: bool = False  # whether the next pass takes known flows as measured


def filter_frames(
    frames: Iterable[ArrayLike | None],
    reference: ArrayLike,
    dynamics: FlowDynamics,
    params: FilterParams | None = None,
    flow_params: FlowParams | None = None,
    known_flows: ArrayLike | None = None,
    runtime: Runtime = DEFAULT,
) -> Filtered:
    """Run the alternating-estimation filter over ``frames`` (paper 3, section 4).

    Memory is bounded by the first block, as many frames as there are known flows.

    Parameters
    ----------
    frames : iterable of array_like, shape (H, W) or (H, W, 3), or None
        Consumed lazily, once.  None is a frame that does not count: nothing is measured from it, and the flow state is
        predicted through it.
    reference : array_like, shape (H, W) or (H, W, 3)
        Image to start from, usually the centroid.
    dynamics : FlowDynamics
        Model of the flow, identified on flows from ``reference``.
    params : FilterParams, optional
        Settings of the filter.
    flow_params : FlowParams, optional
        How flow is measured.
    known_flows : array_like, shape (K, H, W, 2), optional
        Flows already measured from ``reference`` to the first K frames, pixels; they form the first block.  A flow to
        a frame that is None is not looked at.
    runtime : Runtime
        Threads and device.

    Returns
    -------
    Filtered

    Raises
    ------
    DataError
        No frame counts, fewer frames than known flows, shapes that do not agree, or values that are not finite or on
        another scale than 0 to 1.
    ConfigurationError
        ``dynamics`` or settings are of another kind.

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
    image = check_unit_image(reference, "reference")
    stream = enumerate(check_stream(frames))
    checked = (None if each is None else check_unit_image(each, f"frame {index}") for index, each in stream)
    return finish(filter_steps(checked, image, dynamics, params, flow_params, known_flows, runtime))


def filter_steps(
    frames: Iterable[ArrayLike | None],
    reference: ArrayLike,
    dynamics: FlowDynamics,
    params: FilterParams | None = None,
    flow_params: FlowParams | None = None,
    known_flows: ArrayLike | None = None,
    runtime: Runtime = DEFAULT,
    start: FilterCheckpoint | None = None,
) -> Generator[FilterStep, None, Filtered]:
    """Run the filter step by step; :func:`filter_frames` runs it to its end and describes the arguments.

    ``start`` resumes from a checkpoint of the same frames and settings.
    """
    params, flow_params = settings_of(FilterParams, params), settings_of(FlowParams, flow_params, "flow_params")
    require_type("dynamics", dynamics, FlowDynamics, "identify(centroid.flows) finds them")
    image = check_image(reference, "reference")
    flows = _check_flows(image, dynamics, known_flows)
    stream = _checked(frames, image.shape)
    block, known = _first_block(stream, params.block, flows)
    trained = known is not None
    if known is None:
        counted = [frame for frame in block if frame is not None]
        measured = (flow for _, flow in iterate_flows(image, counted, flow_params, runtime))
        known = [None if frame is None else next(measured) for frame in block]
    settings = _measure_settings(block, known, image, dynamics, params, flow_params, runtime)
    image_noise = settings.statistics.image_noise
    prior = _prior(image, image_noise, dynamics, params)
    if start is None and params.training == "skip":
        start = _after_training(prior, image, dynamics, len(known))
    if start is None:
        at = _Position(prior, (), image, deque(block), 0, flows_known=True)
    else:
        _check_checkpoint(start, len(block), image.shape, dynamics)
        for _ in islice(stream, len(start.records) - len(block)):
            pass
        flows_measured = len(start.records) * params.inner_iterations - len(known)
        at = _Position(start.state, start.records, start.reference, deque(), flows_measured)
    del block
    with memory_of(settings.runtime.device):
        at = yield from _filter_blocks(at, stream, known, trained, settings)
    return _to_filtered(at, settings)


def _filter_blocks(
    at: _Position, stream: Iterator[FloatArray | None], known: Flows, trained: bool, settings: PassSettings
) -> Generator[FilterStep, None, _Position]:
    """Do steps 1 to 4 of the module docstring for one block after the other.

    ``known`` are the flows to the first block; with ``trained`` they are those of the training frames, and their
    mean is kept.
    """
    size, iterations = settings.params.block, settings.params.inner_iterations
    # The last pass over a block is the first over the next block too, as threads idle at the end of each pass.
    joint = iterations > 1 and size > 1
    passes_done = 0
    while True:
        if not at.block:
            at = replace(at, block=deque(islice(stream, size)))
            if not at.block:
                return at
            known, passes_done = (), 0
        for _ in range(passes_done, iterations - 1):
            at = yield from _iterate(at, settings, known)
        first_block, reference = not at.records, at.reference
        at = yield from _iterate(at, settings, known, last=True, following=islice(stream, size if joint else 0))
        if first_block and trained:
            training_flow = _mean_flow(at.state.flow_sum, at.records)
            at = replace(at, state=replace(at.state, training_flow=training_flow))
        # The joint pass measured the next block's flows from this image, so a resumed run must too; without a joint
        # pass the next block starts from the newest.
        reference = reference if joint else at.reference
        yield FilterStep(at.flows_measured, FilterCheckpoint(at.state, at.records, reference))
        known, passes_done = (), int(joint)


def _iterate(
    at: _Position, settings: PassSettings, known: Flows, last: bool = False, following: Iterable[FloatArray | None] = ()
) -> Generator[FilterStep, None, _Position]:
    """Run one pass over the block that has begun, and over the frames that follow it; ``last`` settles the block."""
    settled = len(at.block) if last else 0
    frames, known_flows = chain(_drain(at.block), following), chain(known, repeat(None))
    reference = None if at.flows_known else at.reference
    device = settings.runtime.device
    image = settled_image = PixelStacks(load_image(at.state.image.mean, device), load(at.state.image.variance, device))
    flow_sum = at.state.flow_sum.copy() if last else at.state.flow_sum
    flow, records, block, flows_measured = at.state.flow, list(at.records), deque[Frame](), at.flows_measured
    for number, tracked in enumerate(pass_over(frames, known_flows, reference, at.state.flow, settled, settings)):
        image, record = _advance_image(image, tracked, settings)
        if number < settled:
            settled_image, flow = image, tracked.state
            records.append(record)
            if tracked.measured is not None:
                flow_sum += tracked.measured
        else:
            block.append(tracked.frame)
        if not at.flows_known:
            flows_measured += 1
            yield FilterStep(flows_measured)
    pixels = PixelGaussian(store_image(settled_image.mean), store(settled_image.variance))
    state = FilterState(pixels, flow, flow_sum, at.state.training_flow)
    return _Position(state, tuple(records), store_image(image.mean), block, flows_measured)


def _advance_image(
    image: PixelStacks, tracked: TrackedFrame, settings: PassSettings
) -> tuple[PixelStacks, FrameRecord]:
    """Predict the image (eq. 14), and update it by a frame that counts (eqs. 15, 16)."""
    frame = tracked.registered or register(tracked, settings)
    predicted = predict_image(image, settings.params.image_drift)
    if frame is None:
        return predicted, FrameRecord(tracked.state.mean, 0.0, tracked.innovation, np.nan, 0.0)
    image, gains = update_image(predicted, frame.channels, frame.noise)
    gain, information = float(gains.mean()), float((1 / frame.noise).mean())
    return image, FrameRecord(tracked.state.mean, gain, tracked.innovation, frame.sharpness, information)


def _drain(block: deque[Frame]) -> Iterator[Frame]:
    """Hand over the frames of a block, so that no two blocks are in memory."""
    while block:
        yield block.popleft()


def _measure_settings(
    block: list[FloatArray | None],
    known: Flows,
    image: FloatArray,
    dynamics: FlowDynamics,
    params: FilterParams,
    flow_params: FlowParams,
    runtime: Runtime,
) -> PassSettings:
    """Measure the statistics of the first block, and bring what is the same for every frame to the device."""
    pairs = [(frame, flow) for frame, flow in zip(block, known, strict=True) if frame is not None and flow is not None]
    statistics = measure_frame_statistics(
        [frame for frame, _ in pairs],
        [flow for _, flow in pairs],
        image,
        params.image_noise,
        runtime.threads,
    )
    device = find_device(runtime.device)
    runtime = replace(runtime, device=device)
    return PassSettings(dynamics, load_record(statistics, device), params, flow_params, runtime)


def _prior(image: FloatArray, image_noise: float, dynamics: FlowDynamics, params: FilterParams) -> FilterState:
    """State before the first frame."""
    variance = image_noise / params.prior_frames if params.prior_frames else _DIFFUSE
    return FilterState(*first_estimates(image, variance, dynamics), *np.zeros((2, *image.shape[:2], 2), np.float32))


def _after_training(
    prior: FilterState, image: FloatArray, dynamics: FlowDynamics, known_flows: int
) -> FilterCheckpoint:
    """Start after the training frames, with the state of the last of them (paper 3, section 6)."""
    if known_flows != dynamics.frame_count:
        raise DataError(
            f"known_flows: expected the {dynamics.frame_count} flows that the dynamics were identified from, found "
            f"{known_flows}"
        )
    last = Gaussian(dynamics.last_state, flow_noise(dynamics) * np.eye(dynamics.rank))
    records = tuple(FrameRecord(state, 0.0, np.nan, np.nan, 0.0) for state in dynamics.states.T)
    return FilterCheckpoint(replace(prior, flow=last), records, image)


def _mean_flow(flow_sum: FloatArray, records: Sequence[FrameRecord]) -> FloatArray:
    """Average the flows (H, W, 2) to the frames that count; 0 if none of them does."""
    return flow_sum / np.float32(max(sum(np.isfinite(record.sharpness) for record in records), 1))


def _to_filtered(at: _Position, settings: PassSettings) -> Filtered:
    """Join the last state and the records of all frames."""
    state, records = at.state, at.records
    information = np.array([record.information for record in records])
    if not information.any():
        raise DataError("frames: expected at least one after those with known flows, found none; train on fewer")
    mean_flow = _mean_flow(state.flow_sum, records) - state.training_flow
    if settings.params.training == "skip":
        # The paper leaves the image in the geometry of the training frames.
        mean_flow = np.zeros_like(mean_flow)
    return Filtered(
        image=state.image.mean.astype(np.float32),
        variance=state.image.variance.astype(np.float32),
        flow_states=np.array([record.flow_state for record in records]),
        gains=np.array([record.gain for record in records]),
        innovations=np.array([record.innovation for record in records]),
        sharpness=np.array([record.sharpness for record in records]),
        shares=information / information.sum(),
        image_noise=settings.statistics.image_noise,
        sharpness_weight=settings.params.sharpness,
        # The mean square of weights exp(β z), with z normal of variance v, over the square of their mean.
        noise_gain=float(np.exp(settings.params.sharpness**2 * store(settings.statistics.score_variance).mean())),
        mean_flow=mean_flow,
    )


def _check_flows(image: FloatArray, dynamics: FlowDynamics, known_flows: ArrayLike | None) -> FloatArray | None:
    shape = dynamics.mean_flow.shape[:2]
    if image.shape[:2] != shape:
        raise DataError(f"dynamics: expected flows of {image.shape[:2]} pixels, found {shape}")
    flows = None if known_flows is None else check_flow(known_flows, "known_flows")
    if flows is not None and (flows.ndim != 4 or flows.shape[1:3] != shape):
        raise DataError(f"known_flows: expected shape (K, {image.shape[0]}, {image.shape[1]}, 2), found {flows.shape}")
    return flows


def _checked(frames: Iterable[ArrayLike | None], shape: tuple[int, ...]) -> Iterator[FloatArray | None]:
    for index, frame in enumerate(frames):
        image = None if frame is None else check_image(frame, f"frame {index}")
        if image is not None and image.shape != shape:
            raise DataError(f"frame {index}: expected shape {shape} as the reference has, found {image.shape}")
        yield image


def _first_block(
    stream: Iterator[FloatArray | None], size: int, flows: FloatArray | None
) -> tuple[list[FloatArray | None], Flows | None]:
    """Read the first block: the frames with known flows, else ``size`` frames.

    It is extended, without known flows, until one frame is in use.
    """
    block, least = list(islice(stream, size if flows is None else len(flows))), 1 if flows is None else len(flows)
    if len(block) < max(least, 1):
        raise DataError(f"frames: expected at least {least}, found {len(block)}")
    known: Flows | None = flows
    while all(frame is None for frame in block):
        known, more = None, list(islice(stream, size))
        if not more:
            raise DataError("frames: expected at least one frame to count, found none")
        block += more
    return block, known


def _check_checkpoint(
    start: FilterCheckpoint, first_block: int, shape: tuple[int, ...], dynamics: FlowDynamics
) -> None:
    state, size = start.state, shape[:2]
    flows, images = (state.flow_sum, state.training_flow), (state.image.mean, start.reference)
    found = tuple(array.shape for array in (*images, state.image.variance, *flows, state.flow.mean))
    expected = (shape, shape, size, (*size, 2), (*size, 2), (dynamics.rank,))
    if len(start.records) < first_block or found != expected:
        raise DataError(
            f"start: expected a checkpoint of these frames, found one of {len(start.records)} frames and shapes {found}"
        )
