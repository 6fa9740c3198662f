"""Blur of the frames of a stream, as windows of frames tell it.

The frames of a window are registered to the image that is fused from them, so they say about its blur what the frames
of a clip say about that of a restored image (:mod:`turbrestore.blur.posterior`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike

from ..blur.posterior import BlurWitnesses, blur_posterior, estimate_posterior, measure_witnesses
from ..blur.psf import KOLMOGOROV
from ..core.arrays import FloatArray, luminance
from ..core.noise import estimate_noise
from ..core.noise_spectrum import white_noise
from ..runtime.runtime import Runtime
from .camera_path.camera import camera_flow, fit_camera
from .dewarping import dewarp_frame, measure_flow
from .grid import enlarged, grid_of
from .settings import SteadyParams
from .windows import Window, iter_windows

# Median of the squared distance from the centre of a normal distribution in the plane, over the variance along an axis.
_MEDIAN_SQUARE = 2 * np.log(2)


@dataclass(frozen=True, eq=False)
class WindowWitnesses:
    """What the frames of a window say about their blur."""

    of_image: BlurWitnesses  # about that of an image fused from them
    usual: float  # median of the displacement by the air, as a variance along an axis, squared pixels


def find_blur_of_windows(
    window: Window, again: Iterable[ArrayLike], params: SteadyParams, runtime: Runtime
) -> tuple[float, float, WindowWitnesses]:
    """Blur of the window whose width is the median, of this one and up to two later ones of its scene.

    They share no frame.  The widths that single windows of one clip tell differ by a fifth or more.  Of two, the
    narrower is taken.
    """
    apart = 2 * params.reach + 1
    later = islice(iter_windows(again, params.distances), window.number + apart, window.number + 2 * apart + 1, apart)
    usable = [one for one in later if one.frame.scene == window.frame.scene and max(one.neighbours, default=0) > 0]
    found = [find_blur_of_window(one, params, runtime) for one in (window, *usable)]
    return sorted(found, key=lambda one: one[0])[(len(found) - 1) // 2]


def find_blur_of_window(window: Window, params: SteadyParams, runtime: Runtime) -> tuple[float, float, WindowWitnesses]:
    """Width and exponent of the blur of all frames, from one with neighbours on both sides, and what witnesses say."""
    image = dewarp_frame(window, params).image
    said = _witnesses_of_window(window, image)
    return *find_blur_of_image(image, said, said.of_image.independent_frames, runtime), said


def _witnesses_of_window(window: Window, image: FloatArray) -> WindowWitnesses:
    """Measure what the frames of a window, registered to the image fused from them, say about their blur."""
    frames = np.stack([window.frame.image, *(frame.image for frame in window.neighbours.values())])
    still, count = np.zeros((*grid_of(image.shape), 2), np.float32), float(len(frames))
    coarse = [measure_flow(image, frame, still) for frame in frames]
    flows = np.stack([enlarged(flow, image.shape) for flow in coarse])
    displacement = float(np.square(flows - np.median(flows, axis=(1, 2), keepdims=True)).mean())
    # The median leaves out objects, and flat parts, whose flow is arbitrary.
    own = np.stack([flow - camera_flow(fit_camera(flow, image.shape), image.shape, flow.shape) for flow in coarse])
    usual = float(np.median(np.square(own).sum(-1))) / _MEDIAN_SQUARE
    return WindowWitnesses(measure_witnesses(frames, flows, image, BlurWitnesses(displacement, count)), usual)


def find_blur_of_image(image: FloatArray, said: WindowWitnesses, count: float, runtime: Runtime) -> tuple[float, float]:
    """Return width and exponent of the blur to remove from a mean of so many frames.

    A window has few frames.  Where something moves or they are registered badly, they seem to vary, and the posterior
    is too wide; where the scene is soft, so is what the image says.  Edges tell that nothing has blurred, and the
    usual displacement how much the air can have blurred.  The least of the three widths is removed.
    """
    grey, witnesses = luminance(image), said.of_image
    noise = white_noise(estimate_noise(grey))
    if witnesses.frame_noise is not None:
        noise = witnesses.frame_noise.scaled(1 / count)
    variation = None if witnesses.variation is None else replace(witnesses.variation, frames=round(count))
    witnesses = replace(witnesses, independent_frames=count, variation=variation)
    evidence, posterior = estimate_posterior(grey, witnesses, noise, runtime, cautious=True)
    if evidence is None:
        return 0.0, KOLMOGOROV
    ratio = None if variation is None else variation.with_power(grey)
    of_air = blur_posterior(evidence, replace(witnesses, displacement=said.usual), ratio).by_displacement[1]
    return min(posterior.removed, evidence.estimate.removable, float(of_air)), posterior.exponent
