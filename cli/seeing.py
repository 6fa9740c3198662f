"""``turbrestore seeing``: how strong the turbulence in a clip is."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from turbrestore.memory_plan import frames_in_memory, training_share
from turbrestore.preparation import prepare
from turbrestore.registration.centroid import CentroidParams, centroid_steps
from turbrestore.registration.flow import FlowParams
from turbrestore.runtime.steps import finish, step_counter
from turbrestore.seeing.strength import Seeing, seeing_of_picture
from turbrestore.seeing.tilt_theory import Optics, known_optics
from turbrestore.wording import interval_words

from .inputs import open_input
from .options import Flag, Machine, Selection
from .output import print_json
from .progress import progress_bars
from .streams import put


def seeing(
    input: Path,
    /,
    *,
    pixel_scale: float | None = None,
    aperture: float | None = None,
    distance: float | None = None,
    wavelength: float = 550e-9,
    path: Literal["spherical", "plane"] = "spherical",
    train: int | None = None,
    selection: Annotated[Selection, Parameter(name="*")] = Selection(),
    json: Flag = False,
    quiet: Flag = False,
    machine: Annotated[Machine, Parameter(name="*")] = Machine(),
    centroid: CentroidParams = CentroidParams(),
    flow: FlowParams = FlowParams(),
) -> None:
    """Measure how strong the turbulence in a clip is.

    Parameters
    ----------
    input : Path
        Video.
    pixel_scale : float
        Angle of a pixel, rad.  With it and the aperture D/r0 and r0 are reported.
    aperture : float
        Diameter of the aperture, m.
    distance : float
        From the aperture to the scene, m.  With it Cn² is reported too, and D/r0 is much better known.
    wavelength : float
        Wavelength of the light, m.
    path : {"spherical", "plane"}
        Plane where the scene lies far beyond the turbulence; the distance is then the length of the turbulent path.
    train : int
        Frames to use, from the first on.  By default all, up to what 1.5 GB hold.
    json : bool
        Print JSON.
    quiet : bool
        Print neither progress nor remarks on the input.
    centroid : CentroidParams
        Centroid iteration.
    flow : FlowParams
        Optical flow.
    """
    optics = known_optics(pixel_scale, aperture, wavelength, distance, path)
    source = open_input(input, selection, quiet)
    runtime = machine.runtime()
    most = min(len(source), frames_in_memory(source.shape[1:]))
    count = training_share(len(source), source.shape[1:], most if train is None else train)
    prepared = prepare(source, scratch=runtime.scratch)
    frames = prepared.source.read(0, count)
    with progress_bars(quiet) as progress:
        steps = centroid_steps(frames, centroid, flow, runtime)
        found = finish(steps, step_counter(progress, "centroid", count * centroid.iterations))
    measured = seeing_of_picture(prepared.picture, frames, found, optics, runtime.threads)
    if json:
        print_json({"input": str(input), "frames": count, **asdict(measured)})
    else:
        put("\n".join([f"{'frames used':<26}{count} of {len(source)}", *_lines(measured), *_missing(optics)]))


def _missing(optics: Optics | None) -> list[str]:
    """Name the options that the strength of the turbulence needs and has not got."""
    if optics is None:
        return [f"{'D/r0, r0':<26}need --pixel-scale and --aperture", f"{'Cn²':<26}needs --distance as well"]
    return [f"{'Cn²':<26}needs --distance"] if optics.distance is None else []


def _lines(seeing: Seeing) -> list[str]:
    lines = [
        f"{name.replace('_', ' '):<26}{interval_words(estimate, '.3g')} {unit}".rstrip()
        for name, (estimate, unit) in seeing.estimates().items()
        if estimate is not None
    ]
    if seeing.displacement_variance is not None:
        lines.append(f"{'wind direction':<26}{seeing.wind_direction:.0f}° from right downwards")
        lines.append(f"{'independent frames':<26}{seeing.independent_frames:.1f}")
    return [*lines, *(f"remark: {remark}" for remark in seeing.remarks)]
