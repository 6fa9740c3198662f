"""Raw files of cameras, with JPEG beside them and without rawpy."""

import sys

import numpy as np
import pytest
from usual_files import write_dng

from turbrestore.core.errors import ConfigurationError, DataError
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.limits import Limits
from turbrestore.io.video import open_frames

MOSAIC = np.full((96, 128), 1000)
MOSAIC[::2, ::2], MOSAIC[1::2, 1::2] = 500, 600


@pytest.mark.parametrize("level", [1000, 3600])
def test_a_grey_sensor_is_grey_at_the_curve_of_bt709(tmp_path, level):
    write_dng(tmp_path / "a.dng", MOSAIC * (level // 100) // 10)
    image = read_image(tmp_path / "a.dng").image
    expected = 1.099 * (level / 4095) ** 0.45 - 0.099
    assert image.shape == (96, 128, 3)
    np.testing.assert_allclose(image, expected, atol=2e-3)


def test_frames_share_the_white_balance_of_the_first(tmp_path):
    write_dng(tmp_path / "1.dng", MOSAIC)
    write_dng(tmp_path / "2.dng", MOSAIC, neutral=(0.4, 1, 0.9))
    first, second = open_frames(tmp_path).read()
    np.testing.assert_array_equal(first, second)
    assert np.ptp(read_image(tmp_path / "2.dng").image.mean(axis=(0, 1))) > 0.05


def test_of_raw_and_jpeg_the_raw_file_is_read(tmp_path):
    for number in range(3):
        write_dng(tmp_path / f"{number}.dng", MOSAIC + 100 * number)
        write_image(tmp_path / f"{number}.png", np.full((96, 128), 0.5), 8)
    source = open_frames(tmp_path)
    assert source.shape == (3, 96, 128, 3) and source.warnings == ("3 shots found as .dng and .png: .dng is read",)
    assert np.diff(source.read().mean(axis=(1, 2, 3))).min() > 0.01


def test_refusals_are_one_line(tmp_path, monkeypatch):
    path = tmp_path / "a.dng"
    write_dng(path, MOSAIC)
    with pytest.raises(DataError, match=r"a\.dng: expected up to 100 pixels"):
        read_image(path, Limits(max_pixels=100))
    path.write_bytes(b"II*\0" + bytes(400))
    with pytest.raises(DataError, match=r"a\.dng: not a raw file"):
        read_image(path)
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(ConfigurationError, match=r"a\.dng: expected rawpy.*pip install .*rawpy>="):
        read_image(path)
