"""What astronomers choose: calibration, the colours of the sensor, following an object, and the best frames."""

from __future__ import annotations

import asyncio
import dataclasses
from typing import TYPE_CHECKING

from nicegui import events, ui

from turbrestore.footage.frame_selection import Share, best_frames
from turbrestore_cli.options import Selection

from ..clip import LOOKED_THROUGH
from ..tab import Tab
from .elements import named_slider

if TYPE_CHECKING:
    import numpy as np

    from turbrestore.settings import RestoreParams

    from ..restoring import Order

_PATTERNS = {None: "none, or as the file says", "rggb": "RGGB", "grbg": "GRBG", "gbrg": "GBRG", "bggr": "BGGR"}
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


class AstronomyView:
    """The panel below the range of the frames.

    Parameters
    ----------
    tab : Tab
    """

    def __init__(self, tab: Tab) -> None:
        self._tab = tab
        self._quality: np.ndarray | None = None
        self._range = (0, 1)

    def build(self) -> None:
        """Make the elements."""
        with ui.element("details").classes("more"):
            ui.html("Astronomy", tag="summary", sanitize=False)
            with ui.element("div").classes("fields pair"):
                self._dark = ui.input("Dark frames", placeholder="darks.ser")
                self._flat = ui.input("Flat frames", placeholder="flats.ser")
                for field in (self._dark, self._flat):
                    field.props("dense outlined stack-label").classes("grow")
            with ui.element("div").classes("fields"):
                self._bayer = ui.select(_PATTERNS, label="Bayer pattern of a raw clip", value=None)
                self._bayer.props("dense outlined options-dense").classes("grow")
            self._follow = ui.checkbox("Follow a bright object on a dark field").props("dense").classes("q-mt-sm")
            self._keep, self._keep_text = named_slider(
                "Keep best", 1, 100, 1, "Share of the frames to keep, percent", 100
            )
            self._keep.on_value_change(self._draw)
            self._graph = ui.html("", sanitize=False)
            for event in ("pointerdown", "pointermove"):
                self._graph.on(event, self._dragged, throttle=0.05, js_handler=_PLACE)
            self._draw()

    async def opened(self) -> None:
        """Start from the whole of a new clip, and measure its frames."""
        clip = self._tab.clip
        assert clip is not None
        self._quality = None
        self._dark.value = self._flat.value = ""
        self._bayer.value, self._follow.value, self._keep.value = None, False, 100
        self.show_range(0, len(clip.source))
        if len(clip.source) <= LOOKED_THROUGH:
            quality = await asyncio.to_thread(clip.quality)
            if clip is self._tab.clip:
                self._quality = quality
        self._draw()

    def show_range(self, first: int, last: int) -> None:
        """Show the frames of a range alone."""
        self._range = first, last
        self._draw()

    def select(self, selection: Selection) -> Selection:
        """Add to a region and a range of frames what is chosen here.

        Raises
        ------
        ConfigurationError
            A file lies outside the folders of the app.
        """
        folders = self._tab.folders
        dark, flat = (
            str(folders.shown(folders.locate(field.value))) if (field.value or "").strip() else None
            for field in (self._dark, self._flat)
        )
        return dataclasses.replace(
            selection, dark=dark, flat=flat, bayer=self._bayer.value, crop_to_object=bool(self._follow.value)
        )

    def share(self, params: RestoreParams) -> RestoreParams:
        """Put the share of the frames that is kept into the settings of a run."""
        return dataclasses.replace(params, keep_best=Share((self._keep.value or 100) / 100))

    def take_over(self, order: Order) -> None:
        """Fill the fields by what a run had."""
        selection = order.selection
        self._dark.value, self._flat.value = selection.dark or "", selection.flat or ""
        self._bayer.value, self._follow.value = selection.bayer, selection.crop_to_object
        self._keep.value = round(100 * order.params.keep_best)

    def _dragged(self, event: events.GenericEventArguments) -> None:
        """Keep the frames on the left of the place to which the line was dragged."""
        self._keep.value = max(1, round(100 * float(event.args)))

    def _draw(self) -> None:
        """Draw the sharpness of the frames, the sharpest first, with a line behind the last one that is kept."""
        self._keep_text.text = f"{self._keep.value:.0f} %"
        first, last = self._range
        if self._quality is None or last > len(self._quality) or first >= last:
            self._graph.content = ""
            return
        quality = self._quality[first:last]
        kept = int(best_frames(quality, (self._keep.value or 100) / 100).sum())
        ranked = sorted(quality / quality.max(), reverse=True)
        width, height = _GRAPH
        step = width / len(ranked)
        bars = "".join(
            f'<rect class="{"kept" if place < kept else "rest"}" x="{place * step:.2f}" '
            f'y="{height * (1 - value):.1f}" width="{max(step * 0.8, 0.3):.2f}" height="{value * height:.1f}"/>'
            for place, value in enumerate(ranked)
        )
        label = f"Sharpness, sorted: {kept} of {last - first} frames are kept"
        self._graph.content = (
            f'<svg class="quality" viewBox="0 0 {width} {height}" preserveAspectRatio="none" role="img" '
            f'aria-label="{label}">{bars}<path class="level" d="M{kept * step:.1f} 0V{height}"/></svg>'
            f'<p class="note">{label}; drag the line to keep fewer.</p>'
        )
