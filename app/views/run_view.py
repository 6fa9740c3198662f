"""Step two: restore a part or the whole, and watch how it goes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from nicegui import ui

from turbrestore.core.errors import require
from turbrestore.core.remarks import counted
from turbrestore.settings import PRESETS
from turbrestore_cli.options import Selection

from ..restoring import Order
from ..tab import Tab
from .astronomy_view import AstronomyView
from .elements import Notices
from .progress_view import ProgressView
from .stacking_view import StackingView

if TYPE_CHECKING:
    from turbrestore.deconvolution.deconvolve import DeconvolutionParams
    from turbrestore.io.source import Roi

    from ..job import Job

_SIDES = ("x", "y", "width", "height")


class RunView:
    """Region, frames, the buttons, and what is known of the run.

    Parameters
    ----------
    tab : Tab
    notices : Notices
    on_region : callable
        Called with the region that was typed, or None.
    """

    def __init__(self, tab: Tab, notices: Notices, on_region: Callable[[Roi | None], None]) -> None:
        self._tab, self._notices, self._on_region = tab, notices, on_region
        self._astronomy, self._stacking = AstronomyView(tab), StackingView(tab)
        self._progress = ProgressView(tab, "restore")
        self.follow, self.measure = self._progress.follow, self._stacking.measure

    def build(self) -> None:
        """Make the elements."""
        with ui.element("section") as self.place:
            ui.html('<span class="number">2</span> Restore', tag="h2", sanitize=False)
            with ui.element("div").classes("titled"):
                ui.label("Region, pixels").classes("what")
                self._whole = ui.button("Whole frame", on_click=lambda: self.set_region(None))
                self._whole.props("flat dense no-wrap")
            with ui.element("div").classes("four").props('role=group aria-label="Region, pixels"'):
                self._roi = [ui.number(name, min=0, format="%d", on_change=self._typed) for name in _SIDES]
            for number in self._roi:
                number.props("dense outlined")
            with ui.element("div").classes("fields apart"):
                ui.label("Frames").classes("what")
                self._first, self._last = (
                    ui.number(name, min=0, step=1, format="%d", on_change=self._ranged).classes("grow")
                    for name in ("first", "last")
                )
                for number in (self._first, self._last):
                    number.props("dense outlined")
                self._count = ui.label("").classes("value")
            with ui.element("div").classes("fields"):
                ui.label("Preset").classes("what")
                self._preset = ui.toggle(list(PRESETS), value="standard").props(
                    'unelevated no-caps padding="4px 12px" aria-label="Preset"'
                )
            self._astronomy.build()
            self._stacking.build()
            with ui.element("div").classes("fields apart"):
                preview = ui.button("Preview", on_click=lambda: self._start(self._tab.preview)).props("outline")
                run = ui.button("Run", on_click=lambda: self._start(self._tab.run)).classes("grow").props("unelevated")
                self._progress.build((preview, run))
            self._method = ui.label("").classes("note")
            self._progress.build_bars()

    def opened(self) -> None:
        """Start from the whole of a new clip."""
        clip = self._tab.clip
        assert clip is not None
        self._preset.value = "standard"
        self._first.value, self._last.value = 0, len(clip.source) - 1
        self.set_region(None)
        self._typed()
        self._astronomy.opened()
        self._stacking.opened()

    def show_method(self, params: DeconvolutionParams | None) -> None:
        """Say that the next run removes the blur that was chosen, where one was."""
        self._method.text = "" if params is None else f"Removes {params.sigma:.2f} pixels of blur, as chosen in Tune."
        self._method.visible = params is not None
        self._progress.show_tuned(self._tab.pending)

    def set_region(self, roi: Roi | None) -> None:
        """Take over a region that was drawn."""
        for number, value in zip(self._roi, roi or (None,) * 4, strict=True):
            number.value = value

    def take_over(self, order: Order) -> None:
        """Fill the fields by what a run had."""
        start, stop, _ = order.selection.frame_range() or (None, None, None)
        if start is not None and stop is not None:
            self._first.value, self._last.value = start, stop - 1
        self.set_region(order.selection.region())
        self._preset.value = order.preset
        self._astronomy.take_over(order)
        self._stacking.take_over(order.params)

    def order(self) -> Order:
        """Return what the fields say; the deconvolution is that of the last step.

        Raises
        ------
        ConfigurationError
            The region is not all given, a file lies outside the folders of the app, or a planet is not known.
        """
        clip = self._tab.clip
        assert clip is not None
        given = [number.value is not None for number in self._roi]
        require(all(given) or not any(given), "region: expected x, y, width and height, or none of them")
        roi = self._region()
        first, last = self._range()
        selection = Selection(
            frames=None if (first, last) == (0, len(clip.source)) else f"{first}:{last}",
            roi=None if roi is None or roi == (0, 0, *clip.size) else ",".join(map(str, roi)),
        )
        preset = self._preset.value
        params = self._tab.chosen(self._stacking.choose(PRESETS[preset]))
        return Order(clip.path, self._astronomy.select(selection), params, preset)

    def _region(self) -> Roi | None:
        """Return the region in the fields; None if they are not all filled."""
        values = [number.value for number in self._roi]
        if any(value is None for value in values):
            return None
        x, y, width, height = (int(value) for value in values if value is not None)
        return x, y, width, height

    def _range(self) -> tuple[int, int]:
        """Return the range of frames as ``--frames`` takes it, without the last one; empty fields mean either end."""
        clip = self._tab.clip
        most = 1 if clip is None else len(clip.source)
        first, last = self._first.value, self._last.value
        return int(first or 0), most if last is None else min(int(last) + 1, most)

    def _typed(self) -> None:
        self._whole.visible = any(number.value is not None for number in self._roi)
        self._on_region(self._region())

    def _ranged(self) -> None:
        first, last = self._range()
        self._count.text = counted(max(last - first, 0), "frame")
        self._stacking.show_range(first, last)

    def _start(self, begin: Callable[[Order], Job[object]]) -> None:
        with self._notices.catching():
            order = self.order()
            order.selection.frame_range()
            begin(order)
