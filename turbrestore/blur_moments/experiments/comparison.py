"""The experiments of both papers: the error of every observer over many seeds, and the Cramér–Rao bounds.

A recording holds many seeds at once, so every observer corrects all of them in one step.  Errors are compared within
a seed, because the ratio of two observers has a much smaller standard error than either error.  The set-ups are in
:mod:`.scenarios`.

Symbols of the posterior Cramér–Rao bounds (Tichavský, Muravchik & Nehorai, 1998)
---------------------------------------------------------------------------------
J : Bayesian information about the state; J⁻¹ bounds the mean squared error of any estimate.
A_s, Q : motion from one exposure to the next, and covariance of its disturbance.

For a linear motion with Gaussian disturbance ``J⁺ = (Q + A_s J⁻¹ A_sᵀ)⁻¹ + E[Hᵀ R⁻¹ H]``, where the expectation is over
the states that occur, and H is the derivative of the measurement at the true state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from ...core.errors import require
from ...filtering.estimates import Gaussian
from ...runtime.threads import map_ahead
from ..moments import BlurModel, predicted_moments
from ..sensor import ExposureTiming, Float64Array
from ..state_estimation.image_observer import ImageFilter
from ..state_estimation.lifting import LiftedSystem
from ..state_estimation.observers import MomentFilter, Observer, run_observer, steady_kalman
from .scenarios import SLOPE_DISTURBANCE, Recording, Setup, mirror_setup, record, wavefront_setup

# Share of the exposures with the spot on the sensor below which light is lost, chosen.
_LIT = 0.99
# Probabilities at the ends of the consistency band, which holds 95 %.
_BAND = 0.025, 0.975
# Seeds handled together: enough to amortise the overhead of NumPy, few enough to stay in the cache.
_CHUNK = 25
# Orders of the moments for which there is a bound.
_MOMENTS = {"moments": (1, 2), "moments_1_to_4": (1, 2, 3, 4)}
# Standard deviations of ln g, ln ω and ln ζ in the prior of the augmented state: half of the largest that are drawn for
# a plant off by up to 7 dB, so that ±7 dB are two of the gain.
_PLANT = np.array([0.4, 0.15, 0.35])


@dataclass(frozen=True, eq=False)
class Contestant:
    """An observer, the model it uses, and its prior."""

    observer: Observer
    model: BlurModel
    start: Gaussian  # state before the first frame, shape (n,)
    bound: str = ""  # name of the Cramér–Rao bound that holds for it


@dataclass(frozen=True, eq=False)
class Track:
    """Errors of an observer on a recording of T frames and S seeds."""

    errors: Float64Array  # (T, S): of the state, or of the output within the exposure
    misfits: Float64Array  # (T, S): normalised innovation squared per degree of freedom
    observed: int  # degrees of freedom of a frame
    example: Float64Array  # (T, N): estimated output of the first seed


@dataclass(frozen=True)
class Score:
    """Accuracy of an observer over all seeds, after the frames in which it settles."""

    error: float  # mean error
    # Mean error over that of the first observer.
    ratio: float
    ratio_standard_error: float
    # Root mean square error, and the bound on it; NaN where none is known.
    rms: float
    rms_standard_error: float
    cramer_rao_bound: float
    innovation_squared: float  # per degree of freedom
    innovation_band: tuple[float, float]  # contains it in 95 % of all runs if the model fits

    @property
    def consistent(self) -> bool:
        """Whether the innovations are as large as their covariances say."""
        low, high = self.innovation_band
        return low <= self.innovation_squared <= high


@dataclass(frozen=True, eq=False)
class Experiment:
    """Outcome of an experiment, by observer."""

    scores: dict[str, Score]  # ratios are to the first
    tracks: dict[str, Track]
    # Cramér–Rao bounds on the root mean square error: ``moments`` (orders 1 and 2), ``moments_1_to_4``, ``image``.
    bounds: dict[str, float]
    timing: ExposureTiming
    truth: Float64Array  # (T, N): output of the first seed
    lit: float  # share of the exposures, over all seeds, in which the spot is on the sensor
    warnings: tuple[str, ...]  # one line for each observer of the whole image that lost light misleads


def wavefront(seeds: Sequence[int], slope_disturbance: float = SLOPE_DISTURBANCE) -> Experiment:
    """Run the wavefront experiment."""
    setup = wavefront_setup(slope_disturbance)
    model = setup.model
    linear, cov = steady_kalman(model)
    start = Gaussian(np.zeros(2), cov)
    contestants = {
        "O1": Contestant(linear, model, start, "moments"),
        "O2": Contestant(MomentFilter((2,)), model, start, "moments"),
        "O3": Contestant(MomentFilter((1, 2)), model, start, "moments"),
        "O3_legendre": Contestant(MomentFilter((1, 2), "legendre"), model, start, "moments"),
        "moments_1_to_4": Contestant(MomentFilter((1, 2, 3, 4), "legendre"), model, start, "moments_1_to_4"),
        "image_map": Contestant(ImageFilter(), model, start, "image"),
    }
    return _run(setup, seeds, contestants, of_state=True)


def mirror(seeds: Sequence[int], deviation: float = 0.0) -> Experiment:
    """Run the mirror experiment, its plant known, or off by up to ``deviation`` dB."""
    setup = mirror_setup(deviation)
    model = setup.model
    linear, cov = steady_kalman(model)
    start = Gaussian(np.zeros(2), cov)
    contestants = {
        "O1": Contestant(linear, model, start, "moments"),
        "O2": Contestant(MomentFilter((1, 2)), model, start, "moments"),
        "O3": Contestant(ImageFilter("two"), model, start, "image"),
        "O3_map": Contestant(ImageFilter(), model, start, "image"),
    }
    if deviation == 0:
        contestants["O3_infinity"] = Contestant(ImageFilter("infinity", iterations=8), model, start, "image")
    else:
        full = np.diag([0.0, 0.0, *_PLANT**2])
        full[:2, :2] = cov
        augmented = BlurModel(setup.truth, model.sensor)
        contestants["augmented"] = Contestant(ImageFilter(), augmented, Gaussian(np.zeros(5), full))
    return _run(setup, seeds, contestants, of_state=False, bounded=deviation == 0)


def follow(contestant: Contestant, recording: Recording, of_state: bool) -> Track:
    """Run an observer over a recording; measure the norm of the error of the state, or the error of the output."""
    motion, start = contestant.model.motion, contestant.start
    prior = Gaussian(np.broadcast_to(start.mean, (recording.states.shape[1], start.mean.size)), start.cov)
    results = run_observer(contestant.observer, contestant.model, prior, recording.frames, recording.inputs)
    means, steps = np.array([state.mean for state, _ in results]), motion.timing.frame_steps
    estimates, _ = motion.path_and_jacobian(means, recording.inputs, steps)
    if of_state:
        errors = np.linalg.norm(means - recording.states, axis=-1)
    else:
        exposed = slice(motion.timing.exposure_steps)
        errors = np.sqrt(((estimates - recording.outputs)[..., exposed] ** 2).mean(-1))
    observed = results[0][1].observed
    misfits = np.array([innovation.normalised_squared for _, innovation in results]) / observed
    return Track(errors, misfits, observed, estimates[:, 0])


def score(track: Track, first: Track, bound: float, burn_in: int) -> Score:
    """Compare an observer with the first one on the same recordings, and with the bound on its error."""
    errors, misfits = track.errors[burn_in:], track.misfits[burn_in:]
    reference = first.errors[burn_in:].mean(0)
    mean, squares = errors.mean(0), (errors**2).mean(0)
    ratio, rms = mean.mean() / reference.mean(), np.sqrt(squares.mean())
    spread, spread_squares = (
        np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
        for values in (mean - ratio * reference, squares)
    )
    freedom = misfits.size * track.observed
    low, high = chi2.ppf(_BAND, freedom) / freedom
    return Score(
        error=float(mean.mean()),
        ratio=float(ratio),
        ratio_standard_error=float(spread / reference.mean()),
        rms=float(rms),
        rms_standard_error=float(spread_squares / (2 * rms)),
        cramer_rao_bound=bound,
        innovation_squared=float(misfits.mean()),
        innovation_band=(float(low), float(high)),
    )


def information(model: BlurModel, states: Float64Array, inputs: Float64Array) -> dict[str, Float64Array]:
    """Information ``Hᵀ R⁻¹ H`` of a frame about the state, by what is measured: two or four moments, or the image.

    ``states`` (..., n); ``inputs`` (..., N); returns (..., n, n) each.
    """
    found = {}
    for name, orders in _MOMENTS.items():
        _, H, R = predicted_moments(model, states, inputs, orders, "legendre")
        found[name] = np.swapaxes(H, -1, -2) @ np.linalg.solve(R, H)
    _, derivative = model.image_and_jacobian(states, inputs)
    scaled = derivative / model.sensor.deviation
    return {**found, "image": scaled @ np.swapaxes(scaled, -1, -2)}


def posterior_bound(A: Float64Array, Q: Float64Array, start: Float64Array, gained: Float64Array) -> Float64Array:
    """Bound on the covariance of the estimation error after every frame.

    ``A, Q, start`` (n, n); ``gained`` (T, n, n), the information of the frames; returns (T, n, n).
    """
    before, bounds = start, []
    for frame in gained:
        after = np.linalg.inv(np.linalg.inv(before) + frame)
        bounds.append(after)
        before = A @ after @ A.T + Q
    return np.array(bounds)


def error_bound(motion: LiftedSystem, start: Float64Array, gained: Float64Array, burn_in: int, of_state: bool) -> float:
    """Bound on the root mean square error of the state, or of the output within the exposure, after the burn-in."""
    covariances = posterior_bound(motion.A, motion.Q, start, gained)[burn_in:]
    free = motion.free[: motion.timing.exposure_steps]
    weight = np.eye(motion.order) if of_state else free.T @ free / len(free)
    return float(np.sqrt(np.einsum("ab,tba->t", weight, covariances).mean()))


def _run(
    setup: Setup, seeds: Sequence[int], contestants: dict[str, Contestant], of_state: bool, bounded: bool = True
) -> Experiment:
    """Record and follow in chunks of seeds, and score all of them; bounds hold where the plant is known."""
    require(len(seeds) >= 1, "seeds: expected at least 1, found none")
    model, pixels, start = setup.model, setup.model.sensor.pixels, contestants["O1"].start.cov
    motion = model.motion
    assert isinstance(motion, LiftedSystem)

    def work(chunk: Sequence[int]) -> tuple[dict[str, Track], dict[str, Float64Array], Float64Array, int]:
        recording = record(setup, chunk)
        tracks = {name: follow(contestant, recording, of_state) for name, contestant in contestants.items()}
        gained = information(model, recording.states[..., :2], recording.inputs) if bounded else {}
        seen = recording.outputs[setup.burn_in :, :, : motion.timing.exposure_steps]
        lit = int(np.count_nonzero((seen >= pixels.start) & (seen <= pixels.stop)))
        return tracks, {name: part.sum(1) for name, part in gained.items()}, recording.outputs[:, 0], lit

    chunks = [seeds[k : k + _CHUNK] for k in range(0, len(seeds), _CHUNK)]
    parts = [part for _, part in map_ahead(work, chunks)]
    tracks = {name: _joined([part[0][name] for part in parts]) for name in contestants}
    bounds = {}
    for name in parts[0][1]:
        gained = np.asarray(sum(part[1][name] for part in parts)) / len(seeds)
        bounds[name] = error_bound(motion, start, gained, setup.burn_in, of_state)
    scores = {
        name: score(track, tracks["O1"], bounds.get(contestants[name].bound, float("nan")), setup.burn_in)
        for name, track in tracks.items()
    }
    exposures = len(seeds) * (setup.frames - setup.burn_in) * motion.timing.exposure_steps
    lit = sum(part[3] for part in parts) / exposures
    of_image = [name for name, contestant in contestants.items() if isinstance(contestant.observer, ImageFilter)]
    warnings = tuple(
        f"{name} errs {scores[name].ratio:.2f} times as much as O1: an image without its light misleads it, and the "
        f"spot is on the sensor for {100 * lit:.0f} % of the exposures"
        for name in of_image
        if lit < _LIT and scores[name].ratio > 1 + scores[name].ratio_standard_error
    )
    return Experiment(scores, tracks, bounds, motion.timing, parts[0][2], lit, warnings)


def _joined(tracks: list[Track]) -> Track:
    """Join the tracks of an observer over different seeds."""
    errors, misfits = (np.concatenate([getattr(track, name) for track in tracks], 1) for name in ("errors", "misfits"))
    return Track(errors, misfits, tracks[0].observed, tracks[0].example)
