"""The table of methods: every method runs, figures land in the right cells, and a lead of others is printed."""

import json
import sys
from pathlib import Path

import numpy as np
import peers
import pytest
from clips import Clip
from methods.packages import NETWORK, PackageError, run_package
from peer_causes import add_best
from peer_tables import document
from peer_videos import moving_square, score_video
from provenance import LINE

import turbrestore
from conftest import make_sequence
from turbrestore.metrics import compare
from turbrestore.pipeline import restore

BENCHMARKS = Path(peers.__file__).parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("clips")
    np.save(path / "tiny.npy", make_sequence(3, 8, 72, "camera", rms=1.0).frames)
    return path


@pytest.mark.parametrize("method", ["mean", "median", "lucky average", "middle frame", "turbrestore"])
def test_a_method_leaves_both_images_and_says_what_it_used(method, folder):
    used = peers.run_child({"method": method, "folder": str(folder), "clips": ["tiny"], "python": None})
    assert used["failed"] == {}
    assert set(used["clips"]["tiny"]) == {"seconds", "peak", "deblurring"}
    with np.load(folder / f"{method}-tiny.npz") as images:
        assert images["merged"].shape == images["sharp"].shape == (72, 72)


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
SPENT = {"seconds": 1.0, "deblurring": 0.5, "peak": 100.0}


class TestDocument:
    def document(self, **others):
        results = {
            "mean": {"a": {**FIGURES, **SPENT, **others}, "b": {**FIGURES, **SPENT}},
            "turbrestore": {"a": {**FIGURES, **SPENT}, "b": {**FIGURES, **SPENT, "psnr": 30.0}},
        }
        return document(results, {"mean": "temporal mean"}, {"other": "not installed"}, {})

    def test_means_are_those_of_the_clips(self):
        text = self.document()
        assert "| turbrestore | 25.00 | 25.00 | 0.500 | 0.600 | – | – | – | – | 1.0 | 0.5 | 100 |" in text
        assert "- other: not installed" in text
        assert "On no clip." in text

    def test_a_lead_of_another_method_is_printed(self):
        assert "- a: mean 25.40; turbrestore 25.00 dB" in self.document(psnr_sharp=25.4)

    @pytest.mark.parametrize(
        ("figures", "said"),
        [
            ({}, "Before deblurring mean is 5.00 dB behind, so its lead comes from the deblurring."),
            (
                {"psnr_sharp_best": 25.4},
                "With 1.20 px removed in place of 2.00 px it is 25.40, so the estimated width is",
            ),
            ({"psnr_sharp_best": 25.2}, "it is 25.20. Before deblurring mean is 5.00 dB behind"),
            ({"psnr_sharp_best": 25.0}, "Neither of the next widths helps. Before deblurring mean is 5.00 dB behind"),
            ({"psnr_sharp_best": 25.5, "psnr_sharp_exponent": 2.0}, "Gaussian in place of exponent 1.67, removed in"),
            (
                {"psnr_sharp_best": 25.5, "psnr_sharp_width": 0.0},
                "With no blur removed in place of 2.00 px it is 25.50",
            ),
            ({"psnr": 15.0}, "Before deblurring mean is 5.00 dB ahead already."),
            ({"psnr": 20.0}, "Before deblurring mean is neither ahead nor behind"),
            ({"psnr": 15.0, "centroid_sharp": 30.0}, "At the mean geometry of the clip turbrestore is ahead"),
        ],
    )
    def test_a_lead_is_taken_apart(self, figures, said):
        blur = {"_width": 2.0, "_exponent": 5 / 3, "psnr_sharp_width": 1.2, "psnr_sharp_exponent": 5 / 3}
        lead = {**FIGURES, "psnr_sharp": 25.4, "centroid_sharp": 29.0}
        results = {"mean": {"a": lead}, "turbrestore": {"a": {**FIGURES, "psnr": 25.0, **blur, **figures}}}
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


def test_the_best_blur_is_found_where_another_method_is_ahead():
    made = make_sequence(6, 72, 72, "camera", rms=1.0)
    clip = Clip(made.frames, made.scene)
    own = {name: {"psnr_sharp": compare(made.frames.mean(axis=0), made.scene).psnr} for name in ("won", "lost")}
    others = {"won": {"psnr_sharp": 0.0}, "lost": {"psnr_sharp": 99.0}}
    results = {"mean": others, "turbrestore": own}
    add_best(results, {"won": clip, "lost": clip})
    assert set(own["won"]) == {"psnr_sharp"}
    restoration = restore(made.frames)
    assert own["lost"]["_width"] == restoration.deconvolution.sigma
    assert own["lost"]["psnr_sharp_best"] >= compare(restoration.image, made.scene).psnr - 0.3


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
    monkeypatch.setattr(peers, "measure_all", lambda *_: (figures, {}))
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
