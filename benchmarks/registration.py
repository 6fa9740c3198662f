"""What registration survives: a shaken or drifting camera, and regions without texture, as Markdown tables.

Run ``python benchmarks/registration.py``; it takes about a minute, ``--quick`` less.  Each table holds the same
measurement with one parameter of the flow switched off and on.  Ends with 1 if switching it on does not pay.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

import cv2
import numpy as np
import skimage.data
from provenance import publish_printed

from turbrestore.core.arrays import FloatArray
from turbrestore.metrics import compare
from turbrestore.registration.camera.global_shift import overlap
from turbrestore.registration.centroid import find_centroid
from turbrestore.registration.flow import FlowParams, estimate_flow
from turbrestore.synthesis.scenes import printed_words
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

SCENE, SIDE, FRAMES = 512, 192, 16
SHIFTS = (0, 2, 8, 16, 32, 60)
# Jitter (standard deviation) and drift over the clip, pixels.
CAMERAS = ((0, 0), (3, 0), (12, 0), (0, 30), (0, 60), (6, 60))
NOISES = (0.005, 0.01, 0.03)
# A shift of up to 60 px may add this to the end-point error, pixels, and a moving camera cost this, dB.
MOST_ADDED, MOST_LOST = 0.3, 0.5
# What is left of the motion that is invented in a flat region.
MOST_LEFT = 0.3


@dataclass(frozen=True)
class Comparison:
    """One figure with the parameter switched off and on."""

    off: float
    on: float

    def __str__(self) -> str:
        return f"{self.off:.2f} → {self.on:.2f}"


def scenes() -> dict[str, FloatArray]:
    """Return a photograph, a regular texture, and print."""
    photos = {name: getattr(skimage.data, name)().astype(np.float32) / 255 for name in ("camera", "brick")}
    return {**photos, "words": printed_words(SCENE, SCENE)}


def shift_errors(scene: FloatArray) -> list[Comparison]:
    """Median end-point error, pixels, of frames that are shifted as a whole."""
    rng, blurred = np.random.default_rng(0), cv2.GaussianBlur(scene, (0, 0), 1.0)
    reference = _cut(blurred, (0, 0)) + rng.normal(0, 0.01, (SIDE, SIDE)).astype(np.float32)
    rows = []
    for length in SHIFTS:
        shift = np.rint(length * np.array([0.8, -0.6])).astype(int)
        frame = _cut(blurred, shift) + rng.normal(0, 0.02, (SIDE, SIDE)).astype(np.float32)
        both_see, _ = overlap((SIDE, SIDE), shift)

        def error(
            on: bool, frame: FloatArray = frame, shift: np.ndarray = shift, seen: tuple[slice, slice] = both_see
        ) -> float:
            flow = estimate_flow(reference, frame[None], FlowParams(global_shift=on))[0]
            return float(np.median(np.linalg.norm((flow - shift)[seen], axis=-1)))

        rows.append(Comparison(error(False), error(True)))
    return rows


def camera_scores(scene: FloatArray, count: int) -> list[Comparison]:
    """PSNR, dB, of the centroid of turbulent frames from a moving camera."""
    rows = []
    for jitter, drift in CAMERAS:
        frames = moving_frames(scene, count, jitter, drift)
        scores = [
            compare(find_centroid(frames, flow_params=FlowParams(global_shift=on)).image, _cut(scene, (0, 0))).psnr
            for on in (False, True)
        ]
        rows.append(Comparison(*scores))
    return rows


def moving_frames(scene: FloatArray, count: int, jitter: float, drift: float) -> FloatArray:
    """Turbulence (1.5 px a component, blur 1 px, noise .02) before a camera that shakes and drifts."""
    rng = np.random.default_rng(1)
    places = rng.normal(0, jitter, (count, 2)) + np.linspace(-0.5, 0.5, count)[:, None] * drift * np.array([0.8, 0.6])
    places = np.rint(places - places.mean(axis=0)).astype(int)
    flows = smooth_flows(count, SCENE, SCENE, rng)
    flows -= flows.mean(axis=0)
    frames = (distort(scene, flow[None], rng, blur=1.0, noise=0.02)[0] for flow in flows)
    return np.stack([_cut(frame, place) for frame, place in zip(frames, places, strict=True)])


def invented_motion(scene: FloatArray, moving: bool) -> list[tuple[Comparison, Comparison]]:
    """Errors of the flow, pixels, in the textured and in the flat half of a scene."""
    half = cv2.GaussianBlur(_cut(scene, (0, 0)), (0, 0), 1.0)
    half[:, SIDE // 2 :] = 0.5
    textured, flat = ((slice(16, -16), slice(*columns)) for columns in ((16, SIDE // 2 - 16), (SIDE // 2 + 24, -16)))
    rows = []
    for noise in NOISES:
        rng = np.random.default_rng(2)
        flows = smooth_flows(6, SIDE, SIDE, rng, SmoothFlowParams(rms=1.5 if moving else 0.0))
        frames = distort(half, flows, rng, noise=noise)
        # As noisy as a mean of 30 frames.
        reference = half + rng.normal(0, noise / 30**0.5, half.shape).astype(np.float32)
        errors = [estimate_flow(reference, frames, FlowParams(confidence=on)) - flows for on in (False, True)]
        rows.append((Comparison(*(_rms(e, textured) for e in errors)), Comparison(*(_rms(e, flat) for e in errors))))
    return rows


HEAD = """# Registration

Printed by `python benchmarks/registration.py`: scenes of 256×256 pixels."""


def main() -> int:
    """Print the tables; 1 when a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one scene, half of the frames")
    options = parser.parse_args()
    chosen = dict(list(scenes().items())[: 1 if options.quick else None])
    shifts = {name: shift_errors(scene) for name, scene in chosen.items()}
    print("## End-point error of a frame shifted as a whole, px, global_shift off → on\n")
    _print_table("shift, px", [str(length) for length in SHIFTS], shifts)
    cameras = {name: camera_scores(scene, FRAMES // (1 + options.quick)) for name, scene in chosen.items()}
    print("\n## PSNR of the centroid under jitter and drift of the camera, dB, global_shift off → on\n")
    _print_table("jitter, drift, px", [f"{jitter}, {drift}" for jitter, drift in CAMERAS], cameras)
    grass = skimage.data.grass().astype(np.float32) / 255
    still, moving = (invented_motion(grass, motion) for motion in (False, True))
    print("\n## Error of the flow of a half-flat scene, px, confidence off → on\n")
    rows = {
        f"{title}, {part} half": [row[index] for row in table]
        for title, table in (("still", still), ("moving 1.5 px", moving))
        for index, part in enumerate(("textured", "flat"))
    }
    _print_table("noise", [f"{noise:g}" for noise in NOISES], rows)
    added = max(row.on - rows[0].on for rows in shifts.values() for row in rows)
    lost = max(rows[0].on - row.on for rows in cameras.values() for row in rows)
    left = max(flat.on / flat.off for _, flat in still)
    print(f"\nShifts add {added:.2f} px, moving cameras cost {lost:.2f} dB, {left:.0%} of invented motion is left.")
    return int(added > MOST_ADDED or lost > MOST_LOST or left > MOST_LEFT)


def _cut(scene: FloatArray, shift: np.ndarray | tuple[int, int]) -> FloatArray:
    """Middle of the scene, as a camera sees it that is shifted by whole pixels."""
    left, top = (SCENE - SIDE) // 2 - np.asarray(shift)
    return scene[top : top + SIDE, left : left + SIDE]


def _rms(flows: FloatArray, where: tuple[slice, slice]) -> float:
    return float(np.sqrt(np.mean(np.sum(np.square(flows[:, *where]), axis=-1))))


def _print_table(corner: str, columns: list[str], rows: dict[str, list[Comparison]]) -> None:
    print(f"| {corner} | {' | '.join(columns)} |\n|---|{'---:|' * len(columns)}")
    for name, row in rows.items():
        print(f"| {name} | {' | '.join(map(str, row))} |")


if __name__ == "__main__":
    sys.exit(publish_printed(HEAD, main))
