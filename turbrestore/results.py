"""What a restoration yields, and where the results of its stages are kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeVar

from .blind.guards import GuardReading
from .blur.estimation import BlurEstimate
from .core.arrays import FloatArray
from .core.decision import Decision
from .deconvolution.deconvolve import Deconvolution
from .display.plots import plot_images
from .display.preview import preview
from .dynamics.flow_model import FlowDynamics
from .filtering.alternating import FilterCheckpoint, Filtered
from .registration.centroid import Centroid
from .registration.coverage import Rectangle
from .seeing.strength import Seeing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Result = TypeVar("Result")


class Store(Protocol):
    """Where a restoration keeps the results of its stages, and finds those of an earlier run.

    :class:`turbrestore.runs.run_folder.RunFolder` keeps them on disk; :class:`NoStore` keeps nothing.
    """

    def get(self, name: str, compute: Callable[[], Result]) -> Result:
        """Return the result of that name: the one that was kept, else the one that is computed now and then kept."""

    @property
    def stored(self) -> frozenset[str]:
        """Names of the files on disk that hold the results of stages."""

    def filter_start(self) -> FilterCheckpoint | None:
        """Return the state from which an interrupted filter continues."""

    def checkpoint(self, state: FilterCheckpoint) -> None:
        """Take the newest state of the filter."""


class NoStore:
    """A store that computes every result and keeps none.

    Examples
    --------
    >>> NoStore().get("seven", lambda: 7)
    7
    """

    stored = frozenset[str]()

    def get(self, name: str, compute: Callable[[], Result]) -> Result:
        """Compute the result."""
        return compute()

    def filter_start(self) -> None:
        """Return None: there is no earlier run."""

    def checkpoint(self, state: FilterCheckpoint) -> None:
        """Let the state go."""


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
        Temporal mean of the prepared frames, in their size: all of them once the filter has run, else the training
        frames.  What passes through the scene is not in it.
    centroid : Centroid
    dynamics : FlowDynamics or None
        Where frames are processed in tiles it is for the record: the filter has a model of each tile.
    filtered : Filtered or None
        Recentred: its image is at the mean geometry of all frames; the centroid and its flows are at that of the
        training frames.
    blur : BlurEstimate or None
        Estimated blur of the filtered image; None where sigma was given.
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
    disagreement : ndarray, float32, shape (H, W), or None
        Share, 0 to 1, of the mean of the registered frames in the detail of the image, because they do not agree on it;
        None unless the image was deblurred.
    """

    image: FloatArray
    crop: Rectangle
    mean: FloatArray
    centroid: Centroid
    dynamics: FlowDynamics | None
    filtered: Filtered | None
    blur: BlurEstimate | None
    deconvolution: Deconvolution | None
    guard_readings: tuple[GuardReading, ...]
    decisions: tuple[Decision, ...]
    train: int
    frame_count: int
    seconds: dict[str, float]
    seeing: Seeing | None = None
    uncertainty: FloatArray | None = None
    disagreement: FloatArray | None = None

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
