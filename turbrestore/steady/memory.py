"""Memory of what is static: a recursive estimate of the scene, as long as it agrees with the frames.

Symbols
-------
F : frame k, dewarped and fused within its window
Z : memory; n : number of frames that it holds, for every pixel, so that its variance is that of a frame over n
C : affine map from the steadied frame k to the one before; N : from the steadied frame to F; both from the path of the
    camera (:mod:`turbrestore.steady.camera_path.path`)
E : pose, affine map from the steadied frame to the grid of Z
R : flow from Z to F; A its affine part; r = R − A
w : agreement of ``F ∘ (id + R)`` with Z (:mod:`turbrestore.steady.fusion`), less where r is more than turbulence, 0 in
    objects that move (:mod:`turbrestore.steady.displacement`)
g : gain, 1 over the number of frames since the memory began, at least 1/64
s : steadiness, 0 to 1, of the camera, less where turbulence is weak: the window averages that out, and what is left
    is motion, of leaves or water

The camera carries the memory along before anything is compared, ``E ← E C``.  As the grid of Z moves by whole pixels,
a pan costs no sharpness; turns and zooms resample it when they move the corners by a pixel.  The search for R starts
from ``N E⁻¹``, where the path of the camera expects F.

Z is a Kalman filter of one value for every pixel, whose image drift a pixel earns: where the innovation
``F ∘ (id + R) − Z`` is explained by misregistration and noise (w = 1), n grows and the frame has a weight of 1/n; where
it is not, the variance is opened, n falls to 1, and the frame takes its place::

    n ← 1 + w min(n, s (1 − g) / (1 − s (1 − g))),      Z ← Z + (F ∘ (id + R) − Z) / n

The geometry is estimated likewise.  R is what F lies away from the mean geometry of the frames before, so that the mean
moves by g R, and the memory with it: ``Z ← Z ∘ (id + V)`` with V the inverse flow of ``g_r r + g_A (A − (N E⁻¹ − 1))``,
``g_r = 1 − s (1 − g)`` and g_A the same, but at least 1/12: what the memory as a whole lies off the path of the camera
is an error of the path or of the memory, and the output must not drift away from the input.  Where r cannot be trusted
(w small, an object or the background it uncovers) it is filled in from around.

Where the mean M of the frames before and after frame k is known (:mod:`turbrestore.steady.scene_mean`), Z goes there
instead, as far as displacements are those of turbulence: V is the inverse flow of ``g_r m``, m the flow from Z to
``M ∘ S⁻¹ E⁻¹`` with S the map from frame k to the steadied one, filled in likewise.  M averages ten times as many
frames as the displacement of a frame does, and no error of the flow to a single frame is in it.  Once g_r is below a
quarter, m is measured every fourth frame and counts four times.  A frame that begins a memory, as every frame of a
camera that shakes, is placed by the whole of m, as far as turbulence is strong.

A memory that has gone astray, because a period of a pattern was taken for another or the scene moves slowly, may still
agree with every next frame.  It is therefore checked against the mean B of the luminance of the last frames, which the
camera alone carries along and no flow: with e_Z and e_F the distances of Z and of ``F ∘ N E⁻¹`` from B, squared and
averaged over a window and eight frames, w falls by ``1 / (1 + (e_Z / e_F)⁴)``, so that a memory further away than the
frames is let go.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..registration.warp import inside, sample_linear, warp
from .camera_path.camera import Matrix, camera_flow, corner_motion, fit_camera
from .camera_path.path import motion
from .displacement import turbulent_weight
from .fusion import agreement_on_grid, agreement_weight, explained_difference, for_channels
from .grid import enlarged, follow, grid_of, inverted, pixel_of, reduced
from .scene_mean import SceneMean
from .windows import coarse_image, light_between, relit

# Flow between two images (h, w, 2): reference, image, where the search starts, shape of the frames.
Flow = Callable[..., FloatArray]

# Longest memory, frames, chosen: a geometry that follows by 1/12 a frame in place of 1/64 is 0.1 dB worse.
_LONGEST = 64
# Window from which r is filled in, pixels, chosen.
_SURROUNDINGS = 12.0
# Margin of what moves, and its soft edge, pixels, both chosen.
_MARGIN, _MARGIN_EDGE = np.ones((5, 5), np.uint8), 1.5
# Window in which an object draws the flow of a flat background along, chosen.
_BESIDE = np.ones((25, 25), np.uint8)
# Least weight of the surroundings that a flow is filled in from, chosen; with less it fades.
_LEAST_WEIGHT = 0.05
# What weak turbulence displaces at most, which leaves nothing to the memory, and strong one, pixels; both chosen.
_WEAK, _STRONG = 1.2, 1.8
# Least g_A, chosen: an offset from the path of the camera falls to 1/e within 12 frames.
_PULL = 1 / 12
# Every how many frames a memory that is no longer young is placed in the mean of the frames around: four lose nothing.
_PLACED = 4
# Windows of the distance from B, pixels; weight of a frame in its mean over time, frames in B, and a distance that does
# not count, squared intensity.  All chosen.
_DIFFERENCE_WINDOW, _DISTANCE_WINDOW = 1.0, 6.0
_CHECKED, _RECENT, _EVEN = 1 / 8, 32, 1e-5
# Moves of the corners, pixels, that are left out, chosen, and by which the grid of the memory follows: a whole pixel.
_LEAST_MOVE, _FARTHEST = 0.02, 1.0
# Steadiness below which nothing is remembered, chosen.
_LEAST_STEADINESS = 0.1


@dataclass(frozen=True, eq=False)
class Memory:
    """What is remembered of a scene."""

    image: FloatArray  # (H, W) or (H, W, 3): Z, at the mean geometry of the frames
    held: FloatArray  # (H, W): n, frames
    frames: int  # number of frames since the memory began
    pose: Matrix  # (3, 3): E
    mean: FloatArray  # (H, W): B
    distances: FloatArray  # (H, W, 2): e_Z and e_F, squared intensity
    replaced: float  # share of the image that the last frame replaced because it differed from B


@dataclass(frozen=True, eq=False)
class Around:
    """Mean of the frames before and after a frame, in which it is placed."""

    mean: SceneMean
    back: Matrix  # (3, 3): from the steadied frame to the frame
    largest: float  # what turbulence displaces at most, pixels, however the camera moves
    trust: float  # whether displacements are those of turbulence, 0 to 1


def remember(
    memory: Memory | None,
    image: FloatArray,
    flow_between: Flow,
    noise: float,
    largest: float,
    steadiness: float,
    moving: NDArray[np.bool_],
    carry: Matrix,
    offset: Matrix,
    around: Around | None = None,
) -> Memory:
    """Take a frame into the memory, which :func:`shown` then gives as the estimate of this frame.

    ``image`` (H, W) or (H, W, 3); ``moving`` (H, W); ``carry, offset`` (3, 3).
    """
    shape = image.shape[:2]
    steadiness *= _strength(largest)
    if memory is None or steadiness < _LEAST_STEADINESS:
        return _begun(image, flow_between, noise, moving, offset, around)
    memory = _carried(memory, carry, offset, image)
    expected = motion(offset @ np.linalg.inv(memory.pose))
    grid, pixel = grid_of(shape), pixel_of(shape)
    flow = flow_between(memory.image, image, camera_flow(expected, shape, grid), shape)
    camera = fit_camera(flow, shape)
    own = flow - camera_flow(camera, shape, grid)
    memory = _in_light(memory, coarse_image(warp(image, camera_flow(expected, shape))))
    placed = sample_linear((luminance(image),), camera_flow(expected, shape))
    found = [_distance(one, memory.mean) for one in (luminance(memory.image), placed)]
    distances = memory.distances + _CHECKED * (np.stack(found, -1) - memory.distances)
    agrees = 1 / (1 + (distances[..., 0] / (distances[..., 1] + _EVEN)) ** 4)
    tolerance = explained_difference(memory.image, noise)
    weight = agreement_weight(sample_linear((image,), enlarged(flow, shape)), memory.image, tolerance)
    weight *= turbulent_weight(own, largest, pixel)
    # R follows a slow object from frame to frame, and would hold it back, and with it the flat background beside it.
    near, beside = _beside(moving)
    weight *= reduced((1 - cv2.GaussianBlur(near, (0, 0), _MARGIN_EDGE)) * agrees)
    own = _filled(own, np.where(beside, 0, weight), pixel)
    frames = memory.frames + 1
    kept = steadiness * (1 - 1 / min(frames, _LONGEST))
    held = 1 + enlarged(weight, shape) * np.minimum(memory.held, kept / (1 - kept))
    innovation = warp(image, enlarged(own, shape) + camera_flow(camera, shape)) - memory.image
    innovation /= for_channels(held, image)
    # Share of the way to the mean geometry of the frames, for which flow is measured every few frames.
    to_mean = min(_PLACED * (1 - kept), 1) if frames % _PLACED == 0 or _PLACED * (1 - kept) > 1 else 0.0
    trust = 0.0 if around is None else around.trust
    pulled = camera_flow(max(1 - kept, _PULL) * (camera - expected), shape, grid)
    drift = np.float32(1 - trust) * (pulled + np.float32(1 - kept) * own)
    if around is not None and to_mean * trust > 0:
        off = _off_mean(memory.image, memory.pose, around, flow_between, beside, tolerance)
        drift += np.float32(to_mean * trust) * off
    estimate = memory.image + innovation
    if np.any(drift):
        inverse = enlarged(inverted(drift, shape), shape)
        estimate, held = warp(estimate, inverse), sample_linear((held,), inverse)
    mean = memory.mean + (placed - memory.mean) / np.float32(min(frames, _RECENT))
    replaced = float(1 - agrees.mean())
    return Memory(estimate, held, frames, memory.pose, mean, distances, replaced)


def _begun(
    image: FloatArray,
    flow_between: Flow,
    noise: float,
    moving: NDArray[np.bool_],
    offset: Matrix,
    around: Around | None,
) -> Memory:
    """Begin a memory with a frame, placed in the mean of the frames around it as far as there is turbulence."""
    shape = image.shape[:2]
    if around is not None and (strength := around.trust * _strength(around.largest)):
        to_steadied = camera_flow(motion(offset), shape)
        steadied = warp(image, to_steadied)
        tolerance, beside = explained_difference(steadied, noise), _beside(moving)[1]
        off = _off_mean(steadied, np.eye(3), around, flow_between, beside, tolerance)
        image = warp(image, np.float32(strength) * (to_steadied + enlarged(inverted(off, shape), shape)))
    distances = np.zeros((*shape, 2), np.float32)
    return Memory(image, np.ones(shape, np.float32), 1, np.eye(3), luminance(image), distances, 0.0)


def _off_mean(
    image: FloatArray,
    pose: Matrix,
    around: Around,
    flow_between: Flow,
    beside: NDArray[np.bool_],
    tolerance: FloatArray,
) -> FloatArray:
    """Flow from an image at a pose to the mean of the frames around, filled in where it cannot be trusted."""
    shape = image.shape[:2]
    grid, pixel = grid_of(shape), pixel_of(shape)
    mean, known = around.mean.seen_from(around.back @ np.linalg.inv(pose))
    seen = reduced(luminance(image))
    mean = relit(mean, light_between(coarse_image(seen), coarse_image(mean)))
    mean = seen + known * (mean - seen)
    flow = flow_between(image, mean, np.zeros((*grid, 2), np.float32), shape)
    weight = agreement_on_grid(follow(mean, flow, shape) - seen, tolerance, pixel)
    weight *= turbulent_weight(flow, around.largest, pixel) * known
    return _filled(flow, np.where(beside, 0, weight), pixel)


def _strength(largest: float) -> float:
    """Tell how much the memory counts, 0 where turbulence is weak and 1 where it is strong."""
    return float(np.clip((largest - _WEAK) / (_STRONG - _WEAK), 0, 1))


def _beside(moving: NDArray[np.bool_]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Give what moves a margin (H, W), and mark the flat background on the grid whose flow it draws along."""
    near = cv2.dilate(moving.astype(np.uint8), _MARGIN)
    return near.astype(np.float32), reduced(cv2.dilate(near, _BESIDE).astype(np.float32)) > 0


def _in_light(memory: Memory, seen: FloatArray) -> Memory:
    """Memory in the light of a frame, whose coarse image is given."""
    known = coarse_image(memory.image)
    gain, grey_gain = light_between(seen, known), light_between(luminance(seen), luminance(known))
    return replace(memory, image=relit(memory.image, gain), mean=relit(memory.mean, grey_gain))


def shown(memory: Memory) -> Memory:
    """Bring a memory from its grid to the steadied frame."""
    if corner_motion(motion(memory.pose), memory.held.shape) < _LEAST_MOVE:
        return memory
    flow = camera_flow(motion(memory.pose), memory.held.shape)
    held = sample_linear((memory.held,), flow)
    return replace(memory, image=warp(memory.image, flow), held=held, pose=np.eye(3))


def _carried(memory: Memory, carry: Matrix, offset: Matrix, image: FloatArray) -> Memory:
    """Carry a memory along with the camera, by whole pixels if that is enough; what comes into sight is that of F."""
    shape = memory.held.shape
    pose = memory.pose @ carry
    if corner_motion(motion(pose), shape) < _FARTHEST:
        return replace(memory, pose=pose)
    rest = pose.copy()
    rest[:2, 2] -= np.rint(pose[:2, 2])
    if corner_motion(motion(rest), shape) >= _FARTHEST:
        rest = np.eye(3)
    flow = camera_flow(motion(pose @ np.linalg.inv(rest)), shape)
    seen = inside(flow)
    fresh = warp(image, camera_flow(motion(offset @ np.linalg.inv(rest)), shape))
    share = seen if image.ndim == 2 else seen[..., None]
    moved = fresh + share * (warp(memory.image, flow) - fresh)
    mean = luminance(fresh) + seen * (sample_linear((memory.mean,), flow) - luminance(fresh))
    distances = sample_linear((memory.distances[..., 0], memory.distances[..., 1]), flow)
    return Memory(
        moved, 1 + seen * (sample_linear((memory.held,), flow) - 1), memory.frames, rest, mean, distances, 0.0
    )


def _distance(image: FloatArray, mean: FloatArray) -> FloatArray:
    """Average the squared difference of two images in a window."""
    difference = cv2.GaussianBlur(image - mean, (0, 0), _DIFFERENCE_WINDOW)
    return np.asarray(cv2.GaussianBlur(difference**2, (0, 0), _DISTANCE_WINDOW), np.float32)


def _filled(flow: FloatArray, weight: FloatArray, pixel: float) -> FloatArray:
    """Replace a flow by that of its surroundings where its weight is small."""
    window = _SURROUNDINGS / pixel
    total = cv2.GaussianBlur(weight, (0, 0), window) + _LEAST_WEIGHT
    around = cv2.GaussianBlur(flow * weight[..., None], (0, 0), window) / total[..., None]
    return np.asarray(around + weight[..., None] * (flow - around), np.float32)
