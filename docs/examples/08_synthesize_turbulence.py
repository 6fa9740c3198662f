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
# # Synthesize turbulence
#
# Two models make clips whose truth is known. Phase screens image a scene through layers of simulated air; the dynamic
# texture learns how a clip moves, and moves another scene like it.

# %%
import matplotlib.pyplot as plt
import numpy as np
from scipy.special import gamma, kv

import turbrestore as tr
from turbrestore.registration.warp import warp
from turbrestore.synthesis.phase_screen import draw_screen, sample_lattice
from turbrestore.synthesis.scenes import picture, resolution_chart
from turbrestore.synthesis.smooth_flow import distort

plt.style.use("tableau-colorblind10")
plt.rcParams.update({"figure.dpi": 80, "figure.constrained_layout.use": True, "font.size": 9})


def show(panels, rows=1, width=2.4):
    """Show images by title, black at 0 and white at 1."""
    columns = -(-len(panels) // rows)
    _, axes = plt.subplots(rows, columns, figsize=(columns * width, rows * (width + 0.3)), squeeze=False)
    for ax, (title, image) in zip(axes.flat, panels.items(), strict=True):
        ax.imshow(image, cmap="gray", vmin=0, vmax=1)
        ax.set_title(title)
        ax.axis("off")


# %% [markdown]
# ## A phase screen
# The refractive index of turbulent air has von Kármán's spectrum. A screen is a difference of optical path over a
# plane; its structure function `D(r)`, the mean square difference of phase over a distance r, is what theory predicts.

# %%
WAVELENGTH, R0, OUTER, INNER = 550e-9, 0.05, 5.0, 0.005
TO_PHASE = 2 * np.pi / WAVELENGTH


def path_difference(drawn, x, y):
    """Evaluate a screen at points (x, y) in metres: its lattice plus its plane waves."""
    x, y = np.broadcast_arrays(x, y)
    (lattice,) = sample_lattice(drawn, [drawn.path], x, y)
    return lattice + (np.exp(-2j * np.pi * (np.stack([x, y], axis=-1) @ drawn.frequencies.T)) @ drawn.waves).real


def von_karman(r):
    """Structure function of the phase for a finite outer scale (Conan 2000)."""
    x = 2 * np.pi * r / OUTER
    front = (OUTER / R0) ** (5 / 3) * (24 / 5 * gamma(6 / 5)) ** (5 / 6) * 2 ** (1 / 6) * gamma(11 / 6)
    return front / np.pi ** (8 / 3) * (gamma(5 / 6) / 2 ** (1 / 6) - x ** (5 / 6) * kv(5 / 6, x))


def screen(seed):
    """Draw a screen of 512 points, 1 cm apart."""
    rng = np.random.default_rng(seed)
    return draw_screen(512, 0.01, R0, OUTER, INNER, rng, wavelength=WAVELENGTH, aperture=0.1)


distances = np.geomspace(0.04, 10.0, 14)
measured = []
for seed in range(10):
    drawn, rng = screen(seed), np.random.default_rng(100 + seed)
    x, y = rng.uniform(0, 50, (2, 60, 1))
    angle = rng.uniform(0, 2 * np.pi, (60, 1))
    ends = path_difference(drawn, x + distances * np.cos(angle), y + distances * np.sin(angle))
    measured.append(np.mean((TO_PHASE * (ends - path_difference(drawn, x, y))) ** 2, axis=0))
measured = np.array(measured)
error = measured.std(axis=0, ddof=1) / np.sqrt(len(measured))

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
grid = np.linspace(0, 2, 96)
phase = TO_PHASE * path_difference(screen(0), *np.meshgrid(grid, grid))
shown = left.imshow(phase, cmap="viridis", extent=(0, 2, 2, 0))
left.set(title="phase of one screen", xlabel="x, m", ylabel="y, m")
figure.colorbar(shown, ax=left, label="rad")
right.errorbar(distances, measured.mean(axis=0), 2 * error, fmt="o", capsize=3, label="10 screens, ± 2 standard errors")
right.plot(distances, von_karman(distances), "-", label="von Kármán")
right.plot(distances, 6.884 * (distances / R0) ** (5 / 3), ":", label="Kolmogorov, no outer scale")
right.set(xscale="log", yscale="log", xlabel="distance r, m", ylabel="structure function, rad²")
_ = right.legend()

# %% [markdown]
# The phase varies by many radians over two metres, on all scales. Its structure function lies on von Kármán's from four
# centimetres to ten metres, and levels off beyond the outer scale of 5 m. Kolmogorov's law, which has no outer
# scale, is above it even at the shortest distances.

# %% [markdown]
# ## Weak, medium, strong
# Strength is the diameter of the aperture over r0. The clips are 6 frames of a picture 2 km away, seen through 0.1 m.

# %%
SIZE = 112
scene = picture("camera", SIZE, SIZE)
strengths = {"weak": 1.2, "medium": 2.5, "strong": 5.0}
panels = {"truth": scene}
for name, ratio in strengths.items():
    params = tr.PhaseScreenParams(d_over_r0=ratio)
    clip = list(tr.phase_screen_frames(scene, 6, np.random.default_rng(11), params))
    panels[f"{name}, D/r0 = {ratio}"] = clip[0].image
    found = np.std([frame.flow for frame in clip])
    print(f"{name:7} displacement along an axis {found:.2f} px rms, expected {params.tilt_rms():.2f} px")
show(panels)

# %% [markdown]
# Edges wave and details vanish, more so in stronger turbulence. The displacements are as large as theory expects.

# %% [markdown]
# Every frame comes with its flow. Warping the frame back by it removes the motion and leaves the blur. The image
# of the scene through the optics alone is the best possible restoration.

# %%
frame = clip[-1]
show(
    {
        "strong, last frame": frame.image,
        "warped back by its flow": warp(frame.image, frame.flow),
        "optics alone": tr.diffraction_limited(scene),
        "truth": scene,
    }
)

# %% [markdown]
# The man is straight again, and as soft as before.

# %% [markdown]
# ## Exposure
# A frame may gather light while the air moves. Wind is 8 m/s across the view, and a frame is the mean over 6 instants.

# %%
air = tr.PhaseScreenParams(d_over_r0=2.5, wind=(8.0,))
panels = {}
chart = resolution_chart(SIZE, SIZE)
for exposure in (0.0, 0.1, 0.5):
    camera = tr.CameraParams(frame_rate=2.0, exposure=exposure, sub_frames=6)
    frame = next(iter(tr.phase_screen_frames(chart, 1, np.random.default_rng(12), air, camera)))
    panels[f"{1000 * exposure:.0f} ms"] = frame.image
    figures = tr.compare(frame.image, chart)
    print(f"{1000 * exposure:4.0f} ms: sharpness {figures.sharpness:.2f}, PSNR {figures.psnr:.2f} dB")
show(panels)

# %% [markdown]
# In an instant the bars wave and are fairly sharp. The longer the exposure, the straighter and softer they are: motion
# has become blur, and the sharpness printed above falls.

# %% [markdown]
# ## Dynamic texture: the motion of a clip on another scene
# The flows of a clip are measured and a linear system identified; run with new noise it makes sequences of flows of
# any length, which here distort another picture. The clip is a brick wall seen through medium turbulence. It should
# have detail everywhere, because a flow that cannot be measured cannot be learned. The frames shown are six apart.

# %%
wall = picture("brick", SIZE, SIZE)
clip = np.stack([frame.image for frame in tr.phase_screen_frames(wall, 24, np.random.default_rng(15))])
texture = tr.synthesize_like(clip, 120, np.random.default_rng(13), scene=chart)
numbers = (0, 6, 12, 18)
bent = distort(texture.scene, [texture.flows[k] for k in numbers], np.random.default_rng(14), blur=1.0, noise=0.01)
rows = {f"clip, frame {k}": clip[k] for k in numbers} | {
    f"new scene, frame {k}": image for k, image in zip(numbers, bent, strict=True)
}
show(rows, rows=2)

# %% [markdown]
# Mortar and bars waver alike. The scene is the new one, and its true flow is known: `texture.flows`.

# %% [markdown]
# The next figure compares strength and memory of the motion with those of the clip.

# %%
learned = tr.find_centroid(clip).flows
synthesized = np.stack(list(texture.flows))
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3))
for (name, flows), style in zip({"clip": learned, "synthesized": synthesized}.items(), ("o-", "s--"), strict=True):
    track = flows[:, ::8, ::8] - flows[:, ::8, ::8].mean(axis=0)
    correlation = [np.mean(track[lag:] * track[: len(track) - lag]) / track.var() for lag in range(9)]
    left.plot(range(9), correlation, style, label=f"{name}, {track.std():.2f} px rms")
left.set(xlabel="lag, frames", ylabel="correlation of the displacement")
left.legend()
circle = np.exp(2j * np.pi * np.linspace(0, 1, 200))
right.plot(circle.real, circle.imag, color="0.7")
right.plot(texture.eigenvalues.real, texture.eigenvalues.imag, "o", markersize=4)
_ = right.set(
    title=f"{len(texture.eigenvalues)} eigenvalues", xlabel="real part", ylabel="imaginary part", aspect="equal"
)

# %% [markdown]
# The synthesized flow has about the strength of the clip's and forgets in the same few frames. No eigenvalue lies
# outside the circle, so that the sequence neither grows nor fades, however long it is.
