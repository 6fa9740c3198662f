"""Compiled loops of nonlocal TV against operators on all pairs at once, and these against the formulas of the paper."""

import numpy as np
import pair_operators as pairs
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.deconvolution.nonlocal_prior import nonlocal_tv
from turbrestore.deconvolution.nonlocal_prior.nonlocal_tv import NonlocalPenalty, add_adjoint, add_gradient, add_squares
from turbrestore.deconvolution.nonlocal_prior.nonlocal_weights import NonlocalGraph, NonlocalParams, nonlocal_weights

SMALL = NonlocalParams(patch=3, search=5, best=3)


def p_of(graph: NonlocalGraph, dual: nonlocal_tv.PairDual) -> np.ndarray:
    """``p = ga + Kl``."""
    factors = np.stack([dual.factor[pairs.tails(graph)], dual.factor[graph.heads]])
    return factors * dual.values + pairs.gradient(graph, dual.lag)


@pytest.fixture
def graph(monkeypatch) -> NonlocalGraph:
    """Of an image of many bands."""
    monkeypatch.setattr(nonlocal_tv, "_LEAST_ROWS", 1)
    guide = np.random.default_rng(0).random((23, 14)).astype(np.float32)
    return nonlocal_weights(guide, NonlocalParams(patch=3, search=7, best=5))


def test_the_value_is_that_of_the_operators(graph):
    image = np.random.default_rng(1).random(graph.shape).astype(np.float32)
    assert NonlocalPenalty(graph).value(image) == pytest.approx(pairs.total_variation(graph, image), rel=1e-5)


@pytest.mark.parametrize("relaxation", [1.0, 1.4])
def test_ascent_is_a_relaxed_projection(graph, relaxation):
    rng, penalty = np.random.default_rng(2), NonlocalPenalty(graph)
    dual, p = None, np.zeros((2, len(graph.heads)), np.float32)
    for _ in range(5):
        image = rng.normal(size=graph.shape).astype(np.float32)
        p += relaxation * (pairs.project(graph, p + 0.7 * pairs.gradient(graph, image)) - p)
        dual, adjoint = penalty.ascend(dual, image, 0.7, relaxation)
        assert adjoint == pytest.approx(-pairs.divergence(graph, p), abs=2e-5)
        assert p_of(graph, dual) == pytest.approx(p, abs=2e-5)
    assert np.abs(p).max() > 0.5


def test_bands_of_one_half_share_no_pixels(graph):
    """Else threads could write to the same pixel at the same time."""
    bands: list[np.ndarray] = []
    NonlocalPenalty(graph)._over_bands(bands.append)
    reached = [
        set(range(first, last)) | set(graph.heads[graph.starts[first] : graph.starts[last]].tolist())
        for first, last in bands
    ]
    half = (len(bands) + 1) // 2
    for part in (reached[:half], reached[half:]):
        assert sum(map(len, part)) == len(set().union(*part))
    assert len(bands) > 4
    assert sorted(first for first, _ in bands)[1:] == sorted(last for _, last in bands)[:-1]


def test_compiled_loops_do_what_is_written(graph):
    rng, size = np.random.default_rng(4), graph.shape[0] * graph.shape[1]
    factor, image, total = rng.random((3, size)).astype(np.float32)
    values, band = rng.normal(size=(2, len(graph.heads))).astype(np.float32), np.array([14, 140])
    edges = graph.starts, graph.heads, graph.roots, band
    for loop, before in (
        (add_gradient, (factor, image, *edges, values, total)),
        (add_adjoint, (factor, image, *edges, values, total)),
        (add_squares, (image, *edges, total)),
    ):
        fast, slow = ([array.copy() for array in before] for _ in range(2))
        loop(*fast)
        loop.py_func(*slow)
        for one, other in zip(fast, slow, strict=True):
            assert one == pytest.approx(other, abs=1e-5)
        assert np.abs(fast[-1] - total).max() > 0.1


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(1, 2), (5, 4), (9, 13)]))
def test_divergence_is_the_negative_adjoint_of_the_gradient(seed, shape):
    rng = np.random.default_rng(seed)
    graph = nonlocal_weights(rng.random(shape), NonlocalParams(patch=3, search=5, best=4))
    u = rng.normal(size=shape).astype(np.float32)
    v = rng.normal(size=(2, len(pairs.tails(graph)))).astype(np.float32)
    left = np.vdot(pairs.gradient(graph, u).astype(np.float64), v)
    right = -np.vdot(u.astype(np.float64), pairs.divergence(graph, v))
    assert left == pytest.approx(right, abs=1e-4 * np.sqrt(v.size))


def test_operators_match_the_formulas_of_the_paper():
    rng = np.random.default_rng(5)
    graph = nonlocal_weights(rng.random((6, 5)), SMALL)
    w, u = pairs.weight_matrix(graph), rng.normal(size=(6, 5)).astype(np.float32)
    flat, forward, backward = (
        u.ravel().astype(np.float64),
        (pairs.tails(graph), graph.heads),
        (graph.heads, pairs.tails(graph)),
    )
    gradient = (flat[None, :] - flat[:, None]) * np.sqrt(w)
    found = pairs.gradient(graph, u)
    assert found[0] == pytest.approx(gradient[forward], abs=1e-5)
    assert found[1] == pytest.approx(gradient[backward], abs=1e-5)
    v = np.zeros_like(w)
    edges = rng.normal(size=found.shape).astype(np.float32)
    v[forward], v[backward] = edges
    divergence = ((v - v.T) * np.sqrt(w)).sum(axis=1)
    assert pairs.divergence(graph, edges).ravel() == pytest.approx(divergence, abs=1e-5)
    assert pairs.magnitude(graph, edges).ravel() == pytest.approx(np.sqrt((v**2).sum(axis=1)), abs=1e-5)
    assert pairs.total_variation(graph, u) == pytest.approx(np.sqrt((gradient**2).sum(axis=1)).sum(), rel=1e-5)


def test_projection_is_the_nearest_point_of_the_unit_balls():
    rng = np.random.default_rng(6)
    graph = nonlocal_weights(rng.random((6, 5)), SMALL)
    v = rng.normal(size=(2, len(pairs.tails(graph)))).astype(np.float32)
    v[:, :20] *= 0.01
    nearest = pairs.project(graph, v)
    assert pairs.magnitude(graph, nearest).max() <= 1 + 1e-6
    for _ in range(50):
        other = pairs.project(graph, rng.normal(size=v.shape).astype(np.float32))
        # The angle at the projection is obtuse for every other point of the convex set.
        assert np.vdot(v - nearest, other - nearest) <= 1e-4
