"""A planet that turns during a clip: its surface is turned back on its ellipsoid before frames are registered.

Symbols
-------
a, q : equatorial radius of the disc, pixels, and polar over equatorial radius; ψ : angle of the equator in the image
β : latitude of the centre of the disc; T : period of the rotation; t : time from the middle of the clip, seconds
o, e₁, e₂ : direction to the observer, and axes of the image along equator and pole, in units of a, planet at rest

A pixel of the disc sees the point ``P = u e₁ + v e₂ + s o`` of the ellipsoid ``P_x² + P_y² + P_z² / q² = 1``, with
the larger s that solves this.  At the time t the surface has turned by ``2π t / T`` about z, so that P lies at P′ and
is seen at ``(P′·e₁, P′·e₂)``.  The flow D_t from the one place to the other is zero at the limb and outside.  Frames
are warped by it once, ``I_t ∘ (id + D_t)``, so that all show the surface of the middle of the clip.

Which way it turns depends on how the telescope shows the sky, so both ways are tried, and that is taken with which the
first and the last third of the clip are more alike.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.arrays import FloatArray, luminance
from ..core.errors import ConfigurationError, DataError
from ..footage.object_crop import find_object
from ..io.pixels import unrepaired
from ..io.source import FrameSource, Window
from ..registration.camera.global_shift import correlation
from ..registration.warp import warp

# Published sidereal periods of what is seen, hours, and flattening; of system II of Jupiter, and III of Saturn.
PLANETS = {"jupiter": (9.9280, 0.0649), "saturn": (10.656, 0.0980), "mars": (24.6229, 0.0059)}
# Brightness of the limb, as a share of that of the disc, chosen.
_LIMB = 0.3
# Flattening that must be seen for its direction to say where the pole is, chosen: Mars has less, Jupiter has more.
_FLAT = 0.02
# Frames of each third that are compared, share of the radius within which, window of detail, pixels; all chosen.
_COMPARED, _WITHIN, _DETAIL = 40, 0.8, 4.0


@dataclass(frozen=True)
class Rotation:
    """How a planet turns."""

    period: float  # hours
    flattening: float
    # Of the equator in the image, degrees from the x axis towards the y axis; None where the outline tells it.
    angle: float | None = None
    # Of the centre of the disc, degrees, positive where the pole that is up in the image is turned to the observer.
    latitude: float = 0.0


@dataclass(frozen=True)
class Disc:
    """Outline of a planet in an image, pixels and radians."""

    x: float
    y: float
    radius: float
    angle: float


def read_rotation(text: str) -> Rotation:
    """Read ``PLANET`` or a period in hours, and perhaps ``,ANGLE`` and ``,LATITUDE`` in degrees."""
    name, *rest = (word.strip() for word in text.lower().split(","))
    wrong = ConfigurationError(
        f"derotate: expected {', '.join(PLANETS)} or a period in hours, and perhaps ,ANGLE,LATITUDE, found {text!r}"
    )
    try:
        period, flattening = PLANETS[name] if name in PLANETS else (float(name.removesuffix("h")), 0.0)
        numbers: list[float | None] = [*map(float, rest), *[None] * (2 - len(rest))]
        angle, latitude = numbers
    except ValueError as error:
        raise wrong from error
    if not (period > 0 and np.isfinite(period)) or not -90 < (latitude or 0) < 90:
        raise wrong
    return Rotation(period, flattening, angle, latitude or 0.0)


def derotated(source: FrameSource, rotation: Rotation) -> FrameSource:
    """Turn the surface of a planet back to where it is in the middle of a clip; every frame is read once.

    DataError where the times of the frames are not known, or no disc is found.
    """
    times = _times(source)
    images, places = _thirds(source)
    disc = find_disc(images.mean(axis=0), rotation)
    centre = np.median(list(places.values()), axis=0)
    offsets = {number: place - centre for number, place in places.items()}
    middle = float(times[len(times) // 2])
    early, late = (float(np.mean(part)) - middle for part in (np.array_split(times, 3)[0], np.array_split(times, 3)[2]))
    turned = {}
    for way in (1.0, -1.0):
        ends = [
            warp(image, rotation_flow(image.shape, disc, rotation, way * time))
            for image, time in zip((images[0], images[2]), (early, late), strict=True)
        ]
        turned[way] = _likeness(ends[0], ends[1], disc)
    way = max(turned, key=lambda one: turned[one])
    after = dict(zip(source.numbers, way * (times - middle), strict=True))
    angle = float(np.degrees(2 * np.pi * (times[-1] - times[0]) / (3600 * rotation.period)))

    def turn_back(number: int, values: FloatArray, window: Window) -> FloatArray:
        rows, columns = window
        dx, dy = offsets.get(number, np.zeros(2))
        corner = rows.start - source.window[0].start, columns.start - source.window[1].start
        placed = dataclasses.replace(disc, x=disc.x + dx - corner[1], y=disc.y + dy - corner[0])
        return warp(values, rotation_flow(values.shape, placed, rotation, after[number]))

    remark = (
        f"turned back by {angle:.2f}° in all, {'against' if way < 0 else 'with'} the x axis, on a disc of "
        f"{2 * disc.radius:.0f} pixels at {np.degrees(disc.angle):.1f}°"
    )
    found = source.adjusted(turn_back)
    return dataclasses.replace(found, repair=source.repair or unrepaired, warnings=(*source.warnings, remark))


def find_disc(image: FloatArray, rotation: Rotation) -> Disc:
    """Fit the outline of a planet by the area and the second moments of what is bright.

    ``image`` (H, W).
    """
    place = find_object(image)
    if place is None or place.cut:
        raise DataError("derotate: expected the whole disc of a planet in the frames, found none")
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    field = float(np.median(smooth[[0, -1]]))
    bright = np.uint8(smooth > field + _LIMB * (float(np.percentile(smooth[smooth > field], 90)) - field))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(bright)
    largest = 1 + int(np.argmax(boxes[1:, cv2.CC_STAT_AREA]))
    rows, columns = np.nonzero(labels == largest)
    variances, axes = np.linalg.eigh(np.cov(np.stack([columns, rows])))
    latitude = np.radians(rotation.latitude)
    polar = float(np.hypot((1 - rotation.flattening) * np.cos(latitude), np.sin(latitude)))
    angle = 0.0 if rotation.angle is None else float(np.radians(rotation.angle))
    if rotation.angle is None and 1 - np.sqrt(variances[0] / variances[1]) > _FLAT:
        angle = float(np.arctan2(axes[1, 1], axes[0, 1]))
        angle = (angle + np.pi / 2) % np.pi - np.pi / 2
    radius = float(np.sqrt(len(rows) / (np.pi * polar)))
    return Disc(float(columns.mean()), float(rows.mean()), radius, angle)


def rotation_flow(shape: tuple[int, ...], disc: Disc, rotation: Rotation, seconds: float) -> FloatArray:
    """Flow D_t from where a point of the surface is seen to where it is seen some seconds later, pixels.

    Returns (H, W, 2).
    """
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    x, y = (x - disc.x) / disc.radius, (y - disc.y) / disc.radius
    cosine, sine = np.cos(disc.angle), np.sin(disc.angle)
    # Rows count downwards, and the pole is up.
    u, v = cosine * x + sine * y, sine * x - cosine * y
    cos_b, sin_b = np.cos(np.radians(rotation.latitude)), np.sin(np.radians(rotation.latitude))
    q2 = (1 - rotation.flattening) ** 2
    # (−v sin β + s cos β)² + u² + (v cos β + s sin β)² / q² = 1, a quadratic equation for s.
    square, half = cos_b**2 + sin_b**2 / q2, v * sin_b * cos_b * (1 / q2 - 1)
    rest = v**2 * (sin_b**2 + cos_b**2 / q2) + u**2 - 1
    root = half**2 - square * rest
    s = (-half + np.sqrt(np.maximum(root, 0))) / square
    px, py, pz = s * cos_b - v * sin_b, u, s * sin_b + v * cos_b
    turn = 2 * np.pi * seconds / (3600 * rotation.period)
    qx, qy = np.cos(turn) * px - np.sin(turn) * py, np.sin(turn) * px + np.cos(turn) * py
    du, dv = qy - u, pz * cos_b - qx * sin_b - v
    # What turns out of sight, and what is no disc, stays.
    seen = (root > 0) & (qx * cos_b + pz / q2 * sin_b > 0)
    du, dv = np.where(seen, du, 0), np.where(seen, dv, 0)
    return (disc.radius * np.stack([cosine * du + sine * dv, sine * du - cosine * dv], -1)).astype(np.float32)


def _times(source: FrameSource) -> NDArray[np.float64]:
    if source.timestamps is not None:
        return np.asarray(source.timestamps, np.float64)
    if not source.fps:
        raise DataError(
            f"{source.name}: expected times of its frames to turn a planet back, found none; a SER has them"
        )
    return np.arange(len(source)) / source.fps


def _thirds(source: FrameSource) -> tuple[FloatArray, dict[int, NDArray[np.float64]]]:
    """Mean of some frames of each third, moved onto each other, and where the disc is in every frame."""
    sums, counts = np.zeros((3, *source.shape[1:3])), np.zeros(3)
    places: dict[int, NDArray[np.float64]] = {}
    first: NDArray[np.float64] | None = None
    step = max(1, len(source) // (3 * _COMPARED))
    for place, frame in enumerate(source):
        grey = luminance(frame)
        found = find_object(grey)
        if found is None:
            continue
        centre = np.array([found.x, found.y])
        places[source.numbers[place]] = centre
        first = centre if first is None else first
        if place % step == 0:
            third = min(3 * place // len(source), 2)
            shift = np.broadcast_to((centre - first).astype(np.float32), (*grey.shape, 2))
            sums[third] += warp(grey, shift)
            counts[third] += 1
    if not counts.all():
        raise DataError(f"{source.name}: expected a bright disc in the frames, found none")
    return (sums / counts[:, None, None]).astype(np.float32), places


def _likeness(a: FloatArray, b: FloatArray, disc: Disc) -> float:
    """Correlation of the detail of two images within a disc."""
    y, x = np.mgrid[: a.shape[0], : a.shape[1]]
    within = np.hypot(x - disc.x, y - disc.y) < _WITHIN * disc.radius
    details = [cv2.GaussianBlur(one, (0, 0), 1.0) - cv2.GaussianBlur(one, (0, 0), _DETAIL) for one in (a, b)]
    return correlation(*(detail[within] for detail in details))
