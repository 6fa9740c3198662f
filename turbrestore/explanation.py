"""Decisions of a restoration in words: what was chosen from the data, and the figures that led to it."""

from __future__ import annotations

import numpy as np

from .alternating import Filtered
from .border import Rectangle
from .centroid import Centroid
from .decision import Decision
from .dynamics import FlowDynamics

# A frame that counts for less than this share of the average hardly counts.
_HARDLY = 0.2


def explain_training(train: int, frame_count: int, wanted: int | None) -> Decision:
    """Which frames the centroid and the flow model are taken from.

    Parameters
    ----------
    train, frame_count : int
        Training frames, and all.
    wanted : int or None
        What was asked for.

    Returns
    -------
    Decision

    Examples
    --------
    >>> explain_training(60, 120, None)
    Decision(subject='training', choice='first 60 of 120 frames', reason='half of the clip')
    """
    share = train / frame_count
    reason = "asked for" if wanted is not None else "the whole clip" if share == 1 else "half of the clip"
    if wanted is None and abs(share - 0.5) > 0.01 and share < 1:
        reason = "enough for both, and all of them fit into memory"
    return Decision("training", f"first {train} of {frame_count} frames", reason)


def explain_centroid(centroid: Centroid) -> Decision:
    """How the centroid was found.

    Parameters
    ----------
    centroid : Centroid

    Returns
    -------
    Decision

    Examples
    --------
    >>> import numpy as np
    >>> explain_centroid(Centroid(np.zeros((4, 4)), np.zeros((2, 4, 4, 2)), np.array([0.9, 0.1]), True)).choice
    '2 iterations, converged'
    """
    sizes = centroid.mean_flow_sizes
    return Decision(
        "centroid",
        f"{sizes.size} iteration{'s' * (sizes.size > 1)}, {'' if centroid.converged else 'not '}converged",
        f"mean flow of {sizes[0]:.2f} pixels at first, {sizes[-1]:.2f} at last",
    )


def explain_dynamics(dynamics: FlowDynamics) -> tuple[Decision, ...]:
    """Rank of the flow model, and what had to be done to it.

    Parameters
    ----------
    dynamics : FlowDynamics

    Returns
    -------
    tuple of Decision

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.dynamics import identify
    >>> flows = np.random.default_rng(0).normal(size=(8, 4, 4, 2)).astype(np.float32)
    >>> explain_dynamics(identify(flows))[0].subject
    'flow model'
    """
    largest = float(abs(dynamics.eigenvalues).max(initial=0.0))
    modes = Decision(
        "flow model",
        f"{dynamics.rank} modes",
        f"{dynamics.energy_share:.0%} of the energy of the motion, largest eigenvalue {largest:.2f}",
    )
    return modes, *(Decision("flow model", "adjusted", note) for note in dynamics.notes)


def explain_frames(filtered: Filtered, chosen: int | None) -> Decision:
    """Which frames the image is made of.

    Parameters
    ----------
    filtered : Filtered
    chosen : int or None
        How many of the sharpest frames were asked for.

    Returns
    -------
    Decision

    Examples
    --------
    >>> import numpy as np
    >>> shares = np.array([0.45, 0.05, 0.5])
    >>> none = np.zeros(3)
    >>> filtered = Filtered(np.zeros((4, 4)), np.zeros((4, 4)), none, none, none, none, shares, 1e-4, 1.0)
    >>> explain_frames(filtered, None).choice
    '2 of 3 frames count'
    """
    count = filtered.shares.size
    mean = 1 / (count if chosen is None else chosen)
    counting = int(np.sum(filtered.shares >= _HARDLY * mean))
    reason = f"by sharpness, registration and outliers; the best frame counts {filtered.shares.max() / mean:.1f} times"
    asked = "" if chosen is None else f", {chosen} of them asked for as the sharpest"
    return Decision("frames", f"{counting} of {count} frames count", f"{reason} the average{asked}")


def explain_border(seen: float, crop: Rectangle | None) -> Decision:
    """Say what became of the border.

    Parameters
    ----------
    seen : float
        Share of the frames that show the pixel that is seen least.
    crop : tuple of int, or None
        x, y, width and height that are left.

    Returns
    -------
    Decision

    Examples
    --------
    >>> explain_border(0.6, None).choice
    'kept'
    """
    choice = "kept" if crop is None else f"cropped to {crop[2]}×{crop[3]} pixels from ({crop[0]}, {crop[1]})"
    return Decision("border", choice, f"the pixel that is seen least is in {seen:.0%} of the training frames")
