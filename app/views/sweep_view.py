"""Widths of the blur side by side: a part of the image, deblurred by each; a press chooses one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from html import escape

from nicegui import ui

from turbrestore.core.arrays import FloatArray
from turbrestore.core.remarks import counted
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.display.preview import data_uri, encode_image
from turbrestore.report.pictures import shown_range, to_levels

from ..restoring import Restored
from ..tab import Tab
from ..tuning import sweep
from .elements import in_thread


class SweepView:
    """The contact sheet of ``turbrestore deconvolve --sweep``.

    Parameters
    ----------
    tab : Tab
    on_show : callable
        Called when there is something new to be looked at.
    on_choose : callable
        Called with the width that was chosen.
    """

    def __init__(self, tab: Tab, on_show: Callable[[], None], on_choose: Callable[[float], None]) -> None:
        self._tab, self._on_show, self._on_choose = tab, on_show, on_choose
        self.filled = False
        self._number = 0

    def build(self) -> None:
        """Make the elements."""
        with ui.element("div").classes("place") as self.place:
            self._sheet = ui.element("div").classes("sheet").props('role=group aria-label="Widths of the blur"')
            self._note = ui.label("").classes("note").props("role=status")

    def clear(self) -> None:
        """Discard the images."""
        self._number += 1
        self.filled = False
        self._sheet.clear()

    async def show(self, restored: Restored, params: DeconvolutionParams, widths: tuple[float, ...]) -> None:
        """Fill the sheet one width after the other, until another sheet or another run is asked for."""
        self.clear()
        number, levels, begun = self._number, None, asyncio.get_running_loop().time()
        images = sweep(restored, params, widths)
        for count, width in enumerate((0.0, *widths)):
            panel = await in_thread(next, images, None)
            if panel is None or number != self._number or self._tab.closed or self._tab.restored is not restored:
                return
            title, image = panel
            levels = levels or shown_range(image)
            with self._sheet:
                self._add(title, image, width, levels)
            seconds = asyncio.get_running_loop().time() - begun
            self._note.text = f"{count} of {counted(len(widths), 'width')} in {seconds:.1f} s. Press one to choose it."
            if not self.filled:
                self.filled = True
                self._on_show()

    def _add(self, title: str, image: FloatArray, width: float, levels: tuple[float, float]) -> None:
        button = ui.button(on_click=partial(self._on_choose, width)).props("flat")
        with button.props(f'aria-label="{escape(title)}"'):
            source = data_uri(encode_image(to_levels(image, *levels)))
            ui.html(f'<img src="{source}" alt=""><div class="words">{escape(title)}</div>', sanitize=False)
