"""The blur of a fused image, by what its frames and the image itself say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..blur.estimation import BlurEstimate, estimate_blur, limit_to_edges
from ..blur.posterior import BlurPosterior, BlurWitnesses, blur_posterior
from ..blur.witnesses.image_evidence import image_evidence
from ..core.arrays import FloatArray, luminance
from ..deconvolution.deconvolve import DeconvolutionParams
from ..runtime.runtime import Runtime

# The widest blur that is found, pixels, and the least shorter side of an image in widths of its blur: a wider one
# leaves nothing to restore.
WIDEST, SIGMAS_A_SIDE = 21.0, 8


def find_blur(
    image: FloatArray, params: DeconvolutionParams, runtime: Runtime, witnesses: BlurWitnesses | None
) -> tuple[BlurEstimate | None, BlurPosterior | None]:
    """Estimate the blur by the image, and by the frames where there are witnesses."""
    if params.sigma is not None:
        return None, None
    if witnesses is None:
        return estimate_blur(image, exponent=params.exponent, runtime=runtime), None
    grey = luminance(image)
    if witnesses.picture is not None:
        grey = np.ascontiguousarray(grey[witnesses.picture])
    evidence = image_evidence(grey, runtime)
    ratio = None if witnesses.variation is None else witnesses.variation.with_power(grey)
    posterior = blur_posterior(evidence, witnesses, ratio)
    widest = min(WIDEST, min(grey.shape) / SIGMAS_A_SIDE)
    posterior = replace(posterior, removed=min(posterior.removed, widest))
    if evidence is None:
        return estimate_blur(image, exponent=params.exponent, runtime=runtime), replace(posterior, removed=0.0)
    if posterior.removed == 0:
        return evidence.estimate, posterior
    # No scene is steeper behind a blur than a step.
    limited = limit_to_edges(replace(evidence.estimate, sigma=posterior.removed, exponent=posterior.exponent), grey)
    if not limited.edge_limited:
        return evidence.estimate, posterior
    removed = limited.sigma if limited.blurred else 0.0
    return evidence.estimate, replace(posterior, removed=removed, exponent=limited.exponent, edge_limited=True)
