"""Deconvolution by nonlocal TV, TV, Wiener or Tikhonov regularisation as one problem (paper 3, section 5).

``min_u λ/2 ‖M(k∗u − f)‖² + J(u)``.  Eq. 21 is its general form; eqs. 22 and 24 are the gradient flows of the energies
with TV and with nonlocal TV.  The data term of eq. 21 has no λ/2, so that its μ is 1/λ for Wiener and Tikhonov.  The
paper's Tikhonov penalty is ‖u‖²; here the deviation from the mean is penalised, which keeps the brightness.

Symbols as in :mod:`turbrestore.deconvolution.problem`, and

J : ``Σ|∇_w u|`` ("nltv"), ``Σ|∇u|`` ("tv"), ``½‖∇u‖²`` ("wiener"), ``½‖u − mean f‖²`` ("tikhonov").

The nltv and tv problems are solved by :mod:`turbrestore.deconvolution.primal_dual`, the wiener and tikhonov ones by
:mod:`turbrestore.deconvolution.conjugate_gradient`; the same code runs in NumPy and in torch.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..blur.estimation import BlurEstimate
from ..blur.psf import GAUSSIAN, blur_otf, check_exponent, half_frequency, psf_to_otf
from ..core.arrays import FloatArray, check_grey, check_image, check_unit_image, luminance
from ..core.errors import ConfigurationError, DataError, require, require_between, settings_of
from ..core.noise import NoiseCurve, estimate_noise
from ..core.noise_spectrum import NoiseSpectrum
from ..display.curves import plot_objective
from ..display.preview import preview, summary
from ..runtime.device import find_device, memory_of
from ..runtime.image_stacks import Stack, load, store
from ..runtime.runtime import DEFAULT, Runtime
from ..runtime.steps import finish
from ..runtime.threads import ThreadTeam, one_thread_each
from .conjugate_gradient import quadratic_solver, wiener_fidelity, wiener_image
from .nonlocal_prior.nonlocal_tv import PARALLEL_PIXELS, NonlocalPenalty
from .nonlocal_prior.nonlocal_weights import NonlocalParams, nonlocal_weights
from .nonlocal_prior.torch_nonlocal import torch_nonlocal_penalty
from .primal_dual import Penalty, PrimalDual
from .problem import Problem, margin_around, problem_of, read_blur
from .stopping import Solution, Steps, iterate
from .tv import LocalPenalty

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METHODS = ("nltv", "tv", "wiener", "tikhonov")
BOUNDARIES = ("unknown", "periodic")
CHANNELS = ("luminance", "each")


@dataclass(frozen=True)
class DeconvolutionParams:
    """How an image is deblurred.

    Parameters
    ----------
    method : {"nltv", "tv", "wiener", "tikhonov"}
        Penalty: nonlocal TV, TV, squared gradient, squared deviation from the mean.
    sigma : float, optional
        Width of the blur, pixels.  It is estimated if it is not given, except by :func:`deconvolve`, which needs it.
    exponent : float, optional
        Shape of the blur: 2 is a Gaussian, 5/3 a long exposure through turbulence.  By
        default 2 if the width is given, and that of fused frames if it is estimated.
    fidelity : float, optional
        Weight λ of the data: a larger one gives a sharper and noisier image.  By default it is chosen from the noise
        of the image.
    iterations : int
        Largest number of iterations.
    tolerance : float
        Stop when every tile of 64×64 pixels is predicted to change by at most this from then on, relative to the
        brightest tile.  nltv and tv, whose images oscillate, also stop when
        no tile has changed by more than this for 50 iterations.
    boundary : {"unknown", "periodic"}
        What lies beyond the border: unknown pixels, which are estimated too, or the image repeated periodically.
    channels : {"luminance", "each"}
        For a colour image, deblur the luminance and keep the chroma, or deblur every channel.
    sharpen_guide : bool
        Compare patches of the guide after a Wiener deconvolution instead of the blurred guide as in the paper.  Sharp
        patches show better which pixels are similar; this gains 0.2 to 4 dB on photographs, brick and text.
    weights : NonlocalParams
        Settings of the nonlocal weights.
    """

    method: Literal["nltv", "tv", "wiener", "tikhonov"] = "nltv"
    sigma: float | None = None
    exponent: float | None = None
    fidelity: float | None = None
    iterations: int = 400
    tolerance: float = 3e-3
    boundary: Literal["unknown", "periodic"] = "unknown"
    channels: Literal["luminance", "each"] = "luminance"
    sharpen_guide: bool = True
    weights: NonlocalParams = field(default_factory=NonlocalParams)

    def __post_init__(self) -> None:
        for name, value, known in (
            ("method", self.method, METHODS),
            ("boundary", self.boundary, BOUNDARIES),
            ("channels", self.channels, CHANNELS),
        ):
            require(value in known, f"{name}: expected one of {', '.join(known)}, found {value!r}")
        if self.sigma is not None:
            require_between("sigma", self.sigma, 0, 1000, "pixels")
        if self.exponent is not None:
            check_exponent(self.exponent)
        if self.fidelity is not None:
            require_between("fidelity", self.fidelity, 1e-6, 1e9)
        require_between("iterations", self.iterations, 1, 100_000)
        require_between("tolerance", self.tolerance, 0, 1)


@dataclass(frozen=True, eq=False)
class Deconvolution:
    """A deblurred image and how it was found.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        Clipped to [0, 1].
    sigma : float
        Standard deviation of the blur that was removed, pixels (root mean square over x and y of a given PSF).
    fidelity : float
        λ that was used.
    noise : float
        Noise that the deconvolution reckons with, intensity: the standard deviation of white noise that is as strong as
        that of the blurred image at the frequency of which the blur leaves half, and no less than second differences
        tell.  The deviation of a pixel is smaller where the noise is smooth.
    iterations : int
        Iterations that were run.
    converged : bool
        Whether the predicted change fell below the tolerance, or the image was at rest.
    recorded : ndarray, int64, shape (n,)
        Iterations at which ``objective`` and ``changes`` were recorded.
    objective : ndarray, float64, shape (n,)
        Value of the minimised energy, summed over channels.
    changes : ndarray, float64, shape (n,)
        Change per iteration of the tile that changes most, relative to the brightest tile.  For nltv and tv with an
        unknown boundary, a border as wide as the blur is not counted.
    """

    image: FloatArray
    sigma: float
    fidelity: float
    noise: float
    iterations: int
    converged: bool
    recorded: NDArray[np.int64]
    objective: NDArray[np.float64]
    changes: NDArray[np.float64]

    def plot(self) -> Figure:
        """Draw the energy over the iterations.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ConfigurationError
            Matplotlib is not installed.
        """
        return plot_objective(self.recorded, self.objective)

    def __repr__(self) -> str:
        return summary("Deconvolution", self._facts(), self.image.shape)

    def _repr_html_(self) -> str:
        return preview("Deblurred image", self._facts(), self.image)

    def _facts(self) -> list[tuple[str, str]]:
        return [
            ("blur removed", f"{self.sigma:.2f} pixels" if self.sigma > 0 else "none"),
            ("noise at half frequency", f"{100 * self.noise:.2f} % of full scale, if it were white"),
            ("iterations", f"{self.iterations}, {'' if self.converged else 'not '}converged"),
        ]


def deconvolve(
    image: ArrayLike,
    sigma_or_psf: float | BlurEstimate | ArrayLike | None = None,
    params: DeconvolutionParams | None = None,
    guide: ArrayLike | None = None,
    runtime: Runtime = DEFAULT,
    noise: NoiseSpectrum | None = None,
) -> Deconvolution:
    """Deblur an image.

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        f.
    sigma_or_psf : float, BlurEstimate, or array_like of shape (h, w) with odd sizes, optional
        Width of a blur of shape ``params.exponent``, pixels; or an estimate, whose removable width is used, with its
        shape unless ``params.exponent`` is given; or a sampled point spread function.  By default ``params.sigma``.
        Without blur (0, or a single pixel) the image is returned unchanged.
    params : DeconvolutionParams, optional
        Method and settings.
    guide : array_like, shape (H, W) or (H, W, 3), optional
        Image from which the nonlocal weights are computed, with the same blur as ``image``; by default ``image``.  The
        paper uses the centroid.
    runtime : Runtime
        Threads and device.
    noise : NoiseSpectrum, optional
        Noise of the luminance, such as :attr:`turbrestore.Restoration.noise`; by default second differences of the
        image tell how much white noise it has.

    Returns
    -------
    Deconvolution

    Raises
    ------
    DataError
        Wrong shapes, values that are not finite or on another scale than 0 to 1, or an unusable PSF.
    ConfigurationError
        The blur is not given, negative, not finite or wider than the longer side of the image, or the memory of the
        device is not enough.

    Examples
    --------
    >>> import cv2, numpy as np
    >>> square = np.zeros((48, 48), np.float32); square[16:32, 16:32] = 0.8
    >>> blurred = cv2.GaussianBlur(square, (0, 0), 1.5)
    >>> result = deconvolve(blurred, 1.5, DeconvolutionParams(method="tv", fidelity=1000.0))
    >>> bool(np.abs(result.image - square).mean() < 0.3 * np.abs(blurred - square).mean())
    True
    """
    pixels = check_unit_image(image)
    guide = None if guide is None else check_unit_image(guide, "guide")
    return finish(deconvolve_steps(pixels, sigma_or_psf, params, guide, runtime, spectrum=noise))


def deconvolve_steps(
    image: ArrayLike,
    sigma_or_psf: float | BlurEstimate | ArrayLike | None = None,
    params: DeconvolutionParams | None = None,
    guide: ArrayLike | None = None,
    runtime: Runtime = DEFAULT,
    photons: NoiseCurve | None = None,
    full_scale: tuple[float, float] = (0.0, 1.0),
    spectrum: NoiseSpectrum | None = None,
    refuse: Callable[[FloatArray], bool] | None = None,
) -> Steps[Deconvolution]:
    """Deblur an image step by step; arguments, errors and result as of :func:`deconvolve`.

    ``photons`` is the noise of the image at every level, relative to its mean; ``full_scale`` is black and white, to
    which the result is clipped; ``spectrum`` is the noise of the luminance, if the frames have told it.  ``refuse``
    tells by the image after a few iterations whether to end there.
    """
    params = settings_of(DeconvolutionParams, params)
    pixels = check_image(image)
    if sigma_or_psf is None:
        if params.sigma is None:
            raise ConfigurationError("sigma_or_psf: expected a blur here or in params.sigma, found neither")
        sigma_or_psf = params.sigma
    if isinstance(sigma_or_psf, BlurEstimate):
        params = dataclasses.replace(params, exponent=params.exponent or sigma_or_psf.exponent)
        sigma_or_psf = sigma_or_psf.removable
    psf, sigma, reach = read_blur(sigma_or_psf)
    longest = max(pixels.shape[:2])
    require(
        psf is not None or sigma <= longest,
        f"sigma_or_psf: expected at most the {longest} pixels of the longer side of the image, found {sigma:g}",
    )
    planes = split_planes(pixels, params.channels)
    noise, fidelity = _noise_and_fidelity(planes, params, sigma, spectrum)
    if sigma == 0:
        nothing = np.zeros(0)
        return Deconvolution(pixels, 0.0, fidelity, noise, 0, True, nothing.astype(np.int64), nothing, nothing)
    (height, width), unknown = planes[0].shape, params.boundary == "unknown"
    margin = margin_around((height, width), reach if unknown else None)
    shape = margin.shape
    otf = blur_otf(shape, sigma, params.exponent or GAUSSIAN) if psf is None else psf_to_otf(psf, shape)
    oscillates = unknown and params.method in ("nltv", "tv")
    rim = min(int(np.ceil(sigma)), min(height, width) // 4) if oscillates else 0
    device = find_device(runtime.device)
    with memory_of(device), one_thread_each(), ThreadTeam(runtime.workers) as team:
        transfer = load(otf, device)
        problems = [problem_of(plane, margin, photons, transfer, fidelity, runtime.workers) for plane in planes]
        measured = load(margin.mask(rim), device)
        guide_image = None
        if guide is not None:
            grey = check_grey(guide, "guide")
            if grey.shape != margin.size:
                raise DataError(f"guide: expected the size of the image {margin.size}, found {grey.shape}")
            guide_image = margin.pad(grey)

        def shown(images: list[Stack]) -> FloatArray:
            planes = [store(u)[margin.inside()] for u in images]
            return np.clip(join_planes(pixels, planes, params.channels), *full_scale)

        stop = None if refuse is None else lambda images: refuse(shown(images))
        solution = yield from _solve(problems, guide_image, noise, measured, params, team, stop)
    records = (np.array(column) for column in zip(*solution.records, strict=True))
    return Deconvolution(
        shown(solution.images), sigma, fidelity, noise, solution.iterations, solution.converged, *records
    )


def whole_image_fidelity(
    image: ArrayLike, params: DeconvolutionParams, sigma: float = 0.0, spectrum: NoiseSpectrum | None = None
) -> float:
    """Weight λ of the data for an image (H, W[, 3]), so that its tiles can have the same."""
    return _noise_and_fidelity(split_planes(check_image(image), params.channels), params, sigma, spectrum)[1]


def split_planes(image: FloatArray, channels: str) -> list[FloatArray]:
    """Split an image (H, W[, 3]) into the planes (H, W) that are deblurred."""
    if image.ndim == 3 and channels == "each":
        return [np.ascontiguousarray(image[..., index]) for index in range(image.shape[2])]
    return [luminance(image)]


def join_planes(image: FloatArray, planes: list[FloatArray], channels: str) -> FloatArray:
    """Join deblurred planes (H, W) into an image (H, W[, 3]); the reverse of :func:`split_planes`."""
    if image.ndim == 2:
        return planes[0]
    if channels == "each":
        return np.stack(planes, axis=-1)
    return image + (planes[0] - luminance(image))[..., None]


def _solve(
    problems: list[Problem],
    guide: FloatArray | None,
    noise: float,
    measured: Stack,
    params: DeconvolutionParams,
    team: ThreadTeam,
    refuse: Callable[[list[Stack]], bool] | None,
) -> Steps[Solution]:
    stop = measured, params.iterations, params.tolerance, refuse
    if params.method in ("wiener", "tikhonov"):
        quadratic = quadratic_solver(problems[0], params.method)
        return (yield from iterate(quadratic, problems, [quadratic.start(p) for p in problems], *stop))
    starts, compared = _sharpened(problems, guide, noise, params, team)
    penalty: Penalty = LocalPenalty()
    if params.method == "nltv" and isinstance(measured, np.ndarray):
        penalty = NonlocalPenalty(nonlocal_weights(compared, params.weights, problems[0].threads), team)
    elif params.method == "nltv":
        penalty = torch_nonlocal_penalty(compared, params.weights, measured.device)
    solver = PrimalDual(penalty)
    states = [solver.start(problem, u) for problem, u in zip(problems, starts, strict=True)]
    del starts, compared
    return (yield from iterate(solver, problems, states, *stop))


def _sharpened(
    problems: list[Problem], guide: FloatArray | None, noise: float, params: DeconvolutionParams, team: ThreadTeam
) -> tuple[list[Stack], FloatArray]:
    """Return the Wiener solutions to start from, and the image for patches, by default the mean of the channels."""
    observed, blurred = problems[0].observed, list(problems)
    if guide is not None and params.sharpen_guide and params.method == "nltv":
        blurred.append(dataclasses.replace(problems[0], observed=load(guide, observed.device)))
    side_by_side = isinstance(observed, np.ndarray) and observed.size >= PARALLEL_PIXELS
    sharpen = partial(wiener_image, noise=noise)
    sharp = list(team.map(sharpen, blurred) if side_by_side else map(sharpen, blurred))
    starts, further = sharp[: len(problems)], sharp[len(problems) :]
    if further:
        return starts, store(further[0])
    if guide is not None:
        return starts, guide
    own = starts if params.sharpen_guide else [problem.observed for problem in problems]
    return starts, np.mean([store(u) for u in own], axis=0, dtype=np.float32)


def _noise_and_fidelity(
    planes: list[FloatArray], params: DeconvolutionParams, sigma: float, spectrum: NoiseSpectrum | None
) -> tuple[float, float]:
    """Noise that the deconvolution meets, and λ.

    Second differences tell white noise.  Of smooth noise, what there certainly is at the half frequency counts.
    """
    noise = float(np.sqrt(np.mean([estimate_noise(plane) ** 2 for plane in planes])))
    if spectrum is not None:
        known = spectrum.certain
        smooth = known.deviation if sigma == 0 else float(known.at(np.array(half_frequency(sigma)))) ** 0.5
        noise = max(noise, smooth)
    return noise, params.fidelity or automatic_fidelity(params.method, planes[0], noise)


def automatic_fidelity(method: str, image: FloatArray, noise: float) -> float:
    """Choose the weight λ of the data term from the noise of the blurred image (H, W)."""
    if method == "nltv":
        return 20.0 / float(np.hypot(noise, 0.004))
    if method == "tv":
        return 12.0 / float(np.hypot(noise, 0.003))
    fidelity = wiener_fidelity(image, noise)
    return fidelity if method == "wiener" else fidelity / 2
