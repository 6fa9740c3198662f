"""The frames of the clip: a scrubber, and the region that is drawn on them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from nicegui import events, ui

from turbrestore.core.arrays import FloatArray
from turbrestore.display.preview import data_uri, encode_image
from turbrestore.report.pictures import shown_range, to_levels

from ..clip import LOOKED_THROUGH
from ..job import one_line
from ..pictures import LONGEST
from ..tab import Tab
from .elements import Notices, in_thread, set_most

if TYPE_CHECKING:
    from turbrestore.io.source import Roi

    from ..clip import Clip

# Smaller rectangles are clicks, pixels of the clip.
_SMALLEST = 16
# Frames of the strip, and their longest side, pixels.
_IN_STRIP, _SMALL = 8, 160


class ClipView:
    """One frame, a scrubber under it, and a rectangle that is drawn with mouse, pen or finger.

    Parameters
    ----------
    tab : Tab
    notices : Notices
    on_region : callable
        Called with the region that was drawn, or None.
    """

    def __init__(self, tab: Tab, notices: Notices, on_region: Callable[[Roi | None], None]) -> None:
        self._tab, self._notices, self._on_region = tab, notices, on_region
        # Intensities that are shown black and white.
        self._levels = (0.0, 1.0)
        self._roi: Roi | None = None
        self._from: tuple[float, float] | None = None
        self._wanted, self._shown, self._busy = 0, -1, False

    def build(self) -> None:
        """Make the elements."""
        with ui.element("div").classes("place") as self.place:
            with ui.element("div").classes("clip") as self._frame:
                self._image = (
                    ui.interactive_image(
                        on_mouse=self._pointed, events=["pointerdown", "pointermove", "pointerup"], sanitize=False
                    )
                    .props("id=frame")
                    .classes("picture")
                )
                self._image.visible = False
            self._strip = ui.element("div").classes("strip").props('role=group aria-label="Frames of the clip"')
            with ui.element("div").classes("fields") as self._below:
                ui.label("Frame").classes("what")
                self._scrubber = ui.slider(min=0, max=1, value=0, on_change=self._scrubbed).classes("grow")
                self._scrubber.props('aria-label="Frame"')
                self._number = ui.label("0").classes("value")
            self._hint = ui.label("").classes("note")
            self._below.visible = self._hint.visible = False

    async def opened(self) -> None:
        """Show the middle frame of a clip."""
        clip = self._tab.clip
        assert clip is not None
        width, height = clip.size
        middle = len(clip.source) // 2
        self._levels = shown_range(await in_thread(clip.frame, middle))
        brighter = "" if self._levels == (0, 1) else f" Shown brighter: white is {self._levels[1]:.3g} of full scale."
        self._hint.text = f"Drag a rectangle to restore that part alone; a click removes it.{brighter}"
        # The frame is not wider than its height on the page allows.
        self._frame.style(f"--ratio: {width / height}")
        self._image.visible = self._below.visible = self._hint.visible = True
        set_most(self._scrubber, len(clip.source) - 1)
        ui.run_javascript('document.querySelector("#frame img").alt = "Frame of the clip"')
        self._shown = -1
        self._scrubber.value = middle
        await self._show(middle)
        await self._fill_strip(clip)

    async def _fill_strip(self, clip: Clip) -> None:
        """Show small frames of all times; each leads to its frame."""
        self._strip.clear()
        if len(clip.source) > LOOKED_THROUGH:
            return
        pictures = await in_thread(_thumbnails, clip, self._levels)
        if clip is not self._tab.clip:
            return
        with self._strip:
            for number, picture in pictures.items():
                button = ui.button(on_click=partial(self._scrubber.set_value, number)).props("flat dense")
                with button.props(f'aria-label="Frame {number}"'):
                    ui.html(f'<img src="{picture}" alt="">', sanitize=False)

    def draw(self, roi: Roi | None) -> None:
        """Draw the region, or none."""
        self._roi = roi
        clip = self._tab.clip
        if roi is None or clip is None:
            self._image.content = ""
            return
        scale = self._scale()
        x, y, width, height = (value / scale for value in roi)
        whole = f"M0 0H{clip.size[0] / scale:g}V{clip.size[1] / scale:g}H0Z"
        hole = f"M{x:g} {y:g}v{height:g}h{width:g}v{-height:g}Z"
        self._image.content = (
            f'<path d="{whole}{hole}" fill="#000" fill-opacity=".45" fill-rule="evenodd"/>'
            f'<path d="{hole}" fill="none" stroke="#fff" stroke-width="2" vector-effect="non-scaling-stroke"/>'
        )

    def _scale(self) -> float:
        """Pixels of the clip for one of the picture."""
        clip = self._tab.clip
        return 1.0 if clip is None else max(max(clip.size) / LONGEST, 1.0)

    def _pointed(self, event: events.MouseEventArguments) -> None:
        x, y = event.image_x, event.image_y
        if event.type == "pointerdown":
            self._from = x, y
        elif self._from is not None:
            roi = self._rectangle(self._from, (x, y))
            if event.type == "pointerup" or not event.buttons:
                self._from = None
                self._on_region(roi)
            self.draw(roi)

    def _rectangle(self, one: tuple[float, float], two: tuple[float, float]) -> Roi | None:
        """Return the rectangle between two points of the picture, in pixels of the clip."""
        clip = self._tab.clip
        assert clip is not None
        scale = self._scale()
        (left, right), (top, bottom) = (
            sorted(min(max(round(value * scale), 0), size) for value in ends)
            for ends, size in zip(zip(one, two, strict=True), clip.size, strict=True)
        )
        if min(right - left, bottom - top) < _SMALLEST:
            return None
        return left, top, right - left, bottom - top

    async def _scrubbed(self, event: events.ValueChangeEventArguments) -> None:
        if event.value is not None:
            await self._show(int(event.value))

    async def _show(self, number: int) -> None:
        """Show a frame; of those that are asked for while one is decoded, the last."""
        clip = self._tab.clip
        self._number.text = str(number)
        self._wanted = number
        if clip is None or self._busy:
            return
        self._busy = True
        try:
            while self._shown != self._wanted:
                number = self._wanted
                image = await in_thread(clip.frame, number)
                self._image.set_source(await in_thread(self._tab.pictures.put, image, self._levels, "frame"))
                self._shown = number
        except Exception as error:
            self._notices.tell(one_line(error))
        finally:
            self._busy = False


def _small(frame: FloatArray, levels: tuple[float, float]) -> str:
    return data_uri(encode_image(to_levels(frame, *levels, _SMALL)))


def _thumbnails(clip: Clip, levels: tuple[float, float]) -> dict[int, str]:
    """Encode small frames, by their numbers."""
    count = len(clip.source)
    step = max(1, -(-count // _IN_STRIP))
    return {start: _small(clip.frame(start), levels) for start in range(step // 2, count, step)}
