"""Structure that the frames lack: waves on water, and what is none."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import make_sequence
from turbrestore.metrics import compare
from turbrestore.pipeline import restore
from turbrestore.synthesis.scenes import SCENES
from turbrestore.verification.structure import LASTING, LEFT, UNSEEN, StructureReading, compare_structure
from turbrestore.wording import explain_structure

SIDE = 112


def under_waves(scene, count=24, seed=0):
    """Frames of a scene under waves that refract it and whose crests shine."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: scene.shape[0], : scene.shape[1]].astype(np.float32)
    lengths, angles, phases = rng.uniform(15, 50, 12), rng.normal(0.5, 0.5, 12), rng.uniform(0, 2 * np.pi, 12)
    frames = []
    for time in range(count):
        slope, curvature = np.zeros((2, *scene.shape), np.float32), np.zeros(scene.shape, np.float32)
        for length, angle, phase in zip(lengths, angles, phases, strict=True):
            wave = 2 * np.pi / length * np.array([np.cos(angle), np.sin(angle)])
            argument = wave[0] * x + wave[1] * y - 1.6 * time * np.hypot(*wave) ** 0.5 + phase
            slope += length * wave[:, None, None] * np.cos(argument)
            curvature -= length * (wave @ wave) * np.sin(argument)
        slope, curvature = 2 * slope / slope[0].std(), curvature / curvature.std()
        seen = cv2.remap(scene, x + slope[0], y + slope[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        seen = seen * (1 + 0.25 * np.clip(curvature, -1, 1)) + 0.25 * np.clip(-curvature - 1, 0, 2)
        frames.append(np.clip(seen + 0.008 * rng.standard_normal(seen.shape), 0, 1))
    return np.array(frames, np.float32)


# Of seeds 0 to 5, 2 has the fewest unseen edges in the photograph; registration bends a row of bricks into the next.
@pytest.mark.parametrize(("scene", "seed"), [("camera", 0), ("camera", 2), ("brick", 0)])
def test_where_the_image_keeps_waves_the_mean_is_the_result(scene, seed):
    rock = cv2.GaussianBlur(SCENES[scene](SIDE, SIDE), (0, 0), 1.2) * 0.5 + 0.2
    found = restore(under_waves(rock, seed=seed))
    x, y, width, height = found.crop
    np.testing.assert_array_equal(found.image, found.mean[y : y + height, x : x + width])
    assert compare(found.mean, rock).psnr > compare(found.filtered.image, rock).psnr + 3
    assert "structure" in {decision.subject for decision in found.decisions}
    assert found.deconvolution is None and np.isinf(found.uncertainty).all()


@pytest.mark.parametrize("scene", ["camera", "chart"])
def test_turbulence_adds_no_structure(scene):
    clip = make_sequence(3, 12, SIDE, scene, blur=1.0, noise=0.01)
    found = restore(clip.frames)
    assert "structure" not in {decision.subject for decision in found.decisions}


def test_an_edge_counts_as_unseen_where_fewer_than_half_of_the_frames_have_it():
    y, x = np.mgrid[:64, :64]
    scene, passing = (np.float32(0.4) * (axis >= 32) for axis in (x, y))
    still = np.zeros((8, 64, 64, 2), np.float32)
    for having, expected in ((5, 0.0), (2, 0.5)):
        frames = np.stack([scene + passing * (number < having) for number in range(8)])
        assert compare_structure(scene + passing, frames, still).unseen == pytest.approx(expected, abs=0.1)


def test_a_shaken_camera_is_explained_by_its_shifts():
    large = SCENES["camera"](160, 160)
    shifts = np.random.default_rng(0).integers(0, 40, (9, 2))
    frames = np.stack([large[y : y + 120, x : x + 120] for x, y in shifts])
    flows = np.broadcast_to((20 - shifts)[:, None, None].astype(np.float32), (*frames.shape, 2))
    reading = compare_structure(large[20:140, 20:140], frames, flows)
    assert reading.unseen < 0.01 and reading.left < 0.01 and reading.explained
    assert not compare_structure(large[20:140, 20:140], frames, 0 * flows).explained


def test_more_unseen_edges_are_allowed_the_less_registration_leaves():
    at = StructureReading
    for explained in (at(0.9 * UNSEEN, 1.0), at(1.9 * UNSEEN, LEFT / 2), at(1.0, 0.0)):
        assert explained.explained and explain_structure(explained) == ()
    for unexplained in (at(1.1 * UNSEEN, LEFT), at(2.1 * UNSEEN, LEFT / 2), at(2.1 * UNSEEN, LEFT / 2, 2 * LASTING)):
        assert not unexplained.explained
        (decision,) = explain_structure(unexplained)
        assert decision.subject == "structure" and "edges" in decision.reason


def test_a_scene_that_changes_is_named_and_the_mean_is_the_result_where_registration_explains_little():
    steady, changing = StructureReading(0.0, 1.0, LASTING / 2), StructureReading(0.0, 1.0, 2 * LASTING)
    assert steady.explained and not changing.explained
    (decision,) = explain_structure(changing)
    assert decision.subject == "structure" and "changes" in decision.reason
    (decision,) = explain_structure(StructureReading(0.0, LEFT / 2, 2 * LASTING))
    assert decision.choice == "no blur is removed"


def test_noise_does_not_count_as_what_registration_leaves():
    rng = np.random.default_rng(2)
    scene = cv2.GaussianBlur(SCENES["camera"](SIDE, SIDE), (0, 0), 1.0)
    shifts = rng.integers(-3, 4, (16, 2))
    clean = np.stack([np.roll(scene, shift, axis=(0, 1)) for shift in shifts])
    frames = np.float32(clean + rng.normal(0, 0.1, clean.shape))
    flows = np.broadcast_to(shifts[:, None, None, ::-1].astype(np.float32), (*frames.shape, 2))
    assert compare_structure(scene, frames, flows).left > LEFT
    assert compare_structure(scene, frames, flows, noise=0.01).left < LEFT / 3


@given(gain=st.floats(0.05, 1), offset=st.floats(-0.2, 0.2))
@settings(deadline=None, max_examples=10)
def test_the_reading_depends_on_neither_gain_nor_offset(gain, offset):
    clip = make_sequence(3, 5, 64, "camera", blur=1.0, noise=0.01)
    image, still = clip.frames.mean(axis=0), np.zeros((*clip.frames.shape, 2), np.float32)
    first = compare_structure(image, clip.frames, still)
    second = compare_structure(gain * image + offset, gain * clip.frames + offset, still)
    assert second.unseen == pytest.approx(first.unseen, abs=0.01)
    assert second.left == pytest.approx(first.left, abs=0.01)
