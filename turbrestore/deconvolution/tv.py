"""Total variation by differences of neighbouring pixels, periodic, as a penalty of the primal-dual splitting.

Symbols as in :mod:`turbrestore.deconvolution.primal_dual`: ``K = ∇``, ``Kᵀ = −div``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import FloatArray
from ..runtime.scratch import new_stack
from .strip_grid import StripGrid

_ALL = slice(0, None)


def local_gradient(u: FloatArray, rows: slice = _ALL) -> FloatArray:
    """Periodic forward differences.

    Parameters
    ----------
    u : ndarray, float32, shape (H, W)
        Image.
    rows : slice
        Rows that they are found for, h of them; by default all.

    Returns
    -------
    ndarray, float32, shape (2, h, W)
        Along rows' index y, and along x.

    Examples
    --------
    >>> import numpy as np
    >>> local_gradient(np.array([[1.0, 3.0]], np.float32))[1]
    array([[ 2., -2.]], dtype=float32)
    """
    strip = u[rows]
    found = np.empty((2, *strip.shape), np.float32)
    np.subtract(strip[1:], strip[:-1], out=found[0, :-1])
    np.subtract(u[rows.indices(len(u))[1] % len(u)], strip[-1], out=found[0, -1])
    np.subtract(strip[:, 1:], strip[:, :-1], out=found[1, :, :-1])
    np.subtract(strip[:, 0], strip[:, -1], out=found[1, :, -1])
    return found


def local_divergence(v: FloatArray, rows: slice = _ALL) -> FloatArray:
    """Negative adjoint of :func:`local_gradient`.

    Parameters
    ----------
    v : ndarray, float32, shape (2, H, W)
        Vector field.
    rows : slice
        Rows that it is found for, h of them; by default all.

    Returns
    -------
    ndarray, float32, shape (h, W)

    Examples
    --------
    >>> import numpy as np
    >>> local_divergence(np.array([[[0.0, 0.0]], [[2.0, 0.0]]], np.float32))
    array([[ 2., -2.]], dtype=float32)
    """
    down, right = v[:, rows]
    found = down + right
    found[1:] -= down[:-1]
    found[0] -= v[0, rows.start - 1]
    found[:, 1:] -= right[:, :-1]
    found[:, 0] -= right[:, -1]
    return found


@dataclass(frozen=True, eq=False)
class LocalPenalty:
    """J[u] = Σ|∇u|.

    Attributes
    ----------
    grid : StripGrid
        Of its images.
    """

    grid: StripGrid

    @property
    def norm_squared(self) -> float:
        """Upper bound of ‖K‖²."""
        return 8.0

    def dual(self, image: FloatArray) -> FloatArray:
        """Start from p = 0 for an image of this size."""
        dual = np.asarray(new_stack((2, *image.shape), self.grid.folder))

        def begin(rows: slice) -> None:
            dual[:, rows] = 0

        self.grid.over_rows(begin, dual)
        return dual

    def ascend(self, dual: FloatArray, image: FloatArray, step: float, relaxation: float, pull: FloatArray) -> None:
        """Add ``step`` times K of the image to p, project and over-relax, in place; ``pull`` becomes Kᵀp."""

        def rise(rows: slice) -> None:
            p, forward = dual[:, rows], local_gradient(image, rows)
            forward *= np.float32(step)
            forward += p
            forward /= np.maximum(np.sqrt(np.square(forward).sum(axis=0)), 1)
            forward -= p
            forward *= np.float32(relaxation)
            p += forward

        def draw(rows: slice) -> None:
            np.negative(local_divergence(dual, rows), out=pull[rows])

        self.grid.over_rows(rise, dual, image)
        self.grid.over_rows(draw, dual, pull)

    def value(self, image: FloatArray) -> float:
        """J[u]."""

        def share(rows: slice) -> float:
            return float(np.sqrt(np.square(local_gradient(image, rows)).sum(axis=0)).sum(dtype=np.float64))

        return sum(self.grid.over_rows(share, image))
