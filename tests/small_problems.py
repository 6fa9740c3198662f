"""Problems of deconvolution that are small enough for dense algebra."""

import numpy as np
from scipy import fft

from turbrestore.blur.psf import blur_otf
from turbrestore.deconvolution.problem import Problem


def small_problem(seed: int, fidelity: float, shape: tuple[int, int] = (8, 8), margin: int = 2) -> Problem:
    rng = np.random.default_rng(seed)
    seen = np.zeros(shape, np.float32)
    seen[margin : shape[0] - margin, margin : shape[1] - margin] = 1
    return Problem(rng.random(shape).astype(np.float32), seen, blur_otf(shape, 0.7), fidelity)


def dense(operator, shape: tuple[int, int]) -> np.ndarray:
    unit = np.eye(shape[0] * shape[1], dtype=np.float32).reshape(-1, *shape)
    return np.stack([operator(u).ravel() for u in unit], axis=1).astype(np.float64)


def dense_blur(problem: Problem) -> np.ndarray:
    return dense(lambda u: problem.blur(fft.rfft2(u)), problem.shape)


def gaussian_psf(sigma):
    """Gaussian point spread function at pixel centres, out to 4σ."""
    radius = int(np.ceil(4 * sigma))
    profile = np.exp(-(np.arange(-radius, radius + 1) ** 2) / (2 * sigma**2))
    return np.outer(profile, profile) / profile.sum() ** 2
