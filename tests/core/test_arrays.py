import numpy as np
import pytest

from turbrestore.core.arrays import check_flow, check_frames, check_image, from_unit, luminance
from turbrestore.core.errors import DataError
from turbrestore.runtime.scratch import to_scratch


def test_integers_are_scaled_by_their_type():
    assert check_image(np.array([[0, 65535]], np.uint16)).tolist() == [[0.0, 1.0]]
    assert check_frames(np.full((1, 2, 2), 255, np.uint8)).max() == 1.0


def test_a_right_array_is_not_copied():
    image = np.zeros((3, 4), np.float32)
    assert check_image(image) is image


@pytest.mark.parametrize("bad", [(np.nan, np.nan), (np.inf, np.inf), (-np.inf, -np.inf), (np.inf, -np.inf)])
def test_values_that_are_not_finite_are_counted(bad):
    """Infinities of both signs do not cancel."""
    image = np.zeros((4, 5), np.float32)
    image[1, 2], image[3, 4] = bad
    with pytest.raises(DataError, match="found 2 NaN or infinite"):
        check_image(image)


@pytest.mark.parametrize("shape", [(3,), (2, 2, 2), (2, 2, 4), (0, 3), (1, 2, 3, 3)])
def test_images_of_wrong_shape_are_refused(shape):
    with pytest.raises(DataError):
        check_image(np.zeros(shape))


def test_frames_and_flows_of_wrong_shape_are_refused():
    with pytest.raises(DataError, match="at least 2 frames, found 1"):
        check_frames(np.zeros((1, 4, 4)), at_least=2)
    with pytest.raises(DataError, match="found \\(4, 4, 3\\)"):
        check_flow(np.zeros((4, 4, 3)))
    with pytest.raises(DataError, match="floating point or unsigned"):
        check_image([["a", "b"]])
    with pytest.raises(DataError, match="expected real numbers"):
        check_flow("text")


@pytest.mark.parametrize("shape", [(50, 40, 3), (7, 10, 12, 3)])
def test_a_large_image_in_parts_is_the_same(shape, tmp_path, monkeypatch):
    image = np.random.default_rng(0).random(shape, dtype=np.float32)
    grey, levels = luminance(image), from_unit(image, 12)
    assert np.array_equal(levels, np.rint(image * np.float64(4095)))
    monkeypatch.setattr("turbrestore.core.arrays.PART", 500)
    for kept in (image, to_scratch(image, tmp_path)):
        assert np.array_equal(luminance(kept), grey)
        assert np.array_equal(from_unit(kept, 12), levels)


def test_luminance_weighs_green_most():
    red, green, blue = (luminance(np.eye(3, dtype=np.float32)[i].reshape(1, 1, 3)).item() for i in range(3))
    assert green > red > blue
    assert red + green + blue == pytest.approx(1.0)


@pytest.mark.parametrize("depth", [1, 8, 10, 12, 16])
def test_quantising_keeps_every_level(depth):
    levels = np.arange(2**depth)
    unit = (levels / (2**depth - 1)).astype(np.float32)
    assert (from_unit(unit, depth) == levels).all()
