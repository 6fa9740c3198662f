"""Stages in tiles: close to those of the whole, the same where there is one tile, and records that add up."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore import pipeline
from turbrestore.core.errors import DataError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.dynamics.dynamic_texture import DynamicsParams
from turbrestore.filtering.alternating import Filtered
from turbrestore.io.source import FrameSource
from turbrestore.metrics import psnr
from turbrestore.registration.centroid import CentroidParams, find_centroid
from turbrestore.registration.flow import FlowParams
from turbrestore.runs import resumption
from turbrestore.runs.checkpoint import load_tiles, save_tiles
from turbrestore.runs.resumption import KeptStages
from turbrestore.runtime.tiling import halo_tiles
from turbrestore.settings import RestoreParams
from turbrestore.tiled_stages import filter_tiles, find_tiled_centroid

HALO = 24
TILES = halo_tiles((128, 128), 112, HALO)


@pytest.fixture(scope="module")
def sequence():
    return make_sequence(seed=61, count=12, size=128, blur=1.2)


@pytest.fixture(scope="module")
def blurred(sequence):
    return find_centroid(sequence.frames).image


def test_there_are_four_tiles():
    assert len(TILES) == 4


def test_a_centroid_in_tiles_is_as_good_as_that_of_the_whole(sequence, tmp_path):
    whole = find_centroid(sequence.frames)
    tiled = find_tiled_centroid(sequence.frames, TILES, scratch=tmp_path)
    assert isinstance(tiled.flows, np.memmap) and isinstance(tiled.image, np.memmap)
    inner = slice(8, -8)
    found, usual = (psnr(centroid.image[inner, inner], sequence.scene[inner, inner]) for centroid in (tiled, whole))
    assert abs(found - usual) < 0.3
    assert np.median(np.abs(tiled.flows - whole.flows)) < 0.05
    assert tiled.converged == whole.converged


def test_one_tile_is_the_whole(sequence, blurred):
    tiles = halo_tiles((128, 128), 128, HALO)
    whole, tiled = find_centroid(sequence.frames), find_tiled_centroid(sequence.frames, tiles)
    for name in ("image", "flows", "mean_flow_sizes"):
        assert np.array_equal(getattr(whole, name), getattr(tiled, name))


def test_figures_of_the_filter_are_means_over_tiles():
    tiles = halo_tiles((40, 80), 44, 8)
    values = iter((1.0, 2.0, 6.0))

    def part(tile):
        value, image = next(values), np.full(tile.shape, 0.5, np.float32)
        one = np.array([value, np.nan])
        share = np.array([0.25, 0.75])
        return Filtered(image, 2 * image, np.ones((2, 3)), one, one, one, share, value, value), 3 * image

    filtered, mean = filter_tiles(part, tiles, (40, 80))
    weights = [tile.row_weights.sum() * tile.column_weights.sum() for tile in tiles]
    expected = np.average([1, 2, 6], weights=weights)
    for name in ("gains", "sharpness"):
        assert getattr(filtered, name)[0] == pytest.approx(expected)
        assert np.isnan(getattr(filtered, name)[1])
    assert filtered.innovations[0] == pytest.approx(np.average([1, 4, 36], weights=weights) ** 0.5)
    assert filtered.image_noise == filtered.motion_share == pytest.approx(expected)
    assert filtered.shares == pytest.approx([0.25, 0.75])
    assert filtered.flow_states.shape == (2, 9)
    for image, level in ((filtered.image, 0.5), (filtered.variance, 1.0), (mean, 1.5)):
        np.testing.assert_allclose(image, level, atol=1e-6)


QUICK = RestoreParams(
    train=9,
    centroid=CentroidParams(iterations=2),
    dynamics=DynamicsParams(rank=2),
    displacement_cue=True,
    deconvolution=DeconvolutionParams(sigma=1.0, iterations=30),
)


@pytest.fixture
def in_tiles(monkeypatch):
    """Restore in tiles from now on, whatever the limit."""

    def begin(source):
        plan = replace(pipeline.memory_plan(source, QUICK), in_file=True, tile=112)
        for module in (pipeline, resumption):
            monkeypatch.setattr(module, "memory_plan", lambda *_: plan)
        monkeypatch.setattr(pipeline, "halo_tiles", lambda shape, side, halo=HALO: halo_tiles(shape, side, halo))

    return begin


@pytest.mark.parametrize("channels", [1, 3])
def test_a_restoration_in_tiles_is_as_good_as_that_of_whole_frames(sequence, tmp_path, in_tiles, channels):
    frames, truth = (
        image if channels == 1 else np.stack([image] * 3, axis=-1) for image in (sequence.frames, sequence.scene)
    )
    source = FrameSource.from_array(frames)
    whole = pipeline.restore(source, QUICK)
    in_tiles(source)
    told = []
    tiled = pipeline.restore(
        source, QUICK, progress=lambda stage, done, total: told.append((stage, done, total)), scratch=tmp_path
    )
    inner = slice(8, -8)
    for name in ("mean", "image"):
        found, usual = (psnr(getattr(run, name)[inner, inner], truth[inner, inner]) for run in (tiled, whole))
        assert abs(found - usual) < 0.3
    np.testing.assert_allclose(tiled.mean, whole.mean, atol=1e-6)
    assert tiled.filtered.shares.sum() == pytest.approx(1)
    assert tiled.filtered.gains.shape == (12,)
    assert tiled.frame_count == 12
    assert not list(tmp_path.iterdir())
    for stage in ("centroid", "filter", "deconvolve"):
        done = [count for name, count, _ in told if name == stage]
        totals = {total for name, _, total in told if name == stage}
        assert done == sorted(done) and len(totals) == 1 and done[-1] <= totals.pop()
    assert [done for name, done, total in told if name == "filter"][-1] == 4 * (2 * 12 - 9)


@pytest.mark.parametrize("memory", [None, 1e6])
def test_a_restoration_in_tiles_is_deblurred_as_a_whole(sequence, in_tiles, tmp_path, memory):
    source = FrameSource.from_array(sequence.frames)
    in_tiles(source)
    params = replace(QUICK, deconvolution=replace(QUICK.deconvolution, memory=memory))
    tiled = pipeline.restore(source, params, scratch=tmp_path)
    whole = deconvolve(tiled.filtered.image, 1.0, QUICK.deconvolution, tiled.centroid.image)
    assert isinstance(tiled.deconvolution.image, np.memmap)
    assert np.array_equal(tiled.deconvolution.image, whole.image)


def test_a_restoration_in_tiles_is_the_same_bytes_whatever_the_number_of_threads(sequence, in_tiles, monkeypatch):
    source = FrameSource.from_array(sequence.frames)
    in_tiles(source)
    # Several strips in the deconvolution.
    monkeypatch.setattr("turbrestore.deconvolution.nonlocal_tv.STRIP_PIXELS", 2000)
    monkeypatch.setattr("turbrestore.deconvolution.strip_grid._ONE_STRIP", 1)
    monkeypatch.setattr("turbrestore.deconvolution.strip_grid._STRIP", 2000)

    def run(threads):
        for module in ("runtime.threads", "deconvolution.deconvolve", "deconvolution.nonlocal_tv"):
            monkeypatch.setattr(f"turbrestore.{module}.available_cores", lambda: threads)
        restored = pipeline.restore(source, replace(QUICK, flow=FlowParams(threads=threads)))
        return [
            getattr(stage, name).tobytes()
            for stage, names in (
                (restored, ("mean", "image")),
                (restored.centroid, ("image", "flows")),
                (restored.filtered, ("image", "variance", "flow_states", "shares")),
            )
            for name in names
        ]

    one, *others = map(run, (1, 2, 5))
    assert all(other == one for other in others)


def test_frames_that_do_not_count_do_not_in_any_tile(sequence, in_tiles):
    source = FrameSource.from_array(sequence.frames)
    in_tiles(source)
    restored = pipeline.restore(source, replace(QUICK, keep_best=0.5))
    assert np.count_nonzero(restored.filtered.shares) == 6
    assert np.isnan(restored.filtered.sharpness).sum() == 6
    assert np.isfinite(restored.image).all()


@pytest.mark.parametrize("finished", [1, 3])
def test_a_run_in_tiles_that_is_interrupted_ends_the_same(sequence, tmp_path, in_tiles, finished):
    source = FrameSource.from_array(sequence.frames)
    in_tiles(source)
    whole = pipeline.restore(source, QUICK)
    kept = KeptStages(tmp_path, source, QUICK)

    def keep(done):
        kept.keep(done)
        if done.filtered is None and done.tiles is not None and len(done.tiles.parts) == finished:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pipeline.restore(source, QUICK, on_result=keep)
    later = KeptStages(tmp_path, source, QUICK, resume=True)
    assert later.notes == (f"goes on after the flow model and {finished} tiles of the filter",)
    assert all(isinstance(part.image, np.memmap) for part in later.done.tiles.parts)
    told = []
    resumed = pipeline.restore(
        source, QUICK, lambda stage, done, _: told.append((stage, done)), later.done, later.keep, tmp_path
    )
    for name in ("image", "variance", "flow_states", "gains", "innovations", "sharpness", "shares"):
        assert np.array_equal(getattr(resumed.filtered, name), getattr(whole.filtered, name))
    assert resumed.filtered.image_noise == whole.filtered.image_noise
    assert np.array_equal(resumed.image, whole.image) and np.array_equal(resumed.mean, whole.mean)
    assert next(done for stage, done in told if stage == "filter") == finished * (2 * 12 - 9)
    assert not (tmp_path / "checkpoint.npz").exists()


def test_tiles_of_another_run_are_not_taken_over(sequence, tmp_path, in_tiles):
    source = FrameSource.from_array(sequence.frames)
    in_tiles(source)
    kept = KeptStages(tmp_path, source, QUICK)
    found = []

    def keep(done):
        kept.keep(done)
        if done.tiles is not None:
            found.append(done.tiles)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pipeline.restore(source, QUICK, on_result=keep)
    path = tmp_path / "checkpoint.npz"
    save_tiles(path, found[0], "another")
    notes = KeptStages(tmp_path, source, QUICK, resume=True).notes
    assert notes[0].startswith(f"{path}: expected a checkpoint of this run")
    save_tiles(path, found[0], "another")
    with np.load(path) as arrays:
        kept_ones = {name: arrays[name] for name in arrays if name != "shares_0"}
    np.savez(path, **kept_ones)
    with pytest.raises(DataError, match="expected a checkpoint of the filter, found something else"):
        load_tiles(path, "another")
