"""Measure the present tree and an earlier revision of it by the same script, each in a process of its own.

A script that measures is started again as the child: it finds a task after ``--child`` and prints figures, both JSON.
What it imports must be there in the earlier revision too.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from turbrestore.core.errors import ConfigurationError, TurbrestoreError

Figures = dict[str, Any]


@contextmanager
def revision(name: str | None) -> Iterator[Path | None]:
    """Lay out the packages of a revision in a folder that goes away afterwards; None for no name."""
    if name is None:
        yield None
        return
    root = Path(__file__).resolve().parent.parent
    command = ["git", "archive", "--format=tar", name, "turbrestore", "cli"]
    packed = subprocess.run(command, cwd=root, capture_output=True, check=False)
    if packed.returncode:
        said = packed.stderr.decode().strip().splitlines()[-1:]
        raise ConfigurationError(f"--before: expected a revision of this repository, found {name!r}: {''.join(said)}")
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
            archive.extractall(folder, filter="data")
        # The name under which it is installed.
        (Path(folder) / "cli").rename(Path(folder) / "turbrestore_cli")
        yield Path(folder)


def environment(tree: Path | None) -> dict[str, str]:
    """Environment of a process that has the packages in a folder, or the present ones."""
    paths = [str(tree)] if tree else []
    return {**os.environ, "PYTHONPATH": os.pathsep.join([*paths, os.environ.get("PYTHONPATH", "")]).strip(":")}


def child(script: str, task: Figures, tree: Path | None = None) -> Figures:
    """Measure a task by a script, with the package in a folder or with the present one."""
    command = [sys.executable, script, "--child", json.dumps(task)]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            command, stdout=subprocess.PIPE, text=True, check=False, cwd=folder, env=environment(tree)
        )
    if done.returncode:
        raise TurbrestoreError(f"{Path(script).name}: expected figures of {task}, found exit status {done.returncode}")
    figures: Figures = json.loads(done.stdout)
    print(f"{'before' if tree else 'now'}: {task} {figures}", file=sys.stderr, flush=True)
    return figures


def take_two_cores() -> None:
    """Let this process and those that it starts use two cores: bounds in seconds are those of as many."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
