"""What a restoration yields, and where the results of its stages are kept."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from .blind.guards import GuardReading
from .blur.estimation import BlurEstimate
from .blur.posterior import BlurPosterior
from .core.arrays import FloatArray
from .core.decision import Decision
from .core.noise_spectrum import NoiseSpectrum
from .core.remarks import counted
from .deconvolution.deconvolve import Deconvolution
from .display.maps import plot_images
from .display.preview import preview
from .dynamics.flow_model import FlowDynamics
from .filtering.alternating import FilterCheckpoint, Filtered
from .footage.levels import Levels
from .metrics import sharpness
from .registration.centroid import Centroid
from .registration.coverage import Rectangle
from .runtime.scratch import variance_of
from .seeing.strength import Seeing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Result = TypeVar("Result")

# Frames that move less have little to undo, pixels; an image that gains less is no sharper than the mean.
_STILL, _NO_GAIN = 0.05, 1.02
# An image of fewer frames, if all had equal weight, is about as noisy as one of them.
_FEW_FRAMES = 4
# Share of pixels without information that is worth a look.
_UNKNOWN = 0.01
# Decisions that are a doubt about the image, whatever they choose.
_DOUBTS = ("input", "motion", "saturation")


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


@dataclass(frozen=True)
class Verdict:
    """What a restoration gained, and what a person should look at.

    Attributes
    ----------
    gained : str
        One sentence without a full stop.
    checks : tuple of str
        One clause each; empty where nothing is doubtful.

    Examples
    --------
    >>> str(Verdict("1.50 times as sharp as the mean of 48 frames", ()))
    '1.50 times as sharp as the mean of 48 frames; looks right'
    """

    gained: str
    checks: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.gained}; " + (f"check: {'; '.join(self.checks)}" if self.checks else "looks right")


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
        Where frames are processed in tiles it is for the record: the filter has a model of each tile.
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
        Noise of the filtered image at every frequency, in the levels of the stages; None unless a blur is looked for.
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

    @property
    def motion(self) -> float:
        """Displacement of the training frames about its mean, root mean square over pixels and frames, pixels."""
        return math.sqrt(float(variance_of(self.centroid.flows).sum(axis=-1).mean()))

    @property
    def sharpening(self) -> float:
        """Sharpness of the image relative to the temporal mean; NaN where the mean has no contrast."""
        x, y, width, height = self.crop
        mean = self.mean[y : y + height, x : x + width]
        return sharpness(self.image, mean) if np.ptp(mean) > 0 else math.nan

    @property
    def is_mean(self) -> bool:
        """Whether the mean of the frames is the result, because they contradict the filtered image."""
        return any(decision.subject == "structure" for decision in self.decisions)

    @property
    def verdict(self) -> Verdict:
        """What was gained, and what to look at; computed from the images at every call."""
        motion, gain = self.motion, self.sharpening
        return Verdict(_gained(self, motion, gain), tuple(_checks(self, motion, gain)))

    def plot(self) -> Figure:
        """Draw the temporal mean beside the result.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ConfigurationError
            Matplotlib is not installed.
        """
        x, y, width, height = self.crop
        return plot_images({"mean": self.mean[y : y + height, x : x + width], "result": self.image})

    def __repr__(self) -> str:
        height, width = self.image.shape[:2]
        lines = [f"Restoration: {width}×{height} pixels", *(f"{name}: {value}" for name, value in self._facts())]
        return "\n".join([*lines, f"verdict: {self.verdict}"])

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


def _gained(restoration: Restoration, motion: float, gain: float) -> str:
    count = counted(restoration.frame_count, "frame")
    if restoration.is_mean:
        return f"the mean of {count} is the result"
    removed = [f"{motion:.2f} pixels of motion"]
    if restoration.deconvolution is not None and restoration.deconvolution.sigma > 0:
        removed.append(f"{restoration.deconvolution.sigma:.2f} pixels of blur")
    sharper = "" if math.isnan(gain) else f"{gain:.2f} times as sharp as the mean of "
    return f"{sharper}{count}, with {' and '.join(removed)} removed"


def _checks(restoration: Restoration, motion: float, gain: float) -> Iterator[str]:
    if restoration.is_mean:
        yield "the frames contradict the filtered image; the scene itself may move"
    elif motion < _STILL:
        yield f"the frames hardly move ({motion:.2f} pixels), so there was little to undo"
    elif gain < _NO_GAIN:
        yield "the image is no sharper than the mean of the frames"
    if not restoration.centroid.converged:
        yield "the centroid has not converged"
    yield from (decision.reason for decision in restoration.decisions if decision.subject in _DOUBTS)
    if restoration.dynamics is not None and restoration.dynamics.overfitted:
        yield "the flow model is overfitted: too few flows for so many states"
    if any(decision.subject == "moving objects" for decision in restoration.decisions):
        yield "moving objects were replaced by the background and may have left traces"
    if restoration.seeing is not None and (doubt := restoration.seeing.disagreement):
        yield doubt
    if restoration.filtered is not None and not restoration.is_mean:
        effective = 1 / float(np.square(restoration.filtered.shares).sum())
        if effective < _FEW_FRAMES:
            yield f"the image is as noisy as the average of {effective:.1f} frames"
    yield from _checks_of_blur(restoration)
    deviation = restoration.uncertainty
    if deviation is not None and not restoration.is_mean and (unknown := np.isinf(deviation).mean()) > _UNKNOWN:
        yield f"{unknown:.0%} of the pixels are saturated or seen in no frame"


def _checks_of_blur(restoration: Restoration) -> Iterator[str]:
    done, readings = restoration.deconvolution, restoration.guard_readings
    if done is None:
        return
    if readings and not readings[-1].passed:
        if done.sigma > 0:
            yield "at the width that was given, edges ring or overshoot, or noise is amplified"
        else:
            yield "no blur is removed, because every width made edges ring or overshoot"
    if restoration.blur is not None and not math.isfinite(restoration.blur.uncertainty):
        yield "the width of the blur could not be measured"
    if done.sigma > 0 and not done.converged:
        yield "the deconvolution has not converged"
