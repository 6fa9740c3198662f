"""Which version, revision, day and machine a table is of; ``publish`` prints a table and writes it with that line."""

from __future__ import annotations

import datetime
import os
import platform
import re
import subprocess
from pathlib import Path

import turbrestore
from turbrestore.io.output import atomic_write

ROOT = Path(__file__).resolve().parent.parent
# What tables depend on.
CODE = ("turbrestore", "benchmarks", ":!benchmarks/results")
LINE = re.compile(r"(?m)^\*turbrestore (?P<version>\S+), revision (?P<revision>\S+), (?P<day>[\d-]+); .*\*\n\n")
CPU = Path("/proc/cpuinfo")


def publish(text: str, path: Path | None) -> None:
    """Print a document, and write it where a path is given, with its origin below the heading."""
    print(text, end="")
    if path is not None:
        atomic_write(path, with_origin(text).encode(), overwrite=True)


def with_origin(text: str) -> str:
    """Document with the line of its origin below its heading; an older line goes."""
    head, _, rest = LINE.sub("", text).partition("\n\n")
    return f"{head}\n\n{origin()}\n\n{rest}"


def origin() -> str:
    """Version, revision, day, machine, and the processor time of this process and of those that it has waited for."""
    today = datetime.datetime.now(tz=datetime.UTC).date()
    made = f"turbrestore {turbrestore.__version__}, revision {revision()}, {today}"
    return f"*{made}; {machine()}; {sum(os.times()[:4]):,.0f} s of processor time.*"


def revision() -> str:
    """Last commit of the code, with ``+`` where it has been changed since, or ``unknown`` without git."""
    found = _git("log", "-1", "--format=%h", "--", *CODE)
    return found + "+" * bool(_git("status", "--porcelain", "--", *CODE)) if found else "unknown"


def machine() -> str:
    """Cores that may be used, and their kind."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    named = re.search(r"model name\s*: (.+)", CPU.read_text()) if CPU.exists() else None
    return f"{cores} cores, {named[1].split('@')[0].strip() if named else platform.machine()}"


def _git(*words: str) -> str:
    try:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        return ""
