"""Clips that the pictures show: a scene, its frames through simulated air, and what is restored from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import turbrestore as tr
from turbrestore.core.arrays import FloatArray
from turbrestore.synthesis.atmosphere import STRENGTHS
from turbrestore.synthesis.moving_objects import MovingObject


@dataclass(frozen=True, eq=False)
class Clip:
    """A synthesized clip, the scene without what moves in it, and the restoration of its frames."""

    truth: FloatArray
    frames: FloatArray
    restoration: tr.Restoration

    @property
    def frame(self) -> FloatArray:
        """The middle frame."""
        return self.frames[len(self.frames) // 2]


def film(
    scene: FloatArray, strength: float, count: int, noise: float = 0.005, objects: Sequence[MovingObject] = ()
) -> FloatArray:
    """Synthesize frames of a scene through air of a strength D/r0, shape (T, H, W) or (T, H, W, 3)."""
    air, camera = tr.PhaseScreenParams(d_over_r0=strength), tr.CameraParams(read_noise=noise)
    made = tr.phase_screen_frames(scene, count, np.random.default_rng(7), air, camera, objects=objects)
    return np.stack([frame.image for frame in made])


def clip(scene: FloatArray, strength: str, count: int, noise: float, objects: Sequence[MovingObject] = ()) -> Clip:
    """Synthesize a clip of a named strength, and restore it with the defaults."""
    frames = film(scene, STRENGTHS[strength], count, noise, objects)
    return Clip(scene, frames, tr.restore(frames))
