"""Tiles of an image, and the settings of the comparison of their spectra."""

import numpy as np
import pytest

from turbrestore.blur_moments.tile_spectra import CueParams, TileGrid, tile_map
from turbrestore.core.errors import ConfigurationError


def test_tile_map_keeps_planes_between_the_centres():
    rows, columns = np.array([0, 8, 16]), np.array([0, 8])
    grid = TileGrid(rows, columns, (16, 16), (32, 24))
    plane = (rows[:, None] + 7.5) * 2 + (columns + 7.5)
    y, x = np.mgrid[8:23, 8:15]
    assert tile_map(plane, grid)[8:23, 8:15] == pytest.approx(2 * y + x, abs=1e-3)


@pytest.mark.parametrize(
    "settings_", [{"tile": 8}, {"tile": 20.5}, {"lowest": 1}, {"highest": 0.6}, {"misfit": 0}, {"departure": -1}]
)
def test_settings_are_checked(settings_):
    with pytest.raises(ConfigurationError, match=next(iter(settings_))):
        CueParams(**settings_)
