"""Restorations within a memory limit: the same result, where files lie, and what is said."""

import gc
import json
import re
import weakref
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from memory_limits import least_limit

from conftest import make_sequence
from turbrestore import pipeline
from turbrestore.core.errors import StorageError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.filtering.filter_records import FilterParams
from turbrestore.io.source import FrameSource
from turbrestore.memory_plan import plan_memory
from turbrestore.registration.centroid import CentroidParams
from turbrestore.runs.dependencies import stage_dependencies
from turbrestore.runs.run_folder import RunFolder
from turbrestore.runtime.runtime import Runtime
from turbrestore.settings import RestoreParams
from turbrestore_cli.__main__ import main
from turbrestore_cli.inputs import read_input_image

QUICK = RestoreParams(
    train=16, centroid=CentroidParams(iterations=2), deconvolution=DeconvolutionParams(sigma=1.0, iterations=5)
)
TWO = Runtime(threads=2)


@pytest.fixture(scope="module")
def frames():
    return make_sequence(seed=51, count=20, size=96, blur=1.0).frames


def limit_that(shape, holds, params=QUICK):
    """Return the largest limit, in steps of 200 kB, whose plan is like that."""
    for limit in np.arange(6e8, 2e8, -2e5):
        if holds(plan_memory(shape, params, replace(TWO, memory_limit=float(limit)))):
            return float(limit)
    raise AssertionError("no limit has such a plan")


def in_scratch(plan):
    return plan.runtime.scratch is not None


@pytest.fixture(scope="module")
def limited(frames):
    """What a restoration may use whose plan is a scratch file, and nothing else."""
    return replace(TWO, memory_limit=limit_that(frames.shape, in_scratch))


@pytest.fixture(scope="module")
def kept(frames, tmp_path_factory):
    """The folder and the result of a run without a limit."""
    folder, source = tmp_path_factory.mktemp("kept"), FrameSource.from_array(frames)
    return folder, pipeline.restore(source, QUICK, TWO, RunFolder(folder, source, QUICK, TWO))


def test_the_truth_is_not_in_memory_while_the_stages_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sequence = make_sequence(seed=51, count=4, size=96, blur=1.0)
    cv2.imwrite("truth.png", (255 * sequence.scene).astype(np.uint8))
    np.save("clip.npy", sequence.frames)
    truths = []

    def read(*words):
        image = read_input_image(*words)
        truths.append(weakref.ref(image))
        return image

    def run(*words, **more):
        # Readers may leave frames in cycles, which hold the local variables of their callers.
        gc.collect()
        assert [truth() is None for truth in truths] == [True]
        return pipeline.restore(*words, **more)

    for module in ("inputs", "clip"):
        monkeypatch.setattr(f"turbrestore_cli.{module}.read_input_image", read)
    monkeypatch.setattr("turbrestore_cli.clip.run_pipeline", run)
    quick = ["--centroid.iterations=1", "--sigma=1", "--deconvolution.iterations=2", "--quiet"]
    assert main(["restore", "clip.npy", "image.png", "--truth=truth.png", "--json", *quick]) == 0
    assert "psnr" in json.loads(capsys.readouterr().out)["stages"]["deconvolved"]
    assert len(truths) == 2


def test_a_truth_in_the_folder_of_the_stages_is_refused(frames, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("clip.npy", frames[:4])
    (tmp_path / "stages").mkdir()
    cv2.imwrite("stages/mean.png", np.zeros((96, 96), np.uint8))
    words = ["restore", "clip.npy", "image.png", "--truth=stages/mean.png", "--keep=stages", "--overwrite", "--quiet"]
    assert main(words) != 0
    assert "stages/mean.png: is an input or output already" in capsys.readouterr().err


def test_a_limit_for_a_run_that_does_not_deconvolve(frames):
    params = replace(QUICK, train=20, until="centroid", deconvolution=DeconvolutionParams())
    limit = limit_that(frames.shape, in_scratch, params)
    assert pipeline.restore(frames, params, replace(TWO, memory_limit=limit)).train == 20


def test_the_result_is_the_same_bit_for_bit(frames, limited, kept, tmp_path):
    free, found = kept[1], pipeline.restore(frames, QUICK, replace(limited, scratch=tmp_path))
    assert isinstance(found.centroid.flows, np.memmap)
    assert isinstance(found.dynamics.C, np.memmap)
    for name in ("image", "mean"):
        assert np.array_equal(getattr(free, name), getattr(found, name))
    assert np.array_equal(free.centroid.flows, found.centroid.flows)
    assert np.array_equal(free.dynamics.C, found.dynamics.C)
    assert np.array_equal(free.filtered.image, found.filtered.image)
    assert found.decisions[0].subject == "memory"
    assert found.decisions[1:] == free.decisions
    assert not list(tmp_path.iterdir())


def test_the_scratch_file_lies_in_the_folder_that_is_named(frames, limited, tmp_path):
    with pytest.raises(StorageError, match="nowhere"):
        pipeline.restore(frames, QUICK, replace(limited, scratch=tmp_path / "nowhere"))


def test_a_disk_without_room_is_refused_before_the_work(frames, limited, tmp_path, monkeypatch):
    def full(path, size):
        raise StorageError(f"{path}: needs {size}")

    monkeypatch.setattr(pipeline, "check_space", full)
    monkeypatch.setattr("turbrestore.pipeline.centroid_steps", None)
    with pytest.raises(StorageError, match=f"^{re.escape(str(tmp_path))}: needs"):
        pipeline.restore(frames, QUICK, replace(limited, scratch=tmp_path))


def dependencies(source, params, runtime):
    return stage_dependencies(source, params, plan_memory(source.shape, params, runtime))


def test_a_stage_depends_on_the_size_of_the_tiles():
    source, params = FrameSource.from_array(np.zeros((12, 800, 1000))), replace(QUICK, train=None)
    limits = (2e9, float(least_limit(source.shape)))
    loose, strict = (dependencies(source, params, replace(TWO, memory_limit=limit)) for limit in limits)
    assert "tile" not in loose["centroid"] and strict["centroid"].pop("tile") >= 384
    assert "tile" not in loose["deblurred"] and strict["deblurred"].pop("tile") >= 384
    assert strict == loose


@pytest.mark.long
def test_the_command_restores_large_frames_in_tiles(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # Wide frames, so that the whole is out of reach at a size that a test has time for.
    frames = np.tile(make_sequence(seed=53, count=2, size=200, blur=1.0).frames, (1, 2, 4))
    np.save("clip.npy", frames)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    quick = ["--centroid.iterations=1", "--filter.inner-iterations=1", "--sigma=1"]
    quick += ["--deconvolution.iterations=2", "--quiet"]
    limit = f"--memory-limit={least_limit(frames.shape)}"
    assert main(["restore", "clip.npy", "tiled.png", limit, "--json", *quick]) == 0
    assert "tiles of up to" in json.loads(capsys.readouterr().out)["decisions"][0]["choice"]
    assert main(["restore", "clip.npy", "whole.png", *quick]) == 0
    found, usual = (cv2.imread(name, cv2.IMREAD_GRAYSCALE).astype(float) for name in ("tiled.png", "whole.png"))
    assert found.shape == usual.shape == (400, 800)
    assert np.sqrt(np.mean((found - usual) ** 2)) < 6
    assert not list((tmp_path / "temporary").iterdir())


def test_the_command_says_what_the_limit_caused_and_leaves_no_file(frames, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("clip.npy", frames)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    quick = ["--train=16", "--threads=2", "--until=identify", "--centroid.iterations=1", "--quiet"]
    params = RestoreParams(train=16, until="identify")
    limit = f"--memory-limit={limit_that(frames.shape, in_scratch, params) / 1e6}MB"
    for words in ([], ["--keep=kept"]):
        assert main(["restore", "clip.npy", f"o{len(words)}.png", limit, "--json", *quick, *words]) == 0
        decisions = json.loads(capsys.readouterr().out)["decisions"]
        assert decisions[0]["choice"] == "training frames in a scratch file"
    assert "memory_limit = " in Path("o0.png.toml").read_text()
    assert main(["restore", "clip.npy", "again.png", "--config=o0.png.toml", "--quiet"]) == 0
    assert Path("again.png").read_bytes() == Path("o0.png").read_bytes()
    assert not list((tmp_path / "temporary").iterdir())
    assert not [path for path in Path("kept").iterdir() if path.name.startswith("turbrestore-")]


def test_a_kept_run_continues_with_another_limit(frames, limited, kept, tmp_path, monkeypatch):
    monkeypatch.setattr("turbrestore.io.npy._LARGE", 1000)
    source, (folder, whole) = FrameSource.from_array(frames), kept
    later = RunFolder(folder, source, QUICK, limited, resume=True)
    assert later.notes == ("continues after the deconvolution",)
    again = pipeline.restore(source, QUICK, limited, later)
    assert np.array_equal(again.image, whole.image)
    assert isinstance(again.centroid.flows, np.memmap)
    # In another order products with it, and so the filter, would differ in the last bit.
    assert isinstance(again.dynamics.C, np.memmap)
    assert again.dynamics.C.strides == whole.dynamics.C.strides
    # And what a limited run keeps is what any run keeps.
    pipeline.restore(source, QUICK, limited, RunFolder(tmp_path, source, QUICK, limited))
    found = pipeline.restore(source, QUICK, TWO, RunFolder(tmp_path, source, QUICK, TWO, resume=True))
    assert np.array_equal(found.centroid.flows, whole.centroid.flows)
    assert np.array_equal(found.dynamics.C, whole.dynamics.C)


@pytest.mark.long
def test_a_limited_run_interrupted_in_the_filter_ends_the_same(tmp_path):
    frames = make_sequence(seed=52, count=32, size=64, blur=1.0).frames
    source, params = FrameSource.from_array(frames), replace(QUICK, filter=FilterParams(block=8))
    (scratch := tmp_path / "scratch").mkdir()
    runtime = replace(TWO, memory_limit=limit_that(frames.shape, in_scratch, params), scratch=scratch)
    whole = pipeline.restore(source, params, runtime)
    assert isinstance(whole.centroid.flows, np.memmap)
    # After the frames of the training, and between two blocks of those behind them.
    for records in (16, 24):
        (folder := tmp_path / f"kept{records}").mkdir()
        kept = RunFolder(folder, source, params, runtime, checkpoint_every=1)
        taken = kept.checkpoint

        def checkpoint(state, taken=taken, records=records):
            taken(state)
            if len(state.records) == records:
                raise KeyboardInterrupt

        kept.checkpoint = checkpoint
        with pytest.raises(KeyboardInterrupt):
            pipeline.restore(source, params, runtime, kept)
        assert not list(scratch.iterdir())
        later = RunFolder(folder, source, params, runtime, resume=True)
        assert len(later.filter_start().records) == records
        resumed = pipeline.restore(source, params, runtime, later)
        for name in ("image", "variance", "shares", "flow_states"):
            assert np.array_equal(getattr(resumed.filtered, name), getattr(whole.filtered, name))
        assert np.array_equal(resumed.image, whole.image)
        assert not list(scratch.iterdir())
