"""Structure that the frames lack: edges of the fused image that few of the registered frames have.

Symbols
-------
f : fused image; I_k : registered frame

An edge of f is unseen if fewer than half of the frames that show its place have a gradient of its direction there.  The
average of frames that were registered rightly has the edges that they have in common.  Where registration follows what
moves through the scene, such as waves on water, each frame brings edges of its own, and weights by sharpness keep
them at full contrast.

The share is of edges and not of the frame, so that it does not depend on how much of it is empty.

Registration also follows texture that renews itself, such as the granulation of the Sun, and bends the frames until
they look alike.  Two things tell that.  Registration leaves much of what the frames differ by, noise apart.  And much
of what it leaves lasts: the beginning and the end of the clip differ by more than independent frames would.

Unseen edges make the mean of the frames the result, the more of them the less registration leaves: it can explain most
differences and still bend one row of bricks into the next, but noise hides edges, too.  A change of the scene does so
only where registration leaves much; otherwise no blur is removed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import ROUNDING, FloatArray, luminance
from ..core.gradient import gradient_noise, sobel_gradient
from ..core.noise import estimate_noise
from ..core.robust import spread
from ..registration.warp import inside, warp
from ..runtime.scratch import drop_pages

# Largest share of unseen edges, where registration leaves this share of the variance over the frames or more; figures
# in benchmarks/decisions/guards.md.
UNSEEN, LEFT = 0.03, 0.3
# Share of what is left that lasts, from which the scene itself changes.  Recorded and simulated clips of scenes that do
# not change have up to 0.04, textures that live for a tenth of the clip and longer 0.17 and more.
LASTING = 0.1
# Standard deviation of the Gaussian before a gradient is taken, pixels, chosen.
_SCALE = 2.0
# Edges of f have at least this share of its steepest gradients, and this multiple of those of noise; both chosen.
_EDGE, _CLEAR = 0.1, 6.0
# Cosine of the angle within which gradients have one direction, about 45°.
_ALIKE = 0.7
# Percentile of the gradients that is taken for the steepest, chosen.
_STEEPEST = 99
# Frames that are compared, windows along an axis and their side, pixels, for their cost; pixels at the border that are
# left out, of which the Gaussian and the derivative reach 9.
_FRAMES, _WINDOWS, _SIDE, _BORDER = 15, 4, 256, 12

Window = tuple[slice, slice]


@dataclass(frozen=True)
class StructureReading:
    """How far the registered frames agree with a fused image."""

    unseen: float  # share of the edges of the image that fewer than half of the registered frames have
    # Variance over the registered frames, relative to that over the frames as they are, both without noise.
    left: float
    lasting: float = 0.0  # share of the variance over the registered frames that their mean has too, as it lasts

    @property
    def explained(self) -> bool:
        """Whether the filtered image may be the result."""
        return self.unseen <= self.most_unseen and not self.unexplained_change

    @property
    def most_unseen(self) -> float:
        """Largest share of unseen edges, in inverse proportion to what registration leaves where that is little."""
        return UNSEEN * max(LEFT / max(self.left, ROUNDING), 1.0)

    def motion_left(self, removed: float) -> float:
        """Motion, pixels, that makes the differences that registration leaves, if ``removed`` made the others."""
        return removed * float(np.sqrt(self.left / max(1 - self.left, ROUNDING)))

    @property
    def unexplained_change(self) -> bool:
        """Whether the scene itself changes, and registration leaves much of that."""
        return self.changes and self.left > LEFT

    @property
    def changes(self) -> bool:
        """Whether the scene itself changes during the clip."""
        return self.lasting > LASTING


def compare_structure(
    image: FloatArray, frames: FloatArray, flows: FloatArray, noise: float = 0.0, lasting: float = 0.0
) -> StructureReading:
    """Compare a fused image (H, W[, 3]) with its frames (T, H, W[, 3]), registered by flows (T, H, W, 2).

    ``noise`` is the variance of what is new in every frame, ``lasting`` that of what the mean of the frames has beyond
    the noise of so many independent frames, both squared intensity.
    """
    picked = spread(len(frames), _FRAMES)
    gradient = _gradient(luminance(image))
    steepness = np.hypot(*gradient)
    within = _within(steepness.shape)
    steepest = float(np.percentile(steepness[within], _STEEPEST))
    least = max(_EDGE * steepest, _CLEAR * gradient_noise(_SCALE) * estimate_noise(frames[picked[0]]))
    edges = (steepness > least) & within
    totals = np.zeros(5)
    for window in _windows(edges.shape):
        direction = np.stack([derivative[window] for derivative in gradient])
        direction /= np.maximum(steepness[window], np.float32(ROUNDING))
        pairs = (_registered(frames[number], flows[number], window) for number in picked)
        totals += _compare_window(pairs, direction, edges[window])
        drop_pages(frames)
        drop_pages(flows)
    shown, unseen, registered, plain, pixels = totals
    variances = np.maximum(np.array([registered, plain]) / max(pixels, 1) - noise, 0)
    left = float(min(variances[0] / max(variances[1], ROUNDING**2), 1.0))
    return StructureReading(
        float(unseen / max(shown, 1)), left, float(lasting / max(registered / max(pixels, 1), ROUNDING**2))
    )


def _gradient(plane: FloatArray) -> tuple[FloatArray, FloatArray]:
    return sobel_gradient(cv2.GaussianBlur(plane, (0, 0), _SCALE))


def _within(shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Mark the pixels that are not at the border; all of a small image."""
    border = min(_BORDER, min(shape) // 4)
    marks = np.zeros(shape, bool)
    marks[border : shape[0] - border, border : shape[1] - border] = True
    return marks


def _windows(shape: tuple[int, ...]) -> Iterator[Window]:
    """Yield windows spread evenly over an image, which cover one of up to 1024 pixels a side."""

    def parts(length: int) -> list[slice]:
        side = min(_SIDE, length)
        count = min(_WINDOWS, -(-length // side))
        return [slice(int(start), int(start) + side) for start in np.linspace(0, length - side, count).round()]

    yield from ((rows, columns) for rows in parts(shape[0]) for columns in parts(shape[1]))


def _registered(
    frame: FloatArray, flow: FloatArray, window: Window
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return a frame in a window, registered, the gradient of this, and where the frame shows the window."""
    reach = int(np.ceil(np.abs(flow[window]).max())) + _BORDER
    around = tuple(slice(max(part.start - reach, 0), part.stop + reach) for part in window)
    inner = tuple(
        slice(part.start - wide.start, part.stop - wide.start) for part, wide in zip(window, around, strict=True)
    )
    plane, moved = np.ascontiguousarray(luminance(frame[around])), np.ascontiguousarray(flow[around])
    registered = warp(plane, moved)
    x, y = _gradient(registered)
    return plane[inner], registered[inner], x[inner], y[inner], inside(moved)[inner] > 0


def _compare_window(frames: Iterable[Any], direction: FloatArray, edges: NDArray[np.bool_]) -> NDArray[Any]:
    """Edges that are shown, those that are unseen, sums of the variances of registered and plain frames, and pixels."""
    shown, had, *moments = (np.zeros(edges.shape) for _ in range(6))
    count = 0
    for plain, registered, x, y, seen in frames:
        shown += seen
        had += seen & (x * direction[0] + y * direction[1] > _ALIKE * np.hypot(x, y))
        for plane, total, squares in zip((registered, plain), moments[::2], moments[1::2], strict=True):
            cv2.accumulate(plane, total)
            cv2.accumulateSquare(plane, squares)
        count += 1
    always = shown == count
    variances = [
        float((squares / count - np.square(total / count))[always].sum()) * count / max(count - 1, 1)
        for total, squares in zip(moments[::2], moments[1::2], strict=True)
    ]
    found = edges & (shown > 0)
    return np.array([found.sum(), (found & (had < shown / 2)).sum(), *variances, always.sum()])
