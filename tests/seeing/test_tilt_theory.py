"""Differential tilt against the phase screens of the synthesizer, and the formulas against each other."""

import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError
from turbrestore.seeing.tilt_theory import Optics, displacement_differences, strength_of_tilt
from turbrestore.synthesis.atmosphere import Layer, PhaseScreenParams, tilt_variance
from turbrestore.synthesis.phase_screen import draw_turbulence, tilt_flow

OPTICS = Optics(2.75e-6, aperture=0.1, wavelength=550e-9, distance=2000.0)


def test_differences_are_those_of_phase_screens():
    params = PhaseScreenParams(cn2=1e-14, layers=5, inner_scale=0.0)
    axis = np.arange(64) - 31.5
    found = []
    for seed in range(4):
        turbulence = draw_turbulence(params, (64, 64), np.random.default_rng(seed))
        for time in np.arange(0.0, 200.0, 7.3):
            flow = tilt_flow(turbulence, axis, axis, turbulence.drift(time))
            blocks = flow.reshape(4, 16, 4, 16, 2).mean(axis=(1, 3))
            found.append([np.mean((blocks[:, k:] - blocks[:, : 4 - k]) ** 2, axis=(0, 1)) for k in (1, 2, 3)])
    predicted = 1e-14 * displacement_differences(OPTICS, 16.0, (1, 4), 16.0)[0, 1:]
    mean = np.mean(found, axis=0)
    np.testing.assert_allclose(mean.sum(axis=1), predicted.sum(axis=1), rtol=0.15)
    np.testing.assert_allclose(mean, predicted, rtol=0.3)
    # Along the separation the difference is larger than across.
    assert (predicted[:, 0] > 1.5 * predicted[:, 1]).all()


def test_differences_are_symmetric_in_the_axes_and_larger_for_smaller_windows():
    differences = displacement_differences(OPTICS, 10.0, (3, 3), 10.0)
    np.testing.assert_allclose(differences[..., 0], differences[..., 1].T, rtol=1e-9, atol=1e6)
    assert (displacement_differences(OPTICS, 10.0, (1, 3), 2.0)[0, 1:] > differences[0, 1:]).all()


@pytest.mark.parametrize("scale", [20.0, 100.0, 1000.0])
def test_strength_of_tilt_inverts_the_variance(scale):
    layers = (Layer(0.0, 1.0, 0.1 / 3.0, (0.0, 0.0)),)
    variance = tilt_variance(layers, 0.1, 550e-9, scale * 0.1) / OPTICS.pixel_scale**2
    usual, least, largest = strength_of_tilt(variance, OPTICS)
    assert {20.0: largest, 100.0: usual, 1000.0: least}[scale] == pytest.approx(3.0, rel=1e-6)


def test_optics_and_a_missing_distance_are_refused():
    with pytest.raises(ConfigurationError, match="pixel_scale"):
        Optics(0.0, 0.1)
    with pytest.raises(ConfigurationError, match="path"):
        Optics(1e-6, 0.1, path="bent")
    with pytest.raises(ConfigurationError, match="distance"):
        displacement_differences(Optics(1e-6, 0.1), 10.0, (2, 2), 10.0)
