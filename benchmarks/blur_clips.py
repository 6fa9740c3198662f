"""Clips whose blur is known: behind phase screens, moved by smooth flows behind a lens, and standing still.

Scenes are split: constants of the package were set on CHOSEN, and REPORTED ones give the tables.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import skimage.data

import turbrestore as tr
from turbrestore.core.arrays import FloatArray
from turbrestore.registration.flow_algebra import invert_flow
from turbrestore.registration.warp import warp
from turbrestore.seeing.strength import measure_seeing
from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.scenes import SCENES
from turbrestore.synthesis.sequence import CameraParams
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows

CHOSEN = ("camera", "coffee", "brick", "moon", "words", "gravel")
REPORTED = ("cat", "page", "astronaut", "coins", "rocket", "grass", "retina", "chart")
# Side of a clip behind phase screens, and height and width of the others.
AIR, LENS = 176, (160, 224)
# Behind a lens: pixels around a clip that flows and lens bring in, side of the whole photograph in pixels of the clip,
# and samples of it along each of them; all chosen.
EDGE, LENS_SIDE, FINER = 24, 320, 2
LENSES, DEFOCUS = (0.0, 0.7, 1.5, 2.5), (0.0, 2.0)


@dataclass(frozen=True)
class Case:
    """One clip: ``kind`` is air, lens or quiet, and ``number`` a draw of the air or the width of the lens."""

    part: str
    scene: str
    kind: str
    number: float

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.part}_{self.scene}_{self.kind}_{self.number:g}"


def cases(part: str) -> Iterator[Case]:
    """Yield the clips of a part, ``c`` (chosen) or ``r`` (reported)."""
    for scene in CHOSEN if part == "c" else REPORTED:
        for kind, numbers in (("air", range(6 if part == "c" else 4)), ("lens", LENSES), ("quiet", DEFOCUS)):
            yield from (Case(part, scene, kind, number) for number in numbers)


def make_clip(case: Case, folder: Path) -> Path:
    """Synthesize and filter a clip, unless its file is there: frames, flows, filtered image, scene and facts."""
    path = folder / f"{case.name}.npz"
    if path.exists():
        return path
    rng = np.random.default_rng(zlib.crc32(case.name.encode()))
    frames, truth = (behind_air if case.kind == "air" else behind_lens)(case, rng)
    frames = np.rint(255 * np.clip(frames, 0, 1)).astype(np.uint8)
    levels = frames.astype(np.float32) / 255
    centroid = tr.find_centroid(levels)
    filtered = tr.filter_frames(levels, centroid.image, tr.identify(centroid.flows), known_flows=centroid.flows)
    found = measure_seeing(levels, centroid.flows, centroid.image, levels.mean(axis=0)).displacement_variance
    np.savez(
        path,
        frames=frames,
        flows=centroid.flows.astype(np.float16),
        filtered=filtered.recentred().image,
        truth=truth,
        seeing=np.array(np.nan if found is None else found.value),
    )
    return path


def behind_air(case: Case, rng: np.random.Generator, codec: bool = True) -> tuple[FloatArray, FloatArray]:
    """Frames behind phase screens of random strength, diffraction, noise, lens and codec, and the mean geometry."""
    params = PhaseScreenParams(d_over_r0=1.0)
    while params.tilt_rms() > 3.2 or params.strength == 1.0:
        strength = float(np.exp(rng.uniform(np.log(0.6), np.log(7))))
        params = PhaseScreenParams(
            d_over_r0=strength, nyquist=rng.uniform(1.2, 4) / 2, wind=(float(rng.uniform(2, 20)),)
        )
    noise, count = float(np.exp(rng.uniform(np.log(0.003), np.log(0.05)))), int(rng.choice([16, 30, 45]))
    lens, quality = float(rng.choice([0, 0, 0, 0.8, 1.3])), int(rng.choice([0, 0, 0, 20, 28]))
    scene = part_of(case.scene, (AIR, AIR), rng, AIR if int(case.number) % 2 else 512)
    blurred = cv2.GaussianBlur(scene, (0, 0), lens) if lens else scene
    camera = CameraParams(photons=np.inf, read_noise=noise)
    made = list(phase_screen_frames(blurred, count, rng, params, camera))
    frames = np.stack([frame.image for frame in made])
    mean = np.mean([frame.flow for frame in made], axis=0, dtype=np.float32)
    return h264(frames, quality) if quality and codec else frames, warp(scene, invert_flow(mean))


def behind_lens(case: Case, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Frames of a photograph behind a Gaussian lens, which smooth flows move by 1.3 px or not at all.

    The photograph has more samples than the frames, whose pixels average them: frames interpolated from a picture of
    their own resolution would lack detail that a camera records, which a method that sharpens would seem to restore.
    Where the photograph is smaller than that (page, coins), the scene itself is soft.
    """
    height, width = LENS
    count, noise = (30, 0.008) if case.kind == "lens" else (24, 0.004)
    size = FINER * (height + 2 * EDGE), FINER * (width + 2 * EDGE)
    scene = part_of(case.scene, size, rng, FINER * LENS_SIDE)
    params = SmoothFlowParams(rms=FINER * 1.5, correlation_length=FINER * 12.0)
    still = np.zeros((count, *size, 2), np.float32)
    flows = smooth_flows(count, *size, rng, params) if case.kind == "lens" else still
    # The flows from the scene to the frames are zero on average: the scene lies at the mean geometry, which is all that
    # the frames can tell.
    flows -= flows.mean(axis=0)
    frames = []
    for flow in flows:
        frame = warp(scene, invert_flow(flow))
        frame = cv2.GaussianBlur(frame, (0, 0), FINER * case.number) if case.number else frame
        frames.append(_inner(_pixels(frame)) + noise * rng.standard_normal((height, width)))
    return np.array(frames, np.float32), _inner(_pixels(scene)).copy()


def _pixels(fine: FloatArray) -> FloatArray:
    """Means over squares of an image."""
    height, width = fine.shape
    return cv2.resize(fine, (width // FINER, height // FINER), interpolation=cv2.INTER_AREA)


def _inner(image: FloatArray) -> FloatArray:
    return image[EDGE:-EDGE, EDGE:-EDGE]


def part_of(name: str, size: tuple[int, int], rng: np.random.Generator, side: int) -> FloatArray:
    """Grey picture of this side, or a random part of it of this size, with a contrast that can be seen."""
    if name in ("words", "chart"):
        image = SCENES[name](400, 400)
    elif name == "retina":
        image = cv2.imread(str(Path(skimage.data.__file__).parent / "retina.jpg"), cv2.IMREAD_GRAYSCALE) / 255
    else:
        image = getattr(skimage.data, name)() / 255
        image = image if image.ndim == 2 else cv2.cvtColor(np.float32(image), cv2.COLOR_RGB2GRAY)
    least = min(image.shape)
    top, left = ((length - least) // 2 for length in image.shape)
    square = cv2.resize(
        np.float32(image[top : top + least, left : left + least]), (side, side), interpolation=cv2.INTER_AREA
    )
    y, x = (int(rng.integers(0, side - length + 1)) for length in size)
    found = np.clip(square[y : y + size[0], x : x + size[1]], 0, 1)
    contrast = float(found.std())
    return found if contrast > 0.03 else np.clip((found - found.mean()) * 0.06 / contrast + 0.5, 0, 1)


def h264(frames: FloatArray, quality: int) -> FloatArray:
    """Frames after H.264 at a constant rate factor."""
    import av

    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=25, options={"crf": str(quality)})
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], "yuv420p"
        for frame in np.rint(255 * np.clip(frames, 0, 1)).astype(np.uint8):
            picture = av.VideoFrame.from_ndarray(frame, format="gray").reformat(format="yuv420p")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    buffer.seek(0)
    with av.open(buffer) as container:
        decoded = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    return np.stack(decoded).astype(np.float32) / 255
