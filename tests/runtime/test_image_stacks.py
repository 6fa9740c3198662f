import numpy as np
import pytest

from turbrestore.registration.warp import warp
from turbrestore.runtime.image_stacks import numpy_ops, spline_coefficients, torch_ops, warp_stack

RNG = np.random.default_rng(0)
STACK = RNG.random((3, 20, 27)).astype(np.float32)
KERNEL = np.array([0.1, -0.3, 0.5, 0.2, 0.4], np.float32)
ONE = np.ones(1, np.float32)
Y, X = (np.broadcast_to(axis, STACK.shape).astype(np.float32) for axis in np.mgrid[:20, :27])
FLOW = RNG.uniform(-4, 4, (20, 27, 2)).astype(np.float32)
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
        lambda ops, stack: ops.sample(stack, *map(ops.load, SHIFTED)),
        lambda ops, stack: ops.sample(spline_coefficients(stack, ops), *map(ops.load, SHIFTED)),
        lambda ops, stack: warp_stack(stack, ops.load(FLOW), ops),
        lambda ops, stack: ops.median(stack, 3),
        lambda ops, stack: ops.median(stack[None], 5),
    ],
)
def test_both_libraries_agree(operation):
    pytest.importorskip("torch", reason="torch is not installed")
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
    sampled = ops.sample(spline_coefficients(STACK, ops), *SHIFTED)
    flow = np.stack([SHIFTED[0] - X, SHIFTED[1] - Y], axis=-1)
    for image, displacement, found in zip(STACK, flow, sampled, strict=True):
        assert np.abs(warp(image, displacement) - found).max() < 1e-5


def test_median_is_that_of_the_window():
    padded = np.pad(STACK, ((0, 0), (2, 2), (2, 2)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(1, 2))
    assert (numpy_ops().median(STACK, 5) == np.median(windows, axis=(-1, -2))).all()


def test_torch_samples_wide_images_as_exactly_as_narrow_ones():
    pytest.importorskip("torch", reason="torch is not installed")
    wide = RNG.random((1, 16, 4000)).astype(np.float32)
    t = np.float32(0.375)
    y, x = (axis[None] + t for axis in np.mgrid[:16, :4000].astype(np.float32))
    ops = torch_ops("cpu")
    sampled = ops.store(ops.sample(ops.load(wide), ops.load(x), ops.load(y)))
    weights = np.array([(1 - t) ** 3, 4 - 6 * t**2 + 3 * t**3, 1 + 3 * t + 3 * t**2 - 3 * t**3, t**3]) / 6
    windows = np.lib.stride_tricks.sliding_window_view(wide[0], (4, 4))
    assert np.abs(np.einsum("yxij,i,j->yx", windows, weights, weights) - sampled[0, 1:-2, 1:-2]).max() < 1e-6


def test_torch_filters_with_kernels_longer_than_the_image():
    pytest.importorskip("torch", reason="torch is not installed")
    kernel = RNG.random(61).astype(np.float32)
    here, there = numpy_ops(), torch_ops("cpu")
    a, b = here.filter(STACK, kernel, ONE), there.store(there.filter(there.load(STACK), kernel, ONE))
    assert np.abs(a - b).max() < 1e-5 * np.abs(a).max()
