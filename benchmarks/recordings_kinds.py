"""Clips with more than the scene in them: weather, photons, titles, pictures in pictures, sensors, shadows, a car.

    python benchmarks/recordings_kinds.py

prints the peak signal-to-noise ratio of the result, of the filtered image, of the temporal mean and of the median of
every clip, after the best gain and offset.  ``robustness.py --groups recordings`` asks that no result is worse than the
mean, text as little as the rest, and that in snow and rain it is better than the median.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.io.source import FrameSource
from turbrestore.metrics import compare
from turbrestore.pipeline import restore
from turbrestore.settings import RestoreParams

COUNT, SIDE = 32, 144
# Kinds in which what hides the scene covers a pixel in less than half of the frames.
COVERED = ("snow", "rain")
# Ratio from which text is as it was drawn, dB.
AS_DRAWN = 35.0
RNG = np.random.default_rng


@dataclass(frozen=True)
class Figures:
    """Ratios of one clip, in dB."""

    name: str
    result: float
    filtered: float
    mean: float
    median: float
    text: tuple[float, float] | None = None  # of result and mean, in dB, where digits are drawn over the scene

    def bound(self, slack: float) -> float:
        """Return the least ratio that the result may have."""
        return self.median if self.name.split()[-1] in COVERED else self.mean - slack

    def text_is_worse(self, slack: float) -> bool:
        """Whether text is worse than in the mean, and not as good as what is drawn."""
        return self.text is not None and self.text[0] < min(self.text[1] - slack, AS_DRAWN)


def as_8_bits(frames: FloatArray) -> np.ndarray:
    """Frames of a camera of 8 bits."""
    return np.rint(255 * np.clip(frames, 0, 1)).astype(np.uint8)


def covered(frames: FloatArray, share: float, streaks: bool) -> np.ndarray:
    """Snow or rain that covers a share of every frame."""
    rng, result = RNG(21), frames.copy()
    for frame in result:
        cover = np.zeros(frame.shape, np.float32)
        while (cover > 0.3).mean() < share:
            x, y = (int(place) for place in rng.uniform(0, 16 * SIDE, 2))
            if streaks:
                length, shade = rng.uniform(15, 30), rng.uniform(0.3, 0.6)
                cv2.line(
                    cover, (x // 16, y // 16), (int(x / 16 - 0.2 * length), int(y / 16 + length)), shade, 1, cv2.LINE_AA
                )
            else:
                cv2.circle(cover, (x, y), int(16 * rng.uniform(1, 2.4)), rng.uniform(0.6, 1), -1, cv2.LINE_AA, 4)
        cover = np.clip(cv2.GaussianBlur(cover, (0, 0), 0.8), 0, 1)
        np.add(frame, cover * (0.95 - frame), out=frame)
    return as_8_bits(result)


def photons(frames: FloatArray, white: float) -> np.ndarray:
    """Light of so many photons where it is white."""
    counts = RNG(22).poisson(white * np.clip(0.75 * frames, 0, 1)) / white
    return np.rint(65535 * np.clip(counts, 0, 1)).astype(np.uint16)


def titled(frames: FloatArray) -> np.ndarray:
    """Draw a place and a clock that ticks once."""
    result = as_8_bits(frames)
    for number, frame in enumerate(result):
        for shade, width in ((0, 3), (255, 1)):
            for text, place in (("PIER 3", (6, 138)), (f"07:31:{20 + number // 20}", (6, 14))):
                cv2.putText(frame, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, shade, width)
    return result


def written(frames: FloatArray) -> np.ndarray:
    """Draw a clock whose last digit changes in every frame."""
    result = as_8_bits(frames)
    for number, frame in enumerate(result):
        for shade, width in ((0, 3), (255, 1)):
            place, text = (8, 136), f"09:48:{number // 10:02d}.{number % 10}"
            cv2.putText(frame, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, shade, width)
    return result


def stamped(frames: FloatArray) -> np.ndarray:
    """Draw a time code over the frames, and a counter in a black box, whose digits change in every frame."""
    result = as_8_bits(frames)
    for number, frame in enumerate(result):
        for shade, width in ((0, 3), (255, 1)):
            text = f"14:06:{51 + number // 25:02d}:{number % 25:02d}"
            cv2.putText(frame, text, (30, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.42, shade, width)
        cv2.rectangle(frame, (50, 120), (132, 138), 0, -1)
        cv2.putText(frame, f"No {2871 + number:06d}", (54, 133), cv2.FONT_HERSHEY_SIMPLEX, 0.4, 255, 1, cv2.LINE_AA)
    return result


def with_logo(frames: FloatArray) -> np.ndarray:
    """Lay a logo over the frames through which the scene shines."""
    cover = np.zeros((SIDE, SIDE), np.float32)
    cv2.ellipse(cover, (24, 22), (16, 11), 0, 0, 360, 0.65, -1, cv2.LINE_AA)
    cv2.rectangle(cover, (18, 17), (30, 27), 0, -1)
    return as_8_bits(frames + cover * (0.85 - frames))


def side_by_side(frames: FloatArray) -> np.ndarray:
    """Show the same part of the scene twice, once mirrored."""
    part = frames[:, :, SIDE // 3 : SIDE // 3 + SIDE // 2]
    return as_8_bits(np.concatenate([part, part[:, :, ::-1]], axis=2))


def in_picture(frames: FloatArray) -> np.ndarray:
    """Show the whole scene once more in a frame in a corner."""
    result, side = as_8_bits(frames), SIDE // 3
    for frame in result:
        small = cv2.copyMakeBorder(
            cv2.resize(frame, (side, side), interpolation=cv2.INTER_AREA), 2, 2, 2, 2, 0, None, 255
        )
        frame[6 : 10 + side, -10 - side : -6] = small
    return result


def warm(frames: FloatArray) -> np.ndarray:
    """Raise some pixels of the sensor."""
    rng, excess = RNG(25), np.zeros((SIDE, SIDE), np.float32)
    excess.ravel()[rng.choice(SIDE * SIDE, 70, replace=False)] = rng.uniform(0.08, 0.4, 70)
    return as_8_bits(0.6 * frames + excess)


def lit(frames: FloatArray, kind: str) -> np.ndarray:
    """Let a shadow creep over the scene, or a lamp go on and off; the mean over time stays."""
    y, x = np.mgrid[:SIDE, :SIDE].astype(np.float32) / SIDE
    if kind == "shadow":
        gain = np.stack([1 - 0.3 / (1 + np.exp((y + 0.2 * x - edge) / 0.03)) for edge in np.linspace(-0.1, 1.3, COUNT)])
    else:
        spot = np.exp(-((x - 0.6) ** 2 + (y - 0.4) ** 2) / (2 * 0.2**2))
        gain = 1 + 0.4 * spot * (np.cumsum(RNG(26).random(COUNT) < 0.3) % 2)[:, None, None]
    return as_8_bits(0.7 * frames * np.float32(gain / gain.mean(axis=0)))


def striped(frames: FloatArray, dead: bool = False) -> np.ndarray:
    """Columns with offsets of their own, or two that are dead."""
    if not dead:
        return as_8_bits(0.1 + 0.8 * frames + 0.015 * RNG(23).standard_normal(SIDE).astype(np.float32))
    result = as_8_bits(frames)
    result[:, :, 61], result[:, 90] = 4, 180
    return result


KINDS: dict[str, Callable[[FloatArray], np.ndarray]] = {
    "snow": lambda f: covered(f, 0.07, False),
    "rain": lambda f: covered(f, 0.12, True),
    "60 photons": lambda f: photons(f, 60),
    "400 photons": lambda f: photons(f, 400),
    "night": lambda f: as_8_bits(0.6 * f + 0.15 * RNG(24).standard_normal(f.shape).astype(np.float32)),
    "title": titled,
    "stripes": striped,
    "dead columns": lambda f: striped(f, dead=True),
    "warm pixels": warm,
    "shadow": lambda f: lit(f, "shadow"),
    "lamp": lambda f: lit(f, "lamp"),
}
# What is drawn into the picture is part of what is right.
DRAWN: dict[str, Callable[[FloatArray], np.ndarray]] = {
    "clock": written,
    "time code": stamped,
    "logo": with_logo,
    "side by side": side_by_side,
    "picture in picture": in_picture,
}


TEXTS = {"title": titled, "clock": written, "time code": stamped}


def of_text(
    frames: FloatArray, scene: FloatArray, record: Callable[[FloatArray], np.ndarray]
) -> Callable[[FloatArray], float]:
    """Return the ratio of an image to the mean of what was drawn, in most of the frames, over the scene at rest."""
    text = np.mean(np.abs(record(frames) - 255 * frames) > 20, axis=0) >= 0.5
    truth = record(np.repeat(scene[None], COUNT, axis=0)).mean(axis=0) / np.float32(255)
    return lambda image: float(-10 * np.log10(np.mean((image[text] - truth[text]) ** 2)))


def clips() -> Iterator[tuple[str, np.ndarray, FloatArray, Callable[[FloatArray], float] | None]]:
    """Name, frames and truth of every clip, and the ratio of an image in its text."""
    from conftest import make_sequence

    for scene in ("camera", "chart"):
        still = make_sequence(19, COUNT, SIDE, scene, blur=0.8, noise=0.008, rms=1.2)
        for kind, record in KINDS.items():
            ratio = of_text(still.frames, still.scene, TEXTS[kind]) if kind in TEXTS else None
            yield f"{scene}, {kind}", record(still.frames), still.scene, ratio
        for kind, record in DRAWN.items():
            ratio = of_text(still.frames, still.scene, TEXTS[kind]) if kind in TEXTS else None
            yield f"{scene}, {kind}", record(still.frames), record(still.scene[None])[0] / np.float32(255), ratio
    wide = make_sequence(20, COUNT, SIDE + 48, "camera", blur=0.8, noise=0.008, rms=0.8)
    places = np.arange(COUNT) * 3 // 2
    frames = np.stack([frame[24 : 24 + SIDE, x : x + SIDE] for frame, x in zip(wide.frames, places, strict=True)])
    for k, frame in enumerate(frames):
        frame[100:124, max(9 * k - 60, 0) : max(9 * k, 0)] = 0.9
    yield "camera, car before a moving camera", as_8_bits(frames), wide.scene[24 : 24 + SIDE, 23 : 23 + SIDE], None


def figures() -> Iterator[Figures]:
    """Ratios of every clip."""
    for name, frames, truth, ratio in clips():
        found = restore(FrameSource.from_array(frames), RestoreParams(border="keep"))
        raw = frames / np.float32(np.iinfo(frames.dtype).max)
        fused = found.mean if found.filtered is None else found.filtered.image
        images = found.image, fused, raw.mean(axis=0), np.median(raw, axis=0)
        text = None if ratio is None else (ratio(images[0]), ratio(images[2]))
        yield Figures(name, *(compare(image, truth).psnr_fit for image in images), text)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    for row in figures():
        print(
            "{name}: result {result:.2f}, filtered {filtered:.2f}, mean {mean:.2f}, median {median:.2f}".format(
                **vars(row)
            ),
            "" if row.text is None else "text {:.2f}, mean {:.2f}".format(*row.text),
        )
