"""The experiments of both papers: how well each observer does, over many seeds at once, and what no observer can beat.

The set-ups are in :mod:`.scenarios`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ...core.errors import require
from ...filtering.kalman import Gaussian
from ...runtime.threads import map_ahead
from ..blur_model import BlurModel
from .bounds import image_information, moment_information, posterior_bound
from ..image_observer import ImageFilter
from ..kernels import Float64Array
from ..lifting import LiftedSystem
from ..observers import MomentFilter, luenberger, steady_kalman
from .scenarios import (
    MirrorParams,
    WavefrontParams,
    mirror_model,
    mirror_oscillator,
    record_mirror,
    record_wavefront,
    wavefront_model,
)
from ..sensor import ExposureTiming
from .trials import Contestant, Recording, Score, Track, follow, join_tracks, score

# Seeds handled together: enough to spare NumPy's overhead, few enough to stay in the cache.
_CHUNK = 25
_LEGENDRE = "legendre"


@dataclass(frozen=True, eq=False)
class Experiment:
    """Outcome of an experiment.

    Parameters
    ----------
    seeds : int
        Number of runs.
    scores : dict of str to Score
        By observer; ratios are to the first.
    bounds : dict of str to float
        Cramér–Rao bounds on the root mean square error: ``moments`` (orders 1 and 2), ``moments_1_to_4``, ``image``.
    timing : ExposureTiming
    truth : ndarray, float64, shape (T, N)
        Output of the first seed.
    estimates : dict of str to ndarray, float64, shape (T, N)
        Of the first seed, by observer.
    errors : dict of str to ndarray, float64, shape (T,)
        Error after every frame, mean over the seeds, by observer.
    """

    seeds: int
    scores: dict[str, Score]
    bounds: dict[str, float]
    timing: ExposureTiming
    truth: Float64Array
    estimates: dict[str, Float64Array]
    errors: dict[str, Float64Array]


def wavefront(seeds: Sequence[int], params: WavefrontParams | None = None) -> Experiment:
    """Run the wavefront experiment.

    Parameters
    ----------
    seeds : sequence of int
        One run each.
    params : WavefrontParams

    Returns
    -------
    Experiment
        The error is the norm of the error of the state after the frame. O1 is the settled Kalman filter on the first
        moment, O2 uses the second, O3 both; the rest goes beyond the paper.

    Raises
    ------
    ConfigurationError
        No seeds.

    Examples
    --------
    >>> result = wavefront(range(2), WavefrontParams(frames=4, burn_in=1))
    >>> sorted(result.bounds)
    ['image', 'moments', 'moments_1_to_4']
    """
    settings = params or WavefrontParams()
    model = wavefront_model(settings)
    observer, cov = steady_kalman(model)
    start = Gaussian(np.zeros(2), cov)
    two, four = (1, 2), (1, 2, 3, 4)
    contestants = {
        "O1": Contestant(observer, model, start, "moments"),
        "O2": Contestant(MomentFilter((2,)), model, start, "moments"),
        "O3": Contestant(MomentFilter(two), model, start, "moments"),
        "O3_legendre": Contestant(MomentFilter(two, _LEGENDRE), model, start, "moments"),
        "O3_unscented": Contestant(MomentFilter(two, _LEGENDRE, "unscented"), model, start, "moments"),
        "O3_iterated": Contestant(MomentFilter(two, _LEGENDRE, "iterated"), model, start, "moments"),
        "moments_1_to_4": Contestant(MomentFilter(four, _LEGENDRE), model, start, "moments_1_to_4"),
        "image_one_step": Contestant(ImageFilter(iterations=1), model, start, "image"),
        "image_map": Contestant(ImageFilter(), model, start, "image"),
    }
    return _run(
        seeds,
        lambda chunk: record_wavefront(chunk, settings),
        contestants,
        settings.burn_in,
        of_state=True,
        linear=model,
    )


def mirror(seeds: Sequence[int], params: MirrorParams | None = None) -> Experiment:
    """Run the mirror experiment.

    Parameters
    ----------
    seeds : sequence of int
        One run each.
    params : MirrorParams
        With ``deviation`` above 0 the plant is another one for every seed, and the observers do not know it.

    Returns
    -------
    Experiment
        The error is the root mean square error of the output within the exposure. O1 is a Luenberger observer on the
        first moment with the Kalman gain, O2 uses moments 1 and 2, O3 predicts the image; ``augmented`` estimates gain,
        frequency and damping as well; of 200 runs with an unknown plant about three settle on a wrong one, which
        their innovations show. Bounds are for the known plant.

    Raises
    ------
    ConfigurationError
        No seeds.

    Examples
    --------
    >>> result = mirror([0, 1], MirrorParams(frames=3, burn_in=1, deviation=7.0))
    >>> list(result.scores)
    ['O1', 'O2', 'O3', 'O3_map', 'augmented']
    """
    settings = params or MirrorParams()
    model = mirror_model(settings)
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
    if settings.deviation > 0:
        augmented = BlurModel(mirror_oscillator(settings), model.sensor)
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
    return _run(
        seeds,
        lambda chunk: record_mirror(chunk, settings),
        contestants,
        settings.burn_in,
        of_state=False,
        linear=None if settings.deviation > 0 else model,
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

    def work(chunk: Sequence[int]) -> tuple[dict[str, Track], dict[str, Float64Array], Float64Array]:
        recording = record(chunk)
        tracks = {name: follow(contestant, recording, of_state) for name, contestant in contestants.items()}
        return tracks, _informations(linear, recording), recording.outputs[:, 0]

    parts = [part for _, part in map_ahead(work, chunks)]
    tracks = {name: join_tracks([part[0][name] for part in parts]) for name in contestants}
    bounds: dict[str, float] = {}
    if linear is not None:
        cov = contestants["O1"].start.cov
        weights = [len(chunk) / len(seeds) for chunk in chunks]
        for name in parts[0][1]:
            information = sum(w * part[1][name] for w, part in zip(weights, parts, strict=True))
            bounds[name] = _bound(linear, cov, np.asarray(information), burn_in, of_state)
    of_observers = {name: bounds[c.bound] for name, c in contestants.items() if c.bound in bounds}
    model = contestants["O1"].model
    return Experiment(
        seeds=len(seeds),
        scores=score(tracks, of_observers, burn_in),
        bounds=bounds,
        timing=model.motion.timing,
        truth=parts[0][2],
        estimates={name: track.example for name, track in tracks.items()},
        errors={name: track.errors.mean(1) for name, track in tracks.items()},
    )


def _informations(model: BlurModel | None, recording: Recording) -> dict[str, Float64Array]:
    """Mean information of every frame by what is measured; the known motion has as many states as the model."""
    if model is None:
        return {}
    states = recording.states[..., : model.motion.order]
    return {
        "moments": moment_information(model, states, recording.inputs, (1, 2), _LEGENDRE).mean(1),
        "moments_1_to_4": moment_information(model, states, recording.inputs, (1, 2, 3, 4), _LEGENDRE).mean(1),
        "image": image_information(model, states, recording.inputs).mean(1),
    }


def _bound(model: BlurModel, cov: Float64Array, information: Float64Array, burn_in: int, of_state: bool) -> float:
    """Bound on the root mean square error of the state, or of the output within the exposure."""
    motion = model.motion
    assert isinstance(motion, LiftedSystem)
    covariances = posterior_bound(motion.A, motion.Q, cov, information)[burn_in:]
    free = motion.free[: motion.timing.exposure_steps]
    weight = np.eye(motion.order) if of_state else free.T @ free / len(free)
    return float(np.sqrt(np.einsum("ab,tba->t", weight, covariances).mean()))


def _augmented_start(cov: Float64Array) -> Gaussian:
    """Prior of the augmented state: ±7 dB taken as two standard deviations of the gain."""
    full = np.zeros((5, 5))
    full[:2, :2] = cov
    full[2:, 2:] = np.diag([0.4, 0.15, 0.35]) ** 2
    return Gaussian(np.zeros(5), full)
