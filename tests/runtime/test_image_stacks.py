import numpy as np
import pytest

from turbrestore.runtime.image_stacks import (
    correlate,
    full_precision,
    load,
    load_image,
    median,
    namespace,
    resize,
    sample,
    sample_spline,
    spline_coefficients,
    store,
    store_image,
    warp_stack,
)

RNG = np.random.default_rng(0)
STACK = RNG.random((3, 20, 27)).astype(np.float32)
KERNEL = np.array([0.1, -0.3, 0.5, 0.2, 0.4], np.float32)
ONE = np.ones(1, np.float32)
FLOW = RNG.uniform(-4, 4, (20, 27, 2)).astype(np.float32)
FLOWS = RNG.uniform(-4, 4, (3, 2, 20, 27)).astype(np.float32)


@pytest.mark.parametrize(
    "operation",
    [
        lambda stack: correlate(stack, KERNEL, ONE),
        lambda stack: correlate(stack, ONE, KERNEL),
        lambda stack: correlate(stack, KERNEL, KERNEL),
        lambda stack: correlate(stack[:, None, None], KERNEL, ONE),
        lambda stack: resize(stack, (10, 14)),
        lambda stack: resize(stack[None], (41, 53)),
        lambda stack: sample(stack, load(FLOWS, stack.device)),
        lambda stack: sample(spline_coefficients(stack), load(FLOWS, stack.device)),
        lambda stack: warp_stack(stack, load(FLOW, stack.device)),
        lambda stack: median(stack, 3),
        lambda stack: median(stack[None], 5),
    ],
)
def test_both_libraries_agree(operation):
    pytest.importorskip("torch", reason="torch is not installed")
    a, b = operation(STACK), store(operation(load(STACK, "cpu:0")))
    assert a.shape == b.shape
    assert a.dtype == b.dtype == np.float32
    assert np.abs(a - b).max() < 2e-5


def test_an_array_tells_its_library_and_an_image_comes_back():
    torch = pytest.importorskip("torch", reason="torch is not installed")
    assert load(STACK, "cpu") is STACK
    for device, library in (("cpu", np), ("cpu:0", torch)):
        for image in (STACK[0], np.moveaxis(STACK, 0, -1)):
            channels = load_image(image, device)
            assert namespace(channels) is library
            assert tuple(channels.shape[-2:]) == image.shape[:2]
            assert np.array_equal(store_image(channels), image)
            assert namespace(load(STACK, channels.device)) is library


def test_filter_correlates_and_reflects_the_image():
    padded = np.pad(STACK, ((0, 0), (0, 0), (2, 2)), mode="reflect")
    by_hand = sum(k * padded[..., i : i + 27] for i, k in enumerate(KERNEL))
    assert np.abs(correlate(STACK, KERNEL, ONE) - by_hand).max() < 1e-6


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (2, 2), (9, 1), (31, 45)])
def test_the_compiled_spline_does_what_it_says(shape):
    coefficients = RNG.random((2, shape[0] + 3, shape[1] + 3), np.float32)
    flow = RNG.normal(0, 3, (*shape, 2)).astype(np.float32)
    fast, slow = np.empty((2, *shape), np.float32), np.empty((2, *shape), np.float32)
    sample_spline(coefficients, flow, fast)
    sample_spline.py_func(coefficients, flow, slow)
    assert fast == pytest.approx(slow, abs=1e-6)


def test_a_spline_is_that_of_scipy():
    from scipy.ndimage import map_coordinates

    sampled = sample(spline_coefficients(STACK), FLOWS)
    y, x = np.mgrid[:20, :27]
    for image, (dx, dy), found in zip(STACK, FLOWS, sampled, strict=True):
        place = np.clip(y + dy, 0, 19), np.clip(x + dx, 0, 26)
        assert np.abs(map_coordinates(image, place, order=3, mode="mirror") - found).max() < 1e-5


def test_median_is_that_of_the_window():
    padded = np.pad(STACK, ((0, 0), (2, 2), (2, 2)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(1, 2))
    assert (median(STACK, 5) == np.median(windows, axis=(-1, -2))).all()


def test_torch_samples_wide_images_as_exactly_as_narrow_ones():
    pytest.importorskip("torch", reason="torch is not installed")
    wide, t = RNG.random((1, 16, 4000)).astype(np.float32), np.float32(0.375)
    sampled = store(sample(load(wide, "cpu:0"), load(np.full((1, 2, 16, 4000), t), "cpu:0")))
    weights = np.array([(1 - t) ** 3, 4 - 6 * t**2 + 3 * t**3, 1 + 3 * t + 3 * t**2 - 3 * t**3, t**3]) / 6
    windows = np.lib.stride_tricks.sliding_window_view(wide[0], (4, 4))
    assert np.abs(np.einsum("yxij,i,j->yx", windows, weights, weights) - sampled[0, 1:-2, 1:-2]).max() < 1e-6


def test_torch_filters_with_kernels_longer_than_the_image():
    pytest.importorskip("torch", reason="torch is not installed")
    kernel = RNG.random(61).astype(np.float32)
    a, b = correlate(STACK, kernel, ONE), store(correlate(load(STACK, "cpu:0"), kernel, ONE))
    assert np.abs(a - b).max() < 1e-5 * np.abs(a).max()


def test_the_settings_of_cudnn_are_restored_by_the_last_one_out():
    cudnn = pytest.importorskip("torch.backends.cudnn", reason="torch is not installed")
    before = cudnn.enabled, cudnn.benchmark, cudnn.deterministic, cudnn.allow_tf32
    with full_precision():
        with full_precision():
            assert (cudnn.enabled, cudnn.deterministic, cudnn.allow_tf32) == (before[0], True, False)
        assert not cudnn.allow_tf32
    assert (cudnn.enabled, cudnn.benchmark, cudnn.deterministic, cudnn.allow_tf32) == before
