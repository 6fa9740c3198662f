"""Wording of the decisions on the blur and on the guards."""

from __future__ import annotations

import numpy as np

from ..blur.estimation import BlurEstimate
from ..blur.posterior import BlurPosterior
from ..core.decision import Decision
from .guards import GuardParams, GuardReading

# Probability from which the air is said to have blurred the image, chosen.
_MOSTLY = 0.8


def explain_choice(removed: float) -> str:
    """Say which width is removed, pixels."""
    return f"{removed:.2f} pixels removed" if removed > 0 else "none removed"


def explain_blur(blur: BlurEstimate | None, sigma: float, given: str = "asked for") -> Decision:
    """Explain which width is removed; ``given`` is the reason if none was estimated."""
    choice = explain_choice(sigma)
    if blur is None:
        return Decision("blur", choice, given)
    width = f"{blur.sigma:.2f} ± {blur.uncertainty:.2f} pixels"
    if blur.edge_limited:
        return Decision("blur", choice, f"{width}, edges are too steep for the wider blur that is likeliest")
    found = f"{width} found in the whole image"
    where = "" if blur.reduction == 1 else f", reduced by {blur.reduction}"
    remark = ", no more than a sharp image has"
    if sigma > 0:
        remark = ", part of the uncertainty is left in" if blur.removable < blur.sigma else ""
    return Decision("blur", choice, found + where + remark)


def explain_posterior(posterior: BlurPosterior, removed: float) -> Decision:
    """Explain which width is removed in the end, pixels, and what each witness says."""
    choice = explain_choice(removed)
    low, width, high = posterior.width
    witnesses = {
        "the displacement": posterior.by_displacement,
        "the variation of the frames": posterior.by_variation,
        "the edges of the image": posterior.by_image,
    }
    witnesses = {name: found for name, found in witnesses.items() if np.isfinite(found).all()}
    said = ", ".join(f"{found[0]:.2f} to {found[2]:.2f} from {name}" for name, found in witnesses.items())
    cause = "caused mostly by the air" if posterior.air > _MOSTLY else "caused by the air or the lens"
    if posterior.air < 1 - _MOSTLY:
        cause = "not caused by the air"
    told = " by the two tones of the image" if np.isfinite(posterior.by_tones).all() else ""
    reason = f"measured {width:.2f} pixels ({low:.2f} to {high:.2f}){told}, {cause}; expected {said}"
    if posterior.edge_limited:
        reason = f"the edges of the image are too steep for more; {reason}"
    elif posterior.removed == 0:
        reason = f"removing one is not expected to improve it; {reason}"
    for name, found in witnesses.items():
        if found[0] > high or found[2] < low:
            reason += f"; {name} alone would give {'more' if found[0] > high else 'less'}"
    return Decision("blur", choice, reason)


def explain_guards(sigma: float, readings: tuple[GuardReading, ...], guards: GuardParams) -> tuple[Decision, ...]:
    """Explain what the guards measured and what followed from it."""
    if not readings:
        return ()
    first, last = readings[0], readings[-1]
    if last.passed:
        choice = "passed" if len(readings) == 1 else f"blur lowered from {first.sigma:.2f} to {last.sigma:.2f} pixels"
    else:
        choice = "failed, kept because the width was given" if sigma > 0 else "failed at every width, no blur removed"
    reason = (
        f"at {first.sigma:.2f} px, {first.ringing:.0%} of edges ring (bound {guards.ringing:.0%}), "
        f"{first.overshoot:.0%} of pixels near edges overshoot (bound {guards.overshoot:.0%}), "
        f"noise × {first.noise_gain:.1f} (bound {guards.noise_gain:g})"
    )
    return (Decision("guards", choice, reason),)
