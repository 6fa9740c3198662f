"""Restorations within a memory limit: the same result, where files lie, and what is said."""

import contextlib
import json
import weakref
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from memory_limits import least_limit

from conftest import make_sequence
from turbrestore import pipeline
from turbrestore.core.errors import StorageError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.dynamics.dynamic_texture import DynamicsParams
from turbrestore.io.source import FrameSource
from turbrestore.memory_plan import plan_memory
from turbrestore.registration.centroid import CentroidParams
from turbrestore.registration.flow import FlowParams
from turbrestore.runs.resumption import KeptStages, stage_facts
from turbrestore.runtime.jit import COMPILER_BYTES, can_compile
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.settings import RestoreParams
from turbrestore_cli.__main__ import main
from turbrestore_cli.inputs import read_input_image
from turbrestore_cli.output import describe

QUICK = RestoreParams(
    train=16,
    centroid=CentroidParams(iterations=2),
    flow=FlowParams(threads=2),
    deconvolution=DeconvolutionParams(sigma=1.0, iterations=5),
)


@pytest.fixture(scope="module")
def frames():
    return make_sequence(seed=51, count=24, size=96, blur=1.0).frames


def limit_that(shape, holds, **settings):
    """Return the largest limit, in steps of 200 kB, whose plan is like that."""
    settings = {"deconvolution": QUICK.deconvolution, **settings}
    for limit in np.arange(4e8, 1.6e8, -2e5):
        plan = plan_memory(shape, limit, **settings)
        if holds(plan):
            return float(limit)
    raise AssertionError("no limit has such a plan")


@pytest.fixture(scope="module")
def in_file(frames):
    """Settings whose plan is a file, and nothing else."""
    limit = limit_that(frames.shape, lambda plan: plan.in_file, wanted=16, flow=QUICK.flow)
    return replace(QUICK, memory_limit=limit)


def test_a_comparison_with_the_truth_that_breaks_the_limit_is_refused_before_the_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("truth.png", np.tile(np.arange(256, dtype=np.uint8), (6000, 12)))
    np.save("clip.npy", np.random.default_rng(0).random((4, 96, 96), np.float32))
    words = ["restore", "clip.npy", "image.png", "--truth=truth.png", "--json", "--quiet"]
    limit = MemorySize("400MB") + (COMPILER_BYTES if can_compile() else 0)
    assert main([*words, f"--memory-limit={limit}"]) == 2
    assert "--truth: expected a --memory-limit of at least 1." in capsys.readouterr().err
    assert not (tmp_path / "image.png").exists()


def test_images_are_handed_back_as_they_are_compared(frames, tmp_path, monkeypatch):
    restoration = pipeline.restore(frames[:4], replace(QUICK, train=4))
    seen, released = [], []
    monkeypatch.setattr("turbrestore_cli.output.compare", lambda image, truth: seen.append(id(image)) or QUICK.guards)
    monkeypatch.setattr("turbrestore.runtime.scratch.drop_pages", lambda image: released.append(id(image)))
    describe(restoration, frames[0])
    assert len(seen) == 4 and released == seen


def test_a_truth_in_the_folder_of_the_stages_is_refused(frames, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("clip.npy", frames[:4])
    (tmp_path / "stages").mkdir()
    cv2.imwrite("stages/mean.png", np.zeros((96, 96), np.uint8))
    words = ["restore", "clip.npy", "image.png", "--truth=stages/mean.png", "--keep=stages", "--overwrite", "--quiet"]
    assert main(words) != 0
    assert "stages/mean.png: is an input or output already" in capsys.readouterr().err


def test_the_truth_is_not_in_memory_while_others_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sequence = make_sequence(seed=51, count=4, size=96, blur=1.0)
    cv2.imwrite("truth.png", (255 * sequence.scene).astype(np.uint8))
    np.save("clip.npy", sequence.frames)
    truths = []

    def read(*words):
        image = read_input_image(*words)
        truths.append(weakref.ref(image))
        return image

    def run(*words):
        assert [truth() for truth in truths] == [None]
        return pipeline.restore(*words)

    monkeypatch.setattr("turbrestore_cli.restore.read_input_image", read)
    monkeypatch.setattr("turbrestore_cli.restore.run_pipeline", run)
    quick = ["--centroid.iterations=1", "--sigma=1", "--deconvolution.iterations=2", "--quiet"]
    assert main(["restore", "clip.npy", "image.png", "--truth=truth.png", "--json", *quick]) == 0
    assert "psnr" in json.loads(capsys.readouterr().out)["stages"]["deconvolved"]
    assert len(truths) == 2


def test_a_limit_for_a_run_that_does_not_deconvolve(frames):
    limit = limit_that(frames.shape, lambda plan: plan.in_file, wanted=24, flow=QUICK.flow, until="centroid")
    settings = replace(QUICK, train=24, until="centroid", deconvolution=DeconvolutionParams(), memory_limit=limit)
    assert pipeline.restore(frames, settings).train == 24


@pytest.mark.parametrize(("limit", "kept", "tight"), [(None, 1, 0), ("20GB", 0, 0), ("400MB", 0, 1)])
def test_freed_memory_is_kept_without_a_limit_and_given_back_where_it_is_tight(frames, monkeypatch, limit, kept, tight):
    seen = []

    @contextlib.contextmanager
    def setting(name, wanted):
        seen.append((name, wanted))
        yield
        seen.append(name)

    def deblur(*_):
        seen.append("deblur")
        raise StorageError("seen")

    for name in ("returning_freed", "keeping_freed"):
        monkeypatch.setattr(pipeline, name, partial(setting, name))
    monkeypatch.setattr(pipeline, "_deblur", deblur)
    with pytest.raises(StorageError, match="seen"):
        pipeline.restore(frames, replace(QUICK, memory_limit=limit))
    assert seen == [("returning_freed", tight), ("keeping_freed", kept), "keeping_freed", "deblur"]


def test_the_result_is_the_same_bit_for_bit(frames, in_file, tmp_path):
    free, limited = (pipeline.restore(frames, params, scratch=tmp_path) for params in (QUICK, in_file))
    assert isinstance(limited.centroid.flows, np.memmap)
    assert isinstance(limited.dynamics.C, np.memmap)
    for name in ("image", "mean"):
        assert np.array_equal(getattr(free, name), getattr(limited, name))
    assert np.array_equal(free.centroid.flows, limited.centroid.flows)
    assert np.array_equal(free.dynamics.C, limited.dynamics.C)
    assert np.array_equal(free.filtered.image, limited.filtered.image)
    assert limited.decisions[0].subject == "memory"
    assert limited.decisions[1:] == free.decisions
    assert not list(tmp_path.iterdir())


def test_the_file_lies_in_the_folder_that_is_named(frames, in_file, tmp_path):
    with pytest.raises(StorageError, match="nowhere"):
        pipeline.restore(frames, in_file, scratch=tmp_path / "nowhere")


def test_a_disk_without_room_is_refused_before_the_work(frames, in_file, tmp_path, monkeypatch):
    def full(path, size):
        raise StorageError(f"{path}: needs {size}")

    monkeypatch.setattr(pipeline, "check_space", full)
    monkeypatch.setattr(pipeline, "find_centroid", None)
    with pytest.raises(StorageError, match="what memory does not hold: needs"):
        pipeline.restore(frames, in_file, scratch=tmp_path)


def test_a_limit_changes_nothing_that_a_stage_depends_on(frames, in_file):
    source = FrameSource.from_array(frames)
    assert stage_facts(source, in_file) == stage_facts(source, QUICK)
    fewer = limit_that(frames.shape, lambda plan: plan.train < 24, flow=QUICK.flow, dynamics=DynamicsParams(rank=20))
    loose, strict = (
        replace(QUICK, train=None, dynamics=DynamicsParams(rank=20), memory_limit=limit) for limit in (4e8, fewer)
    )
    assert stage_facts(source, loose) != stage_facts(source, strict)


@pytest.mark.usefixtures("no_compiler")
def test_a_stage_depends_on_the_size_of_the_tiles():
    source = FrameSource.from_array(np.zeros((12, 800, 1000)))
    loose, strict = (stage_facts(source, replace(QUICK, train=None, memory_limit=limit)) for limit in (1e9, 4e8))
    assert "tile" not in loose["centroid"] and strict["centroid"].pop("tile") >= 384
    assert strict == loose


def test_the_command_restores_large_frames_in_tiles(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # Wide frames, so that the whole is out of reach at a size that a test has time for.
    frames = np.tile(make_sequence(seed=53, count=4, size=200, blur=1.0).frames, (1, 2, 5))
    np.save("clip.npy", frames)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    quick = ["--centroid.iterations=2", "--sigma=1", "--deconvolution.iterations=10", "--quiet"]
    limit = f"--memory-limit={least_limit(frames.shape)}"
    assert main(["restore", "clip.npy", "tiled.png", limit, "--json", *quick]) == 0
    assert "tiles of up to" in json.loads(capsys.readouterr().out)["decisions"][0]["choice"]
    assert main(["restore", "clip.npy", "whole.png", *quick]) == 0
    found, usual = (cv2.imread(name, cv2.IMREAD_GRAYSCALE).astype(float) for name in ("tiled.png", "whole.png"))
    assert found.shape == usual.shape == (400, 1000)
    assert np.sqrt(np.mean((found - usual) ** 2)) < 6
    assert not list((tmp_path / "temporary").iterdir())


def test_the_command_says_what_the_limit_caused_and_leaves_no_file(frames, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("clip.npy", frames)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    quick = ["--train=16", "--flow.threads=2", "--until=identify", "--centroid.iterations=1", "--quiet"]
    least = limit_that(frames.shape, lambda plan: plan.in_file, wanted=16, flow=QUICK.flow, until="identify")
    limit = f"--memory-limit={least / 1e6}MB"
    for words in ([], ["--keep=kept"]):
        assert main(["restore", "clip.npy", f"o{len(words)}.png", limit, "--json", *quick, *words]) == 0
        decisions = json.loads(capsys.readouterr().out)["decisions"]
        assert decisions[0]["choice"] == "training frames kept in a file"
    assert "memory_limit = " in Path("o0.png.toml").read_text()
    assert main(["restore", "clip.npy", "again.png", "--config=o0.png.toml", "--quiet"]) == 0
    assert Path("again.png").read_bytes() == Path("o0.png").read_bytes()
    assert not list((tmp_path / "temporary").iterdir())
    assert not [path for path in Path("kept").iterdir() if path.name.startswith("turbrestore-")]


def test_a_kept_run_goes_on_with_another_limit(frames, in_file, tmp_path, monkeypatch):
    monkeypatch.setattr("turbrestore.io.npy._LARGE", 1000)
    source = FrameSource.from_array(frames)
    first = KeptStages(tmp_path, source, QUICK)
    whole = pipeline.restore(source, QUICK, done=first.done, on_result=first.keep)
    later = KeptStages(tmp_path, source, in_file, resume=True)
    assert later.notes == ("goes on after the deconvolution",)
    assert isinstance(later.done.centroid.flows, np.memmap)
    # In another order products with it, and so the filter, would differ in the last bit.
    assert isinstance(later.done.dynamics.C, np.memmap)
    assert later.done.dynamics.C.strides == whole.dynamics.C.strides
    again = pipeline.restore(source, in_file, done=later.done, scratch=tmp_path)
    assert np.array_equal(again.image, whole.image)
    # And what a limited run keeps is what any run keeps.
    limited = KeptStages(tmp_path, source, in_file)
    pipeline.restore(source, in_file, done=limited.done, on_result=limited.keep, scratch=tmp_path)
    found = KeptStages(tmp_path, source, QUICK, resume=True).done
    assert np.array_equal(found.centroid.flows, whole.centroid.flows)
    assert np.array_equal(found.dynamics.C, whole.dynamics.C)


@pytest.mark.parametrize("records", [16, 40])
def test_a_limited_run_interrupted_in_the_filter_ends_the_same(tmp_path, records):
    frames = make_sequence(seed=52, count=64, size=96, blur=1.0).frames
    limit = limit_that(frames.shape, lambda plan: plan.in_file, wanted=16, flow=QUICK.flow)
    params, source = replace(QUICK, memory_limit=limit), FrameSource.from_array(frames)
    (scratch := tmp_path / "scratch").mkdir()
    (folder := tmp_path / "kept").mkdir()
    kept = KeptStages(folder, source, params, every=1)

    def keep(done):
        kept.keep(done)
        if done.filtered is None and done.checkpoint is not None and len(done.checkpoint.records) == records:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pipeline.restore(source, params, on_result=keep, scratch=scratch)
    assert not list(scratch.iterdir())
    done = KeptStages(folder, source, params, resume=True).done
    assert len(done.checkpoint.records) == records
    resumed, whole = (pipeline.restore(source, params, done=one, scratch=scratch) for one in (done, None))
    assert isinstance(whole.centroid.flows, np.memmap)
    for name in ("image", "variance", "shares", "flow_states"):
        assert np.array_equal(getattr(resumed.filtered, name), getattr(whole.filtered, name))
    assert np.array_equal(resumed.image, whole.image)
    assert not list(scratch.iterdir())
