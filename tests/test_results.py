"""Statements about a restoration: the verdict, and that every figure in a decision is that of the result."""

import math
from dataclasses import replace

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.decision import Decision
from turbrestore.pipeline import restore
from turbrestore.seeing.strength import Estimate
from turbrestore.settings import RestoreParams


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


def test_every_doubt_is_named(restoration):
    done, reading = restoration.deconvolution, restoration.guard_readings[-1]
    seeing = restoration.seeing
    missed = replace(seeing, displacement_by_flow=Estimate(0.2, 0.1, 0.3), displacement_by_blur=Estimate(1.5, 1.2, 1.8))
    doubts = {
        "no sharper than the mean": {"image": restoration.mean},
        "hardly move (0.00 pixels)": {"centroid": replace(restoration.centroid, flows=0 * restoration.centroid.flows)},
        "centroid has not converged": {"centroid": replace(restoration.centroid, converged=False)},
        "deconvolution has not converged": {"deconvolution": replace(done, converged=False)},
        "at the width that was given": {"guard_readings": (replace(reading, passed=False),)},
        "no blur is removed, because": {
            "guard_readings": (replace(reading, passed=False),),
            "deconvolution": replace(done, sigma=0.0),
        },
        "could not be measured": {"blur": replace(restoration.blur, uncertainty=math.inf)},
        "motion that the flow has missed": {"seeing": missed},
        "as noisy as the average of 1.0 frames": {"filtered": replace(restoration.filtered, shares=np.eye(24)[0])},
        "100% of the pixels are saturated or seen in no frame": {"uncertainty": restoration.uncertainty + np.inf},
        "cut short": {"decisions": (Decision("input", "", "cut short"),)},
        "the flow model is overfitted": {"dynamics": replace(restoration.dynamics, overfitted=True)},
        "3% are at full scale": {"decisions": (Decision("saturation", "", "3% are at full scale"),)},
        "may have left traces": {"decisions": (Decision("moving objects", "", ""),)},
        "the frames contradict the filtered image": {"decisions": (Decision("structure", "", ""),)},
    }  # fmt: skip
    for words, change in doubts.items():
        verdict = replace(restoration, **change).verdict
        assert any(words in check for check in verdict.checks), (words, verdict)
        assert "; check: " in str(verdict)


def test_an_earlier_stage_has_a_verdict_too(sequence):
    verdict = restore(sequence.frames, RestoreParams(until="centroid")).verdict
    assert verdict.gained.endswith("pixels of motion removed")


def test_a_restoration_is_printed_in_five_lines(restoration):
    lines = str(restoration).splitlines()
    assert [line.split(":")[0] for line in lines] == ["Restoration", "frames", "blur removed", "time", "verdict"]
