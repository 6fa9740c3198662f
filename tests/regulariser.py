"""A penalty by its operators on all edges at once, which those that work in strips are held against."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from turbrestore.core.arrays import FloatArray


class Regulariser(NamedTuple):
    """Penalty of four functions: K, Kᵀ, the projection on |p|(x) ≤ 1, and J; with a bound of ‖K‖²."""

    gradient: Callable[[FloatArray], FloatArray]
    adjoint: Callable[[FloatArray], FloatArray]
    project: Callable[[FloatArray], FloatArray]
    value: Callable[[FloatArray], float]
    norm_squared: float

    def dual(self, image: FloatArray) -> FloatArray:
        """Start from p = 0 for an image of this size."""
        return np.zeros_like(self.gradient(image))

    def ascend(self, dual: FloatArray, image: FloatArray, step: float, relaxation: float, pull: FloatArray) -> None:
        """Add ``step`` times K of the image to p, project and over-relax, in place; ``pull`` becomes Kᵀp."""
        forward = self.gradient(image)
        forward *= np.float32(step)
        forward += dual
        forward = self.project(forward)
        forward -= dual
        forward *= np.float32(relaxation)
        dual += forward
        pull[:] = self.adjoint(dual)
