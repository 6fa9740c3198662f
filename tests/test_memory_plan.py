"""The plan of a restoration within a memory limit."""

import shutil
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_limits import least_limit

from turbrestore.core.errors import ConfigurationError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.memory_plan import _SHOWN_SIDE, plan_memory, training_share
from turbrestore.report.pictures import _LONGEST
from turbrestore.runtime.device import TORCH_BYTES
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.runtime.runtime import Runtime
from turbrestore.settings import STAGES, RestoreParams

FULL_HD, FOUR_K = (300, 1080, 1920), (300, 2160, 3840)


def plan_of(shape, limit=None, threads=2, **params):
    return plan_memory(shape, RestoreParams(**params), Runtime(threads=threads, memory_limit=limit))


def test_without_a_limit_what_fits_stays_in_memory():
    plan = plan_of((300, 480, 640), threads=3)
    assert (plan.train, plan.runtime, plan.tile, plan.decisions) == (100, Runtime(threads=3), None, ())


def test_without_a_limit_large_frames_go_to_a_file_where_the_disk_has_room(monkeypatch, tmp_path):
    def plan():
        return plan_memory(FULL_HD, RestoreParams(), Runtime(threads=3, scratch=tmp_path))

    kept = plan()
    assert kept.train == training_share(300, FULL_HD[1:])
    assert kept.runtime == Runtime(threads=3, scratch=tmp_path) and kept.tile is None
    assert [decision.choice for decision in kept.decisions] == ["training frames in a scratch file"]
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=2 * kept.scratch_bytes))
    assert (plan().runtime, plan().decisions) == (Runtime(threads=3), ())


def test_what_changes_no_result_comes_first():
    generous, tight, small = (plan_of(FULL_HD, limit, threads=8) for limit in (2e10, 2.5e9, 1.7e9))
    assert (generous.runtime.threads, generous.runtime.scratch, generous.decisions) == (8, None, ())
    assert tight.runtime.scratch is not None and 1 <= tight.runtime.threads < 8 and tight.train == 60
    assert small.runtime.threads < tight.runtime.threads and small.tile is None
    assert [decision.choice for decision in tight.decisions] == [
        "training frames in a scratch file",
        f"{tight.runtime.threads} of 8 threads",
    ]


def test_frames_too_large_for_memory_are_processed_in_tiles():
    whole, tiled, small = (plan_of(FOUR_K, limit, threads=4) for limit in (6e9, 3e9, 1.5e9))
    assert whole.tile is None
    assert tiled.train == small.train == training_share(300, FOUR_K[1:]) == 15
    assert tiled.runtime.scratch is not None and tiled.tile > small.tile
    assert tiled.decisions[0].choice.endswith("pixels, training frames in a scratch file")
    assert "the 3.00 GB allowed" in tiled.decisions[0].reason


@pytest.mark.parametrize("limit", [1.2e9, 3e9])
def test_the_size_of_tiles_does_not_follow_from_the_number_of_threads(limit):
    plans = [plan_of(FOUR_K, limit, threads) for threads in (1, 2, 16)]
    assert len({plan.tile for plan in plans}) == 1
    assert [plan.runtime.threads for plan in plans] == sorted(plan.runtime.threads for plan in plans)


@pytest.mark.long
def test_limits_with_the_same_tiles_have_the_same_side():
    plans = [plan_of(FOUR_K, limit) for limit in np.arange(1.2e9, 4e9, 3e8)]
    sides = {}
    for plan in plans:
        sides.setdefault(plan.decisions[0].choice, set()).add(plan.tile)
    assert len(sides) > 3
    assert all(len(found) == 1 for found in sides.values())
    assert [plan.tile for plan in plans] == sorted(plan.tile for plan in plans)


@pytest.mark.parametrize("method", ["nltv", "wiener"])
@pytest.mark.parametrize("channels", ["luminance", "each"])
def test_every_deconvolution_of_the_largest_video_fits_into_eight_gigabytes(method, channels):
    blur = DeconvolutionParams(method=method, channels=channels, sigma=40.0)
    assert plan_of((9, 4320, 7680, 3), 8e9, deconvolution=blur).tile is not None


def test_room_for_a_report_is_for_the_images_that_it_shows():
    assert _SHOWN_SIDE == _LONGEST


@pytest.mark.long
@given(
    st.integers(2, 3000),
    st.integers(16, 5000),
    st.integers(16, 5000),
    st.sampled_from([(), (3,)]),
    st.floats(1e6, 1e12),
    st.sampled_from(STAGES),
    st.none() | st.integers(2, 3000),
)
@settings(max_examples=20, deadline=None)
def test_a_plan_keeps_the_limit_or_names_one_that_can_be_kept(count, height, width, colour, limit, until, wanted):
    shape, wanted = (count, height, width, *colour), wanted if wanted is None else min(wanted, count)
    try:
        plan = plan_of(shape, limit, until=until, train=wanted)
    except ConfigurationError as error:
        least = MemorySize(str(error).split("expected at least ")[1].split(" for frames")[0])
        assert least > limit
        assert plan_of(shape, least, until=until, train=wanted).train >= 2
        # It is rounded, with a hundredth added.
        with pytest.raises(ConfigurationError):
            plan_of(shape, 0.97 * least, until=until, train=wanted)
        return
    share = training_share(count, shape[1:], wanted)
    # In a file there is room for a few even of the largest.
    assert 2 <= plan.train <= (share if plan.tile is None or wanted is not None else max(share, min(10, count)))
    assert plan.tile is None or (384 <= plan.tile < max(height, width) and plan.runtime.scratch is not None)
    assert 1 <= plan.runtime.threads <= 2
    assert (plan.runtime.scratch is not None) == (plan.scratch_bytes > 0)
    assert plan.deconvolution_side is None or plan.deconvolution_side >= 384


def test_torch_counts(monkeypatch):
    monkeypatch.setattr("turbrestore.memory_plan.find_device", lambda name: name)
    least = []
    for device in ("cpu", "cuda"):
        with pytest.raises(ConfigurationError) as refusal:
            plan_memory(FULL_HD, RestoreParams(), Runtime(2, 1e8, device))
        least.append(MemorySize(str(refusal.value).split("at least ")[1].split(" for frames")[0]))
    assert least[1] - least[0] == pytest.approx(TORCH_BYTES, rel=0.1)


@pytest.mark.parametrize("channels", ["luminance", "each"])
def test_the_tiles_of_the_deconvolution_do_not_follow_from_the_number_of_threads(channels):
    params, sides = {"deconvolution": DeconvolutionParams(channels=channels)}, set()
    for limit in np.arange(1.6e9, 3.4e9, 6e8):
        plans = [plan_of((25, 1080, 1920, 3), limit, threads, **params) for threads in (1, 2, 8)]
        assert len({plan.deconvolution_side for plan in plans}) == 1, limit
        said = [any("deconvolution in tiles" in item.choice for item in plan.decisions) for plan in plans]
        assert said == [plan.deconvolution_side is not None for plan in plans], limit
        sides.add(plans[0].deconvolution_side)
    assert len(sides) > 1


def test_more_memory_is_never_worse():
    plans = [plan_of((400, 2160, 3840), limit, threads=4) for limit in np.geomspace(5e9, 1e11, 20)]
    assert all(before.train <= after.train for before, after in pairwise(plans))


def test_training_frames_asked_for_are_not_made_fewer():
    with pytest.raises(ConfigurationError, match=r"of 1920×1080 and 300 training frames, found 400 MB; allow more"):
        plan_of(FULL_HD, 4e8, train=300)
    assert plan_of(FULL_HD, 2e9, train=300).train == 300


def test_two_gigabytes_are_enough_for_full_hd():
    assert plan_of(FULL_HD, 2e9).tile is None
    assert plan_of((300, 4320, 7680), 8e9).tile is not None
    assert replace(plan_of(FULL_HD, 2e9), decisions=()).train == 60


def test_the_halves_that_the_result_is_compared_with_count():
    shape, given = (24, 2160, 3840, 3), DeconvolutionParams(sigma=20.0)
    found, asked = (least_limit(shape, deconvolution=one) for one in (DeconvolutionParams(), given))
    # A width that is given is compared with nothing.
    assert found - asked > 12 * np.prod(shape[1:])
