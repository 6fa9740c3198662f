"""What an image alone says about its blur: the cost of every width for several shapes of the blur.

The width depends on the shape that is assumed, and the shape on whether the air or a lens has blurred.  So the
likelihood of :mod:`turbrestore.blur.marginal_likelihood` is computed for three exponents; the posterior of the blur
interpolates between them.

A wide blur is measured in a reduced image, because noise and codec hide it in the original one.  But a soft scene, such
as the Moon, looks blurred by about the same share of a pixel at every reduction.  So the image is reduced as far as its
blur is wider than a pixel of the reduced image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...runtime.runtime import DEFAULT, Runtime
from ...runtime.threads import ThreadTeam, one_thread_each
from ..estimation import BlurEstimate, choose_blur, find_candidates, unreduced_width
from ..marginal_likelihood import WIDTHS, image_gradients, width_costs

Float64Array = NDArray[np.float64]

# Exponents of the transfer function: strong air, weak air behind an aperture, a lens.
EXPONENTS = (1.2, 1.55, 2.0)
# Rises of the cost after which wider blurs are not tried, and the cost of those above the smallest.
_RISES, _BEYOND = 4, 3.0


@dataclass(frozen=True, eq=False)
class ImageEvidence:
    """Costs per gradient of the image (exponents, widths), the widths in pixels, and the estimate for one shape."""

    widths: Float64Array
    costs: Float64Array
    estimate: BlurEstimate


def image_evidence(image: FloatArray, runtime: Runtime = DEFAULT) -> ImageEvidence | None:
    """Compute the costs of an image (H, W); None if it is too small or uniform."""
    with one_thread_each():
        found = find_candidates(image)
        if not found:
            return None
        estimate = choose_blur(found, runtime)
        resolved = [one for one in found if one.estimate.sigma >= one.estimate.reduction]
        chosen = max(resolved or found[:1], key=lambda one: one.estimate.reduction)
        gradients, noise = image_gradients(chosen.part), chosen.estimate.noise
        with ThreadTeam(min(runtime.workers, 2)) as team:
            curves = list(team.map(lambda shape: width_costs(gradients, shape, noise, rises=_RISES), EXPONENTS))
    costs = np.full((len(EXPONENTS), len(WIDTHS)), np.inf)
    for row, curve in zip(costs, curves, strict=True):
        row[: len(curve)] = curve
    widths = np.array([unreduced_width(width, chosen.estimate.reduction) for width in WIDTHS])
    return ImageEvidence(widths, np.minimum(costs, costs.min() + _BEYOND), estimate)
