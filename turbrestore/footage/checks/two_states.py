"""A part of the scene that switches between two states, such as a sign that shows one text and then another.

The largest principal components of the reduced frames tell it.  Where air bends the frames, a component takes all
values around its mean; where something switches, it takes two, and lies in the part that switches.
"""

from __future__ import annotations

from itertools import groupby

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.arrays import luminance
from ...core.decision import Decision
from ...core.robust import spread
from ...core.verdict import CheckKind
from ..correction import Correction
from ..survey import Survey

# Components that are looked at, chosen, and most frames that they are found from, for their cost.
_COMPONENTS, _SAMPLES = 4, 256
# Least share of the variance of a component between two states, and largest part of the picture that holds most of its
# energy.  A sign has 0.98 or more, in 0.10 of the picture; of 30 other clips, static, shaking and zooming ones, those
# above 0.90 are a zoom, with 0.94 in 0.49, and the Moon, with 0.90 in 0.56.  As most counts `_MOST` of the energy, on a
# grid of 16×16 blocks; both chosen.
_TWO, _LARGEST, _MOST, _GRID = 0.96, 0.25, 0.9, 16
# Least share of the frames in either state, chosen: what fewer show is replaced as a moving object is.
_LEAST = 0.25


def find_two_states(survey: Survey) -> Correction | None:
    """Say which frames show either state, if a part of the scene has two; frames stay as they are."""
    frames = luminance(survey.small)
    count = len(frames)
    mean = frames.mean(axis=0)
    sample = frames[spread(count, _SAMPLES)]
    sample -= mean
    sample = sample.reshape(len(sample), -1)
    energy, modes = np.linalg.eigh(sample @ sample.T)
    for column in range(1, min(_COMPONENTS, len(sample) - 1) + 1):
        if energy[-column] <= 0:
            break
        shape = sample.T @ modes[:, -column]
        second = _second_state(np.array([np.vdot(frame - mean, shape) for frame in frames]))
        part = _part(shape.reshape(mean.shape))
        if second is not None and part <= _LARGEST:
            return Correction((_in_words(np.asarray(survey.clip.numbers), second, part),))
    return None


def _second_state(values: NDArray[np.float64]) -> NDArray[np.bool_] | None:
    """Which of the values are above the threshold that divides them best (Otsu 1979); None if they are not in two."""
    order, count = np.sort(values), len(values)
    below = np.arange(1, count)
    sums = np.cumsum(order)
    apart = (sums[-1] - sums[:-1]) / (count - below) - sums[:-1] / below
    between = below * (count - below) / count**2 * apart**2
    between[np.minimum(below, count - below) < _LEAST * count] = 0
    place = int(np.argmax(between))
    return values > order[place] if between[place] >= _TWO * order.var() > 0 else None


def _part(shape: NDArray[np.floating]) -> float:
    """Part of the picture that holds most of the energy of a component."""
    blocks = np.sort(cv2.resize(np.square(shape), (_GRID, _GRID), interpolation=cv2.INTER_AREA), axis=None)[::-1]
    return float(np.searchsorted(np.cumsum(blocks), _MOST * blocks.sum()) + 1) / blocks.size


def _in_words(numbers: NDArray[np.int64], second: NDArray[np.bool_], part: float) -> Decision:
    runs = [[place for place, _ in run] for _, run in groupby(enumerate(second.tolist()), key=lambda pair: pair[1])]
    longest = [max((run for run in runs if second[run[0]] == state), key=len) for state in (second[0], not second[0])]
    one, other = (f"--frames {numbers[run[0]]}:{numbers[run[-1]] + 1}" for run in longest)
    choice = f"{100 * part:.0f} % of the picture switches between them"
    return Decision("two states", choice, f"one is in {one}, the other in {other}", CheckKind.TWO_STATES)
