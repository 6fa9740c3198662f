"""Lucky imaging: rank the frames of a clip by sharpness and keep the best (Fried 1978).

The quality of a frame is the energy of its Laplacian of Gaussian over its mean intensity squared: what stacking
programs for planets use, insensitive to brightness, and to noise as far as the Gaussian goes.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import check_image, luminance
from ..core.errors import ConfigurationError, DataError, require

# Fine enough for the detail that turbulence takes away, coarse enough to leave pixel noise out.
_SIGMA = 1.5
_DARK = 1e-3


class Share(float):
    """A part of a whole from 0 to 1; text such as ``"30%"`` is understood.

    Parameters
    ----------
    value : float or str
        A number, or text of a number with or without a percent sign.

    Raises
    ------
    ConfigurationError
        Neither.

    Examples
    --------
    >>> Share("30%"), Share(0.3), Share("1")
    (0.3, 0.3, 1.0)
    """

    def __new__(cls, value: float | str) -> Share:
        """Read the number."""
        text = str(value).strip()
        try:
            number = float(text[:-1]) / 100 if text.endswith("%") else float(text)
        except ValueError:
            raise ConfigurationError(f"--keep-best: expected a share such as 0.3 or 30%, found {value!r}") from None
        return super().__new__(cls, number)


def frame_quality(frames: Iterable[ArrayLike]) -> np.ndarray:
    """Sharpness of every frame, for ranking frames of one clip.

    Parameters
    ----------
    frames : iterable of array_like, shape (H, W) or (H, W, 3)
        Consumed lazily.

    Returns
    -------
    ndarray, float64, shape (T,)
        Energy of the Laplacian of Gaussian (σ = 1.5 pixels) over the squared mean intensity.

    Raises
    ------
    DataError
        No frames, or values that are not finite.

    Examples
    --------
    >>> import numpy as np
    >>> sharp = np.zeros((32, 32), np.float32); sharp[:, 16:] = 1
    >>> soft = np.repeat([np.clip((np.arange(32) - 8) / 16, 0, 1)], 32, axis=0)
    >>> bool(np.diff(frame_quality([soft, sharp]))[0] > 0)
    True
    """
    quality = []
    for index, frame in enumerate(frames):
        grey = luminance(check_image(frame, f"frame {index}"))
        detail = cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), _SIGMA), cv2.CV_32F)
        quality.append(float(np.mean(np.square(detail))) / max(float(grey.mean()), _DARK) ** 2)
    if not quality:
        raise DataError("frames: expected at least 1, found none")
    return np.array(quality)


def best_frames(quality: ArrayLike, share: float) -> np.ndarray:
    """Mark the sharpest frames.

    Parameters
    ----------
    quality : array_like, shape (T,)
        From :func:`frame_quality`.
    share : float
        Part of the frames to keep, above 0, up to 1.

    Returns
    -------
    ndarray, bool, shape (T,)
        True for the ⌈share · T⌉ frames of highest quality; of equals the earlier.

    Raises
    ------
    ConfigurationError
        The share is not between 0 and 1.

    Examples
    --------
    >>> best_frames([0.1, 0.5, 0.3, 0.2], 0.5).tolist()
    [False, True, True, False]
    """
    check_share(share)
    values = np.asarray(quality, np.float64)
    kept = np.zeros(values.shape, bool)
    kept[np.argsort(-values, kind="stable")[: int(np.ceil(round(share * values.size, 9)))]] = True
    return kept


def check_share(share: float) -> None:
    """Refuse what is no share of frames.

    Parameters
    ----------
    share : float
        Above 0, up to 1.

    Raises
    ------
    ConfigurationError
        It is not.

    Examples
    --------
    >>> check_share(0.3)
    """
    require(0 < share <= 1, f"keep_best: expected a share above 0 and up to 1, or 1% to 100%, found {share}")
