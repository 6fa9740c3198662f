"""What synthetic sequences have in common: scenes that show motion, frames with their true flow, and the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_image, from_unit
from ..core.errors import DataError, require, require_between

# Below this no stage can tell motion.
SMALLEST_SCENE = 16
_LEAST_CONTRAST = 1e-3


@dataclass(frozen=True, eq=False)
class SyntheticFrame:
    """One frame and the motion it was made with.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        Intensities at the bit depth of the camera.
    flow : ndarray, float32, shape (H, W, 2)
        Mean displacement from the truth to this frame over the exposure, pixels: before blur
        ``truth(x) = frame(x + flow(x))``.
    """

    image: FloatArray
    flow: FloatArray


@dataclass(frozen=True)
class CameraParams:
    """When the camera looks, and what it adds.

    Parameters
    ----------
    frame_rate : float
        Frames per second.
    exposure : float
        Time over which a frame gathers light, s, from the start of the frame on; 0 is an instant.
    sub_frames : int
        Instants that an exposure is summed from.
    photons : float
        Photons per pixel at white, which give shot noise; inf for none.
    read_noise : float
        Standard deviation of the noise of reading, intensity.
    bit_depth : int
        1 to 16.
    """

    frame_rate: float = 30.0
    exposure: float = 0.0
    sub_frames: int = 4
    photons: float = 10_000.0
    read_noise: float = 0.005
    bit_depth: int = 8

    def __post_init__(self) -> None:
        require_between("frame_rate", self.frame_rate, 1e-3, 1e6, "Hz")
        require(
            0 <= self.exposure <= 1 / self.frame_rate,
            f"exposure: expected 0 to the frame time of {1 / self.frame_rate:.6g} s, found {self.exposure:g}",
        )
        require_between("sub_frames", self.sub_frames, 1, 1000)
        # Beyond 10¹² shot noise is less than a millionth; NumPy cannot draw it beyond 10¹⁸.
        if self.photons != np.inf:
            require_between("photons", self.photons, 1, 1e12, "per pixel at white, or inf")
        require_between("read_noise", self.read_noise, 0, 1)
        require_between("bit_depth", self.bit_depth, 1, 16)

    def sub_frame_shares(self) -> tuple[float, ...]:
        """Instants of an exposure as shares of the frame time, each in the middle of its part.

        Returns
        -------
        tuple of float
            A single 0 without an exposure.

        Examples
        --------
        >>> CameraParams(frame_rate=20.0, exposure=0.05, sub_frames=2).sub_frame_shares()
        (0.25, 0.75)
        """
        if self.exposure == 0:
            return (0.0,)
        share = self.exposure * self.frame_rate
        return tuple(share * (index + 0.5) / self.sub_frames for index in range(self.sub_frames))


def check_scene(scene: ArrayLike) -> FloatArray:
    """Return a scene that can show turbulence, as float32.

    Parameters
    ----------
    scene : array_like, shape (H, W) or (H, W, 3)
        Floating point intensities in [0, 1], or unsigned integers.

    Returns
    -------
    ndarray, float32

    Raises
    ------
    DataError
        Not an image, smaller than 16×16 pixels, values outside [0, 1], or all of one colour.

    Examples
    --------
    >>> import numpy as np
    >>> check_scene(np.full((32, 32), 0.5))
    Traceback (most recent call last):
    ...
    turbrestore.core.errors.DataError: scene: expected contrast, found one colour only; choose a picture with detail
    """
    image = check_image(scene, "scene")
    height, width = image.shape[:2]
    if min(height, width) < SMALLEST_SCENE:
        raise DataError(f"scene: expected at least {SMALLEST_SCENE}×{SMALLEST_SCENE} pixels, found {width}×{height}")
    lowest, highest = float(image.min()), float(image.max())
    if lowest < 0 or highest > 1:
        raise DataError(f"scene: expected values in 0 to 1, found {lowest:.6g} to {highest:.6g}; scale them")
    if np.ptp(image, axis=(0, 1)).max() < _LEAST_CONTRAST:
        raise DataError("scene: expected contrast, found one colour only; choose a picture with detail")
    return image


def record(image: FloatArray, camera: CameraParams, rng: np.random.Generator) -> FloatArray:
    """Give what the camera makes of an image: shot noise, read noise, quantisation.

    Parameters
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        Intensities; clipped to [0, 1].
    camera : CameraParams
    rng : numpy.random.Generator
        Source of the noise.

    Returns
    -------
    ndarray, float32, shape of ``image``
        On the 2^bit_depth levels of [0, 1].

    Examples
    --------
    >>> import numpy as np
    >>> record(np.full((1, 1), 0.4, np.float32), CameraParams(read_noise=0.0, bit_depth=1), np.random.default_rng(0))
    array([[0.]], dtype=float32)
    """
    exposed: FloatArray = np.clip(image, 0, 1)
    if np.isfinite(camera.photons):
        exposed = (rng.poisson(exposed * camera.photons) / camera.photons).astype(np.float32)
    if camera.read_noise > 0:
        exposed = exposed + np.float32(camera.read_noise) * rng.standard_normal(image.shape, dtype=np.float32)
    return np.divide(from_unit(exposed, camera.bit_depth), np.float32(2**camera.bit_depth - 1), dtype=np.float32)
