"""Tables of ``peers.py``: means over the clips, every clip, where another method is ahead, and videos."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence

import numpy as np

Figures = dict[str, float]
# Method, clip, figure.
Results = dict[str, dict[str, Figures]]

TURBRESTORE = "turbrestore"
# Suffix of the figures of deblurred images.
SAME = "_sharp"
# What is less than this is no lead: dB, and shares of words.
LEADS = {f"psnr{SAME}": 0.05, f"words{SAME}": 0.02}
COLUMNS = (
    ("PSNR, dB", "psnr", 2),
    ("deblurred", f"psnr{SAME}", 2),
    ("SSIM", "ssim", 3),
    ("deblurred", f"ssim{SAME}", 3),
    ("PSNR at the mean geometry, dB, deblurred", f"centroid{SAME}", 2),
    ("words", "words", 2),
    ("deblurred", f"words{SAME}", 2),
    ("processor time a clip, s", "seconds", 1),
    ("of deblurring", "deblurring", 1),
    ("peak memory, MB", "peak", 0),
)
VIDEO_FIGURES = (("psnr", 2), ("ssim", 3), ("flicker", 2), ("seconds", 1))


def document(
    results: Results,
    meanings: Mapping[str, str],
    skipped: Mapping[str, str],
    videos: Mapping[str, Results],
    chosen: Sequence[str] = (),
) -> str:
    """Markdown of everything that was measured; ``chosen`` are the clips that were asked for, all if it is empty."""
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
        "PSNR and structural similarity (SSIM, after the best gain and offset) over the clips with known truth, words "
        "over those with text, each after alignment and over the clips on which every method ended.  Processor time is "
        "that of all threads, and high on a busy machine; packages start an interpreter for each clip, which counts.  "
        "Memory is the peak of the process over all clips, libraries included.\n",
        _means(results),
        "## Where another method is ahead\n",
        _leads(results),
    ]
    for heading, figure, digits in (
        ("PSNR of the merged images, dB", "psnr", 2),
        ("PSNR of the deblurred images, dB", f"psnr{SAME}", 2),
        ("Share of the words that tesseract reads, deblurred images", f"words{SAME}", 2),
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


def _means(results: Results) -> str:
    """Return a row of means for each method, over the clips that have the figure by every method."""
    header = "| method | " + " | ".join(title for title, _, _ in COLUMNS) + " |\n|---|" + "---:|" * len(COLUMNS)
    lines = [header]
    for method, clips in results.items():
        cells = []
        for _, figure, digits in COLUMNS:
            common = [clip for clip in clips if all(figure in found.get(clip, {}) for found in results.values())]
            values = [clips[clip][figure] for clip in common]
            mean = max(values) if values and figure == "peak" else float(np.mean(values)) if values else None
            cells.append(_number(mean, digits))
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _leads(results: Results) -> str:
    """List of the clips on which a deblurred image of another method is better than that of this project."""
    lines = []
    for clip, own in results.get(TURBRESTORE, {}).items():
        for figure, least in LEADS.items():
            others = {
                name: found[clip][figure]
                for name, found in results.items()
                if name != TURBRESTORE and figure in found.get(clip, {})
            }
            ahead = {name: value for name, value in others.items() if figure in own and value > own[figure] + least}
            if ahead:
                unit = " dB" if figure.startswith("psnr") else " of the words"
                said = ", ".join(f"{name} {ahead[name]:.2f}" for name in sorted(ahead, key=lambda one: -ahead[one]))
                lines.append(f"- {clip}: {said}; {TURBRESTORE} {own[figure]:.2f}{unit}\n")
    return "".join(lines) or "On no clip.\n"


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
