"""What people who stack choose: the best frames, the geometry of another result, and a finer grid."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import TYPE_CHECKING

from nicegui import events, ui

from turbrestore.core.remarks import counted
from turbrestore.footage.frame_selection import Share, best_frames
from turbrestore.stacking.quality import QualityList, sort_by_quality

from ..clip import LOOKED_THROUGH
from ..tab import Tab
from .elements import in_thread, named_slider

if TYPE_CHECKING:
    import numpy as np

    from turbrestore.settings import RestoreParams

# Sides of the graph of the quality, in units of its own.
_GRAPH = (300, 60)
# Place of the pointer in the graph while a button is held, as a share of its width.
_PLACE = """(event) => {
  const graph = event.currentTarget.querySelector("svg");
  if (!graph || !event.buttons) return;
  event.preventDefault();
  const box = graph.getBoundingClientRect();
  emit(Math.min(Math.max((event.clientX - box.x) / box.width, 0), 1));
}"""


# Frames that are named as the best and as the worst.
_NAMED = 5
_SCALES = {1.0: "of the clip", 1.5: "1.5 times as fine", 2.0: "twice as fine", 3.0: "three times as fine"}


class StackingView:
    """The panel with the frames sorted by quality, what shares of them cost and gain, a reference and the scale.

    Parameters
    ----------
    tab : Tab
    """

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self._measured: np.ndarray | None = None
        self._sorted: QualityList | None = None
        self._range = (0, 1)

    def build(self) -> None:
        """Make the elements."""
        with ui.element("details").classes("more"):
            ui.html("Stacking", tag="summary", sanitize=False)
            self._keep, self._keep_text = named_slider(
                "Keep best", 1, 100, 1, "Share of the frames to keep, percent", 100
            )
            self._keep.on_value_change(self._draw)
            self._graph = ui.html("", sanitize=False)
            for event in ("pointerdown", "pointermove"):
                self._graph.on(event, self._dragged, throttle=0.05, js_handler=_PLACE)
            self._shares = ui.element("div").classes("shares").props('role=group aria-label="Shares to keep"')
            self._named = ui.label("").classes("note")
            with ui.element("div").classes("fields"):
                self._reference = ui.input("Reference for the geometry", placeholder="red.tif")
                self._reference.props("dense outlined stack-label").classes("grow")
            with ui.element("div").classes("fields"):
                self._scale = ui.select(_SCALES, label="Grid of the result", value=1.0)
                self._scale.props("dense outlined options-dense").classes("grow")

    def opened(self) -> None:
        """Start from all frames of a new clip."""
        clip = self._tab.clip
        assert clip is not None
        self._measured = None
        self._keep.value, self._reference.value, self._scale.value = 100, "", 1.0
        self.show_range(0, len(clip.source))

    async def measure(self) -> None:
        """Measure the frames of the clip; what the user chooses meanwhile stays."""
        clip = self._tab.clip
        assert clip is not None
        if len(clip.source) <= LOOKED_THROUGH:
            measured = await in_thread(clip.quality)
            if clip is self._tab.clip:
                self._measured = measured
        self.show_range(*self._range)

    def show_range(self, first: int, last: int) -> None:
        """Show the frames of a range alone."""
        self._range = first, last
        part = None if self._measured is None else self._measured[first:last]
        self._sorted = None if part is None or not 0 < last - first == len(part) else sort_by_quality(part)
        self._shares.clear()
        self._named.text = ""
        if self._sorted is not None:
            self._list(self._sorted)
        self._draw()

    def choose(self, params: RestoreParams) -> RestoreParams:
        """Put what is chosen here into the settings of a run.

        Raises
        ------
        ConfigurationError
            The reference lies outside the folders of the app.
        """
        folders, named = self._tab.folders, (self._reference.value or "").strip()
        reference = str(folders.shown(folders.locate(named))) if named else None
        share = Share((self._keep.value or 100) / 100)
        return dataclasses.replace(params, keep_best=share, reference=reference, scale=self._scale.value)

    def take_over(self, params: RestoreParams) -> None:
        """Fill the fields by what a run had."""
        self._keep.value = round(100 * params.keep_best)
        self._reference.value, self._scale.value = params.reference or "", params.scale

    def _dragged(self, event: events.GenericEventArguments) -> None:
        """Keep the frames on the left of the place to which the line was dragged."""
        self._keep.value = max(1, round(100 * float(event.args)))

    def _list(self, found: QualityList) -> None:
        """List what shares cost and gain; each can be chosen."""
        with self._shares:
            for words in ("Keep", "Frames", "Noise", "Sharpness", "Worth"):
                ui.label(words).classes("what")
            suggested = () if found.suggested is None else (found.suggested,)
            for one in (*found.kept, *suggested):
                percent = one.percent
                button = ui.button(f"{percent} %", on_click=partial(self._keep.set_value, percent))
                button.props("outline dense no-wrap")
                if one is found.suggested:
                    button.props(f'aria-label="{percent} %, suggested"')
                for words in (str(one.frames), f"{one.noise:.2f}×", f"{one.sharpness:.2f}×", f"{one.worth:.2f}×"):
                    ui.label(words)
        said = "The last row is suggested." if suggested else "No share is clearly worth more than all frames."
        named = [str(self._range[0] + int(place)) for place in found.order]
        self._named.text = (
            f"{said} Worth is detail over noise and error, all frames = 1. The sharpest frames are "
            f"{', '.join(named[:_NAMED])}, the softest {', '.join(named[: -_NAMED - 1 : -1])}."
        )

    def _draw(self) -> None:
        """Draw the quality of the frames, the best first, with a line behind the last one that is kept."""
        self._keep_text.text = f"{self._keep.value:.0f} %"
        if self._sorted is None:
            self._graph.content = ""
            return
        quality = self._sorted.quality
        kept = int(best_frames(quality, (self._keep.value or 100) / 100).sum())
        ranked = quality[self._sorted.order] / (quality.max() or 1.0)
        width, height = _GRAPH
        step = width / len(ranked)
        bars = "".join(
            f'<rect class="{"kept" if place < kept else "rest"}" x="{place * step:.2f}" '
            f'y="{height * (1 - value):.1f}" width="{max(step * 0.8, 0.3):.2f}" height="{value * height:.1f}"/>'
            for place, value in enumerate(ranked)
        )
        label = f"Sharpness, sorted: {kept} of {counted(len(quality), 'frame')} kept"
        self._graph.content = (
            f'<svg class="quality" viewBox="0 0 {width} {height}" preserveAspectRatio="none" role="img" '
            f'aria-label="{label}">{bars}<path class="level" d="M{kept * step:.1f} 0V{height}"/></svg>'
            f'<p class="note">{label}; drag the line to keep fewer.</p>'
        )
