"""A run that dies goes on where it stopped, and ends as if nothing had happened."""

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.errors import ConfigurationError, DataError, OutputError
from turbrestore.filtering.filter_records import FilterCheckpoint, FilterParams, FilterState, FrameRecord
from turbrestore.filtering.image_state import PixelGaussian
from turbrestore.filtering.kalman import Gaussian
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames, write_video
from turbrestore.memory_plan import plan_memory
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams
from turbrestore.runs.checkpoint import load_checkpoint, save_checkpoint
from turbrestore.runs.dependencies import stage_dependencies
from turbrestore.runs.digests import content_digest
from turbrestore.runs.folder_lock import LOCK, lock_folder
from turbrestore.runs.run_files import load_run, read_stages
from turbrestore.runs.run_folder import RunFolder
from turbrestore.runtime.runtime import DEFAULT
from turbrestore_cli.__main__ import main

SETTINGS = ["--train=8", "--centroid.iterations=1", "--filter.block=8", "--deconvolution.iterations=3"]
OFTEN = "--checkpoint-every=8"
STAGES = ("centroid_steps", "identify", "filter_steps", "remove_blur_steps")
WORDS = ["restore", "clip.mkv", "sharp.png", "--keep=kept", OFTEN, *SETTINGS]


@pytest.fixture(scope="module")
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
        module = "turbrestore.pipeline" if name == "remove_blur_steps" else "turbrestore.fusion"
        real = getattr(sys.modules[module], name)

        def counted(*arguments, real=real, name=name, **named):
            called.append(name)
            return real(*arguments, **named)

        monkeypatch.setattr(f"{module}.{name}", counted)
    return called


PLACES = {
    "centroid": ("turbrestore.fusion.centroid_steps", 1),
    "flow model": ("turbrestore.fusion.identify", 1),
    "first block": ("turbrestore.filtering.alternating.pass_over", 1),
    "third block": ("turbrestore.filtering.alternating.pass_over", 4),
    "deconvolution": ("turbrestore.pipeline.remove_blur_steps", 1),
    "kept images": ("turbrestore_cli.output.write_image", 2),
    "output": ("turbrestore_cli.restore.write_result", 1),
    "settings": ("turbrestore_cli.restore.write_settings", 1),
}


@pytest.mark.parametrize("where", PLACES)
def test_an_interrupted_run_ends_as_if_nothing_had_happened(whole, place, capsys, where):
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, *PLACES[where])
        assert main(WORDS) == 130
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("turbrestore: interrupted; --keep kept --resume continues")
    assert not (place / "kept" / LOCK).exists()
    assert main([*WORDS, "--resume"]) == 0
    assert contents(place) == contents(whole)


def test_what_is_done_is_not_done_again(place, monkeypatch):
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, "turbrestore.filtering.alternating.pass_over", 4)
        main(WORDS)
    # Eight training frames, then blocks of eight: two are done and kept.
    kept = RunFolder("kept", open_frames("clip.mkv"), params_of(WORDS), resume=True)
    assert len(kept.filter_start().records) == 16
    called, blocks = spy(monkeypatch), []
    real = sys.modules["turbrestore.filtering.alternating"].pass_over
    monkeypatch.setattr(
        "turbrestore.filtering.alternating.pass_over", lambda *words: blocks.append(words[4]) or real(*words)
    )
    assert main([*WORDS, "--resume"]) == 0
    assert called == ["filter_steps", "remove_blur_steps"]
    # The third block begins anew, then it is finished while the fourth begins.
    assert blocks == [0, 8, 4]


def params_of(words):
    from turbrestore_cli.application import build

    _, bound, _ = build().parse_args(words, exit_on_error=False, print_error=False)
    return bound.arguments["params"]


def test_a_checkpoint_is_as_far_back_as_asked_for_at_most(place, monkeypatch):
    saved = []
    monkeypatch.setattr(
        "turbrestore.runs.run_folder.save_checkpoint", lambda _, checkpoint, key: saved.append(len(checkpoint.records))
    )
    main([word.replace("every=8", "every=18") for word in WORDS])
    # The next block of eight would end 24 frames after the last checkpoint.
    assert saved == [16, 28]


@pytest.mark.parametrize(
    ("change", "first", "said"),
    [
        (["--flow.dis.smoothness=9"], 0, "centroid: flow.dis.smoothness was 6.0 and is 9"),
        (["--centroid.iterations=2"], 0, "centroid: centroid.iterations was 1 and is 2"),
        (["--train=9"], 0, "centroid: training_frames was [0, 8, 1] and is [0, 9, 1]"),
        (["--roi=0,0,32,30"], 0, "centroid: region was"),
        (["--dynamics.rank=2"], 1, "flow model: dynamics.rank was None and is 2"),
        (["--filter.sharpness=1"], 2, "filter: filter.sharpness was None and is 1"),
        (["--keep-best=50%"], 2, "filter: keep_best was 1"),
        (["--frames=0:20"], 0, "centroid: frames was [0, 28, 1] and is [0, 20, 1]"),
        (["--sigma=1"], 3, "deconvolution: deconvolution.sigma was None and is 1"),
        (["--threads=1", "--border=crop"], 4, "continues after the deconvolution"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_changed_setting_concerns_what_depends_on_it(ended, monkeypatch, capsys, change, first, said):
    called = spy(monkeypatch)
    flags = {word.split("=")[0] for word in change}
    same = [word for word in WORDS if word.split("=")[0] not in flags]
    assert main([*same, "--resume", "--overwrite", *change]) == 0
    assert called == list(STAGES[first:])
    assert said in capsys.readouterr().err


def test_what_starts_again_is_what_a_new_run_gives(ended):
    change = ["--filter.sharpness=1", "--overwrite"]
    assert main([*WORDS, "--resume", *change]) == 0
    resumed = contents(ended)
    assert main([*WORDS, *change]) == 0
    assert contents(ended) == resumed


def test_every_setting_belongs_to_one_stage_or_changes_nothing_that_is_kept():
    source = FrameSource.from_array(np.zeros((60, 32, 32), np.float32))
    params = RestoreParams()
    facts = stage_dependencies(source, params, plan_memory(source.shape, params, DEFAULT))
    held = {name for stage in facts.values() for name in stage}
    # What the number of training frames changes is which frames these are.
    idle = {"until", "border", "train", "scale"}
    assert {item.name for item in dataclasses.fields(RestoreParams)} - held == idle
    assert sum(len(stage) for stage in facts.values()) == len(held)
    assert set(dataclasses.asdict(params.flow)) == set(facts["centroid"]["flow"])


def test_another_version_starts_again(ended, monkeypatch, capsys):
    called = spy(monkeypatch)
    newer = {**sys.modules["turbrestore.runs.dependencies"].versions(), "numpy": "9.9"}
    monkeypatch.setattr("turbrestore.runs.dependencies.versions", lambda: newer)
    assert main([*WORDS, "--resume", "--overwrite"]) == 0
    assert called == list(STAGES)
    assert "versions.numpy was" in capsys.readouterr().err


def test_a_version_with_other_results_starts_again(ended, monkeypatch, capsys):
    called = spy(monkeypatch)
    monkeypatch.setattr("turbrestore.runs.dependencies._RESULTS", 1000)
    assert main([*WORDS, "--resume", "--overwrite"]) == 0
    assert called == list(STAGES)
    assert "results was" in capsys.readouterr().err


def test_a_folder_of_an_earlier_layout_starts_again(whole, ended, monkeypatch, capsys):
    path = ended / "kept" / "run.json"
    record = json.loads(path.read_text())
    for reading in record["deblurred"]["readings"]:
        del reading["ringing"]
    path.write_text(json.dumps(record | {"schema": 2}))
    with pytest.raises(DataError, match="layout 4, found layout 2"):
        load_run("kept")
    called = spy(monkeypatch)
    assert main([*WORDS, "--resume", "--overwrite"]) == 0
    assert called == list(STAGES)
    assert "starts again: an earlier version of turbrestore kept these stages" in capsys.readouterr().err
    assert contents(ended) == contents(whole)


def test_a_changed_input_starts_again_and_a_touched_one_does_not(ended, monkeypatch, capsys):
    called = spy(monkeypatch)
    os.utime("clip.mkv", (1, 1))
    assert main([*WORDS, "--resume", "--overwrite"]) == 0
    assert called == []
    frames = open_frames("clip.mkv").read()
    frames[-1, 20, 20] = 1 - frames[-1, 20, 20]
    write_video("clip.mkv", frames, 25, overwrite=True)
    capsys.readouterr()
    assert main([*WORDS, "--resume", "--overwrite"]) == 0
    assert called == list(STAGES)
    assert "starts again at the centroid: the content of the input has changed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "change"),
    [("centroid.npz", "cut"), ("filtered.npz", "lost"), ("mean.npy", "other"), ("blur.npz", "lost")],
)
def test_files_that_are_not_what_was_written_are_made_again(whole, ended, capsys, name, change):
    path = ended / "kept" / name
    data = path.read_bytes()
    path.unlink()
    if change != "lost":
        path.write_bytes(data[: len(data) // 2] if change == "cut" else data.replace(b"\x00", b"\x01", 1))
    assert main([*WORDS, "--resume", "--overwrite"]) == 0
    assert f"{name} is missing or damaged and is made again" in capsys.readouterr().err
    assert contents(ended) == contents(whole)


def test_a_damaged_checkpoint_costs_the_filter_only(whole, place, monkeypatch, capsys):
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, "turbrestore.filtering.alternating.pass_over", 4)
        main(WORDS)
    path = place / "kept" / "checkpoint.npz"
    path.write_bytes(path.read_bytes()[:-40])
    called = spy(monkeypatch)
    assert main([*WORDS, "--resume"]) == 0
    assert called == ["filter_steps", "remove_blur_steps"]
    assert "checkpoint.npz: expected a checkpoint" in capsys.readouterr().err
    assert contents(place) == contents(whole)


def test_a_damaged_record_is_one_line(ended, capsys):
    (ended / "kept" / "run.json").write_text('{"schema": 1}')
    assert main([*WORDS, "--resume", "--overwrite"]) == DataError.exit_code
    assert capsys.readouterr().err.count("\n") == 1


class TestFolder:
    def test_resuming_nothing_just_starts(self, whole, place):
        (place / "kept").mkdir()
        assert main([*WORDS, "--resume", "--quiet"]) == 0
        assert contents(place) == contents(whole)

    def test_without_resume_a_folder_in_use_is_refused_or_starts_anew(self, ended, monkeypatch, capsys):
        called = spy(monkeypatch)
        words = [word.replace("sharp", "other") for word in WORDS]
        assert main(words) == OutputError.exit_code
        assert "resume the run in it" in capsys.readouterr().err
        assert main([*words, "--overwrite"]) == 0
        assert called == list(STAGES)

    def test_a_folder_with_something_else_is_refused(self, place, capsys):
        (place / "kept").mkdir()
        (place / "kept" / "letter.txt").write_text("dear")
        assert main([*WORDS, "--resume"]) == OutputError.exit_code
        assert "holds no run to go on with" in capsys.readouterr().err
        assert [path.name for path in (place / "kept").iterdir()] == ["letter.txt"]

    def test_resume_needs_a_folder_and_checkpoints_a_distance(self, place, capsys):
        assert main(["restore", "clip.mkv", "o.png", "--resume"]) == ConfigurationError.exit_code
        assert main([word.replace("every=8", "every=0") for word in WORDS]) == ConfigurationError.exit_code
        assert capsys.readouterr().err.count("\n") == 2
        assert [path.name for path in place.iterdir()] == ["clip.mkv"]

    def test_a_complete_result_is_not_replaced_unasked(self, ended, capsys):
        assert main([*WORDS, "--resume"]) == OutputError.exit_code
        assert "sharp.png: exists already" in capsys.readouterr().err

    def test_a_second_run_in_the_folder_is_refused(self, place, capsys):
        with lock_folder("kept"):
            assert main([*WORDS, "--resume"]) == OutputError.exit_code
        assert "another run is at work in this folder" in capsys.readouterr().err
        assert [path.name for path in place.iterdir()] == ["clip.mkv"]

    def test_the_lock_dies_with_its_owner(self, place):
        importing = "from turbrestore.runs.folder_lock import lock_folder"
        code = f"{importing}\nwith lock_folder('kept'):\n print(flush=True); input()"
        with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as owner:
            owner.stdout.readline()
            with pytest.raises(OutputError, match="another run"), lock_folder(place / "kept"):
                pass
            owner.kill()
        with lock_folder(place / "kept") as locks:
            assert locks

    def test_a_file_system_without_locks_is_told(self, place, monkeypatch, capsys):
        monkeypatch.setattr("turbrestore.runs.folder_lock._lock", lambda _: False)
        assert main([*WORDS, "--until=centroid"]) == 0
        assert "does not support locks" in capsys.readouterr().err


# The run waits for a signal after a checkpoint, so that it does not come too late on a fast machine.  It may come
# before the wait as well: hence the alarm.
WAITING = """
import signal, sys
from turbrestore.runs import run_folder
from turbrestore_cli.__main__ import main
save = run_folder.save_checkpoint
signal.signal(signal.SIGALRM, lambda *_: None)
def save_and_wait(*words):
    save(*words)
    signal.alarm(2)
    signal.pause()
run_folder.save_checkpoint = save_and_wait
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_signals(whole, place, number):
    command = [sys.executable, "-c", WAITING, *WORDS]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        while not (place / "kept" / "checkpoint.npz").exists() and process.poll() is None:
            time.sleep(0.005)
        process.send_signal(number)
        _, err = process.communicate()
    expected = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}[number]
    assert process.returncode == expected, err
    assert err.count("\n") == (0 if number == signal.SIGKILL else 1)
    assert not (place / "sharp.png").exists()
    parts = [path for path in place.rglob("*") if path.suffix == ".part"]
    assert len(parts) <= (number == signal.SIGKILL)
    assert main([*WORDS, "--resume", "--quiet"]) == 0
    assert contents(place) == contents(whole)


class TestContent:
    def test_copies_are_equal_and_changes_are_seen(self, tmp_path):
        frames = np.random.default_rng(0).uniform(size=(4, 16, 16)).astype(np.float32)
        np.save(tmp_path / "a.npy", frames)
        shutil.copy(tmp_path / "a.npy", tmp_path / "b.npy")
        frames[3, 15, 15] += 1e-6
        np.save(tmp_path / "c.npy", frames)
        first, copy, changed = (content_digest(open_frames(tmp_path / f"{name}.npy")) for name in "abc")
        assert first == copy != changed

    def test_of_a_folder_names_and_images_count(self, tmp_path):
        folder = tmp_path / "frames"
        folder.mkdir()
        for name in "ab":
            shutil.copy(Path(__file__).parents[2] / "sample_data" / "chart_truth.png", folder / f"{name}.png")
        before = content_digest(open_frames(folder))
        (folder / "notes.txt").write_text("no image")
        assert content_digest(open_frames(folder)) == before
        (folder / "b.png").rename(folder / "c.png")
        assert content_digest(open_frames(folder)) != before

    def test_a_huge_file_is_sampled(self, tmp_path, monkeypatch):
        monkeypatch.setattr("turbrestore.runs.digests._WHOLE", 1000)
        path = tmp_path / "a.npy"
        np.save(path, np.zeros((100, 64, 64), np.float32))
        source = open_frames(path)
        before = content_digest(source)
        assert content_digest(source) == before
        with path.open("r+b") as file:
            file.seek(800_000)
            file.write(b"\1")
        os.utime(path, (1, 1))
        assert content_digest(source) != before


def test_a_checkpoint_comes_back_bit_for_bit(tmp_path):
    rng = np.random.default_rng(0)
    for rank, shape in ((0, (5, 4)), (3, (5, 4, 3))):
        image = PixelGaussian(rng.normal(size=shape).astype(np.float32), rng.uniform(size=(5, 4)).astype(np.float32))
        flow = Gaussian(rng.normal(size=rank), 0.1 * np.eye(rank))
        records = tuple(FrameRecord(rng.normal(size=rank), 0.1 * k, np.nan, np.nan, 3.0) for k in range(4))
        state = FilterState(image, flow, *rng.normal(size=(2, 5, 4, 2)).astype(np.float32))
        save_checkpoint(tmp_path / "c.npz", FilterCheckpoint(state, records, 2 * image.mean), "key")
        found = load_checkpoint(tmp_path / "c.npz", "key")
        assert np.array_equal(found.reference, 2 * image.mean)
        assert found.reference.dtype == np.float32
        assert np.array_equal(found.state.image.mean, image.mean)
        assert found.state.image.mean.dtype == np.float32
        assert np.array_equal(found.state.image.variance, image.variance)
        assert np.array_equal(found.state.flow.cov, flow.cov)
        assert np.array_equal(found.state.flow_sum, state.flow_sum)
        assert np.array_equal(found.state.training_flow, state.training_flow)
        for one, other in zip(found.records, records, strict=True):
            assert np.array_equal(one.flow_state, other.flow_state)
            for name in ("gain", "innovation", "sharpness", "information"):
                assert np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)
    with pytest.raises(DataError, match="other frames or settings"):
        load_checkpoint(tmp_path / "c.npz", "other")


class Recorder:
    """A store that keeps everything in memory, and starts from a part of it."""

    def __init__(self, results=(), start=None):
        self.results, self.start, self.checkpoints = dict(results), start, []

    def get(self, name, compute):
        if name not in self.results:
            self.results[name] = compute()
        return self.results[name]

    def filter_start(self):
        return self.start

    def checkpoint(self, state):
        self.checkpoints.append(state)


def test_from_every_point_the_library_ends_the_same():
    grey = make_sequence(seed=42, count=16, size=32, scene="camera", rms=0.6).frames
    frames = grey[..., None] * np.float32([1, 0.8, 0.6])
    params = RestoreParams(
        train=8,
        keep_best=0.6,
        centroid=CentroidParams(iterations=1),
        filter=FilterParams(block=4, image_drift=1e-5),
    )
    params = replace(params, deconvolution=replace(params.deconvolution, iterations=2))
    first = Recorder()
    expected = restore(frames, params, store=first)
    names = list(first.results)
    assert names == ["centroid", "dynamics", "filtered", "mean", "deblurred"]
    assert [len(state.records) for state in first.checkpoints] == [8, 12, 16]
    points = [Recorder([(name, first.results[name]) for name in names[:count]]) for count in range(1, len(names) + 1)]
    points += [Recorder([(name, first.results[name]) for name in names[:2]], state) for state in first.checkpoints]
    for store in points:
        found = restore(frames, params, store=store)
        assert np.array_equal(found.image, expected.image)
        assert np.array_equal(found.mean, expected.mean)
        assert np.array_equal(found.filtered.shares, expected.filtered.shares)
        assert found.decisions == expected.decisions


def test_the_record_names_the_outputs_only_while_they_are_written(place):
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, "turbrestore_cli.restore.write_settings", 1)
        assert main(WORDS) == 130
    names = {Path(name).name for name in read_stages("kept")["outputs"]}
    assert names == {"sharp.png", "sharp.png.toml"}
    assert main([*WORDS, "--resume"]) == 0
    assert read_stages("kept")["outputs"] == []


def test_a_run_that_dies_twice_may_still_replace_its_own_outputs(place):
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, "turbrestore_cli.restore.write_settings", 1)
        assert main(WORDS) == 130
    assert (place / "sharp.png").exists()
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, "turbrestore.pipeline._crop", 1)
        assert main([*WORDS, "--resume"]) == 130
    assert main([*WORDS, "--resume"]) == 0
