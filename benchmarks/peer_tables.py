"""Tables of ``peers.py``: means over the clips, a network, where another method is ahead, every clip, and videos."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from clips import is_reported
from methods.packages import NETWORK


class Trial(NamedTuple):
    """A figure with a blur of this width (pixels) and exponent removed, and λ times a factor."""

    figure: float
    width: float
    exponent: float
    factor: float = 1.0


Figures = dict[str, float]
# Method, clip, figure.
Results = dict[str, dict[str, Figures]]
# By clip and figure; the first is what is removed by default.
Trials = dict[tuple[str, str], list[Trial]]

TURBRESTORE = "turbrestore"
# Suffix of the figures of deblurred images.
SAME = "_sharp"
# Figure of a method that returns one image, which it has merged and sharpened at once.
INSEPARABLE = "inseparable"
# Readers, and the figures of what each reads.
READ = {"tesseract": "words", "rapidocr": "words_rapidocr"}
# Rounding of a figure; and what is less is no lead: dB, chosen, and shares of words.  The last bits of an image move
# what is read by 0.03 (``words.py``), and so a difference by 0.04.
EQUAL = 0.005
LEADS = {f"psnr{SAME}": 0.05} | {f"{figure}{SAME}": 0.04 for figure in READ.values()}
COLUMNS = (
    ("PSNR, dB", "psnr", 2),
    ("PSNR, dB, deblurred", f"psnr{SAME}", 2),
    ("SSIM", "ssim", 3),
    ("SSIM, deblurred", f"ssim{SAME}", 3),
    ("PSNR at the mean geometry, dB, deblurred", f"centroid{SAME}", 2),
    ("words by Tesseract", "words", 2),
    ("words by Tesseract, deblurred", f"words{SAME}", 2),
    ("words by RapidOCR, deblurred", f"words_rapidocr{SAME}", 2),
    ("processor time a clip, s", "seconds", 1),
    ("peak memory, MB", "peak", 0),
)
VIDEO_FIGURES = (("psnr", 2), ("ssim", 3), ("flicker", 2), ("seconds", 1))


def document(
    results: Results,
    meanings: Mapping[str, str],
    skipped: Mapping[str, str],
    videos: Mapping[str, Results],
    chosen: Sequence[str] = (),
    trials: Trials | None = None,
) -> str:
    """Markdown of everything that was measured; ``chosen`` are the clips that were asked for, all if it is empty.

    ``trials`` say what other settings give where another method is ahead.
    """
    parts = [
        "# Beside other methods\n",
        "What `TURBRESTORE_DATA=DIR python benchmarks/peers.py --write benchmarks/results/peers.md` measures: the same "
        "clips by methods of others and by this project.  Settings and where they come from stand in "
        "`benchmarks/methods`; what is not a paper's was chosen on crops of these clips, in favour of the method.  A "
        "method that ends with a blurred image is also shown with the blind deconvolution of this project after it, so "
        "that merged images are compared with merged ones, and deblurred with deblurred.\n",
        "".join(f"- **{name}**: {meaning}.\n" for name, meaning in meanings.items()),
    ]
    if chosen:
        part = f"Only some of the clips were measured: `--clips {shlex.join(chosen)}`.  Without the option all are.\n"
        parts.insert(2, part)
    if skipped:
        parts.append("Not measured:\n\n" + "".join(f"- {name}: {reason}\n" for name, reason in skipped.items()))
    parts += [
        "## Means\n",
        "Over the clips `drawn_…`, on which nothing was chosen: scenes, crops and settings are drawn anew for every "
        "version.  PSNR and structural similarity (SSIM, after the best gain and offset) after alignment, over the "
        "clips on which every method ended.  Processor time is that of all threads, with deblurring, and high on a "
        "busy machine; packages start an interpreter for each clip, which counts.  Memory is the peak of the process, "
        "libraries included: over all clips, and of packages for one clip.\n",
        _means(results, is_reported),
        "## Means over the other clips\n",
        "Settings were chosen on some of these.  PSNR and SSIM are over the clips with known truth, words over those "
        f"with text, each without the clips on which a method gave no result; {NETWORK}, which ran on some only, does "
        "not count here.\n",
        _means(results, lambda clip: not is_reported(clip)),
        "## Beside a network\n",
        _network(results),
        "## Where another method is ahead\n",
        f"Each clip on which another method is ahead by {LEADS[f'psnr{SAME}']} dB or {LEADS[f'words{SAME}']} of the "
        "words, and where its lead arises.  The blur of a merged image of others is estimated from that image alone; "
        f"{TURBRESTORE} also uses the frames.  Each lead is taken apart by "
        f"removing other widths from the merged image of {TURBRESTORE}, from half to twice the one that it has "
        "removed, or up to 1 px where it has removed none, and by removing none; where that is not enough, for PSNR a "
        "Gaussian in place of the estimated shape, and then half and twice the weight λ of the data at the best "
        "width.  The share of words is the best of all trials, and so partly chance.\n",
        _leads(results, trials or {}),
    ]
    for heading, figure, digits in (
        ("PSNR of the merged images, dB", "psnr", 2),
        ("PSNR of the deblurred images, dB", f"psnr{SAME}", 2),
        ("Share of the words that Tesseract reads, deblurred images", f"words{SAME}", 2),
        ("Share of the words that RapidOCR reads, deblurred images", f"words_rapidocr{SAME}", 2),
    ):
        rows = {
            clip: {method: found[clip][figure] for method, found in results.items() if figure in found.get(clip, {})}
            for clip in dict.fromkeys(clip for found in results.values() for clip in found)
        }
        rows = {clip: row for clip, row in rows.items() if row}
        parts.append(f"## {heading}\n\n" + _table("clip", rows, [*results], digits))
    if videos:
        parts.append(_videos(videos))
    return "\n".join(parts)


def _means(results: Results, chosen: Callable[[str], bool]) -> str:
    """Return a row of means for each method, over the chosen clips whose figure is known of all but the network."""
    header = "| method | " + " | ".join(title for title, _, _ in COLUMNS) + " |\n|---|" + "---:|" * len(COLUMNS)
    lines = [header]
    for method, clips in results.items():
        cells = []
        for _, figure, digits in COLUMNS:
            others = [found for name, found in results.items() if name != NETWORK and any(map(chosen, found))]
            names = filter(chosen, dict.fromkeys(clip for found in others for clip in found))
            common = [clip for clip in names if all(figure in found.get(clip, {}) for found in others)]
            values = [clips[clip][figure] for clip in common if figure in clips.get(clip, {})]
            whole = bool(values) and len(values) == len(common)
            mean = (max(values) if figure == "peak" else float(np.mean(values))) if whole else None
            cells.append(_number(mean, digits))
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


NETWORK_COLUMNS = (
    ("PSNR, dB", f"psnr{SAME}", 2),
    ("Tesseract", f"words{SAME}", 2),
    ("RapidOCR", f"words_rapidocr{SAME}", 2),
    ("s", "seconds", 0),
)


def _network(results: Results) -> str:
    """Table of the network and of this project, clip by clip."""
    own, found = results.get(TURBRESTORE, {}), results.get(NETWORK, {})
    rows = [clip for clip in found if clip in own]
    if not rows:
        return "Not measured.\n"
    titles = [f"{who}: {title}" for title, _, _ in NETWORK_COLUMNS for who in ("network", "turbrestore")]
    lines = [
        "The mean of its de-tilted frames as it is, and, as all else here, after the deconvolution of this project.  "
        "The network is one half of its method: the other half, which deblurs, is not in that package.\n",
        f"| clip | network, not deblurred, dB | {' | '.join(titles)} |",
        f"|---|{'---:|' * (1 + len(titles))}",
    ]
    for clip in rows:
        pairs = [_number(by[clip].get(figure), digits) for _, figure, digits in NETWORK_COLUMNS for by in (found, own)]
        lines.append(f"| {clip} | {_number(found[clip].get('psnr'), 2)} | {' | '.join(pairs)} |")
    return "\n".join(lines) + "\n"


def leaders(results: Results, clip: str, figure: str) -> Figures:
    """Figures of the methods that end with more on a clip than this project, the best first."""
    own = results.get(TURBRESTORE, {}).get(clip, {})
    others = {name: found.get(clip, {}).get(figure) for name, found in results.items() if name != TURBRESTORE}
    ahead = {
        name: value
        for name, value in others.items()
        if figure in own and value is not None and value > own[figure] + LEADS[figure]
    }
    return dict(sorted(ahead.items(), key=lambda item: -item[1]))


def _leads(results: Results, trials: Trials) -> str:
    """List of the clips on which a deblurred image of another method is better than that of this project."""
    lines = []
    for clip, own in results.get(TURBRESTORE, {}).items():
        for figure in LEADS:
            if ahead := leaders(results, clip, figure):
                said = ", ".join(f"{name} {value:.2f}" for name, value in ahead.items())
                first = next(iter(ahead))
                why = _cause(first, results[first][clip], own, figure, trials.get((clip, figure), []))
                lines.append(f"- {clip}: {said}; {TURBRESTORE} {own[figure]:.2f} {_unit(figure)}. {why}\n")
    return "".join(lines) or "On no clip.\n"


def reader_of(figure: str) -> str | None:
    """Reader that tells a figure of deblurred images, None where it is no share of words."""
    return next((name for name, read in READ.items() if figure == f"{read}{SAME}"), None)


def _unit(figure: str) -> str:
    reader = reader_of(figure)
    return f"of the words by {reader}" if reader else "dB"


def _cause(name: str, other: Figures, own: Figures, figure: str, trials: Sequence[Trial]) -> str:
    """Sentence on the stage in which a lead arises: geometry, width, shape, λ, or merging."""
    centroid = f"centroid{SAME}"
    if figure.startswith("psnr") and centroid in own and own[centroid] >= other.get(centroid, np.inf):
        return f"At the mean geometry of the clip {TURBRESTORE} is ahead, so the scene is bent as a whole, not blurred."
    if not trials:
        return _merging(name, other, own, figure)
    removed, best = trials[0], max(trials, key=lambda trial: trial.figure)
    if best.figure <= own[figure] + LEADS[figure]:
        return f"No blur that was tried gives clearly more. {_merging(name, other, own, figure)}"
    if best.figure <= removed.figure + LEADS[figure]:
        best = removed
        reached = f"Without weights by brightness and the checks that follow the deconvolution it has {best.figure:.2f}"
    else:
        reached = f"By removing {_change(removed, best)} it has {best.figure:.2f}"
    if best.figure >= other[figure] - LEADS[figure]:
        return f"{reached}: its merged image is good enough."
    return f"{reached}, and by no blur that was tried more. {_merging(name, other, own, figure)}"


def _change(removed: Trial, best: Trial) -> str:
    changed = [_width(best.width)]
    if best.width != removed.width:
        changed.append(f"in place of {_width(removed.width)}")
    if best.width and removed.width and abs(best.exponent - removed.exponent) >= EQUAL:
        changed.append(f"as a Gaussian in place of an exponent of {removed.exponent:.2f}")
    if best.factor != 1:
        changed.append(f"with {'half' if best.factor < 1 else 'twice'} the λ")
    return " ".join(changed)


def _width(width: float) -> str:
    return f"{width:.2f} px" if width else "no blur"


def _merging(name: str, other: Figures, own: Figures, figure: str) -> str:
    """Sentence on who is ahead before deblurring."""
    merged = figure.removesuffix(SAME)
    if merged not in own or merged not in other:
        return ""
    if other.get(INSEPARABLE):
        return f"{name} sharpens as it merges, so that its stages cannot be told apart."
    less = own[merged] - other[merged]
    if abs(less) < (EQUAL if figure.startswith("psnr") else LEADS[figure]):
        return f"Before deblurring {name} is neither ahead nor behind."
    size = f"{abs(less):.2f} {'dB' if figure.startswith('psnr') else 'of the words'}"
    return f"Before deblurring {name} is {size} {'behind' if less > 0 else 'ahead already'}."


def _videos(videos: Mapping[str, Results]) -> str:
    parts = [
        "## Videos\n",
        "Every third frame against that of the truth, PSNR in dB over all channels and SSIM of grey; flicker is the "
        "mean difference of successive frames relative to that of the truth, right at 1.  Networks are the published "
        "outputs that lie beside a clip.\n",
    ]
    for name, methods in videos.items():
        lines = [f"| {name} | PSNR, dB | SSIM | flicker | processor time, s |\n|---|---:|---:|---:|---:|"]
        for method, found in methods.items():
            cells = [_number(found.get(figure), digits) for figure, digits in VIDEO_FIGURES]
            lines.append(f"| {method} | {' | '.join(cells)} |")
        own = methods[TURBRESTORE]["psnr"] + LEADS[f"psnr{SAME}"] if TURBRESTORE in methods else np.inf
        ahead = [method for method, found in methods.items() if found["psnr"] > own]
        lines.append(f"\nAhead of {TURBRESTORE} in PSNR: {', '.join(ahead) or 'none'}.")
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None or np.isnan(value) else f"{value:.{digits}f}"


def _table(corner: str, rows: Mapping[str, Figures], columns: list[str], digits: int) -> str:
    if not rows:
        return "No such clip was measured.\n"
    lines = [f"| {corner} | {' | '.join(columns)} |", f"|---|{'---:|' * len(columns)}"]
    for name, row in rows.items():
        lines.append(f"| {name} | {' | '.join(_number(row.get(column), digits) for column in columns)} |")
    return "\n".join(lines) + "\n"
