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

    Parameters
    ----------
    image : array_like, shape (H, W) or (H, W, 3)
        Intensities; colour is reduced to luminance.
    window : float
        Standard deviation of the window, pixels.
    floor : float
        Deviation that is added in quadrature, so that flat regions stay flat.

    Returns
    -------
    ndarray, float32, shape (H, W)
        Dimensionless.

    Examples
    --------
    >>> import numpy as np
    >>> normalise_contrast(np.full((4, 4), 0.3, np.float32), window=2.0).max().item()
    0.0
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

    Parameters
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
    window, floor : float
        As for :func:`normalise_contrast`; with a window of 0 the luminance is kept as it is.
    smoothing : float
        Standard deviation of a Gaussian that the image is smoothed by first, pixels.

    Returns
    -------
    ndarray, uint8, shape (H, W)

    Examples
    --------
    >>> grey_levels(np.full((2, 2), 0.3, np.float32), window=2.0, floor=0.01)[0]
    array([128, 128], dtype=uint8)
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
