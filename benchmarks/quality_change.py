"""What has changed since a revision in the images of the clips with truth or text; ``quality.py --before`` prints it.

The earlier tree restores by its defaults, the present one by a preset, both from the same frames.  PSNR has bounds, on
the clips that settings were chosen on as on those that nothing was chosen on.  Words have none: noise of 0.00001 in
the frames moves the share of a clip by 0.02.  Their change has the standard error that is due to the reader alone.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from clips import Clip, find_clips, is_reported
from revisions import child, revision
from words import DITHERED_COPIES, can_read, shares_read

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import InputNotFoundError
from turbrestore.metrics import compare

# What clips may lose on average and any of them, dB, by preset.
LOSS_BOUNDS = {"standard": (0.05, 0.2), "fast": (0.3, float("inf"))}
CHILD = str(Path(__file__).with_name("restore_child.py"))
STAGES = ("filtered", "result")
FRAMES, IMAGES = "frames.npy", "images.npz"

Pair = tuple[float, float]
# The filtered image and the result, and the processor time, s.
Restored = tuple[dict[str, FloatArray], float]


@dataclass(frozen=True, eq=False)
class Change:
    """Figures of a clip, before and now.

    Attributes
    ----------
    psnr : dict of str to pair of float
        Of each stage, dB; none without truth.
    words : ndarray, shape (2, DITHERED_COPIES), optional
        Share of the words that are read in copies of the result.
    time : float
        Processor time now over that before.
    """

    psnr: dict[str, Pair]
    words: FloatArray | None
    time: float


def compare_with(before: str, patterns: Sequence[str], preset: str = "standard") -> tuple[str, bool]:
    """Markdown of what has changed since a revision, and whether the clips have lost more than the bounds.

    Raises
    ------
    InputNotFoundError
        A pattern matches nothing, or nothing of the clips can be measured.
    """
    with revision(before) as tree:
        changes = dict(_changes(patterns, tree, preset))
    if not changes:
        raise InputNotFoundError("--clips: expected a clip with truth, or with text and tesseract, found none")
    average, most = LOSS_BOUNDS[preset]
    lines = [
        f"# Quality against revision {before}\n",
        f"What `TURBRESTORE_DATA=DIR python benchmarks/quality.py --before {before} --preset {preset}` measures: clips "
        "of `benchmarks/quality.py` restored from the same frames by the defaults of that revision and by this preset "
        "of the present tree; PSNR, dB, where the truth is known, and the share of the words that tesseract reads "
        f"where there is text: the mean over {DITHERED_COPIES} dithered copies, and after ± the standard error of its "
        "change that is due to the reader.  Words have no bound.\n",
        "| clip | filtered: before | now | change | result: before | now | change | words: before | now | change |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
        *(_row(name, change) for name, change in changes.items()),
        "\n| results of clips | number | mean change, dB | bound | least | bound | CPU, now / before |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    held = True
    for title, reported in (
        ("others, on some of which settings were chosen", False),
        ("that nothing was chosen on", True),
    ):
        part = [change for name, change in changes.items() if change.psnr and is_reported(name) == reported]
        if not part:
            continue
        differences = [now - was for was, now in (change.psnr["result"] for change in part)]
        mean, least = float(np.mean(differences)), min(differences)
        held &= mean >= -average and least >= -most
        cells = [
            title,
            str(len(part)),
            f"{mean:+.3f}",
            f"{-average}",
            f"{least:+.3f}",
            f"{-most}" if np.isfinite(most) else "none",
        ]
        lines.append(f"| {' | '.join(cells)} | {np.median([change.time for change in part]):.2f} |")
    words = [change.words for change in changes.values() if change.words is not None]
    if words:
        was, now, change = _words_cells(np.mean(words, axis=0))
        lines.append(f"\nWords, mean of {len(words)} clips: {was} before, {now} now, change {change}.")
    return "\n".join(lines) + "\n", not held


def _changes(patterns: Sequence[str], tree: Path | None, preset: str) -> Iterator[tuple[str, Change]]:
    for name, load in find_clips(patterns).items():
        clip = load()
        readable = bool(clip.words) and can_read()
        if clip.truth is None and not readable:
            continue
        print(name, file=sys.stderr)
        yield name, _change(clip, restored_by(clip.frames, tree), restored_by(clip.frames, None, preset), readable)


def _change(clip: Clip, before: Restored, after: Restored, readable: bool) -> Change:
    psnr: dict[str, Pair] = {}
    (old, old_cpu), (new, new_cpu) = before, after
    if clip.truth is not None:
        psnr = {stage: (compare(old[stage], clip.truth).psnr, compare(new[stage], clip.truth).psnr) for stage in STAGES}
    words = np.stack([shares_read(some["result"], clip.words) for some in (old, new)]) if readable else None
    return Change(psnr, words, new_cpu / old_cpu)


def _row(name: str, change: Change) -> str:
    cells = [name]
    for stage in STAGES:
        was, now = change.psnr.get(stage, (None, None))
        cells += ["–"] * 3 if was is None or now is None else [f"{was:.2f}", f"{now:.2f}", f"{now - was:+.3f}"]
    cells += ["–"] * 3 if change.words is None else _words_cells(change.words)
    return f"| {' | '.join(cells)} |"


def _words_cells(shares: FloatArray) -> list[str]:
    """Means of shares (2, N) before and now, and their change with its standard error."""
    changes = shares[1] - shares[0]
    error = changes.std(ddof=1) / np.sqrt(changes.size)
    return [*(f"{share:.3f}" for share in shares.mean(axis=1)), f"{changes.mean():+.3f} ± {error:.3f}"]


def restored_by(frames: FloatArray, tree: Path | None, preset: str = "standard") -> Restored:
    """Return what the package in a folder, or the present one, makes of frames, and its processor time, s.

    Frames are handed over: a synthesizer that rounds otherwise draws other noise.
    """
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder, FRAMES), frames)
        task = {"frames": str(Path(folder, FRAMES)), "images": str(Path(folder, IMAGES)), "preset": preset}
        cpu = child(CHILD, task, tree)["cpu"]
        with np.load(Path(folder, IMAGES)) as images:
            return {stage: images[stage] for stage in STAGES}, cpu
