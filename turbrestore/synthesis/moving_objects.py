"""Objects on straight paths in front of a scene, with the truth of every frame.

Symbols
-------
p(k) : centre of an object at frame k, pixels, ``p(0) + k v``; v : velocity, pixels a frame

An object is an ellipse with stripes that travel with it.  One that has left the scene on one side enters it on the
opposite one.  The air lies in front of the objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray
from ..core.errors import require_between

# Semi-axes in shares of the shorter side of the scene, and speeds, pixels a frame; all chosen.
_SIZES, _SPEEDS = (0.06, 0.12), (1.0, 3.0)
# Period of the stripes in semi-axes, and their amplitude, intensity; chosen, as is the largest number of objects.
_PERIOD, _AMPLITUDE = 0.7, 0.15
MOST_OBJECTS = 100


@dataclass(frozen=True)
class MovingObject:
    """An ellipse that moves at constant velocity."""

    # Centre at frame 0, pixels, and velocity, pixels a frame, (x, y).
    start: tuple[float, float]
    velocity: tuple[float, float]
    semi_axes: tuple[float, float]  # pixels, along x and y
    brightness: float  # mean intensity
    direction: float  # of the stripes, rad


def draw_objects(count: int, shape: tuple[int, ...], rng: np.random.Generator) -> tuple[MovingObject, ...]:
    """Draw objects at random places, with random velocities."""
    require_between("moving", count, 0, MOST_OBJECTS, "objects")
    height, width = shape[:2]
    objects = []
    for _ in range(count):
        angle, speed = rng.uniform(0, 2 * np.pi), rng.uniform(*_SPEEDS)
        semi_axes = rng.uniform(*_SIZES, 2) * min(height, width)
        # Dark or bright, so that an object stands out from most scenes.
        brightness = rng.choice([0.2, 0.8])
        objects.append(
            MovingObject(
                start=(float(rng.uniform(0, width)), float(rng.uniform(0, height))),
                velocity=(float(speed * np.cos(angle)), float(speed * np.sin(angle))),
                semi_axes=(float(semi_axes[0]), float(semi_axes[1])),
                brightness=float(brightness),
                direction=float(rng.uniform(0, np.pi)),
            )
        )
    return tuple(objects)


def with_objects(
    scene: FloatArray, objects: Sequence[MovingObject], number: int
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Scene with the objects in front of it, at one frame.

    ``scene`` (H, W) or (H, W, 3); returns ``mask`` (H, W).
    """
    height, width = scene.shape[:2]
    image, mask = scene.copy(), np.zeros((height, width), bool)
    x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    for item in objects:
        a, b = item.semi_axes
        along_x = x - _wrapped(item.start[0] + number * item.velocity[0], a, width)
        along_y = y - _wrapped(item.start[1] + number * item.velocity[1], b, height)
        # Distance from the outline, pixels, to first order: the outline is smooth over one pixel.
        radius = np.hypot(along_x / a, along_y / b)
        cover = np.clip(0.5 + (1 - radius) * min(a, b), 0, 1).astype(np.float32)
        position = along_x * np.cos(item.direction) + along_y * np.sin(item.direction)
        stripes = _AMPLITUDE * np.cos(2 * np.pi / (_PERIOD * min(a, b)) * position)
        shown = np.asarray(item.brightness + stripes, np.float32)
        if scene.ndim == 3:
            cover, shown = cover[..., None], shown[..., None]
        image += cover * (shown - image)
        mask |= (cover if scene.ndim == 2 else cover[..., 0]) >= 0.5
    return image, mask


def _wrapped(centre: float, semi_axis: float, size: int) -> float:
    """Centre of an object that re-enters on the opposite side once it has left the scene."""
    return float((centre + semi_axis) % (size + 2 * semi_axis)) - semi_axis
