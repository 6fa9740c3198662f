"""Videos that are whole, of frames that no image should be made of as they are; the same in every run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from hostile_files import HEIGHT, WIDTH, clip, encode

from turbrestore.core.arrays import FloatArray
from turbrestore.io.video import write_video
from turbrestore.synthesis.smooth_flow import distort, smooth_flows


@dataclass(frozen=True)
class Content:
    """A video of odd content, and the words that the command line must write about it."""

    name: str
    write: Callable[[Path], object]
    word: str
    refused: bool = False
    options: tuple[str, ...] = ()


def other_clip(count: int) -> FloatArray:
    """Turbulent frames of something else."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    blobs = sum(np.exp(-((x - rng.uniform(0, 64)) ** 2 + (y - rng.uniform(0, 48)) ** 2) / 18) for _ in range(14))
    scene = (0.1 + 0.8 * blobs / blobs.max()).astype(np.float32)
    return np.clip(distort(scene, smooth_flows(count, HEIGHT, WIDTH, rng), rng, noise=0.01), 0, 1).astype(np.float32)


def _with(value: float, *places: tuple[slice | int, ...]) -> FloatArray:
    changed = clip()
    for place in places:
        changed[place] = value
    return changed


def _npy(frames: Callable[[], FloatArray]) -> Callable[[Path], object]:
    return lambda path: np.save(path, frames())


def _video(frames: Callable[[], FloatArray]) -> Callable[[Path], object]:
    return lambda path: write_video(path, frames(), 25, 8, overwrite=True)


def _tiff_of_nan(path: Path) -> None:
    import tifffile

    tifffile.imwrite(path, _with(np.nan, (3, 10, 10), (4, 5, 5)), photometric="minisblack")


def _images(sizes: list[tuple[int, int]]) -> Callable[[Path], object]:
    def write(path: Path) -> None:
        import cv2

        path.mkdir()
        for number, (height, width) in enumerate(sizes):
            cv2.imwrite(str(path / f"{number}.png"), np.uint8(255 * clip(1, height, width)[0]))

    return write


def _pages_of_two_sizes(path: Path) -> None:
    import tifffile

    with tifffile.TiffWriter(path) as tiff:
        for height in (48, 48, 40):
            tiff.write(np.uint8(255 * clip(1, height)[0]), metadata=None)


def _two_scenes() -> FloatArray:
    return np.concatenate([clip(14), other_clip(10)])


def _scene_that_comes_back() -> FloatArray:
    return np.concatenate([clip(16)[:8], other_clip(4), clip(16)[8:]])


def _repeated(*places: int) -> FloatArray:
    changed = clip()
    for place in places:
        changed[place] = changed[place - 1]
    return changed


_STRICT = ("--strict",)
CONTENT = (
    Content("nan.npy", _npy(lambda: _with(np.nan, (3, 10, 12), (3, 10, 13), (8, 40, 60))), "3 NaN or infinite values"),
    Content("nan.npy", _npy(lambda: _with(np.nan, (3, 10, 12), (3, 10, 13), (8, 40, 60))), "NaN", True, _STRICT),
    Content("nan_first.npy", _npy(lambda: _with(np.nan, (0, 0, 0))), "1 NaN or infinite value in frame 0"),
    Content("inf.npy", _npy(lambda: _with(np.inf, (5, 20, 20))), "1 NaN or infinite value in frame 5"),
    Content("inf_minus.npy", _npy(lambda: _with(-np.inf, (5, 20, 20))), "1 NaN or infinite value in frame 5"),
    Content(
        "nan_block.npy", _npy(lambda: _with(np.nan, (slice(None), slice(4, 9), slice(4, 9)))), "300 NaN or infinite"
    ),
    Content("nan_frame.npy", _npy(lambda: _with(np.nan, (4,))), "3072 of 3072 NaN", True),
    Content("nan_rows.npy", _npy(lambda: _with(np.nan, (4, slice(0, 10)))), "filled by what other frames show"),
    Content("nan_all.npy", _npy(lambda: np.full((12, 48, 64), np.nan, np.float32)), "NaN", True),
    Content("nan.tif", _tiff_of_nan, "2 NaN or infinite values in frames 3, 4"),
    Content("scale.npy", _npy(lambda: clip() * 255), "0 is black, 214.164 is white"),
    Content("negative.npy", _npy(lambda: clip() - 0.5), "-0.3367 is black"),
    Content("black.mkv", _video(lambda: np.zeros_like(clip())), "contrast", True),
    Content("white.mkv", _video(lambda: np.ones_like(clip())), "contrast", True),
    Content("grey.npy", _npy(lambda: np.full_like(clip(), 0.5)), "contrast", True),
    Content("one.npy", _npy(lambda: clip()[:1]), "at least 2", True),
    Content("two.npy", _npy(lambda: clip()[:2]), "2 frames"),
    Content("three.npy", _npy(lambda: clip()[:3]), "3 frames"),
    Content("four.npy", _npy(lambda: clip()[:4]), "4 frames"),
    Content("sizes", _images([(48, 64), (48, 64), (40, 64)]), "expected 64×48", True),
    Content("pages.tif", _pages_of_two_sizes, "expected 64×48", True),
    Content("pixel.npy", _npy(lambda: clip()[:, :1, :1]), "contrast", True),
    Content("tiny.npy", _npy(lambda: clip()[:, :8, :8]), "at least 16×16", True),
    Content("line.npy", _npy(lambda: clip()[:, :2, :]), "at least 16×16", True),
    Content("small.npy", _npy(lambda: clip()[:, :16, :16]), "12 frames"),
    Content("narrow.npy", _npy(lambda: clip()[:, :, :16]), "12 frames"),
    Content("saturated.mkv", _video(lambda: np.clip(3 * clip(), 0, 1)), "at white"),
    Content("two_scenes.mkv", _video(_two_scenes), "2 scenes: only the longest is used, 14 frames from 0 to 13"),
    Content("two_scenes.mkv", _video(_two_scenes), "2 scenes", True, _STRICT),
    Content("two_scenes.mkv", _video(_two_scenes), "10 frames", False, ("--frames", "14:24")),
    Content("come_back.mkv", _video(_scene_that_comes_back), "2 scenes: only the longest is used, 16 frames"),
    Content("black_frames.mkv", _video(lambda: _with(0, (0,), (6,))), "2 blank: frames 0, 6 left out"),
    Content("black_frames.mkv", _video(lambda: _with(0, (0,), (6,))), "2 blank", True, _STRICT),
    Content("white_frame.mkv", _video(lambda: _with(1, (7,))), "1 blank: frame 7 left out"),
    Content("duplicated.mkv", _video(lambda: _repeated(3, 4, 9)), "3 duplicated: frames 3, 4, 9 left out"),
    Content("duplicated.mkv", _video(lambda: _repeated(3, 4, 9)), "3 duplicated", True, _STRICT),
    Content("still.mkv", _video(lambda: np.repeat(clip()[:1], 12, 0)), "all frames are the same"),
    Content("hot.mkv", _video(lambda: _with(1, (slice(None), 20, 30))), "1 stuck pixel (x 30, y 20)"),
    Content("dead.mkv", _video(lambda: _with(0, (slice(None), 12, 40))), "1 stuck pixel (x 40, y 12)"),
    Content("hot.mkv", _video(lambda: _with(1, (slice(None), 20, 30))), "1 stuck pixel", True, _STRICT),
    Content("times.mkv", lambda path: encode(path, clip(), "ffv1", "gray", [*range(8), 20, 21, 30, 50]), "variable"),
)
