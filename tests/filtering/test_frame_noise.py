import cv2
import numpy as np
import pytest

from turbrestore.core.noise_spectrum import RINGS, NoiseSpectrum
from turbrestore.filtering.frame_noise import (
    SHARPNESS_WINDOW,
    frame_noise_variance,
    invalid_mask,
    local_sharpness,
    project_gradient,
)
from turbrestore.filtering.frame_statistics import _coloured, measure_frame_statistics
from turbrestore.registration.warp import inside

SHAPE = (200, 210)
INSIDE = np.s_[16:-16, 16:-16]


def smooth(image, window):
    return cv2.GaussianBlur(image, (0, 0), window)


def gradient(image):
    padded = np.pad(image.astype(np.float64), 1, mode="reflect")
    across = (padded[:, 2:] - padded[:, :-2]) / 8
    down = (padded[2:] - padded[:-2]) / 8
    return (across[:-2] + 2 * across[1:-1] + across[2:], down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:])


@pytest.fixture(scope="module")
def model_and_frames():
    rng = np.random.default_rng(0)
    scene = 0.5 + 0.5 * smooth(rng.normal(0, 1, SHAPE).astype(np.float32), 1.5)
    frames = [smooth(scene, 0.5 + k / 8) + rng.normal(0, 0.01, SHAPE).astype(np.float32) for k in range(8)]
    still = np.zeros((8, *SHAPE, 2), np.float32)
    return measure_frame_statistics(frames, still, scene), scene, frames


def noise_of(frame, flow, statistics, sharpness_weight):
    return frame_noise_variance(frame, flow, inside(flow), statistics, sharpness_weight)


def test_the_noise_is_that_of_its_definition(model_and_frames):
    model, scene, frames = model_and_frames
    frame = frames[2].copy()
    frame[95:110, 60:75] += 0.4
    flow = smooth(np.random.default_rng(1).normal(0, 9, (*SHAPE, 2)).astype(np.float32), 6.0)
    ux, uy = gradient(flow[..., 0])
    vx, vy = gradient(flow[..., 1])
    assert np.min((1 + ux) * (1 + vy) - uy * vx) > 0
    noise, sharp = noise_of(frame, flow, model, sharpness_weight=1.5)

    product = sum(a * b for a, b in zip(gradient(frame), gradient(scene), strict=True))
    energy = sum(a**2 for a in gradient(scene))
    assert sharp == pytest.approx(product.sum() / energy.sum(), rel=1e-3)
    score = np.clip(model.score_scale * (smooth(product, SHARPNESS_WINDOW) - model.mean_sharpness), -3, 3)
    excess = smooth(np.square(frame - model.mean_frame), 3.0) / model.deviation / 6
    difference = frame - model.median
    small = smooth(np.square(difference - smooth(difference, 5.0)), 0.8) / model.spread / 8
    assert excess.max() > 3
    assert (small > np.maximum(excess, 1)).any()
    excess = np.maximum(np.maximum(excess, small), 1)
    score = np.where(score > 0, score / excess**2, score)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    seen = 1.0
    for place, last in ((x + flow[..., 0], SHAPE[1] - 1), (y + flow[..., 1], SHAPE[0] - 1)):
        seen = seen * np.clip(1 - np.maximum(-place, place - last), 0, 1)
    expected = model.image_noise * np.exp(1.5**2 * model.score_variance / 2 - 1.5 * score) * excess**3
    assert noise == pytest.approx(expected * 1000 ** (1 - seen), rel=2e-2)
    assert np.median(np.abs(noise / (expected * 1000 ** (1 - seen)) - 1)) < 1e-3


@pytest.mark.parametrize("row", [1, 77, 100, SHAPE[0] - 3])
def test_a_fold_is_found_wherever_it_is(model_and_frames, row):
    model, _, frames = model_and_frames
    calm, _ = noise_of(frames[4], np.zeros((*SHAPE, 2), np.float32), model, sharpness_weight=1.0)
    flow = np.zeros((*SHAPE, 2), np.float32)
    # Rows above come to lie below those underneath.
    flow[row, 100:120, 1], flow[row + 1, 100:120, 1] = 3.0, -3.0
    torn, _ = noise_of(frames[4], flow, model, sharpness_weight=1.0)
    assert torn[row, 110] > 500 * calm[row, 110]
    assert torn[row, 40] == pytest.approx(calm[row, 40], rel=1e-4)


def test_the_flow_is_invalid_where_the_jacobian_vanishes_and_around_it():
    """Against gradients in double precision, a dilation and a Gaussian of OpenCV."""
    flow = smooth(np.random.default_rng(3).normal(0, 20.0, (60, 50, 2)).astype(np.float32), 2.0)
    (ux, uy), (vx, vy) = gradient(flow[..., 0]), gradient(flow[..., 1])
    folded = ((1 + ux) * (1 + vy) <= uy * vx).astype(np.uint8)
    assert 0 < folded.sum() < folded.size
    expected = smooth(cv2.dilate(folded, np.ones((7, 7), np.uint8)).astype(np.float32), 2.0)
    seen = inside(flow)
    assert invalid_mask(flow, seen) == pytest.approx(np.maximum(expected, 1 - seen), abs=1e-5)
    assert (invalid_mask(0 * flow, seen) == 1 - seen).all()


def test_what_holds_for_all_frames_is_their_mean_and_variance(model_and_frames):
    model, scene, frames = model_and_frames
    stack, slopes = np.array(frames, np.float64), gradient(scene)
    products = [sum(a * b for a, b in zip(gradient(frame), slopes, strict=True)) for frame in frames]
    seen = np.array([smooth(product, SHARPNESS_WINDOW) for product in products])
    assert model.image_noise == pytest.approx(stack.var(axis=0, ddof=1).mean(), rel=1e-4)
    # Nothing deviates from the rest.
    assert model.mean_frame == pytest.approx(stack.mean(axis=0), abs=1e-5)
    assert model.mean_sharpness == pytest.approx(seen.mean(axis=0), abs=1e-3 * seen.mean())
    assert model.score_variance == pytest.approx(model.score_scale**2 * seen.var(axis=0), rel=1e-2, abs=1e-3)
    spread = smooth(stack.var(axis=0).astype(np.float32), 3.0) + 0.1 * stack.var(axis=0, ddof=1).mean()
    assert np.median(np.abs(model.deviation / spread - 1)) < 0.02


def noisy_statistics(scene, blurs, noise):
    rng = np.random.default_rng(1)
    frames = [smooth(scene, 1 + blur) + rng.normal(0, noise, SHAPE).astype(np.float32) for blur in blurs]
    still = np.zeros((len(frames), *SHAPE, 2), np.float32)
    return frames, measure_frame_statistics(frames, still, smooth(scene, 1.0))


def test_noise_alone_gives_no_sharpness(model_and_frames):
    """The variance of the score that noise explains is all that there is where the blur does not change."""
    _, scene, _ = model_and_frames
    _, model = noisy_statistics(scene, np.zeros(60), 0.1)
    assert model.left_out > 0.2
    assert model.score_variance[INSIDE].mean() < 0.15


def test_the_part_of_the_score_that_is_sharpness_falls_with_the_noise(model_and_frames):
    _, scene, _ = model_and_frames
    blurs = np.tile([0.0, 0.2, 0.4], 8)
    models = [noisy_statistics(scene, blurs, noise)[1] for noise in (0.005, 0.1, 0.4)]
    variances = [model.score_variance[INSIDE].mean() for model in models]
    assert variances[0] > variances[1] > variances[2]
    assert models[0].left_out == 0.0 < models[1].left_out < models[2].left_out <= 0.25


def test_the_score_hardly_knows_the_noise_of_its_own_pixel(model_and_frames):
    """By Stein's lemma the weights shift a fused pixel by the covariance of its noise with its score."""
    model, scene, _ = model_and_frames
    laplacian, rng, shifts = cv2.Laplacian(scene, cv2.CV_32F), np.random.default_rng(1), np.zeros(2)
    for _ in range(20):
        noise = rng.normal(0, 1, SHAPE).astype(np.float32)
        projection = project_gradient(noise, model.template)
        scores = [local_sharpness(projection, left_out) for left_out in (0.0, 0.25)]
        shifts += [-float((noise * score * laplacian)[INSIDE].sum()) for score in scores]
    assert 0 < shifts[1] < 0.4 * shifts[0]


def test_where_no_noise_is_certain_it_is_taken_for_white(model_and_frames):
    template, power = model_and_frames[0].template, np.full(RINGS.size, 1e-4)
    error = np.where(RINGS < 0.3, power, 0.05 * power)
    guessed = _coloured(template, NoiseSpectrum(power, error, np.zeros(RINGS.size)))
    np.testing.assert_allclose(guessed, template, atol=0.02 * np.abs(template).max())
    # What is certain counts: noise without high frequencies has more power at the low ones, where the template is.
    smooth_noise = NoiseSpectrum(1e-4 * np.exp(-((8 * RINGS) ** 2)), np.zeros(RINGS.size), np.zeros(RINGS.size))
    assert np.square(_coloured(template, smooth_noise)).mean() > 1.5 * np.square(template).mean()


def test_flat_ground_without_noise_has_finite_statistics():
    y, x = np.mgrid[:64, :64] - 31.5
    scene = np.exp(-(x**2 + y**2) / 10).astype(np.float32)
    frames = [scene * np.float32(1 + 0.1 * n) for n in range(6)]
    with np.errstate(all="raise", under="ignore"):
        found = measure_frame_statistics(frames, [np.zeros((64, 64, 2), np.float32)] * 6, scene)
    assert np.isfinite(found.score_scale).all() and np.isfinite(found.score_variance).all()
