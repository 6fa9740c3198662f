"""What the training frames say about the air, and about structure, noise and blur of their image.

It is gathered while the training frames are in memory, and used when they are gone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .blur.posterior import BlurWitnesses, measure_witnesses
from .blur.witnesses.short_exposure import displacement_variance
from .core.arrays import ROUNDING, FloatArray, luminance
from .core.decision import Decision
from .core.noise import NoiseCurve, photon_noise
from .core.noise_spectrum import NoiseSpectrum
from .deblurring.remove_blur import Deblurred, left_blurred
from .deconvolution.conjugate_gradient import wiener_filtered
from .filtering.filter_records import Filtered
from .registration.centroid import Centroid
from .registration.flow_algebra import invert_flow
from .registration.recentring import recentring_flow
from .registration.registered_noise import HalvedClip, Halves, halve
from .registration.warp import warp
from .restoration_run import Run
from .results import Restoration
from .runtime.scratch import iter_frames
from .seeing.displacement import LEAST_FRAMES
from .seeing.strength import Seeing, seeing_of_picture
from .verification.halves import MOSTLY, Guarded, disputed_detail, keep_agreed
from .verification.structure import compare_structure
from .wording import explain_few_frames, explain_seeing, explain_structure

# Least variance of the noise of dark parts, relative to that of bright ones, that the decision states, chosen.
_LEAST_SHARE = 0.01
# Least standard deviation of ln V, the displacement that D/r0 implies: theory and simulated clips agree no better.
_LEAST_SPREAD = 0.2
# Fewest frames that are deblurred.  Where the air moves the scene by 1.5 pixels and hardly changes between frames that
# follow each other, the mean of fewer is off by more than a pixel: a photograph behind a blur of 1 pixel loses 0.4 to
# 1.8 dB when it is deblurred, and gains from five frames on.
_FEW_FRAMES = 5


@dataclass(frozen=True)
class Evidence:
    """What the deblurring needs to know from the training frames, which are freed before it runs."""

    saturation: float  # intensity from which the mean is saturated
    is_mean: bool = False  # whether the mean replaces the filtered image, which has structure that the frames lack
    finds_blur: bool = True  # whether a blur is looked for
    noise: NoiseSpectrum | None = None  # of the filtered image
    witnesses: BlurWitnesses | None = None  # None if no blur is to be estimated
    halves: HalvedClip | None = None  # None then


def seeing_of_frames(run: Run, training: FloatArray, centroid: Centroid) -> Seeing | None:
    """Measure the strength of the turbulence, unless there are too few frames."""
    if len(training) < LEAST_FRAMES:
        return None
    with run.timed("seeing"):
        picture, threads = run.prepared.picture, run.plan.runtime.threads
        seeing = seeing_of_picture(picture, training, centroid, run.params.optics, threads)
    run.decide(*explain_seeing(seeing))
    return seeing


def evidence_of_frames(
    run: Run, fused: Restoration, filtered: Filtered, training: FloatArray, saturation: float
) -> tuple[Restoration, Evidence]:
    """Check that the frames have the structure of the filtered image, else take the mean; measure how blurred it is."""
    image, flows = luminance(fused.image), fused.centroid.flows
    mean_flow = filtered.mean_flow
    if mean_flow.any():
        # The flows start from the geometry of the centroid.
        image = warp(image, invert_flow(recentring_flow(mean_flow)))
    with run.timed("noise"):
        halves = halve(training, flows, training.shape[1:], len(training), run.plan.runtime.threads)
    structure = compare_structure(image, training, flows, halves.frame_noise, halves.beyond)
    run.decide(*explain_structure(structure))
    fused = replace(fused, structure=structure, is_mean=not structure.explained)
    if fused.is_mean:
        return replace(fused, image=fused.mean), Evidence(saturation, is_mean=True)
    noise = fused_noise(filtered, halves)
    # No guard overrides a width that was asked for.
    if not run.params.finds_blur:
        return fused, Evidence(saturation, noise=noise)
    few = fused.frame_count < _FEW_FRAMES
    if few:
        run.decide(explain_few_frames(fused.frame_count, _FEW_FRAMES))
    if few or structure.changes:
        return fused, Evidence(saturation, finds_blur=False, noise=noise)
    witnesses = _find_witnesses(run, training, fused, halves.alternate.mean)
    return fused, Evidence(saturation, noise=noise, witnesses=witnesses, halves=halves.recentred(mean_flow))


def fused_noise(filtered: Filtered, halves: HalvedClip) -> NoiseSpectrum:
    """Noise of the filtered image: that of the mean of the training frames, for as many frames as its weights leave."""
    # Σ / Z₀ is one over the number of frames that count.  A border that few of them show is no usual pixel.
    counting = filtered.image_noise / max(float(np.median(filtered.variance)), ROUNDING**2)
    return halves.noise.scaled(halves.count / counting * filtered.noise_gain)


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
        known = BlurWitnesses(displacement, frames, picture)
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


def agreed_image(
    run: Run, fused: Restoration, deblurred: Deblurred, halves: HalvedClip, photons: NoiseCurve | None
) -> tuple[Deblurred, Guarded]:
    """Keep what the halves of the clip agree on; where that is little of the detail, no blur is removed."""
    agreed = _agreed(run, deblurred, halves, photons)
    if deblurred.deconvolution.sigma == 0 or disputed_detail(agreed.share, fused.mean) <= MOSTLY:
        return deblurred, agreed
    deblurred = left_blurred(deblurred, fused.image)
    run.decide(deblurred.decisions[-1])
    return deblurred, _agreed(run, deblurred, halves, photons)


def _agreed(run: Run, deblurred: Deblurred, halves: HalvedClip, photons: NoiseCurve | None) -> Guarded:
    """Compare the halves of the clip behind the deconvolution of the image, and keep what they agree on."""
    done, posterior = deblurred.deconvolution, deblurred.posterior
    assert posterior is not None
    exponent = run.params.deconvolution.exponent or posterior.exponent

    def sharpened(half: FloatArray) -> FloatArray:
        grey = luminance(half)
        return grey if done.sigma == 0 else wiener_filtered(grey, done.sigma, exponent, done.noise)

    with run.timed("agreement"):
        pairs = halves.alternate, halves.lasting
        sharp = [Halves(sharpened(pair.first), sharpened(pair.second)) for pair in pairs]
        full_scale = run.prepared.levels.full_scale
        return keep_agreed(done.image, halves.alternate.mean, halves.noise, sharp, full_scale, photons)


def measure_photon_noise(run: Run, halves: Halves) -> NoiseCurve | None:
    """Measure how the noise of the image depends on its level."""
    curve = photon_noise(luminance(halves.first), luminance(halves.second))
    if curve is not None:
        times = float(curve.variances[-1] / max(curve.variances[0], _LEAST_SHARE * curve.variances[-1]))
        reason = f"its variance is {times:.0f} times as large where the scene is bright, as that of photons"
        run.decide(Decision("noise", "dark parts count more than bright ones in the deconvolution", reason))
    return curve
