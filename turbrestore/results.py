"""What a restoration yields, and where the results of its stages are kept."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from .blur.estimation import BlurEstimate
from .blur.posterior import BlurPosterior
from .core.arrays import ROUNDING, FloatArray
from .core.decision import Decision
from .core.noise_spectrum import NoiseSpectrum
from .core.remarks import counted
from .core.verdict import Check, CheckKind, Verdict
from .deblurring.guards import GuardReading
from .deconvolution.deconvolve import Deconvolution
from .display.maps import plot_images
from .display.preview import preview, summary
from .dynamics.flow_model import FlowDynamics, mean_flow_error
from .filtering.alternating import FilterCheckpoint, Filtered
from .footage.levels import Levels
from .metrics import sharpness
from .registration.centroid import Centroid
from .registration.coverage import Rectangle
from .runtime.scratch import variance_of
from .seeing.strength import Seeing
from .verification.halves import MOSTLY, disputed_detail
from .verification.repetition import repetition
from .verification.structure import StructureReading
from .wording import share_words, write_check

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Result = TypeVar("Result")

# Error of the geometry that is seen, pixels; chosen: a line that is bent by one pixel shows a step.
_SEEN_BEND = 1.0
# Frames whose halves are too few to tell what they agree on, chosen.
FEW = 8
# Share of the image that is worth a look, chosen; most of something.
_UNSEEN, _HALF = 0.01, 0.5
# Largest displacement, in standard deviations along an axis, chosen: 0.3 % of normal ones are larger.
_LARGEST = 3.0


class Store(Protocol):
    """Where a restoration keeps the results of its stages, and finds those of an earlier run.

    :class:`turbrestore.runs.run_folder.RunFolder` keeps them on disk.
    """

    def get(self, name: str, compute: Callable[[], Result]) -> Result:
        """Return the result of that name: the one that was kept, or compute it, keep it and return it."""

    def has(self, name: str) -> bool:
        """Tell whether a result of that name is kept."""

    def set_levels(self, levels: Levels) -> None:
        """Take the levels at which the stages are about to work, so that what is kept can be brought back."""

    def filter_start(self) -> FilterCheckpoint | None:
        """Return the state from which an interrupted filter continues."""

    def checkpoint(self, state: FilterCheckpoint) -> None:
        """Take the newest state of the filter."""


@dataclass(frozen=True, repr=False)
class Restoration:
    """The restored image and everything it came from.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        Result of the last stage that ran; smaller than those of the stages where its border is cropped.
    crop : tuple of int
        x, y, width and height of the image within the frames, pixels.
    mean : ndarray, float32, shape (H, W) or (H, W, 3)
        Temporal mean of the prepared frames, in their size: all of them once the filter has run, else the training
        frames.  Moving objects are not in it.
    centroid : Centroid
    dynamics : FlowDynamics or None
        Where frames are processed in tiles it is for information only: each tile has its own model.
    filtered : Filtered or None
        Recentred: its image is at the mean geometry of all frames; the centroid and its flows are at that of the
        training frames.
    blur : BlurEstimate or None
        Blur of the filtered image by its edges alone; None where it was given.
    posterior : BlurPosterior or None
        Blur by the frames and the image together, which decides on the width that is removed; None where it was given.
    deconvolution : Deconvolution or None
    guard_readings : tuple of GuardReading
        What the guards saw of every width of the blur that was tried.
    decisions : tuple of Decision
        What was chosen from the data, and why, in the order of the stages.
    train : int
        Number of training frames.
    frame_count : int
        Number of frames that were read.
    seconds : dict of str to float
        Wall time of each stage.
    seeing : Seeing or None
        Strength of the turbulence in the training frames, in pixels and frames; None for fewer than three.
    uncertainty : ndarray, float32, shape (H, W), or None
        Standard deviation of every pixel of the image, intensity; infinite where nothing is known, and everywhere
        where the mean of the frames is the result; None unless the filter has run.
    finer : ndarray, float32, shape (s·H, s·W) or (s·H, s·W, 3), or None
        The image on a grid that is ``RestoreParams.scale`` times as fine; None where that is 1.
    disagreement : ndarray, float32, shape (H, W), or None
        Share, 0 to 1, of the mean of the registered frames in the image: where they do not agree on its detail or
        colour, and in flat parts that ring or are noisy; None unless the image was deblurred.
    noise : NoiseSpectrum or None
        Noise of the luminance of the filtered image at every frequency; None unless the filter has run, and where the
        mean of the frames is the result.
    structure : StructureReading or None
        How far the registered frames agree with the filtered image.
    is_mean : bool
        Whether the mean of the frames is the result, because they contradict the filtered image.
    objects_replaced : bool
        Whether moving objects were replaced by the background.
    unseen : float
        Share of the image that hardly any frame shows.
    keep_best : float
        Share of the frames that was asked for.
    """

    image: FloatArray
    crop: Rectangle
    mean: FloatArray
    centroid: Centroid
    train: int
    frame_count: int
    seconds: dict[str, float]
    dynamics: FlowDynamics | None = None
    filtered: Filtered | None = None
    blur: BlurEstimate | None = None
    deconvolution: Deconvolution | None = None
    guard_readings: tuple[GuardReading, ...] = ()
    decisions: tuple[Decision, ...] = ()
    seeing: Seeing | None = None
    uncertainty: FloatArray | None = None
    posterior: BlurPosterior | None = None
    finer: FloatArray | None = None
    disagreement: FloatArray | None = None
    noise: NoiseSpectrum | None = None
    structure: StructureReading | None = None
    is_mean: bool = False
    objects_replaced: bool = False
    unseen: float = 0.0
    keep_best: float = 1.0

    @property
    def motion(self) -> float:
        """Displacement of the training frames about its mean, root mean square over pixels and frames, pixels."""
        return math.sqrt(float(variance_of(self.centroid.flows).sum(axis=-1).mean()))

    @property
    def shown(self) -> tuple[slice, slice]:
        """Rows and columns of the frames that the image shows; see :attr:`crop`."""
        x, y, width, height = self.crop
        return slice(y, y + height), slice(x, x + width)

    @property
    def sharpening(self) -> float:
        """Sharpness of the image relative to the temporal mean; NaN where the mean has no contrast."""
        mean = self.mean[self.shown]
        return sharpness(self.image, mean) if np.ptp(mean) > 0 else math.nan

    @property
    def verdict(self) -> Verdict:
        """What was gained, and what to look at; computed from the images at every call."""
        motion = self.motion
        return Verdict(_gained(self, motion), tuple(_checks(self, motion)))

    def plot(self) -> Figure:
        """Draw the temporal mean beside the result; ConfigurationError without Matplotlib."""
        return plot_images({"mean": self.mean[self.shown], "result": self.image})

    def __repr__(self) -> str:
        return summary("Restoration", [*self._facts(), ("verdict", str(self.verdict))], self.image.shape)

    def _repr_html_(self) -> str:
        choices = [(decision.subject, decision.choice) for decision in self.decisions]
        return preview("Restoration", [*self._facts(), *choices], self.image)

    def _facts(self) -> list[tuple[str, str]]:
        sigma = 0.0 if self.deconvolution is None else self.deconvolution.sigma
        return [
            ("frames", f"{self.frame_count}, {self.train} to train"),
            ("blur removed", f"{sigma:.2f} pixels" if sigma > 0 else "none"),
            ("time", f"{sum(self.seconds.values()):.1f} s"),
        ]


def at_levels_of_clip(result: Result, levels: Levels) -> Result:
    """Bring the result of a stage from the levels of the stages back to those of the clip."""
    gain = levels.gain
    if not levels.changed:
        return result
    if isinstance(result, Centroid):
        return replace(result, image=levels.original(result.image))
    if isinstance(result, Filtered):
        image, noise = levels.original(result.image), result.image_noise / gain**2
        return replace(result, image=image, variance=result.variance / np.float32(gain**2), image_noise=noise)
    if isinstance(result, Deconvolution):
        return replace(result, image=levels.original(result.image), noise=result.noise / gain)
    if isinstance(result, BlurEstimate):
        return replace(result, noise=result.noise / gain)
    return result


def _gained(restoration: Restoration, motion: float) -> str:
    count, gain = counted(restoration.frame_count, "frame"), restoration.sharpening
    if restoration.is_mean:
        return f"the mean of {count} is the result"
    removed = [f"{motion:.2f} pixels of motion"]
    if restoration.deconvolution is not None and restoration.deconvolution.sigma > 0:
        removed.append(f"{restoration.deconvolution.sigma:.2f} pixels of blur")
    # Rings and noise are no sharpness.
    sharper = "" if math.isnan(gain) or _is_too_sharp(restoration) else f"{gain:.2f} times as sharp as the mean of "
    objects = ", moving objects replaced by the background" if restoration.objects_replaced else ""
    return f"{sharper}{count}, with {' and '.join(removed)} removed{objects}"


def _checks(restoration: Restoration, motion: float) -> Iterator[Check]:
    for decision in restoration.decisions:
        if decision.check is not None:
            yield write_check(decision.check, decision.reason)
    structure, filtered = restoration.structure, restoration.filtered
    if restoration.is_mean:
        changes = structure is not None and structure.unexplained_change
        remedy = "leave out --keep-best, or " if restoration.keep_best < 1 else ""
        yield write_check(CheckKind.SCENE_CHANGES if changes else CheckKind.CONTRADICTION, remedy)
    if restoration.unseen > _UNSEEN:
        yield write_check(CheckKind.UNSEEN, share_words(restoration.unseen))
    if restoration.is_mean or filtered is None or restoration.dynamics is None:
        return
    # A shift, turn or zoom of the whole frame bends no line.
    of_air = _share_of_air(restoration.centroid.flows)
    period, largest = repetition(restoration.mean), _LARGEST * of_air * motion / math.sqrt(2)
    if period < 2 * largest:
        yield write_check(CheckKind.REPETITION, period, largest)
    # Frames that were not kept make neither the image nor its geometry.
    kept = int(np.isfinite(filtered.sharpness).sum())
    error = of_air * mean_flow_error(restoration.dynamics, kept)
    if kept < FEW:
        yield write_check(CheckKind.FEW_FRAMES, counted(kept, "frame"), error, FEW)
    elif error > _SEEN_BEND:
        yield write_check(CheckKind.GEOMETRY, error, counted(kept, "frame"))
    # Where little moves, what is left of the differences is noise and compression.
    if structure is not None and structure.left > _HALF and structure.motion_left(motion) > _SEEN_BEND:
        yield write_check(CheckKind.MOTION, structure.left)
    if (disputed := _disputed(restoration)) > MOSTLY:
        yield write_check(CheckKind.AGREEMENT, disputed)
    yield from _checks_of_blur(restoration)


def _checks_of_blur(restoration: Restoration) -> Iterator[Check]:
    done = restoration.deconvolution
    if done is None:
        return
    removed = float(done.sigma)
    if _is_too_sharp(restoration):
        yield write_check(CheckKind.TOO_SHARP, removed)
    if restoration.posterior is None:
        return
    if restoration.blur is not None and not math.isfinite(restoration.blur.uncertainty):
        yield write_check(CheckKind.BLUR_UNKNOWN)
        return
    decided, (low, width, high) = float(restoration.posterior.removed), map(float, restoration.posterior.width)
    # A pixel and one interpolation blur by a box of one pixel each.
    is_seen = width > 1 / math.sqrt(6)
    if removed < _HALF * decided:
        yield write_check(CheckKind.BLUR_LEFT if removed > 0 else CheckKind.NO_BLUR_REMOVED, decided, removed)
    elif is_seen and removed < min(low, _HALF * width):
        yield write_check(CheckKind.LESS_THAN_MEASURED, width, low, high)


def _is_too_sharp(restoration: Restoration) -> bool:
    """Whether the guards object to what was removed."""
    done, readings = restoration.deconvolution, restoration.guard_readings
    return done is not None and done.sigma > 0 and bool(readings) and not readings[-1].passed


def _share_of_air(flows: FloatArray) -> float:
    """Share of the motion, flows (T, H, W, 2), that is no shift, turn or zoom of whole frames."""
    some = flows[:, ::4, ::4] - flows[:, ::4, ::4].mean(axis=0)
    bent = some - np.median(some, axis=(1, 2), keepdims=True)
    y, x = (axis - axis.mean() for axis in np.mgrid[: some.shape[1], : some.shape[2]].astype(np.float32))
    # Displacements (dx, dy) by a zoom, and by a turn about the middle.
    for mode in (np.stack([x, y], axis=-1), np.stack([-y, x], axis=-1)):
        size = np.einsum("thwc,hwc->t", bent, mode) / max(float(np.square(mode).sum()), ROUNDING)
        bent -= np.multiply.outer(size, mode)
    return float(np.linalg.norm(bent) / max(float(np.linalg.norm(some)), ROUNDING))


def _disputed(restoration: Restoration) -> float:
    """Share of the detail of the result on which the frames do not agree."""
    if restoration.disagreement is None:
        return 0.0
    return disputed_detail(restoration.disagreement, restoration.mean[restoration.shown])
