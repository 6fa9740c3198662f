"""Estimates of the image, ρ̂ and Σ, and of the state of its flow, ξ̂ and P (paper 3, section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..core.errors import DataError
from ..dynamics.flow_model import Float64Array, FlowDynamics
from ..runtime.image_stacks import Stack


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Mean and covariance of a state."""

    mean: Float64Array  # (..., n): ξ̂
    # (..., n, n): P, symmetric positive semi-definite. Its leading axes may be fewer than those of the mean: one
    # covariance then holds for all of them.
    cov: Float64Array

    def __post_init__(self) -> None:
        mean, cov = np.asarray(self.mean, np.float64), np.asarray(self.cov, np.float64)
        if mean.ndim < 1:
            raise DataError("mean: expected shape (..., n), found a single number")
        if not np.isfinite(mean).all():
            raise DataError("mean: expected finite values, found NaN or infinite ones; the filter may be unstable")
        check_covariance(cov, mean.shape[-1], "cov")
        check_batches(mean.shape[:-1], cov=cov.shape[:-2])
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "cov", cov)


@dataclass(frozen=True, eq=False)
class PixelGaussian:
    """Mean and variance of every pixel."""

    mean: NDArray[np.floating]  # (H, W) or (H, W, 3): ρ̂, intensities
    variance: NDArray[np.floating]  # (H, W): Σ, squared intensities, not negative

    def __post_init__(self) -> None:
        mean = np.asarray(self.mean)
        mean = mean if mean.dtype in (np.float32, np.float64) else mean.astype(np.float64)
        variance = np.asarray(self.variance, mean.dtype)
        pixels = variance.shape
        if mean.shape not in (pixels, (*pixels, 3)):
            raise DataError(f"mean: expected the shape of variance {pixels} or {(*pixels, 3)}, found {mean.shape}")
        if not np.isfinite(np.sum(mean, dtype=np.float64)):
            raise DataError("mean: expected finite values, found NaN or infinite ones")
        if not np.isfinite(np.sum(variance, dtype=np.float64)) or (variance < 0).any():
            raise DataError("variance: expected finite values of at least 0, found others")
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "variance", variance)


class PixelStacks(NamedTuple):
    """PixelGaussian as the device holds it, unchecked."""

    mean: Stack  # (C, H, W): ρ̂
    variance: Stack  # (H, W): Σ


def first_estimates(image: FloatArray, variance: float, dynamics: FlowDynamics) -> tuple[PixelGaussian, Gaussian]:
    """Estimates before the first frame: an image (H, W[, 3]) of one variance, and the state 0, with its covariance."""
    pixels, covariance = np.full(image.shape[:2], variance, np.float32), dynamics.state_covariance
    return PixelGaussian(image, pixels), Gaussian(np.zeros(len(covariance)), covariance)


def check_matrix(matrix: NDArray[np.floating], rows: int, columns: int, name: str) -> None:
    """Raise DataError unless the last two axes have these lengths."""
    if matrix.ndim < 2 or matrix.shape[-2:] != (rows, columns):
        raise DataError(f"{name}: expected shape (..., {rows}, {columns}), found {matrix.shape}")


def check_covariance(cov: Float64Array, n: int, name: str) -> None:
    """Raise DataError unless matrices (..., n, n) are symmetric and positive semi-definite."""
    check_matrix(cov, n, n, name)
    if not np.isfinite(cov).all():
        raise DataError(f"{name}: expected finite values, found NaN or infinite ones; the filter may be unstable")
    diagonal = np.abs(np.diagonal(cov, axis1=-2, axis2=-1))
    scale = diagonal.max(-1, initial=0.0)[..., None]
    if (np.abs(cov - cov.mT) > 1e-8 * scale[..., None]).any():
        raise DataError(f"{name}: expected a symmetric matrix, found one that is not")
    # Rounding may leave the eigenvalue of a known direction slightly negative; only more than that is an error.
    slack = 1e-10 * diagonal + 1e-14 * scale + 1e-300
    cholesky(cov + slack[..., None] * np.eye(n), name, "positive semi-definite")


def check_batches(state: tuple[int, ...], **batches: tuple[int, ...]) -> None:
    """Raise DataError where leading axes do not broadcast with those of the mean of a state."""
    for name, batch in batches.items():
        try:
            np.broadcast_shapes(state, batch)
        except ValueError:
            raise DataError(
                f"{name}: expected leading axes that fit those of the mean {state}, found {batch}"
            ) from None


def cholesky(matrix: Float64Array, name: str, kind: str) -> Float64Array:
    """Lower Cholesky factor; a DataError says that the matrix is not of the kind that is expected."""
    try:
        return np.asarray(np.linalg.cholesky(matrix), np.float64)
    except np.linalg.LinAlgError:
        raise DataError(f"{name}: expected a {kind} matrix, found one that is not; check the covariances") from None
