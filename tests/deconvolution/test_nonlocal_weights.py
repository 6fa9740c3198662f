"""Weights against a double loop over all pixels."""

import numpy as np
import pair_operators as pairs
import pytest
from pair_operators import tails, weight_matrix
from small_problems import dense

from turbrestore.core.errors import DataError
from turbrestore.deconvolution.nonlocal_prior.nonlocal_weights import (
    NonlocalParams,
    join_pairs,
    mark_pairs,
    nonlocal_weights,
    place_pairs,
    search_patches,
    search_tile,
)

SMALL = NonlocalParams(patch=3, search=5, best=3)


def brute_force_weights(guide: np.ndarray, params: NonlocalParams, h: float) -> np.ndarray:
    """Equation (23) for every pair of pixels of the search window, then the choice of neighbours."""
    height, width = guide.shape
    reach, half = params.search // 2, params.patch // 2
    axis = np.arange(-half, half + 1)
    window = np.exp(-(axis**2) / (2 * params.patch_sigma**2))
    window = np.outer(window, window) / window.sum() ** 2
    padded = np.pad(guide, half, mode="reflect").astype(np.float64)
    patches = {(y, x): padded[y : y + 2 * half + 1, x : x + 2 * half + 1] for y in range(height) for x in range(width)}
    matrix = np.zeros((guide.size, guide.size))
    for (y, x), patch in patches.items():
        found = []
        for (v, u), other in patches.items():
            if (v, u) != (y, x) and max(abs(v - y), abs(u - x)) <= reach:
                near = (v - y) ** 2 + (u - x) ** 2 <= {0: 0, 4: 1, 8: 2}[params.nearest]
                found.append((float((window * (patch - other) ** 2).sum()), near, v * width + u))
        found.sort()
        for rank, (distance, near, neighbour) in enumerate(found):
            if near or rank < params.best:
                matrix[y * width + x, neighbour] = np.exp(-distance / h**2)
    return np.maximum(matrix, matrix.T)


@pytest.mark.parametrize("nearest", [0, 4, 8])
@pytest.mark.parametrize("shape", [(8, 7), (2, 9)])
def test_weights_match_a_double_loop(nearest, shape):
    guide = np.random.default_rng(0).random(shape).astype(np.float32)
    params = NonlocalParams(patch=3, search=5, best=3, nearest=nearest, h=0.4)
    assert weight_matrix(nonlocal_weights(guide, params)) == pytest.approx(
        brute_force_weights(guide, params, 0.4), abs=1e-4
    )


@pytest.mark.long
def test_tiles_leave_no_seam(monkeypatch):
    guide = np.random.default_rng(1).random((22, 19)).astype(np.float32)
    whole = nonlocal_weights(guide, SMALL)
    monkeypatch.setattr("turbrestore.deconvolution.nonlocal_prior.nonlocal_weights._TILE_ROWS", 7)
    monkeypatch.setattr("turbrestore.deconvolution.nonlocal_prior.nonlocal_weights._TILE_COLUMNS", 6)
    parts = nonlocal_weights(guide, SMALL, threads=3)
    assert weight_matrix(parts) == pytest.approx(weight_matrix(whole), abs=1e-5)


def test_pairs_are_stored_once_and_weights_are_positive():
    guide = np.random.default_rng(2).random((16, 16)).astype(np.float32)
    graph = nonlocal_weights(guide)
    assert (tails(graph) < graph.heads).all()
    assert len(set(zip(tails(graph).tolist(), graph.heads.tolist(), strict=True))) == len(tails(graph))
    assert ((graph.roots**2) > 0).all()
    assert ((graph.roots**2) <= 1 + 1e-6).all()
    # Every pixel keeps its four neighbours, so none is left without regularisation.
    assert (np.count_nonzero(weight_matrix(graph), axis=1) >= 4 - 2).all()


@pytest.mark.parametrize("noise", [0.001, 0.02])
def test_flat_regions_hold_together_whatever_the_noise(noise):
    guide = np.full((32, 32), 0.5, np.float32)
    guide[:, 16:] = 0.9
    guide += np.random.default_rng(3).normal(0, noise, guide.shape).astype(np.float32)
    graph = nonlocal_weights(guide)
    inside = (tails(graph) % 32 < 10) & (graph.heads % 32 < 10)
    across = (tails(graph) % 32 < 15) & (graph.heads % 32 > 16)
    assert (graph.roots**2)[inside].min() > 0.5
    assert np.median((graph.roots**2)[inside]) > 0.85
    assert (graph.roots**2)[across].max(initial=0) < 1e-3


def test_noise_raises_h_only_when_it_matters():
    rng = np.random.default_rng(4)
    scene = np.tile(np.linspace(0, 1, 64, dtype=np.float32), (64, 1))
    noisy = scene + rng.normal(0, 0.05, scene.shape).astype(np.float32)
    assert nonlocal_weights(scene).h == pytest.approx(1 / 8, rel=0.03)
    assert nonlocal_weights(noisy).h == pytest.approx(0.2, rel=0.1)


def test_equal_patches_take_the_nearer_pixels():
    graph = nonlocal_weights(np.zeros((9, 9)), NonlocalParams(patch=3, search=9, best=8, nearest=0))
    matrix = weight_matrix(graph).reshape(9, 9, 9, 9)
    assert np.count_nonzero(matrix[4, 4]) == 8
    assert (matrix[4, 4, 3:6, 3:6].ravel()[[0, 1, 2, 3, 5, 6, 7, 8]] == 1).all()


@pytest.mark.parametrize("params", [SMALL, NonlocalParams()])
def test_norm_bound_holds_and_is_not_wasteful(params):
    rng = np.random.default_rng(7)
    graph = nonlocal_weights(rng.random((14, 15)), params)
    exact = 2 * np.linalg.norm(dense(lambda u: pairs.gradient(graph, u)[0], graph.shape), 2) ** 2
    assert exact <= graph.norm_squared() * (1 + 1e-6)
    assert graph.norm_squared() < 1.5 * exact


def test_colour_guides_are_reduced_to_luminance():
    grey = np.random.default_rng(8).random((8, 8)).astype(np.float32)
    colour = np.repeat(grey[..., None], 3, axis=2)
    a, b = nonlocal_weights(grey, SMALL), nonlocal_weights(colour, SMALL)
    assert weight_matrix(a) == pytest.approx(weight_matrix(b), abs=1e-4)


def test_a_single_pixel_has_no_neighbours():
    with pytest.raises(DataError, match="two pixels"):
        nonlocal_weights(np.zeros((1, 1)))


@pytest.mark.parametrize("shape", [(1, 9), (14, 19), (67, 5)])
@pytest.mark.parametrize("chosen", [(4, 10), (0, 3), (8, 0), (0, 32)])
def test_the_compiled_search_does_what_is_written(monkeypatch, shape, chosen):
    """In the image, at its border, and where so many neighbours are chosen that some lie beyond the border."""
    guide, (nearest, best) = np.random.default_rng(9).random(shape, np.float32), chosen
    params = NonlocalParams(patch=3, search=7, nearest=nearest, best=best)
    mask, fast = params.rank_mask, search_patches(guide, params)
    monkeypatch.setattr("turbrestore.deconvolution.nonlocal_prior.nonlocal_weights.search_tile", search_tile.py_func)
    slow = search_patches(guide, params)
    assert fast.shape == slow.shape == (guide.size, nearest + best)
    assert np.array_equal(fast[:, :nearest] & mask, slow[:, :nearest] & mask)
    for part in (np.s_[:, :nearest], np.s_[:, nearest:]):
        distances = [(np.sort(keys[part], axis=1) & ~mask).view(np.float32) for keys in (fast, slow)]
        assert distances[0] == pytest.approx(distances[1], rel=1e-4)
    # The same offsets, except for those of about the same distance.
    same = (np.sort(fast & mask, axis=1) == np.sort(slow & mask, axis=1)).all(axis=1)
    assert same.mean() > 0.98


@pytest.mark.parametrize("shape", [(1, 9), (5, 1), (4, 9), (14, 19)])
@pytest.mark.parametrize("chosen", [(4, 6), (0, 1), (8, 0), (0, 20)])
@pytest.mark.parametrize("flat", [True, False])
def test_pairs_are_those_that_either_pixel_chooses(monkeypatch, shape, chosen, flat):
    """Compiled and as written; where all patches are equal, most pairs are chosen twice."""
    guide = np.random.default_rng(10).random(shape, np.float32) * (not flat)
    params = NonlocalParams(patch=1, search=7, nearest=chosen[0], best=chosen[1])
    keys, chosen_pairs = search_patches(guide, params), set()
    for pixel, key in zip(*np.nonzero(keys < np.float32(np.inf).view(np.int32)), strict=True):
        dy, dx = params.offsets[keys[pixel, key] & params.rank_mask]
        chosen_pairs.add(tuple(sorted((int(pixel), int(pixel + dy * shape[1] + dx)))))
    fast = join_pairs(keys.copy(), shape[1], params)
    for name, loop in (("mark_pairs", mark_pairs), ("place_pairs", place_pairs)):
        monkeypatch.setattr(f"turbrestore.deconvolution.nonlocal_prior.nonlocal_weights.{name}", loop.py_func)
    slow = join_pairs(keys, shape[1], params)
    for one, other in zip(fast, slow, strict=True):
        assert np.array_equal(one, other)
    starts, heads, _ = fast
    found = list(zip(np.repeat(np.arange(guide.size), np.diff(starts)).tolist(), heads.tolist(), strict=True))
    assert len(found) == len(chosen_pairs)
    assert set(found) == chosen_pairs
