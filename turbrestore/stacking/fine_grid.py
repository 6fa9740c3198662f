"""Fusion on a grid finer than that of the sensor, from the sub-pixel motion that the air makes (use of drizzle).

Symbols
-------
s : scale, fine pixels a pixel; x : a fine pixel, in pixels of the frames
y_k, W_k : frame k, and the flow that leads to it from the image, pixels
p, d : pixel of the frame nearest to ``x + W_k(x)``, and how far that lies from it, at most half a pixel along each axis
w_k : share of the frame; g : Gaussian of deviation τ = 1 / 2s pixels; u : the image

``u(x) = Σ_k w_k g(d) y_k(p) / Σ_k w_k g(d)``

A sample is the scene under the blur and the box of one pixel, and counts near its own place only.  The air moves frames
by fractions of pixels, so that samples fall everywhere: the mean of u is the scene under blur, box and g, and what an
undersampled frame folds back cancels.  A little of the interpolated frame fills what no sample falls near, so there are
no holes.  The transfer function that is then removed is the product

``H(ν) = B(ν) · sinc(s ν_x) sinc(s ν_y) · G(ν)``,  ν in cycles per fine pixel,

with G that of g cut off at half a pixel, and B that of the blur which the restoration has removed, at s times its width
without the box of a pixel, ``σ_s² = s² (σ² − 1/12)``, because that width had the box in it.  Where that blur is so wide
that nothing was folded back, the image reduced to the usual grid is the usual result.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..blur.psf import GAUSSIAN, blur_otf
from ..core.arrays import ROUNDING, FloatArray, luminance
from ..core.decision import Decision
from ..deblurring.remove_blur import Refusal, guarded_steps
from ..deconvolution.deconvolve import Deconvolution, deconvolve_steps
from ..deconvolution.stopping import Steps
from ..preparation import Prepared
from ..registration.registered_noise import Halves
from ..results import Restoration
from ..runtime.runtime import Runtime
from ..runtime.steps import finish
from ..runtime.threads import sum_in_threads
from ..settings import RestoreParams
from ..verification.halves import keep_agreed
from .registered import registering_flows

# Weight of the interpolated frame, where a sample in its place has 1, chosen.
_FILL = 1e-3
# Variance of the box of a pixel, squared pixels; width of the blur below which there is none, fine pixels, chosen.
_BOX, _LEAST = 1 / 12, 0.2
# Parts of a clip that go to one half and to the other in turns, chosen.
_PARTS = 8
# Room around a point spread function, in widths of the blur: a Gaussian falls to 0.0003 of its height there.
_REACH = 4.0


def fine_image(
    prepared: Prepared, restoration: Restoration, params: RestoreParams, runtime: Runtime
) -> tuple[FloatArray, Decision]:
    """Fuse the frames of a restoration on the finer grid, and remove blur and pixel there.

    Returns (s·H, s·W) or (s·H, s·W, 3).
    """
    scale, full_scale = params.scale, prepared.levels.full_scale
    filtered, done = restoration.filtered, restoration.deconvolution
    counts = np.ones(restoration.frame_count) if filtered is None else filtered.shares * restoration.frame_count
    flows = registering_flows(prepared.source, restoration, restoration.centroid.image, params, runtime)
    halves = fuse_finely(flows, counts, prepared.source.shape[1:], scale, runtime.threads)
    image = halves.mean
    if done is None:
        choice, reason = f"{scale:g} times as fine, blurred", "no blur is removed before the last stage"
        return image, Decision("scale", choice, reason)
    removed = _removed(image, done.sigma, params, restoration, runtime, full_scale)
    sharp = np.clip(_with_usual(removed.image, done.image, done.sigma), *full_scale)
    compared = Halves(luminance(halves.first), luminance(halves.second))
    agreed = keep_agreed(sharp, image, halves.noise(), [compared], full_scale)
    choice = f"{scale:g} times as fine, with {removed.sigma:.2f} fine pixels of blur and the pixel removed"
    reason = f"{restoration.motion:.2f} pixels of motion place {restoration.frame_count} frames between its pixels"
    return agreed.image, Decision("scale", choice, reason)


def fuse_finely(
    frames: Iterable[tuple[FloatArray, FloatArray]],
    weights: NDArray[np.float64],
    shape: tuple[int, ...],
    scale: float,
    threads: int = 0,
) -> Halves:
    """Fuse each half of some frames on the finer grid.

    ``frames`` yields (H, W) or (H, W, 3) with its flow (H, W, 2); ``weights`` (T,), in units of the mean weight.
    """
    fine, count = fine_shape(shape, scale), len(weights)

    def add(numbered: list[tuple[int, tuple[FloatArray, FloatArray]]]) -> tuple[np.ndarray, ...]:
        sums, held = np.zeros((2, *fine)), np.zeros((2, *fine[:2]))
        for number, (frame, flow) in numbered:
            half = number * _PARTS // count % 2
            sample, weight = _samples(frame, flow, (fine[0], fine[1]), scale)
            weight *= np.float32(weights[number])
            sums[half] += sample * (weight if frame.ndim == 2 else weight[..., None])
            held[half] += weight
        return sums, held

    sums, held = sum_in_threads(add, enumerate(frames), threads)
    held = np.maximum(held, ROUNDING**2)
    return Halves(*((total.T / some.T).T.astype(np.float32) for total, some in zip(sums, held, strict=True)))


def fine_shape(shape: tuple[int, ...], scale: float) -> tuple[int, ...]:
    """Shape of an image on the finer grid."""
    return round(shape[0] * scale), round(shape[1] * scale), *shape[2:]


def fine_psf(sigma: float, exponent: float, scale: float) -> NDArray[np.float64]:
    """Point spread function of blur, pixel and sampling on the finer grid; its sides are odd."""
    side = 2 * int(np.ceil(_REACH * sigma + 2 * scale + 2)) + 1
    nu, half = np.fft.fftfreq(side), np.fft.rfftfreq(side)
    otf = blur_otf((side, side), sigma, exponent).astype(np.float64)
    for frequencies, axis in ((nu, np.s_[:, None]), (half, np.s_[None, :])):
        otf = otf * (np.sinc(scale * frequencies) * _sampling(frequencies, scale))[axis]
    return np.clip(np.fft.fftshift(np.fft.irfft2(otf, s=(side, side))), 0, None)


def _sampling(frequencies: NDArray[np.floating], scale: float) -> NDArray[np.float64]:
    """Transfer function of g, cut off at half a pixel."""
    d = np.linspace(-0.5, 0.5, 201)
    g = np.exp(-2 * (scale * d) ** 2)
    return np.cos(2 * np.pi * scale * np.outer(frequencies, d)) @ g / g.sum()


def _samples(frame: FloatArray, flow: FloatArray, size: tuple[int, int], scale: float) -> tuple[FloatArray, FloatArray]:
    """Sample of a frame that belongs to every fine pixel, and its weight g(d)."""
    height, width = frame.shape[:2]
    flow = cv2.resize(flow, size[::-1], interpolation=cv2.INTER_LINEAR)
    x = (np.arange(size[1], dtype=np.float32) + 0.5) * np.float32(width / size[1]) - 0.5 + flow[..., 0]
    y = ((np.arange(size[0], dtype=np.float32) + 0.5) * np.float32(height / size[0]) - 0.5)[:, None] + flow[..., 1]
    column, row = np.rint(x), np.rint(y)
    weight = np.exp(np.float32(-2 * scale**2) * (np.square(x - column) + np.square(y - row)))
    # Beyond the border the nearest pixel is no sample of the scene.
    weight[(x < -0.5) | (y < -0.5) | (x > width - 0.5) | (y > height - 0.5)] = 0
    nearest = frame[np.clip(row, 0, height - 1).astype(np.intp), np.clip(column, 0, width - 1).astype(np.intp)]
    between = cv2.remap(frame, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    share = weight / (weight + np.float32(_FILL))
    sample = between + (nearest - between) * (share if frame.ndim == 2 else share[..., None])
    return sample, weight + np.float32(_FILL)


def _with_usual(fine: FloatArray, usual: FloatArray, sigma: float) -> FloatArray:
    """Let the reduced image be that of the usual grid as far as blur leaves nothing to fold back there.

    The share is one less the transfer function of the blur at half a cycle per pixel, ``1 − exp(−π² σ² / 2)``.
    """
    share = np.float32(1 - np.exp(-((np.pi * sigma) ** 2) / 2))
    rest = usual - cv2.resize(fine, usual.shape[1::-1], interpolation=cv2.INTER_AREA)
    size = fine.shape[1::-1]
    return fine + share * cv2.resize(rest, size, interpolation=cv2.INTER_CUBIC)


def _removed(
    image: FloatArray,
    sigma: float,
    params: RestoreParams,
    restoration: Restoration,
    runtime: Runtime,
    full_scale: tuple[float, float],
) -> Deconvolution:
    """Remove blur and pixel, by a smaller width of the blur where the guards object to it."""
    scale, blur = params.scale, restoration.posterior or restoration.blur
    fine = scale * float(np.sqrt(max(sigma**2 - _BOX, 0.0)))
    fine = fine if fine > _LEAST else 0.0
    exponent = params.deconvolution.exponent or (GAUSSIAN if blur is None else blur.exponent)
    settings = replace(params.deconvolution, sigma=None, exponent=None)

    def attempt(width: float, refuse: Refusal | None = None) -> Steps[Deconvolution]:
        psf = fine_psf(width, exponent, scale)
        found = yield from deconvolve_steps(image, psf, settings, image, runtime, full_scale=full_scale, refuse=refuse)
        return replace(found, sigma=width)

    if params.deconvolution.sigma is not None:
        return finish(attempt(fine))
    return finish(guarded_steps(attempt, image, fine, params.guards))[0]
