"""The temporal mean of a clip, whose frames are taken one at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..io.source import FrameSource


def temporal_mean(source: FrameSource) -> FloatArray:
    """Mean of the frames, read one after the other."""
    total = np.zeros(source.shape[1:])
    return finish_mean(added_up(source, total), total, len(source))


def added_up(frames: Iterable[FloatArray], total: NDArray[np.float64]) -> Iterator[FloatArray]:
    """Pass frames on, and add them to ``total``, (H, W) or (H, W, 3)."""
    for frame in frames:
        total += frame
        yield frame


def finish_mean(unread: Iterator[FloatArray], total: NDArray[np.float64], count: int) -> FloatArray:
    """Return the mean of frames that are added up in ``total``: those not yet read are read, which adds them up."""
    deque(unread, 0)
    return (total / count).astype(np.float32)
