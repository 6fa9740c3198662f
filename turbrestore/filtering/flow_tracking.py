"""The flow's half of the alternating filter: from frames to flow states and registered frames (paper 3, section 4).

Symbols
-------
ξ, P : state of the flow and its covariance; A, C, Q, R from :mod:`turbrestore.dynamics.dynamic_texture` (eqs. 10, 13b)
W^meas : measured flow (eq. 17); W̄ its mean, Ŵ estimated flow
M : gain of the flow state (eq. 19)
G : share of the flow outside the subspace of C that is motion and not noise
Z : noise of a registered frame

The state of the flow needs no image once its flow is measured, and as CᵀC = I a measured flow says nothing of the state
but ``z = Cᵀ(W^meas − W̄)``, with noise R.  So ``M = P / R`` with P after the update, and no P depends on what is
measured: they are found for some frames at once.  What is left to do frame after frame are two small products; flow,
projection and registration run side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..dynamics.flow_model import FlowDynamics, flow_of, project_deviation
from ..registration.flow import FlowFrame, FlowParams, prepare_reference
from ..registration.warp import warp
from ..runtime.runtime import Runtime
from ..runtime.scratch import drop_pages, iter_frames
from ..runtime.threads import in_batches, map_in_turns
from .frame_noise import FrameNoise, judge_frame
from .kalman import Gaussian

# Smallest variance of the flow, so that noise-free synthetic data keep every gain defined: (0.001 px)².
_FLOW_NOISE_FLOOR = 1e-6

# Frames, and frames with their flows; None for those that do not count.
Frames = Iterator[FloatArray | None]
_Pair = tuple[FloatArray | None, FloatArray | None]
_Item = TypeVar("_Item")


@dataclass(frozen=True)
class RegisteredFrame:
    """A frame on the image.

    Attributes
    ----------
    frame : ndarray, float32, shape (H, W) or (H, W, 3)
    noise : float or ndarray, float32, shape (H, W)
        Z, squared intensity.
    sharpness : float
    """

    frame: FloatArray
    noise: float | FloatArray
    sharpness: float


@dataclass(frozen=True)
class TrackedFrame:
    """What is known of a frame's flow once it has been measured.

    Attributes
    ----------
    frame, measured : ndarray or None
        The frame and W^meas; None if it does not count, and once it is registered.
    state : ndarray, float64, shape (n,)
        ξ̂ after the frame.
    innovation : float
        Root mean square of W^meas − W̄ − C A ξ̂, pixels; NaN if it does not count.
    registered : RegisteredFrame or None
        None if it does not count, or a device registers it.
    """

    frame: FloatArray | None
    measured: FloatArray | None
    state: NDArray[np.float64]
    innovation: float
    registered: RegisteredFrame | None = None


@dataclass(frozen=True)
class Tracking:
    """What stays the same from frame to frame.

    Attributes
    ----------
    dynamics : FlowDynamics
    model : FrameNoise
    motion_share : ndarray, float32, shape (H, W, 2)
        G for both components: NumPy multiplies arrays of one shape several times as fast.
    sharpness : float
        β, see :func:`turbrestore.filtering.frame_noise.judge_frame`.
    flow : FlowParams
    runtime : Runtime
    registers : bool
        Whether frames are registered too.
    progress : callable or None
        Called with 1 after each measured flow.
    """

    dynamics: FlowDynamics
    model: FrameNoise
    motion_share: FloatArray
    sharpness: float
    flow: FlowParams
    runtime: Runtime
    registers: bool
    progress: Callable[[int], None] | None


@dataclass(frozen=True)
class _Seen:
    """One frame with its measured flow (None if it does not count), z, and the sum of squares of W^meas − W̄."""

    frame: FloatArray | None
    measured: FloatArray | None
    state: NDArray[np.float64]
    squared: float


def state_covariances(prior: Gaussian, counted: list[bool], dynamics: FlowDynamics) -> list[NDArray[np.float64]]:
    """P after each of some frames (eqs. 14d and 19).

    Parameters
    ----------
    prior : Gaussian
        Before the first.
    counted : list of bool
        Whether a flow is measured to each.
    dynamics : FlowDynamics

    Returns
    -------
    list of ndarray, float64, shape (n, n)

    Examples
    --------
    >>> from turbrestore.dynamics.dynamic_texture import identify
    >>> flows = np.zeros((9, 2, 2, 2)); flows[..., 0] = np.array([1, -2, 2, 0, -1, 3, -3, 1, -1])[:, None, None]
    >>> dynamics = identify(flows)
    >>> seen, unseen = state_covariances(Gaussian(np.zeros(1), np.eye(1)), [True, False], dynamics)
    >>> bool(seen[0, 0] < 1e-5), bool(unseen[0, 0] > 1)
    (True, True)
    """
    noise, unit = _flow_noise(dynamics), np.eye(dynamics.rank)
    P: NDArray[np.float64] = prior.cov
    covariances = []
    for counts in counted:
        P = dynamics.A @ P @ dynamics.A.T + dynamics.Q
        if counts:
            # (P⁻¹ + I / R)⁻¹, and no inverse of P is needed.
            P = noise * np.asarray(np.linalg.solve(P + noise * unit, P), np.float64)
        P = (P + P.T) / 2
        covariances.append(P)
    return covariances


def track_known(
    state: NDArray[np.float64],
    covariances: list[NDArray[np.float64]],
    frames: Frames,
    flows: FloatArray,
    tracking: Tracking,
) -> Iterator[TrackedFrame]:
    """Follow the flow through frames whose flows have been measured.

    Parameters
    ----------
    state : ndarray, float64, shape (n,)
        ξ̂ before the first.
    covariances : list of ndarray
        From :func:`state_covariances`.
    frames : iterator of ndarray or None
    flows : ndarray, float32, shape (T, H, W, 2)
        Pixels.
    tracking : Tracking

    Yields
    ------
    TrackedFrame
    """
    pairs = ([pair] for pair in zip(iter_frames(frames), iter_frames(flows), strict=True))
    return _track(state, covariances, pairs, list, tracking.runtime.threads, tracking)


def track_measured(
    state: NDArray[np.float64],
    covariances: list[NDArray[np.float64]],
    frames: Frames,
    image: FloatArray,
    number: int,
    done: int,
    prepared: dict[int, FlowFrame],
    known: FloatArray,
    tracking: Tracking,
) -> Iterator[TrackedFrame]:
    """Measure flows from an image to frames, and follow them.

    Parameters
    ----------
    state : ndarray, float64, shape (n,)
        ξ̂ before the first.
    covariances : list of ndarray
        From :func:`state_covariances`.
    frames : iterator of ndarray or None
    image : ndarray, float32, shape (H, W) or (H, W, 3)
    number : int
        Of the first frame.
    done : int
        Of so many frames, the first ones, no flow will be measured any more.
    prepared : dict of int to FlowFrame
        What has been prepared of frames for an earlier image, by their numbers; the rest is added.
    known : ndarray, float32, shape (K, H, W, 2)
        Earlier flows to the first frames of all, pixels.  Flows to these start from them; flows to other frames start
        from the last that were measured to them, the first ones from nothing.
    tracking : Tracking

    Yields
    ------
    TrackedFrame
    """
    reference = prepare_reference(image, tracking.flow, tracking.runtime)

    def prepare(index: int, frame: FloatArray) -> FlowFrame:
        found = prepared.pop(index, None) or reference.prepare(frame)
        if index >= number + done:
            prepared[index] = found
        return replace(found, start=known[index]) if index < len(known) else found

    def measure(batch: list[tuple[int, FloatArray | None]]) -> list[_Pair]:
        counted = [(index, prepare(index, frame)) for index, frame in batch if frame is not None]
        flows = reference.solve([frame for _, frame in counted]) if counted else []
        drop_pages(known)
        for (index, frame), flow in zip(counted, flows, strict=True):
            if index >= max(number + done, len(known)):
                prepared[index] = replace(frame, start=_coarse(flow))
        left = iter(flows)
        return [(None, None) if frame is None else (frame, next(left)) for _, frame in batch]

    batches = in_batches(enumerate(iter_frames(frames), number), reference.batch)
    for tracked in _track(state, covariances, batches, measure, reference.threads, tracking):
        if tracking.progress is not None:
            tracking.progress(1)
        yield tracked


def _track(
    state: NDArray[np.float64],
    covariances: list[NDArray[np.float64]],
    batches: Iterable[list[_Item]],
    measure: Callable[[list[_Item]], list[_Pair]],
    threads: int,
    tracking: Tracking,
) -> Iterator[TrackedFrame]:
    left = iter(covariances)

    def see(batch: list[_Item]) -> list[_Seen]:
        return [_see(frame, flow, tracking.dynamics) for frame, flow in measure(batch)]

    def update(batch: list[_Seen]) -> list[TrackedFrame]:
        nonlocal state
        tracked = []
        for seen in batch:
            tracked.append(_update(state, next(left), seen, tracking.dynamics))
            state = tracked[-1].state
        return tracked

    def register(batch: list[TrackedFrame]) -> list[TrackedFrame]:
        # What is registered waits for its place in the image without what it was registered by.
        return [
            replace(tracked, frame=None, measured=None, registered=_register(tracked, tracking)) for tracked in batch
        ]

    late: Callable[[list[TrackedFrame]], list[TrackedFrame]] = register if tracking.registers else list
    for done in map_in_turns(see, update, late, batches, threads):
        yield from done


def _coarse(flow: FloatArray) -> NDArray[np.float16]:
    """Flow at half the resolution, a byte a pixel of the image.

    For a start that is enough: it is exact to a pixel up to 2,000 pixels, and the search finds back from several.
    """
    height, width = flow.shape[:2]
    return cv2.resize(flow, (width // 2, height // 2), interpolation=cv2.INTER_AREA).astype(np.float16)


def _flow_noise(dynamics: FlowDynamics) -> float:
    return max(dynamics.R, _FLOW_NOISE_FLOOR)


def _see(frame: FloatArray | None, measured: FloatArray | None, dynamics: FlowDynamics) -> _Seen:
    if frame is None or measured is None:
        return _Seen(None, None, np.zeros(0), 0.0)
    deviation = measured - dynamics.mean_flow
    state = project_deviation(dynamics, deviation)
    return _Seen(frame, measured, state, float(np.square(deviation, out=deviation).sum(dtype=np.float64)))


def _update(
    state: NDArray[np.float64], covariance: NDArray[np.float64], seen: _Seen, dynamics: FlowDynamics
) -> TrackedFrame:
    """Prediction and update of ξ for one frame (eqs. 14b, 17, 19)."""
    foreseen = dynamics.A @ state
    if seen.frame is None or seen.measured is None:
        return TrackedFrame(None, None, foreseen, np.nan)
    updated = foreseen + covariance @ (seen.state - foreseen) / _flow_noise(dynamics)
    squared = seen.squared - float(foreseen @ (2 * seen.state - foreseen))
    return TrackedFrame(seen.frame, seen.measured, updated, (max(squared, 0.0) / seen.measured.size) ** 0.5)


def _register(tracked: TrackedFrame, tracking: Tracking) -> RegisteredFrame | None:
    """Bring the frame onto the image by Ŵ, and judge it (eq. 15)."""
    if tracked.frame is None or tracked.measured is None:
        return None
    modelled = flow_of(tracking.dynamics, tracked.state)
    estimate = tracked.measured - modelled
    estimate *= tracking.motion_share
    estimate += modelled
    registered = warp(tracked.frame, estimate)
    return RegisteredFrame(registered, *judge_frame(registered, estimate, tracking.model, tracking.sharpness))
