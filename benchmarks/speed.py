"""Time of whole restorations against the bare flow calls they make, how it grows, memory against frames, and the help.

    python benchmarks/speed.py --write benchmarks/results/speed.md
    python benchmarks/speed.py --full --before 890600a --write benchmarks/results/speed.md

prints a Markdown document, writes it, and exits with 1 when a bound is broken.  Times of a row are taken in one child
process, flow calls before and after the restoration, because machines differ and drift; of the shorter clips five
times, and the run whose ratio is in the middle counts.  Peak memory is that of a child process.  ``--before`` names a
revision of this repository that is measured beside the present tree, row by row; ``--full`` adds 1,000 frames,
1920×1080, and what ``benchmarks/tvl1.py`` and ``benchmarks/deconvolution.py`` print.  Where Numba is installed, some
figures are taken without it too.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import TypeVar

import deconvolution
import numpy as np
import tvl1
from revisions import Figures, child, revision, take_two_cores

from turbrestore.core.errors import TurbrestoreError
from turbrestore.deconvolution.nonlocal_weights import nonlocal_weights
from turbrestore.io.output import atomic_write
from turbrestore.io.source import FrameSource
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.registration.flow import FlowParams, iterate_flows
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

TIME_BOUND, MEMORY_BOUND_MB, HELP_BOUND = 1.25, 20.0, 6.0
FRAMES_BOUND, PIXELS_BOUND = 1.05, 1.1
THREADS = 2
# Frames, height, width, and scene: what is done once takes longer for a photograph than for a chart.
Row = tuple[int, int, int, str]
ROWS: tuple[Row, ...] = (
    (50, 128, 128, "chart"),
    (120, 256, 256, "chart"),
    (300, 256, 256, "chart"),
    (200, 512, 512, "chart"),
)
FULL_ROWS: tuple[Row, ...] = ((1000, 256, 256, "chart"), (25, 1080, 1920, "chart"), (25, 1080, 1920, "camera"))
# Restored without Numba too.
PLAIN_ROW = (120, 256, 256)
# Clips of so many pixels in all are restored five times.
REPEATED, RUNS = 25_000_000, 5
# What the exponents are fitted to: two passes of the centroid, and so many frames to train, whatever the clip.
COUNTS, COUNTS_SIDE = (500, 1000, 1500, 2000), 128
SIDES, SIDES_COUNT = (128, 192, 256, 384, 768), 60
FEW, MANY, TRAINED = 260, 2060, 60
# Distinct frames of a clip; longer ones repeat them.
DISTINCT = 60
# One in so many frames is taken to measure flow alone before, and again after; at least and at most so many.  Of the
# shorter clips all are: a tenth of a second of flow says little.
SAMPLE, LEAST_SAMPLE, LARGEST_SAMPLE = 2, 8, 200
# Benchmarks of parts whose tables are part of the document.
PARTS = ("tvl1", "deconvolution")

Result = TypeVar("Result")


def main() -> int:
    """Print the document; 1 when a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="1,000 frames and 1920×1080 as well")
    parser.add_argument("--before", metavar="REVISION", help="measure this revision beside the present tree")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    parser.add_argument("--child", metavar="JSON", help=argparse.SUPPRESS)
    options = parser.parse_args()
    take_two_cores()
    if options.child is not None:
        print(json.dumps(run_child(json.loads(options.child))))
        return 0
    try:
        with revision(options.before) as tree:
            text, broken = document(options.full, options.before, tree)
    except TurbrestoreError as error:
        print(f"speed: {error}", file=sys.stderr)
        return error.exit_code
    print(text, end="")
    if options.write is not None:
        atomic_write(options.write, text.encode(), overwrite=True)
    for line in broken:
        print(f"speed: {line}", file=sys.stderr)
    return int(bool(broken))


def document(full: bool, before: str | None, tree: Path | None) -> tuple[str, list[str]]:
    """Markdown of the tables, and the bounds that are broken."""
    broken: list[str] = []
    command = f"python benchmarks/speed.py{' --full' if full else ''}{f' --before {before}' if before else ''}"
    lines = [
        "# Speed\n",
        f"What `{command} --write benchmarks/results/speed.md` measures: scenes under smooth random flow, {THREADS} "
        f"threads on two cores, {_machine()}, {_compiled()}.  It ends with 1 where a bound is broken.\n",
        "## Against the flow calls\n",
        "Seconds of a whole restoration with the default settings, and of its optical flow alone, each call timed "
        f"by itself and without a start. The bound of both ratios is {TIME_BOUND}. It is exceeded where work that is "
        "done once, above all the deconvolution, takes long compared with the flow: by clips of less than a second. "
        "As made, most calls start from an earlier flow of the frame and use what has been prepared, so they are "
        "cheaper: no bound holds for the ratio to these. Frames are in memory, so nothing is decoded.\n",
        *_time_table((*ROWS, *FULL_ROWS) if full else ROWS, tree, broken),
        *_plain_lines(),
        "\n## Growth\n",
        "Exponent of the time of a restoration, fitted to some clips each, with two passes of the centroid and "
        f"{TRAINED} frames to train.\n",
        *_growth_table(tree, broken),
        "\n## Parts\n",
        f"TV-L1: CPU time for a frame of {tvl1.SIDE}×{tvl1.SIDE}, {tvl1.THREADS} threads, on the sets of "
        "`benchmarks/tvl1.py`; the rest: clock, on the image of `benchmarks/deconvolution.py`. These two hold the "
        "bounds. Smallest of a few runs, of iterations the median.\n",
        *_parts_table(tree),
        "\n## Memory\n",
        f"Peak resident memory of a process that restores frames of 128×128, {TRAINED} of them to train.\n",
        *_memory_table(tree, broken),
    ]
    seconds, cost = help_ratio(9)
    if cost > HELP_BOUND:
        broken.append(f"--help takes {cost:.1f} times as long as importing NumPy, bound {HELP_BOUND}")
    lines.append(
        f"\n`turbrestore --help` takes {seconds:.2f} s, {cost:.1f} times as long as Python with NumPy takes to start; "
        f"bound {HELP_BOUND:.0f}."
    )
    for part in PARTS if full else ():
        text, kept = part_tables(part)
        lines.append(f"\n## {part}\n\n`python benchmarks/{part}.py`\n\n{text}")
        if not kept:
            broken.append(f"benchmarks/{part}.py: a bound is broken, see its tables")
    if broken:
        lines += ["\n## Broken bounds\n", *(f"- {line}" for line in broken)]
    return "\n".join(lines) + "\n", broken


def _time_table(rows: tuple[Row, ...], tree: Path | None, broken: list[str]) -> list[str]:
    stages = ("centroid", "identify", "filter", "deconvolve")
    earlier = ["before: whole, s", "flow calls", "ratio"] if tree else []
    names = ["whole, s", "flow calls", "alone, s", "ratio", "of CPU time", "as made, s", "ratio"]
    names += [*(f"{stage}, s" for stage in stages), "peak, MB"]
    names = ["frames", "size", "scene", *earlier, *names]
    lines = [f"| {' | '.join(names)} |", f"|{'---:|' * len(names)}"]
    for count, height, width, scene in rows:
        task = {"kind": "time", "frames": count, "height": height, "width": width, "scene": scene}
        runs = RUNS if count * height * width <= REPEATED else 1
        old = child(__file__, task, tree) if tree else None
        new = sorted((child(__file__, task | {"made": True}) for _ in range(runs)), key=_ratio)[runs // 2]
        ratio, work = _ratio(new), new["whole_work"] / new["bare_work"]
        if max(ratio, work) > TIME_BOUND:
            found = f"ratio {max(ratio, work):.3f}, bound {TIME_BOUND}"
            broken.append(f"{count} frames of {width}×{height}, {scene}: {found}")
        cells = [f"{count:,}", f"{width}×{height}", scene]
        if old is not None:
            cells += [f"{old['whole']:.1f}", f"{old['calls']}", f"{old['whole'] / old['bare']:.2f}"]
        cells += [f"{new['whole']:.1f}", f"{new['calls']}", f"{new['bare']:.1f}", f"{ratio:.2f}"]
        cells += [f"{work:.2f}", f"{new['made']:.1f}", f"{new['whole'] / new['made']:.2f}"]
        cells += [*(f"{new['stages'].get(stage, 0.0):.1f}" for stage in stages), f"{new['peak']:,.0f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _ratio(figures: Figures) -> float:
    return float(figures["whole"] / figures["bare"])


def _plain_lines() -> list[str]:
    """Sentence on the ratio without a compiler, which no bound holds for."""
    if find_spec("numba") is None:
        return []
    count, height, width = PLAIN_ROW
    task = {"kind": "time", "frames": count, "height": height, "width": width, "plain": True}
    found = sorted((child(__file__, task) for _ in range(RUNS)), key=_ratio)[RUNS // 2]
    ratio, work = _ratio(found), found["whole_work"] / found["bare_work"]
    return [
        f"\nBounds are those with Numba. Without it {count} frames of {width}×{height} take "
        f"{found['whole']:.1f} s, {ratio:.2f} times their flow calls, and {work:.2f} times their CPU time."
    ]


def _parts_table(tree: Path | None) -> list[str]:
    task = {"kind": "parts"}
    columns = {"before": child(__file__, task, tree)} if tree else {}
    columns |= {"now": child(__file__, task)}
    if find_spec("numba"):
        columns |= {"now, without Numba": child(__file__, task | {"plain": True})}
    lines = [f"| | {' | '.join(columns)} |", f"|---|{'---:|' * len(columns)}"]
    for name in columns["now"]:
        lines.append(f"| {name} | {' | '.join(f'{column[name]:.3g}' for column in columns.values())} |")
    return lines


def measure_parts() -> Figures:
    """Return times of what a restoration is made of, by name."""
    figures: Figures = {}
    solve = tvl1.methods()[tvl1.OURS]
    for name, make in tvl1.SETS.items():
        motion = make(8)
        seconds = min(clocked(lambda motion=motion: solve(motion))[0][1] for _ in range(3))
        figures[f"TV-L1, {name.lower()}, ms a frame"] = 1e3 * seconds / len(motion.frames)
    image = deconvolution.make_image(deconvolution.STATED, deconvolution.STATED)
    figures[f"nonlocal weights of {deconvolution.STATED}², s"] = deconvolution.fastest(
        lambda: nonlocal_weights(image), 3
    )
    figures[f"an iteration at {deconvolution.STATED}², ms"] = 1e3 * deconvolution.iterate(image)[0]
    for size in deconvolution.STAGE_BOUNDS_S:
        figures[f"deblurring of {size}², s"] = deconvolution.whole_stage(size, size)
    return figures


def part_tables(name: str) -> tuple[str, bool]:
    """Return what the benchmark of a part prints, its headings one level lower, and whether its bounds hold."""
    command = [sys.executable, str(Path(__file__).with_name(f"{name}.py"))]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    return done.stdout.replace("\n## ", "\n### ").removeprefix("## ").strip(), done.returncode == 0


def _growth_table(tree: Path | None, broken: list[str]) -> list[str]:
    lines = [f"| against |{' before |' if tree else ''} exponent | bound |", f"|---|{'---:|' * (2 + bool(tree))}"]
    frames = [(count, COUNTS_SIDE) for count in COUNTS]
    pixels = [(SIDES_COUNT, side) for side in SIDES]
    for name, clips, bound in (
        (f"frames: {', '.join(map(str, COUNTS))} of {COUNTS_SIDE}×{COUNTS_SIDE}", frames, FRAMES_BOUND),
        (f"pixels: {SIDES_COUNT} frames of side {', '.join(map(str, SIDES))}", pixels, PIXELS_BOUND),
    ):
        found = exponent(clips)
        if found > bound:
            broken.append(f"exponent against {name}: {found:.2f}, bound {bound}")
        earlier = f" {exponent(clips, tree):.2f} |" if tree else ""
        lines.append(f"| {name} |{earlier} {found:.2f} | {bound} |")
    return lines


def _memory_table(tree: Path | None, broken: list[str]) -> list[str]:
    lines = [
        f"| | filtered: {FEW - TRAINED} | {MANY - TRAINED:,} | growth, MB | bound |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, where in ((("before", tree),) if tree else ()) + (("now", None),):
        few, many = (
            child(__file__, {"kind": "memory", "frames": count, "height": 128, "width": 128}, where)["peak"]
            for count in (FEW, MANY)
        )
        lines.append(f"| {name} | {few:.0f} MB | {many:.0f} MB | {many - few:.1f} | {MEMORY_BOUND_MB:.0f} |")
        if where is None and many - few > MEMORY_BOUND_MB:
            broken.append(f"memory grows by {many - few:.1f} MB, bound {MEMORY_BOUND_MB}")
    return lines


def exponent(clips: list[tuple[int, int]], tree: Path | None = None) -> float:
    """Slope of log time over log size of clips, given as frames and side, that differ in one of them."""
    tasks = [{"kind": "growth", "frames": count, "height": side, "width": side} for count, side in clips]
    seconds = [child(__file__, task, tree)["whole"] for task in tasks]
    sizes = [count * side * side for count, side in clips]
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def run_child(task: Figures) -> Figures:
    """Restore a clip and say how long it took, how long its flow calls take alone, and the peak memory, MB.

    A task of the kind ``parts`` restores nothing.  One that is ``plain`` does without Numba.
    """
    if task.get("plain"):
        # What is None here cannot be found, nor imported.
        sys.modules["numba"] = None
    if task["kind"] == "parts":
        return measure_parts()
    source, sample = repeated(task["frames"], task["height"], task["width"], task.get("scene", "chart"))
    train = None if task["kind"] == "time" else TRAINED
    centroid = CentroidParams() if task["kind"] == "time" else CentroidParams(iterations=2)
    params = RestoreParams(train=train, flow=FlowParams(threads=THREADS), centroid=centroid)
    few = task["frames"] * task["height"] * task["width"] <= REPEATED
    part = task["frames"] if few else min(max(task["frames"] // SAMPLE, LEAST_SAMPLE), LARGEST_SAMPLE)

    def flows(count: int) -> None:
        frames = (sample[index % len(sample)] for index in range(count))
        for _ in iterate_flows(sample.mean(axis=0), frames, params.flow):
            pass

    def alone() -> np.ndarray:
        with as_restored():
            # Memory that is kept is taken before.
            flows(2 * THREADS)
            return np.array(clocked(lambda: flows(part))[0])

    # What is loaded and started once.
    restore(sample[:4, :32, :32])
    first = alone() if task["kind"] == "time" else 0
    whole, restoration = clocked(lambda: restore(source, params))
    # Linux counts kilobytes, macOS bytes.
    unit = 1024 if sys.platform != "darwin" else 1024 * 1024
    figures = {"whole": whole[0], "peak": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit}
    if task["kind"] != "time":
        return figures
    passes = len(restoration.centroid.mean_flow_sizes)
    # The last pass of the centroid serves the first of the filter.
    calls = (passes - 1) * restoration.train + params.filter.inner_iterations * task["frames"]
    bare = (first + alone()) / 2 * calls / part
    figures |= {"whole_work": whole[1], "bare": bare[0], "bare_work": bare[1], "calls": calls}
    figures |= {"stages": restoration.seconds}
    if not task.get("made"):
        return figures
    # New calls are those of the first pass of the centroid, and of the first of the filter for the other frames.
    cold = figures["bare"] / calls * task["frames"]
    stack = np.stack([sample[index % len(sample)] for index in range(part)])
    with as_restored():
        later = started(stack, params.flow, 1) * (passes - 1) * restoration.train
        again = started(stack, params.flow, 0) * (params.filter.inner_iterations - 1) * task["frames"]
    return figures | {"made": cold + later + again}


def as_restored() -> AbstractContextManager[None]:
    """Have freed memory kept, as a restoration has it; other trees, which are measured by this script too, do not."""
    try:
        from turbrestore.runtime.scratch import keeping_freed
    except ImportError:
        return nullcontext()
    return keeping_freed()


def started(stack: np.ndarray, params: FlowParams, start_level: int) -> float:
    """Seconds of a flow of a frame that has been prepared, from an earlier flow."""
    # Other trees, which are measured by this script too, have none of these.
    from turbrestore.registration.flow import measure_flows, prepare_reference

    reference = prepare_reference(stack.mean(axis=0), params, start_level=start_level)
    prepared, flows = zip(*measure_flows(reference, stack), strict=True)
    (seconds, _), _ = clocked(lambda: list(measure_flows(reference, prepared, flows)))
    return seconds / len(stack)


def clocked(call: Callable[[], Result]) -> tuple[tuple[float, float], Result]:
    """Seconds of wall and of CPU time that a call takes, and what it returns."""
    begun, worked = time.perf_counter(), time.process_time()
    result = call()
    return (time.perf_counter() - begun, time.process_time() - worked), result


def repeated(count: int, height: int, width: int, scene: str = "chart") -> tuple[FrameSource, np.ndarray]:
    """Clip that repeats a few 8-bit frames, and those frames as they are read."""
    distinct = min(count, DISTINCT, max(8, 2**24 // (height * width)))
    frames = np.rint(make_frames(distinct, height, width, scene) * 255)
    stored = frames.astype(np.uint8)

    def pixels(numbers: Sequence[int]) -> Iterator[np.ndarray]:
        for number in numbers:
            yield stored[number % len(stored)]

    source = FrameSource(
        name="repeated", format="array", file_shape=(count, height, width), full_scale=255, bit_depth=8, pixels=pixels
    )
    return source, (frames / 255).astype(np.float32)


def make_frames(count: int, height: int, width: int, scene: str) -> np.ndarray:
    """Frames of a scene under smooth random flow, blurred by 1 to 2 pixels."""
    rng, image = np.random.default_rng(0), SCENES[scene](height, width)
    flows = smooth_flows(count, height, width, rng, SmoothFlowParams(rms=1.5))
    return np.stack([distort(image, flow[None], rng, blur=1 + rng.random(), noise=0.01)[0] for flow in flows])


def help_ratio(runs: int) -> tuple[float, float]:
    """Median seconds of ``turbrestore --help``, and its ratio to starting Python and importing NumPy."""

    def seconds(code: str) -> float:
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=True)
        return time.perf_counter() - begun

    pairs = [
        (seconds("from turbrestore_cli.__main__ import main; main(['--help'])"), seconds("import numpy"))
        for _ in range(runs)
    ]
    return float(np.median([a for a, _ in pairs])), float(np.median([a / b for a, b in pairs]))


def _compiled() -> str:
    return "with Numba" if find_spec("numba") else "without Numba"


def _machine() -> str:
    models = Path("/proc/cpuinfo")
    text = models.read_text() if models.is_file() else ""
    names = [line.split(":")[1].strip() for line in text.splitlines() if line.startswith("model name")]
    return names[0] if names else sys.platform


if __name__ == "__main__":
    sys.exit(main())
