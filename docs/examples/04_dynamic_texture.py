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
# # Dynamic texture of the flow
#
# The flow of turbulent air is modelled as a small linear system: `ξ' = A ξ + noise`, `flow = mean + C ξ` (Micheli, Lou,
# Soatto and Bertozzi, section 3). This example looks at its eigenvalues, at how well it predicts the next frame, and at
# new frames made with it: Figures 7, 8 and 6 of the paper.

# %%
import matplotlib.pyplot as plt
import numpy as np

import turbrestore as tr
from turbrestore.registration.warp import warp
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows

plt.style.use("tableau-colorblind10")
plt.rcParams.update({"figure.dpi": 80, "figure.constrained_layout.use": True, "font.size": 9})


def show(rows, width=2.4):
    """Show rows of images by title, black at 0 and white at 1."""
    columns = max(len(row) for row in rows)
    _, axes = plt.subplots(len(rows), columns, figsize=(columns * width, len(rows) * (width + 0.25)), squeeze=False)
    for ax, (title, image) in zip(axes.flat, (panel for row in rows for panel in row.items()), strict=True):
        ax.imshow(image, cmap="gray", vmin=0, vmax=1)
        ax.set_title(title)
        ax.axis("off")


# %% [markdown]
# ## Training flows
# A chart is seen through phase screens that drift with the wind, 30 times a second. The flows are measured from the
# centroid of the first 40 frames. The paper has up to 1000 frames; 200 small ones do here.

# %%
SIZE, FRAMES, TRAIN = 96, 200, 160
scene = resolution_chart(SIZE, SIZE)
air = tr.PhaseScreenParams(d_over_r0=2.0, wind=(0.3,), layers=2, field_spacing=48)
clip = np.stack([frame.image for frame in tr.phase_screen_frames(scene, FRAMES, np.random.default_rng(3), air)])
centroid = tr.find_centroid(clip[:40]).image
flows = tr.estimate_flow(centroid, clip)
print(f"mean length of the flow {np.linalg.norm(flows, axis=-1).mean():.2f} px")

# %% [markdown]
# ## Eigenvalues
# Each panel of the upper row has the eigenvalues of A for n = 20 states and a longer training sequence. The lower row
# is a check with a known answer: flows drawn from a system in which every eigenvalue is 0.8 (cross).

# %%
known = smooth_flows(
    TRAIN, SIZE, SIZE, np.random.default_rng(4), SmoothFlowParams(correlation_length=10, persistence=0.8)
)
lengths = (21, 40, 80, 160)
circle = np.exp(2j * np.pi * np.linspace(0, 1, 200))
figure, axes = plt.subplots(2, 4, figsize=(9, 4.8), sharex=True, sharey=True)
for row, (name, training) in zip(axes, {"phase screens": flows, "known system": known}.items(), strict=True):
    for ax, length in zip(row, lengths, strict=True):
        values = tr.identify(training[:length], tr.DynamicsParams(rank=20)).eigenvalues
        ax.plot(circle.real, circle.imag, color="0.7")
        ax.plot(values.real, values.imag, "o", markersize=3)
        ax.set_title(f"{name}, τ = {length}")
        ax.set_aspect("equal")
    row[0].set_ylabel("imaginary part")
for ax in axes[1]:
    ax.plot(0.8, 0, "x", color="C1", markersize=9, markeredgewidth=2)
    ax.set_xlabel("real part")

# %% [markdown]
# With 21 flows for 20 states the system only repeats them: its eigenvalues are the 21st roots of unity other than 1, as
# in Figure 7a of the paper. More flows move them inside. Those of the known system gather about the cross, still
# scattered at τ = 160. Most of those of the phase screens settle near 1, some in pairs off the axis: modes that swing
# while the air drifts by. In the paper they settle at τ = 500 for n = 50.

# %% [markdown]
# The number of states matters as well. Here the training sequence is as long as it gets, and the largest modulus tells
# how slowly a prediction fades.

# %%
figure, axes = plt.subplots(1, 4, figsize=(11, 2.8), sharex=True, sharey=True)
for ax, rank in zip(axes, (5, 20, 60, 120), strict=True):
    dynamics = tr.identify(flows[:TRAIN], tr.DynamicsParams(rank=rank))
    values = dynamics.eigenvalues
    ax.plot(circle.real, circle.imag, color="0.7")
    ax.plot(values.real, values.imag, "o", markersize=3)
    ax.set_title(f"n = {rank}, {100 * dynamics.energy_share:.0f} % of the variance")
    ax.set_xlabel(f"real part; largest modulus {abs(values[0]):.2f}")
    ax.set_aspect("equal")
axes[0].set_ylabel("imaginary part")
automatic = tr.identify(flows[:TRAIN])
print(f"the automatic choice is n = {automatic.rank}, which holds {100 * automatic.energy_share:.0f} % of the variance")

# %% [markdown]
# More states hold more of the variance, but the same frames have to tell more about each. At n = 120 the eigenvalues
# move back towards the circle, as they do where there are too few frames. The automatic choice stops at 95 % of the
# variance or three frames a state, whichever comes first.

# %% [markdown]
# ## One-step prediction
# The system is identified from the first 160 flows. The prediction bends the centroid by the flow `mean + C A ξ`.

# %%
dynamics = tr.identify(flows[:TRAIN])
predicted = warp(centroid, tr.invert_flow(tr.predict_flow(dynamics, dynamics.last_state)))
actual = clip[TRAIN]
show(
    [
        {
            "centroid": centroid,
            f"frame {TRAIN}": actual,
            "predicted from the one before": predicted,
            "difference + 0.5": predicted - actual + 0.5,
            "centroid's difference + 0.5": centroid - actual + 0.5,
        }
    ]
)

# %% [markdown]
# The prediction bends the bars and letters as the frame does, and little is left of the difference, while the centroid
# differs at every edge.

# %% [markdown]
# A figure for it: the error of the predicted flow over the 40 frames that were not trained on, one to ten frames ahead.
# It is compared with taking the flow to stay as it is, and with taking it to vanish.

# %%
states = np.stack([dynamics.C.T @ (flow - dynamics.mean_flow).ravel() for flow in flows[TRAIN:]])
ahead = np.arange(1, 11)
errors = {"dynamic texture": [], "stays as it is": [], "the centroid": []}
for steps in ahead:
    step = np.linalg.matrix_power(dynamics.A, steps)
    guess = (states[:-steps] @ step.T @ dynamics.C.T).reshape(-1, SIZE, SIZE, 2) + dynamics.mean_flow
    future = flows[TRAIN + steps :]
    for name, flow in zip(errors, (guess, flows[TRAIN:-steps], dynamics.mean_flow[None]), strict=True):
        errors[name].append(np.sqrt(np.mean((future - flow) ** 2)))
figure, ax = plt.subplots(figsize=(5.5, 3))
for (name, values), style in zip(errors.items(), ("o-", "s--", "D:"), strict=True):
    ax.plot(ahead, values, style, label=name)
ax.set(xlabel="frames ahead", ylabel="error of the flow, px", ylim=(0, None))
for name, values in errors.items():
    print(f"{name:16} one frame ahead {values[0]:.2f} px, ten {values[-1]:.2f} px")
_ = ax.legend()

# %% [markdown]
# Both predictions are far better than the centroid. One frame ahead, the model does no better than to repeat the last
# flow, which the paper does not compare with: at 30 frames a second this air moves little in between, and the model
# loses what its states leave out. A few frames ahead the model is better, until both have lost most of what they knew.

# %% [markdown]
# ## Synthesis
# Fresh noise makes the system go on for ever. The centroid, bent by such flows, looks like the clip (Figure 6). The
# frames of a row are eight apart.

# %%
simulated = tr.simulate(dynamics, 200, np.random.default_rng(7))
numbers = (0, 8, 16, 24, 32)
show(
    [
        {f"clip, frame {k}": clip[k] for k in numbers},
        {f"synthesized, frame {k}": warp(centroid, tr.invert_flow(simulated[k])) for k in numbers},
    ]
)

# %% [markdown]
# Bars and letters lean in the lower row as they do in the upper one. The synthesized frames have neither noise nor a
# changing blur, for all are one image, bent.

# %% [markdown]
# Do they move alike? Left, the displacement of the middle pixel; right, the correlation over time, mean over many.

# %%
some = (slice(None), slice(0, None, 8), slice(0, None, 8), 0)
tracks = {"clip": flows[:TRAIN][some], "synthesized": np.stack(list(simulated))[some]}
lags = np.arange(1, 30)
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 2.8))
for (name, track), style in zip(tracks.items(), ("-", "--"), strict=True):
    centred = track - track.mean(axis=0)
    correlation = [np.mean(centred[lag:] * centred[:-lag]) / centred.var() for lag in lags]
    left.plot(np.arange(90) / 30, track[:90, 6, 6], style, label=name)
    right.plot(lags / 30, correlation, style, label=f"{name}, {centred.std():.2f} px rms")
left.set(xlabel="time, s", ylabel="dx, px")
right.set(xlabel="lag, s", ylabel="correlation")
for ax in (left, right):
    ax.legend()

# %% [markdown]
# The synthesized motion is about as strong and forgets as fast, for a third of a second. Beyond that the two curves
# part, which five seconds of one draw of the air do not decide. The clip has a fast jitter that the simulation lacks:
# the part of the measured flow outside the states. `turbrestore.synthesize_like` puts it back.
