"""Marginal likelihood of an image as a function of the width of its blur.

The gradients of a sharp scene are sparse: a few are large, most are almost zero.  An image that is explained by a blur
that is too narrow or too wide needs a scene with less sparse gradients, so the likelihood of the image, with the scene
integrated out, is largest at the true width.  Maximising over the scene and the blur together would not work: it
prefers no blur at all.

Symbols
-------
y : gradients of the image, one plane along x and one along y, tapered to zero at the border; m values in total
x : gradients of the scene, ``y = k ∗ x + noise``
γ_i : prior variance of x_i, ``x_i ~ N(0, γ_i)``
k : point spread function of :func:`turbrestore.blur.psf.blur_otf`; σ its width, ‖k‖² its energy
n : standard deviation of the noise of the image
λ : variance of the noise of y, 2 n²
C_i : posterior variance of x_i

The cost is the variational upper bound of the negative logarithm of the marginal likelihood (Wipf and Zhang,
"Revisiting Bayesian blind deconvolution", JMLR 2014):

    L(σ) = (1/m) min over x and γ of  ‖y − k ∗ x‖² / λ + Σ_i [ x_i² / γ_i + log(λ + γ_i ‖k‖²) ]

It is minimised by alternating

    x   = argmin ‖y − k ∗ x‖² / λ + Σ_i x_i² / γ_i      (conjugate gradients)
    C_i = 1 / (‖k‖² / λ + 1 / γ_i)
    γ_i = x_i² + C_i
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ..core.arrays import FloatArray
from ..runtime.jit import jit
from .psf import Float64Array, half_frequency

# Widths whose cost is computed, pixels, chosen; the first is the width of a sharp image.
WIDTHS = np.array([0.35, 0.45, 0.55, 0.65, 0.8, 0.95, 1.1, 1.3, 1.55, 1.85, 2.2, 2.6])
# Pixels over which gradients are tapered to zero at each border, chosen.
_TAPER = 8
# Smallest variance that γ starts from: below the square of one level of 16 bits.
_LEAST_VARIANCE = 1e-10
# Updates of γ, and conjugate gradient steps in each.  The steps stop early when the squared residual is below this
# share of the squared right-hand side: for narrow blurs x hardly changes in the last updates.  All chosen.
_UPDATES, _STEPS, _TOLERANCE = 8, 8, 1e-8


@dataclass(frozen=True, eq=False)
class ImageGradients:
    """Gradients of an image, y.

    Both planes go through one complex transform, because a symmetric kernel does not mix real and imaginary parts.
    """

    planes: FloatArray  # (h, w, 2): differences along x and along y, intensity per pixel
    spectrum: FloatArray  # (h, w, 2): Fourier transform of ``planes`` read as complex numbers
    frequency: FloatArray  # (h, w): spatial frequency of each entry of ``spectrum``, cycles per pixel


def image_gradients(image: FloatArray) -> ImageGradients:
    """Compute the tapered gradients of an image (h + 1, w + 1) and their spectrum."""
    dx, dy = image[:-1, 1:] - image[:-1, :-1], image[1:, :-1] - image[:-1, :-1]
    rows, columns = (_taper(size) for size in dx.shape)
    planes = np.stack([dx, dy], axis=-1) * np.outer(rows, columns)[..., None]
    frequency = np.hypot(np.fft.fftfreq(len(rows))[:, None], np.fft.fftfreq(len(columns)))
    return ImageGradients(planes, cv2.dft(planes), frequency.astype(np.float32))


def width_costs(gradients: ImageGradients, exponent: float | Sequence[float], noise: float, rises: int) -> Float64Array:
    """Compute L (k,) for increasing widths until it has risen several times in a row; L has a single minimum."""
    costs: list[float] = []
    scene = gradients.planes
    prior = np.full_like(scene, max(float(np.square(scene).mean()), _LEAST_VARIANCE))
    for width, shape in zip(WIDTHS, np.broadcast_to(exponent, WIDTHS.shape), strict=True):
        # The solution for one width is a good start for the next.
        scene, prior, cost = fit_scene(gradients, scene, prior, (float(width), float(shape)), noise)
        costs.append(cost)
        if len(costs) > rises and (np.diff(costs[-rises - 1 :]) > 0).all():
            break
    return np.array(costs)


def likeliest_width(costs: Float64Array) -> float:
    """Return the width of the smallest L (k,), by a parabola in log σ through the three smallest neighbours."""
    index = int(np.argmin(costs))
    if not 0 < index < len(costs) - 1:
        return float(WIDTHS[index])
    x = np.log(WIDTHS[index - 1 : index + 2] / WIDTHS[index])
    curvature, slope, _ = np.polyfit(x, costs[index - 1 : index + 2], 2)
    return float(WIDTHS[index] * np.exp(-slope / (2 * curvature)))


def fit_scene(
    gradients: ImageGradients, scene: FloatArray, prior: FloatArray, blur: tuple[float, float], noise: float
) -> tuple[FloatArray, FloatArray, float]:
    """Minimise the bound over x and γ, both (h, w, 2), for one blur, from a given start."""
    width, exponent = blur
    otf = np.exp(-np.log(2) * (gradients.frequency / half_frequency(width)) ** exponent).astype(np.float32)
    # ‖k‖² by Parseval.  OpenCV's inverse transform does not divide by the size, so the kernel does.
    energy, variance = np.float32(np.square(otf).mean()), np.float32(2 * noise**2)
    kernel = np.repeat((otf / np.float32(otf.size))[..., None], 2, axis=2)
    power = kernel * (otf[..., None] / variance)
    right = cv2.dft(kernel * gradients.spectrum, flags=cv2.DFT_INVERSE) / variance
    scene = scene.copy()
    # Kᵀ(y − Kx) / λ does not depend on γ, so it is carried from one update to the next.
    data_residual = right - cv2.dft(power * cv2.dft(scene), flags=cv2.DFT_INVERSE)
    for _ in range(_UPDATES):
        precision = np.reciprocal(prior)
        posterior = np.reciprocal(energy / variance + precision)
        target = _TOLERANCE * float(np.vdot(right, posterior * right))
        _solve(power, precision, posterior, scene, data_residual, target)
        prior = scene**2 + posterior
    blurred = cv2.dft(kernel * cv2.dft(scene), flags=cv2.DFT_INVERSE)
    misfit = np.square(gradients.planes - blurred).sum(dtype=np.float64) / variance
    total = float(misfit + np.sum(scene**2 / prior + np.log(variance + prior * energy), dtype=np.float64))
    return scene, prior, total / scene.size


def _solve(
    power: FloatArray,
    precision: FloatArray,
    preconditioner: FloatArray,
    x: FloatArray,
    data_residual: FloatArray,
    target: float,
) -> None:
    """Solve ``(KᵀK / λ + 1 / γ) x = Kᵀy / λ`` by preconditioned conjugate gradients.

    ``power`` is |K|² / λ in Fourier space, divided by the size.  x and ``data_residual``, ``Kᵀ(y − Kx) / λ``, are
    updated in place.
    """
    spectrum, residual = np.empty_like(x), data_residual
    residual -= precision * x
    direction = preconditioner * residual
    decrease = np.array([np.vdot(residual, direction)], np.float32)
    fixed, moving = (precision.ravel(), preconditioner.ravel()), (direction.ravel(), x.ravel(), residual.ravel())
    for _ in range(_STEPS):
        if decrease[0] <= target:
            break
        cv2.dft(direction, dst=spectrum)
        np.multiply(spectrum, power, out=spectrum)
        descend(cv2.dft(spectrum, flags=cv2.DFT_INVERSE).ravel(), *fixed, *moving, decrease)
    residual += precision * x


@jit
def descend(
    image: FloatArray,
    precision: FloatArray,
    preconditioner: FloatArray,
    direction: FloatArray,
    x: FloatArray,
    residual: FloatArray,
    decrease: FloatArray,
) -> None:
    """Take one preconditioned conjugate gradient step; the caller has already applied ``KᵀK / λ``.

    ``image`` (m,); ``precision, preconditioner`` (m,); ``direction, x, residual`` (m,); ``decrease`` (1,).
    """
    curvature, remaining = np.float32(0), np.float32(0)
    for pixel in range(x.size):
        image[pixel] += precision[pixel] * direction[pixel]
        curvature += direction[pixel] * image[pixel]
    length = decrease[0] / curvature
    for pixel in range(x.size):
        x[pixel] += direction[pixel] * length
        new_residual = residual[pixel] - image[pixel] * length
        residual[pixel] = new_residual
        remaining += preconditioner[pixel] * new_residual * new_residual
    ratio = remaining / decrease[0]
    decrease[0] = remaining
    for pixel in range(x.size):
        direction[pixel] = direction[pixel] * ratio + preconditioner[pixel] * residual[pixel]


def _taper(size: int) -> FloatArray:
    """Weights of 1 that fall to 0 at both ends, because the blurred scene continues beyond the image."""
    steps = np.arange(1, size + 1, dtype=np.float32)
    return np.minimum(np.minimum(steps, steps[::-1]) / (_TAPER + 1), 1)
