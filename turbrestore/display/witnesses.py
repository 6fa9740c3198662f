"""What the witnesses of a blur say: the widths that each allows, and the curves over frequency."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .figure import ACCENT, INK, add_axes, new_figure, write_instead

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Least and largest variation that are drawn.
_LEAST, _MOST = 1e-4, 10.0


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


def plot_transfer(frequencies: ArrayLike, curves: Mapping[str, ArrayLike], removed: ArrayLike) -> Figure:
    """Draw the transfer function by the posterior (``mean``, ``lowest``, ``highest``), and the one that is removed."""
    figure = new_figure()
    axes = add_axes(figure, "Blur: contrast that is left", "frequency, cycles per pixel", "transfer function")
    nu = np.asarray(frequencies, float)
    low, mean, high = (np.asarray(curves[name], float) for name in ("lowest", "mean", "highest"))
    axes.fill_between(nu, low, high, color=ACCENT, alpha=0.2, linewidth=0)
    axes.plot(nu, mean, color=ACCENT, linewidth=1.4)
    axes.plot(nu, np.asarray(removed, float), color=INK, linewidth=0.9, linestyle="--")
    axes.set_ylim(0, 1.02)
    axes.set_xlim(0, nu[-1])
    return figure


def plot_variation(frequencies: ArrayLike, rows: Mapping[str, tuple[ArrayLike, ArrayLike, ArrayLike]]) -> Figure:
    """Draw measured variation, its error and what is expected of it, by name; NaN is left out."""
    figure = new_figure()
    axes = add_axes(figure, "Blur: how much the frames vary", "frequency, cycles per pixel", "relative variance")
    nu = np.asarray(frequencies, float)
    drawn = False
    for number, (name, columns) in enumerate(rows.items()):
        value, error, expected = (np.asarray(column, float) for column in columns)
        seen = np.isfinite(value) & (value > np.maximum(error, _LEAST)) & (value < _MOST)
        color = (ACCENT, INK)[number % 2]
        bars = np.stack([np.minimum(error, value * 0.9), error])[:, seen]
        axes.errorbar(nu[seen], value[seen], bars, color=color, marker="o", markersize=3, linewidth=0, elinewidth=0.8)
        if seen.any():
            axes.plot(nu, np.clip(expected, _LEAST, _MOST), color=color, linewidth=1.2, label=name)
            drawn = True
    if not drawn:
        return write_instead(figure, axes, "the frames hardly vary")
    axes.set_yscale("log")
    axes.legend(frameon=False, fontsize="small")
    return figure
