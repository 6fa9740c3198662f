"""Restore a table of clips by simple methods, by every stage of the pipeline and by its defaults, and score them.

Run ``python benchmarks/quality.py``; it prints a Markdown document.  Clips: synthetic ones made here, and those under
the folder that ``TURBRESTORE_DATA`` names, where there are any.  Clips on which nothing was chosen have means of their
own.  ``--clips`` takes names or patterns, ``--images`` writes the images side by side, ``--json`` the figures,
``--write benchmarks/results/quality.md`` the document.

``--bounds`` instead restores a few simulated clips with the blur given by hand, and exits with 1 when a bound is
broken or a stage is worse than the one before; without the data it says so and exits with 0.

``--before`` instead restores the clips with truth or text by an earlier revision too, and exits with 1 where results
have lost more than 0.05 dB on average or 0.2 dB on a clip; with ``--preset fast`` more than 0.3 dB on average.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from itertools import accumulate
from pathlib import Path

import cv2
import numpy as np
from clips import (
    COUNT,
    LARGEST_SIDE,
    MOST_FRAMES,
    SCREEN_SIDE,
    SMOOTH_SIDE,
    STRONG_RMS,
    Clip,
    data_folder,
    find_clips,
    is_reported,
)
from provenance import publish
from quality_change import LOSS_BOUNDS, compare_with
from words import READERS, can_read, missing, share_read

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import TurbrestoreError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.filtering.alternating import FilterParams
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.output import atomic_write
from turbrestore.io.video import open_frames
from turbrestore.metrics import appearance, compare
from turbrestore.pipeline import Restoration, RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams, mean_registered
from turbrestore.registration.flow import estimate_flow

# The paper's choices, with this project's optical flow and automatic fidelity.
PAPER = RestoreParams(
    centroid=CentroidParams(mode="single"),
    filter=FilterParams(residual="drop", sharpness=0.0),
    deconvolution=DeconvolutionParams(sigma=1.45, sharpen_guide=False),
)
METHODS = {
    "middle frame": "one frame as it is",
    "mean": "temporal mean of all frames",
    "median": "temporal median of all frames",
    "registered": "mean of all frames after one registration to the temporal mean, by the pipeline's optical flow",
    "centroid": "first stage of the pipeline: iterated centroid of the training frames",
    "filtered": "second stage: alternating Kalman filter over all frames",
    "paper": "the paper's settings: one warped frame as the centroid, flow outside the subspace dropped, no weights "
    "by sharpness, nonlocal TV against a Gaussian of σ = 1.45 px with weights from the centroid as it is",
    "default": "the whole pipeline, blind",
}
# Clip: sigma by hand, pixels, and the least PSNR of the result, dB.
BOUNDS = {
    "ao_camera_medium": (1.0, 27.5),
    "purdue1_camera_medium": (1.2, 28.5),
    "purdue1_chart_medium": (1.2, 19.5),
    "ao_brick_weak": (0.8, 33.0),
}
PANEL_COLUMNS, LABEL_HEIGHT = 3, 18

Figures = dict[str, float]
Results = dict[str, dict[str, Figures]]


def main() -> int:
    """Measure and print."""
    options = _options()
    if options.bounds:
        return check_bounds()
    results, lost = Results(), False
    try:
        if options.before is not None:
            text, lost = compare_with(options.before, options.clips, options.preset)
        else:
            results = measure_all(options.clips, options.images)
            text = document(results, options.clips)
    except TurbrestoreError as error:
        print(f"quality: {error}", file=sys.stderr)
        return error.exit_code
    publish(text, options.write)
    if options.json is not None:
        atomic_write(options.json, (json.dumps(results, indent=2) + "\n").encode(), overwrite=True)
    return int(lost)


def measure_all(patterns: list[str], folder: Path | None) -> Results:
    """Figures of every clip by every method; their images go into a folder."""
    results: Results = {}
    for name, load in find_clips(patterns).items():
        started = time.perf_counter()
        clip = load()
        restored = restorations(clip)
        results[name] = {method: figures(image, clip, s) for method, (image, s) in restored.items()}
        if clip.words and clip.peers:
            results[name]["peers"] = {
                figure: max(words_read(peer, clip)[figure] for peer in clip.peers.values())
                for figure in map(words_by, filter(can_read, READERS))
            }
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            write_image(folder / f"{name}.png", panel(restored, clip), 8, overwrite=True)
        print(f"{name}: {time.perf_counter() - started:.0f} s", file=sys.stderr, flush=True)
    return results


def restorations(clip: Clip) -> dict[str, tuple[FloatArray, float]]:
    """Image and wall time, s, of each method."""
    frames = clip.frames
    images = {
        "middle frame": _timed(lambda: frames[len(frames) // 2]),
        "mean": _timed(lambda: frames.mean(axis=0)),
        "median": _timed(lambda: np.median(frames, axis=0)),
        "registered": _timed(lambda: mean_registered(frames, estimate_flow(frames.mean(axis=0), frames))),
    }
    whole = restore(frames)
    until = dict(zip(whole.seconds, accumulate(whole.seconds.values()), strict=True))
    images["centroid"] = whole.centroid.image, until["centroid"]
    images["filtered"] = _filtered(whole), until["filter"]
    images["paper"] = _timed(lambda: restore(frames, PAPER).image)
    images["default"] = whole.image, until["deconvolve"]
    return images


def figures(image: FloatArray, clip: Clip, seconds: float) -> Figures:
    """All that can be measured of one restored image."""
    seen = appearance(image, clip.frames.mean(axis=0)) if clip.truth is None else compare(image, clip.truth)
    measured = {name: round(value, 4) for name, value in dataclasses.asdict(seen).items()}
    if clip.centroid is not None:
        measured["centroid_psnr"] = round(compare(image, clip.centroid).psnr, 4)
    return measured | words_read(image, clip) | {"seconds": round(seconds, 2)}


def words_read(image: FloatArray, clip: Clip) -> Figures:
    """Share of the words of a clip that each reader reads; nothing of clips without."""
    readers = filter(can_read, READERS) if clip.words else ()
    return {words_by(reader): round(share_read(image, clip.words, reader), 4) for reader in readers}


def words_by(reader: str) -> str:
    """Name of the figure of a reader."""
    return f"words by {reader}"


def panel(restored: dict[str, tuple[FloatArray, float]], clip: Clip) -> FloatArray:
    """Images of all methods and the truth side by side, each under its name."""
    pictures = {name: image for name, (image, _) in restored.items()}
    if clip.truth is not None:
        pictures["truth"] = clip.truth
    height, width = np.max([picture.shape[:2] for picture in pictures.values()], axis=0)
    tiles = []
    for name, picture in pictures.items():
        tile = np.zeros((height + LABEL_HEIGHT, width, 3), np.uint8)
        cv2.putText(tile, name, (4, LABEL_HEIGHT - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
        colour = picture if picture.ndim == 3 else picture[..., None]
        tile[LABEL_HEIGHT : LABEL_HEIGHT + len(picture), : picture.shape[1]] = np.rint(255 * np.clip(colour, 0, 1))
        tiles.append(tile)
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % PANEL_COLUMNS)
    rows = [np.hstack(tiles[start : start + PANEL_COLUMNS]) for start in range(0, len(tiles), PANEL_COLUMNS)]
    return np.vstack(rows).astype(np.float32) / np.float32(255)


def document(results: Results, chosen: Sequence[str] = ()) -> str:
    """Markdown of everything that was measured; ``chosen`` are the clips that were asked for, all if it is empty."""
    parts = [
        "# Quality\n",
        "What `TURBRESTORE_DATA=DIR python benchmarks/quality.py --write benchmarks/results/quality.md` measures: "
        "clips restored by simple methods, by every stage of the pipeline and by its defaults.\n",
        *([f"Only some of the clips were measured: `--clips {shlex.join(chosen)}`.\n"] if chosen else []),
        "".join(f"- **{method}**: {meaning}.\n" for method, meaning in METHODS.items()),
        f"Clips called `smooth_…` ({COUNT} frames of {SMOOTH_SIDE}×{SMOOTH_SIDE}: smooth random flow, Gaussian blur of "
        f"1 to 2 px, noise 0.01), `strong_…` and `stronger_…` (the same, displaced by {STRONG_RMS['strong']:g} and "
        f"{STRONG_RMS['stronger']:g} px) and `screens_…` ({COUNT} frames of {SCREEN_SIDE}×{SCREEN_SIDE} through phase "
        "screens, weak, medium and strong: D/r0 1.2, 2.5 and 5) "
        "are made on the spot.  The others come from the folder that "
        f"`TURBRESTORE_DATA` names; of real clips the first {MOST_FRAMES} frames and, where there is no text to read, "
        f"the middle {LARGEST_SIDE}×{LARGEST_SIDE} pixels are used.  Results are aligned with the truth once "
        "(`turbrestore.metrics.align`).  Clips called `drawn_…` are those to judge by: their scenes appear in no other "
        "clip, their crops, motion, blur and noise are drawn anew for every version, and nothing was chosen on "
        "them.  Settings were chosen on some of the others, whose means stand apart.  The truth of `drawn_…` is the "
        "scene at the mean geometry of the clip.\n",
    ]
    for heading, figure, digits in (
        ("PSNR, dB", "psnr", 2),
        ("PSNR, dB, against the scene at the mean geometry of the clip", "centroid_psnr", 2),
        ("Structural similarity, after the best gain and offset", "ssim", 3),
    ):
        rows = _rows(results, figure, figure)
        parts.append(f"## {heading}\n\n{_split(rows, digits)}")
    parts += [_words_section(results, reader) for reader in READERS]
    for heading, figure, digits in (
        ("Sharpness without truth: mean gradient relative to the temporal mean", "sharpness", 2),
        ("Overshoot without truth: share of pixels outside the local range of the temporal mean", "overshoot", 4),
    ):
        rows = {name: row for name, row in _rows(results, figure, figure).items() if name not in _scored(results)}
        parts.append(f"## {heading}\n\n{_table(rows, METHODS, digits)}")
    rows = _rows(results, "seconds", "seconds")
    parts.append(
        "## Wall time, s\n\nOnly ratios carry over to another machine; a stage includes those before it.\n\n"
        + _table(rows, METHODS, 1, average=True)
    )
    return "\n".join(parts)


def check_bounds() -> int:
    """Print PSNR of every stage with the blur given by hand; 1 if a bound is broken."""
    root = data_folder()
    if root is None or not (root / "simulated").is_dir():
        print("TURBRESTORE_DATA names no folder with simulated clips; nothing to measure")
        return 0
    print(
        "| clip | sigma | mean | centroid | filtered | deconvolved | bound | seconds |\n"
        "|---|---|---|---|---|---|---|---|"
    )
    failed = False
    for name, (sigma, bound) in BOUNDS.items():
        folder = root / "simulated" / name
        params = RestoreParams(deconvolution=DeconvolutionParams(sigma=sigma))
        restoration = restore(open_frames(folder / "clip.mkv"), params)
        truth = read_image(folder / "truth.png").image
        images = (restoration.mean, restoration.centroid.image, _filtered(restoration), restoration.image)
        mean, centroid, filtered, deconvolved = stages = [compare(image, truth).psnr for image in images]
        failed |= not (mean < centroid <= filtered < deconvolved and deconvolved >= bound)
        cells = " | ".join(f"{stage:.2f}" for stage in stages)
        print(f"| {name} | {sigma} | {cells} | {bound} | {sum(restoration.seconds.values()):.1f} |", flush=True)
    return int(failed)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="+", default=[], metavar="NAME", help="names or patterns; all by default")
    parser.add_argument("--images", type=Path, metavar="DIR", help="write one panel of images a clip")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    parser.add_argument("--bounds", action="store_true", help="check PSNR with the blur given by hand")
    parser.add_argument("--before", metavar="REVISION", help="compare with what this revision makes of the clips")
    parser.add_argument("--preset", choices=LOSS_BOUNDS, default="standard", help="what is compared with --before")
    options = parser.parse_args()
    if options.before is not None and (options.json or options.images or options.bounds):
        parser.error("--before goes with --clips, --preset and --write only")
    return options


def _timed(action: Callable[[], FloatArray]) -> tuple[FloatArray, float]:
    started = time.perf_counter()
    image = action()
    return image, time.perf_counter() - started


def _filtered(restoration: Restoration) -> FloatArray:
    if restoration.filtered is None:
        raise RuntimeError("the filter did not run")
    return restoration.filtered.image


def _scored(results: Results) -> set[str]:
    """Names of the clips with truth."""
    return {name for name, methods in results.items() if "psnr" in methods["default"]}


def _rows(results: Results, needed: str, figure: str) -> dict[str, Figures]:
    """Figures of the clips that have them."""
    return {
        name: {method: found[figure] for method, found in methods.items() if figure in found}
        for name, methods in results.items()
        if needed in methods["default"]
    }


def _split(rows: dict[str, Figures], digits: int) -> str:
    """Tables of the clips on which nothing was chosen, and of the others."""
    parts = [{name: row for name, row in rows.items() if is_reported(name) is part} for part in (True, False)]
    return "\n".join(_table(part, METHODS, digits, average=True) for part in parts if part) or _table({}, (), digits)


def _words_section(results: Results, reader: str) -> str:
    heading = f"## Share of the words that {reader} reads\n\n"
    if not can_read(reader):
        return heading + f"Not measured: {missing(reader)}.\n"
    rows = _rows(results, words_by(reader), words_by(reader))
    columns = [*METHODS]
    note = ""
    if any("peers" in row for row in rows.values()):
        columns.append("peers")
        note = "peers: the best of the results of trained networks that lie beside the clip.\n\n"
    return heading + note + _table(rows, columns, 2, average=True)


def _table(rows: dict[str, Figures], columns: Iterable[str], digits: int, average: bool = False) -> str:
    """Markdown table; with ``average``, a last row of the mean of every complete column."""
    if not rows:
        return "No such clip was measured.\n"
    names = [*columns]
    lines = [f"| clip | {' | '.join(names)} |", f"|---|{'---:|' * len(names)}"]
    complete = {name: [row[name] for row in rows.values() if name in row] for name in names}
    means = {name: float(np.mean(found)) for name, found in complete.items() if len(found) == len(rows)}
    for clip, row in [*rows.items(), *([("**mean**", means)] if average else [])]:
        cells = " | ".join(f"{row[name]:.{digits}f}" if name in row else "–" for name in names)
        lines.append(f"| {clip} | {cells} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
