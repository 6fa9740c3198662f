"""Background subtraction: moving objects are replaced by the background that most frames show behind them.

Moving objects are cars and people, which are large, and snow and rain, which are small.

Symbols
-------
m, v : median of the frames at every place of the scene; squared median deviation, scaled to a variance
r : reach of the turbulence, pixels: three standard deviations of the displacement, and at least 4
d : squared deviation of a frame from m, averaged in a Gaussian window
e : distance of a frame from the range that m has nearby

Turbulence bends edges, so v is large beside edges.  A pixel belongs to a large object where d exceeds the largest v
within r several times, over an area that holds a disc of 15 pixels.  Flakes and streaks are smaller, but bending never
leaves the range of the scene within r, so they are where e² exceeds v several times.  Small objects count if they cover
more of the frames than turbulence explains; fewer are left to the alternating filter
(:mod:`turbrestore.filtering.frame_noise`).  Moving objects are replaced by the mean of the frames that show the
background there.  The mean is less sharp than a frame and weighs little in the filter, but the flow no longer follows
the objects.

The median is the background where that is seen in more than half of the frames.  While the camera moves, frames are
compared at the place of the scene that they show, to whole pixels.  What no frame shows free of objects stays as it is.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..core.decision import Decision
from ..core.robust import MEDIAN_DEVIATION, MEDIAN_OF, MEDIAN_ROWS, spread
from ..io.source import FrameSource, Window
from ..registration.camera.global_shift import LONGEST_SIDE, known_shifts
from ..registration.flow import MIN_SIDE
from ..registration.flow_methods.opencv_flow import DisParams, dis_solver
from ..runtime.scratch import iter_frames
from .correction import Correction
from .placement import Placement, camera_moves, reduce_frames, relative_window
from .survey import FEWEST, Survey

# d counts from the first times the sum of v and the square of the second; windows of d and of v, pixels; all chosen.
_EXCEEDS, _LEAST_DEVIATION = 8.0, 0.01
_WINDOW, _VARIANCE_WINDOW = 1.5, 3.0
# Least r, chosen, and r in standard deviations of the displacement, within which 99.7 % of normal numbers are; the
# scene nearby, for e, ends a pixel before r.
_REACH, _REACHED = 4, 3.0
# Radii of closed gaps, of the discs that must fit, and of the surroundings that are replaced too, pixels; all chosen.
_GAP, _DISC, _AROUND = 2, 7, 3
# Standard deviation of the transition between frame and background, pixels, chosen.
_FADE = 1.5
# The same for small objects: e² counts from the first times the sum of a quarter of v, for e is measured in a window,
# and the square of the least deviation, and beside such pixels from the third times that; windows of e and of v, and
# the transition, pixels; all chosen.
_SMALL_EXCEEDS, _SMALL_SHARE, _SLIGHTLY = 9.0, 0.25, 0.2
_SMALL_WINDOW, _SMALL_VARIANCE_WINDOW, _SMALL_FADE = 0.8, 1.5, 0.7
# Least share of the frames that small objects cover (strong turbulence over fine detail reaches two thirds of it), and
# least share of them that is brighter than the scene nearby, or darker, chosen.
_LEAST_SMALL, _ONE_SIDED = 0.06, 0.75
# Least and largest share of the frames that objects cover, largest part of a frame that is replaced, and fewest frames
# that show a pixel of the background; all chosen.
_LEAST, _LARGEST, _LARGEST_PART, _SEEN = 0.0025, 0.35, 0.5, 3
# Least share of all edges that the background has, chosen.
_OWN_EDGES = 0.5
# Most pixels of what a moving camera shows, in frames, and share of the variance that following may leave; both chosen.
_LARGEST_SCENE, _FOLLOWED = 4.0, 0.5


@dataclass(frozen=True, eq=False)
class Background:
    """The scene behind moving objects, and where frames show it."""

    image: FloatArray  # (H', W') or (H', W', 3)
    known: NDArray[np.uint8]  # (H', W'): 1 where enough frames show the background, else 0
    # Weight of the background in a frame with moving objects, by the number of the frame in the file: a PNG of shape
    # (H, W), 255 where the background replaces the frame.
    weights: dict[int, NDArray[np.uint8]]
    placement: Placement  # where frames lie in the image
    window: Window  # rows and columns of the file that the frames are

    def shown(self, number: int, values: FloatArray, window: Window) -> FloatArray:
        """Replace the moving objects in a frame, or in a window of it.

        ``values`` (h, w) or (h, w, 3).
        """
        if number not in self.weights:
            return values
        place, part = self.placement.place(number), relative_window(self.window, window)
        stored = np.asarray(cv2.imdecode(self.weights[number], cv2.IMREAD_GRAYSCALE))[part]
        weight = stored.astype(np.float32) / np.float32(255) * self.known[place][part]
        weight = weight if values.ndim == 2 else weight[..., None]
        return values + weight * (self.image[place][part] - values)


@dataclass(frozen=True, eq=False)
class _Model:
    """The background as most frames show it, and thresholds that objects exceed; maps have the shape (H', W')."""

    median: FloatArray  # m
    deviation: FloatArray  # d above which a pixel belongs to a large object
    # Range of m nearby.
    low: FloatArray
    high: FloatArray
    excess: FloatArray | None  # e² above which it belongs to a small one; None if there are no small objects
    spread: float  # mean of v
    reach: int  # r

    def at(self, place: Window) -> _Model:
        parts = (self.median[place], self.deviation[place], self.low[place], self.high[place])
        return _Model(*parts, None if self.excess is None else self.excess[place], self.spread, self.reach)

    def without_small(self) -> _Model:
        return dataclasses.replace(self, excess=None)


def find_moving_objects(survey: Survey) -> Correction | None:
    """Find moving objects, which are replaced by the background.

    If there are any, all frames are read once more, because each shows another part of the background.
    """
    source = survey.clip
    found = _model_background(survey) if len(source) >= FEWEST else None
    if found is None:
        return None
    model, placement = found
    background, share, touched = _average_background(source, model, placement)
    reason = f"they cover {share:.1%} of a frame on average, and {touched:.0%} of the scene at some time"
    if model.excess is not None:
        reason += "; small ones such as snow or rain are among them"
    decision = Decision("moving objects", "replaced by the background", reason)
    return Correction((decision,), background.shown, replaces_objects=True)


def _model_background(survey: Survey) -> tuple[_Model, Placement] | None:
    """Model the background of a clip, and place its frames in it; None if there are no moving objects."""
    source, places = survey.clip, spread(len(survey.numbers), MEDIAN_OF)
    numbers = tuple(survey.numbers[place] for place in places)
    stack = np.empty((len(places), *source.shape[1:3]), np.uint8)
    sample = map(source.intensities, numbers, iter_frames(map(survey.pixels.__getitem__, places)))
    for plane, frame in zip(stack, sample, strict=True):
        np.rint(255 * np.clip(luminance(frame), 0, 1), out=plane, casting="unsafe")
    still = Placement(dict.fromkeys(source.numbers, (0, 0)), (source.shape[1], source.shape[2]))
    model = _median_model(stack, numbers, still)
    found = _fitted(stack, numbers, model, still)
    reach = _REACH if found is None else max(_REACH, math.ceil(_REACHED * _displacement(stack)))
    if reach > _REACH:
        found = _fitted(stack, numbers, _median_model(stack, numbers, still, reach=reach), still)
    if found is not None:
        return found, still
    if not camera_moves(_shifts(_reduced(map(_grey, stack), stack.shape), stack.shape)):
        return None
    # The scene moves through the frames too if the camera does; what moves as most of the frame does is the scene.
    small = luminance(survey.small)
    moving = Placement.by(_shifts(_reduced(small, small.shape), source.shape), source.numbers, still.size)
    if np.prod(moving.shape) > _LARGEST_SCENE * np.prod(moving.size):
        return None
    followed = _median_model(stack, numbers, moving, reach=reach)
    if followed.spread >= _FOLLOWED * model.spread:
        return None
    found = _fitted(stack, numbers, followed, moving)
    return None if found is None else (found, moving)


def _reduced(frames: Iterable[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Reduce and smooth T frames of (H, W) pixels, ``shape`` beginning with (T, H, W), to measure their shifts."""
    return reduce_frames(frames, shape[:3], LONGEST_SIDE, MIN_SIDE, 1.0)


def _shifts(small: FloatArray, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Shifts (dx, dy) of reduced frames, in pixels of the frames, (T, 2)."""
    return known_shifts(small)[0] * (shape[2] / small.shape[2], shape[1] / small.shape[1])


def _grey(plane: NDArray[np.uint8]) -> FloatArray:
    return plane.astype(np.float32) / np.float32(255)


def _displacement(stack: NDArray[np.uint8]) -> float:
    """Return the standard deviation of a component of the displacement, pixels, by flows between distant frames.

    Moving objects cover less than half of the frames, so the median length of a flow is that of the scene.
    """
    half, lengths = len(stack) // 2, []
    for early, late in zip(stack[:half], stack[-half:], strict=True):
        (flow,) = dis_solver(DisParams(), early)(late[None], [None], True)
        lengths.append(np.hypot(*np.moveaxis(flow - np.median(flow, axis=(0, 1)), -1, 0)))
    # Both frames are displaced, by normal numbers.
    return float(np.median(lengths) / np.sqrt(2 * 2 * np.log(2)))


def _fitted(stack: NDArray[np.uint8], numbers: Sequence[int], model: _Model, placement: Placement) -> _Model | None:
    """Fit a model to the moving objects of a sample; None if there are none, or so many that they are the scene."""
    parts = [model.at(placement.place(number)) for number in numbers]
    large = [_foreground(_grey(plane), part.without_small()) for plane, part in zip(stack, parts, strict=True)]
    if not _is_precipitation(stack, large, parts):
        model, parts, masks = model.without_small(), [part.without_small() for part in parts], large
    else:
        masks = [_foreground(_grey(plane), part) for plane, part in zip(stack, parts, strict=True)]
        # Rain widens the spread of the frames, under which some of it hides.
        model = _median_model(stack, numbers, placement, masks, model.reach)
        parts = [model.at(placement.place(number)) for number in numbers]
        masks = [_foreground(_grey(plane), part) for plane, part in zip(stack, parts, strict=True)]
    touched, share = np.mean([(mask > 0).mean() for mask in masks]), np.mean([mask.mean() / 255 for mask in masks])
    if touched < _LEAST or share > _LARGEST:
        return None
    shifts = np.array([placement.shifts[number] for number in numbers], np.float64)
    return model if _is_scene(stack, masks, parts, shifts) else None


def _is_precipitation(stack: NDArray[np.uint8], large: list[NDArray[np.uint8]], parts: list[_Model]) -> bool:
    """Whether more of the frames is beyond the range of the scene, on one side of it, than turbulence explains."""
    shares, brighter = [], []
    for plane, mask, part in zip(stack, large, parts, strict=True):
        grey = _grey(plane)
        # The edges of large objects are no small ones.
        small = (_small_objects(grey, part) > 0) & (cv2.dilate(mask, _disc(2 * _DISC)) == 0)
        shares.append(small.mean())
        brighter.append((small & (grey > part.median)).mean())
    share = float(np.mean(shares))
    return share >= _LEAST_SMALL and abs(float(np.mean(brighter)) / share - 0.5) >= _ONE_SIDED - 0.5


def _is_scene(
    stack: NDArray[np.uint8], masks: list[NDArray[np.uint8]], parts: list[_Model], shifts: NDArray[np.float64]
) -> bool:
    """Whether the background is a scene with edges of its own, which does not move against the given shifts.

    A planet that drifts over a black sky is no moving object, because without it there is no scene.
    """
    seen = zip(stack, masks, parts, strict=True)
    left = _reduced((np.where(mask > 0, part.median, _grey(plane)) for plane, mask, part in seen), stack.shape)
    both = _reduced(map(_grey, stack), stack.shape), left
    edges = [np.hypot(*np.gradient(some, axis=(1, 2))).sum() for some in both]
    away = _shifts(left, stack.shape) - shifts
    # Snow has more edges than the scene.
    own = parts[0].excess is not None or bool(edges[1] > _OWN_EDGES * edges[0])
    return own and not camera_moves(away - away.mean(axis=0))


def _median_model(
    stack: NDArray[np.uint8],
    numbers: Sequence[int],
    placement: Placement,
    masks: Sequence[NDArray[np.uint8]] | None = None,
    reach: int = _REACH,
) -> _Model:
    """Take the median over the frames at every place of the scene, and the thresholds that moving objects exceed.

    Pixels in ``masks``, where objects have been found, are left out unless that leaves too few frames.
    """
    shape, places = placement.shape, [placement.place(number) for number in numbers]
    median, variance, seen = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    for top in range(0, shape[0], MEDIAN_ROWS):
        rows = slice(top, min(top + MEDIAN_ROWS, shape[0]))
        values = np.full((len(stack), rows.stop - top, shape[1]), np.nan, np.float32)
        hidden = np.zeros(values.shape, bool)
        for index, (frame, (down, across)) in enumerate(zip(stack, places, strict=True)):
            first, last = max(down.start, top), min(down.stop, rows.stop)
            if first < last:
                shown = np.s_[index, first - top : last - top, across]
                part = np.s_[first - down.start : last - down.start]
                values[shown] = _grey(frame[part])
                hidden[shown] = False if masks is None else masks[index][part] > 0
        few = (np.isfinite(values) & ~hidden).sum(axis=0) < FEWEST
        values[hidden & ~few] = np.nan
        seen[rows] = np.isfinite(values).sum(axis=0) >= FEWEST
        median[rows] = _median(values)
        variance[rows] = (MEDIAN_DEVIATION * _median(np.abs(values - median[rows]))) ** 2
    around = np.ones((2 * reach + 1,) * 2, np.uint8)
    least, known = np.float32(_LEAST_DEVIATION**2), cv2.erode(seen, around) > 0
    deviation = cv2.dilate(cv2.GaussianBlur(variance, (0, 0), _VARIANCE_WINDOW), around) + least
    excess = np.float32(_SMALL_SHARE) * cv2.GaussianBlur(variance, (0, 0), _SMALL_VARIANCE_WINDOW) + least
    deviation, excess = (
        np.where(known, some, np.float32(np.inf)) for some in (_EXCEEDS * deviation, _SMALL_EXCEEDS * excess)
    )
    smooth, nearby = cv2.GaussianBlur(median, (0, 0), _SMALL_WINDOW), _disc(reach - 1)
    spread = float(variance[seen > 0].mean()) if seen.any() else np.inf
    low, high = cv2.erode(smooth, nearby), cv2.dilate(smooth, nearby)
    return _Model(median, deviation, low, high, excess, spread, reach)


def _median(values: FloatArray) -> FloatArray:
    """Median over the first axis of what is not NaN; 0 where all is."""
    # Values side by side are sorted in a fraction of the time.
    ordered = np.sort(np.ascontiguousarray(np.moveaxis(values, 0, -1)), axis=-1)
    count = np.isfinite(ordered).sum(axis=-1)
    middle = (np.maximum(count - 1, 0) // 2, np.maximum(count, 1) // 2)
    places = (np.minimum(index, len(values) - 1)[..., None] for index in middle)
    low, high = (np.take_along_axis(ordered, place, -1)[..., 0] for place in places)
    return np.nan_to_num((low + high) / 2)


def _foreground(grey: FloatArray, model: _Model) -> NDArray[np.uint8]:
    """Mark moving objects by 255, fading; a frame that is mostly marked shows another scene, so nothing is marked."""
    mask = (cv2.GaussianBlur((grey - model.median) ** 2, (0, 0), _WINDOW) > model.deviation).view(np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, _disc(_GAP))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(_DISC))
    weight = _faded(mask, _AROUND, _FADE)
    if model.excess is not None:
        weight = np.maximum(weight, _faded(_small_objects(grey, model), 1, _SMALL_FADE))
    weight = np.rint(255 * weight).astype(np.uint8)
    return np.asarray(weight if weight.mean() <= 255 * _LARGEST_PART else np.zeros_like(weight), np.uint8)


def _small_objects(grey: FloatArray, model: _Model) -> NDArray[np.uint8]:
    """Mark pixels clearly beyond the range of the scene nearby, and those beside them that are slightly beyond it."""
    assert model.excess is not None
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMALL_WINDOW)
    beyond = np.maximum(np.maximum(smooth - model.high, model.low - smooth), 0) ** 2
    _, labels = cv2.connectedComponents((beyond > _SLIGHTLY * model.excess).view(np.uint8), connectivity=8)
    clear = np.zeros(int(labels.max()) + 1, np.uint8)
    clear[labels[beyond > model.excess]] = 1
    clear[0] = 0
    return np.asarray(clear[labels], np.uint8)


def _faded(mask: NDArray[np.uint8], around: int, fade: float) -> FloatArray:
    """Widen a mask, and fade it outside of what it was."""
    wide = cv2.dilate(mask, _disc(around)).astype(np.float32)
    return np.maximum(cv2.GaussianBlur(wide, (0, 0), fade) * wide, mask.astype(np.float32))


def _average_background(source: FrameSource, model: _Model, placement: Placement) -> tuple[Background, float, float]:
    """Average the frames where they show the background.

    Returns the shares of the frames, and of the scene at some time, that moving objects cover as well.
    """
    shape = placement.shape
    total, count, most = np.zeros((*shape, *source.shape[3:])), np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    weights: dict[int, NDArray[np.uint8]] = {}
    for number, frame in zip(source.numbers, source, strict=True):
        place = placement.place(number)
        weight = _foreground(luminance(frame), model.at(place))
        if weight.any():
            weights[number] = np.asarray(cv2.imencode(".png", weight)[1], np.uint8)
        free = weight == 0
        total[place][free] += frame[free]
        count[place] += free
        most[place] += 1
    seen = np.maximum(count, 1) if total.ndim == 2 else np.maximum(count, 1)[..., None]
    known = (count >= _SEEN).astype(np.uint8)
    background = Background((total / seen).astype(np.float32), known, weights, placement, source.window)
    return background, 1 - float(count.sum() / most.sum()), float((count < most).mean())


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2), np.uint8)
