"""Lucky imaging: rank the frames of a clip by sharpness and keep the best (Fried 1978).

The quality of a frame is the energy of its Laplacian of Gaussian divided by its squared mean intensity, as in programs
that stack images of planets. Division makes it independent of brightness, and the Gaussian suppresses noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray, check_grey
from ..core.errors import ConfigurationError, DataError, require

# Small enough for the detail that turbulence blurs, large enough to suppress pixel noise; chosen.
_SIGMA = 1.5
# A frame that is darker on average counts as this bright, a quarter of a level of 8 bits: what it shows is noise.
DARK = 1e-3


class Share(float):
    """A fraction; text of a number, with or without a percent sign, is understood."""

    def __new__(cls, value: float | str) -> Share:
        """Read the number; raise ConfigurationError where there is none."""
        text = str(value).strip()
        try:
            number = float(text[:-1]) / 100 if text.endswith("%") else float(text)
        except ValueError:
            raise ConfigurationError(f"keep_best: expected a share such as 0.3 or 30%, found {value!r}") from None
        return super().__new__(cls, number)


def frame_quality(frames: Iterable[ArrayLike]) -> np.ndarray:
    """Sharpness of the frames of one clip, which are taken one at a time: float64 of shape (T,)."""
    quality = []
    for index, frame in enumerate(frames):
        grey = check_grey(frame, f"frame {index}")
        detail = cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), _SIGMA), cv2.CV_32F)
        quality.append(float(np.mean(np.square(detail))) / max(float(grey.mean()), DARK) ** 2)
    if not quality:
        raise DataError("frames: expected at least 1, found none")
    return np.array(quality)


def best_frames(quality: ArrayLike, share: float) -> np.ndarray:
    """Mark the ⌈share · T⌉ frames of highest quality; of equal frames the earlier ones."""
    check_share(share)
    values = np.asarray(quality, np.float64)
    kept = np.zeros(values.shape, bool)
    kept[np.argsort(-values, kind="stable")[: int(np.ceil(round(share * values.size, 9)))]] = True
    return kept


def only_counted(frames: Iterable[FloatArray], counted: NDArray[np.bool_]) -> Iterator[FloatArray | None]:
    """Replace frames that do not count by None."""
    return (frame if counts else None for frame, counts in zip(frames, counted, strict=True))


def check_share(share: float) -> None:
    """Raise ConfigurationError unless the fraction of frames to keep is above 0 and at most 1."""
    remedy = f"; write {share / 100:g}" if 2 <= share <= 100 else "; write 1 for all" if 1 < share < 2 else ""
    require(0 < share <= 1, f"keep_best: expected a share above 0 and up to 1, or 1% to 100%, found {share:g}{remedy}")
