"""Scenes that are drawn, in colour and at any size: a street, a road sign, a number plate and a planet."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ..core.arrays import FloatArray
from .scenes import OVERSAMPLING, picture

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

# Drawn this many times larger and averaged down, which avoids jagged edges; coordinates are those of a scene 224 wide.
_UNIT = 224
# Height of the ground of the street, chosen.
_GROUND = 150


def road_sign(height: int, width: int) -> FloatArray:
    """Draw a blue road sign with places and distances in front of a brick wall."""
    from PIL import ImageDraw, ImageFont

    scale = OVERSAMPLING * width / _UNIT
    wall = _enlarged(picture("brick", height, width))[..., None] * np.array([0.95, 0.80, 0.70], np.float32) + 0.12
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


def number_plate(height: int, width: int) -> FloatArray:
    """Draw the rear of a car with its number plate, lights and bumper."""
    from PIL import ImageDraw, ImageFont

    scale = OVERSAMPLING * width / _UNIT
    fall = np.linspace(0.42, 0.2, height * OVERSAMPLING, dtype=np.float32)[:, None, None]
    paint = np.broadcast_to(fall * np.array([1.0, 0.32, 0.26], np.float32), (*fall.shape[:1], width * OVERSAMPLING, 3))
    canvas = _canvas(paint)
    drawing = ImageDraw.Draw(canvas)
    middle = height * OVERSAMPLING / 2
    drawing.rectangle([0, middle + 52 * scale, 224 * scale, middle + 80 * scale], fill=(38, 40, 44))
    for left in (4, 192):
        drawing.rounded_rectangle(
            [left * scale, middle - 66 * scale, (left + 28) * scale, middle - 34 * scale],
            radius=5 * scale,
            fill=(196, 40, 36),
            outline=(238, 214, 208),
            width=round(1.5 * scale),
        )
    frame = [32 * scale, middle - 24 * scale, 192 * scale, middle + 24 * scale]
    rim = round(2 * scale)
    drawing.rounded_rectangle(frame, radius=5 * scale, fill=(240, 240, 236), outline=(24, 24, 26), width=rim)
    drawing.rectangle([35 * scale, middle - 20 * scale, 49 * scale, middle + 20 * scale], fill=(30, 70, 150))
    for x, y, text, size, ink in (
        (121, 0, "TR 4207 K", 26, (20, 20, 24)),
        (112, 36, "harbour motors, quay 3", 8, (226, 214, 206)),
    ):
        font = ImageFont.load_default(size * scale)
        drawing.text((x * scale, middle + y * scale), text, fill=ink, font=font, anchor="mm")
    return _reduced(canvas, height, width)


def street(height: int, width: int) -> FloatArray:
    """Draw a row of brick houses with windows behind a road with lamps and a sign."""
    from PIL import ImageDraw

    scale = OVERSAMPLING * width / _UNIT
    tall, wide = height * OVERSAMPLING, width * OVERSAMPLING
    fall = np.linspace(0, 1, tall, dtype=np.float32)[:, None, None]
    sky = np.broadcast_to(
        np.array([0.62, 0.74, 0.88], np.float32) + fall * np.array([0.3, 0.2, 0.05], np.float32), (tall, wide, 3)
    )
    canvas = _canvas(sky)
    drawing = ImageDraw.Draw(canvas)
    _houses(canvas, drawing, _enlarged(_small_texture("brick", height, width)), scale)
    _road(canvas, drawing, _enlarged(_small_texture("gravel", height, width)), scale)
    _lamps_and_sign(drawing, scale)
    return _reduced(canvas, height, width)


def _houses(canvas: Image, drawing: ImageDraw, bricks: FloatArray, scale: float) -> None:
    ground = round(_GROUND * scale)
    houses = (
        (0, 62, 40, (0.98, 0.62, 0.50)),
        (62, 58, 56, (1.05, 0.95, 0.78)),
        (120, 64, 30, (0.80, 0.66, 0.62)),
        (184, 60, 48, (0.95, 0.80, 0.66)),
    )
    for left, across, top, tint in houses:
        x, y, w = round(left * scale), round(top * scale), round(across * scale)
        wall = bricks[y:ground, x : min(x + w, bricks.shape[1])][..., None] * np.array(tint, np.float32) + 0.08
        canvas.paste(_canvas(wall), (x, y))
        roof = [(x, y), (x + w, y), (x + w - 6 * scale, y - 11 * scale), (x + 6 * scale, y - 11 * scale)]
        drawing.polygon(roof, fill=(92, 52, 44))
        for column in range(3):
            for row in range(int((_GROUND - top) // 26)):
                _window(drawing, x + (6 + column * (across - 4) / 3) * scale, y + (7 + 26 * row) * scale, scale)


def _window(drawing: ImageDraw, u: float, v: float, scale: float) -> None:
    frame, width = (232, 228, 218), round(scale)
    drawing.rectangle([u - 1.5 * scale, v - 1.5 * scale, u + 11.5 * scale, v + 15.5 * scale], fill=frame)
    drawing.rectangle([u, v, u + 10 * scale, v + 14 * scale], fill=(44, 58, 78))
    drawing.line([u + 5 * scale, v, u + 5 * scale, v + 14 * scale], fill=frame, width=width)
    drawing.line([u, v + 7 * scale, u + 10 * scale, v + 7 * scale], fill=frame, width=width)


def _road(canvas: Image, drawing: ImageDraw, stones: FloatArray, scale: float) -> None:
    ground, wide = round(_GROUND * scale), stones.shape[1]
    if ground < len(stones):
        road = np.repeat((0.25 + 0.4 * stones[ground:])[..., None], 3, axis=2) * np.array([0.95, 0.97, 1.0], np.float32)
        canvas.paste(_canvas(road), (0, ground))
    drawing.rectangle([0, ground, wide, ground + 7 * scale], fill=(176, 172, 164))
    drawing.rectangle([0, ground + 7 * scale, wide, ground + 9 * scale], fill=(120, 118, 114))
    for left in range(0, _UNIT, 32):
        dash = [left * scale, ground + 40 * scale, (left + 18) * scale, ground + 43 * scale]
        drawing.rectangle(dash, fill=(235, 232, 215))


def _lamps_and_sign(drawing: ImageDraw, scale: float) -> None:
    from PIL import ImageFont

    foot, iron = (_GROUND + 4) * scale, (38, 42, 46)
    for x in (30, 140):
        drawing.rectangle([x * scale, 46 * scale, (x + 2.5) * scale, foot], fill=iron)
        bulb = [(x - 5) * scale, 38 * scale, (x + 7.5) * scale, 48 * scale]
        drawing.ellipse(bulb, fill=(246, 240, 205), outline=iron, width=round(scale))
    drawing.rectangle([187 * scale, 92 * scale, 189.5 * scale, foot], fill=(70, 74, 78))
    board, white = [168 * scale, 68 * scale, 210 * scale, 98 * scale], (240, 242, 240)
    drawing.rounded_rectangle(board, radius=3 * scale, fill=(24, 100, 66), outline=white, width=round(1.5 * scale))
    for y, text, size in ((76, "EXIT", 11), (89, "27 B", 13)):
        font = ImageFont.load_default(size * scale)
        drawing.text((189 * scale, y * scale), text, fill=white, font=font, anchor="mm")


def planet(height: int, width: int) -> FloatArray:
    """Draw a disc with belts, an oval storm and a darkened limb on a dark field, and two moons."""
    rng, radius = np.random.default_rng(4), 0.33 * min(height, width)
    y, x = np.mgrid[:height, :width].astype(np.float32) - np.array([[[height / 2]], [[width / 2]]], np.float32)
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
    colour = shade[..., None] * (
        np.array([1.0, 0.88, 0.72], np.float32) - storm[..., None] * np.array([0.0, 0.28, 0.38], np.float32)
    )
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
    return cv2.resize(image, None, fx=OVERSAMPLING, fy=OVERSAMPLING, interpolation=cv2.INTER_CUBIC)


def _canvas(image: FloatArray) -> Image:
    from PIL import Image

    return Image.fromarray((np.clip(image, 0, 1) * 255).round().astype(np.uint8))


def _reduced(canvas: Image, height: int, width: int) -> FloatArray:
    drawn = np.asarray(canvas, np.float32) / 255
    return np.clip(cv2.resize(drawn, (width, height), interpolation=cv2.INTER_AREA), 0, 1)


DRAWN: dict[str, Callable[[int, int], FloatArray]] = {
    "street": street,
    "sign": road_sign,
    "plate": number_plate,
    "planet": planet,
}
