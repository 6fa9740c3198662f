"""What moves through the scene: cars and people, snow and rain, behind which most frames show the background.

Symbols
-------
m, v : median of the frames at every place of the scene; squared median deviation, scaled to a variance
r : reach of the turbulence, pixels: three standard deviations of the displacement, and at least 4
d : squared deviation of a frame from m, averaged in a Gaussian window
e : distance of a frame from the range that m has nearby

Turbulence bends edges, so v is large beside edges.  A pixel belongs to what passes where d exceeds the largest v within
r several times, over an area that holds a disc of 15 pixels.  Flakes and streaks are smaller, but bending never leaves
the range of the scene within r, so they are where e² exceeds v several times; this counts if it is so in more of the
frames than turbulence explains, and what is left, the alternating filter leaves out
(:mod:`turbrestore.filtering.frame_noise`).  Such pixels are replaced by the mean of the frames that show the background
there.  The mean is less sharp than a frame and weighs little in the filter, but flow is no longer pulled along by what
passes.

The median is the background where that is seen in more than half of the frames.  While the camera moves, frames are
compared at the place of the scene that they show, to whole pixels.  What no frame shows free stays as it is.
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
from ..io.source import FrameSource, Window
from ..registration.camera.global_shift import known_shifts
from ..registration.opencv_flow import DisParams, dis_solver
from ..runtime.scratch import iter_frames
from .placement import Placement, reduce_frames, relative_window
from .survey import Survey, spread

# Frames of which the median is taken, the fewest that tell what passes, and rows that it is taken of at once.
_SAMPLES, _FEWEST, _ROWS = 25, 9, 64
_MEDIAN_DEVIATION = 1.4826
# d counts from the first times the sum of v and the square of the second; windows of d and of v, pixels.
_EXCEEDS, _LEAST_DEVIATION = 8.0, 0.01
_WINDOW, _USUAL_WINDOW = 1.5, 3.0
# Least r, and r in standard deviations of the displacement; the scene nearby, for e, ends a pixel before r.
_REACH, _REACHED = 4, 3.0
# Radii of the gaps that are closed, of the discs that must fit, and of the surroundings that are replaced too, pixels.
_GAP, _DISC, _AROUND = 2, 7, 3
# Standard deviation of the transition between frame and background, pixels.
_FADE = 1.5
# The same for what is small: e² counts from the first times the sum of a quarter of v, for e is measured in a window,
# and the square of the least deviation; windows of e and of v, and the transition, pixels.
_SMALL_EXCEEDS, _SMALL_SHARE, _SLIGHTLY = 9.0, 0.25, 0.2
_SMALL_WINDOW, _SMALL_USUAL_WINDOW, _SMALL_FADE = 0.8, 1.5, 0.7
# Least share of the frames that is small, which strong turbulence over fine detail reaches by two thirds, and that of
# what is brighter than the scene nearby, or darker, among it.
_LEAST_SMALL, _ONE_SIDED = 0.06, 0.75
# Least and largest share of the frames that passes, largest part of a frame that is replaced, and fewest frames that
# show a pixel of the background.
_LEAST, _LARGEST, _LARGEST_PART, _SEEN = 0.0025, 0.35, 0.5, 3
# Root mean square of the shifts from which the camera moves, pixels; least share of all edges that the background has.
_CAMERA, _OWN_EDGES = 3.0, 0.5
# Most pixels of what a moving camera shows, in frames, and the share of the variance that following it may leave.
_LARGEST_SCENE, _FOLLOWED = 4.0, 0.5
# Longest side of the reduced frames whose shifts are measured.
_REDUCED_SIDE = 192


@dataclass(frozen=True, eq=False)
class Background:
    """The scene behind what passes, and where something does."""

    image: FloatArray  # (H', W') or (H', W', 3)
    known: NDArray[np.uint8]  # (H', W'): 1 where enough frames show the background, else 0
    # Share of the background in a frame from which something is taken, by the number of the frame in the file: a PNG of
    # shape (H, W) with 255 for the background alone.
    weights: dict[int, NDArray[np.uint8]]
    placement: Placement  # where frames lie in the image
    window: Window  # rows and columns of the file that the frames are

    def shown(self, number: int, values: FloatArray, window: Window) -> FloatArray:
        """Replace what passes in a frame, or in a window of it.

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
class _Usual:
    """The scene as most frames show it, and what nothing exceeds but what passes; maps have the shape (H', W')."""

    median: FloatArray  # m
    deviation: FloatArray  # d above which a pixel belongs to what passes
    # Range of m nearby.
    low: FloatArray
    high: FloatArray
    excess: FloatArray | None  # e² above which it does; None if nothing small passes
    spread: float  # mean of v
    reach: int  # r

    def at(self, place: Window) -> _Usual:
        parts = (self.median[place], self.deviation[place], self.low[place], self.high[place])
        return _Usual(*parts, None if self.excess is None else self.excess[place], self.spread, self.reach)

    def of_large(self) -> _Usual:
        return dataclasses.replace(self, excess=None)


def without_passers(survey: Survey) -> tuple[FrameSource, tuple[Decision, ...]]:
    """Replace what passes by the background; a clip in which nothing does is returned as it is.

    Where something does, all frames are read once more, because each shows the background elsewhere.
    """
    source = survey.clip
    usual = _usual_of(survey) if len(source) >= _FEWEST else None
    if usual is None:
        return source, ()
    background, share, touched = _background(source, *usual)
    reason = f"they cover {share:.1%} of the frames, and {touched:.0%} of the scene at some time"
    if usual[0].excess is not None:
        reason += "; small ones such as snow or rain are among them"
    decision = Decision("passers", "replaced by the background", reason)
    return source.adjusted(background.shown), (decision,)


def _usual_of(survey: Survey) -> tuple[_Usual, Placement] | None:
    """Find what frames usually show, and where they lie; None where nothing passes."""
    source, places = survey.clip, spread(len(survey.numbers), _SAMPLES)
    numbers = tuple(survey.numbers[place] for place in places)
    stack = np.empty((len(places), *source.shape[1:3]), np.uint8)
    sample = map(source.intensities, numbers, iter_frames(map(survey.pixels.__getitem__, places)))
    for plane, frame in zip(stack, sample, strict=True):
        np.rint(255 * np.clip(luminance(frame), 0, 1), out=plane, casting="unsafe")
    still = Placement(dict.fromkeys(source.numbers, (0, 0)), (source.shape[1], source.shape[2]))
    usual = _usual(stack, numbers, still)
    found = _passed_by(stack, numbers, usual, still)
    reach = _REACH if found is None else max(_REACH, math.ceil(_REACHED * _displacement(stack)))
    if reach > _REACH:
        found = _passed_by(stack, numbers, _usual(stack, numbers, still, reach=reach), still)
    if found is not None:
        return found, still
    if not _moves(_shifts(_reduced(map(_grey, stack), stack.shape), stack.shape)):
        return None
    # For a camera that moves the scene passes too; what moves as most of the frame does is the scene.
    small = luminance(survey.small)
    moving = Placement.by(_shifts(_reduced(small, small.shape), source.shape), source.numbers, still.size)
    if np.prod(moving.shape) > _LARGEST_SCENE * np.prod(moving.size):
        return None
    followed = _usual(stack, numbers, moving, reach=reach)
    found = _passed_by(stack, numbers, followed, moving) if followed.spread < _FOLLOWED * usual.spread else None
    return None if found is None else (found, moving)


def _moves(shifts: NDArray[np.float64]) -> bool:
    return float(np.sqrt(np.mean(np.sum(shifts**2, axis=1)))) >= _CAMERA


def _reduced(frames: Iterable[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Reduce and smooth T frames of (H, W) pixels, ``shape`` beginning with (T, H, W), to measure their shifts."""
    return reduce_frames(frames, shape[:3], _REDUCED_SIDE, 16, 1.0)


def _shifts(small: FloatArray, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Shifts (dx, dy) of reduced frames, in pixels of the frames, (T, 2)."""
    return known_shifts(small)[0] * (shape[2] / small.shape[2], shape[1] / small.shape[1])


def _grey(plane: NDArray[np.uint8]) -> FloatArray:
    return plane.astype(np.float32) / np.float32(255)


def _displacement(stack: NDArray[np.uint8]) -> float:
    """Return the standard deviation of a component of the displacement, pixels, by flows between distant frames.

    What passes covers less than half of the frames, so the median length of a flow is that of the scene.
    """
    half, lengths = len(stack) // 2, []
    for early, late in zip(stack[:half], stack[-half:], strict=True):
        (flow,) = dis_solver(DisParams(), early)(late[None], [None], True)
        lengths.append(np.hypot(*np.moveaxis(flow - np.median(flow, axis=(0, 1)), -1, 0)))
    # Both frames are displaced, by normal numbers.
    return float(np.median(lengths) / np.sqrt(2 * 2 * np.log(2)))


def _passed_by(stack: NDArray[np.uint8], numbers: Sequence[int], usual: _Usual, placement: Placement) -> _Usual | None:
    """Return what tells what passes in a sample; None where nothing does, or so much that it is the scene."""
    parts = [usual.at(placement.place(number)) for number in numbers]
    large = [_passing(_grey(plane), part.of_large()) for plane, part in zip(stack, parts, strict=True)]
    masks = [_passing(_grey(plane), part) for plane, part in zip(stack, parts, strict=True)]
    if not _is_precipitation(stack, large, parts):
        usual, parts, masks = usual.of_large(), [part.of_large() for part in parts], large
    else:
        # Rain widens the spread of the frames, under which some of it hides.
        usual = _usual(stack, numbers, placement, masks, usual.reach)
        parts = [usual.at(placement.place(number)) for number in numbers]
        masks = [_passing(_grey(plane), part) for plane, part in zip(stack, parts, strict=True)]
    touched, share = np.mean([(mask > 0).mean() for mask in masks]), np.mean([mask.mean() / 255 for mask in masks])
    if touched < _LEAST or share > _LARGEST:
        return None
    shifts = np.array([placement.shifts[number] for number in numbers], np.float64)
    return usual if _stands(stack, masks, parts, shifts) else None


def _is_precipitation(stack: NDArray[np.uint8], large: list[NDArray[np.uint8]], parts: list[_Usual]) -> bool:
    """Whether more of the frames is beyond the range of the scene, on one side of it, than turbulence explains."""
    shares, brighter = [], []
    for plane, mask, part in zip(stack, large, parts, strict=True):
        grey = _grey(plane)
        # The edges of what is large are not what is small.
        small = (_small(grey, part) > 0) & (cv2.dilate(mask, _disc(2 * _DISC)) == 0)
        shares.append(small.mean())
        brighter.append((small & (grey > part.median)).mean())
    share = float(np.mean(shares))
    return share >= _LEAST_SMALL and abs(float(np.mean(brighter)) / share - 0.5) >= _ONE_SIDED - 0.5


def _stands(
    stack: NDArray[np.uint8], masks: list[NDArray[np.uint8]], parts: list[_Usual], shifts: NDArray[np.float64]
) -> bool:
    """Whether what is left without the passers is a scene, with edges of its own, that lies where it is taken to lie.

    A planet that drifts over a black sky passes through nothing.
    """
    seen = zip(stack, masks, parts, strict=True)
    left = _reduced((np.where(mask > 0, part.median, _grey(plane)) for plane, mask, part in seen), stack.shape)
    both = _reduced(map(_grey, stack), stack.shape), left
    edges = [np.hypot(*np.gradient(some, axis=(1, 2))).sum() for some in both]
    away = _shifts(left, stack.shape) - shifts
    # Snow has more edges than the scene.
    own = parts[0].excess is not None or bool(edges[1] > _OWN_EDGES * edges[0])
    return own and not _moves(away - away.mean(axis=0))


def _usual(
    stack: NDArray[np.uint8],
    numbers: Sequence[int],
    placement: Placement,
    masks: Sequence[NDArray[np.uint8]] | None = None,
    reach: int = _REACH,
) -> _Usual:
    """Median over the frames at every place of the scene, and the values that are not exceeded where nothing passes.

    What is known to pass does not count, but does where that leaves too few frames.
    """
    shape, places = placement.shape, [placement.place(number) for number in numbers]
    median, variance, seen = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    for top in range(0, shape[0], _ROWS):
        rows = slice(top, min(top + _ROWS, shape[0]))
        values = np.full((len(stack), rows.stop - top, shape[1]), np.nan, np.float32)
        hidden = np.zeros(values.shape, bool)
        for index, (frame, (down, across)) in enumerate(zip(stack, places, strict=True)):
            first, last = max(down.start, top), min(down.stop, rows.stop)
            if first < last:
                shown, part = (
                    np.s_[index, first - top : last - top, across],
                    np.s_[first - down.start : last - down.start],
                )
                values[shown] = _grey(frame[part])
                hidden[shown] = False if masks is None else masks[index][part] > 0
        few = (np.isfinite(values) & ~hidden).sum(axis=0) < _FEWEST
        values[hidden & ~few] = np.nan
        seen[rows] = np.isfinite(values).sum(axis=0) >= _FEWEST
        median[rows] = _median(values)
        variance[rows] = (_MEDIAN_DEVIATION * _median(np.abs(values - median[rows]))) ** 2
    around = np.ones((2 * reach + 1,) * 2, np.uint8)
    least, known = np.float32(_LEAST_DEVIATION**2), cv2.erode(seen, around) > 0
    deviation = cv2.dilate(cv2.GaussianBlur(variance, (0, 0), _USUAL_WINDOW), around) + least
    excess = np.float32(_SMALL_SHARE) * cv2.GaussianBlur(variance, (0, 0), _SMALL_USUAL_WINDOW) + least
    deviation, excess = (
        np.where(known, some, np.float32(np.inf)) for some in (_EXCEEDS * deviation, _SMALL_EXCEEDS * excess)
    )
    smooth, nearby = cv2.GaussianBlur(median, (0, 0), _SMALL_WINDOW), _disc(reach - 1)
    spread = float(variance[seen > 0].mean()) if seen.any() else np.inf
    return _Usual(median, deviation, cv2.erode(smooth, nearby), cv2.dilate(smooth, nearby), excess, spread, reach)


def _median(values: FloatArray) -> FloatArray:
    """Median over the first axis of what is not NaN; 0 where all is."""
    # Values side by side are sorted in a fraction of the time.
    ordered = np.sort(np.ascontiguousarray(np.moveaxis(values, 0, -1)), axis=-1)
    count = np.isfinite(ordered).sum(axis=-1)
    middle = (np.maximum(count - 1, 0) // 2, np.maximum(count, 1) // 2)
    places = (np.minimum(index, len(values) - 1)[..., None] for index in middle)
    low, high = (np.take_along_axis(ordered, place, -1)[..., 0] for place in places)
    return np.nan_to_num((low + high) / 2)


def _passing(grey: FloatArray, usual: _Usual) -> NDArray[np.uint8]:
    """Mark what passes by 255, fading; nothing where it would be most of the frame, which then shows something else."""
    mask = (cv2.GaussianBlur((grey - usual.median) ** 2, (0, 0), _WINDOW) > usual.deviation).view(np.uint8)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, _disc(_GAP))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, _disc(_DISC))
    weight = _faded(mask, _AROUND, _FADE)
    if usual.excess is not None:
        weight = np.maximum(weight, _faded(_small(grey, usual), 1, _SMALL_FADE))
    weight = np.rint(255 * weight).astype(np.uint8)
    return np.asarray(weight if weight.mean() <= 255 * _LARGEST_PART else np.zeros_like(weight), np.uint8)


def _small(grey: FloatArray, usual: _Usual) -> NDArray[np.uint8]:
    """Mark what is clearly beyond the range of the scene nearby, and what is slightly so and belongs to it."""
    assert usual.excess is not None
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMALL_WINDOW)
    beyond = np.maximum(np.maximum(smooth - usual.high, usual.low - smooth), 0) ** 2
    _, labels = cv2.connectedComponents((beyond > _SLIGHTLY * usual.excess).view(np.uint8), connectivity=8)
    clear = np.zeros(int(labels.max()) + 1, np.uint8)
    clear[labels[beyond > usual.excess]] = 1
    clear[0] = 0
    return np.asarray(clear[labels], np.uint8)


def _faded(mask: NDArray[np.uint8], around: int, fade: float) -> FloatArray:
    """Widen a mask, and fade it outside of what it was."""
    wide = cv2.dilate(mask, _disc(around)).astype(np.float32)
    return np.maximum(cv2.GaussianBlur(wide, (0, 0), fade) * wide, mask.astype(np.float32))


def _background(source: FrameSource, usual: _Usual, placement: Placement) -> tuple[Background, float, float]:
    """Average the frames where nothing passes; the share of the frames and that of the scene where something does."""
    shape = placement.shape
    total, count, most = np.zeros((*shape, *source.shape[3:])), np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    weights: dict[int, NDArray[np.uint8]] = {}
    for number, frame in zip(source.numbers, source, strict=True):
        place = placement.place(number)
        weight = _passing(luminance(frame), usual.at(place))
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
