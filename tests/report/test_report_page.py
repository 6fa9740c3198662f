"""The page of a report: what is in it, and what is kept out."""

import base64
import dataclasses
import hashlib
import html
import math
import shlex

import numpy as np
import pytest

from turbrestore.core.arrays import from_unit
from turbrestore.core.decision import Decision
from turbrestore.core.verdict import CheckKind
from turbrestore.deblurring.guards import GuardReading
from turbrestore.pipeline import restore
from turbrestore.report import facts, render_report
from turbrestore.report.facts import duration
from turbrestore.runs.run_record import RunRecord
from turbrestore.runtime.scratch import new_stack

from .conftest import EVIL, QUICK, Elements, decoded


def mapped(array, folder):
    """Copy an array to a file and map it."""
    copy = new_stack(array.shape, folder)
    copy[...] = array
    return copy


def test_a_report_of_images_in_files_is_the_same(whole, run, page, tmp_path):
    centroid = dataclasses.replace(
        whole.centroid, image=mapped(whole.centroid.image, tmp_path), flows=mapped(whole.centroid.flows, tmp_path)
    )
    filtered = dataclasses.replace(whole.filtered, image=mapped(whole.filtered.image, tmp_path))
    result, mean = mapped(whole.image, tmp_path), mapped(whole.mean, tmp_path)
    in_files = dataclasses.replace(whole, image=result, mean=mean, centroid=centroid, filtered=filtered)
    assert render_report(in_files, run) == page


class TestPage:
    def test_everything_it_needs_is_in_it(self, page):
        elements = Elements(page)
        for address in elements.values("src") + elements.values("href"):
            assert address.startswith(("data:image/", "#"))
        assert "url(#" in page
        assert page.count("url(") == page.count("url(#")
        assert not {"link", "iframe", "object", "base", "form"} & {tag for tag, _ in elements.found}
        assert "http:" not in page
        assert "https:" not in page

    def test_policy_allows_its_own_style_and_script_only(self, page):
        (policy,) = (a["content"] for t, a in Elements(page).found if t == "meta" and a.get("http-equiv"))
        rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
        assert rules["default-src"] == "'none'"
        assert rules["img-src"] == "data:"
        for tag in ("style", "script"):
            text = page.split(f"<{tag}>")[1].split(f"</{tag}>")[0]
            digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
            assert rules[f"{tag}-src"] == f"'sha256-{digest}'"
            assert page.count(f"<{tag}") == 1
        assert not Elements(page).values("style")
        assert not [name for _, attributes in Elements(page).found for name in attributes if name.startswith("on")]

    def test_names_are_text(self, page):
        elements = Elements(page)
        assert elements.text["title"] == [f"{EVIL} – turbrestore"]
        assert "".join(elements.text["h1"]) == EVIL
        assert "Remark: alpha channel <ignored>" in elements.text["p"]
        assert "95 % of the <motion>" in elements.text["td"]
        assert shlex.split("".join(elements.text["code"][:1])) == ["turbrestore", "restore", EVIL, "o.png"]

    def test_ids_are_unique_and_references_meet_them(self, page):
        elements = Elements(page)
        ids = elements.values("id")
        assert len(ids) == len(set(ids))
        wanted = [address[1:] for address in elements.values("href") if address.startswith("#")]
        wanted += [value[5:-1] for value in elements.values("clip-path")]
        assert wanted
        assert set(wanted) <= set(ids)

    def test_whole_run(self, page, whole):
        text = html.unescape(page)
        for word in ("Frame 3", "Mean", "Centroid", "Filtered", "Result", "3 states", "Blur by all witnesses", "numpy"):
            assert word in text
        assert f"{whole.posterior.width[1]:.2f} px" in text and f"{whole.posterior.removed:.2f} px removed" in text
        labels = [a["aria-label"] for tag, a in Elements(page).found if tag == "svg" and "aria-label" in a]
        assert len(labels) == 11
        for stage in whole.seconds.values():
            assert f"{stage:.2f} s" in text

    @pytest.mark.parametrize("until", ["centroid", "identify", "filter"])
    def test_part_of_a_run(self, frames, run, until):
        params = dataclasses.replace(QUICK, until=until)
        part = restore(frames, params)
        text = html.unescape(render_report(part, run))
        assert ("Flow model" in text) == (until != "centroid")
        assert ("Effective frames" in text) == (until == "filter")
        assert "Estimated blur" not in text
        images = [a["alt"] for tag, a in Elements(text).found if tag == "img"]
        last = ["Centroid"] if until == "filter" else []
        assert images == ["Frame 3", "Mean", *last, "Result"]

    def test_colour(self, frames):
        tinted = np.stack([frames, 0.5 * frames, 1 - frames], axis=-1)
        restoration = restore(tinted, dataclasses.replace(QUICK, until="centroid"))
        found = Elements(render_report(restoration, RunRecord("c.mkv", tinted[3]))).found
        (address,) = (a["src"] for tag, a in found if tag == "img" and a["alt"] == "Result")
        assert (decoded(address) == from_unit(restoration.image, 8)).all()

    def test_what_the_image_does_not_tell_is_said(self, whole):
        blur = dataclasses.replace(whole.blur, sigma=0.0, uncertainty=math.inf, widths=np.zeros(0), costs=np.zeros(0))
        unknown = dataclasses.replace(whole, blur=blur, posterior=None)
        (fact,) = (fact for fact in facts.findings(unknown) if fact.name == "Estimated blur")
        assert (fact.value, fact.note, fact.doubtful) == ("0.00 px", "cannot be measured", True)
        assert "could not be estimated" in [fact.note for fact in facts.headline(unknown)]

    @pytest.mark.parametrize(
        ("sigma", "removed", "limited", "reason"),
        [
            (0.9, 0.9, False, ""),
            (0.0, 0.0, False, "; whether removing more would help is doubtful"),
            (0.3, 0.3, False, "; whether removing more would help is doubtful"),
            (0.3, 0.3, True, "; the edges of the image are too steep for more"),
            (0.3, 0.9, False, "; the guards against ringing and noise forbid more"),
        ],
    )
    def test_the_headline_says_why_less_blur_is_removed_than_measured(self, whole, sigma, removed, limited, reason):
        width = np.array([0.61, 0.93, 1.2])
        posterior = dataclasses.replace(whole.posterior, width=width, removed=removed, edge_limited=limited)
        done = dataclasses.replace(whole.deconvolution, sigma=sigma)
        changed = dataclasses.replace(whole, posterior=posterior, deconvolution=done)
        (fact,) = (fact for fact in facts.headline(changed) if fact.name == "Blur removed")
        assert fact.note == f"measured 0.93 (0.61 to 1.20){reason}"

    def test_doubts_stand_at_the_top(self, whole, run):
        sure = render_report(dataclasses.replace(whole, guard_readings=()), run)
        doubt, remark = "cut short after 6 whole frames; the others are missing", "1 duplicated: frame 3 left out"
        doubted = dataclasses.replace(whole, decisions=(Decision("input", "to be checked", doubt, CheckKind.INPUT),))
        page = render_report(doubted, dataclasses.replace(run, warnings=(doubt, remark)))
        assert page.index(f"<li>{doubt}<br>") < page.index(f"Remark: {remark}") < page.index('<dl class="headline">')
        assert page.count(remark) == 1 and f"Remark: {doubt}" not in page
        assert "times as sharp as the mean of 6 frames" in sure

    def test_settings_that_differ_are_marked(self, run):
        found = facts.settings(run)
        assert [setting.name for setting in found if setting.changed] == ["centroid.iterations"]
        values = {setting.name: setting.value for setting in found}
        assert (values["train"], values["flow.global-shift"]) == ("automatic", "true")

    def test_frames_that_count(self, whole):
        shares = np.array([0.5, 0.25, 0.25])
        filtered = dataclasses.replace(whole.filtered, shares=shares, innovations=np.array([1, np.nan, 3]))
        uneven = dataclasses.replace(whole, filtered=filtered)
        found = {fact.name: fact.value for fact in facts.findings(uneven)}
        assert found["Effective frames"] == "2.7 of 3"
        assert found["Innovation"] == "2.00 px"

    def test_guards_that_object_stand_out(self, whole):
        readings = (GuardReading(2.0, 0.25, 0.125, 7.0, False), GuardReading(1.7, 0.05, 0.02, 3.0, True))
        found = facts.findings(dataclasses.replace(whole, guard_readings=readings))
        guards = [fact for fact in found if fact.name.startswith("Guards")]
        assert [fact.doubtful for fact in guards] == [True, False]
        assert guards[0].name == "Guards at 2.00 px"
        assert guards[0].value == "25% of edges ring, 12% of pixels near them overshoot, noise ×7.0"

    def test_laps_follow_each_other(self, whole):
        laps = facts.laps(whole)
        assert [lap.start for lap in laps[1:]] == pytest.approx([lap.start + lap.share for lap in laps[:-1]])
        assert sum(lap.share for lap in laps) == pytest.approx(100)


@pytest.mark.parametrize(("seconds", "text"), [(9.96, "10.0 s"), (179.9, "3 min 0 s"), (150.4, "2 min 30 s")])
def test_durations_are_rounded_as_a_whole(seconds, text):
    assert duration(seconds) == text
