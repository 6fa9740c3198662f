"""What an image alone says about its blur: the cost of every width for several shapes of the blur.

The width depends on the shape that is assumed, and the shape on whether the air or a lens has blurred.  So the
likelihood of :mod:`turbrestore.blur.marginal_likelihood` is computed for three exponents; the posterior of the blur
interpolates between them.

They are computed at the reduction of the image that :func:`turbrestore.blur.estimation.choose_blur` prefers, with two
exceptions.  A soft scene, such as the Moon, looks blurred by about the same share of a pixel at every reduction: images
that are reduced by more than two count as far as their blur is as wide as a reduced pixel.  And noise and codec make
the original image look sharp: where a blur has more pixels in the image reduced by two than in the original one, or
is too wide for all but the smallest image, that one counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from ...core.arrays import FloatArray
from ...runtime.runtime import DEFAULT, Runtime
from ...runtime.threads import ThreadTeam, one_thread_each
from ..estimation import BlurCandidate, BlurEstimate, choose_blur, find_candidates, unreduced_width
from ..marginal_likelihood import WIDTHS, image_gradients, width_costs
from ..psf import Float64Array

# Exponents of the transfer function: strong air, that of wide fused blurs; weak air behind an aperture, chosen; a lens.
EXPONENTS = (1.2, 1.55, 2.0)
# Rises of the cost after which wider blurs are not tried, and the cost of those above the smallest; both chosen.
_RISES, _BEYOND = 4, 3.0
# Largest reduction at which a blur may be narrower than this, in reduced pixels; both chosen: in a test a soft scene
# has 0.91, and letters have 1.01.
_TRUSTED, _RESOLVED = 2, 0.95
# Share of the widest blur of an image from which its width may be beyond it, chosen.
_SATURATED = 0.95


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
        chosen = judged_candidate(found, estimate.reduction)
        gradients, noise = image_gradients(chosen.part), chosen.estimate.noise
        with ThreadTeam(min(runtime.workers, 2)) as team:
            curves = list(team.map(partial(width_costs, gradients, noise=noise, rises=_RISES), EXPONENTS))
    costs = np.full((len(EXPONENTS), len(WIDTHS)), np.inf)
    for row, curve in zip(costs, curves, strict=True):
        row[: len(curve)] = curve
    widths = np.array([unreduced_width(width, chosen.estimate.reduction) for width in WIDTHS])
    return ImageEvidence(widths, np.minimum(costs, costs.min() + _BEYOND), estimate)


def judged_candidate(found: tuple[BlurCandidate, ...], preferred: int) -> BlurCandidate:
    """Return the candidate, of those in order of their reduction, by which the image is judged."""
    original, *reduced = (one.estimate.sigma / one.estimate.reduction for one in found)
    beyond = preferred == found[0].estimate.reduction and original > _SATURATED * WIDTHS[-1]
    if beyond or (reduced and reduced[0] > max(original, 1)):
        return found[-1]
    if preferred > _TRUSTED:
        pixels = zip(found, (original, *reduced), strict=True)
        return max(
            (one for one, blur in pixels if blur >= _RESOLVED and one.estimate.reduction <= preferred),
            key=lambda one: one.estimate.reduction,
            default=found[0],
        )
    return next(one for one in found if one.estimate.reduction == preferred)
