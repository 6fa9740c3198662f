"""Noise of photons is told from noise that is the same at every level, and dark parts then count more."""

import cv2
import numpy as np
import pytest
from scipy.optimize import nnls

from turbrestore.core.noise import nonnegative_least_squares, photon_noise
from turbrestore.deconvolution.problem import margin_around
from turbrestore.synthesis.scenes import resolution_chart

WHITE = 500.0


@pytest.fixture(scope="module")
def scene():
    ramp = np.linspace(0.05, 0.9, 200, dtype=np.float32)[None] * np.ones((200, 1), np.float32)
    return cv2.GaussianBlur(np.where(resolution_chart(200, 200) > 0.5, ramp, 0.7 * ramp), (0, 0), 1.0)


def halves(scene, seed=0):
    rng = np.random.default_rng(seed)
    return [np.float32(rng.poisson(WHITE * scene) / WHITE) for _ in range(2)]


def test_noise_of_photons_grows_with_the_level(scene):
    curve = photon_noise(*halves(scene))
    assert curve is not None
    smooth = cv2.GaussianBlur(scene, (0, 0), 1.0)
    found = curve.variance(smooth)
    assert found.mean() == pytest.approx(1, rel=0.1)
    np.testing.assert_allclose(found, smooth / smooth.mean(), atol=0.2)


def test_other_noise_is_not_that_of_photons(scene):
    rng = np.random.default_rng(1)
    white = [np.float32(scene + rng.normal(0, 0.02, scene.shape)) for _ in range(2)]
    moved = [np.roll(scene, shift, axis=1) for shift in (0, 1)]
    for pair in (white, moved, [scene, scene]):
        assert photon_noise(*pair) is None


def test_weights_are_the_inverse_of_the_noise_and_limited(scene):
    curve = photon_noise(*halves(scene))
    margin = margin_around(scene.shape, 4)
    weights = margin.weights(scene, curve)
    assert (weights[margin.mask() == 0] == 0).all()
    inside = weights[margin.inside()]
    assert 0.25 <= inside.min() < 0.7 and 1.5 < inside.max() <= 4
    assert inside[:, :20].mean() > 2 * inside[:, -20:].mean()
    assert (margin.weights(scene, None) == margin.mask()).all()


def test_least_squares_without_negative_unknowns_are_those_of_scipy():
    rng = np.random.default_rng(2)
    for rows, columns in ((2, 1), (3, 5), (8, 8), (24, 13)):
        for values in rng.standard_normal((20, rows)):
            design = rng.standard_normal((rows, columns))
            unknowns, misfit = nonnegative_least_squares(design, values)
            assert (unknowns >= 0).all()
            assert misfit == pytest.approx(nnls(design, values)[1], abs=1e-9)
            assert misfit == pytest.approx(np.linalg.norm(design @ unknowns - values))
