"""How much of a printed text a recogniser reads from an image, through tesseract where it is installed.

The image is read at three times its size, as one block of text and as scattered words.  For each word of the text the
best match among the words read counts from 0 to 1 (twice the length of the matching parts over the length of both);
the mean over the text, for the better of the two readings, is the figure.
"""

from __future__ import annotations

import difflib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from turbrestore.core.arrays import FloatArray, from_unit, luminance
from turbrestore.io.images import write_image

ENLARGEMENT = 3
# Page segmentation of tesseract: one uniform block, sparse text.
READINGS = ("6", "11")
PUNCTUATION = ".,|:;'\""
# Threads of tesseract wait for each other: two gain little on free cores and take minutes on busy ones.
ONE_THREAD = {**os.environ, "OMP_THREAD_LIMIT": "1"}


def can_read() -> bool:
    """Whether tesseract is installed."""
    return shutil.which("tesseract") is not None


def share_read(image: FloatArray, words: Sequence[str]) -> float:
    """Share of the words that can be read, 0 to 1."""
    return max(float(np.mean([_best_match(word, seen) for word in words])) for seen in _readings(image))


def _readings(image: FloatArray) -> list[list[str]]:
    """Words of each reading, in lower case and without punctuation."""
    large = cv2.resize(
        from_unit(luminance(image), 8), None, fx=ENLARGEMENT, fy=ENLARGEMENT, interpolation=cv2.INTER_CUBIC
    )
    found = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "page.png")
        write_image(path, large.astype(np.float32) / 255, 8)
        for mode in READINGS:
            command = ["tesseract", str(path), "-", "--psm", mode]
            text = subprocess.run(command, capture_output=True, text=True, check=True, env=ONE_THREAD).stdout
            found.append([word.strip(PUNCTUATION).lower() for word in text.split()])
    return found


def _best_match(word: str, seen: Sequence[str]) -> float:
    return max((difflib.SequenceMatcher(None, word, other).ratio() for other in seen), default=0.0)
