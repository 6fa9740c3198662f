"""Commands whose outputs cannot be written: each must end with one line and its exit code, and change nothing.

As root on Linux disks that are full or read-only are small file systems in memory (``mount -t tmpfs``); elsewhere the
size of files is limited (RLIMIT_FSIZE), and the cases that need a mount are left out.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from turbrestore.io.images.image_files import write_image
from turbrestore.synthesis.scenes import resolution_chart

COMMAND = [sys.executable, "-m", "turbrestore_cli"]
SETTINGS = ["--train=8", "--centroid.iterations=1", "--filter.block=8", "--deconvolution.iterations=5", "--quiet"]
CREATE, STORAGE, USAGE = 73, 74, 2
MEGABYTE = 1 << 20


@dataclass(frozen=True)
class Result:
    """One case: what it was, and what was wrong."""

    name: str
    faults: tuple[str, ...]


@dataclass(frozen=True)
class Ended:
    """How a process ended."""

    code: int
    error: str


def execute(words: list[str], folder: Path, **options: object) -> Ended:
    """Run the command in a folder."""
    done = subprocess.run([*COMMAND, *words], cwd=folder, capture_output=True, text=True, check=False, **options)
    return Ended(done.returncode, done.stderr)


def digests(folder: Path) -> dict[str, str]:
    """Checksum of every file below a folder, of links where they lead; without times, and reports that show them."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.suffix != ".html":
            data = path.read_bytes()
            if path.name == "run.json":
                record = json.loads(data)
                # The record of an interrupted run has neither part yet.
                record.get("run", {}).pop("finished", None)
                record.get("restoration", {}).pop("seconds", None)
                data = json.dumps(record).encode()
            found[str(path.relative_to(folder))] = hashlib.sha256(data).hexdigest()
    return found


@contextmanager
def mounted(folder: Path, size: int) -> Iterator[Path]:
    """Mount a small file system in memory."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], check=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def can_mount(folder: Path) -> bool:
    """Whether this process may mount."""
    try:
        with mounted(folder / "probe", MEGABYTE):
            return True
    except (subprocess.CalledProcessError, OSError):
        return False
    finally:
        shutil.rmtree(folder / "probe", ignore_errors=True)


def small_files() -> None:
    """Let the child process write no file beyond 2 KiB."""
    import resource

    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, 2048))


@dataclass(frozen=True)
class Case:
    """A command that must fail: words, exit code, what is prepared in the folder."""

    name: str
    words: list[str]
    code: int
    prepare: Callable[[Path, ExitStack], None] = lambda _folder, _stack: None
    limited: bool = False


def run_case(case: Case, clip: Path, root: Path) -> Result:
    """One command that must fail and leave everything as it was."""
    with tempfile.TemporaryDirectory(dir=root) as name, ExitStack() as stack:
        folder = Path(name)
        shutil.copy(clip, folder / "clip.mkv")
        (folder / "frames").mkdir()
        case.prepare(folder, stack)
        before, there = digests(folder), {str(path) for path in folder.rglob("*")}
        ended = execute(case.words, folder, preexec_fn=small_files if case.limited else None)
        faults = []
        if ended.code != case.code:
            faults.append(f"exit code {ended.code} in place of {case.code}: {ended.error.strip()[-200:]}")
        if ended.error.count("\n") != 1 or not ended.error.startswith("turbrestore: "):
            faults.append(f"not one line: {ended.error.strip()[-300:]!r}")
        if digests(folder) != before:
            faults.append("files differ from before")
        left = sorted({str(path) for path in folder.rglob("*")} - there)
        if left:
            faults.append(f"left behind: {', '.join(left)}")
        return Result(case.name, tuple(faults))


def touch(name: str) -> Callable[[Path, ExitStack], None]:
    """Let a file be there."""
    return lambda folder, _: (folder / name).write_text("precious") and None


def read_only(folder: Path, stack: ExitStack) -> None:
    """Mount a read-only folder."""
    place = stack.enter_context(mounted(folder / "fixed", MEGABYTE))
    subprocess.run(["mount", "-o", "remount,ro", str(place)], check=True)


def full(free: int) -> Callable[[Path, ExitStack], None]:
    """Mount a folder with so many bytes free."""

    def prepare(folder: Path, stack: ExitStack) -> None:
        place = stack.enter_context(mounted(folder / "full", 4 * MEGABYTE))
        (place / "ballast").write_bytes(bytes(4 * MEGABYTE - free))

    return prepare


def linked(kind: str) -> Callable[[Path, ExitStack], None]:
    """Give the input a second name, that of an image."""

    def prepare(folder: Path, _: ExitStack) -> None:
        if kind == "symbolic":
            (folder / "link.png").symlink_to("clip.mkv")
        else:
            os.link(folder / "clip.mkv", folder / "link.png")

    return prepare


def dangling(folder: Path, _: ExitStack) -> None:
    """Let an output be a link into a folder that is missing."""
    (folder / "link.png").symlink_to("none/o.png")


def folder_link(folder: Path, _: ExitStack) -> None:
    """Give the folder of frames a second name, and a frame."""
    shutil.copy(Path(__file__).parents[1] / "sample_data" / "chart_truth.png", folder / "frames" / "a.png")
    (folder / "alias").symlink_to("frames")


def kept_input(folder: Path, _: ExitStack) -> None:
    """Let the input have the name of a file that --keep writes."""
    np.save(folder / "mean.npy", np.random.default_rng(0).uniform(size=(10, 32, 32)).astype(np.float32))


def output_cases(mounts: bool) -> list[Case]:
    """All commands that must fail."""

    def restore(output: str, *more: str, input: str = "clip.mkv") -> list[str]:
        return ["restore", input, output, *SETTINGS, *more]

    cases = [
        Case("missing folder", restore("none/o.png"), CREATE),
        Case("missing folder of the report", restore("o.png", "--report=none/r.html"), CREATE),
        Case("missing folder above --keep", restore("o.png", "--keep=none/kept"), CREATE),
        Case("link into a missing folder", restore("link.png"), CREATE, dangling),
        Case("folder in place of the image", restore("frames"), USAGE),
        Case("folder with the name of an image", restore("o.png"), CREATE, lambda f, _: (f / "o.png").mkdir()),
        Case("file in place of a folder", restore("clip.mkv/o.png"), CREATE),
        Case("no image format", restore("o.gif"), USAGE),
        Case("image exists", restore("o.png"), CREATE, touch("o.png")),
        Case("settings exist", restore("o.png"), CREATE, touch("o.png.toml")),
        Case("report exists", restore("o.png", "--report=r.html"), CREATE, touch("r.html")),
        Case("--keep has something in it", restore("o.png", "--keep=frames"), CREATE, touch("frames/letter.txt")),
        Case("--resume finds something else", restore("o.png", "--keep=frames", "--resume"), CREATE, touch("frames/a")),
        Case("centroid exists", ["centroid", "clip.mkv", "c.npz"], CREATE, touch("c.npz")),
        Case("settings file exists", ["config", "--init=run.toml"], CREATE, touch("run.toml")),
        Case("truth of a synthesis exists", ["synthesize", "chart", "s.mkv"], CREATE, touch("s.truth.png")),
        Case("output is the input", restore("clip.mkv", "--overwrite"), USAGE),
        Case("output links to the input", restore("link.png", "--overwrite"), CREATE, linked("symbolic")),
        Case("output is a hard link of the input", restore("link.png", "--overwrite"), CREATE, linked("hard")),
        Case("--keep is the input", restore("o.png", "--keep=clip.mkv", "--overwrite"), CREATE),
        Case("output among the frames", restore("frames/o.png", input="frames"), CREATE, folder_link),
        Case("output among the frames by a link", restore("alias/o.png", input="frames"), CREATE, folder_link),
        Case(
            "--keep would replace the input",
            restore("o.png", "--keep=.", "--overwrite", input="mean.npy"),
            CREATE,
            kept_input,
        ),
        Case("--keep would replace the output", restore("frames/mean.png", "--keep=frames"), CREATE),
        Case("synthesis onto its scene", ["synthesize", "clip.mkv", "clip.mkv", "--overwrite"], CREATE),
        Case("flows onto the input", ["flow", "clip.png", "mean.npy", "mean.npy", "--overwrite"], CREATE, kept_input),
        Case("image breaks off", restore("o.png"), STORAGE, limited=True),
        Case("artifact breaks off", ["centroid", "clip.mkv", "c.npz", "--train=4", "--quiet"], STORAGE, limited=True),
        Case("video breaks off", ["synthesize", "chart", "s.mkv", "--frames=3", "--size=64x64"], STORAGE, limited=True),
        Case("kept stage breaks off", restore("o.png", "--keep=kept"), STORAGE, limited=True),
    ]
    if mounts:
        cases += [
            Case("read-only disk", restore("fixed/o.png"), CREATE, read_only),
            Case("report on a read-only disk", restore("o.png", "--report=fixed/r.html"), CREATE, read_only),
            Case("--keep on a read-only disk", restore("o.png", "--keep=fixed/kept"), CREATE, read_only),
            Case("video on a read-only disk", ["synthesize", "chart", "fixed/s.mkv"], CREATE, read_only),
            Case("full disk", restore("full/o.png"), STORAGE, full(0)),
            Case("nearly full disk", restore("full/o.png"), STORAGE, full(8192)),
            Case("--keep on a full disk", restore("o.png", "--keep=full/kept"), STORAGE, full(65536)),
            Case("artifact on a full disk", ["centroid", "clip.mkv", "full/c.npz", "--quiet"], STORAGE, full(65536)),
            Case("flows on a full disk", ["flow", "clip.png", "clip.mkv", "full/f.npy"], STORAGE, flow_on_full),
            Case("video on a full disk", ["synthesize", "chart", "full/s.mkv", "--frames=9"], STORAGE, full(65536)),
            Case("stack on a full disk", ["synthesize", "chart", "full/s.tif", "--frames=9"], STORAGE, full(65536)),
            Case("settings on a full disk", ["config", "--init=full/run.toml"], STORAGE, full(0)),
        ]
    return cases


def flow_on_full(folder: Path, stack: ExitStack) -> None:
    """Mount a full disk, and let a reference be there."""
    full(65536)(folder, stack)
    write_image(folder / "clip.png", resolution_chart(64, 64), 8)
