"""What flow calls are worth: PSNR of the fused and the restored image against passes of the centroid and of the filter.

    TURBRESTORE_DATA=DIR python benchmarks/flow_calls.py --write benchmarks/results/flow_calls.md

prints a Markdown document and writes it, with a picture of the curves beside it.  Clips are those of
``benchmarks/quality.py`` that have a truth, cut to their first frames and their middle; ``--clips`` takes names or
patterns.  Time is the number of flow calls times what one takes, measured on each clip, so that a busy machine changes
the scale of the curves and not their shape.  It ends with 1 where the default is not at the knee.

    TURBRESTORE_DATA=DIR python benchmarks/flow_calls.py --presets --write benchmarks/results/presets.md

instead restores the whole clips by the presets and by what lies around them, and shows PSNR against processor time.  It
ends with 1 where ``fast`` is less than 1.5 times as fast as ``standard``, or loses more than 0.3 dB on average.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from clips import find_clips
from provenance import publish

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import TurbrestoreError
from turbrestore.filtering.alternating import FilterParams
from turbrestore.metrics import compare
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.registration.flow import FlowParams, iterate_flows
from turbrestore.registration.flow_methods.opencv_flow import DisParams
from turbrestore.runtime.runtime import Runtime
from turbrestore.settings import preset

CLIPS = ("quick_*", "ao_*", "purdue1_*")
FRAMES, SIDE, THREADS = 48, 160, 2
CENTROID, INNER = range(1, 7), range(1, 4)
DEFAULT, RUNTIME = RestoreParams(), Runtime(threads=THREADS)
# Quality that a default must not cost on any clip, dB.
TOLERATED = 0.05
ONE_PASS = FilterParams(inner_iterations=1)
PRESETS = {
    "**fast**": preset("fast"),
    "8 pixels, 2 refinements": RestoreParams(
        flow=FlowParams(dis=DisParams(patch_stride=8, refinements=2)), filter=ONE_PASS
    ),
    "6 pixels, 4 refinements": RestoreParams(
        flow=FlowParams(dis=DisParams(patch_stride=6, refinements=4)), filter=ONE_PASS
    ),
    "**standard**": preset("standard"),
}
# Least factor of ``fast`` in speed, and the most that it may lose, dB.
FASTER, LOST = 1.5, 0.3


@dataclass(frozen=True)
class Point:
    """One setting on one clip: PSNR, dB, of the fused and of the restored image, flow calls, and their seconds."""

    fused: float
    restored: float
    calls: int
    seconds: float


@dataclass(frozen=True)
class Cost:
    """One preset on one clip: PSNR of the restored image, dB, and the processor time of its restoration, seconds."""

    psnr: float
    seconds: float


# Of one clip: the default, then each setting.
Curves = dict[str, Point]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", nargs="+", default=CLIPS, metavar="NAME", help="names or patterns")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document and a picture")
    parser.add_argument("--presets", action="store_true", help="restore by the presets, and measure processor time")
    options = parser.parse_args()
    measured: dict[str, Curves] = {}
    try:
        if options.presets:
            return compare_presets(options.clips, options.write)
        for name, load in find_clips(options.clips).items():
            clip = load()
            if clip.truth is not None:
                measured[name] = measure(_middle(clip.frames[:FRAMES]), _middle(clip.truth[None])[0])
                print(f"{name}: {measured[name]}", file=sys.stderr, flush=True)
    except TurbrestoreError as error:
        print(f"flow_calls: {error}", file=sys.stderr)
        return error.exit_code
    text, at_knee = document(measured)
    publish(text, options.write)
    if options.write is not None:
        draw(measured, options.write.with_suffix(".png"))
    return int(not at_knee)


def compare_presets(patterns: Sequence[str], write: Path | None) -> int:
    """Restore the clips by every preset and its neighbours; 1 if ``fast`` is too slow, or too bad."""
    measured: dict[str, dict[str, Cost]] = {}
    for name, load in find_clips(patterns).items():
        clip = load()
        if clip.truth is None:
            continue
        if not measured:
            # What is loaded and compiled once.
            restore(_middle(clip.frames[:FRAMES]), DEFAULT, RUNTIME)
        measured[name] = {}
        for setting, params in PRESETS.items():
            begun = time.process_time()
            image = restore(clip.frames, params, RUNTIME).image
            measured[name][setting] = Cost(compare(image, clip.truth).psnr, time.process_time() - begun)
        print(f"{name}: {measured[name]}", file=sys.stderr, flush=True)
    text, held = presets_document(measured)
    publish(text, write)
    if write is not None:
        draw_presets(measured, write.with_suffix(".png"))
    return int(not held)


def presets_document(measured: dict[str, dict[str, Cost]]) -> tuple[str, bool]:
    """Markdown of the curve, and whether ``fast`` keeps its bounds."""
    lines = [
        "# Presets: quality against time\n",
        "What `TURBRESTORE_DATA=DIR python benchmarks/flow_calls.py --presets --write benchmarks/results/presets.md` "
        f"measures on {len(measured)} simulated clips, whole: PSNR of the restored image against the truth, and the "
        "processor time of the restoration. All but `standard` have one inner pass of the filter; the search for flow "
        "ends at a quarter of the resolution with `fast`, and at half of it with the others. "
        "*Pixels* are the distance between patches.\n",
        "![PSNR against processor time](presets.png)\n",
        f"| setting | CPU, s | times as fast as standard | PSNR, dB | {' | '.join(measured)} |",
        f"|---|---:|---:|---:|{'---:|' * len(measured)}",
    ]
    means = mean_costs(measured)
    standard = means["**standard**"]
    for setting, cost in means.items():
        changes = [f"{costs[setting].psnr - costs['**standard**'].psnr:+.2f}" for costs in measured.values()]
        factor = standard.seconds / cost.seconds
        row = f"| {setting} | {cost.seconds:.1f} | {factor:.2f} | {cost.psnr:.2f} | {' | '.join(changes)} |"
        lines.append(row)
    fast = means["**fast**"]
    factor, lost = standard.seconds / fast.seconds, standard.psnr - fast.psnr
    lines.append(
        f"\nColumns of clips: change against `standard`, dB. `fast` is {factor:.2f} times as fast as `standard` (bound "
        f"{FASTER}) and loses {lost:.2f} dB (bound {LOST})."
    )
    return "\n".join(lines) + "\n", factor >= FASTER and lost <= LOST


def mean_costs(measured: dict[str, dict[str, Cost]]) -> dict[str, Cost]:
    """Mean over the clips."""
    return {
        setting: Cost(*np.mean([(costs[setting].psnr, costs[setting].seconds) for costs in measured.values()], axis=0))
        for setting in PRESETS
    }


def draw_presets(measured: dict[str, dict[str, Cost]], path: Path) -> None:
    """Draw the means over the clips."""
    figure, axis = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    for setting, cost in mean_costs(measured).items():
        named = setting.startswith("*")
        axis.plot(cost.seconds, cost.psnr, "o", color="C1" if named else "C0")
        axis.annotate(setting.strip("*"), (cost.seconds, cost.psnr), (5, 4), textcoords="offset points", fontsize=8)
    axis.set(xlabel="processor time of a restoration, s", ylabel="PSNR, dB")
    axis.margins(x=0.25, y=0.15)
    axis.set_xlim(left=0)
    figure.savefig(path, dpi=110)


def settings() -> dict[str, RestoreParams]:
    """Name the default, and what is changed of it."""
    centroid = {
        f"centroid {count}": replace(DEFAULT, centroid=CentroidParams(iterations=count, tolerance=0.0))
        for count in CENTROID
    }
    inner = {f"inner {count}": replace(DEFAULT, filter=FilterParams(inner_iterations=count)) for count in INNER}
    return {"default": DEFAULT, **centroid, **inner}


def measure(frames: FloatArray, truth: FloatArray) -> Curves:
    """Restore with every setting."""
    begun = time.process_time()
    for _ in iterate_flows(frames.mean(axis=0), frames, DEFAULT.flow, RUNTIME):
        pass
    a_call = (time.process_time() - begun) / len(frames)
    curves = {}
    for name, params in settings().items():
        restoration = restore(frames, params, RUNTIME)
        if restoration.filtered is None:
            raise RuntimeError("the whole chain did not run")
        passes = restoration.centroid.mean_flow_sizes.size
        # The last pass of the centroid serves the first of the filter.
        calls = (passes - 1) * restoration.train + params.filter.inner_iterations * len(frames)
        fused, restored = (compare(image, truth).psnr for image in (restoration.filtered.image, restoration.image))
        curves[name] = Point(fused, restored, calls, calls * a_call)
    return curves


def document(measured: dict[str, Curves]) -> tuple[str, bool]:
    """Markdown of the tables, and whether the default is at the knee."""
    lines = [
        "# What flow calls are worth\n",
        "Optical flow takes most of the time of a restoration. This page shows the value of its repetitions, as "
        "`TURBRESTORE_DATA=DIR python benchmarks/flow_calls.py --write benchmarks/results/flow_calls.md` measures it "
        f"on {len(measured)} simulated clips: the first {FRAMES} frames, the middle {SIDE}×{SIDE} pixels, two "
        "threads.\n",
        "![PSNR against seconds of flow calls](flow_calls.png)\n",
        "## Mean over the clips\n",
        "PSNR, dB, of the fused image (after the filter) and of the restored one; seconds of the flow calls, each "
        "timed by itself and without a start (most repetitions start from an earlier flow and take two thirds of "
        "that, so they gain more for each second); and the gain of one more repetition. The number of passes of the "
        "centroid is the largest allowed, without tolerance: it stops where its mean flow no longer shrinks. The "
        "default stops as soon as the mean flow is below the tolerance, after two passes at least. A centroid that "
        "has not converged recentres its flows once more at the end, so two passes without tolerance are not the "
        "two of the default.\n",
        "| setting | calls | seconds | fused | restored | gain of one more: fused | restored | dB a second, restored |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    mean = {name: _mean([curves[name] for curves in measured.values()]) for name in settings()}
    for group, counts in (("centroid", CENTROID), ("inner", INNER)):
        before = None
        for count in counts:
            point = mean[f"{group} {count}"]
            lines.append(_row(f"{group}, {count}", point, before))
            before = point
    lines.append(_row("**default**", mean["default"], None))
    lines += [
        "\n## Every clip\n",
        "PSNR, dB, of the restored image: the default, and the change by another setting.\n",
        f"| clip | default | {' | '.join(list(settings())[1:])} |",
        f"|---|---:|{'---:|' * (len(settings()) - 1)}",
    ]
    for name, curves in measured.items():
        base = curves["default"].restored
        changes = [f"{curves[other].restored - base:+.2f}" for other in list(settings())[1:]]
        lines.append(f"| {name} | {base:.2f} | {' | '.join(changes)} |")
    verdict, at_knee = _verdict(measured, mean)
    return "\n".join([*lines, *verdict]) + "\n", at_knee


def draw(measured: dict[str, Curves], path: Path) -> None:
    """Curves of the mean over the clips."""
    default = _mean([curves["default"] for curves in measured.values()])
    figure, axes = plt.subplots(1, 2, figsize=(8, 3.2), sharey=True, layout="constrained")
    for axis, (group, counts) in zip(axes, (("centroid", CENTROID), ("inner", INNER)), strict=True):
        for kind in ("fused", "restored"):
            points = {n: _mean([curves[f"{group} {n}"] for curves in measured.values()]) for n in counts}
            # Passes that are never made are no points.
            made = [n for n in counts if n == counts[0] or points[n].calls > points[n - 1].calls]
            changes = [getattr(points[n], kind) - getattr(default, kind) for n in made]
            axis.plot([points[n].seconds for n in made], changes, "o-", label=kind)
            for number, change in zip(made, changes, strict=True):
                axis.annotate(str(number), (points[number].seconds, change), (0, 6), textcoords="offset points")
        axis.set(
            xlabel="seconds of flow calls", title={"centroid": "passes of the centroid"}.get(group, "inner passes")
        )
        axis.margins(y=0.15)
    axes[0].set_ylabel("PSNR beside the default, dB")
    axes[1].legend()
    figure.savefig(path, dpi=110)


def _verdict(measured: dict[str, Curves], mean: Curves) -> tuple[list[str], bool]:
    """Say what a second buys on either side of the default, and which settings cost no clip more than is tolerated.

    The default is at the knee where a second buys more up to it than beyond it, and cheaper settings cost too much.
    The fused image is judged: small changes of it may change the width of the blur that is removed from it.
    """
    lines = [
        "\n## The knee\n",
        "Change of the fused image in dB for each second of flow calls, from a cheaper setting to the default and "
        "from the default to a more expensive one. The restored image is not judged: small changes may change the "
        f"width of the blur that is removed. A default may change only where no clip loses more than {TOLERATED} dB.\n",
        "| setting | largest loss on a clip, dB | mean change, dB | flow calls | dB a second |",
        "|---|---:|---:|---:|---:|",
    ]
    default, rates, harmless = mean["default"], dict[str, float](), list[str]()
    for name, point in mean.items():
        loss = max(curves["default"].fused - curves[name].fused for curves in measured.values())
        change, calls = point.fused - default.fused, point.calls / default.calls - 1
        if calls:
            rates[name] = change / (point.seconds - default.seconds)
        rate = f"{rates[name]:+.2f}" if name in rates else ""
        lines.append(f"| {name} | {max(loss, 0.0):.2f} | {change:+.2f} | {100 * calls:+.0f} % | {rate} |")
        if calls < 0 and loss <= TOLERATED:
            harmless.append(name)
    cheaper = min(rate for name, rate in rates.items() if mean[name].calls < default.calls)
    dearer = max(rate for name, rate in rates.items() if mean[name].calls > default.calls)
    text = f"One more second gains {cheaper:+.2f} dB or more up to the default, and {dearer:+.2f} or less beyond it"
    at_knee = cheaper > max(dearer, 0) and not harmless
    text += f": the default is {'' if at_knee else 'not '}at the knee."
    few = f"With fewer flow calls, no clip loses more than {TOLERATED} dB by {', '.join(harmless)}."
    none = f"Every setting with fewer flow calls costs some clip more than {TOLERATED} dB."
    return [*lines, f"\n{text} {few if harmless else none}"], at_knee


def _row(name: str, point: Point, before: Point | None) -> str:
    cells = [name, f"{point.calls}", f"{point.seconds:.2f}", f"{point.fused:.2f}", f"{point.restored:.2f}"]
    if before is None:
        return f"| {' | '.join(cells)} | | | |"
    spent, gained = point.seconds - before.seconds, point.restored - before.restored
    rate = f"{gained / spent:+.2f}" if spent > 0 else ""
    return f"| {' | '.join(cells)} | {point.fused - before.fused:+.2f} | {gained:+.2f} | {rate} |"


def _mean(points: list[Point]) -> Point:
    return Point(
        float(np.mean([point.fused for point in points])),
        float(np.mean([point.restored for point in points])),
        round(float(np.mean([point.calls for point in points]))),
        float(np.mean([point.seconds for point in points])),
    )


def _middle(frames: FloatArray) -> FloatArray:
    height, width = frames.shape[1:3]
    y, x = max(height - SIDE, 0) // 2, max(width - SIDE, 0) // 2
    return frames[:, y : y + SIDE, x : x + SIDE]


if __name__ == "__main__":
    sys.exit(main())
