"""What the result of each stage depends on, so that a later run can tell which results still hold."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ..io.limits import input_errors
from ..io.source import FrameSource
from ..memory_plan import MemoryPlan
from ..settings import RestoreParams
from .digests import content_digest, file_digest
from .run_record import versions

# Raised where the same frames and settings begin to give another image.
_RESULTS = 15
_OPTICS = ("pixel_scale", "aperture", "distance", "wavelength")


def stage_dependencies(source: FrameSource, params: RestoreParams, plan: MemoryPlan) -> dict[str, dict[str, Any]]:
    """List what each stage depends on beside the stage before it; reads the input once."""
    settings = dataclasses.asdict(params)
    rows, columns = source.window
    facts = {
        "centroid": {
            "input": content_digest(source),
            "format": source.format,
            "training_frames": _span(source.numbers[: plan.train]),
            # What is repaired, masked or evened out is found by looking at all frames.
            "frames": _span(source.numbers),
            "repaired": None if source.repair is None else list(source.warnings),
            **({} if plan.tile is None else {"tile": plan.tile}),
            "region": [columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start],
            "device": plan.runtime.device,
            "static_mask": params.static_mask if params.static_mask in ("auto", "off") else _digest(params.static_mask),
            "reference": _geometry_digest(params.reference),
            "like": _geometry_digest(params.like),
            "flow": settings["flow"],
            "centroid": settings["centroid"],
            "versions": versions(),
            "results": _RESULTS,
        },
        "dynamics": {"dynamics": settings["dynamics"]},
        "filtered": {name: settings[name] for name in ("keep_best", "filter")},
        "deblurred": {
            **({} if plan.deconvolution_side is None else {"tile": plan.deconvolution_side}),
            "psf": None if params.psf is None else _digest(params.psf),
            **{name: settings[name] for name in (*_OPTICS, "deconvolution", "guards")},
        },
    }
    return json.loads(json.dumps(facts))


def filter_key(facts: dict[str, dict[str, Any]]) -> str:
    """Return a checksum of all that the filter depends on."""
    parts = [facts[stage] for stage in ("centroid", "dynamics", "filtered")]
    return hashlib.blake2b(json.dumps(parts, sort_keys=True).encode(), digest_size=16).hexdigest()


def _digest(path: str) -> str:
    """Return the checksum of a file that a setting names."""
    with input_errors(Path(path)):
        return file_digest(Path(path))


def _geometry_digest(named: str | None) -> str | None:
    """Return the checksum of an image, of flows, or of the stages of a run that have its geometry."""
    if named is None:
        return None
    path = Path(named)
    with input_errors(path):
        files = [path / name for name in ("centroid.npz", "filtered.npz")] if path.is_dir() else [path]
        return " ".join(file_digest(file) for file in files if file.exists())


def _span(numbers: Sequence[int]) -> list[int]:
    return [numbers.start, numbers.stop, numbers.step] if isinstance(numbers, range) else list(numbers)


def list_changes(before: Any, now: Any, name: str = "") -> Iterator[str]:
    """Say what differs between two records, one line for each value."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in {**before, **now}:
            yield from list_changes(before.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif name == "input" and before != now:
        yield "the content of the input has changed"
    elif before != now:
        yield f"{name} was {before} and is {now}"
