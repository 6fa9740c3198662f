"""What is remembered of a still scene: its noise, geometry and blur, and what is let go."""

import dataclasses

import cv2
import numpy as np
import pytest
from shaken_scenes import SIZE, photo, psnr, windows_of_a_wall

from turbrestore.blur.posterior import BlurWitnesses
from turbrestore.core.noise_spectrum import white_noise
from turbrestore.runtime.runtime import Runtime
from turbrestore.steady.dewarping import measure_flow
from turbrestore.steady.memory import Around, Memory, remember
from turbrestore.steady.scene_mean import iter_scene_means
from turbrestore.steady.settings import SteadyParams
from turbrestore.steady.video import _Scenes
from turbrestore.steady.window_blur import WindowWitnesses, find_blur_of_image

STILL = np.eye(3)


class TestMemory:
    """Frames that have been dewarped, with displacements that are left over."""

    @staticmethod
    def remembered(frames, flows, stillness=1.0, moving=None):
        memory, still = None, np.zeros(frames[0].shape, bool)
        for number, (frame, flow) in enumerate(zip(frames, flows, strict=True)):
            mask = still if moving is None else moving[number]
            memory = remember(memory, frame, lambda *_, flow=flow: flow, 0.02, 2.0, stillness, mask, STILL, STILL)
        return memory

    def test_noise_falls_as_in_a_mean_of_all_frames(self):
        scene, rng = photo(size=64), np.random.default_rng(0)
        frames = [(scene + rng.normal(0, 0.02, scene.shape)).astype(np.float32) for _ in range(32)]
        memory = self.remembered(frames, np.zeros((32, 64, 64, 2), np.float32))
        assert 24 < memory.held.mean() <= 32
        assert np.std(memory.image - scene) < 1.3 * 0.02 / np.sqrt(32)

    def test_geometry_is_the_mean_of_all_frames(self):
        # A scene that is the first frame, then one pixel to the right of it for good: the mean lies 5/6 to the right.
        scene = cv2.GaussianBlur(photo(size=72), (0, 0), 2.0)
        first, later = scene[:, 4:68], scene[:, 3:67]
        memory = remember(None, first, measure_flow, 0.0, 2.0, 1.0, np.zeros(first.shape, bool), STILL, STILL)
        for _ in range(5):
            memory = remember(memory, later, measure_flow, 0.0, 2.0, 1.0, np.zeros(first.shape, bool), STILL, STILL)
        shift = np.median(measure_flow(first, memory.image, np.zeros((64, 64, 2), np.float32))[8:-8, 8:-8, 0])
        assert abs(shift - 5 / 6) < 0.1

    @pytest.mark.parametrize("trust", [0.0, 1.0])
    def test_geometry_is_that_of_the_frames_around_as_far_as_they_are_trusted(self, trust):
        scene = cv2.GaussianBlur(photo(size=72), (0, 0), 2.0)
        first, later = scene[:, 4:68], scene[:, 3:67]
        still = np.zeros(first.shape, bool)
        # The mean of the frames around is darker, and lies another pixel to the right.
        mean = next(iter_scene_means([0.9 * scene[:, 2:66]] * 12))
        memory, around = None, Around(mean, STILL, 2.0, trust)
        for frame in [first] + [later] * 40:
            memory = remember(memory, frame, measure_flow, 0.0, 2.0, 1.0, still, STILL, STILL, around)
        shift = np.median(measure_flow(first, memory.image, np.zeros((72, 64, 2), np.float32))[8:-8, 8:-8, 0])
        # The memory is checked against the last frames without any flow, one pixel to the right, and let go by and by.
        assert 0.9 < shift < 1.1 if not trust else 1.5 < shift < 2.1

    def test_what_has_changed_passes_at_once(self):
        scene = photo(size=64)
        changed = scene.copy()
        changed[20:44, 20:44] = 1 - changed[20:44, 20:44]
        frames = [scene] * 12 + [changed]
        memory = self.remembered(frames, np.zeros((13, 64, 64, 2), np.float32))
        inside, beyond = np.s_[24:40, 24:40], np.s_[:10]
        assert np.abs(memory.image - changed)[inside].mean() < 0.01
        assert memory.held[inside].mean() < 1.5
        assert memory.held[beyond].min() > 12

    def test_nothing_is_held_where_something_moves_or_the_camera_does(self):
        frames, flows = [photo(size=64)] * 6, np.zeros((6, 64, 64, 2), np.float32)
        moving = np.zeros((6, 64, 64), bool)
        moving[:, :32] = True
        memory = self.remembered(frames, flows, moving=moving)
        assert memory.held[:24].max() < 1.1
        assert memory.held[-16:].min() > 5
        assert self.remembered(frames, flows, stillness=0.0).held.max() == 1

    def test_weak_turbulence_leaves_nothing_to_the_memory(self):
        still = np.zeros((64, 64), bool)
        memory = remember(None, photo(size=64), measure_flow, 0.02, 1.0, 1.0, still, STILL, STILL)
        assert np.array_equal(
            remember(memory, photo("brick", 64), measure_flow, 0.02, 1.0, 1.0, still, STILL, STILL).image,
            photo("brick", 64),
        )

    def test_an_object_is_not_held_back_by_the_memory(self):
        # The flow follows the object, and draws the flat background beside it along.
        frames, flows, masks = [], [], []
        for number in range(8):
            frame, flow, mask = (np.zeros((64, 96, *size), np.float32) + 0.5 for size in ((), (2,), ()))
            left = 20 + 2 * number
            frame[24:40, left : left + 16] = photo(size=16)
            mask[24:40, left : left + 16] = 1
            flow[...] = 0
            flow[16:48, left - 8 : left + 24, 0] = 2
            frames.append(frame)
            flows.append(flow)
            masks.append(mask > 0.5)
        memory = self.remembered(frames, flows, moving=masks)
        assert psnr(memory.image, frames[-1], masks[-1]) > 30


def test_width_of_what_is_remembered_gradually_becomes_that_of_its_own_image():
    soft, short = cv2.GaussianBlur(photo(), (0, 0), 2.0), np.ones((SIZE, SIZE), np.float32)
    said, runtime = WindowWitnesses(BlurWitnesses(0.5, 11.0), 0.5), Runtime(threads=1)
    scenes = _Scenes(SteadyParams(), 0.8, said, runtime)

    def width(scenes, image, held):
        frames = 3 * held
        return scenes._remembered_width(
            Memory(image, held * short, frames, STILL, image, np.zeros((SIZE, SIZE, 2)), 0.0)
        )

    assert width(scenes, soft, 1) == 0.8
    widths = [width(scenes, soft, 10) for _ in range(80)]
    assert 0 < max(np.diff([0.8, *widths])) < 0.1
    assert widths[-1] == pytest.approx(find_blur_of_image(soft, said, 10, runtime)[0], abs=0.02)
    given = _Scenes(SteadyParams(sigma=0.8), 0.8, None, runtime)
    assert width(given, soft, 10) == 0.8
    flat = _Scenes(SteadyParams(), 0.8, said, runtime)
    assert width(flat, 0 * soft, 10) == 0.8


def test_noise_of_what_is_remembered_is_that_of_a_mean_of_the_frames_it_holds(monkeypatch):
    said, noises, frames = WindowWitnesses(BlurWitnesses(0.5, 11.0, frame_noise=white_noise(0.04)), 0.5), [], []

    def estimate(image, witnesses, noise, runtime, cautious):
        assert cautious
        noises.append(noise.deviation)
        frames.append(witnesses.independent_frames)
        return None, None

    monkeypatch.setattr("turbrestore.steady.window_blur.estimate_posterior", estimate)
    scenes, held = _Scenes(SteadyParams(), 0.8, said, Runtime(threads=1)), np.full((SIZE, SIZE), 36, np.float32)
    scenes._remembered_width(Memory(photo(), held, 36, STILL, photo(), np.zeros((SIZE, SIZE, 2)), 0.0))
    assert noises == [pytest.approx(0.04 / 6)]
    assert frames == [36]


def test_a_memory_that_has_gone_astray_is_let_go():
    wall, still = windows_of_a_wall(96, 96, 16, 16), np.zeros((96, 96), bool)

    def remembered(memory, flow):
        return remember(memory, frame, lambda *_: flow, 0.01, 2.0, 1.0, still, STILL, STILL)

    frame, none, memory = wall, np.zeros((96, 96, 2), np.float32), None
    for _ in range(12):
        memory = remembered(memory, none)
    assert memory.held[40:56, 40:56].min() > 10
    assert memory.replaced < 0.01
    # It slips by a period with every frame agreeing, but for a corner that does not repeat.
    astray = dataclasses.replace(memory, image=np.roll(wall, 5, 1))
    for _ in range(8):
        astray = remembered(astray, np.full((96, 96, 2), (-5.0, 0.0), np.float32))
    assert astray.replaced > 0.3
