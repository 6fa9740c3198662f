"""Packages of others in environments of their own, because what they need contradicts what this project needs."""

from __future__ import annotations

import json
import subprocess
import tempfile
import venv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.core.errors import TurbrestoreError

ROOT = Path(__file__).resolve().parents[2]
CHILD = Path(__file__).with_name("package_child.py")
LONGEST = 1800


class PackageError(TurbrestoreError):
    """A package of others cannot be installed or gives no result."""


@dataclass(frozen=True)
class Environment:
    """A folder, and the calls of pip that fill it from there."""

    folder: Path
    calls: tuple[str, ...]

    @property
    def python(self) -> Path:
        """Its interpreter."""
        return self.folder / "bin" / "python"

    @property
    def made(self) -> Path:
        """File that is there once the folder is filled: what was killed on the way does not pass for whole."""
        return self.folder / "made"


STACKERS = Environment(
    ROOT / ".venv-peers",
    (
        # The stacker asks for NumPy below 1.23, which no current Python has, and runs with any below 2.
        "install --no-deps planetary-system-stacker==0.9.8.2 pystackreg==0.2.8",
        "install numpy<2 opencv-python-headless<4.11 PyQt5 matplotlib psutil scipy astropy scikit-image tqdm",
    ),
)
NETWORKS = Environment(
    ROOT / ".venv-networks",
    (
        "install numpy onnxruntime opencv-python-headless Pillow PyYAML pyclipper shapely six tqdm",
        "install --no-deps rapidocr-onnxruntime==1.4.4",
        # The package itself needs a newer Python and a GPU; its archive holds the weights, which need neither.
        "download --no-deps --python-version=3.12 --only-binary=:all: --dest=. vs-undistort==2.3.1",
    ),
)
NETWORK = "TMT de-tilting"
PACKAGES = {"PlanetarySystemStacker": STACKERS, "pystackreg": STACKERS, NETWORK: NETWORKS}


def make_environment(environment: Environment) -> Path:
    """Return the interpreter of an environment, which is made where there is none.

    Raises
    ------
    PackageError
        It cannot be made, for example without a network.
    """
    folder, python = environment.folder, environment.python
    if environment.made.exists():
        return python
    try:
        venv.create(folder, clear=True, with_pip=True)
        for call in environment.calls:
            _check([str(python), "-m", "pip", "--quiet", *call.split()], folder)
        environment.made.touch()
    except (OSError, subprocess.SubprocessError, PackageError) as error:
        raise PackageError(f"{folder}: the environment cannot be made: {error}") from None
    return python


def run_package(name: str, frames: FloatArray, python: Path) -> tuple[FloatArray, dict[str, float]]:
    """Image or frames that a package makes of frames, and the processor time (s) and peak memory (MB) of its process.

    Raises
    ------
    PackageError
        The package fails or takes longer than half an hour.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "frames.npy"), Path(folder, "image.npy")
        np.save(source, frames)
        used = json.loads(_check([str(python), str(CHILD), name, str(source), str(target)]).splitlines()[-1])
        return np.load(target), used


def _check(command: list[str], folder: Path | None = None) -> str:
    """Return what a command prints; raise PackageError with its last line where it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=LONGEST, cwd=folder)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PackageError(str(error)) from None
    if done.returncode:
        raise PackageError((done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1])
    return done.stdout
