"""What a resumed run makes again: what depends on something that is changed, damaged or lost."""

import dataclasses
import json
import os
import sys

import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.footage.checks.content import check_content, clean_source
from turbrestore.footage.sensor.calibration import calibrated, make_calibration
from turbrestore.io.source import FrameSource
from turbrestore.io.video import open_frames, write_video
from turbrestore.memory_plan import plan_memory
from turbrestore.pipeline import RestoreParams
from turbrestore.runs.dependencies import stage_dependencies
from turbrestore.runs.run_files import load_run
from turbrestore.runtime.runtime import DEFAULT
from turbrestore_cli.__main__ import main

from .conftest import STAGES, WORDS, contents, interrupt, spy


@pytest.mark.parametrize(
    ("change", "first", "said"),
    [
        (["--flow.dis.smoothness=9"], 0, "centroid: flow.dis.smoothness was 6.0 and is 9"),
        (["--centroid.iterations=2"], 0, "centroid: centroid.iterations was 1 and is 2"),
        (["--train=9"], 0, "centroid: training_frames was [0, 8, 1] and is [0, 9, 1]"),
        (["--roi=0,0,32,30"], 0, "centroid: region was"),
        (["--dynamics.rank=2"], 1, "flow model: dynamics.rank was None and is 2"),
        (["--filter.sharpness=2"], 2, "filter: filter.sharpness was 1.0 and is 2"),
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
    change = ["--filter.sharpness=2", "--overwrite"]
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


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_another_dark_frame_is_another_clip_however_it_is_read(tmp_path, channels, turned):
    rng = np.random.default_rng(0)
    frames = np.uint8(rng.integers(60, 200, (40, 40)) + rng.integers(0, 6, (8, 40, 40)))
    if turned:
        frames[5:] = frames[5:, ::-1, ::-1]
    np.save(tmp_path / "clip.npy", np.squeeze(np.repeat(frames[..., None], channels, axis=-1)))
    source, facts = open_frames(tmp_path / "clip.npy"), []
    for level in (None, 5, 9):
        dark = None if level is None else FrameSource.from_array(np.full_like(next(source.native()), level)[None])
        seen = source if dark is None else calibrated(source, make_calibration(source, dark, None))
        cleaned = clean_source(seen, check_content(seen))
        assert len(cleaned.shape) == 3
        params = RestoreParams()
        facts.append(stage_dependencies(cleaned, params, plan_memory(cleaned.shape, params, DEFAULT))["centroid"])
    assert facts[0] != facts[1] != facts[2]


def test_another_version_and_one_with_other_results_start_again(ended, monkeypatch, capsys):
    newer = {**sys.modules["turbrestore.runs.dependencies"].versions(), "numpy": "9.9"}
    for name, value, told in (("versions", lambda: newer, "versions.numpy was"), ("_RESULTS", 1000, "results was")):
        with monkeypatch.context() as patch:
            called = spy(patch)
            patch.setattr(f"turbrestore.runs.dependencies.{name}", value)
            assert main([*WORDS, "--resume", "--overwrite"]) == 0
            assert called == list(STAGES)
            assert told in capsys.readouterr().err


def test_a_folder_of_an_earlier_layout_starts_again(whole, ended, monkeypatch, capsys):
    path = ended / "kept" / "run.json"
    record = json.loads(path.read_text())
    for reading in record["deblurred"]["readings"]:
        del reading["ringing"]
    path.write_text(json.dumps(record | {"schema": 2}))
    with pytest.raises(DataError, match="layout 6, found layout 2"):
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
    ("name", "change", "said"),
    [
        ("centroid.npz", "cut", "from the start"),
        ("filtered.npz", "lost", "after the flow model"),
        ("deconvolution.npz", "lost", "after the filter"),
        ("mean.npy", "other", "after the deconvolution"),
        ("blur.npz", "lost", "after the deconvolution"),
    ],
)
def test_files_that_are_not_what_was_written_are_made_again(whole, ended, capsys, name, change, said):
    path = ended / "kept" / name
    data = path.read_bytes()
    path.unlink()
    if change != "lost":
        path.write_bytes(data[: len(data) // 2] if change == "cut" else data.replace(b"\x00", b"\x01", 1))
    assert main([*WORDS, "--resume", "--overwrite"]) == 0
    err = capsys.readouterr().err
    assert f"{name} is missing or damaged and is made again" in err
    # What is said ends at the first gap.
    assert f"continues {said}" in err and err.count("continues") == 1
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
