"""Videos whose channels are equal are read as grey, and no others."""

import numpy as np
import pytest

import turbrestore as tr
from turbrestore import FrameSource, check_content, clean_source
from turbrestore.footage.sensor.calibration import calibrated, make_calibration


def grey_clip(count=8, side=40, seed=0):
    rng = np.random.default_rng(seed)
    scene = rng.integers(40, 200, (side, side))
    return (scene + rng.integers(-5, 6, (count, side, side))).astype(np.uint8)


def in_colour(frames):
    return np.repeat(frames[..., None], 3, axis=-1)


def cleaned_of(frames):
    source = frames if isinstance(frames, FrameSource) else FrameSource.from_array(frames)
    return clean_source(source, check_content(source))


def test_equal_channels_are_read_as_one():
    frames = grey_clip()
    cleaned = cleaned_of(in_colour(frames))
    assert cleaned.shape == (8, 40, 40)
    np.testing.assert_array_equal(cleaned.read(), FrameSource.from_array(frames).read())
    assert cleaned.warnings == ("its three channels are equal: read as grey",)


@pytest.mark.parametrize("frame", [0, 5, 7])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_one_pixel_of_another_colour_in_any_frame_keeps_all_channels(frame, channel):
    frames = in_colour(grey_clip())
    frames[frame, 3, 4, channel] += 1
    cleaned = cleaned_of(frames)
    assert cleaned.shape == (8, 40, 40, 3)
    assert not cleaned.warnings


def test_a_selection_of_the_cleaned_clip_is_grey():
    frames = grey_clip()
    part = cleaned_of(in_colour(frames)).select(frames=(2, 6), roi=(3, 4, 20, 10))
    np.testing.assert_array_equal(part.read(), frames[2:6, 4:14, 3:23] / np.float32(255))


def test_defects_are_repaired_before_a_channel_is_taken():
    frames = grey_clip().astype(np.float32) / 255
    frames[2, 5, 6] = np.nan
    frames[:, 20, 21] = 1
    frames[4:] = frames[4:, ::-1, ::-1]
    grey, colour = cleaned_of(frames), cleaned_of(in_colour(frames))
    assert colour.shape == grey.shape
    assert [line for line in colour.warnings if "turned back" in line]
    np.testing.assert_allclose(colour.read(), grey.read(), atol=1e-6)


def test_a_flat_field_of_colours_keeps_all_channels():
    frames = in_colour(grey_clip())
    flat = FrameSource.from_array(np.full((1, 40, 40, 3), [200, 150, 100], np.uint8))
    source = FrameSource.from_array(frames)
    cleaned = cleaned_of(calibrated(source, make_calibration(source, None, flat)))
    assert cleaned.shape == (8, 40, 40, 3)
    assert np.ptp(cleaned.read(), axis=-1).max() > 0.1


def test_the_restored_image_is_that_of_the_grey_clip():
    frames = grey_clip(count=6)
    grey, colour = (tr.restore(cleaned_of(some)) for some in (frames, in_colour(frames)))
    np.testing.assert_array_equal(grey.image, colour.image)
