"""Cues against scenes whose blur and motion are known, and against brute force."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from conftest import SCENES
from turbrestore.blur_moments.cues import (
    CueParams,
    FrameBlur,
    TileGrid,
    blur_against,
    displacement_variance,
    frame_blur,
    frame_noise_factor,
    frame_weight,
    fuse_frames,
    fusion_rule,
    fusion_weights,
    laplacian_energy,
    noise_factor,
    refer_blur,
    relative_blur,
    tile_map,
)
from turbrestore.errors import ConfigurationError, DataError
from turbrestore.metrics import psnr
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows
from turbrestore.warp import warp


def blurred(scene, sigma, rng, noise=0.01):
    soft = cv2.GaussianBlur(scene, (0, 0), sigmaX=np.atleast_1d(sigma)[0], sigmaY=np.atleast_1d(sigma)[-1])
    return (soft + rng.normal(0, noise, scene.shape)).astype(np.float32)


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
    blur = frame_blur(flat, noise)
    assert blur.extra.max() == 0
    assert blur.deviation == pytest.approx(np.full_like(blur.deviation, 2), abs=1e-3)
    assert fuse_frames(flat, fusion_rule(blur, laplacian_energy(flat[0]), noise)) == pytest.approx(flat[0], abs=1e-6)


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
    field = tile_map(found.tile_matrix[..., 0, 0], found.grid)
    assert field.shape == (128, 192)
    assert field[:, :30].max() < 0.05
    assert field[:, -30:].min() > 0.8 * moved


def moving_blur(scene, count, rng, low=0.6, high=2.4, noise=0.01):
    """Frames whose σ varies from ``low`` to ``high`` in time and across the image, and their variance."""
    height, width = scene.shape
    levels = np.linspace(low, high, 13)
    stack = np.stack([cv2.GaussianBlur(scene, (0, 0), level) for level in levels])
    ends = rng.uniform(0, 1, (count, 2, 2)).astype(np.float32)
    share = np.stack([cv2.resize(end, (width, height), interpolation=cv2.INTER_LINEAR) for end in ends])
    variance = low**2 + (high**2 - low**2) * share
    place = np.interp(variance, levels**2, np.arange(13.0))
    lower = np.minimum(place.astype(int), 11)
    frames = [
        (1 - (p - i)) * np.take_along_axis(stack, i[None], 0)[0]
        + (p - i) * np.take_along_axis(stack, i[None] + 1, 0)[0]
        for p, i in zip(place, lower, strict=True)
    ]
    return (np.stack(frames) + rng.normal(0, noise, place.shape)).astype(np.float32), variance


@pytest.fixture(scope="module")
def varied():
    scene = SCENES["camera"](144)
    return scene, *moving_blur(scene, 40, np.random.default_rng(0))


def tile_means(maps, grid):
    centres = grid.rows + grid.size[0] // 2, grid.columns + grid.size[1] // 2
    smooth = np.stack([cv2.GaussianBlur(m, (0, 0), 11) for m in maps])
    return smooth[:, centres[0]][:, :, centres[1]]


@pytest.mark.parametrize(("rms", "registered", "least"), [(0.0, False, 0.95), (1.5, True, 0.95), (1.5, False, 0.92)])
def test_frame_blur_follows_the_truth(rms, registered, least):
    for scene in SCENES.values():
        rng, image = np.random.default_rng(0), scene(144)
        frames, variance = moving_blur(image, 40, rng, noise=0.0)
        flows = smooth_flows(40, 144, 144, rng, SmoothFlowParams(rms=rms))
        frames = [distort(frame, flow[None], rng, noise=0.01)[0] for frame, flow in zip(frames, flows, strict=True)]
        if registered:
            frames = [warp(frame, flow) for frame, flow in zip(frames, flows, strict=True)]
        found = frame_blur(np.stack(frames), 0.01)
        true = tile_means(variance, found.grid)
        true = true - true.mean(axis=0)
        seen = np.broadcast_to(np.median(found.deviation, axis=0) < 0.4, true.shape)
        assert seen.mean() > 0.8
        assert np.corrcoef(true[seen], found.relative[seen])[0, 1] > least
        assert np.polyfit(true[seen], found.relative[seen], 1)[0] == pytest.approx(1, abs=0.15)


def test_deviation_of_frame_blur_is_honest():
    errors = []
    for seed, scene in enumerate(2 * list(SCENES.values())):
        rng = np.random.default_rng(seed)
        image, sigma = scene(144), rng.uniform(0.8, 2.0, 30)
        found = frame_blur(np.stack([blurred(image, s, rng) for s in sigma]), 0.01)
        true = (sigma**2 - np.mean(sigma**2))[:, None, None]
        errors.append(((found.relative - true) / found.deviation).ravel())
    assert 0.6 < np.mean(np.concatenate(errors) ** 2) < 1.6


def test_frame_blur_of_equal_frames_draws_to_nothing():
    rng = np.random.default_rng(0)
    found = frame_blur(np.stack([blurred(SCENES["camera"](96), 1.0, rng) for _ in range(20)]), 0.01)
    assert found.relative.mean(axis=0) == pytest.approx(0, abs=1e-5)
    assert np.median(found.extra) < 0.05
    assert (found.extra >= 0).all()


def test_noise_alone_makes_no_frame_sharper():
    noise = np.random.default_rng(0).normal(0.5, 0.05, (20, 96, 96)).astype(np.float32)
    found = frame_blur(noise, 0.05)
    assert np.ptp(found.relative) > 0.3
    assert np.quantile(found.extra, 0.9) < 0.05


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 7), st.floats(0.01, 1e3), st.floats(0.01, 1.0), st.integers(0, 1000))
def test_weights_are_those_of_a_general_solver(count, energy, noise, seed):
    s = np.random.default_rng(seed).exponential(1.0, count)
    s -= s.min()
    scale = energy / 4 * s.max() ** 2 + noise**2

    def cost(w):
        return (energy / 4 * (w @ s) ** 2 + noise**2 * (w @ w)) / scale

    weights = fusion_weights(s, np.array(energy), noise).astype(float)
    assert weights.sum() == pytest.approx(1, abs=1e-4)
    assert weights.min() >= 0
    total = {"type": "eq", "fun": lambda w: w.sum() - 1}
    best = minimize(cost, np.full(count, 1 / count), bounds=[(0, 1)] * count, constraints=total, method="SLSQP")
    assert cost(weights) <= best.fun * (1 + 1e-3) + 1e-7


def test_limits_of_the_weights():
    s = np.array([0.0, 1.0, 2.0])
    assert fusion_weights(s, np.array(0.0), 0.1) == pytest.approx(np.full(3, 1 / 3), abs=1e-4)
    assert fusion_weights(s, np.array(1.0), 0.0) == pytest.approx(np.array([1.0, 0.0, 0.0]), abs=1e-4)
    assert fusion_weights(np.zeros(3), np.array(1.0), 0.0) == pytest.approx(np.full(3, 1 / 3))


def test_weights_from_blur_beat_mean_and_inverse_variance(varied):
    scene, frames, variance = varied
    blur = frame_blur(frames, 0.01)
    mean = frames.mean(axis=0)
    energy = laplacian_energy(mean, 0.01 / np.sqrt(len(frames)))
    extra = np.stack([tile_map(tile, blur.grid) for tile in blur.extra])
    inverse = 1 / (energy / 4 * extra**2 + 0.01**2)
    known = fusion_weights(variance - variance.min(axis=0), energy, 0.01)
    fused = fuse_frames(frames, fusion_rule(blur, energy, 0.01))
    plain, by_variance, by_blur, by_truth = (
        psnr(image[8:-8, 8:-8].astype(np.float32), scene[8:-8, 8:-8])
        for image in (mean, (inverse * frames).sum(0) / inverse.sum(0), fused, (known * frames).sum(0))
    )
    assert by_blur > by_variance + 1 > plain + 2
    assert by_blur > plain + 3
    assert by_blur > by_truth - 1


def test_rule_and_weights_agree(varied):
    _, frames, _ = varied
    blur = frame_blur(frames, 0.01)
    energy = laplacian_energy(frames.mean(axis=0))
    rule = fusion_rule(blur, energy, 0.01)
    shares = np.stack([frame_weight(rule, index) for index in range(len(frames))])
    extra = np.stack([tile_map(tile, blur.grid) for tile in blur.extra])
    assert np.abs(shares - fusion_weights(extra, energy, 0.01)).max() < 1e-5
    assert np.abs(shares.sum(axis=0) - 1).max() < 1e-4
    factors = np.stack([frame_noise_factor(rule, index, largest=1e6) for index in range(len(frames))])
    assert np.abs((1 / factors).mean(axis=0) - 1).max() < 1e-3
    assert frame_noise_factor(rule, 0, largest=2.0).max() <= 2.0


def test_colour_is_fused_as_grey_is(varied):
    _, frames, _ = varied
    rule = fusion_rule(frame_blur(frames, 0.01), laplacian_energy(frames[0]), 0.01)
    grey = fuse_frames(frames, rule)
    assert np.abs(fuse_frames(np.stack([frames] * 3, axis=-1), rule) - grey[..., None]).max() < 1e-6


def test_laplacian_energy_of_noise_is_nothing_and_of_blur_its_error():
    rng = np.random.default_rng(0)
    noise = rng.normal(0.5, 0.05, (128, 128)).astype(np.float32)
    assert laplacian_energy(noise, 0.05).mean() < 0.1 * laplacian_energy(noise).mean()
    scene = cv2.GaussianBlur(SCENES["camera"](128), (0, 0), 2.0)
    error = np.mean((cv2.GaussianBlur(scene, (0, 0), 0.7) - scene)[8:-8, 8:-8] ** 2)
    assert 0.49**2 / 4 * laplacian_energy(scene)[8:-8, 8:-8].mean() == pytest.approx(error, rel=0.25)


def test_tile_map_keeps_planes_between_the_centres():
    rows, columns = np.array([0, 8, 16]), np.array([0, 8])
    grid = TileGrid(rows, columns, (16, 16), (32, 24))
    plane = (rows[:, None] + 7.5) * 2 + (columns + 7.5)
    y, x = np.mgrid[8:23, 8:15]
    assert tile_map(plane, grid)[8:23, 8:15] == pytest.approx(2 * y + x, abs=1e-3)


@pytest.mark.parametrize(
    "settings_", [{"tile": 8}, {"tile": 20.5}, {"lowest": 1}, {"highest": 0.6}, {"misfit": 0}, {"departure": -1}]
)
def test_settings_are_checked(settings_):
    with pytest.raises(ConfigurationError, match=next(iter(settings_))):
        CueParams(**settings_)


def test_bad_input_is_named():
    image = np.zeros((32, 32), np.float32)
    grid = TileGrid(np.array([0]), np.array([0]), (32, 32), (32, 32))
    blur = FrameBlur(*(np.zeros((2, 1, 1), np.float32) for _ in range(3)), grid)
    with pytest.raises(DataError, match="second"):
        relative_blur(image, image[1:], 0.01)
    with pytest.raises(DataError, match="16 pixels"):
        relative_blur(image[:8], image[:8], 0.01)
    with pytest.raises(ConfigurationError, match="noise"):
        relative_blur(image, image, (0.01, -1.0))
    with pytest.raises(DataError, match="at least 2 frames"):
        frame_blur(image[None], 0.01)
    with pytest.raises(ConfigurationError, match="noise"):
        frame_blur(np.stack([image, image]), np.nan)
    with pytest.raises(DataError, match="at least 2 frames"):
        displacement_variance(image[None], 0.01)
    with pytest.raises(DataError, match="energy"):
        fusion_weights(np.zeros((2, 3)), np.zeros(4), 0.1)
    with pytest.raises(DataError, match="0 or more"):
        fusion_weights(np.array([-1.0, 1.0]), np.array(1.0), 0.1)
    with pytest.raises(DataError, match="energy"):
        fusion_rule(blur, np.zeros((31, 32)), 0.1)
    with pytest.raises(DataError, match="frames"):
        fuse_frames(np.zeros((3, 32, 32)), fusion_rule(blur, image, 0.1))
    with pytest.raises(DataError, match=r"frames: expected the size \(32, 32\) of the reference"):
        blur_against(image[None, :, :31], refer_blur(np.stack([image, image]), 0.01)[0])
    with pytest.raises(ConfigurationError, match="largest"):
        frame_noise_factor(fusion_rule(blur, image, 0.1), 0, largest=0.5)


def test_frames_one_by_one_against_their_reference_are_judged_as_together(varied):
    _, frames, _ = varied
    reference, together = refer_blur(frames, 0.01)
    assert (together.extra == frame_blur(frames, 0.01).extra).all()
    for index in (0, 7, 39):
        alone = blur_against(frames[index : index + 1], reference)
        for name in ("relative", "deviation", "extra"):
            assert getattr(alone, name)[0] == pytest.approx(getattr(together, name)[index], abs=1e-5)


@pytest.mark.parametrize("scene", SCENES)
def test_frames_that_the_reference_has_not_seen_are_judged_by_their_blur(scene):
    image, rng = SCENES[scene](144), np.random.default_rng(0)
    reference, _ = refer_blur(np.stack([blurred(image, sigma, rng) for sigma in 4 * [0.8, 1.2, 1.6]]), 0.01)
    for sigma, noise in ((1.0, 0.01), (1.4, 0.01), (1.8, 0.01), (1.4, 0.002), (1.4, 0.04)):
        found = blur_against(blurred(image, sigma, rng, noise)[None], reference, noise)
        seen = found.deviation < 0.3
        assert seen.sum() > 5
        # The error of a tile, and nothing that all tiles share beyond the sharpest frame being a little off.
        assert np.median(found.extra[seen]) == pytest.approx(sigma**2 - 0.8**2, rel=0.1, abs=0.1)
    assert blur_against(blurred(image, 0.6, rng)[None], reference).extra.min() == 0


def test_a_blurry_newcomer_is_trusted_least(varied):
    scene, frames, _ = varied
    reference, blur = refer_blur(frames, 0.01)
    rule = fusion_rule(blur, laplacian_energy(frames.mean(axis=0), 0.002), 0.01)
    assert (noise_factor(rule, blur.extra[3]) == frame_noise_factor(rule, 3)).all()
    newcomer = blurred(scene, 4.0, np.random.default_rng(1))
    factor = noise_factor(rule, blur_against(newcomer[None], reference).extra[0], largest=50.0)
    known = np.stack([frame_noise_factor(rule, index, largest=50.0) for index in range(len(frames))])
    assert (factor >= np.median(known, axis=0)).mean() > 0.95
    assert np.mean(factor == 50.0) > 0.5
