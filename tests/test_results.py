"""Statements about a restoration: the verdict, and that every figure in a decision is that of the result."""

import math
from dataclasses import replace

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.decision import Decision
from turbrestore.core.verdict import CheckKind
from turbrestore.pipeline import restore
from turbrestore.settings import RestoreParams
from turbrestore.verification.structure import StructureReading


@pytest.fixture(scope="module")
def restoration():
    """A blurred chart, so that motion and blur are removed."""
    sequence = make_sequence(seed=3, count=24, size=112, rms=1.2, blur=2.2, blur_change=0.4, noise=0.005)
    return restore(sequence.frames)


def test_a_good_restoration_looks_right(restoration):
    verdict = restoration.verdict
    assert verdict.checks == ()
    assert str(verdict).endswith("; looks right")
    assert f"{restoration.sharpening:.2f} times as sharp as the mean of 24 frames" in verdict.gained
    assert f"{restoration.motion:.2f} pixels of motion" in verdict.gained
    assert f"{restoration.deconvolution.sigma:.2f} pixels of blur removed" in verdict.gained


def test_the_motion_of_the_verdict_is_that_of_the_flows(restoration):
    flows = restoration.centroid.flows
    about_mean = flows - flows.mean(axis=0)
    expected = math.sqrt(np.square(about_mean).sum(axis=-1).mean() * len(flows) / (len(flows) - 1))
    assert restoration.motion == pytest.approx(expected, rel=0.05)


OF_THE_MEAN = (CheckKind.SCENE_CHANGES, CheckKind.CONTRADICTION)


def widths(restoration, low, width, high):
    """The posterior with other quantiles of the width, the median of which is to be removed."""
    return replace(restoration.posterior, width=np.array([low, width, high]), removed=width)


def only(restoration, kept):
    """The filtered image with the first frames alone."""
    sharpness = np.where(np.arange(restoration.frame_count) < kept, restoration.filtered.sharpness, np.nan)
    return replace(restoration.filtered, sharpness=sharpness)


def test_every_doubt_is_named_once_with_a_remedy(restoration):
    done, reading, removed = restoration.deconvolution, restoration.guard_readings[-1], restoration.deconvolution.sigma
    none, frames = replace(done, sigma=0.0), restoration.frame_count
    coarse = (np.indices((112, 112)) // 2).sum(axis=0) % 2
    doubts = {
        CheckKind.INPUT: {"decisions": (Decision("input", "", "cut short", CheckKind.INPUT),)},
        CheckKind.WATERMARK: {"decisions": (Decision("overlay", "", "", CheckKind.WATERMARK),)},
        CheckKind.TWO_STATES: {"decisions": (Decision("two states", "", "--frames 0:9", CheckKind.TWO_STATES),)},
        CheckKind.SATURATED: {"decisions": (Decision("saturation", "", "3% are white", CheckKind.SATURATED),)},
        CheckKind.LARGE_MOTION: {"decisions": (Decision("motion", "", "9 pixels", CheckKind.LARGE_MOTION),)},
        CheckKind.SCENE_CHANGES: {"is_mean": True, "structure": StructureReading(0.05, 0.6, 0.2)},
        CheckKind.CONTRADICTION: {"is_mean": True, "structure": StructureReading(0.07, 0.2, 0.2)},
        CheckKind.MOTION: {"structure": StructureReading(0.0, 0.9, 0.0)},
        CheckKind.REPETITION: {"mean": coarse.astype(np.float32)},
        CheckKind.FEW_FRAMES: {"filtered": only(restoration, 7)},
        CheckKind.GEOMETRY: {"dynamics": replace(restoration.dynamics, R=1600.0)},
        CheckKind.AGREEMENT: {"disagreement": np.ones_like(restoration.disagreement)},
        CheckKind.UNSEEN: {"unseen": 0.04},
        CheckKind.NO_BLUR_REMOVED: {"deconvolution": none, "posterior": widths(restoration, 0.6, 0.9, 1.2)},
        CheckKind.BLUR_LEFT: {"posterior": widths(restoration, 1.5 * removed, 2.5 * removed, 3 * removed)},
        CheckKind.LESS_THAN_MEASURED: {
            "deconvolution": none,
            "posterior": replace(widths(restoration, 0.6, 0.9, 1.2), removed=0.0),
        },
        CheckKind.BLUR_UNKNOWN: {"blur": replace(restoration.blur, uncertainty=math.inf)},
        CheckKind.TOO_SHARP: {"guard_readings": (replace(reading, passed=False),)},
    }  # fmt: skip
    assert doubts.keys() == set(CheckKind) - {CheckKind.DRIFT}
    for kind, change in doubts.items():
        verdict = replace(restoration, **change).verdict
        assert [check.kind for check in verdict.checks] == [kind], verdict
        (check,) = verdict.checks
        assert check.text and check.remedy and "{" not in check.text + check.remedy
        assert str(verdict).endswith(f"; check: {check.text} ({check.remedy})")
        # Rings are no sharpness.
        assert ("times as sharp" in verdict.gained) == (kind not in (CheckKind.TOO_SHARP, *OF_THE_MEAN))
    assert f"{frames} frames" in restoration.verdict.gained


def test_differences_are_no_motion_where_hardly_anything_moves(restoration):
    for left, motion in ((0.6, 1.22), (0.9, 3.0), (0.2, 0.5)):
        assert StructureReading(0.0, left).motion_left(1.0) == pytest.approx(motion, rel=0.01)
    assert StructureReading(0.0, 1.0).motion_left(1.0) > 1e3
    still = replace(restoration.centroid, flows=0.1 * restoration.centroid.flows)
    changed = replace(restoration, centroid=still, structure=StructureReading(0.0, 0.9))
    assert CheckKind.MOTION not in {check.kind for check in changed.verdict.checks}


def test_too_few_of_the_frames_may_be_why_they_contradict_the_image(restoration):
    changed = replace(restoration, is_mean=True, keep_best=0.3)
    assert "leave out --keep-best" in str(changed.verdict)
    assert "keep-best" not in str(replace(restoration, is_mean=True).verdict)


@pytest.mark.parametrize(
    ("sigma", "text"), [(0.0, "no blur is removed, although 0.70 "), (0.2, "0.20 of 0.70 pixels of blur are removed")]
)
def test_a_remedy_names_the_width_that_the_guards_took_back(restoration, sigma, text):
    posterior = replace(widths(restoration, 0.61, 0.93, 1.2), removed=0.7)
    changed = replace(restoration, deconvolution=replace(restoration.deconvolution, sigma=sigma), posterior=posterior)
    (check,) = changed.verdict.checks
    assert check.text.startswith(text) and "0.93" not in str(check)
    assert check.remedy.startswith("--sigma 0.70 ")


def test_a_blur_of_pixels_alone_is_no_doubt(restoration):
    posterior = replace(widths(restoration, 0.2, 0.35, 0.6), removed=0.0)
    changed = replace(restoration, deconvolution=replace(restoration.deconvolution, sigma=0.0), posterior=posterior)
    assert changed.verdict.checks == ()


@pytest.mark.parametrize("motion", ["shift", "zoom", "turn"])
def test_motion_of_the_whole_frame_is_no_doubt_about_the_geometry(restoration, motion):
    y, x = np.mgrid[-56:56, -56:56].astype(np.float32)
    mode = {"shift": np.ones((1, 1, 2)), "zoom": np.stack([x, y], -1), "turn": np.stack([-y, x], -1)}[motion]
    sizes = np.random.default_rng(0).standard_normal((len(restoration.centroid.flows), 1, 1, 1))
    shaken = (restoration.centroid.flows + sizes * mode * 40 / np.abs(mode).max()).astype(np.float32)
    dynamics = replace(restoration.dynamics, R=1600.0)
    moved = replace(restoration, centroid=replace(restoration.centroid, flows=shaken), dynamics=dynamics)
    assert moved.verdict.checks == ()
    bent = replace(restoration, dynamics=dynamics)
    assert [check.kind for check in bent.verdict.checks] == [CheckKind.GEOMETRY]


def test_only_the_frames_that_are_kept_tell_the_geometry(restoration):
    (few,) = replace(restoration, filtered=only(restoration, 7)).verdict.checks
    assert few.text.startswith("with 7 frames, ")
    bent = replace(restoration, filtered=only(restoration, 12), dynamics=replace(restoration.dynamics, R=1600.0))
    (geometry,) = bent.verdict.checks
    assert geometry.kind is CheckKind.GEOMETRY and " 12 frames tell " in geometry.text


def test_objects_that_were_replaced_are_part_of_what_was_gained(restoration):
    verdict = replace(restoration, objects_replaced=True).verdict
    assert verdict.gained.endswith("removed, moving objects replaced by the background") and not verdict.checks


def test_an_earlier_stage_has_a_verdict_too(sequence):
    verdict = restore(sequence.frames, RestoreParams(until="centroid")).verdict
    assert verdict.gained.endswith("pixels of motion removed")


def test_a_restoration_is_printed_in_five_lines(restoration):
    lines = str(restoration).splitlines()
    assert [line.split(":")[0] for line in lines] == ["Restoration", "frames", "blur removed", "time", "verdict"]
