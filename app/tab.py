"""What one tab of the browser has open; tabs know nothing of each other."""

from __future__ import annotations

import dataclasses
import secrets
import tempfile
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

from turbrestore.core.errors import DataError
from turbrestore.io.video import VIDEO_SUFFIXES

from .clip import Clip, open_clip
from .folders import Folders
from .job import Job, Kind
from .pictures import Pictures
from .restoring import Order, Restored, preview_order, restore_order
from .several import Row, Task, restore_all
from .steadying import Steadied, SteadyOrder, steady_order, watch_camera

if TYPE_CHECKING:
    from turbrestore.deconvolution.deconvolve import DeconvolutionParams
    from turbrestore.settings import RestoreParams

Result = TypeVar("Result")

# Seconds to wait for the end of a run whose tab is gone.
_PATIENCE = 2.0


class Tab:
    """The clip, the run and the files of one tab.

    Parameters
    ----------
    folders : Folders
        What may be read and written.

    Attributes
    ----------
    clip : Clip or None
        What is open.
    job : Job or None
        The newest run or preview.
    restored : Restored or None
        Result of the newest run that has ended.
    tuned : DeconvolutionParams or None
        What the user has chosen of the deconvolution; None leaves it to be measured.
    border : {"keep", "crop"}
        What the user has chosen of the border.
    ordered : Order or None
        What was ordered last of the clip, as the form says it.
    ordered_video : SteadyOrder or None
        The steadied video of the clip that was ordered last.
    steadied : Steadied or None
        The newest steadied video of the clip.
    films : dict of str to Path
        Files of the films that the page may ask for, by their names.
    rows : list of Row
        What becomes of several clips.
    closed : bool
    """

    def __init__(self, folders: Folders) -> None:
        self.folders = folders
        self.key = secrets.token_urlsafe(12)
        self.pictures = Pictures(f"pictures/{self.key}")
        self.clip: Clip | None = None
        self.job: Job[object] | None = None
        self.restored: Restored | None = None
        self.ordered: Order | None = None
        self.ordered_video: SteadyOrder | None = None
        self.tuned: DeconvolutionParams | None = None
        self.border: Literal["keep", "crop"] = "keep"
        self.steadied: Steadied | None = None
        self.films: dict[str, Path] = {}
        self.rows: list[Row] = []
        self.closed = False
        self._opening = 0
        self._film_numbers = count(1)
        self._own: tempfile.TemporaryDirectory[str] | None = None

    @property
    def busy(self) -> bool:
        """Whether a run is at work, or a clip is being read: a run that began now would be stopped."""
        return self._opening > 0 or (self.job is not None and self.job.state == "running")

    def open(self, path: Path) -> Clip:
        """Look through a clip and make it that of the tab; what was run before is forgotten.

        Raises
        ------
        TurbrestoreError
            It cannot be used.
        """
        uploaded = self._own is not None and path.is_relative_to(self._own.name)
        self._opening += 1
        try:
            clip = open_clip(path, Path(path.name) if uploaded else self.folders.shown(path))
            self.stop()
            self.clip, self.job, self.restored, self.ordered = clip, None, None, None
            self.tuned, self.border, self.steadied, self.ordered_video = None, "keep", None, None
        finally:
            self._opening -= 1
        return clip

    def place_for(self, name: str) -> Path:
        """Return where an upload may lie until the tab is closed; raise DataError where it is no clip by its name."""
        clean = "".join(sign for sign in Path(name.replace("\\", "/")).name if sign.isprintable())[-100:].lstrip(".-")
        if Path(clean).suffix.lower() not in VIDEO_SUFFIXES:
            raise DataError(f"{clean or 'upload'}: expected one of {', '.join(VIDEO_SUFFIXES)}")
        return self._folder() / clean

    def chosen(self, params: RestoreParams) -> RestoreParams:
        """Put into the settings of a run what was tuned."""
        deconvolution = params.deconvolution if self.tuned is None else self.tuned
        return dataclasses.replace(params, deconvolution=deconvolution, border=self.border)

    @property
    def tuned_order(self) -> Order | None:
        """The order of the result with what was tuned since; None where there is no result."""
        if self.restored is None:
            return None
        order = self.restored.order
        return dataclasses.replace(order, params=self.chosen(order.params))

    @property
    def pending(self) -> bool:
        """Whether something was tuned that the result does not have yet."""
        return self.restored is not None and self.tuned_order != self.restored.order

    def apply(self) -> None:
        """Deconvolve the whole image by what was tuned."""
        order = self.tuned_order
        if order is not None and not self.busy:
            self.run(order)

    def run(self, order: Order) -> Job[Restored]:
        """Restore in a thread; the result becomes that of the tab when it is done."""
        earlier, self.ordered = self.restored, order

        def work(job: Job[Restored]) -> Restored:
            restored = restore_order(order, job, earlier)
            job.check()
            self.restored = restored
            return restored

        return self._start("restore", work)

    def preview(self, order: Order) -> Job[Restored]:
        """Restore a small part in a thread."""
        assert self.clip is not None
        self.ordered = order
        part = preview_order(order, self.clip.source.shape)
        return self._start("restore", lambda job: restore_order(part, job))

    def steady(self, order: SteadyOrder) -> Job[Steadied]:
        """Steady the clip in a thread; the video becomes that of the tab when it is done."""
        film, self.ordered_video = self._next_film(), order
        # Its frames and its region are those of the form for restorations.
        self.ordered = dataclasses.replace(self.ordered or Order(order.path), selection=order.selection)

        def work(job: Job[Steadied]) -> Steadied:
            steadied = steady_order(order, job, film)
            job.check()
            self.steadied = steadied
            return steadied

        return self._start("steady", work)

    def watch(self, camera: str) -> Job[None]:
        """Steady what a camera films, in a thread, until it is stopped."""
        return self._start("live", lambda job: watch_camera(camera, job))

    def restore_all(self, tasks: Sequence[Task]) -> Job[None]:
        """Restore several clips in a thread, one after the other."""
        self.rows = [Row(str(task.name)) for task in tasks]
        return self._start("several", lambda job: restore_all(tasks, self.rows, job))

    def stop(self) -> None:
        """End the run, if there is one."""
        if self.job is not None:
            self.job.stop()

    def close(self) -> None:
        """End the run and remove what was uploaded, and the films."""
        self.closed = True
        self.stop()
        if self.job is not None:
            self.job.join(_PATIENCE)
        self.pictures.clear()
        if self._own is not None:
            self._own.cleanup()

    def _folder(self) -> Path:
        """Return the folder of files that go with the tab."""
        if self._own is None:
            self._own = tempfile.TemporaryDirectory(prefix="turbrestore-")
        return Path(self._own.name)

    def _next_film(self) -> Path:
        """Return where the next film goes; the one that is shown stays, and older ones are removed."""
        shown = None if self.steadied is None else self.steadied.film_path
        for name, path in tuple(self.films.items()):
            if path != shown:
                del self.films[name]
                path.unlink(missing_ok=True)
        path = self._folder() / f".film{next(self._film_numbers)}.mp4"
        self.films[path.name] = path
        return path

    def _start(self, kind: Kind, work: Callable[[Job[Result]], Result]) -> Job[Result]:
        self.stop()
        job = Job(work, kind)
        self.job = job
        return job
