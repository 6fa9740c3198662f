"""The steadied video beside its input: one film of both, split by a divider, as in the report."""

from __future__ import annotations

import json

from nicegui import ui

from turbrestore.report.comparison import film_comparison

from ..folders import printable
from ..tab import Tab


class VideoView:
    """The player.

    Parameters
    ----------
    tab : Tab
    """

    def __init__(self, tab: Tab) -> None:
        self._tab = tab

    def build(self) -> None:
        """Make the elements."""
        with ui.element("div").classes("place") as self.place:
            ui.html('<div id="video" class="player"></div>', sanitize=False).classes("holder")
            self._note = ui.label("").classes("note")

    def fill(self) -> None:
        """Show the newest video of the tab, or none."""
        found = self._tab.steadied
        if found is None:
            ui.run_javascript('turbrestore.fill("video", "")')
            return
        address = f"videos/{self._tab.key}/{found.film_path.name}"
        ui.run_javascript(f'turbrestore.fill("video", {json.dumps(film_comparison(found.film, address))})')
        name = printable(self._tab.folders.shown(found.video.resolve()))
        self._note.text = f"{name}, {found.film.count} frames beside the input"
