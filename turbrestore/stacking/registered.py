"""The frames of a clip in the geometry of its restored image.

Symbols
-------
q : centroid of the training frames; W_k : flow from q to frame I_k, pixels
V : flow that moves q onto the mean geometry of all frames, see :mod:`turbrestore.registration.recentring`

A registered frame is ``I_k ∘ (id + W'_k)`` with ``W'_k = W_k ∘ (id + V) + V``: the two flows are joined, so that a
frame is interpolated once.  The flows of the training frames are those that the centroid was averaged with, so the mean
of their registered frames is the centroid.  Those of later frames are measured from it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from ..core.arrays import FloatArray
from ..core.errors import require_type, settings_of
from ..footage.frame_selection import frame_quality
from ..io.source import FrameSource
from ..preparation import prepare
from ..registration.flow import iterate_flows
from ..registration.flow_algebra import compose_flows
from ..registration.recentring import recentre, recentring_flow
from ..registration.warp import warp
from ..results import Restoration
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.scratch import iter_frames
from ..runtime.threads import map_ahead
from ..settings import RestoreParams


@dataclass(frozen=True, eq=False)
class RegisteredFrame:
    """A frame in the geometry of the restored image.

    Attributes
    ----------
    number : int
        Number of the frame in the file.
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        At the levels of the clip; beyond the border of the frame its nearest pixel is repeated.
    flow : ndarray, float32, shape (H, W, 2)
        From the restored image to the frame as it was recorded, pixels.
    share : float
        Share of the information in the restored image that the frame brought; NaN unless the filter has run.
    sharpness : float
        Gradient of the registered frame on that of the image, 1 if they are equal; NaN for frames that do not count.
    quality : float
        Energy of fine detail over the squared brightness of the recorded frame, as programs sort frames by.
    """

    number: int
    image: FloatArray
    flow: FloatArray
    share: float
    sharpness: float
    quality: float


def registered_frames(
    source: FrameSource, restoration: Restoration, params: RestoreParams | None = None, runtime: Runtime = DEFAULT
) -> Iterator[RegisteredFrame]:
    """Yield the frames of a clip in the geometry of its restored image.

    A handful of frames are in memory at a time.

    Parameters
    ----------
    source : FrameSource
        The frames that were restored.
    restoration : Restoration
        Result of :func:`turbrestore.restore` for them, run to the filter or further.
    params : RestoreParams, optional
        Settings of that restoration.
    runtime : Runtime
        Threads and device.

    Yields
    ------
    RegisteredFrame

    Raises
    ------
    DataError
        Frames cannot be read, or have another size than the restoration.
    ConfigurationError
        The source or the settings are of another type.

    Examples
    --------
    >>> from turbrestore.pipeline import restore
    >>> frames = np.random.default_rng(0).uniform(size=(4, 32, 32)).astype(np.float32)
    >>> source = FrameSource.from_array(frames)
    >>> params = RestoreParams(until="filter")
    >>> registered = list(registered_frames(source, restore(source, params), params))
    >>> mean = np.mean([frame.image for frame in registered], axis=0)
    >>> len(registered), mean.shape
    (4, (32, 32))
    """
    params = settings_of(RestoreParams, params)
    require_type("source", source, FrameSource, "use open_frames(path) or FrameSource.from_array(frames)")
    prepared = prepare(source, params.static_mask, runtime.scratch)
    filtered, count = restoration.filtered, len(source)
    unknown = np.full(count, np.nan)
    shares, sharpness = (unknown, unknown) if filtered is None else (filtered.shares, filtered.sharpness)

    def finish(pair: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, float]:
        frame, flow = pair
        image = prepared.put_back(prepared.levels.original(warp(frame, flow)))
        return image, float(frame_quality([prepared.levels.original(frame)])[0])

    start = prepared.levels.stretched(restoration.centroid.image)
    flows = registering_flows(prepared.source, restoration, start, params, runtime)
    for number, ((_, flow), (image, quality)) in enumerate(map_ahead(finish, flows, runtime.threads)):
        yield RegisteredFrame(
            source.numbers[number], image, flow, float(shares[number]), float(sharpness[number]), quality
        )


def registering_flows(
    source: FrameSource, restoration: Restoration, centroid: FloatArray, params: RestoreParams, runtime: Runtime
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield every prepared frame with the flow W' that leads to it from the geometry of the restored image.

    ``centroid`` (H, W) or (H, W, 3) is the centroid at the levels of the frames.
    """
    train, filtered = restoration.train, restoration.filtered
    mean_flow = np.zeros((*centroid.shape[:2], 2), np.float32) if filtered is None else filtered.mean_flow
    V = recentring_flow(mean_flow)
    flows = iter_frames(restoration.centroid.flows)
    known = (compose_flows(flow, V) if V.any() else np.array(flow) for flow in flows)
    trained: Iterator[tuple[FloatArray, FloatArray]] = zip(source.select(frames=(0, train)), known, strict=True)
    if train == len(source):
        return trained
    later = source.select(frames=(train, None))
    return chain(trained, iterate_flows(recentre(centroid, mean_flow), later, params.flow, runtime))
