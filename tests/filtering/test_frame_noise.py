import cv2
import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.filtering.frame_noise import judge_frame, measure_frame_noise
from turbrestore.registration.warp import strips

SHAPE = (200, 210)


def smooth(image, window):
    return cv2.GaussianBlur(image, (0, 0), window)


def gradient(image):
    padded = np.pad(image.astype(np.float64), 1, mode="reflect")
    across = (padded[:, 2:] - padded[:, :-2]) / 8
    down = (padded[2:] - padded[:-2]) / 8
    return (
        across[:-2] + 2 * across[1:-1] + across[2:],
        down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:],
    )


@pytest.fixture(scope="module")
def model_and_frames():
    rng = np.random.default_rng(0)
    scene = 0.5 + 0.5 * smooth(rng.normal(0, 1, SHAPE).astype(np.float32), 1.5)
    frames = [smooth(scene, 0.5 + k / 8) + rng.normal(0, 0.01, SHAPE).astype(np.float32) for k in range(8)]
    still = np.zeros((8, *SHAPE, 2), np.float32)
    return measure_frame_noise(frames, still, scene, np.ones(SHAPE, np.float32)), scene, frames


def test_the_noise_is_that_of_its_definition(model_and_frames):
    model, scene, frames = model_and_frames
    frame = frames[2].copy()
    frame[95:110, 60:75] += 0.4
    flow = smooth(np.random.default_rng(1).normal(0, 9, (*SHAPE, 2)).astype(np.float32), 6.0)
    ux, uy = gradient(flow[..., 0])
    vx, vy = gradient(flow[..., 1])
    assert np.min((1 + ux) * (1 + vy) - uy * vx) > 0
    noise, sharp = judge_frame(frame, flow, model, sharpness=1.5)

    product = sum(a * b for a, b in zip(gradient(frame), gradient(scene), strict=True))
    energy = sum(a**2 for a in gradient(scene))
    assert sharp == pytest.approx(product.sum() / energy.sum(), rel=1e-3)
    score = np.clip(model.score_scale * (smooth(product, model.window) - model.usual), -3, 3)
    excess = np.maximum(smooth(np.square(frame - model.usual_frame), 3.0) / model.deviation / 6, 1)
    assert excess.max() > 3
    score = np.where(score > 0, score / excess**2, score)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    seen = 1.0
    for place, last in ((x + flow[..., 0], SHAPE[1] - 1), (y + flow[..., 1], SHAPE[0] - 1)):
        seen = seen * np.clip(1 - np.maximum(-place, place - last), 0, 1)
    expected = model.image_noise * np.exp(1.5**2 * model.score_variance / 2 - 1.5 * score) * excess**3
    assert noise == pytest.approx(expected * 1000 ** (1 - seen), rel=2e-2)
    assert np.median(np.abs(noise / (expected * 1000 ** (1 - seen)) - 1)) < 1e-3


def test_a_fold_is_found_wherever_a_strip_ends(model_and_frames, monkeypatch):
    monkeypatch.setattr("turbrestore.registration.warp._STRIP", 16_000)
    model, _, frames = model_and_frames
    ends = [rows.stop for rows in strips(SHAPE)][:-1]
    assert ends
    calm, _ = judge_frame(frames[4], np.zeros((*SHAPE, 2), np.float32), model, sharpness=1.0)
    for row in (ends[0] - 1, ends[0], 100):
        flow = np.zeros((*SHAPE, 2), np.float32)
        # Rows above come to lie below those underneath.
        flow[row, 100:120, 1], flow[row + 1, 100:120, 1] = 3.0, -3.0
        torn, _ = judge_frame(frames[4], flow, model, sharpness=1.0)
        assert torn[row, 110] > 500 * calm[row, 110]
        assert torn[row, 40] == pytest.approx(calm[row, 40], rel=1e-4)


def test_what_holds_for_all_frames_is_their_mean_and_variance(model_and_frames):
    model, scene, frames = model_and_frames
    stack, slopes = np.array(frames, np.float64), gradient(scene)
    products = [sum(a * b for a, b in zip(gradient(frame), slopes, strict=True)) for frame in frames]
    seen = np.array([smooth(product, model.window) for product in products])
    assert model.image_noise == pytest.approx(stack.var(axis=0, ddof=1).mean(), rel=1e-4)
    # Nothing deviates from the rest.
    assert model.usual_frame == pytest.approx(stack.mean(axis=0), abs=1e-5)
    assert model.usual == pytest.approx(seen.mean(axis=0), abs=1e-3 * seen.mean())
    assert model.score_variance == pytest.approx(model.score_scale**2 * seen.var(axis=0), rel=1e-2, abs=1e-3)
    spread = smooth(stack.var(axis=0).astype(np.float32), 3.0) + 0.1 * stack.var(axis=0, ddof=1).mean()
    assert np.median(np.abs(model.deviation / spread - 1)) < 0.02


def test_residuals_of_another_shape_are_refused(model_and_frames):
    _, scene, frames = model_and_frames
    with pytest.raises(DataError, match=r"residual_variance: expected shape \(200, 210\), found \(200,\)"):
        measure_frame_noise(frames, np.zeros((8, *SHAPE, 2), np.float32), scene, np.ones(200, np.float32))


def test_what_holds_for_all_frames_does_not_depend_on_strips(model_and_frames, monkeypatch):
    model, scene, frames = model_and_frames
    monkeypatch.setattr("turbrestore.registration.warp._STRIP", 3_000)
    assert len(list(strips(SHAPE))) > 10
    still = np.zeros((8, *SHAPE, 2), np.float32)
    parts = measure_frame_noise(frames, still, scene, np.ones(SHAPE, np.float32), threads=2)
    assert parts.image_noise == model.image_noise
    for name in ("usual", "score_scale", "score_variance", "motion_share", "usual_frame", "deviation"):
        one, other = getattr(parts, name), getattr(model, name)
        assert one.dtype == np.float32
        assert np.array_equal(one, other)
        assert np.ptp(one) > 0


def test_colour_is_judged_by_its_luminance(model_and_frames):
    model, _, frames = model_and_frames
    flow = np.zeros((*SHAPE, 2), np.float32)
    grey, colour = (judge_frame(f, flow, model, 1.0) for f in (frames[3], np.dstack([frames[3]] * 3)))
    assert colour[0] == pytest.approx(grey[0], rel=1e-3)
    assert colour[1] == pytest.approx(grey[1], rel=1e-4)
