"""Strength of the turbulence in a clip: from displacements to D/r0, r0 and Cn², with 95 % intervals.

Symbols
-------
V : variance of the displacement of blocks about their mean over the frame, squared pixels.
ν : its degrees of freedom.  ρ : autocorrelation.
D, r0, Cn² : aperture, Fried parameter, refractive-index structure constant.

The displacement is measured twice, by flow (:mod:`turbrestore.seeing.displacement`) and by blur: the temporal mean is
blurred by the displacement on top of what blurs a frame, and second moments add (:mod:`.relative_blur`).  Where the two
disagree by more than their errors, a remark says so.  The blur of more than two squared pixels is a lower bound,
because the spectrum of the mean vanishes where a larger one would be read.

Where the clip spans few correlation times, the variance over a long time is unknown: what the mean over time has taken
away is put back only for lags within the clip.  The value is then a lower bound, and what follows from it too.

With a distance, V gives Cn²; without one, the whole displacement gives D/r0 for a range of outer scales
(:mod:`turbrestore.seeing.tilt_theory`).  Neither is given where the displacement rotates as much as it diverges: it is
then no gradient of a phase.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np

from ..core.arrays import ROUNDING, FloatArray
from ..core.noise import estimate_noise
from ..io.source import Window
from ..registration.centroid import Centroid
from ..runtime.scratch import mean_of
from ..synthesis.atmosphere import fried_parameter
from .displacement import Displacement, Float64Array, MotionStatistics, measure_motion, motion_statistics
from .relative_blur import relative_blur
from .tilt_theory import MEAN_CONE, Optics, displacement_differences, strength_of_tilt

# Relative error of a variance besides that of finitely many frames: on synthetic clips of D/r0 1 to 6 the variance of
# blocks is 1 to 8 % too large on photographs and 21 % on a chart, as aberrations other than tilt move a block too.
_MODEL_ERROR = 0.12
# The same of a variance by blur, chosen.
_BLUR_ERROR = 0.1
# Blur by displacement above which it is a lower bound, squared pixels, chosen.
LARGEST_BLUR = 2.0
# Largest part of an image that is compared by blur, pixels a side, for its cost.
_COMPARED = 512
# Share of rotation from which the displacement is not that of turbulence, chosen; 0.5 is that of unrelated x and y.
_ROTATING = 0.4
_HALF, _E_FOLD = 0.5, float(np.exp(-1))
_DEVIATIONS = NormalDist().inv_cdf(0.975)


@dataclass(frozen=True)
class Estimate:
    """A value and its 95 % interval.

    Attributes
    ----------
    value, low, high : float
        Infinite where there is no upper bound.
    """

    value: float
    low: float
    high: float

    def overlaps(self, other: Estimate) -> bool:
        """Whether the intervals of two estimates have a value in common.

        Parameters
        ----------
        other : Estimate

        Returns
        -------
        bool

        Examples
        --------
        >>> Estimate(1.0, 0.8, 1.2).overlaps(Estimate(1.5, 1.1, 1.9))
        True
        """
        return self.low <= other.high and other.low <= self.high


@dataclass(frozen=True)
class Seeing:
    """Strength of the turbulence in a clip.

    Attributes
    ----------
    displacement_variance, displacement_variance_x, displacement_variance_y : Estimate or None
        Per axis over a long time, mean of both axes and each, squared pixels.
    displacement_by_flow, displacement_by_blur : Estimate or None
        Mean of both axes over this clip, by the flow, and by the blur of the temporal mean, squared pixels.
    isoplanatic_patch : Estimate or None
        Separation at which the correlation of the displacements is one half, pixels.
    coherence_time : Estimate or None
        Lag at which the autocorrelation of the displacement is 1/e, frames.
    wind_anisotropy : Estimate or None
        Variance of the change from frame to frame along the direction in which it is largest over that across; 3 for
        one slow wind, 1 for none or many.
    wind_direction : float
        That direction, degrees from right downwards, 0 to 180.
    independent_frames : float
        How many independent frames the clip is worth.
    rotation : float
        Share of rotation in the gradient of the displacement: near 0 for turbulence, 0.5 if x and y are unrelated.
    d_over_r0, r0, cn2 : Estimate or None
        Aperture over Fried parameter; Fried parameter, m; structure constant, m^(-2/3).
    remarks : tuple of str
        What a person should know, one line each.
    """

    displacement_variance: Estimate | None = None
    displacement_variance_x: Estimate | None = None
    displacement_variance_y: Estimate | None = None
    displacement_by_flow: Estimate | None = None
    displacement_by_blur: Estimate | None = None
    isoplanatic_patch: Estimate | None = None
    coherence_time: Estimate | None = None
    wind_anisotropy: Estimate | None = None
    wind_direction: float = np.nan
    independent_frames: float = np.nan
    rotation: float = np.nan
    d_over_r0: Estimate | None = None
    r0: Estimate | None = None
    cn2: Estimate | None = None
    remarks: tuple[str, ...] = ()

    @property
    def disagreement(self) -> str:
        """What it means that the displacements by flow and by blur differ by more than their errors; empty else."""
        by_flow, by_blur = self.displacement_by_flow, self.displacement_by_blur
        if by_flow is None or by_blur is None or by_flow.overlaps(by_blur):
            return ""
        if by_blur.low > by_flow.high:
            return "motion that the frames do not agree on, such as a moving scene or a failed registration"
        # A mean that is blurred by more than the limit is no longer told apart from one that is blurred by the limit.
        if by_flow.value >= LARGEST_BLUR:
            return ""
        return "the flow has more motion than the mean shows, or the exposure itself has blurred the frames"

    def estimates(self) -> dict[str, tuple[Estimate | None, str]]:
        """Return the estimates by name, each with its unit.

        Returns
        -------
        dict of str to (Estimate or None, str)
        """
        units = {
            "d_over_r0": "",
            "r0": "m",
            "cn2": "m^(-2/3)",
            "displacement_variance": "px²",
            "displacement_variance_x": "px²",
            "displacement_variance_y": "px²",
            "displacement_by_flow": "px²",
            "displacement_by_blur": "px²",
            "isoplanatic_patch": "px",
            "coherence_time": "frames",
            "wind_anisotropy": "",
        }
        return {name: (getattr(self, name), unit) for name, unit in units.items()}


def seeing_of_picture(
    picture: Window, frames: FloatArray, centroid: Centroid, optics: Optics | None = None, threads: int = 0
) -> Seeing:
    """Measure the strength of the turbulence between the bars, since what fills them is not the scene.

    ``frames`` (T, H, W) or (T, H, W, 3).
    """
    rows, columns = picture
    seen, flows = frames[:, rows, columns], centroid.flows[:, rows, columns]
    return measure_seeing(seen, flows, centroid.image[rows, columns], mean_of(seen), optics, threads)


def measure_seeing(
    frames: Sequence[FloatArray] | FloatArray,
    flows: Sequence[FloatArray] | FloatArray,
    image: FloatArray,
    mean: FloatArray,
    optics: Optics | None = None,
    threads: int = 0,
) -> Seeing:
    """Measure the strength of the turbulence.

    Parameters
    ----------
    frames : sequence of ndarray, float32, shape (H, W) or (H, W, 3)
        At least three, consecutive.
    flows : sequence of ndarray, float32, shape (H, W, 2)
        From the image to each frame, pixels.
    image : ndarray, float32, shape (H, W) or (H, W, 3)
        Frames fused without their displacement, such as the centroid.
    mean : ndarray, float32, shape of ``image``
        Temporal mean of the frames.
    optics : Optics, optional
        Without it only what is seen in pixels and frames is reported.
    threads : int
        0 means one for each core.

    Returns
    -------
    Seeing

    Raises
    ------
    DataError
        Fewer than three frames.

    Examples
    --------
    >>> from turbrestore.synthesis.anisoplanatic import phase_screen_frames
    >>> from turbrestore.synthesis.atmosphere import PhaseScreenParams
    >>> from turbrestore.synthesis.scenes import resolution_chart
    >>> from turbrestore.registration.centroid import find_centroid
    >>> chart, path = resolution_chart(96, 96), PhaseScreenParams(wind=(4.0,))
    >>> made = phase_screen_frames(chart, 24, np.random.default_rng(0), path)
    >>> frames = np.stack([frame.image for frame in made])
    >>> centroid = find_centroid(frames)
    >>> optics = Optics(pixel_scale=2.75e-6, aperture=0.1, distance=2000.0)
    >>> seeing = measure_seeing(frames, centroid.flows, centroid.image, frames.mean(axis=0), optics)
    >>> seeing.d_over_r0.low < 2.5 < seeing.d_over_r0.high
    True
    """
    noise = estimate_noise(frames[0])
    motion = measure_motion(frames, flows, image, noise, threads)
    by_blur = _by_blur(mean, image, noise / np.sqrt(len(flows)))
    if motion is None:
        remark = "too little structure or motion to measure the displacement: no strength of the turbulence is reported"
        return Seeing(displacement_by_blur=by_blur, remarks=(remark,))
    found, whole, rotation = motion.displacement, motion.statistics, motion.rotation
    w = found.blocks[:, found.counts]
    variance = max(float(np.mean(w**2)) - found.noise_variance, 0.0)
    by_flow = _with_deviation(variance, _MODEL_ERROR * variance)
    anisotropy, direction = _wind(w, whole, found.noise_variance)
    remarks: tuple[str, ...] = ()
    if whole.slow:
        remarks += (
            f"the clip holds only {whole.independent_frames:.1f} independent frames, so the variance is a lower bound; "
            "a longer clip gives more",
        )
    strength: dict[str, Any] = {}
    if optics is not None and np.isnan(rotation):
        remarks += ("too few neighbouring blocks to tell turbulence from other motion: no r0 is reported",)
    elif optics is not None and rotation > _ROTATING:
        remarks += (
            f"the displacement rotates as much as it diverges ({rotation:.0%} rotation): it is not that of light "
            "through turbulence, and no r0 is reported",
        )
    elif optics is not None:
        strength = _strength(found, whole, optics)
    x, y = (_interval(float(part), whole, whole.freedom / 2) for part in whole.variance)
    seeing = Seeing(
        displacement_variance=_interval(float(whole.variance.mean()), whole, whole.freedom),
        displacement_variance_x=x,
        displacement_variance_y=y,
        displacement_by_flow=by_flow,
        displacement_by_blur=by_blur,
        isoplanatic_patch=_crossing(motion.correlation, _HALF, whole.freedom, float(found.spacing)),
        coherence_time=_crossing(whole.autocorrelation, _E_FOLD, whole.freedom, 1.0),
        wind_anisotropy=anisotropy,
        wind_direction=direction,
        independent_frames=whole.independent_frames,
        rotation=rotation,
        **strength,
    )
    if by_blur is not None and seeing.disagreement:
        figures = f"displacement variance {by_flow.value:.2f} px² by flow and {by_blur.value:.2f} px² by blur"
        remarks = (f"{figures}: {seeing.disagreement}", *remarks)
    return replace(seeing, remarks=remarks)


def chi_square_interval(variance: float, freedom: float, relative: float = 0.0) -> Estimate:
    """95 % interval of a variance with ν degrees of freedom and an independent relative error."""
    lower, upper = (max(chi_square_quantile(freedom, share) / freedom, 1e-12) for share in (0.025, 0.975))
    below, above = (np.hypot(np.log(quantile), _DEVIATIONS * relative) for quantile in (upper, lower))
    return Estimate(variance, float(variance * np.exp(-below)), float(variance * np.exp(above)))


def chi_square_quantile(freedom: float, share: float) -> float:
    """Value below which χ² with ν degrees of freedom remains with a probability of ``share``.

    Newton steps on a logarithmic scale from the approximation of Wilson and Hilferty; the probability is the power
    series of the incomplete gamma function.
    """
    shape, deviation = freedom / 2, NormalDist().inv_cdf(share)
    x, step = shape * max(1 - 1 / (9 * shape) + deviation / (3 * math.sqrt(shape)), 0.1) ** 3, 1.0
    while abs(step) > 1e-9:
        count = 60 + max(x - shape, 0) + 12 * math.sqrt(x)
        series = 1 + float(np.cumprod(x / (shape + np.arange(1, count))).sum())
        density = math.exp(shape * math.log(x) - x - math.lgamma(shape))
        step = min(max((share - density / shape * series) / density, -1), 1)
        x *= math.exp(step)
    return 2 * x


def _interval(variance: float, motion: MotionStatistics, freedom: float) -> Estimate:
    """Interval of a variance over a long time, without an upper bound where there are few independent frames."""
    found = chi_square_interval(variance, freedom, _MODEL_ERROR)
    return replace(found, high=np.inf) if motion.slow else found


def _strength(found: Displacement, whole: MotionStatistics, optics: Optics) -> dict[str, Estimate]:
    if optics.distance is None:
        usual, least, largest = strength_of_tilt(float(whole.variance.mean()), optics)
        around = _interval(1.0, whole, whole.freedom)
        ratio = Estimate(usual, least * around.low ** (3 / 5), largest * around.high ** (3 / 5))
        return {"d_over_r0": ratio, "r0": _inverse(ratio, optics.aperture)}
    w = found.blocks[:, found.counts]
    among = motion_statistics(w - w.mean(axis=1, keepdims=True), found.noise_variance)
    differences = displacement_differences(optics, found.spacing, found.counts.shape, found.window)
    rows, columns = np.nonzero(found.counts)
    pairs = differences[abs(rows[:, None] - rows), abs(columns[:, None] - columns)]
    # The variance about the mean of the blocks is half the mean of the difference over all pairs.
    per_cn2 = float(pairs.mean()) / 2
    cn2 = _interval(float(among.variance.mean()) / per_cn2, among, among.freedom)
    path = optics.distance, optics.wavelength, MEAN_CONE[optics.path]
    value, low, high = (
        fried_parameter(part, *path) if np.isfinite(part) else 0.0 for part in (cn2.value, cn2.low, cn2.high)
    )
    r0 = Estimate(value, high, low)
    return {"d_over_r0": _inverse(r0, optics.aperture), "r0": r0, "cn2": cn2}


def _inverse(estimate: Estimate, over: float) -> Estimate:
    return Estimate(over / estimate.value, over / estimate.high, over / estimate.low if estimate.low > 0 else np.inf)


def _by_blur(mean: FloatArray, image: FloatArray, noise: float) -> Estimate | None:
    height, width = image.shape[:2]
    rows, columns = (slice(max(side - _COMPARED, 0) // 2, None) for side in (height, width))
    one, other = (part[rows, columns][:_COMPARED, :_COMPARED] for part in (mean, image))
    blur = relative_blur(one, other, noise)
    if not np.isfinite(blur.deviation):
        return None
    value = max(blur.variance, 0.0)
    found = _with_deviation(value, float(np.hypot(blur.deviation, _BLUR_ERROR * value)))
    return found if value < LARGEST_BLUR else Estimate(value, found.low, np.inf)


def _with_deviation(value: float, deviation: float) -> Estimate:
    return Estimate(value, max(value - _DEVIATIONS * deviation, 0.0), value + _DEVIATIONS * deviation)


def _wind(w: Float64Array, whole: MotionStatistics, noise_variance: float) -> tuple[Estimate, float]:
    """Anisotropy and direction of the change from frame to frame.

    A frozen phase that drifts changes the tilt along the wind three times as much as across, in variance, because of
    ``<cos⁴> = 3 <cos² sin²>`` over the directions of its waves.
    """
    change = np.diff(w, axis=0).reshape(-1, 2)
    values, vectors = np.linalg.eigh(change.T @ change / len(change))
    # The noise of both frames is in the change.
    values = np.maximum(values - 2 * noise_variance, ROUNDING**2)
    ratio = float(values[1] / values[0])
    # Each of the two variances has half of the degrees of freedom, and an error of sqrt(2 / that).
    factor = float(np.exp(_DEVIATIONS * np.sqrt(8 / max(whole.freedom, 1.0))))
    direction = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])) % 180)
    return Estimate(ratio, max(ratio / factor, 1.0), ratio * factor), direction


def _crossing(correlation: Float64Array, level: float, freedom: float, step: float) -> Estimate:
    """Where a correlation falls below a level, linear between its values; infinite where it does not."""
    error = _DEVIATIONS * (1 - level**2) / np.sqrt(max(freedom / 2, 1.0))

    def first_below(limit: float) -> float:
        below = np.flatnonzero(correlation < limit)
        if not below.size:
            return np.inf
        at = int(below[0])
        if at == 0:
            return 0.0
        return float(at - (limit - correlation[at]) / (correlation[at - 1] - correlation[at]))

    value, low, high = (step * first_below(limit) for limit in (level, level + error, level - error))
    return Estimate(value, low, high)
