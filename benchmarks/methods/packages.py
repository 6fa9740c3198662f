"""Packages of others in an environment of their own, because what they need contradicts what this project needs."""

from __future__ import annotations

import json
import subprocess
import tempfile
import venv
from pathlib import Path

import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import TurbrestoreError

CHILD = Path(__file__).with_name("package_child.py")
# The stacker asks for NumPy below 1.23, which no current Python has, and runs with any below 2.
WITHOUT_DEPENDENCIES = ("planetary-system-stacker==0.9.8.2", "pystackreg==0.2.8")
DEPENDENCIES = ("numpy<2", "opencv-python-headless<4.11", "PyQt5", "matplotlib", "psutil", "scipy", "astropy")
DEPENDENCIES += ("scikit-image", "tqdm")
LONGEST = 600


class PackageError(TurbrestoreError):
    """A package of others cannot be installed or gives no result."""


def make_environment(folder: Path) -> Path:
    """Return the interpreter of the environment in a folder, which is made where there is none.

    Raises
    ------
    PackageError
        It cannot be made, for example without a network.
    """
    python = folder / "bin" / "python"
    if python.exists():
        return python
    try:
        venv.create(folder, with_pip=True)
        for packages in (["--no-deps", *WITHOUT_DEPENDENCIES], [*DEPENDENCIES]):
            _check([str(python), "-m", "pip", "install", "--quiet", *packages])
    except (OSError, subprocess.SubprocessError, PackageError) as error:
        # A half-made environment would pass for a whole one.
        if python.is_file():
            python.unlink()
        raise PackageError(f"{folder}: the environment cannot be made: {error}") from None
    return python


def run_package(name: str, frames: FloatArray, python: Path) -> tuple[FloatArray, dict[str, float]]:
    """Image that a package makes of frames, and the processor time (s) and peak memory (MB) of its process.

    Raises
    ------
    PackageError
        The package fails or takes longer than ten minutes.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "frames.npy"), Path(folder, "image.npy")
        np.save(source, frames)
        used = json.loads(_check([str(python), str(CHILD), name, str(source), str(target)]).splitlines()[-1])
        return np.load(target), used


def _check(command: list[str]) -> str:
    """Return what a command prints; raise PackageError with its last line where it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LONGEST)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PackageError(str(error)) from None
    if done.returncode:
        raise PackageError((done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1])
    return done.stdout
