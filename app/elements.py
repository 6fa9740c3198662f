"""What several parts of the page need of NiceGUI's elements."""

from __future__ import annotations

from nicegui import ui


def set_most(slider: ui.slider | ui.range, most: float) -> None:
    """Set the largest value of a slider, before its value."""
    slider.props["max"] = most
    slider.update()
