"""Measure the present tree and an earlier revision of it by the same script, each in a process of its own.

A script that is measured by names itself and reads a task, which is JSON, after ``--child``; it prints its figures as
JSON.  It may use nothing that the earlier revision lacks.
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

Figures = dict[str, Any]


@contextmanager
def revision(name: str | None) -> Iterator[Path | None]:
    """Lay out the package of a revision in a folder that goes away afterwards; None for no name."""
    if name is None:
        yield None
        return
    root = Path(__file__).resolve().parent.parent
    command = ["git", "archive", "--format=tar", name, "turbrestore"]
    packed = subprocess.run(command, cwd=root, capture_output=True, check=False)
    if packed.returncode:
        sys.exit(f"{Path(sys.argv[0]).stem}: {packed.stderr.decode().strip()}")
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
            archive.extractall(folder, filter="data")
        yield Path(folder)


def child(script: str, task: Figures, tree: Path | None = None) -> Figures:
    """Measure a task by a script, with the package in a folder or with the present one."""
    paths = [str(tree)] if tree else []
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*paths, os.environ.get("PYTHONPATH", "")]).strip(":")}
    command = [sys.executable, script, "--child", json.dumps(task)]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=folder, env=environment)
    figures: Figures = json.loads(done.stdout)
    print(f"{'before' if tree else 'now'}: {task} {figures}", file=sys.stderr, flush=True)
    return figures
