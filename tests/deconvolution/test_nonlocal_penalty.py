"""Nonlocal TV by strips against its operators on all edges at once."""

import numpy as np
import pytest
from regulariser import Regulariser

from turbrestore.deconvolution.nonlocal_penalty import NonlocalPenalty
from turbrestore.deconvolution.nonlocal_tv import (
    NonlocalGraph,
    NonlocalParams,
    nonlocal_divergence,
    nonlocal_gradient,
    nonlocal_total_variation,
    nonlocal_weights,
    project_to_unit,
)
from turbrestore.deconvolution.strip_grid import StripGrid
from turbrestore.runtime.threads import ThreadTeam


def by_operators(graph: NonlocalGraph) -> Regulariser:
    return Regulariser(
        lambda u: nonlocal_gradient(graph, u),
        lambda p: -nonlocal_divergence(graph, p),
        lambda p: project_to_unit(graph, p),
        lambda u: nonlocal_total_variation(graph, u),
        graph.norm_squared,
    )


def penalty_of(graph: NonlocalGraph) -> NonlocalPenalty:
    return NonlocalPenalty(graph, StripGrid(graph.shape))


def ascended(penalty, dual, image: np.ndarray, step: float, relaxation: float) -> np.ndarray:
    pull = np.full_like(image, np.nan)
    penalty.ascend(dual, image.copy(), step, relaxation, pull)
    return pull


def p_of(graph, dual):
    """``ga + Kl``, as the docstring of the module has it."""
    factors = np.stack([dual.factor.ravel()[graph.tails], dual.factor.ravel()[graph.heads]])
    return factors * dual.values + nonlocal_gradient(graph, dual.lagged)


@pytest.fixture(params=[1, 10_000], ids=["strips", "whole"])
def graph(request, monkeypatch):
    monkeypatch.setattr("turbrestore.deconvolution.nonlocal_tv.STRIP_PIXELS", request.param)
    guide = np.random.default_rng(0).random((23, 14)).astype(np.float32)
    return nonlocal_weights(guide, NonlocalParams(patch=3, search=7, best=5))


def test_the_value_is_that_of_the_operators(graph):
    image = np.random.default_rng(1).random(graph.shape).astype(np.float32)
    assert penalty_of(graph).value(image) == pytest.approx(nonlocal_total_variation(graph, image), rel=1e-5)


@pytest.mark.parametrize("relaxation", [1.0, 1.4])
def test_steps_are_those_of_the_operators(graph, relaxation):
    rng = np.random.default_rng(2)
    found, expected = penalty_of(graph), by_operators(graph)
    image = rng.random(graph.shape).astype(np.float32)
    dual, reference = found.dual(image), expected.dual(image)
    for _ in range(5):
        image = rng.normal(size=graph.shape).astype(np.float32)
        pull = ascended(found, dual, image, 0.7, relaxation)
        assert pull == pytest.approx(ascended(expected, reference, image, 0.7, relaxation), abs=2e-5)
        assert p_of(graph, dual) == pytest.approx(reference, abs=2e-5)
    assert np.abs(reference).max() > 0.5


def test_threads_and_files_change_nothing(graph, tmp_path, monkeypatch):
    image = np.random.default_rng(3).normal(size=graph.shape).astype(np.float32)
    pulls = []
    monkeypatch.setattr("turbrestore.deconvolution.strip_grid._ONE_STRIP", 1)
    for workers, folder in ((1, None), (2, None), (4, tmp_path)):
        with ThreadTeam(workers) as team:
            penalty = NonlocalPenalty(graph, StripGrid(graph.shape, team, folder), folder)
            dual = penalty.dual(image)
            pulls.append(b"".join(ascended(penalty, dual, image, 0.7, 1.4).tobytes() for _ in range(3)))
    assert len(set(pulls)) == 1
