"""The folder of --keep when a run has died early in it, or somebody else has put something into it."""

import contextlib
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.errors import DataError, OutputError
from turbrestore.io.images.image_files import write_image
from turbrestore.io.video import open_frames
from turbrestore.runs.digests import content_digest
from turbrestore.runs.folder_lock import LOCK, lock_folder
from turbrestore.runs.run_files import RECORD, read_stages
from turbrestore_cli.__main__ import main

SETTINGS = ["--train=6", "--centroid.iterations=1", "--sigma=1", "--deconvolution.iterations=2"]
WORDS = ["restore", "clip.npy", "sharp.png", "--keep=kept", *SETTINGS]


@pytest.fixture(scope="module")
def frames():
    return make_sequence(seed=61, count=8, size=32, scene="camera", rms=0.5).frames


@pytest.fixture
def place(tmp_path, monkeypatch, frames):
    """Folder with a clip, to work in."""
    np.save(tmp_path / "clip.npy", frames)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def whole(tmp_path_factory, frames):
    """Folder in which a run has ended."""
    folder = tmp_path_factory.mktemp("whole")
    np.save(folder / "clip.npy", frames)
    with contextlib.chdir(folder):
        assert main([*WORDS, "--quiet"]) == 0
    return folder


# The process dies at once in the first stage: before anything is written, and between two files.
DYING = """
import os, sys
from turbrestore.runs import run_files, run_folder
from turbrestore_cli.__main__ import main
where = sys.argv.pop(1)
real = run_folder.save_stage
def dying(path, *words, **named):
    if where == "after":
        real(path, *words, **named)
    os._exit(9)
def half(path, *words, **named):
    path.with_name(".0123456789abcdef.part").write_bytes(b"half")
    os._exit(9)
run_folder.save_stage = half if where == "within" else dying
if where == "record":
    run_files.atomic_write = half
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize("where", ["record", "before", "within", "after"])
def test_a_run_that_was_killed_in_its_first_stage_can_be_resumed(place, where):
    done = subprocess.run([sys.executable, "-c", DYING, where, *WORDS], capture_output=True, check=False)
    assert done.returncode == 9, done.stderr
    assert any((place / "kept").iterdir())
    assert main([*WORDS, "--resume", "--quiet"]) == 0
    assert (place / "sharp.png").exists()
    assert not [path for path in (place / "kept").iterdir() if path.suffix == ".part" or path.name == LOCK]


def test_a_run_that_fails_before_it_has_anything_leaves_nothing(place, monkeypatch):
    def fail(*_):
        raise DataError("no such luck")

    monkeypatch.setattr("turbrestore.pipeline.centroid_steps", fail)
    assert main(WORDS) == DataError.exit_code
    assert [path.name for path in place.iterdir()] == ["clip.npy"]


def test_an_interruption_right_after_a_file_is_written(place, monkeypatch, capsys):
    real = sys.modules["turbrestore.runs.run_folder"].save_stage

    def interrupted(*words, **named):
        real(*words, **named)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("turbrestore.runs.run_folder.save_stage", interrupted)
        assert main(WORDS) == 130
    assert "--resume continues from the start" in capsys.readouterr().err
    assert main([*WORDS, "--resume"]) == 0


def test_files_that_are_no_remains_of_a_run_stay(place, capsys):
    (place / "kept").mkdir()
    (place / "kept" / "letter.part").write_text("dear")
    assert main([*WORDS, "--resume"]) == OutputError.exit_code
    assert "holds no run to go on with" in capsys.readouterr().err
    assert (place / "kept" / "letter.part").read_text() == "dear"


@pytest.mark.parametrize("name", ["mean.png", "filtered.npz", "images.npz", "run.json", LOCK])
@pytest.mark.parametrize("more", [["--resume"], ["--overwrite"]], ids=str)
def test_nothing_is_written_through_a_link_in_the_folder(ended, capsys, name, more):
    (ended / "precious.txt").write_text("dear")
    (ended / "sharp.png").unlink()
    (ended / "sharp.png.toml").unlink()
    (ended / "kept" / name).unlink(missing_ok=True)
    (ended / "kept" / name).symlink_to(ended / "precious.txt")
    assert main([*WORDS, *more]) == OutputError.exit_code
    err = capsys.readouterr().err
    assert f"{name}: is a link" in err
    assert err.count("\n") == 1
    assert (ended / "precious.txt").read_text() == "dear"


@pytest.mark.parametrize("call", ["os.open", "fcntl.flock", "os.fstat"])
def test_a_signal_while_a_folder_is_being_held_leaves_nothing(tmp_path, monkeypatch, call):
    pytest.importorskip("fcntl", reason="Windows delivers no signals there")
    module, name = call.split(".")
    real, calls = getattr(sys.modules[module], name), []

    def interrupted(*words):
        found = real(*words)
        calls.append(found)
        if len(calls) == 1:
            raise KeyboardInterrupt
        return found

    monkeypatch.setattr(call, interrupted)
    with pytest.raises(KeyboardInterrupt), lock_folder(tmp_path / "kept"):
        pytest.fail("the folder was held")
    assert list(tmp_path.iterdir()) == []
    with lock_folder(tmp_path / "kept"):
        assert (tmp_path / "kept" / LOCK).exists()


def test_the_lock_is_made_where_it_belongs(tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / LOCK).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutputError, match="cannot be written to"), lock_folder(tmp_path / "kept"):
        pass
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("name", ["centroid.npz", RECORD])
def test_a_pipe_in_the_folder_holds_nobody_up(ended, capsys, name):
    (ended / "kept" / name).unlink()
    os.mkfifo(ended / "kept" / name)
    assert main([*WORDS, "--resume", "--overwrite"]) in (DataError.exit_code, OutputError.exit_code)
    assert capsys.readouterr().err.count("\n") == 1


DAMAGE = {
    "empty": lambda record: {},
    "outputs are numbers": lambda record: record | {"outputs": [1]},
    "verdict without readings": lambda record: record | {"deblurred": {"estimated": True}},
    "reading is a number": lambda record: record | {"deblurred": record["deblurred"] | {"readings": [1]}},
    "decisions are a text": lambda record: record | {"deblurred": record["deblurred"] | {"decisions": "abc"}},
}


def test_a_record_with_wrong_content_is_one_line_that_says_what_to_do(ended, capsys):
    path = ended / "kept" / RECORD
    whole = path.read_text()
    for case, damage in DAMAGE.items():
        path.write_text(json.dumps(damage(json.loads(whole))))
        with pytest.raises(DataError):
            read_stages("kept")
        assert main([*WORDS, "--resume", "--overwrite"]) == DataError.exit_code, case
        err = capsys.readouterr().err
        assert err.count("\n") == 1, case
        assert RECORD in err, case
        assert "start anew without resuming" in err, case


class TestFolderOfImages:
    @pytest.fixture
    def folder(self, place, frames):
        folder = place / "frames"
        folder.mkdir()
        for number, frame in enumerate(frames):
            write_image(folder / f"f{number}.png", frame, 8)
        return folder

    def test_only_its_frames_count(self, folder):
        before = content_digest(open_frames(folder))
        (folder / "old.png").mkdir()
        (folder / "gone.png").symlink_to("nowhere")
        os.mkfifo(folder / "pipe.png")
        (folder / ".hidden.png").write_bytes(b"anything")
        source = open_frames(folder)
        assert len(source) == 8
        assert content_digest(source) == before

    def test_names_need_not_be_text(self, place, folder, capsys):
        (folder / "f0.png").rename(folder / os.fsdecode(b"bad\xff.png"))
        words = ["restore", "frames", os.fsdecode(b"out\xff.png"), "--keep=kept", "--report=r.html", *SETTINGS]
        assert main(words) == 0, capsys.readouterr().err
        assert "out?.png" in (place / "r.html").read_text("utf-8")
        assert main(["report", "kept", "again.html"]) == 0
