"""``turbrestore synthesize``: a turbulent video, and the truth beside it."""

from __future__ import annotations

import dataclasses
import json as json_format
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from turbrestore import __version__
from turbrestore.arrays import FloatArray
from turbrestore.errors import ConfigurationError, require
from turbrestore.images import check_output, read_image, write_image
from turbrestore.pipeline import training_share
from turbrestore.synthesis.anisoplanatic import diffraction_limited, phase_screen_frames
from turbrestore.synthesis.atmosphere import STRENGTHS, PhaseScreenParams
from turbrestore.synthesis.dynamic_texture import DynamicTextureParams, synthesize_like
from turbrestore.synthesis.exposure import exposed_frame, flows_between
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.sequence import CameraParams, SyntheticFrame, check_scene, record
from turbrestore.video import VIDEO_OUTPUT_SUFFIXES, open_frames, write_video

from .options import Flag
from .output import print_json
from .progress import say

# What is written beside the video, by the end of its name.
TRUTH, DIFFRACTION, FLOW, PARAMETERS = ".truth.png", ".truth_diffraction.png", ".flow.npy", ".json"
CENTROID = "centroid"
SIGN = "before blur truth(x, y) = frame(x + dx, y + dy), pixels; mean over the exposure"


@dataclass(frozen=True, eq=False)
class Synthesis:
    """What is to be written: the truths, the frames to come, and what they were made with."""

    truth: FloatArray
    diffraction: FloatArray | None
    frames: Iterator[SyntheticFrame]
    record: dict[str, Any]


def synthesize(
    scene: str,
    output: Path,
    /,
    *,
    model: Literal["phase-screen", "dynamic-texture"] = "phase-screen",
    frames: int = 120,
    seed: int = 0,
    size: str | None = None,
    strength: Literal["weak", "medium", "strong"] | None = None,
    like: Path | None = None,
    train: int | None = None,
    overwrite: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
    camera: Annotated[CameraParams, Parameter(name="*")] = CameraParams(),
    path: Annotated[PhaseScreenParams, Parameter(name="*", negative_iterable="")] = PhaseScreenParams(),
    dynamic_texture: DynamicTextureParams = DynamicTextureParams(),
) -> None:
    """Make a turbulent video of a scene, with the truth, the true flow and all parameters beside it.

    Beside clip.mkv lie clip.truth.png, clip.flow.npy, clip.json and, for phase screens, clip.truth_diffraction.png.

    Parameters
    ----------
    scene : str
        Image file, or the name of a drawn scene: chart and others; ``centroid`` stands for that of ``--like``.
    output : Path
        Video to write: .mkv, .mp4, .ser, .tif or .npy.
    model : {"phase-screen", "dynamic-texture"}
        Light through layers of turbulence, or motion learned from a clip (of which the path plays no part).
    frames : int
        Number of frames.
    seed : int
        Of the random numbers; the same seed gives the same frames.
    size : str
        Height and width of a drawn scene, as ``256x256``, the default.
    strength : {"weak", "medium", "strong"}
        D/r0 of 1.2, 2.5 or 5, in place of ``--d-over-r0``, ``--r0`` or ``--cn2``.
    like : Path
        Video whose motion the dynamic texture continues.
    train : int
        Frames of it to learn from, from the first on; by default as many as a restoration would take.
    overwrite : bool
        Replace existing outputs.
    json : bool
        Print all parameters, as JSON, on standard output.
    quiet : bool
        No remarks.
    camera : CameraParams
        Timing and noise.
    path : PhaseScreenParams
        Path and optics of the phase screens.
    dynamic_texture : DynamicTextureParams
        Settings of the dynamic texture.
    """
    require(frames >= 1, f"--frames: expected at least 1, found {frames}")
    require(seed >= 0, f"--seed: expected a whole number from 0, found {seed}")
    inputs = [item for item in (None if scene in (*SCENES, CENTROID) else Path(scene), like) if item is not None]
    outputs = _outputs(output, model == "phase-screen")
    for name, suffixes in zip(outputs, (VIDEO_OUTPUT_SUFFIXES, *[None] * len(outputs)), strict=False):
        check_output(name, inputs, overwrite, suffixes)
    rng = np.random.default_rng(seed)
    if model == "phase-screen":
        require(like is None and train is None, "--like, --train: have no effect on phase screens; leave them out")
        made = _through_screens(_scene(scene, size), frames, rng, _with_strength(path, strength), camera)
    else:
        require(strength is None, "--strength: has no effect with --model dynamic-texture; leave it out")
        require(path == PhaseScreenParams(), "--model dynamic-texture: knows no path and no optics; leave them out")
        if like is None:
            raise ConfigurationError("--like: expected a video for --model dynamic-texture to learn from")
        source = open_frames(like)
        training = source.read(0, training_share(len(source), source.shape[1:], train))
        truth = None if scene == CENTROID else _scene(scene, size)
        made = _like_a_clip(training, truth, frames, rng, dynamic_texture, camera)
    facts: dict[str, Any] = {
        "turbrestore": __version__,
        "scene": scene,
        "model": model,
        "like": None if like is None else str(like),
        "seed": seed,
        "frames": frames,
        "size": [made.truth.shape[1], made.truth.shape[0]],
        "flow": SIGN,
        "camera": _record(camera),
    }
    flow_rms = _write(output, outputs, made, frames, camera, {**facts, **made.record}, overwrite)
    if json:
        print_json({**facts, **made.record, "flow_rms": flow_rms, "output": str(output)})
    else:
        say(f"{output}: {frames} frames, flow of {flow_rms[0]:.2f} and {flow_rms[1]:.2f} pixels along x and y", quiet)


def _outputs(output: Path, has_diffraction: bool) -> list[Path]:
    endings = (TRUTH, *([DIFFRACTION] if has_diffraction else []), FLOW, PARAMETERS)
    return [output, *(output.with_name(output.stem + ending) for ending in endings)]


def _scene(scene: str, size: str | None) -> FloatArray:
    if scene not in SCENES:
        require(scene != CENTROID, "centroid: needs --model dynamic-texture and --like")
        require(size is None, "--size: has no effect on an image file; leave it out")
        if not Path(scene).suffix:
            raise ConfigurationError(f"{scene}: expected an image file or one of {', '.join(sorted(SCENES))}")
        return check_scene(read_image(scene).image)
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", "256x256" if size is None else size)
    if found is None:
        raise ConfigurationError(f"--size: expected height and width as 256x256, found {size!r}")
    return check_scene(SCENES[scene](int(found[1]), int(found[2])))


def _with_strength(path: PhaseScreenParams, strength: str | None) -> PhaseScreenParams:
    if strength is None:
        return path
    given = [name for name in ("cn2", "r0", "d_over_r0") if getattr(path, name) is not None]
    require(not given, f"--strength: contradicts {', '.join(given)}; leave one of them out")
    return dataclasses.replace(path, d_over_r0=STRENGTHS[strength])


def _through_screens(
    scene: FloatArray, count: int, rng: np.random.Generator, path: PhaseScreenParams, camera: CameraParams
) -> Synthesis:
    derived = {
        "r0": path.fried,
        "d_over_r0": path.strength,
        "ifov": path.pixel_angle,
        "expected_flow_rms": path.tilt_rms(),
        "layers": [dataclasses.asdict(layer) for layer in path.path()],
    }
    frames = phase_screen_frames(scene, count, rng, path, camera)
    facts = {"path": dataclasses.asdict(path), "derived": derived}
    return Synthesis(scene, diffraction_limited(scene, path), iter(frames), facts)


def _like_a_clip(
    training: FloatArray,
    scene: FloatArray | None,
    count: int,
    rng: np.random.Generator,
    params: DynamicTextureParams,
    camera: CameraParams,
) -> Synthesis:
    # One flow more than frames: the last exposure ends on it.
    texture = synthesize_like(training, count + 1, rng, params, scene)
    seeds = rng.integers(2**63, size=(count, 2))

    def frames() -> Iterator[SyntheticFrame]:
        pairs = flows_between(texture.flows, camera.sub_frame_shares())
        for number, flows in zip(seeds, pairs, strict=True):
            image, flow = exposed_frame(texture.scene, flows)
            yield SyntheticFrame(record(image, camera, np.random.default_rng(number)), flow)

    derived = {"states": texture.dynamics.rank, "largest_eigenvalue": float(abs(texture.eigenvalues).max(initial=0.0))}
    facts = {"train": len(training), "dynamic_texture": dataclasses.asdict(params), "derived": derived}
    return Synthesis(check_scene(np.clip(texture.scene, 0, 1)), None, frames(), facts)


def _write(
    output: Path,
    outputs: list[Path],
    made: Synthesis,
    count: int,
    camera: CameraParams,
    facts: dict[str, Any],
    overwrite: bool,
) -> list[float]:
    """Write everything into a hidden folder first, so that a failure leaves nothing; root mean square of the flow."""
    with tempfile.TemporaryDirectory(prefix=".synthesis-", dir=output.parent) as folder:
        video, *_ = staged = [Path(folder) / name.name for name in outputs]
        beside = {ending: name for name in staged for ending in (TRUTH, FLOW) if name.name.endswith(ending)}
        squares = np.zeros(2)
        with beside[FLOW].open("wb") as file:
            shape = (count, *made.truth.shape[:2], 2)
            header = {"descr": np.lib.format.dtype_to_descr(np.dtype("<f4")), "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(file, header)

            def images() -> Iterator[FloatArray]:
                for frame in made.frames:
                    file.write(frame.flow.astype("<f4").tobytes())
                    squares[:] += np.mean(np.square(frame.flow, dtype=np.float64), axis=(0, 1))
                    yield frame.image

            write_video(video, images(), camera.frame_rate, camera.bit_depth)
        rms = [float(value) for value in np.sqrt(squares / count)]
        write_image(beside[TRUTH], made.truth, bit_depth=16)
        if made.diffraction is not None:
            write_image(Path(folder) / (output.stem + DIFFRACTION), made.diffraction, bit_depth=16)
        text = json_format.dumps({**facts, "flow_rms": rms}, indent=2, allow_nan=False)
        (Path(folder) / (output.stem + PARAMETERS)).write_text(text + "\n", "utf-8")
        for name, target in zip(staged, outputs, strict=True):
            name.replace(target)
    if overwrite and made.diffraction is None:
        # What an earlier run left would not belong to this one.
        output.with_name(output.stem + DIFFRACTION).unlink(missing_ok=True)
    return rms


def _record(camera: CameraParams) -> dict[str, Any]:
    """Parameters as JSON can hold them: no limit of photons is null."""
    values = dataclasses.asdict(camera)
    return {**values, "photons": values["photons"] if np.isfinite(values["photons"]) else None}
