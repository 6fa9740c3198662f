"""One bar for the whole command, the verdict at its end, and decisions as they are made."""

import numpy as np
import pytest
from command_line import QUICK

from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.pipeline import restore
from turbrestore.settings import PRESETS, RestoreParams
from turbrestore_cli.clip import _expected_times
from turbrestore_cli.progress import TITLES, TimeLeft, share_done


def test_the_bar_only_moves_on_and_ends_full(sequence):
    sharper = RestoreParams(deconvolution=DeconvolutionParams(sigma=1.0))
    for name, params in (("standard", sharper), ("standard", RestoreParams(until="filter")), ("fast", PRESETS["fast"])):
        calls = []
        restore(sequence.frames, params, progress=lambda *call, calls=calls: calls.append(call))
        weights, usual = _expected_times(_Source(sequence.frames), params, name)
        shares = [share_done(weights, *call, usual.get(call[0], 1)) for call in calls]
        assert {"read"} <= {stage for stage, *_ in calls} <= set(weights) <= set(TITLES)
        assert shares == sorted(shares)
        # Without a blur to remove, the bar jumps over the deconvolution.
        assert 0 < shares[0] < 0.2 and 0.3 < shares[-1] <= 1
        # No stage counts as done before the next begins.
        assert len({round(share, 3) for share in shares}) > len(weights)


def test_a_stage_that_usually_ends_early_has_its_share_by_then():
    times, usual = _expected_times(_Source(np.empty((100, 16, 16))), RestoreParams(), "standard")
    passes = RestoreParams().centroid.iterations
    place = [share_done(times, "centroid", done, passes, usual["centroid"]) for done in (0, 1, 2, passes)]
    assert place[0] == times["read"] / sum(times.values())
    assert place[1] - place[0] == pytest.approx(times["centroid"] / sum(times.values()) / 2)
    assert place[2] == place[3] == share_done(times, "filter", 0, 9)


def test_the_time_that_is_left_never_rises():
    now = [0.0]
    left = TimeLeft(lambda: now[0])
    assert left.text(0) == ""
    for now[0], share, text in ((10, 0.1, "1:30"), (20, 0.1, "1:30"), (30, 0.3, "1:10"), (90, 0.9, "0:10")):
        assert left.text(share) == text


class _Source:
    """Length and shape of a clip, which is all that the times depend on."""

    def __init__(self, frames):
        self.shape, self.frames = frames.shape, frames

    def __len__(self):
        return len(self.frames)


def test_a_stage_without_steps_is_done_and_an_unknown_length_is_none():
    assert share_done({"centroid": 1.0, "filter": 3.0}, "filter", 0, 0) == 1.0
    assert share_done({"centroid": 1.0, "filter": 3.0}, "filter", 1, 2) == 0.625
    assert share_done({"steady": 1.0}, "steady", 12, 0) is None


def test_the_last_line_is_the_verdict_and_verbose_tells_decisions(run, clip, tmp_path):
    words = [word for word in QUICK if word != "--quiet"]
    code, _, err = run("restore", clip, tmp_path / "a.png", *words, "--sigma", "1", "--verbose")
    assert code == 0
    *decisions, last = err.splitlines()
    assert last.startswith(f"turbrestore: {tmp_path / 'a.png'} (")
    assert "times as sharp as the mean of 8 frames" in last
    assert last.endswith("; looks right") or "; check: " in last
    told = [line.split(": ")[1] for line in decisions]
    assert {"training", "centroid", "frames", "blur", "border"} <= set(told)
    code, _, err = run("restore", clip, tmp_path / "b.png", *words, "--sigma", "1")
    assert (code, len(err.splitlines())) == (0, 1)
    code, _, err = run("restore", clip, tmp_path / "c.png", "--quiet", "--verbose")
    assert code == 2 and "--verbose: contradicts --quiet" in err
