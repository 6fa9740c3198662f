"""Deviation of every pixel against linear systems, and of whole restorations against their scenes."""

import numpy as np
import pytest
from scipy.stats import spearmanr

import turbrestore
from turbrestore.blur.psf import blur_otf, laplacian_symbol
from turbrestore.core.noise import estimate_noise
from turbrestore.deconvolution.conjugate_gradient import wiener_fidelity
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, automatic_fidelity
from turbrestore.io.images.image_files import write_image
from turbrestore.io.source import FrameSource
from turbrestore.io.video import write_video
from turbrestore.synthesis.scenes import picture
from turbrestore.synthesis.smooth_flow import distort, smooth_flows
from turbrestore.verification.pixel_deviation import (
    pixel_deviation,
    posterior_gain,
    quadratic_fidelity,
    variance_by_blur,
)
from turbrestore_cli.commands import run as run_command


def test_gain_is_the_posterior_variance_of_a_linear_gaussian_model():
    rng, n, sigma = np.random.default_rng(0), 32, 1.2
    fidelity = 1500.0
    otf = np.abs(np.fft.fft2(np.fft.irfft2(blur_otf((n, n), sigma), s=(n, n))))
    symbol = np.fft.fft2(np.fft.irfft2(laplacian_symbol(n, n), s=(n, n))).real
    # Scenes of the prior, blurred, with noise of unit variance; the mean of the posterior misses them by its deviation.
    prior = np.sqrt(fidelity / np.maximum(symbol, 1e-9)) * (symbol > 1e-9)
    errors = []
    for _ in range(60):
        scene = prior * np.fft.fft2(rng.normal(size=(n, n)))
        seen = otf * scene + np.fft.fft2(rng.normal(size=(n, n)))
        errors.append(np.fft.ifft2(otf * seen / (otf**2 + symbol / fidelity) - scene).real)
    assert np.mean(np.square(errors)) == pytest.approx(posterior_gain((n, n), fidelity, sigma, None), rel=0.05)


def test_gain_of_all_frequencies_is_that_of_a_full_transform():
    shape, sigma = (12, 10), 1.5
    otf, symbol = (
        np.fft.fft2(np.fft.irfft2(half, s=shape)).real for half in (blur_otf(shape, sigma), laplacian_symbol(*shape))
    )
    assert posterior_gain(shape, 50.0, sigma, None) == pytest.approx(np.mean(1 / (otf**2 + symbol / 50)), rel=1e-5)
    assert posterior_gain(shape, 50.0, 0.0, None) == 1.0


@pytest.mark.parametrize("method", ["nltv", "tv", "wiener", "tikhonov"])
def test_the_weight_of_the_data_is_that_which_was_used(method):
    image = picture("camera", 48, 48)
    automatic = automatic_fidelity(method, image, estimate_noise(image))
    usual = quadratic_fidelity(image, method, automatic, estimate_noise(image))
    assert usual == pytest.approx(wiener_fidelity(image, estimate_noise(image)))
    assert quadratic_fidelity(image, method, 3 * automatic, estimate_noise(image)) == pytest.approx(3 * usual)
    assert posterior_gain((48, 48), 3 * usual, 1.5, None) > 1.5 * posterior_gain((48, 48), usual, 1.5, None)


def test_position_makes_edges_uncertain_and_flat_parts_not():
    image = np.repeat(np.float32([[0.2, 0.8]]), 16, axis=1).repeat(32, axis=0)
    flat = np.zeros((32, 32), np.float32)
    deviation = pixel_deviation(image, flat + 1e-6, 4.0, flat + 0.04, flat == 0)
    assert deviation[16, 4] == pytest.approx(2e-3)
    assert deviation[16, 15] > 10 * deviation[16, 4]


def test_the_posterior_of_the_blur_makes_edges_uncertain_and_flat_parts_not():
    step = np.zeros((48, 48), np.float32)
    step[:, 24:] = 0.5
    fidelity = 500.0
    narrow, wide = (variance_by_blur(step, fidelity, widths, 1.5) for widths in ((1.0, 1.1), (0.8, 1.4)))
    assert (np.sqrt(narrow[4:-4, 22:27]) > 10 * np.sqrt(narrow[4:-4, 4:8].max())).all()
    assert (wide[:, 22:27] > 10 * narrow[:, 22:27]).all()
    assert not variance_by_blur(step, fidelity, (1.2, 1.2), 1.5).any()


@pytest.fixture(scope="module")
def clip():
    rng = np.random.default_rng(3)
    scene = picture("camera", 96, 96)
    flows = smooth_flows(20, 96, 96, rng)
    # At the mean geometry the scene is as it was drawn.
    frames = np.stack(list(distort(scene, flows - flows.mean(axis=0), rng, blur=1.0, noise=0.01)))
    frames[:, 40:48, 40:48] = 1.0
    return scene, frames.astype(np.float32)


def test_deviation_of_a_restoration_ranks_and_bounds_its_error(clip, tmp_path):
    scene, frames = clip
    restoration = turbrestore.restore(frames)
    deviation, error = restoration.uncertainty, np.abs(restoration.image - scene)
    assert deviation.shape == restoration.image.shape and deviation.dtype == np.float32
    assert np.isinf(deviation[43:45, 43:45]).all()
    inside = np.zeros((96, 96), bool)
    inside[8:-8, 8:-8] = True
    inside[34:54, 34:54] = False
    assert spearmanr(error[inside], deviation[inside])[0] >= 0.4
    assert 0.85 <= np.mean(error[inside] <= 2 * deviation[inside]) <= 0.98
    turbrestore.save_run(tmp_path / "run", restoration, turbrestore.RunRecord("clip", frames[0]))
    np.testing.assert_array_equal(turbrestore.load_run(tmp_path / "run")[0].uncertainty, deviation)
    assert turbrestore.restore(frames, turbrestore.RestoreParams(until="identify")).uncertainty is None


def test_what_no_frame_shows_is_unknown(clip, tmp_path):
    scene, frames = clip
    # In this geometry the first six columns are beyond the frames.
    write_image(tmp_path / "reference.png", np.roll(scene, 6, axis=1), 8)
    params = turbrestore.RestoreParams(reference=str(tmp_path / "reference.png"))
    unknown = np.isinf(turbrestore.restore(frames[:8, :], params).uncertainty)
    assert unknown[8:-8, :4].mean() > 0.9
    assert unknown[8:30, 12:-8].mean() < 0.05


def deviation_of(frames, **deconvolution):
    # Squares that are pasted into the frames would be taken for an overlay.
    params = turbrestore.RestoreParams(
        static_mask="off", deconvolution=DeconvolutionParams(method="wiener", **deconvolution)
    )
    found = turbrestore.restore(FrameSource.from_array(np.rint(65535 * frames).astype(np.uint16)), params)
    return found.uncertainty


def test_the_scale_of_the_file_does_not_matter_and_the_fidelity_does(clip):
    frames = clip[1][:12, :80, :80].copy()
    frames[:, 40:48, 40:48] = frames[:, :8, :8]
    whole, faint = (deviation_of(k * (0.1 + 0.8 * frames), sigma=1.5) / k for k in (1, 1 / 16))
    middle = np.s_[12:-12, 12:-12]
    assert np.median(faint[middle] / whole[middle]) == pytest.approx(1, abs=0.05)
    given = deviation_of(0.1 + 0.8 * frames, sigma=1.5, fidelity=10.0)
    assert np.median(given[middle]) < 0.7 * np.median(whole[middle])


def test_a_camera_that_saturates_below_full_scale_is_noticed(clip):
    bright = np.minimum(clip[1][:8, ..., None].repeat(3, axis=-1), 0.8) / 16
    # One channel that is saturated in every frame is enough.
    bright[:, 40:48, 40:48] = (0.3 / 16, 0.9 / 16, 0.3 / 16)
    deviation = deviation_of(bright, sigma=0.0)
    assert np.isinf(deviation[43:45, 43:45]).all() and np.isfinite(deviation).mean() > 0.8


def test_what_an_overlay_hides_in_every_frame_is_infinite(clip, tmp_path):
    mask = np.zeros((96, 96), np.float32)
    mask[60:80, 50:75] = 1
    write_image(tmp_path / "mask.png", mask, 8)
    deviation = turbrestore.restore(
        clip[1][:8], turbrestore.RestoreParams(static_mask=str(tmp_path / "mask.png"))
    ).uncertainty
    assert np.isinf(deviation[60:80, 50:75]).all() and np.isfinite(deviation[60:80, 78:]).all()


def test_the_command_writes_the_map_and_refuses_what_has_none(clip, tmp_path, capsys):
    tifffile, fits = pytest.importorskip("tifffile"), pytest.importorskip("astropy.io.fits")
    video = tmp_path / "clip.mkv"
    write_video(video, clip[1][:8], 30.0)
    result, path, report = (tmp_path / name for name in ("sharp.fits", "deviation.tif", "report.html"))
    words = ["restore", str(video), str(result), "--quiet", f"--uncertainty={path}"]
    assert run_command([*words, f"--report={report}"]) == 0
    found = tifffile.imread(path)
    assert found.shape == (96, 96) and (found > 0).all()
    np.testing.assert_array_equal(fits.getdata(result, "UNCERT"), found)
    assert "Where not to trust the result" in report.read_text()
    capsys.readouterr()
    assert run_command([*words, "--overwrite", "--until=centroid"]) == 2
    assert "--uncertainty" in capsys.readouterr().err
