"""A run that has ended, folders to work in, and what stops or watches the stages of a run."""

import json
import shutil
import sys

import pytest

from conftest import make_sequence
from turbrestore.io.video import write_video
from turbrestore_cli.__main__ import main

SETTINGS = ["--train=8", "--centroid.iterations=1", "--filter.block=8", "--deconvolution.iterations=3"]
OFTEN = "--checkpoint-every=8"
STAGES = ("centroid_steps", "identify", "filter_steps", "remove_blur_steps")
WORDS = ["restore", "clip.mkv", "sharp.png", "--keep=kept", OFTEN, *SETTINGS]


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """Folder in which a run has ended without interruption."""
    folder = tmp_path_factory.mktemp("whole")
    write_video(folder / "clip.mkv", make_sequence(seed=41, count=28, size=32, scene="camera", rms=0.6).frames, 25)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*WORDS, "--quiet"]) == 0
    return folder


@pytest.fixture
def place(whole, tmp_path, monkeypatch):
    """Folder with the clip, to work in."""
    shutil.copy(whole / "clip.mkv", tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def ended(whole, tmp_path, monkeypatch):
    """Folder in which a run has ended, to work in."""
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder):
    """Bytes of all files; of the record of the run all but times."""
    found = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    record = json.loads(found["kept/run.json"])
    del record["run"]["finished"], record["restoration"]["seconds"]
    return {**found, "kept/run.json": json.dumps(record)}


def interrupt(monkeypatch, name, call, error=KeyboardInterrupt):
    """Let the ``call``-th call of a function end as Ctrl-C would."""
    module, _, function = name.rpartition(".")
    __import__(module)
    real, calls = getattr(sys.modules[module], function), []

    def interrupted(*arguments, **named):
        calls.append(name)
        if len(calls) == call:
            raise error
        return real(*arguments, **named)

    monkeypatch.setattr(name, interrupted)


def spy(monkeypatch):
    """Names of the stages that are computed from now on."""
    called = []
    for name in STAGES:
        real = getattr(sys.modules["turbrestore.pipeline"], name)

        def counted(*arguments, real=real, name=name, **named):
            called.append(name)
            return real(*arguments, **named)

        monkeypatch.setattr(f"turbrestore.pipeline.{name}", counted)
    return called


def params_of(words):
    from turbrestore_cli.commands import build

    _, bound, _ = build().parse_args(words, exit_on_error=False, print_error=False)
    return bound.arguments["params"]
