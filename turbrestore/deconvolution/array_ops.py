"""The operations that the solvers need of NumPy or torch, so that every solver is written once.

Arithmetic, ``sum``, ``clip``, ``abs``, ``roll``, ``stack`` and ``sqrt`` are spelled alike in both libraries.  Loading
arrays and Fourier transforms are not, and are here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..runtime.image_stacks import from_device

# ndarray or torch tensor.
Array = Any
# Transforms of smaller images are faster on one thread than on several.
_PARALLEL_PIXELS = 1 << 20


@dataclass(frozen=True, eq=False)
class ArrayOps:
    """Operations of one library."""

    arrays: Any  # ``numpy`` or ``torch``
    # Convert from a NumPy array of real or complex numbers, and back to one.
    load: Callable[[NDArray[Any]], Array]
    store: Callable[[Array], NDArray[Any]]
    forward: Callable[[Array], Array]  # half-spectrum of a real image, as :func:`scipy.fft.rfft2`
    back: Callable[[Array, tuple[int, int]], Array]  # ``back(spectrum, shape)`` is the image of a half-spectrum

    def total(self, values: Array) -> float:
        """Sum all values in double precision."""
        return float(values.sum(dtype=self.arrays.float64))


def numpy_ops(threads: int = 1) -> ArrayOps:
    """Operations of NumPy and SciPy."""

    def workers(shape: tuple[int, ...]) -> int:
        return threads if shape[0] * shape[1] >= _PARALLEL_PIXELS else 1

    return ArrayOps(
        arrays=np,
        load=lambda array: array,
        store=lambda array: array,
        forward=lambda image: scipy.fft.rfft2(image, workers=workers(image.shape)),
        back=lambda spectrum, shape: scipy.fft.irfft2(spectrum, s=shape, workers=workers(shape)),
    )


def torch_ops(device: str) -> ArrayOps:
    """Operations of torch on a device."""
    import torch

    return ArrayOps(
        arrays=torch,
        # torch shares no memory that is read-only.
        load=lambda array: torch.from_numpy(np.require(array, requirements=["C", "W"])).to(device),
        store=from_device,
        forward=torch.fft.rfft2,
        back=lambda spectrum, shape: torch.fft.irfft2(spectrum, s=shape),
    )
