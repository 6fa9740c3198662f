"""The camera of synthetic sequences: exposures with their true flow, noise, and the scenes that it can record.

Symbols
-------
Y : image of an integrative sensor, ``Y = (1/T_e) ∫ ρ ∘ w_t⁻¹ dt`` over the exposure T_e (papers 1 and 2), here the mean
over sub-frames in the middle of equal parts of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import FloatArray, check_image, from_unit
from ..core.errors import DataError, require, require_between
from ..display.preview import summary
from ..registration.flow import MIN_SIDE
from ..registration.flow_algebra import invert_flow
from ..registration.warp import warp

# Smallest contrast of a scene: a quarter of a level of 8 bits, chosen.
_LEAST_CONTRAST = 1e-3


@dataclass(frozen=True, eq=False)
class SyntheticFrame:
    """One frame and its true motion.

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

    def __repr__(self) -> str:
        size = np.sqrt(2 * np.mean(np.square(self.flow), dtype=np.float64))
        return summary("SyntheticFrame", [("motion", f"{size:.2f} pixels")], self.image.shape)


@dataclass(frozen=True)
class CameraParams:
    """Timing and noise of the camera.

    Parameters
    ----------
    frame_rate : float
        Frames per second.
    exposure : float
        Exposure time from the start of the frame on, s; 0 is an instant.
    sub_frames : int
        Number of instants over which an exposure is averaged.
    photons : float
        Photons per pixel at white, which determine the shot noise; inf for none.
    read_noise : float
        Standard deviation of the read noise, intensity.
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
        # Above 10¹² photons shot noise is less than a millionth; NumPy cannot draw it above 10¹⁸.
        if self.photons != np.inf:
            require_between("photons", self.photons, 1, 1e12, "per pixel at white, or inf")
        require_between("read_noise", self.read_noise, 0, 1)
        require_between("bit_depth", self.bit_depth, 1, 16)

    def sub_frame_shares(self) -> tuple[float, ...]:
        """Instants of an exposure as shares of the frame time, in the middle of equal parts.

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
    """Check that a scene can show turbulence, and return it as float32.

    ``scene`` (H, W) or (H, W, 3).
    """
    image = check_image(scene, "scene")
    height, width = image.shape[:2]
    if min(height, width) < MIN_SIDE:
        raise DataError(f"scene: expected at least {MIN_SIDE}×{MIN_SIDE} pixels, found {width}×{height}")
    lowest, highest = float(image.min()), float(image.max())
    if lowest < 0 or highest > 1:
        raise DataError(f"scene: expected values in 0 to 1, found {lowest:.6g} to {highest:.6g}; scale them")
    if np.ptp(image, axis=(0, 1)).max() < _LEAST_CONTRAST:
        raise DataError("scene: expected contrast, found one colour only; choose a picture with detail")
    return image


def record(image: FloatArray, camera: CameraParams, rng: np.random.Generator) -> FloatArray:
    """Add shot noise and read noise to an image, and quantise it.

    ``image`` (H, W) or (H, W, 3).
    """
    exposed: FloatArray = np.clip(image, 0, 1)
    if np.isfinite(camera.photons):
        exposed = (rng.poisson(exposed * camera.photons) / camera.photons).astype(np.float32)
    if camera.read_noise > 0:
        exposed = exposed + np.float32(camera.read_noise) * rng.standard_normal(image.shape, dtype=np.float32)
    return np.divide(from_unit(exposed, camera.bit_depth), np.float32(2**camera.bit_depth - 1), dtype=np.float32)


def exposed_frame(
    scene: ArrayLike, sub_flows: Iterable[FloatArray], blur: Callable[[FloatArray, int], FloatArray] | None = None
) -> tuple[FloatArray, FloatArray]:
    """Average a scene displaced by the flow of each sub-frame.

    Parameters
    ----------
    scene : array_like, shape (H, W) or (H, W, 3)
        ρ.
    sub_flows : iterable of ndarray, float32, shape (H, W, 2)
        From the scene to each sub-frame, pixels; at least one.
    blur : callable, optional
        ``blur(image, index)`` is applied to each displaced sub-frame; it may crop.

    Returns
    -------
    image : ndarray, float32
        Y, before noise.
    flow : ndarray, float32, shape (H, W, 2)
        Mean of the flows, pixels.

    Raises
    ------
    DataError
        No flow, or shapes do not agree.

    Examples
    --------
    >>> import numpy as np
    >>> dot = np.zeros((16, 16), np.float32); dot[8, 8] = 1
    >>> flows = np.zeros((2, 16, 16, 2), np.float32); flows[1, ..., 0] = 2
    >>> image, flow = exposed_frame(dot, flows)
    >>> image[8, 8:11:2].round(3), flow[8, 8]
    (array([0.5, 0.5], dtype=float32), array([1., 0.], dtype=float32))
    """
    truth = check_image(scene, "scene")
    total, displacement, count = None, None, 0
    for index, flow in enumerate(sub_flows):
        seen = warp(truth, invert_flow(flow))
        seen = seen if blur is None else blur(seen, index)
        total = seen if total is None else total + seen
        displacement = flow if displacement is None else displacement + flow
        count += 1
    if total is None or displacement is None:
        raise DataError("sub_flows: expected at least one flow, found none")
    return total / np.float32(count), displacement / np.float32(count)


def flows_between(flows: Iterable[FloatArray], shares: Sequence[float]) -> Iterator[list[FloatArray]]:
    """Interpolate the flows of the sub-frames of each frame linearly in time, between its flow and the next one.

    ``flows`` (H, W, 2) each; yields (H, W, 2) each.
    """
    previous: FloatArray | None = None
    for flow in flows:
        if previous is not None:
            yield [previous + np.float32(share) * (flow - previous) for share in shares]
        previous = flow
