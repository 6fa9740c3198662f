"""Peak memory of whole restorations in processes of their own, and of each stage by itself.

``python benchmarks/memory.py`` prints a table of frames × size × limit and exits with 1 when a bound is broken:
300 grey frames of 1920×1080 within 2 GB, without a limit too, every other limit kept, and 2,000 frames no more than
20 MB above 200.
``--write benchmarks/results/memory.md`` writes the table as a document.
``--quick`` takes 24 frames of that size within the limit, and fewer rows with fewer frames.
``--largest`` adds frames of 3840×2160 and 7680×4320.
``--stages`` prints the peak of every stage and of the deconvolution, in bytes a pixel, which the constants of the
functions ``flow_memory``, ``identify_memory``, ``filter_memory`` and ``deconvolution_memory`` were fitted to.
Memory is the largest resident set, mapped files included.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from provenance import with_origin
from revisions import take_two_cores

GROWTH_BOUND_MB, FREE_BOUND_MB = 20.0, 2000.0
SEED = 0
EVERYTHING = ("--report={folder}/report.html", "--keep={folder}/stages", "--bit-depth=32")
INTRO = (
    "What `{command}` measures: the largest resident set of `turbrestore restore`, mapped files included, on two "
    "cores.  Clips are a random scene under smooth random motion.  It ends with 1 where a limit is exceeded, or where "
    "300 frames without one take more than 2,000 MB.\n"
)
HEAD = """| frames | read from | options | limit, MB | peak, MB |
|---|---|---|---:|---:|"""
# What a clip is read from.
ARRAY, VIDEO, IMAGES = "clip.npy", "clip.mkv", "images"
FORMS = {ARRAY: "8-bit array", VIDEO: "H.264 video", IMAGES: "16-bit images"}
# A process takes over the peak of the one that starts it, so this one stays small and leaves clips to others to write.
STATM = Path("/proc/self/statm")


@dataclass(frozen=True)
class Clip:
    """Frames, height, width and channels."""

    count: int
    height: int
    width: int
    channels: int = 1

    def __str__(self) -> str:
        return f"{self.count} × {self.width}×{self.height} {'RGB' if self.channels == 3 else 'grey'}"

    def write(self, path: Path) -> None:
        """Write 8-bit frames of a random scene under smooth random motion, one after the other."""
        rng = np.random.default_rng(SEED)
        shape = (self.count, self.height, self.width, *([3] if self.channels == 3 else []))
        frames = np.lib.format.open_memmap(path, "w+", np.uint8, shape)
        scene = cv2.GaussianBlur(rng.random(shape[1:], dtype=np.float32), (0, 0), 2)
        scene = np.clip(0.5 + 2.5 * (scene - scene.mean()), 0, 1)
        cv2.imwrite(str(path.with_name("scene.png")), (255 * scene).astype(np.uint8))
        y, x = np.mgrid[: self.height, : self.width].astype(np.float32)
        for index in range(self.count):
            flow = self.flow(rng)
            moved = cv2.remap(
                scene, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
            )
            noise = cv2.randn(np.empty(moved.shape, np.float32), 0, 0.01)
            frames[index] = np.clip(255 * (moved + noise), 0, 255).astype(np.uint8)
            frames.flush()

    def encode(self, folder: Path) -> tuple[Path, Path]:
        """Write the frames of an array as H.264 and as a folder of images of 16 bits."""
        import av

        frames, video, images = np.load(folder / ARRAY, mmap_mode="r"), folder / VIDEO, folder / IMAGES
        images.mkdir()
        with av.open(str(video), "w") as output:
            stream = output.add_stream("libx264", rate=25)
            stream.width, stream.height, stream.pix_fmt = self.width, self.height, "yuv420p"
            for index, pixels in enumerate(frames):
                cv2.imwrite(str(images / f"{index:04}.png"), pixels.astype(np.uint16) * 257)
                frame = av.VideoFrame.from_ndarray(pixels, "rgb24" if self.channels == 3 else "gray")
                output.mux(stream.encode(frame))
            output.mux(stream.encode())
        return video, images

    def flow(self, rng: np.random.Generator) -> np.ndarray:
        """Smooth random motion, pixels."""
        coarse = rng.normal(0, 1.5, (max(self.height // 24, 2), max(self.width // 24, 2), 2)).astype(np.float32)
        return cv2.resize(coarse, (self.width, self.height), interpolation=cv2.INTER_CUBIC)


def write_apart(clip: Clip, path: Path) -> None:
    """Write a clip in a process of its own."""
    run_apart(f"{clip!r}.write(Path({str(path)!r}))")


def run_apart(call: str) -> None:
    """Run a call of this module in a process of its own."""
    subprocess.run([sys.executable, "-c", f"from memory import *; {call}"], check=True, cwd=Path(__file__).parent)


def restore_peak(clip: Path, options: list[str]) -> float:
    """Largest resident set of ``turbrestore restore``, MB."""
    output = clip.with_suffix(".tif")
    options = [option.format(folder=clip.parent) for option in options]
    words = ["restore", str(clip), str(output), "--quiet", "--overwrite", *options]
    code = f"import sys; from turbrestore_cli.__main__ import main; sys.exit(main({words!r}))"
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise RuntimeError(f"turbrestore {' '.join(words)} ended with {child.returncode}")
    return usage.ru_maxrss * 1024 / 1e6


@dataclass(frozen=True)
class Case:
    """A clip, what it is read from, the limit in MB, and further options."""

    clip: Clip
    limit: float | None
    options: tuple[str, ...] = ()
    form: str = ARRAY

    def measure(self, extra: list[str]) -> tuple[float, str]:
        """Peak, MB, and a row of the table."""
        with tempfile.TemporaryDirectory() as name:
            write_apart(self.clip, Path(name, ARRAY))
            if self.form != ARRAY:
                run_apart(f"{self.clip!r}.encode(Path({name!r}))")
            limits = [] if self.limit is None else [f"--memory-limit={self.limit}MB"]
            peak = restore_peak(Path(name, self.form), [*limits, *self.options, *extra])
        options = " ".join(option.replace("{folder}/", "") for option in self.options)
        limit = "none" if self.limit is None else f"{self.limit:,.0f}"
        cells = str(self.clip), FORMS[self.form], f"`{options}`" if options else "", limit, f"{peak:,.0f}"
        return peak, f"| {' | '.join(cells)} |"


def limited_cases(quick: bool, largest: bool) -> Iterator[Case]:
    """Restorations that have to keep a limit; a quick run has fewer frames, which take as much memory."""
    few = 12 if quick else 24
    yield Case(Clip(24 if quick else 300, 1080, 1920), 2000, () if quick else ("--train=60",))
    yield Case(Clip(few, 540, 960), 900)
    if not quick:
        yield Case(Clip(few, 540, 960, 3), 1100)
        # Here and from 3840×2160 on whole frames do not fit.
        yield Case(Clip(few, 1080, 1920, 3), 1500)
        yield Case(Clip(few, 1080, 1920, 3), 3000)
    yield Case(Clip(few, 1080, 1920, 3), 1500, form=VIDEO)
    yield Case(Clip(few, 540, 960, 3), 1100, form=IMAGES)
    # With all that a run can write.
    yield Case(Clip(8, 1080, 1920, 3), 1500, EVERYTHING)
    if largest:
        yield Case(Clip(16, 2160, 3840, 3), 8000)
        yield Case(Clip(16, 2160, 3840), 3000)
        yield Case(Clip(12, 4320, 7680), 8000)


def check_limits(quick: bool, largest: bool, extra: list[str]) -> Iterator[tuple[str, bool]]:
    """Rows of limited runs, and whether each keeps its limit."""
    for case in limited_cases(quick, largest):
        peak, row = case.measure(extra)
        yield row, peak <= case.limit


def check_free(extra: list[str]) -> Iterator[tuple[str, bool]]:
    """Row of a long clip of large frames without a limit, and whether it is within the bound."""
    peak, row = Case(Clip(300, 1080, 1920), None).measure(extra)
    yield row, peak <= FREE_BOUND_MB


def check_growth(extra: list[str]) -> Iterator[tuple[str, bool]]:
    """Rows of few and of many frames, and what more frames take; whether it is within the bound."""
    peaks = []
    for count in (200, 2000):
        options = "--train=60", "--sigma=1", "--deconvolution.method=wiener"
        peak, row = Case(Clip(count, 128, 128), None, options).measure(extra)
        peaks.append(peak)
        yield row, True
    growth = peaks[1] - peaks[0]
    text = f"\n2,000 frames of 128×128 take {growth:.1f} MB more than 200; bound {GROWTH_BOUND_MB:g} MB."
    yield text, growth <= GROWTH_BOUND_MB


class Watch:
    """Largest resident set between laps, above what was there when they began; bytes."""

    def __init__(self) -> None:
        self._floor = self._peak = resident()
        self._reading = threading.Lock()
        threading.Thread(target=self._look, daemon=True).start()

    def lap(self) -> float:
        """Begin anew, and return what was taken."""
        with self._reading:
            taken = max(self._peak, resident()) - self._floor
            self._floor = self._peak = resident()
        return taken

    def _look(self) -> None:
        while True:
            with self._reading:
                self._peak = max(self._peak, resident())
            time.sleep(0.003)


def resident() -> float:
    """Bytes of the process in memory."""
    return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


class StageWatch(Watch):
    """A store that keeps nothing, and notes what the process takes while each result is computed."""

    def __init__(self) -> None:
        super().__init__()
        self.taken: dict[str, float] = {}

    def get(self, name: str, compute: Callable[[], Any]) -> Any:
        """Compute a result."""
        self.lap()
        result = compute()
        self.taken[name] = self.lap()
        return result

    def has(self, name: str) -> bool:
        """Tell that nothing is kept."""
        return False

    def set_levels(self, levels: object) -> None:
        """Forget the levels."""

    def filter_start(self) -> None:
        """Return None: nothing was kept."""

    def checkpoint(self, state: object) -> None:
        """Discard the checkpoint."""


def measure_stages(clip: Clip, threads: int, method: str) -> None:
    """Print what each stage takes above what is held before it, bytes a pixel; in a process of its own."""
    from turbrestore.io.source import FrameSource
    from turbrestore.pipeline import restore
    from turbrestore.registration.centroid import CentroidParams
    from turbrestore.registration.flow import FlowParams
    from turbrestore.runtime.runtime import Runtime
    from turbrestore.settings import RestoreParams

    # Fewer than there are, because the filter holds a block of those that follow.
    settings = RestoreParams(
        train=16, until="filter", flow=FlowParams(method=method), centroid=CentroidParams(iterations=2)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.npy"
        write_apart(replace(clip, height=96, width=96), path)
        # What is loaded and compiled once.
        restore(FrameSource.from_array(np.load(path)), settings)
        write_apart(clip, path)
        watch, source = StageWatch(), FrameSource.from_array(np.load(path, mmap_mode="r"))
        # Within a limit freed memory goes back to the system.
        restore(source, settings, Runtime(threads=threads, memory_limit=1e12), watch)
    words = ", ".join(f"{name} {size / clip.height / clip.width:.0f}" for name, size in watch.taken.items())
    print(f"{clip} {method:9} {threads} threads: {words}; bytes a pixel", flush=True)


def measure_deconvolution(clip: Clip, method: str) -> None:
    """Print the peak of a deconvolution, bytes a pixel."""
    from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
    from turbrestore.deconvolution.memory import deconvolution_memory
    from turbrestore.runtime.threads import available_cores

    pixels, threads = clip.height * clip.width, available_cores()
    # The image is periodic, so that there is no margin.
    params = DeconvolutionParams(method=method, iterations=60, tolerance=0, channels="each", boundary="periodic")
    with tempfile.TemporaryDirectory() as name:
        write_apart(clip, Path(name) / "clip.npy")
        image = np.load(Path(name) / "clip.npy")[0] / np.float32(255)
    # What is loaded and compiled once.
    deconvolve(image[:64, :64], 2.0, params)
    watch = Watch()
    deconvolve(image, 2.0, params)
    stated = deconvolution_memory(image.shape, params, threads)
    print(
        f"{clip} {method:6} {threads} threads: {watch.lap() / pixels:.0f} of {stated / pixels:.0f} bytes a pixel",
        flush=True,
    )


def print_stages() -> None:
    """Run every combination in a process of its own."""
    for channels, threads, method in (
        (1, 1, "dis"),
        (1, 2, "dis"),
        (1, 4, "dis"),
        (3, 1, "dis"),
        (3, 2, "dis"),
        (1, 1, "farneback"),
        (1, 2, "farneback"),
        (1, 1, "tvl1"),
        (1, 2, "tvl1"),
    ):
        run_apart(f"measure_stages(Clip(40, 720, 1280, {channels}), {threads}, {method!r})")
    for channels in (1, 3):
        for method in ("nltv", "tv", "wiener"):
            run_apart(f"measure_deconvolution(Clip(1, 1080, 1920, {channels}), {method!r})")
            run_apart(f"measure_deconvolution(Clip(1, 2160, 3840, {channels}), {method!r})")


def document(arguments: argparse.Namespace) -> tuple[str, bool]:
    """Print the table as it is made; its document, and whether all bounds hold."""
    quick, largest, options = arguments.quick, arguments.largest, arguments.options
    command = f"python benchmarks/memory.py{' --quick' if quick else ''}{' --largest' if largest else ''}"
    lines, held = [], True
    checks = {
        "limits": lambda: check_limits(quick, largest, options),
        "free": lambda: check_free(options),
        "growth": lambda: check_growth(options),
    }
    print(HEAD, flush=True)
    for name, check in checks.items():
        for line, good in check() if arguments.only in (None, name) else ():
            print(line if good else f"{line} broken", flush=True)
            lines.append(line)
            held &= good
    intro = INTRO.format(command=f"{command} --write benchmarks/results/memory.md")
    return "\n".join(["# Memory\n", intro, HEAD, *lines]) + "\n", held


def main() -> int:
    """Print the tables; 1 where a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer rows with fewer frames")
    parser.add_argument("--largest", action="store_true", help="frames of 3840×2160 and 7680×4320 as well")
    parser.add_argument("--stages", action="store_true", help="bytes a pixel of every stage, and nothing else")
    parser.add_argument("--only", choices=("limits", "free", "growth"), help="some of the rows")
    parser.add_argument("--write", type=Path, metavar="FILE", help="write the document")
    parser.add_argument("options", nargs="*", help="further options of turbrestore restore, after --")
    arguments = parser.parse_args()
    if arguments.stages:
        print_stages()
        return 0
    if arguments.write is not None and (arguments.only or arguments.options):
        parser.error("--write: the document is of all rows, without further options")
    take_two_cores()
    text, held = document(arguments)
    if arguments.write is not None:
        arguments.write.write_text(with_origin(text), encoding="utf-8")
    return int(not held)


if __name__ == "__main__":
    sys.exit(main())
