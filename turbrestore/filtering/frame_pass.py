"""One pass over consecutive frames: measure flows, update the flow state, register frames (paper 3, section 4).

Symbols as in :mod:`turbrestore.filtering.flow_state` and :mod:`turbrestore.filtering.frame_noise`.

Threads measure and project the flows of several frames in parallel.  The flow state is then updated by one frame after
another, and the frames are registered in parallel again.  On a torch device a frame is registered only when the image
is updated by it, so that at most one registered frame takes memory there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import count

import cv2
import numpy as np

from ..core.arrays import FloatArray
from ..dynamics.flow_model import FlowDynamics, ProjectedFlow, flow_of, project_measured
from ..registration.flow import FlowFrame, FlowParams, FlowReference, prepare_reference
from ..runtime.device import CPU
from ..runtime.runtime import Runtime
from ..runtime.scratch import iter_frames
from ..runtime.threads import in_batches, map_in_turns
from .estimates import Gaussian
from .filter_records import FilterParams
from .flow_state import advance_flow_state
from .frame_noise import FrameStatistics, RegisteredFrame, register_frame

# A frame as it was read, or prepared for flow; None for a frame that does not count.
Frame = FloatArray | FlowFrame | None


@dataclass(frozen=True, eq=False)
class PassSettings:
    """Model, statistics and settings that are the same for every frame."""

    dynamics: FlowDynamics
    statistics: FrameStatistics  # its maps are on the device
    params: FilterParams
    flow_params: FlowParams
    runtime: Runtime  # with the device that was found


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """A frame on its way through a pass; a frame that does not count has neither flows nor pixels."""

    frame: Frame  # prepared for flow as soon as one is measured
    known_flow: FloatArray | None  # (H, W, 2): pixels
    passes_again: bool  # whether it takes part in another pass, for which it has a flow to start from
    state: Gaussian  # ξ̂ and P after the frame; until then those before the pass
    measured: FloatArray | None = None  # (H, W, 2): W^meas, pixels
    projected: ProjectedFlow | None = None
    innovation: float = np.nan  # root mean square of W^meas − W̄ − C A ξ̂, pixels
    registered: RegisteredFrame | None = None  # None on a device too, where the update of the image registers it

    @property
    def pixels(self) -> FloatArray | None:
        """The frame as it was read, (H, W) or (H, W, 3)."""
        return self.frame.image if isinstance(self.frame, FlowFrame) else self.frame


def pass_over(
    frames: Iterable[Frame],
    known_flows: Iterable[FloatArray | None],
    image: FloatArray | None,
    state: Gaussian,
    settled: int,
    settings: PassSettings,
) -> Iterator[TrackedFrame]:
    """Measure flows from an image to frames, update the flow state by these flows, and register the frames.

    With ``image`` None the known flows are taken as measured.  ``image`` (H, W) or (H, W, 3).
    """
    dynamics, on_cpu = settings.dynamics, settings.runtime.device == CPU
    reference = (
        None
        if image is None
        else prepare_reference(image, settings.flow_params, settings.runtime, settings.statistics.frame_noise)
    )
    size, threads = (1, settings.runtime.threads) if reference is None else (reference.batch, reference.threads)

    def measure(batch: list[tuple[int, Frame, FloatArray | None]]) -> list[TrackedFrame]:
        items = [TrackedFrame(frame, known, number >= settled, state) for number, frame, known in batch]
        if reference is None:
            items = [item if item.frame is None else replace(item, measured=item.known_flow) for item in items]
        else:
            items = _measure_flows(items, reference)
        return [
            item if item.measured is None else replace(item, projected=project_measured(item.measured, dynamics))
            for item in items
        ]

    def update_states(items: list[TrackedFrame]) -> list[TrackedFrame]:
        nonlocal state
        updated = []
        for item in items:
            state, innovation = advance_flow_state(state, item.projected, dynamics)
            updated.append(replace(item, state=state, innovation=innovation))
        return updated

    def register_all(items: list[TrackedFrame]) -> list[TrackedFrame]:
        # What flow has prepared of a frame takes memory, and is of use in another pass only.
        plain = [item if item.passes_again else replace(item, frame=item.pixels) for item in items]
        return [replace(item, registered=register(item, settings)) for item in plain] if on_cpu else plain

    numbered = zip(count(), iter_frames(frames), iter_frames(known_flows), strict=False)
    for tracked in map_in_turns(measure, update_states, register_all, in_batches(numbered, size), threads):
        yield from tracked


def register(tracked: TrackedFrame, settings: PassSettings) -> RegisteredFrame | None:
    """Register a frame by the measured flow, or by that of the model; None if the frame does not count."""
    if tracked.pixels is None or tracked.measured is None:
        return None
    flow = tracked.measured if settings.params.residual == "keep" else flow_of(settings.dynamics, tracked.state.mean)
    return register_frame(tracked.pixels, flow, settings.statistics, settings.params.sharpness)


def _measure_flows(items: list[TrackedFrame], reference: FlowReference) -> list[TrackedFrame]:
    """Measure W^meas from the image to the frames that count (eq. 17).

    In the next pass the measurement starts from this flow, unless there is a known one.
    """
    prepared = []
    for item in items:
        if item.frame is not None:
            # An earlier pass may have prepared it.
            frame = item.frame if isinstance(item.frame, FlowFrame) else reference.prepare(item.frame)
            start = frame.start if item.known_flow is None else item.known_flow
            # The first of several flows is where the next one starts.
            prepared.append(replace(frame, start=start, draft=item.passes_again and start is None))
    solved = iter(zip(prepared, reference.solve(prepared) if prepared else [], strict=True))
    return [item if item.frame is None else _with_flow(item, *next(solved)) for item in items]


def _with_flow(item: TrackedFrame, frame: FlowFrame, flow: FloatArray) -> TrackedFrame:
    if item.passes_again and item.known_flow is None:
        # Half the resolution and float16 take one byte for each pixel of the image, and are accurate enough to start
        # from: displacements of up to 2,000 pixels are exact to one pixel, and the search recovers from several.
        size = flow.shape[1] // 2, flow.shape[0] // 2
        frame = replace(frame, start=cv2.resize(flow, size, interpolation=cv2.INTER_AREA).astype(np.float16))
    return replace(item, frame=frame, measured=flow)
