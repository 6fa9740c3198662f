"""Maps of the displacement, and images side by side: arrays in, a matplotlib figure out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import ROUNDING, FloatArray, check_flow, check_grey, check_image
from ..core.errors import DataError
from ..runtime.scratch import iter_frames, variance_of
from .figure import FONT, INK, REST, WIDTH, new_figure, set_labels
from .preview import shrink

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Longest side of a map, pixels, and number of arrows along it; both chosen.
_MAP_SIDE, _ARROWS = 320, 20
# Opacity of the image under a map, chosen.
_UNDERLAY = 0.35
# Colours and arrows are scaled to this quantile, so that a few folds of the flow do not set the scale; chosen.
_SCALE_QUANTILE = 0.99


def plot_flow(flow: ArrayLike, image: ArrayLike | None = None, title: str = "Displacement of one frame") -> Figure:
    """Show the length of a flow as colour and the flow itself as arrows, over its reference image.

    ``flow`` (H, W, 2); ``image`` (H, W) or (H, W, 3).
    """
    field = check_flow(flow)
    if field.ndim != 3:
        raise DataError(f"flow: expected one, shape (H, W, 2), found {field.shape}")
    lengths = np.hypot(field[..., 0], field[..., 1])
    figure, axes = _draw_map(lengths, image, f"{title}, pixels")
    rows, columns = _grid(field.shape[:2])
    _draw_arrows(axes, rows, columns, field[np.ix_(rows, columns)], heads=True)
    return figure


def plot_displacements(flows: ArrayLike, image: ArrayLike | None = None) -> Figure:
    """Show how far every pixel moves: standard deviation as colour, direction of the largest motion as strokes.

    ``flows`` (T, H, W, 2); ``image`` (H, W) or (H, W, 3).
    """
    stack = check_flow(flows, "flows")
    if stack.ndim != 4 or len(stack) < 2:
        raise DataError(f"flows: expected at least two, shape (T, H, W, 2), found {stack.shape}")
    deviation = np.sqrt(variance_of(stack).sum(axis=-1))
    figure, axes = _draw_map(deviation, image, "Standard deviation of displacement, pixels")
    rows, columns = _grid(stack.shape[1:3])
    samples = np.stack([flow[np.ix_(rows, columns)] for flow in iter_frames(stack)])
    samples = samples - samples.mean(axis=0)
    covariance = np.einsum("tyxi,tyxj->yxij", samples, samples) / (len(stack) - 1)
    values, vectors = np.linalg.eigh(covariance)
    strokes = vectors[..., :, -1] * np.sqrt(np.maximum(values[..., -1:], 0))
    _draw_arrows(axes, rows, columns, strokes, heads=False)
    return figure


def plot_uncertainty(deviation: ArrayLike, image: ArrayLike | None = None) -> Figure:
    """Show the standard deviation of every pixel as colour; infinite ones have the brightest colour.

    ``deviation`` (H, W); ``image`` (H, W) or (H, W, 3).
    """
    percent = 100 * np.asarray(deviation, np.float32)
    known = percent[np.isfinite(percent)]
    top = float(np.quantile(known, _SCALE_QUANTILE)) if known.size else 1.0
    return _draw_map(np.minimum(percent, np.float32(top)), image, "Standard deviation, % of full scale")[0]


def plot_disagreement(share: ArrayLike, image: ArrayLike | None = None) -> Figure:
    """Show how much of the detail of every pixel gave way to the mean of the frames as colour.

    ``share`` (H, W); ``image`` (H, W) or (H, W, 3).
    """
    return _draw_map(100 * np.asarray(share, np.float32), image, "Detail taken from the mean, %")[0]


def plot_images(images: Mapping[str, ArrayLike], columns: int | None = None) -> Figure:
    """Show images side by side.

    ``images`` (H, W) or (H, W, 3).
    """
    checked = {title: np.clip(check_image(image, title), 0, 1) for title, image in images.items()}
    height, width = next(iter(checked.values())).shape[:2]
    across = min(columns or len(checked), len(checked))
    down = math.ceil(len(checked) / across)
    figure = new_figure(WIDTH * across, down * (WIDTH * height / width + 0.3))
    for number, (title, image) in enumerate(checked.items(), 1):
        axes = figure.add_subplot(down, across, number)
        axes.imshow(image, cmap="gray", vmin=0, vmax=1, interpolation="none")
        axes.set_title(title, color=INK, fontsize=FONT + 1, loc="left")
        axes.set_axis_off()
    return figure


def _draw_map(values: FloatArray, image: ArrayLike | None, title: str) -> tuple[Figure, Axes]:
    """Colours over a faint image, with a colour bar; axes in pixels of the image."""
    height, width = values.shape
    # The colour bar and the labels take a fifth of the width and half an inch of the height.
    figure = new_figure(WIDTH, 0.8 * WIDTH * min(height / width, 2.0) + 0.5)
    reduced = shrink(values, _MAP_SIDE)
    axes = figure.add_subplot()
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    top = max(float(np.quantile(values, _SCALE_QUANTILE)), ROUNDING)
    # Only now is it known to be installed.
    import matplotlib as mpl

    # Each colour of the bar is a separate path in SVG, so there are fewer than usual.
    colours = mpl.colormaps["viridis"].resampled(64)
    drawn = axes.imshow(reduced, cmap=colours, vmin=0, vmax=top, extent=extent, interpolation="none")
    if image is not None:
        grey = check_grey(image)
        if grey.shape != values.shape:
            raise DataError(
                f"image: expected {width}×{height} pixels as the flow, found {grey.shape[1]}×{grey.shape[0]}"
            )
        shade = np.clip(shrink(grey, _MAP_SIDE), 0, 1)[..., None]
        blend = (1 - _UNDERLAY) * drawn.to_rgba(reduced)[..., :3] + _UNDERLAY * shade
        axes.imshow(blend, extent=extent, interpolation="none")
    axes.spines[:].set_visible(False)
    axes.tick_params(colors=INK, labelsize=FONT, color=REST)
    bar = figure.colorbar(drawn, ax=axes, aspect=28, extend="max")
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=INK, labelsize=FONT, color=REST)
    set_labels(axes, title, "", "")
    return figure, axes


def _draw_arrows(axes: Axes, rows: NDArray[Any], columns: NDArray[Any], vectors: NDArray[Any], heads: bool) -> None:
    """White arrows, enlarged so that almost all of them are no longer than their spacing."""
    longest = float(np.quantile(np.hypot(vectors[..., 0], vectors[..., 1]), _SCALE_QUANTILE))
    if longest <= 0:
        return
    spacing = float(np.diff(rows)[0]) if rows.size > 1 else 1.0
    factor = spacing / longest
    drawn = axes.quiver(columns, rows, vectors[..., 0], vectors[..., 1], angles="xy", scale_units="xy",
                scale=1 / factor, color="#ffffff", width=0.0035, pivot="tail" if heads else "mid")  # fmt: skip
    if heads:
        drawn.headwidth, drawn.headlength, drawn.headaxislength = 3.5, 4.0, 3.5
    else:
        drawn.headwidth = drawn.headlength = drawn.headaxislength = 0
    kind = "arrows" if heads else "strokes"
    axes.set_xlabel(f"pixels; {kind} ×{factor:.2g}", color=INK, fontsize=FONT)


def _grid(shape: tuple[int, ...]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Rows and columns at which arrows are drawn."""
    step = max(-(-max(shape) // _ARROWS), 1)
    rows, columns = (np.arange(step // 2, size, step) for size in shape[:2])
    return rows, columns
