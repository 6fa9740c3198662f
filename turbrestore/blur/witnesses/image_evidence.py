"""What an image alone says about its blur: the cost of every width for several shapes of the blur.

The width depends on the shape that is assumed, and the shape on whether the air or a lens has blurred.  So the
likelihood of :mod:`turbrestore.blur.marginal_likelihood` is computed for three exponents, at the reduction of the image
that :func:`turbrestore.blur.estimation.choose_blur` prefers; the posterior of the blur interpolates between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...runtime.runtime import DEFAULT, Runtime
from ...runtime.threads import ThreadTeam, one_thread_each
from ..estimation import BlurCandidate, BlurEstimate, choose_blur, find_candidates, unreduced_width
from ..marginal_likelihood import WIDTHS, image_gradients, width_costs

Float64Array = NDArray[np.float64]

# Exponents of the transfer function: strong air, weak air behind an aperture, a lens.
EXPONENTS = (1.2, 1.55, 2.0)
# Rises of the cost after which wider blurs are not tried, and the cost of those above the smallest.
_RISES, _BEYOND = 4, 3.0
# Width from which the reduction is chosen by two shapes, pixels.
_WIDE = 1.5


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
        estimate, chosen = _chosen(found, runtime)
        if max(estimate.sigma, found[0].estimate.sigma) > _WIDE:
            # A wrong shape can make the image look sharper than it is where it is reduced less.
            other = _chosen(find_candidates(image, exponent=EXPONENTS[1]), runtime)
            estimate, chosen = max((estimate, chosen), other, key=lambda one: one[0].reduction)
        gradients, noise = image_gradients(chosen.part), chosen.estimate.noise
        with ThreadTeam(min(runtime.workers, 2)) as team:
            curves = list(team.map(lambda shape: width_costs(gradients, shape, noise, rises=_RISES), EXPONENTS))
    costs = np.full((len(EXPONENTS), len(WIDTHS)), np.inf)
    for row, curve in zip(costs, curves, strict=True):
        row[: len(curve)] = curve
    widths = np.array([unreduced_width(width, estimate.reduction) for width in WIDTHS])
    return ImageEvidence(widths, np.minimum(costs, costs.min() + _BEYOND), estimate)


def _chosen(candidates: tuple[BlurCandidate, ...], runtime: Runtime) -> tuple[BlurEstimate, BlurCandidate]:
    """Return the estimate of an image and the candidate that it comes from."""
    estimate = choose_blur(candidates, runtime)
    return estimate, next(one for one in candidates if one.estimate.reduction == estimate.reduction)
