"""Objects in front of a scene: known paths, masks, and the air in front of them."""

import cv2
import numpy as np

from turbrestore.synthesis.anisoplanatic import phase_screen_frames
from turbrestore.synthesis.atmosphere import PhaseScreenParams
from turbrestore.synthesis.moving_objects import MovingObject, draw_objects, with_objects

SCENE = np.tile(np.linspace(0.2, 0.8, 64, dtype=np.float32), (48, 1))
BALL = MovingObject(start=(20.0, 24.0), velocity=(1.5, -0.5), semi_axes=(7.0, 5.0), brightness=0.8, direction=0.3)


def test_an_object_moves_along_its_path_and_leaves_the_scene_as_it_is():
    for number in (0, 4, 9):
        image, mask = with_objects(SCENE, [BALL], number)
        rows, columns = np.nonzero(mask)
        assert abs(columns.mean() - (20 + 1.5 * number)) < 0.2
        assert abs(rows.mean() - (24 - 0.5 * number)) < 0.2
        assert abs(mask.sum() - np.pi * 35) < 8
        beyond = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3))) == 0
        assert np.array_equal(image[beyond], SCENE[beyond])


def test_stripes_travel_with_the_object():
    first, later = (with_objects(SCENE, [BALL], number)[0] for number in (0, 2))
    assert np.allclose(first[22:27, 16:25], later[21:26, 19:28], atol=1e-5)


def test_an_object_that_left_enters_again():
    seen = [with_objects(SCENE, [BALL], number)[1].any() for number in range(300)]
    assert seen[0]
    assert not all(seen)
    assert any(seen[seen.index(False) :])


def test_the_air_is_that_of_the_clip_without_objects():
    params = PhaseScreenParams(layers=2, pupil_samples=24)
    with_ball, without = (
        list(phase_screen_frames(SCENE, 2, np.random.default_rng(0), params, objects=objects))
        for objects in ([BALL], [])
    )
    for number, (one, other) in enumerate(zip(with_ball, without, strict=True)):
        assert np.array_equal(one.flow, other.flow)
        mask = with_objects(SCENE, [BALL], number)[1].astype(np.uint8)
        assert np.median(np.abs(one.image - other.image)[cv2.erode(mask, np.ones((5, 5))) > 0]) > 0.1
        far = cv2.dilate(mask, np.ones((31, 31))) == 0
        assert np.abs(one.image - other.image)[far].mean() < 0.01


def test_colours_and_random_objects():
    objects = draw_objects(3, SCENE.shape, np.random.default_rng(0))
    colour, mask = with_objects(np.stack([SCENE] * 3, -1), objects, 5)
    assert np.array_equal(colour[..., 1], with_objects(SCENE, objects, 5)[0])
    assert mask.shape == SCENE.shape
