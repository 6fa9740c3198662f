"""Anisoplanatic imaging: a scene seen through several layers of turbulence that drift with the wind.

Symbols
-------
L, D, λ, r0, γ : as in :mod:`turbrestore.synthesis.atmosphere`.  S : phase screen, m.
θ : field angle, rad.  ρ : position in the pupil, m.  v : wind of a layer, m/s.  t : time, s.
φ_θ(ρ) = (2π/λ) Σ_layers S(γρ + zθ − vt) : phase over the pupil, for spherical waves.
h_θ : point spread function ``|∫ exp(iφ_θ − 2πi ρ·u/λ) dρ|²`` of the phase without its tilt; sums to 1.

How a frame is made
-------------------
1. Tilt at every pixel (:func:`turbrestore.synthesis.phase_screen.tilt_flow`).  Light of θ arrives from θ + tilt, so
   ``frame(x + tilt) = truth(x)``.
2. Point spread functions of the tilt-free phase at field points ``field_spacing`` apart, by matrix Fourier transform
   at the pixels of the camera.  In colour the path differences are shared and the phase goes with 1/λ of a channel.
3. Displacement first, blur second, as light has it (Chan, *Tilt-then-blur or blur-then-tilt?*, 2022).  The blur varies
   over the image: ``frame(y) = Σ_k c_k(y) (h_k ∗ displaced)(y)`` with h_0 the mean and the other h_k the principal
   components of point spread functions seen elsewhere in the same screens; c_k is linear between field points.  The
   h_k with k > 0 sum to 0: no light is lost or gained.
4. The mean over the sub-frames of the exposure, then shot noise, read noise and quantisation.

Beyond the edge the scene is continued by reflection.  Left out: scintillation, absorption, changing wind.  In strong
turbulence point spread functions vary faster over the field than ``field_spacing``; mixtures stand for those between.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from ..arrays import FloatArray
from ..errors import require
from ..parallel import map_ahead, one_thread_each
from .atmosphere import PhaseScreenParams
from .exposure import exposed_frame
from .phase_screen import Turbulence, draw_turbulence, sample_lattice, tilt_flow
from .sequence import CameraParams, SyntheticFrame, check_scene, record

Float64Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex64]

# Waves bend little over the pupil; singular values of their bends below this share of the largest are left out.
_BEND_TOLERANCE = 1e-3
_SAMPLED_INSTANTS, _SAMPLED_POINTS = 16, 32
_KEPT_VARIANCE, _MOST_COMPONENTS = 0.99, 32
# Displacements beyond this many standard deviations see the edge of the reflected scene repeated.
_WIDEST_TILT = 4


@dataclass(frozen=True, eq=False)
class Pupil:
    """Samples of a circular aperture, and how the plane waves of each screen bend over it.

    Attributes
    ----------
    mask : ndarray, bool, shape (N, N)
        Samples inside the aperture; there are P.
    x, y : ndarray, float64, shape (P,)
        Their positions ρ, m.
    planes : ndarray, float32, shape (3, P)
        Orthonormal basis of piston and tilts.
    bends : tuple of (complex128 (m, r), float32 (r, P))
        For each layer, ``exp(−2πi γ f·ρ)`` of each wave without its piston and tilt, as a product.
    """

    mask: NDArray[np.bool_]
    x: Float64Array
    y: Float64Array
    planes: FloatArray
    bends: tuple[tuple[NDArray[np.complex128], FloatArray], ...]


@dataclass(frozen=True, eq=False)
class PsfBasis:
    """Low-rank basis of the point spread functions at one wavelength.

    Attributes
    ----------
    mean : ndarray, float32, shape (K, K)
        Sums to 1.
    components : ndarray, float32, shape (r, K, K)
        Orthonormal; each sums to 0.
    kept : float
        Share of the variance of the sampled functions that the components hold.
    """

    mean: FloatArray
    components: FloatArray
    kept: float


def phase_screen_frames(
    scene: ArrayLike,
    count: int,
    rng: np.random.Generator,
    params: PhaseScreenParams | None = None,
    camera: CameraParams | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[SyntheticFrame]:
    """Frames of a scene seen through turbulence, one after the other.

    Parameters
    ----------
    scene : array_like, shape (H, W) or (H, W, 3)
        Truth, intensities in [0, 1].
    count : int
        Number of frames.
    rng : numpy.random.Generator
        Source of randomness; the same state of it gives the same bytes.
    params : PhaseScreenParams, optional
        Path and optics.
    camera : CameraParams, optional
        Timing and noise.
    progress : callable, optional
        Called with 1 after each frame.

    Returns
    -------
    iterator of SyntheticFrame
        Memory does not grow with ``count``.

    Raises
    ------
    DataError
        The scene is too small, of one colour, or not in [0, 1].
    ConfigurationError
        ``count`` is not positive.

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
    require(count >= 1, f"count: expected at least 1 frame, found {count}")
    return _frames(truth, count, rng, params, camera, progress)


def diffraction_limited(scene: ArrayLike, params: PhaseScreenParams | None = None) -> FloatArray:
    """Show a scene as the optics alone would, without turbulence and noise.

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


def pupil_mask(params: PhaseScreenParams) -> NDArray[np.bool_]:
    """Mark the samples of the grid over the pupil that lie inside the aperture.

    Parameters
    ----------
    params : PhaseScreenParams

    Returns
    -------
    ndarray, bool, shape (N, N)

    Examples
    --------
    >>> round(float(pupil_mask(PhaseScreenParams()).mean()), 3)
    0.793
    """
    axis = (np.arange(params.pupil_samples) + 0.5) / params.pupil_samples - 0.5
    return np.hypot(axis[:, None], axis) <= 0.5


def sample_pupil(turbulence: Turbulence) -> Pupil:
    """Sample the aperture, and find how the plane waves of the screens bend over it.

    Parameters
    ----------
    turbulence : Turbulence

    Returns
    -------
    Pupil

    Examples
    --------
    >>> import numpy as np
    >>> pupil = sample_pupil(draw_turbulence(PhaseScreenParams(layers=2), (64, 64), np.random.default_rng(0)))
    >>> pupil.planes.shape[0], len(pupil.bends)
    (3, 2)
    """
    params = turbulence.params
    mask = pupil_mask(params)
    axis = ((np.arange(params.pupil_samples) + 0.5) / params.pupil_samples - 0.5) * params.aperture
    x, y = (grid[mask] for grid in np.meshgrid(axis, axis))
    planes = np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=1))[0].T
    bends = []
    for layer, screen in zip(turbulence.layers, turbulence.screens, strict=True):
        waves = np.exp(-2j * np.pi * layer.shrink * (screen.frequencies @ np.stack([x, y])))
        waves -= (waves @ planes.T) @ planes
        weighed = waves * np.abs(screen.waves)[:, None]
        sizes, basis = _principal_directions(np.concatenate([weighed.real, weighed.imag]))
        basis = basis[sizes > _BEND_TOLERANCE * sizes[0]]
        bends.append((waves @ basis.T, basis.astype(np.float32)))
    return Pupil(mask, x, y, planes.astype(np.float32), tuple(bends))


def tilt_free_path(
    turbulence: Turbulence, pupil: Pupil, x: Float64Array, y: Float64Array, drift: Float64Array
) -> FloatArray:
    """Difference of optical path over the pupil, less its piston and tilt, for several field points.

    Parameters
    ----------
    turbulence : Turbulence
    pupil : Pupil
    x, y : ndarray, float64, shape (F,)
        Field points, pixels from the line of sight.
    drift : ndarray, float64, shape (layers, 2)
        m.

    Returns
    -------
    ndarray, float32, shape (F, P)
        m.

    Examples
    --------
    >>> import numpy as np
    >>> turbulence = draw_turbulence(PhaseScreenParams(layers=2), (64, 64), np.random.default_rng(0))
    >>> pupil = sample_pupil(turbulence)
    >>> path = tilt_free_path(turbulence, pupil, np.zeros(1), np.zeros(1), turbulence.drift(0.0))
    >>> bool(abs(path @ pupil.planes.T).max() < 1e-4 * abs(path).max())
    True
    """
    total = np.zeros((len(x), len(pupil.x)), np.float32)
    for number, (layer, screen) in enumerate(zip(turbulence.layers, turbulence.screens, strict=True)):
        scale = layer.distance * turbulence.params.pixel_angle
        centres = np.stack([scale * x - drift[number, 0], scale * y - drift[number, 1]], axis=1)
        at_x, at_y = (centres[:, :1] + layer.shrink * pupil.x, centres[:, 1:] + layer.shrink * pupil.y)
        total += sample_lattice(screen, [screen.path], at_x, at_y)[0]
        bends, basis = pupil.bends[number]
        turned = np.exp(-2j * np.pi * (centres @ screen.frequencies.T)) * screen.waves
        total += (turned @ bends).real.astype(np.float32) @ basis
    return np.subtract(total, (total @ pupil.planes.T) @ pupil.planes, dtype=np.float32)


def point_spread_functions(
    path: FloatArray, mask: NDArray[np.bool_], wavelength: float, params: PhaseScreenParams
) -> FloatArray:
    """Point spread functions of differences of path over the pupil, at the pixels of the camera.

    Where pixels are coarser than λ/2D the intensity is averaged over each of them.

    Parameters
    ----------
    path : ndarray, float32, shape (F, P)
        m.
    mask : ndarray, bool, shape (N, N)
        Of :func:`pupil_mask`, true P times.
    wavelength : float
        m.
    params : PhaseScreenParams

    Returns
    -------
    ndarray, float32, shape (F, K, K), K odd
        Each sums to 1; what falls outside the window counts as inside.

    Examples
    --------
    >>> import numpy as np
    >>> params = PhaseScreenParams(d_over_r0=1.0)
    >>> mask = pupil_mask(params)
    >>> sharp = point_spread_functions(np.zeros((1, mask.sum()), np.float32), mask, 550e-9, params)[0]
    >>> sharp.shape, round(float(sharp.max()), 3)
    ((27, 27), 0.203)
    """
    transform, parts = _transform(wavelength, params)
    field = np.zeros((len(path), *mask.shape), np.complex64)
    field[:, mask] = np.exp(path * np.complex64(2j * np.pi / wavelength))
    spread = transform @ field @ transform.T
    intensity = spread.real**2 + spread.imag**2
    width = len(transform) // parts
    if parts > 1:
        intensity = intensity.reshape(-1, width, parts, width, parts).sum(axis=(2, 4))
    return intensity / intensity.sum(axis=(1, 2), keepdims=True)


def psf_basis(
    turbulence: Turbulence, pupil: Pupil, wavelength: float, shape: tuple[int, ...], rng: np.random.Generator
) -> PsfBasis:
    """Principal components of point spread functions at random places of the screens.

    Parameters
    ----------
    turbulence : Turbulence
    pupil : Pupil
    wavelength : float
        m.
    shape : (int, int)
        Rows and columns of the field of view, pixels.
    rng : numpy.random.Generator
        Chooses the places.

    Returns
    -------
    PsfBasis

    Examples
    --------
    >>> import numpy as np
    >>> turbulence = draw_turbulence(PhaseScreenParams(layers=2), (64, 64), np.random.default_rng(0))
    >>> basis = psf_basis(turbulence, sample_pupil(turbulence), 550e-9, (64, 64), np.random.default_rng(1))
    >>> basis.kept > 0.95, bool(abs(basis.mean.sum() - 1) < 1e-5)
    (True, True)
    """
    half_height, half_width = (size / 2 for size in shape[:2])
    samples = []
    for _ in range(_SAMPLED_INSTANTS):
        drift = rng.uniform(0, 1000, (len(turbulence.layers), 2))
        x, y = rng.uniform(-1, 1, (2, _SAMPLED_POINTS)) * [[half_width], [half_height]]
        path = tilt_free_path(turbulence, pupil, x, y, drift)
        samples.append(point_spread_functions(path, pupil.mask, wavelength, turbulence.params))
    stack = np.concatenate(samples).astype(np.float64)
    mean = stack.mean(axis=0)
    centred = (stack - mean).reshape(len(stack), -1)
    sizes, components = _principal_directions(centred)
    shares = np.cumsum(sizes**2) / max(np.sum(sizes**2), np.finfo(np.float64).tiny)
    rank = min(int(np.searchsorted(shares, _KEPT_VARIANCE)) + 1, _MOST_COMPONENTS)
    kept = components[:rank].reshape(rank, *mean.shape)
    return PsfBasis(mean.astype(np.float32), kept.astype(np.float32), float(shares[rank - 1]))


@dataclass(frozen=True, eq=False)
class _View:
    """All that stays the same from frame to frame."""

    turbulence: Turbulence
    pupil: Pupil
    camera: CameraParams
    scene: FloatArray
    margin: int
    columns: Float64Array
    rows: Float64Array
    nodes: tuple[Float64Array, Float64Array]
    to_pixels: tuple[FloatArray, FloatArray]
    wavelengths: tuple[float, ...]
    bases: tuple[PsfBasis, ...]
    spectra: tuple[ComplexArray, ...]
    padded: tuple[int, int]


def _frames(
    truth: FloatArray,
    count: int,
    rng: np.random.Generator,
    params: PhaseScreenParams,
    camera: CameraParams,
    progress: Callable[[int], None] | None,
) -> Iterator[SyntheticFrame]:
    with one_thread_each():
        view = _prepare(truth, rng, params, camera)
    # Each frame has noise of its own, so that threads cannot change it.
    seeds = rng.integers(2**63, size=(count, 2))
    for _, frame in map_ahead(partial(_frame, view, seeds), range(count)):
        if progress is not None:
            progress(1)
        yield frame


def _prepare(truth: FloatArray, rng: np.random.Generator, params: PhaseScreenParams, camera: CameraParams) -> _View:
    height, width = truth.shape[:2]
    turbulence = draw_turbulence(params, (height, width), rng)
    pupil = sample_pupil(turbulence)
    wavelengths = _wavelengths(truth, params)
    # All channels are sampled at the same places.
    seed = rng.integers(2**63)
    bases = tuple(
        psf_basis(turbulence, pupil, wavelength, (height, width), np.random.default_rng(seed))
        for wavelength in wavelengths
    )
    margin = max(basis.mean.shape[0] for basis in bases) // 2 + int(np.ceil(_WIDEST_TILT * params.tilt_rms()))
    columns, rows = (np.arange(-margin, size + margin) - (size - 1) / 2 for size in (width, height))
    node_x, to_x = _linear_nodes(width, params.field_spacing)
    node_y, to_y = _linear_nodes(height, params.field_spacing)
    nodes_x, nodes_y = (grid.ravel() for grid in np.meshgrid(node_x - (width - 1) / 2, node_y - (height - 1) / 2))
    padded = (fft.next_fast_len(len(rows), real=True), fft.next_fast_len(len(columns), real=True))
    return _View(
        turbulence,
        pupil,
        camera,
        cv2.copyMakeBorder(truth, margin, margin, margin, margin, cv2.BORDER_REFLECT_101),
        margin,
        columns,
        rows,
        (nodes_x, nodes_y),
        (to_x, to_y),
        wavelengths,
        bases,
        tuple(_spectra(basis, padded) for basis in bases),
        padded,
    )


def _frame(view: _View, seeds: NDArray[np.int64], number: int) -> SyntheticFrame:
    rate = view.camera.frame_rate
    drifts = [view.turbulence.drift((number + share) / rate) for share in view.camera.sub_frame_shares()]
    flows = (tilt_flow(view.turbulence, view.columns, view.rows, drift) for drift in drifts)
    image, flow = exposed_frame(view.scene, flows, lambda displaced, index: _blurred(view, displaced, drifts[index]))
    inside = slice(view.margin, -view.margin)
    seen = record(image, view.camera, np.random.default_rng(seeds[number]))
    return SyntheticFrame(seen, np.ascontiguousarray(flow[inside, inside]))


def _blurred(view: _View, displaced: FloatArray, drift: Float64Array) -> FloatArray:
    """Space-varying blur of a displaced scene, without its margin."""
    path = tilt_free_path(view.turbulence, view.pupil, *view.nodes, drift)
    to_x, to_y = view.to_pixels
    planes = []
    for plane, wavelength, basis, spectra in zip(
        _planes(displaced), view.wavelengths, view.bases, view.spectra, strict=True
    ):
        psfs = point_spread_functions(path, view.pupil.mask, wavelength, view.turbulence.params)
        rank = len(basis.components)
        weights = (psfs - basis.mean).reshape(len(psfs), -1) @ basis.components.reshape(rank, -1).T
        maps = to_y @ weights.T.reshape(rank, to_y.shape[1], to_x.shape[1]) @ to_x.T
        spectrum = fft.rfft2(plane, s=view.padded)
        rows, columns = (slice(view.margin, view.margin + len(matrix)) for matrix in (to_y, to_x))
        blurred = fft.irfft2(spectrum * spectra[0], s=view.padded)[rows, columns]
        for weight, component in zip(maps, spectra[1:], strict=True):
            blurred += weight * fft.irfft2(spectrum * component, s=view.padded)[rows, columns]
        planes.append(blurred)
    return _joined(planes)


def _transform(wavelength: float, params: PhaseScreenParams) -> tuple[ComplexArray, int]:
    """Matrix from the samples of the pupil to the window of the image, and its rows for each pixel."""
    pixel = params.pixel_angle
    widest = max(params.wavelength, *params.channel_wavelengths)
    radius = max(int(np.ceil(params.psf_radius * widest / params.aperture / pixel)), 1)
    # An odd number of parts keeps the middle of a pixel among them.
    parts = 2 * int(np.ceil((pixel / (params.wavelength / (2 * params.aperture)) - 1 - 1e-9) / 2)) + 1
    count = (2 * radius + 1) * parts
    angles = (np.arange(count) - (count - 1) / 2) * (pixel / parts)
    axis = ((np.arange(params.pupil_samples) + 0.5) / params.pupil_samples - 0.5) * params.aperture
    return np.exp(-2j * np.pi / wavelength * np.outer(angles, axis)).astype(np.complex64), max(parts, 1)


def _principal_directions(rows: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Singular values of a matrix, largest first, and its right singular vectors where the values are not nothing."""
    wide = rows.shape[0] < rows.shape[1]
    # The smaller Gram matrix is many times faster than the decomposition, and knows sizes to 1e-6 of the largest.
    values, vectors = np.linalg.eigh(rows @ rows.T if wide else rows.T @ rows)
    kept = np.flatnonzero(values > 1e-12 * max(values[-1], np.finfo(np.float64).tiny))[::-1]
    sizes, vectors = np.sqrt(values[kept]), vectors[:, kept]
    return sizes, (vectors / sizes).T @ rows if wide else vectors.T


def _spectra(basis: PsfBasis, shape: tuple[int, int]) -> ComplexArray:
    """Fourier transforms of the mean and the components, centred on the first pixel."""
    kernels = np.concatenate([basis.mean[None], basis.components])
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
