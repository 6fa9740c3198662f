"""Training of the estimator of the blur on simulated clips.

``python benchmarks/blur_training.py make FOLDER FIRST LAST`` restores the clips of the seeds FIRST to LAST − 1
(:mod:`blur_simulators`) up to the point where their blur is looked for, and keeps for each what the estimator then
knows and the true transfer function.  Clips that are there are kept, so it goes on where it stopped.
"""

from __future__ import annotations

import argparse
import pickle
import sys
import time
from pathlib import Path
from unittest.mock import patch

import numpy as np
from blur_calibration import registered, transfer_function
from blur_simulators import SimulatedClip, simulate

from turbrestore import TurbrestoreError, evidence, pipeline
from turbrestore.blind import remove_blur
from turbrestore.blur.posterior import measure_witnesses
from turbrestore.blur.witnesses.hypotheses import shapes
from turbrestore.core.arrays import FloatArray
from turbrestore.runtime.runtime import Runtime

# Distances, pixels, over which differences of the displacement are kept.
DISTANCES = (2, 4, 8, 16, 32, 64)


class _ReachedError(Exception):
    """Ends a restoration where the blur has been found."""


def main() -> int:
    """Make clips, or train and judge an estimator."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("make",))
    parser.add_argument("folder", type=Path)
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    given = parser.parse_args()
    given.folder.mkdir(exist_ok=True)
    for seed in range(given.first, given.last):
        path = given.folder / f"{seed}.pkl"
        if not path.exists():
            begun = time.perf_counter()
            clip = simulate(seed)
            found = witnesses_of(clip)
            path.write_bytes(pickle.dumps({"seed": seed, "simulator": clip.simulator, "scene": clip.scene, **found}))
            seconds = time.perf_counter() - begun
            print(seed, clip.simulator, clip.scene, clip.frames.shape, f"{seconds:.1f} s", flush=True)
    return 0


def witnesses_of(clip: SimulatedClip) -> dict[str, object]:
    """Restore a clip up to its blur: what is known there, and the transfer function that is to be found."""
    known: dict[str, object] = {"frames": len(clip.frames)}

    def spy_levels(*given: object) -> object:
        prepared = prepare(*given)
        known["levels"] = prepared.levels
        return prepared

    def spy_frames(frames: FloatArray, flows: FloatArray, mean: FloatArray, before: object) -> object:
        known["structure"] = structure_of(flows)
        known["mean"] = mean.astype(np.float16)
        known["unregistered"] = frames.mean(axis=0).astype(np.float16)
        return measure_witnesses(frames, flows, mean, before)

    def spy_image(image: FloatArray, *given: object) -> object:
        with patch.object(remove_blur, "image_evidence", spy_costs):
            known["posterior"] = find_blur(image, *given)[1]
        known["witnesses"], known["image"] = given[-1], image
        raise _ReachedError

    def spy_costs(*given: object) -> object:
        known["evidence"] = image_evidence(*given)
        return known["evidence"]

    prepare, find_blur, image_evidence = pipeline.prepare, remove_blur.find_blur, remove_blur.image_evidence
    try:
        with (
            patch.object(pipeline, "prepare", spy_levels),
            patch.object(evidence, "measure_witnesses", spy_frames),
            patch.object(remove_blur, "find_blur", spy_image),
        ):
            pipeline.restore(clip.frames, runtime=Runtime(threads=1))
    except _ReachedError:
        pass
    except TurbrestoreError as error:
        return {"refused": str(error)}
    if "image" not in known:
        return {"refused": "no blur is looked for"}
    image = known["image"]
    truth = registered(known["levels"].stretched(clip.truth), image)
    transfer = transfer_function(image, truth)
    (width,), (exponent,) = shapes(transfer[None])
    kept = {"image": image.astype(np.float16), "truth": truth.astype(np.float16)}
    return {**known, **kept, "transfer": transfer, "width": float(width), "exponent": float(exponent)}


def structure_of(flows: FloatArray) -> FloatArray:
    """Mean square of the difference of the displacement, less its mean, over some distances; (distances, 2)."""
    wandering = flows - flows.mean(axis=0)
    values = np.full((len(DISTANCES), 2), np.nan)
    for row, distance in enumerate(DISTANCES):
        if 2 * distance < min(flows.shape[1:3]):
            apart = wandering[:, :, distance::4] - wandering[:, :, :-distance:4]
            values[row] = np.square(apart).mean(axis=(0, 1, 2))
    return values


if __name__ == "__main__":
    sys.exit(main())
