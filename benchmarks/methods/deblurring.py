"""The deconvolution of this project behind the merged image of any method, as a restoration of the clip calls it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.core.noise_spectrum import NoiseSpectrum
from turbrestore.deblurring.remove_blur import remove_blur_steps
from turbrestore.deconvolution.deconvolve import Deconvolution, DeconvolutionParams
from turbrestore.footage.levels import Levels
from turbrestore.footage.lighting.range import find_range
from turbrestore.footage.survey import take_survey
from turbrestore.io.source import FrameSource
from turbrestore.registration.recentring import recentre
from turbrestore.results import Restoration
from turbrestore.runtime.runtime import DEFAULT, Runtime
from turbrestore.runtime.steps import finish


def levels_of(frames: FloatArray) -> Levels:
    """Levels at which a restoration works if it corrects nothing else: a range that is part of the scale is stretched.

    λ weighs the data against the total variation, which grow with the square of the contrast and with the contrast: at
    other levels the same λ is another.
    """
    found = find_range(take_survey(FrameSource.from_array(frames)))
    return Levels() if found is None or found.levels is None else found.levels


def known(restoration: Restoration) -> tuple[FloatArray, NoiseSpectrum | None]:
    """Guide and noise with which a restoration was deblurred, at the levels of the clip."""
    guide, filtered = restoration.centroid.image, restoration.filtered
    return guide if filtered is None else recentre(guide, filtered.mean_flow), restoration.noise


def deblurred(
    image: FloatArray,
    levels: Levels,
    params: DeconvolutionParams | None = None,
    guide: FloatArray | None = None,
    noise: NoiseSpectrum | None = None,
    runtime: Runtime = DEFAULT,
) -> Deconvolution:
    """Image without its blur; images and noise are at the levels of the clip, λ at those of the restoration.

    The guide is by default the image, from which alone the width is estimated where ``params`` has none.
    """
    blurred = levels.stretched(image)
    seen = blurred if guide is None else levels.stretched(guide)
    stretched = None if noise is None else noise.scaled(levels.gain**2)
    steps = remove_blur_steps(blurred, seen, params, runtime=runtime, full_scale=levels.full_scale, noise=stretched)
    found = finish(steps).deconvolution
    return replace(found, image=np.clip(levels.original(found.image), 0, 1))
