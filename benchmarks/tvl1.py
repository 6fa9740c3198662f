"""TV-L1 flow against OpenCV's DualTVL1 with its defaults: time and error where the motion is known.

Run ``python benchmarks/tvl1.py``; it takes some minutes, ``--quick`` one.  Three sets of frames with known flow:
phase screens, smooth random flows, and a dynamic texture learned from a clip.  All methods see the same prepared images
and end where they end: no shift is taken out and no flow regularised.  Errors are mean end-point errors over all pixels
and over the half with the larger gradients.

Every method solves the frames of a set on two threads.  Time is CPU time of the process, which a busy machine
disturbs less than the clock; the methods take turns, and the smallest of the runs counts.  Ends with 1 if the flow is
less than five times faster than OpenCV's on any set, or its error is larger.

``--starts`` compares what a flow may start from instead: nothing, the flow to the frame before, the one-step prediction
of a dynamic texture that was identified on 40 earlier frames, and for a bound the flow to the frame itself.

``--clips`` restores the clips with truth instead, among them those under the folder that ``TURBRESTORE_DATA`` names: by
TV-L1 that begins every flow anew, but for the shift of its frame, that starts from earlier flows, and by dense inverse
search.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar
from unittest import mock

import cv2
import numpy as np
from provenance import publish_printed

from turbrestore.core.arrays import FloatArray, luminance
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.dynamics.flow_model import predict_flow, project_deviation
from turbrestore.metrics import endpoint_error
from turbrestore.registration.flow import FlowParams, iterate_flows, normalise_contrast
from turbrestore.registration.flow_methods.opencv_flow import FlowSolver, GreyImage
from turbrestore.registration.flow_methods.tvl1 import TvL1Params, prepare_tvl1, tvl1_flows
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.threads import map_ahead
from turbrestore.synthesis.anisoplanatic import diffraction_limited, phase_screen_frames
from turbrestore.synthesis.atmosphere import STRENGTHS, PhaseScreenParams
from turbrestore.synthesis.dynamic_texture import synthesize_like
from turbrestore.synthesis.scenes import SCENES, resolution_chart
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

SIDE, THREADS, LEAST_RATIO = 192, 2, 5.0
# Frames that a dynamic texture is identified on, later frames that flows are started for, and levels of the pyramid.
IDENTIFIED, STARTED, STARTED_LEVELS = 40, 12, (4, 3, 2, 1)
Found = TypeVar("Found")
BASELINE, OURS = "DualTVL1, its defaults", "tvl1"


@dataclass(frozen=True, eq=False)
class KnownMotion:
    """A reference, frames of it, and the flow from one to the other.

    Attributes
    ----------
    reference : ndarray, float32, shape (H, W)
    frames : ndarray, float32, shape (T, H, W)
    truth : ndarray, float32, shape (T, H, W, 2)
    """

    reference: FloatArray
    frames: FloatArray
    truth: FloatArray


@dataclass(frozen=True)
class Score:
    """CPU seconds and clock seconds for a frame, and errors in pixels."""

    cpu: float
    clock: float
    everywhere: float
    textured: float


def phase_screens(count: int) -> KnownMotion:
    """Return frames through layers of turbulence with blur and noise; the reference is what the optics alone show."""
    params = PhaseScreenParams(d_over_r0=STRENGTHS["medium"])
    scene = luminance(SCENES["cat"](SIDE, SIDE))
    frames = list(phase_screen_frames(scene, count, np.random.default_rng(11), params))
    images, flows = (np.stack([getattr(frame, name) for frame in frames]) for name in ("image", "flow"))
    return KnownMotion(diffraction_limited(scene, params), images, flows)


def smooth_motion(count: int) -> KnownMotion:
    """Return a blurred scene under smooth random flows of 1.5 px a component."""
    rng = np.random.default_rng(12)
    return _distorted(SCENES["brick"](SIDE, SIDE), smooth_flows(count, SIDE, SIDE, rng), rng)


def dynamic_texture(count: int) -> KnownMotion:
    """Return a blurred scene that moves like a clip does."""
    rng = np.random.default_rng(13)
    motion = smooth_flows(60, SIDE, SIDE, rng, SmoothFlowParams(rms=1.3, correlation_length=12.0))
    clip = distort(resolution_chart(SIDE, SIDE), motion, rng, blur=1.0, noise=0.01)
    scene = SCENES["camera"](SIDE, SIDE)
    texture = synthesize_like(clip, count, rng, scene=scene)
    return _distorted(scene, np.stack(list(texture.flows)), rng)


SETS = {"Phase screens": phase_screens, "Smooth flows": smooth_motion, "Dynamic texture": dynamic_texture}


def methods() -> dict[str, Callable[[KnownMotion], FloatArray]]:
    """Return what is compared: from a set to its flows."""
    plain = FlowParams(global_shift=False, confidence=False)
    ours = replace(plain, method="tvl1")
    total = replace(ours, tvl1=TvL1Params(huber=0.0))
    return {
        BASELINE: lambda motion: _opencv(motion, lambda solver: None),
        "DualTVL1, 3 warps, 2 × 10 iterations, no median": lambda motion: _opencv(motion, _hurry),
        "DIS": lambda motion: _flows(motion, plain),
        "tvl1, total variation": lambda motion: _flows(motion, total),
        OURS: lambda motion: _flows(motion, ours),
    }


def measure(motion: KnownMotion, runs: int) -> dict[str, Score]:
    """Score every method; they take turns."""
    textured = _textured_half(motion.reference)
    times: dict[str, list[tuple[float, float]]] = {}
    errors: dict[str, tuple[float, float]] = {}
    for solve in list(methods().values())[2:]:
        # What is compiled once.
        solve(replace(motion, frames=motion.frames[:1]))
    for _ in range(runs):
        for name, solve in methods().items():
            begun = time.process_time(), time.perf_counter()
            flows = solve(motion)
            ended = time.process_time(), time.perf_counter()
            times.setdefault(name, []).append((ended[0] - begun[0], ended[1] - begun[1]))
            where = flows[:, textured], motion.truth[:, textured]
            errors[name] = endpoint_error(flows, motion.truth), endpoint_error(*(a[:, None] for a in where))
    best = {name: np.min(np.array(t), axis=0) / len(motion.frames) for name, t in times.items()}
    return {name: Score(*map(float, best[name]), *errors[name]) for name in times}


HEAD = """# TV-L1 flow

Printed by `python benchmarks/tvl1.py`: our flow, and OpenCV's DualTVL1 with its defaults."""


def main() -> int:
    """Print the tables; 1 when a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument("--quick", action="store_true", help="half of the frames, one run")
    choice.add_argument("--starts", action="store_true", help="compare what flows start from")
    choice.add_argument("--clips", action="store_true", help="restore clips with and without starts")
    options = parser.parse_args()
    if options.starts or options.clips:
        (compare_starts if options.starts else compare_clips)()
        return 0
    count, runs = (4, 1) if options.quick else (8, 3)
    good = True
    for name, make in SETS.items():
        motion = make(count)
        scores = measure(motion, runs)
        base, ours = scores[BASELINE], scores[OURS]
        lengths = np.linalg.norm(motion.truth, axis=-1)
        print(f"## {name}: {count} frames of {SIDE}×{SIDE}, mean motion {lengths.mean():.2f} px\n")
        print("| method | CPU, ms a frame | ratio | clock, ms a frame | error, px | textured half, px |")
        print("|---|---:|---:|---:|---:|---:|")
        for method, score in scores.items():
            ratio = base.cpu / score.cpu
            cells = f"{1e3 * score.cpu:.1f} | {ratio:.1f} | {1e3 * score.clock:.1f}"
            print(f"| {method} | {cells} | {score.everywhere:.3f} | {score.textured:.3f} |")
        print()
        good &= base.cpu / ours.cpu >= LEAST_RATIO
        good &= ours.everywhere <= base.everywhere and ours.textured <= base.textured
    print(f"At least {LEAST_RATIO:g} times faster at no larger error: {'yes' if good else 'NO'}.")
    return int(not good)


def compare_starts() -> None:
    """Print time, warps at full resolution and error of flows by what they start from, and how far off that is."""
    for name, make in SETS.items():
        motion = make(IDENTIFIED + STARTED)
        frames = np.stack([_grey_levels(frame) for frame in motion.frames]).astype(np.float32)
        later = frames[IDENTIFIED:]
        reference, truth = _grey_levels(motion.reference).astype(np.float32), motion.truth[IDENTIFIED:]
        found = tvl1_flows(frames, prepare_tvl1(reference)).flows
        dynamics = identify(found[:IDENTIFIED])
        before, own = found[IDENTIFIED - 1 : -1], found[IDENTIFIED:]
        states = [project_deviation(dynamics, flow - dynamics.mean_flow) for flow in before]
        predicted = np.stack([predict_flow(dynamics, state) for state in states])
        starts = {"nothing": np.zeros_like(own), "frame before": before, "prediction": predicted, "frame itself": own}
        print(f"## {name}\n\n| levels | start | its error, px | CPU, ms a frame | warps | error, px |")
        print("|---:|---|---:|---:|---:|---:|")
        for levels in STARTED_LEVELS:
            prepared = prepare_tvl1(reference, TvL1Params(levels=levels))
            for label, start in starts.items():
                runs = [_clocked(partial(tvl1_flows, later, prepared, start)) for _ in range(3)]
                flows, spent = runs[0][0], min(seconds for _, seconds in runs)
                cells = f"{endpoint_error(start, truth):.2f} | {1e3 * spent / STARTED:.1f} | {flows.warps.mean():.1f}"
                error = endpoint_error(flows.flows, truth)
                print(f"| {len(prepared.levels)} | {label} | {cells} | {error:.3f} |")
        print()


def compare_clips() -> None:
    """Print the CPU time of whole restorations, and PSNR of the filtered and the deblurred image."""
    from clips import find_clips

    from turbrestore.metrics import compare
    from turbrestore.pipeline import RestoreParams, restore
    from turbrestore.registration.flow import FLOW_METHODS

    started = FLOW_METHODS["tvl1"]

    def begin_anew(params: FlowParams, reference: GreyImage, device: str) -> FlowSolver:
        solve = started(params, reference, device)
        return lambda frames, starts, draft: solve(frames, [None] * len(starts), draft)

    # What the others take is not to be that of the compiler.
    restore(phase_screens(12).frames, RestoreParams(flow=FlowParams(method="tvl1")))
    ways = {"tvl1, begun anew": ("tvl1", begin_anew), "tvl1": ("tvl1", started), "dis": ("dis", started)}
    print(f"| clip | {' | '.join(f'{way}: s, filtered, deblurred' for way in ways)} |\n|---|{'---|' * len(ways)}")
    for name, load in find_clips([]).items():
        clip, cells = load(), []
        if clip.truth is None:
            continue
        for method, solver in ways.values():
            call = partial(restore, clip.frames, RestoreParams(flow=FlowParams(method=method)))
            with mock.patch.dict(FLOW_METHODS, tvl1=solver):
                found, spent = _clocked(call)
            images = found.filtered.image, found.deconvolution.image
            cells.append(f"{spent:.1f}, " + ", ".join(f"{compare(image, clip.truth).psnr:.3f}" for image in images))
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def _clocked(call: Callable[[], Found]) -> tuple[Found, float]:
    """Return what a call gives, and the CPU time that it took, s."""
    begun = time.process_time()
    return call(), time.process_time() - begun


def _distorted(scene: FloatArray, flows: FloatArray, rng: np.random.Generator) -> KnownMotion:
    blurred = cv2.GaussianBlur(scene, (0, 0), 1.0)
    return KnownMotion(blurred, distort(blurred, flows, rng, noise=0.01), flows)


def _flows(motion: KnownMotion, params: FlowParams) -> FloatArray:
    return np.stack(
        [flow for _, flow in iterate_flows(motion.reference, motion.frames, params, Runtime(threads=THREADS))]
    )


def _opencv(motion: KnownMotion, change: Callable[[cv2.optflow.DualTVL1OpticalFlow], None]) -> FloatArray:
    """Solve with OpenCV on the images that the flow of this package sees."""
    reference = _grey_levels(motion.reference)

    def solve(frame: FloatArray) -> FloatArray:
        solver = cv2.optflow.DualTVL1OpticalFlow.create()
        change(solver)
        return solver.calc(reference, _grey_levels(frame), None)

    return np.stack([flow for _, flow in map_ahead(solve, motion.frames, THREADS)])


def _grey_levels(image: FloatArray) -> np.ndarray:
    levels = 128 + 32 * normalise_contrast(image, FlowParams().contrast_window, FlowParams().contrast_floor)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def _hurry(solver: cv2.optflow.DualTVL1OpticalFlow) -> None:
    solver.setWarpingsNumber(3)
    solver.setOuterIterations(2)
    solver.setInnerIterations(10)
    solver.setMedianFiltering(1)


def _textured_half(reference: FloatArray) -> np.ndarray:
    slopes = [cv2.Sobel(reference, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))]
    energy = cv2.GaussianBlur(slopes[0] ** 2 + slopes[1] ** 2, (0, 0), 3.0)
    return energy >= np.median(energy)


if __name__ == "__main__":
    sys.exit(publish_printed(HEAD, main))
