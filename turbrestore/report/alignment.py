"""The same margins for all figures of a page, so that their axes line up from row to row and from column to column."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..display.figure import WIDTH

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Inches: margins; height of figures with curves, room above a row that has a title, and place of the vertical label.
_LEFT, _RIGHT, _BOTTOM, _TOP = 0.68, 0.1, 0.46, 0.1
_HEIGHT, _TITLED, _LABEL = 3.2, 0.3, 0.12
# Inches: room on the right of a map for its colour bar, gap before the bar, and its width.
_MAP_RIGHT, _GAP, _BAR = 0.6, 0.1, 0.13


def take_title(figure: Figure) -> str:
    """Remove the title of a figure with one plot and return it; rows keep their titles."""
    titled = [axes for axes in figure.axes if axes.get_title(loc="left")]
    if len(titled) != 1:
        return ""
    title = titled[0].get_title(loc="left")
    titled[0].set_title("", loc="left")
    return title


def align_curves(figure: Figure) -> None:
    """Give a figure of one or more rows of curves the height and the margins of all others."""
    figure.set_layout_engine(None)
    figure.set_size_inches(WIDTH, _HEIGHT)
    rows = len(figure.axes)
    above = _TITLED if any(axes.get_title(loc="left") for axes in figure.axes) else _TOP
    each = (_HEIGHT - _BOTTOM - above - (rows - 1) * _TITLED) / rows
    figure.subplots_adjust(
        left=_LEFT / WIDTH,
        right=1 - _RIGHT / WIDTH,
        bottom=_BOTTOM / _HEIGHT,
        top=1 - above / _HEIGHT,
        hspace=_TITLED / each,
    )
    for axes in figure.axes:
        # Axes of equal scale would be narrow and in the middle.
        axes.set_anchor("SW")
        axes.yaxis.set_label_coords((_LABEL - _LEFT) / (WIDTH - _LEFT - _RIGHT), 0.5)


def align_map(figure: Figure) -> None:
    """Give a map and its colour bar the margins of all other maps; the figure is as high as the map needs."""
    axes, *bars = figure.axes
    figure.set_layout_engine(None)
    left, right, bottom, top = axes.images[0].get_extent()
    width = WIDTH - _LEFT - _MAP_RIGHT
    # A map that would be higher than two widths keeps its shape in a narrower place.
    height = width * min(abs((bottom - top) / (right - left)), 2.0)
    whole = height + _BOTTOM + _TOP
    figure.set_size_inches(WIDTH, whole)
    axes.set_position((_LEFT / WIDTH, _BOTTOM / whole, width / WIDTH, height / whole))
    for bar in bars:
        start = _LEFT + width + _GAP
        bar.set_box_aspect(height / _BAR)
        bar.set_position((start / WIDTH, _BOTTOM / whole, _BAR / WIDTH, height / whole))
