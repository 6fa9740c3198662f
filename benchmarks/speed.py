"""Time of whole restorations beside an earlier revision and beside optical flow alone, how it grows, and memory.

    python benchmarks/speed.py --before 7b5207f --full --write benchmarks/results/speed.md

prints a Markdown document, writes it, and exits with 1 when a bound is broken.  Each figure comes from a process of its
own, the revisions in turn, and the smallest of a few runs counts.  ``--before`` names a revision of this repository;
without it only the present tree is measured.  ``--full`` adds 1,000 frames and frames of 1920×1080.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from revisions import Figures, child, revision, take_two_cores

from turbrestore.core.errors import TurbrestoreError
from turbrestore.io.output import atomic_write
from turbrestore.registration.flow import iterate_flows
from turbrestore.runtime.runtime import Runtime
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

CHILD = str(Path(__file__).with_name("restore_child.py"))
# Against the earlier revision: a whole restoration, and the deconvolution by itself.
WHOLE_BOUND, DECONVOLUTION_BOUND = 1.15, 1.4
FRAMES_BOUND, PIXELS_BOUND, MEMORY_BOUND_MB, HELP_BOUND = 1.05, 1.1, 20.0, 6.0
# What the exponents are fitted to: two passes of the centroid, and so many frames to train, whatever the clip.
COUNTS, COUNTS_SIDE, SIDES, SIDES_COUNT = (500, 1000, 2000), 128, (128, 256, 384, 768), 60
FEW, MANY, TRAINED = 260, 2060, 60
# Distinct frames of a clip; longer ones repeat them.
DISTINCT = 60
STAGES = ("centroid", "identify", "filter", "deconvolve")


@dataclass(frozen=True)
class Clip:
    """A clip of a scene under smooth random motion; what is done once takes longer for a photograph than for a chart.

    Attributes
    ----------
    count, height, width : int
    scene : str
    bound : bool
        Whether the time has a bound.
    runs : int
        Runs of each revision.
    """

    count: int
    height: int
    width: int
    scene: str = "chart"
    bound: bool = False
    runs: int = 3

    def write(self, folder: Path) -> Path:
        """Write the distinct frames, 8 bits, as a .npy file."""
        count = min(self.count, DISTINCT, max(25, 2**24 // (self.height * self.width)))
        path = folder / f"{self.scene}_{count}_{self.height}_{self.width}.npy"
        if not path.exists():
            rng, image = np.random.default_rng(0), SCENES[self.scene](self.height, self.width)
            flows = smooth_flows(count, self.height, self.width, rng, SmoothFlowParams(rms=1.5))
            moved = (distort(image, flow[None], rng, blur=1 + rng.random(), noise=0.01)[0] for flow in flows)
            np.save(path, np.stack([np.rint(frame * 255).clip(0, 255).astype(np.uint8) for frame in moved]))
        return path


ROWS = (
    Clip(50, 128, 128),
    Clip(120, 256, 256, bound=True, runs=5),
    Clip(300, 256, 256),
    Clip(200, 512, 512, runs=1),
)
FULL_ROWS = (
    Clip(1000, 256, 256, runs=1),
    Clip(25, 1080, 1920, bound=True, runs=2),
    Clip(25, 1080, 1920, "camera", bound=True, runs=2),
)


def main() -> int:
    """Print the document; 1 when a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="1,000 frames and 1920×1080 as well")
    parser.add_argument("--before", metavar="REVISION", help="measure this revision beside the present tree")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    options = parser.parse_args()
    take_two_cores()
    try:
        with revision(options.before) as tree, tempfile.TemporaryDirectory() as folder:
            text, broken = document(options.full, options.before, tree, Path(folder))
    except TurbrestoreError as error:
        print(f"speed: {error}", file=sys.stderr)
        return error.exit_code
    print(text, end="")
    if options.write is not None:
        atomic_write(options.write, text.encode(), overwrite=True)
    for line in broken:
        print(f"speed: {line}", file=sys.stderr)
    return int(bool(broken))


def document(full: bool, before: str | None, tree: Path | None, folder: Path) -> tuple[str, list[str]]:
    """Markdown of the tables, and the bounds that are broken."""
    broken: list[str] = []
    command = f"python benchmarks/speed.py{' --full' if full else ''}{f' --before {before}' if before else ''}"
    lines = [
        "# Speed\n",
        f"What `{command} --write benchmarks/results/speed.md` measures: scenes under smooth random motion, two cores, "
        f"{_machine()}.  It ends with 1 where a bound is broken.\n",
        "## Restorations\n",
        "Seconds of a whole restoration with the default settings, smallest of a few runs, and of its optical flow "
        "alone, each call without a start from an earlier flow. Frames are in memory, so nothing is decoded.\n",
        *_time_table((*ROWS, *FULL_ROWS) if full else ROWS, tree, folder, broken),
        "\n## Growth\n",
        f"Exponent of the time of a restoration, with two passes of the centroid and {TRAINED} frames to train.\n",
        *_growth_table(folder, broken),
        "\n## Memory\n",
        *_memory_lines(folder, broken),
        *_help_lines(broken),
    ]
    if broken:
        lines += ["\n## Broken bounds\n", *(f"- {line}" for line in broken)]
    return "\n".join(lines) + "\n", broken


def _time_table(rows: tuple[Clip, ...], tree: Path | None, folder: Path, broken: list[str]) -> list[str]:
    names = ["frames", "size", "scene"]
    names += ["before, s", "now / before", "CPU", "deconvolution alone"] if tree else []
    names += ["now, s", "flow alone, s", "ratio", *(f"{stage}, s" for stage in STAGES), "peak, MB"]
    lines = [f"| {' | '.join(names)} |", f"|{'---:|' * len(names)}"]
    for clip in rows:
        path = clip.write(folder)
        task = {"frames": str(path), "count": clip.count, "deconvolution": True}
        old, new = list[Figures](), list[Figures]()
        for _ in range(clip.runs):
            old += [child(CHILD, task, tree)] if tree else []
            new.append(child(CHILD, task))
        best = min(new, key=lambda found: found["seconds"])
        flow = _flow_seconds(np.load(path)) * best["calls"]
        cells = [f"{clip.count:,}", f"{clip.width}×{clip.height}", clip.scene]
        if old:
            cells.append(f"{_least(old, 'seconds'):.2f}")
            whole, work, alone = (_least(new, name) / _least(old, name) for name in ("seconds", "cpu", "deconvolution"))
            cells += [f"{whole:.2f}", f"{work:.2f}", f"{alone:.2f}"]
            name = f"{clip.count} frames of {clip.width}×{clip.height}, {clip.scene}"
            if clip.bound and whole > WHOLE_BOUND:
                broken.append(f"{name}: {whole:.3f} times the time before, bound {WHOLE_BOUND}")
            if clip.bound and alone > DECONVOLUTION_BOUND:
                broken.append(f"{name}: deconvolution {alone:.2f} times, bound {DECONVOLUTION_BOUND}")
        cells += [f"{best['seconds']:.2f}", f"{flow:.2f}", f"{best['seconds'] / flow:.2f}"]
        cells += [*(f"{best['stages'].get(stage, 0.0):.2f}" for stage in STAGES), f"{best['peak']:,.0f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _least(runs: list[Figures], name: str) -> float:
    return float(min(run[name] for run in runs))


def _flow_seconds(stored: np.ndarray) -> float:
    """Wall time of one flow, two frames at a time."""
    frames = stored[:25].astype(np.float32) / 255
    begun = time.perf_counter()
    for _ in iterate_flows(frames.mean(axis=0), frames, runtime=Runtime(threads=2)):
        pass
    return (time.perf_counter() - begun) / len(frames)


def _growth_table(folder: Path, broken: list[str]) -> list[str]:
    lines = ["| against | exponent | bound |", "|---|---:|---:|"]
    for name, clips, bound in (
        (
            f"frames: {', '.join(map(str, COUNTS))} of {COUNTS_SIDE}×{COUNTS_SIDE}",
            [Clip(count, COUNTS_SIDE, COUNTS_SIDE) for count in COUNTS],
            FRAMES_BOUND,
        ),
        (
            f"pixels: {SIDES_COUNT} frames of side {', '.join(map(str, SIDES))}",
            [Clip(SIDES_COUNT, side, side) for side in SIDES],
            PIXELS_BOUND,
        ),
    ):
        seconds = [_growth(clip, folder)["seconds"] for clip in clips]
        sizes = [clip.count * clip.height * clip.width for clip in clips]
        found = float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
        if found > bound:
            broken.append(f"exponent against {name}: {found:.2f}, bound {bound}")
        lines.append(f"| {name} | {found:.2f} | {bound} |")
    return lines


def _growth(clip: Clip, folder: Path) -> Figures:
    task = {"frames": str(clip.write(folder)), "count": clip.count, "train": TRAINED, "passes": 2}
    return child(CHILD, task)


def _memory_lines(folder: Path, broken: list[str]) -> list[str]:
    few, many = (_growth(Clip(count, COUNTS_SIDE, COUNTS_SIDE), folder)["peak"] for count in (FEW, MANY))
    if many - few > MEMORY_BOUND_MB:
        broken.append(f"memory grows by {many - few:.1f} MB, bound {MEMORY_BOUND_MB}")
    return [
        f"A process that restores {FEW:,} frames of {COUNTS_SIDE}×{COUNTS_SIDE} peaks at {few:.0f} MB, and at "
        f"{many:.0f} MB for {MANY:,}; bound {MEMORY_BOUND_MB:.0f} MB more."
    ]


def _help_lines(broken: list[str]) -> list[str]:
    """Compare ``turbrestore --help`` with starting Python and importing NumPy, by the median of nine pairs."""

    def seconds(code: str) -> float:
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=True)
        return time.perf_counter() - begun

    pairs = [
        (seconds("from turbrestore_cli.__main__ import main; main(['--help'])"), seconds("import numpy"))
        for _ in range(9)
    ]
    ratio = float(np.median([a / b for a, b in pairs]))
    if ratio > HELP_BOUND:
        broken.append(f"--help takes {ratio:.1f} times as long as importing NumPy, bound {HELP_BOUND}")
    taken = float(np.median([a for a, _ in pairs]))
    return [
        f"\n`turbrestore --help` takes {taken:.2f} s, {ratio:.1f} times as long as Python with NumPy takes to start; "
        f"bound {HELP_BOUND:.0f}."
    ]


def _machine() -> str:
    models = Path("/proc/cpuinfo")
    text = models.read_text() if models.is_file() else ""
    names = [line.split(":")[1].strip() for line in text.splitlines() if line.startswith("model name")]
    return names[0] if names else sys.platform


if __name__ == "__main__":
    sys.exit(main())
