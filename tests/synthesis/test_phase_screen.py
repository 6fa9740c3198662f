"""Phase screens and the tilts of a path through them against von Kármán, Noll and Taylor.

Margins are four standard errors, estimated from the scatter between independent draws, plus 2 % for sampling.
"""

from dataclasses import replace

import numpy as np
import pytest
from atmosphere_theory import sample_path, small_turbulence, structure_function, tilt_covariance

from turbrestore.core.errors import ConfigurationError
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.phase_screen import draw_screen, draw_turbulence, sample_lattice, tilt_flow

WAVELENGTH = 550e-9


def screen_of(seed, size=64, spacing=0.005, aperture=0.1, turn=0.3, **scales):
    rng = np.random.default_rng(seed)
    settings = {"r0": 0.05, "outer_scale": 5.0, "inner_scale": 0.01, **scales}
    return draw_screen(size, spacing, rng=rng, wavelength=WAVELENGTH, aperture=aperture, turn=turn, **settings)


def agrees(samples, expected, slack=0.02, largest_error=0.03):
    """Mean over the first axis is what is expected, above and below."""
    mean, error = samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))
    assert (error < largest_error).all(), "too few draws to tell"
    return bool((np.abs(mean - expected) < 4 * error + slack).all())


def tilt_constants(params, draws):
    """Variance of the tilt about x and y of each draw, over (D/r0)^(5/3) (λ/D)²."""
    variances = []
    for seed in range(draws):
        turbulence = small_turbulence(params, seed, 64, 20)
        starts = np.random.default_rng(seed).uniform(0, 1e4, (8, params.layers, 2))
        flow = [tilt_flow(turbulence, np.zeros(1), np.zeros(1), start) for start in starts]
        variances.append(np.mean(np.square(flow, dtype=np.float64), axis=(0, 1, 2)))
    unit = params.strength ** (5 / 3) * (params.wavelength / params.aperture) ** 2
    return np.array(variances) * params.pixel_angle**2 / unit


@pytest.mark.parametrize("outer_scale", [2.0, 20.0])
def test_structure_function_is_von_karmans(outer_scale):
    # From one lattice point to far beyond the period of 0.32 m, which is shorter than the outer scale.
    separations = 0.005 * np.array([1, 2, 5, 12, 30, 77, 153, 413, 1613])
    rows = []
    for seed in range(80):
        screen = screen_of(seed, outer_scale=outer_scale, turn=0.0)
        rng = np.random.default_rng(1000 + seed)
        x, y = 0.005 * rng.integers(0, 20_000, (2, 60))
        start = sample_path(screen, x, y)
        rows.append([np.mean((sample_path(screen, x + s, y) - start) ** 2, dtype=np.float64) for s in separations])
    expected = structure_function(separations, 0.05, outer_scale, 0.01)
    ratios = np.array(rows) * (2 * np.pi / WAVELENGTH) ** 2 / expected
    assert agrees(ratios, np.ones(len(separations)))


def test_look_up_between_lattice_points_takes_a_little_of_the_finest_structure():
    # Spacing and inner scale that the default path has at the aperture.
    spacing, steps = 0.1 / 32, np.array([1, 4, 16])
    rows = []
    for seed in range(40):
        screen = screen_of(seed, spacing=spacing, inner_scale=0.005, turn=0.6)
        x, y = np.random.default_rng(seed).uniform(0, 100, (2, 400))
        start = sample_path(screen, x, y)
        rows.append([np.mean((sample_path(screen, x + s, y) - start) ** 2, dtype=np.float64) for s in spacing * steps])
    expected = structure_function(spacing * steps, 0.05, 5.0, 0.005)
    ratios = np.array(rows) * (2 * np.pi / WAVELENGTH) ** 2 / expected
    assert agrees(ratios, np.array([0.86, 0.97, 1.0]), slack=0.01)


def test_screen_is_isotropic():
    squares = []
    for seed in range(80):
        screen = screen_of(seed, turn=0.7)
        x, y = np.random.default_rng(seed).uniform(0, 100, (2, 60))
        start = sample_path(screen, x, y)
        ends = [sample_path(screen, x + 0.2 * np.cos(a), y + 0.2 * np.sin(a)) for a in (0.0, np.pi / 4, np.pi / 2)]
        squares.append([np.mean((end - start) ** 2, dtype=np.float64) for end in ends])
    ratios = np.array(squares) / np.mean(squares)
    assert agrees(ratios, np.ones(3))


def test_slopes_are_those_of_planes_fitted_over_the_aperture():
    screen = screen_of(3)
    axis = (np.arange(40) + 0.5) / 40 * 0.1 - 0.05
    px, py = (grid[np.hypot(*np.meshgrid(axis, axis)) <= 0.05] for grid in np.meshgrid(axis, axis))
    design = np.stack([np.ones_like(px), px, py], axis=1)
    rng = np.random.default_rng(0)
    fitted, looked_up = [], []
    for _ in range(40):
        x, y = rng.uniform(0, 3, 2)
        fitted.append(np.linalg.lstsq(design, sample_path(screen, x + px, y + py), rcond=None)[0][1:])
        waves = np.exp(-2j * np.pi * (screen.frequencies @ [x, y]))
        lattice = sample_lattice(screen, screen.slopes, np.array([[x]]), np.array([[y]]))
        looked_up.append([float(lattice[a][0, 0] + (screen.wave_slopes[a] @ waves).real) for a in range(2)])
    error = np.std(np.subtract(looked_up, fitted)) / np.std(fitted)
    assert error < 0.02


def test_lattice_comes_back_and_waves_do_not():
    screen = screen_of(4, turn=0.0)
    period = len(screen.path) * screen.spacing
    points = np.array([[0.1, 0.2]]), np.array([[0.3, 0.1]])
    (here,), (there,) = (sample_lattice(screen, [screen.path], points[0] + d, points[1]) for d in (0.0, period))
    assert there == pytest.approx(here, abs=1e-3 * float(np.abs(screen.path).max()))
    assert not np.allclose(sample_path(screen, *points), sample_path(screen, points[0] + period, points[1]), rtol=0.01)


# A narrow view, and two layers of different wind, keep many draws cheap.
NARROW = PhaseScreenParams(layers=2, d_over_r0=2.5, wind=(1.0, 3.0), wind_direction=(0.0, 60.0))
COLUMNS = np.arange(-64.0, 65.0, 16.0)
ROWS = np.array([-40.0, 40.0])
LAG, FASTER = 0.01, (0.0, 1.0, 3.0, 10.0)


@pytest.fixture(scope="module")
def tilts():
    """Tilt in rad, shape (draws, places, lags, rows, columns, 2)."""
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        turbulence = draw_turbulence(NARROW, (128, 128), rng)
        starts = rng.uniform(0, 1000, (10, 2, 2))
        drifts = [turbulence.drift(LAG * factor) for factor in FASTER]
        found.append([[tilt_flow(turbulence, COLUMNS, ROWS, start + drift) for drift in drifts] for start in starts])
    return np.array(found, np.float64) * NARROW.pixel_angle


def theory(angle=(0.0, 0.0), lag=0.0, faster=1.0):
    params = replace(NARROW, wind=tuple(faster * wind for wind in NARROW.wind))
    scales = (params.outer_scale, params.inner_scale)
    return tilt_covariance(params.path(), params.aperture, params.wavelength, *scales, angle, lag)


def test_tilt_variance_is_that_of_theory(tilts):
    variance = theory()
    constant = variance[0] / (NARROW.strength ** (5 / 3) * (NARROW.wavelength / NARROW.aperture) ** 2)
    # Noll's 0.182 holds without an outer scale; 5 m takes a third of it away on this path.
    assert 0.112 < constant < 0.13
    assert agrees(tilt_constants(NARROW, 160).mean(axis=1) / constant, np.ones(()))
    # The full-size screens of draw_turbulence, fewer of them.
    assert np.mean(tilts**2) == pytest.approx(variance[0], rel=0.15)


def test_tilt_variance_reaches_nolls_constant_without_an_outer_scale():
    params = PhaseScreenParams(layers=1, d_over_r0=1.0, outer_scale=1e6, inner_scale=0.0)
    assert agrees(tilt_constants(params, 200).mean(axis=1) / 0.182, np.ones(()))


def test_tilt_correlation_falls_with_the_field_angle(tilts):
    expected = np.array([theory((16 * step * NARROW.pixel_angle, 0.0)) for step in (1, 3, 8)]) / theory()
    assert (np.diff(expected, axis=0) < -0.05).all()
    for step, correlation in zip((1, 3, 8), expected, strict=True):
        a, b = tilts[..., step:, :], tilts[..., :-step, :]
        excess = np.mean(a * b - correlation * (a**2 + b**2) / 2, axis=(1, 2, 3, 4)) / theory()
        assert agrees(excess, np.zeros(2), largest_error=0.045)


def test_tilt_correlation_from_frame_to_frame_falls_with_the_wind_as_frozen_flow_has_it(tilts):
    expected = np.array([theory(lag=LAG, faster=factor) for factor in FASTER]) / theory()
    assert (np.diff(expected, axis=0) < -0.02).all()
    for number, correlation in enumerate(expected):
        a, b = tilts[:, :, number], tilts[:, :, 0]
        excess = np.mean(a * b - correlation * (a**2 + b**2) / 2, axis=(1, 2, 3)) / theory()
        assert agrees(excess, np.zeros(2))


def test_nothing_repeats_within_the_field_of_view():
    params = PhaseScreenParams(layers=3)
    turbulence = draw_turbulence(params, (256, 256), np.random.default_rng(0))
    for layer, screen in zip(turbulence.layers, turbulence.screens, strict=True):
        width = 256 * params.pixel_angle * layer.distance + layer.shrink * params.aperture
        assert len(screen.path) * screen.spacing > width
        assert screen.spacing <= max(layer.shrink * params.aperture / 32, params.inner_scale / 4) * 1.001


def test_a_lattice_needs_points():
    with pytest.raises(ConfigurationError, match="^size"):
        screen_of(0, size=4)
