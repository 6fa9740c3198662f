"""Timing, kernel, exposure operator and its table, against brute force and closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import norm

from turbrestore.blur_moments.sensor import ExposureTiming, GaussianKernel, LineSensor, PixelGrid, expose, tabulate
from turbrestore.core.errors import ConfigurationError, DataError

POINT = GaussianKernel(0.0)
PIXELS = PixelGrid(-1.0, 1.0, 50)
POINTS = PixelGrid(-1.0, 1.0, 50, integrating=False)
paths = st.lists(st.floats(-0.6, 0.6), min_size=1, max_size=8).map(np.array)
widths = st.floats(0.03, 0.06)


class TestTiming:
    def test_steps_are_those_of_both_papers(self):
        first, second = ExposureTiming(1e-3, 0.2, 0.0, 0.2), ExposureTiming(1e-3, 0.1, 0.35, 0.45, trigger=0.09)
        assert first.frame_steps == first.exposure_steps == 200
        assert (second.frame_steps, second.exposure_steps) == (450, 100)

    @pytest.mark.parametrize(
        ("times", "named"),
        [
            ((1e-3, 0.1, 0.35, 0.449), "frame_period"),
            ((1e-3, 0.1, 0.35, 0.4505), "frame_period"),
            ((1e-3, 0.1005, 0.3, 0.45), "exposure"),
            ((1e-3, 0.1, 0.35, 0.45, 0.0905), "trigger"),
            ((0.0, 0.1, 0.35, 0.45), "fast_period"),
            ((1e-3, 0.0, 0.35, 0.45), "exposure"),
            ((1e-3, 1e-13, 0.35, 0.45), "exposure"),
            ((1e-3, 0.1, -0.1, 0.45), "readout"),
            ((1e-3, float("nan"), 0.1, 0.45), "exposure"),
            ((1e-3, 0.1, 0.1, float("inf")), "frame_period"),
        ],
    )
    def test_what_does_not_fit_is_named(self, times, named):
        with pytest.raises(ConfigurationError, match=f"^{named}: expected .* found [^\n]*$"):
            ExposureTiming(*times)


class TestKernel:
    @pytest.mark.parametrize("pixels", [PIXELS, POINTS])
    def test_slope_is_the_derivative(self, pixels):
        kernel, distance, step = GaussianKernel(0.07, 0.02), np.linspace(-0.21, 0.19, 41), 1e-6
        ahead, behind = (kernel.response(distance + s, pixels) for s in (step, -step))
        np.testing.assert_allclose(kernel.slope(distance, pixels), (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-5)

    def test_pixels_average_the_density(self):
        kernel, pixels = GaussianKernel(0.02), PixelGrid(-0.2, 0.2, 5)
        seen = expose([0.03], kernel, pixels)
        for centre, value in zip(pixels.centres, seen, strict=True):
            mean = quad(norm(0.03, 0.02).pdf, centre - 0.04, centre + 0.04, points=[0.03])[0] / 0.08
            assert value == pytest.approx(mean, abs=1e-9)

    @pytest.mark.parametrize(
        "make",
        [
            lambda: GaussianKernel(-0.1),
            lambda: GaussianKernel(float("nan")),
            lambda: GaussianKernel(0.1, np.inf),
            lambda: tabulate(LineSensor(GaussianKernel(1e-9), PIXELS, noise=0.1)),
            lambda: tabulate(LineSensor(POINT, PIXELS, noise=0.1)),
            lambda: PixelGrid(1.0, -1.0, 5),
            lambda: PixelGrid(-1.0, 1.0, 0),
            lambda: LineSensor(GaussianKernel(0.1), PIXELS, noise=0.0),
            lambda: LineSensor(GaussianKernel(0.1), PIXELS, noise=0.1, total=0.0),
            lambda: POINT.slope(np.zeros(1), PIXELS),
        ],
    )
    def test_invalid_settings_are_refused_in_one_line(self, make):
        with pytest.raises(ConfigurationError, match="^[a-z]+: expected [^\n]*$"):
            make()


class TestExpose:
    @given(paths, widths)
    @settings(max_examples=40, deadline=None)
    def test_light_is_conserved(self, path, width):
        for kernel in (GaussianKernel(width), GaussianKernel(0.0, 0.01)):
            assert expose(path, kernel, PIXELS, total=0.2).sum() * PIXELS.width == pytest.approx(0.2, abs=1e-9)

    @given(paths, paths)
    @settings(max_examples=25, deadline=None)
    def test_exposures_add_up(self, first, second):
        kernel = GaussianKernel(0.05)
        both = expose(np.concatenate([first, second]), kernel, PIXELS, len(first) + len(second))
        apart = expose(first, kernel, PIXELS, len(first)) + expose(second, kernel, PIXELS, len(second))
        np.testing.assert_allclose(both, apart, atol=1e-9)

    def test_delta_makes_a_histogram(self):
        path = np.random.default_rng(0).uniform(-1, 1, 500)
        counts = np.histogram(path, 50, (-1, 1))[0]
        np.testing.assert_allclose(expose(path, POINT, PIXELS) * PIXELS.width * 500, counts, atol=1e-9)

    def test_point_on_the_border_of_two_pixels_is_counted_once(self):
        edges = PIXELS.start + PIXELS.width * np.arange(1, 50)
        for edge in edges:
            assert expose([edge], POINT, PIXELS).sum() * PIXELS.width == pytest.approx(1.0)

    @pytest.mark.parametrize("path", [np.zeros(0), np.array([np.nan]), np.array(0.0)])
    def test_empty_or_broken_exposures_are_refused(self, path):
        with pytest.raises(DataError, match="^path: expected [^\n]*$"):
            expose(path, GaussianKernel(0.1), PIXELS)

    def test_delta_needs_pixels_that_integrate(self):
        with pytest.raises(ConfigurationError, match="delta"):
            expose([0.0], POINT, POINTS)


class TestTable:
    def test_equals_the_operator_up_to_its_step(self):
        kernel, path = GaussianKernel(0.05, 0.01), np.random.default_rng(0).uniform(-1.3, 1.3, (3, 40))
        table = tabulate(LineSensor(kernel, PIXELS, noise=0.1, total=0.7))
        image, _ = table.image_and_jacobian(path, np.ones((3, 40, 1)))
        peak = 0.7 * kernel.response(np.linspace(-0.1, 0.1, 99), PIXELS).max()
        assert np.abs(image - expose(path, kernel, PIXELS, 0.7)).max() < 0.0035 * peak

    def test_jacobian_is_the_derivative(self):
        kernel, rng = GaussianKernel(0.1), np.random.default_rng(5)
        path, slopes = rng.uniform(-0.8, 0.8, (2, 30)), rng.normal(size=(2, 30, 3))
        _, derivative = tabulate(LineSensor(kernel, PIXELS, noise=0.1)).image_and_jacobian(path, slopes)
        for k in range(3):
            step = 1e-5 * slopes[..., k]
            change = (expose(path + step, kernel, PIXELS) - expose(path - step, kernel, PIXELS)) / 2e-5
            np.testing.assert_allclose(derivative[:, k], change, atol=0.02 * np.abs(change).max())

    def test_far_away_leaves_no_light(self):
        table = tabulate(LineSensor(GaussianKernel(0.05), PIXELS, noise=0.1))
        assert not table.image_and_jacobian(np.array([-50.0, 1e9, -1e300]), np.ones((3, 1)))[0].any()
