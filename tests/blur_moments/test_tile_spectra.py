"""Tiles of an image, and the settings of the comparison of their spectra."""

import pytest

from turbrestore.blur_moments.tile_spectra import CueParams
from turbrestore.core.errors import ConfigurationError


@pytest.mark.parametrize(
    "settings_", [{"tile": 8}, {"tile": 20.5}, {"lowest": 1}, {"highest": 0.6}, {"misfit": 0}, {"departure": -1}]
)
def test_settings_are_checked(settings_):
    with pytest.raises(ConfigurationError, match=next(iter(settings_))):
        CueParams(**settings_)
