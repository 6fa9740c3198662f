"""The table of methods: every method runs, figures land in the right cells, and a lead of others is printed."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import peer_causes
import peers
import pytest
from clips import Clip
from methods import packages
from methods.deblurring import deblurred, levels_of
from methods.packages import NETWORK, PackageError, make_environment, run_package
from peer_causes import tried, try_others
from peer_tables import Trial, document
from peer_videos import moving_square, score_video
from provenance import LINE

import turbrestore
from conftest import make_sequence
from turbrestore.core.noise_spectrum import white_noise
from turbrestore.deconvolution.deconvolve import DeconvolutionParams
from turbrestore.footage.levels import Levels
from turbrestore.metrics import compare
from turbrestore.pipeline import restore

BENCHMARKS = Path(peers.__file__).parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("clips")
    np.save(path / "tiny.npy", make_sequence(3, 8, 72, "camera", rms=1.0).frames)
    return path


@pytest.mark.parametrize("method", ["mean", "median", "lucky average", "middle frame", "Sobolev flow", "turbrestore"])
def test_a_method_leaves_both_images_and_says_what_it_used(method, folder):
    used = peers.run_child({"method": method, "folder": str(folder), "clips": ["tiny"], "python": None})
    assert used["failed"] == {}
    more = {"inseparable"} if method == "Sobolev flow" else set()
    assert set(used["clips"]["tiny"]) == {"seconds", "peak"} | more
    with np.load(folder / f"{method}-tiny.npz") as images:
        assert images["merged"].shape == images["sharp"].shape == (72, 72)


def test_others_are_deblurred_at_the_levels_of_the_restoration(folder):
    frames = np.load(folder / "tiny.npy")
    pale, levels = 0.4 + 0.2 * frames, levels_of(0.4 + 0.2 * frames)
    span = levels.stretched(pale)
    assert levels.gain > 2 and span.min() > 0 and span.max() < 1
    params = DeconvolutionParams(sigma=1.0)
    found = deblurred(pale.mean(axis=0), levels, params)
    whole = deblurred(levels.stretched(pale.mean(axis=0)), Levels(), params)
    np.testing.assert_allclose(levels.stretched(found.image), whole.image, atol=1e-5)
    noise, guide = white_noise(0.02), pale[0]
    found = deblurred(pale.mean(axis=0), levels, params, guide, noise)
    known = white_noise(0.02 * levels.gain)
    whole = deblurred(levels.stretched(pale.mean(axis=0)), Levels(), params, levels.stretched(guide), known)
    np.testing.assert_allclose(levels.stretched(found.image), whole.image, atol=1e-5)
    # Neither the guide nor the noise is that of the image alone; and at its own levels λ is another.
    assert np.abs(deblurred(pale.mean(axis=0), levels, params, guide).image - found.image).mean() > 1e-4
    found = deblurred(pale.mean(axis=0), levels, params)
    other = deblurred(pale.mean(axis=0), Levels(), params).image
    assert np.abs(found.image - other).mean() > 1e-4


def test_every_method_has_a_meaning():
    assert set(peers.MEANINGS) == {*peers.METHODS, *peers.PACKAGES}


def test_a_package_that_fails_is_left_out_with_its_reason(folder, tmp_path):
    used = peers.run_child(
        {"method": "pystackreg", "folder": str(folder), "clips": ["tiny"], "python": str(tmp_path / "none")}
    )
    assert used["clips"] == {}
    assert "No such file" in used["failed"]["tiny"]
    with pytest.raises(PackageError, match="ModuleNotFoundError"):
        # The interpreter of the tests has no such package.
        run_package("pystackreg", np.zeros((2, 8, 8), np.float32), Path(sys.executable))


FIGURES = {"psnr": 20.0, "psnr_sharp": 25.0, "ssim": 0.5, "ssim_sharp": 0.6}
SPENT = {"seconds": 1.0, "peak": 100.0}


class TestDocument:
    def document(self, **others):
        results = {
            "mean": {"a": {**FIGURES, **SPENT, **others}, "b": {**FIGURES, **SPENT}},
            "turbrestore": {"a": {**FIGURES, **SPENT}, "b": {**FIGURES, **SPENT, "psnr": 30.0}},
        }
        return document(results, {"mean": "temporal mean"}, {"other": "not installed"}, {})

    def test_means_are_those_of_the_clips(self):
        text = self.document()
        assert "| turbrestore | 25.00 | 25.00 | 0.500 | 0.600 | – | – | – | – | 1.0 | 100 |" in text
        assert "- other: not installed" in text
        assert "On no clip." in text

    def test_a_lead_of_another_method_is_printed(self):
        assert "- a: mean 25.40; turbrestore 25.00 dB" in self.document(psnr_sharp=25.4)

    @pytest.mark.parametrize(
        ("own", "best", "said"),
        [
            ({}, None, "dB. Before deblurring mean is 5.00 dB behind."),
            (
                {},
                Trial(25.4, 1.2, 1.67),
                "By removing 1.20 px in place of 2.00 px it has 25.40: its merged image is good",
            ),
            ({}, Trial(25.2, 1.2, 1.67), "it has 25.20, and by no blur that was tried more. Before deblurring mean is"),
            (
                {},
                Trial(25.0, 1.2, 1.67),
                "No blur that was tried gives clearly more. Before deblurring mean is 5.00 dB",
            ),
            (
                {},
                Trial(25.4, 1.2, 2.0),
                "1.20 px in place of 2.00 px as a Gaussian in place of an exponent of 1.67 it has",
            ),
            ({}, Trial(25.4, 0.0, 2.0), "By removing no blur in place of 2.00 px it has 25.40"),
            ({}, Trial(25.4, 2.0, 1.67, 0.5), "By removing 2.00 px with half the λ it has 25.40"),
            ({"psnr": 15.0}, None, "Before deblurring mean is 5.00 dB ahead already."),
            ({"psnr": 20.0}, None, "Before deblurring mean is neither ahead nor behind"),
            ({"centroid_sharp": 30.0}, Trial(25.4, 1, 2), "At the mean geometry of the clip turbrestore is ahead"),
        ],
    )
    def test_a_lead_is_taken_apart(self, own, best, said):
        lead = {**FIGURES, "psnr_sharp": 25.4, "centroid_sharp": 29.0}
        results = {"mean": {"a": lead}, "turbrestore": {"a": {**FIGURES, "psnr": 25.0, **own}}}
        trials = {("a", "psnr_sharp"): [Trial(25.0, 2.0, 1.67), best]} if best else {}
        assert said in document(results, {}, {}, {}, trials=trials)

    def test_what_the_checks_cost_is_not_put_down_to_the_width(self):
        results = {"mean": {"a": {**FIGURES, "psnr_sharp": 26.0}}, "turbrestore": {"a": {**FIGURES, "psnr": 25.0}}}
        trials = {("a", "psnr_sharp"): [Trial(25.3, 2.0, 1.67), Trial(25.32, 1.2, 1.67)]}
        said = "checks that follow the deconvolution it has 25.30, and by no blur that was tried more. Before"
        assert said in document(results, {}, {}, {}, trials=trials)

    def test_stages_of_a_method_that_returns_one_image_are_not_told_apart(self):
        lead = {**FIGURES, "psnr_sharp": 25.4}
        for inseparable, said in (({"inseparable": 1.0}, "mean sharpens as it merges"), ({}, "Before deblurring mean")):
            results = {"mean": {"a": lead | inseparable}, "turbrestore": {"a": {**FIGURES, "psnr": 25.0}}}
            assert said in document(results, {}, {}, {})

    def test_a_network_has_a_table_and_spoils_no_mean_where_it_did_not_run(self):
        drawn, other = "drawn_air_page", "quick_chart"
        found = {**FIGURES, **SPENT}
        results = {
            NETWORK: {drawn: {**found, "psnr_sharp": 24.0}},
            "turbrestore": {drawn: found, other: found},
        }
        text = document(results, {}, {}, {})
        reported, others = text.split("## Means over the other clips")
        assert f"| {NETWORK} | 20.00 | 24.00 |" in reported
        assert f"| {NETWORK} | – | – |" in others and "| turbrestore | 20.00 | 25.00 |" in others
        assert f"| {drawn} | 20.00 | 24.00 | 25.00 | – | – |" in text

    def test_a_lead_on_a_video_is_printed(self):
        methods = {"mean": {"psnr": 22.0}, "turbrestore": {"psnr": 21.0}}
        text = document({}, {}, {}, {"road": methods})
        assert "| mean | 22.00 | – | – | – |" in text
        assert "Ahead of turbrestore in PSNR: mean." in text


@pytest.fixture(scope="module")
def clip():
    made = make_sequence(3, 12, 72, "camera", rms=1.0)
    return Clip(made.frames, made.scene, ("word",))


class TestTrials:
    def test_only_clips_on_which_another_is_ahead_are_tried(self, clip, monkeypatch):
        asked = []
        monkeypatch.setattr(
            peer_causes, "tried", lambda _, one, figure, wanted: asked.append((one, figure, wanted)) or [1]
        )
        results = {
            "mean": {"won": {"psnr_sharp": 10.0}, "lost": {"psnr_sharp": 30.0, "words_sharp": 0.5}},
            "turbrestore": {name: {"psnr_sharp": 20.0, "words_sharp": 0.2} for name in ("won", "lost")},
        }
        found = try_others(results, {"won": None, "lost": clip})
        assert asked == [(clip, "psnr_sharp", 30.0), (clip, "words_sharp", 0.5)]
        assert set(found) == {("lost", "psnr_sharp"), ("lost", "words_sharp")}

    def test_the_first_is_the_product_and_more_is_tried_until_one_is_enough(self, clip):
        whole = restore(clip.frames)
        reached = compare(whole.image, clip.truth).psnr
        trials = tried(whole, clip, "psnr_sharp", 99.0)
        first, best = trials[0], max(trials, key=lambda one: one.figure)
        assert first.width == whole.deconvolution.sigma and first.exponent == whole.posterior.exponent
        assert first.figure == pytest.approx(reached, abs=0.1)
        assert best.figure >= first.figure
        assert {one.factor for one in trials} == {0.5, 1, 2} and {first.exponent, 2.0} == {
            one.exponent for one in trials
        }
        widths = {one.width for one in trials}
        assert max(widths) == pytest.approx(2 * first.width) and min(widths - {0}) == pytest.approx(first.width / 2)
        few = tried(whole, clip, "psnr_sharp", 0.0)
        assert {one.exponent for one in few} == {first.exponent} and len(few) < len(trials)

    def test_words_are_read_by_the_reader_of_the_figure(self, clip, monkeypatch):
        monkeypatch.setattr(peer_causes, "share_read", lambda _, words, reader: f"{reader} {words}")
        assert peer_causes._score(clip.truth, clip, "words_rapidocr_sharp") == "rapidocr ('word',)"
        assert peer_causes._score(clip.truth, clip, "words_sharp") == "tesseract ('word',)"


def test_videos_are_scored_frame_by_frame():
    frames, truth = moving_square(6, 64)
    assert frames.shape == truth.shape == (6, 64, 64)
    still = np.repeat(truth[:1], 6, axis=0)
    assert score_video(truth, truth)["flicker"] == 1
    assert score_video(truth, truth)["ssim"] == 1
    assert score_video(still, truth)["flicker"] == 0
    assert score_video(truth + np.float32(0.1), truth)["psnr"] == pytest.approx(20, abs=1e-3)
    spoilt = truth + np.float32(0.1)
    # Only every third frame is compared.
    spoilt[[1, 2, 4, 5]] = 0
    assert score_video(spoilt, truth)["psnr"] == pytest.approx(20, abs=1e-3)
    # What a network crops is cropped from the truth.
    assert score_video(truth[:, 2:-2, 4:-4], truth)["ssim"] == 1


def test_the_script_prints_and_writes_its_document(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("TURBRESTORE_DATA", raising=False)
    figures = {"mean": {"tiny": {"psnr": 20.0, "seconds": 1.0}}}
    monkeypatch.setattr(peers, "measure_all", lambda *_: (figures, {}, {}))
    target = tmp_path / "peers.md"
    monkeypatch.setattr(
        sys, "argv", ["peers.py", "--without-videos", "--write", str(target), "--json", str(tmp_path / "f.json")]
    )
    assert peers.main() == 0
    assert LINE.sub("", target.read_text()) == capsys.readouterr().out
    assert LINE.search(target.read_text())["version"] == turbrestore.__version__
    assert "--clips" not in target.read_text()
    monkeypatch.setattr(sys, "argv", ["peers.py", "--without-videos", "--clips", "smooth_*", "tiny"])
    assert peers.main() == 0
    assert "Only some of the clips were measured: `--clips 'smooth_*' tiny`." in capsys.readouterr().out
    assert json.loads((tmp_path / "f.json").read_text())["clips"] == figures


def test_all_methods_are_measured_and_leads_taken_apart(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "find_clips", lambda _: {"tiny": lambda: replace(clip, words=())})
    monkeypatch.setattr(peers, "try_others", lambda results, clips: (sorted(results), [*clips]))
    results, skipped, trials = peers.measure_all([], ["mean", "turbrestore"], tmp_path)
    assert trials == (["mean", "turbrestore"], ["tiny"]) and not skipped
    assert results["turbrestore"]["tiny"]["psnr"] > results["mean"]["tiny"]["psnr"] > 10
    assert (tmp_path / "tiny.png").exists()


def test_a_method_that_fails_on_every_clip_spoils_no_mean(clip, monkeypatch):
    monkeypatch.setattr(peers, "find_clips", lambda _: {"tiny": lambda: replace(clip, words=())})
    monkeypatch.setattr(peers, "make_environment", lambda _: Path("none"))
    monkeypatch.setattr(peers, "child", lambda _, task: {"clips": {}, "failed": {"tiny": "it broke"}})
    results, skipped, _ = peers.measure_all([], ["pystackreg"], None)
    assert results == {} and skipped == {"pystackreg": "it broke"}


def test_an_environment_that_was_not_finished_is_made_again(tmp_path, monkeypatch):
    begun = []
    monkeypatch.setattr(packages.venv, "create", lambda folder, **_: begun.append(folder.mkdir(exist_ok=True)))
    monkeypatch.setattr(packages, "_check", lambda command, _: fail() if len(begun) == 1 else "")

    def fail():
        raise KeyboardInterrupt

    environment = packages.Environment(tmp_path / "env", ("install nothing",))
    with pytest.raises(KeyboardInterrupt):
        make_environment(environment)
    assert make_environment(environment) == make_environment(environment) == environment.python
    assert len(begun) == 2
