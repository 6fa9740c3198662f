"""Run the command line on files that are malformed or damaged, have forged headers or odd content, and count passes.

Run ``python benchmarks/hostile_input.py``; it prints a Markdown table and exits with 1 when a row fails.
``--sample`` runs a few cases of every group; ``--only`` one group.

Every case is a call of the real command line in a process of its own, forked from this one, which has everything
imported and nothing decoded; where memory is measured the process starts from nothing.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from hostile_content import CONTENT, Content
from hostile_files import BOMBS, FLIPPED, FORMATS, STILLS, flipped, flipped_still, malformed, write_clip, write_still

from turbrestore.core.errors import DataError
from turbrestore.io.images.image_files import read_image
from turbrestore_cli.__main__ import main as command_line

BAD_DATA, DONE = 65, 0
SECONDS, PEAK_BYTES = 10.0, 400e6
FLIPS = 100
# Imported once instead of in every fork.
IMPORTED = (
    "av",
    "tifffile",
    "PIL.Image",
    "turbrestore_cli.clip",
    "turbrestore_cli.stages",
    "turbrestore_cli.inspection",
)


@dataclass(frozen=True)
class Ended:
    """How a call of the command line ended."""

    code: int
    stdout: str
    stderr: str
    seconds: float
    peak_bytes: int


@dataclass
class Row:
    """Cases of one kind: how many, and which failed why."""

    title: str
    rule: str
    count: int = 0
    note: str = ""
    failures: list[str] | None = None

    def add(self, name: str, complaint: str) -> None:
        """Count a case; an empty complaint means that it passed."""
        self.count += 1
        self.failures = [*(self.failures or []), *([f"{name}: {complaint}"] if complaint else [])]


def main() -> int:
    """Run the groups and print the table."""
    options = _options()
    rows: list[Row] = []
    for module in IMPORTED:
        importlib.import_module(module)
    # A fork has none of the threads that OpenCV believes it has, and would wait for them.
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        for name, group in GROUPS.items():
            if options.only in (None, name):
                started = time.perf_counter()
                place = Path(folder, name)
                place.mkdir()
                rows += group(place, options.sample)
                print(f"{name}: {time.perf_counter() - started:.0f} s", file=sys.stderr)
    print(table(rows))
    failures = [failure for row in rows for failure in row.failures or []]
    print("\n".join(failures), file=sys.stderr)
    return 1 if failures else 0


def table(rows: Iterable[Row]) -> str:
    """Rows as Markdown."""
    lines = ["| input | cases | passes when | passed |", "|---|---|---|---|"]
    for row in rows:
        passed = row.count - len(row.failures or [])
        note = f" ({row.note})" if row.note else ""
        lines.append(f"| {row.title} | {row.count} | {row.rule}{note} | {passed} |")
    return "\n".join(lines) + "\n"


def malformed_files(folder: Path, sample: bool) -> list[Row]:
    """Empty, text, wrong magic, random, and truncated at ten points."""
    row = Row("malformed: empty, text, wrong first bytes, random, cut at ten points; ten formats", _REFUSED)
    _apart(lambda: [write_clip(folder / f"whole{suffix}") for suffix in FORMATS])
    for suffix in FORMATS:
        cases = malformed((folder / f"whole{suffix}").read_bytes(), suffix)
        for name, data in list(cases.items())[:: 4 if sample else 1]:
            path = folder / f"{name}{suffix}"
            path.write_bytes(data)
            row.add(path.name, refusal(restored(path), _output(path)))
    return [row]


def flipped_bytes(folder: Path, sample: bool) -> list[Row]:
    """Flip one byte, every time another."""
    rows = []
    for name, suffix in FLIPPED.items():
        checked = name.startswith("FFV1")
        rule = "found every time, exit 65" if checked else "exit 65 or read to the end; no crash, no hang, one line"
        row = Row(f"one byte flipped: {name}", rule)
        whole = folder / f"whole{suffix}"
        _apart(lambda whole=whole, name=name: write_clip(whole, name))
        found = 0
        for number, data in enumerate(flipped(whole, name, 5 if sample else FLIPS)):
            path = folder / f"flip{number}{suffix}"
            path.write_bytes(data)
            ended = run_forked(["info", str(path)])
            found += ended.code == BAD_DATA
            row.add(f"{name} {number}", refusal(ended) if checked or ended.code != DONE else "")
            path.unlink()
        row.note = f"found {found}"
        rows.append(row)
    return rows + [_flipped_stills(folder, name, 5 if sample else FLIPS) for name in STILLS]


def _flipped_stills(folder: Path, compression: str, count: int) -> Row:
    """Flip one byte of the compressed pixels of a TIFF image."""
    checked = STILLS[compression]
    rule = "found every time, exit 65" if checked else "exit 65 or read; no crash, no hang"
    row = Row(f"one byte of the pixels flipped: TIFF image, {compression}", rule)
    whole, path, found = folder / f"{compression}.tif", folder / f"flip {compression}.tif", 0
    span = write_still(whole, compression)
    for number, data in enumerate(flipped_still(whole, span, count)):
        path.write_bytes(data)
        ended = run_forked(["evaluate", str(path), str(whole)])
        found += ended.code == BAD_DATA
        row.add(f"{compression} {number}", refusal(ended) if checked or ended.code != DONE else "")
    row.note = f"found {found}"
    return row


def bombs(folder: Path, sample: bool) -> list[Row]:
    """Headers that promise far more than there is, and small files that inflate."""
    row = Row("decompression bombs and lying headers", f"{_REFUSED}, peak memory below {PEAK_BYTES / 1e6:.0f} MB")
    highest = 0
    truth = folder / "truth.png"
    _apart(lambda: _write_bombs(folder, truth))
    for name, bomb in list(BOMBS.items())[:: 5 if sample else 1]:
        path = folder / name
        output = folder / f"{name}.result.png"
        words = [word.format(input=path, truth=truth, output=output) for word in bomb.command]
        ended = run_apart(words)
        highest = max(highest, ended.peak_bytes)
        large = f"peak memory {ended.peak_bytes / 1e6:.0f} MB" if ended.peak_bytes > PEAK_BYTES else ""
        row.add(name, refusal(ended, output) or large)
    row.note = f"highest {highest / 1e6:.0f} MB"
    return [row]


def odd_content(folder: Path, sample: bool) -> list[Row]:
    """Files that are whole, of frames that no image should be made of as they are."""
    row = Row(
        "content: NaN, Inf, constant, few frames, mixed sizes, tiny, saturated, cuts, black, duplicated, stuck pixels, "
        "variable rate",
        "exit 65 in one line, or the remark that the documentation names and a finite image",
    )
    _apart(lambda: [content.write(folder / content.name) for content in CONTENT])
    for content in CONTENT[:: 8 if sample else 1]:
        row.add(f"{content.name} {' '.join(content.options)}", _content_complaint(folder, content))
    return [row]


def restored(path: Path, *options: str) -> Ended:
    """Call ``restore``."""
    return run_forked(["restore", str(path), str(_output(path)), "--overwrite", *options])


def refusal(ended: Ended, output: Path | None = None) -> str:
    """Say what is wrong with a refusal; nothing where it is as it should be."""
    if ended.code != BAD_DATA:
        return f"ended with {ended.code}, {ended.stderr[-300:]!r}"
    if ended.stderr.count("\n") != 1 or "Traceback" in ended.stderr or not ended.stderr.startswith("turbrestore: "):
        return f"expected one line, found {ended.stderr[-500:]!r}"
    if ended.stdout or (output is not None and output.exists()):
        return "left output"
    return f"took {ended.seconds:.1f} s of CPU time" if ended.seconds > SECONDS else ""


def run_forked(words: list[str]) -> Ended:
    """Call the command line in a fork of this process."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        started = time.perf_counter()
        child = os.fork()
        if child == 0:
            _as_command(words, out.fileno(), err.fileno())
        code, seconds, peak = _wait(child, started)
        out.seek(0)
        err.seek(0)
        texts = (stream.read().decode(errors="replace") for stream in (out, err))
        return Ended(code, *texts, seconds, peak)


def run_apart(words: list[str]) -> Ended:
    """Call the command line in a process that starts from nothing, for a fair look at its memory."""
    code = "import sys, turbrestore_cli.__main__ as m; sys.exit(m.main(sys.argv[1:]))"
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        started = time.perf_counter()
        child = subprocess.Popen([sys.executable, "-P", "-c", code, *words], stdout=out, stderr=err)
        ended_code, seconds, peak = _wait(child.pid, started)
        child.returncode = ended_code
        out.seek(0)
        err.seek(0)
        texts = (stream.read().decode(errors="replace") for stream in (out, err))
        return Ended(ended_code, *texts, seconds, peak)


_REFUSED = "exit 65, one line, no traceback, no output, 10 s of CPU time at most"
GROUPS: dict[str, Callable[[Path, bool], list[Row]]] = {
    "malformed": malformed_files,
    "flips": flipped_bytes,
    "bombs": bombs,
    "content": odd_content,
}


def _content_complaint(folder: Path, content: Content) -> str:
    path = folder / content.name
    ended = restored(path, "--bit-depth", "32", *content.options)
    output = _output(path)
    try:
        if content.refused:
            missing = (
                "" if content.word in ended.stderr else f"expected {content.word!r}, found {ended.stderr[-300:]!r}"
            )
            return refusal(ended, output) or missing
        if ended.code != DONE or "Traceback" in ended.stderr:
            return f"ended with {ended.code}, {ended.stderr[-500:]!r}"
        if content.word not in ended.stderr:
            return f"expected {content.word!r}, found {ended.stderr[-300:]!r}"
        read_image(output)  # refuses what is not finite
    except DataError as error:
        return str(error)
    finally:
        output.unlink(missing_ok=True)
        output.with_name(output.name + ".toml").unlink(missing_ok=True)
    return ""


def _output(path: Path) -> Path:
    return path.parent.parent / f"{path.name}.result.tif"


def _write_bombs(folder: Path, truth: Path) -> None:
    cv2.imwrite(str(truth), np.zeros((32, 32), np.uint8))
    for name, bomb in BOMBS.items():
        bomb.write(folder / name)


def _apart(action: Callable[[], object]) -> None:
    """Run in a fork: a process that has started the threads of the decoders must not fork."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            action()
            code = 0
        finally:
            sys.stderr.flush()
            os._exit(code)
    if os.waitpid(child, 0)[1]:
        raise SystemExit("the inputs could not be written")


def _as_command(words: list[str], out: int, err: int) -> None:
    code = 1
    try:
        os.dup2(out, 1)
        os.dup2(err, 2)
        sys.stdout = io.TextIOWrapper(io.FileIO(1, "w", closefd=False), encoding="utf-8", write_through=True)
        sys.stderr = io.TextIOWrapper(io.FileIO(2, "w", closefd=False), encoding="utf-8", write_through=True)
        code = command_line(words)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
        os._exit(code)


def _wait(child: int, started: float) -> tuple[int, float, int]:
    """Exit code, below 0 for a signal, CPU time, and peak memory in bytes; a child that hangs is killed."""
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024
        if time.perf_counter() - started > 6 * SECONDS:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.002)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sample", action="store_true", help="a few cases of every group")
    parser.add_argument("--only", choices=GROUPS, help="one group")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
