"""The whole chain: frames → centroid → flow dynamics → alternating filter → deconvolution (paper 3, Figure 9)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from .alternating import FilterCheckpoint, Filtered, FilterParams, filter_frames
from .arrays import FloatArray
from .blind import Deblurred, remove_blur
from .blur_cues import BlurBounds, bound_blur, displacement_maps
from .blur_estimation import BlurEstimate
from .border import Rectangle, coverage, well_seen
from .centroid import Centroid, CentroidParams, find_centroid
from .decision import Decision
from .deconvolution import Deconvolution, DeconvolutionParams
from .dynamics import DynamicsParams, FlowDynamics, identify, with_displacement
from .errors import DataError, require
from .explanation import (
    explain_border,
    explain_camera,
    explain_centroid,
    explain_dynamics,
    explain_frames,
    explain_input,
    explain_motion,
    explain_training,
)
from .flow import MIN_SIDE, FlowParams
from .frame_selection import Share, best_frames, check_share, frame_quality
from .frame_source import FrameSource
from .guards import GuardParams, GuardReading
from .plots import plot_images
from .preview import preview
from .psf import KOLMOGOROV

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STAGES = ("centroid", "identify", "filter", "deconvolve")
BORDERS = ("keep", "crop")
# Share of the training frames that show every pixel of a cropped image.
_SEEN = 0.9
_ALL = Share(1)
# Contrast below one grey level of an 8-bit camera is no scene.
_LEAST_CONTRAST = 1 / 255
_FEWEST_TRAINED, _MOST_TRAINED = 40, 100
# A blur wider than this share of the image leaves nothing to restore.
_SIGMAS_A_SIDE = 8
# Training frames and their flows stay in memory: 12 bytes a pixel for grey frames, up to this many bytes.
_TRAINING_BYTES = 1.5e9

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class StageResults:
    """What has been done of a restoration; one that was interrupted goes on from here.

    Attributes
    ----------
    centroid : Centroid or None
    dynamics : FlowDynamics or None
    checkpoint : FilterCheckpoint or None
        Where the filter stands; None before and after it.
    filtered : Filtered or None
    mean : ndarray, float32, shape (H, W) or (H, W, 3), or None
        Temporal mean of the frames that were filtered.
    blur_bounds : BlurBounds or None
    deblurred : Deblurred or None
    """

    centroid: Centroid | None = None
    dynamics: FlowDynamics | None = None
    checkpoint: FilterCheckpoint | None = None
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


def restore(
    frames: FrameSource | ArrayLike,
    params: RestoreParams | None = None,
    progress: Progress | None = None,
    done: StageResults | None = None,
    on_result: Callable[[StageResults], None] | None = None,
) -> Restoration:
    """Restore one image from frames of a static scene.

    The frames are read from the first to the last, once (twice where only the best are kept); only the training frames
    stay in memory.

    Parameters
    ----------
    frames : FrameSource or array_like, shape (T, H, W) or (T, H, W, 3)
        At least two frames of at least 16×16 pixels.
    params : RestoreParams, optional
        Settings of every stage.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.
    done : StageResults, optional
        What an earlier run of the same frames and settings has done already; the result is the same, bit for bit.
        Nothing is checked: :mod:`turbrestore.resumption` keeps results on disk and tells which still hold.
    on_result : callable, optional
        Called with all that is done after each stage, and after each block of frames in the filter.

    Returns
    -------
    Restoration

    Raises
    ------
    DataError
        Too few, too small, damaged or constant frames.
    ConfigurationError
        More training frames than frames.

    Examples
    --------
    >>> import numpy as np
    >>> from turbrestore.synthesis.scenes import resolution_chart
    >>> from turbrestore.synthesis.smooth_flow import distort, smooth_flows
    >>> rng = np.random.default_rng(0)
    >>> frames = distort(resolution_chart(64, 64), smooth_flows(6, 64, 64, rng), rng, blur=1.0, noise=0.01)
    >>> restoration = restore(frames)
    >>> restoration.image.shape, restoration.train
    ((64, 64), 6)
    """
    params = params or RestoreParams()
    source = frames if isinstance(frames, FrameSource) else FrameSource.from_array(frames)
    train = training_share(len(source), source.shape[1:], params.train)
    _check_sigma(params.deconvolution.sigma, source.shape)
    stages = STAGES[: STAGES.index(params.until) + 1]
    run = _Run(source, params, progress, done or StageResults(), on_result)
    stream = iter(source)
    training = _read_training(stream, train)
    run.clock.lap("read")
    centroid = _find_centroid(run, training)
    image, mean = centroid.image, training.mean(axis=0, dtype=np.float32)
    dynamics = filtered = deblurred = None
    if "identify" in stages:
        dynamics = _identify(run, centroid, training)
    if "filter" in stages and dynamics is not None:
        filtered, mean = _filter(run, centroid, dynamics, training, stream)
        image = filtered.image
    if "deconvolve" in stages:
        deblurred = _deblur(run, image, mean, centroid, training)
        image = deblurred.deconvolution.image
    crop, on_border = _crop(image, centroid.flows, params.border, deblurred)
    x, y, width, height = crop
    return Restoration(
        image=image if params.border == "keep" else image[y : y + height, x : x + width],
        crop=crop,
        mean=mean,
        centroid=centroid,
        dynamics=dynamics,
        filtered=filtered,
        blur=None if deblurred is None else deblurred.blur,
        blur_bounds=run.done.blur_bounds,
        deconvolution=None if deblurred is None else deblurred.deconvolution,
        guard_readings=() if deblurred is None else deblurred.readings,
        decisions=(*_decisions(run, training, centroid, dynamics, filtered, deblurred), on_border),
        train=train,
        frame_count=len(source) if filtered is not None else train,
        seconds=run.clock.seconds,
    )


def training_share(frame_count: int, frame_shape: tuple[int, ...], wanted: int | None = None) -> int:
    """How many frames the centroid and the flow dynamics are taken from.

    Parameters
    ----------
    frame_count : int
        Frames there are.
    frame_shape : tuple of int
        (H, W) or (H, W, 3).
    wanted : int, optional
        What the user asked for.

    Returns
    -------
    int
        ``wanted``; else all of up to 40 frames, then half of them, at most 100 and at most what 1.5 GB hold.

    Raises
    ------
    DataError
        Fewer than two frames, or frames too small.
    ConfigurationError
        More wanted than there are.

    Examples
    --------
    >>> [training_share(n, (256, 256)) for n in (5, 40, 60, 120, 900)]
    [5, 40, 40, 60, 100]
    """
    if frame_count < 2:
        raise DataError(f"frames: expected at least 2 to restore an image from, found {frame_count}")
    if min(frame_shape[:2]) < MIN_SIDE:
        raise DataError(
            f"frames: expected at least {MIN_SIDE}×{MIN_SIDE} pixels, found {frame_shape[1]}×{frame_shape[0]}"
        )
    if wanted is not None:
        require(wanted >= 2, f"train: expected 2 frames or more, found {wanted}")
        require(wanted <= frame_count, f"train: expected at most the {frame_count} frames there are, found {wanted}")
        return wanted
    share = min(max(frame_count // 2, _FEWEST_TRAINED), _MOST_TRAINED)
    frame_bytes = 4 * (int(np.prod(frame_shape)) + 2 * frame_shape[0] * frame_shape[1])
    return min(frame_count, max(2, min(share, int(_TRAINING_BYTES // frame_bytes))))


def stage_counter(progress: Progress | None, stage: str, total: int) -> Callable[[int], None] | None:
    """Turn ``progress(stage, done, total)`` into the callback of one stage, which is told of single steps.

    Parameters
    ----------
    progress : callable or None
    stage : str
        Name of the stage.
    total : int
        Largest number of steps.

    Returns
    -------
    callable or None
        Takes a number of steps; None if ``progress`` is.

    Examples
    --------
    >>> step = stage_counter(lambda stage, done, total: print(stage, done, total), "filter", 5)
    >>> step(2)
    filter 2 5
    """
    if progress is None:
        return None
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        progress(stage, done, total)

    return advance


class _Clock:
    """Wall time between laps."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now


class _Sum:
    """Frames passed on, and their sum kept, so that the mean of all costs no second reading."""

    def __init__(self, training: FloatArray, rest: Iterable[FloatArray]) -> None:
        self._training, self._rest = training, rest
        self._total = np.zeros(training.shape[1:])
        self._count = 0

    def __iter__(self) -> Iterator[FloatArray]:
        for frames in (self._training, self._rest):
            for frame in frames:
                self._total += frame
                self._count += 1
                yield frame

    def mean(self) -> FloatArray:
        return (self._total / self._count).astype(np.float32)


class _Run:
    """What every stage needs, and what is done so far."""

    def __init__(
        self,
        source: FrameSource,
        params: RestoreParams,
        progress: Progress | None,
        done: StageResults,
        on_result: Callable[[StageResults], None] | None,
    ) -> None:
        self.source, self.params, self.progress = source, params, progress
        self.done = done
        self.clock = _Clock()
        self._on_result = on_result

    def finish(self, done: StageResults, stage: str | None = None) -> None:
        self.done = done
        if stage is not None:
            self.clock.lap(stage)
        if self._on_result is not None:
            self._on_result(done)


def _find_centroid(run: _Run, training: FloatArray) -> Centroid:
    if run.done.centroid is not None:
        return run.done.centroid
    params = run.params
    counter = stage_counter(run.progress, "centroid", len(training) * params.centroid.iterations)
    centroid = find_centroid(training, params.centroid, params.flow, counter)
    run.finish(replace(run.done, centroid=centroid), "centroid")
    return centroid


def _identify(run: _Run, centroid: Centroid, training: FloatArray) -> FlowDynamics:
    if run.done.dynamics is not None:
        return run.done.dynamics
    dynamics = identify(centroid.flows, run.params.dynamics)
    if run.params.displacement_cue:
        dynamics = with_displacement(dynamics, *displacement_maps(training))
    run.finish(replace(run.done, dynamics=dynamics), "identify")
    return dynamics


def _filter(
    run: _Run, centroid: Centroid, dynamics: FlowDynamics, training: FloatArray, rest: Iterator[FloatArray]
) -> tuple[Filtered, FloatArray]:
    """Return the filtered image, and the mean of all frames."""
    if run.done.filtered is not None and run.done.mean is not None:
        return run.done.filtered, run.done.mean
    params, source = run.params, run.source
    counted = None if params.keep_best == 1 else best_frames(frame_quality(source), params.keep_best)
    summed = _Sum(training, rest)
    filtered = filter_frames(
        summed,
        centroid.image,
        dynamics,
        params.filter,
        params.flow,
        centroid.flows,
        stage_counter(run.progress, "filter", len(source) * params.filter.inner_iterations - len(training)),
        counted,
        run.done.checkpoint,
        lambda checkpoint: run.finish(replace(run.done, checkpoint=checkpoint)),
    )
    mean = summed.mean()
    run.finish(replace(run.done, checkpoint=None, filtered=filtered, mean=mean), "filter")
    return filtered, mean


def _deblur(run: _Run, image: FloatArray, mean: FloatArray, centroid: Centroid, training: FloatArray) -> Deblurred:
    if run.done.deblurred is not None:
        return run.done.deblurred
    params, bounds = run.params, None
    if params.blur_bounds:
        exponent = params.deconvolution.exponent or KOLMOGOROV
        bounds = bound_blur(image, mean, training, len(run.source), exponent)
    counter = stage_counter(run.progress, "deconvolve", params.deconvolution.iterations)
    deblurred = remove_blur(image, centroid.image, params.deconvolution, params.guards, bounds, counter)
    run.finish(replace(run.done, blur_bounds=bounds, deblurred=deblurred), "deconvolve")
    return deblurred


def _decisions(
    run: _Run,
    training: FloatArray,
    centroid: Centroid,
    dynamics: FlowDynamics | None,
    filtered: Filtered | None,
    deblurred: Deblurred | None,
) -> Iterator[Decision]:
    """Put what was chosen into words, in the order of the stages."""
    yield explain_training(len(training), len(run.source), run.params.train)
    yield from explain_input(training)
    yield explain_centroid(centroid)
    yield from explain_camera(centroid.flows)
    yield from explain_motion(centroid.flows)
    if dynamics is not None:
        yield from explain_dynamics(dynamics)
    if filtered is not None:
        # The sharpness of frames that do not count is not measured.
        chosen = int(np.isfinite(filtered.sharpness).sum())
        yield explain_frames(filtered, None if run.params.keep_best == 1 else chosen)
    if deblurred is not None:
        yield from deblurred.decisions


def _crop(image: FloatArray, flows: FloatArray, border: str, deblurred: Deblurred | None) -> tuple[Rectangle, Decision]:
    """Rectangle of the image that is the result."""
    seen = coverage(flows)
    whole = (0, 0, image.shape[1], image.shape[0])
    if border == "keep":
        return whole, explain_border(float(seen.min()), None)
    # Pixels within a width of the border are deblurred from light that fell beyond it.
    sigma = 0.0 if deblurred is None else deblurred.deconvolution.sigma
    crop = well_seen(seen, _SEEN, int(np.ceil(sigma)), MIN_SIDE)
    if crop == whole:
        return whole, explain_border(float(seen.min()), None)
    return crop, explain_border(float(seen.min()), crop)


def _check_sigma(sigma: float | None, shape: tuple[int, ...]) -> None:
    largest = min(shape[1:3]) / _SIGMAS_A_SIDE
    require(
        sigma is None or sigma <= largest,
        f"sigma: expected at most {largest:g} pixels for frames of {shape[2]}×{shape[1]}, found {sigma}",
    )


def _read_training(stream: Iterator[FloatArray], train: int) -> FloatArray:
    training = np.stack(list(islice(stream, train)))
    contrast = float(np.ptp(training.mean(axis=0)))
    if contrast < _LEAST_CONTRAST:
        raise DataError(
            f"frames: expected a scene with some contrast, found one intensity within {contrast:.1g} of full scale"
        )
    return training
