"""Every command and every piece of Python that the pages print runs, in the order of the page, on small clips.

Files that a page takes as given are stand-ins.  What a command computes is made small.
"""

import re
import shlex
import tomllib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.video import open_frames, write_video
from turbrestore_cli.__main__ import main
from turbrestore_cli.commands import build

ROOT = Path(__file__).parents[2]
PAGES = sorted(path for path in (ROOT / "docs").rglob("*.md") if not {"_build", "jupyter_execute"} & set(path.parts))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES]
BLOCK = re.compile(r"(?ms)^( *)```(bash|python|)\n(.*?)^\1```$")
VIDEOS = {
    "haze.mp4",
    "haze.mkv",
    "clip.mkv",
    "phone.mp4",
    "wide.mkv",
    "moon.ser",
    "night.ser",
    "darks.ser",
    "moon.fits",
    "clip.npy",
}
VIDEOS |= {"red.ser", "green.ser", "blue.ser", "infrared.ser"}
FOLDERS = {"flats"}
IMAGES = {"photo.png", "mask.png"}
# Settings that take less time.  Numbers of frames become those of the stand-ins.
STEPS = ["--deconvolution.iterations", "3", "--quiet"]
QUICK = {
    "restore": ["--centroid.iterations", "1", "--filter.inner-iterations", "1", *STEPS],
    "register": ["--centroid.iterations", "1", "--filter.inner-iterations", "1", "--quiet"],
    "deconvolve": STEPS,
    "synthesize": ["--frames", "4", "--quiet"],
    "steady": ["--frames", "0:4", "--quiet"],
    "moments": ["--seeds", "2"],
}
SMALLER = {"--frames": "0:4", "--roi": "0,0,48,48", "--train": "3", "--seeds": "2", "--size": "96x96", "--reach": "2"}
# What serves until it is interrupted, or needs a machine that is not there: tests/app and tests/cli start the like.
ELSEWHERE = re.compile(r"turbrestore (app|sample|--install-completion)\b|--scheduler|--workers|cuda|\||\[")
# What writes no file that a page goes on with is understood here, and run by tests/cli: experiments, and batches, which
# take processes of their own.
PARSED = {"moments", "batch"}


def parts(page):
    """Commands of a page, and its pieces of Python, in order."""
    for _, kind, text in BLOCK.findall(page.read_text("utf-8")):
        if kind == "python":
            yield kind, text
        else:
            yield from (("command", line.strip()) for line in text.replace("\\\n", " ").splitlines())


def commands(page):
    return [text for kind, text in parts(page) if kind == "command" and text.startswith("turbrestore ")]


def smaller(line, reports):
    """Words of a command, with numbers that take less time."""
    words = shlex.split(line.partition(" # ")[0])[1:]
    taken = [SMALLER.get(before, word) for before, word in pairwise(["", *words])]
    if not reports:
        taken = drop(taken, "--report")
    if words[0] == "synthesize":
        is_scene = words[1].isalpha() and words[1] != "centroid"
        taken += ["--size", "72x72"] if is_scene and "--size" not in words else []
        taken += ["--layers", "2", "--pupil-samples", "24"] if is_scene and "--like" not in words else []
        taken = drop(taken, "--frames")
    if words[0] in ("steady", "moments"):
        taken = drop(taken, "--frames" if words[0] == "steady" else "--seeds")
    if words[0] in ("synthesize", "restore"):
        # A page may show two ways to the same file.
        taken.append("--overwrite")
    blurred = words[0] == "restore" and not {"--sigma", "--config"} & set(words)
    return [*taken, *QUICK.get(words[0], []), *(["--sigma", "1"] if blurred else [])]


def drop(words, option):
    """Leave an option and its value out."""
    return [word for before, word in pairwise(["", *words]) if option not in (before, word)]


def provide(words, frames):
    """Make the files that a command reads and that no earlier one has made; its third word is what it writes."""
    for name in {word for index, word in enumerate(words) if index != 2 or words[0] == "evaluate"}:
        path = Path(name)
        if path.exists():
            continue
        if name in VIDEOS:
            save(path, frames)
        elif name in FOLDERS:
            path.mkdir()
            for index, frame in enumerate(frames):
                write_image(path / f"{index}.png", frame, 8)
        elif name in IMAGES:
            write_image(path, np.pad(np.ones((48, 48), np.float32), 12), 8)


def save(path, frames):
    if path.suffix == ".fits":
        from astropy.io import fits

        fits.PrimaryHDU((255 * frames).astype(np.uint8)).writeto(path)
    elif path.suffix == ".npy":
        np.save(path, frames)
    else:
        write_video(path, frames, 25)


@pytest.fixture(scope="module")
def frames():
    return open_frames(ROOT / "sample_data" / "chart.mkv", roi=(32, 32, 72, 72)).read(0, 4)


@pytest.fixture
def folder(tmp_path, monkeypatch, frames):
    """A folder to work in, with a part of the sample clip and of its truth."""
    samples = tmp_path / "sample_data"
    samples.mkdir()
    write_video(samples / "chart.mkv", frames, 25)
    write_image(samples / "chart_truth.png", read_image(ROOT / "sample_data/chart_truth.png").image[32:104, 32:104], 16)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def with_something(pages):
    return [page for page in pages if any(kind == "python" for kind, _ in parts(page)) or commands(page)]


@pytest.mark.long
@pytest.mark.parametrize("page", with_something(PAGES), ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_prints_runs(page, folder, frames, capsys):
    names = {}
    for kind, text in parts(page):
        if kind == "python":
            provide(["", *re.findall(r'"([\w.]+)"', text)], frames)
            for name in re.findall(r'write_\w+\("([\w.]+)"', text):
                Path(name).unlink(missing_ok=True)
            exec(compile(text, str(page), "exec"), names)
        elif text.startswith("turbrestore ") and not ELSEWHERE.search(text):
            # A report takes longer than the rest; that of the first command is enough.
            words = smaller(text, reports=text.endswith("--report chart.html"))
            if words[0] in PARSED:
                build().parse_args(words, exit_on_error=False)
                continue
            provide(words, frames)
            assert main(words) == 0, f"{text}\n{capsys.readouterr().err}"


def test_the_pages_have_commands():
    found = [command for page in PAGES for command in commands(page)]
    assert len(found) > 40
    # The one whose report is made.
    assert any(command.endswith("--report chart.html") for command in found)


def test_extras_that_pages_name_exist():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    for page in PAGES:
        for names in re.findall(r"'\.\[([\w,]+)\]'", page.read_text("utf-8")):
            assert set(names.split(",")) <= set(extras), page


def test_benchmarks_that_pages_name_exist_with_their_options():
    for page in PAGES:
        for name, rest in re.findall(r"python (benchmarks/\w+\.py)([^`\n]*)", page.read_text("utf-8")):
            script = (ROOT / name).read_text("utf-8")
            for option in re.findall(r"--[a-z][\w-]+", rest):
                assert f'"{option}"' in script or "add_help" in script, f"{name} {option} in {page}"
