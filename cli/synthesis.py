"""``turbrestore synthesize``: a turbulent video with its truth."""

from __future__ import annotations

import dataclasses
import json as json_format
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from turbrestore import __version__
from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import ConfigurationError, OutputError, require, require_between
from turbrestore.core.remarks import counted
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.limits import Limits
from turbrestore.io.output import check_output, check_space
from turbrestore.io.video import VIDEO_OUTPUT_SUFFIXES, open_frames, write_video
from turbrestore.memory_plan import training_share
from turbrestore.runtime.steps import Progress, step_counter
from turbrestore.synthesis.anisoplanatic import diffraction_limited, phase_screen_frames
from turbrestore.synthesis.atmosphere import STRENGTHS, PhaseScreenParams
from turbrestore.synthesis.drawn_scenes import DRAWN
from turbrestore.synthesis.dynamic_texture import DynamicTextureParams, synthesize_like
from turbrestore.synthesis.moving_objects import MovingObject, draw_objects, with_objects
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.sequence import (
    CameraParams,
    SyntheticFrame,
    check_scene,
    exposed_frame,
    flows_between,
    record,
)

from .options import Flag, limits_of
from .output import print_json
from .progress import progress_bars, say

# Endings of the names of the files written beside the video.
VIDEO, TRUTH, DIFFRACTION, FLOW, PARAMETERS = "", ".truth.png", ".truth_diffraction.png", ".flow.npy", ".json"
# Written with moving objects only.
FRAMES_TRUTH, MASK = ".truth.mkv", ".mask.mkv"
CENTROID = "centroid"
INCLUDED = {**SCENES, **DRAWN}
MOST_FRAMES = 1_000_000
SIGN = "before blur truth(x, y) = frame(x + dx, y + dy), pixels; mean over the exposure"


@dataclass(frozen=True, eq=False)
class Synthesis:
    """Content of the output: the truths, the frames and their number, the objects, and the parameters."""

    truth: FloatArray
    diffraction: FloatArray | None
    frames: Iterator[SyntheticFrame]
    count: int
    record: dict[str, Any]
    objects: tuple[MovingObject, ...] = ()


def synthesize(
    scene: str,
    output: Path,
    /,
    *,
    model: Literal["phase-screen", "dynamic-texture"] = "phase-screen",
    frames: int = 120,
    seed: int = 0,
    size: str | None = None,
    moving: int = 0,
    strength: Literal["weak", "medium", "strong"] | None = None,
    like: Path | None = None,
    train: int | None = None,
    max_pixels: int | None = None,
    overwrite: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
    camera: Annotated[CameraParams, Parameter(name="*")] = CameraParams(),
    path: Annotated[PhaseScreenParams, Parameter(name="*", negative_iterable="")] = PhaseScreenParams(),
    dynamic_texture: DynamicTextureParams = DynamicTextureParams(),
) -> None:
    """Make a turbulent video of a scene, with the truth, the true flow and all parameters beside it.

    Beside clip.mkv lie clip.truth.png, clip.flow.npy, clip.json and, for phase screens, clip.truth_diffraction.png.
    With moving objects, clip.truth.mkv has the truth of every frame, and clip.mask.mkv shows where the objects are.

    Parameters
    ----------
    scene : str
        Image file, or name of an included scene.  These are chart, words, street, sign, plate, planet, camera, brick,
        grass, gravel, coins, moon, page, astronaut, cat, coffee, rocket; or ``centroid``, the clean image of the
        video that ``--like`` names.
    output : Path
        Video to write: .mkv, .mp4, .ser, .tif or .npy.
    model : {"phase-screen", "dynamic-texture"}
        Light through layers of turbulence, or motion learned from a clip, on which the path has no effect.
    frames : int
        Number of frames.
    seed : int
        Seed of the random numbers; the same seed gives the same bytes.
    size : str
        Width and height of an included scene, as ``256x256``, the default.
    moving : int
        Number of objects that move on straight paths in front of the scene, behind the air of phase screens.
    strength : {"weak", "medium", "strong"}
        D/r0 of 1.2, 2.5 or 5, in place of ``--d-over-r0``, ``--r0`` or ``--cn2``.
    like : Path
        Video whose motion the dynamic texture continues.
    train : int
        Number of its first frames to learn from; by default as many as a restoration would use.
    max_pixels : int
        Largest scene, and frame of --like, pixels; by default 67 million.
    overwrite : bool
        Replace existing outputs.
    json : bool
        Print all parameters, as JSON, on standard output.
    quiet : bool
        No progress and no remarks.
    camera : CameraParams
        Timing and noise.
    path : PhaseScreenParams
        Path and optics of the phase screens.
    dynamic_texture : DynamicTextureParams
        Settings of the dynamic texture.
    """
    require_between("--frames", frames, 1, MOST_FRAMES)
    limits = limits_of(max_pixels)
    require(seed >= 0, f"--seed: expected a whole number from 0, found {seed}")
    inputs = [item for item in (None if scene in (*INCLUDED, CENTROID) else Path(scene), like) if item is not None]
    check_output(output, inputs, overwrite, VIDEO_OUTPUT_SUFFIXES)
    outputs = _outputs(output, model == "phase-screen", moving > 0)
    for name in outputs.values():
        check_output(name, inputs, overwrite, suffixes=None)
    rng = np.random.default_rng(seed)
    stages = {"synthesize": 1.0} if model == "phase-screen" else {"centroid": 1.0, "synthesize": 1.0}
    with progress_bars(quiet, stages) as progress:
        if model == "phase-screen":
            require(like is None and train is None, "--like, --train: have no effect on phase screens; leave them out")
            idle = dynamic_texture == DynamicTextureParams()
            require(idle, "--dynamic-texture: has no effect on phase screens; leave it out")
            truth = _scene(scene, size, limits)
            # Their generator is another one, so that the air is that of a clip without objects.
            objects = draw_objects(moving, truth.shape, np.random.default_rng([seed, 1]))
            made = _through_screens(truth, frames, rng, _with_strength(path, strength), camera, objects)
        else:
            require(moving == 0, "--moving: has no effect with --model dynamic-texture; leave it out")
            require(strength is None, "--strength: has no effect with --model dynamic-texture; leave it out")
            require(
                path == PhaseScreenParams(),
                "--model dynamic-texture: has no path and no optics; leave their options out",
            )
            given = None if scene == CENTROID and size is None else _scene(scene, size, limits)
            made = _like_a_clip(
                _training_frames(like, train, limits), given, frames, rng, dynamic_texture, camera, progress
            )
        request = {"scene": scene, "model": model, "like": None if like is None else str(like), "seed": seed}
        facts = _write(outputs, made, camera, request, step_counter(progress, "synthesize", frames))
    if overwrite:
        # Files of an earlier run would not belong to this one.
        for ending in {DIFFRACTION, FRAMES_TRUTH, MASK} - set(outputs):
            output.with_name(output.stem + ending).unlink(missing_ok=True)
    if json:
        print_json({**facts, "output": str(output)})
    else:
        along_x, along_y = facts["flow_rms"]
        moved = f"displaced by {along_x:.2f} and {along_y:.2f} pixels along x and y (rms)"
        say(f"{output}: {counted(frames, 'frame')}, {moved}", quiet)


def _outputs(output: Path, has_diffraction: bool, has_objects: bool) -> dict[str, Path]:
    """Files to write by the endings of their names; that of the video is empty."""
    optional = ([DIFFRACTION] if has_diffraction else []) + ([FRAMES_TRUTH, MASK] if has_objects else [])
    endings = (TRUTH, *optional, FLOW, PARAMETERS)
    return {VIDEO: output, **{ending: output.with_name(output.stem + ending) for ending in endings}}


def _scene(scene: str, size: str | None, limits: Limits) -> FloatArray:
    if scene not in INCLUDED:
        require(size is None, f"--size: has no effect on {scene}, which has a size; leave it out")
        require(scene != CENTROID, "centroid: needs --model dynamic-texture and --like")
        if not Path(scene).suffix:
            raise ConfigurationError(f"{scene}: expected an image file or one of {', '.join(sorted(INCLUDED))}")
        return read_image(scene, limits).image
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", "256x256" if size is None else size)
    if found is None:
        raise ConfigurationError(f"--size: expected width and height as 256x256, found {size!r}")
    width, height = int(found[1]), int(found[2])
    most = limits.max_pixels
    require(width * height <= most, f"--size: expected at most {most} pixels, found {width}×{height}")
    return INCLUDED[scene](height, width)


def _training_frames(like: Path | None, train: int | None, limits: Limits) -> FloatArray:
    if like is None:
        raise ConfigurationError("--like: expected a video for --model dynamic-texture to learn from")
    # Two flows have no dynamics.
    require(train is None or train >= 3, f"--train: expected 3 frames or more, found {train}")
    source = open_frames(like, limits=limits)
    return source.read(0, training_share(len(source), source.shape[1:], train))


def _with_strength(path: PhaseScreenParams, strength: str | None) -> PhaseScreenParams:
    if strength is None:
        return path
    given = [f"--{name.replace('_', '-')}" for name in ("cn2", "r0", "d_over_r0") if getattr(path, name) is not None]
    require(not given, f"--strength: contradicts {', '.join(given)}; leave one of them out")
    return dataclasses.replace(path, d_over_r0=STRENGTHS[strength])


def _through_screens(
    scene: FloatArray,
    count: int,
    rng: np.random.Generator,
    path: PhaseScreenParams,
    camera: CameraParams,
    objects: tuple[MovingObject, ...],
) -> Synthesis:
    derived = {
        "r0": path.fried,
        "d_over_r0": path.strength,
        "ifov": path.pixel_angle,
        "expected_flow_rms": path.tilt_rms(),
        "layers": [dataclasses.asdict(layer) for layer in path.path()],
    }
    frames = phase_screen_frames(scene, count, rng, path, camera, objects=objects)
    facts: dict[str, Any] = {"path": dataclasses.asdict(path), "derived": derived}
    if objects:
        facts["objects"] = [dataclasses.asdict(item) for item in objects]
    return Synthesis(scene, diffraction_limited(scene, path), frames, count, facts, objects)


def _like_a_clip(
    training: FloatArray,
    scene: FloatArray | None,
    count: int,
    rng: np.random.Generator,
    params: DynamicTextureParams,
    camera: CameraParams,
    progress: Progress | None,
) -> Synthesis:
    measured = step_counter(progress, "centroid", len(training) * params.centroid.iterations)
    # One flow more than frames: the last exposure ends on it.
    texture = synthesize_like(training, count + 1, rng, params, scene, measured)
    seeds = rng.integers(2**63, size=(count, 2))

    def frames() -> Iterator[SyntheticFrame]:
        pairs = flows_between(texture.flows, camera.sub_frame_shares())
        for number, flows in zip(seeds, pairs, strict=True):
            image, flow = exposed_frame(texture.scene, flows)
            yield SyntheticFrame(record(image, camera, np.random.default_rng(number)), flow)

    derived = {"states": texture.dynamics.rank, "largest_eigenvalue": float(abs(texture.eigenvalues).max(initial=0.0))}
    facts = {"train": len(training), "dynamic_texture": dataclasses.asdict(params), "derived": derived}
    return Synthesis(check_scene(np.clip(texture.scene, 0, 1)), None, frames(), count, facts)


def _write(
    outputs: dict[str, Path],
    made: Synthesis,
    camera: CameraParams,
    request: dict[str, Any],
    count: Callable[[object], None],
) -> dict[str, Any]:
    """Write everything into a hidden folder first, so that a failure leaves nothing; return the facts."""
    # Size of the flows; that of the encoded frames is not known beforehand.
    check_space(outputs[VIDEO], 8 * made.count * made.truth.shape[0] * made.truth.shape[1])
    with _hidden_folder(outputs[VIDEO]) as folder:
        staged = {ending: folder / path.name for ending, path in outputs.items()}
        flow_rms = _write_frames(staged[VIDEO], staged[FLOW], made, camera, count)
        write_image(staged[TRUTH], made.truth, bit_depth=16)
        if made.objects:
            shown = [partial(with_objects, made.truth, made.objects, number) for number in range(made.count)]
            write_video(staged[FRAMES_TRUTH], (draw()[0] for draw in shown), camera.frame_rate, 16)
            write_video(staged[MASK], (draw()[1].astype(np.float32) for draw in shown), camera.frame_rate)
        if made.diffraction is not None:
            write_image(staged[DIFFRACTION], made.diffraction, bit_depth=16)
        facts = {
            "turbrestore": __version__,
            **request,
            "frames": made.count,
            "size": [made.truth.shape[1], made.truth.shape[0]],
            "flow": SIGN,
            "camera": _record(camera),
            **made.record,
            "flow_rms": flow_rms,
        }
        staged[PARAMETERS].write_text(json_format.dumps(facts, indent=2, allow_nan=False) + "\n", "utf-8")
        for ending, path in staged.items():
            path.replace(outputs[ending])
    return facts


@contextmanager
def _hidden_folder(output: Path) -> Iterator[Path]:
    """Temporary folder beside an output."""
    try:
        folder = tempfile.TemporaryDirectory(prefix=".synthesis-", dir=output.parent)
    except OSError as error:
        raise OutputError(f"{output}: cannot be created ({error.strerror})") from error
    with folder as name:
        yield Path(name)


def _write_frames(
    video: Path, flow_file: Path, made: Synthesis, camera: CameraParams, count: Callable[[object], None]
) -> list[float]:
    """Write frames and flows as they are generated; return the root mean square of the flow along x and y."""
    squares = np.zeros(2)
    with flow_file.open("wb") as file:
        shape = (made.count, *made.truth.shape[:2], 2)
        header = {"descr": np.lib.format.dtype_to_descr(np.dtype("<f4")), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)

        def images() -> Iterator[FloatArray]:
            for frame in made.frames:
                file.write(frame.flow.astype("<f4").tobytes())
                squares[:] += np.mean(np.square(frame.flow, dtype=np.float64), axis=(0, 1))
                yield frame.image
                count(frame)

        write_video(video, images(), camera.frame_rate, camera.bit_depth)
    return [float(value) for value in np.sqrt(squares / made.count)]


def _record(camera: CameraParams) -> dict[str, Any]:
    """Parameters for JSON, in which an infinite number of photons is null."""
    values = dataclasses.asdict(camera)
    return {**values, "photons": values["photons"] if np.isfinite(values["photons"]) else None}
