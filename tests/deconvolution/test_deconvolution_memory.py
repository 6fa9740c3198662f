"""Memory that a deconvolution takes, against what is stated for it."""

import tracemalloc

import numpy as np
import pytest

from turbrestore.deconvolution.deconvolve import METHODS, DeconvolutionParams, deconvolve
from turbrestore.deconvolution.memory import deconvolution_memory
from turbrestore.deconvolution.nonlocal_prior.nonlocal_weights import NonlocalParams
from turbrestore.deconvolution.primal_dual import REST, PrimalDual
from turbrestore.runtime.runtime import Runtime


def peak(image: np.ndarray, params: DeconvolutionParams, threads: int) -> int:
    """Peak of arrays, bytes."""
    tracemalloc.start()
    try:
        deconvolve(image, 1.5, params, image, Runtime(threads=threads))
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("channels", "threads"), [("grey", 1), ("luminance", 8), ("each", 8)])
def test_every_method_keeps_what_is_stated(monkeypatch, threads, method, channels):
    shape = (400, 500) if channels == "grey" else (400, 500, 3)
    image = np.random.default_rng(0).random(shape, np.float32)
    # All images that the rule of rest compares with are kept.
    monkeypatch.setattr(PrimalDual, "window", 1)
    params = DeconvolutionParams(method=method, sigma=1.5, iterations=REST + 2, tolerance=0)
    if channels == "each":
        params = DeconvolutionParams(method=method, sigma=1.5, iterations=REST + 2, tolerance=0, channels="each")
    # The compiler takes memory once.
    deconvolve(image[:48, :48], 1.5, params)
    stated = deconvolution_memory(shape, params, threads)
    assert 0.3 * (stated - 2e7) < peak(image, params, threads) < stated


def test_many_neighbours_and_wide_margins_count():
    least = deconvolution_memory((540, 960), DeconvolutionParams(sigma=1.0))
    assert deconvolution_memory((540, 960), DeconvolutionParams(sigma=20.0)) > 1.3 * least
    many = DeconvolutionParams(sigma=1.0, weights=NonlocalParams(best=60))
    assert deconvolution_memory((540, 960), many) > least + 540 * 960 * 50 * 8
