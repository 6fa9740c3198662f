"""Step two: restore a part or the whole, and watch how it goes."""

from __future__ import annotations

import asyncio
import dataclasses
import html
from collections.abc import Callable
from typing import TYPE_CHECKING

from nicegui import events, ui

from turbrestore.core.errors import require
from turbrestore.footage.frame_selection import Share, best_frames
from turbrestore.settings import PRESETS
from turbrestore_cli.options import Selection
from turbrestore_cli.progress import TITLES

from .clip import LOOKED_THROUGH
from .elements import set_most
from .job import Job
from .restoring import Order

if TYPE_CHECKING:
    import numpy as np

    from turbrestore.deconvolution.deconvolve import DeconvolutionParams
    from turbrestore.io.source import Roi

    from .page import Page

_SIDES = ("x", "y", "width", "height")
_STATES = {"running": "at work …", "stopped": "stopped", "failed": "failed"}
# Sides of the graph of the quality, in units of its own.
_GRAPH = (300, 60)
# Height of the pointer in the graph while a button is held, as a share.
_LEVEL = """(event) => {
  const graph = event.currentTarget.querySelector("svg");
  if (!graph || !event.buttons) return;
  event.preventDefault();
  const box = graph.getBoundingClientRect();
  emit(Math.min(Math.max(1 - (event.clientY - box.y) / box.height, 0), 1));
}"""


class RunView:
    """Region, frames, the buttons, and what is known of the run.

    Parameters
    ----------
    page : Page
    """

    def __init__(self, page: Page) -> None:
        self._page = page
        self._job: Job | None = None
        self._quality: np.ndarray | None = None
        self._images, self._ended = 0, False
        self._bars: dict[str, tuple[ui.linear_progress, ui.label]] = {}

    def build(self) -> None:
        """Make the elements."""
        with ui.element("section") as self.place:
            ui.html('<span class="number">2</span> Run', tag="h2", sanitize=False)
            with ui.element("div").classes("four").props('role=group aria-label="Region"'):
                self._roi = [ui.number(name, min=0, format="%d", on_change=self._typed) for name in _SIDES]
            for number in self._roi:
                number.props("dense outlined clearable=false")
            with ui.element("div").classes("fields apart"):
                ui.label("Frames").classes("what")
                self._frames = ui.range(min=0, max=1, step=1, on_change=self._ranged).classes("grow q-mx-sm")
                self._frames_text = ui.label("").classes("value")
            with ui.element("div").classes("fields"):
                ui.label("Keep best").classes("what")
                self._keep = ui.slider(min=1, max=100, step=1, value=100, on_change=self._kept).classes("grow q-mx-sm")
                self._keep.props('aria-label="Share of the frames to keep, percent"')
                self._keep_text = ui.label("100 %").classes("value")
            self._graph = ui.html("", sanitize=False)
            for event in ("pointerdown", "pointermove"):
                self._graph.on(event, self._dragged, throttle=0.05, js_handler=_LEVEL)
            with ui.element("div").classes("fields"):
                ui.label("Preset").classes("what")
                self._preset = ui.toggle(list(PRESETS), value="standard").props(
                    'unelevated no-caps padding="4px 12px" aria-label="Preset"'
                )
            with ui.element("div").classes("fields apart"):
                self._preview = ui.button("Preview", on_click=lambda: self._start(self._page.tab.preview))
                self._preview.props("outline")
                self._run = ui.button("Run", on_click=lambda: self._start(self._page.tab.run)).classes("grow")
                self._run.props("unelevated")
                self._page.starters += [self._preview, self._run]
                self._stop = ui.button("Stop", on_click=self._page.tab.stop).props("outline")
                self._stop.visible = False
            self._method = ui.label("").classes("note")
            self._state = ui.label("").classes("note").props("role=status")
            self._stages = ui.element("div").classes("stages")
            self._decided = ui.html("", sanitize=False)

    async def opened(self) -> None:
        """Start from the whole of a new clip."""
        clip = self._page.tab.clip
        assert clip is not None
        self._job, self._quality = None, None
        self._keep.value, self._preset.value = 100, "standard"
        set_most(self._frames, len(clip.source))
        self._frames.value = {"min": 0, "max": len(clip.source)}
        self.set_region(None)
        self._clear()
        self._state.text = ""
        self._show_buttons(running=False)
        if len(clip.source) <= LOOKED_THROUGH:
            self._quality = await asyncio.to_thread(clip.quality)
        self._draw_quality()

    def show_method(self, params: DeconvolutionParams | None) -> None:
        """Say that the next run removes the blur that was chosen, where one was."""
        self._method.text = "" if params is None else f"Removes {params.sigma:.2f} pixels of blur, as chosen in Tune."
        self._method.visible = params is not None

    def set_region(self, roi: Roi | None) -> None:
        """Take over a region that was drawn."""
        for number, value in zip(self._roi, roi or (None,) * 4, strict=True):
            number.value = value

    def take_over(self, order: Order) -> None:
        """Fill the fields by what a run had."""
        start, stop, _ = order.selection.frame_range() or (None, None, None)
        if start is not None and stop is not None:
            self._frames.value = {"min": start, "max": stop}
        self.set_region(order.selection.region())
        self._keep.value, self._preset.value = round(100 * order.params.keep_best), order.preset

    def region(self) -> Roi | None:
        """Return the region in the fields; None if they are not all filled."""
        values = [number.value for number in self._roi]
        if any(value is None for value in values):
            return None
        x, y, width, height = (int(value) for value in values if value is not None)
        return x, y, width, height

    def order(self) -> Order:
        """Return what the fields say; the deconvolution is that of the last step.

        Raises
        ------
        ConfigurationError
            The region is not all given.
        """
        clip = self._page.tab.clip
        assert clip is not None
        given = [number.value is not None for number in self._roi]
        require(all(given) or not any(given), "region: expected x, y, width and height, or none of them")
        roi = self.region()
        first, last = self._range()
        selection = Selection(
            frames=None if (first, last) == (0, len(clip.source)) else f"{first}:{last}",
            roi=None if roi is None or roi == (0, 0, *clip.size) else ",".join(map(str, roi)),
        )
        preset = self._preset.value
        params = dataclasses.replace(PRESETS[preset], keep_best=Share((self._keep.value or 100) / 100))
        return Order(clip.path, selection, self._page.tune_view.chosen(params), preset)

    async def follow(self) -> bool:
        """Show how the run goes; tell whether it has just ended."""
        job = self._page.tab.job
        if job is None or (job is self._job and self._ended):
            return False
        if job is not self._job:
            self._job, self._images, self._ended = job, 0, False
            self._clear()
        if self._bars.keys() - job.bars.keys():
            # The next of several clips.
            self._images = 0
            self._clear()
        running = job.state == "running"
        self._show_bars(job)
        self._show_decisions(job)
        self._show_buttons(running)
        self._state.text = f"done in {job.seconds:.1f} s" if job.state == "done" else _STATES[job.state]
        self._stages.visible = job.state != "done"
        if running and len(job.images) > self._images:
            self._images = len(job.images)
            with self._page.catching():
                await self._page.compare_view.show(dict(job.images), "The stages that are done so far.")
        self._ended = not running
        return self._ended

    def _range(self) -> tuple[int, int]:
        values = self._frames.value or {"min": 0, "max": 1}
        return int(values["min"]), int(values["max"])

    def _typed(self) -> None:
        self._page.clip_view.draw(self.region())

    def _ranged(self) -> None:
        first, last = self._range()
        self._frames_text.text = f"{first}:{last}"
        self._draw_quality()

    def _kept(self) -> None:
        self._keep_text.text = f"{self._keep.value:.0f} %"
        self._draw_quality()

    def _dragged(self, event: events.GenericEventArguments) -> None:
        """Keep the frames above a level to which the line was dragged."""
        first, last = self._range()
        if self._quality is None or last > len(self._quality) or first >= last:
            return
        above = self._quality[first:last] >= float(event.args) * self._quality.max()
        self._keep.value = max(1, round(100 * float(above.mean())))

    def _draw_quality(self) -> None:
        """Draw the sharpness of the frames as bars, those that are kept in colour, and a line at the least of these."""
        first, last = self._range()
        if self._quality is None or last > len(self._quality) or first >= last:
            self._graph.content = ""
            return
        kept = set(first + best_frames(self._quality[first:last], (self._keep.value or 100) / 100).nonzero()[0])
        width, height = _GRAPH
        step, scale = width / len(self._quality), height / float(self._quality.max())
        bars = "".join(
            f'<rect class="{"kept" if number in kept else "rest"}" x="{number * step:.2f}" '
            f'y="{height - value * scale:.1f}" width="{max(step * 0.8, 0.3):.2f}" height="{value * scale:.1f}"/>'
            for number, value in enumerate(self._quality)
        )
        level = height - min(self._quality[number] for number in kept) * scale
        label = f"Sharpness of the frames; {len(kept)} of {last - first} are kept"
        self._graph.content = (
            f'<svg class="quality" viewBox="0 0 {width} {height}" preserveAspectRatio="none" role="img" '
            f'aria-label="{label}">{bars}<path class="level" d="M0 {level:.1f}H{width}"/></svg>'
            f'<p class="note">{label}; drag the line to keep others.</p>'
        )

    def _start(self, begin: Callable[[Order], Job]) -> None:
        with self._page.catching():
            order = self.order()
            order.selection.frame_range()
            begin(order)
            self._show_buttons(running=True)

    def _show_buttons(self, running: bool) -> None:
        self._stop.visible = running
        for button in self._page.starters:
            button.set_enabled(not running)

    def _clear(self) -> None:
        self._bars.clear()
        self._stages.clear()
        self._decided.content = ""

    def _show_bars(self, job: Job) -> None:
        for stage, bar in job.bars.copy().items():
            if stage not in self._bars:
                with self._stages, ui.element("div").classes("lap"):
                    ui.label(TITLES[stage])
                    left = ui.label("").classes("note")
                    line = ui.linear_progress(0, show_value=False, size="6px").props("instant-feedback")
                    line.props(f'aria-label="{TITLES[stage]}"')
                self._bars[stage] = line, left
            line, left = self._bars[stage]
            line.value = round(bar.share, 3)
            seconds = bar.left
            left.text = "done" if bar.share == 1 else "" if seconds is None else f"{seconds:.0f} s left"

    def _show_decisions(self, job: Job) -> None:
        lines = (
            f"<dt>{html.escape(decision.subject)}: {html.escape(decision.choice)}</dt>"
            f"<dd>{html.escape(decision.reason)}</dd>"
            for decision in tuple(job.decisions)
        )
        shown = "" if job.state == "done" else " open"
        head = f'<summary class="note">{len(job.decisions)} decisions</summary>'
        content = f'<details class="decisions"{shown}>{head}<dl class="decided">{"".join(lines)}</dl></details>'
        self._decided.visible = bool(job.decisions)
        if self._decided.content != content:
            self._decided.content = content
