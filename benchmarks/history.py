"""Quality, time, memory and size of every release, as a table and as a figure.

    python benchmarks/history.py --write benchmarks/results/history.md

The command of each release restores the drawn clips of the present version, each in a process of its own.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from clips import drawn_clips
from provenance import publish
from revisions import environment, revision

import turbrestore
from turbrestore.core.arrays import FloatArray
from turbrestore.metrics import compare

# Versions of the changelog, and revisions whose code has their number.
RELEASES = {"0.1.0": "85ac0a9", "0.2.0": "a8c87a1", "0.3.0": "698b073", turbrestore.__version__: None}
# A command that prints its largest memory, MB, at its end.
COMMAND = """import sys
sys.path.append(sys.argv[1])
from usage import peak_megabytes
from turbrestore_cli.__main__ import main
code = main(sys.argv[2:])
print(peak_megabytes())
sys.exit(code)"""


@dataclass(frozen=True)
class Release:
    """Figures of a release: PSNR of each clip, dB, seconds and megabytes of each, and lines of the package."""

    name: str
    psnr: tuple[float, ...]
    seconds: tuple[float, ...]
    memory: tuple[float, ...]
    lines: int


def main() -> int:
    """Print the table, or write it and its figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path)
    given = parser.parse_args()
    clips = {name: load() for name, load in drawn_clips(turbrestore.__version__).items()}
    truths = [clip.truth for clip in clips.values() if clip.truth is not None]
    mean = [compare(clip.frames.mean(axis=0), truth).psnr for clip, truth in zip(clips.values(), truths, strict=True)]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, f"{name}.npy") for name in clips]
        for path, clip in zip(paths, clips.values(), strict=True):
            np.save(path, np.rint(255 * clip.frames).astype(np.uint8))
        releases = [measure(name, made_from, paths, truths) for name, made_from in RELEASES.items()]
    publish(document(releases, float(np.mean(mean))), given.write)
    if given.write is not None:
        draw(releases, float(np.mean(mean)), given.write.with_suffix(".png"))
    return 0


def measure(name: str, made_from: str | None, paths: list[Path], truths: list[FloatArray]) -> Release:
    """Restore clips by the command of a release; the first one once more before, so that all is compiled."""
    with revision(made_from) as tree:
        restore(paths[0], tree)
        rows = [(restore(path, tree), truth) for path, truth in zip(paths, truths, strict=True)]
        package = (Path(turbrestore.__file__).parent if tree is None else tree / "turbrestore").rglob("*.py")
        lines = sum(len(path.read_text().splitlines()) for path in package)
    psnr = tuple(compare(image, truth).psnr for (image, _, _), truth in rows)
    seconds, memory = tuple(row[1] for row, _ in rows), tuple(row[2] for row, _ in rows)
    print(f"{name}: {np.mean(psnr):.2f} dB, {np.mean(seconds):.1f} s", file=sys.stderr, flush=True)
    return Release(name, psnr, seconds, memory, lines)


def restore(path: Path, tree: Path | None) -> tuple[FloatArray, float, float]:
    """Image (H, W), seconds and megabytes of a command."""
    result, usage = path.with_suffix(".png"), str(Path(__file__).parent / "methods")
    command = [sys.executable, "-c", COMMAND, usage, "restore", str(path), str(result), "--overwrite", "--quiet"]
    begun = time.perf_counter()
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True, cwd=path.parent, env=environment(tree))
    seconds = time.perf_counter() - begun
    return np.float32(iio.imread(result)) / np.float32(255), seconds, float(done.stdout.split()[-1])


def document(releases: list[Release], mean: float) -> str:
    """Markdown table."""
    count = len(releases[0].psnr)
    lines = [
        "# Releases",
        "",
        f"Made by `python benchmarks/history.py`: {count} drawn clips, restored by the command of each release with",
        f"its defaults on one machine, with the libraries of today. The mean of the frames has {mean:.2f} dB. Time,",
        "start included, and peak memory are means over the clips. Gains are over the release before, with their",
        "standard error; the least is that of a single clip.",
        "",
        "| release | mean PSNR, dB | gain, dB | least gain, dB | time, s | memory, MB | package, lines |",
        "|---|---|---|---|---|---|---|",
    ]
    for before, release in zip([None, *releases], releases, strict=False):
        gain, least = _gain(release.psnr, before.psnr) if before else ("–", "–")
        lines.append(
            f"| {release.name} | {np.mean(release.psnr):.2f} | {gain} | {least} | {np.mean(release.seconds):.1f} | "
            f"{np.mean(release.memory):.0f} | {release.lines:,} |"
        )
    return "\n".join([*lines, "", "![The same as a figure](history.png)"]) + "\n"


def _gain(now: tuple[float, ...], before: tuple[float, ...]) -> tuple[str, str]:
    """Mean difference with its standard error, and the least."""
    gains = np.subtract(now, before)
    return f"{gains.mean():+.2f} ± {gains.std(ddof=1) / np.sqrt(gains.size):.2f}", f"{gains.min():+.2f}"


def draw(releases: list[Release], mean: float, path: Path) -> None:
    """Draw the figures of the table over the releases."""
    import matplotlib.pyplot as plt

    shown = {
        "PSNR, dB": [np.mean(release.psnr) for release in releases],
        "time, s": [np.mean(release.seconds) for release in releases],
        "memory, MB": [np.mean(release.memory) for release in releases],
        "lines, thousands": [release.lines / 1e3 for release in releases],
    }
    figure, axes = plt.subplots(1, len(shown), figsize=(10, 2.4), layout="constrained")
    for axis, (title, values) in zip(axes, shown.items(), strict=True):
        axis.plot([release.name for release in releases], values, "o-")
        axis.set_title(title)
        if title != "PSNR, dB":
            axis.set_ylim(bottom=0)
    axes[0].axhline(mean, color="0.6", linestyle=":", label="mean of the frames")
    axes[0].legend()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    sys.exit(main())
