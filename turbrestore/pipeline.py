"""The whole chain: frames → centroid → flow dynamics → alternating filter → deconvolution (paper 3, Figure 9)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .blur.measured_psf import psf_from_image
from .core.arrays import FloatArray
from .core.decision import Decision
from .core.errors import require, settings_of
from .core.noise import NoiseCurve, estimate_noise
from .deblurring.remove_blur import Deblurred, find_blur, remove_blur_steps
from .deconvolution.problem import largest_width, read_blur
from .dynamics.dynamic_texture import identify
from .dynamics.flow_model import FlowDynamics
from .evidence import Evidence, agreed_image, evidence_of_frames, measure_photon_noise, seeing_of_frames
from .filtering.alternating import Filtered, filter_steps
from .footage.checks.content import without_blank
from .footage.frame_selection import best_frames, frame_quality, only_counted
from .footage.temporal_mean import added_up, finish_mean
from .io.images.image_files import read_image
from .io.output import check_space
from .io.source import FrameSource
from .known_geometry import centroid_of_known_flows, onto_reference, settings_of_known_flows
from .memory_plan import plan_memory
from .preparation import prepare
from .registration.centroid import Centroid, centroid_steps
from .registration.coverage import SEEN, Rectangle, coverage, well_seen
from .registration.flow import MIN_SIDE
from .registration.recentring import recentre
from .restoration_run import Run, TileMap
from .results import Restoration, Store
from .runtime.allocator import returning_freed_memory
from .runtime.device import explain_device
from .runtime.runtime import DEFAULT, Runtime
from .runtime.scratch import drop_pages, iter_frames, mean_of, new_stack
from .runtime.steps import Progress, finish
from .settings import RestoreParams
from .stacking.fine_grid import fine_image, fine_shape
from .tiles import centroids_of_tiles, filtered_tiles, join_centroids, join_filtered
from .verification.pixel_deviation import SATURATED, measure_deviation, saturation_level
from .wording import (
    explain_border,
    explain_camera,
    explain_centroid,
    explain_dynamics,
    explain_frames,
    explain_geometry,
    explain_input,
    explain_motion,
    explain_training,
)

# Files of floating point are taken for those of 16 bits.
_MOST_BITS = 16
# A pixel that fewer frames show is about as noisy as in one of them; chosen.
_FEW_FRAMES = 4


def restore(
    frames: FrameSource | ArrayLike,
    params: RestoreParams | None = None,
    runtime: Runtime = DEFAULT,
    store: Store | None = None,
    progress: Progress | None = None,
    on_decision: Callable[[Decision], None] | None = None,
    map_tiles: TileMap | None = None,
) -> Restoration:
    """Restore one image from frames of a static scene.

    Frames are read in order: all of them to survey the clip, once more if there are moving objects, then the
    training frames, and those after them by the filter.  Only the training frames are kept, in
    memory or, if they do not fit, in a scratch file.

    Parameters
    ----------
    frames : FrameSource or array_like, shape (T, H, W) or (T, H, W, 3)
        At least two frames of at least 16×16 pixels.  Frames of an array that show nothing are left out; a source is
        taken as it is, and :func:`turbrestore.clean_source` repairs it.
    params : RestoreParams, optional
        Settings of every stage.
    runtime : Runtime
        What the restoration may use of the machine.
    store : Store, optional
        Keeps the results of the stages.  The results of an earlier run of the same frames and settings are reused, and
        the restored image is then the same, bit for bit.
    progress : callable, optional
        Called as ``progress(stage, done, total)``.
    on_decision : callable, optional
        Called with every :class:`turbrestore.Decision` when it is made.
    map_tiles : callable, optional
        Works on tiles elsewhere, where ``runtime.tile`` or a memory limit asks for tiles; see
        :data:`turbrestore.restoration_run.TileMap`.  By default they are worked on here, with the same result.

    Returns
    -------
    Restoration

    Raises
    ------
    DataError
        Too few, too small, damaged or constant frames, a static mask of another size, or no point in the image of the
        point spread function.
    InputNotFoundError
        The static mask or the image of the point spread function does not exist.
    ConfigurationError
        More training frames than frames, or as many where those that train are not filtered; a blur wider than an
        eighth of the shorter side; a device that is not there, or a memory limit that cannot be kept.
    StorageError
        The disk has no space for a scratch file.

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
    params = settings_of(RestoreParams, params)
    begun = time.perf_counter()
    source, blank_decisions = (
        (frames, ()) if isinstance(frames, FrameSource) else without_blank(FrameSource.from_array(frames))
    )
    params = settings_of_known_flows(params, len(source))
    plan = plan_memory(source.shape, params, runtime)
    psf = None if params.psf is None else psf_from_image(read_image(params.psf).image, params.psf)
    _check_sigma(params.deconvolution.sigma if psf is None else read_blur(psf)[1], source.shape)
    _check_training(params, plan.train, len(source))
    if plan.runtime.scratch is not None:
        check_space(plan.runtime.scratch, plan.scratch_bytes)
    prepared = prepare(source, params.static_mask, plan.runtime.scratch, progress)
    if store is not None:
        store.set_levels(prepared.levels)
    run = Run(prepared, prepared.stretched(params), plan, store, progress, on_decision, map_tiles)
    run.seconds["read"] = time.perf_counter() - begun
    run.decide(
        *blank_decisions, *plan.decisions, *explain_device(runtime.device, plan.runtime.device, params.flow.method)
    )
    run.decide(*prepared.decisions)
    with returning_freed_memory(runtime.memory_limit is not None):
        restoration = _deblur_and_crop(run, *_fuse(run), psf)
    if params.scale > 1:
        restoration = _add_finer_grid(run, restoration)
    return prepared.undo(restoration)


def _fuse(run: Run) -> tuple[Restoration, Evidence]:
    """Fuse the frames into one image; the training frames are freed when this function returns."""
    params, source, runtime = run.params, run.source, run.plan.runtime
    total = np.zeros(source.shape[1:])
    # Tiles read their parts of the frames themselves.
    stream = iter(source) if run.tiles else added_up(source, total)
    training, saturation = read_training(run, stream)

    centroid = run.stage("centroid", "centroid", partial(centroid_stage, run, training))
    run.decide(explain_centroid(centroid), *explain_camera(centroid.flows), *explain_motion(centroid.flows))
    seeing = seeing_of_frames(run, training, centroid)

    dynamics, filtered = None, None
    if params.runs("identify"):
        dynamics = run.stage("identify", "dynamics", partial(identify, centroid.flows, params.dynamics, runtime))
        run.decide(*explain_dynamics(dynamics, params.filter.residual == "drop"))

    if dynamics is not None and params.runs("filter"):
        filtering = partial(filter_stage, run, centroid, dynamics, training, stream)
        filtered = run.stage("filter", "filtered", filtering)
        # Where the filter came from the store, nobody has read the rest of the frames, and tiles read their own.
        unread = added_up(source, total) if run.tiles else stream
        mean = run.stage("filter", "mean", partial(finish_mean, unread, total, len(source)))
        # The sharpness is NaN for frames that do not count.
        chosen = int(np.isfinite(filtered.sharpness).sum())
        asked = None if params.keep_best == 1 else chosen
        run.decide(explain_frames(filtered, asked), explain_geometry(filtered, dynamics))
    else:
        mean = mean_of(training)

    fused = Restoration(
        image=centroid.image if filtered is None else filtered.image,
        crop=(0, 0, source.shape[2], source.shape[1]),
        mean=mean,
        centroid=centroid,
        dynamics=dynamics,
        filtered=filtered,
        train=len(training),
        frame_count=len(training) if filtered is None else len(source),
        seconds=run.seconds,
        seeing=seeing,
        keep_best=float(params.keep_best),
    )
    if filtered is None:
        return fused, Evidence(saturation)
    return evidence_of_frames(run, fused, filtered, training, saturation)


def read_training(run: Run, stream: Iterator[FloatArray]) -> tuple[FloatArray, float]:
    """Read the training frames; also the intensity from which their mean is saturated."""
    levels, count, bits = run.prepared.levels, run.plan.train, min(run.source.bit_depth, _MOST_BITS)
    least, share, brightest = levels.full_scale[1] - levels.gain * (1 - SATURATED), 0.0, 0.0
    with run.timed("read"):
        training = new_stack((count, *run.source.shape[1:]), run.plan.runtime.scratch)
        for place in training:
            # In a loop over the stream, one frame would stay in memory while the next is made.
            place[...] = next(stream)
            share += float(np.mean(place >= least)) / count
            brightest = max(brightest, float(place.max()))
            drop_pages(training)
    run.decide(explain_training(count, len(run.source), run.params.train), *explain_input(share))
    return training, saturation_level(brightest, estimate_noise(training[0]), levels.gain / (2**bits - 1), least)


def centroid_stage(run: Run, training: FloatArray) -> Centroid:
    """Find the centroid of the training frames, in the geometry that was asked for.

    ``training`` (K, H, W) or (K, H, W, 3).
    """
    params, runtime = run.params, run.plan.runtime
    if params.like is not None:
        return centroid_of_known_flows(training, run.source, params.like, runtime)
    if run.tiles:
        parts = centroids_of_tiles(run, training)
        found = join_centroids(parts, run.tiles, training.shape, runtime.scratch)
    else:
        steps = centroid_steps(training, params.centroid, params.flow, runtime)
        found = finish(steps, run.counter("centroid", len(training) * params.centroid.iterations))
    if params.reference is None:
        return found
    placed, reference_decision = onto_reference(found, training, params.reference, runtime)
    run.decide(reference_decision)
    return placed


def filter_stage(
    run: Run, centroid: Centroid, dynamics: FlowDynamics, training: FloatArray, rest: Iterator[FloatArray]
) -> Filtered:
    """Filter the training frames and those after them, and move the image onto the mean geometry of all frames.

    With ``reference`` or ``like`` it stays in the geometry of the other clip.
    ``training`` (K, H, W) or (K, H, W, 3).
    """
    params, source = run.params, run.source
    counted = np.ones(len(source), bool)
    if params.keep_best < 1:
        counted = best_frames(frame_quality(source), params.keep_best)
    if run.tiles:
        parts = filtered_tiles(run, centroid, training, counted)
        filtered = join_filtered(parts, run.tiles, source.shape[1:], run.plan.runtime.scratch)
    else:
        frames = only_counted(chain(iter_frames(training), rest), counted)
        start = None if run.store is None else run.store.filter_start()
        settings = params.filter, params.flow, centroid.flows, run.plan.runtime
        steps = filter_steps(frames, centroid.image, dynamics, *settings, start)
        filtered = finish(steps, partial(run.observe_filter, 0))
    if params.reference is None and params.like is None:
        return filtered.recentred()
    return replace(filtered, mean_flow=np.zeros_like(filtered.mean_flow))


def _deblur_and_crop(run: Run, fused: Restoration, evidence: Evidence, psf: NDArray[np.float64] | None) -> Restoration:
    """Deblur the fused image, keep what the halves of the clip agree on, measure its uncertainty, and crop both."""
    params, image, halves = run.params, fused.image, evidence.halves
    deblurred, agreed = None, None
    if params.runs("deconvolve") and evidence.finds_blur and not evidence.is_mean:
        photons = None if halves is None else measure_photon_noise(run, halves.alternate)
        deblurred = run.from_store("deblurred", lambda: _remove_blur(run, fused, evidence, psf, photons))
        run.decide(*deblurred.decisions)
        image = deblurred.deconvolution.image
        if halves is not None and deblurred.posterior is not None:
            deblurred, agreed = agreed_image(run, fused, deblurred, halves, photons)
            run.decide(*agreed.decisions)
            image = agreed.image
    seen = coverage(fused.centroid.flows)
    crop, border_decision = _find_crop(image, seen, params.border, deblurred)
    run.decide(border_decision)
    deviation = _measure_uncertainty(run, image, fused, evidence, seen, deblurred)
    x, y, width, height = crop
    part = np.s_[y : y + height, x : x + width]
    restoration = replace(
        fused,
        image=image if params.border == "keep" else image[part],
        crop=crop,
        decisions=tuple(run.decisions),
        uncertainty=None if deviation is None else deviation[part],
        disagreement=None if agreed is None else agreed.share[part],
        noise=evidence.noise,
        unseen=_unseen_share(run, seen, part, fused.train),
    )
    if deblurred is None:
        return restoration
    return replace(
        restoration,
        blur=deblurred.blur,
        posterior=deblurred.posterior,
        deconvolution=deblurred.deconvolution,
        guard_readings=deblurred.readings,
    )


def _add_finer_grid(run: Run, restoration: Restoration) -> Restoration:
    """Add the image on the finer grid."""
    with run.timed("scale"):
        finer, scale_decision = fine_image(run.prepared, restoration, run.params, run.plan.runtime)
        run.decide(scale_decision)
        x, y, width, height = restoration.crop
        upper, left = fine_shape((y, x), run.params.scale)
        lower, right = fine_shape((y + height, x + width), run.params.scale)
    return replace(restoration, finer=finer[upper:lower, left:right], decisions=tuple(run.decisions))


def _remove_blur(
    run: Run, fused: Restoration, evidence: Evidence, psf: NDArray[np.float64] | None, photons: NoiseCurve | None
) -> Deblurred:
    """Estimate the blur and remove it, with the centroid as the guide."""
    params, plan, guide = run.params, run.plan, fused.centroid.image
    if fused.filtered is not None:
        guide = recentre(guide, fused.filtered.mean_flow)
    found = None
    if params.finds_blur:
        with run.timed("width"):
            found = find_blur(fused.image, params.deconvolution, plan.runtime, evidence.witnesses, evidence.noise)
    settings = params.deconvolution, params.guards, plan.runtime, plan.deconvolution_side
    full_scale = run.prepared.levels.full_scale
    steps = remove_blur_steps(fused.image, guide, *settings, found, psf, photons, full_scale, evidence.noise)
    with run.timed("deconvolve"):
        return finish(steps, run.counter("deconvolve", params.deconvolution.iterations))


def _measure_uncertainty(
    run: Run, image: FloatArray, fused: Restoration, evidence: Evidence, seen: FloatArray, deblurred: Deblurred | None
) -> FloatArray | None:
    """Measure the standard deviation of every pixel of a filtered image."""
    filtered, dynamics = fused.filtered, fused.dynamics
    if filtered is None or dynamics is None:
        return None
    if evidence.is_mean:
        return np.full(image.shape[:2], np.inf, np.float32)
    with run.timed("uncertainty"):
        # A pixel can be measured if a frame has shown it and no channel is saturated in every frame.
        measurable = (seen > 0) & (np.atleast_3d(fused.mean).max(axis=-1) < evidence.saturation)
        if run.prepared.hidden is not None:
            measurable &= ~run.prepared.hidden
        return measure_deviation(image, filtered, dynamics, measurable, run.params.deconvolution, deblurred)


def _find_crop(
    image: FloatArray, seen: FloatArray, border: str, deblurred: Deblurred | None
) -> tuple[Rectangle, Decision]:
    """Find the rectangle of the image that is the result."""
    whole = (0, 0, image.shape[1], image.shape[0])
    if border == "keep":
        return whole, explain_border(float(seen.min()), None)
    # Part of the light of pixels within one width of the blur from the border fell outside the frames.
    sigma = 0.0 if deblurred is None else deblurred.deconvolution.sigma
    crop = well_seen(seen, SEEN, int(np.ceil(sigma)), MIN_SIDE)
    return crop, explain_border(float(seen.min()), None if crop == whole else crop)


def _unseen_share(run: Run, seen: FloatArray, part: tuple[slice, slice], train: int) -> float:
    """Share of the image that fewer than four of the training frames, or than half of a few, show."""
    unseen = seen * train < min(_FEW_FRAMES, train / 2)
    if run.prepared.hidden is not None:
        unseen |= run.prepared.hidden
    return float(unseen[part].mean())


def _check_sigma(sigma: float | None, shape: tuple[int, ...]) -> None:
    largest = largest_width(shape[1:3])
    require(
        sigma is None or sigma <= largest,
        f"sigma: expected at most {largest:g} pixels for frames of {shape[2]}×{shape[1]}, found {sigma}",
    )


def _check_training(params: RestoreParams, train: int, count: int) -> None:
    require(
        params.filter.training == "filter" or not params.runs("filter") or train < count,
        f"train: expected fewer than the {count} frames there are, as those that train are not filtered, found {train}",
    )
