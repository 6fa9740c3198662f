"""Short exposures: the table agrees with theory."""

import numpy as np

from turbrestore.blur.witnesses.short_exposure import displacement_variance, short_exposures
from turbrestore.synthesis.atmosphere import PhaseScreenParams


def test_weak_air_has_the_mean_of_fried():
    u = np.linspace(0.0, 0.9, 19)
    diffraction = 2 / np.pi * (np.arccos(u) - u * np.sqrt(1 - u * u))
    for strength in (0.5, 1.0, 1.5):
        mean, _, _ = short_exposures(np.array([strength]), np.array([1.0]), u)
        fried = diffraction * np.exp(-3.44 * (strength * u) ** (5 / 3) * (1 - u ** (1 / 3)))
        # Fried's exponent is an approximation that overestimates what the tilt takes away.
        assert np.abs(mean[0, 0] - fried).max() < 0.06, strength


def test_frequencies_scale_with_the_diffraction():
    nu = np.linspace(0, 0.4, 9)
    wide, narrow = (short_exposures(np.array([2.0]), np.array([size]), at) for size, at in ((2.0, nu / 2), (1.0, nu)))
    for one, other in zip(wide, narrow, strict=True):
        np.testing.assert_allclose(one, other)


def test_variation_grows_with_the_strength_and_powers_vary_more():
    strengths, at = np.array([0.5, 1.0, 1.5, 2.0, 3.0]), np.array([0.2])
    mean, amplitude, power = (values[:, 0, 0] for values in short_exposures(strengths, np.array([1.0]), at))
    assert (np.diff(mean) < 0).all() and (np.diff(amplitude) > 0).all() and (np.diff(power) > 0).all()
    assert (power > amplitude).all()


def test_the_displacement_is_that_of_the_synthesizer_within_its_outer_scale():
    for strength in (1.0, 3.0):
        params = PhaseScreenParams(d_over_r0=strength, nyquist=1.0)
        expected = displacement_variance(np.array(strength), np.array(2.0))
        assert 0.5 < params.tilt_rms() ** 2 / expected < 1.5
