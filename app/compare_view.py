"""The images of the stages, two at a time, split by a divider as in the report."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING

import numpy as np
from nicegui import ui

from turbrestore.core.arrays import FloatArray
from turbrestore.display.preview import shrink
from turbrestore.report.comparison import comparison
from turbrestore.report.pictures import Gallery, Picture, stages

from .pictures import LONGEST

if TYPE_CHECKING:
    from .page import Page
    from .restoring import Restored

# Quantiles of the intensity that are black and white where the contrast is stretched.
_ENDS = (0.005, 0.995)
_TITLES = {
    "frame": "Frame",
    "mean": "Mean",
    "centroid": "Centroid",
    "filtered": "Filtered",
    "deblurred": "Deblurred",
    "result": "Result",
}


class CompareView:
    """Two images and a divider.

    Parameters
    ----------
    page : Page
    """

    def __init__(self, page: Page) -> None:
        self._page = page
        self.filled = False
        self._shown: Restored | None = None

    def build(self) -> None:
        """Make the elements."""
        with ui.element("div") as self.place:
            ui.html('<div id="compare"></div>', sanitize=False)
            self._stretch = ui.checkbox("Stretch the contrast, on this page alone", on_change=self._display).props(
                "dense"
            )
            self._stretch.visible = False
            self._note = ui.label("").classes("note")

    def clear(self) -> None:
        """Forget the images."""
        self.filled, self._shown = False, None
        self._stretch.visible = False
        ui.run_javascript('document.getElementById("compare").replaceChildren()')

    async def show(self, images: dict[str, FloatArray], note: str) -> None:
        """Show the images that there are, the last one on the right."""
        pictures = [await asyncio.to_thread(self._picture, key, images[key]) for key in _TITLES if key in images]
        markup = comparison(Gallery(tuple(pictures), "8 bits, lossless"))
        ui.run_javascript(f"turbrestore.compare({json.dumps(markup)})")
        self._note.text = note
        self.filled, self._shown = True, None
        self._page.look_at("compare")

    async def show_result(self, restored: Restored) -> None:
        """Show the stages of a run that has ended, cropped like its result."""
        found = restored.restoration
        height, width = found.image.shape[:2]
        whole = restored is self._page.tab.restored
        what = f"{width}×{height} pixels from {found.frame_count} frames in {sum(found.seconds.values()):.1f} s"
        note = what if whole else f"Preview of a part: {what}"
        await self.show(stages(found, restored.frame), note)
        self._shown = restored
        self._stretch.visible = True
        self._display()

    async def show_part(self, restored: Restored, part: tuple[slice, slice], image: FloatArray, note: str) -> None:
        """Put a part that was deblurred anew into the result that is shown."""
        if self._shown is not restored:
            await self.show_result(restored)
        x, y, width, height = restored.restoration.crop
        result = restored.restoration.image.copy()
        rows, columns = _within(part[0], y, height), _within(part[1], x, width)
        inside = tuple(
            slice(span.start + offset - whole.start, span.stop + offset - whole.start)
            for span, whole, offset in zip((rows, columns), part, (y, x), strict=True)
        )
        result[rows, columns] = image[inside]
        address = await asyncio.to_thread(self._page.tab.pictures.put, result)
        ui.run_javascript(f'turbrestore.replace("result", {json.dumps(address)})')
        self._note.text = note

    async def middle(self) -> tuple[float, float]:
        """Return the point of the result in the middle of what is seen, as shares of its width and height."""
        try:
            x, y = await ui.run_javascript("turbrestore.middle()", timeout=2.0)
        except TimeoutError:
            return 0.5, 0.5
        return float(x), float(y)

    def _display(self) -> None:
        """Stretch the contrast of what is shown, or not."""
        style = "none"
        if self._stretch.value and self._shown is not None:
            low, high = (float(value) for value in np.quantile(self._shown.restoration.image, _ENDS))
            slope = 1 / max(high - low, 1 / 255)
            contrast = 1 + 2 * low * slope
            style = f"brightness({slope / contrast:.4f}) contrast({contrast:.4f})"
        ui.run_javascript(f'document.getElementById("compare").style.setProperty("--display", "{style}")')

    def _picture(self, key: str, image: FloatArray) -> Picture:
        height, width = shrink(image, LONGEST).shape[:2]
        return Picture(key, _TITLES[key], self._page.tab.pictures.put(image), width, height)


def _within(span: slice, offset: int, size: int) -> slice:
    """Rows or columns of the frame as those of the cropped image."""
    return slice(max(span.start - offset, 0), min(span.stop - offset, size))
