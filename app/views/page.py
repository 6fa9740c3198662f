"""The page of one tab: its layout, and what happens when something is opened, run or goes wrong."""

from __future__ import annotations

from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from nicegui import ui

from turbrestore.report.comparison import text_file

from ..clip import Clip
from ..job import Job
from ..restoring import Restored
from ..tab import Tab
from .clip_view import ClipView
from .compare_view import CompareView
from .elements import Notices, in_thread
from .live_view import LiveView
from .open_view import OpenView
from .run_view import RunView
from .save_view import SaveView
from .several_view import SeveralView
from .steady_view import SteadyView
from .sweep_view import SweepView
from .tune_view import TuneView
from .video_view import VideoView

if TYPE_CHECKING:
    from turbrestore.io.source import Roi

# Seconds between two looks at the run.
_BEAT = 0.15


class Page:
    """All parts of the page of one tab, and what leads from one to another.

    Parameters
    ----------
    tab : Tab
    """

    def __init__(self, tab: Tab) -> None:
        self.tab, self.notices = tab, Notices()
        self.clip_view = ClipView(tab, self.notices, on_region=self._drawn)
        self.compare_view = CompareView(tab, on_show=lambda: self.look_at("compare"))
        self.video_view = VideoView(tab)
        self.sweep_view = SweepView(tab, on_show=self._swept, on_choose=self._chosen)
        self.open_view = OpenView(tab, self.notices, on_open=self.open)
        self.run_view = RunView(tab, self.notices, on_region=self.clip_view.draw)
        self.tune_view = TuneView(tab, self.notices, self.compare_view, self.sweep_view, on_change=self._tuned)
        self.save_view = SaveView(tab, self.notices)
        self.steady_view = SteadyView(tab, self.notices, selection=lambda: self.run_view.order().selection)
        self.live_view = LiveView(tab, self.notices, on_start=lambda: self.look_at("live"))
        self.several_view = SeveralView(tab, self.notices, like=self.run_view.order)
        # The run whose images are shown, and how many of them.
        self._seen: tuple[Job[object] | None, int] = (None, 0)

    async def show(self, file: Path | None) -> None:
        """Build the page, and open a file once it is seen; a tab that was loaded again goes on with its clip."""
        with ui.element("div").classes("app"):
            self.notices.build()
            # The library has a landmark "main" around all of this.
            with ui.element("div").classes("view"):
                self._build_viewer()
            with ui.element("aside").classes("side").props('aria-label="Steps"'):
                for view in (*self._steps(), self.live_view):
                    view.build()
        self._refresh()
        ui.timer(_BEAT, self._look)
        if self.tab.clip is not None:
            ui.timer(0, self._go_on, once=True)
        elif file is not None:
            ui.timer(0, lambda: self.open(file.absolute()), once=True)

    async def open(self, path: Path) -> None:
        """Open a clip that is allowed, and show it."""
        with self.notices.catching():
            with self.notices.waiting(f"Reading {path.name} …"):
                clip = await in_thread(self.tab.open, path)
            self.compare_view.clear()
            self.sweep_view.clear()
            self.video_view.fill()
            await self._opened(clip)

    def look_at(self, what: str) -> None:
        """Show ``clip``, stages (``compare``), widths of the blur (``sweep``), ``video`` or a camera (``live``)."""
        self.clip_view.place.visible = what == "clip"
        self.compare_view.place.visible = what == "compare"
        self.sweep_view.place.visible = what == "sweep"
        self.video_view.place.visible = what == "video"
        self.live_view.place.visible = what == "live"
        ui.run_javascript(f"turbrestore.look('{what}')")
        for name, button in self._tabs.items():
            button.classes(add="chosen" if name == what else "", remove="" if name == what else "chosen")
            button.props(f"aria-pressed={'true' if name == what else 'false'}")

    def _steps(self) -> tuple[OpenView, RunView, TuneView, SaveView, SteadyView, SeveralView]:
        """Return the views of the steps, which are beside the picture, from the top down."""
        return (
            self.open_view, self.run_view, self.tune_view, self.save_view, self.steady_view, self.several_view,
        )  # fmt: skip

    async def _opened(self, clip: Clip) -> None:
        self.notices.name(clip.name)
        self.open_view.opened()
        self.run_view.opened()
        if self.tab.ordered is not None:
            self.run_view.take_over(self.tab.ordered)
        self.save_view.opened()
        self.tune_view.opened()
        self.steady_view.opened()
        if self.tab.ordered_video is not None:
            self.steady_view.take_over(self.tab.ordered_video)
        self.several_view.opened()
        self.look_at("clip")
        self._refresh()
        await self.clip_view.opened()
        await self.run_view.measure()

    async def _go_on(self) -> None:
        """Show again what a page that was loaded anew had open; a run that is running or has ended is followed."""
        clip, restored = self.tab.clip, self.tab.restored
        assert clip is not None
        with self.notices.catching():
            await self._opened(clip)
            if restored is not None:
                await self.compare_view.show_result(restored)
                await self.tune_view.restored()
            self.video_view.fill()
            self._refresh()
            if self.tab.job is not None and self.tab.job.kind == "steady" and self.tab.steadied is not None:
                self.look_at("video")

    def _drawn(self, roi: Roi | None) -> None:
        self.run_view.set_region(roi)

    async def _ended(self, job: Job[object]) -> None:
        """Show how a run has ended."""
        if job.state == "failed":
            self.notices.tell(job.message)
        if job.state == "done":
            with self.notices.catching():
                await self._show_result(job)
        self._refresh()

    async def _show_result(self, job: Job[object]) -> None:
        """Show what a run has made; after several clips, their rows and what there was before."""
        if job.kind == "steady":
            self.video_view.fill()
            self.look_at("video")
            return
        if job.kind == "several":
            self.several_view.look()
        result = self.tab.restored if job.kind == "several" else job.result
        if not isinstance(result, Restored):
            self.compare_view.clear()
            self.look_at("clip")
            return
        await self.compare_view.show_result(result)
        if result is self.tab.restored:
            await self.tune_view.restored()

    def _swept(self) -> None:
        self._refresh()
        self.look_at("sweep")

    def _chosen(self, sigma: float) -> None:
        self.look_at("compare")
        self.tune_view.choose(sigma)

    def _tuned(self) -> None:
        self.save_view.refresh()
        self.run_view.show_method(self.tab.tuned)

    def _refresh(self) -> None:
        """Show the steps that can be taken now."""
        opened, restored = self.tab.clip is not None, self.tab.restored is not None
        for view in (self.run_view, self.steady_view, self.several_view):
            view.place.visible = opened
        self.tune_view.place.visible = self.save_view.place.visible = restored
        self._tabs["clip"].visible, self._tabs["compare"].visible = opened, self.compare_view.filled
        self._tabs["sweep"].visible = self.sweep_view.filled
        self._tabs["video"].visible = self.tab.steadied is not None
        self._tab_row.visible = self.compare_view.filled or self.tab.steadied is not None
        self.open_view.empty.visible = not opened
        self.save_view.refresh()

    def _build_viewer(self) -> None:
        with ui.element("div").classes("tabs").props('role=group aria-label="What is shown"') as self._tab_row:
            self._tabs = {
                name: ui.button(words, on_click=partial(self.look_at, name)).props("flat dense padding='4px 12px'")
                for name, words in (("clip", "Clip"), ("compare", "Compare"), ("sweep", "Widths"), ("video", "Video"))
            }
        self.open_view.build_empty()
        self.clip_view.build()
        self.compare_view.build()
        self.sweep_view.build()
        self.video_view.build()
        self.live_view.build_pictures()
        self.look_at("")

    async def _look(self) -> None:
        """Follow the run; called again and again."""
        await self._show_images()
        await self.live_view.refresh()
        for view in (self.run_view, self.steady_view, self.several_view, self.live_view):
            ended = view.follow()
            if ended is not None:
                await self._ended(ended)

    async def _show_images(self) -> None:
        """Show the images of the stages that are done."""
        job = self.tab.job
        if job is None or job.kind == "live" or job.state != "running":
            return
        # A copy: the next of several clips begins with none.
        images = dict(job.images)
        if images and self._seen != (job, len(images)):
            self._seen = job, len(images)
            with self.notices.catching():
                await self.compare_view.show(images, "The stages that are done so far.")
            self._refresh()


def add_styles_and_scripts() -> None:
    """Put into the head of the page what all its parts need; to be called before the browser has the page."""
    here = files(__package__)
    styles = text_file("palette.css") + text_file("compare.css") + here.joinpath("page.css").read_text("utf-8")
    parts = {"mountCompare": text_file("compare.js"), "mountFilm": text_file("film.js")}
    scripts = "".join(f"const {name} = () => {{{text}}};\n" for name, text in parts.items())
    ui.add_css(styles)
    ui.add_head_html(f"<script>{scripts}{here.joinpath('page.js').read_text('utf-8')}</script>")
