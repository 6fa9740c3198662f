"""Fusion of frames into the image of the alternating filter, in torch.

Symbols as in :mod:`turbrestore.filtering.alternating` and :mod:`turbrestore.filtering.frame_noise`, which do the same
on the processor: the
frame is warped by the estimated flow, its noise Z follows from how sharp it is, how it deviates and where it is lost,
and every pixel takes it in by ``L = Σ / (Σ + Z)``.  Image and variance stay on the device from frame to frame; a frame
and its flows go there, three numbers come back.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from ..core.arrays import FloatArray, luminance
from ..runtime.device import memory_of
from ..runtime.image_stacks import StackOps, torch_ops, warp_stack
from .frame_noise import (
    AROUND_FOLD,
    FOLD_FADE,
    LARGEST_EXPONENT,
    LARGEST_SCORE,
    LOG_DISTRUST,
    OUTLIER,
    OUTLIER_WINDOW,
    FrameNoise,
)
from .kalman import PixelGaussian

if TYPE_CHECKING:
    from torch import Tensor

# Sobel's derivative, divided by 8, is one along and the other across.
_DIFFERENCE, _BINOMIAL = np.array([-1, 0, 1], np.float32), np.array([0.125, 0.25, 0.125], np.float32)


class DevicePixels(NamedTuple):
    """ρ̂ and Σ on a device: shapes (C, H, W) and (H, W)."""

    mean: Tensor
    variance: Tensor


class FusedFrame(NamedTuple):
    """Mean gain, sharpness, and mean of 1 / Z of a frame that was taken in."""

    gain: float
    sharpness: float
    information: float


@dataclass(frozen=True, eq=False)
class DeviceFusion:
    """What stays the same from frame to frame, on a device.

    Attributes
    ----------
    maps : dict of str to tensor
        Maps of :class:`turbrestore.filtering.frame_noise.FrameNoise`.
    image_noise, window, template_energy : float
        As there.
    sharpness : float
        β.
    drift : float
        S, squared intensity.
    ops : StackOps
        Operations on the device.
    """

    maps: dict[str, Tensor]
    image_noise: float
    window: float
    template_energy: float
    sharpness: float
    drift: float
    ops: StackOps


def load_fusion(model: FrameNoise, sharpness: float, drift: float, device: str) -> DeviceFusion:
    """Bring to a device what stays the same.

    Parameters
    ----------
    model : FrameNoise
        Without a measure of blur, which is taken on the processor only.
    sharpness : float
        β.
    drift : float
        S, squared intensity.
    device : str
        Name that torch gives it.

    Returns
    -------
    DeviceFusion

    Raises
    ------
    ConfigurationError
        The memory of the device is not enough.
    """
    ops = torch_ops(device)
    along, across = model.template
    arrays = {
        "along": along,
        "across": across,
        "usual": model.usual,
        "score_scale": model.score_scale,
        "score_variance": model.score_variance,
        "motion_share": model.motion_share,
        "usual_frame": model.usual_frame,
        "deviation": model.deviation,
    }
    with memory_of(device, "take a smaller --roi"):
        maps = {name: ops.load(np.asarray(array, np.float32)) for name, array in arrays.items()}
    return DeviceFusion(maps, model.image_noise, model.window, model.template_energy, sharpness, drift, ops)


def load_pixels(pixels: PixelGaussian, fusion: DeviceFusion) -> DevicePixels:
    """Bring ρ̂ and Σ to the device.

    Parameters
    ----------
    pixels : PixelGaussian
    fusion : DeviceFusion

    Returns
    -------
    DevicePixels
    """
    load = fusion.ops.load
    return DevicePixels(
        load(_planes(np.asarray(pixels.mean, np.float32))), load(np.asarray(pixels.variance, np.float32))
    )


def store_pixels(pixels: DevicePixels, fusion: DeviceFusion) -> PixelGaussian:
    """Bring ρ̂ and Σ back.

    Parameters
    ----------
    pixels : DevicePixels
    fusion : DeviceFusion

    Returns
    -------
    PixelGaussian
        float32.
    """
    mean = fusion.ops.store(pixels.mean)
    image = mean[0] if len(mean) == 1 else np.ascontiguousarray(np.moveaxis(mean, 0, -1))
    return PixelGaussian(image, fusion.ops.store(pixels.variance))


def fuse_frame(
    pixels: DevicePixels, frame: FloatArray, modelled: FloatArray, measured: FloatArray, fusion: DeviceFusion
) -> tuple[DevicePixels, FusedFrame]:
    """Register a frame and take it in (paper 3, eqs. 15 and 16).

    Parameters
    ----------
    pixels : DevicePixels
        ρ̂ and Σ after the frame before.
    frame : ndarray, float32, shape (H, W) or (H, W, 3)
    modelled, measured : ndarray, float32, shape (H, W, 2)
        C ξ̂ and W^meas, pixels.
    fusion : DeviceFusion

    Returns
    -------
    pixels : DevicePixels
    record : FusedFrame

    Raises
    ------
    ConfigurationError
        The memory of the device is not enough.
    """
    with memory_of(str(pixels.variance.device), "take a smaller --roi"):
        return _fuse(pixels, frame, modelled, measured, fusion)


def _fuse(
    pixels: DevicePixels, frame: FloatArray, modelled: FloatArray, measured: FloatArray, fusion: DeviceFusion
) -> tuple[DevicePixels, FusedFrame]:
    ops, maps = fusion.ops, fusion.maps
    flow = ops.load(modelled)
    flow = flow + maps["motion_share"][..., None] * (ops.load(measured) - flow)
    registered = warp_stack(ops.load(_planes(frame)), flow, ops)
    grey = registered[0] if len(registered) == 1 else _luminance(registered)
    projected = _projection(grey, fusion)
    noise = _noise(grey, projected, flow, fusion)
    prior = pixels.variance + fusion.drift
    gain = prior / (prior + noise)
    after = DevicePixels(pixels.mean + gain * (registered - pixels.mean), gain * noise)
    # One transfer for all three.
    found = ops.store(ops.arrays.stack([gain.mean(), projected.sum(), (1 / noise).mean()])).tolist()
    return after, FusedFrame(found[0], found[1] / max(fusion.template_energy, 1e-12), found[2])


def _noise(grey: Tensor, projected: Tensor, flow: Tensor, fusion: DeviceFusion) -> Tensor:
    """Z of a frame; see :func:`turbrestore.filtering.frame_noise.judge_frame`."""
    ops, maps, beta = fusion.ops, fusion.maps, fusion.sharpness
    if beta == 0:
        return ops.arrays.full_like(grey, fusion.image_noise)
    excess = _smooth((grey - maps["usual_frame"]).square(), OUTLIER_WINDOW, ops) / maps["deviation"] / OUTLIER
    excess = excess.clamp(min=1)
    squared = excess.square()
    score = maps["score_scale"] * (_smooth(projected, fusion.window, ops) - maps["usual"])
    score = score.clamp(-LARGEST_SCORE, LARGEST_SCORE)
    score = ops.arrays.where(score > 0, score / squared, score)
    exponent = 0.5 * beta**2 * maps["score_variance"] - beta * score + float(LOG_DISTRUST) * _lost(flow, ops)
    return fusion.image_noise * squared * excess * exponent.clamp(max=LARGEST_EXPONENT).exp()


def _lost(flow: Tensor, ops: StackOps) -> Tensor:
    """1 where the map id + Ŵ folds, and where it leaves the frame, fading to 0 around it."""
    from torch.nn import functional

    (ux, uy), (vx, vy) = (_gradient(flow[..., axis], ops) for axis in (0, 1))
    folded = ((1 + ux) * (1 + vy) <= uy * vx).float()
    wider = functional.max_pool2d(folded[None, None], 2 * AROUND_FOLD + 1, stride=1, padding=AROUND_FOLD)[0, 0]
    height, width = flow.shape[:2]
    y, x = (ops.load(axis) for axis in np.mgrid[:height, :width].astype(np.float32))
    inside = _inside(x + flow[..., 0], width) * _inside(y + flow[..., 1], height)
    return ops.arrays.maximum(_smooth(wider, FOLD_FADE, ops), 1 - inside)


def _inside(position: Tensor, length: int) -> Tensor:
    return (1 - (-position).maximum(position - (length - 1))).clamp(0, 1)


def _projection(grey: Tensor, fusion: DeviceFusion) -> Tensor:
    """Gradient of a frame projected on that of the image."""
    dx, dy = _gradient(grey, fusion.ops)
    return dx * fusion.maps["along"] + dy * fusion.maps["across"]


def _gradient(image: Tensor, ops: StackOps) -> tuple[Tensor, Tensor]:
    """Sobel's derivatives, divided by 8."""
    return ops.filter(image, _DIFFERENCE, _BINOMIAL), ops.filter(image, _BINOMIAL, _DIFFERENCE)


def _smooth(image: Tensor, sigma: float, ops: StackOps) -> Tensor:
    """Gaussian, cut off at 4σ as OpenCV does."""
    kernel = cv2.getGaussianKernel(round(8 * sigma + 1) | 1, sigma, cv2.CV_32F).ravel()
    return ops.filter(image, kernel, kernel)


def _luminance(planes: Tensor) -> Tensor:
    # Of the three unit colours it is what each channel weighs.
    red, green, blue = luminance(np.eye(3, dtype=np.float32)[None])[0].tolist()
    return red * planes[0] + green * planes[1] + blue * planes[2]


def _planes(image: FloatArray) -> FloatArray:
    return image[None] if image.ndim == 2 else np.moveaxis(image, -1, 0)
