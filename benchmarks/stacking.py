"""What people who stack rely on: registered frames, clips in one geometry, finer grids, discs that turn, a night.

Every section prints one table.  Errors of ``channels`` are medians over the pixels, weighted by the energy of the
gradient, because flat areas show no geometry; those of ``aligned`` are medians over all pixels.

python benchmarks/stacking.py
python benchmarks/stacking.py channels finer
python benchmarks/stacking.py --write benchmarks/results/stacking.md
"""

from __future__ import annotations

import argparse
import contextlib
import math
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from provenance import with_origin

from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.source import FrameSource
from turbrestore.io.video import write_video
from turbrestore.pipeline import restore
from turbrestore.registration.coverage import coverage
from turbrestore.registration.flow import estimate_flow
from turbrestore.registration.flow_algebra import compose_flows, invert_flow
from turbrestore.registration.warp import warp
from turbrestore.settings import RestoreParams
from turbrestore.stacking.derotation import derotated, read_rotation
from turbrestore.stacking.registered import registered_frames
from turbrestore.stacking.results_alignment import align_results
from turbrestore.synthesis.drawn_scenes import number_plate, planet, road_sign, street
from turbrestore.synthesis.scenes import SCENES, picture
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows
from turbrestore_cli.__main__ import main as turbrestore

Scene = Callable[[int, int], FloatArray]
DRAWN: dict[str, Scene] = {"street": street, "sign": road_sign, "plate": number_plate, "planet": planet}
TO_FILTER = RestoreParams(until="filter")
# Pixels beside the border that are not compared.
BORDER = 10


def air(count: int, height: int, width: int, seed: int, rms: float = 1.0) -> FloatArray:
    """Flows of a turbulent clip."""
    params = SmoothFlowParams(rms=rms, correlation_length=14, persistence=0.3)
    return smooth_flows(count, height, width, np.random.default_rng(seed), params)


def scene(name: str, height: int, width: int) -> FloatArray:
    """Draw or load a scene, in colour where it has any."""
    return (DRAWN.get(name) or SCENES[name])(height, width)


def median_length(flow: FloatArray, image: FloatArray) -> float:
    """Median length of a flow, weighted by the energy of the gradient of an image."""
    soft = cv2.GaussianBlur(image, (0, 0), 1.0)
    energy = sum(np.square(cv2.Sobel(soft, cv2.CV_32F, *axis)) for axis in ((1, 0), (0, 1)))
    inner = np.s_[BORDER:-BORDER, BORDER:-BORDER]
    lengths, weights = np.linalg.norm(flow, axis=-1)[inner].ravel(), energy[inner].ravel()
    order = np.argsort(lengths)
    total = np.cumsum(weights[order])
    return float(lengths[order][np.searchsorted(total, total[-1] / 2)])


def decibels(image: FloatArray, truth: FloatArray, part: object = np.s_[8:-8, 8:-8]) -> float:
    """PSNR of a part of an image."""
    return float(-10 * np.log10(np.mean(np.square(np.clip(image, 0, 1) - truth)[part])))


def registered() -> Iterator[str]:
    """Compare the mean of registered frames with the mean that the restored image started from."""
    yield "| scene | frames | largest difference of their mean and the centroid |\n|---|---|---|"
    for name in ("street", "camera", "chart"):
        grey, flows = luminance(scene(name, 128, 128)), air(24, 128, 128, 0)
        source = FrameSource.from_array(distort(grey, flows, np.random.default_rng(1), blur=0.8, noise=0.01))
        restoration = restore(source, TO_FILTER)
        frames = list(registered_frames(source, restoration, TO_FILTER))
        seen = coverage(np.stack([frame.flow for frame in frames])) == 1
        mean = np.mean([frame.image for frame in frames], axis=0)
        yield f"| {name} | {len(frames)} | {np.abs(mean - restoration.centroid.image)[seen].max():.1e} |"


def channels(side: int = 160, count: int = 60) -> Iterator[str]:
    """Red, green and blue of true colours, each from a clip of its own, on the geometry of red."""
    pairs = ((0, 1), (0, 2), (1, 2))
    heads = [f"{'RGB'[a]}–{'RGB'[b]} {words}" for words in ("alone", "on red") for a, b in pairs]
    yield f"| scene | {' | '.join(heads)} |\n|---|{'---|' * len(heads)}"
    drifts = ((0.0, 0.0), (1.5, -1.0), (-2.5, 2.0))
    for name in ("street", "sign", "planet", "astronaut", "cat", "coffee"):
        colour = scene(name, side, side)
        alone, placed = [], []
        with tempfile.TemporaryDirectory() as folder:
            reference = Path(folder) / "red.tif"
            for number, drift in enumerate(drifts):
                plane, flows = np.ascontiguousarray(colour[..., number]), air(count, side, side, number)
                frames = distort(plane, flows + np.float32(drift), np.random.default_rng(number), blur=0.8, noise=0.01)
                alone.append(restore(frames, TO_FILTER).image)
                if number == 0:
                    write_image(reference, alone[0], 32)
                on_red = RestoreParams(until="filter", reference=str(reference))
                placed.append(alone[0] if number == 0 else restore(frames, on_red).image)
        where = [
            [geometry(image, np.ascontiguousarray(colour[..., number])) for number, image in enumerate(images)]
            for images in (alone, placed)
        ]
        cells = [f"{median_length(one[a] - one[b], luminance(colour)):.2f}" for one in where for a, b in pairs]
        yield f"| {name} | {' | '.join(cells)} |"


def geometry(result: FloatArray, truth: FloatArray) -> FloatArray:
    """Where a result shows the points of the scene of its own channel, at the same sharpness, pixels."""
    soft = [cv2.GaussianBlur(truth, (0, 0), width) for width in np.arange(0.5, 2.6, 0.25)]
    # Flow between images of unlike sharpness is biased.
    alike = min(
        soft,
        key=lambda one: float(np.abs(cv2.Laplacian(one, -1)).mean() - np.abs(cv2.Laplacian(result, -1)).mean()) ** 2,
    )
    flow = estimate_flow(alike, result[None])[0]
    again = estimate_flow(warp(alike, invert_flow(flow)), result[None])[0]
    return cv2.GaussianBlur(flow + again, (0, 0), 3)


def aligned(count: int = 40, pad: int = 28) -> Iterator[str]:
    """Results with shifts of up to 10 pixels, 3 degrees and 2 %, and bent by .3 pixels, against the common geometry."""
    yield "| scene | results | aligned | median error, pixels | largest of all results |\n|---|---|---|---|---|"
    inner = np.s_[pad:-pad, pad:-pad]
    for name in ("street", "moon", "camera"):
        grey, rng = luminance(scene(name, 192, 216)), np.random.default_rng(11)
        made, true = [], []
        for _ in range(count):
            F = similarity(grey.shape, rng.uniform(-10, 10, 2), rng.uniform(-3, 3), 1 + rng.uniform(-0.02, 0.02))
            bend = SmoothFlowParams(rms=0.3, correlation_length=14)
            F = compose_flows(F, smooth_flows(1, *grey.shape, rng, bend)[0])
            image = warp(grey, invert_flow(F, iterations=60))[inner]
            made.append((image + rng.normal(0, 0.005, image.shape)).astype(np.float32))
            true.append(F[inner])
        found = align_results(made).alignments
        errors = [one.flow - F for one, F in zip(found, true, strict=True) if not isinstance(one, str)]
        apart = [np.median(np.linalg.norm(one - np.median(errors, axis=0), axis=-1)[8:-8, 8:-8]) for one in errors]
        yield f"| {name} | {count} | {len(errors)} | {np.median(apart):.3f} | {max(apart):.3f} |"


def similarity(shape: tuple[int, ...], shift: FloatArray, rotation: float, scale: float) -> FloatArray:
    """Flow of a similarity about the centre."""
    y, x = (axis - (length - 1) / 2 for axis, length in zip(np.mgrid[: shape[0], : shape[1]], shape, strict=True))
    cosine, sine = (scale * function(math.radians(rotation)) for function in (math.cos, math.sin))
    return np.stack([cosine * x - sine * y + shift[0] - x, sine * x + cosine * y + shift[1] - y], -1).astype(np.float32)


def finer(over: int = 4, size: tuple[int, int] = (104, 128)) -> Iterator[str]:
    """``--scale 2``: a sharp lens on large pixels, and one that blurs by .9 pixels, which is well sampled."""
    yield (
        "| scene | lens, pixels | usual result enlarged, dB | twice as fine, dB | gain | reduced, against usual |\n"
        "|---|---|---|---|---|---|"
    )
    for lens in (0.2, 0.9):
        for name in ("street", "plate", "words", "chart", "camera", "coins"):
            grey = luminance(scene(name, over * size[0], over * size[1]))
            result = restore(FrameSource.from_array(sampled(grey, lens, over, size)), RestoreParams(scale=2))
            truth, usual = reduced(grey, result.finer.shape), reduced(grey, size)
            enlarged = cv2.resize(result.image, truth.shape[::-1], interpolation=cv2.INTER_CUBIC)
            before, after = decibels(enlarged, truth), decibels(result.finer, truth)
            again = decibels(reduced(result.finer, size), usual) - decibels(result.image, usual)
            yield f"| {name} | {lens} | {before:.2f} | {after:.2f} | {after - before:+.2f} | {again:+.2f} |"


def sampled(grey: FloatArray, lens: float, over: int, size: tuple[int, int], count: int = 40) -> FloatArray:
    """Frames through a lens of this blur, by a sensor that averages over whole pixels."""
    flows, large = air(count, *size, 3, rms=0.8), grey.shape[::-1]
    flows -= flows.mean(axis=0)
    soft = cv2.GaussianBlur(grey, (0, 0), lens * over)
    moved = (warp(soft, invert_flow(over * cv2.resize(flow, large, interpolation=cv2.INTER_LINEAR))) for flow in flows)
    frames = np.stack([reduced(one, size) for one in moved])
    return np.clip(frames + np.random.default_rng(3).normal(0, 0.004, frames.shape), 0, 1).astype(np.float32)


def reduced(image: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Mean over whole pixels."""
    return cv2.resize(image, shape[1::-1], interpolation=cv2.INTER_AREA)


def derotation(radius: float = 170.0, count: int = 40) -> Iterator[str]:
    """Jupiter over some minutes: means of frames without air, and restorations of frames through air."""
    yield (
        "| minutes | turned by | mean without air, dB | derotated | restored through air, dB | derotated |\n"
        "|---|---|---|---|---|---|"
    )
    jupiter, side = read_rotation("jupiter"), int(2.5 * radius)
    surface, truth = jupiter_surface(radius), np.clip(jupiter_disc(radius, side, 0.0), 0, 1)
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    within = np.hypot(x, y) < 0.8 * radius
    flows = air(count, side, side, 5)
    flows -= flows.mean(axis=0)
    for minutes in (2.5, 10.0, 20.0):
        rng, times = np.random.default_rng(6), np.linspace(-30 * minutes, 30 * minutes, count)
        discs = np.clip([jupiter_disc(radius, side, time, surface) for time in times], 0, 1)
        hazy = np.concatenate(
            [distort(disc, flow[None], rng, 1.0, 0.02) for disc, flow in zip(discs, flows, strict=True)]
        )
        rate = (count - 1) / (60 * minutes)
        cells = []
        for frames, image_of in (
            (discs, lambda source: source.read().mean(axis=0)),
            (hazy, lambda s: restore(s).image),
        ):
            source = FrameSource.from_array(frames, fps=rate)
            cells += [decibels(image_of(one), truth, within) for one in (source, derotated(source, jupiter))]
        angle = 360 * minutes / 60 / jupiter.period
        yield f"| {minutes:g} | {angle:.1f}° | {' | '.join(f'{cell:.2f}' for cell in cells)} |"


def jupiter_surface(radius: float) -> FloatArray:
    """Belts and spots over longitude and latitude."""
    width = round(4 * np.pi * radius)
    noise = np.tile(np.random.default_rng(4).standard_normal((width // 2, width)).astype(np.float32), (1, 3))
    surface = 0.62 + 0.1 * np.sin(np.linspace(-35, 35, width // 2, dtype=np.float32))[:, None]
    for part, height in ((10, 0.06), (25, 0.05), (60, 0.05), (100, 0.04)):
        spots = cv2.GaussianBlur(noise, (0, 0), sigmaX=2 * radius / part, sigmaY=radius / part)[:, width : 2 * width]
        surface = surface + np.float32(height) * spots / spots.std()
    return np.asarray(surface, np.float32)


def jupiter_disc(radius: float, side: int, seconds: float, surface: FloatArray | None = None) -> FloatArray:
    """Jupiter above its equator, drawn twice as large and averaged down."""
    surface, jupiter = jupiter_surface(radius) if surface is None else surface, read_rotation("jupiter")
    y, x = (np.mgrid[: 2 * side, : 2 * side] + 0.5 - side) / (2 * radius)
    cosine, sine = math.cos(math.radians(12)), math.sin(math.radians(12))
    u, v = cosine * x + sine * y, (sine * x - cosine * y) / (1 - jupiter.flattening)
    depth = np.sqrt(np.clip(1 - u**2 - v**2, 0, 1))
    longitude = np.arctan2(u, depth) - 2 * np.pi * seconds / (3600 * jupiter.period)
    columns = longitude / (2 * np.pi) % 1 * surface.shape[1]
    rows = (np.arcsin(np.clip(v, -1, 1)) / np.pi + 0.5) * (surface.shape[0] - 1)
    places = columns.astype(np.float32), rows.astype(np.float32)
    seen = cv2.remap(surface, *places, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    shaded = np.where(u**2 + v**2 < 1, seen * (0.35 + 0.65 * depth), 0).astype(np.float32)
    return reduced(shaded, (side, side))


def night(clips: int = 30, side: int = 160, count: int = 24) -> Iterator[str]:
    """Thirty short recordings of the Moon: ``batch``, then ``align``, and one sheet."""
    yield "| command | results | wall time, s | processor time, s |\n|---|---|---|---|"
    moon = picture("moon", side + 40, side + 40)
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        Path("night").mkdir()
        for number in range(clips):
            rng = np.random.default_rng(number)
            F = similarity(moon.shape, rng.uniform(-8, 8, 2), rng.uniform(-1, 1), 1.0)
            still = warp(moon, invert_flow(F))[20:-20, 20:-20]
            frames = distort(still, air(count, side, side, number), rng, blur=0.8, noise=0.02)
            write_video(Path(f"night/{number:02}.ser"), frames, 25.0, 16)
        for words in ("batch night/*.ser results", "align results/*.png aligned"):
            start, before = time.perf_counter(), processor_time()
            code = turbrestore([*words.split(), "--quiet"])
            wall, own = time.perf_counter() - start, processor_time() - before
            made = len(list(Path(words.split()[-1]).glob("[0-9]*.png"))) if code == 0 else 0
            yield f"| `turbrestore {words}` | {made} | {wall:.0f} | {own:.0f} |"
        height, width = read_image("aligned/sheet.png").image.shape[:2]
        yield f"| `aligned/sheet.png`, {width}×{height} pixels | {clips} | | |"


def processor_time() -> float:
    """Processor time of this process and of those that it has waited for, seconds."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


SECTIONS = {one.__name__: one for one in (registered, channels, aligned, finer, derotation, night)}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    command = " ".join(["python benchmarks/stacking.py", *options.sections])
    lines = ["# Stacking", "", f"Printed by `{command}`."]
    print("\n".join(lines))
    for name in options.sections or SECTIONS:
        section = SECTIONS[name]
        for line in ("", f"## {section.__doc__}", ""):
            print(line)
            lines.append(line)
        for line in section():
            print(line, flush=True)
            lines.append(line)
    if options.write is not None:
        options.write.write_text(with_origin("\n".join(lines) + "\n"), encoding="utf-8")


if __name__ == "__main__":
    main()
