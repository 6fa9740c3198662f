"""Which version, revision, day and machine a table is of; tables are printed, and written with that line.

A script either has a document and calls ``publish``, or prints its table as it goes and is run by ``publish_printed``.
"""

from __future__ import annotations

import argparse
import datetime
import io
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path

import turbrestore
from turbrestore.io.output import atomic_write

ROOT = Path(__file__).resolve().parent.parent
# What tables depend on.
CODE = ("turbrestore", "benchmarks", ":!benchmarks/results", ":!benchmarks/decisions")
LINE = re.compile(r"(?m)^\*turbrestore (?P<version>\S+), revision (?P<revision>\S+), (?P<day>[\d-]+); .*\*\n\n")
CPU = Path("/proc/cpuinfo")


def publish(text: str, path: Path | None) -> None:
    """Print a document, and write it where a path is given, with its origin below the heading."""
    print(text, end="")
    if path is not None:
        atomic_write(path, with_origin(text).encode(), overwrite=True)


def publish_printed(head: str, main: Callable[[], int | None]) -> int:
    """Run a script that prints a table; its option ``--write FILE`` stores what it prints below a heading."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--write", type=Path)
    options, sys.argv[1:] = parser.parse_known_args()
    printed = _Copied(sys.stdout)
    with redirect_stdout(printed):
        code = main()
    if options.write is not None:
        # The command that a head names is the one that was called.
        head = re.sub(r"(?<=python benchmarks/)(\w+\.py)(?=`)", rf"\1{arguments()}", head)
        atomic_write(options.write, with_origin(f"{head}\n\n{printed.getvalue()}").encode(), overwrite=True)
    return code or 0


class _Copied(io.StringIO):
    """Text that is kept and goes on to a stream."""

    def __init__(self, stream: io.TextIOBase) -> None:
        super().__init__()
        self.stream = stream

    def write(self, text: str) -> int:
        self.stream.write(text)
        self.stream.flush()
        return super().write(text)


def with_origin(text: str, seconds: float | None = None) -> str:
    """Document with the line of its origin below its heading; an older line goes."""
    head, _, rest = LINE.sub("", text).partition("\n\n")
    return f"{head}\n\n{origin(seconds)}\n\n{rest}"


def origin(seconds: float | None = None) -> str:
    """Version, revision, day, machine, and processor time, by default of this process and those it has waited for."""
    today = datetime.datetime.now(tz=datetime.UTC).date()
    made = f"turbrestore {turbrestore.__version__}, revision {revision()}, {today}"
    spent = sum(os.times()[:4]) if seconds is None else seconds
    return f"*{made}; {machine()}; {spent:,.0f} s of processor time.*"


def revision() -> str:
    """Last commit of the code, with ``+`` where it has been changed since, or ``unknown`` without git."""
    found = _git("log", "-1", "--format=%h", "--", *CODE)
    return found + "+" * bool(_git("status", "--porcelain", "--", *CODE)) if found else "unknown"


def arguments() -> str:
    """Words of the command line behind a space each, without ``--write FILE``."""
    words = sys.argv[1:]
    if "--write" in words:
        place = words.index("--write")
        words = words[:place] + words[place + 2 :]
    return "".join(f" {shlex.quote(word)}" for word in words)


def machine() -> str:
    """Cores that may be used, and their kind."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    named = re.search(r"model name\s*: (.+)", CPU.read_text()) if CPU.exists() else None
    return f"{cores} cores, {named[1].split('@')[0].strip() if named else platform.machine()}"


def outdated(versions: dict[str, str], changelog: str) -> list[str]:
    """Names of the tables whose version is before the last release, the newest heading of the changelog with a date."""
    released = re.search(r"(?m)^## (\S+), \d{4}-\d\d-\d\d$", changelog)
    least = _numbers(released[1]) if released else ()
    return [name for name, version in versions.items() if _numbers(version) < least]


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", version)))


def _git(*words: str) -> str:
    try:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        return ""
