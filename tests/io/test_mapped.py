"""Frames of a mapped file: another process is handed the name of the file, and reads the same."""

import pickle

import cloudpickle
import numpy as np
import pytest
from astropy.io import fits

from turbrestore.core.errors import DataError, InputNotFoundError
from turbrestore.io.npy import MappedFrames
from turbrestore.io.video import open_frames, write_video

FRAMES = np.random.default_rng(0).integers(0, 256, (5, 200, 210), np.uint8)


@pytest.mark.parametrize("suffix", [".npy", ".fits", ".ser", ".tif"])
def test_a_source_names_its_file_and_does_not_carry_its_frames(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    if suffix == ".fits":
        fits.PrimaryHDU(FRAMES).writeto(path)
    else:
        write_video(path, FRAMES / np.float32(255), 25)
    source = open_frames(path).select(roi=(20, 30, 40, 50))
    sent = cloudpickle.dumps(source)
    assert len(sent) < 10_000
    np.testing.assert_array_equal(pickle.loads(sent).read(), source.read())


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 0, 1, 2), (1, 2, 3, 0)])
@pytest.mark.parametrize("begin", [0, 1])
def test_views_in_any_order_of_axes(tmp_path, order, begin):
    np.save(tmp_path / "a.npy", np.arange(5 * 6 * 7 * 3, dtype=">u2").reshape(5, 6, 7, 3))
    view = np.load(tmp_path / "a.npy", mmap_mode="r").transpose(order)[begin:, :, begin:]
    frames = MappedFrames.of(view)
    assert len(pickle.dumps(frames)) < 1000
    np.testing.assert_array_equal(list(frames(range(len(view)))), view)
    np.testing.assert_array_equal(list(frames([1, 0])), view[[1, 0]])


def test_a_file_that_has_gone_or_is_shorter(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, FRAMES)
    source = open_frames(path)
    path.write_bytes(path.read_bytes()[:-1])
    assert len(source.read(0, 4)) == 4
    with pytest.raises(DataError, match=r"a\.npy: .*has changed"):
        source.read()
    path.unlink()
    with pytest.raises(InputNotFoundError):
        source.read()
