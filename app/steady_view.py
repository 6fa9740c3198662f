"""Beside the image: the clip as a steadied video, written into a file and played on the page."""

from __future__ import annotations

import html
from pathlib import Path
from typing import TYPE_CHECKING

from nicegui import ui

from turbrestore.steady.settings import SteadyParams

from .folders import printable
from .steadying import SteadyOrder

if TYPE_CHECKING:
    from .page import Page

_CAMERAS = {"keep": "keep its motion", "steady": "smooth its motion", "lock": "lock it"}


class SteadyView:
    """What becomes of the camera, the name of the video, and the player.

    Parameters
    ----------
    page : Page
    """

    def __init__(self, page: Page) -> None:
        self._page = page

    def build(self) -> None:
        """Make the elements."""
        with ui.element("section") as self.place:
            ui.html("Steadied video", tag="h2", sanitize=False)
            with ui.element("div").classes("fields"):
                self._camera = ui.select(_CAMERAS, label="Camera", value="keep").classes("grow")
                self._camera.props("dense outlined options-dense")
            with ui.element("div").classes("fields"):
                self._path = ui.input("Video, .mp4").props("dense outlined").classes("grow")
            with ui.element("div").classes("fields"):
                self._overwrite = ui.checkbox("Replace existing files").props("dense").classes("grow")
                button = ui.button("Steady", on_click=self._start).props("unelevated")
            self._page.starters.append(button)
            self._note = ui.label("").classes("note").props("role=status")
            self._command = ui.html("", tag="pre", sanitize=False).classes("command")
            self._command.props('aria-label="Command of the video"').visible = False

    def build_player(self) -> None:
        """Make the place of the video among what is shown."""
        self.player = ui.html("", sanitize=False)

    def opened(self) -> None:
        """Suggest a name for the video of a new clip."""
        clip = self._page.tab.clip
        assert clip is not None
        self._path.value = printable(f"{clip.name.stem}.steady.mp4")
        self._note.text, self.player.content = "", ""
        self._command.visible = False

    def fill(self) -> None:
        """Put the video of the tab into the player of the browser."""
        tab = self._page.tab
        if tab.video is None:
            return
        name = html.escape(printable(tab.folders.shown(tab.video.resolve())))
        # The address of another video is another one, so that the browser does not show the one before.
        address = f"videos/{tab.key}/{tab.video.stat().st_mtime_ns}.mp4"
        self.player.content = (
            f'<video class="video" controls loop src="{address}" aria-label="Steadied video"></video>'
            f'<p class="note">{name}</p>'
        )

    def _start(self) -> None:
        page = self._page
        with page.catching():
            clip, name = page.tab.clip, self._path.value or ""
            assert clip is not None
            order = SteadyOrder(
                clip.path,
                page.tab.folders.output(name),
                page.run_view.order().selection,
                SteadyParams(camera=self._camera.value),
                bool(self._overwrite.value),
            )
            order.check()
            page.tab.steady(order)
            self._note.text = "This command makes the same video:"
            self._command.content = html.escape(printable(order.command_line(clip.name, Path(name))))
            self._command.visible = True
