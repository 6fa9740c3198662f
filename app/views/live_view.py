"""A camera of this machine, steadied while it films: its newest frame beside the steadied one."""

from __future__ import annotations

import re
from collections.abc import Callable

from nicegui import ui

from turbrestore.core.errors import require

from ..tab import Tab
from .elements import Notices, in_thread
from .progress_view import ProgressView

# What Linux calls cameras.
_CAMERA = re.compile(r"/dev/video\d{1,3}")


class LiveView:
    """The name of the camera, a button, and the pictures.

    Parameters
    ----------
    tab : Tab
    notices : Notices
    on_start : callable
        Called when a camera has been started.
    """

    def __init__(self, tab: Tab, notices: Notices, on_start: Callable[[], None]) -> None:
        self._tab, self._notices, self._on_start = tab, notices, on_start
        self._progress = ProgressView(tab, "live")
        self.follow = self._progress.follow
        self._shown = 0

    def build(self) -> None:
        """Make the elements beside the pictures."""
        with ui.element("section"), ui.element("details").classes("more"):
            ui.html("Live camera", tag="summary", sanitize=False)
            with ui.element("div").classes("fields"):
                self._name = ui.input("Camera", value="/dev/video0").props("dense outlined").classes("grow")
            with ui.element("div").classes("fields"):
                button = ui.button("Watch", on_click=self._start).props("unelevated").classes("grow")
                self._progress.build((button,))
            self._progress.build_bars()

    def build_pictures(self) -> None:
        """Make the pictures."""
        with ui.element("div").classes("place") as self.place, ui.element("div").classes("fields"):
            self._pictures = {}
            for words in ("camera", "steadied"):
                with ui.element("figure").classes("grow"):
                    self._pictures[words] = ui.html("", sanitize=False)
                    ui.html(words, tag="figcaption", sanitize=False).classes("note")

    async def refresh(self) -> None:
        """Show the newest frames, if there are newer ones."""
        job = self._tab.job
        if job is None or job.kind != "live" or "steadied" not in job.images:
            return
        newest = id(job.images["steadied"])
        if newest == self._shown:
            return
        self._shown = newest
        for words, picture in self._pictures.items():
            address = await in_thread(self._tab.pictures.put, job.images[words], (0.0, 1.0), "live")
            picture.content = f'<img src="{address}" alt="{words}" style="width: 100%">'

    def _start(self) -> None:
        with self._notices.catching():
            name = (self._name.value or "").strip()
            require(_CAMERA.fullmatch(name) is not None, f"camera: expected a name such as /dev/video0, found {name!r}")
            self._tab.watch(name)
            self._on_start()
