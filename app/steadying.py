"""A steadied video as the page orders it: what ``turbrestore steady`` writes, while the page watches."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from turbrestore.core.arrays import FloatArray
from turbrestore.footage.content import clean_source, keep_all
from turbrestore.io.output import check_output
from turbrestore.io.video import write_video
from turbrestore.steady.settings import SteadyParams
from turbrestore_cli.inputs import open_checked
from turbrestore_cli.options import Machine, Selection
from turbrestore_cli.output import write_settings
from turbrestore_cli.steady import USUAL_RATE, Output, settings_record

if TYPE_CHECKING:
    from turbrestore.io.source import FrameSource

    from .job import Job


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
    overwrite : bool
        Replace existing files.
    """

    path: Path
    output: Path
    selection: Selection = field(default_factory=Selection)
    params: SteadyParams = field(default_factory=SteadyParams)
    overwrite: bool = False

    @property
    def settings(self) -> Path:
        """The settings file beside the video."""
        return self.output.with_name(self.output.name + ".toml")

    def check(self) -> None:
        """Raise an error if something could not be written."""
        check_output(self.output, [self.path], self.overwrite, (".mp4",))
        check_output(self.settings, [self.path], self.overwrite, suffixes=None)

    def command_line(self, input: Path, output: Path) -> str:
        """Return the command that repeats the order, with the paths as it is to name them."""
        chosen = {"camera": self.params.camera, "frames": self.selection.frames, "roi": self.selection.roi}
        flags = [f"--{name}={value}" for name, value in chosen.items() if value not in (None, SteadyParams().camera)]
        return shlex.join(["turbrestore", "steady", str(input), str(output), *flags])


def steady_order(order: SteadyOrder, job: Job) -> Path:
    """Steady a video as ``turbrestore steady`` does, and write it with its settings.

    Parameters
    ----------
    order : SteadyOrder
    job : Job
        Hears of every frame.

    Returns
    -------
    Path
        The video.

    Raises
    ------
    TurbrestoreError
        The clip cannot be read, or an output exists already or cannot be written.
    """
    order.check()
    source, report = open_checked(order.path, order.selection)
    source = clean_source(source, keep_all(report))
    machine, written = Machine(), Output()
    images = _images(source, order.params, machine, job)
    write_video(order.output, images, source.fps or USUAL_RATE, source.bit_depth, order.overwrite, companion=source)
    write_settings(order.settings, settings_record(machine, order.selection, order.params, written))
    return order.output


def _images(source: FrameSource, params: SteadyParams, machine: Machine, job: Job) -> Iterator[FloatArray]:
    from turbrestore.steady.video import steady_frames

    for number, frame in enumerate(steady_frames(source, params, machine.runtime()), 1):
        job.progress("steady", number, len(source))
        yield frame.image
