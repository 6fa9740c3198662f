"""Weights against a double loop over all pixels, operators against their definitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.deconvolution.nonlocal_tv import (
    NonlocalGraph,
    NonlocalParams,
    nonlocal_divergence,
    nonlocal_gradient,
    nonlocal_magnitude,
    nonlocal_total_variation,
    nonlocal_weights,
    project_to_unit,
)

SMALL = NonlocalParams(patch=3, search=5, best=3)


def weight_matrix(graph: NonlocalGraph) -> np.ndarray:
    count = graph.shape[0] * graph.shape[1]
    matrix = np.zeros((count, count))
    matrix[graph.tails, graph.heads] = graph.weights
    return matrix + matrix.T


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


def test_bands_tiles_and_strips_leave_no_seam(monkeypatch):
    guide = np.random.default_rng(1).random((40, 31)).astype(np.float32)
    whole = nonlocal_weights(guide, SMALL)
    for name, size in (
        ("deconvolution.patch_search.BAND_ROWS", 7),
        ("deconvolution.patch_search._TILE_COLUMNS", 6),
        ("deconvolution.nonlocal_tv.STRIP_PIXELS", 1),
    ):
        monkeypatch.setattr(f"turbrestore.{name}", size)
    parts = nonlocal_weights(guide, SMALL)
    assert len(parts.strips) > 8
    assert len(whole.strips) == 1
    assert np.array_equal(whole.tails, parts.tails)
    assert np.array_equal(whole.heads, parts.heads)
    assert np.allclose(whole.weights, parts.weights, atol=1e-5)


def test_pairs_in_a_file_are_those_in_memory(tmp_path):
    guide = np.random.default_rng(1).random((80, 31)).astype(np.float32)
    kept, filed = nonlocal_weights(guide), nonlocal_weights(guide, folder=tmp_path)
    assert isinstance(filed.strips[0].roots.base.base, np.memmap)
    assert np.array_equal(kept.heads, filed.heads)
    assert np.array_equal(kept.weights, filed.weights)
    assert kept.norm_squared == filed.norm_squared


def test_pairs_are_stored_once_and_weights_are_positive():
    guide = np.random.default_rng(2).random((16, 16)).astype(np.float32)
    graph = nonlocal_weights(guide)
    assert (graph.tails < graph.heads).all()
    assert len(set(zip(graph.tails.tolist(), graph.heads.tolist(), strict=True))) == len(graph.tails)
    assert (graph.weights > 0).all()
    assert (graph.weights <= 1 + 1e-6).all()
    # Every pixel keeps its four neighbours, so none is left without regularisation.
    assert (np.count_nonzero(weight_matrix(graph), axis=1) >= 4 - 2).all()


@pytest.mark.parametrize("noise", [0.001, 0.02])
def test_flat_regions_hold_together_whatever_the_noise(noise):
    guide = np.full((32, 32), 0.5, np.float32)
    guide[:, 16:] = 0.9
    guide += np.random.default_rng(3).normal(0, noise, guide.shape).astype(np.float32)
    graph = nonlocal_weights(guide)
    inside = (graph.tails % 32 < 10) & (graph.heads % 32 < 10)
    across = (graph.tails % 32 < 15) & (graph.heads % 32 > 16)
    assert graph.weights[inside].min() > 0.5
    assert np.median(graph.weights[inside]) > 0.85
    assert graph.weights[across].max(initial=0) < 1e-3


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


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(1, 2), (5, 4), (9, 13)]))
def test_divergence_is_the_negative_adjoint_of_the_gradient(seed, shape):
    rng = np.random.default_rng(seed)
    graph = nonlocal_weights(rng.random(shape), NonlocalParams(patch=3, search=5, best=4))
    u = rng.normal(size=shape).astype(np.float32)
    v = rng.normal(size=(2, len(graph.tails))).astype(np.float32)
    left = np.vdot(nonlocal_gradient(graph, u).astype(np.float64), v)
    right = -np.vdot(u.astype(np.float64), nonlocal_divergence(graph, v))
    assert left == pytest.approx(right, abs=1e-4 * np.sqrt(v.size))


def test_operators_match_the_formulas_of_the_paper():
    rng = np.random.default_rng(5)
    graph = nonlocal_weights(rng.random((6, 5)), SMALL)
    w, u = weight_matrix(graph), rng.normal(size=(6, 5)).astype(np.float32)
    flat, forward, backward = u.ravel().astype(np.float64), (graph.tails, graph.heads), (graph.heads, graph.tails)
    gradient = (flat[None, :] - flat[:, None]) * np.sqrt(w)
    found = nonlocal_gradient(graph, u)
    assert found[0] == pytest.approx(gradient[forward], abs=1e-5)
    assert found[1] == pytest.approx(gradient[backward], abs=1e-5)
    v = np.zeros_like(w)
    edges = rng.normal(size=found.shape).astype(np.float32)
    v[forward], v[backward] = edges
    divergence = ((v - v.T) * np.sqrt(w)).sum(axis=1)
    assert nonlocal_divergence(graph, edges).ravel() == pytest.approx(divergence, abs=1e-5)
    assert nonlocal_magnitude(graph, edges).ravel() == pytest.approx(np.sqrt((v**2).sum(axis=1)), abs=1e-5)
    assert nonlocal_total_variation(graph, u) == pytest.approx(np.sqrt((gradient**2).sum(axis=1)).sum(), rel=1e-5)


def test_projection_is_the_nearest_point_of_the_unit_balls():
    rng = np.random.default_rng(6)
    graph = nonlocal_weights(rng.random((6, 5)), SMALL)
    v = rng.normal(size=(2, len(graph.tails))).astype(np.float32)
    v[:, :20] *= 0.01
    nearest = project_to_unit(graph, v)
    assert nonlocal_magnitude(graph, nearest).max() <= 1 + 1e-6
    for _ in range(50):
        other = project_to_unit(graph, rng.normal(size=v.shape).astype(np.float32))
        # The angle at the projection is obtuse for every other point of the convex set.
        assert np.vdot(v - nearest, other - nearest) <= 1e-4


@pytest.mark.parametrize("params", [SMALL, NonlocalParams()])
def test_norm_bound_holds_and_is_not_wasteful(params):
    rng = np.random.default_rng(7)
    graph = nonlocal_weights(rng.random((14, 15)), params)
    exact = 2 * np.linalg.norm(graph.difference.toarray().astype(np.float64), 2) ** 2
    assert exact <= graph.norm_squared * (1 + 1e-6)
    assert graph.norm_squared < 1.5 * exact


def test_colour_guides_are_reduced_to_luminance():
    grey = np.random.default_rng(8).random((8, 8)).astype(np.float32)
    colour = np.repeat(grey[..., None], 3, axis=2)
    a, b = nonlocal_weights(grey, SMALL), nonlocal_weights(colour, SMALL)
    assert weight_matrix(a) == pytest.approx(weight_matrix(b), abs=1e-4)


@pytest.mark.parametrize(
    "settings",
    [
        {"patch": 4},
        {"search": 0},
        {"search": 103},
        {"patch_sigma": 0.0},
        {"nearest": 5},
        {"best": -1},
        {"best": 0, "nearest": 0},
        {"search": 3, "best": 9},
        {"search": 1, "best": 0},
        {"h": 0.0},
    ],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(ConfigurationError, match="expected"):
        NonlocalParams(**settings)


def test_a_single_pixel_has_no_neighbours():
    with pytest.raises(DataError, match="two pixels"):
        nonlocal_weights(np.zeros((1, 1)))
