"""Several clips of a folder, by the settings of the steps above, one after the other."""

from __future__ import annotations

import html
from collections.abc import Callable

from nicegui import ui

from turbrestore.core.errors import TurbrestoreError

from ..folders import Entry, printable
from ..job import Job
from ..restoring import Order
from ..several import inputs_of, plan_several
from ..tab import Tab
from .elements import Notices, labelled
from .progress_view import ProgressView


class SeveralView:
    """The clips beside the one that is open, where their results go, and what becomes of each.

    Parameters
    ----------
    tab : Tab
    notices : Notices
    like : callable
        Returns the order whose settings all clips are restored by.
    """

    def __init__(self, tab: Tab, notices: Notices, like: Callable[[], Order]) -> None:
        self._tab, self._notices, self._like = tab, notices, like
        self._progress = ProgressView(tab, "several")
        self._boxes: list[tuple[Entry, ui.checkbox]] = []
        self._drawn = ""

    def build(self) -> None:
        """Make the elements."""
        with ui.element("section") as self.place:
            ui.html("Several clips", tag="h2", sanitize=False)
            ui.label("Whole clips, restored with the preset, the stacking and the blur chosen above.").classes("note")
            self._list = ui.element("div").classes("files choice")
            self._list.props('role=group aria-label="Clips to restore"')
            with ui.element("div").classes("fields"):
                self._folder = ui.input("Folder for the results", value="restored").props("dense outlined")
                self._folder.classes("grow")
            self._overwrite = ui.checkbox("Replace existing files").props("dense").classes("q-mt-sm")
            with ui.element("div").classes("fields"):
                ui.button("Choose all", on_click=self._choose_all).props("outline no-wrap")
                button = ui.button("Restore them", on_click=self._start).props("unelevated").classes("grow")
                self._progress.build((button,))
            self._rows = ui.html("", sanitize=False).props("role=status")
            self._progress.build_bars()

    def opened(self) -> None:
        """List the clips in the folder of the one that is open."""
        tab = self._tab
        assert tab.clip is not None
        try:
            entries = tab.folders.listing(tab.clip.path.parent)
        except TurbrestoreError:
            # What was uploaded, or named when the app was started, lies elsewhere.
            entries = tab.folders.listing(tab.folders.start)
        clips = inputs_of(entries)
        self._list.clear()
        with self._list:
            self._boxes = [(entry, ui.checkbox(printable(entry.name)).props("dense")) for entry in clips]
            if not clips:
                ui.label("There are no clips in this folder.").classes("note q-pa-sm")

    def follow(self) -> Job[object] | None:
        """Show what becomes of the clips; return the run when it has just ended."""
        rows = "".join(
            f'<tr class="{row.state}"><th scope="row">{html.escape(printable(row.name))}</th>'
            f"<td>{row.state}{html.escape(printable(f': {labelled(row.words)}' if row.words else ''))}</td></tr>"
            for row in tuple(self._tab.rows)
        )
        if rows != self._drawn:
            self._drawn = rows
            self._rows.content = f'<table class="rows">{rows}</table>'
        return self._progress.follow()

    def look(self) -> None:
        """Bring the rows into sight, which are far below the picture on a phone."""
        ui.run_javascript("document.querySelector('table.rows')?.scrollIntoView({ block: 'nearest' })")

    def _choose_all(self) -> None:
        """Choose all clips, or none where all are chosen."""
        wanted = not all(box.value for _, box in self._boxes)
        for _, box in self._boxes:
            box.value = wanted

    def _start(self) -> None:
        with self._notices.catching():
            clips = [entry.path for entry, box in self._boxes if box.value]
            overwrite, folders = bool(self._overwrite.value), self._tab.folders
            self._tab.restore_all(plan_several(clips, self._folder.value or "", self._like(), overwrite, folders))
