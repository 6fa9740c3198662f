"""Records that were changed: what is refused, and in which words."""

import math

import pytest

from turbrestore.core.errors import DataError
from turbrestore.deblurring.guards import GuardReading
from turbrestore.registration.centroid import CentroidParams
from turbrestore.results import Restoration
from turbrestore.runs.typed_records import KeptRecord, convert_to
from turbrestore.seeing.strength import Estimate, Seeing

READING = {"sigma": 1, "ringing": math.nan, "overshoot": math.inf, "noise_gain": 0.5, "passed": True}
SEEING = dict.fromkeys(("displacement_variance", "displacement_variance_x", "displacement_variance_y"))
SEEING |= dict.fromkeys(("displacement_by_flow", "isoplanatic_patch", "coherence_time", "wind_anisotropy"))
SEEING |= {"wind_direction": 1, "independent_frames": 2.5, "rotation": 0, "remarks": ["a", "b"]}
SEEING["displacement_by_blur"] = {"value": 1, "low": 0.5, "high": math.inf}


def test_what_was_written_comes_back_and_numbers_need_not_be_finite():
    reading = convert_to(GuardReading, READING, "a")
    assert reading == GuardReading(1.0, reading.ringing, math.inf, 0.5, True)
    assert math.isnan(reading.ringing) and type(reading.sigma) is float
    seeing = convert_to(Seeing, SEEING, "a")
    assert (seeing.displacement_by_blur, seeing.remarks) == (Estimate(1.0, 0.5, math.inf), ("a", "b"))


def test_a_message_names_the_place_what_was_expected_and_what_was_found():
    for kind, found, told in (
        (KeptRecord, {"files": {"a.npz": 1}}, "expected files[...] to be `str`, found `int`"),
        (KeptRecord, {"facts": {"centroid": []}}, "expected facts[...] to be `object`, found `array`"),
        (KeptRecord, [1], "expected the record to be `object`, found `array`"),
        (tuple[GuardReading, ...], [{}], "Object missing required field `sigma` in [0]"),
        (GuardReading, READING | {"passed": 1}, "expected passed to be `bool`, found `int`"),
        (GuardReading, READING | {"sigma": True}, "expected sigma to be `float`, found `bool`"),
        (GuardReading, READING | {"sigma": 10**400}, "Number out of range in sigma"),
        (Seeing, SEEING | {"remarks": "text"}, "expected remarks to be `array`, found `str`"),
        (Restoration, {"image": [1.0]}, "expected image to be `numpy.ndarray`, found `list`"),
        (CentroidParams, {"tolerance": -1}, "tolerance: expected"),
    ):
        with pytest.raises(DataError) as caught:
            convert_to(kind, found, "run.json")
        assert str(caught.value).startswith(f"run.json: {told}"), caught.value
