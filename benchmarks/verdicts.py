"""How often the verdict is right: checks on good results, and "looks right" on bad ones, as Markdown.

    python benchmarks/verdicts.py --write benchmarks/results/verdicts.md

restores drawn clips, recordings and clips that are made to go wrong, two at a time with one thread each.  A result is
bad where it is the mean of the frames or lies more than 0.2 dB below it, lies more than 3 dB below what the filtered
image gives when the best of some widths is removed from it by a Wiener filter, or is bent against the truth by more
than a pixel, root mean square about the shift of the whole.  All others are good.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from clips import drawn_clips
from methods.deblurring import deblurred, levels_of
from provenance import arguments, publish

import turbrestore
from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.core.gradient import sobel_gradient
from turbrestore.core.verdict import Verdict
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.io.source import FrameSource
from turbrestore.metrics import compare
from turbrestore.pipeline import restore
from turbrestore.registration.flow import estimate_flow
from turbrestore.runtime.runtime import Runtime
from turbrestore.settings import RestoreParams
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

COUNT, SIDE = 24, 112
WIDTHS = (0.5, 0.8, 1.1, 1.5, 2.0, 2.7, 3.5)
# Decibels below the mean, and below the right width, from which a result is bad.
SLACK, LOST = 0.2, 3.0
# Pixels by which a result may be bent.
BENT = 1.0
# Of the recordings, every so many.
EVERY = 3

Made = tuple[np.ndarray, FloatArray]


@dataclass(frozen=True)
class Row:
    """One restored clip."""

    group: str
    name: str
    result: float  # dB, as the two that follow
    mean: float
    best: float
    bent: float  # pixels
    is_mean: bool
    verdict: Verdict

    @property
    def is_bad(self) -> bool:
        """Whether a person should be warned."""
        return self.is_mean or self.bent > BENT or self.result < max(self.mean - SLACK, self.best - LOST)


def moved(
    scene: FloatArray, rng: np.random.Generator, count: int = COUNT, rms: float = 1.2, alike: float = 0.5
) -> FloatArray:
    """Frames of a scene that smooth flows bend, each ``alike`` the one before, blurred by a pixel."""
    flows = smooth_flows(count, *scene.shape, rng, SmoothFlowParams(rms, 12.0, alike))
    return distort(scene, flows, rng, blur=1.0, noise=0.008)


def smooth_noise(shape: tuple[int, ...], length: float, rng: np.random.Generator) -> FloatArray:
    """Noise of unit variance in every frame, smoothed over so many pixels."""
    fields = [
        cv2.GaussianBlur(rng.standard_normal(shape[1:]).astype(np.float32), (0, 0), length) for _ in range(shape[0])
    ]
    return np.stack([field / field.std() for field in fields])


def noisy(scene: FloatArray, rng: np.random.Generator, deviation: float, length: float) -> Made:
    """Noise as cameras, codecs and film leave it."""
    frames = moved(scene, rng)
    return frames + deviation * smooth_noise(frames.shape, length, rng), scene


def texture(scene: FloatArray, rng: np.random.Generator, keep: float, contrast: float) -> Made:
    """Lay a texture over the scene that renews itself; the truth is the mean of what it makes."""
    fresh, state, scenes = smooth_noise((COUNT + 1, *scene.shape), 2.0, rng), np.float32(0), []
    for field in fresh[1:]:
        state = keep * state + np.sqrt(1 - keep**2) * field
        scenes.append(np.clip(scene * (1 + contrast * state), 0, 1).astype(np.float32))
    flows = smooth_flows(COUNT, *scene.shape, rng, SmoothFlowParams(1.2, 12.0, 0.5))
    frames = [distort(one, flow[None], rng, blur=1.0, noise=0.008)[0] for one, flow in zip(scenes, flows, strict=True)]
    return np.stack(frames), np.mean(scenes, axis=0)


def facade(_: FloatArray, rng: np.random.Generator, period: int, rms: float) -> Made:
    """Windows that repeat more finely than they move."""
    y, x = np.mgrid[: 4 * SIDE, : 4 * SIDE] / 4
    wall = np.where((x % period > 0.4 * period) & (y % (1.5 * period) > 0.5 * period), 0.25, 0.7)
    scene = cv2.resize(wall.astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    return moved(scene, rng, rms=rms), scene


def planet_flip(_: FloatArray, rng: np.random.Generator) -> Made:
    """Turn a planet by 180 degrees midway."""
    y, x = np.mgrid[:SIDE, :SIDE]
    disc = np.clip((35 - np.hypot(x - 56, y - 56)) / 2, 0, 1)
    planet = np.float32(disc * (0.5 + 0.2 * np.sin(y / 5) + 0.15 * (np.hypot(x - 66, 1.6 * (y - 66)) < 7)))
    frames = moved(planet, rng)
    frames[COUNT // 2 :] = frames[COUNT // 2 :, ::-1, ::-1]
    return frames, planet


def dissolve(scene: FloatArray, rng: np.random.Generator) -> Made:
    """One scene that fades into another."""
    share = np.linspace(0, 1, COUNT, dtype=np.float32)[:, None, None]
    return (1 - share) * moved(scene, rng) + share * moved(scene[::-1].copy(), rng), scene


def watermark(scene: FloatArray, rng: np.random.Generator) -> Made:
    """Lay a half-transparent word over a camera that shakes."""
    word = np.zeros(scene.shape, np.uint8)
    cv2.putText(word, "STOCK", (8, 66), cv2.FONT_HERSHEY_SIMPLEX, 1.0, 255, 4)
    frames = moved(scene, rng)
    for frame in frames:
        frame[:] = np.roll(frame, tuple(rng.integers(-3, 4, 2)), (0, 1))
    return frames + 0.4 * word / np.float32(255) * (1 - frames), scene


def few(scene: FloatArray, rng: np.random.Generator, count: int) -> Made:
    """Frames of a burst."""
    return moved(scene, rng, count), scene


def slow(scene: FloatArray, rng: np.random.Generator) -> Made:
    """Make a clip in which the air hardly changes, so that its mean is bent."""
    return moved(scene, rng, rms=2.0, alike=0.95), scene


def plain(scene: FloatArray, rng: np.random.Generator) -> Made:
    """Make a usual clip."""
    return moved(scene, rng), scene


# Maker, scene, and width that is asked for.
OWN: dict[str, tuple[Callable[..., Made], str, float | None]] = {
    **{f"smooth noise {d:.0%}, {s} px, {n}": (partial(noisy, deviation=d, length=s), n, None)
       for n, d, s in (("camera", 0.03, 1.0), ("cat", 0.06, 1.5), ("brick", 0.06, 1.0), ("camera", 0.04, 2.5))},
    **{f"texture {c:.0%}, {k}, {n}": (partial(texture, keep=k, contrast=c), n, None)
       for n, k, c in (("camera", 0.92, 0.08), ("cat", 0.8, 0.1), ("camera", 0.98, 0.15))},
    **{f"{count} frames, {n}": (partial(few, count=count), n, None)
       for n, count in (("cat", 2), ("camera", 3), ("brick", 2), ("cat", 5))},
    **{f"--sigma {s}, {n}": (plain, n, s) for n, s in (("cat", 2.5), ("camera", 3.0), ("chart", 2.2), ("cat", 1.0))},
    **{f"facade {p} px, {r} px": (partial(facade, period=p, rms=r), "cat", None)
       for p, r in ((6, 2.0), (8, 1.5), (14, 1.0))},
    "planet, turned midway": (planet_flip, "cat", None),
    **{f"dissolve, {n}": (dissolve, n, None) for n in ("camera", "brick")},
    **{f"watermark, {n}": (watermark, n, None) for n in ("cat", "camera")},
    **{f"slow, {n}": (slow, n, None) for n in ("cat", "camera", "brick")},
    **{f"plain, {n}": (plain, n, None) for n in ("cat", "camera", "brick", "chart", "words")},
}  # fmt: skip


def tasks() -> Iterator[tuple[str, str]]:
    """Yield group and name of every clip."""
    from recordings import clips

    yield from (("drawn", name) for name in drawn_clips(turbrestore.__version__))
    yield from (("recording", name) for name, *_ in list(clips())[::EVERY])
    yield from (("own", name) for name in OWN)


def make(group: str, name: str) -> tuple[np.ndarray, FloatArray, float | None]:
    """Frames, truth and width that is asked for."""
    if group == "drawn":
        clip = drawn_clips(turbrestore.__version__)[name]()
        assert clip.truth is not None
        # The truth is at the mean geometry of all frames, of which every second one is taken.
        top, left = ((length - SIDE) // 2 for length in clip.truth.shape)
        part = np.s_[top : top + SIDE, left : left + SIDE]
        return clip.frames[::2, *part], clip.truth[part], None
    if group == "recording":
        from recordings import clips

        return *next((frames, truth) for known, frames, truth in clips() if known == name), None
    maker, scene, sigma = OWN[name]
    rng = np.random.default_rng(list(OWN).index(name))
    frames, truth = maker(luminance(SCENES[scene](SIDE, SIDE)), rng)
    return np.rint(255 * np.clip(frames, 0, 1)).astype(np.uint8), truth, sigma


def bend(image: FloatArray, truth: FloatArray) -> float:
    """Root mean square of the flow between two images about their shift, pixels, weighted by the gradient."""
    grey = luminance(image)
    like = (grey - grey.mean()) * truth.std() / max(grey.std(), 1e-6) + truth.mean()
    flow = estimate_flow(truth, like[None], runtime=Runtime(threads=1))[0]
    weight = np.hypot(*sobel_gradient(truth)) ** 2
    about = flow - np.einsum("yxc,yx->c", flow, weight) / weight.sum()
    return float(np.sqrt(np.average(np.square(about).sum(axis=-1), weights=weight)))


def judge(task: tuple[str, str]) -> Row:
    """Restore a clip and compare it with its truth."""
    frames, truth, sigma = make(*task)
    params, one = RestoreParams(deconvolution=DeconvolutionParams(sigma=sigma)), Runtime(threads=1)
    found = restore(FrameSource.from_array(frames), params, one)
    assert found.filtered is not None
    fused, levels = found.filtered.image, levels_of(frames)
    wiener = [DeconvolutionParams(method="wiener", sigma=width) for width in WIDTHS]
    sharpened = [deblurred(fused, levels, each, runtime=one).image for each in wiener]
    result, mean, *others = (compare(image, truth).psnr_fit for image in (found.image, found.mean, fused, *sharpened))
    return Row(*task, result, mean, max(result, *others), bend(found.image, truth), found.is_mean, found.verdict)


def table(rows: Sequence[Row]) -> str:
    """Count what each group and each check has, and list the clips on which the verdict is wrong."""
    lines = ['| clips | good | of these with a check | bad | of these "looks right" |', "|---|---|---|---|---|"]
    for group in (*dict.fromkeys(row.group for row in rows), "all"):
        some = [row for row in rows if group in (row.group, "all")]
        good, bad = [row for row in some if not row.is_bad], [row for row in some if row.is_bad]
        alarms, missed = sum(bool(row.verdict.checks) for row in good), sum(not row.verdict.checks for row in bad)
        lines.append(f"| {group} | {len(good)} | {alarms} | {len(bad)} | {missed} |")
    lines += ["", "| check | on good results | on bad ones |", "|---|---|---|"]
    counts = [
        Counter(check.kind for row in rows if row.is_bad is bad for check in row.verdict.checks)
        for bad in (False, True)
    ]
    lines += [f"| {kind} | {counts[0][kind]} | {counts[1][kind]} |" for kind in sorted(counts[0] | counts[1])]
    lines += ["", "| wrong on | result | mean | right width | bent, px | verdict |", "|---|---|---|---|---|---|"]
    lines += [
        f"| {row.name} | {row.result:.1f} | {row.mean:.1f} | {row.best:.1f} | {row.bent:.1f} | "
        f"{'; '.join(check.text for check in row.verdict.checks) or 'looks right'} |"
        for row in rows
        if row.is_bad is not bool(row.verdict.checks)
    ]
    return "\n".join(lines)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="parts of the names of clips; all by default")
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    wanted = [task for task in tasks() if not options.names or any(part in task[1] for part in options.names)]
    with multiprocessing.get_context("spawn").Pool(2, initializer=_path) as pool:
        rows = []
        for row in pool.imap(judge, wanted):
            rows.append(row)
            figures = f"{row.result:.1f}, mean {row.mean:.1f}, best {row.best:.1f}, bent {row.bent:.1f}"
            print(f"{row.name}: {figures}; {row.verdict}", file=sys.stderr)
    made = f"Made by `python benchmarks/verdicts.py{arguments()}`: peak signal-to-noise ratios in dB."
    publish(f"# The verdict\n\n{made} {_SAYS}\n\n{table(rows)}\n", options.write)


_SAYS = (
    f"A result is bad where it is the mean of the frames or more than {SLACK} dB below it, more than {LOST:g} dB below "
    f"the filtered image with the best of some widths removed, or bent by more than {BENT:g} pixel."
)


def _path() -> None:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
    os.environ["OMP_NUM_THREADS"] = "1"


if __name__ == "__main__":
    _path()
    main()
