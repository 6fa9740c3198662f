"""Figures of what the stages find: plain arrays in, a matplotlib figure out.

Figures have no ground of their own and use colours that read on white and on black.  They are made without pyplot, so
nothing piles up and no window opens; notebooks show them as they are.  Needs matplotlib, the extra ``report``.

Symbols: ξ and C are states and modes of the flow, A the transition, σ the width of a blur, τ the number of flows.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import FloatArray, check_flow, check_image, luminance
from ..core.errors import ConfigurationError, DataError
from ..runtime.scratch import iter_frames, variance_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

# Text and axes, what is shown, what it is compared with.
INK, ACCENT, REST = "#747c87", "#1786a6", "#a3abb5"
_WIDTH, _HEIGHT = 4.6, 2.9
_FONT = 8.5
# Longest side of a map, pixels; vectors along it; most points along a curve of frames.
_MAP_SIDE, _VECTORS, _POINTS = 320, 20, 600
# How strongly the image shows through a map; share of it that its colours and vectors are scaled to.
_UNDERLAY = 0.35
_SCALED_TO = 0.99
# Singular values below this share of the largest are rounding.
_ROUNDING = 1e-5


def new_figure(width: float = _WIDTH, height: float = _HEIGHT) -> Figure:
    """Empty figure without a ground, which a notebook shows as SVG.

    Parameters
    ----------
    width, height : float
        Inches.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> len(new_figure().axes)
    0
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigurationError(
            "plot: expected matplotlib, which is not installed; run pip install 'turbrestore[report]'"
        ) from error

    class _Shown(Figure):
        # Notebooks know figures of pyplot only.
        def _repr_svg_(self) -> str:
            buffer = io.StringIO()
            self.savefig(buffer, format="svg")
            return buffer.getvalue()

    return _Shown(figsize=(width, height), layout="constrained", facecolor="none")


def plot_flow(flow: ArrayLike, image: ArrayLike | None = None, title: str = "Displacement of one frame") -> Figure:
    """Length of a flow as colour, the flow itself as arrows, over the image that it starts from.

    Parameters
    ----------
    flow : array_like, shape (H, W, 2)
        Pixels.
    image : array_like, shape (H, W) or (H, W, 3), optional
        Reference of the flow.
    title : str

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    DataError
        Shapes that are no flow and image of one size.
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> len(plot_flow(np.ones((24, 32, 2))).axes)
    2
    """
    field = _one_flow(flow)
    sizes = np.hypot(field[..., 0], field[..., 1])
    figure, axes = _map(sizes, image, f"{title}, pixels")
    rows, columns = _lattice(field.shape[:2])
    _arrows(axes, rows, columns, field[np.ix_(rows, columns)], headed=True)
    return figure


def plot_displacements(flows: ArrayLike, image: ArrayLike | None = None) -> Figure:
    """How far every pixel moves: standard deviation as colour, the axis along which it is largest as strokes.

    Parameters
    ----------
    flows : array_like, shape (T, H, W, 2)
        Pixels, at least two.
    image : array_like, shape (H, W) or (H, W, 3), optional
        Reference of the flows.

    Returns
    -------
    matplotlib.figure.Figure
        The colour is the root of the displacement variance, summed over both axes.

    Raises
    ------
    DataError
        Shapes that are no flows and image of one size, or a single flow.
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> flows = np.random.default_rng(0).normal(size=(6, 24, 32, 2))
    >>> len(plot_displacements(flows).axes)
    2
    """
    stack = check_flow(flows, "flows")
    if stack.ndim != 4 or len(stack) < 2:
        raise DataError(f"flows: expected at least two, shape (T, H, W, 2), found {stack.shape}")
    spread = np.sqrt(variance_of(stack).sum(axis=-1))
    figure, axes = _map(spread, image, "Standard deviation of displacement, pixels")
    rows, columns = _lattice(stack.shape[1:3])
    samples = np.stack([flow[np.ix_(rows, columns)] for flow in iter_frames(stack)])
    samples = samples - samples.mean(axis=0)
    covariance = np.einsum("tyxi,tyxj->yxij", samples, samples) / (len(stack) - 1)
    values, vectors = np.linalg.eigh(covariance)
    strokes = vectors[..., :, -1] * np.sqrt(np.maximum(values[..., -1:], 0))
    _arrows(axes, rows, columns, strokes, headed=False)
    return figure


def plot_convergence(mean_flow_sizes: ArrayLike, tolerance: float | None = None) -> Figure:
    """Length of the mean flow in every iteration of the centroid.

    Parameters
    ----------
    mean_flow_sizes : array_like, shape (iterations,)
        Pixels.
    tolerance : float, optional
        Pixels.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> len(plot_convergence([0.8, 0.3, 0.1], 0.2).axes)
    1
    """
    sizes = np.asarray(mean_flow_sizes, float)
    figure = new_figure()
    axes = _axes(figure, "Centroid: mean flow left in each iteration", "iteration", "pixels")
    steps = np.arange(1, sizes.size + 1)
    axes.plot(steps, sizes, color=ACCENT, marker="o", markersize=4, linewidth=1.4)
    if tolerance is not None:
        axes.axhline(tolerance, color=INK, linewidth=0.9, linestyle="--")
        axes.text(0.99, tolerance, "tolerance", transform=axes.get_yaxis_transform(), ha="right", va="bottom",
                  color=INK, fontsize=_FONT)  # fmt: skip
    axes.set_ylim(bottom=0)
    axes.set_xlim(0.6, sizes.size + 0.4)
    _whole_ticks(axes)
    return figure


def plot_singular_values(singular_values: ArrayLike, rank: int) -> Figure:
    """Singular values of the flows, those of the chosen states marked.

    Parameters
    ----------
    singular_values : array_like, shape (τ,)
        Falling.
    rank : int
        Number of states.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> len(plot_singular_values([3.0, 1.0, 0.1], 2).axes)
    1
    """
    figure = new_figure()
    _draw_singular_values(_axes(figure), np.asarray(singular_values, float), rank)
    return figure


def plot_eigenvalues(eigenvalues: ArrayLike) -> Figure:
    """Eigenvalues of the transition and the unit circle (paper 3, Figure 7).

    Parameters
    ----------
    eigenvalues : array_like, complex, shape (n,)

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> len(plot_eigenvalues([0.9 + 0.1j, 0.9 - 0.1j]).axes)
    1
    """
    figure = new_figure(_WIDTH, _WIDTH * 0.84)
    _draw_eigenvalues(_axes(figure), np.asarray(eigenvalues, complex))
    return figure


def plot_dynamics(singular_values: ArrayLike, eigenvalues: ArrayLike) -> Figure:
    """Singular values of the flows beside the eigenvalues of the transition.

    Parameters
    ----------
    singular_values : array_like, shape (τ,)
    eigenvalues : array_like, complex, shape (n,)
        As many as states were chosen.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> len(plot_dynamics([3.0, 1.0, 0.1], [0.5, -0.5]).axes)
    2
    """
    figure = new_figure(2 * _WIDTH, _HEIGHT * 1.2)
    values = np.asarray(eigenvalues, complex)
    _draw_singular_values(_axes(figure, place=(1, 2, 1)), np.asarray(singular_values, float), values.size)
    _draw_eigenvalues(_axes(figure, place=(1, 2, 2)), values)
    return figure


def plot_filter(gains: ArrayLike, innovations: ArrayLike) -> Figure:
    """Gain of the image and innovation of the flow, frame by frame.

    Parameters
    ----------
    gains : array_like, shape (N,)
        0 to 1.
    innovations : array_like, shape (N,)
        Pixels; NaN leaves a gap.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> len(plot_filter([1.0, 0.5, 0.3], [0.2, 0.2, 0.1]).axes)
    2
    """
    figure = new_figure(_WIDTH, _WIDTH * 0.84)
    rows = {"Gain of the image": np.asarray(gains, float), "Innovation of the flow, pixels": np.asarray(innovations)}
    _draw_rows(figure, rows)
    return figure


def plot_frames(sharpness: ArrayLike, shares: ArrayLike) -> Figure:
    """How sharp each frame is, and how much it counts.

    Parameters
    ----------
    sharpness : array_like, shape (N,)
        1 is as sharp as the image that the filter started from; NaN leaves a gap.
    shares : array_like, shape (N,)
        They sum to 1; drawn times N, so that 1 is an equal share.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> len(plot_frames([0.9, 1.0, 1.1], [0.2, 0.3, 0.5]).axes)
    2
    """
    figure = new_figure(_WIDTH, _WIDTH * 0.84)
    weights = np.asarray(shares, float)
    rows = {"Sharpness": np.asarray(sharpness, float), "Share of the result, 1 = equal": weights * weights.size}
    sharp, share = _draw_rows(figure, rows)
    for axes in (sharp, share):
        axes.axhline(1, color=INK, linewidth=0.9, linestyle="--")
    return figure


def plot_objective(recorded: ArrayLike, objective: ArrayLike) -> Figure:
    """Energy of the deconvolution above the lowest that was recorded.

    Parameters
    ----------
    recorded : array_like, int, shape (n,)
        Iterations.
    objective : array_like, shape (n,)

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> len(plot_objective([1, 10, 20], [9.0, 5.0, 4.5]).axes)
    1
    """
    figure = new_figure()
    axes = _axes(figure, "Deconvolution: energy", "iteration", "")
    energy = np.asarray(objective, float)
    if energy.size == 0:
        return _nothing(figure, axes, "no blur removed, nothing iterated")
    axes.plot(np.asarray(recorded), energy, color=ACCENT, linewidth=1.4, marker="o", markersize=3)
    return figure


def plot_blur(widths: ArrayLike, costs: ArrayLike, sigma: float, uncertainty: float) -> Figure:
    """Likelihood of every width of the blur that was tried, and the width that was found.

    Parameters
    ----------
    widths : array_like, shape (k,)
        Pixels.
    costs : array_like, shape (k,)
        Negative logarithm of the likelihood per value; drawn as what it lies above the lowest.
    sigma, uncertainty : float
        Pixels; the uncertainty may be infinite.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> len(plot_blur([0.5, 1.0, 1.5], [0.3, 0.0, 0.2], 1.05, 0.1).axes)
    1
    """
    figure = new_figure()
    axes = _axes(figure, "Blur: cost of every width that was tried", "width σ, pixels", "−log likelihood, above lowest")
    tried, cost = np.asarray(widths, float), np.asarray(costs, float)
    if tried.size == 0:
        return _nothing(figure, axes, "the image says nothing of its blur")
    axes.plot(tried, cost - cost.min(), color=ACCENT, linewidth=1.4, marker="o", markersize=3.5)
    axes.axvline(sigma, color=INK, linewidth=0.9, linestyle="--")
    if np.isfinite(uncertainty):
        axes.axvspan(sigma - uncertainty, sigma + uncertainty, color=ACCENT, alpha=0.15, linewidth=0)
    axes.set_ylim(bottom=0)
    return figure


def plot_images(images: Mapping[str, ArrayLike]) -> Figure:
    """Images side by side.

    Parameters
    ----------
    images : mapping of str to array_like, shape (H, W) or (H, W, 3)
        Title and intensities, 0 to 1.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    DataError
        Something is no image.
    ConfigurationError
        Matplotlib is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> len(plot_images({"mean": np.zeros((8, 8)), "result": np.ones((8, 8))}).axes)
    2
    """
    checked = {title: np.clip(check_image(image, title), 0, 1) for title, image in images.items()}
    height, width = next(iter(checked.values())).shape[:2]
    figure = new_figure(_WIDTH * len(checked), _WIDTH * height / width + 0.3)
    for number, (title, image) in enumerate(checked.items(), 1):
        axes = figure.add_subplot(1, len(checked), number)
        axes.imshow(image, cmap="gray", vmin=0, vmax=1, interpolation="none")
        axes.set_title(title, color=INK, fontsize=_FONT + 1, loc="left")
        axes.set_axis_off()
    return figure


def _axes(figure: Figure, title: str = "", x: str = "", y: str = "", place: tuple[int, int, int] = (1, 1, 1)) -> Axes:
    axes = figure.add_subplot(*place, facecolor="none")
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(REST)
    axes.tick_params(colors=INK, labelsize=_FONT, color=REST)
    axes.grid(color=REST, alpha=0.25, linewidth=0.6)
    axes.set_axisbelow(True)
    _label(axes, title, x, y)
    return axes


def _label(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, color=INK, fontsize=_FONT + 1, loc="left")
    axes.set_xlabel(x, color=INK, fontsize=_FONT)
    axes.set_ylabel(y, color=INK, fontsize=_FONT)


def _whole_ticks(axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(nbins=8, integer=True, min_n_ticks=1))


def _nothing(figure: Figure, axes: Axes, text: str) -> Figure:
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=INK, fontsize=_FONT)
    axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    return figure


def _draw_singular_values(axes: Axes, values: NDArray[np.float64], rank: int) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    _label(axes, f"Singular values of the flows: {rank} of {values.size} kept", "number", "pixels")
    # With the mean taken out the last value is zero but for rounding, which would stretch the axis.
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
    _whole_ticks(axes)


def _draw_eigenvalues(axes: Axes, values: NDArray[np.complex128]) -> None:
    from matplotlib.patches import Circle

    _label(axes, "Eigenvalues of the transition", "real part", "imaginary part")
    axes.add_patch(Circle((0, 0), 1, fill=False, edgecolor=INK, linewidth=0.9))
    axes.plot(values.real, values.imag, linestyle="none", marker="o", markersize=4, color=ACCENT, alpha=0.85)
    reach = 1.1 * max(1.0, float(np.abs(values).max(initial=0.0)))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set(xticks=[-1, -0.5, 0, 0.5, 1], yticks=[-1, -0.5, 0, 0.5, 1])


def _draw_rows(figure: Figure, rows: Mapping[str, NDArray[Any]]) -> list[Axes]:
    """One curve a row over the frames; long ones by means of neighbouring frames."""
    drawn = []
    for number, (title, values) in enumerate(rows.items(), 1):
        last = number == len(rows)
        axes = _axes(figure, title, "frame" if last else "", place=(len(rows), 1, number))
        step = -(-values.size // _POINTS) or 1
        edges = np.arange(0, values.size, step)
        means = _bin_means(np.asarray(values, float), edges)
        axes.plot(edges, means, color=ACCENT, linewidth=1.2, marker="o" if values.size <= 60 else None, markersize=2.5)
        axes.set_ylim(bottom=0)
        _whole_ticks(axes)
        if not last:
            axes.tick_params(labelbottom=False)
        drawn.append(axes)
    return drawn


def _bin_means(values: NDArray[np.float64], edges: NDArray[Any]) -> NDArray[np.float64]:
    """Mean of what is known between edges; NaN where nothing is."""
    if values.size == 0:
        return values
    known = np.isfinite(values)
    counts = np.add.reduceat(known.astype(float), edges)
    sums = np.add.reduceat(np.where(known, values, 0.0), edges)
    return np.divide(sums, counts, out=np.full(counts.shape, np.nan), where=counts > 0)


def _map(values: FloatArray, image: ArrayLike | None, title: str) -> tuple[Figure, Axes]:
    """Colours over a faint image, with a scale; axes in pixels of the image."""
    height, width = values.shape
    # The scale and the labels take a fifth of the width and half an inch of the height.
    figure = new_figure(_WIDTH, 0.8 * _WIDTH * min(height / width, 2.0) + 0.5)
    colours = _shrink(values)
    axes = figure.add_subplot()
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    # A fold or two would leave one colour to the rest.
    top = max(float(np.quantile(values, _SCALED_TO)), 1e-6)
    drawn = axes.imshow(colours, cmap=_colours(), vmin=0, vmax=top, extent=extent, interpolation="none")
    if image is not None:
        grey = luminance(check_image(image))
        if grey.shape != values.shape:
            raise DataError(
                f"image: expected {width}×{height} pixels as the flow, found {grey.shape[1]}×{grey.shape[0]}"
            )
        shade = np.clip(_shrink(grey), 0, 1)[..., None]
        blend = (1 - _UNDERLAY) * drawn.to_rgba(colours)[..., :3] + _UNDERLAY * shade
        axes.imshow(blend, extent=extent, interpolation="none")
    axes.spines[:].set_visible(False)
    axes.tick_params(colors=INK, labelsize=_FONT, color=REST)
    scale = figure.colorbar(drawn, ax=axes, aspect=28, extend="max")
    scale.outline.set_visible(False)
    scale.ax.tick_params(colors=INK, labelsize=_FONT, color=REST)
    _label(axes, title, "", "")
    return figure, axes


def _colours() -> Colormap:
    # Each colour of the scale is a path of its own in SVG, so there are fewer than usual.
    import matplotlib as mpl

    return mpl.colormaps["viridis"].resampled(64)


def _arrows(axes: Axes, rows: NDArray[Any], columns: NDArray[Any], vectors: NDArray[Any], headed: bool) -> None:
    """White vectors, so enlarged that almost all are no longer than the step of the lattice."""
    longest = float(np.quantile(np.hypot(vectors[..., 0], vectors[..., 1]), _SCALED_TO))
    if longest <= 0:
        return
    spacing = float(np.diff(rows)[0]) if rows.size > 1 else 1.0
    factor = spacing / longest
    drawn = axes.quiver(columns, rows, vectors[..., 0], vectors[..., 1], angles="xy", scale_units="xy",
                scale=1 / factor, color="#ffffff", width=0.0035, pivot="tail" if headed else "mid")  # fmt: skip
    if headed:
        drawn.headwidth, drawn.headlength, drawn.headaxislength = 3.5, 4.0, 3.5
    else:
        drawn.headwidth = drawn.headlength = drawn.headaxislength = 0
    kind = "arrows" if headed else "strokes"
    axes.set_xlabel(f"pixels; {kind} ×{factor:.2g}", color=INK, fontsize=_FONT)


def _lattice(shape: tuple[int, ...]) -> tuple[NDArray[Any], NDArray[Any]]:
    step = max(-(-max(shape) // _VECTORS), 1)
    rows, columns = (np.arange(step // 2, size, step) for size in shape[:2])
    return rows, columns


def _shrink(values: FloatArray) -> FloatArray:
    factor = _MAP_SIDE / max(values.shape)
    if factor >= 1:
        return values
    size = [max(round(side * factor), 1) for side in values.shape[::-1]]
    return cv2.resize(values, size, interpolation=cv2.INTER_AREA)


def _one_flow(flow: ArrayLike) -> FloatArray:
    field = check_flow(flow)
    if field.ndim != 3:
        raise DataError(f"flow: expected one, shape (H, W, 2), found {field.shape}")
    return field
