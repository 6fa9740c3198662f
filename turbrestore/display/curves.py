"""Curves over iterations, frames and widths of the blur: arrays in, a matplotlib figure out.

Symbol: σ is the width of a blur.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .figure import ACCENT, FONT, INK, WIDTH, add_axes, new_figure, use_integer_ticks, write_instead

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Largest number of points along a curve over the frames, chosen.
_POINTS = 600


def plot_convergence(mean_flow_sizes: ArrayLike, tolerance: float | None = None) -> Figure:
    """Show the length of the mean flow in every iteration of the centroid.

    ``mean_flow_sizes`` (iterations,).
    """
    sizes = np.asarray(mean_flow_sizes, float)
    figure = new_figure()
    axes = add_axes(figure, "Centroid: remaining mean flow in each iteration", "iteration", "pixels")
    steps = np.arange(1, sizes.size + 1)
    axes.plot(steps, sizes, color=ACCENT, marker="o", markersize=4, linewidth=1.4)
    if tolerance is not None:
        axes.axhline(tolerance, color=INK, linewidth=0.9, linestyle="--")
        axes.text(0.99, tolerance, "tolerance", transform=axes.get_yaxis_transform(), ha="right", va="bottom",
                  color=INK, fontsize=FONT)  # fmt: skip
    axes.set_ylim(bottom=0)
    axes.set_xlim(0.6, sizes.size + 0.4)
    use_integer_ticks(axes)
    return figure


def plot_frames(sharpness: ArrayLike, shares: ArrayLike) -> Figure:
    """Show how sharp each frame is, and how much weight it has.

    ``sharpness`` (N,); ``shares`` (N,).
    """
    weights = np.asarray(shares, float)
    return plot_over_frames({"Sharpness": sharpness, "Share of the result, 1 = equal": weights * weights.size}, 1.0)


def plot_over_frames(rows: Mapping[str, ArrayLike], reference: float | None = None) -> Figure:
    """Show values of every frame, a row of the figure for each kind; long curves show means of neighbouring frames.

    ``rows`` (N,).
    """
    figure = new_figure(WIDTH, WIDTH * 0.42 * len(rows))
    for number, (title, row) in enumerate(rows.items(), 1):
        values, last = np.asarray(row, float), number == len(rows)
        axes = add_axes(figure, title, "frame" if last else "", place=(len(rows), 1, number))
        edges = np.arange(0, values.size, -(-values.size // _POINTS) or 1)
        means = _bin_means(values, edges)
        axes.plot(edges, means, color=ACCENT, linewidth=1.2, marker="o" if values.size <= 60 else None, markersize=2.5)
        axes.set_ylim(bottom=0)
        # Drawn within the limits of the curve.
        if reference is not None:
            axes.axhline(reference, color=INK, linewidth=0.9, linestyle="--")
        use_integer_ticks(axes)
        if not last:
            axes.tick_params(labelbottom=False)
    return figure


def plot_objective(recorded: ArrayLike, objective: ArrayLike) -> Figure:
    """Show the energy that the deconvolution minimises, over the iterations.

    ``recorded`` (n,); ``objective`` (n,).
    """
    figure = new_figure()
    axes = add_axes(figure, "Deconvolution: energy", "iteration", "")
    energy = np.asarray(objective, float)
    if energy.size == 0:
        return write_instead(figure, axes, "no blur was removed, so there were no iterations")
    axes.plot(np.asarray(recorded), energy, color=ACCENT, linewidth=1.4, marker="o", markersize=3)
    return figure


def plot_blur(widths: ArrayLike, costs: ArrayLike, sigma: float, uncertainty: float) -> Figure:
    """Show the likelihood of every blur width that was tried, and the estimated width.

    ``widths`` (k,); ``costs`` (k,).
    """
    figure = new_figure()
    axes = add_axes(figure, "Blur: cost of every width that was tried", "width σ, pixels", "−log likelihood − minimum")
    tried, cost = np.asarray(widths, float), np.asarray(costs, float)
    if tried.size == 0:
        return write_instead(figure, axes, "the blur could not be estimated from this image")
    axes.plot(tried, cost - cost.min(), color=ACCENT, linewidth=1.4, marker="o", markersize=3.5)
    axes.axvline(sigma, color=INK, linewidth=0.9, linestyle="--")
    if np.isfinite(uncertainty):
        axes.axvspan(sigma - uncertainty, sigma + uncertainty, color=ACCENT, alpha=0.15, linewidth=0)
    axes.set_ylim(bottom=0)
    return figure


def _bin_means(values: NDArray[np.float64], edges: NDArray[Any]) -> NDArray[np.float64]:
    """Mean of the finite values of each bin; NaN where there are none."""
    if values.size == 0:
        return values
    known = np.isfinite(values)
    counts = np.add.reduceat(known.astype(float), edges)
    sums = np.add.reduceat(np.where(known, values, 0.0), edges)
    return np.divide(sums, counts, out=np.full(counts.shape, np.nan), where=counts > 0)
