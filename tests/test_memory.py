"""Restorations within a memory limit: the plan, and that the result is the same."""

import contextlib
import json
import weakref
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import make_sequence
from turbrestore import pipeline
from turbrestore.alternating import FilterParams
from turbrestore.centroid import CentroidParams
from turbrestore.compiled import COMPILER_BYTES, can_compile
from turbrestore.deconvolution import DeconvolutionParams
from turbrestore.deconvolution_memory import DeconvolutionWork, Room
from turbrestore.device import TORCH_BYTES
from turbrestore.dynamics import DynamicsParams
from turbrestore.errors import ConfigurationError, StorageError
from turbrestore.flow import FlowParams
from turbrestore.frame_source import FrameSource
from turbrestore.memory import _SHOWN_SIDE, StageMemory, _Work, check_comparison, plan_memory, training_share
from turbrestore.memory_size import MemorySize
from turbrestore.nonlocal_tv import NonlocalParams
from turbrestore.report.pictures import _LONGEST
from turbrestore.restoration import STAGES, RestoreParams
from turbrestore.resumption import KeptStages, stage_facts
from turbrestore_cli.__main__ import main
from turbrestore_cli.inputs import read_input_image
from turbrestore_cli.output import describe

FULL_HD = (300, 1080, 1920)
QUICK = RestoreParams(
    train=16,
    centroid=CentroidParams(iterations=2),
    flow=FlowParams(threads=2),
    deconvolution=DeconvolutionParams(sigma=1.0, iterations=5),
)


@pytest.fixture(scope="module")
def frames():
    return make_sequence(seed=51, count=24, size=96, blur=1.0).frames


def limit_that(shape, holds, **settings):
    """Return the largest limit, in steps of 200 kB, whose plan is like that."""
    settings = {"deconvolution": QUICK.deconvolution, **settings}
    for limit in np.arange(4e8, 1.6e8, -2e5):
        plan = plan_memory(shape, limit, **settings)
        if holds(plan):
            return float(limit)
    raise AssertionError("no limit has such a plan")


def least_limit(shape, **settings):
    """Return the limit that a refusal names."""
    with pytest.raises(ConfigurationError) as refusal:
        plan_memory(shape, 1e8, **settings)
    return MemorySize(str(refusal.value).split("at least ")[1].split(" for frames")[0])


@pytest.fixture(scope="module")
def in_file(frames):
    """Settings whose plan is a file, and nothing else."""
    limit = limit_that(frames.shape, lambda plan: plan.in_file, wanted=16, flow=QUICK.flow)
    return replace(QUICK, memory_limit=limit)


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


@pytest.fixture
def no_compiler(monkeypatch):
    """What a plan chooses at a limit depends on what Numba takes, and so on whether it is installed."""
    for module in ("memory", "deconvolution_memory"):
        monkeypatch.setattr(f"turbrestore.{module}.can_compile", lambda: False)


def test_the_compiler_counts_where_it_is_installed(monkeypatch):
    least = []
    for installed in (False, True):
        monkeypatch.setattr("turbrestore.memory.can_compile", lambda found=installed: found)
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


def test_a_comparison_with_the_truth_that_breaks_the_limit_is_refused_before_the_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("truth.png", np.tile(np.arange(256, dtype=np.uint8), (6000, 12)))
    np.save("clip.npy", np.random.default_rng(0).random((4, 96, 96), np.float32))
    words = ["restore", "clip.npy", "image.png", "--truth=truth.png", "--json", "--quiet"]
    limit = MemorySize("400MB") + (COMPILER_BYTES if can_compile() else 0)
    assert main([*words, f"--memory-limit={limit}"]) == 2
    assert "--truth: expected a --memory-limit of at least 1." in capsys.readouterr().err
    assert not (tmp_path / "image.png").exists()


def test_a_comparison_counts_what_whole_frames_keep_in_memory():
    shape, limit = (200, 720, 1280), 2.6e9
    plan = plan_memory(shape, limit)
    assert not plan.in_file and plan.results > 8 * plan.train * 720 * 1280
    with pytest.raises(ConfigurationError, match="--truth"):
        check_comparison(plan, limit, shape[1:], (5000, 3750))
    check_comparison(replace(plan, results=3e8), limit, shape[1:], (5000, 3750))
    check_comparison(plan_memory(shape), None, shape[1:], (50_000, 50_000))


def test_images_are_handed_back_as_they_are_compared(frames, tmp_path, monkeypatch):
    restoration = pipeline.restore(frames[:4], replace(QUICK, train=4))
    seen, released = [], []
    monkeypatch.setattr("turbrestore_cli.output.compare", lambda image, truth: seen.append(id(image)) or QUICK.guards)
    monkeypatch.setattr("turbrestore.scratch.release", lambda image: released.append(id(image)))
    describe(restoration, frames[0])
    assert len(seen) == 4 and released == seen


def test_a_truth_in_the_folder_of_the_stages_is_refused(frames, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("clip.npy", frames[:4])
    (tmp_path / "stages").mkdir()
    cv2.imwrite("stages/mean.png", np.zeros((96, 96), np.uint8))
    words = ["restore", "clip.npy", "image.png", "--truth=stages/mean.png", "--keep=stages", "--overwrite", "--quiet"]
    assert main(words) != 0
    assert "stages/mean.png: is an input or output already" in capsys.readouterr().err


def test_the_truth_is_not_in_memory_while_others_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sequence = make_sequence(seed=51, count=4, size=96, blur=1.0)
    cv2.imwrite("truth.png", (255 * sequence.scene).astype(np.uint8))
    np.save("clip.npy", sequence.frames)
    truths = []

    def read(*words):
        image = read_input_image(*words)
        truths.append(weakref.ref(image))
        return image

    def run(*words):
        assert [truth() for truth in truths] == [None]
        return pipeline.restore(*words)

    monkeypatch.setattr("turbrestore_cli.restore.read_input_image", read)
    monkeypatch.setattr("turbrestore_cli.restore.run_pipeline", run)
    quick = ["--centroid.iterations=1", "--sigma=1", "--deconvolution.iterations=2", "--quiet"]
    assert main(["restore", "clip.npy", "image.png", "--truth=truth.png", "--json", *quick]) == 0
    assert "psnr" in json.loads(capsys.readouterr().out)["stages"]["deconvolved"]
    assert len(truths) == 2


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


def test_a_limit_for_a_run_that_does_not_deconvolve(frames):
    limit = limit_that(frames.shape, lambda plan: plan.in_file, wanted=24, flow=QUICK.flow, until="centroid")
    settings = replace(QUICK, train=24, until="centroid", deconvolution=DeconvolutionParams(), memory_limit=limit)
    assert pipeline.restore(frames, settings).train == 24


def test_room_is_asked_for_all_files(frames, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(pipeline, "check_space", lambda path, size: asked.append((path.parent, size)))
    settings = replace(QUICK, deconvolution=DeconvolutionParams(sigma=1.0, iterations=2, memory="1MB"))
    pipeline.restore(frames, settings, scratch=tmp_path)
    # The margin of four widths is part of it.
    work = DeconvolutionWork((104, 104), 1, "nltv", NonlocalParams())
    assert asked == [(tmp_path, int(work.files(Room(1, True, True))))]


def test_pairs_lie_in_the_folder_that_is_named(frames, tmp_path, monkeypatch):
    def full(shape, folder):
        raise StorageError(f"{folder} has no room")

    for module in ("nonlocal_tv", "nonlocal_penalty"):
        with monkeypatch.context() as patch:
            patch.setattr(f"turbrestore.{module}.new_stack", full)
            settings = replace(QUICK, deconvolution=DeconvolutionParams(sigma=1.0, memory="1MB"))
            with pytest.raises(StorageError, match=rf"^{tmp_path} has no room"):
                pipeline.restore(frames, settings, scratch=tmp_path)


@pytest.mark.parametrize(("limit", "kept", "tight"), [(None, 1, 0), ("20GB", 0, 0), ("400MB", 0, 1)])
def test_freed_memory_is_kept_without_a_limit_and_given_back_where_it_is_tight(frames, monkeypatch, limit, kept, tight):
    seen = []

    @contextlib.contextmanager
    def setting(name, wanted):
        seen.append((name, wanted))
        yield
        seen.append(name)

    def deblur(*_):
        seen.append("deblur")
        raise StorageError("seen")

    for name in ("returning_freed", "keeping_freed"):
        monkeypatch.setattr(pipeline, name, partial(setting, name))
    monkeypatch.setattr(pipeline, "_deblur", deblur)
    with pytest.raises(StorageError, match="seen"):
        pipeline.restore(frames, replace(QUICK, memory_limit=limit))
    assert seen == [("returning_freed", tight), ("keeping_freed", kept), "keeping_freed", "deblur"]


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


def test_the_result_is_the_same_bit_for_bit(frames, in_file, tmp_path):
    free, limited = (pipeline.restore(frames, params, scratch=tmp_path) for params in (QUICK, in_file))
    assert isinstance(limited.centroid.flows, np.memmap)
    assert isinstance(limited.dynamics.C, np.memmap)
    for name in ("image", "mean"):
        assert np.array_equal(getattr(free, name), getattr(limited, name))
    assert np.array_equal(free.centroid.flows, limited.centroid.flows)
    assert np.array_equal(free.dynamics.C, limited.dynamics.C)
    assert np.array_equal(free.filtered.image, limited.filtered.image)
    assert limited.decisions[0].subject == "memory"
    assert limited.decisions[1:] == free.decisions
    assert not list(tmp_path.iterdir())


def test_the_file_lies_in_the_folder_that_is_named(frames, in_file, tmp_path):
    with pytest.raises(StorageError, match="nowhere"):
        pipeline.restore(frames, in_file, scratch=tmp_path / "nowhere")


def test_a_disk_without_room_is_refused_before_the_work(frames, in_file, tmp_path, monkeypatch):
    def full(path, size):
        raise StorageError(f"{path}: needs {size}")

    monkeypatch.setattr(pipeline, "check_space", full)
    monkeypatch.setattr(pipeline, "find_centroid", None)
    with pytest.raises(StorageError, match="what memory does not hold: needs"):
        pipeline.restore(frames, in_file, scratch=tmp_path)


def test_a_limit_changes_nothing_that_a_stage_depends_on(frames, in_file):
    source = FrameSource.from_array(frames)
    assert stage_facts(source, in_file) == stage_facts(source, QUICK)
    fewer = limit_that(frames.shape, lambda plan: plan.train < 24, flow=QUICK.flow, dynamics=DynamicsParams(rank=20))
    loose, strict = (
        replace(QUICK, train=None, dynamics=DynamicsParams(rank=20), memory_limit=limit) for limit in (4e8, fewer)
    )
    assert stage_facts(source, loose) != stage_facts(source, strict)


@pytest.mark.usefixtures("no_compiler")
def test_a_stage_depends_on_the_size_of_the_tiles():
    source = FrameSource.from_array(np.zeros((12, 800, 1000)))
    loose, strict = (stage_facts(source, replace(QUICK, train=None, memory_limit=limit)) for limit in (1e9, 4e8))
    assert "tile" not in loose["centroid"] and strict["centroid"].pop("tile") >= 384
    assert strict == loose


def test_the_command_restores_large_frames_in_tiles(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # Wide frames, so that the whole is out of reach at a size that a test has time for.
    frames = np.tile(make_sequence(seed=53, count=4, size=200, blur=1.0).frames, (1, 2, 5))
    np.save("clip.npy", frames)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    quick = ["--centroid.iterations=2", "--sigma=1", "--deconvolution.iterations=10", "--quiet"]
    limit = f"--memory-limit={least_limit(frames.shape)}"
    assert main(["restore", "clip.npy", "tiled.png", limit, "--json", *quick]) == 0
    assert "tiles of up to" in json.loads(capsys.readouterr().out)["decisions"][0]["choice"]
    assert main(["restore", "clip.npy", "whole.png", *quick]) == 0
    found, usual = (cv2.imread(name, cv2.IMREAD_GRAYSCALE).astype(float) for name in ("tiled.png", "whole.png"))
    assert found.shape == usual.shape == (400, 1000)
    assert np.sqrt(np.mean((found - usual) ** 2)) < 6
    assert not list((tmp_path / "temporary").iterdir())


def test_the_command_says_what_the_limit_caused_and_leaves_no_file(frames, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("clip.npy", frames)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    quick = ["--train=16", "--flow.threads=2", "--until=identify", "--centroid.iterations=1", "--quiet"]
    least = limit_that(frames.shape, lambda plan: plan.in_file, wanted=16, flow=QUICK.flow, until="identify")
    limit = f"--memory-limit={least / 1e6}MB"
    for words in ([], ["--keep=kept"]):
        assert main(["restore", "clip.npy", f"o{len(words)}.png", limit, "--json", *quick, *words]) == 0
        decisions = json.loads(capsys.readouterr().out)["decisions"]
        assert decisions[0]["choice"] == "training frames kept in a file"
    assert "memory_limit = " in Path("o0.png.toml").read_text()
    assert main(["restore", "clip.npy", "again.png", "--config=o0.png.toml", "--quiet"]) == 0
    assert Path("again.png").read_bytes() == Path("o0.png").read_bytes()
    assert not list((tmp_path / "temporary").iterdir())
    assert not [path for path in Path("kept").iterdir() if path.name.startswith("turbrestore-")]


def test_a_kept_run_goes_on_with_another_limit(frames, in_file, tmp_path, monkeypatch):
    monkeypatch.setattr("turbrestore.npy._LARGE", 1000)
    source = FrameSource.from_array(frames)
    first = KeptStages(tmp_path, source, QUICK)
    whole = pipeline.restore(source, QUICK, done=first.done, on_result=first.keep)
    later = KeptStages(tmp_path, source, in_file, resume=True)
    assert later.notes == ("goes on after the deconvolution",)
    assert isinstance(later.done.centroid.flows, np.memmap)
    # In another order products with it, and so the filter, would differ in the last bit.
    assert isinstance(later.done.dynamics.C, np.memmap)
    assert later.done.dynamics.C.strides == whole.dynamics.C.strides
    again = pipeline.restore(source, in_file, done=later.done, scratch=tmp_path)
    assert np.array_equal(again.image, whole.image)
    # And what a limited run keeps is what any run keeps.
    limited = KeptStages(tmp_path, source, in_file)
    pipeline.restore(source, in_file, done=limited.done, on_result=limited.keep, scratch=tmp_path)
    found = KeptStages(tmp_path, source, QUICK, resume=True).done
    assert np.array_equal(found.centroid.flows, whole.centroid.flows)
    assert np.array_equal(found.dynamics.C, whole.dynamics.C)


@pytest.mark.parametrize("records", [16, 40])
def test_a_limited_run_interrupted_in_the_filter_ends_the_same(tmp_path, records):
    frames = make_sequence(seed=52, count=64, size=96, blur=1.0).frames
    limit = limit_that(frames.shape, lambda plan: plan.in_file, wanted=16, flow=QUICK.flow)
    params, source = replace(QUICK, memory_limit=limit), FrameSource.from_array(frames)
    (scratch := tmp_path / "scratch").mkdir()
    (folder := tmp_path / "kept").mkdir()
    kept = KeptStages(folder, source, params, every=1)

    def keep(done):
        kept.keep(done)
        if done.filtered is None and done.checkpoint is not None and len(done.checkpoint.records) == records:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pipeline.restore(source, params, on_result=keep, scratch=scratch)
    assert not list(scratch.iterdir())
    done = KeptStages(folder, source, params, resume=True).done
    assert len(done.checkpoint.records) == records
    resumed, whole = (pipeline.restore(source, params, done=one, scratch=scratch) for one in (done, None))
    assert isinstance(whole.centroid.flows, np.memmap)
    for name in ("image", "variance", "shares", "flow_states"):
        assert np.array_equal(getattr(resumed.filtered, name), getattr(whole.filtered, name))
    assert np.array_equal(resumed.image, whole.image)
    assert not list(scratch.iterdir())
