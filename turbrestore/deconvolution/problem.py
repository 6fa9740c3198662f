"""The deconvolution problem: data term, boundary, and the planes of a colour image.

Symbols
-------
f : observed image; u : unknown image.
k : point spread function; B : convolution with k; H : its transfer function; Bᵀ : adjoint of B.
M : 1 where a pixel was observed, 0 in the margin around the image; where the noise n depends on the level of the
    image, mean(n²) / n² in place of 1.
λ : fidelity, the weight of the data.  The paper's μ is 1 here.

The data term ``λ/2 Σ M(Bu − f)²`` is that of F_λ,μ in paper 3, section 5, for the model ``f = k∗u + n`` (eq. 20), with
the mask M added.

Boundary
--------
Pixels near the border of f received light from outside the image.  The unknown u therefore has a margin of at least 4σ
on each side, in which M is 0.  The convolution is periodic on that padded domain; opposite sides meet within the
margin, where nothing was observed.

Solvers are written once for NumPy and torch, see :mod:`turbrestore.runtime.image_stacks`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..blur.psf import check_psf
from ..core.arrays import FloatArray
from ..core.errors import require
from ..core.noise import NoiseCurve
from ..runtime.fourier import fast_length, irfft2, rfft2
from ..runtime.image_stacks import Stack, load, namespace

# Smallest margin, beyond which lie 6·10⁻⁵ of a Gaussian along an axis, and least shorter side of an image, in widths of
# the blur; the second chosen: a wider blur leaves nothing to restore.
MARGIN_SIGMAS, _SIGMAS_A_SIDE = 4.0, 8
# Largest weight of a pixel, and the inverse of the least; chosen.
_MOST_WEIGHT = 4.0
# Transforms of smaller images are faster on one thread than on several.
PARALLEL_PIXELS = 1 << 20


@dataclass(frozen=True, eq=False)
class Problem:
    """Data term ``λ/2 Σ M(Bu − f)²`` on the padded domain."""

    observed: Stack  # (P, Q): f, extended by reflection into the margin
    seen: Stack  # (P, Q): M
    otf: Stack  # (P, Q // 2 + 1): H
    fidelity: float  # λ
    threads: int = 1  # of transforms on the CPU
    # What follows from these.
    shape: tuple[int, int] = field(init=False)  # P and Q
    power: Stack = field(init=False)  # |H|², the transfer function of BᵀB
    mean: float = field(init=False)  # of the observed pixels

    def __post_init__(self) -> None:
        mean = total(self.seen * self.observed) / total(self.seen)
        object.__setattr__(self, "shape", (self.observed.shape[0], self.observed.shape[1]))
        object.__setattr__(self, "power", abs(self.otf) ** 2)
        object.__setattr__(self, "mean", mean)

    def forward(self, image: Stack) -> Stack:
        """Half-spectrum of an image."""
        if not isinstance(image, np.ndarray):
            return namespace(image).fft.rfft2(image)
        return rfft2(image, self._workers)

    def back(self, spectrum: Stack) -> Stack:
        """Image of a half-spectrum."""
        if not isinstance(spectrum, np.ndarray):
            return namespace(spectrum).fft.irfft2(spectrum, s=self.shape)
        return irfft2(spectrum, self.shape, self._workers)

    @property
    def _workers(self) -> int:
        return self.threads if self.shape[0] * self.shape[1] >= PARALLEL_PIXELS else 1

    def blur(self, spectrum: Stack) -> Stack:
        """Image Bu from the transform of u."""
        return self.back(self.otf * spectrum)

    def misfit(self, u: Stack) -> float:
        """``λ/2 Σ M(Bu − f)²``."""
        residual = self.blur(self.forward(u)) - self.observed
        return self.fidelity / 2 * total(self.seen * residual**2)


@dataclass(frozen=True)
class Margin:
    """Margin of pixels around an image, in which nothing was observed."""

    size: tuple[int, int]  # H and W of the image
    widths: tuple[tuple[int, int], tuple[int, int]]  # pixels before and after the image along each axis

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns with the margin."""
        (top, bottom), (left, right) = self.widths
        return self.size[0] + top + bottom, self.size[1] + left + right

    def inside(self, rim: int = 0) -> tuple[slice, slice]:
        """Part of the padded domain that the image covers, without its outermost ``rim`` pixels."""
        (top, _), (left, _) = self.widths
        return slice(top + rim, top + self.size[0] - rim), slice(left + rim, left + self.size[1] - rim)

    def mask(self, rim: int = 0) -> FloatArray:
        """1 in :meth:`inside`, 0 elsewhere; with ``rim`` 0 it is M."""
        mask = np.zeros(self.shape, np.float32)
        mask[self.inside(rim)] = 1
        return mask

    def weights(self, plane: FloatArray, photons: NoiseCurve | None) -> FloatArray:
        """M of an image whose noise, relative to its mean, is known at every level."""
        mask = self.mask()
        if photons is not None:
            variance = photons.variance(cv2.GaussianBlur(plane, (0, 0), 1.0))
            mask[self.inside()] = 1 / np.clip(variance, 1 / _MOST_WEIGHT, _MOST_WEIGHT)
        return mask

    def pad(self, image: FloatArray) -> FloatArray:
        """Extend an image into the margin by reflection."""
        return np.pad(image, self.widths, mode="symmetric")


def margin_around(size: tuple[int, int], least: int | None) -> Margin:
    """Margin of at least ``least`` pixels on each side, enlarged to a size with a fast Fourier transform."""
    if least is None:
        return Margin(size, ((0, 0), (0, 0)))
    extra = [fast_length(length + 2 * least) - length for length in size]
    top, left = (total // 2 for total in extra)
    return Margin(size, ((top, extra[0] - top), (left, extra[1] - left)))


def total(values: Stack) -> float:
    """Sum all values in double precision."""
    return float(values.sum(dtype=namespace(values).float64))


def problem_of(
    plane: FloatArray, margin: Margin, photons: NoiseCurve | None, otf: Stack, fidelity: float, threads: int
) -> Problem:
    """Problem of a plane (H, W); ``photons`` is its noise at every level, relative to the mean."""
    observed, seen = (load(image, otf.device) for image in (margin.pad(plane), margin.weights(plane, photons)))
    return Problem(observed, seen, otf, fidelity, threads)


def largest_width(shape: tuple[int, ...]) -> float:
    """Return the largest width of a blur that commands remove from an image (H, W[, 3]), pixels."""
    return min(shape[:2]) / _SIGMAS_A_SIDE


def read_blur(sigma_or_psf: float | ArrayLike) -> tuple[NDArray[np.float64] | None, float, int]:
    """Read a blur that is given either by its width or by its PSF (h, w)."""
    if np.ndim(sigma_or_psf) == 0:
        sigma: Any = sigma_or_psf
        require(
            np.asarray(sigma).dtype.kind in "fiu" and np.isfinite(sigma) and sigma >= 0,
            f"sigma_or_psf: expected a finite number of 0 or more pixels, found {sigma!r}",
        )
        return None, float(sigma), int(np.ceil(MARGIN_SIGMAS * sigma))
    psf = check_psf(sigma_or_psf)
    y, x = (np.arange(size) - size // 2 for size in psf.shape)
    squares = psf.sum(axis=1) @ y**2 + psf.sum(axis=0) @ x**2
    return psf, float(np.sqrt(squares / 2)), max(psf.shape) // 2
