"""The plan of a restoration within a memory limit."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory_limits import least_limit

from turbrestore.core.errors import ConfigurationError
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.dynamics.dynamic_texture import DynamicsParams
from turbrestore.filtering.alternating import FilterParams
from turbrestore.memory_plan import _SHOWN_SIDE, StageMemory, _Work, check_comparison, plan_memory, training_share
from turbrestore.registration.flow import FlowParams
from turbrestore.report.pictures import _LONGEST
from turbrestore.runtime.device import TORCH_BYTES
from turbrestore.runtime.jit import COMPILER_BYTES
from turbrestore.runtime.memory_size import MemorySize
from turbrestore.settings import STAGES, RestoreParams

FULL_HD = (300, 1080, 1920)


@pytest.mark.parametrize(
    ("text", "size"),
    [("2GB", 2e9), ("1.5 GiB", 1.5 * 2**30), ("800mb", 8e8), ("64 KiB", 65536), ("12kB", 12000), ("3", 3), (7e8, 7e8)],
)
def test_sizes_are_read(text, size):
    assert MemorySize(text) == size
    assert RestoreParams(memory_limit=text).memory_limit == size


@pytest.mark.parametrize("text", ["", "GB", "2 bananas", "2QB", "0", "-1GB", "nan", "inf", "1e400GB", "2 G B", True])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(ConfigurationError, match="^--memory-limit: expected a size such as 2GB") as caught:
        MemorySize(text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("text", "meant"), [("2GBB", "2GB"), ("2G", "2GB"), ("512 k", "512kB"), ("1.5mi", "1.5MiB")])
def test_a_unit_that_is_nearly_right_is_suggested(text, meant):
    with pytest.raises(ConfigurationError, match=rf"did you mean {meant}\?"):
        MemorySize(text)


@pytest.mark.parametrize("text", ["2QB", "2 bananas", "plenty"])
def test_nothing_is_suggested_for_a_guess(text):
    with pytest.raises(ConfigurationError) as caught:
        MemorySize(text)
    assert "did you mean" not in str(caught.value)


def test_the_deconvolution_takes_a_size_too():
    assert DeconvolutionParams(memory="500MB").memory == 5e8
    with pytest.raises(ConfigurationError, match=r"^--deconvolution\.memory: expected a size such as 2GB"):
        DeconvolutionParams(memory="5QB")


def test_without_a_limit_nothing_changes():
    plan = plan_memory(FULL_HD, flow=FlowParams(threads=3))
    assert (plan.train, plan.threads, plan.in_file, plan.decisions) == (60, 3, False, ())
    assert plan.train == training_share(300, FULL_HD[1:])


def test_the_compiler_counts_where_it_is_installed(monkeypatch):
    least = []
    for installed in (False, True):
        monkeypatch.setattr("turbrestore.memory_plan.can_compile", lambda found=installed: found)
        least.append(least_limit(FULL_HD))
    assert least[1] - least[0] == pytest.approx(1.01 * COMPILER_BYTES, abs=1e7)


@pytest.mark.usefixtures("no_compiler")
def test_what_changes_no_result_comes_first():
    generous, tight, small = (plan_memory(FULL_HD, limit, flow=FlowParams(threads=8)) for limit in (2e10, 2e9, 1.4e9))
    assert (generous.threads, generous.in_file, generous.decisions) == (8, False, ())
    assert tight.in_file and 1 <= tight.threads < 8 and tight.train == 60
    assert small.threads == 1 and small.in_file
    assert [decision.choice for decision in tight.decisions] == [
        "training frames kept in a file",
        f"{tight.threads} of 8 threads",
    ]


@pytest.mark.usefixtures("no_compiler")
def test_threads_are_kept_where_a_file_is_enough():
    shape = (100, 480, 640)
    limit = 6.5e8
    alone = plan_memory(shape, limit, flow=FlowParams(threads=1))
    three = plan_memory(shape, limit, flow=FlowParams(threads=3))
    assert (three.threads, three.in_file) == (3, True)
    assert (alone.threads, alone.in_file) == (1, False)


@pytest.mark.usefixtures("no_compiler")
def test_frames_too_large_for_memory_are_worked_on_in_tiles():
    shape, four = (300, 2160, 3840), {"flow": FlowParams(threads=4)}
    whole, tiled, small = (plan_memory(shape, limit, **four) for limit in (6e9, 3e9, 1.2e9))
    assert whole.tile is None
    assert tiled.train == small.train == training_share(300, shape[1:]) == 15
    assert tiled.in_file and tiled.tight
    assert tiled.tile > small.tile
    assert tiled.decisions[0].choice.endswith("pixels, training frames kept in a file")
    assert "the 3.00 GB allowed" in tiled.decisions[0].reason


@pytest.mark.usefixtures("no_compiler")
@pytest.mark.parametrize("limit", [8e8, 1.2e9, 3e9])
def test_the_size_of_tiles_does_not_follow_from_the_number_of_threads(limit):
    plans = [plan_memory((300, 2160, 3840), limit, flow=FlowParams(threads=threads)) for threads in (1, 2, 4, 16)]
    assert len({plan.tile for plan in plans}) == 1
    assert [plan.threads for plan in plans] == sorted(plan.threads for plan in plans)
    assert plans[0].threads == 1 and plans[-1].threads >= (1 if limit < 1e9 else 2)


@pytest.mark.usefixtures("no_compiler")
def test_limits_with_the_same_tiles_have_the_same_side():
    plans = [plan_memory((300, 2160, 3840), limit) for limit in np.arange(7.2e8, 4e9, 2e7)]
    sides = {}
    for plan in plans:
        sides.setdefault(plan.decisions[0].choice, set()).add(plan.tile)
    assert len(sides) > 3
    assert all(len(found) == 1 for found in sides.values())
    assert [plan.tile for plan in plans] == sorted(plan.tile for plan in plans)


@pytest.mark.parametrize("blur", [{"sigma": 24.0}, {"sigma": 60.0}, {"boundary": "periodic"}])
def test_frames_are_cut_into_tiles_whatever_the_blur(blur):
    shape, blur = (300, 2160, 3840), {"deconvolution": DeconvolutionParams(**blur)}
    assert least_limit(shape, **blur) < 1.2 * least_limit(shape)
    assert least_limit(shape, until="filter", **blur) <= least_limit(shape)
    assert plan_memory(shape, 1.5e9, **blur).tile == plan_memory(shape, 1.5e9).tile


@pytest.mark.parametrize("boundary", ["unknown", "periodic"])
def test_the_margin_of_a_wide_blur_counts_where_there_is_one(boundary):
    shape = (300, 4320, 7680)
    least = [least_limit(shape, deconvolution=DeconvolutionParams(sigma=s, boundary=boundary)) for s in (3, 700)]
    margin = 20 * ((4320 + 8 * 700) * (7680 + 8 * 700) - 4320 * 7680)
    assert least[1] >= least[0]
    assert (least[1] > least[0] + margin / 2) == (boundary == "unknown")


@pytest.mark.parametrize("method", ["nltv", "tv", "wiener", "tikhonov"])
@pytest.mark.parametrize("channels", ["luminance", "each"])
def test_every_deconvolution_of_the_largest_video_fits_into_two_gigabytes(method, channels):
    blur = DeconvolutionParams(method=method, channels=channels, sigma=40.0)
    assert plan_memory((9, 4320, 7680), 2e9, deconvolution=blur).tile is not None


@pytest.mark.usefixtures("no_compiler")
def test_a_run_that_goes_further_has_the_same_tiles():
    assert len({plan_memory((300, 2160, 3840), 1.3e9, until=stage).tile for stage in STAGES}) == 1


def test_bounds_on_the_blur_count_in_tiles_and_so_do_the_frames_that_they_are_found_from():
    few, many = (least_limit((300, 2160, 3840), wanted=count, blur_bounds=True) for count in (60, 300))
    # Of few frames the deconvolution takes more.
    assert many > max(few, least_limit((300, 2160, 3840), wanted=300)) + 50 * 0.2 * 2160 * 3840


@pytest.mark.parametrize("shape", [(300, 4320, 7680), (300, 4320, 7680, 3)])
def test_two_gigabytes_are_enough_for_bounds_on_the_blur_of_the_largest_video(shape):
    assert plan_memory(shape, 2e9, blur_bounds=True).tile is not None


def test_a_block_counts_only_where_frames_follow_those_trained_on():
    def peak(count):
        shape = (count, 1080, 1920)
        work = _Work(shape, FilterParams(block=24), DynamicsParams(), DeconvolutionParams(), "filter", False, False)
        return work.peak(40, 2, True)

    # Of each frame its levels, and what flow prepares of it.
    assert peak(64) - peak(40) == pytest.approx(24 * 1080 * 1920 * 6)
    assert peak(300) == peak(64)


def test_bounds_on_the_blur_count_for_whole_frames():
    # So many that they outweigh the filter.
    shape = (8000, 1080, 1920)
    work = _Work(shape, FilterParams(), DynamicsParams(), DeconvolutionParams(), "deconvolve", True, False)
    assert work.peak(8000, 1, True) - work.peak(6000, 1, True) > 2000 * 0.2 * 1080 * 1920


@pytest.mark.usefixtures("no_compiler")
def test_bounds_on_the_blur_of_a_small_image_take_little():
    bounded, plain = (least_limit((300, 128, 128), blur_bounds=bounds) for bounds in (True, False))
    assert bounded < 1.1 * plain


@pytest.mark.parametrize("until", ["centroid", "deconvolve"])
@pytest.mark.parametrize("shape", [(40, 64, 64), (40, 512, 512, 3), (9, 4320, 7680), (9, 2160, 3840, 3)])
def test_a_report_fits_into_every_limit(shape, until):
    work = _Work(shape, FilterParams(), DynamicsParams(), DeconvolutionParams(), until, False, False)
    assert least_limit(shape, until=until) >= work.base + work.report()


def test_room_for_a_report_is_for_the_images_that_it_shows():
    assert _SHOWN_SIDE == _LONGEST
    small, large = (
        _Work((9, side, side, 3), FilterParams(), DynamicsParams(), DeconvolutionParams(), "deconvolve", False, False)
        for side in (2048, 8192)
    )
    # Levels of five images, one as float beside the frame, and what codes one image.
    assert small.report() > 2048**2 * (5 * 3 + 2 * 12 + 28)
    # Gradients of one image beside the frame and the image that they are of.
    assert large.report() > 8192**2 * (2 * 12 + 3 * 4)


def test_a_comparison_counts_what_whole_frames_keep_in_memory():
    shape, limit = (200, 720, 1280), 2.6e9
    plan = plan_memory(shape, limit)
    assert not plan.in_file and plan.results > 8 * plan.train * 720 * 1280
    with pytest.raises(ConfigurationError, match="--truth"):
        check_comparison(plan, limit, shape[1:], (5000, 3750))
    check_comparison(replace(plan, results=3e8), limit, shape[1:], (5000, 3750))
    check_comparison(plan_memory(shape), None, shape[1:], (50_000, 50_000))


@given(
    st.integers(2, 3000),
    st.integers(16, 5000),
    st.integers(16, 5000),
    st.sampled_from([(), (3,)]),
    st.floats(1e6, 1e12),
    st.sampled_from(["dis", "tvl1", "farneback"]),
    st.sampled_from(STAGES),
    st.none() | st.integers(2, 3000),
    st.booleans(),
    st.sampled_from([{}, {"sigma": 30.0}, {"sigma": 90.0, "boundary": "periodic"}]),
)
@settings(max_examples=100, deadline=None)
def test_a_plan_keeps_the_limit_or_names_one_that_can_be_kept(
    count, height, width, colour, limit, method, until, wanted, on_device, blur
):
    shape, wanted = (count, height, width, *colour), wanted if wanted is None else min(wanted, count)
    rest = {"flow": FlowParams(method=method, threads=4), "wanted": wanted, "until": until, "on_device": on_device}
    rest["deconvolution"] = DeconvolutionParams(**blur)
    try:
        plan = plan_memory(shape, limit, **rest)
    except ConfigurationError as error:
        words = str(error).split("expected at least ")[1].split(" for frames")[0]
        least = MemorySize(words)
        assert least > limit
        assert plan_memory(shape, least, **rest).train >= 2
        # It is rounded, with a hundredth added.
        with pytest.raises(ConfigurationError):
            plan_memory(shape, 0.97 * least, **rest)
        return
    share = training_share(count, shape[1:], wanted)
    # In a file there is room for a few even of the largest.
    assert 2 <= plan.train <= (share if plan.tile is None or wanted is not None else max(share, min(10, count)))
    assert plan.tile is None or (384 <= plan.tile < max(height, width) and plan.in_file)
    assert 1 <= plan.threads <= 4
    if until == "deconvolve":
        assert 0 < plan.deconvolution < limit
        assert DeconvolutionParams(memory=plan.deconvolution).memory == plan.deconvolution
        assert plan.file_bytes >= 0 and (plan.file_bytes > 0 or not plan.in_file)
    else:
        assert plan.deconvolution is None
        assert plan.in_file == (plan.file_bytes > 0)
    assert plan.tight or not plan.decisions


def test_a_limit_beyond_all_memory_is_none():
    assert plan_memory(FULL_HD, 2e15).deconvolution <= 1e15
    assert not plan_memory(FULL_HD, 2e15).tight


def test_torch_counts():
    limits = (plan_memory(FULL_HD, 1e12, on_device=device).deconvolution for device in (False, True))
    assert next(limits) - next(limits) == TORCH_BYTES


def test_more_memory_is_never_worse():
    plans = [plan_memory((400, 2160, 3840), limit, flow=FlowParams(threads=4)) for limit in np.geomspace(5e9, 1e11, 40)]
    assert all(before.train <= after.train for before, after in pairwise(plans))
    assert all(
        before.deconvolution <= after.deconvolution
        for before, after in pairwise(plans)
        if before.in_file == after.in_file
    )


def test_training_frames_asked_for_are_not_made_fewer():
    with pytest.raises(ConfigurationError, match=r"of 1920×1080 and 300 training frames, found 400 MB; allow more"):
        plan_memory(FULL_HD, 4e8, wanted=300)
    assert plan_memory(FULL_HD, 2e9, wanted=300).train == 300


def test_every_channel_and_thread_counts():
    memory = StageMemory(10, 3, 5, 2)
    assert memory.bytes(7, 1, 1) == 7 * 20
    assert memory.bytes(7, 3, 4) == 7 * (10 + 9 + 4 * 11)
