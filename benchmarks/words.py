"""How much of a printed text a recogniser reads from an image, through Tesseract or RapidOCR where they are installed.

The image is read at three times its size; Tesseract takes it as one block of text and as scattered words, and the
better of both counts.  For each word of the text the best match among the words read counts from 0 to 1 (twice the
length of the matching parts over the length of both); the mean over the text is the figure.  RapidOCR runs in the
environment that ``benchmarks/methods/packages.py`` makes for networks.

What Tesseract reads depends on the last bits of an image: noise of 0.00002 moves the figure of a page of five words by
up to 0.03 (standard deviation).  Images that differ by little are therefore compared by the mean over dithered copies,
which it moves by 0.01; it moves the mean over crops by a pixel by 0.02.
"""

from __future__ import annotations

import difflib
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from methods.packages import NETWORKS

from turbrestore.core.arrays import FloatArray, from_unit, luminance
from turbrestore.io.images.image_files import write_image

ENLARGEMENT = 3
# Page segmentation of tesseract: one uniform block, sparse text.
READINGS = ("6", "11")
PUNCTUATION = ".,|:;'\""
DITHERED_COPIES = 8
# Threads of tesseract wait for each other: two gain little on free cores and take minutes on busy ones.
ONE_THREAD = {**os.environ, "OMP_THREAD_LIMIT": "1"}
CHILD = Path(__file__).with_name("methods") / "reader_child.py"


def missing(reader: str) -> str:
    """Why a reader cannot read, empty where it can."""
    if reader == "tesseract":
        return "" if shutil.which("tesseract") else "tesseract is not installed"
    return "" if NETWORKS.made.exists() else f"{NETWORKS.folder.name}, the environment of RapidOCR, has not been made"


def can_read(reader: str = "tesseract") -> bool:
    """Whether a reader is installed."""
    return not missing(reader)


def share_read(image: FloatArray, words: Sequence[str], reader: str = "tesseract") -> float:
    """Share of the words that a reader can read, 0 to 1."""
    large = cv2.resize(
        from_unit(luminance(image), 8), None, fx=ENLARGEMENT, fy=ENLARGEMENT, interpolation=cv2.INTER_CUBIC
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "page.png")
        write_image(path, large.astype(np.float32) / 255, 8)
        found = [[word.strip(PUNCTUATION).lower() for word in seen] for seen in READERS[reader](path)]
    return max(float(np.mean([_best_match(word, seen) for word in words])) for seen in found)


def shares_read(image: FloatArray, words: Sequence[str], reader: str = "tesseract") -> FloatArray:
    """Shares of the words, shape (DITHERED_COPIES,), that a reader can read in copies of an image.

    Each copy has triangular noise of one 8-bit level, with which rounding to 8 bits is right on average.  Images of one
    size have the same noise, so differences of their shares belong together.
    """
    grey = luminance(image)
    noise = (np.random.default_rng(seed).triangular(-1, 0, 1, grey.shape) / 255 for seed in range(DITHERED_COPIES))
    return np.array([share_read(grey + some.astype(np.float32), words, reader) for some in noise], np.float32)


def _tesseract(path: Path) -> list[list[str]]:
    commands = [["tesseract", str(path), "-", "--psm", mode] for mode in READINGS]
    done = [subprocess.run(words, capture_output=True, text=True, check=True, env=ONE_THREAD) for words in commands]
    return [one.stdout.split() for one in done]


def _rapidocr(path: Path) -> list[list[str]]:
    process = _rapidocr_process()
    print(path, file=process.stdin, flush=True)
    return [json.loads(process.stdout.readline())]


@cache
def _rapidocr_process() -> subprocess.Popen[str]:
    """Start what reads images; it loads its network once, and ends with this process."""
    command = [str(NETWORKS.python), str(CHILD)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


READERS: dict[str, Callable[[Path], list[list[str]]]] = {"tesseract": _tesseract, "rapidocr": _rapidocr}


def _best_match(word: str, seen: Sequence[str]) -> float:
    return max((difflib.SequenceMatcher(None, word, other).ratio() for other in seen), default=0.0)
