"""A planet that drifts over a dark field."""

import cv2
import numpy as np
import pytest

from turbrestore.core.errors import DataError
from turbrestore.footage.object_crop import crop_to_object, find_object
from turbrestore.io.images.image_files import read_image
from turbrestore.io.source import FrameSource
from turbrestore.io.video import write_video
from turbrestore_cli.__main__ import main

PLACES = [(40 + 31 * number, 50 + 5 * number) for number in range(6)]


def planet(x, y, size=(120, 260), radius=18, seed=0, channels=()):
    """A disk with belts and a darker limb, in a dark field with noise."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    distance = np.hypot(columns - x, rows - y)
    disk = (
        np.clip(radius + 0.5 - distance, 0, 1) * (0.6 + 0.15 * np.sin((rows - y) / 2.5)) * (1 - 0.3 * distance / radius)
    )
    image = cv2.GaussianBlur(disk, (0, 0), 1.0) + 0.02 + np.random.default_rng(seed).normal(0, 0.004, size)
    return (image if not channels else image[..., None] * np.array(channels)).clip(0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def frames():
    return np.stack([planet(x, y, seed=number) for number, (x, y) in enumerate(PLACES)])


def test_place_of_an_object(frames):
    for frame, (x, y) in zip(frames, PLACES, strict=True):
        place = find_object(frame)
        assert abs(place.x - x) < 0.5 and abs(place.y - y) < 0.5 and not place.cut
        assert 30 < place.width < 44 and 30 < place.height < 44
    assert find_object(planet(4, 50)).cut
    assert (
        find_object(frames[0] * 0 + np.random.default_rng(0).normal(0.1, 0.02, frames[0].shape).astype(np.float32))
        is None
    )


@pytest.mark.parametrize("channels", [(), (1.0, 0.8, 0.5)])
def test_the_window_follows_it(channels):
    stack = np.stack([planet(x, y, seed=number, channels=channels) for number, (x, y) in enumerate(PLACES)])
    source = crop_to_object(FrameSource.from_array(np.uint16(stack * 65535)))
    assert source.shape[1] < 80 and source.shape[2] < 80 and source.bit_depth == 16
    assert "drift of 155×25 pixels" in source.warnings[0]
    centres = [find_object(frame) for frame in source]
    assert np.ptp([place.x for place in centres]) < 1.2 and np.ptp([place.y for place in centres]) < 1.2
    # Pixels are those of the file.
    first = source.read(0, 1)[0]
    x, y = cv2.minMaxLoc(cv2.matchTemplate(stack[0], first, cv2.TM_SQDIFF))[2]
    assert np.abs(stack[0, y : y + len(first), x : x + first.shape[1]] - first).max() < 1e-4


def test_selections_and_frames_without_it(frames):
    stack = np.concatenate([frames[:2], planet(2, 50)[None], frames[2:4], 0 * frames[:1] + 0.02])
    source = crop_to_object(FrameSource.from_array(stack))
    assert source.numbers == (0, 1, 3, 4) and "frames 2, 5 left out" in source.warnings[-1]
    whole = source.read()
    np.testing.assert_array_equal(source.select((1, 4, 2), (3, 4, 20, 10)).read(), whole[1:4:2, 4:14, 3:23])
    part = crop_to_object(FrameSource.from_array(stack).select((3, 5), (50, 0, 200, 120)))
    assert part.numbers == range(3, 5) and len(part.read()) == 2


def test_what_shows_no_object_is_refused(frames):
    for stack, words in ((0 * frames, "bright object"), (frames[:, 30:70, 20:60], "bright object|fills them")):
        with pytest.raises(DataError, match=words):
            crop_to_object(FrameSource.from_array(stack))


def test_option_of_the_command_line(frames, tmp_path, capsys):
    write_video(tmp_path / "a.ser", frames, 25, bit_depth=12)
    quick = ["--centroid.iterations", "1", "--filter.inner-iterations", "1", "--sigma", "0", "--threads", "1"]
    assert main(["restore", str(tmp_path / "a.ser"), str(tmp_path / "a.png"), "--crop-to-object", *quick]) == 0
    assert "cropped to the object" in capsys.readouterr().err
    image = read_image(tmp_path / "a.png").image
    assert max(image.shape) < 80
    # The belts are as deep as in a frame: nothing is smeared.
    middle = image[:, image.shape[1] // 2]
    assert np.ptp(middle[25:-25]) > 0.12
