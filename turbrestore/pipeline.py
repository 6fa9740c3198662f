"""The whole chain: frames → centroid → flow dynamics → alternating filter → deconvolution (paper 3, Figure 9)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .agreement.last_guard import Guarded, keep_agreed
from .blind.remove_blur import SIGMAS_A_SIDE, Deblurred, remove_blur_steps
from .blind.structure import compare_structure
from .blur.measured_psf import psf_from_image
from .blur.posterior import BlurWitnesses, measure_witnesses
from .blur.psf import GAUSSIAN
from .blur.witnesses.short_exposure import displacement_variance
from .core.arrays import FloatArray, luminance
from .core.decision import Decision
from .core.errors import require
from .core.noise import NoiseCurve, photon_noise
from .core.noise_spectrum import NoiseSpectrum
from .deconvolution.conjugate_gradient import wiener_filtered
from .deconvolution.problem import read_blur
from .dynamics.dynamic_texture import identify
from .footage.checks.content import without_blank
from .footage.levels import Levels
from .fusion import Run, TileMap, added_up, centroid_stage, filter_stage, finish_mean, read_training
from .io.images import read_image
from .io.output import check_space
from .io.source import FrameSource
from .memory_plan import plan_memory
from .preparation import prepare, undo_preparation
from .registration.centroid import Centroid
from .registration.coverage import Rectangle, coverage, well_seen
from .registration.flow import MIN_SIDE
from .registration.flow_algebra import invert_flow
from .registration.recentring import recentre, recentring_flow
from .registration.registered_noise import HalvedClip, Halves, halve
from .registration.warp import warp
from .results import Restoration, Store
from .runtime.allocator import returning_freed_memory
from .runtime.device import explain_device
from .runtime.runtime import DEFAULT, Runtime
from .runtime.scratch import iter_frames, mean_of, variance_of
from .runtime.steps import Progress, finish
from .seeing.displacement import LEAST_FRAMES
from .seeing.strength import Seeing, seeing_of_picture
from .settings import RestoreParams
from .stacking.fine_grid import fine_image, fine_shape
from .stacking.placement import settings_of_known_flows
from .uncertainty.pixel_deviation import measure_deviation
from .wording import (
    explain_border,
    explain_dynamics,
    explain_filter,
    explain_registration,
    explain_seeing,
    explain_structure,
)

# Every border pixel of a cropped image is visible in at least this share of the training frames.
_SEEN = 0.9
# A pixel that fewer frames show is about as noisy as in one of them.
_FEW_FRAMES = 4
# Least variance of the noise of dark parts, relative to that of bright ones, that the decision states.
_LEAST_SHARE = 0.01
# Least standard deviation of ln V, the displacement that D/r0 implies: theory and simulated clips agree no better.
_LEAST_SPREAD = 0.2


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

    Frames are read in order: a sample of them to survey the clip, all of them once more if there are moving
    objects, then the training frames, and those after them by the filter.  Only the training frames are kept, in
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
        :data:`turbrestore.fusion.TileMap`.  By default they are worked on here, with the same result.

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
    params = params or RestoreParams()
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
    prepared = prepare(source, params.static_mask, plan.runtime.scratch)
    if store is not None:
        store.set_levels(prepared.levels)
    stretched = _stretched_params(params, prepared.levels)
    run = Run(prepared, stretched, plan, store, progress, on_decision, map_tiles)
    run.seconds["read"] = time.perf_counter() - begun
    run.decide(
        *blank_decisions, *plan.decisions, *explain_device(runtime.device, plan.runtime.device, params.flow.method)
    )
    run.decide(*prepared.decisions)
    with returning_freed_memory(runtime.memory_limit is not None):
        restoration = _deblur_and_crop(run, *_fuse(run), psf)
    if params.scale > 1:
        restoration = _add_finer_grid(run, restoration)
    return undo_preparation(restoration, prepared)


@dataclass(frozen=True)
class _Evidence:
    """What :func:`_deblur_and_crop` needs to know from the training frames, which are freed before it runs."""

    saturation: float  # intensity from which the mean is saturated
    is_mean: bool = False  # whether the mean replaces the filtered image, which has structure that the frames lack
    witnesses: BlurWitnesses | None = None  # None if no blur is to be estimated
    halves: HalvedClip | None = None  # None then


def _fuse(run: Run) -> tuple[Restoration, _Evidence]:
    """Fuse the frames into one image; the training frames are freed when this function returns."""
    params, source, runtime = run.params, run.source, run.plan.runtime
    total = np.zeros(source.shape[1:])
    # Tiles read their parts of the frames themselves.
    stream = iter(source) if run.tiles else added_up(source, total)
    training, saturation = read_training(run, stream)

    centroid = run.stage("centroid", "centroid", partial(centroid_stage, run, training))
    run.decide(*explain_registration(centroid))
    seeing = _measure_seeing(run, training, centroid)

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
        run.decide(*explain_filter(filtered, dynamics, None if params.keep_best == 1 else chosen))
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
    )
    if filtered is None:
        return fused, _Evidence(saturation)
    return _check_by_frames(run, fused, training, filtered.mean_flow, saturation)


def _check_by_frames(
    run: Run, fused: Restoration, training: FloatArray, mean_flow: FloatArray, saturation: float
) -> tuple[Restoration, _Evidence]:
    """Check that the frames have the structure of the filtered image, else take the mean; measure how blurred it is."""
    image, flows = luminance(fused.image), fused.centroid.flows
    if mean_flow.any():
        # The flows start from the geometry of the centroid.
        image = warp(image, invert_flow(recentring_flow(mean_flow)))
    halves = halve(training, flows, training.shape[1:], len(training), run.plan.runtime.threads)
    new, lasting = halves.alternate.noise().deviation ** 2, halves.lasting.noise().deviation ** 2
    structure = compare_structure(image, training, flows, len(training) * new, max(lasting - new, 0.0))
    run.decide(*explain_structure(structure))
    fused = replace(fused, structure=structure, is_mean=not structure.explained)
    if fused.is_mean:
        return replace(fused, image=fused.mean), _Evidence(saturation, is_mean=True)
    # No guard overrides a width that was asked for.
    if not run.params.finds_blur:
        return fused, _Evidence(saturation)
    witnesses, halves = _find_witnesses(run, training, fused, halves.alternate.mean), halves.recentred(mean_flow)
    witnesses = replace(witnesses, noise=_fused_noise(fused, halves))
    return fused, _Evidence(saturation, False, witnesses, halves)


def _fused_noise(fused: Restoration, halves: HalvedClip) -> NoiseSpectrum:
    """Noise of the filtered image: that of the mean of the training frames, for as many frames as its weights leave."""
    noise, filtered = halves.noise(), fused.filtered
    if filtered is None:
        return noise
    # Σ / Z₀ is one over the number of frames that count.
    counting = filtered.image_noise / max(float(filtered.variance.mean()), 1e-12)
    return noise.scaled(halves.count / counting * filtered.noise_gain)


def _deblur_and_crop(run: Run, fused: Restoration, evidence: _Evidence, psf: NDArray[np.float64] | None) -> Restoration:
    """Deblur the fused image, keep what the halves of the clip agree on, measure its uncertainty, and crop both."""
    params, image, halves = run.params, fused.image, evidence.halves
    deblurred, agreed = None, None
    if params.runs("deconvolve") and not evidence.is_mean:
        photons = None if halves is None else _photon_noise(run, halves.alternate)
        deblurred = run.stage("deconvolve", "deblurred", lambda: _remove_blur(run, fused, evidence, psf, photons))
        run.decide(*deblurred.decisions)
        image = deblurred.deconvolution.image
        if halves is not None:
            agreed = _keep_agreed(run, fused, deblurred, halves)
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
        noise=None if evidence.witnesses is None else evidence.witnesses.noise,
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


def _keep_agreed(run: Run, fused: Restoration, deblurred: Deblurred, halves: HalvedClip) -> Guarded:
    """Compare the halves of the clip behind the deconvolution of the image, and keep what they agree on."""
    done, posterior = deblurred.deconvolution, deblurred.posterior

    def sharpened(half: FloatArray) -> FloatArray:
        grey = luminance(half)
        if done.sigma == 0:
            return grey
        return wiener_filtered(grey, done.sigma, GAUSSIAN if posterior is None else posterior.exponent, done.noise)

    pairs = halves.alternate, halves.lasting
    sharp = [Halves(sharpened(pair.first), sharpened(pair.second)) for pair in pairs]
    mean = halves.alternate.mean
    return keep_agreed(done.image, mean, halves.noise(), sharp, run.prepared.levels.full_scale)


def _add_finer_grid(run: Run, restoration: Restoration) -> Restoration:
    """Add the image on the finer grid."""
    with run.timed("scale"):
        finer, scale_decision = fine_image(run.prepared, restoration, run.params, run.plan.runtime)
        run.decide(scale_decision)
        x, y, width, height = restoration.crop
        upper, left = fine_shape((y, x), run.params.scale)
        lower, right = fine_shape((y + height, x + width), run.params.scale)
    return replace(restoration, finer=finer[upper:lower, left:right], decisions=tuple(run.decisions))


def _measure_seeing(run: Run, training: FloatArray, centroid: Centroid) -> Seeing | None:
    """Measure the strength of the turbulence, unless there are too few frames."""
    if len(training) < LEAST_FRAMES:
        return None
    with run.timed("seeing"):
        picture, threads = run.prepared.picture, run.plan.runtime.threads
        seeing = seeing_of_picture(picture, training, centroid, run.params.optics, threads)
    run.decide(*explain_seeing(seeing))
    return seeing


def _find_witnesses(run: Run, training: FloatArray, fused: Restoration, mean: FloatArray) -> BlurWitnesses:
    """Measure what the frames say about their blur; ``mean`` (H, W[, 3]) is that of the registered frames."""
    seeing = fused.seeing
    measured = None if seeing is None else seeing.displacement_variance
    rows, columns = picture = run.prepared.picture
    with run.timed("witnesses"):
        cropped, flows = training[:, rows, columns], fused.centroid.flows[:, rows, columns]
        if seeing is not None and measured is not None:
            displacement, frames = measured.value, seeing.independent_frames
        else:
            # Where no displacement can be measured, that of the flow is taken instead, less what the camera adds.
            variances = [np.square(flow - np.median(flow, axis=(0, 1))).mean() for flow in iter_frames(flows)]
            displacement, frames = float(np.mean(variances)), float(len(training))
        error = float(np.sqrt(variance_of(flows).mean() / len(training)))
        known = BlurWitnesses(displacement, frames, picture, position_error=error)
        return measure_witnesses(cropped, flows, mean[rows, columns], _of_optics(known, run, seeing))


def _of_optics(known: BlurWitnesses, run: Run, seeing: Seeing | None) -> BlurWitnesses:
    """Add the diffraction of the optics and, if D/r0 is measured, the displacement that it implies."""
    optics = run.params.optics
    if optics is None:
        return known
    strength, diffraction = None if seeing is None else seeing.d_over_r0, optics.diffraction
    if optics.distance is None or strength is None or not np.isfinite(strength.high):
        return replace(known, diffraction=diffraction)
    implied = float(displacement_variance(np.array(strength.value), np.array(diffraction)))
    # V grows as the power 5/3 of D/r0, and a 95 % interval has four standard deviations.
    spread = max(5 / 3 * np.log(strength.high / strength.low) / 4, _LEAST_SPREAD)
    return replace(known, displacement=implied, diffraction=diffraction, spread=float(spread))


def _remove_blur(
    run: Run, fused: Restoration, evidence: _Evidence, psf: NDArray[np.float64] | None, photons: NoiseCurve | None
) -> Deblurred:
    """Estimate the blur and remove it, with the centroid as the guide."""
    params, plan, guide = run.params, run.plan, fused.centroid.image
    if fused.filtered is not None:
        guide = recentre(guide, fused.filtered.mean_flow)
    settings = params.deconvolution, params.guards, plan.runtime, plan.deconvolution_side
    full_scale = run.prepared.levels.full_scale
    steps = remove_blur_steps(fused.image, guide, *settings, evidence.witnesses, psf, photons, full_scale)
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
    run: Run, image: FloatArray, fused: Restoration, evidence: _Evidence, seen: FloatArray, deblurred: Deblurred | None
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
    crop = well_seen(seen, _SEEN, int(np.ceil(sigma)), MIN_SIDE)
    return crop, explain_border(float(seen.min()), None if crop == whole else crop)


def _unseen_share(run: Run, seen: FloatArray, part: tuple[slice, slice], train: int) -> float:
    """Share of the image that fewer than four of the training frames, or than half of a few, show."""
    unseen = seen * train < min(_FEW_FRAMES, train / 2)
    if run.prepared.hidden is not None:
        unseen |= run.prepared.hidden
    return float(unseen[part].mean())


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
