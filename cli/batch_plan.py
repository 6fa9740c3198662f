"""What a batch has to do: which clips there are, where their results go, and what an earlier batch has done."""

from __future__ import annotations

import csv
import dataclasses
import glob
import hashlib
import io
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from turbrestore import __version__
from turbrestore.core.errors import ConfigurationError, DataError, InputNotFoundError, OutputError
from turbrestore.core.verdict import RIGHT
from turbrestore.io.folders import frame_files
from turbrestore.io.limits import input_errors
from turbrestore.io.output import atomic_write, check_output
from turbrestore.report.batch_page import ClipRow, write_batch_page
from turbrestore.runs.typed_records import convert_to

if TYPE_CHECKING:
    from .clip import Order

# In a folder, files of these kinds are clips; images, TIFF and FITS files are the frames of one.
CLIP_SUFFIXES = (".mkv", ".mp4", ".m4v", ".mov", ".webm", ".avi", ".gif", ".ser", ".npy", ".apng")
JOURNAL, TABLE, PAGE = "batch.jsonl", "summary.csv", "index.html"
_COLUMNS = (
    *("input", "output", "state", "reason", "frames", "width", "height", "blur", "seconds", "checks", "remarks"),
)


def find_clips(inputs: Iterable[Path]) -> list[Path]:
    """List the clips that files, folders and patterns name, each once.

    A folder is its videos where it holds any, one clip where it holds images or FITS files, and else its folders.

    Raises
    ------
    InputNotFoundError
        There is no such file, or none that a pattern matches.
    DataError
        A folder holds no clip.
    """
    found: dict[Path, None] = {}
    for path in inputs:
        named = [path]
        if not path.exists() and glob.has_magic(str(path)):
            # Path.glob, which the rule asks for, refuses absolute patterns and matches hidden files.
            named = [Path(name) for name in sorted(glob.glob(str(path), recursive=True))]  # noqa: PTH207
        if not named:
            raise InputNotFoundError(f"{path}: no file matches this pattern")
        for one in named:
            if not one.exists():
                raise InputNotFoundError(f"{one}: no such file or folder")
            found |= dict.fromkeys(_clips_in(one))
    if not found:
        raise ConfigurationError("batch: expected at least one clip, found none; name files, folders or patterns")
    return list(found)


def name_outputs(clips: Sequence[Path], out: Path, suffix: str) -> list[Path]:
    """Give every clip the name of its result; clips of one name keep their suffix, or have that of their folder."""
    names = [clip.stem if clip.is_file() else clip.name for clip in clips]
    for longer in (lambda clip: clip.name, lambda clip: f"{clip.absolute().parent.name}_{clip.name}"):
        counts = Counter(name.casefold() for name in names)
        names = [longer(clip) if counts[name.casefold()] > 1 else name for clip, name in zip(clips, names, strict=True)]
    twice = next((name for name, count in Counter(name.casefold() for name in names).items() if count > 1), None)
    if twice is not None:
        raise ConfigurationError(f"batch: expected clips of different names, found {twice} twice; rename one of them")
    return [out / f"{name}{suffix}" for name in names]


def plan(orders: Sequence[Order], out: Path, resume: bool, overwrite: bool) -> tuple[list[ClipRow], list[Order]]:
    """Compare what is wanted with what an earlier batch has left; return a row for every clip, and what is to do.

    Raises
    ------
    OutputError
        An output exists that no earlier batch has made, or is an input.
    """
    if (out / JOURNAL).exists() and not resume and not overwrite:
        raise OutputError(f"{out}: holds a batch; choose another folder, add --overwrite, or --resume the batch in it")
    earlier = read_journal(out / JOURNAL) if resume else {}
    read = {path.resolve() for order in orders for path in order.inputs}
    for name in (JOURNAL, TABLE, PAGE):
        check_output(
            out / name, overwrite=overwrite or (resume and (not (out / name).exists() or bool(earlier))), suffixes=None
        )
    rows, missing = [], []
    for order in orders:
        row = ClipRow(str(order.input), str(order.output), key=key_of(order))
        before = earlier.get(order.output.name)
        for path in order.outputs:
            if path.resolve() in read:
                raise OutputError(f"{path}: is an input; choose another folder")
            check_output(path, order.inputs, overwrite or before is not None, suffixes=None)
        there = all(path.exists() for path in order.outputs)
        if before is not None and before.state == "done" and before.key == row.key and there:
            row = dataclasses.replace(before, input=row.input, output=row.output)
        else:
            missing.append(order)
        rows.append(row)
    return rows, missing


def key_of(order: Order) -> str:
    """Identify the input and all settings that a result depends on."""
    settings = (order.params, order.selection, order.bit_depth, order.memory_limit, order.tile, order.machine.device)
    stamps = [_stamp(file) for path in order.inputs for file in (frame_files(path) if path.is_dir() else [path])]
    text = f"{__version__}\0{settings!r}\0{stamps!r}\0{order.report is not None}"
    return hashlib.blake2b(text.encode(errors="surrogateescape"), digest_size=12).hexdigest()


def read_journal(path: Path) -> dict[str, ClipRow]:
    """Read the newest row of every result, by its name; lines that are no rows, such as a cut one, are skipped."""
    found: dict[str, ClipRow] = {}
    if not path.is_file():
        return found
    with input_errors(path):
        lines = path.read_text("utf-8", "replace").splitlines()
    for line in lines:
        with suppress(ValueError, RecursionError, DataError):
            row = convert_to(ClipRow, json.loads(line), str(path))
            found[Path(row.output).name] = row
    return found


def journal_line(row: ClipRow) -> str:
    """One row as a line of the journal."""
    return json.dumps(dataclasses.asdict(row)) + "\n"


def write_summary(out: Path, rows: Sequence[ClipRow]) -> None:
    """Write the table and the page of a batch, in place of earlier ones; the page where its package is there."""
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, _COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        done = row.state == "done"
        said = figures(row) | ({"checks": row.checks or RIGHT} if done else {})
        writer.writerow({name: value if done or isinstance(value, str) else "" for name, value in said.items()})
    atomic_write(out / TABLE, table.getvalue().encode(errors="replace"), overwrite=True)
    if not writes_page():
        # That of an earlier batch would show other clips.
        (out / PAGE).unlink(missing_ok=True)
        return
    write_batch_page(out / PAGE, rows)


def writes_page() -> bool:
    """Tell whether the package is there that the page of a batch needs."""
    return find_spec("jinja2") is not None


def figures(row: ClipRow) -> dict[str, Any]:
    """Return what the table says of a clip."""
    rounded = dataclasses.replace(row, blur=round(row.blur, 4), seconds=round(row.seconds, 3))
    return {name: getattr(rounded, name) for name in _COLUMNS}


def _clips_in(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    with input_errors(path):
        entries = sorted(entry for entry in path.iterdir() if entry.name[0] != ".")
        videos = [entry for entry in entries if entry.suffix.lower() in CLIP_SUFFIXES and entry.is_file()]
        if videos:
            return videos
        if frame_files(path):
            return [path]
        folders = [entry for entry in entries if entry.is_dir() and not entry.is_symlink()]
    found = []
    for folder in folders:
        with suppress(DataError):
            found += _clips_in(folder)
    if not found:
        raise DataError(f"{path}: expected videos, images or folders of them, found none in the folder")
    return found


def _stamp(path: Path) -> tuple[str, int, int]:
    with input_errors(path):
        status = path.stat()
    return path.name, status.st_size, status.st_mtime_ns
