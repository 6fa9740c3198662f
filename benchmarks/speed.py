"""Time of the command that restores a clip beside an earlier revision, its start alone, and how it grows.

    python benchmarks/speed.py --before 546a653 --full --write benchmarks/results/speed.md
    python benchmarks/speed.py --stages

prints a Markdown document, writes it, and exits with 1 when a bound is broken.  Other programs on the machine change
the time of the processor little, that of the clock much.  Each figure comes from a process of its own, the revisions in
turn, and ratios are medians of those of neighbouring runs.  ``--before`` names a revision of this repository; without
it only the present tree is measured.  ``--full`` adds larger clips, frames of 1920×1080 and 3840×2160, and more runs.
``--stages`` prints what every stage takes, which ``cli/progress.py`` has.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import batch
import numpy as np
from provenance import publish
from revisions import Figures, child, environment, revision, take_two_cores

from turbrestore.core.errors import TurbrestoreError
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

CHILD = str(Path(__file__).with_name("restore_child.py"))
# Processor time against the standard preset of an earlier revision; the exponents; and the list of commands and the
# start of a restoration against an import of NumPy.
WHOLE_BOUND, FRAMES_BOUND, PIXELS_BOUND, HELP_BOUND, START_BOUND = 1.15, 1.05, 1.1, 1.0, 6.0
# What the exponents are fitted to: two passes of the centroid, and at most so many frames to train.
COUNTS, COUNTS_SIDE, TRAINED = (12, 120, 500, 2000), 128, 60
SIZES, FULL_SIZES, SIZES_COUNT = ((128, 128), (256, 256), (512, 512)), ((1080, 1920), (2160, 3840)), 12
# Exponents leave out what is smaller: there most of the time is what is done once.
FEWEST_FITTED, LEAST_PIXELS = 120, 256**2
BATCH = (6, 48, 128)
# Distinct frames of a clip; longer ones repeat them.
DISTINCT = 60
HELP = ("--help", "restore --help")
# A command that leaves the names of the modules that it has loaded, and what loads them.
COMMAND = """import sys
from turbrestore_cli.__main__ import main
code = main(sys.argv[2:])
open(sys.argv[1], "w").write(" ".join(sys.modules))
sys.exit(code)"""
START = """import contextlib, importlib, sys
for name in open(sys.argv[1]).read().split():
    with contextlib.suppress(Exception):
        importlib.import_module(name)"""
# Stages of the clip by which ``--stages`` measures, with what they grow with.
STAGES_CLIP, STAGES_PRESETS = (60, 256, 256, "camera"), ("standard", "fast", "paper")


@dataclass(frozen=True)
class Clip:
    """A clip of a scene under smooth random motion; what is done once takes longer for a photograph than for a chart.

    Each revision and preset is run ``runs`` times; only with more than one run do the ratios have to hold a bound.
    """

    count: int
    height: int
    width: int
    scene: str = "chart"
    runs: int = 1

    def __str__(self) -> str:
        return f"{self.count:,} × {self.width}×{self.height}"

    def write(self, folder: Path) -> Path:
        """Write the distinct frames, 8 bits, as a .npy file."""
        count = min(self.count, DISTINCT, max(12, 2**24 // (self.height * self.width)))
        path = folder / f"{self.scene}_{count}_{self.height}_{self.width}.npy"
        if not path.exists():
            rng, image = np.random.default_rng(0), SCENES[self.scene](self.height, self.width)
            flows = smooth_flows(count, self.height, self.width, rng, SmoothFlowParams(rms=1.5))
            moved = (distort(image, flow[None], rng, blur=1 + rng.random(), noise=0.01)[0] for flow in flows)
            np.save(path, np.stack([np.rint(frame * 255).clip(0, 255).astype(np.uint8) for frame in moved]))
        return path

    def write_whole(self, folder: Path) -> Path:
        """Write all frames, which repeat the distinct ones, as a .npy file."""
        distinct, path = np.load(self.write(folder)), folder / f"whole_{self.scene}_{self.count}_{self.height}.npy"
        if not path.exists():
            np.save(path, distinct[np.arange(self.count) % len(distinct)])
        return path

    def command(self, folder: Path, preset: str = "standard", tree: Path | None = None) -> Figures:
        """Run ``turbrestore restore`` on the clip: its time, and the processor time of loading what it loads."""
        modules, result = folder / "modules.txt", folder / "result.png"
        words = ["restore", str(self.write_whole(folder)), str(result), "--preset", preset, "--overwrite", "--quiet"]
        seconds, cpu = run_timed(COMMAND, [str(modules), *words], tree)
        _, start = run_timed(START, [str(modules)], tree)
        figures = {"seconds": seconds, "cpu": cpu, "start": start, "modules": len(modules.read_text().split())}
        print(f"{'before' if tree else 'now'}: {self}, {preset}: {json.dumps(figures)}", file=sys.stderr, flush=True)
        return figures

    def measure(self, folder: Path, tree: Path | None = None, **task: object) -> Figures:
        """Restore the clip in a process of its own."""
        return child(CHILD, {"frames": str(self.write(folder)), "count": self.count, **task}, tree)


def run_timed(code: str, words: list[str], tree: Path | None = None) -> tuple[float, float]:
    """Run Python code in a process: seconds of the clock and of the processor."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-c", code, *words]
    # Packages of the working folder would come first.
    folder = tempfile.gettempdir()
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True, cwd=folder, env=environment(tree))
    seconds, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


# Run first, so that all that is compiled once has been.
WARM = Clip(24, 64, 64)
ROWS = (Clip(50, 128, 128), Clip(120, 256, 256, runs=3))
FULL_ROWS = (
    Clip(50, 128, 128),
    Clip(120, 256, 256, runs=5),
    Clip(120, 256, 256, "camera"),
    Clip(1000, 256, 256),
    Clip(25, 1080, 1920, runs=5),
    Clip(25, 1080, 1920, "camera"),
)


def main() -> int:
    """Print the document; 1 when a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="larger clips, and more runs")
    parser.add_argument("--before", metavar="REVISION", help="measure this revision beside the present tree")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    parser.add_argument("--stages", action="store_true", help="print what every stage takes, and nothing else")
    options = parser.parse_args()
    take_two_cores()
    if options.stages:
        with tempfile.TemporaryDirectory() as folder:
            print(stage_costs(Path(folder)))
        return 0
    try:
        with revision(options.before) as tree, tempfile.TemporaryDirectory() as folder:
            text, broken = document(options.full, options.before, tree, Path(folder))
    except TurbrestoreError as error:
        print(f"speed: {error}", file=sys.stderr)
        return error.exit_code
    publish(text, options.write)
    for line in broken:
        print(f"speed: {line}", file=sys.stderr)
    return int(bool(broken))


def document(full: bool, before: str | None, tree: Path | None, folder: Path) -> tuple[str, list[str]]:
    """Markdown of the tables, and the bounds that are broken."""
    broken: list[str] = []
    command = f"python benchmarks/speed.py{' --full' if full else ''}{f' --before {before}' if before else ''}"
    beside = f"  *Before* is the preset `standard` of revision {before}." if before else ""
    lines = [
        "# Speed\n",
        f"What `{command} --write benchmarks/results/speed.md` measures, on two cores, with clips under smooth random "
        "motion.  It ends with 1 where a bound is broken.\n",
        "## Commands\n",
        "`turbrestore restore CLIP IMAGE`, from its start to its end, medians of the runs: seconds of the clock and of "
        f"the processor.  *Start* is the processor time of loading all that it loads, and nothing else.{beside}\n",
        *_restorations(FULL_ROWS if full else ROWS, tree, folder, broken),
        "\n## Growth\n",
        f"Processor time of restorations in memory with two passes of the centroid and at most {TRAINED} frames to "
        "train.  Exponents leave out the smallest clips, where most of the time is what is done once.\n",
        *_growth(full, folder, broken),
        "\n## Cores, videos and batches\n",
        *_others(folder, broken),
        *_help_lines(broken),
    ]
    if broken:
        lines += ["\n## Broken bounds\n", *(f"- {line}" for line in broken)]
    return "\n".join(lines) + "\n", broken


def _restorations(rows: tuple[Clip, ...], tree: Path | None, folder: Path, broken: list[str]) -> list[str]:
    names = ["clip", "scene", "preset", "runs"]
    names += ["clock before, s", "now / before", "CPU before, s", "now / before"] if tree else []
    names += ["clock, s", "CPU, s", "start, s", "start, % of CPU", "modules"]
    lines = [f"| {' | '.join(names)} |", f"|---|---|---|{'---:|' * (len(names) - 3)}"]
    for warmed in {None, tree}:
        WARM.command(folder, tree=warmed)
    numpy = _median([{"cpu": run_timed("import numpy", [])[1]} for _ in range(3)], "cpu")
    for clip in rows:
        runs: dict[str, list[Figures]] = {"before": [], "standard": [], "fast": []}
        for _ in range(clip.runs):
            if tree:
                runs["before"].append(clip.command(folder, tree=tree))
            for preset in ("standard", "fast"):
                runs[preset].append(clip.command(folder, preset))
        for preset in ("standard", "fast"):
            lines.append(_restoration(clip, preset, runs["before"], runs[preset], broken))
    start = _median(runs["standard"], "start") / numpy
    if start > START_BOUND:
        broken.append(f"the start of a restoration takes {start:.1f} times as long as NumPy's, bound {START_BOUND}")
    return [*lines, "", f"The start takes {start:.1f} times as long as an import of NumPy, bound {START_BOUND:.0f}."]


def _restoration(clip: Clip, preset: str, old: list[Figures], new: list[Figures], broken: list[str]) -> str:
    cells = [str(clip), clip.scene, preset, str(clip.runs)]
    for name in ("seconds", "cpu") if old else ():
        ratio = float(np.median([now[name] / was[name] for was, now in zip(old, new, strict=True)]))
        cells += [f"{_median(old, name):.2f}", f"{ratio:.2f}"]
        if name == "cpu" and clip.runs > 1 and ratio > WHOLE_BOUND:
            broken.append(f"{clip}, {clip.scene}, {preset}: {ratio:.2f} times the time before, bound {WHOLE_BOUND}")
    cpu, start = _median(new, "cpu"), _median(new, "start")
    cells += [f"{_median(new, 'seconds'):.2f}", f"{cpu:.2f}", f"{start:.2f}", f"{100 * start / cpu:.0f}"]
    return f"| {' | '.join([*cells, str(new[-1]['modules'])])} |"


def stage_costs(folder: Path) -> str:
    """Seconds of every stage by preset, a megapixel: for each frame, each training frame, or once."""
    clip = Clip(*STAGES_CLIP)
    lines = []
    for preset in STAGES_PRESETS:
        found = clip.measure(folder, preset=preset)
        seconds, pixels = found["stages"], clip.height * clip.width / 1e6
        frames, train = clip.count * pixels, found["train"] * pixels
        costs = {
            "read": seconds["read"] / frames,
            "centroid": seconds["centroid"] / train,
            "filter": sum(seconds.get(stage, 0) for stage in ("seeing", "identify", "filter")) / frames,
            "witnesses": seconds["witnesses"] / train,
            "width": seconds["width"] / pixels,
            "deconvolve": (seconds["deconvolve"] + seconds["uncertainty"]) / pixels,
        }
        lines.append(f"{preset}: {', '.join(f'{stage} {cost:.2f}' for stage, cost in costs.items())}")
    return "\n".join(lines)


def _median(runs: list[Figures], name: str) -> float:
    return float(np.median([run[name] for run in runs]))


def _growth(full: bool, folder: Path, broken: list[str]) -> list[str]:
    by_frames = [Clip(count, COUNTS_SIDE, COUNTS_SIDE) for count in COUNTS]
    by_pixels = [Clip(SIZES_COUNT, *size) for size in (*SIZES, *(FULL_SIZES if full else ()))]
    lines = ["| clip | CPU, s | µs a pixel of a frame |", "|---|---:|---:|"]
    measured: dict[Clip, float] = {}
    for clip in dict.fromkeys((*by_frames, *by_pixels)):
        found = clip.measure(folder, train=min(TRAINED, clip.count), passes=2)
        measured[clip] = found["cpu"]
        a_pixel = 1e6 * found["cpu"] / (clip.count * clip.height * clip.width)
        lines.append(f"| {clip} | {found['cpu']:.2f} | {a_pixel:.2f} |")
    fitted = [clip for clip in by_frames if clip.count >= FEWEST_FITTED]
    exponents = []
    large = [clip for clip in by_pixels if clip.height * clip.width >= LEAST_PIXELS]
    for name, clips, bound in (("frames", fitted, FRAMES_BOUND), ("pixels", large, PIXELS_BOUND)):
        sizes = [clip.count * clip.height * clip.width for clip in clips]
        exponent = float(np.polyfit(np.log(sizes), np.log([measured[clip] for clip in clips]), 1)[0])
        if exponent > bound:
            broken.append(f"exponent of the time against {name}: {exponent:.2f}, bound {bound}")
        exponents.append(f"Exponent of the time against {name}: {exponent:.2f}, bound {bound}.")
    return [*lines, "", *exponents]


def _others(folder: Path, broken: list[str]) -> list[str]:
    """One thread and two, a steadied video, and a batch."""
    clip = Clip(120, 256, 256)
    one, two = (clip.measure(folder, threads=threads) for threads in (1, 2))
    steady = Clip(DISTINCT, 256, 256)
    video = steady.measure(folder, steady=True)
    clips, frames, side = BATCH
    taken = batch.measure(*BATCH)
    if not taken.same:
        broken.append("a batch gives other images than single runs")
    return [
        f"- {clip} takes {one['cpu']:.2f} s of processor time on one thread and {two['cpu']:.2f} s on two, "
        f"{two['cpu'] / one['cpu']:.2f} times as much; by the clock {two['seconds'] / one['seconds']:.2f} times, which "
        "is 0.5 at best, and more where other programs run.",
        f"- A steadied video of {steady} takes {1000 * video['cpu'] / steady.count:.0f} ms a frame.",
        f"- {clips} clips of {frames} × {side}×{side} take {taken.batch_cpu:.1f} s as a batch, the start of its "
        f"processes included, and {taken.single_cpu:.1f} s one after the other in one process; the images are "
        f"{'the same' if taken.same else 'NOT the same'}.",
    ]


def _help_lines(broken: list[str]) -> list[str]:
    """Compare ``turbrestore --help`` with starting Python and importing NumPy, by the median of five pairs."""
    calls = {name: f"from turbrestore_cli.__main__ import main; main({name.split()!r})" for name in HELP}
    runs = [[run_timed(code, [])[1] for code in ("import numpy", *calls.values())] for _ in range(5)]
    lines = []
    for number, name in enumerate(calls, 1):
        taken, ratio = np.median([(run[number], run[number] / run[0]) for run in runs], axis=0)
        lines.append(f"- `turbrestore {name}` takes {taken:.2f} s, {ratio:.1f} times as long as an import of NumPy.")
        if name == HELP[0] and ratio > HELP_BOUND:
            broken.append(f"{name} takes {ratio:.1f} times as long as importing NumPy, bound {HELP_BOUND}")
    return lines


if __name__ == "__main__":
    sys.exit(main())
