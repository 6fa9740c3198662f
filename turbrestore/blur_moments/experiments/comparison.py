"""The experiments of both papers: the error of every observer over many seeds, and the Cramér–Rao bounds.

A recording holds many seeds at once, so every observer corrects all of them in one step.  Errors are compared within
a seed, because the ratio of two observers has a much smaller standard error than either error.  The set-ups are in
:mod:`.scenarios`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from ...core.errors import require
from ...filtering.kalman import Gaussian
from ...runtime.threads import map_ahead
from ..moments import BlurModel
from ..sensor import ExposureTiming, Float64Array
from ..state_estimation.image_observer import ImageFilter
from ..state_estimation.lifting import LiftedSystem
from ..state_estimation.observers import MomentFilter, Observer, luenberger, run_observer, steady_kalman
from .bounds import error_bound, recorded_information
from .scenarios import (
    MIRROR,
    WAVEFRONT,
    MirrorParams,
    Recording,
    WavefrontParams,
    mirror_model,
    mirror_oscillator,
    record_mirror,
    record_wavefront,
    wavefront_model,
)

# Share of the exposures with the spot on the sensor below which light is lost.
_LIT = 0.99
# Probability of the consistency band.
_BAND = 0.95
# Seeds handled together: enough to amortise the overhead of NumPy, few enough to stay in the cache.
_CHUNK = 25
_LEGENDRE = "legendre"


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
    between: Float64Array  # (T, S): root mean square error of the output over all fast steps until the next exposure
    misfits: Float64Array  # (T, S): normalised innovation squared
    observed: int  # degrees of freedom of one of them
    example: Float64Array  # (T, N): estimated output of the first seed


@dataclass(frozen=True)
class Score:
    """Accuracy of an observer over all seeds, after the frames in which it settles."""

    error: float  # mean error
    # Mean error over that of the first observer, and its standard error.
    ratio: float
    ratio_error: float
    # Root mean square error, and its standard error.
    rms: float
    rms_error: float
    bound: float  # Cramér–Rao bound on ``rms``; NaN where none is known
    between: float  # mean error of the output over all fast steps until the next exposure
    innovation: float  # normalised innovation squared per degree of freedom
    # Band that contains it in 95 % of all runs if the model fits.
    innovation_low: float
    innovation_high: float
    of_image: bool = False  # whether the observer uses the whole image, and not its moments

    @property
    def consistent(self) -> bool:
        """Whether the innovations are as large as their covariances say."""
        return self.innovation_low <= self.innovation <= self.innovation_high


@dataclass(frozen=True, eq=False)
class Experiment:
    """Outcome of an experiment."""

    seeds: int  # number of runs
    scores: dict[str, Score]  # by observer; ratios are to the first
    # Cramér–Rao bounds on the root mean square error: ``moments`` (orders 1 and 2), ``moments_1_to_4``, ``image``.
    bounds: dict[str, float]
    timing: ExposureTiming
    truth: Float64Array  # (T, N): output of the first seed
    estimates: dict[str, Float64Array]  # (T, N): of the first seed, by observer
    errors: dict[str, Float64Array]  # (T,): error after every frame, mean over the seeds, by observer
    lit: float  # share of the exposures, over all seeds, in which the spot is on the sensor

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line for each observer of the whole image that errs more than O1 where the spot leaves the sensor."""
        return tuple(
            f"{name} errs {score.ratio:.2f} times as much as O1: an image without its light misleads it, and the spot "
            f"is on the sensor for {100 * self.lit:.0f} % of the exposures"
            for name, score in self.scores.items()
            if score.of_image and self.lit < _LIT and score.ratio > 1 + score.ratio_error
        )


def wavefront(seeds: Sequence[int], params: WavefrontParams = WAVEFRONT) -> Experiment:
    """Run the wavefront experiment."""
    model = wavefront_model(params)
    observer, cov = steady_kalman(model)
    start = Gaussian(np.zeros(2), cov)
    both = (1, 2)
    contestants = {
        "O1": Contestant(observer, model, start, "moments"),
        "O2": Contestant(MomentFilter((2,)), model, start, "moments"),
        "O3": Contestant(MomentFilter(both), model, start, "moments"),
        "O3_legendre": Contestant(MomentFilter(both, _LEGENDRE), model, start, "moments"),
        "O3_unscented": Contestant(MomentFilter(both, _LEGENDRE, "unscented"), model, start, "moments"),
        "O3_iterated": Contestant(MomentFilter(both, _LEGENDRE, "iterated"), model, start, "moments"),
        "moments_1_to_4": Contestant(MomentFilter((1, 2, 3, 4), _LEGENDRE), model, start, "moments_1_to_4"),
        "image_one_step": Contestant(ImageFilter(iterations=1), model, start, "image"),
        "image_map": Contestant(ImageFilter(), model, start, "image"),
    }

    def record(chunk: Sequence[int]) -> Recording:
        return record_wavefront(chunk, params)

    return _run(seeds, record, contestants, params.burn_in, of_state=True, linear=model)


def mirror(seeds: Sequence[int], params: MirrorParams = MIRROR) -> Experiment:
    """Run the mirror experiment."""
    model = mirror_model(params)
    motion = model.motion
    assert isinstance(motion, LiftedSystem)
    observer, cov = steady_kalman(model)
    start = Gaussian(np.zeros(2), cov)
    contestants = {
        "O1": Contestant(observer, model, start, "moments"),
        "O2": Contestant(MomentFilter((1, 2)), model, start, "moments"),
        "O3": Contestant(ImageFilter("two"), model, start, "image"),
        "O3_map": Contestant(ImageFilter(), model, start, "image"),
    }
    if params.deviation > 0:
        augmented = BlurModel(mirror_oscillator(params), model.sensor)
        contestants["augmented"] = Contestant(ImageFilter(), augmented, _augmented_start(cov))
    else:
        contestants |= {
            "O1_poles_.02_.03": Contestant(luenberger(motion, [0.02, 0.03]), model, start, "moments"),
            "O1_poles_.3_.35": Contestant(luenberger(motion, [0.3, 0.35]), model, start, "moments"),
            "O2_legendre": Contestant(MomentFilter((1, 2), _LEGENDRE), model, start, "moments"),
            "moments_1_to_4": Contestant(MomentFilter((1, 2, 3, 4), _LEGENDRE), model, start, "moments_1_to_4"),
            "O3_one_start": Contestant(ImageFilter("two", multistart=False), model, start, "image"),
            "O3_infinity": Contestant(ImageFilter("infinity", iterations=8), model, start, "image"),
        }

    def record(chunk: Sequence[int]) -> Recording:
        return record_mirror(chunk, params)

    linear = None if params.deviation > 0 else model
    return _run(seeds, record, contestants, params.burn_in, of_state=False, linear=linear)


def follow(contestant: Contestant, recording: Recording, of_state: bool) -> Track:
    """Run an observer over a recording; measure the norm of the error of the state, or the error of the output."""
    motion, start = contestant.model.motion, contestant.start
    seeds = recording.states.shape[1]
    prior = Gaussian(np.broadcast_to(start.mean, (seeds, start.mean.size)), start.cov)
    results = run_observer(contestant.observer, contestant.model, prior, recording.frames, recording.inputs)
    pairs = zip(results, recording.inputs, strict=True)
    estimates = np.array([motion.fast_output(state, held)[0] for (state, _), held in pairs])
    squared = (estimates - recording.outputs) ** 2
    if of_state:
        means = np.array([state.mean for state, _ in results])
        errors = np.linalg.norm(means - recording.states, axis=-1)
    else:
        errors = np.sqrt(squared[..., : motion.timing.exposure_steps].mean(-1))
    return Track(
        errors=errors,
        between=np.sqrt(squared.mean(-1)),
        misfits=np.array([innovation.normalised_squared for _, innovation in results]),
        observed=int(results[0][1].observed.flat[0]),
        example=estimates[:, 0],
    )


def score(tracks: Mapping[str, Track], bounds: Mapping[str, float], burn_in: int) -> dict[str, Score]:
    """Compare observers on the same recordings with the first of them and with the bounds known for some of them."""
    reference = next(iter(tracks.values())).errors[burn_in:].mean(0)
    return {
        name: _score_one(track, reference, bounds.get(name, float("nan")), burn_in) for name, track in tracks.items()
    }


def _score_one(track: Track, reference: Float64Array, bound: float, burn_in: int) -> Score:
    errors, misfits = track.errors[burn_in:], track.misfits[burn_in:]
    seeds = errors.shape[1]
    mean, squares = errors.mean(0), (errors**2).mean(0)
    ratio, rms = mean.mean() / reference.mean(), np.sqrt(squares.mean())
    spread = np.std(mean - ratio * reference, ddof=1) if seeds > 1 else np.nan
    spread_squares = np.std(squares, ddof=1) if seeds > 1 else np.nan
    freedom = misfits.size * track.observed
    low, high = chi2.ppf([0.5 - _BAND / 2, 0.5 + _BAND / 2], freedom) / freedom
    return Score(
        error=float(mean.mean()),
        ratio=float(ratio),
        ratio_error=float(spread / np.sqrt(seeds) / reference.mean()),
        rms=float(rms),
        rms_error=float(spread_squares / np.sqrt(seeds) / (2 * rms)),
        bound=float(bound),
        between=float(track.between[burn_in:].mean()),
        innovation=float(misfits.sum() / freedom),
        innovation_low=float(low),
        innovation_high=float(high),
    )


def _run(
    seeds: Sequence[int],
    record: Callable[[Sequence[int]], Recording],
    contestants: dict[str, Contestant],
    burn_in: int,
    of_state: bool,
    linear: BlurModel | None,
) -> Experiment:
    """Record, follow and score in chunks of seeds."""
    require(len(seeds) >= 1, "seeds: expected at least 1, found none")
    chunks = [seeds[k : k + _CHUNK] for k in range(0, len(seeds), _CHUNK)]

    first, bounds = contestants["O1"], dict[str, float]()
    exposed, pixels = first.model.motion.timing.exposure_steps, first.model.sensor.pixels

    def work(chunk: Sequence[int]) -> tuple[dict[str, Track], dict[str, Float64Array], Float64Array, float]:
        recording = record(chunk)
        tracks = {name: follow(contestant, recording, of_state) for name, contestant in contestants.items()}
        seen = recording.outputs[burn_in:, :, :exposed]
        lit = float(np.mean((seen >= pixels.start) & (seen <= pixels.stop)))
        return tracks, recorded_information(linear, recording) if linear else {}, recording.outputs[:, 0], lit

    parts = [part for _, part in map_ahead(work, chunks)]
    tracks = {name: _joined([part[0][name] for part in parts]) for name in contestants}
    shares = [len(chunk) / len(seeds) for chunk in chunks]
    if linear is not None:
        for name in parts[0][1]:
            information = np.asarray(sum(share * part[1][name] for share, part in zip(shares, parts, strict=True)))
            bounds[name] = error_bound(linear, first.start.cov, information, burn_in, of_state)
    of_observers = {name: bounds[c.bound] for name, c in contestants.items() if c.bound in bounds}
    scores = score(tracks, of_observers, burn_in)
    return Experiment(
        seeds=len(seeds),
        scores={
            name: replace(found, of_image=isinstance(contestants[name].observer, ImageFilter))
            for name, found in scores.items()
        },
        bounds=bounds,
        timing=first.model.motion.timing,
        truth=parts[0][2],
        estimates={name: track.example for name, track in tracks.items()},
        errors={name: track.errors.mean(1) for name, track in tracks.items()},
        lit=sum(share * part[3] for share, part in zip(shares, parts, strict=True)),
    )


def _joined(tracks: list[Track]) -> Track:
    """Join the tracks of an observer over different seeds."""
    errors, between, misfits = (
        np.concatenate([getattr(track, name) for track in tracks], 1) for name in ("errors", "between", "misfits")
    )
    return Track(errors, between, misfits, tracks[0].observed, tracks[0].example)


def _augmented_start(cov: Float64Array) -> Gaussian:
    """Prior of the augmented state: ±7 dB taken as two standard deviations of the gain."""
    full = np.zeros((5, 5))
    full[:2, :2] = cov
    full[2:, 2:] = np.diag([0.4, 0.15, 0.35]) ** 2
    return Gaussian(np.zeros(5), full)
