import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.metrics import endpoint_error
from turbrestore.registration.flow import (
    FLOW_METHODS,
    FlowParams,
    estimate_flow,
    iterate_flows,
    measure_flows,
    normalise_contrast,
    normalise_to_8_bits,
    prepare_reference,
)
from turbrestore.registration.flow_methods.opencv_flow import DisParams, dis_solver, flow_memory
from turbrestore.registration.flow_methods.refinement_step import flow_refinement
from turbrestore.registration.flow_methods.tvl1 import TvL1Params, prepare_tvl1, tvl1_flows
from turbrestore.registration.warp import warp
from turbrestore.runtime.runtime import Runtime
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, smooth_flows


def texture(seed=0, size=96):
    rng = np.random.default_rng(seed)
    field = smooth_flows(1, size, size, rng, SmoothFlowParams(rms=0.15, correlation_length=2.0))[0, ..., 0]
    return np.clip(0.5 + field, 0, 1)


def pair(seed=0, rms=1.5):
    """A reference, a frame, and the flow between them by the sign rule."""
    flow = smooth_flows(1, 96, 96, np.random.default_rng(seed + 100), SmoothFlowParams(rms=rms))[0]
    frame = texture(seed)
    return warp(frame, flow), frame, flow


# Largest end-point errors, pixels, for motion of 1.5 px a component on dense texture.
@pytest.mark.parametrize(("method", "bound"), [("dis", 0.12), ("tvl1", 0.2), ("farneback", 0.3)])
@pytest.mark.parametrize("seed", range(2))
def test_known_motion_is_found(method, bound, seed):
    reference, frame, truth = pair(seed)
    found = estimate_flow(reference, frame[None], FlowParams(method=method))[0]
    assert endpoint_error(found[8:-8, 8:-8], truth[8:-8, 8:-8]) < bound


@pytest.mark.parametrize("method", FLOW_METHODS)
def test_equal_images_do_not_move(method):
    image = texture()
    flow = estimate_flow(image, image[None], FlowParams(method=method))[0]
    # Farneback invents motion within its neighbourhood of the border.
    assert np.abs(flow[12:-12, 12:-12]).max() < 1e-3


@pytest.mark.parametrize("method", FLOW_METHODS)
def test_flat_images_give_finite_flow(method):
    flat = np.full((32, 32), 0.5, np.float32)
    assert np.isfinite(estimate_flow(flat, flat[None], FlowParams(method=method))).all()


def cut(scene, dx, dy, side=128):
    """Frame that a reference cut at (64, 64) is shifted against by (dx, dy)."""
    return scene[64 - dy : 64 - dy + side, 64 - dx : 64 - dx + side]


@pytest.mark.parametrize("shift", [(24, 10), (-30, 0), (6, -40)])
def test_large_shifts_are_taken_out_first(shift):
    scene, rng = texture(5, 256), np.random.default_rng(5)
    turbulence = smooth_flows(1, 128, 128, rng, SmoothFlowParams(rms=1.0))[0]
    frame = (cut(scene, *shift) + rng.normal(0, 0.01, (128, 128))).astype(np.float32)
    # warp(cut(0, 0), turbulence) lies on the frame once the frame is moved back by the shift.
    reference = warp(cut(scene, 0, 0), turbulence)
    both_see = slice(44, -44), slice(44, -44)
    truth = turbulence + np.float32(shift)
    with_shift, without = (
        estimate_flow(reference, frame[None], FlowParams(global_shift=on))[0][both_see] for on in (True, False)
    )
    assert endpoint_error(with_shift, truth[both_see]) < 0.25
    assert endpoint_error(without, truth[both_see]) > 3


def test_what_a_shifted_frame_does_not_show_moves_with_it():
    scene = texture(6, 256)
    flow = estimate_flow(cut(scene, 0, 0), cut(scene, -40, 0)[None])[0]
    # The frame starts where column 40 of the reference is.
    assert np.abs(flow[8:-8, :30] - (-40, 0)).max() < 0.5


@pytest.mark.parametrize("shift", [(0, 0), (1, 0), (-1, 2)])
def test_small_shifts_are_left_to_the_method(shift):
    scene = texture(7, 256)
    frames = cut(scene, *shift)[None]
    on, off = (estimate_flow(cut(scene, 0, 0), frames, FlowParams(global_shift=g)) for g in (True, False))
    assert (on == off).all()


@pytest.mark.parametrize("noise", [0.005, 0.03])
def test_flat_regions_invent_no_motion(noise):
    rng = np.random.default_rng(8)
    still = texture(8)
    still[:, 48:] = 0.5
    reference, frame = (still + rng.normal(0, n, still.shape).astype(np.float32) for n in (noise / 5, noise))
    trusting, cautious = (
        estimate_flow(reference, frame[None], FlowParams(confidence=on))[0][8:-8, 60:-8] for on in (False, True)
    )
    assert np.sqrt(np.mean(trusting**2)) > 1
    assert np.sqrt(np.mean(cautious**2)) < 0.4


def test_dark_and_faint_texture_registers_as_well_as_bright():
    reference, frame, truth = pair(1)
    faint = estimate_flow(0.1 + 0.05 * reference, (0.1 + 0.05 * frame)[None], FlowParams(contrast_floor=1e-4))[0]
    assert endpoint_error(faint[8:-8, 8:-8], truth[8:-8, 8:-8]) < 0.15


def test_normalised_contrast_has_zero_mean_and_unit_deviation():
    image = texture(size=256) * np.linspace(0.1, 1, 256, dtype=np.float32)
    normalised = normalise_contrast(image, 10.0, floor=1e-6)
    thirds = np.array_split(normalised, 3, axis=1)
    assert [round(float(part.mean()), 1) for part in thirds] == pytest.approx([0, 0, 0], abs=0.1)
    assert [float(part.std()) for part in thirds] == pytest.approx([1, 1, 1], abs=0.1)


def test_colour_is_measured_on_luminance():
    reference, frame, _ = pair(0)
    grey = estimate_flow(reference, frame[None])
    colour = estimate_flow(np.repeat(reference[..., None], 3, 2), np.repeat(frame[None, ..., None], 3, 3))
    assert np.abs(grey - colour).max() < 0.05


def test_frames_are_read_only_a_few_ahead():
    taken = 0

    def stream():
        nonlocal taken
        for _ in range(100):
            taken += 1
            yield texture()

    flows = iterate_flows(texture(), stream(), runtime=Runtime(threads=2))
    next(flows)
    assert taken <= 6
    flows.close()
    assert threading.active_count() < 10


def measure(reference, frames, starts):
    """Flows that start from others."""
    return np.stack([flow for _, flow in measure_flows(reference, frames, starts)])


def test_what_is_prepared_of_a_frame_serves_every_reference():
    stack = np.stack([pair(seed)[1] for seed in range(3)])
    one, other = pair(0)[0], pair(1)[0]
    prepared, flows = zip(*measure_flows(prepare_reference(one), stack), strict=True)
    assert np.array_equal(flows, estimate_flow(one, stack))
    again = [flow for _, flow in measure_flows(prepare_reference(other), prepared)]
    assert np.array_equal(again, estimate_flow(other, stack))


@pytest.mark.parametrize(("method", "worse"), [("dis", 0.04), ("tvl1", 0.011)])
def test_a_flow_from_a_good_start_errs_by_hardly_more_than_one_from_none(method, worse):
    reference, frame, truth = pair(rms=2.0)
    params, found = FlowParams(method=method, confidence=False), (truth + np.float32(0.5))[None]
    anew = estimate_flow(reference, frame[None], params)[0]
    found = measure(prepare_reference(reference, params), [frame], found)
    errors = [endpoint_error(one[8:-8, 8:-8], truth[8:-8, 8:-8]) for one in (found[0], anew)]
    assert errors[0] <= errors[1] + worse


def test_a_flow_begins_at_its_start():
    """Nothing brings a flow back that starts beyond the reach of the search."""
    params = FlowParams(global_shift=False, confidence=False)
    image, errors = texture(size=160), []
    for start in (10.5, 34):
        flows = np.full((1, 160, 160, 2), (start, 0), np.float32)
        flows = measure(prepare_reference(image, params), [np.roll(image, 10, axis=1)], flows)
        errors.append(float(np.abs(flows[0, 40:-40, 40:-40, 0] - 10).mean()))
    assert errors[0] < 0.1
    assert errors[1] > 2


@pytest.mark.parametrize("method", ["dis", "tvl1"])
def test_a_start_includes_the_shift_of_the_frame(method):
    reference, frame, params = texture(size=128), texture(size=128), FlowParams(method=method)
    frame = np.roll(frame, 20, axis=1)
    flows = estimate_flow(reference, frame[None], params)
    again = measure(prepare_reference(reference, params), [frame], flows)
    inside = np.s_[0, 30:-30, 30:-30, 0]
    assert np.median(flows[inside]) == pytest.approx(20, abs=0.1)
    assert again[inside] == pytest.approx(flows[inside], abs=0.2)


@pytest.mark.parametrize(("method", "most"), [("dis", 0.25), ("tvl1", 0.5)])
def test_the_shift_of_a_start_is_not_measured_again(monkeypatch, method, most):
    reference, params = texture(size=128), FlowParams(method=method)
    frame, target = np.roll(reference, 20, axis=1), prepare_reference(reference, params)
    flows = estimate_flow(reference, frame[None], params)

    def refuse(*arguments):
        raise AssertionError("measured again")

    monkeypatch.setattr("turbrestore.registration.camera.global_shift.measure_shift", refuse)
    again = measure(target, [frame], flows)
    # Without the shift, pixels that the frame does not show would not stay where the reference has them.
    assert np.abs(again[0, :, -18:] - flows[0, :, -18:]).max() < most


@pytest.mark.parametrize("motion", [6, 12, 20])
def test_where_half_of_the_scene_moves_the_other_stays(motion):
    """The mean of such a flow is the shift of nothing."""
    reference = texture(size=160)
    frame = reference.copy()
    frame[:, 80:] = np.roll(reference, motion, axis=1)[:, 80:]
    flows = estimate_flow(reference, frame[None])
    for _ in range(2):
        flows = measure(prepare_reference(reference), [frame], flows)
        assert np.abs(flows[0, :, :12]).max() < 0.05


@pytest.mark.parametrize(("finest", "level"), [(0, 0), (1, 1)])
def test_a_search_ends_at_its_level_and_steps_refine_it(finest, level):
    image = texture(size=64)
    dis = DisParams(finest_scale=finest)
    frame, params = np.roll(image, 2, axis=1), FlowParams(confidence=False, global_shift=False, dis=dis)
    target = prepare_reference(image, params)
    normalised = [target.prepare(one).normalised for one in (image, frame)]
    draft, whole = (next(flow for _, flow in measure_flows(target, [frame], draft=draft)) for draft in (True, False))
    searched = cv2.resize(dis_search(level).calc(*normalised, None), (32, 32), interpolation=cv2.INTER_AREA)
    assert np.array_equal(draft, cv2.resize(searched, (64, 64)))
    refined = flow_refinement(normalised[0])(normalised[1], searched)
    assert np.array_equal(whole, cv2.resize(refined, (64, 64)))


def test_a_search_near_a_start_begins_a_level_above_the_finest():
    image = (255 * texture(size=64)).astype(np.uint8)
    frame, start = np.roll(image, 2, axis=1), np.full((64, 64, 2), (1, 0), np.float32)
    solver = dis_search(1)
    solver.setCoarsestScale(2)
    found = dis_solver(DisParams(), image)(frame[None], [start.copy()], False)[0]
    assert np.array_equal(found, solver.calc(image, frame, start))


def dis_search(level):
    """OpenCV's solver with the settings of the default parameters."""
    solver = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    solver.setFinestScale(level)
    solver.setPatchStride(DisParams().patch_stride)
    solver.setVariationalRefinementIterations(DisParams().refinements)
    solver.setVariationalRefinementAlpha(DisParams().smoothness)
    return solver


def test_a_draft_of_tvl1_is_the_flow_of_the_next_coarser_level():
    reference, frame, truth = pair(rms=2.0)
    params = FlowParams(method="tvl1", confidence=False)
    draft = next(flow for _, flow in measure_flows(prepare_reference(reference, params), [frame], draft=True))
    whole = measure(prepare_reference(reference, params), [frame], [None])[0]
    errors = [endpoint_error(one[8:-8, 8:-8], truth[8:-8, 8:-8]) for one in (whole, draft)]
    assert errors[0] < errors[1] < errors[0] + 0.3
    # Between every second pixel it is interpolated.
    assert np.abs(np.diff(draft, 2, axis=0)).mean() < 0.7 * np.abs(np.diff(whole, 2, axis=0)).mean()


def test_tvl1_with_a_start_goes_through_two_levels():
    reference, frame, truth = pair(rms=2.0)
    params = FlowParams(method="tvl1", confidence=False)
    found = measure(prepare_reference(reference, params), [frame], [truth])
    grey = [
        prepare_reference(reference, params).prepare(image).normalised.astype(np.float32)
        for image in (reference, frame)
    ]
    anew = prepare_tvl1(grey[0], TvL1Params(levels=2))
    assert np.array_equal(found[0], tvl1_flows(grey[1][None], anew, truth[None]).flows[0])


@pytest.mark.parametrize("method", ["dis", "tvl1"])
def test_of_a_batch_some_have_a_start_and_some_have_none(method):
    params = FlowParams(method=method)
    reference, _, _ = pair(0)
    target = prepare_reference(reference, params)
    frames = [target.prepare(pair(seed)[1]) for seed in range(4)]
    for number in (1, 2):
        frames[number] = replace(frames[number], start=pair(number)[2])
    alone = [target.solve([frame])[0] for frame in frames]
    assert np.array_equal(target.solve(frames), alone)
    assert not np.array_equal(alone[1], target.solve([replace(frames[1], start=None)])[0])


@pytest.mark.parametrize("method", ["dis", "tvl1"])
@pytest.mark.parametrize("shape", [(16, 16), (17, 40)])
def test_a_start_in_the_smallest_images(shape, method):
    image = texture(size=64)[: shape[0], : shape[1]]
    flows, params = np.zeros((1, *shape, 2), np.float32), FlowParams(method=method)
    flows = measure(prepare_reference(image, params), [image], flows)
    assert np.abs(flows).max() < 0.1


@pytest.mark.parametrize("size", [(8, 8), (15, 64)])
def test_images_too_small_for_flow_are_refused(size):
    image = np.zeros(size, np.float32)
    with pytest.raises(DataError, match="at least 16×16 pixels"):
        estimate_flow(image, image[None])


def test_frames_of_another_size_are_refused():
    with pytest.raises(DataError, match="expected .96, 96. pixels, found .64, 64."):
        estimate_flow(texture(size=96), texture(size=64)[None])


def test_memory_of_flow_grows_with_pixels_channels_and_threads():
    grey, colour = flow_memory((9, 100, 200), 1), flow_memory((9, 100, 200, 3), 1)
    assert flow_memory((5, 200, 200), 1) == 2 * grey
    assert grey < colour
    assert flow_memory((9, 100, 200), 3) - flow_memory((9, 100, 200), 2) == flow_memory((9, 100, 200), 2) - grey > 0


def noisy_pair(noise, seed=3):
    reference, frame, flow = pair(seed)
    return reference, frame + np.random.default_rng(seed).normal(0, noise, frame.shape).astype(np.float32), flow


@pytest.mark.parametrize("noise", [0.15, 0.01])
def test_noisy_frames_and_no_others_are_smoothed_for_the_flow(noise):
    reference, frame, _ = noisy_pair(noise)
    prepared = prepare_reference(reference).prepare(frame)
    assert prepared.noisy == (noise > 0.1)
    seen = cv2.GaussianBlur(frame, (0, 0), 1.0) if prepared.noisy else frame
    expected = normalise_to_8_bits(seen, FlowParams().contrast_window, FlowParams().contrast_floor)
    assert np.array_equal(prepared.normalised, expected)


def test_noisy_and_clean_frames_of_a_batch_are_each_seen_as_they_are():
    (reference, noisy, _), (_, clean, _) = noisy_pair(0.15), noisy_pair(0.01)
    target = prepare_reference(reference)
    frames = [target.prepare(image) for image in (noisy, clean, noisy)]
    assert [frame.noisy for frame in frames] == [True, False, True]
    together = target.solve(frames)
    assert all(np.array_equal(flow, target.solve([frame])[0]) for flow, frame in zip(together, frames, strict=True))
