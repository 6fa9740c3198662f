"""What the witnesses of a blur say: the widths that each allows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .figure import ACCENT, INK, add_axes, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_witnesses(widths: Mapping[str, ArrayLike], removed: float) -> Figure:
    """Draw the 16 %, 50 % and 84 % quantiles of the width by each witness, pixels, and the width that is removed."""
    figure = new_figure()
    axes = add_axes(figure, "Blur: what each witness says, and what is removed", "width σ, pixels", "")
    for place, quantiles in enumerate(np.asarray(found, float) for found in widths.values()):
        low, middle, high = quantiles
        axes.plot([low, high], [place, place], color=ACCENT, linewidth=5, alpha=0.35, solid_capstyle="butt")
        axes.plot([middle], [place], color=ACCENT, marker="o", markersize=5)
    if removed > 0:
        axes.axvline(removed, color=INK, linewidth=0.9, linestyle="--")
    axes.set_yticks(range(len(widths)), list(widths))
    axes.set_ylim(len(widths) - 0.5, -0.5)
    axes.set_xlim(left=0)
    return figure
