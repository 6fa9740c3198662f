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
# # The alternating filter
#
# A Kalman filter goes through the video and keeps two states, the image and the flow. Each frame updates one given the
# other (Micheli, Lou, Soatto and Bertozzi, section 4). This example follows it from frame to frame, and shows what
# becomes of motion that the flow model does not hold.

# %%
import matplotlib.pyplot as plt
import numpy as np

import turbrestore as tr
from turbrestore.synthesis.scenes import picture
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

plt.style.use("tableau-colorblind10")
plt.rcParams.update({"figure.dpi": 80, "figure.constrained_layout.use": True, "font.size": 9})

# %% [markdown]
# ## A clip, its centroid and the model of its flow
# 48 frames of a picture; some are sharper than others, as frames of turbulent air are. The first 24 train. The paper
# trains on 100 frames and filters 400.

# %%
SIZE, FRAMES, TRAIN = 112, 48, 24
rng = np.random.default_rng(8)
scene = picture("camera", SIZE, SIZE)
true_flows = smooth_flows(FRAMES, SIZE, SIZE, rng, SmoothFlowParams(rms=1.8, correlation_length=12))
true_flows[:TRAIN] -= true_flows[:TRAIN].mean(axis=0)
true_flows[TRAIN:] -= true_flows[TRAIN:].mean(axis=0)
blurs = rng.uniform(0.5, 2.0, FRAMES)
frames = np.stack(
    [distort(scene, flow[None], rng, blur=blur, noise=0.01)[0] for flow, blur in zip(true_flows, blurs, strict=True)]
)
centroid = tr.find_centroid(frames[:TRAIN])
dynamics = tr.identify(centroid.flows)
print(f"{dynamics.rank} states hold {100 * dynamics.energy_share:.0f} % of the variance of the flow")

# %% [markdown]
# ## Through the frames
# The filter runs over the first 24, 36 and 48 frames. `keep` registers the frames by the measured
# flow; `drop` is the paper as printed, `flow = C ξ`.

# %%
counts = (24, 36, 48)
variants = {
    "keep": tr.FilterParams(),
    "keep, all frames alike": tr.FilterParams(sharpness=0.0),
    "drop": tr.FilterParams(residual="drop", sharpness=0.0),
}
runs = {
    name: [
        tr.filter_frames(frames[:count], centroid.image, dynamics, params, known_flows=centroid.flows)
        for count in counts
    ]
    for name, params in variants.items()
}
figure, ax = plt.subplots(figsize=(6.5, 3.2))
for (name, run), style in zip(runs.items(), ("o-", "s--", "D:"), strict=True):
    ax.plot(counts, [tr.compare(filtered.image, scene).psnr for filtered in run], style, label=name)
mean_psnr = [tr.compare(frames[:count].mean(axis=0), scene).psnr for count in counts]
ax.plot(counts, mean_psnr, "k-.", label="temporal mean")
ax.axhline(tr.compare(centroid.image, scene).psnr, color="0.5", label="centroid of the first 24")
ax.set(xlabel="frames filtered", ylabel="PSNR, dB")
for name, run in runs.items():
    print(f"{name:24} after {counts[-1]} frames {tr.compare(run[-1].image, scene).psnr:.2f} dB")
_ = ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))

# %% [markdown]
# With the residual kept, the filter ends far above the centroid. That comes from sharp frames, which it prefers; with
# all frames alike it stays where the centroid is. With the residual dropped it ends below the centroid it starts from,
# and more frames make it worse: the motion that is left out blurs them.

# %%
panels = {
    "one frame": frames[0],
    "temporal mean": frames.mean(axis=0),
    "centroid": centroid.image,
    "filtered, drop": runs["drop"][-1].image,
    "filtered, keep": runs["keep"][-1].image,
    "truth": scene,
}
figure, axes = plt.subplots(1, 6, figsize=(12, 2.3))
for ax, (title, image) in zip(axes, panels.items(), strict=True):
    ax.imshow(image[8:80, 20:92], cmap="gray", vmin=0, vmax=1)
    ax.set_title(title)
    ax.axis("off")

# %% [markdown]
# The filtered image with the residual dropped is softer than the centroid. With the residual kept, face, camera and
# tripod come out, though less than in the truth: blur is left, which is for deconvolution.

# %% [markdown]
# ## The residual
# What the states leave out of the flow, root mean square over the training frames, and where it lies.

# %%
kept = runs["keep"][-1]
figure, axes = plt.subplots(1, 3, figsize=(10, 2.9))
spread = np.sqrt(dynamics.flow_variance)
maps = {"flow": spread, "residual": np.sqrt(dynamics.residual_variance)}
for ax, (title, values) in zip(axes, maps.items(), strict=False):
    shown = ax.imshow(values, cmap="viridis", vmin=0, vmax=2.5)
    ax.set_title(title)
    ax.axis("off")
figure.colorbar(shown, ax=axes[:2], label="px rms")
sizes = dynamics.singular_values / np.sqrt(TRAIN * SIZE * SIZE)
axes[2].bar(np.arange(1, TRAIN), sizes[:-1], color=["C0" if k < dynamics.rank else "C1" for k in range(TRAIN - 1)])
_ = axes[2].set(xlabel="singular value", ylabel="px rms", title=f"{dynamics.rank} states, and the rest")

# %% [markdown]
# The residual is smaller than the flow but spread over the whole image, about half a pixel. The singular values fall
# smoothly past the last state: with 24 training frames the rest is not noise but motion, and is kept.

# %% [markdown]
# ## Gain, innovation, share
# What a run records for every frame: the share of the frame that goes into the image, the flow that the prediction did
# not foresee, and how much the frame counts.

# %%
figure, axes = plt.subplots(1, 3, figsize=(11, 2.9))
for (name, run), style in zip(runs.items(), ("-", "--", ":"), strict=True):
    axes[0].semilogy(run[-1].gains, style, label=name)
axes[0].semilogy(1 / np.arange(1, FRAMES + 1), color="0.6", linewidth=0.8, label="1 / number of frames")
axes[0].set(xlabel="frame", ylabel="gain of the image")
axes[1].plot(kept.innovations, ".-")
axes[1].axvline(TRAIN - 0.5, color="0.5", linestyle=":")
axes[1].set(xlabel="frame; training ends at the line", ylabel="innovation, px rms", ylim=(0, None))
axes[2].plot(blurs, kept.shares * FRAMES, "o")
axes[2].axhline(1, color="0.6", linewidth=0.8)
_ = axes[2].set(xlabel="true blur of the frame, σ in px", ylabel="share of the frame × frames")
_ = axes[0].legend()

# %% [markdown]
# With all frames alike the gain is one over the number of frames, with the residual kept or not: the filter is a
# running mean. Preferring sharp frames, it changes by a factor of up to six from one frame to the next, and the
# shares follow the true blur, which the filter does not know. The innovation is larger after the training frames: the
# model foresees flows it was fitted to better than new ones.
