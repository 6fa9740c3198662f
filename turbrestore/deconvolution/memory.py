"""Memory that a deconvolution takes, measured as peak resident memory on Linux and rounded up.

Bytes for each pixel with the margin, of c channels that are deblurred and t threads; for nltv each pixel chooses b
neighbours, and has about 0.55 b pairs because many are chosen from both sides::

    nltv                30 + 112 c + 55 min(t, c + 1) + 0.55 b · (8 + 8 c)
    tv                  30 + 130 c
    wiener, tikhonov    30 + 50 c

A pair takes 8 bytes in the graph and 8 in the dual variable of every channel.  Wiener solutions of the channels and the
guide are found side by side, which is the part that grows with the threads.
"""

from __future__ import annotations

import numpy as np

from .deconvolve import DeconvolutionParams
from .problem import MARGIN_SIGMAS, margin_around

# Of any size, measured as well: compiled code, tiles of the search, stacks of threads.
_FIXED = 2e7
# Width of the blur that the margin is computed for where none is given, pixels, chosen.
_SIGMA = 3.0
# Pairs for each neighbour that a pixel chooses.
_PAIRS = 0.55


def deconvolution_memory(shape: tuple[int, ...], params: DeconvolutionParams, threads: int = 1) -> float:
    """Largest memory that the deconvolution of an image takes, its input not counted."""
    reach = int(np.ceil(MARGIN_SIGMAS * (params.sigma if params.sigma is not None else _SIGMA)))
    height, width = margin_around((shape[0], shape[1]), reach if params.boundary == "unknown" else None).shape
    colour = len(shape) == 3
    channels = 3 if colour and params.channels == "each" else 1
    if params.method == "nltv":
        pairs = _PAIRS * (params.weights.best + params.weights.nearest)
        a_pixel = 30 + 112 * channels + 55 * min(threads, channels + 1) + pairs * (8 + 8 * channels)
    else:
        a_pixel = 30 + (130 if params.method == "tv" else 50) * channels
    # Luminance, and the joined image before and after it is clipped.
    joined = 28 if colour else 4
    return _FIXED + height * width * (a_pixel + joined)
