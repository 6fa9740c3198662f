"""The same margins for all figures of a page, so that their axes line up from row to row and from column to column."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..display.figure import WIDTH

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Inches: room for labels on the left and below, margins and gaps elsewhere, height of figures with curves, room above a
# row that has a title, and on the right of a map for its colour bar; all chosen.
_LEFT, _BOTTOM, _MARGIN, _HEIGHT, _TITLED, _MAP_RIGHT = 0.68, 0.46, 0.1, 3.2, 0.3, 0.6


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
    above = _TITLED if any(axes.get_title(loc="left") for axes in figure.axes) else _MARGIN
    each = (_HEIGHT - _BOTTOM - above - (rows - 1) * _TITLED) / rows
    figure.subplots_adjust(
        left=_LEFT / WIDTH,
        right=1 - _MARGIN / WIDTH,
        bottom=_BOTTOM / _HEIGHT,
        top=1 - above / _HEIGHT,
        hspace=_TITLED / each,
    )
    for axes in figure.axes:
        # Axes of equal scale would be narrow and in the middle.
        axes.set_anchor("SW")
        axes.yaxis.set_label_coords((_MARGIN - _LEFT) / (WIDTH - _LEFT - _MARGIN), 0.5)


def align_map(figure: Figure) -> None:
    """Give a map and its colour bar the margins of all other maps; the figure is as high as the map needs."""
    axes, *bars = figure.axes
    figure.set_layout_engine(None)
    left, right, bottom, top = axes.images[0].get_extent()
    width = WIDTH - _LEFT - _MAP_RIGHT
    # A map that would be higher than two widths keeps its shape in a narrower place.
    height = width * min(abs((bottom - top) / (right - left)), 2.0)
    whole = height + _BOTTOM + _MARGIN
    figure.set_size_inches(WIDTH, whole)
    axes.set_position((_LEFT / WIDTH, _BOTTOM / whole, width / WIDTH, height / whole))
    for bar in bars:
        start = _LEFT + width + _MARGIN
        bar.set_box_aspect(height / _MARGIN)
        bar.set_position((start / WIDTH, _BOTTOM / whole, _MARGIN / WIDTH, height / whole))
