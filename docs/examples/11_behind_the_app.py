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
# # Behind the app
#
# The app opens a clip, runs the stages, and then lets the deblurring be tuned while the filtered image stays as it is.
# This example calls the functions that it calls, so that the same can be done in a script.

# %%
import dataclasses
import tempfile
import time
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import turbrestore as tr
from turbrestore.deconvolution.deconvolve import whole_image_fidelity
from turbrestore_app.stage_memory import StageMemory

plt.style.use("tableau-colorblind10")
plt.rcParams.update({"figure.dpi": 80, "figure.constrained_layout.use": True, "font.size": 9})


def show(panels, width=3.2):
    """Show images by title, black at 0 and white at 1."""
    height, across = next(iter(panels.values())).shape
    _, axes = plt.subplots(1, len(panels), figsize=(width * len(panels), width * height / across + 0.3))
    for ax, (title, image) in zip(axes, panels.items(), strict=True):
        ax.imshow(image, cmap="gray", vmin=0, vmax=1)
        ax.set_title(title)
        ax.axis("off")


# %% [markdown]
# ## Open
# The app reads the chosen frames and region, checks what is in them, and leaves out duplicates and blank frames.

# %%
whole = tr.open_frames("../../sample_data/chart.mkv", frames=(0, 30), roi=(76, 96, 180, 96))
report = tr.check_content(whole)
source = tr.clean_source(whole, report)
print(
    f"{len(source)} of {len(whole)} frames of {source.shape[2]}×{source.shape[1]}; remarks: {report.warnings or 'none'}"
)

# %% [markdown]
# ## Run
# A store keeps the result of every stage but the last, and hands on their images as they are done. `progress` moves the
# bars of the page, and `on_decision` writes its list of decisions.

# %%
images, decisions, bars = {}, [], {}
memory = StageMemory(show=images.__setitem__)


def progress(stage, done, total):
    """Note how far a stage is."""
    bars[stage] = f"{done} of {total}"


begun = time.perf_counter()
first = tr.restore(source, store=memory, progress=progress, on_decision=decisions.append)
seconds = time.perf_counter() - begun
print(f"bars: {', '.join(bars)}; {len(decisions)} decisions, such as")
for decision in decisions[-3:]:
    print(f"  {decision.subject}: {decision.choice}")
show({name: images[name] for name in ("mean", "centroid", "filtered", "deblurred")})

# %% [markdown]
# These are the images that the page shows, stage by stage: the edges become straight first, and sharp in the end.

# %% [markdown]
# ## Run again with another deconvolution
# Only the settings of the deconvolution change, so the store answers for all other stages. The sliders start from what
# was measured, which `dataclasses.replace` fills in.

# %%
measured = tr.DeconvolutionParams(sigma=round(first.deconvolution.sigma, 3), exponent=first.blur.exponent)
wider = dataclasses.replace(measured, sigma=1.25 * measured.sigma)
begun = time.perf_counter()
second = tr.restore(source, tr.RestoreParams(deconvolution=wider), store=memory)
share = (time.perf_counter() - begun) / seconds
print(f"filtered image: {'the same' if second.filtered is first.filtered else 'another'}; widths removed:")
print(f"{first.deconvolution.sigma:.2f} and {second.deconvolution.sigma:.2f} px; {100 * share:.0f} % of the time")

# %% [markdown]
# ## Tune on a part
# While a slider moves, the app deblurs a part of the image, with the weight λ of the whole image: a few steps of total
# variation first, then the method itself.

# %%
part = (slice(0, 96), slice(8, 104))
filtered, guide = first.filtered.image[part], first.centroid.image[part]
panels = {"filtered": filtered}
for factor in (0.7, 1.0, 1.4):
    width = factor * measured.sigma
    params = dataclasses.replace(measured, sigma=width, fidelity=whole_image_fidelity(first.filtered.image, measured))
    panels[f"σ = {width:.2f} px"] = tr.deconvolve(filtered, width, params, guide=guide).image
show(panels, width=2.3)

# %% [markdown]
# With too small a width the letters stay soft; with too large a one they get bright rims. The measured width lies
# between the two. λ and the method are tuned in the same way.

# %% [markdown]
# ## Save
# The page writes the image with the depth of the input, and can write a report.

# %%
with tempfile.TemporaryDirectory() as folder:
    tr.write_image(Path(folder) / "sharp.png", second.image, source.bit_depth)
    saved = tr.read_image(Path(folder) / "sharp.png")
    print(f"{saved.bit_depth} bits; largest rounding {np.abs(saved.image - second.image).max():.4f} of full scale")

# %% [markdown]
# `turbrestore app sample_data/chart.mkv` opens [the page](../app.md). *Copy command* there gives the command line that
# makes the same image.
