"""Arrays that are computed or read on demand: one frame at a time, with the same result as arrays in memory."""

import numpy as np
import pytest

from turbrestore.io.source import FrameSource

FRAMES = np.random.default_rng(0).random((6, 8, 9, 3), np.float32)


@pytest.fixture
def lazy():
    """A Dask array of one frame a chunk, and the numbers of the frames that were computed."""
    import dask.array as dask_array

    computed = []

    def load(block_info=None):
        number = block_info[None]["array-location"][0][0]
        computed.append(number)
        return FRAMES[number : number + 1]

    chunks = ((1,) * 6, (8,), (9,), (3,))
    return dask_array.map_blocks(load, chunks=chunks, dtype=np.float32, meta=FRAMES[:0]), computed


def test_frames_are_computed_when_they_are_read(lazy):
    array, computed = lazy
    source = FrameSource.from_array(array)
    assert source.shape == FRAMES.shape and computed == []
    np.testing.assert_array_equal(next(iter(source.select((2, 5)))), FRAMES[2])
    assert computed == [2]
    np.testing.assert_array_equal(source.select((1, 6, 2), (1, 2, 4, 3)).read(), FRAMES[1:6:2, 2:5, 1:5])
    assert computed == [2, 1, 3, 5]


def test_labelled_arrays_stay_lazy(lazy):
    import xarray

    array, computed = lazy
    source = FrameSource.from_array(xarray.DataArray(array, dims=("time", "y", "x", "channel")))
    assert computed == [] and source.format == "array/float32"
    np.testing.assert_array_equal(source.read(3, 5), FRAMES[3:5])
    assert computed == [3, 4]
