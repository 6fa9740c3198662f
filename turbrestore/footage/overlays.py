"""Static overlays, which stay in place while the scene moves: a field stop, a reticle, a clock, bars, titles.

Symbols
-------
mean, deviation : of the frames over time, at every pixel; where an edge of the mean moves by s pixels, the deviation is
    about s times the gradient of the mean
s : shift of the scene in a frame, measured without the overlay

Pixels of an overlay are replaced in every frame by what other frames show of the scene at that place, moved by whole
pixels.  Where none shows anything the scene around is continued smoothly, because an edge there would be taken for one
of the scene.  Flow, fusion and deconvolution then see the scene alone.

With a static camera no frame shows what is behind a title.  The scene moves all the same, by the pixel or two that the
air bends it: every frame is continued over the overlay, whose pixels are put back into the result as they are in the
mean of the frames.  A title lacks the noise of the camera, unless a coder has spread that over it; then its edges
move less by an order of magnitude than those of the scene.

A watermark is a title that the scene shows through, by which its pixels vary.  Under them no frame is continued well
from around, and what is found of it are those letters behind which the scene is flat.  It is named; where the camera
moves it stays in the frames, which are registered by the scene.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import ROUNDING, FloatArray, luminance
from ..core.decision import Decision
from ..core.errors import DataError
from ..core.gradient import sobel_gradient
from ..core.verdict import CheckKind
from ..io.images.image_files import read_image
from ..io.source import FrameSource, Window
from ..registration.camera.global_shift import known_shifts
from .checks.clocks import (
    BESIDE,
    DEVIATIONS,
    FEWEST_STROKES,
    LINE,
    STILL,
    around,
    clock_digits,
    regions,
    with_gaps,
)
from .checks.missing_pixels import continued
from .correction import Correction
from .placement import Placement, camera_moves, relative_window
from .survey import Moments, Survey

# Fewest frames of a clip in which an overlay is looked for: a test finds one in three.
FEWEST = 3
# An edge is static if it varies by less than its gradient times this share of the motion of the edges, or one pixel;
# with a static camera, the edges move by at least so many pixels.  Tests fail at half and at double of either.
_STATIC, _LEAST_BENDING = 1 / 3, 0.3
# The least change that counts is one level of 8 bits, or less in a clip whose range, between these percentiles, is
# below this share of full scale; both chosen.
_SPAN, _RANGE = 0.5, (1, 99)
# Largest deviation of pixels without noise, in units of the noise, and level of a dark stop, from black to the scene;
# both chosen.
_CONSTANT, _DARK = 0.5, 0.25
# Fewest static edge pixels of an overlay, as a share of the frame, chosen, and the largest part of a frame that it may
# cover: a stop that covers half of the frame is found, one that covers nearly all is not.
_LEAST_EDGES, _LARGEST = 0.0005, 0.7
# Least share of the scene, shown by no frame, that the decision states, chosen.
_REPORTED = 0.002
# Pixels around an overlay that are replaced too, reach of the fill under which shifts are measured, and the share of a
# reduced pixel beside an overlay that has to show the scene; all chosen.
_AROUND, _REACH, _FREE = 2, 12.0, 0.9
# With a static camera: radius around static edges in which what has no noise belongs to them; pixels around them over
# which the overlay fades; both chosen.
_NEAR, _FADE = 4, 0.7
# An edge is drawn over the scene if its deviation is below that of the noise by this factor, or its motion below that
# of the edges of the scene by this one: tests of titles fail at half and at double of either.
_NOISELESS, _DRAWN = 0.7, 1 / 8
# Least share of the clear edges in a title, and of the pixels next to it, that are drawn: tests fail at half and at
# double; pixels along the border that do not count: codecs draw up to two lines there, and a derivative reaches one
# more.
_LEAST_DRAWN, _BORDER = 1 / 3, 3
# A part of a title has moved if edges with this share of its squared gradients are so many pixels from where they were,
# chosen: in a test two thirds of them move by less, or a third by more, and it stays; two thirds by more, and it goes.
_MOVED, _MOTION = 0.5, 0.5
# What is static is half-transparent if less than this share of it, without its edges, lacks noise.  On photographs of a
# cup, a person and bricks behind words of an opacity of 0.35 or less, 0.02 or less does, with a static or a shaking
# camera; behind opaque words of three styles, as stored and after H.264, 0.05 or more does.
_SEEN_THROUGH = 0.03


@dataclass(frozen=True, eq=False)
class Overlay:
    """Static pixels, and the scene behind them."""

    mask: NDArray[np.bool_]  # (H, W)
    scene: FloatArray  # (H', W') or (H', W', 3): mean of the frames at one place, without the overlay
    hidden: NDArray[np.bool_]  # (H, W): pixels of the scene, at its mean position, that no frame shows
    placement: Placement  # where frames lie in the scene
    window: Window  # rows and columns of the file that the mask spans

    def without(self, number: int, values: FloatArray, window: Window) -> FloatArray:
        """Replace the overlay in a frame, or in a window of it, by the scene behind it."""
        part = relative_window(self.window, window)
        replaced, chosen = values.copy(), self.mask[part]
        replaced[chosen] = self.scene[self.placement.place(number)][part][chosen]
        return replaced


@dataclass(frozen=True, eq=False)
class Title:
    """An overlay of a static camera: pixels that stay while the air bends the scene around them."""

    mask: NDArray[np.bool_]  # (H, W)
    frame: FloatArray  # (H, W) or (H, W, 3): mean of the frames
    window: Window  # rows and columns of the file that the mask spans
    seen_through: bool = False  # whether the scene shows through it

    def without(self, _: int, values: FloatArray, window: Window) -> FloatArray:
        """Continue the scene of a frame, or of a window of it, over the title."""
        mask = self.mask[relative_window(self.window, window)]
        return continued(values, ~mask) if mask.any() else values

    @cached_property
    def _pixels(self) -> tuple[FloatArray, FloatArray, NDArray[np.int32]]:
        """Luminance, gradient and number of the part, from 1, of every pixel of the title."""
        grey = luminance(self.frame)
        labels = cv2.connectedComponents(self.mask.astype(np.uint8), connectivity=8)[1]
        return grey[self.mask], np.hypot(*sobel_gradient(grey))[self.mask], labels[self.mask]

    def at_rest(self, frame: FloatArray, noise: float) -> Title | None:
        """Keep the parts whose edges have not moved: blocks that a coder copies look drawn for a while."""
        before, gradient, parts = self._pixels
        edges = gradient > DEVIATIONS * noise
        moved = edges & (np.abs(luminance(frame)[self.mask] - before) > _MOTION * gradient)
        of_all, gone = (np.bincount(parts, gradient**2 * pixels) for pixels in (edges, moved))
        still = (gone <= _MOVED * of_all)[parts]
        if still.all():
            return self
        mask = self.mask.copy()
        mask[mask] = still
        return replace(self, mask=mask) if mask.any() else None

    def put_back(self, image: FloatArray, left: int = 0, top: int = 0) -> FloatArray:
        """Put the title back, with a soft edge, into an image whose first pixel is at (left, top) of the frame."""
        window = np.s_[top : top + len(image), left : left + image.shape[1]]
        weight = np.maximum(cv2.GaussianBlur(self.mask.astype(np.float32), (0, 0), _FADE), self.mask)[window]
        weight = weight if image.ndim == 2 else weight[..., None]
        return image + weight * (self.frame[window] - image)


def read_static_mask(path: str | os.PathLike[str], source: FrameSource) -> NDArray[np.bool_]:
    """Read which pixels of the frames do not show the scene.

    Returns (H, W).
    """
    image = read_image(path).image
    marked: NDArray[np.bool_] = luminance(image) > 0
    size = source.shape[1:3]
    if marked.shape != size and all(side >= part.stop for side, part in zip(marked.shape, source.window, strict=True)):
        marked = marked[source.window]
    if marked.shape != size:
        found = f"{marked.shape[1]}×{marked.shape[0]}"
        raise DataError(f"{path}: expected a mask of {size[1]}×{size[0]} pixels, as the frames, found {found}")
    if marked.all() or not marked.any():
        what = "all of them" if marked.all() else "none"
        raise DataError(f"{path}: expected white where the frames do not show the scene, found {what} white")
    return marked


@dataclass(frozen=True, eq=False)
class _Static:
    """What is static in a clip, and how the scene moves behind it."""

    mask: NDArray[np.bool_]  # (H, W)
    small: FloatArray  # (T, h, w[, 3]): reduced frames without it
    shifts: NDArray[np.float64]  # (T, 2): of the camera, pixels
    title: Title | None = None  # what it is if the camera is static
    digits: NDArray[np.bool_] | None = None  # (H, W): those that change


def find_title(survey: Survey) -> Title | None:
    """Find the title that a static camera has drawn over its frames."""
    found = _find_static(survey)
    return None if found is None or camera_moves(found.shifts) else found.title


def find_overlay(survey: Survey, mask: NDArray[np.bool_] | None = None) -> Correction | None:
    """Find the static overlay of a clip, which is replaced by the scene or, if the camera is static, put back.

    ``mask`` (H, W) names the pixels that are replaced.
    """
    if mask is not None:
        return _replaced(survey, _Static(mask, *_behind(survey, mask, None)), "asked for")
    found = _find_static(survey)
    if found is None:
        return None
    if camera_moves(found.shifts):
        return _uncovered(survey, found)
    return None if found.title is None else _kept(found.small, found.title)


def _uncovered(survey: Survey, found: _Static) -> Correction | None:
    """Replace the overlay of a camera that moves, unless the scene shows through it."""
    moments, mask = survey.moments, None
    seen_through = found.title is not None and found.title.seen_through
    if not seen_through:
        level = _grey_level(survey)
        mask, _ = _static_regions(survey.clip, moments, level, found.shifts)
        if mask is None:
            return None
        constant = np.sqrt(moments.variance) < _CONSTANT * max(moments.noise, level / STILL)
        seen_through = _is_seen_through(mask, luminance(moments.mean), constant, _AROUND)
    if mask is None or seen_through:
        reason = "the scene moves behind it and shows through it"
        return Correction((Decision("overlay", "left in the frames", reason, CheckKind.WATERMARK),))
    if found.digits is not None:
        mask, _ = _with_digits(mask, None, found.digits & around(mask, len(mask) // LINE))
    return _replaced(survey, replace(found, mask=mask), "it is static while the scene moves")


def _find_static(survey: Survey) -> _Static | None:
    if len(survey.small) < FEWEST:
        return None
    level = _grey_level(survey)
    mask, title = _static_regions(survey.clip, survey.moments, level)
    if mask is None:
        return None
    digits = clock_digits(survey, level, mask if title is None else title.mask)
    mask, title = _with_digits(mask, title, digits)
    return _Static(mask, *_behind(survey, mask, title), title, digits)


def _behind(survey: Survey, mask: NDArray[np.bool_], title: Title | None) -> tuple[FloatArray, NDArray[np.float64]]:
    """Reduced frames (T, h, w[, 3]) without what is static, and the shifts of the camera (T, 2) in pixels."""
    small = _continued_small(survey.small, mask)
    shown = luminance(small)
    # What is not found of a title that is seen through holds measured shifts back, and is gone without the mean.
    shown = shown - shown.mean(axis=0) if title is not None and title.seen_through else shown
    return small, known_shifts(shown)[0] * (mask.shape[1] / small.shape[2], mask.shape[0] / small.shape[1])


def _replaced(survey: Survey, found: _Static, reason: str) -> Correction:
    """Replace an overlay by what other frames show there."""
    overlay, share = _overlay(survey, found.mask, found.shifts), f"{100 * float(found.mask.mean()):.1f} % of the frame"
    choice, unseen = f"{share} replaced by what other frames show", float(overlay.hidden.mean())
    if unseen >= _REPORTED:
        choice = f"{share} replaced"
        reason += f"; {100 * unseen:.1f} % is shown by no frame and filled from around, the rest by others"
    return Correction((Decision("overlay", choice, reason),), overlay.without, found.small, overlay.hidden)


def _kept(small: FloatArray, title: Title) -> Correction:
    """Continue the scene over a title; the pixels under one that the scene shows through do not count as hidden."""
    choice = f"{100 * float(title.mask.mean()):.1f} % of the frame kept as in the mean of the frames"
    reason = "it is static while the air bends the scene around it; it is neither moved nor deblurred"
    check, hidden = (CheckKind.WATERMARK, None) if title.seen_through else (None, title.mask)
    decision = Decision("overlay", choice, reason, check)
    return Correction((decision,), title.without, small, hidden, put_back=title.put_back)


def _static_regions(
    source: FrameSource, moments: Moments, level: float, shifts: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.bool_] | None, Title | None]:
    """Find connected regions with static edges: for a camera that moves and, if edges move, for a static one.

    Where ``shifts`` (T, 2) of the camera are known, what lies along its path does not count.
    """
    mean, deviation = luminance(moments.mean), np.sqrt(moments.variance)
    noise = max(moments.noise, level / STILL)
    still = deviation < STILL * noise
    gradient = np.hypot(*sobel_gradient(mean))
    clear = gradient > DEVIATIONS * noise
    moved = np.maximum(deviation[clear] ** 2 - moments.noise**2, 0) / gradient[clear] ** 2
    motion = measured = float(np.sqrt(np.median(moved))) if moved.size else 0.0
    if shifts is not None:
        slopes = sobel_gradient(mean)
        across = np.einsum("iyx,ij,jyx->yx", slopes, np.cov(shifts.T), slopes)
        motion = np.minimum(measured, np.sqrt(np.maximum(across, 0)) / np.maximum(gradient, ROUNDING))
    edges = still & clear & (gradient * np.minimum(_STATIC * motion, 1.0) > deviation)
    # A title has no noise of the camera, unless a coder spreads noise over it.
    drawn = _titles(clear & (deviation < np.maximum(_DRAWN * motion * gradient, _NOISELESS * noise)), clear)
    if edges.sum() < _LEAST_EDGES * edges.size and not drawn.any():
        return None, None
    constant = deviation < _CONSTANT * noise
    # A flat part of the scene does not change either; an overlay lacks the noise of the scene, or is dark like a stop.
    black = float(mean.min())
    dark = mean < black + _DARK * (float(np.median(mean[~still])) - black) if (~still).any() else still
    mask = regions((still & dark) | constant | edges | drawn, edges | drawn)
    if mask.mean() > _LARGEST:
        return None, None
    mask = around(mask, _AROUND)
    if not drawn.any() or measured < _LEAST_BENDING:
        return mask, None
    letters = around(with_gaps(regions((constant & around(drawn, _NEAR)) | drawn, drawn)) > 0, 1)
    return mask, Title(letters, moments.mean, source.window, _is_seen_through(letters, mean, constant, 1))


def _is_seen_through(mask: NDArray[np.bool_], mean: FloatArray, constant: NDArray[np.bool_], edge: int) -> bool:
    """Tell whether hardly any static pixel lacks noise, apart from the edge; a stop has noise too, but is dark."""
    inner = ~around(~mask, edge)
    if not inner.any() or float(constant[inner].mean()) >= _SEEN_THROUGH:
        return False
    return float(mean[mask].mean()) > float(continued(mean, ~mask)[mask].mean())


def _grey_level(survey: Survey) -> float:
    """Least change that counts: one level of 8 bits, or less for a dim clip of finer steps."""
    low, high = np.percentile(luminance(survey.moments.mean), _RANGE)
    # The numbers of a file may be of fewer bits than its type.
    step = np.diff(np.unique(survey.pixels[0])).min(initial=survey.clip.full_scale) / survey.clip.full_scale
    return min(max(float(high - low) / _SPAN / 255, float(step), 1 / (2**survey.clip.bit_depth - 1)), 1 / 255)


def _titles(drawn: NDArray[np.bool_], clear: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Keep drawn pixels in and near regions of many: in few frames of slow air some edges of the scene seem drawn.

    A dark line along the border, a pixel or two wide, is no title.
    """
    count, labels = cv2.connectedComponents(with_gaps(drawn), connectivity=8)
    beside = cv2.dilate(labels.astype(np.float32), np.ones((3, 3), np.uint8))
    inner = np.zeros_like(drawn)
    inner[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
    found, all_edges = (np.bincount(beside[pixels & inner].astype(int), minlength=count) for pixels in (drawn, clear))
    many = (found >= FEWEST_STROKES) & (found >= _LEAST_DRAWN * all_edges)
    many[0] = False
    return drawn & around(many[labels], len(drawn) // LINE)


def _with_digits(
    mask: NDArray[np.bool_], title: Title | None, digits: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], Title | None]:
    """Add digits, and a pixel around them, to an overlay; a digit that a box surrounds is a hole in it."""
    wide = around(digits, 2)
    if title is None:
        return mask | wide, None
    letters = title.mask | wide
    _, labels, sizes, _ = cv2.connectedComponentsWithStats((~letters).astype(np.uint8), connectivity=4)
    letters |= (sizes[:, cv2.CC_STAT_AREA] <= (2 * BESIDE + 1) ** 2)[labels]
    return mask | wide, replace(title, mask=letters)


def _continued_small(small: FloatArray, mask: NDArray[np.bool_]) -> FloatArray:
    """Fill reduced frames smoothly where they show pixels of an overlay; (T, h, w) or (T, h, w, 3)."""
    size, reach = small.shape[2:0:-1], _REACH * small.shape[2] / mask.shape[1]
    free = cv2.resize((~mask).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    known = np.float32(free >= _FREE)
    around = cv2.GaussianBlur(known, (0, 0), reach) + 1e-3
    filled = np.empty_like(small)
    for after, frame in zip(filled, small, strict=True):
        seen = (frame.T * known.T).T
        middle = seen.sum(axis=(0, 1)) / max(float(known.sum()), 1.0)
        fill = (cv2.GaussianBlur(seen, (0, 0), reach) + 1e-3 * middle).T / around.T
        after[...] = seen + (fill * (1 - known.T)).T
    return filled


def _overlay(survey: Survey, mask: NDArray[np.bool_], shifts: NDArray[np.float64]) -> Overlay:
    """Average what the whole frames show of the scene, without the overlay."""
    placement = Placement.by(shifts, survey.clip.numbers, (mask.shape[0], mask.shape[1]))
    total, count = np.zeros((*placement.shape, *survey.clip.shape[3:])), np.zeros(placement.shape)
    for number, frame in zip(survey.numbers, survey, strict=True):
        place = placement.place(number)
        total[place][~mask] += frame[~mask]
        count[place][~mask] += 1
    scene = continued((total.T / np.maximum(count, 1).T).T.astype(np.float32), count > 0)
    return Overlay(mask, scene, count[placement.of_shift(0, 0)] == 0, placement, survey.clip.window)
