"""Total variation against its definition."""

import numpy as np
import pytest

from turbrestore.deconvolution.tv import LocalPenalty, local_divergence, local_gradient


@pytest.mark.parametrize("shape", [(1, 5), (7, 6)])
def test_divergence_is_the_negative_adjoint_of_the_gradient(shape):
    rng = np.random.default_rng(0)
    u, v = rng.normal(size=shape).astype(np.float32), rng.normal(size=(2, *shape)).astype(np.float32)
    assert np.vdot(local_gradient(u), v) == pytest.approx(-np.vdot(u, local_divergence(v)), abs=1e-4)


@pytest.mark.parametrize("relaxation", [1.0, 1.8])
def test_ascent_is_a_relaxed_projection(relaxation):
    rng, penalty = np.random.default_rng(1), LocalPenalty()
    u, p = rng.normal(size=(9, 7)).astype(np.float32), rng.normal(size=(2, 9, 7)).astype(np.float32)
    raised = p + 0.7 * local_gradient(u)
    nearest = np.where((length := np.hypot(*raised)) > 1, raised / length, raised)
    expected = p + relaxation * (nearest - p)
    found, adjoint = penalty.ascend(p, u, 0.7, relaxation)
    assert found == pytest.approx(expected, abs=1e-5)
    assert adjoint == pytest.approx(-local_divergence(expected), abs=1e-5)
    first, adjoint = penalty.ascend(None, u, 0.7, relaxation)
    expected, of_it = penalty.ascend(0 * p, u, 0.7, relaxation)
    assert (first == expected).all() and (adjoint == of_it).all()


def test_value_is_the_sum_of_lengths():
    u = np.random.default_rng(2).random((6, 8)).astype(np.float32)
    assert LocalPenalty().value(u) == pytest.approx(np.hypot(*local_gradient(u)).sum(), rel=1e-5)


def test_the_bound_of_the_norm_holds():
    stripes = np.indices((8, 8)).sum(axis=0) % 2 * 2.0 - 1
    ratio = (local_gradient(stripes) ** 2).sum() / (stripes**2).sum()
    assert ratio == LocalPenalty().norm_squared
