"""One pass over consecutive frames: measure flows, update the flow state, register frames (paper 3, section 4).

Symbols as in :mod:`turbrestore.filtering.kalman` and :mod:`turbrestore.filtering.frame_noise`.

Threads measure and project the flows of several frames in parallel.  The flow state is then updated by one frame after
another, and the frames are registered in parallel again.  On a torch device a frame is registered only when the image
is updated by it, so that at most one registered frame takes memory there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..dynamics.flow_model import FlowDynamics, ProjectedFlow, flow_of, project_measured
from ..registration.flow import FlowFrame, FlowParams, FlowReference, prepare_reference
from ..runtime.runtime import Runtime
from ..runtime.scratch import iter_frames
from ..runtime.threads import in_batches, map_in_turns
from .array_backend import ArrayBackend
from .frame_noise import FrameStatistics, RegisteredFrame, register_frame
from .kalman import Gaussian, advance_state

# A frame as it was read, or prepared for flow; None for a frame that does not count.
Frame = FloatArray | FlowFrame | None


@dataclass(frozen=True, eq=False)
class PassSettings:
    """Model, statistics and settings that are the same for every frame."""

    dynamics: FlowDynamics
    statistics: FrameStatistics  # its arrays are on the backend
    modelled: bool  # whether frames are registered by C ξ̂ + W̄ and not by W^meas
    # β, and S in squared intensity.
    sharpness: float
    drift: float
    flow: FlowParams
    runtime: Runtime
    backend: ArrayBackend


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame after the update of the flow state."""

    frame: Frame  # the frame for the next pass, with a flow to start from; None if no other pass follows
    state: Gaussian  # ξ̂ and P after the frame
    innovation: float  # root mean square of W^meas − W̄ − C A ξ̂, pixels; NaN if the frame does not count
    # None if the frame does not count: the frame, (H, W) or (H, W, 3), and w^meas, (H, W, 2), pixels.
    image: FloatArray | None
    measured: FloatArray | None
    registered: RegisteredFrame | None = None  # None on a device too, where the update of the image registers it


@dataclass(frozen=True, eq=False)
class _Item:
    """A frame within a pass; ``start`` is a known flow to it, and ``kept`` is True if another pass follows."""

    frame: Frame
    start: FloatArray | None
    kept: bool
    measured: FloatArray | None = None
    projected: ProjectedFlow | None = None


def pass_over(
    frames: Iterable[Frame],
    starts: Iterable[FloatArray | None],
    image: FloatArray | None,
    state: Gaussian,
    settled: int,
    settings: PassSettings,
) -> Iterator[TrackedFrame]:
    """Measure flows from an image to frames, update the flow state by these flows, and register the frames.

    ``image`` (H, W) or (H, W, 3).
    """
    reference = None if image is None else prepare_reference(image, settings.flow, settings.runtime)
    batch, threads = (1, settings.runtime.threads) if reference is None else (reference.batch, reference.threads)

    def measure(items: list[_Item]) -> list[_Item]:
        measured = _take_known(items) if reference is None else _measure_flows(items, reference)
        return [_project(item, settings.dynamics) for item in measured]

    def update_states(items: list[_Item]) -> list[tuple[_Item, Gaussian, float]]:
        nonlocal state
        updated = []
        for item in items:
            state, innovation = advance_state(state, item.projected, settings.dynamics)  # (14b, 14d, 17, 19)
            updated.append((item, state, innovation))
        return updated

    def track(updated: list[tuple[_Item, Gaussian, float]]) -> list[TrackedFrame]:
        return [_track(*one, settings) for one in updated]

    pairs = zip(iter_frames(frames), iter_frames(starts), strict=False)
    items = (_Item(*pair, number >= settled) for number, pair in enumerate(pairs))
    for tracked in map_in_turns(measure, update_states, track, in_batches(items, batch), threads):
        yield from tracked


def register(image: FloatArray, measured: FloatArray, state: Gaussian, settings: PassSettings) -> RegisteredFrame:
    """Register a frame by the measured flow, or by that of the model.

    ``image`` (H, W) or (H, W, 3); ``measured`` (H, W, 2).
    """
    flow = flow_of(settings.dynamics, state.mean) if settings.modelled else measured
    return register_frame(image, flow, settings.statistics, settings.sharpness, settings.backend.ops)


def _measure_flows(items: list[_Item], reference: FlowReference) -> list[_Item]:
    """Measure W^meas from the image to the frames that count (eq. 17)."""
    prepared = [_prepare(item, reference) for item in items]
    counted = [item.frame for item in prepared if isinstance(item.frame, FlowFrame)]
    flows = iter(reference.solve(counted) if counted else [])
    return [item if item.frame is None else _with_flow(item, next(flows)) for item in prepared]


def _take_known(items: list[_Item]) -> list[_Item]:
    return [item if item.frame is None else replace(item, measured=item.start) for item in items]


def _prepare(item: _Item, reference: FlowReference) -> _Item:
    """Prepare a frame for the measurement of flow, unless an earlier pass has done so."""
    if item.frame is None:
        return item
    frame = item.frame if isinstance(item.frame, FlowFrame) else reference.prepare(item.frame)
    frame = frame if item.start is None else replace(frame, start=item.start)
    # The first of several flows is where the next one starts.
    return replace(item, frame=replace(frame, draft=item.kept and frame.start is None))


def _with_flow(item: _Item, flow: FloatArray) -> _Item:
    """Add the measured flow, from which the measurement in the next pass starts unless there is a known flow."""
    if item.kept and item.start is None and isinstance(item.frame, FlowFrame):
        return replace(item, measured=flow, frame=replace(item.frame, start=_half_resolution(flow)))
    return replace(item, measured=flow)


def _half_resolution(flow: FloatArray) -> NDArray[np.float16]:
    """Reduce a flow to half the resolution and to float16, which take one byte for each pixel of the image.

    This is accurate enough for a flow to start from: displacements of up to 2,000 pixels are exact to one pixel, and
    the search recovers from errors of several pixels.
    """
    height, width = flow.shape[:2]
    return cv2.resize(flow, (width // 2, height // 2), interpolation=cv2.INTER_AREA).astype(np.float16)


def _project(item: _Item, dynamics: FlowDynamics) -> _Item:
    return item if item.measured is None else replace(item, projected=project_measured(item.measured, dynamics))


def _track(item: _Item, state: Gaussian, innovation: float, settings: PassSettings) -> TrackedFrame:
    """Register a frame: at once on the CPU, but on a device only when the image is updated by it."""
    frame = item.frame if item.kept else None
    image = item.frame.image if isinstance(item.frame, FlowFrame) else item.frame
    if image is None or item.measured is None:
        return TrackedFrame(frame, state, innovation, None, None)
    registered = register(image, item.measured, state, settings) if settings.backend.is_cpu else None
    return TrackedFrame(frame, state, innovation, image, item.measured, registered)
