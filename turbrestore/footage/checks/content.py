"""Defects of the content of a video: they are found in one pass, then repaired or left out.

====================  =================================================================  =============================
defect                criterion                                                          :func:`clean_source`
====================  =================================================================  =============================
NaN, infinite values  in up to 1 % of a frame; more raises DataError                     fills them from around
black borders         straight and moving, along most of three sides                     filled from other frames
stuck pixels          outside the range of their neighbours in every frame               median of the neighbours
duplicated frames     every value equals that of the frame before                        leaves them out
blank frames          a tenth of the usual contrast or less: lens cap, flash, dropout    leaves them out
overexposed frames    brighter, and with more white, than half of the frames              leaves them out
cuts                  two frames are not similar under any shift                         keeps the longest scene
turned frames         similar to the others once they are turned by 180°                 turns them back
saturation            half of the values or more are white                               only warns
equal channels        three channels are equal in every frame                            reads one of them
====================  =================================================================  =============================

:func:`without_blank` finds blank frames alone, and leaves them out.
The modules beside this one each detect one of these defects.
"""

from __future__ import annotations

import copy
import dataclasses
from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import FloatArray
from ...core.decision import Decision
from ...core.errors import ConfigurationError, DataError, require_type, settings_of
from ...core.remarks import Doubt, counted
from ...io.pixels import PixelArray, mosaic_places, plane_places, planes_of, to_unit, with_planes
from ...io.source import FrameSource, numbers_text
from .black_borders import BlackBorderDetector, without_border
from .colourless import is_grey, may_be_grey, read_as_grey
from .missing_pixels import FEW_MISSING, MOST_MISSING, Backdrop, backdrop_of_file, fill_holes, mean_backdrop
from .overexposure import overexposed
from .repeats import RepeatDetector
from .scene_cuts import MOST_SCENES, Scene, SceneDetector, group_scenes, thumbnail, turned_back
from .stuck_pixels import StuckPixelDetector, repair_stuck

# Blank frames have at most this contrast, half a level of 8 bits, or this share of the median contrast; share of
# saturated pixels that is named.  Both shares are chosen.
LEAST_CONTRAST, BLANK_CONTRAST, _SATURATED = 1 / 510, 0.1, 0.5
# What to do with an array in place of a source.
_OPENED = "use open_frames(path) or FrameSource.from_array(frames)"


@dataclass(frozen=True)
class ContentParams:
    """What is done about defects of the content.

    Parameters
    ----------
    strict : bool
        Raise DataError instead of repairing defects or leaving frames out.
    """

    strict: bool = False


@dataclass(frozen=True, eq=False)
class ContentReport:
    """Defects of the content of a video.

    Attributes
    ----------
    numbers : range or tuple of int
        Numbers, in the file, of the examined frames.
    filled : tuple of int
        Frames with NaN or infinite values.
    filled_values : int
        Number of these values.
    stuck : ndarray, int, shape (N, 2) or (N, 3)
        Row, column, and channel of colour frames, in the file, of every stuck pixel; in the mosaic of a Bayer sensor
        row and column.
    duplicated : tuple of int
        Frames that equal the one before, but for noise of the recording or what a codec leaves.
    blank : tuple of int
        Frames without contrast.
    overexposed : tuple of int
        Frames that are white where other frames show the scene.
    scenes : tuple of Scene
        In the order of their first frames; one where there is no cut.
    turned : tuple of int
        Frames that show the scene turned by 180°, as after the meridian flip of a telescope.
    saturated : float
        Mean share of white values.
    contrast : float
        Largest standard deviation within the thumbnail of a frame; 0 where no frame shows anything.
    left_out : frozenset of int
        Frames that :func:`clean_source` leaves out.
    warnings : tuple of str
        The defects and what is done about them; empty for a clean video.
    backdrop : Backdrop or None
        What frames show behind pixels that others lack; None if no frame lacks more than 1 % and there are no black
        borders.
    grey : bool
        Whether the three channels of every frame are equal, of which :func:`clean_source` then reads one.
    """

    numbers: range | tuple[int, ...]
    filled: tuple[int, ...]
    filled_values: int
    stuck: NDArray[np.int64]
    duplicated: tuple[int, ...]
    blank: tuple[int, ...]
    overexposed: tuple[int, ...]
    scenes: tuple[Scene, ...]
    turned: tuple[int, ...]
    saturated: float
    contrast: float
    left_out: frozenset[int]
    warnings: tuple[str, ...]
    backdrop: Backdrop | None = None
    grey: bool = False


def check_content(source: FrameSource, params: ContentParams | None = None) -> ContentReport:
    """Examine every frame once; memory does not grow with the video, except for 20 bytes per frame.

    Raises
    ------
    DataError
        Damaged frames, too many values that are not finite, or, with ``params.strict``, any defect.
    ConfigurationError
        The source or the settings are of another type.

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
    require_type("source", source, FrameSource, _OPENED)
    params = settings_of(ContentParams, params)
    scan = _ContentScan(source)
    for number, pixels, mosaic in zip(source.numbers, source.native(), source.mosaics(), strict=True):
        scan.update(number, pixels, mosaic)
    report = scan.report()
    repaired = report.filled or report.turned or report.backdrop is not None or len(report.stuck)
    if params.strict and (report.left_out or repaired):
        raise DataError(f"{source.name}: {report.warnings[0]}; refused by strict, leave it out to go on")
    return report


def clean_source(source: FrameSource, report: ContentReport) -> FrameSource:
    """Repair the defects that :func:`check_content` has found, or leave their frames out.

    The returned source repairs frames while they are read, and its ``warnings`` list what is done.

    Raises
    ------
    ConfigurationError
        The report is about other frames, or an argument is of another type.

    Examples
    --------
    >>> frames = np.random.default_rng(0).random((4, 20, 20))
    >>> frames[1, 3, 3] = np.nan
    >>> source = FrameSource.from_array(frames)
    >>> cleaned = clean_source(source, check_content(source))
    >>> bool(np.isfinite(cleaned.read()).all()), cleaned.warnings
    (True, ('1 NaN or infinite value in frame 1: filled from around',))
    """
    require_type("source", source, FrameSource, _OPENED)
    require_type("report", report, ContentReport, "check_content(source) makes one")
    if report.numbers != source.numbers:
        raise ConfigurationError(f"{source.name}: the report is about other frames; check this selection")
    cleaned = source.without(report.left_out, "")
    backdrop = None if report.backdrop is None else backdrop_of_file(report.backdrop, source)
    fill, stuck, before = bool(report.filled) or backdrop is not None, report.stuck, source.repair

    def repaired(pixels: PixelArray) -> PixelArray:
        pixels = pixels if before is None else before(pixels)
        if fill:
            pixels = fill_holes(pixels) if backdrop is None else backdrop.behind(pixels)
        if source.bayer is not None:
            return with_planes(pixels, repair_stuck(planes_of(pixels), plane_places(stuck)))
        return repair_stuck(pixels, stuck) if len(stuck) else pixels

    cleaned = dataclasses.replace(
        cleaned,
        warnings=(*source.warnings, *report.warnings),
        repair=repaired if fill or len(stuck) else source.repair,
        unseen=source.unseen if backdrop is None or not backdrop.unseen.any() else backdrop.unseen,
    )
    cleaned = turned_back(cleaned, frozenset(report.turned)) if report.turned else cleaned
    return read_as_grey(cleaned) if report.grey else cleaned


def without_blank(source: FrameSource) -> tuple[FrameSource, tuple[Decision, ...]]:
    """Leave out frames that show nothing; a source without any is returned as it is."""
    contrasts = np.array([thumbnail(frame).std() for frame in source], np.float64)
    blank = np.asarray(source.numbers)[_are_blank(contrasts)].tolist()
    choice, reason = f"{numbers_text(blank)} left out", f"at most {BLANK_CONTRAST:.0%} of the usual contrast"
    found = Decision("blank frames", choice, reason)
    return (source.without(blank, f"{choice}: {reason}"), (found,)) if blank else (source, ())


def keep_all(report: ContentReport) -> ContentReport:
    """Return the report for a use that keeps every frame: defects are repaired, and nothing is left out."""
    backdrop = report.backdrop
    if backdrop is not None and len(report.scenes) > 1:
        # The backdrop is that of one scene; it must not show in the others.
        backdrop = dataclasses.replace(backdrop, black_borders=False)
    nothing = dataclasses.replace(report, blank=(), overexposed=(), duplicated=(), turned=(), left_out=frozenset())
    kept = dataclasses.replace(nothing, scenes=report.scenes[:1], backdrop=backdrop)
    return dataclasses.replace(kept, warnings=tuple(_in_words(kept, False)))


class _ContentScan:
    """State of the pass over the frames."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self._grey = may_be_grey(source)
        self._previous: PixelArray | None = None
        self._contrasts = array("d")
        self._usual = 0.0
        self._white, self._levels = array("d"), array("d")
        self._filled: list[int] = []
        self._filled_values = 0
        self._duplicated: list[int] = []
        self._repeats = RepeatDetector()
        self._needs_backdrop = False
        self._borders = BlackBorderDetector()
        self._stuck = StuckPixelDetector()
        self._scenes = SceneDetector()
        # The same for a clip with black borders, whose thumbnails are compared without them, from the first one on.
        self._bordered_scenes: SceneDetector | None = None
        self._shown: FloatArray | None = None

    def update(self, number: int, pixels: PixelArray, mosaic: PixelArray | None) -> None:
        pixels = self._with_holes_filled(number, pixels)
        self._grey = self._grey and is_grey(pixels)
        values = to_unit(pixels, self._source.full_scale, f"{self._source.name}: frame {number}")
        self._white.append(np.count_nonzero(values >= 1) / values.size)
        self._levels.append(float(values.mean()))
        if self._previous is not None and np.array_equal(pixels, self._previous):
            self._duplicated.append(number)
        self._previous = pixels
        self._repeats.update(values)
        thumb = shown = thumbnail(values)
        if mosaic is None:
            border = self._borders.update(pixels)
            if border.any():
                if self._bordered_scenes is None:
                    self._bordered_scenes = copy.deepcopy(self._scenes)
                shown = without_border(thumb, border, np.zeros_like(thumb) if self._shown is None else self._shown)
            self._shown = shown
        self._contrasts.append(contrast := float(thumb.std()))
        # A running estimate of the median, because blank frames must reach neither the scenes nor the stuck pixels.
        self._usual += 0.1 * (max(contrast, LEAST_CONTRAST) - self._usual) if self._usual else contrast
        if contrast > max(LEAST_CONTRAST, BLANK_CONTRAST * self._usual):
            # Stuck pixels are isolated in the mosaic; interpolation of colours spreads them.
            self._stuck.update(values if mosaic is None else self._planes(mosaic))
            self._scenes.update(thumb)
            if self._bordered_scenes is not None:
                self._bordered_scenes.update(shown)
        else:
            self._scenes.skip()
            if self._bordered_scenes is not None:
                self._bordered_scenes.skip()

    def report(self) -> ContentReport:
        numbers = np.asarray(self._source.numbers)
        contrasts = np.frombuffer(self._contrasts)
        blank = _are_blank(contrasts)
        duplicated = np.isin(numbers, self._duplicated) | self._repeats.found()
        borders = self._borders.found()
        detector = (borders and self._bordered_scenes) or self._scenes
        labels, turned = np.where(blank, -1, detector.labels()), detector.turned() & ~blank
        if self._needs_backdrop or borders or self._source.unseen is not None:
            # What frames lack is at another place of turned ones, so that they are a scene of their own.
            labels, turned = np.where(turned, labels + MOST_SCENES, labels), np.zeros_like(turned)
        scenes, used = group_scenes(numbers, labels)
        left_out = blank | ~used
        # In a video of one repeated frame there are no others to use.
        repeated = (~(left_out | duplicated)).sum() < 2
        left_out |= duplicated & ~repeated
        left_out |= (bright := overexposed(np.frombuffer(self._white), np.frombuffer(self._levels), ~left_out))
        stuck = self._stuck.found()
        rows, columns = self._source.window
        if self._source.bayer is not None:
            stuck = mosaic_places(stuck) if len(stuck) else stuck
        else:
            stuck[:, 0] += rows.start
            stuck[:, 1] += columns.start
        backdrop = None
        if self._needs_backdrop or borders:
            # Frames that are used are read again, as few clips lack so much.
            frames = self._source.without(numbers[left_out].tolist(), "").native()
            backdrop = mean_backdrop(frames, self._source.shape[1:], borders)
        report = ContentReport(
            numbers=self._source.numbers,
            filled=tuple(self._filled),
            filled_values=self._filled_values,
            stuck=stuck,
            duplicated=tuple(numbers[duplicated].tolist()),
            blank=tuple(numbers[blank].tolist()),
            overexposed=tuple(numbers[bright].tolist()),
            scenes=scenes,
            turned=tuple(numbers[turned & ~left_out].tolist()),
            saturated=float(np.mean(self._white)),
            contrast=float(contrasts.max()),
            left_out=frozenset(numbers[left_out].tolist()),
            warnings=(),
            backdrop=backdrop,
            grey=self._grey,
        )
        return dataclasses.replace(report, warnings=tuple(_in_words(report, bool(repeated))))

    def _planes(self, mosaic: PixelArray) -> FloatArray:
        return np.divide(planes_of(mosaic), self._source.full_scale, dtype=np.float32)

    def _with_holes_filled(self, number: int, pixels: PixelArray) -> PixelArray:
        """Fill isolated values that are not finite; raise DataError where there are too many."""
        if not np.issubdtype(pixels.dtype, np.floating):
            return pixels
        missing = int(pixels.size - np.count_nonzero(np.isfinite(pixels)))
        most = MOST_MISSING if self._source.bayer is None else FEW_MISSING
        if missing > most * pixels.size:
            raise DataError(
                f"{self._source.name}: frame {number}: expected finite values, found {missing} of {pixels.size} NaN or "
                "infinite; select other frames or a region"
            )
        if not missing:
            return pixels
        self._filled.append(number)
        self._filled_values += missing
        filled = fill_holes(pixels)
        if missing > FEW_MISSING * pixels.size:
            self._needs_backdrop = True
            filled = np.where(np.isfinite(filled), filled, np.nanmean(filled)).astype(np.float32)
        return filled


def _in_words(report: ContentReport, repeated: bool) -> list[str]:
    if report.contrast == 0:
        return [Doubt("every frame is of one intensity: there is no scene")]
    lines = []
    if report.filled:
        where = numbers_text(report.filled)
        how = "from around" if report.backdrop is None else _how_filled(report)
        lines.append(f"{counted(report.filled_values, 'NaN or infinite value')} in {where}: filled {how}")
    if report.backdrop is not None and report.backdrop.black_borders:
        lines.append("black borders that move: filled by what other frames show")
    if len(report.stuck):
        places = "; ".join(f"x {place[1]}, y {place[0]}" for place in report.stuck[:3])
        places += "; …" * (len(report.stuck) > 3)
        lines.append(
            f"{counted(len(report.stuck), 'stuck pixel')} ({places}): replaced by the median of the neighbours"
        )
    if report.blank:
        lines.append(f"{len(report.blank)} blank: {numbers_text(report.blank)} left out")
    if report.overexposed:
        which = numbers_text(report.overexposed)
        lines.append(f"{len(report.overexposed)} overexposed: {which} left out; others show what is white in them")
    if report.duplicated and repeated:
        lines.append("all frames are the same: there is no turbulence to take out")
    elif report.duplicated:
        lines.append(f"{len(report.duplicated)} duplicated: {numbers_text(report.duplicated)} left out")
    if len(report.scenes) > 1:
        longest = max(report.scenes, key=lambda scene: scene.count)
        others = ", ".join(f"{scene.first}:{scene.last + 1}" for scene in report.scenes if scene is not longest)
        used = f"{counted(longest.count, 'frame')} from {longest.first} to {longest.last}"
        choice = f"only the longest is used, {used}; to use another, select its frames ({others})"
        lines.append(Doubt(f"{len(report.scenes)} scenes: {choice}"))
    if report.turned:
        which = numbers_text(report.turned)
        lines.append(f"{len(report.turned)} turned by 180°, as by the meridian flip of a mount: {which} turned back")
    if report.grey:
        lines.append("its three channels are equal: read as grey")
    if report.saturated >= _SATURATED:
        lines.append(f"{100 * report.saturated:.0f} % of the values are at white: detail there is lost")
    return lines


def _how_filled(report: ContentReport) -> str:
    unseen = np.zeros(1, bool) if report.backdrop is None else report.backdrop.unseen
    others = "by what other frames show"
    if not unseen.any():
        return others
    share = f"from around, where no frame shows anything ({100 * float(unseen.mean()):.1f} % of the picture)"
    return f"{others}, and {share}" if report.filled_values > unseen.sum() * len(report.numbers) else share


def _are_blank(contrasts: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which frames are blank by their contrasts; none where all would be."""
    blank = contrasts <= BLANK_CONTRAST * np.median(contrasts)
    return np.asarray(blank & ~blank.all())
