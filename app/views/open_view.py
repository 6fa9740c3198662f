"""Step one: choose a clip."""

from __future__ import annotations

import html
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

from nicegui import events, ui

from turbrestore.io.limits import DEFAULT_LIMITS
from turbrestore.io.video import VIDEO_SUFFIXES

from ..folders import Entry, printable
from ..tab import Tab
from .elements import Notices, labelled

_NAMES = {"train": "training frames", "frames_per_second": "frames a second"}
# Facts that are shown only where there is something to say.
_SILENT_ZERO = ("filled_values", "stuck_pixels", "duplicated_frames", "blank_frames", "saturated")


class OpenView:
    """List of a folder, path, upload, and what is known of the clip.

    Parameters
    ----------
    tab : Tab
    notices : Notices
    on_open : callable
        Called with the path that was chosen.
    """

    def __init__(self, tab: Tab, notices: Notices, on_open: Callable[[Path], Awaitable[None]]) -> None:
        self._tab, self._notices, self._open = tab, notices, on_open
        self._folder = tab.folders.start

    def build(self) -> None:
        """Make the elements."""
        with ui.element("section"):
            ui.html('<span class="number">1</span> Open', tag="h2", sanitize=False)
            with ui.element("div") as self._chooser:
                self._build_chooser()
            self._facts = ui.html("", sanitize=False)
            self._another = ui.button("Another clip", on_click=lambda: self._choose(True)).props("outline")
        self._choose(True)

    def build_empty(self) -> None:
        """Make what is shown before a clip is open; the whole page takes files that are dropped."""
        self._upload = ui.upload(
            auto_upload=True,
            max_file_size=DEFAULT_LIMITS.max_bytes,
            on_upload=self._uploaded,
            on_rejected=lambda: self._notices.tell(
                f"upload: expected one clip of up to {DEFAULT_LIMITS.max_bytes} bytes; open larger ones by path"
            ),
        ).props(f'accept="{",".join(VIDEO_SUFFIXES)}"')
        ui.timer(0, lambda: ui.run_javascript(f"turbrestore.acceptDrops({self._upload.id})"), once=True)
        ui.label("Drop the clip to open it").classes("droppable").props("aria-hidden=true")
        with ui.element("div").classes("empty") as self.empty:
            ui.label("Drop a clip here").classes("big")
            ui.label("or open one from the list, by its path, or from your files.")
            self._pick()

    def opened(self) -> None:
        """Show what is known of the clip."""
        clip = self._tab.clip
        assert clip is not None
        rows = [(name, value) for name, value in clip.facts.items() if _worth_saying(name, value)]
        facts = "".join(
            f"<dt>{html.escape(name.replace('_', ' ').capitalize())}</dt><dd>{html.escape(_text(value))}</dd>"
            for name, value in ((_NAMES.get(name, name), value) for name, value in rows)
        )
        remarks = "".join(f'<p class="remark">{html.escape(labelled(remark))}</p>' for remark in clip.remarks)
        summary = html.escape(_summary(clip.facts))
        more = f'<details class="more"><summary>More about this clip</summary><dl class="facts">{facts}</dl></details>'
        self._facts.content = f'<p class="sum">{summary}</p>{remarks}{more}'
        self._choose(False)
        self._path.value = printable(clip.name)

    def _choose(self, choosing: bool) -> None:
        self._chooser.visible, self._another.visible = choosing, not choosing

    def _build_chooser(self) -> None:
        self._list = ui.element("div").classes("files").props('role=group aria-label="Clips of the folder"')
        self._enter(self._folder)
        with ui.element("div").classes("fields"):
            self._path = ui.input("Path of a clip", placeholder="clip.mkv").classes("grow")
            self._path.props("dense outlined stack-label")
            self._path.on("keydown.enter", self._open_path)
            ui.button("Open", on_click=self._open_path).props("outline no-wrap")
        with ui.element("div").classes("fields"):
            self._pick()
            ui.label("or drop it anywhere on the page").classes("note")

    def _pick(self) -> None:
        # Only the browser itself may open its list of files, at the click.
        ui.button("Choose a file").props("outline no-wrap").on(
            "click", js_handler="() => document.querySelector('.q-uploader input[type=file]').click()"
        )

    def _enter(self, folder: Path) -> None:
        with self._notices.catching():
            entries = self._tab.folders.listing(folder)
            self._folder = folder
            self._list.clear()
            with self._list:
                if self._tab.folders.holds_images(folder):
                    images = ui.button("the images of this folder, as frames", on_click=partial(self._open, folder))
                    images.props("flat dense no-caps align=left color=inherit")
                for entry in entries:
                    self._line(entry)
                if not entries:
                    ui.label("There are no clips in this folder.").classes("note q-pa-sm")

    def _line(self, entry: Entry) -> None:
        async def chosen() -> None:
            if entry.is_folder:
                self._enter(entry.path)
            else:
                await self._open(entry.path)

        button = ui.button(printable(entry.name), on_click=chosen).props("flat dense no-caps align=left color=inherit")
        if entry.is_folder:
            button.classes("folder")

    async def _open_path(self) -> None:
        with self._notices.catching():
            path = self._tab.folders.locate(self._path.value or "")
            if path.is_dir() and not self._tab.folders.holds_images(path):
                self._enter(path)
                return
            await self._open(path)

    async def _uploaded(self, event: events.UploadEventArguments) -> None:
        with self._notices.catching():
            place = self._tab.place_for(event.file.name)
            await event.file.save(place)
            await self._open(place)
        event.sender.run_method("reset")


def _worth_saying(name: str, value: object) -> bool:
    if name == "scenes":
        return isinstance(value, list) and len(value) > 1
    # Remarks have a place of their own.
    return name != "warnings" and value is not None and (name not in _SILENT_ZERO or bool(value))


def _summary(facts: dict[str, object]) -> str:
    rate, count = facts["frames_per_second"], facts["frames"]
    words = [f"{facts['width']}×{facts['height']} pixels", f"{facts['bit_depth']} bits", f"{count} frames"]
    if facts["usable_frames"] != count:
        words.append(f"{facts['usable_frames']} of them usable")
    if isinstance(rate, float) and isinstance(count, int):
        words.append(f"{count / rate:.1f} s at {rate:.4g} per second")
    return ", ".join(words)


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
