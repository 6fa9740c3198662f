"""Step one: choose a clip."""

from __future__ import annotations

import html
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from nicegui import events, ui

from turbrestore.io.limits import DEFAULT_LIMITS
from turbrestore.io.video import VIDEO_SUFFIXES

from .folders import Entry, printable

if TYPE_CHECKING:
    from .page import Page

# Facts that are shown only where there is something to say.
_SILENT_ZERO = ("filled_values", "stuck_pixels", "duplicated_frames", "blank_frames", "saturated")


class OpenView:
    """List of a folder, path, upload, and what is known of the clip.

    Parameters
    ----------
    page : Page
    """

    def __init__(self, page: Page) -> None:
        self._page, self._folders = page, page.tab.folders
        self._folder = self._folders.start

    def build(self) -> None:
        """Make the elements."""
        with ui.element("section"):
            ui.html('<span class="number">1</span> Open', tag="h2", sanitize=False)
            with ui.element("div") as self._chooser:
                self._build_chooser()
            self._another = ui.button("Another clip", on_click=lambda: self._choose(True)).props("outline")
            self._facts = ui.html("", sanitize=False)
        self._choose(True)

    def _choose(self, choosing: bool) -> None:
        self._chooser.visible, self._another.visible = choosing, not choosing

    def _build_chooser(self) -> None:
        self._list = ui.element("div").classes("files").props('role=list aria-label="Clips of the folder"')
        self._enter(self._folder)
        with ui.element("div").classes("fields"):
            self._path = ui.input("Path of a clip", placeholder="clip.mkv").props("dense outlined").classes("grow")
            self._path.on("keydown.enter", self._open_path)
            ui.button("Open", on_click=self._open_path).props("outline no-wrap")
        with ui.element("div").classes("fields"):
            ui.upload(
                label="Take a file from elsewhere: drop it here, or choose with +",
                auto_upload=True,
                max_file_size=DEFAULT_LIMITS.max_bytes,
                on_upload=self._uploaded,
                on_rejected=lambda: self._page.tell(
                    f"upload: expected one clip of up to {DEFAULT_LIMITS.max_bytes} bytes; open larger ones by path"
                ),
            ).props(f'flat accept="{",".join(VIDEO_SUFFIXES)}"').classes("grow")

    def opened(self) -> None:
        """Show what is known of the clip."""
        clip = self._page.tab.clip
        assert clip is not None
        rows = [(name, value) for name, value in clip.facts.items() if _worth_saying(name, value)]
        facts = "".join(
            f"<dt>{html.escape(name.replace('_', ' '))}</dt><dd>{html.escape(_text(value))}</dd>"
            for name, value in rows
        )
        remarks = "".join(f'<p class="remark">{html.escape(remark)}</p>' for remark in clip.remarks)
        summary = html.escape(_summary(clip.facts))
        more = f'<details><summary class="note">All that is known</summary><dl class="facts">{facts}</dl></details>'
        self._facts.content = f'<p class="sum">{summary}</p>{remarks}{more}'
        self._choose(False)
        self._path.value = printable(clip.name)

    def _enter(self, folder: Path) -> None:
        with self._page.catching():
            entries = self._folders.listing(folder)
            self._folder = folder
            self._list.clear()
            with self._list:
                if self._folders.holds_images(folder):
                    images = ui.button(
                        "the images of this folder, as frames", on_click=partial(self._page.open, folder)
                    )
                    images.props("flat dense no-caps align=left color=inherit")
                for entry in entries:
                    self._line(entry)
                if not entries:
                    ui.label("no clips here").classes("note q-pa-sm")

    def _line(self, entry: Entry) -> None:
        async def chosen() -> None:
            if entry.is_folder:
                self._enter(entry.path)
            else:
                await self._page.open(entry.path)

        button = ui.button(printable(entry.name), on_click=chosen).props("flat dense no-caps align=left color=inherit")
        if entry.is_folder:
            button.classes("folder")

    async def _open_path(self) -> None:
        with self._page.catching():
            path = self._folders.locate(self._path.value or "")
            if path.is_dir() and not self._folders.holds_images(path):
                self._enter(path)
                return
            await self._page.open(path)

    async def _uploaded(self, event: events.UploadEventArguments) -> None:
        with self._page.catching():
            place = self._page.tab.place_for(event.file.name)
            await event.file.save(place)
            await self._page.open(place)
        event.sender.run_method("reset")


def _worth_saying(name: str, value: object) -> bool:
    if name == "scenes":
        return isinstance(value, list) and len(value) > 1
    # Remarks have a place of their own.
    return name != "warnings" and value is not None and (name not in _SILENT_ZERO or bool(value))


def _summary(facts: dict[str, object]) -> str:
    rate = facts["frames_per_second"]
    words = [f"{facts['width']}×{facts['height']} pixels", f"{facts['bit_depth']} bits", f"{facts['frames']} frames"]
    if facts["usable_frames"] != facts["frames"]:
        words.append(f"{facts['usable_frames']} of them usable")
    return ", ".join(words) + (f", {rate:g} per second" if isinstance(rate, float) else "")


def _text(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
