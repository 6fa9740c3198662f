"""Simulated clips from which the width of a blur is learnt, by seven simulators of blur and one of none.

``screens``   anisoplanatic phase screens of random strength, diffraction, outer scale, path and wind
``kernels``   weighted sums of a few random speckled kernels, whose weights change from place to place and in time
``lens``      one Gaussian, disc or square for the whole clip, moved by smooth flows or not at all
``mixed``     Gaussians whose width changes from place to place and from frame to frame
``near``      the latter with blur of 3 to 8 pixels and long displacements, as of air that is close to the camera
``close``     kernels of 2 to 7.5 pixels and long displacements, more alike from place to place
``chamber``   the latter with 2.5 to 8 pixels before a sheet with a few words, as in a heat chamber
``none``      sharp or soft scenes that smooth flows move or that stand still

A camera exposes each frame of a scene (:mod:`blur_scenes`) for a while, adds noise, sharpens or smooths, burns in a
title, and compresses.
"""

from __future__ import annotations

import string
from dataclasses import dataclass

import cv2
import numpy as np
from blur_clips import h264
from blur_scenes import MARGIN, SCENES, SHEET, draw_scene, part_of_images
from numpy.typing import NDArray

from turbrestore.core.arrays import FloatArray
from turbrestore.registration.flow_algebra import invert_flow
from turbrestore.registration.warp import warp
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.sequence import CameraParams
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows

# Simulators and their shares of the clips.
SHARES = {"screens": 0.27, "kernels": 0.18, "lens": 0.17, "mixed": 0.13, "near": 0.06, "none": 0.13, "close": 0.06}
# A sheet with words in a heat chamber, which is drawn only if it is asked for.
CHAMBER = "chamber"
# Name of the scenes that are parts of given images.
GIVEN = "image"
# Sides of the rectangle around each pixel of a title within which most rings are that the removal of a blur makes.
AROUND_TITLE = (25, 25)
# Most moments of a clip.
MOMENTS = 100
# Widths of the stack of blurred scenes that ``mixed`` interpolates.
STACK = np.array([0.0, 0.4, 0.7, 1.0, 1.4, 1.9, 2.5, 3.2, 4.1, 5.2, 6.6, 8.2, 10.0])


@dataclass(frozen=True, eq=False)
class SimulatedClip:
    """Frames (T, H, W), the scene (H, W) in their mean geometry, and where a title and its surroundings hide it."""

    simulator: str
    scene: str
    frames: FloatArray
    truth: FloatArray
    hidden: NDArray[np.bool_]


def simulate(seed: int, simulator: str | None = None, images: list[NDArray[np.uint8]] | None = None) -> SimulatedClip:
    """Draw from a seed what is not given of a clip: its simulator, and images, of one of which its scene is a part."""
    rng = np.random.default_rng(seed)
    drawn = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    simulator = simulator or drawn
    side = int(rng.integers(168, 224)) if simulator in ("near", "close", CHAMBER) else int(rng.integers(112, 177))
    name = str(rng.choice(list(SCENES), p=list(SCENES.values())))
    if simulator == CHAMBER:
        name = SHEET
    if images is None:
        scene = draw_scene(name, side + 2 * MARGIN, rng)
    else:
        name, scene = GIVEN, part_of_images(images, side + 2 * MARGIN, rng)
    count = int(np.exp(rng.uniform(np.log(4), np.log(100))))
    frames, truth = SIMULATORS[simulator](scene, count, rng)
    bare = truth.copy()
    if rng.uniform() < 0.1:
        _burn_in_title([*frames, truth], rng)
    hidden = cv2.dilate(np.uint8(truth != bare), np.ones(AROUND_TITLE, np.uint8)).astype(bool)
    camera = smoothly_noisy if rng.uniform() < 0.12 else record
    return SimulatedClip(simulator, name, camera(frames, rng), truth, hidden)


def _burn_in_title(images: list[FloatArray], rng: np.random.Generator) -> None:
    """Write the same bright words on images, in a dark box half of the time."""
    height, width = images[0].shape
    word = "".join(rng.choice(list(string.ascii_uppercase + string.digits + ":-"), int(rng.integers(4, 9))))
    size, box = float(rng.uniform(0.35, 0.6)), rng.uniform() < 0.5
    (across, down), _ = cv2.getTextSize(word, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    left = int(rng.integers(4, max(5, width - across - 4)))
    base = int(rng.choice([down + 5, height - 6]))
    ink = np.zeros((height, width), np.uint8)
    cv2.putText(ink, word, (left, base), cv2.FONT_HERSHEY_SIMPLEX, size, 255, 1, cv2.LINE_AA)
    share = ink.astype(np.float32) / 255
    for image in images:
        if box:
            image[max(base - down - 4, 0) : base + 5, max(left - 3, 0) : left + across + 4] = 0.05
        image[...] += share * (0.95 - image)


def _screens(scene: FloatArray, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    params = PhaseScreenParams(d_over_r0=1.0)
    while params.tilt_rms() > 3.5 or params.strength == 1.0:
        params = PhaseScreenParams(
            d_over_r0=float(np.exp(rng.uniform(np.log(0.6), np.log(7)))),
            nyquist=float(rng.uniform(0.5, 2.2)),
            outer_scale=float(np.exp(rng.uniform(np.log(0.5), np.log(50)))),
            distance=float(np.exp(rng.uniform(np.log(500), np.log(6000)))),
            wind=(float(rng.uniform(1, 25)),),
        )
    lens = float(rng.choice([0, 0, 0.8, 1.3]))
    blurred = cv2.GaussianBlur(scene, (0, 0), lens) if lens else scene
    camera = CameraParams(photons=np.inf, read_noise=0.0)
    made = list(phase_screen_frames(blurred[MARGIN:-MARGIN, MARGIN:-MARGIN], count, rng, params, camera))
    mean = np.mean([frame.flow for frame in made], axis=0, dtype=np.float32)
    return np.stack([frame.image for frame in made]), warp(scene[MARGIN:-MARGIN, MARGIN:-MARGIN], invert_flow(mean))


def _kernels(
    scene: FloatArray, count: int, rng: np.random.Generator, widths: tuple[float, float] = (0.4, 3.0)
) -> tuple[FloatArray, FloatArray]:
    (count, moments), kinds = _exposures(count, rng), 7
    width = float(np.exp(rng.uniform(*np.log(widths))))
    stack = [cv2.filter2D(scene, -1, _speckles(width, rng), borderType=cv2.BORDER_REFLECT_101) for _ in range(kinds)]
    length, persistence = float(rng.uniform(10, 60)), float(rng.choice([0, 0.5, 0.9]))
    logs = _wandering(count * moments, (*scene.shape, kinds), length, persistence, rng)
    flows, frames = _flows(count * moments, scene.shape, rng, widths[1] > 4), []
    contrast = float(rng.uniform(0.5, 2.5))
    for log in logs:
        weights = np.exp(contrast * log)
        weights /= weights.sum(-1, keepdims=True)
        frames.append(sum(weights[..., kind] * stack[kind] for kind in range(kinds)))
    return _moved(scene, frames, flows, moments)


def _speckles(width: float, rng: np.random.Generator) -> FloatArray:
    """Random kernel of a few spots within a Gaussian of this width, pixels, centred."""
    radius = int(np.ceil(4 * width)) + 2
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(np.float64)
    kernel, spots = np.zeros_like(x), int(rng.integers(1, 7))
    spot = max(float(rng.uniform(0.35, 0.9)) * width, 0.3)
    spread = max(width**2 - spot**2, 0.0) ** 0.5
    places, powers = spread * rng.standard_normal((spots, 2)), rng.exponential(size=spots)
    places -= np.average(places, axis=0, weights=powers)
    for (across, down), power in zip(places, powers, strict=True):
        kernel += power * np.exp(-((x - across) ** 2 + (y - down) ** 2) / (2 * spot**2))
    return np.float32(kernel / kernel.sum())


def _lens(scene: FloatArray, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    blurred = _optics(scene, float(np.exp(rng.uniform(np.log(0.4), np.log(7)))), rng)
    flows = _flows(count, scene.shape, rng)
    if rng.uniform() < 0.5:
        flows = np.zeros_like(flows)
    # A lens blurs what the air has moved; what the air has blurred moves.
    return _moved(scene, [blurred] * count, flows)


def _optics(scene: FloatArray, width: float, rng: np.random.Generator) -> FloatArray:
    kind = str(rng.choice(["gaussian", "disc", "square"]))
    if kind == "gaussian":
        return cv2.GaussianBlur(scene, (0, 0), width)
    # Disc and square of the same variance, drawn eight times as fine.
    radius = width * (2.0 if kind == "disc" else 3**0.5)
    side = 2 * int(np.ceil(radius)) + 3
    fine = np.abs(np.mgrid[: 8 * side, : 8 * side] - (4 * side - 0.5)) / 8
    inside = (np.hypot(*fine) if kind == "disc" else fine.max(0)) <= radius
    kernel = inside.reshape(side, 8, side, 8).mean((1, 3))
    return cv2.filter2D(scene, -1, np.float32(kernel / kernel.sum()), borderType=cv2.BORDER_REFLECT_101)


def _mixed(
    scene: FloatArray, count: int, rng: np.random.Generator, widths: tuple[float, float] = (0.4, 2.6)
) -> tuple[FloatArray, FloatArray]:
    count, moments = _exposures(count, rng)
    middle, spread = float(np.exp(rng.uniform(*np.log(widths)))), float(rng.uniform(0.1, 0.6))
    persistence, length = float(rng.choice([0, 0.5, 0.9])), float(rng.uniform(12, 60))
    stack = np.stack([scene if width == 0 else cv2.GaussianBlur(scene, (0, 0), width) for width in STACK], -1)
    logs = _wandering(count * moments, (*scene.shape, 1), length, persistence, rng)[..., 0]
    rows, columns = np.indices(scene.shape)
    frames = []
    for log in logs:
        # Variances are interpolated: those of Gaussians add up.
        place = np.interp(np.square(middle * np.exp(spread * log)), np.square(STACK), np.arange(len(STACK)))
        low = np.minimum(place.astype(int), len(STACK) - 2)
        share = np.float32(place - low)
        frames.append((1 - share) * stack[rows, columns, low] + share * stack[rows, columns, low + 1])
    flows = _flows(count * moments, scene.shape, rng, near=widths[1] > 4)
    return _moved(scene, frames, flows, moments)


def _near(scene: FloatArray, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    return _mixed(scene, count, rng, (3.0, 8.0))


def _close(scene: FloatArray, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    return _kernels(scene, max(count, 10), rng, (2.0, 7.5))


def _chamber(scene: FloatArray, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    return _kernels(scene, max(count, 10), rng, (2.5, 8.0))


def _none(scene: FloatArray, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    flows = _flows(count, scene.shape, rng)
    return _moved(scene, [scene] * count, flows * (rng.uniform() < 0.6))


SIMULATORS = {
    "screens": _screens,
    "kernels": _kernels,
    "lens": _lens,
    "mixed": _mixed,
    "near": _near,
    "close": _close,
    "none": _none,
    CHAMBER: _chamber,
}


def _flows(count: int, shape: tuple[int, ...], rng: np.random.Generator, near: bool = False) -> FloatArray:
    params = SmoothFlowParams(
        rms=float(np.exp(rng.uniform(np.log(1.5), np.log(5)) if near else rng.uniform(np.log(0.1), np.log(2.2)))),
        correlation_length=float(rng.uniform(16, 50) if near else rng.uniform(7, 30)),
        persistence=float(rng.choice([0, 0.5, 0.9])),
    )
    return smooth_flows(count, *shape[:2], rng, params)


def _exposures(count: int, rng: np.random.Generator) -> tuple[int, int]:
    """Draw how many moments the exposure of a frame lasts, and limit the number of frames to what can be held."""
    moments = int(rng.choice([1, 2, 4, 8], p=[0.6, 0.15, 0.15, 0.1]))
    return min(count, MOMENTS // moments), moments


def _moved(
    scene: FloatArray, frames: list[FloatArray], flows: FloatArray, moments: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Move blurred scenes, each by its flow, and the scene by their mean; leave the margin out.

    A frame is the mean of several moments.
    """
    inner = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
    moved = np.stack([warp(frame, flow)[inner] for frame, flow in zip(frames, flows, strict=True)])
    exposed = moved.reshape(-1, moments, *moved.shape[1:]).mean(1)
    return exposed, warp(scene, flows.mean(0))[inner]


def _wandering(
    count: int, shape: tuple[int, ...], length: float, persistence: float, rng: np.random.Generator
) -> FloatArray:
    """Fields (count, H, W, n) of unit variance, smooth over a length in pixels, that follow an AR(1) process."""
    height, width, kinds = shape
    coarse = [int(np.ceil(side / length)) + 3 for side in (height, width)]
    state, fields = rng.standard_normal((*coarse, kinds)), []
    for _ in range(count):
        size = coarse[1] * int(length), coarse[0] * int(length)
        grown = cv2.resize(np.float32(state), size, interpolation=cv2.INTER_CUBIC)
        fields.append(grown.reshape(*grown.shape[:2], kinds)[:height, :width])
        state = persistence * state + np.sqrt(1 - persistence**2) * rng.standard_normal(state.shape)
    return np.stack(fields)


def record(frames: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Frames as a camera keeps them: noise, its reduction or sharpening, H.264, eight bits."""
    noise = float(np.exp(rng.uniform(np.log(0.0005), np.log(0.06))))
    level = np.sqrt(np.maximum(frames, 0.02)) / 0.7 if rng.uniform() < 0.4 else 1.0
    kind, grain = str(rng.choice(["white", "smooth", "reduced"], p=[0.6, 0.2, 0.2])), rng.standard_normal(frames.shape)
    if kind == "smooth":
        grain = np.stack([cv2.GaussianBlur(one, (0, 0), float(rng.uniform(0.5, 1.2))) for one in grain])
        grain /= grain.std()
    frames = np.clip(frames + noise * level * grain, 0, 1).astype(np.float32)
    if kind == "reduced":
        frames = np.stack([cv2.bilateralFilter(frame, 5, 3 * noise, 1.5) for frame in frames])
    if rng.uniform() < 0.2:
        width, much = float(rng.uniform(0.7, 1.5)), float(rng.uniform(0.2, 0.8))
        frames = np.stack([frame + much * (frame - cv2.GaussianBlur(frame, (0, 0), width)) for frame in frames])
    if rng.uniform() < 0.35:
        even = tuple(side - side % 2 for side in frames.shape[1:])
        coded = h264(frames[:, : even[0], : even[1]], int(rng.integers(18, 35)))
        pad = [(0, 0), *((0, side - own) for side, own in zip(frames.shape[1:], even, strict=True))]
        frames = np.pad(coded, pad, mode="edge")
    return np.rint(255 * np.clip(frames, 0, 1)).astype(np.float32) / 255


def smoothly_noisy(frames: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Frames with smooth noise of 1 to 10 %, as of film grain, a digital zoom or strong reduction of noise."""
    noise, width = float(np.exp(rng.uniform(np.log(0.01), np.log(0.1)))), float(rng.uniform(0.6, 2.0))
    grain = np.stack([cv2.GaussianBlur(one, (0, 0), width) for one in rng.standard_normal(frames.shape)])
    frames = np.clip(frames + noise * grain / grain.std(), 0, 1)
    return np.rint(255 * frames).astype(np.float32) / 255
