"""When an iteration has come near enough to where it goes.

A photograph is deblurred after some fifty iterations, the finest bars of a chart after hundreds.  A bound for the last
change of the whole tells them apart badly: what changes slowly may have far to go, and a few letters on a large page
change little of it.  So changes are looked at where they are largest, and what follows them is foreseen.

Where the image goes on beyond its border, primal-dual splitting is not judged in the outermost pixels, as many as the
blur is wide.  Up to half of their light comes from pixels that nobody saw.  These and those swing for hundreds of
iterations, by less than can be seen, and the more tiles there are, the more likely one still swings.  Conjugate
gradients do not swing; what they change last lies there, so they are judged everywhere.

Symbols
-------
d : change of the image in a window of iterations, relative.
q : ratio of the changes of two windows in succession, the mean of the last ones.

The changes to come are continued as a geometric series, ``d (q + q² + …) = d q / (1 − q)``.  A q near 1 is known too
badly for that: no more is foreseen than ``MOST`` times the last change, and that much as long as q is not known.

That is too much where an image swings: it goes as far back as it went.  So primal-dual splitting also ends where the
image rests, that is, where all images of the last windows (``turbrestore.deconvolution.primal_dual.REST``) differ from
it by no more than the tolerance.  Neither rule is a bound: that what is left can hardly be seen is measured
(``benchmarks/stopping.py``), and what drifts very slowly may rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray

# Pixels a side of the tiles that changes are compared in.
TILE = 64
# Steps from window to window that q is taken from, of which there must be FEWEST; and how many times the last change is
# foreseen at most.
SPAN, FEWEST, MOST = 5, 4, 6.0


def still_to_come(changes: Sequence[float]) -> float:
    """Sum of the changes that follow.

    Parameters
    ----------
    changes : sequence of float
        Of all windows until now.

    Returns
    -------
    float
        In the unit of the changes; the most that is foreseen as long as there are too few to tell.

    Examples
    --------
    >>> still_to_come([0.8, 0.4, 0.2, 0.1, 0.05])
    0.05
    >>> still_to_come([0.8, 0.5])
    3.0
    """
    last, span = changes[-1], min(SPAN, len(changes) - 1)
    if span < FEWEST or not last < changes[-1 - span]:
        return last * MOST
    ratio = min((last / changes[-1 - span]) ** (1 / span), MOST / (1 + MOST))
    return last * ratio / (1 - ratio)


def tile_sums(strip: FloatArray, first: int) -> NDArray[np.float64]:
    """Sum some rows of an image over tiles.

    Parameters
    ----------
    strip : ndarray, float32, shape (h, W)
        Rows, at least one.
    first : int
        Number of the first of them in the image.

    Returns
    -------
    ndarray, float64, shape (n, ceil(W / TILE))
        Of the n rows of tiles that they belong to, from row ``first // TILE`` of tiles on.

    Examples
    --------
    >>> tile_sums(np.ones((2, 65), np.float32), 63)
    array([[64.,  1.],
           [64.,  1.]])
    """
    across = np.add.reduceat(strip, np.arange(0, strip.shape[1], TILE), axis=1, dtype=np.float64)
    begins = np.arange(-(-(first + 1) // TILE) * TILE, first + len(strip), TILE) - first
    return np.add.reduceat(across, np.concatenate([[0], begins]))


def relative_change(moved: NDArray[np.float64], size: NDArray[np.float64]) -> float:
    """Change of the tile that changed most, relative to the brightest.

    Parameters
    ----------
    moved, size : ndarray, float64, equal shapes
        Squares of the change and of the image, summed over tiles.

    Returns
    -------
    float
        Of their roots.

    Examples
    --------
    >>> relative_change(np.array([0.0, 4.0]), np.array([100.0, 1.0]))
    0.2
    """
    most, brightest = float(moved.max()), float(size.max())
    return float(most > 0) if brightest == 0 else float(np.sqrt(most / brightest))
