"""Clips that benchmarks restore: the project's own synthetic ones, and stored ones where there are any.

Settings of the package were chosen on some of them.  Clips called ``drawn_…`` are judged on: they show scenes that no
other clip shows, and everything about them is drawn from the version and the number of the draw, so that a release has
clips that nobody has seen before.

Stored clips lie under the folder that ``TURBRESTORE_DATA`` names: ``simulated/NAME/clip.*`` with ``truth.png``, and
``real/NAME/clip.*`` with ``words.txt`` where the text is known and ``peer_*.png`` where other methods' results are.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from functools import partial
from pathlib import Path

import numpy as np
from blur_clips import REPORTED, Case, behind_air, behind_lens

import turbrestore
from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import InputNotFoundError
from turbrestore.io.images.image_files import read_image
from turbrestore.io.video import open_frames
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import STRENGTHS, PhaseScreenParams
from turbrestore.synthesis.scenes import SCENES, printed_words
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

# Synthetic clips: frames and pixels a side.
COUNT, SMOOTH_SIDE, SCREEN_SIDE = 60, 192, 256
SMOOTH_SCENES = ("chart", "camera", "words", "cat")
# Scenes that strong air moves, and the root mean squares of the displacement, pixels.
STRONG_SCENES, STRONG_RMS = ("camera", "cat"), {"strong": 5.0, "stronger": 8.0}
SCREEN_SCENES = (("weak", "chart"), ("medium", "camera"), ("medium", "brick"), ("strong", "words"))
# Small print: tesseract reads all of it through a Gaussian of 1.5 px, and half of it through one of 2.5 px.
TEXT = (
    *("harbour", "window", "engine", "seventh", "market", "glacier", "copper", "journey", "planet", "bridge"),
    *("lantern", "quarter", "silence", "meadow", "thunder", "captain", "ribbon", "orchard", "pepper", "village"),
    *("marble", "sunset", "library", "compass", "feather"),
)
PIXELS_A_WORD = 10
# Of the scenes that no constant was set on, those that no other clip here shows.
DRAWN, DRAWN_SCENES = "drawn_", tuple(name for name in REPORTED if name not in ("cat", "chart"))
WIDEST_LENS = 2.5
# Number of the draw of this version.  The first four of 0.4.0 were looked at while the removal of blur was changed.
DRAW = 5
# What is read of real clips, so that a benchmark of all takes minutes.
MOST_FRAMES, LARGEST_SIDE = 60, 320


@dataclass(frozen=True, eq=False)
class Clip:
    """Frames and what is known about them.

    Attributes
    ----------
    frames : ndarray, float32, shape (T, H, W) or (T, H, W, 3)
    truth : ndarray or None
        The scene.
    words : tuple of str
        Words to be read; none where there is no text.
    peers : dict of str to ndarray
        Results of other methods.
    centroid : ndarray or None
        The scene at the mean geometry of the frames, which is all that they can tell.
    """

    frames: FloatArray
    truth: FloatArray | None = None
    words: tuple[str, ...] = ()
    peers: dict[str, FloatArray] = field(default_factory=dict)
    centroid: FloatArray | None = None


def find_clips(patterns: Sequence[str] = ()) -> dict[str, Callable[[], Clip]]:
    """Loaders of the clips whose names match one of the patterns, of all clips without patterns.

    Raises
    ------
    InputNotFoundError
        A pattern matches nothing.
    """
    known = {**drawn_clips(turbrestore.__version__), **_synthetic(), **_stored()}
    for pattern in patterns:
        if not any(fnmatch(name, pattern) for name in known):
            raise InputNotFoundError(f"{pattern}: no such clip; there are {', '.join(known)}")
    return {name: load for name, load in known.items() if not patterns or any(fnmatch(name, one) for one in patterns)}


def data_folder() -> Path | None:
    """Folder of stored clips, None where there is none."""
    named = os.environ.get("TURBRESTORE_DATA", "")
    return Path(named) if named and Path(named).is_dir() else None


def is_reported(name: str) -> bool:
    """Whether nothing was chosen on the clip of this name."""
    return name.startswith(DRAWN)


def drawn_clips(version: str) -> dict[str, Callable[[], Clip]]:
    """Clips that are drawn for a version: every scene behind phase screens, and moved behind a lens."""
    return {
        f"{DRAWN}{kind}_{scene}": partial(_drawn, scene, kind, zlib.crc32(f"{version}.{DRAW} {kind} {scene}".encode()))
        for kind in ("air", "lens")
        for scene in DRAWN_SCENES
    }


def _drawn(scene: str, kind: str, seed: int) -> Clip:
    rng = np.random.default_rng(seed)
    number = float(rng.integers(2) if kind == "air" else rng.uniform(0, WIDEST_LENS))
    case = Case("drawn", scene, kind, number)
    # H.264 does not give the same frames every time, and two runs shall have the same clips.
    frames, truth = behind_air(case, rng, codec=False) if kind == "air" else behind_lens(case, rng)
    # As a camera with 8 bits stores them; the truth is the scene at the mean geometry.
    stored = np.rint(255 * np.clip(frames, 0, 1)).astype(np.float32) / np.float32(255)
    return Clip(stored, np.clip(truth, 0, 1))


def _synthetic() -> dict[str, Callable[[], Clip]]:
    smooth = {f"smooth_{scene}": partial(_smooth, scene) for scene in SMOOTH_SCENES}
    strong = {
        f"{name}_{scene}": partial(_smooth, scene, rms) for name, rms in STRONG_RMS.items() for scene in STRONG_SCENES
    }
    screens = {f"screens_{strength}_{scene}": partial(_screens, strength, scene) for strength, scene in SCREEN_SCENES}
    return {**smooth, **strong, **screens}


def _smooth(scene: str, rms: float = SmoothFlowParams.rms) -> Clip:
    """Smooth random flows without physics, a Gaussian blur that changes from frame to frame, and noise."""
    rng = np.random.default_rng(SMOOTH_SCENES.index(scene))
    truth, words = _scene(scene, SMOOTH_SIDE)
    flows = smooth_flows(COUNT, SMOOTH_SIDE, SMOOTH_SIDE, rng, SmoothFlowParams(rms=rms))
    # The scene is the geometry that is looked for.
    flows -= flows.mean(axis=0)
    frames = [distort(truth, flow[None], rng, blur=1 + rng.random(), noise=0.01)[0] for flow in flows]
    return Clip(np.stack(frames), truth, words)


def _screens(strength: str, scene: str) -> Clip:
    truth, words = _scene(scene, SCREEN_SIDE)
    params = PhaseScreenParams(d_over_r0=STRENGTHS[strength])
    frames = phase_screen_frames(truth, COUNT, np.random.default_rng(1), params)
    return Clip(np.stack([frame.image for frame in frames]), truth, words)


def _scene(name: str, side: int) -> tuple[FloatArray, tuple[str, ...]]:
    """Scene and the words on it."""
    if name != "words":
        return SCENES[name](side, side), ()
    words = TEXT[: side // PIXELS_A_WORD]
    return printed_words(side, side, words), words


def _stored() -> dict[str, Callable[[], Clip]]:
    root = data_folder()
    if root is None:
        return {}
    files = sorted(root.glob("simulated/*/clip.*")) + sorted(root.glob("real/*/clip.*"))
    return {path.parent.name: partial(_read, path) for path in files}


def _read(path: Path) -> Clip:
    truth, text = path.with_name("truth.png"), path.with_name("words.txt")
    peers = {peer.stem.removeprefix("peer_"): read_image(peer).image for peer in sorted(path.parent.glob("peer_*.png"))}
    if truth.is_file():
        bent = path.with_name("truth_centroid.png")
        centroid = read_image(bent).image if bent.is_file() else None
        return Clip(open_frames(path).read(), read_image(truth).image, peers=peers, centroid=centroid)
    words = tuple(text.read_text().split()) if text.is_file() else ()
    return Clip(_middle(path, whole=bool(words)), words=words, peers=peers)


def _middle(path: Path, whole: bool) -> FloatArray:
    """First frames of a video, cut to their middle unless the whole of it is wanted."""
    count, height, width = open_frames(path).shape[:3]
    side = max(height, width) if whole else LARGEST_SIDE
    h, w = min(height, side), min(width, side)
    region = ((width - w) // 2, (height - h) // 2, w, h)
    return open_frames(path, frames=(0, min(count, MOST_FRAMES), None), roi=region).read()
