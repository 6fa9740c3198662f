"""The mean of the frames around a frame: where the camera was, and the scene without turbulence."""

import itertools

import cv2
import numpy as np
import pytest
from shaken_scenes import photo, psnr

from turbrestore.core.errors import DataError
from turbrestore.steady.camera_path.camera import fit_camera
from turbrestore.steady.camera_path.path import LONGEST
from turbrestore.steady.dewarping import dewarp_frame, measure_flow
from turbrestore.steady.scene_mean import iter_scene_means
from turbrestore.steady.settings import SteadyParams
from turbrestore.steady.video import steady_frames
from turbrestore.steady.windows import iter_windows
from turbrestore.synthesis.smooth_flow import SmoothFlowParams, distort, smooth_flows

SIZE = 96


def pan(count, velocity):
    """Frames of a camera that pans, and how far it has come."""
    wide = cv2.GaussianBlur(photo(size=3 * SIZE), (0, 0), 1.0)
    places = velocity * np.arange(count, dtype=float)
    return [cv2.warpAffine(wide, np.array([[1, 0, -20 - x], [0, 1, -60]]), (SIZE, SIZE)) for x in places], places


def through_air(frames, rms, seed):
    rng = np.random.default_rng(seed)
    flows = smooth_flows(len(frames), SIZE, SIZE, rng, SmoothFlowParams(rms=rms, correlation_length=20.0))
    flows -= flows.mean(axis=0)
    return [distort(frame, flow[None], rng, noise=0.0)[0] for frame, flow in zip(frames, flows, strict=True)]


@pytest.mark.parametrize("velocity", [0.0, 0.7])
def test_positions_are_those_of_the_camera(velocity):
    frames, places = pan(80, velocity)
    found = np.array([mean.position[:2, 2] for mean in iter_scene_means(frames)])
    # The scene moves to the left.
    assert found[:, 0] == pytest.approx(-places, abs=0.15)
    assert np.abs(found[:, 1]).max() < 0.15


def test_path_and_mean_are_those_of_the_frames_around():
    frames = pan(130, 0.4)[0]
    means = list(iter_scene_means(frames))
    assert len(means) == len(frames)
    for number in (0, 60, 129):
        path = means[number].path
        assert set(path) == {other - number for other in range(130) if 0 < abs(other - number) <= LONGEST}
        assert all(abs(path[j][0, 2] + 0.4 * j) < 0.2 for j in path)
        image, known = means[number].seen_from(np.eye(3))
        assert (known == 1).mean() > 0.85
        assert psnr(image, frames[number], known == 1) > 32
        # The camera sees a part of the scene that lies further to the right.
        image, known = means[number].seen_from(np.array([[1, 0, 5.0], [0, 1, 0], [0, 0, 1]]))
        assert psnr(image[:, :-5], frames[number][:, 5:], known[:, :-5] == 1) > 32


def test_a_camera_is_followed_by_what_has_texture():
    scene, rng = np.full((160, 160), 0.5, np.float32), np.random.default_rng(0)
    scene[110:130, 40:120] = cv2.GaussianBlur(photo(size=160), (0, 0), 1.0)[110:130, 40:120]
    shake = np.cumsum(rng.normal(0, 1.5, (30, 2)), 0)
    shake -= shake[0]
    frames = [
        cv2.warpAffine(scene, np.array([[1, 0, -30 - x], [0, 1, -50 - y]]), (SIZE, SIZE))
        + rng.normal(0, 0.005, (SIZE, SIZE))
        for x, y in shake
    ]
    found = np.array([mean.position[:2, 2] for mean in iter_scene_means(np.clip(frames, 0, 1))])
    # 2.6 pixels by all of the flow.
    assert np.sqrt(np.square(found + shake).mean()) < 1


def test_small_motion_of_the_camera_is_not_rounded():
    ramp = np.tile(np.linspace(0, 1, SIZE, dtype=np.float32), (SIZE, 1))
    mean = next(iter_scene_means([ramp] * 12))
    for shift in (0.01, 0.02, 0.05):
        moved = mean.seen_from(np.array([[1, 0, shift], [0, 1, 0], [0, 0, 1]]))[0]
        found = (moved - ramp)[8:-8, 8:-8].mean() * (SIZE - 1)
        assert found == pytest.approx(shift, abs=0.002)


def test_air_averages_out_of_the_mean():
    truth, _ = pan(1, 0.0)
    seen = through_air(truth * 60, 1.5, 0)
    mean = list(iter_scene_means(seen))[30]
    # The mean lies where the air has moved the whole frame, which the path tells.
    path = np.mean([camera[:, 2] for camera in mean.path.values()], 0)
    shift = fit_camera(measure_flow(truth[0], mean.seen_from(np.eye(3))[0], np.zeros((SIZE, SIZE, 2), np.float32)))[
        :, 2
    ]
    assert np.hypot(*path) > 0.3
    assert np.hypot(*(path + shift)) < 0.15


def test_a_scene_has_means_of_its_own():
    first, second = pan(1, 0.0)[0][0], photo("brick", SIZE)
    means = list(iter_scene_means([first] * 5 + [second] * 6))
    assert [len(mean.path) for mean in means] == [4] * 5 + [5] * 6
    assert psnr(means[4].seen_from(np.eye(3))[0], first) > 40
    assert psnr(means[5].seen_from(np.eye(3))[0], second) > 40


def test_frames_that_can_be_read_twice_lie_nearer_to_their_place():
    truth, _ = pan(1, 0.0)
    seen = through_air(truth * 60, 1.5, 1)
    errors = [
        np.mean([np.square(frame.image - truth[0]).mean() for frame in steady_frames(given, SteadyParams(sigma=0))])
        for given in (seen, iter(seen))
    ]
    assert errors[0] < 0.7 * errors[1]


def test_near_and_far_things_before_a_swaying_camera_are_no_turbulence():
    near, far = (cv2.GaussianBlur(photo(name, 288), (0, 0), 1.0) for name in ("brick", "camera"))
    frames = []
    for sway in 12 * np.sin(np.arange(30) / 4):
        places = [np.array([[1, 0, -60 - times * sway], [0, 1, -60]]) for times in (1, 3)]
        frame, beside = (cv2.warpAffine(*pair, (160, 160)) for pair in zip((far, near), places, strict=True))
        frame[:, :80] = beside[:, :80]
        frames.append(frame)
    still = through_air(pan(1, 0.0)[0] * 30, 1.5, 3)
    windows = [list(iter_windows(clip, SteadyParams().distances))[16] for clip in (frames, still)]
    parallax, air = (dewarp_frame(window, SteadyParams(sigma=0)).turbulence for window in windows)
    assert parallax < 0.1
    assert air > 0.9


def test_colour_on_a_coarser_grid_is_placed_as_well():
    truth = np.dstack([cv2.GaussianBlur(photo(size=280), (0, 0), sigma) for sigma in (0.7, 1.0, 1.5)])[:, :264]
    rng = np.random.default_rng(2)
    flows = smooth_flows(24, 280, 264, rng, SmoothFlowParams(rms=1.5, correlation_length=40.0))
    flows -= flows.mean(axis=0)
    seen = [np.dstack([distort(plane, flow[None], rng, noise=0.0)[0] for plane in cv2.split(truth)]) for flow in flows]
    steadied = [frame.image for frame in steady_frames(seen, SteadyParams(sigma=0))]
    before, after = (np.mean([np.square(one - truth).mean() for one in images]) for images in (seen, steadied))
    assert after < 0.2 * before


class Once:
    """Frames of a device that gives each of them once."""

    def __init__(self, frames):
        self._frames = iter(frames)

    def __iter__(self):
        return self._frames


def test_frames_that_can_be_read_once_are_all_there():
    frames = pan(1, 0.0)[0] * 30
    assert len(list(steady_frames(Once(frames), SteadyParams(sigma=0, reach=4)))) == 30


def test_fewer_frames_the_second_time_are_refused():
    class Shorter:
        def __init__(self):
            self._count = 90

        def __iter__(self):
            self._count -= 15
            return iter(pan(1, 0.0)[0] * self._count)

    with pytest.raises(DataError, match="expected the same frames every time they are read, found only"):
        list(steady_frames(Shorter(), SteadyParams(sigma=0, reach=4)))


@pytest.mark.parametrize("corner", [(0, 0), (SIZE, SIZE)])
def test_a_zoom_about_a_corner_is_followed(corner):
    scene = cv2.GaussianBlur(photo(size=2 * SIZE), (0, 0), 1.0)
    frames, zooms = [], 1.01 ** np.arange(40)
    for zoom in zooms:
        # A pixel x of a frame shows c + (x - c) zoom, from the middle of the scene.
        frames.append(
            cv2.warpAffine(
                scene,
                np.array([[zoom, 0, (1 - zoom) * corner[0] + 48], [0, zoom, (1 - zoom) * corner[1] + 48]]),
                (SIZE, SIZE),
                flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
            )
        )
    means = list(iter_scene_means(frames))
    assert 1 / np.linalg.det(means[-1].position) ** 0.5 == pytest.approx(zooms[-1], rel=0.01)


def test_only_runs_around_a_frame_are_kept():
    starts = [[run.start for run in mean.runs] for mean in iter_scene_means(pan(1, 0.0)[0] * 130)]
    for number in (0, 60, 129):
        assert min(starts[number]) > number - LONGEST - 12
        assert max(starts[number]) <= number + LONGEST + 12


def test_no_more_frames_are_read_than_the_windows_need():
    read, frames = itertools.count(), pan(1, 0.0)[0] * 200

    def counted():
        for frame in frames:
            next(read)
            yield frame

    next(iter_scene_means(counted()))
    assert next(read) <= LONGEST + 13
