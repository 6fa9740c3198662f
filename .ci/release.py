"""Build source archive and wheel into dist/, twice, and keep them if both times gave the same bytes.

``twine check`` reads what they say of themselves. The wheel is then installed alone into new environments, with the
newest and with the oldest versions of what it asks for. In each a clip is synthesized and restored, and the source
archive replaces the wheel. ``--environment FOLDER`` takes an environment that has the newest versions already.
``--tag v0.2.0`` checks that the tag is the version; ``--no-trial`` leaves the installation out.
"""

import argparse
import gzip
import io
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
from pathlib import Path

from find_links import find_links

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tag")
    parser.add_argument("--no-trial", action="store_true")
    parser.add_argument("--environment", type=Path)
    options = parser.parse_args()
    version = re.search(r'__version__ = "(.+)"', (ROOT / "turbrestore" / "__init__.py").read_text())[1]
    if options.tag not in (None, f"v{version}"):
        sys.exit(f"release: expected the tag v{version}, found {options.tag}; set the version or the tag right")
    if links := find_links():
        os.environ.setdefault("UV_FIND_LINKS", links)
    time = os.environ.get("SOURCE_DATE_EPOCH") or output("git", "log", "-1", "--format=%ct")
    with tempfile.TemporaryDirectory() as folder:
        first, second = (build(Path(folder, name), int(time)) for name in ("first", "second"))
        if {path.name: path.read_bytes() for path in first} != {path.name: path.read_bytes() for path in second}:
            sys.exit("release: two builds of the same source differ")
        subprocess.run([sys.executable, "-m", "twine", "check", "--strict", *first], check=True)
        (ROOT / "dist").mkdir(exist_ok=True)
        kept = [Path(shutil.copy(path, ROOT / "dist")) for path in first]
        if not options.no_trial:
            for name, environment in (("newest", options.environment), ("oldest", None)):
                trial = Path(folder, name)
                trial.mkdir()
                constraints = [] if name == "newest" else ["-c", ROOT / "constraints-lowest.txt"]
                try_out(trial, environment, constraints, *sorted(kept, key=lambda path: path.suffix != ".whl"))
    print("\n".join(str(path.relative_to(ROOT)) for path in kept))


def build(folder: Path, time: int) -> list[Path]:
    """Build from what is committed: the source archive, and the wheel from that."""
    os.umask(0o022)
    source, made = folder / "source", folder / "made"
    source.mkdir(parents=True)
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(source, filter="data")
    environment = {**os.environ, "SOURCE_DATE_EPOCH": str(time)}
    words = [sys.executable, "-m", "build", "--installer", "uv", "--outdir", str(made)]
    subprocess.run([*words, "--sdist", str(source)], check=True, env=environment, stdout=subprocess.DEVNULL)
    (sdist,) = made.glob("*.tar.gz")
    settle(sdist, time)
    with tarfile.open(sdist) as tar:
        tar.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    subprocess.run([*words, "--wheel", str(unpacked)], check=True, env=environment, stdout=subprocess.DEVNULL)
    return sorted(made.iterdir())


def settle(path: Path, time: int) -> None:
    """Write an archive again without times, owners and an order that differ from build to build."""
    settled = io.BytesIO()
    with tarfile.open(path) as old, tarfile.open(fileobj=settled, mode="w", format=tarfile.PAX_FORMAT) as new:
        for member in sorted(old.getmembers(), key=lambda item: item.name):
            member.mtime, member.uid, member.gid, member.uname, member.gname = time, 0, 0, "", ""
            member.mode, member.pax_headers = 0o755 if member.isdir() or member.mode & 0o100 else 0o644, {}
            new.addfile(member, old.extractfile(member) if member.isfile() else None)
    path.write_bytes(gzip.compress(settled.getvalue(), mtime=time))


def try_out(folder: Path, environment: Path | None, constraints: list, wheel: Path, archive: Path) -> None:
    """Install the wheel alone, with what it asks for, and restore a clip; then the source archive in its place."""
    scripts = (environment or folder / "environment").absolute() / ("Scripts" if sys.platform == "win32" else "bin")
    pip = [scripts / "python", "-m", "pip"]
    replace = [*pip, "install", "--quiet", "--no-deps", "--force-reinstall"]
    if environment is None:
        venv.create(scripts.parent, with_pip=True)
        install = [sys.executable, "-m", "uv", "pip", "install", "--quiet", "--only-binary", ":all:"]
        subprocess.run([*install, "--python", scripts / "python", *constraints, f"{wheel}[report]"], check=True)
    else:
        subprocess.run([*replace, wheel], check=True)
        subprocess.run([*pip, "check"], check=True)
    for words in (
        ["synthesize", "chart", "haze.mkv", "--frames", "12", "--size", "96x96", "--strength", "weak"],
        ["restore", "haze.mkv", "sharp.png", "--report", "sharp.html"],
    ):
        subprocess.run([scripts / "turbrestore", *words], cwd=folder, check=True)
    assert (folder / "sharp.html").stat().st_size > 10_000
    subprocess.run([*replace, archive], check=True)
    subprocess.run([scripts / "turbrestore", "sample", "sample"], cwd=folder, check=True)
    assert (folder / "sample" / "chart.mkv").exists()


def output(*words: str) -> str:
    return subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    main()
