"""How well the strength of the turbulence is measured on clips of known D/r0, as Markdown tables.

Run ``python benchmarks/seeing.py``; it takes 5 minutes of one core, and ``--clips 12`` one.  Clips: three scenes of 112
pixels a side, 48 frames at 30 a second, D/r0 of 1 to 6, wind of 1 to 6 m/s from any side.  With ``TURBRESTORE_DATA``
the simulated clips of that folder follow, 48 frames of their middle of 160 pixels a side; their optics are given to all
of them, also to those that have no such physics, which should be reported without r0.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.io.video import open_frames
from turbrestore.registration.centroid import find_centroid
from turbrestore.runtime.runtime import Runtime
from turbrestore.seeing.strength import Seeing, measure_seeing
from turbrestore.seeing.tilt_theory import Optics
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.scenes import picture, resolution_chart

SIDE, FRAMES = 112, 48
RECORDED_SIDE = 160
OPTICS = Optics(pixel_scale=2.75e-6, aperture=0.1, wavelength=550e-9, distance=2000.0)
ONE = Runtime(threads=1)
# D/r0 of the clips that have one.
KNOWN = {"ao_brick_weak": 1.0, "ao_chart_weak": 1.0, "ao_camera_medium": 2.5}


def seeing_of(frames: FloatArray) -> Seeing:
    """Measure the strength as the pipeline does."""
    centroid = find_centroid(frames, runtime=ONE)
    return measure_seeing(frames, centroid.flows, centroid.image, frames.mean(axis=0), OPTICS, threads=1)


def synthesized(count: int) -> None:
    """Print D/r0 and Cn² over their true values on synthetic clips."""
    scenes = {
        "chart": resolution_chart(SIDE, SIDE),
        "camera": picture("camera", SIDE, SIDE),
        "coins": picture("coins", SIDE, SIDE),
    }
    ratios: dict[str, list[float]] = {name: [] for name in scenes}
    inside = 0
    for number in range(count):
        rng = np.random.default_rng(number)
        name = list(scenes)[number % len(scenes)]
        strength = 1 + 5 * (number // len(scenes)) / max((count - 1) // len(scenes), 1)
        params = PhaseScreenParams(d_over_r0=strength, wind=(rng.uniform(1, 6),), wind_direction=(rng.uniform(0, 360),))
        frames = np.stack(
            [frame.image for frame in phase_screen_frames(scenes[name], FRAMES, rng, params, runtime=ONE)]
        )
        found = seeing_of(frames).d_over_r0
        if found is None:
            print(f"{name}, D/r0 = {strength:.2f}: not reported")
            continue
        ratios[name].append(found.value / strength)
        inside += found.low <= strength <= found.high
    print("| scene | clips | D/r0 over the truth, median | median error | largest | Cn², median error |")
    print("|---|---|---|---|---|---|")
    for name, values in [*ratios.items(), ("all", [ratio for part in ratios.values() for ratio in part])]:
        ratio = np.array(values)
        error, cn2 = np.abs(ratio - 1), np.abs(ratio ** (5 / 3) - 1)
        figures = f"{np.median(ratio):.3f} | {np.median(error):.3f} | {error.max():.3f} | {np.median(cn2):.3f}"
        print(f"| {name} | {len(ratio)} | {figures} |")
    print(f"\nInside the 95 % interval: {inside} of {count}")


def recorded(folder: Path) -> None:
    """Print what is found in the simulated clips of a folder."""
    print("\n| clip | D/r0 | true | rotation | variance by flow and by blur, px² |\n|---|---|---|---|---|")
    for place in sorted((folder / "simulated").iterdir()):
        clip = place / "clip.mkv" if (place / "clip.mkv").exists() else place / "frames"
        if not clip.exists():
            continue
        source = open_frames(clip)
        top, left = (max(size - RECORDED_SIDE, 0) // 2 for size in source.shape[1:3])
        sides = [min(size, RECORDED_SIDE) for size in source.shape[1:3]]
        part = source.select((0, min(FRAMES, len(source)), 1), (left, top, sides[1], sides[0]))
        seeing = seeing_of(part.read())
        found, flow, blur = seeing.d_over_r0, seeing.displacement_by_flow, seeing.displacement_by_blur
        strength = "none" if found is None else f"{found.value:.2f} ({found.low:.2f} to {found.high:.2f})"
        both = ", ".join("none" if part is None else f"{part.value:.2f}" for part in (flow, blur))
        print(
            f"| {place.name} | {strength} | {KNOWN.get(place.name, 'none')} | {seeing.rotation:.2f} | {both} |",
            flush=True,
        )


def main() -> None:
    """Read the options and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=60, help="number of synthetic clips")
    synthesized(parser.parse_args().clips)
    folder = os.environ.get("TURBRESTORE_DATA")
    if folder is None:
        print("\nTURBRESTORE_DATA is not set: no recorded clips")
    else:
        recorded(Path(folder))


if __name__ == "__main__":
    main()
