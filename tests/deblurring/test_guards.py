"""Guards: right widths pass, ringing and amplified noise are found."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.blur.psf import blur_otf
from turbrestore.core.arrays import luminance
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.deblurring.guards import GuardParams, GuardReading, evaluate_guards, ringing
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.runtime.scratch import to_scratch
from turbrestore.synthesis.scenes import SCENES

WIENER, TV, NLTV = (DeconvolutionParams(method=method, exponent=2.0) for method in ("wiener", "tv", "nltv"))


def blurred(name, sigma, noise=0.002, side=128):
    scene = SCENES[name](side, side)
    spectrum = np.fft.rfft2(scene) * blur_otf(scene.shape, sigma, 2.0)
    noisy = np.fft.irfft2(spectrum, scene.shape) + np.random.default_rng(1).normal(0, noise, scene.shape)
    return scene, noisy.astype(np.float32)


@pytest.mark.parametrize("name", ["chart", "words", "page", "brick"])
def test_the_right_width_passes_and_too_large_a_one_does_not(name):
    _, image = blurred(name, 1.0)
    passed = [evaluate_guards(deconvolve(image, width, NLTV).image, image, width).passed for width in (1.0, 2.0)]
    assert passed == [True, False]


def disc(level=0.8, dark=0.0, side=96, diameter=56.0):
    """A planet, darker towards its limb."""
    y, x = np.mgrid[:side, :side].astype(float) - (side - 1) / 2
    r = np.hypot(x, y) / (diameter / 2)
    lit = level * (0.35 + 0.65 * np.sqrt(np.clip(1 - r * r, 0, 1)))
    return (dark + np.where(r < 1, lit, 0) * np.clip((1 - r) * diameter / 2 + 0.5, 0, 1)).astype(np.float32)


@pytest.mark.parametrize("dark", [0.0, 0.1])
@pytest.mark.parametrize("around", [0, 400])
def test_a_ring_at_the_limb_of_a_planet_is_found_whatever_is_around_it(dark, around):
    image = cv2.GaussianBlur(disc(dark=dark), (0, 0), 1.2)
    image = (image + np.random.default_rng(0).normal(0, 0.002, image.shape)).clip(0, 1).astype(np.float32)
    found = [deconvolve(image, width, TV).image for width in (1.2, 2.0)]
    image, right, wrong = (np.pad(each, around, mode="edge") for each in (image, *found))
    assert evaluate_guards(right, image, 1.2).ringing < 0.03
    assert evaluate_guards(wrong, image, 2.0).ringing > GuardParams().ringing


def test_detail_beside_an_edge_is_a_ring_only_where_it_is_alike_along_the_edge():
    rng, columns = np.random.default_rng(0), np.arange(96)
    edge = np.tile(np.where(columns < 48, 0.3, 0.7), (96, 1)).astype(np.float32)
    image = cv2.GaussianBlur(edge, (0, 0), 2)
    places = np.zeros(96, int), rng.integers(0, 6, 96)
    alike, detail = (edge + 0.1 * (columns - 48 == place[:, None]) for place in places)
    assert evaluate_guards(alike, image, 2.0).ringing > 0.4
    assert evaluate_guards(detail, image, 2.0).ringing < 0.1


def test_noise_is_that_of_pixels_where_it_is_not_clipped():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[-64:64, -64:64]
    lit = np.hypot(x, y) < 30
    frames = [np.where(lit, 0.5 + rng.normal(0, 0.01 * gain, lit.shape), 0.0) for gain in (1, 8)]
    assert evaluate_guards(frames[1], frames[0], 1.0).noise_gain > 5


def test_amplified_noise_is_found():
    rng = np.random.default_rng(0)
    before = (0.5 + rng.normal(0, 0.01, (64, 64))).astype(np.float32)
    before[:, 32:] += 0.3
    after = before + rng.normal(0, 0.05, before.shape)
    reading = evaluate_guards(after, before, 1.0)
    assert reading.noise_gain == pytest.approx(np.hypot(0.05, 0.01) / 0.01, rel=0.1)
    assert not reading.passed


def test_a_grey_image_in_colour_gives_the_same_reading():
    _, image = blurred("camera", 1.0)
    colour = np.repeat(image[..., None], 3, axis=2)
    assert evaluate_guards(colour, colour, 1.0) == evaluate_guards(image, image, 1.0)


def test_images_in_files_give_the_same_reading(tmp_path):
    _, image = blurred("chart", 2.0)
    colour = np.stack([image, image[::-1], image.T], axis=-1)
    sharp = deconvolve(colour, 2.0, WIENER).image
    reading = evaluate_guards(to_scratch(sharp, tmp_path), to_scratch(colour, tmp_path), 2.0)
    planes = [
        (luminance(sharp), luminance(colour)),
        *zip(sharp.transpose(2, 0, 1), colour.transpose(2, 0, 1), strict=True),
    ]
    alone = [evaluate_guards(after, before, 2.0) for after, before in planes]
    for name in ("ringing", "overshoot", "noise_gain"):
        found = [getattr(one, name) for one in alone]
        assert getattr(reading, name) == max(found) and len(set(found)) > 2


def test_rings_of_colour_without_luminance_are_found():
    before = np.full((64, 64, 3), 0.5, np.float32)
    before[:, 32:] = 0.6
    after = before.copy()
    after[:, 24:32] += np.float32([0.587, -0.299, 0.0]) * 0.8
    assert evaluate_guards(luminance(after), luminance(before), 1.0).overshoot < 0.01
    assert not evaluate_guards(after, before, 1.0).passed


@given(gain=st.floats(0.1, 0.9), black=st.floats(0.05, 0.1))
@settings(deadline=None)
def test_the_reading_depends_on_neither_gain_nor_offset(gain, black):
    scene, image = blurred("camera", 2.0, side=48)
    first, second = (evaluate_guards(g * scene + b, g * image + b, 2.0) for g, b in ((0.9, 0.05), (gain, black)))
    assert second.ringing == pytest.approx(first.ringing, abs=0.02)
    assert second.overshoot == pytest.approx(first.overshoot, abs=0.02)
    assert second.noise_gain == pytest.approx(first.noise_gain, rel=0.1)


def test_different_shapes_and_bad_bounds_are_refused():
    with pytest.raises(DataError, match="expected the shape"):
        evaluate_guards(np.zeros((8, 8)), np.zeros((8, 9)), 1.0)
    with pytest.raises(ConfigurationError, match="overshoot"):
        GuardParams(overshoot=2.0)


def test_edges_in_one_row_of_tiles_are_not_all_left_out(monkeypatch):
    # More edges than are followed, all of them in the second row of tiles.
    monkeypatch.setattr("turbrestore.blur.edges._SAMPLES", 40 * 13)
    edge = np.repeat([0.2] * 24 + [0.8] * 24, 48).reshape(48, 48).astype(np.float32)
    blurred = cv2.GaussianBlur(edge, (0, 0), 1.5)
    assert ringing(edge + 2 * (edge - blurred), blurred, 1.5) == 1.0


@pytest.mark.parametrize(
    ("reading", "factor"),
    [((0.2, 0.0, 1.0), 0.922), ((0.24, 0.0, 1.0), 0.85), ((0.0, 0.17, 1.0), 0.922), ((0.0, 0.0, 12.0), 0.85)],
)
def test_the_width_is_lowered_less_where_a_bound_is_hardly_exceeded(reading, factor):
    assert GuardParams().first_back_off(GuardReading(2.0, *reading, passed=False)) == pytest.approx(factor, rel=1e-4)
