import numpy as np
import pytest

from turbrestore.errors import ConfigurationError
from turbrestore.image_stacks import numpy_ops, sample_spline, spline_coefficients, torch_ops
from turbrestore.warp import warp

RNG = np.random.default_rng(0)
STACK = RNG.random((3, 20, 27)).astype(np.float32)
KERNEL = np.array([0.1, -0.3, 0.5, 0.2, 0.4], np.float32)
ONE = np.ones(1, np.float32)
Y, X = (np.broadcast_to(axis, STACK.shape).astype(np.float32) for axis in np.mgrid[:20, :27])
SHIFTED = [axis + RNG.uniform(-4, 4, STACK.shape).astype(np.float32) for axis in (X, Y)]


@pytest.mark.parametrize(
    "operation",
    [
        lambda ops, stack: ops.filter(stack, KERNEL, ONE),
        lambda ops, stack: ops.filter(stack, ONE, KERNEL),
        lambda ops, stack: ops.filter(stack, KERNEL, KERNEL),
        lambda ops, stack: ops.filter(stack[:, None, None], KERNEL, ONE),
        lambda ops, stack: ops.resize(stack, (10, 14)),
        lambda ops, stack: ops.resize(stack[None], (41, 53)),
        lambda ops, stack: ops.bilinear(stack, *map(ops.load, SHIFTED)),
        lambda ops, stack: sample_spline(spline_coefficients(stack, ops), *map(ops.load, SHIFTED), ops),
        lambda ops, stack: ops.median(stack, 3),
        lambda ops, stack: ops.median(stack[None], 5),
    ],
)
def test_both_libraries_agree(operation):
    here, there = numpy_ops(), torch_ops("cpu")
    a, b = operation(here, STACK), there.store(operation(there, there.load(STACK)))
    assert a.shape == b.shape
    assert a.dtype == b.dtype == np.float32
    assert np.abs(a - b).max() < 2e-5


def test_filter_correlates_and_reflects_the_image():
    padded = np.pad(STACK, ((0, 0), (0, 0), (2, 2)), mode="reflect")
    by_hand = sum(k * padded[..., i : i + 27] for i, k in enumerate(KERNEL))
    assert np.abs(numpy_ops().filter(STACK, KERNEL, ONE) - by_hand).max() < 1e-6


def test_splines_are_those_of_warp():
    ops = numpy_ops()
    sampled = sample_spline(spline_coefficients(STACK, ops), *SHIFTED, ops)
    flow = np.stack([SHIFTED[0] - X, SHIFTED[1] - Y], axis=-1)
    for image, displacement, found in zip(STACK, flow, sampled, strict=True):
        assert np.abs(warp(image, displacement) - found).max() < 1e-5


def test_median_is_that_of_the_window():
    padded = np.pad(STACK, ((0, 0), (2, 2), (2, 2)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(1, 2))
    assert (numpy_ops().median(STACK, 5) == np.median(windows, axis=(-1, -2))).all()


def test_missing_cuda_is_named():
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        with pytest.raises(ConfigurationError, match="^device: torch sees no CUDA"):
            torch_ops("cuda")


def test_missing_torch_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "torch", None)
    with pytest.raises(ConfigurationError, match="^backend: torch is not installed"):
        torch_ops("cpu")
