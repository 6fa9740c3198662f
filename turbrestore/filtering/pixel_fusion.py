"""Taking registered frames into an image, pixel by pixel: the image's half of the alternating filter.

Symbols
-------
ρ̂, Σ : image and its variance per pixel; S drift of the image, Z noise of a registered frame (paper 3, eqs. 13a, 15)
L : gain of the image (eq. 16)

:func:`turbrestore.filtering.kalman.predict_pixels` and :func:`turbrestore.filtering.kalman.update_pixels` are the same
with all checks, and for frames with missing pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..core.errors import DataError
from ..runtime.jit import compiled
from .kalman import PixelGaussian, predict_pixels, update_pixels

_UNUSABLE = "noise_variance: expected values above 0 and finite frames, found others; give the noise a floor"


class PixelFusion:
    """An image that frames are taken into one after the other.

    Parameters
    ----------
    prior : PixelGaussian
        ρ̂ and Σ before the first, float32; left as they are.
    drift : float
        S, squared intensity.

    Examples
    --------
    >>> fusion = PixelFusion(PixelGaussian(np.zeros((1, 2), np.float32), np.ones((1, 2))), drift=0.0)
    >>> fusion.take_in(np.ones((1, 2), np.float32), np.full((1, 2), 3, np.float32))
    (0.25, 0.3333333432674408)
    >>> fusion.image.mean, fusion.image.variance
    (array([[0.25, 0.25]], dtype=float32), array([[0.75, 0.75]], dtype=float32))
    """

    def __init__(self, prior: PixelGaussian, drift: float) -> None:
        self.image, self._drift = prior, drift
        self._loops = compiled(take_in_pixels) if prior.mean.dtype == np.float32 else None
        if self._loops is not None:
            self.image = PixelGaussian(prior.mean.copy(), prior.variance.copy())

    def take_in(self, frame: FloatArray, noise: float | FloatArray) -> tuple[float, float]:
        """Take in a registered frame (eqs. 14a, 14c, 15 and 16).

        Parameters
        ----------
        frame : ndarray, float32, shape (H, W) or (H, W, 3)
        noise : float or ndarray, float32, shape (H, W)
            Z, squared intensity.

        Returns
        -------
        gain : float
            L, mean over the pixels.
        information : float
            Mean of 1 / Z over the pixels.

        Raises
        ------
        DataError
            Shapes do not agree, Z is not positive, or the frame or Z is not finite.
        """
        if frame.shape != self.image.mean.shape:
            raise DataError(f"frame: expected shape {self.image.mean.shape}, found {frame.shape}")
        if self._loops is None:
            if not np.isfinite(float(np.sum(frame, dtype=np.float64)) + np.sum(noise, dtype=np.float64)):
                raise DataError(_UNUSABLE)
            prior = predict_pixels(self.image, self._drift) if self._drift else self.image
            self.image, gain = update_pixels(prior, frame, noise)
            return float(gain.mean()), float(np.mean(1 / np.asarray(noise)))
        mean, variance, sums = self.image.mean, self.image.variance, np.zeros(3)
        z = np.broadcast_to(np.float32(noise), variance.shape).reshape(-1)
        pixels, drift = (variance.size, mean.size // variance.size), np.float32(self._drift)
        self._loops(mean.reshape(pixels), variance.reshape(-1), frame.reshape(pixels), z, drift, sums)
        gain_sum, information, done = sums.tolist()
        if done != variance.size:
            raise DataError(_UNUSABLE)
        return gain_sum / variance.size, information / variance.size


def take_in_pixels(
    mean: FloatArray, variance: FloatArray, frame: FloatArray, noise: FloatArray, drift: np.float32, sums: NDArray
) -> None:
    """Predict and update each pixel, in place; to be compiled.

    Parameters
    ----------
    mean, frame : ndarray, float32, shape (P, C)
        ρ̂, and what is taken in.
    variance, noise : ndarray, float32, shape (P,)
        Σ and Z.
    drift : float32
        S.
    sums : ndarray, float64, shape (3,)
        Gain, 1 / Z, and pixels with a finite frame and a positive Z are added.

    Examples
    --------
    >>> mean, variance, sums = np.zeros((1, 1), np.float32), np.ones(1, np.float32), np.zeros(3)
    >>> take_in_pixels(mean, variance, mean + 1, np.float32([2]), np.float32(1), sums)
    >>> mean, variance, sums
    (array([[0.5]], dtype=float32), array([1.], dtype=float32), array([0.5, 0.5, 1. ]))
    """
    one = np.float32(1)
    gains, information, done = 0.0, 0.0, 0
    for pixel in range(variance.size):
        prior, z = variance[pixel] + drift, noise[pixel]
        gain = prior / (prior + z)
        # L Z equals (1 − L) Σ of eq. 16 without the cancellation when Z is small.
        variance[pixel] = gain * z
        gains += gain
        information += one / z
        # Neither infinite nor NaN.
        usable = z - z == 0 and z > 0
        for channel in range(mean.shape[1]):
            difference = frame[pixel, channel] - mean[pixel, channel]
            mean[pixel, channel] += gain * difference
            usable = usable and difference - difference == 0
        done += usable
    sums[0] += gains
    sums[1] += information
    sums[2] += done
