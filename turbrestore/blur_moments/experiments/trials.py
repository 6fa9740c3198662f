"""Run observers side by side on simulated recordings, and score them.

A recording holds many seeds at once, so that every observer corrects them all in one step.  Errors are compared within
a seed: the ratio of two observers has a much smaller standard error than either error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from ...filtering.kalman import Gaussian
from ..blur_model import BlurModel, Motion
from ..kernels import Float64Array
from ..observers import Observer, run_observer
from ..sensor import LineSensor, expose

# Share of the consistency band.
_BAND = 0.95


@dataclass(frozen=True, eq=False)
class Recording:
    """Simulated truth and what the sensor saw of it; T frames, S seeds.

    Parameters
    ----------
    inputs : ndarray, float64, shape (T, S, N)
    states : ndarray, float64, shape (T, S, n)
        At the start of every exposure.
    outputs : ndarray, float64, shape (T, S, N)
        At every fast step.
    frames : ndarray, float64, shape (T, S, count)
    """

    inputs: Float64Array
    states: Float64Array
    outputs: Float64Array
    frames: Float64Array


@dataclass(frozen=True, eq=False)
class Contestant:
    """An observer, the model it believes in, and what it knows before the first frame.

    Parameters
    ----------
    observer : Observer
    model : BlurModel
    start : Gaussian
        Shape (n,).
    bound : str
        Which Cramér–Rao bound holds for it.
    """

    observer: Observer
    model: BlurModel
    start: Gaussian
    bound: str = ""


@dataclass(frozen=True, eq=False)
class Track:
    """What an observer made of a recording.

    Parameters
    ----------
    errors : ndarray, float64, shape (T, S)
        Of the state, or of the output within the exposure.
    between : ndarray, float64, shape (T, S)
        Root mean square error of the output over all fast steps until the next exposure.
    misfits : ndarray, float64, shape (T, S)
        Normalised innovation squared.
    observed : int
        Degrees of freedom of one of them.
    example : ndarray, float64, shape (T, N)
        Estimated output of the first seed.

    Examples
    --------
    >>> Track(np.ones((3, 2)), np.ones((3, 2)), np.ones((3, 2)), 1, np.ones((3, 5))).observed
    1
    """

    errors: Float64Array
    between: Float64Array
    misfits: Float64Array
    observed: int
    example: Float64Array


@dataclass(frozen=True)
class Score:
    """How an observer did over all seeds, after the frames in which it settles.

    Parameters
    ----------
    error : float
        Mean error.
    ratio, ratio_error : float
        Mean error over that of the first observer, and its standard error.
    rms, rms_error : float
        Root mean square error, and its standard error.
    bound : float
        Cramér–Rao bound on ``rms``; NaN where none is known.
    between : float
        Mean error of the output over all fast steps until the next exposure.
    innovation : float
        Normalised innovation squared per degree of freedom.
    innovation_low, innovation_high : float
        Band that holds it in 95 % of all runs if the model fits.
    """

    error: float
    ratio: float
    ratio_error: float
    rms: float
    rms_error: float
    bound: float
    between: float
    innovation: float
    innovation_low: float
    innovation_high: float

    @property
    def consistent(self) -> bool:
        """Whether the innovations are as large as the observer believes."""
        return self.innovation_low <= self.innovation <= self.innovation_high


def simulate(
    motion: Motion,
    sensor: LineSensor,
    start: Float64Array,
    inputs: Float64Array,
    disturbances: Float64Array,
    noise: Float64Array,
) -> Recording:
    """Simulate a motion and the frames it leaves.

    Parameters
    ----------
    motion : Motion
    sensor : LineSensor
    start : ndarray, float64, shape (S, n)
        State at the start of the first exposure.
    inputs : ndarray, float64, shape (T, S, N)
    disturbances : ndarray, float64, shape (T, S, n)
        Added to the state between two exposures.
    noise : ndarray, float64, shape (T, S, count)
        Standard normal numbers, scaled to the noise of the sensor.

    Returns
    -------
    Recording

    Examples
    --------
    >>> from turbrestore.blur_moments.experiments.scenarios import wavefront_model
    >>> model, none = wavefront_model(), np.zeros((2, 1, 2))
    >>> still = simulate(model.motion, model.sensor, none[0], np.zeros((2, 1, 200)), none, np.zeros((2, 1, 100)))
    >>> still.frames.shape, float(round(still.frames[1, 0].sum() * 0.02, 6))
    ((2, 1, 100), 1.0)
    """
    state, states, outputs, frames = start, [], [], []
    still = np.zeros((start.shape[-1], start.shape[-1]))
    for held, jolt, grain in zip(inputs, disturbances, noise, strict=True):
        now = Gaussian(state, still)
        output, _ = motion.fast_output(now, held)
        image = expose(output[:, : motion.timing.exposure_steps], sensor.kernel, sensor.pixels, sensor.total)
        states.append(state)
        outputs.append(output)
        frames.append(image + np.sqrt(sensor.noise / sensor.pixels.width) * grain)
        state = motion.advance(now, held).mean + jolt
    return Recording(inputs, np.array(states), np.array(outputs), np.array(frames))


def follow(contestant: Contestant, recording: Recording, of_state: bool) -> Track:
    """Run an observer over a recording and measure its errors.

    Parameters
    ----------
    contestant : Contestant
    recording : Recording
    of_state : bool
        Whether the error is the norm of the error of the state, or the root mean square error of the output within
        the exposure.

    Returns
    -------
    Track

    Examples
    --------
    >>> from turbrestore.blur_moments.observers import MomentFilter
    >>> from turbrestore.blur_moments.experiments.scenarios import WavefrontParams, record_wavefront, wavefront_model
    >>> contestant = Contestant(MomentFilter(), wavefront_model(), Gaussian(np.zeros(2), 0.01 * np.eye(2)))
    >>> follow(contestant, record_wavefront([0, 1], WavefrontParams(frames=3, burn_in=0)), of_state=True).errors.shape
    (3, 2)
    """
    model, start = contestant.model, contestant.start
    seeds = recording.states.shape[1]
    everyone = Gaussian(np.broadcast_to(start.mean, (seeds, start.mean.size)), start.cov)
    results = run_observer(contestant.observer, model, everyone, recording.frames, recording.inputs)
    steps = model.motion.timing.exposure_steps
    estimates = np.array(
        [model.motion.fast_output(state, held)[0] for (state, _), held in zip(results, recording.inputs, strict=True)]
    )
    away = (estimates - recording.outputs) ** 2
    if of_state:
        errors = np.array(
            [np.linalg.norm(s.mean - x, axis=-1) for (s, _), x in zip(results, recording.states, strict=True)]
        )
    else:
        errors = np.sqrt(away[..., :steps].mean(-1))
    return Track(
        errors=errors,
        between=np.sqrt(away.mean(-1)),
        misfits=np.array([innovation.normalised_squared for _, innovation in results]),
        observed=int(results[0][1].observed.flat[0]),
        example=estimates[:, 0],
    )


def join_tracks(tracks: list[Track]) -> Track:
    """Put tracks of the same observer over different seeds together.

    Parameters
    ----------
    tracks : list of Track

    Returns
    -------
    Track

    Examples
    --------
    >>> track = Track(np.ones((3, 2)), np.ones((3, 2)), np.ones((3, 2)), 1, np.ones((3, 5)))
    >>> join_tracks([track, track]).errors.shape
    (3, 4)
    """
    errors, between, misfits = (
        np.concatenate([getattr(track, name) for track in tracks], 1) for name in ("errors", "between", "misfits")
    )
    return Track(errors, between, misfits, tracks[0].observed, tracks[0].example)


def score(tracks: Mapping[str, Track], bounds: Mapping[str, float], burn_in: int) -> dict[str, Score]:
    """Compare observers with the first of them and with the bounds.

    Parameters
    ----------
    tracks : mapping of str to Track
        All over the same recordings.
    bounds : mapping of str to float
        Cramér–Rao bound for some of the observers.
    burn_in : int
        Frames left out at the start.

    Returns
    -------
    dict of str to Score

    Examples
    --------
    >>> track = Track(np.ones((3, 2)), np.ones((3, 2)), np.ones((3, 2)), 1, np.ones((3, 5)))
    >>> half = Track(track.errors / 2, track.between, track.misfits, 1, track.example)
    >>> score({"first": track, "second": half}, {}, burn_in=0)["second"].ratio
    0.5
    """
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
