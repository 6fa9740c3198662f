"""Settings, states and results of the alternating filter.

Symbols as in :mod:`turbrestore.filtering.alternating`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from ..core.arrays import FloatArray
from ..core.errors import require, require_between
from ..display.curves import plot_frames
from ..display.preview import preview, summary
from ..registration.recentring import recentring_flow
from ..registration.warp import warp
from .estimates import Gaussian, PixelGaussian

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESIDUALS, TRAININGS = ("keep", "drop"), ("filter", "skip")
# Bytes a pixel while frames are registered and fused: for each channel, for each thread, and for each channel of that.
_SHARED_CHANNEL, _EACH, _EACH_CHANNEL = 15.0, 10.0, 5.0
# Bytes a pixel of means of flows: two sums and a mean; and of a flow that waits in each thread to be added.
_SUMS, _WAITING = 24.0, 8.0


@dataclass(frozen=True)
class FilterParams:
    """How frames are filtered.

    Parameters
    ----------
    residual : {"keep", "drop"}
        Whether frames are registered by the measured flow, or by its estimate in the subspace of the flow model alone;
        ``"drop"`` is the paper as printed.
    inner_iterations : int
        Times that flow is measured, and image and flow updated, for each block of frames.
    training : {"filter", "skip"}
        Whether the frames with known flows are filtered too, or the filter starts after them as in the paper: from the
        state of the last of them, and the image stays in their geometry.
    block : int
        Frames whose flows are measured against the same image; 1 is the paper's, more run side by side.
    sharpness : float
        β: how strongly locally sharp frames are preferred; 0 gives every frame the same scalar gain.  A pixel of a
        frame weighs exp(β z), where z is its local sharpness in standard deviations, shrunk by the share of the
        variance that noise explains; so noise lowers the preference by itself.
    image_noise : float, optional
        Z₀: variance of a registered frame about the image, squared intensity; by default measured on the first block.
    image_drift : float
        S: variance by which the image may drift from one frame to the next, squared intensity.
    prior_frames : float
        Number of frames whose information the starting image is worth; 0 lets the first frames replace it.
    """

    residual: Literal["keep", "drop"] = "keep"
    training: Literal["filter", "skip"] = "filter"
    inner_iterations: int = 2
    block: int = 24
    sharpness: float = 1.0
    image_noise: float | None = None
    image_drift: float = 0.0
    prior_frames: float = 0.0

    def __post_init__(self) -> None:
        for name, value, known in (("residual", self.residual, RESIDUALS), ("training", self.training, TRAININGS)):
            require(value in known, f"{name}: expected one of {', '.join(known)}, found {value!r}")
        require_between("inner_iterations", self.inner_iterations, 1, 100)
        require_between("block", self.block, 1, 10_000, "frames")
        require_between("sharpness", self.sharpness, 0, 10)
        if self.image_noise is not None:
            require_between("image_noise", self.image_noise, 1e-12, 1)
        require_between("image_drift", self.image_drift, 0, 1)
        require_between("prior_frames", self.prior_frames, 0, 1e6)


@dataclass(frozen=True)
class FilterState:
    """Image and flow state after a frame."""

    image: PixelGaussian  # ρ̂ and Σ
    flow: Gaussian  # ξ̂ and P
    flow_sum: FloatArray  # (H, W, 2): sum of W^meas over the frames so far that count, pixels
    # (H, W, 2): mean of W^meas over the frames with known flows, pixels; 0 before they are done, or if there are none.
    training_flow: FloatArray


@dataclass(frozen=True)
class FrameRecord:
    """Figures of one frame; :class:`Filtered` says what each means."""

    flow_state: np.ndarray  # (n,)
    gain: float
    innovation: float
    sharpness: float
    information: float  # mean of 1 / Z over the pixels, before it becomes a share


@dataclass(frozen=True)
class FilterCheckpoint:
    """The filter between two blocks of frames, from which it can be resumed with the same frames."""

    state: FilterState  # after the blocks that are done
    records: tuple[FrameRecord, ...]  # one for each of their frames
    reference: FloatArray  # (H, W) or (H, W, 3): image that the flows of the next block are first measured from


@dataclass(frozen=True)
class FilterStep:
    """Progress of the filter: there is one after each measured flow, and one at the end of each block."""

    # Flows measured so far, including frames that do not count and the run that was resumed; of N frames, the first K
    # of which have known flows, ``inner_iterations * N - K`` in all.
    flows_measured: int
    checkpoint: FilterCheckpoint | None = None  # at the end of a block, the state from which the filter can be resumed


@dataclass(frozen=True)
class Filtered:
    """The filtered image and the record of the run.

    Attributes
    ----------
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        ρ̂ after the last frame, still blurred by Kρ.
    variance : ndarray, float32, shape (H, W)
        Σ after the last frame, squared intensity.
    flow_states : ndarray, float64, shape (N, n)
        ξ̂ after each frame.
    gains : ndarray, float64, shape (N,)
        L of each frame, mean over the pixels.
    innovations : ndarray, float64, shape (N,)
        Root mean square of W^meas − W̄ − C A ξ̂ for each frame, pixels, the error of the prediction; NaN where the
        frame does not count.
    sharpness : ndarray, float64, shape (N,)
        Gradient of each registered frame, projected on that of the image that the filter started from; 1 if they are
        equal, NaN where the frame does not count.
    shares : ndarray, float64, shape (N,)
        Share of the information that each frame brought, mean over the pixels; they sum to 1.
    image_noise : float
        Z₀, squared intensity.
    sharpness_weight : float
        β, the setting ``sharpness``.
    noise_gain : float
        Variance of the noise of the image, relative to that with equal weights.
    mean_flow : ndarray, float32, shape (H, W, 2)
        Mean of W^meas over all frames that count, less that over the frames with known flows, pixels: how far the
        centroid of those, in whose geometry frames are fused, lies from the mean geometry of all frames.  Both means
        have the same bias of the flow method, and the difference has none.  :meth:`recentred` moves image and variance
        there, as :func:`turbrestore.restore` does.
    """

    image: FloatArray
    variance: FloatArray
    flow_states: np.ndarray
    gains: np.ndarray
    innovations: np.ndarray
    sharpness: np.ndarray
    shares: np.ndarray
    image_noise: float
    sharpness_weight: float
    noise_gain: float
    mean_flow: FloatArray

    def recentred(self) -> Filtered:
        """Move image and variance onto the mean geometry; ``mean_flow`` stays, as what was undone.

        Returns
        -------
        Filtered
        """
        if not self.mean_flow.any():
            return self
        V = recentring_flow(self.mean_flow)
        # Linear interpolation keeps variances positive.
        return replace(self, image=warp(self.image, V), variance=warp(self.variance, V, interpolation="linear"))

    def plot(self) -> Figure:
        """Draw how sharp each frame is and how much it counts.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ConfigurationError
            Matplotlib is not installed.
        """
        return plot_frames(self.sharpness, self.shares)

    def __repr__(self) -> str:
        return summary("Filtered", self._facts(), self.image.shape)

    def _repr_html_(self) -> str:
        return preview("Filtered image", self._facts(), self.image)

    def _facts(self) -> list[tuple[str, str]]:
        return [
            ("frames", str(self.gains.size)),
            ("innovation", f"{np.nanmean(self.innovations):.2f} pixels"),
            ("noise of a frame", f"{100 * self.image_noise**0.5:.2f} % of full scale"),
        ]


def filter_memory(shape: tuple[int, ...], train: int, params: FilterParams | None = None, threads: int = 1) -> float:
    """Bytes that the filter takes beside flow, the training frames with their flows, and the modes of the flow model.

    The constants were measured by ``benchmarks/memory.py --stages`` at 1280×720, grey and in colour, with one, two and
    four threads, and rounded up by at least a twentieth.
    """
    params, pixels = params or FilterParams(), float(shape[1] * shape[2])
    channels = shape[3] if len(shape) == 4 else 1
    # A frame, what flow prepares of it, and its flow at half the resolution.
    block = (4.0 * channels + 2.0) * min(params.block, shape[0] - train)
    # From the third iteration on, what flow prepares of the training frames is kept too.
    prepared = float(train) if params.inner_iterations > 2 else 0.0
    each = _EACH + _WAITING + _EACH_CHANNEL * channels
    return pixels * (_SHARED_CHANNEL * channels + _SUMS + threads * each + max(block, prepared))
