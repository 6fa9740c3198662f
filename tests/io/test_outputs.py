"""Outputs are whole or not there, never on top of an input, and nothing is left where they fail."""

import os
import shutil
import subprocess
import sys
from collections import namedtuple
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.errors import OutputError, StorageError
from turbrestore.filtering.estimates import Gaussian, PixelGaussian
from turbrestore.filtering.filter_records import FilterCheckpoint, FilterState
from turbrestore.io.images.image_files import write_image
from turbrestore.io.output import atomic_write, check_output, check_space
from turbrestore.io.video import VIDEO_OUTPUT_SUFFIXES, write_video
from turbrestore.registration.centroid import Centroid
from turbrestore.runs.checkpoint import save_checkpoint
from turbrestore.runs.stage_files import save_artifact, save_flows
from turbrestore_cli.__main__ import main
from turbrestore_cli.output import write_settings

IMAGE = np.random.default_rng(0).uniform(size=(64, 64)).astype(np.float32)
FLOWS = np.zeros((2, 64, 64, 2), np.float32)
STATE = FilterState(
    PixelGaussian(IMAGE, IMAGE), Gaussian(np.zeros(1), np.eye(1)), *np.zeros((2, *IMAGE.shape, 2), np.float32)
)
CHECKPOINT = FilterCheckpoint(STATE, (), IMAGE)

# Everything that is written goes through one of these.
WRITERS = {
    "image.png": lambda path: write_image(path, IMAGE, 16),
    "image.tif": lambda path: write_image(path, IMAGE, 32),
    "artifact.npz": lambda path: save_artifact(path, Centroid(IMAGE, FLOWS, np.zeros(1), True)),
    "flows.npy": lambda path: save_flows(path, FLOWS),
    "checkpoint.npz": lambda path: save_checkpoint(path, CHECKPOINT, "key"),
    "settings.toml": lambda path: write_settings(path, {"text": "long " * 1000}),
    "page.html": lambda path: atomic_write(path, b"<p>" * 2000),
    **{
        f"video{suffix}": lambda path: write_video(path, [IMAGE] * 3, 25, bit_depth=8)
        for suffix in VIDEO_OUTPUT_SUFFIXES
    },
}

resource = pytest.importorskip("resource", reason="the size of files is limited by a call that Windows lacks")


@contextmanager
def small_files():
    """No file grows beyond 2 KiB, as on a full disk.

    Not a fixture: pytest would write its report, which may be a file, while the limit holds.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", WRITERS)
class TestWriters:
    def test_what_breaks_off_leaves_nothing(self, tmp_path, name):
        with pytest.raises(StorageError, match=f"{name}.*nothing was saved"), small_files():
            WRITERS[name](tmp_path / name)
        assert list(tmp_path.iterdir()) == []

    def test_an_interruption_leaves_nothing(self, tmp_path, monkeypatch, name):
        def interrupt(_):
            raise KeyboardInterrupt

        monkeypatch.setattr("turbrestore.io.output.os.fsync", interrupt)
        with pytest.raises(KeyboardInterrupt):
            WRITERS[name](tmp_path / name)
        assert list(tmp_path.iterdir()) == []

    def test_it_is_flushed_before_it_takes_its_name(self, tmp_path, monkeypatch, name):
        seen, fsync = [], os.fsync

        def flush(descriptor):
            [part] = tmp_path.iterdir()
            seen.append((part.suffix, os.fstat(descriptor).st_size))
            fsync(descriptor)

        monkeypatch.setattr("turbrestore.io.output.os.fsync", flush)
        WRITERS[name](tmp_path / name)
        [written] = tmp_path.iterdir()
        assert written.name == name
        assert seen == [(".part", written.stat().st_size)]


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("clip") / "clip.npy"
    np.save(path, make_sequence(seed=51, count=6, size=32, scene="camera", rms=0.5).frames)
    return path


QUICK = ["--centroid.iterations=1", "--deconvolution.iterations=2", "--quiet"]


@pytest.fixture
def place(tmp_path, monkeypatch, clip):
    shutil.copy(clip, tmp_path / "clip.npy")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def disk_with(monkeypatch, free):
    """Have every disk say that it has so many bytes left; the folders that are asked about."""
    asked, usage = [], namedtuple("usage", "total used free")
    monkeypatch.setattr(
        "turbrestore.io.output.shutil.disk_usage", lambda folder: asked.append(folder) or usage(1 << 30, 0, free)
    )
    return asked


def fails(capsys, words, code, part):
    assert main(words) == code
    err = capsys.readouterr().err
    assert err.startswith("turbrestore: ")
    assert err.count("\n") == 1
    assert part in err


@pytest.mark.parametrize(("more", "free"), [([], 500_000), (["--keep=kept"], 1_100_000)], ids=["image", "stages"])
def test_a_disk_that_is_too_full_is_told_before_the_work(place, monkeypatch, capsys, more, free):
    disk_with(monkeypatch, free)
    monkeypatch.setattr("turbrestore.pipeline.centroid_steps", None)
    fails(capsys, ["restore", "clip.npy", "o.png", *more, *QUICK], StorageError.exit_code, "make room on the disk")
    assert [path.name for path in place.iterdir()] == ["clip.npy"]


@pytest.mark.parametrize(
    ("words", "stage"),
    [
        (["centroid", "clip.npy", "c.npz"], "stages.centroid_steps"),
        (["flow", "centroid.npz", "clip.npy", "f.npy"], "stages.iterate_flows"),
        (["identify", "centroid.npz", "d.npz"], "stages.identify_flows"),
        (["filter", "clip.npy", "centroid.npz", "dynamics.npz", "o.tif"], "stages.filter_steps"),
        (["synthesize", "chart", "s.mkv", "--size=256x256", "--frames=9"], "synthesis._write_frames"),
    ],
)
def test_every_stage_asks_for_room_before_the_work(place, monkeypatch, capsys, words, stage):
    assert main(["restore", "clip.npy", "o.png", "--keep=kept", "--sigma=0", *QUICK]) == 0
    for name in ("centroid.npz", "dynamics.npz"):
        (place / "kept" / name).rename(place / name)
    disk_with(monkeypatch, 1 << 20)
    monkeypatch.setattr(f"turbrestore_cli.{stage}", None)
    before = sorted(place.iterdir())
    fails(capsys, [*words, "--quiet"], StorageError.exit_code, "make room on the disk")
    assert sorted(place.iterdir()) == before


def test_room_is_asked_for_with_a_margin(tmp_path):
    free = shutil.disk_usage(tmp_path).free
    check_space(tmp_path / "o.png", free // 2)
    with pytest.raises(StorageError, match="make room"):
        check_space(tmp_path / "o.png", free)


def test_room_is_asked_for_in_the_folder_itself_or_that_of_a_file(tmp_path, monkeypatch):
    asked = disk_with(monkeypatch, 1 << 30)
    for path in (tmp_path, tmp_path / "o.png", tmp_path / "new"):
        check_space(path, 1)
    assert asked == [tmp_path.resolve()] * 3


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["mean.npy", "o.png", "--keep=."], "already"),
        (["clip.npy", "kept/mean.png", "--keep=kept"], "already"),
        (["clip.npy", "o.png", "--keep=linked"], "is the input"),
    ],
)
def test_kept_stages_replace_neither_input_nor_output(place, capsys, words, part):
    (place / "clip.npy").rename(words[0])
    (place / "kept").mkdir()
    (place / "linked").mkdir()
    (place / "linked" / "mean.npy").hardlink_to(words[0])
    data = (place / words[0]).read_bytes()
    fails(capsys, ["restore", *words, "--overwrite", *QUICK], OutputError.exit_code, part)
    assert (place / words[0]).read_bytes() == data


def test_a_folder_that_is_no_folder_cannot_hold_an_output(place, capsys):
    fails(capsys, ["restore", "clip.npy", "clip.npy/o.png"], OutputError.exit_code, "does not exist")
    (place / "loop").symlink_to("loop")
    fails(capsys, ["restore", "clip.npy", "loop/o.png"], OutputError.exit_code, "loop")


@pytest.mark.parametrize("kind", ["pipe", "link to a device", "link to a pipe"])
def test_what_is_no_file_is_not_replaced(tmp_path, kind):
    path = tmp_path / "o.png"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "link to a device":
        path.symlink_to("/dev/full")
    else:
        os.mkfifo(tmp_path / "pipe")
        path.symlink_to("pipe")
    with pytest.raises(OutputError, match="o.png: is a device or a pipe"):
        check_output(path, overwrite=True)


@pytest.mark.long
def test_no_command_opens_a_socket(place):
    """Everything runs in a process that would end with 99 if it did."""
    commands = [
        ["synthesize", "chart", "clip.mkv", "--frames=4", "--size=64x64", "--quiet"],
        ["info", "clip.mkv"],
        ["info", "clip.npy"],
        ["restore", "clip.mkv", "o.png", "--keep=kept", "--report=r.html", "--sigma=1", *QUICK],
        ["report", "kept", "--quiet"],
        ["deconvolve", "kept/filtered.npz", "d.png", "--sigma=1", "--deconvolution.iterations=2", "--quiet"],
        ["evaluate", "o.png", "--reference=d.png"],
        ["config", "--init=run.toml"],
    ]
    code = (
        "import os, sys\n"
        "sys.addaudithook(lambda event, _: os._exit(99) if event.startswith('socket.') else None)\n"
        "from turbrestore_cli.__main__ import main\n"
        f"sys.exit(max(main(words) for words in {commands}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=place)
    assert done.returncode == 0, done.stderr
    assert Path(place / "r.html").exists()
