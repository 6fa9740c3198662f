"""Step four: save the image, its settings and a report, and copy the command that repeats the run."""

from __future__ import annotations

import asyncio
from pathlib import Path

from nicegui import ui

from ..folders import printable
from ..saving import Outputs, check_outputs, command_line, save
from ..tab import Tab
from .elements import Command, Notices

_DEPTHS: dict[int | None, str] = {None: "as the clip", 8: "8 bits", 16: "16 bits", 32: "float, TIFF and FITS"}
# Seconds between two looks at a run that is waited for.
_BEAT = 0.05


class SaveView:
    """Where to save and what, and the command.

    Parameters
    ----------
    tab : Tab
    notices : Notices
    """

    def __init__(self, tab: Tab, notices: Notices) -> None:
        self._tab, self._notices = tab, notices
        self._command = Command()

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
            self._note = ui.label("").classes("note").props("role=status")
            # Beside an error, what was saved before would look like what comes of it.
            self._note.bind_visibility_from(self._notices.error, "visible", backward=lambda shown: not shown)
            self._command.build("Command")

    def opened(self) -> None:
        """Suggest a name for the image of a new clip."""
        clip = self._tab.clip
        assert clip is not None
        self._path.value = printable(f"{clip.name.stem}.restored.png")
        self._note.text = ""

    def refresh(self) -> None:
        """Show the command of the result, with what has been tuned since."""
        order, clip = self._tab.tuned_order, self._tab.clip
        if order is not None and clip is not None:
            image = Path(self._path.value or "image.png")
            self._command.show(command_line(order, self._depth.value, clip.name, image))

    async def _save(self) -> None:
        """Save what is seen: what was tuned is applied to the whole first."""
        tab = self._tab
        # An earlier note says nothing of what goes wrong now.
        self._note.text = ""
        with self._notices.catching():
            clip, image = tab.clip, tab.folders.output(self._path.value or "")
            outputs = Outputs(image, self._depth.value, bool(self._report.value), bool(self._overwrite.value))
            if tab.restored is None or clip is None:
                return
            await asyncio.to_thread(check_outputs, outputs, tab.restored.order)
            if tab.pending:
                self._note.text = "Applying what was tuned to the whole …"
                tab.apply()
            while tab.busy:
                await asyncio.sleep(_BEAT)
            # Another clip may have been opened meanwhile.
            if tab.pending or tab.restored is None:
                self._note.text = "Nothing was saved."
                return
            written = await asyncio.to_thread(save, tab.restored, outputs, clip.name, Path(self._path.value or ""))
            self._note.text = f"Saved: {', '.join(str(tab.folders.shown(path.resolve())) for path in written)}"
