"""The loop of the iterative solvers, and when it stops.

A photograph is deblurred after some thirty iterations, the finest bars of a chart after a hundred.  The last change of
the whole image hardly separates the two: an image that changes slowly may have far to go, and a few letters on a large
page change little of it.  So changes are measured in the tile that changes most, and further changes are predicted.

Where the image continues beyond its border, changes of nltv and tv are not measured in the outermost pixels, as many as
the blur is wide.  Up to half of their light comes from pixels that were not observed.  These oscillate for hundreds of
iterations, by less than can be seen, and the more tiles there are, the more likely one of them still oscillates.
Conjugate gradients do not oscillate; their last changes are at the border, so they are measured everywhere.

Symbols
-------
d : change of the image over a window of iterations, relative to the brightest tile.
q : ratio of the changes of two windows in succession, the mean of the last ones.

The predicted changes are a geometric series, ``d (q + q² + …) = d q / (1 − q)``.  A q near 1 is too uncertain for that:
the prediction is at most ``MOST`` times the last change, and that much as long as q is not known.

That is too much for an image that oscillates.  So primal-dual splitting also stops when the image is at rest: when it
differs from the images after each of the last windows (``turbrestore.deconvolution.primal_dual.REST``) by no more than
the tolerance.  Neither rule is a bound: ``benchmarks/stopping.py`` measures that the remaining change is hardly
visible, and an image that drifts very slowly may be taken to be at rest.

A caller who may refuse the result is asked about the image after ``turbrestore.deconvolution.primal_dual.EARLY``
iterations, by when most images are at rest, and the solver ends there if it is refused.  Of others, whose deblurring
took up to 400 iterations, the guards read nearly what they read at the end (four clips of charts and words: ringing .41
and .35, .73 and .76, .34 and .33, .59 and .58).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..runtime.image_stacks import Stack, namespace, store
from ..runtime.steps import Result
from .conjugate_gradient import ConjugateGradients
from .primal_dual import EARLY, PrimalDual
from .problem import Problem

# Pixels a side of the tiles that changes are measured in, chosen: tiles of 32 go on for noise.
TILE = 64
# q is the mean over this many steps from window to window, of which there must be at least FEWEST; the prediction is at
# most MOST times the last change.  All chosen.
SPAN, FEWEST, MOST = 3, 2, 6.0
# The energy is recorded every so many iterations, a multiple of the windows of all solvers.
_RECORD_EVERY = 10


@dataclass(frozen=True)
class DeconvolutionState:
    """Progress of a deconvolution."""

    iteration: int  # iterations done
    # Latest change for each iteration, of the tile that changes most and relative to the brightest tile; infinite until
    # the first is known.
    change: float


# A deconvolution that yields its state after each iteration.
Steps = Generator[DeconvolutionState, None, Result]


class Solution(NamedTuple):
    """Images, iterations, whether they converged, and records (iteration, energy, change for each iteration)."""

    images: list[Stack]
    iterations: int
    converged: bool
    records: list[tuple[int, float, float]]


def iterate(
    solver: PrimalDual | ConjugateGradients,
    problems: list[Problem],
    states: list[Any],
    measured: Stack,
    iterations: int,
    tolerance: float,
    refuse: Callable[[list[Stack]], bool] | None = None,
) -> Steps[Solution]:
    """Step the problems of all channels until no image changes any more, or until they are refused."""
    images = [state.image for state in states]
    earlier = deque([images], max(solver.rest, 1))
    changes, records, begun, converged = list[float](), list[tuple[int, float, float]](), 0, False
    for iteration in range(1, iterations + 1):
        states = [solver.step(problem, state) for problem, state in zip(problems, states, strict=True)]
        last, full = iteration == iterations, iteration % solver.window == 0
        if last or full:
            images = [state.image for state in states]
            changes.append(change_of(earlier[-1], images, measured) * solver.window / (iteration - begun))
            converged = predicted_change(changes) <= tolerance
            if not converged and full and len(earlier) == solver.rest:
                converged = all(change_of(old, images, measured) <= tolerance for old in earlier)
            begun, last = iteration, last or converged
            if iteration == EARLY and not last and refuse is not None:
                last = refuse(images)
            earlier.append(images)
        change = changes[-1] / solver.window if changes else np.inf
        if last or iteration % _RECORD_EVERY == 0:
            energies = (p.misfit(u) + solver.penalty(p, u) for p, u in zip(problems, images, strict=True))
            records.append((iteration, sum(energies), change))
        yield DeconvolutionState(iteration, change)
        if last:
            break
    return Solution(images, iteration, converged, records)


def predicted_change(changes: Sequence[float]) -> float:
    """Predict the sum of the changes that follow."""
    last, span = changes[-1], min(SPAN, len(changes) - 1)
    if span < FEWEST or not last < changes[-1 - span]:
        return last * MOST
    ratio = min((last / changes[-1 - span]) ** (1 / span), MOST / (1 + MOST))
    return last * ratio / (1 - ratio)


def change_of(before: list[Stack], after: list[Stack], measured: Stack) -> float:
    """Change of images (P, Q) as they are shown, clipped to [0, 1], where it is ``measured`` (P, Q)."""
    moved, size = np.zeros((2, 1, 1))
    for old, new in zip(before, after, strict=True):
        shown = measured * new.clip(0, 1)
        moved = moved + tile_sums((shown - measured * old.clip(0, 1)) ** 2)
        size = size + tile_sums(shown**2)
    most, brightest = float(moved.max()), float(size.max())
    return float(most > 0) if brightest == 0 else float(np.sqrt(most / brightest))


def tile_sums(image: Stack) -> NDArray[np.float64]:
    """Sum an image (P, Q) over tiles, (ceil(P / TILE), ceil(Q / TILE))."""
    rows, columns = (-(-length // TILE) for length in image.shape)
    xp = namespace(image)
    padded = xp.zeros((rows * TILE, columns * TILE), dtype=image.dtype, device=image.device)
    padded[: image.shape[0], : image.shape[1]] = image
    tiles = padded.reshape(rows, TILE, columns, TILE)
    return store(tiles.sum((1, 3), dtype=xp.float64))
