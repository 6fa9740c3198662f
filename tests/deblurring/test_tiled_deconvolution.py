"""Tiles agree with the whole image, and fit the memory they are chosen for."""

import numpy as np
import pytest

from turbrestore.blur.psf import GAUSSIAN, blur_otf
from turbrestore.deblurring.remove_blur import tiled_deconvolution_steps
from turbrestore.deconvolution.deconvolve import DeconvolutionParams, deconvolve
from turbrestore.metrics import psnr
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.steps import finish
from turbrestore.runtime.tiling import halo_tiles
from turbrestore.synthesis.scenes import SCENES

PARAMS = DeconvolutionParams(sigma=1.5)


@pytest.fixture(scope="module")
def brick():
    scene = SCENES["brick"](320, 400)
    spectrum = np.fft.rfft2(scene) * blur_otf(scene.shape, 1.6, GAUSSIAN)
    noise = np.random.default_rng(0).normal(0, 0.005, scene.shape)
    return scene, (np.fft.irfft2(spectrum, scene.shape) + noise).astype(np.float32)


@pytest.mark.long
@pytest.mark.parametrize(("method", "iterations"), [("nltv", 30), ("tv", 100), ("wiener", 200), ("tikhonov", 200)])
def test_tiles_are_as_good_as_the_whole_image(brick, method, iterations):
    scene, image = brick
    tiles, params = halo_tiles(image.shape, side=200, halo=40), DeconvolutionParams(method, iterations=iterations)
    assert len(tiles) == 8
    whole = deconvolve(image, 1.6, params, image)
    tiled = finish(tiled_deconvolution_steps(image, 1.6, params, image, tiles=tiles))
    assert psnr(tiled.image, scene) == pytest.approx(psnr(whole.image, scene), abs=0.05)
    assert tiled.fidelity == whole.fidelity
    assert tiled.noise == pytest.approx(whole.noise, rel=0.1)


def test_colour_and_files_make_no_difference(brick, tmp_path):
    _, image = brick
    colour = np.stack([image, image[::-1], image[:, ::-1]], axis=-1)
    params, tiles = DeconvolutionParams("wiener", channels="each"), halo_tiles(image.shape, side=200, halo=48)
    inside, outside = (
        finish(tiled_deconvolution_steps(colour, 1.6, params, None, Runtime(scratch=folder), tiles)).image
        for folder in (None, tmp_path)
    )
    assert np.array_equal(inside, outside)
    assert isinstance(outside, np.memmap)
    assert np.abs(inside - deconvolve(colour, 1.6, params).image).max() < 0.02
