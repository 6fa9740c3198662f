"""Relative blur and displacement variance, on scenes whose blur and motion are known."""

import cv2
import numpy as np
import pytest

from conftest import SCENES, blurred
from turbrestore.blur_moments.cues import displacement_variance, relative_blur
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize(("soft", "softer"), [(0.8, 1.0), (1.0, 1.5), (1.5, 1.8), (1.0, 2.0), (2.0, 3.0)])
def test_sigma_of_a_known_relative_blur_is_found_within_10_percent(scene, soft, softer):
    image, rng = SCENES[scene](160), np.random.default_rng(0)
    found = relative_blur(blurred(image, softer, rng), blurred(image, soft, rng), 0.01)
    true = softer**2 - soft**2
    assert np.sqrt(found.variance) == pytest.approx(np.sqrt(true), rel=0.05)
    assert np.abs(found.matrix - true * np.eye(2)).max() < 0.1 * true + 0.02


def test_a_blur_along_one_axis_is_found_along_it():
    image, rng = SCENES["camera"](160), np.random.default_rng(0)
    along = relative_blur(blurred(image, (2.0, 1.0), rng), blurred(image, (1.0, 1.0), rng), 0.01)
    assert along.matrix == pytest.approx(np.array([[3.0, 0.0], [0.0, 0.0]]), abs=0.25)


def test_a_blur_along_a_diagonal_is_found_along_it():
    image, rng = SCENES["camera"](160), np.random.default_rng(0)
    place = np.arange(-6, 7)
    streak = np.diag(np.exp(-(place**2) / 2))
    smeared = cv2.filter2D(image, -1, (streak / streak.sum()).astype(np.float32))
    found = relative_blur(blurred(smeared, 1.0, rng), blurred(image, 1.0, rng), 0.01)
    assert found.matrix == pytest.approx(np.ones((2, 2)), abs=0.1)


def test_exchanging_the_images_changes_the_sign():
    image, rng = SCENES["chart"](96), np.random.default_rng(0)
    one, two = blurred(image, 1.5, rng), blurred(image, 1.0, rng, 0.02)
    there, back = relative_blur(one, two, (0.01, 0.02)), relative_blur(two, one, (0.02, 0.01))
    assert there.variance == pytest.approx(-back.variance, rel=1e-4)
    assert there.tile_matrix == pytest.approx(-back.tile_matrix, rel=1e-3, abs=1e-3)
    assert there.tile_deviation == pytest.approx(back.tile_deviation, rel=1e-3)


def test_noise_floors_are_accounted_for():
    """Without them, noise in the sharper image alone makes it look sharper than it is."""
    image, rng = SCENES["camera"](160), np.random.default_rng(0)
    one, two = blurred(image, 1.5, rng, 0.001), blurred(image, 1.0, rng, 0.05)
    right, wrong = relative_blur(one, two, (0.001, 0.05)), relative_blur(one, two, 0.001)
    assert right.variance == pytest.approx(1.25, rel=0.1)
    assert wrong.variance > 1.4


def test_a_shift_between_the_images_does_not_matter():
    image, rng = SCENES["camera"](176), np.random.default_rng(0)
    one, two = blurred(image, 1.5, rng), blurred(image, 1.0, rng)
    assert relative_blur(one[3:, 4:], two[:-3, :-4], 0.01).variance == pytest.approx(1.25, rel=0.08)


def errors_of_tiles(soft, softer, noise, draws):
    """Normalised errors of tiles over scenes, places in them and noise."""
    tiles, matrices, pooled = [], [], []
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        image = list(SCENES.values())[seed % 2](160)[seed : 144 + seed]
        found = relative_blur(blurred(image, softer, rng, noise), blurred(image, soft, rng, noise), noise)
        true = softer**2 - soft**2
        tiles.append(((found.tile_variance - true) / found.tile_deviation).ravel())
        matrices.append(((found.tile_matrix - true * np.eye(2)) / found.tile_matrix_deviation).ravel())
        pooled.append((found.variance - true) / found.deviation)
    return np.concatenate(tiles), np.concatenate(matrices), np.array(pooled)


@pytest.mark.parametrize(("soft", "softer", "noise"), [(1.0, 1.5, 0.01), (0.8, 1.0, 0.01), (1.0, 2.0, 0.02)])
def test_uncertainty_is_honest(soft, softer, noise):
    """Variance of normalised errors within 0.6 to 1.4 for tiles; all tiles together are better than they say."""
    tiles, matrices, pooled = errors_of_tiles(soft, softer, noise, draws=10)
    assert len(tiles) >= 300
    for errors in (tiles, matrices):
        assert 0.6 < np.mean(errors**2) < 1.4
        assert np.quantile(np.abs(errors), 0.99) < 4
    assert np.mean(pooled**2) < 1.4


def test_a_tile_that_shows_nothing_says_so():
    rng = np.random.default_rng(0)
    flat = np.full((96, 96), 0.5, np.float32)
    found = relative_blur(blurred(flat, 1.0, rng), blurred(flat, 1.0, rng), 0.01)
    assert np.median(found.tile_deviation) > 2
    assert np.mean((found.tile_variance / found.tile_deviation) ** 2) < 1.5


@pytest.mark.parametrize("shape", [(16, 16), (20, 100), (50, 49)])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_images_without_content_say_nothing_and_break_nothing(shape, noise):
    flat = np.full((3, *shape), 0.5, np.float32)
    for found in (relative_blur(flat[0], flat[1], noise), displacement_variance(flat, noise)):
        assert found.variance == 0
        assert np.isinf(found.deviation)
        assert np.isinf(found.tile_matrix_deviation).all()


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("rms", [0.5, 1.0, 1.5, 2.5])
def test_displacement_variance_is_found_within_15_percent(scene, rms):
    rng = np.random.default_rng(4)
    flows = smooth_flows(40, 144, 144, rng, SmoothFlowParams(rms=rms, persistence=0.5))
    frames = distort(SCENES[scene](144), flows, rng, blur=0.8, noise=0.01)
    found = displacement_variance(frames, 0.01)
    assert found.variance == pytest.approx(flows.var(axis=0, ddof=1).mean(), rel=0.15)


def test_few_frames_suffice_for_a_large_displacement():
    """Twelve independent shifts; their mean keeps a twelfth of the power at high frequency, which is no blur."""
    ratios = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        flows = np.broadcast_to(rng.normal(0, 2.5, (12, 1, 1, 2)), (12, 128, 128, 2)).astype(np.float32)
        frames = distort(SCENES["camera"](128), flows, rng, blur=0.8, noise=0.01)
        ratios.append(displacement_variance(frames, 0.01).variance / flows.var(axis=0, ddof=1).mean())
    assert np.mean(ratios) == pytest.approx(1, abs=0.15)


def test_displacement_variance_of_tiles_and_axes():
    """The left half stands still, the right half moves along x."""
    rng = np.random.default_rng(0)
    flows = np.zeros((40, 128, 192, 2), np.float32)
    flows[..., 0] = rng.normal(0, 1, (40, 1, 1)) / (1 + np.exp(-(np.arange(192) - 96) / 6))
    scene = np.tile(SCENES["chart"](128), (1, 2))[:, :192]
    found = displacement_variance(distort(scene, flows, rng, blur=1.0, noise=0.01), 0.01)
    moved = flows[:, 0, -1, 0].var(ddof=1)
    still, moving = found.tile_matrix[:, :2], found.tile_matrix[:, -1]
    assert np.abs(still).max() < 0.03
    assert moving[:, 0, 0] == pytest.approx(np.full(3, moved), rel=0.1)
    assert np.abs(moving[:, 1]).max() < 0.05


def test_bad_input_is_named():
    image = np.zeros((32, 32), np.float32)
    with pytest.raises(DataError, match="second"):
        relative_blur(image, image[1:], 0.01)
    with pytest.raises(DataError, match="16 pixels"):
        relative_blur(image[:8], image[:8], 0.01)
    with pytest.raises(ConfigurationError, match="noise"):
        relative_blur(image, image, (0.01, -1.0))
    with pytest.raises(DataError, match="at least 2 frames"):
        displacement_variance(image[None], 0.01)
