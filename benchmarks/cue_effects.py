"""What the cues from blur do to restorations, each switched on by itself, as Markdown tables.

Run ``python benchmarks/cue_effects.py``.  Clips: the simulated ones under the folder that ``TURBRESTORE_DATA`` names,
or synthetic ones without it; ``--clips`` takes names or patterns.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from clips import Clip, data_folder, find_clips

from turbrestore.blind.remove_blur import blur_to_remove
from turbrestore.blur.blur_cues import BlurBounds, bound_blur, displacement_maps, typical_noise
from turbrestore.blur.estimation import BlurEstimate, estimate_blur
from turbrestore.blur.psf import KOLMOGOROV
from turbrestore.blur_moments.cues import RelativeBlur, displacement_variance
from turbrestore.core.arrays import FloatArray
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.dynamics.displacement import with_displacement
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.dynamics.flow_model import FlowDynamics
from turbrestore.filtering.alternating import filter_frames
from turbrestore.memory_plan import training_share
from turbrestore.metrics import compare
from turbrestore.registration.centroid import find_centroid

SETTINGS = DeconvolutionParams()
VARIANTS = ("default", "displacement cue", "blur bounds")


@dataclass(frozen=True, eq=False)
class Effects:
    """Figures of one clip.

    Attributes
    ----------
    before, after : dict of str to float
        PSNR before and after deconvolution for each variant, dB.
    flows, motion : FlowDynamics
        Flow model without and with the displacement cue.
    cue : RelativeBlur
        Displacement variance of the training frames.
    count : int
        Training frames.
    widths : dict of str to float
        Width of the blur that was removed, pixels.
    estimate : BlurEstimate
        Of the image that the default filter makes.
    bounds : BlurBounds
        On the same.
    """

    before: dict[str, float]
    after: dict[str, float]
    flows: FlowDynamics
    motion: FlowDynamics
    cue: RelativeBlur
    count: int
    widths: dict[str, float]
    estimate: BlurEstimate
    bounds: BlurBounds


def measure(clip: Clip) -> Effects:
    """Restore a clip with each cue by itself."""
    frames, truth = clip.frames, clip.truth
    training = frames[: training_share(len(frames), frames.shape[1:])]
    centroid = find_centroid(training)
    flows = identify(centroid.flows)
    cue = displacement_variance(training, typical_noise(training))
    motion = with_displacement(flows, *displacement_maps(training))

    def fuse(dynamics: FlowDynamics) -> FloatArray:
        return filter_frames(frames, centroid.image, dynamics, known_flows=centroid.flows).image

    plain, moved = fuse(flows), fuse(motion)
    images = dict(zip(VARIANTS, (plain, moved, plain), strict=True))
    estimate = estimate_blur(plain, exponent=KOLMOGOROV)
    bounds = bound_blur(plain, frames.mean(axis=0), training, len(frames), KOLMOGOROV)
    after, widths = {}, {}
    for name, image in images.items():
        found = estimate if image is plain else estimate_blur(image, exponent=KOLMOGOROV)
        width, settings = blur_to_remove(found, SETTINGS, bounds if name == "blur bounds" else None)
        result = deconvolve(image, width, settings, guide=centroid.image).image
        after[name], widths[name] = compare(result, truth).psnr, width
    before = {name: compare(image, truth).psnr for name, image in images.items()}
    return Effects(before, after, flows, motion, cue, len(training), widths, estimate, bounds)


def true_variance(name: str, count: int) -> float | None:
    """Displacement variance per axis of the first frames of a clip, squared pixels, where it is stored."""
    folder = data_folder()
    path = Path() if folder is None else folder / "simulated" / name / "true_flow17.npy"
    return float(np.load(path)[:count].var(axis=0, ddof=1).mean()) if path.is_file() else None


def print_effects(found: dict[str, Effects]) -> None:
    """Print PSNR before and after deconvolution."""
    print(f"| clip | {' | '.join(VARIANTS)} |\n|{'---|' * (len(VARIANTS) + 1)}")
    for name, effects in found.items():
        cells = [f"{effects.before[v]:.2f} → {effects.after[v]:.2f}" for v in VARIANTS]
        print(f"| {name} | {' | '.join(cells)} |")
    cells = []
    for variant in VARIANTS:
        before = np.mean([effects.before[variant] for effects in found.values()])
        after = np.mean([effects.after[variant] for effects in found.values()])
        cells.append(f"{before:.2f} → {after:.2f}")
    print(f"| mean | {' | '.join(cells)} |")


def print_displacement(found: dict[str, Effects]) -> None:
    """Print displacement variance by the cue and by the flows, and what the flow model makes of both."""
    columns = ("clip", "true", "flows", "cue", "flows / true", "cue / true", "mean motion factor")
    print(f"\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for name, effects in found.items():
        flows, cue, true = float(effects.flows.flow_variance.mean()), effects.cue, true_variance(name, effects.count)
        shares = ["–"] * 3 if true is None else [f"{true:.3f}", f"{flows / true:.2f}", f"{cue.variance / true:.2f}"]
        factor = float(effects.motion.motion_factor.mean())
        values = f"{flows:.3f} | {cue.variance:.3f} ± {cue.deviation:.3f} | {shares[1]} | {shares[2]} | {factor:.2f}"
        print(f"| {name} | {shares[0]} | {values} |")


def print_bounds(found: dict[str, Effects]) -> None:
    """Print the widths of the blur and their bounds."""
    print("\n| clip | estimated σ | uncertainty | bounds | removed |\n|---|---|---|---|---|")
    for name, effects in found.items():
        estimate, bounds = effects.estimate, effects.bounds
        values = f"{estimate.sigma:.2f} | {estimate.uncertainty:.2f} | {bounds.low:.2f}–{bounds.high:.2f}"
        print(f"| {name} | {values} | {effects.widths['blur bounds']:.2f} |")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    default = ("smooth_*",) if data_folder() is None else ("ao_*", "purdue1_*", "quick_*")
    parser.add_argument("--clips", nargs="*", default=default)
    clips = find_clips(parser.parse_args().clips)
    found = {name: measure(load()) for name, load in clips.items()}
    print_effects(found)
    print_displacement(found)
    print_bounds(found)


if __name__ == "__main__":
    main()
