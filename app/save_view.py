"""Step four: save the image, its settings and a report, and copy the command that repeats the run."""

from __future__ import annotations

import asyncio
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from nicegui import ui

from .folders import printable
from .restoring import Order
from .saving import Outputs, check_outputs, command_line, save

if TYPE_CHECKING:
    from .page import Page

_DEPTHS: dict[int | None, str] = {None: "as the clip", 8: "8 bits", 16: "16 bits", 32: "float, TIFF and FITS"}
# Seconds between two looks at a run that is waited for.
_BEAT = 0.05


class SaveView:
    """Where to save and what, and the command.

    Parameters
    ----------
    page : Page
    """

    def __init__(self, page: Page) -> None:
        self._page = page

    def build(self) -> None:
        """Make the elements."""
        with ui.element("section") as self.place:
            ui.html('<span class="number">4</span> Save', tag="h2", sanitize=False)
            with ui.element("div").classes("fields"):
                self._path = ui.input("Image, .png, .tif or .fits", on_change=self.refresh).props("dense outlined")
                self._path.classes("grow")
            with ui.element("div").classes("fields"):
                self._depth = ui.select(_DEPTHS, label="Depth", value=None, on_change=self.refresh)
                self._depth.props("dense outlined options-dense").classes("grow")
            with ui.element("div").classes("fields"):
                self._report = ui.checkbox("Write a report").props("dense")
                self._overwrite = ui.checkbox("Replace existing files").props("dense")
            with ui.element("div").classes("fields"):
                ui.button("Save", on_click=self._save).props("unelevated").classes("grow")
                ui.button("Copy command", on_click=self._copy).props("outline no-wrap")
            self._note = ui.label("").classes("note").props("role=status")
            self._command = ui.html("", tag="pre", sanitize=False).classes("command").props('aria-label="Command"')

    def opened(self) -> None:
        """Suggest a name for the image of a new clip."""
        clip = self._page.tab.clip
        assert clip is not None
        self._path.value = printable(f"{clip.name.stem}.restored.png")
        self._note.text = ""

    def refresh(self) -> None:
        """Show the command of the result, with what has been tuned since."""
        import html

        order = self._order()
        if order is not None:
            self._command.content = html.escape(self._words(order))

    def _order(self) -> Order | None:
        """Return what would give the image that is to be saved."""
        restored = self._page.tab.restored
        if restored is None:
            return None
        params = self._page.tune_view.chosen(restored.order.params)
        return dataclasses.replace(restored.order, params=params)

    def _words(self, order: Order) -> str:
        clip = self._page.tab.clip
        assert clip is not None
        return printable(command_line(order, self._depth.value, clip.name, Path(self._path.value or "image.png")))

    async def _copy(self) -> None:
        order = self._order()
        if order is not None:
            ui.clipboard.write(self._words(order))
            self._note.text = "The command is copied; run it in the folder where the app was started."

    async def _save(self) -> None:
        """Save what is seen: what was tuned is applied to the whole first."""
        tab = self._page.tab
        with self._page.catching():
            clip, image = tab.clip, tab.folders.output(self._path.value or "")
            outputs = Outputs(image, self._depth.value, bool(self._report.value), bool(self._overwrite.value))
            if tab.restored is None or clip is None:
                return
            await asyncio.to_thread(check_outputs, outputs, tab.restored.order)
            if self._page.tune_view.pending:
                self._note.text = "applying what was tuned to the whole …"
                self._page.tune_view.apply()
            while tab.busy:
                await asyncio.sleep(_BEAT)
            if self._page.tune_view.pending:
                self._note.text = "nothing was saved"
                return
            written = await asyncio.to_thread(save, tab.restored, outputs, clip.name, Path(self._path.value or ""))
            self._note.text = f"Saved: {', '.join(str(tab.folders.shown(path.resolve())) for path in written)}"
