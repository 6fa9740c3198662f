"""The whole chain: frames → centroid → flow dynamics → alternating filter → deconvolution (paper 3, Figure 9)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from .agreement.last_guard import Halves, keep_agreed
from .blind.remove_blur import SIGMAS_A_SIDE, Deblurred, remove_blur_steps
from .blur.measured_psf import psf_from_image
from .core.arrays import FloatArray, luminance
from .core.decision import Decision
from .core.errors import require
from .core.noise import NoiseCurve, photon_noise
from .deconvolution.problem import read_blur
from .footage.bars import Bars
from .footage.checks.content import without_blank
from .footage.levels import Levels
from .footage.overlays import Title
from .fusion import Fused, Run, fuse
from .io.images import read_image
from .io.output import check_space
from .io.source import FrameSource
from .memory_plan import plan_memory
from .preparation import prepare
from .registration.coverage import Rectangle, coverage, well_seen
from .registration.flow import MIN_SIDE
from .registration.recentring import recentre
from .results import NoStore, Restoration, Store, restoration_at_levels_of_clip
from .runtime.allocator import returning_freed_memory
from .runtime.device import explain_device
from .runtime.runtime import DEFAULT, Runtime
from .runtime.steps import Progress, finish
from .runtime.tiling import halo_tiles
from .settings import RestoreParams
from .stacking.fine_grid import fine_image, fine_shape
from .stacking.placement import settings_of_known_flows
from .tiled_stages import TileMap
from .uncertainty.pixel_deviation import measure_deviation
from .wording import explain_border

# Every pixel of a cropped image is visible in at least this share of the training frames.
_SEEN = 0.9
# Least noise of dark parts relative to bright ones that is told in words.
_LEAST_SHARE = 0.01


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

    Frames are read in order.  Only the training frames are kept, in memory or, if they do not fit, in a scratch file.

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
        :data:`turbrestore.tiled_stages.TileMap`.  By default they are worked on here, with the same result.

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
        More training frames than frames, a device that is not there, or a memory limit that cannot be kept.
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
    params = params or RestoreParams()
    begun = time.perf_counter()
    source, on_blank = (
        (frames, ()) if isinstance(frames, FrameSource) else without_blank(FrameSource.from_array(frames))
    )
    params = settings_of_known_flows(params, len(source))
    plan = plan_memory(source.shape, params, runtime)
    psf = None if params.psf is None else psf_from_image(read_image(params.psf).image, params.psf)
    _check_sigma(params.deconvolution.sigma if psf is None else read_blur(psf)[1], source.shape)
    _check_training(params, plan.train, len(source))
    if plan.runtime.scratch is not None:
        check_space(plan.runtime.scratch, plan.scratch_bytes)
    size = source.shape[1], source.shape[2]
    tiles = () if plan.tile is None else halo_tiles(size, plan.tile)
    prepared = prepare(source, params.static_mask, plan.runtime.scratch)
    store = store or NoStore()
    store.begin(prepared.levels)
    stretched = _stretched_params(params, prepared.levels)
    run = Run(prepared, stretched, plan, tiles, store, progress, on_decision, map_tiles, psf)
    run.seconds["read"] = time.perf_counter() - begun
    run.decide(*on_blank, *plan.decisions, *explain_device(runtime.device, plan.runtime.device, params.flow.method))
    run.decide(*prepared.decisions)
    with returning_freed_memory(runtime.memory_limit is not None):
        restoration = _restored(run)
    if params.scale > 1:
        restoration = _refined(run, restoration)
    restoration = restoration_at_levels_of_clip(restoration, prepared.levels)
    for kept in (prepared.title, prepared.bars):
        restoration = restoration if kept is None else _put_back(restoration, kept)
    return restoration


def _refined(run: Run, restoration: Restoration) -> Restoration:
    """Add the image on the finer grid."""
    begun = time.perf_counter()
    found = fine_image(run.prepared, restoration, run.params, run.plan.runtime)
    run.decide(*found.decisions)
    x, y, width, height = restoration.crop
    upper, left = fine_shape((y, x), run.params.scale)
    lower, right = fine_shape((y + height, x + width), run.params.scale)
    run.seconds["scale"] = time.perf_counter() - begun
    return replace(restoration, finer=found.image[upper:lower, left:right], decisions=tuple(run.decisions))


def _put_back(restoration: Restoration, kept: Bars | Title) -> Restoration:
    """Give the images of a restoration what is no scene."""
    image, uncertainty = kept.put_back(restoration.image, *restoration.crop[:2]), restoration.uncertainty
    finer = restoration.finer
    if finer is not None:
        changed, usual = (image != restoration.image).astype(np.float32), image
        size = finer.shape[1::-1]
        hidden, usual = (cv2.resize(one, size, interpolation=cv2.INTER_LINEAR) for one in (changed, usual))
        finer = np.where(hidden > 0.5, usual, finer)
    if uncertainty is not None:
        # What lies under it was not seen.
        hidden = kept.put_back(np.full_like(restoration.image, -1), *restoration.crop[:2]) >= 0
        uncertainty = np.where(hidden if hidden.ndim == 2 else hidden[..., 0], np.float32(np.inf), uncertainty)
    return replace(restoration, image=image, mean=kept.put_back(restoration.mean), uncertainty=uncertainty, finer=finer)


def _restored(run: Run) -> Restoration:
    """Fuse the frames, deblur the image and crop it."""
    params = run.params
    fused = fuse(run)
    image, centroid, deblurred = fused.image, fused.centroid, None
    if params.runs("deconvolve") and not fused.is_mean:
        photons = None if fused.halves is None else _photon_noise(run, fused.halves)
        deblurred = run.stage("deconvolve", "deblurred", lambda: _deblur(run, fused, photons))
        run.decide(*deblurred.decisions)
        image = deblurred.deconvolution.image
    agreed = (
        None
        if deblurred is None or fused.halves is None
        else keep_agreed(image, fused.halves, run.prepared.levels.full_scale)
    )
    if agreed is not None:
        run.decide(*agreed.decisions)
        image = agreed.image
    seen = coverage(centroid.flows)
    crop, on_border = _crop(image, seen, params.border, deblurred)
    run.decide(on_border)
    x, y, width, height = crop
    uncertainty = _measure_uncertainty(run, image, fused, seen, deblurred)
    return Restoration(
        image=image if params.border == "keep" else image[y : y + height, x : x + width],
        crop=crop,
        mean=fused.mean,
        centroid=centroid,
        dynamics=fused.dynamics,
        filtered=fused.filtered,
        blur=None if deblurred is None else deblurred.blur,
        posterior=None if deblurred is None else deblurred.posterior,
        deconvolution=None if deblurred is None else deblurred.deconvolution,
        guard_readings=() if deblurred is None else deblurred.readings,
        decisions=tuple(run.decisions),
        train=run.plan.train,
        frame_count=len(run.source) if params.runs("filter") else run.plan.train,
        seconds=run.seconds,
        seeing=fused.seeing,
        uncertainty=None if uncertainty is None else uncertainty[y : y + height, x : x + width],
        disagreement=None if agreed is None else agreed.share[y : y + height, x : x + width],
    )


def _deblur(run: Run, fused: Fused, photons: NoiseCurve | None) -> Deblurred:
    params, plan = run.params, run.plan
    guide = fused.centroid.image
    if fused.filtered is not None:
        guide = recentre(guide, fused.filtered.mean_flow)
    settings = params.deconvolution, params.guards, plan.runtime, plan.deconvolution_side
    steps = remove_blur_steps(fused.image, guide, *settings, fused.witnesses, run.psf, photons)
    return finish(steps, run.counter("deconvolve", params.deconvolution.iterations))


def _photon_noise(run: Run, halves: Halves) -> NoiseCurve | None:
    """Measure how the noise of the image depends on its level."""
    curve = photon_noise(luminance(halves.first), luminance(halves.second))
    if curve is not None:
        times = float(curve.variances[-1] / max(curve.variances[0], _LEAST_SHARE * curve.variances[-1]))
        reason = f"its variance is {times:.0f} times as large where the scene is bright, as that of photons"
        run.decide(Decision("noise", "dark parts count more than bright ones in the deconvolution", reason))
    return curve


def _measure_uncertainty(
    run: Run, image: FloatArray, fused: Fused, seen: FloatArray, deblurred: Deblurred | None
) -> FloatArray | None:
    """Measure the standard deviation of every pixel of a filtered image."""
    filtered, dynamics = fused.filtered, fused.dynamics
    if filtered is None or dynamics is None:
        return None
    if fused.is_mean:
        return np.full(image.shape[:2], np.inf, np.float32)
    begun = time.perf_counter()
    # A pixel is known if a frame has shown it and no channel is saturated in every frame.
    known = (seen > 0) & (np.atleast_3d(fused.mean).max(axis=-1) < fused.saturation)
    if run.prepared.hidden is not None:
        known &= ~run.prepared.hidden
    deviation = measure_deviation(image, filtered, dynamics, known, run.params.deconvolution, deblurred)
    run.seconds["uncertainty"] = time.perf_counter() - begun
    return deviation


def _crop(image: FloatArray, seen: FloatArray, border: str, deblurred: Deblurred | None) -> tuple[Rectangle, Decision]:
    """Return the rectangle of the image that is the result."""
    whole = (0, 0, image.shape[1], image.shape[0])
    if border == "keep":
        return whole, explain_border(float(seen.min()), None)
    # Part of the light of pixels within one width of the blur from the border fell outside the frames.
    sigma = 0.0 if deblurred is None else deblurred.deconvolution.sigma
    crop = well_seen(seen, _SEEN, int(np.ceil(sigma)), MIN_SIDE)
    return crop, explain_border(float(seen.min()), None if crop == whole else crop)


def _check_sigma(sigma: float | None, shape: tuple[int, ...]) -> None:
    largest = min(shape[1:3]) / SIGMAS_A_SIDE
    require(
        sigma is None or sigma <= largest,
        f"sigma: expected at most {largest:g} pixels for frames of {shape[2]}×{shape[1]}, found {sigma}",
    )


def _check_training(params: RestoreParams, train: int, count: int) -> None:
    require(
        params.filter.training == "filter" or not params.runs("filter") or train < count,
        f"train: expected fewer than the {count} frames there are, as those that train are not filtered, found {train}",
    )


def _stretched_params(params: RestoreParams, levels: Levels) -> RestoreParams:
    """Bring the settings that are intensities to the levels of the stages."""
    given, square = params.filter, levels.gain**2
    noise = None if given.image_noise is None else given.image_noise * square
    return replace(params, filter=replace(given, image_noise=noise, image_drift=given.image_drift * square))
