"""Decisions of a restoration in words: what was chosen from the data, and the figures that led to it."""

from __future__ import annotations

import numpy as np

from .core.arrays import FloatArray, luminance
from .core.decision import Decision
from .dynamics.flow_model import FlowDynamics
from .filtering.alternating import Filtered
from .registration.centroid import Centroid
from .registration.coverage import Rectangle
from .registration.global_shift import DEAD_ZONE
from .runtime.scratch import iter_frames

# A frame that counts for less than this share of the average hardly counts.
_HARDLY = 0.2
# Half a grey level of an 8-bit camera below full scale; a share of such pixels that is worth a word.
_FULL, _MUCH = 1 - 0.5 / 255, 0.01
# A frame of less than this share of the contrast of the best one has none.
_FAINT = 0.1
# Motion of this share of the shorter side is more than flow follows everywhere.
_FAR = 1 / 12


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
    half = frame_count // 2
    if wanted is not None:
        reason = "asked for"
    elif train == frame_count:
        reason = "the whole clip"
    elif train == half:
        reason = "half of the clip"
    else:
        reason = "more than half of a short clip" if train > half else "enough of a long clip, or all that memory holds"
    return Decision("training", f"first {train} of {frame_count} frames", reason)


def explain_input(training: FloatArray) -> tuple[Decision, ...]:
    """Say what of the frames tells little: saturated pixels, frames without texture.

    Parameters
    ----------
    training : ndarray, float32, shape (T, H, W) or (T, H, W, 3)

    Returns
    -------
    tuple of Decision
        Empty where there is nothing to say.

    Examples
    --------
    >>> import numpy as np
    >>> frames = np.random.default_rng(0).uniform(0.2, 0.8, (4, 16, 16)).astype(np.float32)
    >>> frames[2] = 0.5; frames[:, :4] = 1
    >>> [(decision.subject, decision.choice) for decision in explain_input(frames)]
    [('saturation', 'left as it is'), ('flat frames', '1 of 4, kept')]
    """
    said = []
    saturated, contrast = 0.0, np.zeros(len(training))
    for index, frame in enumerate(iter_frames(training)):
        saturated += float(np.mean(frame >= _FULL)) / len(training)
        grey = luminance(frame)
        # A saturated part is no texture.
        textured = grey[grey < _FULL]
        contrast[index] = textured.std() if textured.size else 0.0
    if saturated > _MUCH:
        reason = f"{saturated:.0%} of the training frames is at full scale: detail is lost there, and edges may ring"
        said.append(Decision("saturation", "left as it is", reason))
    faint = int(np.sum(contrast < _FAINT * contrast.max()))
    if faint:
        reason = "hardly any contrast: their flow follows noise, and their weight is what their sharpness gives them"
        said.append(Decision("flat frames", f"{faint} of {len(training)}, kept", reason))
    return tuple(said)


def explain_motion(flows: FloatArray) -> tuple[Decision, ...]:
    """Say that the motion is larger than flow follows well, if it is.

    Parameters
    ----------
    flows : ndarray, float32, shape (T, H, W, 2)
        From the centroid to the frames, pixels.

    Returns
    -------
    tuple of Decision
        Empty where there is nothing to say.

    Examples
    --------
    >>> import numpy as np
    >>> explain_motion(np.full((2, 24, 24, 2), 3.0, np.float32))[0].choice
    'taken as measured'
    """
    squares = sum(float(np.mean(np.square(flow), dtype=np.float64)) for flow in iter_frames(flows))
    size = float(np.sqrt(2 * squares / len(flows)))
    side = min(flows.shape[1:3])
    if size < _FAR * side:
        return ()
    reason = f"{size:.1f} pixels on {side} is more than flow follows everywhere; the result may be doubled"
    return (Decision("motion", "taken as measured", reason),)


def explain_camera(flows: FloatArray) -> tuple[Decision, ...]:
    """Say how far the camera moved, if it did.

    Parameters
    ----------
    flows : ndarray, float32, shape (T, H, W, 2)
        From the centroid to each training frame, pixels.

    Returns
    -------
    tuple of Decision
        None where frames are shifted by two pixels at most.

    Examples
    --------
    >>> still = np.zeros((3, 16, 16, 2), np.float32)
    >>> explain_camera(still)
    ()
    >>> explain_camera(still + np.float32([6, -8]))[0].choice
    'followed over 10.0 pixels'
    """
    shifts = np.array([np.median(flow[::4, ::4].reshape(-1, 2), axis=0) for flow in iter_frames(flows)])
    largest = float(np.hypot(shifts[:, 0], shifts[:, 1]).max())
    if largest <= DEAD_ZONE:
        return ()
    return (Decision("camera", f"followed over {largest:.1f} pixels", "the largest shift of a whole training frame"),)


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
    >>> from turbrestore.dynamics.dynamic_texture import identify
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
