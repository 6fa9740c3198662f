import cv2
import numpy as np
import pytest
import skimage.data
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import DataError
from turbrestore.registration.camera.global_shift import global_shifts, measure_shift, overlap, prepare_shift_reference
from turbrestore.registration.camera.stabilisation import mean_stabilised
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

PHOTO = cv2.GaussianBlur(skimage.data.camera().astype(np.float32) / 255, (0, 0), 1.0)


def seen_from(dx, dy, side=256, noise=0.0, rng=None):
    """Frame that a reference cut at (128, 128) is shifted against by (dx, dy)."""
    frame = PHOTO[128 - dy : 128 - dy + side, 128 - dx : 128 - dx + side]
    return frame if rng is None else frame + rng.normal(0, noise, frame.shape).astype(np.float32)


@pytest.mark.parametrize("noise", [0.0, 0.03])
@pytest.mark.parametrize("shift", [(4, 3), (-12, 5), (20, -20), (-45, 30), (0, 60), (-60, 0)])
def test_shifts_are_found_by_the_sign_rule(shift, noise):
    rng = np.random.default_rng(0)
    found = measure_shift(
        seen_from(*shift, noise=noise, rng=rng), prepare_shift_reference(seen_from(0, 0, noise=noise, rng=rng))
    )
    assert found == pytest.approx(shift, abs=0.5)


def test_shifts_are_found_through_turbulence():
    rng = np.random.default_rng(1)
    flows = smooth_flows(6, 256, 256, rng, SmoothFlowParams(rms=2.0))
    reference = prepare_shift_reference(seen_from(0, 0))
    for flow, shift in zip(flows, [(30, 10), (-30, 10), (5, -40), (15, 0), (0, 15), (50, 20)], strict=True):
        frame = distort(seen_from(*shift), flow[None], rng, noise=0.02)[0]
        assert measure_shift(frame, reference) == pytest.approx(shift, abs=4.0)


@pytest.mark.parametrize("rms", [0.5, 1.5, 3.0])
def test_turbulence_alone_is_no_shift(rms):
    rng = np.random.default_rng(2)
    flows = smooth_flows(8, 256, 256, rng, SmoothFlowParams(rms=rms))
    flows -= flows.mean(axis=0)
    reference = prepare_shift_reference(seen_from(0, 0))
    found = [measure_shift(frame, reference) for frame in distort(seen_from(0, 0), flows, rng, noise=0.01)]
    assert (np.array(found) == 0).all()


def test_unlike_images_have_no_shift():
    a, b = np.random.default_rng(3).normal(0.5, 0.02, (2, 128, 128)).astype(np.float32)
    assert measure_shift(b, prepare_shift_reference(a)) is None
    flat = np.full((64, 64), 0.5, np.float32)
    assert measure_shift(flat, prepare_shift_reference(flat)) is None


def test_large_images_are_measured_on_reduced_ones():
    scene = cv2.resize(PHOTO, (1400, 1200))
    reference = prepare_shift_reference(scene[100:1060, 100:1300])
    assert max(reference.reduced.shape) <= 192
    found = measure_shift(scene[40:1000, 150:1350], reference)
    assert found == pytest.approx((-50, 60), abs=1.5)


def test_colour_is_measured_on_luminance():
    reference, frame = seen_from(0, 0), seen_from(20, 5)
    grey = measure_shift(frame, prepare_shift_reference(reference))
    colour = measure_shift(np.dstack([frame] * 3), prepare_shift_reference(np.dstack([reference] * 3)))
    assert colour == pytest.approx(grey, abs=1e-3)


def test_a_drift_past_the_middle_frame_is_followed():
    # The outermost frames have nothing in common with the middle one.
    starts = np.arange(0, 400, 20)
    frames = np.stack([PHOTO[100:200, x : x + 100] for x in starts])
    assert global_shifts(frames)[:, 0] == pytest.approx(starts.mean() - starts, abs=1.5)


def test_frames_within_the_dead_zone_are_averaged_as_they_are():
    frames = np.stack([seen_from(x, 0) for x in (-2, 0, 2)])
    assert (mean_stabilised(frames) == frames.mean(axis=0)).all()


def test_what_no_frame_saw_is_the_plain_mean():
    frames = np.stack([np.dstack([seen_from(x, x)] * 3) for x in (-30, 30)])
    before = frames.copy()
    mean = mean_stabilised(frames)
    # The first frame shows the lower right, the second the upper left; neither the other two corners.
    corner = slice(0, 25), slice(-25, None)
    assert np.allclose(mean[corner], frames.mean(axis=0)[corner], atol=1e-6)
    assert np.allclose(mean[40:-40, 40:-40, 1], seen_from(0, 0)[40:-40, 40:-40], atol=1e-6)
    assert (frames == before).all()


@given(st.integers(1, 9), st.integers(1, 9), st.integers(-12, 12), st.integers(-12, 12))
@settings(deadline=None)
def test_overlap_holds_the_same_pixels(height, width, dx, dy):
    y, x = np.mgrid[:height, :width]
    to, origin = overlap((height, width), (dx, dy))
    assert x[to].shape == x[origin].shape
    assert (x[to] + dx == x[origin]).all()
    assert (y[to] + dy == y[origin]).all()
    assert x[to].size == max(height - abs(dy), 0) * max(width - abs(dx), 0)


def test_other_sizes_are_refused():
    with pytest.raises(DataError, match="as the reference has"):
        measure_shift(np.zeros((32, 32)), prepare_shift_reference(np.zeros((32, 40))))
    with pytest.raises(DataError, match="frames: expected shape"):
        global_shifts(np.zeros((32, 32)))


@pytest.mark.parametrize("odd", [[20], [20, 21], [20, 21, 22], [15], [14, 15, 16], [0, 1], [28, 29]])
@pytest.mark.parametrize("what", ["black", "noise"])
def test_frames_of_something_else_mislead_no_other(odd, what):
    rng, steps = np.random.default_rng(8), 6 * np.arange(30)
    scene = cv2.GaussianBlur(rng.random((128, 340)).astype(np.float32), (0, 0), 2)
    frames = np.stack([scene[:, step : step + 128] for step in steps])
    frames[odd] = 0.0 if what == "black" else rng.random((len(odd), 128, 128))
    kept = np.setdiff1d(np.arange(30), odd)
    found = global_shifts(frames)[kept, 0]
    assert np.ptp(found + steps[kept]) < 1.0
    centre = round(float((steps[kept] + found).mean()))
    error = mean_stabilised(frames) - scene[:, centre : centre + 128]
    assert np.abs(error).mean() < 0.25 * scene.std()


def turned(degrees, zoom, side=256, scene=PHOTO):
    """Frame of a camera that is turned and zooms about the centre of the image."""
    turn = cv2.getRotationMatrix2D((255.5, 255.5), degrees, zoom)
    start = 256 - side // 2
    return cv2.warpAffine(scene, turn, scene.shape[::-1], flags=cv2.INTER_CUBIC)[
        start : start + side, start : start + side
    ]


class TestTurns:
    ANGLES, ZOOMS = np.array([-2.0, 0.0, 2.0, 1.0, -1.0]), np.array([1.0, 1.03, 0.97, 1.02, 0.98])

    def test_mean_of_a_camera_that_turns_and_zooms_is_sharp_and_in_the_middle(self):
        frames = np.stack([turned(*pair) for pair in zip(self.ANGLES, self.ZOOMS, strict=True)])
        before, inner = frames.copy(), np.s_[16:-16, 16:-16]
        errors = [np.std((mean - turned(0, 1))[inner]) for mean in (mean_stabilised(frames), frames.mean(axis=0))]
        assert errors[0] < 0.01
        assert errors[1] > 0.05
        assert (frames == before).all()

    def test_frames_of_something_else_are_left_out(self):
        frames = np.stack([turned(*pair) for pair in zip(self.ANGLES, self.ZOOMS, strict=True)] * 2)
        kept = np.setdiff1d(np.arange(10), (3, 6))
        frames[3], frames[6] = np.random.default_rng(0).random(frames[3].shape), 0.5
        middle = turned(np.tile(self.ANGLES, 2)[kept].mean(), np.tile(self.ZOOMS, 2)[kept].mean())
        assert np.abs(mean_stabilised(frames) - middle)[16:-16, 16:-16].mean() < 0.006

    def test_turbulence_alone_is_no_turn(self):
        flows = smooth_flows(9, 256, 256, np.random.default_rng(3), SmoothFlowParams(rms=1.5))
        frames = np.stack(distort(seen_from(0, 0), flows, np.random.default_rng(4), noise=0.01))
        assert (mean_stabilised(frames) == frames.mean(axis=0)).all()
