"""One frame without its turbulent displacement, fused with its neighbours.

Symbols
-------
k : the frame; I_k; k ± i its neighbours, i from ``distances``
F_i : flow from frame k to frame k + i, pixels
D : mean displacement of frame k to its neighbours (:mod:`turbrestore.steady.displacement`), about −d_k
V : its inverse map, ``(id + D) ∘ (id + V) = id``, about d_k

1. F_i is measured by dense inverse search, for an earlier neighbour as the inverse of the flow from there; its affine
   part, the camera, is taken off (:mod:`turbrestore.steady.camera_path.camera`).
2. ``J = I_k ∘ (id + V)`` is the frame without its turbulent displacement.
3. ``J_i = I_{k+i} ∘ (id + F_i) ∘ (id + V)`` are its neighbours, registered to it; those that agree are averaged with it
   (:mod:`turbrestore.steady.fusion`).

Exposure and white balance may hunt.  Neighbours get the light of the frame before they are averaged with it, and the
result gets the mean light of the pairs of neighbours, as far as light changes by the few per cent by which cameras
hunt; what is switched on shows at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..core.noise import estimate_noise
from ..registration.camera.global_shift import LEAST_CORRELATION, ShiftReference, correlation, measure_shift
from ..registration.flow_methods.opencv_flow import DisParams, GreyImage, dis_solver
from ..registration.warp import sample_splines
from .camera_path.camera import Matrix, camera_flow, fit_camera
from .camera_path.path import smooth_motion, without_shake
from .displacement import (
    camera_steadiness,
    displacement_sizes,
    expected_motion,
    largest_displacement,
    likely_turbulence,
    mean_displacement,
    moving_mask,
    path_length,
    whole_displacement,
    without_camera,
    witnesses,
)
from .fusion import fuse
from .grid import enlarged, follow, grid_of, inverted, pixel_of, reduced
from .settings import SteadyParams
from .windows import MeasuredFlows, Window, WindowFrame, light_between, normalised_grey, relit

# Patches this sparse lose nothing on phase screens; closer ones take a fifth longer.  Three refinements lose 0.05 dB.
# The side of the patches and the smoothness were chosen.
_FLOW = DisParams(finest_scale=0, patch_size=8, patch_stride=4, refinements=1, smoothness=10.0)
# Change of the light in a window, logarithm, of which half is taken out, chosen: cameras hunt by less, and lamps change
# more.
_HUNTING = 0.25


@dataclass(frozen=True, eq=False)
class DewarpedFrame:
    """A frame that has been dewarped and fused."""

    number: int  # number of the frame in the stream, from 0
    image: FloatArray  # (H, W) or (H, W, 3): not deblurred
    moving: NDArray[np.bool_]  # (H, W): where something moves against the scene
    displacement: float  # root mean square of the displacement that was removed, pixels
    noise: float  # standard deviation of the noise of the frame before it was fused, intensity
    share: float  # what fusion has left of it
    largest: float  # what turbulence displaces at most, pixels; infinite without neighbours
    size: float  # median size of the displacement of turbulence, pixels
    steadiness: float  # whether the camera moves at constant velocity, 0 to 1
    turbulence: float  # whether displacements may be those of turbulence, 0 to 1
    starts_scene: bool  # whether a new scene starts here
    # (2, 3): affine motion of the camera from the frame to each neighbour, by its distance in frames, pixels about the
    # centre of the image.
    cameras: Mapping[int, Matrix]
    removed_camera: Matrix  # (2, 3): its part in the displacement that was removed
    seen: WindowFrame  # the frame as it was
    mean: FloatArray  # (h, w): luminance of its neighbours on the grid, which the camera alone has brought to it
    light: FloatArray  # (1,) or (3,): logarithm of the gain that takes the hunting of the camera off the result


def dewarp_frame(window: Window, params: SteadyParams) -> DewarpedFrame:
    """Free a frame of its turbulent displacement, and fuse it with its neighbours."""
    image, shape = window.frame.image, window.frame.image.shape[:2]
    grid = grid_of(shape)
    flows, cameras = _measure(window)
    own = without_camera(flows, cameras, shape)
    removed_camera, displacement, largest = np.zeros((2, 3)), np.zeros((*grid, 2), np.float32), np.inf
    size, steadiness, turbulence, path = 0.0, 1.0, 1.0, np.zeros(grid, np.float32)
    if flows:
        sizes = displacement_sizes(own)
        size = float(np.mean(sizes))
        # At the ends of a scene |S_1| has one side only, where motion does not cancel, and says nothing of the air.
        whole = whole_displacement(sizes[0]) if {-1, 1} <= flows.keys() else 0.0
        steadiness = camera_steadiness({} if params.camera == "lock" else cameras, shape, whole)
        largest = params.largest or largest_displacement(size, steadiness)
        # What lies at different distances drifts apart only if the camera does not move evenly.
        turbulence = 1 - (1 - steadiness) * (1 - likely_turbulence(sizes))
        removed_camera = (
            turbulence * smooth_motion(cameras, whole_displacement(size, largest), shape)
            if params.camera == "keep"
            else without_shake(cameras, order=int(params.camera == "steady"))
        )
        path = path_length(own)
        displacement = mean_displacement(own, largest, path, pixel_of(shape))
        displacement += camera_flow(removed_camera, shape, grid)
    inverse = inverted(displacement, shape)
    lights = _lights(window, cameras)
    registered = (
        relit(
            sample_splines(frame.planes, enlarged(inverse + follow(flows[offset], inverse, shape), shape)),
            lights[offset],
        )
        for offset, frame in window.neighbours.items()
    )
    noise = estimate_noise(image)
    fused, agreement = fuse(sample_splines(window.frame.planes, enlarged(inverse, shape)), registered, noise)
    placed = _placed(window, cameras)
    there = [placed[offset] for offset in witnesses(placed)]
    moving = moving_mask(path / np.float32(largest), window.frame.grey, there, agreement, pixel_of(shape))
    return DewarpedFrame(
        number=window.number,
        image=fused,
        moving=enlarged(moving.astype(np.float32), shape) > 0.5,
        displacement=float(np.sqrt(np.mean(np.sum(displacement**2, -1)))),
        noise=noise,
        share=float(1 / np.sqrt(1 + len(flows) * float(agreement.mean()))),
        largest=largest,
        size=size,
        steadiness=steadiness,
        turbulence=turbulence,
        starts_scene=window.starts_scene,
        cameras=cameras,
        removed_camera=removed_camera,
        seen=window.frame,
        mean=np.asarray(np.mean([*placed.values()] or [window.frame.grey], 0), np.float32),
        light=_hunted(lights, window.frame),
    )


def measure_flow(
    reference: FloatArray, image: FloatArray, start: FloatArray, shape: tuple[int, ...] | None = None
) -> FloatArray:
    """Flow between two images on their grid, searched for near where it starts.

    ``reference, image`` (H, W) or (H, W, 3), or with their ``shape`` luminance (h, w) on the grid; ``start`` (h, w, 2);
    returns (h, w, 2).
    """
    shape = shape or reference.shape
    normalised = [
        normalised_grey(luminance(one if one.shape[:2] == grid_of(shape) else reduced(one)), shape)
        for one in (reference, image)
    ]
    return _solver(normalised[0], shape)(normalised[1], start)


def _solver(normalised: GreyImage, shape: tuple[int, ...]) -> Callable[[GreyImage, FloatArray], FloatArray]:
    solve, pixel = dis_solver(_FLOW, normalised), np.float32(pixel_of(shape))
    return lambda other, start: pixel * solve(other[None], [start / pixel], False)[0]


def _measure(window: Window) -> MeasuredFlows:
    """Flow from the frame to each neighbour, and its affine part; to earlier ones it is that from there, inverted."""
    shape, known = window.frame.image.shape, window.later.measured(_search)
    flows, cameras = known[0].copy(), known[1].copy()
    for offset, other in window.earlier.items():
        towards = other.measured(_search)[0].get(-offset)
        if towards is not None:
            flows[offset] = inverted(towards, shape)
            cameras[offset] = fit_camera(flows[offset], shape)
    left = {offset: frame for offset, frame in window.neighbours.items() if offset not in flows}
    further = _search(window.frame, left, cameras)
    return flows | further[0], cameras | further[1]


def _search(
    frame: WindowFrame, neighbours: Mapping[int, WindowFrame], known: Mapping[int, Matrix] | None = None
) -> MeasuredFlows:
    """Flow from a frame to its neighbours, and its affine part; that to other neighbours may be ``known``.

    A pan leads far in a dozen frames, so the search for a far neighbour starts where the camera would be if it went on
    as it went to the one before.
    """
    if not neighbours:
        return {}, {}
    shape, grid = frame.image.shape, frame.normalised.shape
    solve = _solver(frame.normalised, shape)
    flows: dict[int, FloatArray] = {}
    cameras = dict(known or {})
    for offset in sorted(neighbours, key=abs):
        neighbour = neighbours[offset]
        if any(offset * other > 0 for other in cameras):
            expected = expected_motion(cameras, offset)
        else:
            expected = first_guess(frame.shift_reference, neighbour.shift_reference, neighbour.image)
        flows[offset] = solve(neighbour.normalised, camera_flow(expected, shape, grid))
        cameras[offset] = fit_camera(flows[offset], shape)
    return flows, {offset: cameras[offset] for offset in flows}


def first_guess(reference: ShiftReference, prepared: ShiftReference, image: FloatArray) -> Matrix:
    """Find a shift (2, 3) of a whole image, given as it is and prepared, where the two are not alike without one.

    A pattern that repeats looks as much alike a period further on, and more so through some turbulence.
    """
    still = correlation(reference.reduced, prepared.reduced)
    shift = None if still > LEAST_CORRELATION else measure_shift(image, reference)
    return np.column_stack([np.zeros((2, 2)), np.zeros(2) if shift is None else shift])


def _placed(window: Window, cameras: dict[int, Matrix]) -> dict[int, FloatArray]:
    """Luminance of the neighbours on the grid, without the motion of the camera."""
    shape, grid = window.frame.image.shape, window.frame.grey.shape
    seen, placed = luminance(window.frame.coarse), {}
    for offset, frame in window.neighbours.items():
        light = light_between(seen, _coarsely(luminance(frame.coarse), cameras[offset], shape))
        placed[offset] = relit(follow(frame.grey, camera_flow(cameras[offset], shape, grid), shape), light)
    return placed


def _lights(window: Window, cameras: dict[int, Matrix]) -> dict[int, FloatArray]:
    """Light of the frame over that of each neighbour, logarithm."""
    shape = window.frame.image.shape
    return {
        offset: light_between(window.frame.coarse, _coarsely(frame.coarse, cameras[offset], shape))
        for offset, frame in window.neighbours.items()
    }


def _coarsely(image: FloatArray, camera: Matrix, shape: tuple[int, ...]) -> FloatArray:
    return follow(image, camera_flow(camera, shape, image.shape), shape)


def _hunted(lights: Mapping[int, FloatArray], frame: WindowFrame) -> FloatArray:
    """Mean light of the pairs of neighbours over that of the frame, logarithm."""
    paired = [-light for offset, light in lights.items() if -offset in lights]
    known = np.stack([*paired, np.zeros(1 if frame.image.ndim == 2 else 3, np.float32)])
    return np.asarray(known.mean(0) / (1 + (np.abs(known).max() / _HUNTING) ** 8), np.float32)
