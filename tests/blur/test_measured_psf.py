"""The point spread function that an image of a star shows, and its removal by both commands."""

import cv2
import numpy as np
import pytest

from turbrestore.blur.measured_psf import psf_from_image
from turbrestore.core.errors import DataError
from turbrestore.deconvolution.problem import read_blur
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.synthesis.scenes import SCENES
from turbrestore_cli.__main__ import main as run_command


def star(x, y, sigma, size=64, background=0.1, noise=0.002):
    rows, columns = np.mgrid[:size, :size]
    light = 0.7 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    return (light + background + np.random.default_rng(0).normal(0, noise, light.shape)).astype(np.float32)


@pytest.mark.parametrize(("x", "y", "sigma"), [(31.0, 33.0, 1.5), (28.4, 35.7, 2.2)])
def test_a_star_gives_a_centred_psf_of_its_width(x, y, sigma):
    psf = psf_from_image(star(x, y, sigma))
    assert psf.sum() == pytest.approx(1) and psf.min() >= 0 and psf.shape[0] == psf.shape[1]
    middle = np.arange(len(psf)) - len(psf) // 2
    assert abs(psf.sum(axis=0) @ middle) < 0.05 and abs(psf.sum(axis=1) @ middle) < 0.05
    assert read_blur(psf)[1] == pytest.approx(sigma, rel=0.03)


def test_a_background_that_is_bright_changes_nothing():
    dark, bright = (psf_from_image(star(31, 31, 2.0, background=level, noise=0.001)) for level in (0.0, 0.25))
    assert read_blur(dark)[1] == pytest.approx(read_blur(bright)[1], rel=0.02)


@pytest.mark.parametrize(
    ("image", "found"),
    [
        (np.full((32, 32), 0.2, np.float32), "a point well above its background"),
        (np.clip(star(31, 31, 4.0) * 3, 0, 0.8), "plateau"),
        (star(31, 31, 1.5) + star(14, 14, 1.5), "several"),
        (star(2, 31, 2.0), "light up to the border"),
        (star(1, 1, 1.0, size=4), "at least 5"),
    ],
)
def test_what_shows_no_single_point_is_refused_in_one_line(image, found):
    with pytest.raises(DataError, match=found):
        psf_from_image(image, "star.png")


def test_deconvolve_removes_a_measured_psf(tmp_path, capsys):
    scene = SCENES["words"](96, 96)
    kernel = psf_from_image(star(31, 31, 1.6, noise=0.0))
    blurred = cv2.filter2D(scene, -1, kernel, borderType=cv2.BORDER_REFLECT)
    image, point, out = (tmp_path / name for name in ("image.tif", "star.tif", "out.tif"))
    write_image(image, blurred, 32)
    write_image(point, star(30.3, 32.6, 1.6), 32)
    assert run_command(["deconvolve", str(image), str(out), "--psf", str(point)]) == 0
    assert "the point spread function is given" in capsys.readouterr().err
    restored = read_image(out).image
    assert np.abs(restored - scene).mean() < 0.8 * np.abs(blurred - scene).mean()
    assert run_command(["deconvolve", str(image), str(out), "--psf", str(point), "--sigma", "1"]) == 2
    assert run_command(["deconvolve", str(image), str(tmp_path / "b.tif"), "--psf", str(image), "--quiet"]) == 65
