"""Stages in tiles: close to those of the whole, the same where there is one tile, and records that add up."""

from dataclasses import replace

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore import pipeline, resumption
from turbrestore.alternating import Filtered
from turbrestore.blind import remove_blur
from turbrestore.centroid import CentroidParams, find_centroid
from turbrestore.checkpoint import load_tiles, save_tiles
from turbrestore.deconvolution import DeconvolutionParams, deconvolve
from turbrestore.dynamics import DynamicsParams
from turbrestore.errors import DataError
from turbrestore.frame_source import FrameSource
from turbrestore.halo_tiles import halo_tiles, sizes_to_deblur
from turbrestore.metrics import psnr
from turbrestore.psf import blur_otf
from turbrestore.restoration import RestoreParams
from turbrestore.resumption import KeptStages
from turbrestore.synthesis.scenes import SCENES
from turbrestore.tiled_stages import deconvolve_tiles, filter_tiles, find_tiled_centroid

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
    params = DeconvolutionParams(iterations=30)
    deblurred, parts = deconvolve(blurred, 1.2, params, blurred), deconvolve_tiles(blurred, 1.2, params, blurred, tiles)
    for name in ("image", "noise", "fidelity", "iterations", "recorded", "objective", "changes"):
        assert np.array_equal(getattr(deblurred, name), getattr(parts, name))


@pytest.mark.parametrize("method", ["nltv", "tv", "wiener"])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_deconvolution_in_tiles_is_that_of_the_whole(blurred, method, channels):
    image = blurred if channels == 1 else np.stack([blurred, blurred[::-1], blurred.T], axis=-1)
    params = DeconvolutionParams(method=method, iterations=100, tolerance=0)
    whole, tiled = deconvolve(image, 1.2, params, image), deconvolve_tiles(image, 1.2, params, image, TILES)
    assert tiled.image.shape == image.shape
    assert (tiled.noise, tiled.fidelity, tiled.sigma) == (whole.noise, whole.fidelity, whole.sigma)
    difference = np.abs(tiled.image - whole.image)
    # The Wiener images that the others start from have the noise of the tile, and at the border of the frame, where
    # nothing tells what lies beyond, a solution is slow to settle.
    assert np.sqrt(np.mean(difference**2)) < (0.002 if method == "wiener" else 0.01)
    # Where tiles meet no more than elsewhere.
    assert difference[60:68].mean() < 1.5 * difference.mean()


def rms(image):
    return np.sqrt(np.mean(np.square(image)))


def soft_scene(shape, sigma):
    """Scene whose two sides go on in each other, blurred and with noise."""
    scene = np.roll(SCENES["camera"](*shape), (11, 17), (0, 1))
    image = np.fft.irfft2(np.fft.rfft2(scene) * blur_otf(shape, sigma), s=shape)
    return (image + np.random.default_rng(0).normal(0, 0.002, shape)).astype(np.float32)


@pytest.mark.parametrize("method", ["tv", "wiener"])
@pytest.mark.parametrize("shape", [(128, 160), (192, 112)])
def test_a_periodic_image_is_deblurred_in_tiles_that_see_its_other_side(method, shape):
    image = soft_scene(shape, 3.0)
    image = np.stack([image, image[::-1], image[:, ::-1]], axis=-1)
    params = DeconvolutionParams(method=method, boundary="periodic", iterations=100, tolerance=0)
    tiles = halo_tiles(shape, 112, HALO)
    whole, tiled = deconvolve(image, 3.0, params, image), deconvolve_tiles(image, 3.0, params, image, tiles)
    blind = deconvolve_tiles(image, 3.0, replace(params, boundary="unknown"), image, tiles)
    assert len(tiles) > 1
    for edge in (np.s_[:6], np.s_[-6:], np.s_[:, :6], np.s_[:, -6:]):
        assert rms((tiled.image - whole.image)[edge]) < 0.001
        assert rms((blind.image - whole.image)[edge]) > 0.003
    assert np.abs(tiled.image - whole.image).max() < 0.01


@pytest.mark.parametrize("boundary", ["unknown", "periodic"])
def test_one_tile_keeps_its_boundary(blurred, boundary):
    params = DeconvolutionParams(method="tv", boundary=boundary, iterations=10)
    (tile,) = halo_tiles(blurred.shape, 128, HALO)
    tiled = deconvolve_tiles(blurred, 2.0, params, blurred, [tile])
    assert np.array_equal(tiled.image, deconvolve(blurred, 2.0, params, blurred).image)


def test_a_halo_of_four_widths_is_enough():
    image, inner = soft_scene((192, 192), 4.0), np.s_[24:-24, 24:-24]
    params = DeconvolutionParams(method="wiener", iterations=100, tolerance=0)
    whole = deconvolve(image, 4.0, params).image
    narrow, enough = (
        rms((deconvolve_tiles(image, 4.0, params, image, halo_tiles(image.shape, 80, halo)).image - whole)[inner])
        for halo in (4, 16)
    )
    assert enough < 0.002 and narrow > 3 * enough


def test_the_weight_of_the_data_is_that_of_the_whole(blurred):
    noise = np.random.default_rng(0).normal(0, 0.05, blurred.shape).astype(np.float32)
    noise[:, :64] = 0
    params = DeconvolutionParams(method="tv", iterations=100, tolerance=0)
    whole = deconvolve(blurred + noise, 1.2, params)
    tiled = deconvolve_tiles(blurred + noise, 1.2, params, blurred, TILES)
    # By weights of their own tiles would differ by 0.06.
    assert np.sqrt(np.mean((tiled.image - whole.image) ** 2)) < 0.01


def test_records_of_a_deconvolution_add_up(blurred):
    params = DeconvolutionParams(method="tv", tolerance=1e-4)
    parts = [
        deconvolve(blurred[t.rows, t.columns], 1.2, replace(params, fidelity=900.0), blurred[t.rows, t.columns])
        for t in TILES
    ]
    tiled = deconvolve_tiles(blurred, 1.2, replace(params, fidelity=900.0), blurred, TILES)
    assert len({part.iterations for part in parts}) > 1
    assert tiled.iterations == max(part.iterations for part in parts)
    assert tiled.objective[-1] == pytest.approx(sum(part.objective[-1] for part in parts))
    assert tiled.objective[0] == pytest.approx(sum(part.objective[0] for part in parts))
    assert tiled.recorded.size == tiled.objective.size == tiled.changes.size
    assert tiled.converged == all(part.converged for part in parts)


def test_a_blur_is_removed_in_tiles_by_one_width(blurred):
    whole, tiled = (remove_blur(blurred, blurred, parts=parts) for parts in ((), TILES))
    assert tiled.blur.sigma == whole.blur.sigma
    assert tiled.deconvolution.sigma == whole.deconvolution.sigma > 0
    assert np.sqrt(np.mean((tiled.deconvolution.image - whole.deconvolution.image) ** 2)) < 0.01


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
        monkeypatch.setattr(pipeline, "sizes_to_deblur", lambda side, sigma: (side, HALO))

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


def test_only_the_deconvolution_has_a_wider_halo(sequence, in_tiles, monkeypatch):
    source = FrameSource.from_array(sequence.frames)
    monkeypatch.setattr("turbrestore.halo_tiles.HALO", HALO)
    in_tiles(source)
    monkeypatch.setattr(pipeline, "sizes_to_deblur", sizes_to_deblur)
    given = []

    def find(frames, tiles, *_):
        given.append({tile.halo for tile in tiles})
        return find_tiled_centroid(frames, tiles, QUICK.centroid)

    def remove(*arguments):
        given.append({tile.halo for tile in arguments[-1]})
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "find_tiled_centroid", find)
    monkeypatch.setattr(pipeline, "remove_blur", remove)
    with pytest.raises(KeyboardInterrupt):
        pipeline.restore(source, replace(QUICK, deconvolution=DeconvolutionParams(sigma=6.75)))
    assert given == [{HALO}, {27}]


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
