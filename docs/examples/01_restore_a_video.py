# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Restore a video
#
# One call turns a video of a static scene, seen through moving air, into one sharp image. This example restores the
# upper half of the sample clip of the repository and looks at what every stage adds.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import turbrestore as tr

plt.style.use("tableau-colorblind10")
plt.rcParams.update({"figure.dpi": 80, "figure.constrained_layout.use": True, "font.size": 9})


def show(panels, rows=1, width=3.4):
    """Show images by title, black at 0 and white at 1."""
    columns = -(-len(panels) // rows)
    height, across = next(iter(panels.values())).shape[:2]
    size = (columns * width, rows * (width * height / across + 0.3))
    _, axes = plt.subplots(rows, columns, figsize=size, squeeze=False)
    for ax, (title, image) in zip(axes.flat, panels.items(), strict=True):
        ax.imshow(image, cmap="gray", vmin=0, vmax=1)
        ax.set_title(title)
        ax.axis("off")


# %% [markdown]
# ## Open
# `open_frames` reads the headers and decodes nothing but the first frame; `roi` is the part to read, as x, y, width and
# height. `read` gives frames as one array, float32 from 0 to 1.

# %%
samples = Path("../../sample_data")
source = tr.open_frames(samples / "chart.mkv", roi=(0, 0, 256, 96))
print(f"{len(source)} frames of {source.shape[2]}×{source.shape[1]}, {source.bit_depth} bits, {source.fps:g} a second")

truth = tr.read_image(samples / "chart_truth.png").image[:96]
early, late = source.read(10, 11)[0], source.read(20, 21)[0]
show({"frame 10": early, "frame 20": late, "difference + 0.5": early - late + 0.5})

# %% [markdown]
# Both frames are soft and noisy, and lines that are straight in the scene wave differently in each. The difference
# shows motion at every edge.

# %% [markdown]
# ## Restore
# `restore` finds the centroid, identifies how the flow moves, filters image and flow together, estimates the blur that
# is left and removes it. The result carries what every stage found.

# %%
result = tr.restore(source)
stages = {
    "frame 20": late,
    "temporal mean": result.mean,
    "centroid": result.centroid.image,
    "filtered": result.filtered.image,
    "restored": result.image,
    "truth": truth,
}
for name, image in stages.items():
    if name != "truth":
        figures = tr.compare(image, truth)
        print(f"{name:14} PSNR {figures.psnr:5.2f} dB   SSIM {figures.ssim:.3f}   sharpness {figures.sharpness:.2f}")
show(stages, rows=2)

# %% [markdown]
# The mean does not move, but the motion has blurred it more than any single frame. In the centroid, the mean of frames
# that were first bent back, edges are straight and words can be read. The filter gives sharp frames more weight, and
# deconvolution brings black and white back to the finest bars and the smallest letters. Some wobble stays in the
# horizontal bars: along a bar no motion can be seen. Sharpness is the mean gradient relative to that of the truth.

# %% [markdown]
# ## What the stages found
# A result has the record of its making: the mean flow of each centroid iteration, the singular values of the flows, the
# gain of the Kalman filter for each frame, and the cost of each width of the blur. Its `decisions` say what was chosen
# from the data, and why.

# %%
figure, axes = plt.subplots(1, 4, figsize=(12, 2.6))
sizes, values = result.centroid.mean_flow_sizes, result.dynamics.singular_values
axes[0].plot(np.arange(1, len(sizes) + 1), sizes, "o-")
axes[0].xaxis.get_major_locator().set_params(integer=True)
axes[0].set(title="centroid", xlabel="iteration", ylabel="mean flow, px", ylim=(0, None))
axes[1].semilogy(np.arange(1, len(values)), values[:-1], ".-")
axes[1].axvline(result.dynamics.rank + 0.5, color="C1", linestyle="--", label=f"n = {result.dynamics.rank}")
axes[1].set(title="singular values of the flows", xlabel="number", ylabel="px")
axes[1].legend()
axes[2].semilogy(result.filtered.gains, ".-")
axes[2].set(title="gain of the filter", xlabel="frame", ylabel="share of the frame")
axes[3].plot(result.blur.widths, result.blur.costs, "o-")
axes[3].axvline(result.blur.sigma, color="C1", linestyle="--", label=f"σ = {result.blur.sigma:.2f} px")
axes[3].set(title="estimated blur", xlabel="width, px", ylabel="cost")
axes[3].legend()

print(
    f"training frames: {result.train}; states of the flow: {result.dynamics.rank}, which hold "
    f"{100 * result.dynamics.energy_share:.0f} % of its variance"
)
for decision in result.decisions:
    print(decision)

# %% [markdown]
# The mean flow falls once and then no further; the rest is the bias of the flow method, and the iteration stops. The
# singular values have no edge at n: the states hold most of the motion, not all. The gain starts at 1, for nothing is
# known before the first frame, and later changes by up to a factor of ten between sharp frames and soft ones. The
# width of the blur is where the cost is lowest.

# %% [markdown]
# ## The same in ten lines
# Every stage is a function. The filter fuses frames in the geometry of the training frames; `recentred` moves its image
# onto the mean geometry of all frames, and `recentre` does so with the centroid, which guides the deconvolution. The
# frames tell more of the noise than the image does.

# %%
part = source.select(roi=(60, 0, 96, 96))
known = tr.RestoreParams(border="keep", deconvolution=tr.DeconvolutionParams(sigma=1.0))
whole = tr.restore(part, known)

frames = part.read()
centroid = tr.find_centroid(frames[: whole.train])
dynamics = tr.identify(centroid.flows)
filtered = tr.filter_frames(frames, centroid.image, dynamics, known_flows=centroid.flows)
straight = filtered.recentred()
guide = tr.recentre(centroid.image, filtered.mean_flow)
sharp = tr.deconvolve(straight.image, 1.0, guide=guide, noise=whole.noise)
print(dynamics)
print(f"largest difference: filtered {np.abs(straight.image - whole.filtered.image).max():.1e}", end=", ")
print(f"deblurred {np.abs(sharp.image - whole.image).max():.1e}")

# %% [markdown]
# There is no difference. Where a clip has flicker, overlays or moving objects, `restore` takes these out of the frames
# first; where the width of the blur is not given, guards and halves of the clip decide how much of it is removed.

# %% [markdown]
# ## Keep it
# `write_image` takes the depth of the input, so that an 8-bit video gives an 8-bit image.

# %%
with tempfile.TemporaryDirectory() as folder:
    tr.write_image(Path(folder) / "sharp.png", result.image, source.bit_depth)
    written = tr.read_image(Path(folder) / "sharp.png")
    print(f"{written.bit_depth} bits, largest rounding {np.abs(written.image - result.image).max():.4f} of full scale")

# %% [markdown]
# The command line does the same: `turbrestore restore sample_data/chart.mkv sharp.png`.
