import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from flow_systems import textbook_update

from conftest import make_sequence
from turbrestore.core.errors import DataError
from turbrestore.dynamics.dynamic_texture import DynamicsParams, identify
from turbrestore.filtering.alternating import filter_frames, filter_steps
from turbrestore.filtering.estimates import Gaussian, PixelStacks
from turbrestore.filtering.filter_records import FilterParams, filter_memory
from turbrestore.filtering.image_state import update_image
from turbrestore.filtering.kalman import predict
from turbrestore.metrics import psnr
from turbrestore.registration.centroid import find_centroid
from turbrestore.registration.warp import warp
from turbrestore.runtime.runtime import DEFAULT, Runtime
from turbrestore.runtime.steps import finish

INSIDE = (slice(12, -12), slice(12, -12))


def quality(image, sequence, blur=1.0):
    return psnr(image[INSIDE], cv2.GaussianBlur(sequence.scene, (0, 0), blur)[INSIDE])


def start(sequence, train=None, **dynamics):
    centroid = find_centroid(sequence.frames[:train])
    return centroid, identify(centroid.flows, DynamicsParams(**dynamics))


def filtered_by_all(frames):
    """Filter frames all of which train."""
    centroid = find_centroid(frames)
    return filter_frames(frames, centroid.image, identify(centroid.flows), known_flows=centroid.flows)


@pytest.fixture(scope="module")
def trained(sequence):
    """Centroid and dynamics of all frames."""
    return start(sequence)


@pytest.fixture(scope="module")
def briefly_trained(sequence):
    """Centroid and dynamics of the first four frames."""
    return start(sequence, 4)


# Weak and strong, smooth and rough, correlated in time and not, few frames, much noise.
STATISTICS = [
    {"seed": 1},
    {"seed": 2, "rms": 0.5},
    {"seed": 3, "rms": 2.5, "correlation_length": 20.0},
    {"seed": 4, "correlation_length": 8.0, "rms": 1.0},
    {"seed": 5, "persistence": 0.0},
    {"seed": 6, "count": 8},
    {"seed": 7, "noise": 0.04},
]


@pytest.mark.parametrize(("scene", "statistics"), [*zip(itertools.cycle(["chart", "camera"]), STATISTICS)], ids=str)
def test_the_filter_never_ends_worse_than_the_centroid(scene, statistics):
    sequence = make_sequence(scene=scene, size=72, blur_change=1.0, **statistics)
    centroid, dynamics = start(sequence, len(sequence.frames) // 2)
    filtered = filter_frames(sequence.frames, centroid.image, dynamics, known_flows=centroid.flows)
    assert quality(filtered.image, sequence) >= quality(centroid.image, sequence)


@pytest.mark.parametrize(("scene", "statistics"), [*zip(itertools.cycle(["camera", "chart"]), STATISTICS)], ids=str)
def test_where_nothing_can_be_gained_less_than_two_grey_levels_are_lost(scene, statistics):
    """Equally sharp frames, registered almost perfectly: the centroid is within a grey level or two of the truth."""
    sequence = make_sequence(scene=scene, size=72, **statistics)
    centroid, dynamics = start(sequence, len(sequence.frames) // 2)
    filtered = filter_frames(sequence.frames, centroid.image, dynamics, known_flows=centroid.flows)
    before, after = (10 ** (-quality(image, sequence) / 20) for image in (centroid.image, filtered.image))
    assert after < before + 2 / 255


def test_keeping_the_residual_beats_dropping_it():
    sequence = make_sequence(seed=4, correlation_length=8.0)
    centroid, dynamics = start(sequence)
    keep, drop = (
        filter_frames(
            sequence.frames,
            centroid.image,
            dynamics,
            FilterParams(residual=residual, sharpness=0, inner_iterations=1),
            known_flows=centroid.flows,
        )
        for residual in ("keep", "drop")
    )
    assert quality(keep.image, sequence) > quality(drop.image, sequence) + 3


def test_in_the_subspace_it_is_the_linear_kalman_filter(sequence):
    """Flows that the model explains exactly: each part must follow the textbook filter."""
    count, rank = 12, 3
    _, model = start(sequence, rank=rank)
    rng = np.random.default_rng(0)
    states = rng.normal(0, 20, (count, rank))
    flows = np.stack([model.mean_flow + (model.C @ xi.astype(np.float32)).reshape(96, 96, 2) for xi in states])
    model = replace(model, R=0.04)
    reference, frames = sequence.frames.mean(axis=0), sequence.frames[:count]
    noise, prior_frames = 1e-3, 2.0
    params = FilterParams(
        residual="drop", sharpness=0, image_noise=noise, prior_frames=prior_frames, inner_iterations=1
    )
    filtered = filter_frames(frames, reference, model, params, known_flows=flows)

    flow = Gaussian(np.zeros(rank), model.state_covariance)
    image = PixelStacks(reference, np.full((96, 96), noise / prior_frames, np.float32))
    for frame, xi, found, unforeseen in zip(frames, states, filtered.flow_states, filtered.innovations, strict=True):
        missed = (model.C @ (xi - predict(flow, model.A, model.Q).mean).astype(np.float32)).astype(np.float64)
        assert unforeseen == pytest.approx(np.sqrt(np.mean(missed**2)), rel=1e-3)
        # With CᵀC = I the measurement Cᵀ(W − W̄) = ξ + Cᵀr says all that W does.
        flow = textbook_update(predict(flow, model.A, model.Q), xi, np.eye(rank), model.R * np.eye(rank))
        assert np.allclose(found, flow.mean, rtol=1e-4, atol=1e-4)
        estimate = model.mean_flow + (model.C @ flow.mean.astype(np.float32)).reshape(96, 96, 2)
        image, _ = update_image(image, warp(frame, estimate), noise)
    assert np.abs(filtered.image - image.mean).max() < 1e-3
    assert np.allclose(filtered.variance, image.variance)


def test_without_drift_and_sharpness_it_is_the_average_of_registered_frames(sequence):
    centroid, dynamics = start(sequence, rank=2)
    params = FilterParams(sharpness=0, inner_iterations=1)
    filtered = filter_frames(sequence.frames, centroid.image, dynamics, params, known_flows=centroid.flows)
    average = np.mean([warp(f, w) for f, w in zip(sequence.frames, centroid.flows, strict=True)], axis=0)
    # The diffuse prior of variance 1 still weighs as much as Z of a frame.
    assert np.abs(filtered.image - average).max() < 2e-3
    assert np.allclose(filtered.gains, 1 / np.arange(1, 17), atol=2e-3)


def test_the_diffuse_prior_forgets_the_reference(sequence, trained):
    centroid, dynamics = trained
    tinted = filter_frames(sequence.frames, centroid.image + 0.1, dynamics, known_flows=centroid.flows)
    plain = filter_frames(sequence.frames, centroid.image, dynamics, known_flows=centroid.flows)
    assert np.abs(tinted.image - plain.image)[INSIDE].mean() < 1e-3


@pytest.mark.parametrize("sharpness", [0.0, 2.0])
def test_frames_alike_carry_the_same_information_whatever_the_weighting(sequence, sharpness):
    still = np.repeat(sequence.scene[None], 20, axis=0)
    still = still + np.random.default_rng(0).normal(0, 0.01, still.shape).astype(np.float32)
    dynamics = identify(np.zeros((20, 96, 96, 2), np.float32))
    known = np.zeros((20, 96, 96, 2), np.float32)
    params = FilterParams(sharpness=sharpness, inner_iterations=1)
    filtered = filter_frames(still, still.mean(axis=0), dynamics, params, known_flows=known)
    assert np.median(filtered.variance) * 20 / filtered.image_noise == pytest.approx(1, abs=0.15)


def test_a_second_inner_iteration_does_not_count_frames_twice(sequence, trained):
    centroid, dynamics = trained
    once, twice = (
        filter_frames(
            sequence.frames,
            centroid.image,
            dynamics,
            FilterParams(inner_iterations=n, sharpness=0),
            known_flows=centroid.flows,
        )
        for n in (1, 2)
    )
    assert np.allclose(once.variance, twice.variance)


def test_the_image_drifts_through_frames_that_do_not_count(sequence, trained):
    centroid, dynamics = trained
    drift, noise, variance = 1e-4, 1e-3, 1.0
    params = FilterParams(sharpness=0, image_noise=noise, image_drift=drift, inner_iterations=1)
    frames = [None if number in (3, 4, 15) else frame for number, frame in enumerate(sequence.frames)]
    filtered = filter_frames(frames, centroid.image, dynamics, params, known_flows=centroid.flows)
    for frame, gain in zip(frames, filtered.gains, strict=True):
        variance += drift
        expected = 0.0 if frame is None else variance / (variance + noise)
        assert gain == pytest.approx(expected, rel=1e-4)
        variance *= 1 - expected
    assert filtered.variance == pytest.approx(variance, rel=1e-3)


def test_frames_are_streamed_a_block_at_a_time(sequence, briefly_trained):
    centroid, dynamics = briefly_trained
    taken, furthest = 0, 0

    def stream():
        nonlocal taken
        for frame in itertools.islice(itertools.cycle(sequence.frames), 40):
            taken += 1
            yield frame

    params = FilterParams(block=5, inner_iterations=1)
    steps = filter_steps(stream(), centroid.image, dynamics, params, known_flows=centroid.flows)
    for step in steps:
        furthest = max(furthest, taken - 4 - step.flows_measured)
    assert (taken, step.flows_measured) == (40, 36)
    # Four training frames need no new flow; beyond them at most a block is in memory.
    assert furthest <= 5


@pytest.mark.parametrize(
    ("iterations", "train", "colour", "left_out"),
    [(1, 9, False, ()), (2, 9, False, ()), (2, 3, True, ()), (3, 9, False, ()), (2, 9, False, (2, 8, 9, 10, 13))],
)
def test_from_every_checkpoint_a_run_goes_on_bit_for_bit(sequence, iterations, train, colour, left_out):
    frames = sequence.frames[:15, :48, :48]
    frames = np.stack([frames, 0.5 * frames, frames**2], axis=-1) if colour else frames
    centroid = find_centroid(frames[:train])
    params = FilterParams(inner_iterations=iterations, block=4)
    counted = [None if number in left_out else frame for number, frame in enumerate(frames)]

    def run(steps, start=None, runtime=DEFAULT):
        dynamics = identify(centroid.flows, DynamicsParams(rank=2))
        arguments = counted, centroid.image, dynamics, params, None, centroid.flows, runtime, start
        found = finish(filter_steps(*arguments), steps.append)
        arrays = found.image, found.variance, found.flow_states, found.shares, found.innovations
        return [array.tobytes() for array in arrays]

    total, whole, steps = 15 * iterations - train, [], []
    whole = run(steps)
    kept = [step.checkpoint for step in steps if step.checkpoint is not None]
    assert [len(one.records) for one in kept] == list(dict.fromkeys([*range(train, 15, 4), 15]))
    assert [step.flows_measured for step in steps if step.checkpoint is None] == list(range(1, total + 1))
    for checkpoint in kept:
        again = []
        assert run(again, checkpoint) == whole
        assert [step.flows_measured for step in again][-1:] in ([total], [])
    assert run([], runtime=Runtime(threads=3)) == whole


def test_a_checkpoint_of_other_frames_is_refused(sequence):
    centroid, dynamics = start(sequence, 4, rank=2)
    arguments = sequence.frames, centroid.image, dynamics, FilterParams(block=4), None, centroid.flows
    steps = list(filter_steps(*arguments))
    early = next(step.checkpoint for step in steps if step.checkpoint is not None)
    for bad in (replace(early, records=early.records[:2]), replace(early, reference=early.reference[1:])):
        with pytest.raises(DataError, match="^start: expected a checkpoint of these frames"):
            finish(filter_steps(*arguments, start=bad))


def test_colour_moves_with_luminance(sequence):
    tint = np.array([1.0, 0.8, 0.6], np.float32)
    frames = sequence.frames[:4, ..., None] * tint
    filtered = filtered_by_all(frames)
    assert filtered.image.shape == (96, 96, 3)
    assert np.abs(filtered.image / tint - filtered.image[..., :1])[INSIDE].max() < 0.01


def test_bad_input_is_refused(sequence, briefly_trained):
    centroid, dynamics = briefly_trained
    with pytest.raises(DataError, match="at least 1, found 0"):
        filter_frames([], centroid.image, dynamics)
    with pytest.raises(DataError, match="at least 4, found 2"):
        filter_frames(sequence.frames[:2], centroid.image, dynamics, known_flows=centroid.flows)
    with pytest.raises(DataError, match="^frames: expected at least one frame to count, found none$"):
        filter_frames([None] * 9, centroid.image, dynamics, known_flows=centroid.flows)
    with pytest.raises(DataError, match="dynamics: expected flows of"):
        filter_frames(sequence.frames[:, :64], centroid.image[:64], dynamics)


def test_frames_whose_flow_folds_count_for_little(sequence):
    dynamics = identify(np.zeros((6, 96, 96, 2), np.float32))
    frames = np.repeat(sequence.frames[:1], 6, axis=0)
    known = np.zeros((6, 96, 96, 2), np.float32)
    # In three frames a region is turned over: x + dx falls as x grows.
    x = np.arange(96, dtype=np.float32)
    known[::2, 30:60, 30:60, 0] = -2 * (x[30:60] - 45)
    # Hardly any weight on sharpness, so that nothing but the fold can tell the frames apart.
    params = FilterParams(inner_iterations=1, sharpness=1e-3)
    filtered = filter_frames(frames, frames[0], dynamics, params, known_flows=known)
    region = (slice(36, 54), slice(36, 54))
    plain = np.mean([warp(f, w) for f, w in zip(frames, known, strict=True)], axis=0)
    assert np.abs(filtered.image - frames[0])[region].max() < 0.05
    assert np.abs(plain - frames[0])[region].max() > 0.1
    # Three of six frames are all the information there is.
    assert np.median(filtered.variance[region]) > 1.7 * np.median(filtered.variance[70:, 70:])


def spoil(frames):
    """A bird that crosses, two flashes, a glint and a frame that slipped."""
    spoilt = frames.copy()
    for step, index in enumerate(range(4, 12)):
        cv2.circle(spoilt[index], (10 + 14 * step, 60), 7, 0.05, -1)
    spoilt[13] = np.clip(spoilt[13] + 0.35, 0, 1)
    spoilt[14] = np.clip(1.5 * spoilt[14], 0, 1)
    cv2.circle(spoilt[16], (80, 40), 12, 1.0, -1)
    return spoilt


@pytest.mark.parametrize("scene", ["chart", "camera"])
def test_what_only_a_few_frames_show_leaves_no_trace(scene):
    sequence = make_sequence(scene=scene, seed=21, count=40)
    filtered = {"clean": filtered_by_all(sequence.frames), "spoilt": filtered_by_all(spoil(sequence.frames))}
    clean, spoilt = (10 ** (-quality(filtered[name].image, sequence) / 20) for name in ("clean", "spoilt"))
    assert spoilt < clean + 1 / 255
    # A flash covers all of its frame, the bird a part of the frames it crosses.
    assert filtered["spoilt"].shares[13:15].max() < 0.1 / 40
    assert filtered["spoilt"].shares[20:].min() > 0.2 / 40


def test_sharper_frames_count_more():
    sequence = make_sequence(seed=7, blur=0.0)
    frames = sequence.frames.copy()
    frames[1::2] = [cv2.GaussianBlur(frame, (0, 0), 2.5) for frame in frames[1::2]]
    centroid = find_centroid(frames)
    dynamics = identify(centroid.flows)
    plain, sharp = (
        filter_frames(frames, centroid.image, dynamics, FilterParams(sharpness=b), known_flows=centroid.flows)
        for b in (0.0, 2.0)
    )
    assert quality(sharp.image, sequence, blur=0.5) > quality(plain.image, sequence, blur=0.5) + 1
    assert sharp.sharpness[::2].min() > sharp.sharpness[1::2].max()
    assert sharp.shares[::2].min() > sharp.shares[1::2].max()
    assert sharp.shares.sum() == pytest.approx(1)


def test_frames_that_do_not_count_change_the_flow_state_only():
    sequence = make_sequence(seed=23, count=16)
    centroid, dynamics = start(sequence, 8)
    counted = np.ones(16, bool)
    counted[[3, 9, 10, 15]] = False
    frames = [frame if counts else None for frame, counts in zip(sequence.frames, counted, strict=True)]
    params = FilterParams(image_noise=1e-3)
    first = filter_frames(frames, centroid.image, dynamics, params, known_flows=centroid.flows)
    assert np.isnan(first.innovations[~counted]).all()
    assert np.isfinite(first.innovations[counted]).all()
    assert (first.gains[~counted] == 0).all()
    assert (first.shares[~counted] == 0).all()
    assert np.allclose(first.flow_states[9], dynamics.A @ first.flow_states[8])
    rest, flows = sequence.frames[counted], centroid.flows[counted[:8]]
    alone = filter_frames(rest, centroid.image, dynamics, params, known_flows=flows)
    assert np.abs(first.image - alone.image).mean() < 0.01


@pytest.mark.parametrize("known", [True, False])
def test_no_frame_of_the_first_block_has_to_count(sequence, briefly_trained, known):
    """The flow state is predicted through it, and the first frames that count are filtered as the first block."""
    centroid, dynamics = briefly_trained
    params, flows = FilterParams(block=4), centroid.flows if known else None
    frames = [*[None] * 4, *sequence.frames[4:12]]
    later = filter_frames(frames, centroid.image, dynamics, params, known_flows=flows)
    alone = filter_frames(sequence.frames[4:12], centroid.image, dynamics, params)
    assert (later.shares[:4] == 0).all() and np.isnan(later.innovations[:4]).all()
    assert later.image_noise == alone.image_noise
    assert np.abs(later.image - alone.image).max() < 0.02
    assert len(later.gains) == 12


def test_a_border_that_was_not_seen_is_not_made_of_its_repetition():
    sequence = make_sequence(scene="camera", seed=25, count=16, blur=0.0, noise=0.005)
    shifts = np.linspace(-4, 4, 16)
    frames = np.stack(
        [
            warp(f, np.broadcast_to(np.float32([s, 0]), (*f.shape, 2)))
            for f, s in zip(sequence.frames, shifts, strict=True)
        ]
    )
    frames = frames[:, 8:-8, 8:-8]
    truth = sequence.scene[8:-8, 8:-8]
    filtered = filtered_by_all(frames)
    error = np.abs(filtered.image - truth)
    assert np.median(error[:, :2]) < 3 * np.median(error[:, 20:-20])


def test_memory_grows_with_channels_threads_and_the_block():
    grey, colour = (filter_memory((100, 10, 10, *channels), 50, FilterParams(block=4)) for channels in ((), (3,)))
    assert grey == 100 * (15 + 24 + 18 + 5 + 4 * 6)
    assert colour == 100 * (45 + 24 + 18 + 15 + 4 * 14)
    assert filter_memory((100, 10, 10), 50, FilterParams(block=4), threads=3) == grey + 100 * 2 * 23
    assert filter_memory((100, 10, 10), 50, FilterParams(inner_iterations=3, block=4)) == grey + 100 * (50 - 24)
