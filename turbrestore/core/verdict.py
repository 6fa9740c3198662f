"""What a run gained, and what a person should look at, each with what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

# The verdict where nothing is doubtful.
RIGHT = "looks right"


class CheckKind(StrEnum):
    """What is doubtful about a result.

    Examples
    --------
    >>> CheckKind.GEOMETRY.value
    'geometry'
    """

    INPUT = "input"  # guesses about the file, lost frames, scenes that are not used
    WATERMARK = "watermark"
    TWO_STATES = "two states"  # of a part of the scene
    SATURATED = "saturated"
    LARGE_MOTION = "large motion"
    SCENE_CHANGES = "scene changes"
    CONTRADICTION = "contradiction"  # the frames lack what the filtered image shows
    REPETITION = "repetition"  # the scene repeats more finely than it moves
    FEW_FRAMES = "few frames"
    GEOMETRY = "geometry"
    MOTION = "motion"  # that the frames do not agree on
    AGREEMENT = "agreement"  # on detail
    UNSEEN = "unseen"
    NO_BLUR_REMOVED = "no blur removed"
    BLUR_LEFT = "blur left"
    LESS_THAN_MEASURED = "less than measured"
    BLUR_UNKNOWN = "blur unknown"
    TOO_SHARP = "too sharp"
    DRIFT = "drift"  # of a steadied video


@dataclass(frozen=True)
class Check:
    """One thing to look at.

    Attributes
    ----------
    kind : CheckKind
    text : str
        What is doubtful, a clause.
    remedy : str
        What to do about it, a clause.

    Examples
    --------
    >>> str(Check(CheckKind.UNSEEN, "4 % of the image is seen in hardly any frame", "--border crop"))
    '4 % of the image is seen in hardly any frame (--border crop)'
    """

    kind: CheckKind
    text: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.text} ({self.remedy})"


@dataclass(frozen=True)
class Verdict:
    """What a run gained, and what a person should look at.

    Attributes
    ----------
    gained : str
        One sentence without a full stop.
    checks : tuple of Check
        Empty where nothing is doubtful.

    Examples
    --------
    >>> str(Verdict("1.50 times as sharp as the mean of 48 frames"))
    '1.50 times as sharp as the mean of 48 frames; looks right'
    """

    gained: str
    checks: tuple[Check, ...] = ()

    def __str__(self) -> str:
        return f"{self.gained}; " + (f"check: {'; '.join(map(str, self.checks))}" if self.checks else RIGHT)
