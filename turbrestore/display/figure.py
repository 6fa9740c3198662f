"""The common look of all figures: size, colours, axes.

Figures have a transparent background and use colours that are readable on white and on black. They are made without
pyplot, so that nothing accumulates and no window opens; notebooks show them as they are. Needs matplotlib, the extra
``report``.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

from ..core.extras import missing_package

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

# Colours of text and axes, of the data that is shown, and of the data it is compared with.
INK, ACCENT, REST = "#747c87", "#1786a6", "#a3abb5"
# Size of a single plot, inches; font size, points; all chosen.
WIDTH, HEIGHT = 4.6, 2.9
FONT = 8.5


def new_figure(width: float = WIDTH, height: float = HEIGHT) -> Figure:
    """Make an empty figure with a transparent background, which notebooks show as SVG."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_package("plot", "matplotlib", "plot") from error

    class _NotebookFigure(Figure):
        # Without this method notebooks show only the figures of pyplot.
        def _repr_svg_(self) -> str:
            buffer = io.StringIO()
            self.savefig(buffer, format="svg")
            return buffer.getvalue()

    return _NotebookFigure(figsize=(width, height), layout="constrained", facecolor="none")


def add_axes(
    figure: Figure, title: str = "", x: str = "", y: str = "", place: tuple[int, int, int] | SubplotSpec = (1, 1, 1)
) -> Axes:
    """Axes with a light grid; ``place`` is rows, columns and number, as matplotlib counts subplots, or of a grid."""
    axes = figure.add_subplot(*(place if isinstance(place, tuple) else (place,)), facecolor="none")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(REST)
    axes.tick_params(colors=INK, labelsize=FONT, color=REST)
    axes.grid(color=REST, alpha=0.25, linewidth=0.6)
    axes.set_axisbelow(True)
    set_labels(axes, title, x, y)
    return axes


def set_labels(axes: Axes, title: str, x: str, y: str) -> None:
    """Title at the left, and names of both axes."""
    axes.set_title(title, color=INK, fontsize=FONT + 1, loc="left")
    axes.set_xlabel(x, color=INK, fontsize=FONT)
    axes.set_ylabel(y, color=INK, fontsize=FONT)


def use_integer_ticks(axes: Axes) -> None:
    """Put the ticks of the horizontal axis at integers."""
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True, min_n_ticks=1))


def write_instead(figure: Figure, axes: Axes, text: str) -> Figure:
    """Put a sentence where there is no data to plot."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=INK, fontsize=FONT)
    axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    return figure
