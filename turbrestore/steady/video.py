"""Video in, video out: every frame steadied by its neighbours, fused with them, and deblurred.

Symbols
-------
k : the frame; I_k; k ± i its neighbours, i from ``distances``
F_i : flow from frame k to frame k + i, pixels
D : mean displacement of frame k to its neighbours (:mod:`turbrestore.steady.displacement`), about −d_k
V : its inverse map, ``(id + D) ∘ (id + V) = id``, about d_k

1. F_i is measured by dense inverse search, and its affine part, the camera, is taken off
   (:mod:`turbrestore.steady.camera`).
2. ``J = I_k ∘ (id + V)`` is the frame without its turbulent displacement.
3. ``J_i = I_{k+i} ∘ (id + F_i) ∘ (id + V)`` are its neighbours, registered to it; those that agree are averaged with it
   (:mod:`turbrestore.steady.fusion`).
4. One blur, estimated from an early frame of the clip, is removed from every frame by a linear filter
   (:mod:`turbrestore.steady.deblurring`).

A frame is worked on as soon as the last of its neighbours is there.  Nothing is carried from frame to frame but the
blur and, where the camera is locked, its path.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..blur.estimation import estimate_blur
from ..blur.psf import KOLMOGOROV
from ..core.arrays import FloatArray, luminance
from ..core.errors import DataError, require, require_between
from ..core.noise import estimate_noise
from ..registration.flow import MIN_SIDE
from ..registration.flow_algebra import invert_flow
from ..registration.opencv_flow import DisParams, dis_solver
from ..registration.warp import sample_linear, warp
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.threads import map_ahead
from .camera import Matrix, camera_flow, fit_camera
from .deblurring import deblur
from .displacement import camera_displacement, camera_shake, largest_displacement, mean_displacement, without_camera
from .fusion import fuse
from .motion import moving_mask
from .windows import Window, iter_windows

CAMERAS = ("keep", "steady", "lock")
# Half of the resolution is enough for displacements as smooth as those of turbulence, and five times as fast.
_FLOW = DisParams(finest_scale=1, patch_size=8, patch_stride=4, refinements=5, smoothness=10.0)
# Level of the pyramid, above the finest, at which a search with a start begins.
_START_LEVEL = 3
# Smallest side of a frame that is registered at half of the resolution.
_HALVED = 128
# Share of the estimated width that is removed: on the two videos of docs/steady.md, a width too small by 15 % costs
# 0.1 dB, one too large by as much 0.4 dB, and estimates are too large by up to a third.
_CAUTION = 0.8


@dataclass(frozen=True)
class SteadyParams:
    """How a video is steadied.

    Parameters
    ----------
    camera : {"keep", "steady", "lock"}
        What becomes of the motion of the camera: kept, smoothed, or removed, so that every frame of a scene shows what
        its first frame shows.
    sigma : float, optional
        Standard deviation of the blur to remove, pixels; 0 removes none.  Estimated by default.
    reach : int
        Distance of the furthest neighbours of a frame, frames: the delay of a stream.
    largest : float, optional
        What turbulence displaces at most, pixels; larger displacements pass for motion and are kept.  By default it is
        measured while the camera stands still or is locked, and 1 while it moves.

    Raises
    ------
    ConfigurationError
        A setting is out of range.

    Examples
    --------
    >>> SteadyParams(reach=6).distances
    (1, 3, 4, 6)
    """

    camera: Literal["keep", "steady", "lock"] = "keep"
    sigma: float | None = None
    reach: int = 12
    largest: float | None = None

    def __post_init__(self) -> None:
        require(self.camera in CAMERAS, f"camera: expected one of {', '.join(CAMERAS)}, found {self.camera!r}")
        require_between("reach", self.reach, 1, 60, "frames")
        if self.largest is not None:
            require_between("largest", self.largest, 0.1, 100, "pixels")
        if self.sigma is not None:
            require_between("sigma", self.sigma, 0, 20, "pixels")

    @property
    def distances(self) -> tuple[int, ...]:
        """Distances of the neighbours in frames: 1, and the quarters of ``reach``."""
        return tuple(sorted({1, *(max(self.reach * quarter // 4, 1) for quarter in (1, 2, 3, 4))}))


@dataclass(frozen=True, eq=False)
class SteadyFrame:
    """A frame of a steadied video.

    Attributes
    ----------
    number : int
        Number of the frame in the stream, from 0.
    image : ndarray, float32, shape (H, W) or (H, W, 3)
    moving : ndarray, bool, shape (H, W)
        Where something moves against the scene.
    displacement : float
        Root mean square of the displacement that was removed, pixels.
    sigma : float
        Width of the blur that was removed, pixels.
    starts_scene : bool
        Whether a new scene starts here.
    cameras : mapping of int to ndarray, float64, shape (2, 3)
        Affine motion of the camera from the frame to each neighbour, by its distance in frames, pixels about the centre
        of the image.
    removed_camera : ndarray, float64, shape (2, 3)
        Its part in the displacement that was removed.
    """

    number: int
    image: FloatArray
    moving: NDArray[np.bool_]
    displacement: float
    sigma: float
    starts_scene: bool
    cameras: Mapping[int, Matrix]
    removed_camera: Matrix


def steady_frames(
    frames: Iterable[ArrayLike], params: SteadyParams | None = None, runtime: Runtime = DEFAULT
) -> Iterator[SteadyFrame]:
    """Steady a stream of frames, one output frame for each input frame.

    The output lags behind the input by ``params.reach`` frames and two for each thread, and at the start by half of
    ``params.reach`` more, because the blur is estimated there.  Memory does not grow with the length of the stream.

    Parameters
    ----------
    frames : iterable of array_like, shape (H, W) or (H, W, 3)
        Intensities in [0, 1]; consumed lazily.
    params : SteadyParams, optional
        Settings.
    runtime : Runtime
        Threads.

    Yields
    ------
    SteadyFrame

    Raises
    ------
    DataError
        Frames differ in size or are smaller than 16×16, or values are not finite.

    Examples
    --------
    >>> frames = np.random.default_rng(0).random((1, 32, 32)).repeat(3, 0)
    >>> [frame.number for frame in steady_frames(frames, SteadyParams(sigma=0))]
    [0, 1, 2]
    """
    params = params or SteadyParams()
    windows = iter_windows(frames, params.distances)
    # The first frame that has neighbours on both sides.
    head = list(islice(windows, params.reach // 2 + 1))
    if not head:
        return
    sigma = params.sigma
    if sigma is None:
        middle = steady_frame(head[-1], replace(params, sigma=0.0))
        sigma = _CAUTION * estimate_blur(middle.image, runtime=runtime).removable
    known = replace(params, sigma=sigma)
    results = map_ahead(lambda window: steady_frame(window, known), chain(head, windows), runtime.threads)
    steadied = (result for _, result in results)
    yield from _locked(steadied, params.reach) if params.camera == "lock" else steadied


def steady_frame(window: Window, params: SteadyParams) -> SteadyFrame:
    """Steady one frame by its neighbours.

    Parameters
    ----------
    window : Window
    params : SteadyParams
        ``sigma`` must be known.

    Returns
    -------
    SteadyFrame
        The camera is not locked.

    Raises
    ------
    DataError
        The frame is smaller than 16×16.

    Examples
    --------
    >>> frames = np.random.default_rng(0).random((1, 32, 32)).repeat(3, 0)
    >>> first, *_ = iter_windows(frames, (1,))
    >>> steady_frame(first, SteadyParams(sigma=0)).displacement
    0.0
    """
    image, shape, sigma = window.frame.image, window.frame.levels.shape, params.sigma or 0.0
    flows, cameras = _measure(window)
    own = without_camera(flows, cameras)
    removed_camera, displacement, largest = np.zeros((2, 3)), np.zeros((*shape, 2), np.float32), np.inf
    if flows:
        largest = params.largest or largest_displacement(own, {} if params.camera == "lock" else cameras)
        if params.camera == "steady":
            removed_camera = camera_shake(cameras)
        else:
            removed_camera = camera_displacement(cameras, shape, largest if params.camera == "keep" else np.inf)
        displacement = mean_displacement(own, largest) + camera_flow(removed_camera, shape)
    inverse = invert_flow(displacement)
    registered = (
        warp(frame.image, inverse + sample_linear((flows[offset][..., 0], flows[offset][..., 1]), inverse))
        for offset, frame in window.neighbours.items()
    )
    noise = estimate_noise(image)
    fused, agreement = fuse(warp(image, inverse), registered, noise)
    share = 1 / np.sqrt(1 + len(flows) * float(agreement.mean()))
    return SteadyFrame(
        number=window.number,
        image=deblur(fused, sigma, KOLMOGOROV, noise * share),
        moving=moving_mask(own, luminance(image), _placed(window, cameras), agreement, largest),
        displacement=float(np.sqrt(np.mean(np.sum(displacement**2, -1)))),
        sigma=sigma,
        starts_scene=window.starts_scene,
        cameras=cameras,
        removed_camera=removed_camera,
    )


def _measure(window: Window) -> tuple[dict[int, FloatArray], dict[int, Matrix]]:
    """Flow from the frame to each neighbour, and its affine part.

    A pan leads far in a dozen frames, so the search for a far neighbour starts where the camera would be if it went on
    as it went to the one before.
    """
    levels = window.frame.levels
    if min(levels.shape) < MIN_SIDE:
        found = f"{levels.shape[1]}×{levels.shape[0]}"
        raise DataError(f"frames: expected at least {MIN_SIDE}×{MIN_SIDE} pixels for optical flow, found {found}")
    params = _FLOW if min(levels.shape) >= _HALVED else replace(_FLOW, finest_scale=0)
    solve = dis_solver(params, levels, _START_LEVEL)
    flows: dict[int, FloatArray] = {}
    cameras: dict[int, Matrix] = {}
    before = {-1: 0, 1: 0}
    for offset in sorted(window.neighbours, key=abs):
        side = 1 if offset > 0 else -1
        near, before[side] = before[side], offset
        start = camera_flow(cameras[near] * (offset / near), levels.shape) if near else None
        flows[offset] = solve(window.neighbours[offset].levels[None], [start])[0]
        cameras[offset] = fit_camera(flows[offset])
    return flows, cameras


def _placed(window: Window, cameras: dict[int, Matrix]) -> dict[int, FloatArray]:
    """Luminance of the furthest pair of neighbours, without the motion of the camera; none if there is no pair."""
    furthest = max((offset for offset in cameras if -offset in cameras), default=0)
    pair = (furthest, -furthest) if furthest else ()
    shape = window.frame.levels.shape
    return {
        offset: sample_linear((luminance(window.neighbours[offset].image),), camera_flow(cameras[offset], shape))
        for offset in pair
    }


def _locked(frames: Iterable[SteadyFrame], reach: int) -> Iterator[SteadyFrame]:
    """Show every frame of a scene from where its steadied first frame was taken.

    The map from there to a frame is the mean over its earlier neighbours of the map to them and on to the frame; those
    far away keep errors from adding up with every frame.
    """
    paths: deque[np.ndarray] = deque(maxlen=reach)
    for frame in frames:
        removed = _affine(frame.removed_camera)
        if frame.starts_scene:
            paths.clear()
            path = np.linalg.inv(removed)
        else:
            earlier = [offset for offset in frame.cameras if offset < 0]
            steps = [np.linalg.inv(_affine(frame.cameras[offset])) @ paths[offset] for offset in earlier]
            path = np.mean(steps, 0)
        paths.append(path)
        flow = camera_flow((removed @ path)[:2] - np.eye(3)[:2], frame.moving.shape)
        moving = sample_linear((frame.moving.astype(np.float32),), flow) > 0.5
        yield replace(frame, image=warp(frame.image, flow), moving=moving)


def _affine(matrix: Matrix) -> NDArray[np.float64]:
    """Write the map id + A as a matrix of homogeneous coordinates about the centre."""
    return np.eye(3) + np.vstack([matrix, np.zeros(3)])
