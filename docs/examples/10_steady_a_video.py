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
# # Steady a video
#
# `steady_frames` turns a video into a steady, sharp video of the same length, in which what moves keeps moving. This
# example steadies a clip with an object that crosses the scene, and compares every frame with its truth.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import turbrestore as tr
from turbrestore.synthesis.moving_objects import MovingObject, with_objects
from turbrestore.synthesis.scenes import picture

plt.style.use("tableau-colorblind10")
plt.rcParams.update({"figure.dpi": 80, "figure.constrained_layout.use": True, "font.size": 9})


def show(panels, width=2.4):
    """Show images by title, black at 0 and white at 1."""
    _, axes = plt.subplots(1, len(panels), figsize=(width * len(panels), width + 0.3))
    for ax, (title, image) in zip(axes, panels.items(), strict=True):
        ax.imshow(image, cmap="gray", vmin=0, vmax=1)
        ax.set_title(title)
        ax.axis("off")


# %% [markdown]
# ## A clip in which something moves
# A striped ellipse travels over the lawn behind the photographer's tripod, by 2.5 px a frame, and the air is in front
# of both. `with_objects` has the truth of every frame.

# %%
SIZE, FRAMES = 112, 32
scene = picture("camera", SIZE, SIZE)
walker = [MovingObject((-4.0, 88.0), (2.5, 0.0), (8.0, 4.5), 0.8, 0.5)]
air = tr.PhaseScreenParams(d_over_r0=1.5)
made = tr.phase_screen_frames(scene, FRAMES, np.random.default_rng(21), air, objects=walker)
frames = np.stack([frame.image for frame in made])
truth = np.stack([with_objects(scene, walker, number)[0] for number in range(FRAMES)])
show({f"frame {number}": frames[number] for number in (4, 13, 22, 31)})

# %% [markdown]
# The picture wavers, the tripod bends, and the ellipse passes from left to right.

# %% [markdown]
# ## Steady it
# The function takes any iterator of images and yields a frame for each. It reads 12 frames ahead, and its memory does
# not grow with the length of the video.

# %%
steadied = list(tr.steady_frames(frames))
images = np.stack([frame.image for frame in steadied])
print(f"{len(images)} frames; blur removed from a frame: {steadied[0].sigma:.2f} px")
print(f"displacement removed: {np.mean([frame.displacement for frame in steadied]):.2f} px rms")
number = 22
show(
    {
        f"frame {number}": frames[number],
        "steadied": images[number],
        "truth": truth[number],
        "moves": steadied[number].moving.astype(float),
    }
)

# %% [markdown]
# The tripod is straighter, and coat and camera have sharper edges. The ellipse is where it is in the truth, with its
# stripes. White in the last panel is what the method takes for motion; the small patches are edges that the air
# displaced by more than most.

# %% [markdown]
# ## Steadiness
# One row of the picture for all frames, time running downwards: what is static is a vertical line. Right, how far
# each frame is from its truth.

# %%
figure, axes = plt.subplots(1, 3, figsize=(10, 2.9))
for ax, (title, stack) in zip(axes, {"row 50 of the frames": frames, "steadied": images}.items(), strict=False):
    ax.imshow(stack[:, 50], cmap="gray", vmin=0, vmax=1, aspect="auto")
    ax.set(title=title, xlabel="x, px", ylabel="frame")
for (name, stack), style in zip({"input": frames, "steadied": images}.items(), ("s--", "o-"), strict=True):
    quality = [tr.compare(image, scene).psnr for image, scene in zip(stack, truth, strict=True)]
    axes[2].plot(quality, style, markersize=3, label=name)
    changes = np.abs(np.diff(stack, axis=0)).mean() / np.abs(np.diff(truth, axis=0)).mean()
    print(f"{name:9} PSNR {np.mean(quality):.2f} dB, change from frame to frame {changes:.1f} times that of the truth")
axes[2].set(xlabel="frame", ylabel="PSNR, dB")
_ = axes[2].legend()

# %% [markdown]
# The lines that wavered are nearly straight, and every frame is nearer to its truth, by about three decibels. A slow
# displacement that lasts longer than the 25 frames of the window stays in.

# %% [markdown]
# ## Write it
# `write_video` takes an iterator, so that a long video passes through frame by frame.

# %%
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "steady.mp4"
    tr.write_video(path, iter(images), 25, bit_depth=8)
    written = tr.open_frames(path)
    print(f"{written.format}: {len(written)} frames of {written.shape[2]}×{written.shape[1]}, {written.fps:g} a second")

# %% [markdown]
# `turbrestore steady haze.mp4 steady.mp4` does the same from file to file and keeps the sound;
# [the manual](../steady.md) has its options. Of a scene in which nothing moves, `turbrestore restore` makes a better
# still image.
