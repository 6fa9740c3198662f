"""``turbrestore moments``: the experiments with integrative image sensors, as tables, JSON and figures."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from turbrestore.blur_moments.experiments.comparison import Experiment
from turbrestore.blur_moments.experiments.comparison import mirror as run_mirror
from turbrestore.blur_moments.experiments.comparison import wavefront as run_wavefront
from turbrestore.blur_moments.experiments.figures import draw_mirror, draw_wavefront, new_figure
from turbrestore.blur_moments.experiments.scenarios import MirrorParams, WavefrontParams
from turbrestore.core.errors import require_between
from turbrestore.io.output import atomic_write, check_output

from .options import Flag
from .output import print_json
from .progress import say
from .streams import flush

_PLOTS = (".png",)
_MOST_SEEDS = 100_000


def wavefront(
    *,
    seeds: int = 200,
    plot: Path | None = None,
    params: WavefrontParams = WavefrontParams(),
    overwrite: Flag = False,
    json: Flag = False,
) -> None:
    """Compare observers of a wavefront slope behind a slow sensor (paper 1).

    Parameters
    ----------
    seeds : int
        Number of simulated runs.
    plot : Path
        Picture to write, .png: figures 4 to 7 of the paper. Needs matplotlib.
    params : WavefrontParams
        Settings of the simulation.
    overwrite : bool
        Replace an existing picture.
    json : bool
        Print JSON.
    """
    _check(seeds, plot, overwrite)
    start = time.perf_counter()
    experiment = run_wavefront(range(seeds), params)
    _draw(plot, draw_wavefront, experiment, overwrite)
    _warn(experiment)
    record = {"experiment": "wavefront", "seeds": seeds, "seconds": _rounded(time.perf_counter() - start)}
    if json:
        print_json(record | describe(experiment))
    else:
        flush(f"wavefront, {seeds} seeds, error of the state\n{table(experiment)}")


def mirror(
    *,
    seeds: int = 200,
    plot: Path | None = None,
    deviation: float = 7.0,
    overwrite: Flag = False,
    json: Flag = False,
) -> None:
    """Compare observers of a fast mirror behind a slow camera, its plant known and unknown (paper 2).

    Parameters
    ----------
    seeds : int
        Number of simulated runs.
    plot : Path
        Picture to write, .png: figures 4 to 7 of the paper, plant known. Needs matplotlib.
    deviation : float
        Largest deviation of the unknown plant from the nominal one, above 0 to 7 dB.
    overwrite : bool
        Replace an existing picture.
    json : bool
        Print JSON.
    """
    _check(seeds, plot, overwrite)
    require_between("--deviation", deviation, 1e-3, 7, "dB")
    start = time.perf_counter()
    known = run_mirror(range(seeds))
    unknown = run_mirror(range(seeds), MirrorParams(deviation=deviation))
    _draw(plot, draw_mirror, known, overwrite)
    _warn(known)
    _warn(unknown)
    record = {"experiment": "mirror", "seeds": seeds, "seconds": _rounded(time.perf_counter() - start)}
    if json:
        print_json(record | {"plant_known": describe(known), "plant_unknown": describe(unknown)})
        return
    flush(f"mirror, {seeds} seeds, plant known, error of the output within the exposure\n{table(known)}")
    flush(f"\nmirror, plant within {deviation:g} dB\n{table(unknown)}")


def describe(experiment: Experiment) -> dict[str, Any]:
    """Scores and bounds of an experiment, to four digits."""
    observers = {}
    for name, score in experiment.scores.items():
        observers[name] = {
            "error": _rounded(score.error),
            "ratio": _rounded(score.ratio),
            "ratio_standard_error": _rounded(score.ratio_error),
            "rms": _rounded(score.rms),
            "rms_standard_error": _rounded(score.rms_error),
            "cramer_rao_bound": _rounded(score.bound),
            "error_until_next_frame": _rounded(score.between),
            "innovation_squared": _rounded(score.innovation),
            "innovation_band": [_rounded(score.innovation_low), _rounded(score.innovation_high)],
            "consistent": score.consistent,
        }
    bounds = {name: _rounded(value) for name, value in experiment.bounds.items()}
    return {"bounds": bounds, "observers": observers, "lit": _rounded(experiment.lit)}


def table(experiment: Experiment) -> str:
    """Scores of an experiment as aligned text."""
    head = f"{'observer':<18}{'error':>9}{'ratio to O1':>16}{'rms':>9}{'bound':>9}{'innovation²':>13}\n"
    lines = [head]
    for name, s in experiment.scores.items():
        bound = f"{s.bound:9.4f}" if s.bound == s.bound else f"{'–':>9}"
        ratio = f"{s.ratio:.3f} ± {s.ratio_error:.3f}"
        mark = "" if s.consistent else " *"
        lines.append(f"{name:<18}{s.error:9.4f}{ratio:>16}{s.rms:9.4f}{bound}{s.innovation:13.4f}{mark}\n")
    if not all(score.consistent for score in experiment.scores.values()):
        lines.append("* outside the 95 % band of an observer whose model fits\n")
    return "".join(lines)


def _check(seeds: int, plot: Path | None, overwrite: bool) -> None:
    require_between("--seeds", seeds, 2, _MOST_SEEDS)
    if plot is not None:
        check_output(plot, overwrite=overwrite, suffixes=_PLOTS)
        new_figure()


def _draw(plot: Path | None, draw: Callable[[Experiment], bytes], experiment: Experiment, overwrite: bool) -> None:
    if plot is not None:
        atomic_write(plot, draw(experiment), overwrite)


def _warn(experiment: Experiment) -> None:
    for warning in experiment.warnings:
        say(warning, quiet=False)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
