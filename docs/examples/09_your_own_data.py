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
# # Your own data
#
# turbrestore reads videos, SER files, TIFF stacks, `.npy` arrays and folders of images, from 8 to 16 bits or floating
# point, and keeps the depth. This example writes each of them into a temporary folder, reads them back and restores.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import turbrestore as tr
from turbrestore.core.errors import TurbrestoreError
from turbrestore.synthesis.scenes import picture
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

plt.style.use("tableau-colorblind10")
plt.rcParams.update({"figure.dpi": 80, "figure.constrained_layout.use": True, "font.size": 9})
temporary = tempfile.TemporaryDirectory()
folder = Path(temporary.name)


def show(panels, width=2.6):
    """Show images by title, black at 0 and white at 1."""
    _, axes = plt.subplots(1, len(panels), figsize=(width * len(panels), width + 0.3))
    for ax, (title, image) in zip(axes, panels.items(), strict=True):
        ax.imshow(image, cmap="gray", vmin=0, vmax=1)
        ax.set_title(title)
        ax.axis("off")


# %% [markdown]
# ## A dim clip
# A camera of 12 bits sees a dim scene: it fills the range from 2 to 4 % of full scale, about five levels of 8 bits and
# eighty of 12. All pictures are shown as recorded or with this range stretched from black to white.

# %%
SIZE, FRAMES = 96, 24
rng = np.random.default_rng(15)
truth = 0.02 + 0.02 * picture("camera", SIZE, SIZE)
flows = smooth_flows(FRAMES, SIZE, SIZE, rng, SmoothFlowParams(rms=1.5, correlation_length=12))
flows -= flows.mean(axis=0)
frames = distort(truth, flows, rng, blur=0.9, noise=0.0001)


def stretch(image):
    """Bring 2 to 4 % of full scale to the range from black to white."""
    return np.clip((image - 0.02) / 0.02, 0, 1)


def quantised(image, bits):
    """Round to the levels of so many bits."""
    return np.round(image * (2**bits - 1)) / (2**bits - 1)


show(
    {
        "as recorded": frames[0],
        "12 bits, stretched": stretch(quantised(frames[0], 12)),
        "8 bits, stretched": stretch(quantised(frames[0], 8)),
    }
)

# %% [markdown]
# As recorded nothing can be seen. Stretched, the frame of 12 bits is a picture, and that of 8 bits a few flat patches.

# %% [markdown]
# ## Write and read
# `write_video` takes the format from the suffix; a folder of images is written one by one. `open_frames` reads any of
# them, and says what it found.

# %%
for name in ("clip.ser", "clip.tif", "clip.mkv"):
    tr.write_video(folder / name, frames, fps=25, bit_depth=12)
tr.write_video(folder / "clip.npy", frames, fps=25, bit_depth=32)
(folder / "images").mkdir()
for number, frame in enumerate(frames):
    tr.write_image(folder / "images" / f"frame{number}.png", frame, bit_depth=16)

sources = {path.name: tr.open_frames(path) for path in sorted(folder.iterdir())}
for name, source in sources.items():
    rate = "no rate" if source.fps is None else f"{source.fps:g} frames/s"
    error = np.abs(source.read() - frames).max()
    print(f"{name:9} {source.format:16} {source.bit_depth:2} bits  {rate:12}  largest error {error:.1e} of full scale")

# %% [markdown]
# MKV and SER keep the 12 bits and the frame rate. TIFF and PNG hold 16 bits, to which the values are scaled, and `.npy`
# floating point without any loss. The largest error is half a grey level of the format.

# %% [markdown]
# ## Restore, and keep the depth
# The SER file of 12 bits is restored. `write_image` takes the depth of the input and gives a PNG of 16 bits, which
# holds all 12. The same clip with 8 bits is restored for comparison.

# %%
source = sources["clip.ser"]
result = tr.restore(source)
tr.write_image(folder / "sharp.png", result.image, source.bit_depth)
kept = tr.read_image(folder / "sharp.png")
print(f"from {source.bit_depth} bits to a PNG of {kept.bit_depth}: {len(np.unique(kept.image))} grey levels")

tr.write_video(folder / "clip8.ser", frames, fps=25, bit_depth=8)
coarse = tr.restore(tr.open_frames(folder / "clip8.ser"))
for name, image in {"12 bits": kept.image, "8 bits": coarse.image}.items():
    figures = tr.compare(stretch(image), stretch(truth))
    print(f"{name:8} PSNR of the stretched image {figures.psnr:.2f} dB, SSIM {figures.ssim:.3f}")
show(
    {
        "one frame": stretch(frames[0]),
        "restored, 12 bits": stretch(kept.image),
        "restored, 8 bits": stretch(coarse.image),
        "truth": stretch(truth),
    }
)

# %% [markdown]
# From 12 bits, coat, grass and houses come back with their shades, in a PNG of 16 bits with many grey levels. From 8
# bits the patches stay patches, with smoother outlines: averaging frames fills the steps between grey levels only where
# noise or motion has mixed them.

# %% [markdown]
# ## Parts of a video, and arrays
# A range of frames and a rectangle are chosen when a file is opened, and nothing else is decoded. Arrays need no file:
# integers are scaled by the range of their type, and `tr.restore(array)` takes them as it takes a file.

# %%
part = tr.open_frames(folder / "clip.tif", frames=(4, 24, 2), roi=(16, 8, 72, 72))
array = (frames * 65535).round().astype(np.uint16)
print(f"part: {part.shape}; array: {array.dtype} {tr.FrameSource.from_array(array).shape}")
show(
    {
        "first frame of the part": stretch(next(iter(part))),
        "restored part": stretch(tr.restore(part).image),
    }
)

# %% [markdown]
# The part has every second frame from the fifth on, and the rectangle of 72 by 72 pixels from (16, 8). Restored, it
# shows the same as that part of the whole, from fewer frames.

# %% [markdown]
# ## When a file is not what it should be
# Every expected failure is a `TurbrestoreError` with a message of one line.

# %%
(folder / "short.ser").write_bytes((folder / "clip.ser").read_bytes()[:100_000])
(folder / "notes.txt").write_text("no video")
for name in ("missing.mkv", "short.ser", "notes.txt"):
    try:
        tr.open_frames(folder / name)
    except TurbrestoreError as error:
        print(str(error).replace(str(folder), "…"))
temporary.cleanup()

# %% [markdown]
# A file that is cut short is refused as a whole, with the number of frames that are intact: `frames=(0, n)` reads
# those.
