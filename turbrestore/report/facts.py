"""The figures and sentences of the report."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..blur.posterior import BlurPosterior
from ..core.remarks import counted
from ..registration.coverage import SEEN, coverage
from ..results import Restoration
from ..runs.run_record import RunRecord
from ..settings import RestoreParams
from ..wording import interval_words
from .detail import detail_spectrum

_STAGE_NAMES = {
    "read": "Reading",
    "centroid": "Centroid",
    "seeing": "Seeing",
    "identify": "Flow model",
    "filter": "Alternating filter",
    "noise": "Noise of the halves",
    "witnesses": "Witnesses of the blur",
    "width": "Width of the blur",
    "deconvolve": "Deconvolution",
    "agreement": "Agreement of the halves",
    "uncertainty": "Uncertainty",
}


# What a run takes of its input and of the machine unless told otherwise; what is not named here is left open.
_USUAL_RUN = {
    **{"preset": "standard", "threads": 0, "device": "cpu", "hdr": "sdr"},
    **dict.fromkeys(("strict", "skip_damaged", "crop_to_object"), False),
}


@dataclass(frozen=True)
class Fact:
    """One measured value."""

    # The note says how to read the value, or is empty.
    name: str
    value: str
    note: str = ""
    doubtful: bool = False  # whether the value should be checked by a person


@dataclass(frozen=True)
class Setting:
    """One setting."""

    name: str
    value: str
    changed: bool  # whether it differs from the default


@dataclass(frozen=True)
class Lap:
    """Time that one stage took."""

    name: str
    seconds: float
    # Percent of the time of the whole run.
    start: float
    share: float


def headline(restoration: Restoration) -> list[Fact]:
    """Return the key figures at the top of the page."""
    facts = [
        Fact("Frames", str(restoration.frame_count), f"{restoration.train} of them for training"),
        Fact("Motion", f"{restoration.motion:.2f} px", "root mean square"),
    ]
    if not math.isnan(restoration.sharpening):
        facts.append(Fact("Sharpness", f"×{restoration.sharpening:.2f}", "relative to the mean"))
    if restoration.deconvolution is not None:
        sigma = restoration.deconvolution.sigma
        facts.append(Fact("Blur removed", f"{sigma:.2f} px" if sigma > 0 else "none", _blur_note(restoration)))
    facts.append(Fact("Time", duration(sum(restoration.seconds.values())), "all stages"))
    return facts


def findings(restoration: Restoration) -> list[Fact]:
    """Return the results of every stage."""
    return [
        *_motion_facts(restoration),
        *_filter_facts(restoration),
        *_blur_facts(restoration),
        *_guard_facts(restoration),
        *_seeing_facts(restoration),
        *_uncertainty_facts(restoration),
    ]


def settings(run: RunRecord, defaults: Mapping[str, Any] | None = None) -> list[Setting]:
    """Return all settings, named as on the command line, with dots between the levels."""
    usual = dict(_flat({**_USUAL_RUN, **dataclasses.asdict(RestoreParams())} if defaults is None else defaults))
    return [
        Setting(name.replace("_", "-"), _as_written(value), value != usual.get(name))
        for name, value in _flat(run.settings)
    ]


def laps(restoration: Restoration) -> list[Lap]:
    """Return the time of every stage, in the order of the run."""
    total = sum(restoration.seconds.values()) or 1.0
    found, start = [], 0.0
    for name, seconds in restoration.seconds.items():
        found.append(Lap(_STAGE_NAMES.get(name, name), seconds, 100 * start / total, 100 * seconds / total))
        start += seconds
    return found


def _motion_facts(restoration: Restoration) -> Iterator[Fact]:
    centroid, dynamics = restoration.centroid, restoration.dynamics
    iterations = counted(centroid.mean_flow_sizes.size, "iteration")
    yield Fact(
        "Centroid",
        f"{iterations}, {centroid.mean_flow_sizes[-1]:.2f} px mean flow remaining",
        "converged" if centroid.converged else "not converged: allow more iterations",
        not centroid.converged,
    )
    if dynamics is None:
        return
    yield Fact(
        "Flow model",
        f"{counted(dynamics.rank, 'state')}, {100 * dynamics.energy_share:.1f} % of the motion",
        "overfitted: too few flows for so many states" if dynamics.overfitted else f"of {dynamics.frame_count} flows",
        dynamics.overfitted,
    )
    largest = float(np.abs(dynamics.eigenvalues).max(initial=0.0))
    note = "stable: the simulated motion decays" if largest < 1 else "the simulated motion does not decay"
    yield Fact("Largest eigenvalue", f"{largest:.3f}", note)
    yield Fact("Flow outside the model", f"{math.sqrt(dynamics.R):.2f} px", "standard deviation")


def _filter_facts(restoration: Restoration) -> Iterator[Fact]:
    filtered = restoration.filtered
    if filtered is None:
        return
    yield Fact("Innovation", f"{np.nanmean(filtered.innovations):.2f} px", "mean motion that the model did not predict")
    yield Fact(
        "Noise of a frame", f"{100 * math.sqrt(filtered.image_noise):.2f} %", "of full scale, deviation from the image"
    )
    effective = 1 / float(np.square(filtered.shares).sum())
    yield Fact(
        "Effective frames",
        f"{effective:.1f} of {filtered.shares.size}",
        "as many frames of equal weight would have the same noise",
    )


def _blur_facts(restoration: Restoration) -> Iterator[Fact]:
    blur, done, posterior = restoration.blur, restoration.deconvolution, restoration.posterior
    if posterior is not None:
        low, width, high = posterior.width
        note = f"{low:.2f} to {high:.2f} px; the air has blurred it with a probability of {posterior.air:.0%}"
        yield Fact("Blur by all witnesses", f"{width:.2f} px", note)
    elif blur is not None:
        known = math.isfinite(blur.uncertainty)
        value = f"{blur.sigma:.2f} ± {blur.uncertainty:.2f} px" if known else f"{blur.sigma:.2f} px"
        note = f"evidence {blur.evidence:.2f}, image reduced {blur.reduction}×" if known else "cannot be measured"
        yield Fact("Estimated blur", value, note, not known)
    found = detail_spectrum(restoration)
    if found is not None:
        note = f"{found.limit:.2f} cycles per pixel: beyond, noise is stronger than the scene"
        yield Fact("Finest detail", f"{1 / found.limit:.1f} px a period", note)
    if done is not None:
        note = "of full scale: white noise as strong as that where the blur leaves half of the detail"
        yield Fact("Noise that deblurring meets", f"{100 * done.noise:.2f} %", note)
        if done.sigma > 0:
            note = "converged" if done.converged else "not converged: allow more iterations"
            value = (
                f"{done.sigma:.2f} px removed in {counted(done.iterations, 'iteration')}, fidelity {done.fidelity:.0f}"
            )
            yield Fact("Deconvolution", value, note, not done.converged)


def _guard_facts(restoration: Restoration) -> Iterator[Fact]:
    for reading in restoration.guard_readings:
        shares = f"{reading.ringing:.0%} of edges ring, {reading.overshoot:.0%} of pixels near them overshoot"
        value = f"{shares}, noise ×{reading.noise_gain:.1f}"
        note = "passed" if reading.passed else "failed: less blur is removed"
        yield Fact(f"Guards at {reading.sigma:.2f} px", value, note, not reading.passed)


def _seeing_facts(restoration: Restoration) -> Iterator[Fact]:
    seeing = restoration.seeing
    if seeing is None:
        return
    notes = {
        "displacement_variance": "per axis, over a long time; 95 % interval",
        "displacement_by_flow": "over this clip",
        "displacement_by_blur": "over this clip, from the blur of the mean; above 2 px² it is a lower bound",
        "isoplanatic_patch": "separation at which the motion is half correlated",
        "coherence_time": "lag at which the correlation of the motion falls to 1/e",
    }
    for name, (estimate, unit) in seeing.estimates().items():
        if estimate is not None and name in notes:
            value = f"{interval_words(estimate)} {unit}"
            yield Fact(name.replace("_", " ").capitalize(), value, notes[name])
    for remark in seeing.remarks:
        yield Fact("Displacement", "uncertain", remark, True)


def _uncertainty_facts(restoration: Restoration) -> Iterator[Fact]:
    deviation = restoration.uncertainty
    if deviation is None:
        return
    known = np.isfinite(deviation)
    # Few frames show the border, and its deviation says nothing of the rest.
    interior = known & (coverage(restoration.centroid.flows)[restoration.shown] >= SEEN)
    if interior.any():
        middle, high = (255 * float(value) for value in np.quantile(deviation[interior], (0.5, 0.95)))
        note = f"of 255, in the median of what nine frames in ten show; below {high:.1f} in 95 % of it"
        yield Fact("Standard deviation of a pixel", f"{middle:.1f} grey levels", note)
    if not known.all():
        value = f"{100 * (1 - known.mean()):.1f} % of the pixels"
        yield Fact("Without information", value, "saturated, or seen in no frame", True)


def _blur_note(restoration: Restoration) -> str:
    blur = restoration.blur
    if restoration.posterior is not None:
        low, width, high = restoration.posterior.width
        return f"measured {width:.2f} ({low:.2f} to {high:.2f}){_why_less(restoration, restoration.posterior)}"
    if blur is None:
        return "as requested"
    if not math.isfinite(blur.uncertainty):
        return "could not be estimated"
    return f"estimated {blur.sigma:.2f} ± {blur.uncertainty:.2f}"


def _why_less(restoration: Restoration, posterior: BlurPosterior) -> str:
    """Say why less blur is removed than the range that was measured; empty where it is not less."""
    done = restoration.deconvolution
    if done is None or done.sigma >= posterior.width[0]:
        return ""
    if done.sigma < posterior.removed:
        return "; the guards against ringing and noise forbid more"
    if posterior.edge_limited:
        return "; the edges of the image are too steep for more"
    return "; whether removing more would help is doubtful"


def _as_written(value: Any) -> str:
    """Value as a settings file writes it; None means that it is measured."""
    if isinstance(value, bool):
        return str(value).lower()
    return "automatic" if value is None else str(value)


def duration(seconds: float) -> str:
    """Time in seconds, or in minutes and seconds."""
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s"


def _flat(record: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in record.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
