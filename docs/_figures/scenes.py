"""Scenes that are drawn for the pictures of the documentation: a street, a sign and a planet, in colour."""

from __future__ import annotations

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from turbrestore.core.arrays import FloatArray
from turbrestore.synthesis.moving_objects import MovingObject
from turbrestore.synthesis.scenes import picture

# Drawn this many times larger and averaged down, which avoids jagged edges.
_OVERSAMPLING = 4


def sign(height: int, width: int) -> FloatArray:
    """Draw a blue road sign with places and distances in front of a brick wall."""
    scale = _OVERSAMPLING * width / 224
    wall = _enlarged(picture("brick", height, width))[..., None] * np.float32([0.95, 0.80, 0.70]) + 0.12
    canvas = _canvas(wall)
    drawing = ImageDraw.Draw(canvas)
    frame = [round(scale * 12), round(scale * 24), round(scale * 212), round(scale * 200)]
    drawing.rounded_rectangle(frame, radius=10 * scale, fill=(238, 240, 242))
    inner = [frame[0] + 3 * scale, frame[1] + 3 * scale, frame[2] - 3 * scale, frame[3] - 3 * scale]
    drawing.rounded_rectangle(inner, radius=8 * scale, fill=(22, 66, 140))
    lines = (("Harbour", "3", 30), ("Old Bridge", "12", 25), ("Observatory", "47", 20), ("Lighthouse", "85", 16))
    y = 54.0
    for place, distance, size in lines:
        font = ImageFont.load_default(size * scale)
        drawing.text((26 * scale, y * scale), place, fill=(242, 244, 246), font=font, anchor="lm")
        drawing.text((198 * scale, y * scale), distance, fill=(242, 244, 246), font=font, anchor="rm")
        y += 1.42 * size
    drawing.text(
        (26 * scale, 188 * scale),
        "toll road from km 21.5",
        fill=(242, 244, 246),
        font=ImageFont.load_default(11 * scale),
        anchor="lm",
    )
    return _reduced(canvas, height, width)


def street(height: int, width: int) -> FloatArray:
    """Draw a row of brick houses with windows behind a road with lamps and a sign."""
    scale = _OVERSAMPLING * width / 224
    tall, wide = height * _OVERSAMPLING, width * _OVERSAMPLING
    fall = np.linspace(0, 1, tall, dtype=np.float32)[:, None, None]
    canvas = _canvas(
        np.broadcast_to(np.float32([0.62, 0.74, 0.88]) + fall * np.float32([0.3, 0.2, 0.05]), (tall, wide, 3))
    )
    bricks = _enlarged(_small_texture("brick", height, width))
    houses = (
        (0, 62, 40, (0.98, 0.62, 0.50)),
        (62, 58, 56, (1.05, 0.95, 0.78)),
        (120, 64, 30, (0.80, 0.66, 0.62)),
        (184, 60, 48, (0.95, 0.80, 0.66)),
    )
    drawing = ImageDraw.Draw(canvas)
    ground = round(150 * scale)
    for left, across, top, tint in houses:
        x, y, w = round(left * scale), round(top * scale), round(across * scale)
        wall = bricks[y:ground, x : min(x + w, wide)][..., None] * np.float32(tint) + 0.08
        canvas.paste(_canvas(wall), (x, y))
        drawing.polygon(
            [(x, y), (x + w, y), (x + w - 6 * scale, y - 11 * scale), (x + 6 * scale, y - 11 * scale)],
            fill=(92, 52, 44),
        )
        for column in range(3):
            for row in range(int((150 - top) // 26)):
                u, v = x + (6 + column * (across - 4) / 3) * scale, y + (7 + 26 * row) * scale
                drawing.rectangle(
                    [u - 1.5 * scale, v - 1.5 * scale, u + 11.5 * scale, v + 15.5 * scale], fill=(232, 228, 218)
                )
                drawing.rectangle([u, v, u + 10 * scale, v + 14 * scale], fill=(44, 58, 78))
                drawing.line(
                    [u + 5 * scale, v, u + 5 * scale, v + 14 * scale], fill=(232, 228, 218), width=round(scale)
                )
                drawing.line(
                    [u, v + 7 * scale, u + 10 * scale, v + 7 * scale], fill=(232, 228, 218), width=round(scale)
                )
    stones = _enlarged(_small_texture("gravel", height, width))
    road = np.repeat((0.25 + 0.4 * stones[ground:])[..., None], 3, axis=2) * np.float32([0.95, 0.97, 1.0])
    canvas.paste(_canvas(road), (0, ground))
    drawing.rectangle([0, ground, wide, ground + 7 * scale], fill=(176, 172, 164))
    drawing.rectangle([0, ground + 7 * scale, wide, ground + 9 * scale], fill=(120, 118, 114))
    for left in range(0, 224, 32):
        drawing.rectangle(
            [left * scale, ground + 40 * scale, (left + 18) * scale, ground + 43 * scale], fill=(235, 232, 215)
        )
    for x in (30, 140):
        drawing.rectangle([x * scale, 46 * scale, (x + 2.5) * scale, ground + 4 * scale], fill=(38, 42, 46))
        drawing.ellipse(
            [(x - 5) * scale, 38 * scale, (x + 7.5) * scale, 48 * scale],
            fill=(246, 240, 205),
            outline=(38, 42, 46),
            width=round(scale),
        )
    drawing.rectangle([187 * scale, 92 * scale, 189.5 * scale, ground + 4 * scale], fill=(70, 74, 78))
    drawing.rounded_rectangle(
        [168 * scale, 68 * scale, 210 * scale, 98 * scale],
        radius=3 * scale,
        fill=(24, 100, 66),
        outline=(240, 242, 240),
        width=round(1.5 * scale),
    )
    drawing.text(
        (189 * scale, 76 * scale), "EXIT", fill=(245, 246, 245), font=ImageFont.load_default(11 * scale), anchor="mm"
    )
    drawing.text(
        (189 * scale, 89 * scale), "27 B", fill=(245, 246, 245), font=ImageFont.load_default(13 * scale), anchor="mm"
    )
    return _reduced(canvas, height, width)


def traffic(height: int, width: int) -> tuple[MovingObject, ...]:
    """Two objects that drive along the road of :func:`street` in opposite directions."""
    scale = width / 224
    return (
        MovingObject((20 * scale, 172 * scale), (3.0 * scale, 0.0), (15 * scale, 7 * scale), 0.2, 0.6),
        MovingObject((200 * scale, 208 * scale), (-3.6 * scale, 0.0), (20 * scale, 9 * scale), 0.8, 2.2),
    )


def planet(height: int, width: int, radius: float = 83) -> FloatArray:
    """Draw a disc with belts, an oval storm and a darkened limb on a dark field, and two moons."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:height, :width].astype(np.float32) - np.float32([[[height / 2]], [[width / 2]]])
    u, v = x / radius, y / (0.94 * radius)
    distance = np.hypot(u, v)
    depth = np.sqrt(np.clip(1 - distance**2, 0, 1))
    eddies = np.zeros((height, width), np.float32)
    for length, weight in ((1.2, 1.4), (2.5, 3.5), (5.0, 5.0)):
        grain = rng.standard_normal((height, width)).astype(np.float32)
        eddies += weight * cv2.GaussianBlur(grain, (0, 0), 2.2 * length, sigmaY=0.8 * length)
    latitude = np.arcsin(np.clip(v, -1, 1)) + 0.05 * eddies
    belts = 0.16 * np.cos(9.0 * latitude + 0.6) + 0.07 * np.cos(21.0 * latitude) + 0.03 * np.cos(40 * latitude)
    storm = np.exp(-((((u - 0.28) / 0.17) ** 2 + ((v - 0.38) / 0.085) ** 2) ** 2))
    shade = np.clip(0.66 + belts + 0.06 * eddies, 0, 1) * (0.25 + 0.75 * depth**0.7)
    colour = shade[..., None] * (np.float32([1.0, 0.88, 0.72]) - storm[..., None] * np.float32([0.0, 0.28, 0.38]))
    cover = np.clip(0.5 + (1 - distance) * radius, 0, 1)[..., None]
    scene = 0.02 + 0.88 * cover * colour
    for place, size in (((0.07, 0.5), 1.6), ((0.95, 0.47), 1.3)):
        dot = np.clip(0.5 + size - np.hypot(x + width / 2 - place[0] * width, y + height / 2 - place[1] * height), 0, 1)
        scene = np.maximum(scene, 0.8 * dot[..., None])
    return np.clip(scene, 0, 1).astype(np.float32)


def _small_texture(name: str, height: int, width: int) -> FloatArray:
    """Texture with stones of half the size: two by two copies."""
    return np.tile(picture(name, (height + 1) // 2, (width + 1) // 2), (2, 2))[:height, :width]


def _enlarged(image: FloatArray) -> FloatArray:
    return cv2.resize(image, None, fx=_OVERSAMPLING, fy=_OVERSAMPLING, interpolation=cv2.INTER_CUBIC)


def _canvas(image: FloatArray) -> Image.Image:
    return Image.fromarray((np.clip(image, 0, 1) * 255).round().astype(np.uint8))


def _reduced(canvas: Image.Image, height: int, width: int) -> FloatArray:
    drawn = np.asarray(canvas, np.float32) / 255
    return np.clip(cv2.resize(drawn, (width, height), interpolation=cv2.INTER_AREA), 0, 1)
