"""The geometry of a restoration, taken from another clip: from its result, or from the flows of its frames.

Symbols
-------
q : centroid of the training frames; W_k : flow from q to frame I_k, pixels
F : alignment of q to the reference, ``q ∘ (id + F)`` lies on it, see :mod:`turbrestore.stacking.alignment`

Onto a reference, flows become ``W_k ∘ (id + F) + F`` and the centroid the mean of the frames that they register, so
that a frame is still interpolated once.  A second recording of the same instants takes the W_k as they are: nothing is
measured from its frames.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from .core.arrays import FloatArray, check_flow
from .core.decision import Decision
from .core.errors import DataError
from .filtering.alternating import Filtered
from .io.images.image_files import read_image
from .io.npy import read_npz
from .io.source import FrameSource
from .registration.centroid import Centroid, mean_registered
from .registration.flow_algebra import compose_flows
from .registration.recentring import recentring_flow
from .runs.stage_files import load_artifact
from .runtime.runtime import Runtime
from .runtime.scratch import fill_frames, iter_frames, new_stack
from .settings import RestoreParams
from .stacking.alignment import align_to


def settings_of_known_flows(params: RestoreParams, count: int) -> RestoreParams:
    """Let every frame train, and the filter measure no flow, where flows are known."""
    if params.like is None:
        return params
    return replace(params, train=count, filter=replace(params.filter, inner_iterations=1))


def onto_reference(
    centroid: Centroid, frames: FloatArray, reference: str, runtime: Runtime
) -> tuple[Centroid, Decision]:
    """Move a centroid and its flows into the geometry of an image file or of a kept run.

    ``frames`` (T, H, W) or (T, H, W, 3).
    """
    image = _read_reference(Path(reference))
    if image.shape[:2] != centroid.image.shape[:2]:
        height, width = centroid.image.shape[:2]
        raise DataError(
            f"reference: expected an image of {width}×{height} pixels as the frames have, found "
            f"{image.shape[1]}×{image.shape[0]}; turbrestore align takes results of any size"
        )
    found = align_to(centroid.image, image)
    flows = new_stack(centroid.flows.shape, runtime.scratch)
    for _ in fill_frames(flows, (compose_flows(flow, found.flow) for flow in iter_frames(centroid.flows))):
        pass
    choice = (
        f"that of the reference: shifted by {found.shift[0]:.2f}, {found.shift[1]:.2f} pixels, turned by "
        f"{found.rotation:.2f}°, scaled by {found.scale:.4f}"
    )
    reason = f"aligned to {reference} with a likeness of {found.likeness:.2f}; {found.residual:.2f} pixels were bent"
    return replace(centroid, image=mean_registered(frames, flows, runtime), flows=flows), Decision(
        "reference", choice, reason
    )


def centroid_of_known_flows(frames: FloatArray, source: FrameSource, like: str, runtime: Runtime) -> Centroid:
    """Mean of the frames that the flows of another recording register.

    ``frames`` (T, H, W) or (T, H, W, 3).
    """
    flows = _read_flows(Path(like), source)
    return Centroid(mean_registered(frames, flows, runtime), flows, np.zeros(1), converged=True)


def _read_reference(path: Path) -> FloatArray:
    """Image of a file, or the filtered image of a kept run, which is as sharp as a centroid."""
    if not path.is_dir():
        return read_image(path).image
    if (path / "filtered.npz").is_file():
        return load_artifact(path / "filtered.npz", Filtered).image
    return load_artifact(path / "centroid.npz", Centroid).image


def _read_flows(path: Path, source: FrameSource) -> FloatArray:
    """Flows from the result of another recording to all of its frames."""
    expected = (*source.shape[:3], 2)
    if path.is_dir():
        flows = load_artifact(path / "centroid.npz", Centroid).flows
        filtered = load_artifact(path / "filtered.npz", Filtered) if (path / "filtered.npz").is_file() else None
        if len(flows) < len(source):
            raise DataError(
                f"{path}: expected a run that trained on all of its {len(source)} frames, found flows of {len(flows)}; "
                f"turbrestore register CLIP OUT --keep {path} --resume --flows FLOWS.npz writes the others"
            )
        if filtered is not None and filtered.mean_flow.any():
            V = recentring_flow(filtered.mean_flow)
            flows = np.stack([compose_flows(flow, V) for flow in flows])
    else:
        arrays = read_npz(path)
        if "flows" not in arrays:
            raise DataError(f"{path}: expected flows that turbrestore register --flows has written, found none")
        flows = check_flow(arrays["flows"], str(path))
        numbers = arrays.get("numbers")
        if numbers is not None and len(numbers) == len(flows):
            # Each camera may have lost other frames.
            places = {int(number): place for place, number in enumerate(numbers)}
            lost = [number for number in source.numbers if number not in places]
            if lost:
                raise DataError(f"{path}: expected the flow to frame {lost[0]} of {source.name}, found none")
            flows = flows[[places[number] for number in source.numbers]]
    if flows.shape != expected:
        raise DataError(f"{path}: expected flows of shape {expected}, found {flows.shape}")
    return flows
