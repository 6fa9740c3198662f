"""What astronomers choose: calibration, the colours of the sensor, and what an object does."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from nicegui import ui

from turbrestore.stacking.derotation import PLANETS, read_rotation
from turbrestore_cli.options import Selection

from ..tab import Tab

if TYPE_CHECKING:
    from ..restoring import Order

_PATTERNS = {None: "none, or as the file says", "rggb": "RGGB", "grbg": "GRBG", "gbrg": "GBRG", "bggr": "BGGR"}


class AstronomyView:
    """The panel below the range of the frames.

    Parameters
    ----------
    tab : Tab
    """

    def __init__(self, tab: Tab) -> None:
        self._tab = tab

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
            with ui.element("div").classes("fields"):
                self._turning = ui.input("Turn a planet back", placeholder="jupiter", autocomplete=list(PLANETS))
                self._turning.props("dense outlined stack-label").classes("grow")

    def opened(self) -> None:
        """Start without any of it."""
        self._dark.value = self._flat.value = self._turning.value = ""
        self._bayer.value, self._follow.value = None, False

    def select(self, selection: Selection) -> Selection:
        """Add to a region and a range of frames what is chosen here.

        Raises
        ------
        ConfigurationError
            A file lies outside the folders of the app, or a planet is not known.
        """
        folders, turning = self._tab.folders, (self._turning.value or "").strip() or None
        dark, flat = (
            str(folders.shown(folders.locate(field.value))) if (field.value or "").strip() else None
            for field in (self._dark, self._flat)
        )
        if turning is not None:
            read_rotation(turning)
        return dataclasses.replace(
            selection,
            dark=dark,
            flat=flat,
            bayer=self._bayer.value,
            crop_to_object=bool(self._follow.value),
            derotate=turning,
        )

    def take_over(self, order: Order) -> None:
        """Fill the fields by what a run had."""
        selection = order.selection
        self._dark.value, self._flat.value = selection.dark or "", selection.flat or ""
        self._bayer.value, self._follow.value = selection.bayer, selection.crop_to_object
        self._turning.value = selection.derotate or ""
