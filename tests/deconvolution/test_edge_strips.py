"""Sums over the edges of a strip: what they are, and what is left of them."""

import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from turbrestore.deconvolution.edge_strips import EdgeStrip


@pytest.fixture
def strip():
    rng = np.random.default_rng(0)
    degrees = rng.integers(0, 5, 300)
    heads = rng.integers(0, 400, degrees.sum()).astype(np.int32)
    roots = rng.random(len(heads), dtype=np.float32)
    return EdgeStrip(10, 400, degrees, heads, roots, np.arange(len(heads) + 1, dtype=np.int32))


@pytest.mark.parametrize("subtract", [False, True])
def test_sums_are_those_of_every_edge(strip, subtract):
    a, b, c, d = np.random.default_rng(1).normal(size=(4, len(strip.heads))).astype(np.float32)
    expected = np.zeros(400)
    np.add.at(expected, np.repeat(np.arange(300), strip.degrees), a * b)
    np.add.at(expected, strip.heads, -c * d if subtract else c * d)
    assert strip.gather((a, b), (c, d), subtract) == pytest.approx(expected, abs=1e-5)


def test_nothing_of_a_sum_stays(strip):
    values = np.ones(len(strip.heads), np.float32)
    there = weakref.ref(values)
    strip.gather((values, values), (values, values))
    del values
    assert there() is None


def test_threads_may_share_a_strip(strip):
    functions = np.random.default_rng(2).normal(size=(64, len(strip.heads))).astype(np.float32)
    alone = [strip.gather((v, v), (v, v)) for v in functions]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda v: strip.gather((v, v), (v, v)), functions))
    assert all(np.array_equal(a, b) for a, b in zip(alone, together, strict=True))
