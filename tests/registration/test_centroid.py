import threading

import cv2
import numpy as np
import pytest

from conftest import natural_scene, photograph
from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.metrics import psnr
from turbrestore.registration import centroid, flow
from turbrestore.registration.centroid import (
    CentroidParams,
    CentroidState,
    centroid_steps,
    find_centroid,
    mean_registered,
)
from turbrestore.registration.flow import FlowParams
from turbrestore.registration.flow_algebra import invert_flow
from turbrestore.registration.warp import warp
from turbrestore.runtime.runtime import Runtime
from turbrestore.runtime.steps import finish
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

INSIDE = (slice(12, -12), slice(12, -12))


def blurred_truth(sequence):
    return cv2.GaussianBlur(sequence.scene, (0, 0), 1.0)[INSIDE]


def test_fused_centroid_beats_the_mean_and_one_warped_frame(sequence):
    truth = blurred_truth(sequence)
    fused = find_centroid(sequence.frames, CentroidParams(mode="fused"))
    single = find_centroid(sequence.frames, CentroidParams(mode="single"))
    mean = psnr(sequence.frames.mean(axis=0)[INSIDE], truth)
    assert psnr(single.image[INSIDE], truth) > mean + 1
    assert psnr(fused.image[INSIDE], truth) > psnr(single.image[INSIDE], truth) + 0.5


def test_flows_are_searched_for_anew_where_displacements_are_large():
    scene, rng = photograph("text", 200), np.random.default_rng(1)
    moved = smooth_flows(12, 200, 200, rng, SmoothFlowParams(rms=5.0))
    frames = distort(scene, moved, rng, blur=1.2, noise=0.01)
    truth = cv2.GaussianBlur(warp(scene, invert_flow(moved.mean(axis=0))), (0, 0), 1.2)[INSIDE]
    found, once = (find_centroid(frames, CentroidParams(iterations=count)) for count in (8, 2))
    assert psnr(found.image[INSIDE], truth) > psnr(once.image[INSIDE], truth) + 2
    # Two iterations are enough where detail is as wide as the displacement.
    sharp, soft = (distort(scene, 0.7 * moved, rng, blur, 0.01) for blur in (1.2, 4.0))
    assert [len(find_centroid(some, CentroidParams(tolerance=5.0)).mean_flow_sizes) > 2 for some in (sharp, soft)] == [
        True,
        False,
    ]


def test_mean_flow_shrinks(sequence):
    centroid = find_centroid(sequence.frames, CentroidParams(mode="single", iterations=10, tolerance=0.0))
    sizes = centroid.mean_flow_sizes
    assert sizes[-1] < 0.3 * sizes[0]
    # Without a tolerance it ends when nothing shrinks any more.
    assert centroid.converged
    assert len(sizes) < 10
    assert sizes[-1] > 0.8 * sizes[-2]


def test_stops_on_the_size_of_the_mean_flow(sequence):
    loose = find_centroid(sequence.frames, CentroidParams(tolerance=5.0))
    assert loose.converged
    # The temporal mean is too blurred a reference to stop at.
    assert len(loose.mean_flow_sizes) == 2
    assert len(find_centroid(sequence.frames, CentroidParams(mode="single", tolerance=5.0)).mean_flow_sizes) == 1
    strict = find_centroid(sequence.frames, CentroidParams(tolerance=0.0, iterations=1))
    assert not strict.converged


@pytest.mark.parametrize("mode", ["fused", "single"])
def test_flows_start_from_the_centroid_and_average_out(sequence, mode):
    centroid = find_centroid(sequence.frames, CentroidParams(mode=mode))
    errors = [
        np.abs(warp(f, w) - centroid.image)[INSIDE].mean() for f, w in zip(sequence.frames, centroid.flows, strict=True)
    ]
    unregistered = [np.abs(f - centroid.image)[INSIDE].mean() for f in sequence.frames]
    assert np.mean(errors) < 0.5 * np.mean(unregistered)
    mean_flow = centroid.flows.mean(axis=0)[INSIDE]
    assert np.hypot(mean_flow[..., 0], mean_flow[..., 1]).mean() <= CentroidParams().tolerance


@pytest.mark.parametrize(
    ("sizes", "converged"), [([2.0, 1.0, 0.9], True), ([2.0, 1.0, 1.1], True), ([1.0, 2.0], False)]
)
def test_a_mean_flow_that_stalls_has_converged_and_one_that_grows_has_not(monkeypatch, sizes, converged):
    found = iter(sizes)

    def measure(reference, frames, starts, draft):
        size = next(found)
        return [
            (reference.prepare(frame), np.full((16, 16, 2), (size, 0.0), np.float32))
            for frame in np.zeros((2, 16, 16), np.float32)
        ]

    monkeypatch.setattr("turbrestore.registration.centroid.measure_flows", measure)
    centroid = find_centroid(np.zeros((2, 16, 16)))
    assert centroid.converged == converged
    assert centroid.mean_flow_sizes == pytest.approx(sizes)


def test_opposite_shifts_meet_in_the_middle(sequence):
    from scipy.ndimage import shift

    image = sequence.frames[0]
    pair = np.stack([shift(image, (0, s), mode="nearest", order=3) for s in (-1.0, 1.0)]).astype(np.float32)
    centroid = find_centroid(pair, CentroidParams(mode="single"))
    assert psnr(centroid.image[INSIDE], image[INSIDE]) > psnr(pair[0][INSIDE], image[INSIDE]) + 8


def test_frames_are_not_changed_and_colour_is_kept(sequence):
    frames = np.repeat(sequence.frames[:3, ..., None], 3, axis=3)
    before = frames.copy()
    centroid = find_centroid(frames)
    assert centroid.image.shape == frames.shape[1:]
    assert (frames == before).all()


@pytest.mark.parametrize(("jitter", "drift"), [(8.0, 0.0), (0.0, 50.0)])
def test_a_moving_camera_costs_nothing(jitter, drift):
    rng = np.random.default_rng(3)
    scene = natural_scene(192)
    half = np.rint(rng.normal(0, jitter, (6, 2)) + np.linspace(0.5, 0.1, 6)[:, None] * (drift, 0)).astype(int)
    # The scene itself is the mean position.
    places = np.concatenate([half, -half[::-1]])
    flows = smooth_flows(12, 192, 192, rng, SmoothFlowParams(rms=1.0))
    frames = distort(scene, flows - flows.mean(axis=0), rng, noise=0.01)
    cuts = np.stack([f[48 - y : 144 - y, 48 - x : 144 - x] for f, (x, y) in zip(frames, places, strict=True)])
    still = np.stack([f[48:144, 48:144] for f in frames])
    truth = scene[48:144, 48:144]
    # Nearer to the border fewer frames show the scene.
    seen = slice(32, -32), slice(32, -32)
    moving, standing, lost = (
        psnr(find_centroid(stack, flow_params=params).image[seen], truth[seen])
        for stack, params in ((cuts, None), (still, None), (cuts, FlowParams(global_shift=False)))
    )
    assert moving > standing - 0.3
    assert lost < standing - 0.5


def test_pixels_that_a_frame_did_not_see_do_not_count():
    frames = np.stack([np.full((8, 8), 0.2), np.tile(np.linspace(0.5, 0.9, 8), (8, 1))]).astype(np.float32)
    flows = np.zeros((2, 8, 8, 2), np.float32)
    flows[1, :, :, 0] = 5
    mean = mean_registered(frames, flows)
    assert np.abs(mean[:, 3:] - 0.2).max() < 1e-3
    assert np.abs(mean[:, :2] - (0.2 + np.linspace(0.5, 0.9, 8)[5:7]) / 2).max() < 1e-3
    # Where no frame shows anything the repeated borders of all count alike.
    assert mean_registered(frames, flows + np.float32([9, 0])) == pytest.approx(np.full((8, 8), 0.55), abs=1e-6)


def test_bad_input_is_refused(sequence):
    with pytest.raises(DataError, match="at least 2 frames, found 1"):
        find_centroid(sequence.frames[:1])
    with pytest.raises(ConfigurationError, match=r"^start: expected a frame below 16"):
        find_centroid(sequence.frames, CentroidParams(mode="single", start=16))


@pytest.mark.parametrize(("mode", "iterations", "drafts"), [("fused", 3, 1), ("fused", 1, 0), ("single", 2, 0)])
def test_flows_from_the_blurred_mean_are_drafts(monkeypatch, mode, iterations, drafts):
    asked, measure = [], centroid.measure_flows

    def spied(reference, frames, starts, draft):
        asked.append(draft)
        return measure(reference, frames, starts, draft)

    monkeypatch.setattr(centroid, "measure_flows", spied)
    frames = np.random.default_rng(0).random((3, 32, 32)).astype(np.float32)
    centroid.find_centroid(frames, centroid.CentroidParams(mode=mode, iterations=iterations, tolerance=0))
    assert asked[0] == bool(drafts)
    assert sum(asked) == drafts


def test_a_state_follows_each_flow_and_the_result_is_returned(sequence):
    frames = sequence.frames[:3]
    steps, states = centroid_steps(frames, CentroidParams(iterations=2)), []
    result = finish(steps, states.append)
    assert states == [CentroidState(iteration, measured) for iteration in (1, 2) for measured in (1, 2, 3)]
    expected = find_centroid(frames, CentroidParams(iterations=2))
    assert result.image.tobytes() == expected.image.tobytes()
    assert result.flows.tobytes() == expected.flows.tobytes()


def test_a_centroid_may_be_left_early(sequence):
    before = set(threading.enumerate())
    steps = centroid_steps(sequence.frames[:6], runtime=Runtime(threads=2))
    assert next(steps) == CentroidState(1, 1)
    steps.close()
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize("scratch", [False, True])
def test_frames_are_prepared_once_where_memory_allows(monkeypatch, tmp_path, scratch):
    calls = []
    monkeypatch.setattr(
        "turbrestore.registration.flow.normalise_to_8_bits",
        lambda *a, find=flow.normalise_to_8_bits: calls.append(1) or find(*a),
    )
    frames = np.random.default_rng(0).random((3, 32, 32)).astype(np.float32)
    runtime = Runtime(scratch=tmp_path if scratch else None)
    passes = find_centroid(frames, CentroidParams(iterations=2), runtime=runtime).mean_flow_sizes.size
    # The reference of each pass is prepared too, for frames with and without noise.
    assert passes == 2
    assert len(calls) == 2 * passes + 3 * (passes if scratch else 1)
