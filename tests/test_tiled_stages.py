"""Stages in tiles: close to those of the whole, the same where there is one tile, and records that add up."""

import pickle
from dataclasses import replace

import cloudpickle
import numpy as np
import pytest

from conftest import make_sequence
from turbrestore import pipeline, restoration_run
from turbrestore import tiles as tiles_module
from turbrestore.core.errors import ConfigurationError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.dynamics.dynamic_texture import DynamicsParams
from turbrestore.filtering.alternating import Filtered
from turbrestore.io.source import FrameSource
from turbrestore.memory_plan import plan_memory
from turbrestore.metrics import psnr
from turbrestore.registration.centroid import CentroidParams, find_centroid
from turbrestore.runs import run_folder as run_folder_module
from turbrestore.runs.run_folder import RunFolder
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.tiling import cut_tile, halo_tiles
from turbrestore.settings import RestoreParams
from turbrestore.tiles import join_centroids, join_filtered

HALO = 16
TILES = halo_tiles((96, 96), 80, HALO)


@pytest.fixture(scope="module")
def sequence():
    return make_sequence(seed=61, count=12, size=96, blur=1.2)


@pytest.fixture(scope="module")
def whole(sequence):
    return find_centroid(sequence.frames)


def test_a_centroid_in_tiles_is_as_good_as_that_of_the_whole(sequence, whole, tmp_path):
    assert len(TILES) == 4
    parts = (find_centroid(cut_tile(sequence.frames, tile)) for tile in TILES)
    tiled = join_centroids(parts, TILES, sequence.frames.shape, tmp_path)
    assert isinstance(tiled.flows, np.memmap) and isinstance(tiled.image, np.memmap)
    inner = slice(8, -8)
    found, usual = (psnr(centroid.image[inner, inner], sequence.scene[inner, inner]) for centroid in (tiled, whole))
    assert abs(found - usual) < 0.3
    assert np.median(np.abs(tiled.flows - whole.flows)) < 0.05
    assert tiled.converged == whole.converged


def test_one_tile_is_the_whole(sequence, whole):
    tiles = halo_tiles((96, 96), 96, HALO)
    tiled = join_centroids([whole], tiles, sequence.frames.shape)
    for name in ("image", "flows", "mean_flow_sizes"):
        assert np.array_equal(getattr(whole, name), getattr(tiled, name))


def test_figures_of_the_filter_are_means_over_tiles():
    tiles = halo_tiles((40, 80), 44, 8)

    def part(tile, value):
        image, flow = np.full(tile.shape, 0.5, np.float32), np.full((*tile.shape, 2), 0.25, np.float32)
        one = np.array([value, np.nan])
        share = np.array([0.25, 0.75])
        return Filtered(image, 2 * image, np.ones((2, 3)), one, one, one, share, value, value, value, flow)

    filtered = join_filtered(map(part, tiles, (1.0, 2.0, 6.0)), tiles, (40, 80))
    weights = [tile.row_weights.sum() * tile.column_weights.sum() for tile in tiles]
    expected = np.average([1, 2, 6], weights=weights)
    for name in ("gains", "sharpness"):
        assert getattr(filtered, name)[0] == pytest.approx(expected)
        assert np.isnan(getattr(filtered, name)[1])
    assert filtered.innovations[0] == pytest.approx(np.average([1, 4, 36], weights=weights) ** 0.5)
    assert filtered.image_noise == filtered.sharpness_weight == pytest.approx(expected)
    assert filtered.shares == pytest.approx([0.25, 0.75])
    assert filtered.flow_states.shape == (2, 9)
    for image, level in ((filtered.image, 0.5), (filtered.variance, 1.0), (filtered.mean_flow, 0.25)):
        np.testing.assert_allclose(image, level, atol=1e-6)


QUICK = RestoreParams(
    train=9,
    centroid=CentroidParams(iterations=2),
    dynamics=DynamicsParams(rank=2),
    deconvolution=DeconvolutionParams(sigma=1.0, iterations=10),
)


def divide(patch, scratch):
    """Restore in tiles from now on, whatever the limit."""

    def plan(shape, params, runtime):
        found = plan_memory(shape, params, runtime)
        return replace(found, runtime=replace(found.runtime, scratch=scratch), tile=80)

    for module in (pipeline, run_folder_module):
        patch.setattr(module, "plan_memory", plan)
    patch.setattr(restoration_run, "halo_tiles", lambda shape, side, halo=HALO: halo_tiles(shape, side, halo))


@pytest.fixture
def in_tiles(monkeypatch, tmp_path):
    (scratch := tmp_path / "scratch").mkdir()
    divide(monkeypatch, scratch)
    return scratch


@pytest.fixture(scope="module")
def tiled(sequence, tmp_path_factory):
    """A restoration in tiles by one thread that nothing interrupts."""
    with pytest.MonkeyPatch.context() as patch:
        divide(patch, tmp_path_factory.mktemp("scratch"))
        return pipeline.restore(FrameSource.from_array(sequence.frames), QUICK, Runtime(threads=1))


@pytest.mark.parametrize("channels", [1, 3])
def test_a_restoration_in_tiles_is_as_good_as_that_of_whole_frames(sequence, request, channels):
    frames, truth = (
        image if channels == 1 else np.stack([image] * 3, axis=-1) for image in (sequence.frames, sequence.scene)
    )
    whole = pipeline.restore(frames, QUICK)
    scratch, told = request.getfixturevalue("in_tiles"), []
    tiled = pipeline.restore(frames, QUICK, progress=lambda stage, done, total: told.append((stage, done, total)))
    inner = slice(8, -8)
    for name in ("mean", "image"):
        found, usual = (psnr(getattr(run, name)[inner, inner], truth[inner, inner]) for run in (tiled, whole))
        assert abs(found - usual) < 0.3
    np.testing.assert_allclose(tiled.mean, whole.mean, atol=1e-6)
    assert tiled.filtered.shares.sum() == pytest.approx(1)
    assert tiled.filtered.gains.shape == (12,)
    assert tiled.frame_count == 12
    assert not list(scratch.iterdir())
    for stage in ("centroid", "filter", "deconvolve"):
        done = [count for name, count, _ in told if name == stage]
        totals = {total for name, _, total in told if name == stage}
        assert done == sorted(done) and len(totals) == 1 and done[-1] <= totals.pop()
    assert [done for name, done, total in told if name == "filter"][-1] == 4 * (2 * 12 - 9)


@pytest.mark.long
@pytest.mark.usefixtures("in_tiles")
def test_a_restoration_in_tiles_is_the_same_bytes_whatever_the_number_of_threads(sequence, tiled):
    def contents(restored):
        return [
            getattr(stage, name).tobytes()
            for stage, names in (
                (restored, ("mean", "image")),
                (restored.centroid, ("image", "flows")),
                (restored.filtered, ("image", "variance", "flow_states", "shares")),
            )
            for name in names
        ]

    assert contents(pipeline.restore(sequence.frames, QUICK, Runtime(threads=5))) == contents(tiled)


def interrupt(source, folder, finished, monkeypatch):
    """Keep a restoration that ends once the filter has finished so many tiles."""
    kept, real = RunFolder(folder, source, QUICK), tiles_module._filter_tile

    def interrupted(run, centroid, training, counted, number):
        if number == finished:
            raise KeyboardInterrupt
        return real(run, centroid, training, counted, number)

    with monkeypatch.context() as patch:
        patch.setattr(tiles_module, "_filter_tile", interrupted)
        with pytest.raises(KeyboardInterrupt):
            pipeline.restore(source, QUICK, store=kept)


def elsewhere(function, tasks):
    """What other processes do, with what they are sent."""
    for task in tasks:
        yield pickle.loads(cloudpickle.dumps(function(pickle.loads(cloudpickle.dumps(task)))))


@pytest.mark.usefixtures("in_tiles")
@pytest.mark.parametrize("keep_best", [1, 0.5])
def test_tiles_are_the_same_bytes_wherever_they_are_worked_on(sequence, tiled, keep_best):
    params, told = replace(QUICK, keep_best=keep_best), []
    source = FrameSource.from_array(sequence.frames)
    here = tiled if keep_best == 1 else pipeline.restore(source, params)
    there = pipeline.restore(
        source, params, progress=lambda stage, done, total: told.append((stage, done, total)), map_tiles=elsewhere
    )
    assert np.array_equal(here.image, there.image)
    assert np.array_equal(here.centroid.flows, there.centroid.flows)
    for name in ("image", "variance", "flow_states", "shares"):
        assert np.array_equal(getattr(here.filtered, name), getattr(there.filtered, name))
    for stage in ("centroid", "filter"):
        assert [step for step in told if step[0] == stage] == [(stage, done, 4) for done in (1, 2, 3, 4)]
    # Frames that do not count do not in any tile.
    assert np.count_nonzero(here.filtered.shares) == 12 * keep_best
    assert np.isnan(here.filtered.sharpness).sum() == 12 * (1 - keep_best)
    assert np.isfinite(here.image).all()


@pytest.mark.usefixtures("in_tiles")
def test_tiles_that_were_kept_are_not_sent_to_other_processes(sequence, tiled, tmp_path):
    source, sent = FrameSource.from_array(sequence.frames), []
    (folder := tmp_path / "kept").mkdir()

    def interrupted(function, tasks):
        for task in tasks:
            if len(sent) == 6:
                raise KeyboardInterrupt
            sent.append(task)
            yield function(task)

    with pytest.raises(KeyboardInterrupt):
        pipeline.restore(source, QUICK, store=RunFolder(folder, source, QUICK), map_tiles=interrupted)
    sent.clear()
    later = RunFolder(folder, source, QUICK, resume=True)
    assert later.notes == ("continues after the flow model and 2 tiles of the filter",)
    resumed = pipeline.restore(source, QUICK, store=later, map_tiles=interrupted)
    assert len(sent) == 2 and np.array_equal(resumed.image, tiled.image)


def test_tiles_may_be_asked_for():
    shape, params = (300, 1080, 1920), RestoreParams()
    plan = plan_memory(shape, params, Runtime(tile=1088))
    assert (plan.train, plan.tile, plan.deconvolution_side) == (60, 1080, None)
    assert plan.runtime.scratch is not None and plan.scratch_bytes > 0
    assert plan.decisions[0].reason == "tiles were asked for"
    assert plan_memory(shape, params, Runtime(tile=1920)).tile is None
    assert plan_memory((20, 4320, 7680), params, Runtime(tile=1088)).train == 10
    limited = plan_memory(shape, params, Runtime(tile=1088, memory_limit="700MB"))
    assert limited.tile < 1080
    with pytest.raises(ConfigurationError, match="at least 384"):
        Runtime(tile=200)


@pytest.mark.long
@pytest.mark.usefixtures("in_tiles")
@pytest.mark.parametrize("finished", [1, 3])
def test_a_run_in_tiles_that_is_interrupted_ends_the_same(sequence, tiled, tmp_path, monkeypatch, finished):
    source = FrameSource.from_array(sequence.frames)
    (folder := tmp_path / "kept").mkdir()
    interrupt(source, folder, finished, monkeypatch)
    later = RunFolder(folder, source, QUICK, resume=True)
    assert later.notes == (f"continues after the flow model and {finished} tile{'s' * (finished > 1)} of the filter",)
    told = []
    resumed = pipeline.restore(source, QUICK, store=later, progress=lambda stage, done, _: told.append((stage, done)))
    for name in ("image", "variance", "flow_states", "gains", "innovations", "sharpness", "shares"):
        assert np.array_equal(getattr(resumed.filtered, name), getattr(tiled.filtered, name))
    assert resumed.filtered.image_noise == tiled.filtered.image_noise
    assert np.array_equal(resumed.image, tiled.image) and np.array_equal(resumed.mean, tiled.mean)
    first = next(done for stage, done in told if stage == "filter")
    assert finished * (2 * 12 - 9) < first <= finished * (2 * 12 - 9) + 12
    assert not list(folder.glob("filtered_tile_*"))


@pytest.mark.usefixtures("in_tiles")
def test_a_damaged_tile_is_filtered_again(sequence, tmp_path, monkeypatch):
    source = FrameSource.from_array(sequence.frames)
    (folder := tmp_path / "kept").mkdir()
    interrupt(source, folder, 2, monkeypatch)
    damaged = folder / "filtered_tile_0.npz"
    damaged.write_bytes(damaged.read_bytes()[:-40])
    notes = RunFolder(folder, source, QUICK, resume=True).notes
    assert notes == (
        "filtered_tile_0.npz is missing or damaged and is made again",
        "continues after the flow model and 1 tile of the filter",
    )
