"""Every figure of every decision is recomputed from the result of the run and agrees."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore.core.verdict import CheckKind
from turbrestore.dynamics.flow_model import mean_flow_error
from turbrestore.pipeline import restore
from turbrestore.registration.coverage import coverage
from turbrestore.registration.recentring import recentring_flow
from turbrestore.report.facts import settings
from turbrestore.runs.run_record import RunRecord
from turbrestore.seeing.strength import LARGEST_BLUR, Estimate
from turbrestore.settings import RestoreParams
from turbrestore.wording import explain_seeing, write_check
from turbrestore_cli.options import Machine, Selection
from turbrestore_cli.output import settings_record

NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?%?")


def figures(result):
    """Figures that the decision on each subject states, in its order, as they are written."""
    sizes, seen = result.centroid.mean_flow_sizes, coverage(result.centroid.flows)
    x, y, width, height = result.crop
    cropped = (width, height) != seen.shape[::-1]
    found = {
        "training": [str(result.train), str(max(result.frame_count, result.train))],
        "centroid": [str(sizes.size), f"{sizes[0]:.2f}", f"{sizes[-1]:.2f}"],
        "border": [*(map(str, (width, height, x, y)) if cropped else ()), f"{seen.min():.0%}"],
    }
    if result.dynamics is not None:
        model = result.dynamics
        largest = abs(model.eigenvalues).max()
        found["flow model"] = [str(model.rank), f"{100 * model.energy_share:.1f}", f"{largest:.3f}"]
    if result.filtered is not None:
        filtered, counted = result.filtered, int(np.isfinite(result.filtered.sharpness).sum())
        weights = filtered.shares * counted
        found["frames"] = [str(int(np.sum(weights >= 0.2))), str(filtered.shares.size)]
        found["frames"] += [f"{filtered.sharpness_weight:.1f}", "0.2", f"{weights.max():.1f}"]
        found["frames"] += [str(counted)] if counted < filtered.shares.size else []
        moved = math.sqrt(2 * np.mean(np.square(recentring_flow(filtered.mean_flow)), dtype=np.float64))
        found["geometry"] = [f"{moved:.2f}", f"{mean_flow_error(result.dynamics, counted):.2f}"]
    return found


CASES = {
    "chart": ({"rms": 1.2, "blur_change": 0.8}, RestoreParams()),
    "photograph, half of the frames": ({"scene": "camera", "count": 30}, RestoreParams(train=20, keep_best=0.5)),
    "cropped": ({"rms": 2.0, "noise": 0.02}, RestoreParams(border="crop", until="filter")),
    "first stage": ({"rms": 0.3}, RestoreParams(until="centroid")),
}


@pytest.fixture(scope="module", params=CASES, ids=lambda name: name)
def result(request):
    clip, params = CASES[request.param]
    return restore(make_sequence(seed=len(request.param), size=80, **{"count": 12, **clip}).frames, params)


def test_every_figure_of_every_decision_is_that_of_the_result(result):
    stated = {one.subject: NUMBER.findall(f"{one.choice} {one.reason}") for one in reversed(result.decisions)}
    expected = figures(result)
    assert {subject: stated[subject] for subject in expected} == expected
    if "displacement" in stated:
        estimates = (result.seeing.displacement_by_flow, result.seeing.displacement_by_blur)
        allowed = {f"{one.value:.2f}" for one in estimates if one} | {f"{LARGEST_BLUR:g}", "95"}
        assert set(stated["displacement"]) <= allowed | {f"{result.seeing.independent_frames:.1f}"}
    if "camera" in stated:
        shifts = np.median(result.centroid.flows[:, ::4, ::4].reshape(len(result.centroid.flows), -1, 2), axis=1)
        assert stated["camera"] == [f"{np.hypot(*shifts.T).max():.1f}"]
    assert not any(re.search(r"\b(inf|nan)\b", f"{one.choice} {one.reason}") for one in result.decisions)


@pytest.mark.parametrize("frames", ["1 frame", "7 frames"])
def test_few_frames_of_any_number_make_a_sentence(frames):
    text = write_check(CheckKind.FEW_FRAMES, frames, 0.42, 8).text
    assert text.startswith(f"with {frames}, neither the motion nor the noise averages out, and the geometry is known")


def test_flow_and_blur_agree_only_where_their_intervals_overlap():
    clip, params = CASES["first stage"]
    measured = restore(make_sequence(seed=1, size=80, count=12, **clip).frames, params).seeing
    values = [Estimate(v, max(v - e, 0), v + e) for v in (0.0, 0.4, 1.5, 1.9, 2.5, 3.77) for e in (0.01, 0.3, 1.0)]
    for by_flow in values:
        for by_blur in [*values, Estimate(2.2, 1.8, math.inf)]:
            seeing = replace(measured, displacement_by_flow=by_flow, displacement_by_blur=by_blur, remarks=())
            said = [one.choice for one in explain_seeing(seeing)]
            assert ("flow and blur agree" in said) == (by_flow.low <= by_blur.high and by_blur.low <= by_flow.high)
            assert all("inf" not in one.reason.split() for one in explain_seeing(seeing))


def test_a_run_without_settings_differs_from_no_default():
    record = settings_record(RestoreParams(), Selection(), None, Machine(), None)
    run = RunRecord("clip", np.zeros((4, 4), np.float32), settings=record)
    assert [one.name for one in settings(run) if one.changed] == []
    changed = replace(run, settings=settings_record(RestoreParams(), Selection(roi="0,0,9,9"), 16, Machine(2), None))
    assert [one.name for one in settings(changed) if one.changed] == ["bit-depth", "threads", "roi"]
