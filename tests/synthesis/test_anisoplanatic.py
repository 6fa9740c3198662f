"""Imaging through phase screens: transfer functions, energy, geometry, noise, seeds, and what is refused."""

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
import skimage.data
from atmosphere_theory import (
    diffraction_mtf,
    long_exposure_mtf,
    sample_path,
    short_exposure_mtf,
    small_turbulence,
    structure_function,
)

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.metrics import psnr
from turbrestore.registration.warp import warp
from turbrestore.runtime.runtime import Runtime
from turbrestore.synthesis.anisoplanatic import diffraction_limited, phase_screen_frames
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.phase_screen import draw_turbulence, tilt_flow
from turbrestore.synthesis.pupil import point_spread_functions, psf_basis, pupil_mask, sample_pupil, tilt_free_path
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.sequence import CameraParams, record

DRAWS = 20
# The image of 24 samples repeats after 24 λ/D.  This window holds 49 pixels, one period: none of the light is missed.
WIDE = PhaseScreenParams(d_over_r0=5.0, pupil_samples=24, nyquist=49 / 48, channel_wavelengths=(550e-9,) * 3)
# Frequencies of transfer functions, as samples by which the pupil is shifted against itself.
SHIFTS = np.array([2, 5, 8, 12, 17])
NOISELESS = CameraParams(photons=float("inf"), read_noise=0.0, bit_depth=16)
ORIGIN = np.zeros(1)


def path_of(**given):
    """Two layers and a coarse pupil, cheap to draw."""
    return PhaseScreenParams(**{"layers": 2, "pupil_samples": 24, **given})


def frames_of(scene, count=2, seed=0, params=None, camera=NOISELESS):
    return list(phase_screen_frames(scene, count, np.random.default_rng(seed), params or path_of(), camera))


@pytest.fixture(scope="module")
def chart():
    return resolution_chart(80, 96)


def transfer(psfs, frequencies, params):
    """Transfer functions along x and along y at the given frequencies (cycles/rad), shape (F, 2, n)."""
    radius = psfs.shape[-1] // 2
    angles = np.arange(-radius, radius + 1) * params.pixel_angle
    lines = np.stack([psfs.sum(axis=1), psfs.sum(axis=2)], axis=1)
    return lines @ np.exp(-2j * np.pi * np.outer(angles, frequencies))


@pytest.fixture(scope="module", params=[5.0, 1e4], ids=["outer scale 5 m", "no outer scale"])
def exposures(request):
    """Frequencies, mean short- and long-exposure transfer function over many draws, their errors, and the params."""
    params = path_of(d_over_r0=2.0, outer_scale=request.param, inner_scale=0.0)
    frequencies = SHIFTS / params.pupil_samples * params.aperture / params.wavelength
    short, long = [], []
    for seed in range(DRAWS):
        turbulence = small_turbulence(params, seed, 192, 48)
        pupil = sample_pupil(turbulence)
        drifts = np.random.default_rng(seed).uniform(0, 1000, (24, 2, 2))
        paths = np.concatenate([tilt_free_path(turbulence, pupil, ORIGIN, ORIGIN, drift) for drift in drifts])
        tilts = np.stack([tilt_flow(turbulence, ORIGIN, ORIGIN, drift)[0, 0] for drift in drifts])
        psfs = point_spread_functions(paths, pupil.mask, params.wavelength, WIDE)
        fixed = transfer(psfs, frequencies, WIDE)
        moving = fixed * np.exp(-2j * np.pi * params.pixel_angle * tilts[..., None] * frequencies)
        short.append(fixed.mean(axis=(0, 1)).real)
        long.append(moving.mean(axis=(0, 1)).real)
    errors = [np.std(values, axis=0, ddof=1) / np.sqrt(DRAWS) for values in (short, long)]
    return frequencies, np.mean(short, axis=0), np.mean(long, axis=0), errors, params


@pytest.mark.long
def test_long_exposure_is_frieds(exposures):
    nu, _, long, (_, error), params = exposures
    # Path differences of all layers, each seen through the cone.
    spread = params.wavelength * nu
    structure = sum(structure_function(layer.shrink * spread, layer.r0, params.outer_scale) for layer in params.path())
    expected = diffraction_mtf(nu, params.aperture, params.wavelength) * np.exp(-structure / 2)
    assert error.max() < 0.012
    assert (np.abs(long - expected) < 4 * error + 0.004).all()
    fried = long_exposure_mtf(nu, params.aperture, params.wavelength, params.fried)
    if params.outer_scale > 1e3:
        assert expected == pytest.approx(fried, abs=0.02)
    else:
        assert (expected > fried).all()


def tilt_free_transfer(params):
    """Mean transfer function along x without tilt, exactly: a Gaussian phase over the samples of the pupil."""
    mask = pupil_mask(params)
    axis = ((np.arange(len(mask)) + 0.5) / len(mask) - 0.5) * params.aperture
    x, y = (grid[mask] for grid in np.meshgrid(axis, axis))
    distances, inverse = np.unique(np.hypot(x[:, None] - x, y[:, None] - y).round(9), return_inverse=True)
    structure = sum(structure_function(layer.shrink * distances, layer.r0, params.outer_scale)
                    for layer in params.path())[inverse.reshape(len(x), len(x))]  # fmt: skip
    planes = np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=1))[0]
    fitted = np.eye(len(x)) - planes @ planes.T
    # Once piston is out, -D/2 serves as the covariance.
    covariance = fitted @ (-structure / 2) @ fitted
    left = np.diag(covariance)[:, None] + np.diag(covariance) - 2 * covariance
    number = np.full(mask.shape, -1)
    number[mask] = np.arange(len(x))
    found = []
    for shift in SHIFTS:
        a, b = number[:, shift:].ravel(), number[:, :-shift].ravel()
        both = (a >= 0) & (b >= 0)
        found.append(np.exp(-left[a[both], b[both]] / 2).sum() / len(x))
    return np.array(found)


def test_short_exposure_is_what_is_left_without_tilt(exposures):
    _, short, _, (error, _), params = exposures
    assert error.max() < 0.01
    assert (np.abs(short - tilt_free_transfer(params)) < 4 * error + 0.004).all()


def test_short_exposure_is_nearly_frieds(exposures):
    nu, short, _, (error, _), params = exposures
    fried = short_exposure_mtf(nu, params.aperture, params.wavelength, params.fried)
    # Fried takes tilt and the rest of the phase for independent, which costs him up to 0.04.  Once tilt is gone the
    # outer scale changes little.
    assert (np.abs(tilt_free_transfer(params) - fried) < 0.04).all()
    assert (np.abs(short - fried) < 4 * error + 0.004 + 0.04).all()
    assert (short > long_exposure_mtf(nu, params.aperture, params.wavelength, params.fried) + 0.02).all()


def test_little_light_falls_outside_the_window():
    params = path_of(d_over_r0=2.0)
    turbulence = small_turbulence(params, 0, 192, 48)
    pupil = sample_pupil(turbulence)
    drifts = np.random.default_rng(0).uniform(0, 1000, (40, 2, 2))
    paths = np.concatenate([tilt_free_path(turbulence, pupil, ORIGIN, ORIGIN, drift) for drift in drifts])
    wide = point_spread_functions(paths, pupil.mask, params.wavelength, WIDE)
    radius = point_spread_functions(paths, pupil.mask, params.wavelength, params).shape[-1] // 2
    middle = slice(wide.shape[-1] // 2 - radius, wide.shape[-1] // 2 + radius + 1)
    assert 0.005 < 1 - wide[:, middle, middle].sum(axis=(1, 2)).mean() < 0.025


def test_without_turbulence_only_diffraction_is_left():
    params = PhaseScreenParams(d_over_r0=0.01)
    flat = np.zeros((1, pupil_mask(params).sum()), np.float32)
    psf = point_spread_functions(flat, pupil_mask(params), params.wavelength, params)
    nu = np.array([0.1, 0.3, 0.5, 0.8]) * params.aperture / params.wavelength
    expected = diffraction_mtf(nu, params.aperture, params.wavelength)
    assert np.abs(transfer(psf, nu, params)[0, 0] - expected).max() < 0.05
    assert psf[0] == pytest.approx(psf[0, ::-1, ::-1], abs=1e-6)


@pytest.mark.parametrize("nyquist", [0.3, 0.5, 1.0, 2.0])
def test_window_and_sampling_follow_the_pixel(nyquist):
    params = PhaseScreenParams(d_over_r0=0.5, nyquist=nyquist)
    flat = np.zeros((1, pupil_mask(params).sum()), np.float32)
    psf = point_spread_functions(flat, pupil_mask(params), params.wavelength, params)[0]
    angles = (np.arange(len(psf)) - len(psf) // 2) * params.pixel_angle / (params.wavelength / params.aperture)
    assert angles[-1] >= params.psf_radius
    # Half of the light falls within 0.535 λ/D; two pixels in three dimensions of sampling blur that a little.
    inside = psf[np.hypot(angles[:, None], angles) <= 1.22].sum()
    assert 0.75 < inside < 0.95


def test_energy_is_kept():
    params = path_of(d_over_r0=4.0)
    turbulence = draw_turbulence(params, (64, 64), np.random.default_rng(0))
    pupil = sample_pupil(turbulence)
    basis = psf_basis(turbulence, pupil, params.wavelength, (64, 64), np.random.default_rng(1))
    assert abs(float(basis[0].sum()) - 1) < 1e-5
    assert np.abs(basis[1:].sum(axis=(1, 2))).max() < 1e-5
    path = tilt_free_path(turbulence, pupil, np.linspace(-30, 30, 7), np.zeros(7), turbulence.drift(0.0))
    psfs = point_spread_functions(path, pupil.mask, params.wavelength, params)
    assert np.abs(psfs.sum(axis=(1, 2)) - 1).max() < 1e-5
    gram = np.einsum("ixy,jxy->ij", basis[1:], basis[1:])
    assert gram == pytest.approx(np.eye(len(gram)), abs=1e-4)


@pytest.mark.parametrize("colour", [False, True])
def test_flat_regions_keep_their_value_and_borders_are_not_dark(colour):
    scene = np.full((96, 96), 0.8, np.float32)
    scene[40:56, 40:56] = 0.2
    scene = np.dstack([scene] * 3) if colour else scene
    for frame in frames_of(scene, params=path_of(d_over_r0=2.5)):
        border = np.concatenate([frame.image[:4].reshape(-1), frame.image[:, -4:].reshape(-1)])
        assert np.abs(border - 0.8).max() < 1e-4


def test_tilt_of_light_is_the_displacement_of_the_image():
    params = path_of(layers=3, d_over_r0=1.5)
    turbulence = draw_turbulence(params, (64, 64), np.random.default_rng(5))
    pupil = sample_pupil(turbulence)
    drift = turbulence.drift(0.7)
    for x, y in ((0.0, 0.0), (25.0, -12.0)):
        # Phase over the pupil by brute force: every layer, every sample, along the cone to the field point.
        path = sum(
            sample_path(screen, layer.shrink * pupil.x + layer.distance * params.pixel_angle * x - shift[0],
                        layer.shrink * pupil.y + layer.distance * params.pixel_angle * y - shift[1]).astype(float)
            for layer, screen, shift in zip(turbulence.layers, turbulence.screens, drift, strict=True)
        )  # fmt: skip
        design = np.stack([np.ones_like(pupil.x), pupil.x, pupil.y], axis=1)
        fit = np.linalg.lstsq(design, path, rcond=None)[0]
        tilt = tilt_flow(turbulence, np.array([x]), np.array([y]), drift)[0, 0]
        assert tilt == pytest.approx(fit[1:] / params.pixel_angle, abs=0.05)
        free = tilt_free_path(turbulence, pupil, np.array([x]), np.array([y]), drift)[0]
        assert free == pytest.approx(path - design @ fit, abs=0.02 * params.wavelength)
        # The point spread function of the phase with its tilt lies where the tilt says.
        psf = point_spread_functions((path - fit[0])[None].astype(np.float32), pupil.mask, params.wavelength, params)[0]
        peak = np.subtract(np.unravel_index(cv2.GaussianBlur(psf, (0, 0), 1.0).argmax(), psf.shape), len(psf) // 2)
        assert peak[::-1] == pytest.approx(tilt, abs=1.0)


def test_waves_bend_over_the_pupil():
    # A lattice only four apertures wide leaves much of the phase without tilt to the waves.
    params = path_of(layers=1, d_over_r0=4.0, inner_scale=0.0)
    turbulence = small_turbulence(params, 6, 192, 48)
    pupil, (layer,), (screen,) = sample_pupil(turbulence), turbulence.layers, turbulence.screens
    path = sample_path(screen, layer.shrink * pupil.x, layer.shrink * pupil.y).astype(np.float64)
    expected = path - (path @ pupil.planes.T) @ pupil.planes
    free = tilt_free_path(turbulence, pupil, ORIGIN, ORIGIN, turbulence.drift(0.0))[0]
    assert free == pytest.approx(expected, abs=2e-3 * params.wavelength)


def test_frames_follow_the_sign_rule(chart):
    params = path_of(d_over_r0=1.5)
    truth = diffraction_limited(chart, params)
    inside = (slice(12, -12), slice(12, -12))
    for frame in frames_of(chart, count=3, params=params):
        assert frame.flow.shape == (*chart.shape, 2)
        assert frame.flow.dtype == np.float32
        moved, back = (
            psnr(frame.image[inside], truth[inside]),
            psnr(warp(frame.image, frame.flow)[inside], truth[inside]),
        )
        away = psnr(warp(frame.image, -frame.flow)[inside], truth[inside])
        assert back > moved + 3 > away


def test_the_pattern_moves_with_the_wind():
    params = path_of(layers=1, wind=(2.0,), wind_direction=(30.0,))
    turbulence = draw_turbulence(params, (64, 64), np.random.default_rng(0))
    (layer,) = turbulence.layers
    step = np.multiply(layer.velocity, 0.02) / (layer.distance * params.pixel_angle)
    x, y = np.arange(-16.0, 17.0), np.arange(-8.0, 9.0)
    before = tilt_flow(turbulence, x, y, turbulence.drift(0.0))
    after = tilt_flow(turbulence, x + step[0], y + step[1], turbulence.drift(0.02))
    assert after == pytest.approx(before, abs=1e-3)
    assert np.abs(tilt_flow(turbulence, x, y, turbulence.drift(0.02)) - before).max() > 0.1


def test_same_seed_same_bytes(chart):
    camera = CameraParams()
    first, again, other = (frames_of(chart, 3, seed, camera=camera) for seed in (1, 1, 2))
    longer = frames_of(chart, 4, 1, camera=camera)
    for a, b, c, d in zip(first, again, other, longer[:3], strict=True):
        assert a.image.tobytes() == b.image.tobytes() == d.image.tobytes()
        assert a.flow.tobytes() == b.flow.tobytes() == d.flow.tobytes()
        assert a.image.tobytes() != c.image.tobytes()
    assert len({frame.image.tobytes() for frame in longer}) == 4


def test_colour_channels_share_the_flow_and_not_the_blur():
    photo = cv2.resize(skimage.data.astronaut(), (80, 64), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    grey_only = np.dstack([photo[..., 1]] * 3)
    params = path_of(d_over_r0=2.0, channel_wavelengths=(900e-9, 550e-9, 400e-9))
    frame = frames_of(grey_only, 1, params=params)[0]
    assert frame.image.shape == (64, 80, 3)
    assert all(psnr(frame.image[..., channel], frame.image[..., 1]) < 45 for channel in (0, 2))
    sharp = diffraction_limited(grey_only, params)
    detail = np.abs(cv2.Laplacian(sharp, cv2.CV_32F)).mean(axis=(0, 1))
    assert detail[0] < detail[1] < detail[2]
    one = replace(params, channel_wavelengths=(550e-9,) * 3)
    same = frames_of(grey_only, 1, params=one)[0].image
    assert same[..., 0] == pytest.approx(same[..., 2], abs=1e-3)
    assert frames_of(photo, 1, params=one)[0].image.mean(axis=(0, 1)) == pytest.approx(
        photo.mean(axis=(0, 1)), abs=0.01
    )


def test_exposure_averages_the_motion(chart):
    params = path_of(wind=(3.0,))
    instants = replace(NOISELESS, frame_rate=100.0)
    long = replace(NOISELESS, frame_rate=25.0, exposure=0.04, sub_frames=4)
    # Four instants of 10 ms at 5, 15, 25 and 35 ms are what the exposure of 40 ms is summed from.
    shifted = replace(NOISELESS, frame_rate=200.0)
    fine = frames_of(chart, 8, params=params, camera=shifted)[1::2]
    one = frames_of(chart, 1, params=params, camera=long)[0]
    assert one.flow == pytest.approx(np.mean([frame.flow for frame in fine], axis=0), abs=1e-4)
    assert one.image == pytest.approx(np.mean([frame.image for frame in fine], axis=0), abs=1e-4)
    start = frames_of(chart, 1, params=params, camera=instants)[0]
    detail = [np.abs(cv2.Laplacian(frame.image, cv2.CV_32F)).mean() for frame in (one, start)]
    assert detail[0] < detail[1]


def test_noise_and_quantisation_are_those_of_the_camera():
    scene = np.full((96, 96), 0.5, np.float32)
    scene[:8, :8] = 0.9
    camera = CameraParams(photons=500.0, read_noise=0.02, bit_depth=12)
    frame = frames_of(scene, 1, camera=camera)[0]
    flat = frame.image[48:, 48:]
    # 2,304 pixels: the variance is known to 3 %, the mean to 0.0008.
    assert flat.var() == pytest.approx(0.5 / 500 + 0.02**2, rel=0.12)
    assert flat.mean() == pytest.approx(0.5, abs=0.003)
    levels = frame.image * (2**12 - 1)
    assert np.abs(levels - np.rint(levels)).max() < 1e-3
    assert set(np.unique(frames_of(scene, 1, camera=replace(camera, bit_depth=1))[0].image)) == {0.0, 1.0}


def test_the_most_photons_can_be_drawn():
    bright = record(np.ones((8, 8), np.float32), CameraParams(photons=1e12, read_noise=0.0), np.random.default_rng(0))
    assert (bright == 1).all()


def test_every_frame_has_noise_of_its_own(chart):
    camera = CameraParams(photons=float("inf"), read_noise=0.05, bit_depth=16)
    still = path_of(wind=(0.0,))
    clean = frames_of(chart, 1, params=still)[0].image
    first, second = (frame.image - clean for frame in frames_of(chart, 2, params=still, camera=camera))
    middle = (clean > 0.2) & (clean < 0.8)
    assert abs(np.corrcoef(first[middle], second[middle])[0, 1]) < 0.1
    assert first[middle].std() == pytest.approx(0.05, rel=0.1)


def test_frames_come_one_at_a_time(chart):
    stream = phase_screen_frames(chart, 10**6, np.random.default_rng(0))
    assert len(list(itertools.islice(stream, 2))) == 2
    stream.close()


@pytest.mark.long
def test_threads_do_not_change_the_frames(chart):
    one, two = (
        list(phase_screen_frames(chart, 3, np.random.default_rng(0), path_of(), runtime=Runtime(threads=n)))
        for n in (1, 2)
    )
    assert all((a.image == b.image).all() for a, b in zip(one, two, strict=True))


@pytest.mark.parametrize(
    ("scene", "part"),
    [
        (np.full((64, 64), 0.5), "one colour"),
        (np.full((64, 64, 3), 0.5), "one colour"),
        (np.array([[0.5]]), "16×16 pixels, found 1×1"),
        (np.linspace(0, 255, 4096).reshape(64, 64), "values in 0 to 1"),
        (np.full((64, 64), np.nan), "finite"),
        (np.zeros((4, 64, 64)), "shape"),
    ],
)
def test_bad_scenes_are_refused_in_one_line(scene, part):
    for act in (lambda: frames_of(scene), lambda: diffraction_limited(scene)):
        with pytest.raises(DataError) as caught:
            act()
        assert part in str(caught.value)
        assert "\n" not in str(caught.value)


def test_frames_are_counted(chart):
    with pytest.raises(ConfigurationError, match="^count"):
        frames_of(chart, 0)
