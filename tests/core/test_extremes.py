"""Frames at the edge of what makes sense: the result is finite, and what was made of them is said."""

import cv2
import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from conftest import make_sequence
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.dynamics.dynamic_texture import DynamicsParams
from turbrestore.filtering.estimates import Gaussian, PixelStacks
from turbrestore.filtering.image_state import predict_image, update_image
from turbrestore.filtering.kalman import predict, update
from turbrestore.pipeline import RestoreParams, restore
from turbrestore.registration.centroid import CentroidParams

RNG = np.random.default_rng(0)
USUAL = make_sequence(seed=3, count=10, size=48, scene="camera", rms=0.6)


def still():
    return np.repeat(USUAL.scene[None], 6, axis=0)


def one_direction():
    return np.stack([np.roll(USUAL.scene, k % 2, axis=1) for k in range(8)])


def without_texture():
    frames = USUAL.frames.copy()
    frames[5] = 0.4
    return frames


def saturated():
    return np.clip(2.2 * USUAL.frames, 0, 1)


def white_frames():
    frames = USUAL.frames.copy()
    frames[[4, 7]] = 1
    return frames


def far():
    scene = cv2.GaussianBlur(RNG.uniform(size=(80, 80)).astype(np.float32), (0, 0), 1.5)
    return np.stack([scene[y : y + 48, x : x + 48] for x, y in RNG.integers(0, 32, (8, 2))])


CASES = {
    "two equal frames": (lambda: USUAL.frames[[0, 0]], "flow model", "the flows do not change over time: no states"),
    "no motion": (still, "flow model", "the flows do not change over time: no states"),
    "motion of rank one": (one_direction, "flow model", "1 state"),
    "fewer flows than states": (
        lambda: USUAL.frames[:4],
        "flow model",
        "8 states asked for, 3 independent flows found",
    ),
    "one frame without texture": (without_texture, "blank frames", "frame 5 left out"),
    "saturated parts": (saturated, "saturation", "left as it is"),
    "white frames": (white_frames, "blank frames", "frames 4, 7 left out"),
    "a camera that moves by a fifth of the image": (far, "camera", "followed over"),
    "16 by 16 pixels": (lambda: USUAL.frames[:6, 10:26, 10:26], "blur", "removed"),
}


@pytest.mark.parametrize("case", CASES)
def test_the_result_is_finite_and_what_was_done_is_said(case):
    make, subject, words = CASES[case]
    rank = 8 if case == "fewer flows than states" else None
    params = RestoreParams(
        centroid=CentroidParams(iterations=1),
        dynamics=DynamicsParams(rank=rank),
        deconvolution=DeconvolutionParams(method="wiener"),
    )
    frames = make()
    found = restore(frames, params)
    assert found.image.shape == frames.shape[1:]
    for array in (found.image, found.centroid.flows, found.filtered.variance, found.filtered.shares, found.dynamics.A):
        assert np.isfinite(array).all()
    assert (found.filtered.variance > 0).all()
    assert any(d.subject == subject and words in f"{d.choice} {d.reason}" for d in found.decisions), found.decisions


def test_ordinary_frames_give_no_cause_for_remarks():
    found = restore(USUAL.frames, RestoreParams(until="centroid"))
    assert [decision.subject for decision in found.decisions] == ["training", "centroid", "displacement", "border"]


SYSTEMS = st.tuples(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 0.5, 0.9, 0.9999, 1.0, 1.05]),
    st.lists(st.floats(-12, 0), min_size=3, max_size=3),
)


@given(system=SYSTEMS)
@example(system=(1, 1.0, [-12.0, -3.0, 0.0]))
@settings(max_examples=3, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.generate])
def test_covariances_stay_symmetric_and_positive(system):
    """Systems that forget, remember or grow; steps of very different noise, some unmeasured."""
    walk(*system, seen=0.7, steps=2000, every=100)


@pytest.mark.long
def test_covariances_stay_symmetric_and_positive_over_many_steps():
    # An update takes longer than a step, so few are measured.
    walk(1, 0.9999, [-12.0, -3.0, 0.0], seen=0.1, steps=20_000, every=200)


def walk(seed, radius, noises, seen, steps, every):
    """Filter one system of three states; its covariance is looked at again and again."""
    rng = np.random.default_rng(seed)
    n, m = 3, 6
    A = radius * np.linalg.qr(rng.normal(size=(n, n)))[0]
    C = np.linalg.qr(rng.normal(size=(m, n)))[0]
    Q = np.diag(10.0 ** np.array(noises))
    state = Gaussian(np.zeros(n), np.eye(n))
    measured = rng.uniform(size=steps) < seen
    values = rng.normal(size=(steps, m))
    for step, noise in enumerate(10.0 ** rng.uniform(-9, 4, steps)):
        state = predict(state, A, Q)
        if measured[step]:
            state = update(state, values[step], C, noise)
        assert (state.cov == state.cov.T).all()
        if step % every == every - 1:
            assert np.linalg.eigvalsh(state.cov).min() > 0, step
    assert np.isfinite(state.mean).all()


@pytest.mark.long
def test_pixel_variances_stay_positive_over_many_steps():
    rng = np.random.default_rng(2)
    state = PixelStacks(np.zeros((1, 2, 3), np.float32), np.ones((2, 3), np.float32))
    noises = (10.0 ** rng.uniform(-8, 8, (1000, 2, 3))).astype(np.float32)
    for step in range(20_000):
        state, gain = update_image(predict_image(state, 1e-9), state.mean, noises[step % 1000])
    assert (state.variance > 0).all()
    assert ((gain >= 0) & (gain <= 1)).all()
