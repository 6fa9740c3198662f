"""Recentring: the mean warp of the frames is found and undone, and nothing else of the image changes."""

import cv2
import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.dynamics.dynamic_texture import identify
from turbrestore.filtering.alternating import filter_frames
from turbrestore.pipeline import restore
from turbrestore.registration.flow import estimate_flow
from turbrestore.registration.flow_algebra import compose_flows
from turbrestore.registration.recentring import recentre, recentring_flow
from turbrestore.registration.warp import warp
from turbrestore.settings import RestoreParams

SIDE = 96


@pytest.fixture
def rng():
    return np.random.default_rng(36)


def smooth_flow(rng, length, sigma=12):
    """Random flow of a root mean square length."""
    flow = np.stack([cv2.GaussianBlur(rng.normal(size=(SIDE, SIDE)), (0, 0), sigma) for _ in range(2)], axis=-1)
    return np.float32(flow * length / np.sqrt(2 * np.mean(flow**2)))


def length(flow):
    """Root mean square, without the border, where samples are repeated."""
    return np.sqrt(2 * np.mean(flow[8:-8, 8:-8] ** 2))


def test_flows_from_the_recentred_image_average_to_zero(rng):
    flows = [smooth_flow(rng, 1.0) + smooth_flow(rng, 0.3) for _ in range(5)]
    inverse = recentring_flow(np.mean(flows, axis=0))
    after = np.mean([compose_flows(flow, inverse) for flow in flows], axis=0)
    assert length(after) < 0.01
    assert length(np.mean(flows, axis=0)) > 0.2


def textured_frames(rng):
    """Scene with texture everywhere, and frames whose flows come in pairs that average to zero."""
    noise = cv2.GaussianBlur(rng.normal(size=(SIDE, SIDE)), (0, 0), 1.5)
    scene = np.float32(0.5 + 0.15 * noise / noise.std())
    flows = [sign * flow for flow in (smooth_flow(rng, 1.0) for _ in range(6)) for sign in (1, -1)]
    return scene, np.stack([warp(scene, flow) for flow in flows])


def test_a_known_mean_warp_is_found_and_undone(rng):
    """The filter starts from a bent image; the scene lies where the frames are on average."""
    scene, frames = textured_frames(rng)
    bent = warp(scene, smooth_flow(rng, 0.6))
    filtered = filter_frames(frames, bent, identify(estimate_flow(bent, frames)))
    recentred = filtered.recentred()
    assert length(filtered.mean_flow) > 0.4
    assert length(estimate_flow(recentred.image, scene[None])[0]) < 0.05
    # The flow that is measured to fine texture has a bias, wherever the image lies.
    assert length(estimate_flow(recentred.image, frames).mean(axis=0)) < 0.08
    assert (recentred.variance > 0).all()


def test_where_all_frames_train_the_image_stays(rng):
    """What is left of the mean flow then is the bias of the flow method."""
    _, frames = textured_frames(rng)
    restoration = restore(frames.clip(0, 1), RestoreParams(train=len(frames), until="filter"))
    assert not restoration.filtered.mean_flow.any()
    assert restoration.filtered.recentred() is restoration.filtered


def test_without_a_mean_flow_nothing_changes(rng):
    image = rng.random((24, 32, 3), np.float32)
    np.testing.assert_allclose(recentre(image, np.zeros((24, 32, 2), np.float32)), image, atol=1e-6)


def test_contrast_and_brightness_are_kept(rng):
    scene = cv2.GaussianBlur(rng.random((SIDE, SIDE), np.float32), (0, 0), 1.5)
    moved = recentre(scene, smooth_flow(rng, 0.5))
    inside = slice(8, -8), slice(8, -8)
    assert moved[inside].mean() == pytest.approx(scene[inside].mean(), rel=5e-3)
    assert moved[inside].std() == pytest.approx(scene[inside].std(), rel=2e-2)


def test_the_shift_of_a_moving_camera_is_left(rng):
    bend = smooth_flow(rng, 0.4)
    bend -= np.median(bend.reshape(-1, 2), axis=0)
    followed = recentring_flow(bend + np.float32([5, -3]))
    np.testing.assert_allclose(followed, recentring_flow(bend), atol=1e-3)


def test_a_restoration_is_at_the_mean_geometry_of_all_frames(rng):
    """The first half of the clip, which trains, is bent against the second."""
    scene, frames = textured_frames(rng)
    bend = smooth_flow(rng, 0.8)
    frames = np.concatenate([[warp(frame, sign * bend) for frame in frames] for sign in (1, -1)]).clip(0, 1)
    restoration = restore(frames, RestoreParams(train=12, until="filter"))
    before = estimate_flow(restoration.centroid.image, scene[None])[0]
    assert length(before) > 0.4
    assert length(estimate_flow(restoration.image, scene[None])[0]) < 0.08
    [decision] = [one for one in restoration.decisions if one.subject == "geometry"]
    assert decision.choice.startswith("moved by 0.")


@pytest.mark.parametrize("flow", [np.zeros((2, 4, 4, 2)), np.full((4, 4, 2), np.nan), np.zeros((4, 4))])
def test_bad_flows_are_refused(flow):
    with pytest.raises(DataError):
        recentring_flow(flow)
