"""Methods of others: what their equations promise, on tiny clips."""

import numpy as np
import pytest
from methods.diffeomorphic import template
from methods.low_rank import decompose, low_rank_image
from methods.sobolev import SobolevParams, latent_image, sobolev_flow, sobolev_latent_image

from conftest import make_sequence
from turbrestore.metrics import compare

METHODS = {"sobolev": sobolev_latent_image, "low rank": low_rank_image, "template": template}


@pytest.fixture(scope="module")
def clip():
    return make_sequence(3, 12, 96, "camera", blur=1.0, noise=0.008, rms=1.5)


@pytest.mark.parametrize("name", METHODS)
class TestEveryMethod:
    def test_is_not_worse_than_the_mean(self, name, clip):
        image = METHODS[name](clip.frames)
        assert image.shape == clip.scene.shape
        assert image.dtype == np.float32
        assert compare(image, clip.scene).psnr > compare(clip.frames.mean(axis=0), clip.scene).psnr

    def test_keeps_the_shape_of_colour_frames(self, name, clip):
        colour = np.stack([clip.frames[:4, :48, :64]] * 3, axis=-1)
        image = METHODS[name](colour)
        assert image.shape == (48, 64, 3)
        assert np.ptp(image, axis=-1).max() < 1e-3

    def test_does_not_move_a_scene_at_rest(self, name, clip):
        still = np.repeat(clip.scene[None], 5, axis=0)
        if name == "sobolev":
            image = latent_image(sobolev_flow(still, SobolevParams(sharpening=1.0)))
        else:
            image = METHODS[name](still)
        assert np.abs(image - clip.scene)[8:-8, 8:-8].max() < 0.02


class TestSobolevFlow:
    def test_without_sharpening_it_diffuses_in_time_alone(self):
        # Frames that differ by a constant keep their gradients, which is all that α = 1 asks for.
        frames = np.repeat(np.array([0.0, 0.0, 1.0, 0.0, 0.0], np.float32)[:, None, None], 32, axis=1)
        frames = np.repeat(frames, 32, axis=2) + np.tile([0.2, 0.4], 16).astype(np.float32)
        diffused = sobolev_flow(frames, SobolevParams(steps=1, sharpening=1.0))[:, 16, 16]
        # (1 − ∂²) v = u with reflected ends.
        second = np.diff(np.pad(diffused, 1, mode="edge"), n=2)
        np.testing.assert_allclose(diffused - second, frames[:, 16, 16], atol=1e-5)

    def test_the_gradient_approaches_the_ratio_that_is_asked_for(self, clip):
        def energy(frames):
            return sum(np.mean(np.diff(frames, axis=axis) ** 2) for axis in (1, 2))

        still = np.repeat(clip.scene[None], 3, axis=0)
        sharpened = sobolev_flow(still, SobolevParams(sharpening=2.0, steps=60, time_step=0.3))
        assert energy(sharpened) / energy(still) == pytest.approx(2.0, abs=0.1)


class TestLowRank:
    def test_the_three_parts_are_told_apart_and_sum_up(self):
        rng = np.random.default_rng(0)
        background = np.outer(rng.uniform(0.2, 0.8, 900), np.ones(20)).astype(np.float32)
        objects = np.zeros_like(background)
        for frame in range(20):
            objects[40 * frame : 40 * frame + 20, frame] = 0.5
        frames = background + objects + rng.normal(0, 0.01, background.shape).astype(np.float32)
        a, o, e = decompose(frames)
        np.testing.assert_allclose(a + o + e, frames, atol=2e-3)
        assert np.abs(a - background).mean() < 0.01
        assert o[objects > 0].min() > 0.3
        assert np.abs(o[objects == 0]).mean() < 0.01


class TestTemplate:
    def test_the_geometry_is_that_of_the_mean_not_of_the_reference(self, clip):
        moved = np.roll(clip.scene, 3, axis=1)
        frames = np.stack([moved, clip.scene, np.roll(clip.scene, -3, axis=1)])
        image = template(frames)
        inside = np.s_[16:-16, 16:-16]
        assert np.abs(image - clip.scene)[inside].mean() < 0.3 * np.abs(moved - clip.scene)[inside].mean()
