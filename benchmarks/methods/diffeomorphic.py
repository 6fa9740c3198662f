"""Registration to a template that is never formed: the mean flow from one frame, inverted.

D. Lao, C. Wang, A. Wong, S. Soatto, *Diffeomorphic template registration for atmospheric turbulence mitigation*, CVPR
2024 (arXiv:2405.03662).

Symbols
-------
I_0 : the first frame, I_t : frame t, J : the template, which is the scene at its mean geometry.
w_t : optical flow from I_0 to I_t, I_0(x) ≈ I_t(x + w_t(x)).
w̄ : mean of the w_t, v : flow of the inverse of id + w̄.

Displacements of the scene have zero mean over time, so the mean of the flows from one frame converges to the flow from
that frame to the template (central limit theorem): I_0(x) ≈ J(x + w̄(x)).  With the inverse, (id + w̄) ∘ (id + v) = id,
every frame is registered to the template without it::

    I_t registered (y) = I_t(x + w_t(x))  at  x = y + v(y)

The two flows are composed, so each frame is interpolated once.  The mean of the registered frames is deblurred by a
Gaussian of unknown width.

From the paper: the first frame as the reference, one pass, the mean, a Gaussian of unknown width.  From this project:
optical flow, inversion of flows, the estimate of the width and total variation as the penalty of the deconvolution; the
paper uses a simple optical flow, and states that a better one helps.
"""

from __future__ import annotations

import numpy as np

from methods.deblurring import deblurred, levels_of
from turbrestore.blur.psf import GAUSSIAN
from turbrestore.core.arrays import FloatArray
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.registration.flow import estimate_flow
from turbrestore.registration.flow_algebra import compose_flows, invert_flow
from turbrestore.registration.warp import warp

DEBLURRING = DeconvolutionParams(method="tv", exponent=GAUSSIAN)


def template(frames: FloatArray, reference: int = 0) -> FloatArray:
    """Return the mean of frames (T, H, W[, 3]) after each is registered to the template."""
    flows = estimate_flow(frames[reference], frames)
    # A frame does not move against itself, whatever an optical flow says.
    flows[reference] = 0
    to_reference = invert_flow(flows.mean(axis=0))
    registered = (warp(frame, compose_flows(w, to_reference)) for frame, w in zip(frames, flows, strict=True))
    return np.mean(list(registered), axis=0, dtype=np.float32)


def deblurred_template(frames: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the template of frames, and the template without its blur."""
    fused = template(frames)
    return fused, deblurred(fused, levels_of(frames), DEBLURRING).image
