"""Theory of the atmosphere against closed forms, limits and brute force."""

import numpy as np
import pytest
from atmosphere_theory import (
    diffraction_mtf,
    long_exposure_mtf,
    short_exposure_mtf,
    structure_function,
    tilt_covariance,
)
from scipy import special

from turbrestore.core.errors import ConfigurationError
from turbrestore.synthesis.atmosphere import Layer, PhaseScreenParams, fried_parameter, phase_spectrum, tilt_variance

WAVELENGTH, APERTURE = 550e-9, 0.1


def von_karman(r, r0, outer_scale):
    """Closed form without inner scale (Conan 2000)."""
    x = 2 * np.pi * r / outer_scale
    front = (outer_scale / r0) ** (5 / 3) * 2 ** (1 / 6) * special.gamma(11 / 6) / np.pi ** (8 / 3)
    front *= (24 / 5 * special.gamma(6 / 5)) ** (5 / 6)
    return front * (special.gamma(5 / 6) / 2 ** (1 / 6) - x ** (5 / 6) * special.kv(5 / 6, x))


def test_structure_function_is_von_karmans():
    r = np.array([0.003, 0.03, 0.3, 3.0, 30.0])
    assert structure_function(r, 0.04, 5.0) == pytest.approx(von_karman(r, 0.04, 5.0), rel=1e-3)
    assert structure_function(0.0, 0.04, 5.0) == 0
    kolmogorov = 6.884 * (r[:3] / 0.04) ** (5 / 3)
    assert structure_function(r[:3], 0.04, 1e8) == pytest.approx(kolmogorov, rel=5e-3)


def test_inner_scale_makes_the_structure_function_quadratic():
    r = np.array([0.001, 0.002])
    small = structure_function(r, 0.04, 5.0, inner_scale=0.05)
    assert small[1] / small[0] == pytest.approx(4.0, rel=0.01)
    assert structure_function(1.0, 0.04, 5.0, 0.01) == pytest.approx(structure_function(1.0, 0.04, 5.0), rel=0.01)


def test_spectrum_integrates_to_the_variance():
    f = np.geomspace(1e-4, 1e3, 20_000)
    variance = 2 * np.pi * np.trapezoid(phase_spectrum(f, 0.04, 5.0, 0.0) * f**2, np.log(f))
    # Far apart two points are independent: the structure function is twice the variance.
    assert 2 * variance == pytest.approx(von_karman(500.0, 0.04, 5.0), rel=1e-3)


def test_fried_parameter_of_a_spherical_and_of_a_plane_wave():
    k = 2 * np.pi / WAVELENGTH
    assert fried_parameter(1e-14, 1000.0, WAVELENGTH) == pytest.approx((0.423 * k**2 * 1e-11 * 3 / 8) ** -0.6)
    assert fried_parameter(1e-14, 1000.0, WAVELENGTH, 1.0) == pytest.approx((0.423 * k**2 * 1e-11) ** -0.6)


@pytest.mark.parametrize("count", [1, 3, 10])
def test_layers_are_as_strong_as_the_path(count):
    layers = PhaseScreenParams(distance=1000.0, r0=0.05, layers=count).path()
    assert sum((layer.shrink / layer.r0) ** (5 / 3) for layer in layers) == pytest.approx(0.05 ** (-5 / 3))
    r = np.array([0.01, 0.05])
    total = sum(structure_function(layer.shrink * r, layer.r0, 1e8) for layer in layers)
    assert total == pytest.approx(6.884 * (r / 0.05) ** (5 / 3), rel=5e-3)


def test_many_layers_have_equal_cn2():
    strengths = [layer.r0 for layer in PhaseScreenParams(distance=1000.0, r0=0.05, layers=20).path()]
    # Each slice of a constant path is as strong as the next for a plane wave; its middle stands for it to 2 %,
    # but for the last slice, where the cone ends in a point.
    assert np.ptp(strengths[:-1]) / np.mean(strengths) < 0.02


def tilt_constant(outer_scale, inner_scale=0.0, r0=0.04):
    one = (Layer(0.0, 1.0, r0, (0.0, 0.0)),)
    variance = tilt_variance(one, APERTURE, WAVELENGTH, outer_scale, inner_scale)
    assert tilt_covariance(one, APERTURE, WAVELENGTH, outer_scale, inner_scale) == pytest.approx([variance] * 2)
    return variance / ((APERTURE / r0) ** (5 / 3) * (WAVELENGTH / APERTURE) ** 2)


def test_tilt_variance_tends_to_nolls_constant():
    # 4/π² times Noll's 0.449; with (D/L0)^(1/3) the limit is reached slowly.
    assert tilt_constant(1e9) == pytest.approx(0.182, rel=2e-3)
    constants = [tilt_constant(scale) for scale in (0.5, 5.0, 50.0, 1e3, 1e6)]
    assert (np.diff(constants) > 0).all()


def test_tilt_variance_by_brute_force_over_the_aperture():
    # ⟨a²⟩ = −½ ∬ Z(ρ) Z(ρ') D_φ(ρ − ρ') over the disc, with Z = 4 x/D: no spectrum, no Bessel filter.
    count = 36
    axis = ((np.arange(count) + 0.5) / count - 0.5) * APERTURE
    x, y = (grid[np.hypot(*np.meshgrid(axis, axis)) <= APERTURE / 2] for grid in np.meshgrid(axis, axis))
    distance = np.hypot(x[:, None] - x, y[:, None] - y)
    distances, inverse = np.unique(distance.round(9), return_inverse=True)
    d = np.where(distances > 0, von_karman(np.maximum(distances, 1e-9), 0.04, 5.0), 0.0)[
        inverse.reshape(distance.shape)
    ]
    z = 4 * x / APERTURE
    z /= np.sqrt(np.mean(z**2))
    coefficient = -0.5 * (z @ d @ z) / len(x) ** 2
    variance = coefficient * (2 * WAVELENGTH / (np.pi * APERTURE)) ** 2
    expected = variance / ((APERTURE / 0.04) ** (5 / 3) * (WAVELENGTH / APERTURE) ** 2)
    assert tilt_constant(5.0) == pytest.approx(expected, rel=0.01)


def test_tilt_correlation_falls_with_the_angle_faster_along_than_across():
    layers = PhaseScreenParams(r0=0.04, wind=(0.0,)).path()
    covariances = np.array(
        [tilt_covariance(layers, APERTURE, WAVELENGTH, 5.0, 0.005, (angle, 0.0)) for angle in np.linspace(0, 4e-4, 6)]
    )
    along, across = covariances.T
    assert (np.diff(along) < 0).all()
    assert (np.diff(across) < 0).all()
    assert (along[1:] < across[1:]).all()
    turned = tilt_covariance(layers, APERTURE, WAVELENGTH, 5.0, 0.005, (0.0, 4e-4))
    assert turned == pytest.approx(covariances[-1, ::-1])


def test_frozen_flow_turns_lag_into_angle():
    layer = (Layer(500.0, 0.75, 0.05, (2.0, 0.0)),)
    later = tilt_covariance(layer, APERTURE, WAVELENGTH, 5.0, lag=0.1)
    elsewhere = tilt_covariance(layer, APERTURE, WAVELENGTH, 5.0, angle=(0.2 / 500.0, 0.0))
    followed = tilt_covariance(layer, APERTURE, WAVELENGTH, 5.0, angle=(0.2 / 500.0, 0.0), lag=0.1)
    assert later == pytest.approx(elsewhere)
    assert followed == pytest.approx(tilt_covariance(layer, APERTURE, WAVELENGTH, 5.0))


def test_diffraction_mtf_is_the_overlap_of_two_discs():
    axis = (np.arange(400) + 0.5) / 400 * 2 - 1
    x, y = np.meshgrid(axis, axis)
    disc = np.hypot(x, y) <= 1
    for share in (0.25, 0.5, 0.9):
        overlap = np.mean(disc & (np.hypot(x - 2 * share, y) <= 1)) / np.mean(disc)
        cutoff = APERTURE / WAVELENGTH
        assert diffraction_mtf(share * cutoff, APERTURE, WAVELENGTH) == pytest.approx(overlap, abs=2e-3)


def test_exposures_lie_between_nothing_and_diffraction():
    nu = np.linspace(0.02, 0.98, 25) * APERTURE / WAVELENGTH
    long, short = (f(nu, APERTURE, WAVELENGTH, 0.04) for f in (long_exposure_mtf, short_exposure_mtf))
    sharp = diffraction_mtf(nu, APERTURE, WAVELENGTH)
    assert (long < short).all()
    assert (short < sharp).all()
    expected = sharp * np.exp(-structure_function(WAVELENGTH * nu, 0.04, 1e9) / 2)
    # A structure function of some 40 rad², 0.1 % off, is 2 % in the exponential.
    assert long == pytest.approx(expected, rel=0.05)


def test_strength_can_be_given_in_three_ways():
    r0 = fried_parameter(2e-15, 2000.0, WAVELENGTH)
    for given in ({"cn2": 2e-15}, {"r0": r0}, {"d_over_r0": 0.1 / r0}):
        assert PhaseScreenParams(**given).fried == pytest.approx(r0)
    assert PhaseScreenParams().strength == pytest.approx(2.5)
    assert PhaseScreenParams(nyquist=0.5).pixel_angle == pytest.approx(WAVELENGTH / APERTURE)


def test_wind_of_every_layer():
    params = PhaseScreenParams(layers=2, wind=(1.0, 2.0), wind_direction=(90.0,))
    assert [layer.velocity for layer in params.path()] == [pytest.approx((0.0, 1.0)), pytest.approx((0.0, 2.0))]


def test_bad_arguments_of_functions():
    with pytest.raises(ConfigurationError, match="^cn2"):
        fried_parameter(-1e-15, 1000.0, WAVELENGTH)
