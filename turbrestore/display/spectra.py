"""Signal and noise of an image, singular values and eigenvalues of the flow model: arrays in, a figure out.

Symbols: ξ and C are states and modes of the flow, A the transition, τ the number of flows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .figure import ACCENT, FONT, HEIGHT, INK, REST, WIDTH, add_axes, new_figure, set_labels, use_integer_ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Singular values below this share of the largest are rounding errors; chosen.
_ROUNDING = 1e-5


def plot_signal(frequencies: ArrayLike, signal: ArrayLike, noise: ArrayLike, limit: float) -> Figure:
    """Show the power of signal and noise over the frequency, cycles per pixel, and up to where the signal is stronger.

    ``frequencies``, ``signal``, ``noise`` (k,).
    """
    figure = new_figure()
    axes = add_axes(figure, "Signal and noise: what the clip tells", "frequency, cycles per pixel", "power")
    nu, of_noise = np.asarray(frequencies, float), np.asarray(noise, float)
    least = 0.1 * float(of_noise.min())
    axes.axvspan(0, limit, color=ACCENT, alpha=0.12, linewidth=0)
    axes.plot(nu, np.maximum(np.asarray(signal, float), least), color=ACCENT, linewidth=1.4, label="signal")
    axes.plot(nu, of_noise, color=INK, linewidth=1.2, linestyle="--", label="noise")
    axes.set_yscale("log")
    axes.set_ylim(bottom=least)
    axes.set_xlim(0, nu[-1])
    axes.legend(frameon=False, fontsize=FONT, labelcolor=INK)
    return figure


def plot_singular_values(singular_values: ArrayLike, rank: int) -> Figure:
    """Show the singular values of the flows, with those of the chosen states marked.

    ``singular_values`` (τ,).
    """
    figure = new_figure()
    _draw_singular_values(add_axes(figure), np.asarray(singular_values, float), rank)
    return figure


def plot_eigenvalues(eigenvalues: ArrayLike) -> Figure:
    """Show the eigenvalues of the transition matrix and the unit circle (paper 3, Figure 7).

    ``eigenvalues`` (n,).
    """
    figure = new_figure(WIDTH, WIDTH * 0.84)
    _draw_eigenvalues(add_axes(figure), np.asarray(eigenvalues, complex))
    return figure


def plot_dynamics(singular_values: ArrayLike, eigenvalues: ArrayLike) -> Figure:
    """Show the singular values of the flows beside the eigenvalues of the transition matrix.

    ``singular_values`` (τ,); ``eigenvalues`` (n,).
    """
    figure = new_figure(2 * WIDTH, HEIGHT * 1.2)
    values = np.asarray(eigenvalues, complex)
    _draw_singular_values(add_axes(figure, place=(1, 2, 1)), np.asarray(singular_values, float), values.size)
    _draw_eigenvalues(add_axes(figure, place=(1, 2, 2)), values)
    return figure


def plot_prediction(
    lengths: ArrayLike,
    ranks: ArrayLike,
    errors: ArrayLike,
    eigenvalues: Sequence[Sequence[ArrayLike]],
    baselines: Mapping[str, float],
) -> Figure:
    """Show the error of one-step prediction over τ for each n, and eigenvalues of A for each τ (paper 3, Figure 7).

    ``lengths`` (a,); ``ranks`` (b,); ``errors`` (a, b).
    """
    taus, values = np.asarray(lengths), np.asarray(errors, float)
    columns = len(taus)
    figure = new_figure(0.55 * WIDTH * columns, 2.1 * HEIGHT)
    grid = figure.add_gridspec(2, columns, height_ratios=(1.25, 1))
    axes = add_axes(figure, "One-step prediction of flows that were not trained on", "τ", "error, pixels", grid[0, :])
    count = len(np.asarray(ranks))
    for number, rank in enumerate(np.asarray(ranks)):
        axes.plot(taus, values[:, number], color=ACCENT, alpha=0.3 + 0.7 * (number + 1) / count, linewidth=1.4,
                  marker="os^Dv"[number % 5], markersize=4, label=f"n = {rank}")  # fmt: skip
    for style, (name, error) in zip(("--", ":", "-."), baselines.items(), strict=False):
        axes.axhline(error, color=INK, linewidth=0.9, linestyle=style, label=name)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=FONT, frameon=False, labelcolor=INK, loc="center left", bbox_to_anchor=(1.0, 0.5))
    use_integer_ticks(axes)
    for number, (tau, of_length) in enumerate(zip(taus, eigenvalues, strict=True)):
        found = np.asarray(of_length[-1] if of_length else [], complex)
        panel = add_axes(figure, place=grid[1, number])
        _draw_eigenvalues(panel, found)
        set_labels(panel, f"τ = {tau}, n = {found.size}", "real part", "imaginary part" if number == 0 else "")
    return figure


def _draw_singular_values(axes: Axes, values: NDArray[np.float64], rank: int) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    set_labels(axes, f"Singular values of the flows: {rank} of {values.size} kept", "number", "pixels")
    # The mean is subtracted, so the last value is zero up to rounding, which would stretch the logarithmic axis.
    shown = np.flatnonzero(values > _ROUNDING * values.max(initial=0.0))
    kept = shown[shown < rank]
    left_out = shown[shown >= rank]
    axes.plot(left_out + 1, values[left_out], linestyle="none", marker="o", markersize=3.5, color=REST)
    axes.plot(kept + 1, values[kept], linestyle="none", marker="o", markersize=3.5, color=ACCENT)
    if 0 < rank < values.size:
        axes.axvline(rank + 0.5, color=INK, linewidth=0.9, linestyle="--")
    if shown.size:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_ylim(bottom=values[shown].min() * 0.7)
    use_integer_ticks(axes)


def _draw_eigenvalues(axes: Axes, values: NDArray[np.complex128]) -> None:
    from matplotlib.patches import Circle

    set_labels(axes, "Eigenvalues of the transition matrix", "real part", "imaginary part")
    axes.add_patch(Circle((0, 0), 1, fill=False, edgecolor=INK, linewidth=0.9))
    axes.plot(values.real, values.imag, linestyle="none", marker="o", markersize=4, color=ACCENT, alpha=0.85)
    limit = 1.1 * max(1.0, float(np.abs(values).max(initial=0.0)))
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
    axes.set(xticks=[-1, -0.5, 0, 0.5, 1], yticks=[-1, -0.5, 0, 0.5, 1])
