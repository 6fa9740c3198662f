"""Figures in README.md and docs/ that are those of the tables in ``benchmarks/results``.

A text holds them between ``<!-- figures: NAME -->`` and ``<!-- end -->``; ``fill_texts`` writes them anew.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
MARK = re.compile(r"(<!-- figures: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
# As README.md calls the methods of peers.md.
METHODS = {
    "mean": "temporal mean",
    "lucky average": "lucky average",
    "PlanetarySystemStacker": "PlanetarySystemStacker",
    "pystackreg": "pystackreg",
    "Sobolev flow": "Sobolev flow (Lou et al. 2013)",
    "low rank": "low rank (Oreifej et al. 2013)",
    "template": "diffeomorphic template (Lao et al. 2024)",
    "TMT de-tilting": "de-tilting network of TMT (Zhang et al. 2024), mean of its frames",
    "turbrestore": "turbrestore",
}
STAGES = {
    "middle frame": "middle frame",
    "mean": "temporal mean",
    "centroid": "centroid",
    "filtered": "filtered",
    "paper": "settings of the paper",
    "default": "default",
}

HEAD = "| PSNR, dB | structural similarity | words by Tesseract | words by RapidOCR |\n|---|---:|---:|---:|---:|"
SCORES = "PSNR of the deblurred images, dB"
OWN, SCENE = "turbrestore", "against the scene"
_MEAN = "PSNR, dB, deblurred"

# Rows of a table by their first cell, each a cell by column.
Table = dict[str, dict[str, str]]


def fill_texts() -> list[str]:
    """Write the figures of all texts, and return the names of those that have changed."""
    changed = []
    for path in texts():
        old = path.read_text("utf-8")
        if (new := filled(old)) != old:
            path.write_text(new, "utf-8")
            changed.append(path.relative_to(ROOT).as_posix())
    return changed


def texts() -> list[Path]:
    """Texts that hold figures."""
    found = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    return [path for path in found if MARK.search(path.read_text("utf-8"))]


def filled(text: str) -> str:
    """Text with the figures of the tables."""
    return MARK.sub(lambda found: found[1] + PARTS[found[2]]() + found[3], text)


def read_table(name: str, heading: str) -> Table:
    """First table below a heading of ``benchmarks/results/NAME.md``."""
    below = (RESULTS / f"{name}.md").read_text("utf-8").partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    lines = re.search(r"(?m)(?:^\|.*\|\n)+", below)
    if lines is None:
        return {}
    head, _, *rows = ([cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[0].splitlines())
    return {row[0]: dict(zip(head, row, strict=True)) for row in rows}


def methods() -> str:
    """Means of the methods over the clips that nothing was chosen on, and where others are ahead."""
    drawn = read_table("peers", "Means")
    text = read_table("peers", "Means over the other clips")
    lines = [f"| method {HEAD}"]
    for name, title in METHODS.items():
        if name in drawn:
            figures = [drawn[name][_MEAN], drawn[name]["SSIM, deblurred"]]
            figures += [text[name][f"words by {reader}, deblurred"] for reader in ("Tesseract", "RapidOCR")]
            lines.append(f"| {title} | {' | '.join(figures)} |")
    reported = [row for name, row in read_table("peers", SCORES).items() if name.startswith("drawn_")]
    # The same clips as those that the table lists, whose figures are rounded.
    listed = (RESULTS / "peers.md").read_text("utf-8").partition("\n## Where another method is ahead\n")[2]
    found = re.findall(r"(?m)^- drawn_\w+: \D* ([\d.]+).*; turbrestore ([\d.]+) dB\.", listed)
    lost = [float(best) - float(own) for best, own in found]
    ended = sum(
        "–" not in [row.get(name) for name in METHODS if drawn.get(name, {}).get(_MEAN) != "–"] for row in reported
    )
    said = (
        f"PSNR and similarity are over the {ended} of {len(reported)} clips on which every method ended. "
        if ended < len(reported)
        else ""
    )
    said += f"Another method is ahead in PSNR on {len(lost)} of the {len(reported)} clips"
    said += f", by up to {max(lost):.1f} dB." if lost else "."
    return "\n".join([*lines, "", said, ""])


def stages() -> str:
    """Means of every stage over the clips that nothing was chosen on, and the words of the others."""
    psnr, ssim = (
        read_table("quality", heading)["**mean**"]
        for heading in ("PSNR, dB", "Structural similarity, after the best gain and offset")
    )
    words = [read_table("quality", f"Share of the words that {one} reads") for one in ("tesseract", "rapidocr")]
    lines = [f"| {HEAD}"]
    for name, title in STAGES.items():
        cells = [psnr[name], ssim[name], *(one.get("**mean**", {}).get(name, "–") for one in words)]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join([*lines, ""])


def limits() -> str:
    """Tell what more frames, less noise and a known blur gain."""
    one, frames, others = (
        read_table("oracles", heading)
        for heading in ("One thing made worse at a time", "More frames", "Other turbulence and other cameras")
    )

    def gain(row: dict[str, str], column: str, before: dict[str, str], column_before: str) -> float:
        return float(row[column]) - float(before[column_before])

    (few, start), *_, (many, end) = frames.items()
    known = {name: gain(row, "true blur", row, OWN) for name, row in others.items()}
    least, most = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
    base, noisy = one["base"], one["noise 0.05"]
    return (
        f"- **More frames** take noise and bends out, not blur: {many} in place of {few.split()[0]} change the PSNR by "
        f"{gain(end, SCENE, start, SCENE):+.1f} dB against the scene, and by "
        f"{gain(end, OWN, start, OWN):+.1f} dB against the scene at the mean geometry of the frames.\n"
        f"- **A camera with a fifth of the noise** changes it by {gain(base, OWN, noisy, OWN):+.1f} dB.\n"
        f"- **A blur that is known** changes it by {gain(base, 'true blur', base, OWN):+.1f} dB for *base*, and "
        f"by {sum(known.values()) / len(known):+.1f} dB on average over the simulators: {known[most]:+.1f} dB for "
        f"*{most}*, {known[least]:+.1f} dB for *{least}*.\n"
    )


PARTS: dict[str, Callable[[], str]] = {"methods": methods, "stages": stages, "limits": limits}
