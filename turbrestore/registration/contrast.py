"""The image that flow methods see: local contrast normalised, in 8 bits."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray, check_image, luminance

# Grey levels for each local standard deviation: ±4 deviations fit into 8 bits.
_LEVELS_PER_DEVIATION = 32.0


def normalise_contrast(image: ArrayLike, window: float, floor: float = 0.01) -> FloatArray:
    """Normalise to zero mean and unit deviation in a Gaussian window.

    ``image`` (H, W) or (H, W, 3); returns (H, W).
    """
    grey = luminance(check_image(image))
    # Centred first, because E[x²] − E[x]² loses all digits of a faint texture on a bright ground.
    centred = grey - cv2.GaussianBlur(grey, (0, 0), window)
    deviation = cv2.GaussianBlur(centred * centred, (0, 0), window)
    deviation += np.float32(floor) ** 2
    centred /= np.sqrt(deviation, out=deviation)
    return centred


def grey_levels(image: FloatArray, window: float, floor: float, smoothing: float = 0.0) -> NDArray[np.uint8]:
    """Contrast-normalised image in 8 bits, with 32 levels for each local standard deviation.

    ``image`` (H, W) or (H, W, 3); returns (H, W).
    """
    if smoothing > 0:
        image = cv2.GaussianBlur(luminance(image), (0, 0), smoothing)
    if window > 0:
        levels = normalise_contrast(image, window, floor)
        levels *= _LEVELS_PER_DEVIATION
        levels += 128.0
    else:
        levels = luminance(image) * 255.0
    return np.clip(np.rint(levels, out=levels), 0, 255, out=levels).astype(np.uint8)
