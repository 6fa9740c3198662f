"""What the report says in words and figures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..metrics import sharpness
from ..runs.run_record import RunRecord
from ..runtime.scratch import drop_pages, variance_of
from ..settings import Restoration, RestoreParams

_STAGE_NAMES = {
    "read": "Reading",
    "centroid": "Centroid",
    "identify": "Flow model",
    "filter": "Alternating filter",
    "deconvolve": "Deconvolution",
}


@dataclass(frozen=True)
class Fact:
    """One measured value.

    Attributes
    ----------
    name, value, note : str
        The note says how to read it, or is empty.
    doubtful : bool
        Whether a person should have a look.
    """

    name: str
    value: str
    note: str = ""
    doubtful: bool = False


@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes
    ----------
    name, value : str
    changed : bool
        Whether it differs from the default.
    """

    name: str
    value: str
    changed: bool


@dataclass(frozen=True)
class Lap:
    """Time of one stage.

    Attributes
    ----------
    name : str
    seconds : float
    start, share : float
        Percent of the whole run.
    """

    name: str
    seconds: float
    start: float
    share: float


def headline(restoration: Restoration) -> list[Fact]:
    """Key figures.

    Parameters
    ----------
    restoration : Restoration

    Returns
    -------
    list of Fact
    """
    spread = float(np.sqrt(variance_of(restoration.centroid.flows).sum(axis=-1).mean()))
    facts = [
        Fact("Frames", str(restoration.frame_count), f"{restoration.train} trained the model"),
        Fact("Motion", f"{spread:.2f} px", "root mean square"),
    ]
    x, y, width, height = restoration.crop
    mean = restoration.mean[y : y + height, x : x + width]
    contrast = np.ptp(mean)
    drop_pages(mean)
    if contrast > 0:
        facts.append(Fact("Sharpness", f"×{sharpness(restoration.image, mean):.2f}", "that of the mean"))
    if restoration.deconvolution is not None:
        sigma = restoration.deconvolution.sigma
        facts.append(Fact("Blur removed", f"{sigma:.2f} px" if sigma > 0 else "none", _blur_note(restoration)))
    facts.append(Fact("Time", _duration(sum(restoration.seconds.values())), "all stages"))
    return facts


def findings(restoration: Restoration) -> list[Fact]:
    """Figures that every stage found.

    Parameters
    ----------
    restoration : Restoration

    Returns
    -------
    list of Fact
    """
    return [
        *_of_motion(restoration),
        *_of_filter(restoration),
        *_of_blur(restoration),
        *_of_guards(restoration),
    ]


def remarks(restoration: Restoration, run: RunRecord) -> list[str]:
    """Warnings of the reader and notes of the stages.

    Parameters
    ----------
    restoration : Restoration
    run : RunRecord

    Returns
    -------
    list of str
    """
    notes = () if restoration.dynamics is None else restoration.dynamics.notes
    return [*run.warnings, *notes]


def settings(run: RunRecord) -> list[Setting]:
    """All settings, with dots between their levels as the command line has them.

    Parameters
    ----------
    run : RunRecord

    Returns
    -------
    list of Setting
    """
    defaults = dict(_flat(dataclasses.asdict(RestoreParams())))
    return [
        Setting(name.replace("_", "-"), _as_written(value), value != defaults.get(name))
        for name, value in _flat(run.settings)
    ]


def laps(restoration: Restoration) -> list[Lap]:
    """Time of every stage, one after the other.

    Parameters
    ----------
    restoration : Restoration

    Returns
    -------
    list of Lap
    """
    total = sum(restoration.seconds.values()) or 1.0
    found, start = [], 0.0
    for name, seconds in restoration.seconds.items():
        found.append(Lap(_STAGE_NAMES.get(name, name), seconds, 100 * start / total, 100 * seconds / total))
        start += seconds
    return found


def _of_motion(restoration: Restoration) -> Iterator[Fact]:
    centroid, dynamics = restoration.centroid, restoration.dynamics
    yield Fact(
        "Centroid",
        f"{centroid.mean_flow_sizes.size} iterations, {centroid.mean_flow_sizes[-1]:.2f} px of mean flow left",
        "converged" if centroid.converged else "not converged: allow more iterations",
        not centroid.converged,
    )
    if dynamics is None:
        return
    yield Fact(
        "Flow model",
        f"{dynamics.rank} states, {100 * dynamics.energy_share:.1f} % of the motion",
        "overfitted: too few flows for so many states" if dynamics.overfitted else f"of {dynamics.frame_count} flows",
        dynamics.overfitted,
    )
    largest = float(np.abs(dynamics.eigenvalues).max(initial=0.0))
    note = "the motion dies out" if largest < 1 else "the motion does not die out"
    yield Fact("Largest eigenvalue", f"{largest:.3f}", note)
    yield Fact("Flow outside the model", f"{math.sqrt(dynamics.R):.2f} px", "standard deviation")


def _of_filter(restoration: Restoration) -> Iterator[Fact]:
    filtered = restoration.filtered
    if filtered is None:
        return
    yield Fact("Innovation", f"{np.nanmean(filtered.innovations):.2f} px", "motion that was not foreseen, mean")
    yield Fact("Noise of a frame", f"{100 * math.sqrt(filtered.image_noise):.2f} %", "of full scale, about the image")
    yield Fact("Motion outside the model", f"{100 * filtered.motion_share:.0f} %", "taken as motion, the rest as noise")
    effective = 1 / float(np.square(filtered.shares).sum())
    yield Fact("Effective frames", f"{effective:.1f} of {filtered.shares.size}", "as many equal shares tell as much")


def _of_blur(restoration: Restoration) -> Iterator[Fact]:
    blur, bounds, done = restoration.blur, restoration.blur_bounds, restoration.deconvolution
    if blur is not None:
        known = math.isfinite(blur.uncertainty)
        value = f"{blur.sigma:.2f} ± {blur.uncertainty:.2f} px" if known else f"{blur.sigma:.2f} px"
        note = f"evidence {blur.evidence:.2f}, image reduced {blur.reduction}×" if known else "the image says nothing"
        yield Fact("Estimated blur", value, note, not known)
    if bounds is not None:
        yield Fact("Bounds of the blur", f"{bounds.low:.2f} to {bounds.high:.2f} px", "from frames and mean")
    if done is not None:
        yield Fact("Noise before deblurring", f"{100 * done.noise:.2f} %", "of full scale")
        if done.sigma > 0:
            note = "converged" if done.converged else "not converged: allow more iterations"
            value = f"{done.sigma:.2f} px removed in {done.iterations} iterations, fidelity {done.fidelity:.0f}"
            yield Fact("Deconvolution", value, note, not done.converged)


def _of_guards(restoration: Restoration) -> Iterator[Fact]:
    for reading in restoration.guard_readings:
        value = f"{100 * reading.overshoot:.1f} % overshoots, noise ×{reading.noise_gain:.1f}"
        note = "passed" if reading.passed else "too much: less blur is removed"
        yield Fact(f"Guards at {reading.sigma:.2f} px", value, note, not reading.passed)


def _blur_note(restoration: Restoration) -> str:
    blur = restoration.blur
    if blur is None:
        return "as asked for"
    if not math.isfinite(blur.uncertainty):
        return "could not be estimated"
    return f"estimated {blur.sigma:.2f} ± {blur.uncertainty:.2f}"


def _as_written(value: Any) -> str:
    """Value as a settings file has it; None is left to be measured."""
    if isinstance(value, bool):
        return str(value).lower()
    return "automatic" if value is None else str(value)


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds // 60:.0f} min {seconds % 60:.0f} s"


def _flat(record: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in record.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
