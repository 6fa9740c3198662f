"""What has changed since a revision in the images of the clips with truth or text; ``quality.py --before`` prints it.

Both trees restore the same frames by their defaults.  PSNR has a bound.  Words have none: what tesseract reads of a
line changes with the last bits of an image.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from clips import Clip, find_clips
from revisions import child, revision
from words import can_read, share_read

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import InputNotFoundError
from turbrestore.metrics import compare

# What a clip may lose, dB.
LOSS_BOUND = 0.05
CHILD = str(Path(__file__).with_name("restore_child.py"))
STAGES = ("filtered", "result")
FRAMES, IMAGES = "frames.npy", "images.npz"

Pair = tuple[float, float]


@dataclass(frozen=True)
class Change:
    """Figures of a clip, before and now.

    Attributes
    ----------
    psnr : dict of str to pair of float
        Of each stage, dB; none without truth.
    words : pair of float, optional
        Share of the words that are read in the result.
    """

    psnr: dict[str, Pair]
    words: Pair | None


def compare_with(before: str, patterns: Sequence[str]) -> tuple[str, bool]:
    """Markdown of what has changed since a revision, and whether a clip has lost more than the bound.

    Raises
    ------
    InputNotFoundError
        A pattern matches nothing, or nothing of the clips can be measured.
    """
    with revision(before) as tree:
        changes = dict(_changes(patterns, tree))
    if not changes:
        raise InputNotFoundError("--clips: expected a clip with truth, or with text and tesseract, found none")
    lines = [
        f"# Quality against revision {before}\n",
        f"What `TURBRESTORE_DATA=DIR python benchmarks/quality.py --before {before}` measures: clips of "
        "`benchmarks/quality.py` restored from the same frames by that revision and by the present tree; PSNR, dB, "
        "where the truth is known, and the share of the words that tesseract reads where there is text.  It ends "
        f"with 1 where an image loses more than {LOSS_BOUND} dB.  Words have no bound: what is read of a line changes "
        "with the last bits of an image.\n",
        "| clip | filtered: before | now | change | result: before | now | change | words: before | now |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
        *(_row(name, change) for name, change in changes.items()),
    ]
    differences = [now - was for change in changes.values() for was, now in change.psnr.values()]
    if differences:
        lines.append(f"\nChanges: {min(differences):+.3f} to {max(differences):+.3f} dB; least allowed: −{LOSS_BOUND}.")
    words = [change.words for change in changes.values() if change.words is not None]
    if words:
        was, now = np.mean(words, axis=0)
        lines.append(f"\nWords, mean of {len(words)} clips: {was:.2f} before, {now:.2f} now.")
    return "\n".join(lines) + "\n", min(differences, default=0.0) < -LOSS_BOUND


def _changes(patterns: Sequence[str], tree: Path | None) -> Iterator[tuple[str, Change]]:
    for name, load in find_clips(patterns).items():
        clip = load()
        readable = bool(clip.words) and can_read()
        if clip.truth is None and not readable:
            continue
        print(name, file=sys.stderr)
        yield name, _change(clip, restored_by(clip.frames, tree), restored_by(clip.frames, None), readable)


def _change(clip: Clip, old: dict[str, FloatArray], new: dict[str, FloatArray], readable: bool) -> Change:
    psnr: dict[str, Pair] = {}
    if clip.truth is not None:
        psnr = {stage: (compare(old[stage], clip.truth).psnr, compare(new[stage], clip.truth).psnr) for stage in STAGES}
    words = (share_read(old["result"], clip.words), share_read(new["result"], clip.words)) if readable else None
    return Change(psnr, words)


def _row(name: str, change: Change) -> str:
    cells = [name]
    for stage in STAGES:
        was, now = change.psnr.get(stage, (None, None))
        cells += ["–"] * 3 if was is None or now is None else [f"{was:.2f}", f"{now:.2f}", f"{now - was:+.3f}"]
    cells += ["–"] * 2 if change.words is None else [f"{share:.2f}" for share in change.words]
    return f"| {' | '.join(cells)} |"


def restored_by(frames: FloatArray, tree: Path | None) -> dict[str, FloatArray]:
    """Return the filtered image and the result of frames by the package in a folder, or by the present one.

    Frames are handed over: a synthesizer that rounds otherwise draws other noise.
    """
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder, FRAMES), frames)
        child(CHILD, {"frames": str(Path(folder, FRAMES)), "images": str(Path(folder, IMAGES))}, tree)
        with np.load(Path(folder, IMAGES)) as images:
            return {stage: images[stage] for stage in STAGES}
