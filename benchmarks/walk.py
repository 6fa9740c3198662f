"""The way of a frame through the source: files that a reader visits, and how often the frames of a clip are read.

    python benchmarks/walk.py

restores the sample clip with the command and follows the interpreter.  A reader who follows a frame from
``turbrestore restore`` to the written image looks into every function that is given an image or a stack of images, or a
record of them, when it is first entered, and goes back to its caller when it ends; functions that are known already are
skipped.  Counted are

- stays: how often the reader turns to another file of the package, of them returns to a file already left;
- files and functions that are visited;
- all stays: the same with every function, whatever it is given;
- readings: frames that the stages have asked the source for, as a multiple of the frames of the clip;
- decodes with ``--frames 200:260`` of an H.264 file with 300 frames and a keyframe each second, as a multiple of the
  frames that are read.

``--files`` lists the files with most stays.  It ends with 1 where a figure is above its bound.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import CodeType, FrameType
from typing import Any
from unittest.mock import patch

import numpy as np

import turbrestore
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames
from turbrestore_cli.__main__ import main as command

ROOT = Path(__file__).parents[1]
CLIP = ROOT / "sample_data" / "chart.mkv"
PLACES = tuple(str(ROOT / name) for name in ("turbrestore", "cli"))
BOUNDS = {"stays": 300, "returns": 200, "readings": 3.0, "decodes": 2.0}
START, STOP, COUNT = 200, 260, 300


class Walk:
    """Follows the calls of all threads; ``with Walk() as walk`` counts what happens inside."""

    def __init__(self, everything: bool = False) -> None:
        self.everything = everything
        self.stays: Counter[str] = Counter()
        self.known: set[CodeType] = set()
        self.decodes = 0
        self._here = ""
        # Of the functions that are at work: the file where it was entered for the first time, else nothing.
        self._entered: dict[int, str] = {}

    def __enter__(self) -> Walk:
        """Begin."""
        threading.setprofile(self._follow)
        sys.setprofile(self._follow)
        return self

    def __exit__(self, *_: object) -> None:
        """End."""
        sys.setprofile(None)
        threading.setprofile(None)

    def _follow(self, frame: FrameType, event: str, argument: Any) -> None:
        if event == "c_call":
            self.decodes += getattr(argument, "__qualname__", "") == "Packet.decode"
            return
        code = frame.f_code
        if not code.co_filename.startswith(PLACES):
            return
        if event == "call" and code.co_name != "<module>" and code not in self.known:
            if not (self.everything or any(map(_has_images, frame.f_locals.values()))):
                return
            self.known.add(code)
            self._entered[id(frame)] = code.co_filename
            self._turn_to(code.co_filename)
        elif event == "return" and self._entered.pop(id(frame), None):
            caller = frame.f_back
            while caller is not None and not caller.f_code.co_filename.startswith(PLACES):
                caller = caller.f_back
            if caller is not None:
                self._turn_to(caller.f_code.co_filename)

    def _turn_to(self, path: str) -> None:
        if path != self._here:
            self._here = path
            self.stays[path] += 1


def _has_images(value: object) -> bool:
    """Whether a value is an image or a stack of images, or a record that has one."""
    if is_dataclass(value):
        return any(_has_images(getattr(value, item.name, None)) for item in fields(value))
    return isinstance(value, np.ndarray) and value.ndim > 1 and min(value.shape[:2]) > 1


def counted(native: Callable[..., Iterator[Any]], tally: Counter[str]) -> Callable[..., Iterator[Any]]:
    """Wrap the method by which a source reads frames."""

    def counting(source: FrameSource, chosen: Any) -> Iterator[Any]:
        for item in native(source, chosen):
            tally["frames"] += 1
            yield item

    return counting


def restored(*words: object, everything: bool = False) -> tuple[Walk, int]:
    """Run ``turbrestore restore`` and follow it; also the number of frames that were read."""
    tally: Counter[str] = Counter()
    counting = patch.object(FrameSource, "_native", counted(FrameSource._native, tally))
    with counting, tempfile.TemporaryDirectory() as folder, Walk(everything) as walk:
        code = command(["restore", *map(str, words), f"{folder}/out.png", "--threads", "1", "--quiet"])
    assert code == 0, words
    return walk, tally["frames"]


def _write_as_cameras(path: Path, frames: Iterator[np.ndarray]) -> None:
    """Write H.264 with a keyframe each second."""
    import av

    with av.open(str(path), "w") as output:
        stream = output.add_stream("libx264", rate=30, options={"g": "30"})
        stream.width, stream.height, stream.pix_fmt = 96, 96, "yuv420p"
        for frame in frames:
            levels = (255 * frame).round().astype(np.uint8)
            output.mux(stream.encode(av.VideoFrame.from_ndarray(levels, "gray").reformat(format="yuv420p")))
        output.mux(stream.encode(None))


def figures() -> tuple[Walk, dict[str, float]]:
    """Everything that is counted, by name."""
    walk, frames = restored(CLIP)
    clip = open_frames(CLIP)
    some = clip.select(roi=(0, 0, 96, 96)).read()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "long.mp4")
        _write_as_cameras(path, (np.roll(some[number % len(some)], number // 7, axis=0) for number in range(COUNT)))
        seeking, part = restored(path, "--frames", f"{START}:{STOP}", "--sigma", 1)
    stays, every = sum(walk.stays.values()), restored(CLIP, everything=True)[0]
    found = {
        "stays": stays,
        "returns": stays - len(walk.stays),
        "files": len(walk.stays),
        "functions": len(walk.known),
        "all stays": sum(every.stays.values()),
        "readings": frames / len(clip),
        "decodes": seeking.decodes / part,
    }
    return walk, found


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--files", action="store_true", help="list the files with most stays")
    options = parser.parse_args()
    if Path(turbrestore.__file__).parents[1] != ROOT:
        sys.exit(f"expected an editable installation of {ROOT}, found {turbrestore.__file__}; install it with pip -e")
    walk, found = figures()
    for name, value in found.items():
        bound = f", at most {BOUNDS[name]:g}" if name in BOUNDS else ""
        print(f"{name:<10}{value:8.4g}{bound}")
    if options.files:
        for path, count in walk.stays.most_common(25):
            print(f"{count:4}  {Path(path).relative_to(ROOT)}")
    return int(any(found[name] > bound for name, bound in BOUNDS.items()))


if __name__ == "__main__":
    sys.exit(main())
