"""Several clips of a folder, by the settings of the steps above, one after the other."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING

from nicegui import ui

from turbrestore.core.errors import TurbrestoreError

from .folders import Entry, printable
from .several import plan_several

if TYPE_CHECKING:
    from .page import Page


class SeveralView:
    """The clips beside the one that is open, where their results go, and what becomes of each.

    Parameters
    ----------
    page : Page
    """

    def __init__(self, page: Page) -> None:
        self._page = page
        self._boxes: list[tuple[Entry, ui.checkbox]] = []
        self._drawn = ""

    def build(self) -> None:
        """Make the elements."""
        with ui.element("section") as self.place:
            ui.html("Several clips", tag="h2", sanitize=False)
            self._list = ui.element("div").classes("files choice")
            self._list.props('role=group aria-label="Clips to restore"')
            with ui.element("div").classes("fields"):
                self._folder = ui.input("Folder for the results", value="restored").props("dense outlined")
                self._folder.classes("grow")
            with ui.element("div").classes("fields"):
                ui.button("Choose all", on_click=self._choose_all).props("outline no-wrap")
                button = ui.button("Restore them", on_click=self._start).props("unelevated").classes("grow")
            self._page.starters.append(button)
            self._overwrite = ui.checkbox("Replace existing files").props("dense").classes("q-mt-sm")
            ui.label("Whole clips, by the preset, share of frames and blur that are chosen above.").classes("note")
            self._rows = ui.html("", sanitize=False).props("role=status")

    def opened(self) -> None:
        """List the clips in the folder of the one that is open."""
        tab = self._page.tab
        assert tab.clip is not None
        try:
            entries = tab.folders.listing(tab.clip.path.parent)
        except TurbrestoreError:
            # What was uploaded, or named when the app was started, lies elsewhere.
            entries = tab.folders.listing(tab.folders.start)
        self._list.clear()
        with self._list:
            clips = [entry for entry in entries if not entry.is_folder]
            self._boxes = [(entry, ui.checkbox(printable(entry.name)).props("dense")) for entry in clips]
            if not clips:
                ui.label("no clips here").classes("note q-pa-sm")

    def follow(self) -> None:
        """Show what becomes of the clips."""
        rows = "".join(
            f'<tr class="{row.state.replace(" ", "-")}"><th scope="row">{html.escape(printable(row.name))}</th>'
            f"<td>{row.state}{html.escape(printable(f': {row.words}' if row.words else ''))}</td></tr>"
            for row in tuple(self._page.tab.rows)
        )
        if rows != self._drawn:
            self._drawn = rows
            self._rows.content = f'<table class="rows">{rows}</table>'

    def _choose_all(self) -> None:
        """Choose all clips, or none where all are chosen."""
        wanted = not all(box.value for _, box in self._boxes)
        for _, box in self._boxes:
            box.value = wanted

    def _start(self) -> None:
        page = self._page
        with page.catching():
            clips = [entry.path for entry, box in self._boxes if box.value]
            overwrite = bool(self._overwrite.value)
            like = page.run_view.order()
            page.tab.restore_all(plan_several(clips, self._folder.value or "", like, overwrite, page.tab.folders))
