"""One picture for each stage, of one clip of a photographer through medium turbulence."""

from __future__ import annotations

import io
from collections.abc import Mapping

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import turbrestore as tr
from turbrestore.blur.psf import blur_otf
from turbrestore.core.arrays import FloatArray
from turbrestore.dynamics.flow_model import flow_of
from turbrestore.seeing.tilt_theory import Optics

from .clips import Clip
from .layout import row, save

LARGEST = 150_000
# The head and the camera of the photographer, and the place whose motion is plotted, row and column.
DETAIL = (slice(20, 132), slice(72, 184))
SHOWN_ROW, PLACE = 96, (100, 136)
_WIDTH, _DPI = 7.6, 120


def frames(clip: Clip) -> None:
    """Show three frames, and one row of all of them."""
    shown = {f"frame {number}": clip.frames[number] for number in (10, 25, 40)}
    save("stage_frames", row(shown | {f"row {SHOWN_ROW} over time": over_time(clip.frames, SHOWN_ROW)}), LARGEST)


def flow(clip: Clip) -> None:
    """Show reference, frame, the flow between them, and its displacement along x."""
    reference, number = clip.restoration.centroid.image, 25
    found = clip.restoration.centroid.flows[number]
    figure, axes = plt.subplots(1, 5, figsize=(_WIDTH, 2.15), width_ratios=(1, 1, 1, 1, 0.06))
    _images(axes, {"reference": reference, f"frame {number}": clip.frames[number], "flow, × 8": reference})
    step = slice(12, None, 20)
    y, x = np.mgrid[: reference.shape[0], : reference.shape[1]][:, step, step]
    dx, dy = np.moveaxis(found[step, step], -1, 0)
    axes[2].quiver(
        x,
        y,
        dx,
        dy,
        color="#ff9d2e",
        angles="xy",
        scale_units="xy",
        scale=0.2,
        width=0.012,
        headwidth=3.5,
        headlength=4,
    )
    _map(axes[3:], found[..., 0], "displacement dx", "px", "PuOr", (-3, 3))
    _save("stage_flow", figure)


def centroid(clip: Clip) -> None:
    """Show a frame, the temporal mean, frames registered once, and the centroid."""
    once = tr.find_centroid(clip.frames[: clip.restoration.train], tr.CentroidParams(iterations=1))
    panels = {
        "one frame": clip.frame,
        "temporal mean": clip.restoration.mean,
        "registered once": once.image,
        "centroid": clip.restoration.centroid.image,
    }
    save("stage_centroid", row(_details(panels), 224), LARGEST)


def dynamics(clip: Clip) -> None:
    """Plot singular values, eigenvalues, and one step of prediction at one place."""
    model, flows = clip.restoration.dynamics, clip.restoration.centroid.flows
    figure, axes = plt.subplots(1, 3, figsize=(_WIDTH, 2.4), width_ratios=(1, 1, 1.7))
    values = model.singular_values[:-1]
    axes[0].semilogy(np.arange(1, len(values) + 1), values, ".-")
    axes[0].axvline(model.rank + 0.5, color="C1", linestyle="--", label=f"{model.rank} kept")
    axes[0].set(title="singular values", xlabel="number", ylabel="px")
    axes[0].legend()
    circle = np.exp(2j * np.pi * np.linspace(0, 1, 200))
    axes[1].plot(circle.real, circle.imag, color="0.7")
    axes[1].plot(model.eigenvalues.real, model.eigenvalues.imag, "o", markersize=4)
    axes[1].set(title="eigenvalues of A", xlabel="real part", ylabel="imaginary part", aspect="equal")
    measured = flows[:, PLACE[0], PLACE[1], 0]
    predicted = [flow_of(model, model.A @ state)[PLACE[0], PLACE[1], 0] for state in model.states.T[:-1]]
    axes[2].plot(measured, "-", label="measured")
    axes[2].plot(np.arange(1, len(predicted) + 1), predicted, "--", label="predicted")
    axes[2].set(title="displacement of one pixel", xlabel="frame", ylabel="dx, px", ylim=(-3.2, 6))
    axes[2].legend(loc="upper right")
    _save("stage_dynamics", figure)


def filtering(clip: Clip) -> None:
    """Show centroid and filtered image, and how much each frame counts."""
    filtered = clip.restoration.filtered
    panels = {"centroid": clip.restoration.centroid.image, "filtered": filtered.image}
    figure, axes = plt.subplots(1, 3, figsize=(_WIDTH, 2.4), width_ratios=(1, 1, 1.5))
    _images(axes, _details(panels))
    count = len(clip.frames)
    axes[2].bar(np.arange(count), filtered.shares * count)
    axes[2].axhline(1, color="0.4", linewidth=0.8)
    axes[2].set(title="share of each frame", xlabel="frame", ylabel="over the average")
    _save("stage_filter", figure)


def blur(clip: Clip) -> None:
    """Show the filtered image, the cost of each width, and the transfer function that is found."""
    estimate = clip.restoration.blur
    figure, axes = plt.subplots(1, 3, figsize=(_WIDTH, 2.4), width_ratios=(1, 1.3, 1.3))
    _images(axes, _details({"filtered": clip.restoration.filtered.image}))
    axes[1].plot(estimate.widths, estimate.costs - estimate.costs.min(), "o-", markersize=4)
    axes[1].axvline(estimate.sigma, color="C1", linestyle="--", label=f"{estimate.sigma:.2f} px")
    axes[1].set(title="cost of each width", xlabel="width of the blur, px", ylabel="above the least")
    axes[1].legend()
    frequency = np.linspace(0, 0.5, 201)
    for label, width, line in (("found", estimate.sigma, "C1-"), ("removed", estimate.removable, "C0--")):
        transfer = blur_otf((1, 400), width, estimate.exponent)[0]
        axes[2].plot(frequency, transfer, line, label=f"{label}, {width:.2f} px")
    axes[2].set(title="transfer function", xlabel="cycles a pixel", ylabel="contrast left")
    axes[2].legend()
    _save("stage_blur", figure)


def deconvolution(clip: Clip) -> None:
    """Show the filtered image, linear and nonlocal deconvolution, and the scene."""
    filtered, found = clip.restoration.filtered.image, clip.restoration.deconvolution
    linear = tr.DeconvolutionParams(method="wiener", exponent=clip.restoration.blur.exponent)
    panels = {
        "filtered": filtered,
        "Wiener": tr.deconvolve(filtered, found.sigma, linear).image,
        "nonlocal TV": clip.restoration.image,
        "truth": clip.truth,
    }
    save("stage_deconvolution", row(_details(panels), 224), LARGEST)


def seeing(films: Mapping[float, FloatArray], clip: Clip) -> None:
    """Plot the strength that is measured beside the true one, and show where the clip moves."""
    optics = Optics(pixel_scale=2.75e-6, aperture=0.1, distance=2000.0)
    figure, axes = plt.subplots(1, 3, figsize=(_WIDTH, 2.5), width_ratios=(1.7, 1, 0.05))
    for strength, film in films.items():
        found = tr.find_centroid(film)
        value = tr.measure_seeing(film, found.flows, found.image, film.mean(axis=0), optics).d_over_r0
        print(f"seeing: D/r0 {strength:g}, measured {value.value:.2f} ({value.low:.2f} to {value.high:.2f})")
        error = [[value.value - value.low], [value.high - value.value]]
        axes[0].errorbar([strength], [value.value], error, fmt="o", color="C0", capsize=4)
    axes[0].plot((0, 6), (0, 6), color="0.6", linewidth=0.8, label="measured = true")
    axes[0].set(
        title="strength, with 95 % intervals", xlabel="true D/r0", ylabel="measured D/r0", xlim=(0, 6), ylim=(0, 6.5)
    )
    axes[0].legend(loc="upper left")
    motion = np.sqrt(clip.restoration.centroid.flows.var(axis=0).mean(axis=-1))
    _map(axes[1:], motion, "displacement", "px rms", "viridis", (0, 2))
    _save("stage_seeing", figure)


def steady(frames_in: FloatArray, frames_out: FloatArray) -> None:
    """Show a frame before and after, and one row of all frames before and after."""
    middle, line = len(frames_in) // 2, round(0.36 * frames_in.shape[1])
    panels = {
        "frame": frames_in[middle],
        "steadied frame": frames_out[middle],
        "row over time": over_time(frames_in, line),
        "steadied": over_time(frames_out, line),
    }
    save("stage_steady", row(panels), LARGEST)


def over_time(stack: FloatArray, line: int) -> FloatArray:
    """One row of every frame, time running downwards, as high as a frame."""
    rows = stack[:, line]
    return np.repeat(rows, -(-stack.shape[1] // len(rows)), axis=0)[: stack.shape[1]]


def style() -> None:
    """Set the look of the plots."""
    mpl.use("Agg")
    plt.style.use("tableau-colorblind10")
    plt.rcParams.update(
        {"figure.dpi": _DPI, "figure.constrained_layout.use": True, "font.size": 10, "axes.titlesize": 10.5}
    )


def _details(panels: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    return {label: image[DETAIL] for label, image in panels.items()}


def _images(axes: np.ndarray, panels: Mapping[str, FloatArray]) -> None:
    for ax, (title, image) in zip(axes, panels.items(), strict=False):
        ax.imshow(image, cmap="gray", vmin=0, vmax=1, interpolation="bicubic")
        ax.set_title(title)
        ax.axis("off")


def _map(
    axes: np.ndarray, values: FloatArray, title: str, unit: str, colours: str, limits: tuple[float, float]
) -> None:
    """Show a map on the first of two axes, and its scale on the second."""
    shown = axes[0].imshow(values, cmap=colours, vmin=limits[0], vmax=limits[1])
    axes[0].set_title(title)
    axes[0].axis("off")
    axes[0].figure.colorbar(shown, cax=axes[1], label=unit)


def _save(name: str, figure: Figure) -> None:
    with io.BytesIO() as buffer:
        figure.savefig(buffer, format="png")
        plt.close(figure)
        save(name, Image.open(buffer).convert("RGB"), LARGEST, quality=92)
