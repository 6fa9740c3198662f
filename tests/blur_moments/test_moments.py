"""Moments and their noise against closed forms; errata 1 to 4 of the blur-moments papers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from turbrestore.blur_moments.moments import (
    BlurModel,
    basis_change,
    basis_functions,
    image_moments,
    kernel_relation,
    moment_noise,
    predicted_moments,
)
from turbrestore.blur_moments.sensor import ExposureTiming, GaussianKernel, LineSensor, PixelGrid, expose
from turbrestore.blur_moments.state_estimation.lifting import FastSystem, lift
from turbrestore.core.errors import ConfigurationError, DataError

V = 0.1
PIXELS = PixelGrid(-1.0, 1.0, 400)
POINTS = PixelGrid(-1.0, 1.0, 100, integrating=False)
paths = st.lists(st.floats(-0.5, 0.5), min_size=1, max_size=12).map(np.array)


def path_moments(path, order):
    return np.array([np.mean(np.asarray(path) ** p) for p in range(order + 1)])


def white_noise(count, rng):
    """Frames of white noise of density V."""
    return np.sqrt(V / POINTS.width) * rng.standard_normal((count, POINTS.count))


class TestBinomialRelation:
    @given(paths, st.floats(0.02, 0.08), st.floats(-0.1, 0.1))
    @settings(max_examples=30, deadline=None)
    def test_holds_for_raw_moments(self, path, width, offset):
        kernel = GaussianKernel(width, offset)
        measured = image_moments(expose(path, kernel, PIXELS), PIXELS, 5)
        # Averages over pixels and values at their centres differ by powers of Δ² / 12 beyond the third order.
        expected = kernel_relation(kernel, PIXELS, 5) @ path_moments(path, 5)
        np.testing.assert_allclose(measured, expected, atol=2e-5)

    def test_erratum_1_the_centred_kernel_of_equation_4_loses_the_offset(self):
        path, offset = 0.6 + 0.02 * np.sin(np.linspace(0, 6, 50)), 0.15
        kernel = GaussianKernel(0.04, offset)
        measured = image_moments(expose(path, kernel, PIXELS), PIXELS, 2)
        raw = kernel_relation(kernel, PIXELS, 2) @ path_moments(path, 2)
        printed = kernel_relation(GaussianKernel(0.04), PIXELS, 2) @ path_moments(path, 2)
        np.testing.assert_allclose(measured, raw, atol=1e-5)
        assert measured[1] - printed[1] == pytest.approx(0.15, abs=1e-6)
        assert abs(measured[2] - printed[2]) > 0.1

    def test_moments_of_the_kernel_against_sums_over_a_fine_grid(self):
        kernel, fine = GaussianKernel(0.1, 0.2), PixelGrid(-2.0, 2.0, 200001, integrating=False)
        summed = expose([0.0], kernel, fine) @ fine.centres[:, None] ** np.arange(7) * fine.width
        np.testing.assert_allclose(kernel_relation(kernel, POINTS, 6)[:, 0], summed, atol=1e-7)

    def test_erratum_4_kernel_and_pixel_width_are_in_the_second_moment(self):
        wide = PixelGrid(-1.0, 1.0, 25)
        path = 0.3 * np.sin(np.linspace(0, 6, 400))
        measured = image_moments(expose(path, GaussianKernel(0.05), wide), wide, 2)[2]
        without, with_kernel = np.mean(path**2), np.mean(path**2) + 0.05**2
        assert measured - without == pytest.approx(0.05**2 + 0.08**2 / 12, rel=0.02)
        assert measured - with_kernel == pytest.approx(0.08**2 / 12, rel=0.1)
        corrected = kernel_relation(GaussianKernel(0.05), wide, 2) @ path_moments(path, 2)
        assert measured == pytest.approx(corrected[2], abs=0.02 * 0.08**2)

    def test_erratum_4_the_border_cuts_moments(self):
        image = expose([0.9], GaussianKernel(0.05), PIXELS)
        first = image_moments(image, PIXELS, 1)[1]
        assert first - 0.9 == pytest.approx(-0.023, abs=5e-4)
        # What the cut Gaussian leaves, in closed form.
        inside = norm.cdf(2.0)
        assert first == pytest.approx(0.9 * inside - 0.05 * norm.pdf(2.0), abs=1e-4)

    def test_integrating_pixels_widen_a_delta(self):
        moments = kernel_relation(GaussianKernel(0.0), PixelGrid(0, 1, 1), 4)[:, 0]
        np.testing.assert_allclose(moments, [1, 0, 1 / 12, 0, 1 / 80])


class TestNoise:
    def test_erratum_2_variances_of_the_moments(self):
        cov = moment_noise(PixelGrid(-1.0, 1.0, 20000), 2, V)
        expected = V * np.array([[2, 0, 2 / 3], [0, 2 / 3, 0], [2 / 3, 0, 2 / 5]])
        np.testing.assert_allclose(cov, expected, atol=1e-8)
        assert abs(cov[2, 2] - 3 * V) > 0.25

    def test_erratum_2_of_measured_moments(self):
        noise = white_noise(40000, np.random.default_rng(0))
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
        image = expose([0.3], GaussianKernel(0.05), POINTS)
        frames = image + white_noise(20000, rng)
        totals = frames.sum(1) * POINTS.width
        # Φ(−1 / √(2 V)) = 1.27 %, known here to 0.08 %.
        assert np.mean(totals <= 0) == pytest.approx(norm.cdf(-1 / np.sqrt(2 * V)), abs=0.003)
        known = image_moments(frames, POINTS, 1)[:, 1]
        ratio = known / totals
        assert known.std() == pytest.approx(np.sqrt(2 * V / 3), rel=0.03)
        assert ratio.std() > 5 * known.std()


class TestBasis:
    def test_legendre_functions_are_orthogonal_on_the_pixels_of_any_interval(self):
        pixels = PixelGrid(0.5, 3.5, 30000)
        functions = basis_functions(pixels, 4, "legendre")
        gram = functions.T @ functions * pixels.width
        np.testing.assert_allclose(gram - np.diag(np.diag(gram)), 0, atol=1e-6)

    def test_both_bases_hold_the_same_information(self):
        image = expose([0.2, 0.4], GaussianKernel(0.1), PIXELS)
        change = basis_change(PIXELS, 4, "legendre")
        np.testing.assert_allclose(
            image_moments(image, PIXELS, 4, "legendre"), change @ image_moments(image, PIXELS, 4)
        )

    def test_unknown_basis(self):
        with pytest.raises(ConfigurationError, match="monomial, legendre"):
            image_moments(np.ones(400), PIXELS, 2, "fourier")


class TestPredicted:
    def test_path_without_an_input_gives_the_moments_of_its_image(self):
        motion = lift(FastSystem([[0.9]], [0.0], [1.0]), ExposureTiming(1.0, 6.0, 1.0, 7.0), [[0.1]])
        model = BlurModel(motion, LineSensor(GaussianKernel(0.05), PIXELS, noise=0.1, total=0.2))
        path, _ = motion.path_and_jacobian(np.array([0.4]), np.zeros(7))
        image = expose(path, model.sensor.kernel, PIXELS, 0.2)
        for basis in ("monomial", "legendre"):
            h, _, R = predicted_moments(model, np.array([0.4]), np.zeros(7), (1, 3), basis)
            np.testing.assert_allclose(h, image_moments(image, PIXELS, 3, basis, total=0.2)[[1, 3]], atol=1e-5)
            noise = moment_noise(PIXELS, 3, 0.1, basis)[np.ix_([1, 3], [1, 3])]
            np.testing.assert_allclose(R, noise / 0.2**2)


@pytest.mark.parametrize(
    ("call", "error", "named"),
    [
        (lambda: image_moments(np.ones(399), PIXELS, 1), DataError, "image"),
        (lambda: image_moments(np.full(400, np.nan), PIXELS, 1), DataError, "image"),
        (lambda: image_moments(np.ones(400), PIXELS, -1), ConfigurationError, "order"),
        (lambda: image_moments(np.ones(400), PIXELS, 1, total=0.0), ConfigurationError, "total"),
        (lambda: kernel_relation(GaussianKernel(0.1), PIXELS, -1), ConfigurationError, "order"),
        (lambda: moment_noise(PIXELS, 1, -1.0), ConfigurationError, "density"),
    ],
)
def test_bad_input_is_named_in_one_line(call, error, named):
    with pytest.raises(error, match=f"^{named}: [^\n]*$"):
        call()
