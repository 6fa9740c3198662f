"""What one tab of the browser has open; tabs know nothing of each other."""

from __future__ import annotations

import secrets
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from turbrestore.core.errors import DataError
from turbrestore.io.video import VIDEO_SUFFIXES

from .clip import Clip, open_clip
from .folders import Folders
from .job import Job
from .pictures import Pictures
from .restoring import Order, Restored, preview_order, restore_order
from .several import Row, Task, restore_all
from .steadying import SteadyOrder, steady_order

if TYPE_CHECKING:
    from turbrestore.deconvolution.deconvolve import DeconvolutionParams

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
    video : Path or None
        The newest steadied video of the clip.
    rows : list of Row
        What becomes of several clips.
    closed : bool
    """

    def __init__(self, folders: Folders) -> None:
        self.folders = folders
        self.key = secrets.token_urlsafe(12)
        self.pictures = Pictures(f"pictures/{self.key}")
        self.clip: Clip | None = None
        self.job: Job | None = None
        self.restored: Restored | None = None
        self.tuned: DeconvolutionParams | None = None
        self.border: Literal["keep", "crop"] = "keep"
        self.video: Path | None = None
        self.rows: list[Row] = []
        self.closed = False
        self._uploads: tempfile.TemporaryDirectory[str] | None = None

    @property
    def busy(self) -> bool:
        """Whether a run is at work."""
        return self.job is not None and self.job.state == "running"

    def open(self, path: Path) -> Clip:
        """Look through a clip and make it that of the tab; what was run before is forgotten.

        Raises
        ------
        TurbrestoreError
            It cannot be used.
        """
        uploaded = self._uploads is not None and path.is_relative_to(self._uploads.name)
        clip = open_clip(path, Path(path.name) if uploaded else self.folders.shown(path))
        self.stop()
        self.clip, self.job, self.restored = clip, None, None
        self.tuned, self.border, self.video = None, "keep", None
        return clip

    def place_for(self, name: str) -> Path:
        """Return where an upload may lie until the tab is closed; raise DataError where it is no clip by its name."""
        clean = "".join(sign for sign in Path(name.replace("\\", "/")).name if sign.isprintable())[-100:].lstrip(".-")
        if Path(clean).suffix.lower() not in VIDEO_SUFFIXES:
            raise DataError(f"{clean or 'upload'}: expected one of {', '.join(VIDEO_SUFFIXES)}")
        if self._uploads is None:
            self._uploads = tempfile.TemporaryDirectory(prefix="turbrestore-")
        return Path(self._uploads.name) / clean

    def run(self, order: Order) -> Job:
        """Restore in a thread; the result becomes that of the tab when it is done."""
        earlier = self.restored

        def work(job: Job) -> Restored:
            restored = restore_order(order, job, earlier)
            job.check()
            self.restored = restored
            return restored

        return self._start(work)

    def preview(self, order: Order) -> Job:
        """Restore a small part in a thread."""
        assert self.clip is not None
        part = preview_order(order, self.clip.source.shape)
        return self._start(lambda job: restore_order(part, job))

    def steady(self, order: SteadyOrder) -> Job:
        """Steady the clip in a thread; the video becomes that of the tab when it is done."""

        def work(job: Job) -> Path:
            video = steady_order(order, job)
            job.check()
            self.video = video
            return video

        return self._start(work)

    def restore_all(self, tasks: Sequence[Task]) -> Job:
        """Restore several clips in a thread, one after the other."""
        self.rows = [Row(str(task.name)) for task in tasks]
        return self._start(lambda job: restore_all(tasks, self.rows, job))

    def stop(self) -> None:
        """End the run, if there is one."""
        if self.job is not None:
            self.job.stop()

    def close(self) -> None:
        """End the run and remove what was uploaded."""
        self.closed = True
        self.stop()
        if self.job is not None:
            self.job.join(_PATIENCE)
        self.pictures.clear()
        if self._uploads is not None:
            self._uploads.cleanup()

    def _start(self, work: Callable[[Job], Restored | Path | None]) -> Job:
        self.stop()
        self.job = Job(work)
        return self.job
