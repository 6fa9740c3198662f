"""One correction of the frames of a clip: what was found, how it is taken out, and what results get back.

Every detector of this folder is a function from a survey to a :class:`Correction`, or to None where it finds nothing;
:mod:`turbrestore.preparation` lists them in the order in which they act.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..core.decision import Decision
from ..io.source import Window
from .levels import Levels

# Takes the number of a frame in the file, its intensities (h, w[, 3]), which stay as they are, and the rows and columns
# of the file that they show.
Apply = Callable[[int, FloatArray, Window], FloatArray]


class PutBack(Protocol):
    """Puts what is no scene back into an image whose first pixel is at (left, top) of the frame."""

    def __call__(self, image: FloatArray, left: int = 0, top: int = 0) -> FloatArray:
        """Return an image (H, W[, 3]) with it."""
        ...


@dataclass(frozen=True, eq=False)
class Correction:
    """What one detector has found in a clip."""

    decisions: tuple[Decision, ...]
    apply: Apply | None = None  # None: it is only named
    small: FloatArray | None = None  # reduced frames after it, if it shows in them: later detectors see these
    hidden: NDArray[np.bool_] | None = None  # (H, W): pixels of the scene that no frame shows
    picture: Window | None = None  # rows and columns outside of which there is no scene
    put_back: PutBack | None = None
    levels: Levels | None = None  # from the intensities before it to those after it
    replaces_objects: bool = False
