"""The decisions of a restoration in words: what was chosen from the data, and the figures that led to it."""

from __future__ import annotations

import math

import numpy as np

from .core.arrays import FloatArray
from .core.decision import Decision
from .core.remarks import counted
from .core.verdict import Check, CheckKind
from .dynamics.flow_model import FlowDynamics, mean_flow_error
from .filtering.alternating import Filtered
from .registration.camera.global_shift import DEAD_ZONE
from .registration.centroid import Centroid
from .registration.coverage import Rectangle
from .registration.recentring import recentring_flow
from .runtime.scratch import iter_frames
from .seeing.strength import LARGEST_BLUR, Estimate, Seeing
from .verification.structure import LASTING, LEFT, StructureReading

# A frame counts if its weight is at least this share of the average weight, chosen.
_COUNTS = 0.2
# Share of saturated pixels above which they are reported, chosen.
_REPORTED_SHARE = 0.01
# Motion beyond this share of the shorter side is too large for optical flow in some places; chosen.
_LARGE_MOTION = 1 / 12


# What is doubtful, and what to do about it.
_CHECKS = {
    CheckKind.INPUT: ("{0}", "ignore this if it is what you expect"),
    CheckKind.WATERMARK: (
        "a half-transparent mark lies over the scene and is restored poorly",
        "leave it out with --roi X,Y,WIDTH,HEIGHT; where the camera moves, --static-mask FILE fills what it names",
    ),
    CheckKind.TWO_STATES: ("a part of the scene switches between two states, and the image may mix them", "{0}"),
    CheckKind.SATURATED: ("{0}", "expose shorter; ignore this where what is white has no detail"),
    CheckKind.LARGE_MOTION: ("{0}", "--frames FIRST:END with the frames that move less"),
    CheckKind.SCENE_CHANGES: (
        "the scene itself changes during the clip, so the mean of the frames is the result",
        "--frames FIRST:END with the frames during which it does not",
    ),
    CheckKind.CONTRADICTION: (
        "the frames contradict the filtered image, so their mean is the result",
        "{0}--frames FIRST:END with those that show one scene, or --roi X,Y,WIDTH,HEIGHT of a part that does not move",
    ),
    CheckKind.REPETITION: (
        "the scene repeats every {0:.1f} pixels and moves by {1:.1f}, so parts may have slipped by one repetition",
        "take the mean of the frames if lines are broken that are whole there",
    ),
    CheckKind.FEW_FRAMES: (
        "with {0}, neither the motion nor the noise averages out, and the geometry is known to {1:.1f} pixels only",
        "use at least {2}",
    ),
    CheckKind.GEOMETRY: (
        "lines may be bent, because {1} tell the geometry to {0:.1f} pixels only",
        "use more frames; ignore this if only sharpness matters",
    ),
    CheckKind.AGREEMENT: (
        "the frames do not agree on {0:.0%} of the detail, which is that of their mean",
        "use more frames",
    ),
    CheckKind.MOTION: (
        "motion that the frames do not agree on: registration leaves {0:.0%} of their differences",
        "--frames FIRST:END with the frames during which the scene stays the same",
    ),
    CheckKind.UNSEEN: ("{0} of the image is seen in hardly any frame", "--border crop"),
    CheckKind.NO_BLUR_REMOVED: (
        "no blur is removed, although {0:.2f} pixels should be: the guards against ringing and noise forbid it",
        "--sigma {0:.2f} removes it; ignore this if edges ring then",
    ),
    CheckKind.BLUR_LEFT: (
        "{1:.2f} of {0:.2f} pixels of blur are removed: the guards against ringing and noise forbid more",
        "--sigma {0:.2f} removes all; ignore this if edges ring then",
    ),
    CheckKind.LESS_THAN_MEASURED: (
        "{0:.2f} pixels of blur were measured ({1:.2f} to {2:.2f}), and less or none is removed: whether more would "
        "improve the image is doubtful",
        "--sigma {0:.2f} shows whether it does",
    ),
    CheckKind.BLUR_UNKNOWN: (
        "the width of the blur could not be measured, and none is removed",
        "--sigma 1 removes a usual one",
    ),
    CheckKind.TOO_SHARP: (
        "at the width of {0:.2f} pixels that was given, edges ring or overshoot, or noise is amplified",
        "leave out --sigma, so that the width is measured",
    ),
    CheckKind.DRIFT: (
        "{0} of the image is averaged less, because the result drifted from the input",
        "ignore this where something moves slowly",
    ),
}


def write_check(kind: CheckKind, *figures: float | str) -> Check:
    """Write what is doubtful, with its figures, and what to do about it."""
    text, remedy = _CHECKS[kind]
    return Check(kind, text.format(*figures), remedy.format(*figures))


def share_words(share: float) -> str:
    """Write a share of an image, which is not 0 % where there is one."""
    return "less than 1 %" if 0 < share < 0.01 else f"{100 * share:.0f} %"


def explain_training(train: int, frame_count: int, wanted: int | None) -> Decision:
    """Say which frames the centroid and the flow model are computed from."""
    half = frame_count // 2
    if wanted is not None:
        reason = "asked for"
    elif train == frame_count:
        reason = "the whole clip"
    elif train == half:
        reason = "half of the clip"
    elif train > half:
        reason = "the motion of a short clip is learnt from more than half of it"
    else:
        reason = "half of the clip exceeds the default limit, or the memory"
    return Decision("training", f"first {train} of {frame_count} frames", reason)


def explain_input(saturated: float) -> tuple[Decision, ...]:
    """Report a share of saturated pixels."""
    if saturated <= _REPORTED_SHARE:
        return ()
    reason = f"{saturated:.0%} of the pixels are at full scale: detail is lost there, and edges may ring"
    return (Decision("saturation", "left as it is", reason, CheckKind.SATURATED),)


def explain_motion(flows: FloatArray) -> tuple[Decision, ...]:
    """Report motion, about the shift of the whole frame, that is too large for optical flow.

    ``flows`` (T, H, W, 2).
    """
    about = (flow - np.median(flow[::4, ::4], axis=(0, 1)) for flow in iter_frames(flows))
    squares = sum(float(np.mean(np.square(flow), dtype=np.float64)) for flow in about)
    rms = float(np.sqrt(2 * squares / len(flows)))
    side = min(flows.shape[1:3])
    if rms < _LARGE_MOTION * side:
        return ()
    reason = (
        f"{rms:.1f} pixels about the shift of the whole in an image of {side} pixels a side: optical flow fails in "
        "places and doubles details"
    )
    return (Decision("motion", "taken as measured", reason, CheckKind.LARGE_MOTION),)


def explain_camera(flows: FloatArray) -> tuple[Decision, ...]:
    """Report how far the camera moved, if it did.

    ``flows`` (T, H, W, 2).
    """
    shifts = np.array([np.median(flow[::4, ::4].reshape(-1, 2), axis=0) for flow in iter_frames(flows)])
    largest = float(np.hypot(shifts[:, 0], shifts[:, 1]).max())
    if largest <= DEAD_ZONE:
        return ()
    return (Decision("camera", f"followed over {largest:.1f} pixels", "the largest shift of a whole training frame"),)


def explain_centroid(centroid: Centroid) -> Decision:
    """Say how the centroid was found."""
    sizes = centroid.mean_flow_sizes
    return Decision(
        "centroid",
        f"{counted(sizes.size, 'iteration')}, {'' if centroid.converged else 'not '}converged",
        f"mean flow of {sizes[0]:.2f} pixels in the first iteration, {sizes[-1]:.2f} in the last",
    )


def explain_dynamics(dynamics: FlowDynamics, modelled: bool = False) -> tuple[Decision, ...]:
    """Say which rank the flow model has, how it was adjusted, and whether it changes the image."""
    largest = float(abs(np.linalg.eigvals(dynamics.A)).max(initial=0.0))
    modes = Decision(
        "flow model",
        counted(len(dynamics.A), "state"),
        f"they hold {100 * dynamics.energy_share:.1f} % of the energy of the motion; the largest eigenvalue is "
        f"{largest:.3f}; frames are registered by {'the flow of the model' if modelled else 'the measured flow'}",
    )
    return modes, *(Decision("flow model", "adjusted", note) for note in dynamics.notes)


def explain_frames(filtered: Filtered, chosen: int | None) -> Decision:
    """Say how many frames the image is made of."""
    count = filtered.shares.size
    mean = 1 / (count if chosen is None else chosen)
    counting = int(np.sum(filtered.shares >= _COUNTS * mean))
    reason = f"weighted by sharpness (β = {filtered.sharpness_weight:.1f}), registration and outliers"
    reason += f"; a frame counts if its weight is at least {_COUNTS:g} times the average"
    largest = f"the largest weight is {filtered.shares.max() / mean:.1f} times the average"
    asked = "" if chosen is None else f"; only the {chosen} sharpest were asked for"
    return Decision("frames", f"{counting} of {count} frames count", f"{reason}; {largest}{asked}")


def explain_geometry(filtered: Filtered, dynamics: FlowDynamics) -> Decision:
    """Say how far the image was moved onto the mean geometry, and how well that is known."""
    moved = float(np.sqrt(2 * np.mean(np.square(recentring_flow(filtered.mean_flow)), dtype=np.float64)))
    error = mean_flow_error(dynamics, int(np.isfinite(filtered.sharpness).sum()))
    reason = f"onto the mean geometry of all frames, which is known to {error:.2f} pixels (standard error)"
    return Decision("geometry", f"moved by {moved:.2f} pixels", reason)


def explain_structure(reading: StructureReading) -> tuple[Decision, ...]:
    """Say why the mean of the frames is the result, or why no blur is removed."""
    if reading.unseen > reading.most_unseen and not reading.unexplained_change:
        reason = (
            f"{reading.unseen:.1%} of the edges of the filtered image occur in fewer than half of the frames (bound "
            f"{reading.most_unseen:.1%}, as registration leaves {reading.left:.0%} of what frames differ by)"
        )
        return (Decision("structure", "the mean of the frames is the result", reason),)
    if reading.changes:
        reason = (
            f"registration leaves {reading.left:.0%} of the differences of the frames (bound {LEFT:.0%}), and "
            f"{reading.lasting:.0%} of that lasts for half of the clip (bound {LASTING:.0%}): the scene itself changes"
        )
        if reading.explained:
            return (Decision("changing scene", "no blur is removed", reason),)
        return (Decision("structure", "the mean of the frames is the result", reason),)
    return ()


def explain_few_frames(count: int, fewest: int) -> Decision:
    """Say that so few frames are not deblurred."""
    reason = (
        f"{counted(count, 'frame')} do not tell where in the image the scene lies, and sharp edges in wrong places are "
        f"worse than blurred ones; take {fewest} frames or more, or set the width to remove (--sigma)"
    )
    return Decision("few frames", "no blur is removed", reason)


def explain_seeing(seeing: Seeing) -> tuple[Decision, ...]:
    """Compare the displacement by flow with that by blur, and pass on the remarks."""
    remarks = tuple(Decision("displacement", "uncertain", remark) for remark in seeing.remarks)
    by_flow, by_blur = seeing.displacement_by_flow, seeing.displacement_by_blur
    if remarks or by_flow is None or by_blur is None:
        return remarks
    if not by_flow.overlaps(by_blur):
        reason = f"variance {by_flow.value:.2f} squared pixels; no more than {LARGEST_BLUR:g} can be told by blur"
        return (Decision("displacement", "measured by flow alone", reason),)
    bound = "at least " if math.isinf(by_blur.high) else ""
    reason = (
        f"variance {by_flow.value:.2f} squared pixels by flow and {bound}{by_blur.value:.2f} by blur: "
        "their 95 % intervals overlap"
    )
    return (Decision("displacement", "flow and blur agree", reason),)


def interval_words(estimate: Estimate, spec: str = ".2f") -> str:
    """Write an estimate and its 95 % interval, which may have no upper end."""
    bounded = math.isfinite(estimate.high)
    ends = f"{estimate.low:{spec}} to {estimate.high:{spec}}" if bounded else f"at least {estimate.low:{spec}}"
    return f"{estimate.value:{spec}} ({ends})"


def explain_border(least_seen: float, crop: Rectangle | None) -> Decision:
    """Say whether the border was kept or cropped."""
    choice = "kept" if crop is None else f"cropped to {crop[2]}×{crop[3]} pixels from ({crop[0]}, {crop[1]})"
    return Decision("border", choice, f"every pixel is visible in at least {least_seen:.0%} of the training frames")
