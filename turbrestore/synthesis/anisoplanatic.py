"""Anisoplanatic imaging: a scene seen through several layers of turbulence that drift with the wind.

Symbols
-------
θ : field angle, rad.  λ : wavelength, m.
h_0, h_k : mean of the point spread functions, and their principal components (:mod:`turbrestore.synthesis.pupil`).
c_k : coefficients of the point spread function of a field angle.

How a frame is made
-------------------
1. Tilt at every pixel (:func:`turbrestore.synthesis.phase_screen.tilt_flow`).  Light of θ arrives from θ + tilt, so
   ``frame(x + tilt) = truth(x)``.
2. Point spread functions of the tilt-free phase at field points ``field_spacing`` apart, by matrix Fourier transform
   at the pixels of the camera.  Colour channels share the path differences; the phase is proportional to 1/λ.
3. Displacement before blur (Chan, *Tilt-then-blur or blur-then-tilt?*, 2022).  The blur varies over the image:
   ``frame(y) = Σ_k c_k(y) (h_k ∗ displaced)(y)`` with c_0 = 1, h_0 the mean and the other h_k the principal components
   of point spread functions at other places of the same screens.  c_k is linear between field points.  The h_k with
   k > 0 sum to 0, so light is neither lost nor gained.
4. The mean over the sub-frames of the exposure, then shot noise, read noise and quantisation.

The scene is continued by reflection beyond its edge.  Scintillation, absorption and changing wind are left out.  In
strong turbulence point spread functions vary faster over the field than ``field_spacing``; between the field points
they are mixtures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from ..core.arrays import FloatArray
from ..core.errors import require, require_type
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.threads import map_ahead, one_thread_each
from .atmosphere import PhaseScreenParams
from .moving_objects import MovingObject, with_objects
from .phase_screen import Turbulence, draw_turbulence, tilt_flow
from .pupil import (
    ComplexArray,
    Float64Array,
    Pupil,
    point_spread_functions,
    psf_basis,
    pupil_mask,
    sample_pupil,
    tilt_free_path,
)
from .sequence import CameraParams, SyntheticFrame, check_scene, exposed_frame, record

# The reflected margin covers displacements up to this many standard deviations, chosen.
_WIDEST_TILT = 4


def phase_screen_frames(
    scene: ArrayLike,
    count: int,
    rng: np.random.Generator,
    params: PhaseScreenParams | None = None,
    camera: CameraParams | None = None,
    runtime: Runtime = DEFAULT,
    objects: Sequence[MovingObject] = (),
) -> Iterator[SyntheticFrame]:
    """Generate frames of a scene seen through turbulence.

    Parameters
    ----------
    scene : array_like, shape (H, W) or (H, W, 3)
        Truth, intensities in [0, 1].
    count : int
        Number of frames.
    rng : numpy.random.Generator
        Source of randomness, used when the first frame is requested; the same state gives the same bytes.
    params : PhaseScreenParams, optional
        Path and optics.
    camera : CameraParams, optional
        Timing and noise.
    runtime : Runtime, optional
        ``threads`` frames are computed side by side; their number does not change the frames.
    objects : sequence of MovingObject
        Objects in front of the scene, behind the air; they do not move during an exposure.
        :func:`turbrestore.synthesis.moving_objects.with_objects` has the truth of a frame.

    Returns
    -------
    iterator of SyntheticFrame
        The memory used does not depend on ``count``.

    Raises
    ------
    DataError
        The scene is too small, of one colour, or not in [0, 1].
    ConfigurationError
        ``count`` is not positive, or ``rng`` is no generator.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.synthesis.scenes import resolution_chart
    >>> frames = phase_screen_frames(resolution_chart(64, 96), 2, np.random.default_rng(0))
    >>> [(frame.image.shape, frame.flow.shape) for frame in frames]
    [((64, 96), (64, 96, 2)), ((64, 96), (64, 96, 2))]
    """
    params, camera = params or PhaseScreenParams(), camera or CameraParams()
    truth = check_scene(scene)
    require_type("rng", rng, np.random.Generator, "write np.random.default_rng(0)")
    require(count >= 1, f"count: expected at least 1 frame, found {count}")
    return _frames(truth, count, rng, params, camera, runtime, tuple(objects))


def diffraction_limited(scene: ArrayLike, params: PhaseScreenParams | None = None) -> FloatArray:
    """Image a scene through the optics alone, without turbulence and noise.

    Parameters
    ----------
    scene : array_like, shape (H, W) or (H, W, 3)
        Intensities in [0, 1].
    params : PhaseScreenParams, optional

    Returns
    -------
    ndarray, float32, shape of ``scene``

    Raises
    ------
    DataError
        The scene is too small, of one colour, or not in [0, 1].

    Examples
    --------
    >>> import numpy as np
    >>> edge = np.repeat(np.float32([[0.0, 1.0]]), 16, axis=1).repeat(32, axis=0)
    >>> diffraction_limited(edge)[16, 14:18].round(2)
    array([0.07, 0.28, 0.72, 0.93], dtype=float32)
    """
    params, truth = params or PhaseScreenParams(), check_scene(scene)
    mask = pupil_mask(params)
    flat = np.zeros((1, np.count_nonzero(mask)), np.float32)
    planes = []
    for plane, wavelength in zip(_planes(truth), _wavelengths(truth, params), strict=True):
        psf = point_spread_functions(flat, mask, wavelength, params)[0]
        planes.append(cv2.filter2D(plane, -1, psf[::-1, ::-1].copy(), borderType=cv2.BORDER_REFLECT))
    return _joined(planes)


@dataclass(frozen=True, eq=False)
class _View:
    """Quantities that all frames share."""

    turbulence: Turbulence
    pupil: Pupil
    camera: CameraParams
    scene: FloatArray
    objects: tuple[MovingObject, ...]
    margin: int
    columns: Float64Array
    rows: Float64Array
    nodes: tuple[Float64Array, Float64Array]
    to_pixels: tuple[FloatArray, FloatArray]
    channels: tuple[tuple[float, FloatArray, ComplexArray], ...]  # wavelength, h_0 … h_r and their spectra
    padded: tuple[int, int]


def _frames(
    truth: FloatArray,
    count: int,
    rng: np.random.Generator,
    params: PhaseScreenParams,
    camera: CameraParams,
    runtime: Runtime,
    objects: tuple[MovingObject, ...],
) -> Iterator[SyntheticFrame]:
    with one_thread_each():
        view = _prepare(truth, rng, params, camera, objects)
    # Each frame has a generator of its own, so its noise does not depend on the threads.
    seeds = rng.integers(2**63, size=(count, 2))
    for _, frame in map_ahead(partial(_frame, view, seeds), range(count), runtime.threads):
        yield frame


def _prepare(
    truth: FloatArray,
    rng: np.random.Generator,
    params: PhaseScreenParams,
    camera: CameraParams,
    objects: tuple[MovingObject, ...],
) -> _View:
    height, width = truth.shape[:2]
    turbulence = draw_turbulence(params, (height, width), rng)
    pupil = sample_pupil(turbulence)
    # All channels are sampled at the same places.
    seed = rng.integers(2**63)
    kernels = [
        (wavelength, psf_basis(turbulence, pupil, wavelength, (height, width), np.random.default_rng(seed)))
        for wavelength in _wavelengths(truth, params)
    ]
    margin = max(len(basis[0]) for _, basis in kernels) // 2 + int(np.ceil(_WIDEST_TILT * params.tilt_rms()))
    columns, rows = (np.arange(-margin, size + margin) - (size - 1) / 2 for size in (width, height))
    node_x, to_x = _linear_nodes(width, params.field_spacing)
    node_y, to_y = _linear_nodes(height, params.field_spacing)
    nodes_x, nodes_y = (grid.ravel() for grid in np.meshgrid(node_x - (width - 1) / 2, node_y - (height - 1) / 2))
    padded = (fft.next_fast_len(len(rows), real=True), fft.next_fast_len(len(columns), real=True))
    return _View(
        turbulence,
        pupil,
        camera,
        truth,
        objects,
        margin,
        columns,
        rows,
        (nodes_x, nodes_y),
        (to_x, to_y),
        tuple((wavelength, basis, _spectra(basis, padded)) for wavelength, basis in kernels),
        padded,
    )


def _frame(view: _View, seeds: NDArray[np.int64], number: int) -> SyntheticFrame:
    rate = view.camera.frame_rate
    drifts = [view.turbulence.drift((number + share) / rate) for share in view.camera.sub_frame_shares()]
    flows = (tilt_flow(view.turbulence, view.columns, view.rows, drift) for drift in drifts)
    scene, margin = with_objects(view.scene, view.objects, number)[0], view.margin
    padded = cv2.copyMakeBorder(scene, margin, margin, margin, margin, cv2.BORDER_REFLECT_101)
    image, flow = exposed_frame(padded, flows, lambda displaced, index: _blurred(view, displaced, drifts[index]))
    inside = slice(margin, -margin)
    seen = record(image, view.camera, np.random.default_rng(seeds[number]))
    return SyntheticFrame(seen, np.ascontiguousarray(flow[inside, inside]))


def _blurred(view: _View, displaced: FloatArray, drift: Float64Array) -> FloatArray:
    """Space-varying blur of a displaced scene, without its margin."""
    path = tilt_free_path(view.turbulence, view.pupil, *view.nodes, drift)
    to_x, to_y = view.to_pixels
    planes = []
    for plane, (wavelength, kernels, spectra) in zip(_planes(displaced), view.channels, strict=True):
        psfs = point_spread_functions(path, view.pupil.mask, wavelength, view.turbulence.params)
        components = kernels[1:].reshape(len(kernels) - 1, -1)
        weights = (psfs - kernels[0]).reshape(len(psfs), -1) @ components.T
        maps = to_y @ weights.T.reshape(len(components), to_y.shape[1], to_x.shape[1]) @ to_x.T
        spectrum = fft.rfft2(plane, s=view.padded)
        rows, columns = (slice(view.margin, view.margin + len(matrix)) for matrix in (to_y, to_x))
        blurred = fft.irfft2(spectrum * spectra[0], s=view.padded)[rows, columns]
        for weight, component in zip(maps, spectra[1:], strict=True):
            blurred += weight * fft.irfft2(spectrum * component, s=view.padded)[rows, columns]
        planes.append(blurred)
    return _joined(planes)


def _spectra(kernels: FloatArray, shape: tuple[int, int]) -> ComplexArray:
    """Fourier transforms of kernels, centred on the first pixel."""
    grid = np.zeros((len(kernels), *shape), np.float32)
    size = kernels.shape[1]
    grid[:, :size, :size] = kernels
    return fft.rfft2(np.roll(grid, (-(size // 2), -(size // 2)), axis=(1, 2)))


def _linear_nodes(size: int, spacing: int) -> tuple[Float64Array, FloatArray]:
    """Evenly spaced nodes from the first pixel to the last, and the matrix of linear interpolation to the pixels."""
    count = int(np.ceil((size - 1) / spacing)) + 1
    nodes = np.linspace(0, size - 1, count)
    distance = np.abs(np.arange(size)[:, None] - nodes) / (nodes[1] - nodes[0])
    return nodes, np.maximum(1 - distance, 0).astype(np.float32)


def _wavelengths(scene: FloatArray, params: PhaseScreenParams) -> tuple[float, ...]:
    return (params.wavelength,) if scene.ndim == 2 else params.channel_wavelengths


def _planes(image: FloatArray) -> list[FloatArray]:
    return [image] if image.ndim == 2 else [np.ascontiguousarray(image[..., channel]) for channel in range(3)]


def _joined(planes: list[FloatArray]) -> FloatArray:
    return planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)
