"""Clips that nothing was chosen on, tables that split by them, what a table is of, and texts with their figures."""

import sys

import all as everything
import blur_clips
import clips
import cv2
import history
import numpy as np
import oracles
import provenance
import pytest
import quality
import quality_change
import texts
import words
from provenance import LINE, outdated, revision, with_origin

import turbrestore
from turbrestore.io.images.image_files import read_image
from turbrestore.registration.flow import estimate_flow
from turbrestore.registration.warp import warp
from turbrestore.synthesis.smooth_flow import smooth_flows


class TestDrawnClips:
    def test_they_are_those_of_the_version(self):
        one, same, other = (clips.drawn_clips(version)["drawn_lens_coins"]() for version in ("1.0", "1.0", "1.1"))
        np.testing.assert_array_equal(one.frames, same.frames)
        assert not np.array_equal(one.truth, other.truth)
        assert one.frames.dtype == np.float32
        # The truth is the scene in the geometry of the frames: their mean lies about it.
        errors = [np.abs(one.frames.mean(axis=0) - truth).mean() for truth in (one.truth, other.truth)]
        assert errors[0] < 0.5 * errors[1]

    def test_frames_behind_a_lens_are_moved_from_the_truth_by_flows_that_are_zero_on_average(self, monkeypatch):
        made, side = [], blur_clips.FINER
        monkeypatch.setattr(blur_clips, "smooth_flows", lambda *given: made.append(smooth_flows(*given)) or made[0])
        case = blur_clips.Case("t", "grass", "lens", 0.0)
        frames, truth = blur_clips.behind_lens(case, np.random.default_rng(1))
        flows = (made[0] - made[0].mean(axis=0)) / side
        edge = side * blur_clips.EDGE
        flows = flows[:, edge:-edge:side, edge:-edge:side]
        errors = (estimate_flow(truth, frames) - flows)[:, 20:-20, 20:-20]
        assert 1.1 < np.sqrt(np.square(flows).mean()) < 1.5
        assert np.median(np.abs(errors)) < 0.1
        assert np.median(np.abs(errors.mean(axis=0))) < 0.06

    def test_a_lens_blurs_by_its_width(self):
        case = blur_clips.Case("t", "grass", "quiet", 1.5)
        frames, truth = blur_clips.behind_lens(case, np.random.default_rng(1))
        blurred = cv2.GaussianBlur(truth, (0, 0), case.number)
        np.testing.assert_allclose(frames.mean(axis=0)[10:-10, 10:-10], blurred[10:-10, 10:-10], atol=0.02)

    def test_frames_behind_a_perfect_lens_are_as_fine_as_the_scene(self):
        def detail(image):
            return np.square(cv2.Laplacian(np.float32(image), cv2.CV_32F)[20:-20, 20:-20]).mean()

        for name, seed in (("grass", 1), ("coins", 2)):
            frames, truth = blur_clips.behind_lens(blur_clips.Case("t", name, "lens", 0.0), np.random.default_rng(seed))
            # Noise of deviation 0.008 has a Laplacian of 20 times its variance.
            found = np.mean([detail(frame) for frame in frames]) - 20 * 0.008**2
            assert 0.9 < found / detail(truth) < 1.1

    def test_no_other_clip_shows_their_scenes(self):
        shown = {
            name.split("_")[-1] for name in clips.find_clips() if name.startswith(("smooth_", "strong", "screens_"))
        }
        assert not shown & set(clips.DRAWN_SCENES)
        assert not set(clips.DRAWN_SCENES) & set(blur_clips.CHOSEN)

    def test_they_are_found_and_told_apart(self):
        assert {*filter(clips.is_reported, clips.find_clips())} == {*clips.drawn_clips(turbrestore.__version__)}


def test_a_release_is_compared_with_the_one_before():
    releases = [
        history.Release(name, psnr, (1.0, 2.0, 3.0), (9.0, 9.0, 9.0), 1000)
        for name, psnr in (("1.0", (30.0, 31.0, 29.0)), ("1.1", (20.0, 20.0, 20.0)), ("1.2", (21.0, 19.0, 23.0)))
    ]
    first, _, last = [line for line in history.document(releases, 20.0).splitlines() if line.startswith("| 1.")]
    assert first == "| 1.0 | 30.00 | – | – | 2.0 | 9 | 1,000 |"
    # Gains of 1, −1 and 3 dB: their standard deviation is 2.
    assert last == "| 1.2 | 21.00 | +1.00 ± 1.15 | -1.00 | 2.0 | 9 | 1,000 |"


def test_reported_and_other_clips_have_means_of_their_own():
    rows = {"drawn_air_page": 30.0, "drawn_lens_page": 20.0, "smooth_cat": 40.0}
    figures = {clip: {"default": {"psnr": value, "ssim": 0.5}} for clip, value in rows.items()}
    text = quality.document(figures)
    reported, others = text.split("## PSNR, dB\n")[1].split("## ")[0].split("| **mean** |")[1:]
    assert "25.00" in reported and "smooth_cat" in reported and "40.00" in others


def test_what_is_read_of_dithered_copies_does_not_depend_on_the_last_bits(monkeypatch):
    monkeypatch.setitem(words.READERS, "bits", lambda path: [["word"] if read_image(path).image[32, 32] > 0.5 else []])
    below, above = (np.full((24, 24), (127.5 + bit) / 255, np.float32) for bit in (-1e-3, 1e-3))
    assert [words.share_read(image, ("word",), "bits") for image in (below, above)] == [0, 1]
    one, other = (words.shares_read(image, ("word",), "bits") for image in (below, above))
    np.testing.assert_array_equal(one, other)
    assert 0 < one.mean() < 1


def test_the_change_of_words_has_the_standard_error_of_its_mean():
    shares = np.array([[0.5, 0.6, 0.7, 0.8], [0.6, 0.6, 0.8, 0.8]], np.float32)
    row = quality_change._row("clip", quality_change.Change({}, shares, 1.0))
    # Changes of 0.1, 0, 0.1 and 0: their deviation is 0.2 / √12, and that of their mean half of it.
    assert row.endswith("| 0.650 | 0.700 | +0.050 ± 0.029 |")


def test_a_table_says_what_it_is_of_once():
    once = with_origin("# Title\n\nText.\n")
    assert with_origin(once).count("turbrestore") == 1
    found = LINE.search(once)
    assert found["version"] == turbrestore.__version__ and found["revision"] == revision()
    assert LINE.sub("", once) == "# Title\n\nText.\n"


def test_oracles_know_the_motion_and_the_blur():
    case = oracles.Case(count=6, displacement=1.5, blur=1.2, noise=0.0)
    frames, flows, truth, _ = oracles.clip("coins", case)
    inside = np.s_[12:-12, 12:-12]
    blurred = cv2.GaussianBlur(truth, (0, 0), case.blur)
    registered = np.mean([warp(frame, flow) for frame, flow in zip(frames, flows, strict=True)], axis=0)
    assert np.abs(registered - blurred)[inside].mean() < 0.2 * np.abs(frames[0] - blurred)[inside].mean()
    assert np.abs(flows.mean(axis=0))[inside].max() < 0.1
    assert oracles.blur_of(blurred, truth).sigma == pytest.approx(case.blur, rel=0.15)


class TestOutdated:
    def test_a_table_before_the_last_release_is_outdated(self):
        changelog = "# Changelog\n\n## 1.10.0, unreleased\nA.\n\n## 1.9.0, 2026-01-02\nB.\n\n## 1.8.0, 2025-01-02\n"
        versions = {"older": "1.8.3", "as old": "1.9.0", "new": "1.10.0"}
        assert outdated(versions, changelog) == ["older"]
        assert outdated(versions, "# Changelog\n\n## 1.0.0, unreleased\n") == []

    def test_no_table_is(self):
        tables = sorted(everything.RESULTS.glob("*.md"))
        found = {path.stem: LINE.search(path.read_text("utf-8")) for path in tables}
        versions = {name: line["version"] if line else "0" for name, line in found.items()}
        assert not outdated(versions, (everything.HERE.parent / "CHANGELOG.md").read_text("utf-8"))


class TestAll:
    def test_it_makes_every_table(self):
        assert {path.stem for path in everything.RESULTS.glob("*.md")} <= set(everything.TABLES)
        for table in everything.TABLES.values():
            assert (everything.HERE / table.words.split()[0]).exists()

    def test_a_table_of_this_revision_is_kept_and_another_is_made(self, tmp_path, monkeypatch, capsys):
        script = tmp_path / "script.py"
        script.write_text("import sys; open(sys.argv[-1], 'a').write('# T\\n\\nText.\\n')")
        monkeypatch.setattr(everything, "RESULTS", tmp_path)
        monkeypatch.setattr(everything, "revision", lambda: "abc1234")
        monkeypatch.setattr(provenance, "revision", lambda: "abc1234")
        table = everything.Table(str(script))
        assert everything.make("t", table)
        # The script itself did not say what its table is of.
        assert LINE.search((tmp_path / "t.md").read_text())["revision"] == "abc1234"
        assert everything.make("t", table) and (tmp_path / "t.md").read_text().count("Text.") == 1
        monkeypatch.setattr(everything, "revision", lambda: "abc1234+")
        assert everything.make("t", table) and (tmp_path / "t.md").read_text().count("Text.") == 2
        script.write_text("raise SystemExit('no clip')")
        assert not everything.make("t", table)
        assert "NOT WRITTEN" in capsys.readouterr().out

    def test_a_bound_that_is_broken_stays_broken_until_the_code_changes(self, tmp_path, monkeypatch, capsys):
        script = tmp_path / "script.py"
        script.write_text("import sys; open(sys.argv[-1], 'w').write('# T\\n\\nText.\\n'); sys.exit(1)")
        monkeypatch.setattr(everything, "RESULTS", tmp_path)
        for module in (everything, provenance):
            monkeypatch.setattr(module, "revision", lambda: "abc1234")
        table = everything.Table(str(script))
        assert not everything.make("t", table) and not everything.make("t", table)
        assert "t: of this revision already" in capsys.readouterr().out
        assert "a bound does not hold" in everything.origin_of(tmp_path / "t.md")
        script.write_text("import sys; open(sys.argv[-1], 'w').write('# T\\n\\nBetter.\\n')")
        for module in (everything, provenance):
            monkeypatch.setattr(module, "revision", lambda: "def5678")
        assert everything.make("t", table) and "bound" not in everything.origin_of(tmp_path / "t.md")

    def test_a_table_of_code_that_changes_meanwhile_does_not_count(self, tmp_path, monkeypatch, capsys):
        script, revisions = tmp_path / "script.py", ["abc1234", "def5678"]
        script.write_text("import sys; open(sys.argv[-1], 'w').write('# T\\n\\nText.\\n')")
        monkeypatch.setattr(everything, "RESULTS", tmp_path)
        monkeypatch.setattr(everything, "revision", lambda: revisions.pop(0) if revisions else "def5678")
        monkeypatch.setattr(provenance, "revision", lambda: "def5678")
        table = everything.Table(str(script))
        assert not everything.make("t", table) and not (tmp_path / "t.md").exists()
        assert "the code has changed since revision abc1234" in capsys.readouterr().out
        assert everything.make("t", table) and (tmp_path / "t.md").exists()


class TestTexts:
    def test_figures_are_those_of_the_tables(self):
        for path in texts.texts():
            assert texts.filled(path.read_text("utf-8")) == path.read_text("utf-8"), f"{path}: run benchmarks/all.py"

    def test_the_first_table_below_a_heading_is_read(self, tmp_path, monkeypatch):
        monkeypatch.setattr(texts, "RESULTS", tmp_path)
        (tmp_path / "t.md").write_text(
            "# T\n\n## A\n\nText.\n\n| x | y |\n|---|---|\n| 1 | 2 |\n\n| z |\n\n## B\n\nNone.\n"
        )
        assert texts.read_table("t", "A") == {"1": {"x": "1", "y": "2"}}
        assert texts.read_table("t", "B") == {}


def test_leads_are_those_that_the_table_lists(tmp_path, monkeypatch):
    scores = (
        "| clip | mean | turbrestore |\n|---|---:|---:|\n| drawn_a | 29.52 | 29.47 |\n| drawn_b | 31.00 | 30.00 |\n"
    )
    (tmp_path / "peers.md").write_text(
        "# T\n\n## Means\n\n| method | x |\n|---|---|\n\n## Where another method is ahead\n\n"
        "- drawn_b: mean 31.00, low rank 30.50; turbrestore 30.00 dB. By removing 1.20 px it has 31.00.\n"
        "- turbtext_d1: mean 0.90; turbrestore 0.50 of the words by tesseract.\n"
        f"\n## {texts.SCORES}\n\n{scores}"
    )
    monkeypatch.setattr(texts, "RESULTS", tmp_path)
    assert "Another method is ahead in PSNR on 1 of the 2 clips, by up to 1.0 dB." in texts.methods()


def test_a_script_that_prints_its_table_stores_it_below_its_heading(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["script.py", "--write", str(tmp_path / "t.md"), "rest"])
    assert provenance.publish_printed("# T", lambda: 3 * bool(sys.stdout.write("| 1 |\n"))) == 3
    assert capsys.readouterr().out == "| 1 |\n"
    assert LINE.sub("", (tmp_path / "t.md").read_text()) == "# T\n\n| 1 |\n"


def test_what_would_help_is_read_from_the_right_cells(tmp_path, monkeypatch):
    head = "| clip | mean | turbrestore | true flow | true blur | against the scene |\n|---|---:|---:|---:|---:|---:|\n"
    (tmp_path / "oracles.md").write_text(
        f"# T\n\n## One thing made worse at a time\n\n{head}| base | 1 | 20.00 | 1 | 22.50 | 1 |\n"
        f"| noise 0.05 | 1 | 19.25 | 1 | 1 | 1 |\n\n## More frames\n\n{head}| 8 frames | 1 | 10.00 | 1 | 1 | 5.00 |\n"
        f"| 30 frames | 9 | 9 | 9 | 9 | 9 |\n| 120 frames | 1 | 10.40 | 1 | 1 | 11.00 |\n\n"
        f"## Other turbulence and other cameras\n\n{head}| here | 1 | 10.00 | 1 | 13.00 | 1 |\n"
        f"| there | 1 | 10 | 1 | 9.00 | 1 |\n"
    )
    monkeypatch.setattr(texts, "RESULTS", tmp_path)
    more, noise, blur = texts.limits().splitlines()
    assert "120 frames in place of 8" in more and "+6.0 dB against the scene, and by +0.4 dB" in more
    assert "+0.8 dB" in noise
    assert "+2.5 dB for *base*" in blur and "+1.0 dB on average" in blur
    assert "+3.0 dB for *here*, -1.0 dB for *there*" in blur
