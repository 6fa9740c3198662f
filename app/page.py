"""The page of one tab: its layout, and what happens when something is opened, run or goes wrong."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib.resources import files
from pathlib import Path

from nicegui import ui

from turbrestore.report.comparison import text_file

from .clip import Clip
from .clip_view import ClipView
from .compare_view import CompareView
from .folders import printable
from .job import Job, one_line
from .open_view import OpenView
from .run_view import RunView
from .save_view import SaveView
from .several_view import SeveralView
from .steady_view import SteadyView
from .tab import Tab
from .tune_view import TuneView

# Seconds between two looks at the run.
_BEAT = 0.15


class Page:
    """All parts of the page of one tab.

    Parameters
    ----------
    tab : Tab
    """

    def __init__(self, tab: Tab) -> None:
        self.tab = tab
        # Buttons that begin a run; none can be pressed while one is at work.
        self.starters: list[ui.button] = []
        self.clip_view, self.compare_view = ClipView(self), CompareView(self)
        self.open_view, self.run_view = OpenView(self), RunView(self)
        self.tune_view, self.save_view = TuneView(self), SaveView(self)
        self.steady_view, self.several_view = SteadyView(self), SeveralView(self)

    async def show(self, file: Path | None) -> None:
        """Build the page, and open a file once it is seen; a tab that was loaded again goes on with its clip."""
        with ui.element("div").classes("app"):
            with ui.element("header").classes("bar"):
                ui.html("turbrestore", tag="h1", sanitize=False)
                self._name = ui.label("no clip is open").classes("name")
                self._busy = ui.label("").classes("busy").props("role=status")
            self._error = ui.label("").classes("error").props("role=alert")
            self._error.visible = False
            with ui.element("main").classes("view"):
                self._build_viewer()
            with ui.element("aside").classes("side").props('aria-label="Steps"'):
                for view in self._steps():
                    view.build()
        self._refresh()
        ui.timer(_BEAT, self._look)
        if self.tab.clip is not None:
            ui.timer(0, self._go_on, once=True)
        elif file is not None:
            ui.timer(0, lambda: self.open(file.absolute()), once=True)

    def _steps(self) -> tuple[OpenView, RunView, TuneView, SaveView, SteadyView, SeveralView]:
        """Return what stands beside what is shown, from above."""
        return (
            self.open_view, self.run_view, self.tune_view, self.save_view, self.steady_view, self.several_view,
        )  # fmt: skip

    async def open(self, path: Path) -> None:
        """Open a clip that is allowed, and show it."""
        with self.catching():
            self._busy.text = printable(f"looking through {path.name} …")
            try:
                clip = await asyncio.to_thread(self.tab.open, path)
            finally:
                self._busy.text = ""
            self.compare_view.clear()
            await self._opened(clip)

    async def _opened(self, clip: Clip) -> None:
        self._name.text = printable(clip.name)
        self.open_view.opened()
        self.save_view.opened()
        self.tune_view.opened()
        self.steady_view.opened()
        self.several_view.opened()
        self.look_at("clip")
        self._refresh()
        await self.clip_view.opened()
        await self.run_view.opened()

    async def _go_on(self) -> None:
        """Show again what a page that was loaded anew had open; a run that is at work or has ended is followed."""
        clip, restored = self.tab.clip, self.tab.restored
        assert clip is not None
        with self.catching():
            await self._opened(clip)
            if restored is not None:
                self.run_view.take_over(restored.order)
                await self.compare_view.show_result(restored)
                await self.tune_view.restored()
            self.steady_view.fill()
            self._refresh()
            if self.tab.job is not None and isinstance(self.tab.job.result, Path):
                self.look_at("video")

    def look_at(self, what: str) -> None:
        """Show the frames of the clip (``clip``), the images of the stages (``compare``), or the ``video``."""
        self.clip_view.place.visible = what == "clip"
        self.compare_view.place.visible = what == "compare"
        self.steady_view.player.visible = what == "video"
        for name, button in self._tabs.items():
            button.classes(add="chosen" if name == what else "", remove="" if name == what else "chosen")
            button.props(f"aria-pressed={'true' if name == what else 'false'}")

    @contextmanager
    def catching(self) -> Iterator[None]:
        """Show an error as one line; an earlier one disappears."""
        self.tell("")
        try:
            yield
        except Exception as error:
            self.tell(one_line(error))

    def tell(self, message: str) -> None:
        """Show one line above all, or none."""
        self._error.text = printable(message)
        self._error.visible = bool(message)

    async def ended(self) -> None:
        """Show how a run has ended."""
        job = self.tab.job
        if job is None:
            return
        if job.state == "failed":
            self.tell(job.message)
        if job.state == "done":
            with self.catching():
                await self._show_result(job)
        self._refresh()

    async def _show_result(self, job: Job) -> None:
        """Show what a run has made; after several clips, what there was before."""
        result = self.tab.restored if job.result is None else job.result
        if result is None:
            self.compare_view.clear()
            self.look_at("clip")
        elif isinstance(result, Path):
            self.steady_view.fill()
            self.look_at("video")
        else:
            await self.compare_view.show_result(result)
            if result is self.tab.restored:
                await self.tune_view.restored()

    def _refresh(self) -> None:
        """Show the steps that can be taken now."""
        self.run_view.place.visible = self.tab.clip is not None
        self.tune_view.place.visible = self.tab.restored is not None
        self.save_view.place.visible = self.tab.restored is not None
        self.steady_view.place.visible = self.several_view.place.visible = self.tab.clip is not None
        self._tabs["video"].visible = self.tab.video is not None
        self._tabs["clip"].visible = self.tab.clip is not None
        self._tabs["compare"].visible = self.compare_view.filled
        self._empty.visible = self.tab.clip is None
        self.save_view.refresh()

    def _build_viewer(self) -> None:
        with ui.element("div").classes("tabs").props('role=group aria-label="What is shown"'):
            self._tabs = {
                name: ui.button(words, on_click=partial(self.look_at, name)).props("flat dense padding='4px 12px'")
                for name, words in (("clip", "Clip"), ("compare", "Compare"), ("video", "Video"))
            }
        self._empty = ui.label("Open a clip on the right: from the list, by its path, or from your files.")
        self._empty.classes("empty")
        self.clip_view.build()
        self.compare_view.build()
        self.steady_view.build_player()
        self.look_at("clip")

    async def _look(self) -> None:
        """Follow the run; called again and again."""
        self.several_view.follow()
        if await self.run_view.follow():
            await self.ended()


def add_styles_and_scripts() -> None:
    """Put into the head of the page what all its parts need; to be called before the browser has the page."""
    here = files(__package__)
    styles = text_file("palette.css") + text_file("compare.css") + here.joinpath("page.css").read_text("utf-8")
    script = here.joinpath("page.js").read_text("utf-8")
    ui.add_css(styles)
    ui.add_head_html(f"<script>const mountCompare = () => {{{text_file('compare.js')}}};\n{script}</script>")
