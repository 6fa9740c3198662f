"""Tiles with halos: that they cover frames once, and put together what was cut."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from turbrestore.core.errors import ConfigurationError
from turbrestore.runtime.tiling import add_tile, cut_tile, halo_tiles, largest_tile, new_mosaic


@pytest.mark.long
@given(st.integers(1, 200), st.integers(1, 200), st.integers(1, 20), st.integers(0, 100))
@settings(max_examples=50, deadline=None)
def test_tiles_count_for_one_at_every_pixel_and_only_far_from_their_edges(height, width, halo, more):
    side, total = 4 * halo + more, np.zeros((height, width))
    tallest, widest = largest_tile((height, width), side, halo)
    assert tallest <= height and widest <= width
    for tile in halo_tiles((height, width), side, halo):
        x, y, columns, rows = tile.roi
        assert (rows, columns) == tile.shape
        assert 0 < rows <= min(tallest, side) and 0 < columns <= min(widest, side)
        total[tile.rows, tile.columns] += np.outer(tile.row_weights, tile.column_weights)
        for weights, start, stop, length in (
            (tile.row_weights, y, y + rows, height),
            (tile.column_weights, x, x + columns, width),
        ):
            assert weights.min() >= 0 and weights.max() == pytest.approx(1)
            # Half of the halo is thrown away.
            assert start == 0 or not weights[: halo // 2].any()
            assert stop == length or not weights[len(weights) - halo // 2 :].any()
    np.testing.assert_allclose(total, 1, atol=1e-6)


@pytest.mark.parametrize("channels", [(), (3,)])
def test_what_is_cut_is_put_together_again(tmp_path, channels):
    stack = np.random.default_rng(0).random((3, 90, 170, *channels), dtype=np.float32)
    for folder in (None, tmp_path):
        mosaic = new_mosaic(stack.shape, folder)
        assert isinstance(mosaic, np.memmap) == (folder is not None)
        tiles = halo_tiles((90, 170), 64, 10)
        assert len(tiles) > 4
        for tile in tiles:
            for whole, part in zip(mosaic, cut_tile(stack, tile, folder), strict=True):
                add_tile(whole, tile, part)
        np.testing.assert_allclose(mosaic, stack, atol=1e-6)


@given(st.integers(1, 700), st.integers(1, 40), st.integers(0, 300))
@settings(max_examples=80, deadline=None)
def test_there_are_as_few_tiles_as_there_can_be(width, halo, more):
    side = 4 * halo + more
    tiles = halo_tiles((1, width), side, halo)
    fewer = len(tiles) - 1
    # Cores of equal size: the largest of fewer would not fit with its halos.
    if fewer:
        halos = {1: 0, 2: 1}.get(fewer, 2)
        assert -(-width // fewer) + halos * halo > side


def test_a_frame_no_larger_than_a_tile_is_one():
    (tile,) = halo_tiles((384, 300), 384)
    assert tile.roi == (0, 0, 300, 384)
    assert tile.row_weights.min() == tile.column_weights.min() == 1


def test_a_tile_has_room_for_its_halo():
    with pytest.raises(ConfigurationError, match=r"^side: expected at least four halos \(40 pixels\), found 39$"):
        halo_tiles((100, 100), 39, 10)
    with pytest.raises(ConfigurationError, match="^halo: expected at least 1 pixel"):
        halo_tiles((100, 100), 39, 0)
