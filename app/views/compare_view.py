"""The images of the stages, two at a time, split by a divider as in the report."""

from __future__ import annotations

import json
from collections.abc import Callable

from nicegui import ui

from turbrestore.core.arrays import FloatArray
from turbrestore.report.comparison import comparison
from turbrestore.report.pictures import Gallery, Picture, shown_range, stages, stretch_of, to_levels

from ..pictures import LONGEST
from ..restoring import Restored
from ..tab import Tab
from .elements import in_thread

_TITLES = {
    "frame": "Frame",
    "mean": "Mean",
    "centroid": "Centroid",
    "filtered": "Filtered",
    "deblurred": "Deblurred",
    "finer": "Finer",
    "result": "Result",
}


class CompareView:
    """Two images and a divider.

    Parameters
    ----------
    tab : Tab
    on_show : callable
        Called when there is something new to be looked at.
    """

    def __init__(self, tab: Tab, on_show: Callable[[], None]) -> None:
        self._tab, self._on_show = tab, on_show
        self.filled = False
        self._shown: Restored | None = None
        # Intensities that are shown black and white.
        self._levels = (0.0, 1.0)

    def build(self) -> None:
        """Make the elements."""
        with ui.element("div").classes("place") as self.place:
            ui.html('<div id="compare" class="player"></div>', sanitize=False).classes("holder")
            self._note = ui.label("").classes("note")

    def clear(self) -> None:
        """Discard the images."""
        self.filled, self._shown = False, None
        ui.run_javascript('turbrestore.fill("compare", "")')

    async def show(self, images: dict[str, FloatArray], note: str) -> None:
        """Show the images that there are, the last one on the right."""
        clip, known = self._tab.clip, [key for key in _TITLES if key in images]
        self._levels = await in_thread(shown_range, images[known[-1]])
        pictures = [await in_thread(self._picture, key, images[key]) for key in known]
        stretch = stretch_of(await in_thread(to_levels, images[known[-1]], *self._levels))
        # Another clip may have been opened meanwhile.
        if clip is not self._tab.clip:
            return
        low, high = self._levels
        scale = "" if (low, high) == (0, 1) else f", black is {low:.4g} and white {high:.4g} of full scale"
        markup = comparison(Gallery(tuple(pictures), f"8 bits{scale}", stretch))
        ui.run_javascript(f'turbrestore.fill("compare", {json.dumps(markup)})')
        self._note.text = note
        self.filled, self._shown = True, None
        self._on_show()

    async def show_result(self, restored: Restored) -> None:
        """Show the stages of a run that has ended, cropped like its result."""
        found = restored.restoration
        height, width = found.image.shape[:2]
        whole = restored is self._tab.restored
        what = f"{width}×{height} pixels from {found.frame_count} frames in {sum(found.seconds.values()):.1f} s"
        note = what if whole else f"Preview of a part: {what}. Run restores the whole, which can be tuned and saved"
        images = stages(found, restored.frame)
        if found.finer is not None:
            images["finer"] = found.finer
            note += f"; the finer image, of {found.finer.shape[1]}×{found.finer.shape[0]}, is what is saved"
        await self.show(images, note)
        self._shown = restored

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
        address = await in_thread(self._tab.pictures.put, result, self._levels, "part")
        ui.run_javascript(f'turbrestore.replace("result", {json.dumps(address)})')
        self._note.text = note

    async def middle(self) -> tuple[float, float]:
        """Return the point of the result in the middle of what is seen, as shares of its width and height."""
        try:
            x, y = await ui.run_javascript("turbrestore.middle()", timeout=2.0) or (0.5, 0.5)
        except TimeoutError:
            return 0.5, 0.5
        return float(x), float(y)

    def _picture(self, key: str, image: FloatArray) -> Picture:
        scale = min(LONGEST / max(image.shape[:2]), 1.0)
        height, width = (max(round(side * scale), 1) for side in image.shape[:2])
        return Picture(key, _TITLES[key], self._tab.pictures.put(image, self._levels), width, height)


def _within(span: slice, offset: int, size: int) -> slice:
    """Rows or columns of the frame as those of the cropped image."""
    return slice(max(span.start - offset, 0), min(span.stop - offset, size))
