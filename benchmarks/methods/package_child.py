"""Run one package of others on frames; the interpreter of their own environment runs this file.

    python package_child.py NAME FRAMES.npy IMAGE.npy

reads frames of shape (T, H, W) or (T, H, W, 3), 0 to 1, writes the image or the frames that are made of them, and
prints what the process has used.  Other files go beside the image.
"""

import builtins
import itertools
import json
import os
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from usage import peak_megabytes, processor_seconds

# Of 30 to 120 frames the tenth that the stacker takes by itself is too few: on crops of synthetic clips half of them
# give more than a quarter and more than all.  Everything else is as the program has it.
STACKED_PERCENT = 50
# The network sees windows of so many frames, and tiles whose sides are multiples of STEP; larger ones take more memory.
WINDOW, STEP, LEAST, LARGEST, OVERLAP = 10, 16, 128, 256, 16


def planetary_system_stacker(frames: np.ndarray, folder: Path, deliver: Callable[[np.ndarray], None]) -> None:
    """Stack the best frames around every alignment point, as the command line of the program does."""
    import cv2

    source = folder / "frames"
    source.mkdir()
    for number, frame in enumerate(frames):
        pixels = np.rint(255 * np.clip(frame, 0, 1)).astype(np.uint8)
        cv2.imwrite(str(source / f"{number:05d}.png"), pixels[..., ::-1] if pixels.ndim == 3 else pixels)

    def read(code: int) -> None:
        written = cv2.imread(str(folder / "frames_pss.png"), cv2.IMREAD_UNCHANGED)
        if written is None:
            print(f"PlanetarySystemStacker wrote no image, exit status {code}", file=sys.stderr, flush=True)
            os._exit(1)
        image = written / np.float32(np.iinfo(written.dtype).max)
        if image.ndim == 3:
            image = image[..., ::-1] if frames.ndim == 4 else image.mean(axis=-1)
        deliver(image)

    # The program ends itself by this name in the middle of an event of Qt.
    vars(builtins)["quit"] = read
    os.environ["QT_QPA_PLATFORM"] = "offscreen"
    sys.argv = ["pss", str(source), "--stack_percent", str(STACKED_PERCENT)]
    from planetary_system_stacker.planetary_system_stacker import main

    main()


def pystackreg(frames: np.ndarray, folder: Path, deliver: Callable[[np.ndarray], None]) -> None:
    """Mean of the frames after a bilinear registration of each to the temporal mean."""
    from pystackreg import StackReg

    grey = frames if frames.ndim == 3 else frames.mean(axis=-1)
    register = StackReg(StackReg.BILINEAR)
    matrices = register.register_stack(grey.astype(np.float64), reference="mean")
    channels = [frames] if frames.ndim == 3 else [frames[..., c] for c in range(frames.shape[3])]
    means = [register.transform_stack(channel.astype(np.float64), tmats=matrices).mean(axis=0) for channel in channels]
    deliver(means[0] if frames.ndim == 3 else np.stack(means, axis=-1))


def tmt_detilting(frames: np.ndarray, folder: Path, deliver: Callable[[np.ndarray], None]) -> None:
    """Frames without their motion, by the first network of Turbulence Mitigation Transformer, with bicubic warping."""
    import onnxruntime

    (archive,) = Path(sys.prefix).glob("vs_undistort-*.whl")
    with zipfile.ZipFile(archive) as packed:
        weights = packed.read("vs_undistort/models/UNet3d_TMT_cub_op19_fp16.onnx")
    options = onnxruntime.SessionOptions()
    options.enable_cpu_mem_arena = False
    network = onnxruntime.InferenceSession(weights, options, providers=["CPUExecutionProvider"])
    colour = frames if frames.ndim == 4 else np.repeat(frames[..., None], 3, axis=-1)
    made = np.empty(colour.shape, np.float32)
    sizes, overlaps = (WINDOW, LARGEST, LARGEST), (0, OVERLAP, OVERLAP)
    for first, top, left in itertools.product(*map(starts, colour.shape[:3], sizes, overlaps)):
        part = colour[first : first + WINDOW, top : top + LARGEST, left : left + LARGEST]
        there = part.shape
        added = [max(LEAST, -(-side // STEP) * STEP) - side for side in there[1:3]]
        part = np.pad(part, ((0, 0), (0, added[0]), (0, added[1]), (0, 0)), mode="edge")
        # Time and colour share the axis of channels: red, green and blue of the first frame, then of the second.
        planes = np.clip(part, 0, 1).transpose(0, 3, 1, 2).reshape(1, -1, *part.shape[1:3]).astype(np.float16)
        found = network.run(None, {"input": planes})[0].reshape(there[0], 3, *part.shape[1:3])
        # Of what two tiles share, each gives its half.
        y, x = (OVERLAP // 2 if begin else 0 for begin in (top, left))
        inner = found[:, :, y : there[1], x : there[2]].transpose(0, 2, 3, 1)
        made[first : first + WINDOW, top + y : top + there[1], left + x : left + there[2]] = inner
    deliver(made if frames.ndim == 4 else made.mean(axis=-1))


def starts(length: int, part: int, overlap: int) -> list[int]:
    """First samples of parts of one length that cover an axis and share at least ``overlap`` samples."""
    if length <= part:
        return [0]
    count = -(-(length - overlap) // (part - overlap))
    return [int(begin) for begin in np.rint(np.linspace(0, length - part, count))]


PACKAGES = {
    "PlanetarySystemStacker": planetary_system_stacker,
    "pystackreg": pystackreg,
    "TMT de-tilting": tmt_detilting,
}


def run() -> None:
    """Read, restore, write, report."""
    name, source, target = sys.argv[1:]

    def deliver(image: np.ndarray) -> None:
        np.save(target, image.astype(np.float32))
        # What packages print comes before it.
        print("\n" + json.dumps({"seconds": processor_seconds(), "peak": peak_megabytes()}), flush=True)
        os._exit(0)

    PACKAGES[name](np.load(source), Path(target).parent, deliver)


if __name__ == "__main__":
    run()
