"""A blurred photograph, which deconvolution is tested on."""

import cv2
import numpy as np
from skimage import data


def camera(size: int, sigma: float, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Photograph, and a crop of it after blur and noise of a larger scene."""
    scene = data.camera()[40 : 40 + size + 48, 100 : 100 + size + 48].astype(np.float32) / 255
    blurred = cv2.GaussianBlur(scene, (0, 0), sigma)
    blurred += np.random.default_rng(seed).normal(0, noise, scene.shape).astype(np.float32)
    inside = slice(24, 24 + size)
    return scene[inside, inside], blurred[inside, inside]


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((image - truth) ** 2)))
