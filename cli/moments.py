"""``turbrestore moments``: the experiments with integrative image sensors, as tables and JSON."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

from turbrestore.blur_moments.experiments.comparison import Experiment
from turbrestore.blur_moments.experiments.comparison import mirror as run_mirror
from turbrestore.blur_moments.experiments.comparison import wavefront as run_wavefront
from turbrestore.blur_moments.experiments.scenarios import SLOPE_DISTURBANCE
from turbrestore.core.errors import require_between

from .options import Flag
from .output import print_json
from .progress import say
from .streams import flush

_MOST_SEEDS = 100_000


def wavefront(*, seeds: int = 200, slope_disturbance: float = SLOPE_DISTURBANCE, json: Flag = False) -> None:
    """Compare observers of a wavefront slope behind a slow sensor (paper 1).

    Parameters
    ----------
    seeds : int
        Number of simulated runs.
    slope_disturbance : float
        Standard deviation of what is added to the slope between exposures.
    json : bool
        Print JSON.
    """
    require_between("--seeds", seeds, 2, _MOST_SEEDS)
    start = time.perf_counter()
    experiment = run_wavefront(range(seeds), slope_disturbance)
    _warn(experiment)
    if json:
        _print_record("wavefront", seeds, start, describe(experiment))
    else:
        flush(f"wavefront, {seeds} seeds, error of the state\n{table(experiment)}")


def mirror(*, seeds: int = 200, deviation: float = 7.0, json: Flag = False) -> None:
    """Compare observers of a fast mirror behind a slow camera, its plant known and unknown (paper 2).

    Parameters
    ----------
    seeds : int
        Number of simulated runs.
    deviation : float
        Largest deviation of the unknown plant from the nominal one, above 0 to 7 dB.
    json : bool
        Print JSON.
    """
    require_between("--seeds", seeds, 2, _MOST_SEEDS)
    require_between("--deviation", deviation, 1e-3, 7, "dB")
    start = time.perf_counter()
    known, unknown = run_mirror(range(seeds)), run_mirror(range(seeds), deviation)
    _warn(known, unknown)
    if json:
        _print_record("mirror", seeds, start, {"plant_known": describe(known), "plant_unknown": describe(unknown)})
        return
    flush(f"mirror, {seeds} seeds, plant known, error of the output within the exposure\n{table(known)}")
    flush(f"\nmirror, plant within {deviation:g} dB\n{table(unknown)}")


def describe(experiment: Experiment) -> dict[str, Any]:
    """Scores and bounds of an experiment, to four digits."""
    observers = {
        name: {**_rounded(dataclasses.asdict(score)), "consistent": score.consistent}
        for name, score in experiment.scores.items()
    }
    return {"bounds": _rounded(experiment.bounds), "observers": observers, "lit": _rounded(experiment.lit)}


def table(experiment: Experiment) -> str:
    """Scores of an experiment as aligned text."""
    lines = [f"{'observer':<18}{'error':>9}{'ratio to O1':>16}{'rms':>9}{'bound':>9}{'innovation²':>13}\n"]
    for name, s in experiment.scores.items():
        bound = f"{s.cramer_rao_bound:9.4f}" if s.cramer_rao_bound == s.cramer_rao_bound else f"{'–':>9}"
        ratio = f"{s.ratio:.3f} ± {s.ratio_standard_error:.3f}"
        mark = "" if s.consistent else " *"
        lines.append(f"{name:<18}{s.error:9.4f}{ratio:>16}{s.rms:9.4f}{bound}{s.innovation_squared:13.4f}{mark}\n")
    if not all(score.consistent for score in experiment.scores.values()):
        lines.append("* outside the 95 % band of an observer whose model fits\n")
    return "".join(lines)


def _warn(*experiments: Experiment) -> None:
    for experiment in experiments:
        for warning in experiment.warnings:
            say(warning, quiet=False)


def _print_record(name: str, seeds: int, start: float, found: dict[str, Any]) -> None:
    print_json({"experiment": name, "seeds": seeds, "seconds": _rounded(time.perf_counter() - start), **found})


def _rounded(value: Any) -> Any:
    """Numbers of a record, a tuple or one alone, to four digits."""
    if isinstance(value, dict):
        return {name: _rounded(part) for name, part in value.items()}
    return [_rounded(part) for part in value] if isinstance(value, tuple) else float(f"{value:.4g}")
