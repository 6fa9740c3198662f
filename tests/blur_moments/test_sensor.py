"""Timing, kernels, exposure operator and noise of the integrative sensor, against brute force and closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm

from turbrestore.blur_moments.exposure_table import tabulate
from turbrestore.blur_moments.kernels import (
    PixelGrid,
    delta_kernel,
    gaussian_kernel,
    kernel_from_still,
    line_response,
    line_slope,
    marginal_kernel,
    sampled_kernel,
)
from turbrestore.blur_moments.sensor import (
    ExposureTiming,
    LineSensor,
    add_noise,
    expose,
    expose_plane,
    noise_variance,
)
from turbrestore.core.errors import ConfigurationError, DataError

PIXELS = PixelGrid(-1.0, 1.0, 50)
POINTS = PixelGrid(-1.0, 1.0, 50, integrating=False)
COLUMNS, ROWS = PixelGrid(-1.0, 1.0, 24), PixelGrid(-0.8, 0.8, 16)
paths = st.lists(st.floats(-0.6, 0.6), min_size=1, max_size=8).map(np.array)
widths = st.floats(0.03, 0.06)


class TestTiming:
    def test_steps_of_paper_2(self):
        timing = ExposureTiming(1e-3, 0.1, 0.35, 0.45, trigger=0.09)
        assert (timing.frame_steps, timing.exposure_steps, timing.trigger_steps) == (450, 100, 90)

    def test_exposed_all_the_time_as_in_paper_1(self):
        timing = ExposureTiming(1e-3, 0.2, 0.0, 0.2)
        assert timing.frame_steps == timing.exposure_steps == 200

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


class TestKernels:
    @pytest.mark.parametrize("kernel", [gaussian_kernel(0.07, 0.02), sampled_kernel([1, 3, 2], 0.05, -0.04)])
    @pytest.mark.parametrize("pixels", [PIXELS, POINTS])
    def test_slope_is_the_derivative(self, kernel, pixels):
        # Away from the nodes of the samples, where the derivative jumps.
        distance = np.linspace(-0.21, 0.19, 41) + 0.0013
        step = 1e-6
        ahead, behind = (line_response(kernel, distance + s, pixels) for s in (step, -step))
        slope = line_slope(kernel, distance, pixels)
        if kernel.samples is None:
            np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-5)
        else:
            assert np.abs(slope.sum() - (ahead - behind).sum() / (2 * step)) < 0.05 * np.abs(slope).sum()

    def test_pixels_average_the_density(self):
        kernel, pixels = gaussian_kernel(0.02), PixelGrid(-0.2, 0.2, 5)
        seen = expose([0.03], kernel, pixels)
        for centre, value in zip(pixels.centres, seen, strict=True):
            mean = quad(norm(0.03, 0.02).pdf, centre - 0.04, centre + 0.04, points=[0.03])[0] / 0.08
            assert value == pytest.approx(mean, abs=1e-9)

    def test_still_exposure_gives_back_the_kernel(self):
        still = expose([0.1], gaussian_kernel(0.05), PIXELS)
        kernel = kernel_from_still(still, PIXELS, position=0.1)
        np.testing.assert_allclose(expose([0.1], kernel, PIXELS), still, atol=1e-12)
        # A shift by whole pixels moves the image by whole pixels.
        np.testing.assert_allclose(expose([0.1 + 3 * PIXELS.width], kernel, PIXELS)[10:40], still[7:37], atol=1e-9)

    def test_mean_of_several_exposures_is_less_noisy(self):
        rng = np.random.default_rng(3)
        still = expose([0.0], gaussian_kernel(0.08), PIXELS)
        frames = add_noise(np.tile(still, (400, 1)), PIXELS.width, rng, density=1e-3) + 0.5
        errors = [
            np.std(kernel_from_still(frames[:n], PIXELS, background=0.5).samples * still.sum() * PIXELS.width - still)
            for n in (1, 400)
        ]
        assert errors[1] < 0.1 * errors[0]

    def test_still_exposure_of_the_plane(self):
        still = expose_plane([[0.0, 0.0]], gaussian_kernel([[0.02, 0.008], [0.008, 0.01]]), COLUMNS, ROWS)
        kernel = kernel_from_still(still[None], COLUMNS, ROWS)
        np.testing.assert_allclose(
            expose_plane([[0.0, 0.0]], kernel, COLUMNS, ROWS), still / (still.sum() / 120), atol=1e-9
        )
        moved = expose_plane([[COLUMNS.width, -2 * ROWS.width]], kernel, COLUMNS, ROWS)
        np.testing.assert_allclose(moved[2:-4, 3:-3] * still.sum() / 120, still[4:-2, 2:-4], atol=1e-9)

    @pytest.mark.parametrize(
        ("make", "error"),
        [
            (lambda: gaussian_kernel(-0.1), ConfigurationError),
            (lambda: gaussian_kernel(float("nan")), ConfigurationError),
            (lambda: gaussian_kernel([[1.0, 2.0], [2.0, 1.0]]), ConfigurationError),
            (lambda: gaussian_kernel([[1.0, 0.5], [0.0, 1.0]]), ConfigurationError),
            (lambda: sampled_kernel([0.0, 0.0], 0.1, 0.0), DataError),
            (lambda: sampled_kernel([1.0, 2.0], 0.0, 0.0), ConfigurationError),
            (lambda: sampled_kernel([1.0, 2.0], [1.0, 2.0], 0.0), ConfigurationError),
            (lambda: sampled_kernel([1.0, 2.0], 1.0, np.nan), ConfigurationError),
            (lambda: gaussian_kernel(0.1, [0.0, 1.0]), ConfigurationError),
            (lambda: gaussian_kernel([0.1, 0.1], np.inf), ConfigurationError),
            (lambda: tabulate(LineSensor(gaussian_kernel(1e-9), PIXELS, noise=0.1)), ConfigurationError),
            (lambda: kernel_from_still(np.zeros(50), PIXELS), DataError),
            (lambda: kernel_from_still(np.ones(49), PIXELS), DataError),
            (lambda: PixelGrid(1.0, -1.0, 5), ConfigurationError),
            (lambda: PixelGrid(-1.0, 1.0, 0), ConfigurationError),
            (lambda: LineSensor(gaussian_kernel(0.1), PIXELS, noise=0.0), ConfigurationError),
            (lambda: line_slope(delta_kernel(), np.zeros(1), PIXELS), ConfigurationError),
            (lambda: tabulate(LineSensor(delta_kernel(), PIXELS, noise=0.1)), ConfigurationError),
            (
                lambda: expose([0.0], gaussian_kernel([0.1, 0.1]), PIXELS),
                ConfigurationError,
            ),
        ],
    )
    def test_what_is_no_kernel_is_refused_in_one_line(self, make, error):
        with pytest.raises(error) as caught:
            make()
        assert "\n" not in str(caught.value)


class TestExposeLine:
    @given(paths, widths)
    @settings(max_examples=40, deadline=None)
    def test_light_is_conserved(self, path, width):
        for kernel in (gaussian_kernel(width), delta_kernel(0.01), sampled_kernel([1, 4, 2, 0.5], PIXELS.width, -0.05)):
            assert expose(path, kernel, PIXELS, exposure=0.2).sum() * PIXELS.width == pytest.approx(0.2, abs=1e-9)

    @given(paths, paths)
    @settings(max_examples=25, deadline=None)
    def test_exposures_add_up(self, first, second):
        kernel = gaussian_kernel(0.05)
        both = expose(np.concatenate([first, second]), kernel, PIXELS, len(first) + len(second))
        apart = expose(first, kernel, PIXELS, len(first)) + expose(second, kernel, PIXELS, len(second))
        np.testing.assert_allclose(both, apart, atol=1e-9)

    def test_delta_makes_a_histogram(self):
        path = np.random.default_rng(0).uniform(-1, 1, 500)
        counts = np.histogram(path, 50, (-1, 1))[0]
        np.testing.assert_allclose(expose(path, delta_kernel(), PIXELS) * PIXELS.width * 500, counts, atol=1e-9)

    def test_point_on_the_border_of_two_pixels_is_counted_once(self):
        edges = PIXELS.start + PIXELS.width * np.arange(1, 50)
        for edge in edges:
            assert expose([edge], delta_kernel(), PIXELS).sum() * PIXELS.width == pytest.approx(1.0)

    def test_order_in_time_does_not_show(self):
        path = np.cumsum(np.random.default_rng(1).normal(0, 0.05, 30))
        kernel = gaussian_kernel(0.05)
        np.testing.assert_allclose(expose(path, kernel, PIXELS), expose(path[::-1], kernel, PIXELS), atol=1e-12)

    def test_batches(self):
        path = np.random.default_rng(2).uniform(-0.5, 0.5, (2, 3, 7))
        images = expose(path, gaussian_kernel(0.1), PIXELS)
        np.testing.assert_allclose(images[1, 2], expose(path[1, 2], gaussian_kernel(0.1), PIXELS))

    @pytest.mark.parametrize("path", [np.zeros(0), np.array([np.nan]), np.array(0.0)])
    def test_empty_or_broken_exposures_are_refused(self, path):
        with pytest.raises(DataError, match="^path: expected [^\n]*$"):
            expose(path, gaussian_kernel(0.1), PIXELS)

    def test_delta_needs_pixels_that_integrate(self):
        with pytest.raises(ConfigurationError, match="delta"):
            expose([0.0], delta_kernel(), POINTS)


class TestExposePlane:
    def test_separable_kernel_equals_two_runs_on_lines(self):
        x, y = np.random.default_rng(0).uniform(-0.4, 0.4, (2, 9))
        kernel = gaussian_kernel([0.07, 0.05], [0.02, -0.03])
        lines = [marginal_kernel(kernel, axis) for axis in (0, 1)]
        still = expose_plane([[x[0], y[0]]], kernel, COLUMNS, ROWS)
        expected = np.outer(expose(y[:1], lines[1], ROWS), expose(x[:1], lines[0], COLUMNS))
        np.testing.assert_allclose(still, expected, atol=1e-12)
        moving = expose_plane(np.stack([x, y], -1), kernel, COLUMNS, ROWS)
        np.testing.assert_allclose(moving.sum(0) * ROWS.width, expose(x, lines[0], COLUMNS), atol=1e-6)
        np.testing.assert_allclose(moving.sum(1) * COLUMNS.width, expose(y, lines[1], ROWS), atol=1e-6)

    @pytest.mark.parametrize(
        "kernel",
        [
            delta_kernel([0.0, 0.0]),
            gaussian_kernel([0.05, 0.06]),
            gaussian_kernel([[0.004, 0.002], [0.002, 0.003]]),
            sampled_kernel([[1, 2, 1], [0, 3, 1]], [COLUMNS.width, ROWS.width], [-0.1, -0.05]),
        ],
    )
    def test_light_is_conserved(self, kernel):
        path = np.random.default_rng(4).uniform(-0.3, 0.3, (2, 6, 2))
        total = expose_plane(path, kernel, COLUMNS, ROWS, exposure=3.0).sum((1, 2)) * COLUMNS.width * ROWS.width
        np.testing.assert_allclose(total, 3.0, atol=1e-5)

    def test_tilted_gaussian_against_many_points_in_each_pixel(self):
        cov = np.array([[0.006, 0.004], [0.004, 0.005]])
        image = expose_plane([[0.05, 0.1]], gaussian_kernel(cov), COLUMNS, ROWS)
        fine = 40
        x, y = PixelGrid(-1.0, 1.0, 24 * fine).centres, PixelGrid(-0.8, 0.8, 16 * fine).centres
        density = multivariate_normal([0.05, 0.1], cov).pdf(np.stack(np.meshgrid(x, y), -1))
        np.testing.assert_allclose(image, density.reshape(16, fine, 24, fine).mean((1, 3)), atol=2e-3 * image.max())

    def test_tilted_gaussian_on_sampling_pixels_is_its_density(self):
        columns, rows = PixelGrid(-1.0, 1.0, 24, False), PixelGrid(-0.8, 0.8, 16, False)
        cov = np.array([[0.06, -0.02], [-0.02, 0.05]])
        image = expose_plane([[0.1, 0.2]], gaussian_kernel(cov, [0.1, 0.0]), columns, rows)
        points = np.stack(np.meshgrid(columns.centres, rows.centres), -1)
        np.testing.assert_allclose(image, multivariate_normal([0.2, 0.2], cov).pdf(points), rtol=1e-9)

    def test_sampled_kernel_of_the_plane_is_linear_in_between(self):
        kernel = sampled_kernel(np.ones((1, 1)), [COLUMNS.width, ROWS.width], [0.0, 0.0])
        centre = np.array([COLUMNS.centres[10], ROWS.centres[5]])
        image = expose_plane([[centre[0] + 0.25 * COLUMNS.width, centre[1] + 0.5 * ROWS.width]], kernel, COLUMNS, ROWS)
        expected = np.array([[0.375, 0.125], [0.375, 0.125]]) / (COLUMNS.width * ROWS.width)
        np.testing.assert_allclose(image[5:7, 10:12], expected, atol=1e-9)

    def test_marginals_of_samples(self):
        values = np.array([[1.0, 2.0, 1.0], [0.0, 3.0, 1.0]])
        kernel = sampled_kernel(values, [0.1, 0.2], [0.0, 0.5])
        across = marginal_kernel(kernel, 0)
        np.testing.assert_allclose(across.samples * 0.1, [1 / 8, 5 / 8, 2 / 8])
        np.testing.assert_allclose(marginal_kernel(kernel, 1).offset, [0.5])

    @pytest.mark.parametrize("path", [np.zeros((0, 2)), np.zeros((3, 3)), np.full((1, 2), np.inf)])
    def test_empty_or_broken_exposures_are_refused(self, path):
        with pytest.raises(DataError, match="^path: expected [^\n]*$"):
            expose_plane(path, gaussian_kernel([0.1, 0.1]), COLUMNS, ROWS)

    def test_axes_must_agree(self):
        with pytest.raises(ConfigurationError, match="both axes"):
            expose_plane([[0.0, 0.0]], gaussian_kernel([0.1, 0.1]), COLUMNS, PixelGrid(-1, 1, 4, False))


class TestNoise:
    def test_white_noise_has_the_density_v(self):
        noise = add_noise(np.zeros((4000, 20)), 0.1, np.random.default_rng(0), density=0.05)
        # The variance of 80000 numbers is known to 0.5 %.
        assert noise.var() == pytest.approx(0.05 / 0.1, rel=0.02)
        assert abs(np.cov(noise[:, 0], noise[:, 1])[0, 1]) < 0.04

    def test_shot_noise_follows_the_light(self):
        image = np.tile([1.0, 4.0], (40000, 1))
        noisy = add_noise(image, 0.1, np.random.default_rng(1), density=0.0, photons=200.0)
        np.testing.assert_allclose(noisy.mean(0), [1.0, 4.0], rtol=0.01)
        np.testing.assert_allclose(noisy.var(0), noise_variance([1.0, 4.0], 0.1, 0.0, 200.0), rtol=0.04)

    @pytest.mark.parametrize(("density", "photons"), [(-0.1, None), (np.nan, None), (0.1, 0.0)])
    def test_no_noise_is_negative(self, density, photons):
        with pytest.raises(ConfigurationError):
            add_noise([1.0], 0.1, np.random.default_rng(0), density, photons)


class TestTable:
    @pytest.mark.parametrize("kernel", [gaussian_kernel(0.05, 0.01), sampled_kernel([1, 3, 2], PIXELS.width, -0.03)])
    def test_equals_the_operator_up_to_its_step(self, kernel):
        path = np.random.default_rng(0).uniform(-1.3, 1.3, (3, 40))
        exact = expose(path, kernel, PIXELS, 0.7)
        table = tabulate(LineSensor(kernel, PIXELS, noise=0.1, total=0.7))
        peak = 0.7 * line_response(kernel, np.linspace(-0.1, 0.1, 99), PIXELS).max()
        assert np.abs(table.image(path) - exact).max() < 0.0035 * peak

    def test_jacobian_is_the_derivative(self):
        kernel = gaussian_kernel(0.1)
        table = tabulate(LineSensor(kernel, PIXELS, noise=0.1))
        rng = np.random.default_rng(5)
        path, slopes = rng.uniform(-0.8, 0.8, (2, 30)), rng.normal(size=(2, 30, 3))
        image, derivative = table.image_and_jacobian(path, slopes)
        np.testing.assert_allclose(image, table.image(path), atol=1e-12)
        for k in range(3):
            step = 1e-5 * slopes[..., k]
            change = (expose(path + step, kernel, PIXELS) - expose(path - step, kernel, PIXELS)) / 2e-5
            np.testing.assert_allclose(derivative[:, k], change, atol=0.02 * np.abs(change).max())

    def test_far_away_leaves_no_light(self):
        table = tabulate(LineSensor(gaussian_kernel(0.05), PIXELS, noise=0.1))
        assert not table.image(np.array([-50.0, 1e9, -1e300])).any()
