"""Moments and their algebra, against closed forms; errata 1 to 4 of the blur-moments papers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from turbrestore.blur_moments.kernels import PixelGrid, delta_kernel, gaussian_kernel, sampled_kernel
from turbrestore.blur_moments.moment_algebra import (
    central_moments,
    compose_moments,
    kernel_moments,
    path_moments,
    plane_kernel_moments,
    remove_kernel,
)
from turbrestore.blur_moments.moments import (
    basis_change,
    basis_functions,
    image_moments,
    moment_noise,
    plane_moments,
    total_intensity,
)
from turbrestore.blur_moments.sensor import add_noise, expose, expose_plane
from turbrestore.core.errors import ConfigurationError, DataError

V = 0.1
PIXELS = PixelGrid(-1.0, 1.0, 400)
POINTS = PixelGrid(-1.0, 1.0, 100, integrating=False)
COLUMNS, ROWS = PixelGrid(-1.0, 1.0, 80), PixelGrid(-0.9, 0.9, 60)
paths = st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=12).map(np.array)


def discrete_kernel_moments(kernel, order):
    """Moments of the density by summing over a fine grid."""
    fine = PixelGrid(-2.0, 2.0, 200001, integrating=False)
    density = expose([0.0], kernel, fine)
    return density @ fine.centres[:, None] ** np.arange(order + 1) * fine.width


class TestBinomialRelation:
    @given(paths, st.floats(0.02, 0.08), st.floats(-0.1, 0.1))
    @settings(max_examples=30, deadline=None)
    def test_holds_for_raw_moments(self, path, width, offset):
        kernel = gaussian_kernel(width, offset)
        measured = image_moments(expose(path, kernel, PIXELS), PIXELS, 5)
        # Averages over pixels and values at their centres differ by powers of Δ² / 12 beyond the third order.
        expected = compose_moments(path_moments(path, 5), kernel_moments(kernel, 5, PIXELS))
        np.testing.assert_allclose(measured, expected, atol=2e-5)

    def test_erratum_1_the_centred_kernel_of_equation_4_loses_the_offset(self):
        path, offset = 0.6 + 0.02 * np.sin(np.linspace(0, 6, 50)), 0.15
        kernel = gaussian_kernel(0.04, offset)
        measured = image_moments(expose(path, kernel, PIXELS), PIXELS, 2)
        raw = compose_moments(path_moments(path, 2), kernel_moments(kernel, 2, PIXELS))
        printed = compose_moments(path_moments(path, 2), kernel_moments(gaussian_kernel(0.04), 2, PIXELS))
        np.testing.assert_allclose(measured, raw, atol=1e-5)
        assert measured[1] - printed[1] == pytest.approx(0.15, abs=1e-6)
        assert abs(measured[2] - printed[2]) > 0.1

    @given(paths)
    @settings(max_examples=30, deadline=None)
    def test_kernel_is_removed_again(self, path):
        kernel = kernel_moments(gaussian_kernel(0.3, 0.2), 6)
        of_image = compose_moments(path_moments(path, 6), kernel)
        np.testing.assert_allclose(remove_kernel(of_image, kernel), path_moments(path, 6), atol=1e-9)

    def test_kernel_is_removed_in_the_plane(self):
        path = np.random.default_rng(0).uniform(-0.5, 0.5, (3, 7, 2))
        kernel = plane_kernel_moments(gaussian_kernel([[0.02, 0.01], [0.01, 0.03]], [0.1, -0.2]), 2)
        of_path = path_moments(path, 2, dimensions=2)
        of_image = compose_moments(of_path, kernel, dimensions=2)
        np.testing.assert_allclose(remove_kernel(of_image, kernel, dimensions=2), of_path, atol=1e-12)

    @pytest.mark.parametrize(
        "kernel",
        [
            gaussian_kernel([0.05, 0.07], [0.02, -0.04]),
            gaussian_kernel([[0.004, 0.002], [0.002, 0.005]], [0.05, 0.03]),
            sampled_kernel([[1, 2, 1], [0, 3, 1]], [COLUMNS.width, ROWS.width], [-0.05, -0.02]),
        ],
    )
    def test_covariances_add_in_the_plane(self, kernel):
        t = np.linspace(0, 1, 200)
        path = np.stack([0.4 * np.sin(3 * t), 0.3 * t**2 - 0.1], -1)
        image = expose_plane(path, kernel, COLUMNS, ROWS)
        measured = central_moments(plane_moments(image, COLUMNS, ROWS, 2), dimensions=2)
        of_kernel = central_moments(plane_kernel_moments(kernel, 2, COLUMNS, ROWS), dimensions=2)
        of_path = np.cov(path.T, bias=True)
        for p, q, i, j in ((2, 0, 0, 0), (0, 2, 1, 1), (1, 1, 0, 1)):
            assert measured[p, q] == pytest.approx(of_kernel[p, q] + of_path[i, j], abs=2e-5)

    def test_all_moments_of_the_plane(self):
        kernel = gaussian_kernel([[0.004, 0.002], [0.002, 0.005]], [0.05, 0.03])
        path = np.random.default_rng(1).uniform(-0.4, 0.4, (20, 2))
        measured = plane_moments(expose_plane(path, kernel, COLUMNS, ROWS), COLUMNS, ROWS, 2)
        of_kernel = plane_kernel_moments(kernel, 2, COLUMNS, ROWS)
        np.testing.assert_allclose(measured, compose_moments(path_moments(path, 2, 2), of_kernel, 2), atol=1e-4)


class TestKernelMoments:
    @pytest.mark.parametrize("kernel", [gaussian_kernel(0.1, 0.2), sampled_kernel([1, 0, 2, 1], 0.1, -0.1)])
    def test_against_sums_over_a_fine_grid(self, kernel):
        np.testing.assert_allclose(kernel_moments(kernel, 6), discrete_kernel_moments(kernel, 6), atol=1e-7)

    def test_erratum_4_kernel_and_pixel_width_are_in_the_second_moment(self):
        wide = PixelGrid(-1.0, 1.0, 25)
        path = 0.3 * np.sin(np.linspace(0, 6, 400))
        measured = image_moments(expose(path, gaussian_kernel(0.05), wide), wide, 2)[2]
        without, with_kernel = np.mean(path**2), np.mean(path**2) + 0.05**2
        assert measured - without == pytest.approx(0.05**2 + 0.08**2 / 12, rel=0.02)
        assert measured - with_kernel == pytest.approx(0.08**2 / 12, rel=0.1)
        corrected = compose_moments(path_moments(path, 2), kernel_moments(gaussian_kernel(0.05), 2, wide))
        assert measured == pytest.approx(corrected[2], abs=0.02 * 0.08**2)

    def test_erratum_4_the_border_cuts_moments(self):
        image = expose([0.9], gaussian_kernel(0.05), PIXELS)
        first = image_moments(image, PIXELS, 1)[1]
        assert first - 0.9 == pytest.approx(-0.023, abs=5e-4)
        # What the cut Gaussian leaves, in closed form.
        inside = norm.cdf(2.0)
        assert first == pytest.approx(0.9 * inside - 0.05 * norm.pdf(2.0), abs=1e-4)

    def test_integrating_pixels_widen_a_delta(self):
        np.testing.assert_allclose(kernel_moments(delta_kernel(), 4, PixelGrid(0, 1, 1)), [1, 0, 1 / 12, 0, 1 / 80])

    def test_tilted_gaussian_against_quadrature(self):
        mean, cov = np.array([0.7, -0.4]), np.array([[0.5, 0.3], [0.3, 0.4]])
        z, weight = np.polynomial.hermite_e.hermegauss(8)
        grid = np.stack(np.meshgrid(z, z), -1).reshape(-1, 2) @ np.linalg.cholesky(cov).T + mean
        weights = np.outer(weight, weight).ravel() / (2 * np.pi)
        found = plane_kernel_moments(gaussian_kernel(cov, mean), 2)
        for p in range(3):
            for q in range(3):
                assert found[p, q] == pytest.approx(weights @ (grid[:, 0] ** p * grid[:, 1] ** q))

    def test_tilted_gaussians_have_two_orders(self):
        with pytest.raises(ConfigurationError, match="at most 2"):
            plane_kernel_moments(gaussian_kernel([[1.0, 0.5], [0.5, 1.0]]), 3)


class TestNoise:
    def test_erratum_2_variances_of_the_moments(self):
        cov = moment_noise(PixelGrid(-1.0, 1.0, 20000), 2, V)
        expected = V * np.array([[2, 0, 2 / 3], [0, 2 / 3, 0], [2 / 3, 0, 2 / 5]])
        np.testing.assert_allclose(cov, expected, atol=1e-8)
        assert abs(cov[2, 2] - 3 * V) > 0.25

    def test_erratum_2_of_measured_moments(self):
        noise = add_noise(np.zeros((40000, 100)), POINTS.width, np.random.default_rng(0), V)
        sampled = np.cov(image_moments(noise, POINTS, 2).T)
        # The largest entry, 2 V, is known to 1.4 %.
        np.testing.assert_allclose(sampled, moment_noise(POINTS, 2, V), atol=0.005)
        assert sampled[2, 2] < 0.2 * 3 * V

    def test_erratum_2_the_legendre_moment_has_less_noise(self):
        pixels = PixelGrid(-1.0, 1.0, 20000)
        cov = moment_noise(pixels, 3, V, "legendre")
        np.testing.assert_allclose(np.diag(cov)[:3], [2 * V, 2 * V / 3, 8 * V / 45], atol=1e-8)
        np.testing.assert_allclose(cov - np.diag(np.diag(cov)), 0, atol=1e-8)

    def test_erratum_3_dividing_by_the_measured_total_is_harmful(self):
        rng = np.random.default_rng(1)
        image = expose([0.3], gaussian_kernel(0.05), POINTS)
        frames = add_noise(np.tile(image, (20000, 1)), POINTS.width, rng, V)
        totals = frames.sum(1) * POINTS.width
        # Φ(−1 / √(2 V)) = 1.27 %, known here to 0.08 %.
        assert np.mean(totals <= 0) == pytest.approx(norm.cdf(-1 / np.sqrt(2 * V)), abs=0.003)
        known = image_moments(frames, POINTS, 1)[:, 1]
        ratio = known / totals
        assert known.std() == pytest.approx(np.sqrt(2 * V / 3), rel=0.03)
        assert ratio.std() > 5 * known.std()
        with pytest.raises(DataError, match="frames without light"):
            image_moments(frames, POINTS, 1, total=None)

    def test_shot_noise(self):
        rng = np.random.default_rng(2)
        image = expose([0.3, -0.2], gaussian_kernel(0.1), POINTS)
        frames = add_noise(np.tile(image, (40000, 1)), POINTS.width, rng, 0.0, photons=500.0)
        sampled = np.cov(image_moments(frames, POINTS, 2).T)
        np.testing.assert_allclose(sampled, moment_noise(POINTS, 2, 0.0, image=image, photons=500.0), atol=6e-5)

    def test_shot_noise_needs_the_image(self):
        with pytest.raises(ConfigurationError, match="photons"):
            moment_noise(POINTS, 2, 0.0, photons=500.0)


class TestBasis:
    def test_legendre_functions_are_orthogonal_on_the_pixels_of_any_interval(self):
        pixels = PixelGrid(0.5, 3.5, 30000)
        functions = basis_functions(pixels, 4, "legendre")
        gram = functions.T @ functions * pixels.width
        np.testing.assert_allclose(gram - np.diag(np.diag(gram)), 0, atol=1e-6)

    def test_both_bases_hold_the_same_information(self):
        image = expose([0.2, 0.4], gaussian_kernel(0.1), PIXELS)
        change = basis_change(PIXELS, 4, "legendre")
        np.testing.assert_allclose(
            image_moments(image, PIXELS, 4, "legendre"), change @ image_moments(image, PIXELS, 4)
        )

    def test_second_legendre_moment_is_the_second_minus_a_third_of_order_0(self):
        np.testing.assert_allclose(basis_change(PIXELS, 2, "legendre")[2], [-1 / 3, 0, 1], atol=1e-12)

    def test_unknown_basis(self):
        with pytest.raises(ConfigurationError, match="monomial, legendre"):
            image_moments(np.ones(400), PIXELS, 2, "fourier")


class TestIntensity:
    def test_background_and_measured_total(self):
        image = 7.0 * expose([0.25], gaussian_kernel(0.05), PIXELS) + 0.3
        moments = image_moments(image, PIXELS, 2, total=None, background=0.3)
        np.testing.assert_allclose(moments, [1.0, 0.25, 0.0625 + 0.0025], atol=1e-5)

    def test_known_total(self):
        image = 0.2 * expose([0.25], gaussian_kernel(0.05), PIXELS)
        np.testing.assert_allclose(image_moments(image, PIXELS, 1, total=0.2), [1.0, 0.25], atol=1e-6)

    def test_robust_total_of_several_frames(self):
        rng = np.random.default_rng(4)
        frames = add_noise(np.tile(expose([0.0], gaussian_kernel(0.1), POINTS), (400, 1)), POINTS.width, rng, V)
        frames[:20] += 5.0
        total, error = total_intensity(frames, POINTS.width)
        assert error == pytest.approx(np.sqrt(np.pi / 2 * 2 * V / 400), rel=0.2)
        assert abs(total - 1.0) < 4 * error
        assert np.isnan(total_intensity(frames[:1], POINTS.width)[1])

    def test_frames_without_light(self):
        for call in (
            lambda: image_moments(np.zeros(400), PIXELS, 1, total=None),
            lambda: plane_moments(np.zeros((60, 80)), COLUMNS, ROWS, 1, total=None),
            lambda: central_moments([0.0, 1.0, 1.0]),
            lambda: total_intensity(np.zeros((3, 400)), 0.1),
        ):
            with pytest.raises(
                DataError, match="^frame: expected a total intensity above 0, found [^\n]* without light"
            ):
                call()

    @pytest.mark.parametrize(
        ("call", "error", "named"),
        [
            (lambda: image_moments(np.ones(399), PIXELS, 1), DataError, "image"),
            (lambda: image_moments(np.full(400, np.nan), PIXELS, 1), DataError, "image"),
            (lambda: plane_moments(np.ones((80, 60)), COLUMNS, ROWS, 1), DataError, "image"),
            (lambda: image_moments(np.ones(400), PIXELS, -1), ConfigurationError, "order"),
            (lambda: image_moments(np.ones(400), PIXELS, 1, total=0.0), ConfigurationError, "total"),
            (lambda: path_moments([], 2), DataError, "path"),
            (lambda: compose_moments([1.0, 0.0], [1.0]), DataError, "moments"),
            (lambda: total_intensity(np.ones(4), 0.1), DataError, "frames"),
            (lambda: moment_noise(PIXELS, 1, -1.0), ConfigurationError, "density"),
        ],
    )
    def test_bad_input_is_named_in_one_line(self, call, error, named):
        with pytest.raises(error, match=f"^{named}: [^\n]*$"):
            call()


class TestCentral:
    @given(paths)
    @settings(max_examples=30, deadline=None)
    def test_of_a_path(self, path):
        central = central_moments(path_moments(path, 4))
        np.testing.assert_allclose(central, [np.mean((path - path.mean()) ** p) for p in range(5)], atol=1e-9)

    def test_divides_by_order_0(self):
        np.testing.assert_allclose(central_moments(3.0 * path_moments([0.0, 2.0], 2)), [1.0, 0.0, 1.0])
