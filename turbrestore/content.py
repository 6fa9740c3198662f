"""What frames show that no image should be made of: found in one pass, then repaired or left out.

====================  =================================================================  =============================
found                 how                                                                what :func:`clean_source` does
====================  =================================================================  =============================
NaN, infinite values  in up to 1 % of a frame; more is refused                           fills them from around
stuck pixels          apart from all eight neighbours, the same way in every frame       median of the neighbours
duplicated frames     every value as in the frame before                                 leaves them out
blank frames          a tenth of the usual contrast or less: lens cap, flash, dropout    leaves them out
cuts                  two frames look alike under no shift                               keeps the longest scene
saturation            half of the values or more at white                                only says so
====================  =================================================================  =============================

Frames are compared as 32×32 thumbnails without their slow shading, by the normalised cross-correlation at its best
circular shift.  On stored clips (eight simulated, twelve real, drift and shake among them) frames of one scene reach
0.69 or more; half of all pairs of different scenes stay below 0.23.  Scenes that look alike at this size, such as two
pages of text, pass for one.  Where frames are unlike throughout, as under heavy noise, no cut is claimed.

A stuck pixel differs from a small detail of the scene in two ways, one of which has to hold: it stands alone, its
neighbours show nothing of it although any lens and any motion would spread it; or it never changes while its
neighbours do.  Pairs and clusters are not found, nor pixels at the border, nor what a lossy codec or a Bayer pattern
has spread.
"""

from __future__ import annotations

import dataclasses
from array import array
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray, luminance
from .errors import ConfigurationError, DataError, require_between
from .frame_source import FrameSource, numbers_text
from .pixels import PixelArray, to_unit

# More values than this share are no isolated defects.
_MOST_MISSING = 0.01
_MOST_STUCK = 0.005
# Rings of values that are filled around what is known.
_WIDEST_HOLE = 32
_FEWEST_FRAMES = 10
# Frames in which pixels are compared everywhere before only few candidates are left to follow.
_DENSE_FRAMES = 8
# Share of its height over the median of the neighbours by which a lone pixel stands over the highest of them.
_ALONE = 0.8
_STILL, _MOVING = 1.5 / 255, 8 / 255
_LEAST_CONTRAST = 1 / 510
_SATURATED = 0.5
_SIDE = 32
# A scene follows slow changes, such as drift and daylight, at this rate.
_FORGETTING = 0.1
# Scenes that are remembered, to know one that comes back.
_MOST_SCENES = 16
_RING = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
_AROUND = np.array([(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)])


@dataclass(frozen=True)
class ContentParams:
    """What counts as a defect of the content, and what is done about it.

    Parameters
    ----------
    strict : bool
        Refuse what would otherwise be repaired or left out.
    blank_contrast : float
        Frames of at most this share of the median contrast are blank.
    cut_similarity : float
        Similarity, 0 to 1, below which two frames show different scenes.
    stuck_excess : float
        Distance, as a share of full scale, by which a stuck pixel lies outside of the range of its neighbours.

    Examples
    --------
    >>> ContentParams(cut_similarity=2)
    Traceback (most recent call last):
    ...
    turbrestore.errors.ConfigurationError: cut_similarity: expected 0 to 1, found 2
    """

    strict: bool = False
    blank_contrast: float = 0.1
    cut_similarity: float = 0.5
    stuck_excess: float = 0.05

    def __post_init__(self) -> None:
        for name in ("blank_contrast", "cut_similarity", "stuck_excess"):
            require_between(name, getattr(self, name), 0, 1)


@dataclass(frozen=True)
class Scene:
    """Frames that show the same.

    Attributes
    ----------
    first, last : int
        Numbers, in the file, of its first and its last frame; frames of other scenes may lie between.
    count : int
        How many frames it has.
    """

    first: int
    last: int
    count: int


@dataclass(frozen=True, eq=False)
class ContentReport:
    """What was found in the frames of a video.

    Attributes
    ----------
    numbers : range or tuple of int
        Numbers, in the file, of the frames that were looked at.
    filled : tuple of int
        Frames with NaN or infinite values.
    filled_values : int
        How many such values there are.
    stuck : ndarray, int, shape (N, 2) or (N, 3)
        Row, column, and channel of colour frames, in the file, of every stuck pixel.
    duplicated : tuple of int
        Frames that equal the one before.
    blank : tuple of int
        Frames without contrast.
    scenes : tuple of Scene
        In the order of their first frames; one where there is no cut.
    saturated : float
        Mean share of values at white.
    contrast : float
        Largest standard deviation within a frame, seen as a thumbnail; 0 where no frame shows anything.
    left_out : frozenset of int
        Frames that :func:`clean_source` leaves out.
    warnings : tuple of str
        All of this in words, and what is done about it; empty for a clean video.
    """

    numbers: range | tuple[int, ...]
    filled: tuple[int, ...]
    filled_values: int
    stuck: NDArray[np.int64]
    duplicated: tuple[int, ...]
    blank: tuple[int, ...]
    scenes: tuple[Scene, ...]
    saturated: float
    contrast: float
    left_out: frozenset[int]
    warnings: tuple[str, ...]


def check_content(source: FrameSource, params: ContentParams | None = None) -> ContentReport:
    """Look at every frame once; memory does not grow with the video, but for 20 bytes a frame.

    Parameters
    ----------
    source : FrameSource
        The video.
    params : ContentParams, optional
        What counts as a defect.

    Returns
    -------
    ContentReport

    Raises
    ------
    DataError
        Damaged frames, too many values that are not finite, or, where ``params.strict``, any defect.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> frames = np.linspace(0.2, 0.7, 32) + rng.normal(0, 0.01, (12, 32, 32))
    >>> frames[5] = frames[4]
    >>> frames[:, 8, 9] = 1.0
    >>> report = check_content(FrameSource.from_array(frames))
    >>> report.duplicated, report.stuck.tolist()
    ((5,), [[8, 9]])
    """
    params = params or ContentParams()
    watch = _Watch(source, params)
    for number, pixels in zip(source.numbers, source.native(), strict=True):
        watch.look(number, pixels)
    report = watch.report()
    if params.strict and (report.left_out or report.filled or len(report.stuck)):
        raise DataError(f"{source.name}: {report.warnings[0]}; refused by strict, leave it out to go on")
    return report


def clean_source(source: FrameSource, report: ContentReport) -> FrameSource:
    """Repair or leave out what :func:`check_content` has found; a clean video comes back as it is.

    Parameters
    ----------
    source : FrameSource
        The video.
    report : ContentReport
        What was found in these very frames.

    Returns
    -------
    FrameSource
        Reads the frames anew and repairs them on the way; ``warnings`` says what was done.

    Raises
    ------
    ConfigurationError
        The report is about other frames.

    Examples
    --------
    >>> frames = np.random.default_rng(0).random((4, 20, 20))
    >>> frames[1, 3, 3] = np.nan
    >>> source = FrameSource.from_array(frames)
    >>> cleaned = clean_source(source, check_content(source))
    >>> bool(np.isfinite(cleaned.read()).all()), cleaned.warnings
    (True, ('1 NaN or infinite value in frame 1: filled from around',))
    """
    if report.numbers != source.numbers:
        raise ConfigurationError(f"{source.name}: the report is about other frames; check this selection")
    cleaned = source.without(report.left_out, "")
    fill, stuck = bool(report.filled), report.stuck

    def repaired(pixels: PixelArray) -> PixelArray:
        pixels = _filled(pixels) if fill else pixels
        return _without_stuck(pixels, stuck) if len(stuck) else pixels

    return dataclasses.replace(
        cleaned,
        warnings=(*source.warnings, *report.warnings),
        repair=repaired if fill or len(stuck) else source.repair,
    )


class _Watch:
    """What has been seen so far."""

    def __init__(self, source: FrameSource, params: ContentParams) -> None:
        self._source, self._params = source, params
        self._previous: PixelArray | None = None
        self._contrasts = array("d")
        self._usual = 0.0
        self._saturated = 0.0
        self._filled: list[int] = []
        self._filled_values = 0
        self._duplicated: list[int] = []
        self._stuck = _StuckPixels(params.stuck_excess)
        self._scenes = _Scenes(params.cut_similarity)

    def look(self, number: int, pixels: PixelArray) -> None:
        pixels = self._complete(number, pixels)
        values = to_unit(pixels, self._source.full_scale, f"{self._source.name}: frame {number}")
        self._saturated += np.count_nonzero(values >= 1) / values.size
        if self._previous is not None and np.array_equal(pixels, self._previous):
            self._duplicated.append(number)
        self._previous = pixels
        thumb = _thumbnail(values)
        contrast = float(thumb.std())
        self._contrasts.append(contrast)
        # A slowly updated median: blank frames must not count as scenes, nor end the watch on stuck pixels.
        self._usual += 0.1 * (max(contrast, _LEAST_CONTRAST) - self._usual) if self._usual else contrast
        if contrast > max(_LEAST_CONTRAST, self._params.blank_contrast * self._usual):
            self._stuck.look(values)
            self._scenes.look(thumb)
        else:
            self._scenes.skip()

    def report(self) -> ContentReport:
        numbers = np.asarray(self._source.numbers)
        contrasts = np.frombuffer(self._contrasts)
        blank = contrasts <= self._params.blank_contrast * np.median(contrasts)
        blank &= ~blank.all()
        duplicated = np.isin(numbers, self._duplicated)
        labels = np.where(blank, -1, self._scenes.labels())
        scenes, used = _divide(numbers, labels)
        left_out = blank | ~used
        # A video of one repeated frame is a still image; there is nothing else to take.
        repeated = (~(left_out | duplicated)).sum() < 2
        left_out |= duplicated & ~repeated
        stuck = self._stuck.found()
        rows, columns = self._source.window
        stuck[:, 0] += rows.start
        stuck[:, 1] += columns.start
        report = ContentReport(
            numbers=self._source.numbers,
            filled=tuple(self._filled),
            filled_values=self._filled_values,
            stuck=stuck,
            duplicated=tuple(self._duplicated),
            blank=tuple(numbers[blank].tolist()),
            scenes=scenes,
            saturated=float(self._saturated) / len(numbers),
            contrast=float(contrasts.max()),
            left_out=frozenset(numbers[left_out].tolist()),
            warnings=(),
        )
        return dataclasses.replace(report, warnings=tuple(_in_words(report, bool(repeated))))

    def _complete(self, number: int, pixels: PixelArray) -> PixelArray:
        """Pixels whose values are finite; isolated holes are filled."""
        if not np.issubdtype(pixels.dtype, np.floating):
            return pixels
        missing = int(pixels.size - np.count_nonzero(np.isfinite(pixels)))
        if missing > _MOST_MISSING * pixels.size:
            raise DataError(
                f"{self._source.name}: frame {number}: expected finite values, found {missing} of {pixels.size} NaN or "
                "infinite; select other frames or a region"
            )
        if missing:
            self._filled.append(number)
            self._filled_values += missing
        return _filled(pixels) if missing else pixels


class _StuckPixels:
    """Pixels that have stood out of all their neighbours in every frame so far."""

    def __init__(self, excess: float) -> None:
        self._excess = excess
        self._frames = 0
        self._high: NDArray[np.bool_] | None = None
        self._low: NDArray[np.bool_] | None = None
        self._searching = True
        self._places = np.empty((0, 2), np.int64)

    def look(self, values: FloatArray) -> None:
        if min(values.shape[:2]) < 3:
            return
        self._frames += 1
        if self._searching:
            self._look_everywhere(values)
        elif len(self._places):
            self._follow(values)

    def found(self) -> NDArray[np.int64]:
        """Row, column, and channel of colour frames."""
        none = np.empty((0, 2), np.int64)
        if self._searching or not len(self._places) or self._frames < _FEWEST_FRAMES:
            return none
        still = (self._most - self._least <= _STILL) & (self._moved() >= _MOVING)
        stuck = self._places[still | (self._alone >= _ALONE)]
        return none if len(stuck) > _MOST_STUCK * self._size else stuck

    def _look_everywhere(self, values: FloatArray) -> None:
        high = values - cv2.dilate(values, _RING) > self._excess
        low = cv2.erode(values, _RING) - values > self._excess
        self._high = high if self._high is None else self._high & high
        self._low = low if self._low is None else self._low & low
        count = np.count_nonzero(self._high) + np.count_nonzero(self._low)
        if count > _MOST_STUCK * values.size and self._frames < _DENSE_FRAMES:
            return
        self._size = values.size
        # At the border half of the neighbours are missing, and codecs and scalers leave marks.
        for marks in (self._high, self._low):
            marks[[0, -1]] = marks[:, [0, -1]] = False
        self._places = np.argwhere(self._high | self._low)
        if len(self._places) > 4 * _MOST_STUCK * values.size:
            self._places = self._places[:0]
        self._sign = np.where(self._high[tuple(self._places.T)], 1, -1).astype(np.float32)
        self._searching, self._high, self._low = False, None, None
        own, around = _with_neighbours(values, self._places)
        self._least, self._most, self._lowest, self._highest = own, own, around, around
        self._alone = np.full(len(own), np.inf, np.float32)

    def _follow(self, values: FloatArray) -> None:
        own, around = _with_neighbours(values, self._places)
        sign = self._sign[:, None]
        over = (sign * (own[:, None] - around)).min(axis=1)
        keep = over > self._excess
        height = np.abs(own - np.median(around, axis=1))
        self._alone = np.minimum(self._alone, over / np.maximum(height, self._excess))[keep]
        self._places, self._sign = self._places[keep], self._sign[keep]
        self._least, self._most = np.minimum(self._least, own)[keep], np.maximum(self._most, own)[keep]
        self._lowest = np.minimum(self._lowest, around)[keep]
        self._highest = np.maximum(self._highest, around)[keep]

    def _moved(self) -> FloatArray:
        return (self._highest - self._lowest).mean(axis=1)


class _Scenes:
    """Which frames show the same; a scene that comes back is known again."""

    def __init__(self, similarity: float) -> None:
        self._similarity = similarity
        self._labels = array("i")
        self._alike = array("f")
        self._references: list[FloatArray] = []
        self._current = -1

    def look(self, thumb: FloatArray) -> None:
        detail = thumb - cv2.GaussianBlur(thumb, (0, 0), _SIDE / 6)
        others = [label for label in range(len(self._references)) if label != self._current]
        candidates = [self._current, *others] if self._current >= 0 else []
        best = -1.0
        for label in candidates:
            alike = _similarity(detail, self._references[label])
            best = max(best, alike)
            if alike >= self._similarity:
                self._current = label
                self._references[label] += _FORGETTING * (detail - self._references[label])
                break
        else:
            if len(self._references) < _MOST_SCENES:
                self._references.append(detail.copy())
            self._current = len(self._references) - 1
        self._labels.append(self._current)
        self._alike.append(best if candidates else 1.0)

    def skip(self) -> None:
        """Count a blank frame, which is of no scene."""
        self._labels.append(-1)

    def labels(self) -> NDArray[np.int32]:
        """Scene of every frame; one for all where frames are unlike throughout."""
        labels = np.array(self._labels, np.int32)
        full = len(self._references) >= _MOST_SCENES
        unlike = len(self._alike) > 0 and float(np.median(np.array(self._alike))) < (1 + self._similarity) / 2 - 0.1
        return np.zeros_like(labels) if full or unlike else labels


def _divide(numbers: NDArray[np.int64], labels: NDArray[np.int32]) -> tuple[tuple[Scene, ...], NDArray[np.bool_]]:
    """Scenes by the labels of frames, and which frames belong to the longest; labels below 0 are of none."""
    scenes: dict[int, Scene] = {}
    for label in dict.fromkeys(labels.tolist()):
        members = numbers[labels == label]
        scenes[label] = Scene(int(members[0]), int(members[-1]), len(members))
    scenes.pop(-1, None)
    if not scenes:
        return (Scene(int(numbers[0]), int(numbers[-1]), len(numbers)),), np.ones(len(numbers), bool)
    longest = max(scenes, key=lambda label: scenes[label].count)
    return tuple(scenes.values()), labels == longest


def _in_words(report: ContentReport, repeated: bool) -> list[str]:
    if report.contrast == 0:
        return ["every frame is of one intensity: there is no scene"]
    lines = []
    if report.filled:
        values = "value" if report.filled_values == 1 else "values"
        where = numbers_text(report.filled)
        lines.append(f"{report.filled_values} NaN or infinite {values} in {where}: filled from around")
    if len(report.stuck):
        places = "; ".join(f"x {place[1]}, y {place[0]}" for place in report.stuck[:3])
        lines.append(
            f"{len(report.stuck)} stuck pixels ({places}{'; …' * (len(report.stuck) > 3)}): replaced by the "
            "median of their neighbours"
        )
    if report.blank:
        lines.append(f"{len(report.blank)} blank: {numbers_text(report.blank)} left out")
    if report.duplicated and repeated:
        lines.append("all frames are the same: there is no turbulence to take out")
    elif report.duplicated:
        lines.append(f"{len(report.duplicated)} duplicated: {numbers_text(report.duplicated)} left out")
    if len(report.scenes) > 1:
        longest = max(report.scenes, key=lambda scene: scene.count)
        others = ", ".join(f"{scene.first}:{scene.last + 1}" for scene in report.scenes if scene is not longest)
        lines.append(
            f"{len(report.scenes)} scenes: only the longest is used, {longest.count} frames from {longest.first} to "
            f"{longest.last}; --frames selects another ({others})"
        )
    if report.saturated >= _SATURATED:
        lines.append(f"{100 * report.saturated:.0f} % of the values are at white: detail there is lost")
    return lines


def _thumbnail(values: FloatArray) -> FloatArray:
    size = min(_SIDE, values.shape[1]), min(_SIDE, values.shape[0])
    thumb = luminance(cv2.resize(values, size, interpolation=cv2.INTER_AREA))
    return thumb - thumb.mean()


def _similarity(a: FloatArray, b: FloatArray) -> float:
    """Normalised cross-correlation at the best circular shift; 0 where one has no detail."""
    scale = float(np.linalg.norm(a)) * float(np.linalg.norm(b))
    if scale == 0:
        return 0.0
    peak = np.fft.irfft2(np.fft.rfft2(a) * np.conj(np.fft.rfft2(b)), a.shape).max()
    return float(peak) / scale


def _with_neighbours(values: PixelArray, places: NDArray[np.int64]) -> tuple[PixelArray, PixelArray]:
    """Values at places off the border, shape (N,), and those of their eight neighbours, shape (N, 8)."""
    rows, columns = places[:, :1] + _AROUND[:, 0], places[:, 1:2] + _AROUND[:, 1]
    channels = [places[:, 2:3]] if places.shape[1] == 3 else []
    return values[tuple(places.T)], values[(rows, columns, *channels)]


def _without_stuck(pixels: PixelArray, stuck: NDArray[np.int64]) -> PixelArray:
    _, around = _with_neighbours(pixels, stuck)
    middle = np.median(around, axis=1)
    repaired = pixels.copy()
    repaired[tuple(stuck.T)] = middle if np.issubdtype(pixels.dtype, np.floating) else np.rint(middle)
    return repaired


def _filled(pixels: PixelArray) -> PixelArray:
    """Fill holes, ring by ring, with the mean of the known among the eight neighbours."""
    missing = ~np.isfinite(pixels)
    if not missing.any():
        return pixels
    with np.errstate(over="ignore"):
        values = np.where(missing, 0, pixels).astype(np.float32)
    for _ in range(_WIDEST_HOLE):
        known = (~missing).astype(np.float32)
        weight = cv2.boxFilter(known, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        total = cv2.boxFilter(values, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        ring = missing & (weight > 0.5)
        values[ring] = total[ring] / weight[ring]
        missing &= ~ring
        if not missing.any():
            break
    values[missing] = np.nan
    return values
