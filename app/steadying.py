"""A steadied video as the page orders it: what ``turbrestore steady`` writes, and a film of it beside its input."""

from __future__ import annotations

import shlex
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from turbrestore.core.arrays import FloatArray
from turbrestore.footage.checks.content import clean_source, keep_all
from turbrestore.io.output import check_output
from turbrestore.io.video import open_frames, write_video
from turbrestore.report import SteadyFigures
from turbrestore.report.film import Film, film_length, write_film
from turbrestore.steady.settings import SteadyParams
from turbrestore_cli.inputs import files_read, open_checked
from turbrestore_cli.options import Machine, Selection
from turbrestore_cli.output import changed_flags, write_settings
from turbrestore_cli.steady import USUAL_RATE, Output, settings_record

if TYPE_CHECKING:
    from turbrestore.io.source import FrameSource

    from .job import Job

# Quality of the film as a rate factor of H.264.
_RATE_FACTOR = 17


@dataclass(frozen=True)
class SteadyOrder:
    """What to steady, how, and where the video goes.

    Parameters
    ----------
    path : Path
    output : Path
        .mp4, which a browser plays.
    selection : Selection
        Range of frames and region.
    params : SteadyParams
    written : Output
        Codec and quality.
    overwrite : bool
        Replace existing files.
    """

    path: Path
    output: Path
    selection: Selection = field(default_factory=Selection)
    params: SteadyParams = field(default_factory=SteadyParams)
    written: Output = field(default_factory=Output)
    overwrite: bool = False

    @property
    def settings(self) -> Path:
        """The settings file beside the video."""
        return self.output.with_name(self.output.name + ".toml")

    def check(self) -> None:
        """Raise an error if something could not be written."""
        inputs = files_read(self.selection, self.path)
        check_output(self.output, inputs, self.overwrite, (".mp4",))
        check_output(self.settings, inputs, self.overwrite, suffixes=None)

    def command_line(self, input: Path, output: Path) -> str:
        """Return the command that repeats the order, with the paths as it is to name them."""
        usual = settings_record(Machine(), Selection(), SteadyParams(), Output())
        flags = changed_flags(settings_record(Machine(), self.selection, self.params, self.written), usual)
        return shlex.join(["turbrestore", "steady", *map(str, (input, output)), *flags])


@dataclass(frozen=True)
class Steadied:
    """A video that was written, and the film of it and its input that the page plays."""

    video: Path
    film: Film
    film_path: Path


def steady_order(order: SteadyOrder, job: Job[object], film_path: Path) -> Steadied:
    """Steady a video as ``turbrestore steady`` does, and write it with its settings.

    Parameters
    ----------
    order : SteadyOrder
    job : Job
        Hears of every frame.
    film_path : Path
        Where the film goes, .mp4.

    Returns
    -------
    Steadied

    Raises
    ------
    TurbrestoreError
        The clip cannot be read, or an output exists already or cannot be written.
    """
    order.check()
    source, report = open_checked(order.path, order.selection)
    source = clean_source(source, keep_all(report))
    machine, fps, figures = Machine(), source.fps or USUAL_RATE, SteadyFigures(remarks=source.warnings)
    images = _images(source, order.params, machine, job, figures)
    encoding = order.written.encoding()
    write_video(order.output, images, fps, source.bit_depth, order.overwrite, encoding, companion=source)
    write_settings(order.settings, settings_record(machine, order.selection, order.params, order.written))
    count = film_length(len(source), *source.shape[1:3])
    film = write_film(film_path, _pairs(source, order.output, count, job), count, fps, _RATE_FACTOR)
    job.message = f"Verdict: {figures.verdict}."
    return Steadied(order.output, film, film_path)


def watch_camera(name: str, job: Job[None]) -> None:
    """Steady what a camera films, and show every frame beside the steadied one, until the job is stopped."""
    from turbrestore.io.containers.stream import open_camera
    from turbrestore.steady.video import steady_frames

    camera, waiting = open_camera(name), deque[FloatArray]()

    def filmed() -> Iterator[FloatArray]:
        for frame in camera.frames:
            waiting.append(frame)
            yield frame

    for steadied in steady_frames(filmed(), SteadyParams(live=True), Machine().runtime()):
        job.show("camera", waiting.popleft())
        job.show("steadied", steadied.image)


def _images(
    source: FrameSource, params: SteadyParams, machine: Machine, job: Job[object], figures: SteadyFigures
) -> Iterator[FloatArray]:
    from turbrestore.steady.video import steady_frames

    for number, frame in enumerate(steady_frames(source, params, machine.runtime()), 1):
        job.progress("steady", number, len(source))
        figures.note(frame)
        yield frame.image


def _pairs(source: FrameSource, output: Path, count: int, job: Job[object]) -> Iterator[tuple[FloatArray, FloatArray]]:
    for number, pair in zip(range(1, count + 1), zip(source, open_frames(output), strict=True), strict=False):
        job.progress("film", number, count)
        yield pair
