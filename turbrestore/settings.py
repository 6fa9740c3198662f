"""A restoration: its settings, what has been done of one, and its result."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from .blind.guards import GuardParams, GuardReading
from .blind.remove_blur import Deblurred
from .blur.blur_cues import BlurBounds
from .blur.estimation import BlurEstimate
from .core.arrays import FloatArray
from .core.decision import Decision
from .core.errors import require
from .deconvolution.deconvolve import Deconvolution, DeconvolutionParams
from .display.plots import plot_images
from .display.preview import preview
from .dynamics.dynamic_texture import DynamicsParams
from .dynamics.flow_model import FlowDynamics
from .filtering.alternating import FilterCheckpoint, Filtered, FilterParams
from .footage.frame_selection import Share, check_share
from .registration.centroid import Centroid, CentroidParams
from .registration.coverage import Rectangle
from .registration.flow import FlowParams
from .tiled_stages import FilteredTiles

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STAGES = ("centroid", "identify", "filter", "deconvolve")
BORDERS = ("keep", "crop")
_ALL = Share(1)


@dataclass(frozen=True)
class StageResults:
    """What has been done of a restoration; one that was interrupted goes on from here.

    Attributes
    ----------
    centroid : Centroid or None
    dynamics : FlowDynamics or None
    checkpoint : FilterCheckpoint or None
        Where the filter stands; None before and after it, and where it works in tiles.
    tiles : FilteredTiles or None
        Where a filter that works in tiles stands.
    filtered : Filtered or None
    mean : ndarray, float32, shape (H, W) or (H, W, 3), or None
        Temporal mean of the frames that were filtered.
    blur_bounds : BlurBounds or None
    deblurred : Deblurred or None
    """

    centroid: Centroid | None = None
    dynamics: FlowDynamics | None = None
    checkpoint: FilterCheckpoint | None = None
    tiles: FilteredTiles | None = None
    filtered: Filtered | None = None
    mean: FloatArray | None = None
    blur_bounds: BlurBounds | None = None
    deblurred: Deblurred | None = None


@dataclass(frozen=True)
class RestoreParams:
    """Settings of the whole chain.

    Parameters
    ----------
    train : int, optional
        Frames, from the first on, that give the centroid and the flow dynamics.  By default all of up to 40, then
        half of them, at most 100.
    until : {"centroid", "identify", "filter", "deconvolve"}
        Last stage to run.
    keep_best : float
        Lucky imaging: share of the frames, the sharpest, that the image is made of; such as 0.3 or 30%.
    border : {"keep", "crop"}
        Keep the border, where fewer frames show the scene, or crop it to what nine frames in ten show.
    displacement_cue : bool
        Draw the size of the motion in the flow model towards what the blur of the mean of the training frames says.
    blur_bounds : bool
        Keep an estimated width of the blur within what the blur of frames, mean and fused image relative to each other
        allows.
    flow : FlowParams
        Optical flow.
    centroid : CentroidParams
        Centroid iteration.
    dynamics : DynamicsParams
        Dynamic texture of the flow.
    filter : FilterParams
        Alternating-estimation Kalman filter.
    deconvolution : DeconvolutionParams
        Deconvolution.
    guards : GuardParams
        What the deconvolved image must not exceed.
    """

    train: int | None = None
    until: Literal["centroid", "identify", "filter", "deconvolve"] = "deconvolve"
    keep_best: Share = _ALL
    border: Literal["keep", "crop"] = "keep"
    displacement_cue: bool = False
    blur_bounds: bool = False
    flow: FlowParams = field(default_factory=FlowParams)
    centroid: CentroidParams = field(default_factory=CentroidParams)
    dynamics: DynamicsParams = field(default_factory=DynamicsParams)
    filter: FilterParams = field(default_factory=FilterParams)
    deconvolution: DeconvolutionParams = field(default_factory=DeconvolutionParams)
    guards: GuardParams = field(default_factory=GuardParams)

    def __post_init__(self) -> None:
        require(self.train is None or self.train >= 2, f"train: expected 2 frames or more, found {self.train}")
        require(
            self.until == STAGES[-1] or self.deconvolution.sigma is None,
            f"deconvolution.sigma: has no effect with until = {self.until}; leave one of them out",
        )
        require(self.border in BORDERS, f"border: expected one of {', '.join(BORDERS)}, found {self.border!r}")
        check_share(self.keep_best)
        require(
            self.keep_best == 1 or self.until in STAGES[2:],
            f"keep_best: has no effect with until = {self.until}; leave one of them out",
        )
        require(self.until in STAGES, f"until: expected one of {', '.join(STAGES)}, found {self.until!r}")
        require(
            not self.blur_bounds or (self.until == STAGES[-1] and self.deconvolution.sigma is None),
            "blur_bounds: has an effect only where the width of the blur is estimated; leave it out",
        )


@dataclass(frozen=True)
class Restoration:
    """The restored image and everything it came from.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        Result of the last stage that ran; smaller than those of the stages where its border is cropped.
    crop : tuple of int
        x, y, width and height of the image within the frames, pixels.
    mean : ndarray, float32, shape (H, W) or (H, W, 3)
        Temporal mean of the frames that were read, in their size: all of them once the filter has run, else the
        training frames.
    centroid : Centroid
    dynamics : FlowDynamics or None
        Where frames are worked on in tiles it is for the record, without the displacement cue: the filter has a model
        of each tile.
    filtered : Filtered or None
    blur : BlurEstimate or None
        Estimated blur of the filtered image; None where sigma was given.
    blur_bounds : BlurBounds or None
        Bounds that the estimated width was kept within; None where they were not asked for.
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
    """

    image: FloatArray
    crop: Rectangle
    mean: FloatArray
    centroid: Centroid
    dynamics: FlowDynamics | None
    filtered: Filtered | None
    blur: BlurEstimate | None
    blur_bounds: BlurBounds | None
    deconvolution: Deconvolution | None
    guard_readings: tuple[GuardReading, ...]
    decisions: tuple[Decision, ...]
    train: int
    frame_count: int
    seconds: dict[str, float]

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

    def _repr_html_(self) -> str:
        sigma = 0.0 if self.deconvolution is None else self.deconvolution.sigma
        facts = [
            ("frames", f"{self.frame_count}, {self.train} to train"),
            ("blur removed", f"{sigma:.2f} pixels" if sigma > 0 else "none"),
            ("time", f"{sum(self.seconds.values()):.1f} s"),
            *((decision.subject, decision.choice) for decision in self.decisions),
        ]
        return preview("Restoration", facts, self.image)
