"""The command line on real files: what it writes, what it says, how it ends."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from command_line import QUICK, QUICKEST, fails, frames_clip

from conftest import make_sequence
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.video import open_frames, write_video
from turbrestore.pipeline import restore
from turbrestore.registration.centroid import Centroid
from turbrestore.runs.stage_files import load_artifact
from turbrestore.settings import PRESETS

SAMPLE = Path(__file__).parents[2] / "sample_data"


class TestRestore:
    def test_sample_clip_is_restored_and_described(self, run, tmp_path):
        output = tmp_path / "sharp.png"
        words = ["restore", SAMPLE / "chart.mkv", output, "--json", "--truth", SAMPLE / "chart_truth.png"]
        code, out, err = run(*words)
        assert code == 0, err
        report = json.loads(out)
        stages = {name: figures["psnr"] for name, figures in report["stages"].items()}
        assert list(stages) == ["mean", "centroid", "filtered", "deconvolved"]
        assert stages["mean"] + 1 < stages["centroid"] <= stages["filtered"] < stages["deconvolved"]
        assert read_image(output).image.shape == (192, 256)
        assert report["frames"] == 48

    def test_settings_beside_the_result_repeat_it(self, run, clip, tmp_path):
        first, second = tmp_path / "a.png", tmp_path / "b.png"
        part = ["--frames", "1:8:2", "--roi", "4,0,72,40", "--bit-depth", "16"]
        settings = [*part, "--sigma", "0.9", "--train", "3", "--flow.method", "farneback"]
        code, out, _ = run("restore", clip, first, *settings, *QUICK, "--json")
        assert (code, json.loads(out)["frames"], read_image(first).image.shape) == (0, 4, (40, 72))
        settings = tmp_path / "a.png.toml"
        assert tomllib.loads(settings.read_text())["flow"]["method"] == "farneback"
        assert run("restore", clip, second, "--config", settings, "--quiet")[0] == 0
        assert first.read_bytes() == second.read_bytes()
        assert settings.read_text() == (tmp_path / "b.png.toml").read_text()

    @pytest.mark.parametrize(
        ("of_file", "flag"),
        [("sigma = 1.5", "--deconvolution.sigma"), ("[deconvolution]\nsigma = 1.5", "--sigma")],
    )
    def test_the_blur_by_either_name_wins_over_the_file(self, run, clip, tmp_path, of_file, flag):
        (tmp_path / "run.toml").write_text(f"train = 4\n{of_file}\n")
        words = ["--config", tmp_path / "run.toml", flag, "0.8", *QUICK]
        code, _, err = run("restore", clip, tmp_path / "o.png", *words)
        assert code == 0, err
        settings = tomllib.loads((tmp_path / "o.png.toml").read_text())
        assert (settings["train"], settings["deconvolution"]["sigma"]) == (4, 0.8)

    def test_options_win_over_the_preset_and_the_preset_over_the_file(self, run, clip, tmp_path):
        (tmp_path / "run.toml").write_text('preset = "paper"\ntrain = 4\n[filter]\nblock = 3\n')
        words = ["restore", clip, tmp_path / "o.png", "--config", tmp_path / "run.toml", "--sigma", "1", "--quiet"]

        def used(*more):
            code, _, err = run(*words, *more, "--overwrite")
            assert code == 0, err
            return tomllib.loads((tmp_path / "o.png.toml").read_text())

        of_file, of_flag = used("--filter.sharpness", "0.5"), used("--preset", "fast")
        assert of_file["preset"] == "paper"
        assert of_file["filter"] | {"block": 3, "sharpness": 0.5, "training": "skip"} == of_file["filter"]
        assert of_flag["preset"] == "fast"
        assert of_flag["filter"] | {"block": 24, "inner_iterations": 1, "training": "filter"} == of_flag["filter"]
        assert "exponent" not in of_flag["deconvolution"]
        assert of_flag["train"] == 4

    @pytest.mark.long
    @pytest.mark.parametrize("preset", PRESETS)
    def test_a_preset_is_what_python_has_by_that_name(self, run, clip, tmp_path, preset):
        # The report takes longer than the rest; that of one preset is enough.
        report = ["--report", tmp_path / "o.html"] if preset == "fast" else []
        words = ["--preset", preset, *report, "--roi", "8,8,48,48"]
        assert run("restore", clip, tmp_path / "o.png", *words, "--quiet")[0] == 0
        image = read_image(tmp_path / "o.png").image
        part = open_frames(clip, roi=(8, 8, 48, 48))
        assert np.abs(image - restore(part, PRESETS[preset]).image).max() <= 0.5 / 255 + 1e-6
        again = tmp_path / "again.png"
        assert run("restore", clip, again, "--config", tmp_path / "o.png.toml", "--quiet")[0] == 0
        assert again.read_bytes() == (tmp_path / "o.png").read_bytes()
        assert not report or "--preset=fast" in (tmp_path / "o.html").read_text()

    def test_a_settings_file_starts_from_a_preset(self, run, tmp_path):
        assert run("config", "--init", tmp_path / "run.toml", "--preset", "fast")[0] == 0
        code, out, _ = run("config", "--check", tmp_path / "run.toml")
        assert code == 0
        assert "preset = 'fast' (default: 'standard')" in out.splitlines()
        assert "filter.inner_iterations = 1 (default: 2)" in out.splitlines()
        fails(run("config", "--check", tmp_path / "run.toml", "--preset", "fast"), 2, "--preset: has no effect")

    def test_the_paper_needs_frames_after_the_training(self, run, clip, tmp_path):
        words = ["--preset", "paper", "--train", "8", "--quiet"]
        result = run("restore", clip, tmp_path / "o.png", *words)
        fails(result, 2, "train: expected fewer than the 8 frames")

    def test_chain_of_stage_commands_equals_restore(self, run, clip, tmp_path):
        # Half of the frames train, so the filter moves the image onto the mean geometry, and the guide must follow.
        c, d, e, chain, whole = (tmp_path / name for name in ("c.npz", "d.npz", "e.npz", "chain.tif", "whole.tif"))
        keep, flows = tmp_path / "keep", tmp_path / "f.npy"
        once, depth = ["--centroid.iterations", "1"], ["--bit-depth", "32"]
        for words in (
            ["restore", clip, whole, "--train", "4", "--sigma", "1", "--keep", keep, *depth, *QUICK],
            ["centroid", clip, c, "--train", "4", *once],
            ["identify", c, d],
            ["filter", clip, c, d, e, "--filter.inner-iterations", "1"],
            ["flow", c, clip, flows, "--frames", "0:3"],
            ["deconvolve", e, chain, "--guide", keep / "centroid.npz", "--sigma", "1", *depth],
        ):
            code, _, err = run(*words)
            assert code == 0, err
        assert {path.name for path in keep.iterdir()} >= {"centroid.npz", "dynamics.npz", "filtered.npz", "mean.png"}
        assert np.load(flows).shape == (3, 80, 80, 2)
        with np.load(e) as filtered:
            assert np.abs(filtered["mean_flow"]).max() > 0.1
        np.testing.assert_allclose(read_image(chain).image, read_image(whole).image, atol=1e-5)

    def test_prediction_is_drawn_and_measured(self, run, clip, tmp_path):
        # Frames that are named train, all of them; the last is predicted from the one before.
        assert run("centroid", clip, tmp_path / "c.npz", "--frames", "0:8", "--centroid.iterations", "1")[0] == 0
        assert load_artifact(tmp_path / "c.npz", Centroid).flows.shape[0] == 8
        words = ["identify", tmp_path / "c.npz", tmp_path / "d.npz", "--dynamics.rank", "2", "--plot"]
        code, _, err = run(*words, tmp_path / "study.png")
        assert code == 0
        assert "least error of 2 predicted flows" in err
        words = ["predict", clip, tmp_path / "c.npz", tmp_path / "d.npz", tmp_path / "predicted.png", "--json"]
        code, out, err = run(*words, "--frame", "7", "--quiet")
        assert code == 0, err
        record = json.loads(out)
        assert set(record["flow_error"]) == {"predicted", "last", "mean"}
        assert record["image_error"]["predicted"] > 0
        for name in ("study.png", "predicted.png"):
            picture = read_image(tmp_path / name).image
            assert picture.shape[1] > 500
            # A white background, and something on it.
            assert picture.max() == 1
            assert picture.std() > 0.02
        fails(run(*words, "--overwrite", "--frame", "8"), 2, "--frame: expected a frame from 1 to 7, found 8")
        code, out, err = run(*words, "--overwrite")
        assert (code, json.loads(out)) == (0, record)
        assert "frame 7 is one that the dynamics were found from" in err
        fails(run(*words[:2], tmp_path / "d.npz", *words[3:], "--overwrite"), 65)

    @pytest.mark.parametrize("colours", ["clip", "centroid"])
    def test_prediction_needs_frames_as_the_centroid_has_them(self, run, clip, tmp_path, colours):
        frames = open_frames(clip).read(0, 4)
        write_video(tmp_path / "colour.npy", np.stack([frames, frames, 0.9 * frames], axis=-1), 25, 32)
        other = tmp_path / "colour.npy"
        first, second = (clip, other) if colours == "clip" else (other, clip)
        files = [tmp_path / "c.npz", tmp_path / "d.npz"]
        quick = ["--train", "3", "--centroid.iterations", "1", "--flow.method", "farneback", "--quiet"]
        assert run("centroid", first, files[0], *quick)[0] == 0
        assert run("identify", *files, "--quiet")[0] == 0
        fails(run("predict", second, *files, tmp_path / "p.png"), 65, "80×80 RGB", "80×80 grey")

    @pytest.mark.long
    def test_all_named_frames_are_used(self, run, tmp_path):
        frames = make_sequence(seed=5, count=50, size=64, rms=0.5).frames[:, 8:56, 8:56]
        clip = frames_clip(tmp_path / "long.mkv", frames)
        quick = ["--centroid.iterations", "1", "--flow.method", "farneback", "--quiet"]
        named = ["--frames", "0:50"]
        for words, count, measured in (([], 40, 50), (named, 50, 50), ([*named, "--train", "9"], 9, 9)):
            assert run("centroid", clip, tmp_path / "c.npz", *words, *quick, "--overwrite")[0] == 0
            assert load_artifact(tmp_path / "c.npz", Centroid).flows.shape[0] == count
            code, out, _ = run("seeing", clip, *words, *quick, "--json")
            assert (code, json.loads(out)["frames"]) == (0, measured)
        assert f"frames used{count:>16} of 50" in run("seeing", clip, *words, *quick)[1]

    def test_sixteen_bits_stay_sixteen_bits(self, run, tmp_path):
        frames = make_sequence(seed=32, count=4, size=64, rms=0.5).frames
        write_video(tmp_path / "deep.mkv", frames, 25, bit_depth=16)
        assert run("restore", tmp_path / "deep.mkv", tmp_path / "o.png", *QUICKEST)[0] == 0
        image = cv2.imread(str(tmp_path / "o.png"), cv2.IMREAD_UNCHANGED)
        assert image.dtype == np.uint16
        assert (image % 257 != 0).any()

    def test_all_outputs_ask_to_check_the_same(self, run, tmp_path):
        first, second = (make_sequence(seed=seed, count=count, size=64).frames for seed, count in ((33, 6), (34, 3)))
        second = np.rot90(second, axes=(1, 2)) ** 3
        stack = np.concatenate([first, second])
        stack[3] = stack[2]
        np.save(tmp_path / "two.npy", stack)
        words = ["restore", tmp_path / "two.npy", tmp_path / "o.png", *QUICKEST[:-1], "--report", tmp_path / "o.html"]
        code, _, err = run(*words)
        assert code == 0
        remark, doubt = (line.removeprefix("turbrestore: two.npy: ") for line in err.splitlines()[:2])
        assert remark == "1 duplicated: frame 3 left out" and doubt.startswith("2 scenes: only the longest is used")
        last = err.splitlines()[-1]
        assert f"; check: {doubt}" in last and remark not in last
        page = (tmp_path / "o.html").read_text("utf-8")
        assert f"<li>{doubt}<br>" in page and f"Remark: {remark}" in page and f"Remark: {doubt}" not in page
        record = json.loads(run(*words, "--json", "--overwrite")[1])
        assert record["warnings"] == [remark, doubt]
        checks = [f"{check['text']} ({check['remedy']})" for check in record["verdict"]["checks"]]
        assert last.endswith(f"; check: {'; '.join(checks)}")


def test_info_says_what_a_video_is(run, clip):
    code, out, _ = run("info", clip, "--json")
    assert code == 0
    record = json.loads(out)
    assert (record["frames"], record["width"], record["height"], record["bit_depth"]) == (8, 80, 80, 8)
    code, out, _ = run("info", clip)
    assert code == 0
    assert "80" in out
    fails(run("info", "missing.mkv"), 66)


class TestEvaluate:
    TRUTH = SAMPLE / "chart_truth.png"

    def test_against_the_truth(self, run):
        code, out, _ = run("evaluate", self.TRUTH, self.TRUTH, "--json")
        assert code == 0
        assert json.loads(out) == {"psnr": None, "psnr_fit": None, "ssim": 1.0, "sharpness": 1.0, "overshoot": 0.0}

    def test_a_brighter_crop_is_located_first(self, run, tmp_path):
        truth = read_image(self.TRUTH).image
        write_image(tmp_path / "crop.png", truth[3:, 5:] * 0.8 + 0.1, 16)
        code, out, _ = run("evaluate", tmp_path / "crop.png", self.TRUTH, "--json")
        assert code == 0
        figures = json.loads(out)
        # The drawing uses 0.12 and 0.88: at most 0.08 off.
        assert 22 < figures["psnr"] < 30
        assert figures["psnr_fit"] > 60
        assert figures["sharpness"] == pytest.approx(0.8, abs=0.01)

    def test_against_a_reference_without_truth(self, run, tmp_path):
        truth = read_image(self.TRUTH).image
        write_image(tmp_path / "soft.png", cv2.GaussianBlur(truth, (0, 0), 1.5), 16)
        code, out, _ = run("evaluate", self.TRUTH, "--reference", tmp_path / "soft.png", "--json")
        assert code == 0
        figures = json.loads(out)
        assert set(figures) == {"sharpness", "overshoot"}
        assert figures["sharpness"] > 1.1
        code, out, _ = run("evaluate", self.TRUTH, self.TRUTH, "--reference", tmp_path / "soft.png")
        assert code == 0
        assert [line.split()[0] for line in out.splitlines()] == ["psnr", "psnr", "ssim", "sharpness", "overshoot"]
        assert f"{figures['sharpness']}" in out

    @pytest.mark.parametrize("suffix", [".npy", ".flo"])
    def test_flows_give_an_end_point_error(self, run, tmp_path, suffix):
        flows = np.random.default_rng(0).normal(0, 1, (1, 5, 7, 2)).astype(np.float32)
        paths = [tmp_path / f"{name}{suffix}" for name in ("measured", "true")]
        for path, flow in zip(paths, (flows + np.float32(3), flows), strict=True):
            if suffix == ".flo":
                cv2.writeOpticalFlow(str(path), flow[0])
            else:
                np.save(path, flow)
        code, out, err = run("evaluate", *paths, "--json")
        assert code == 0, err
        figures = json.loads(out)
        assert figures["endpoint_error"] == pytest.approx(np.sqrt(18), abs=1e-3)
        assert figures["endpoint_error_centred"] is None

    def test_bad_input_is_one_line(self, run, tmp_path):
        write_image(tmp_path / "small.png", np.full((20, 20), 0.5), 8)
        write_image(tmp_path / "flat.png", np.full((100, 100), 0.5), 8)
        np.save(tmp_path / "flows.npy", np.zeros((2, 8, 8, 2), np.float32))
        np.save(tmp_path / "fewer.npy", np.zeros((1, 8, 8, 2), np.float32))
        (tmp_path / "cut.flo").write_bytes(b"PIEH\x08\0\0\0\x08\0\0\0123")
        fails(run("evaluate", self.TRUTH, "none.png"), 66, "none.png")
        fails(run("evaluate", tmp_path / "small.png", self.TRUTH), 65, "result: expected at least 68 pixels")
        fails(run("evaluate", self.TRUTH, tmp_path / "flat.png"), 65, "truth: expected an image with some contrast")
        fails(run("evaluate", self.TRUTH, "--reference", tmp_path / "small.png"), 65, "expected the size")
        fails(run("evaluate", tmp_path / "flows.npy", self.TRUTH), 65, "flows.npy: expected an image")
        fails(run("evaluate", self.TRUTH, tmp_path / "flows.npy"), 65, "expected flows")
        fails(run("evaluate", tmp_path / "fewer.npy", tmp_path / "flows.npy"), 65, "flows: expected shape")
        fails(run("evaluate", tmp_path / "cut.flo", tmp_path / "flows.npy"), 65, "cut.flo: expected a flow")
        fails(run("evaluate", "none.flo", tmp_path / "flows.npy"), 66, "none.flo")


@pytest.mark.parametrize(
    ("error", "code", "parts"),
    [(KeyboardInterrupt(), 130, ["interrupted"]), (MemoryError("9 GiB"), 1, ["out of memory", "--roi"])],
    ids=["interruption", "memory"],
)
def test_what_ends_a_run_is_one_line_and_leaves_nothing(run, clip, tmp_path, monkeypatch, error, code, parts):
    monkeypatch.setattr("turbrestore.pipeline.centroid_steps", Mock(side_effect=error))
    fails(run("restore", clip, tmp_path / "o.png"), code, *parts)
    assert list(tmp_path.iterdir()) == []


def test_the_installed_command_answers(tmp_path):
    command = Path(sys.executable).with_name("turbrestore")
    version = subprocess.run([command, "--version"], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert version.stdout.strip().count(".") == 2
    failed = subprocess.run([command, "info", "none.mkv"], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert failed.returncode == 66
    assert "Traceback" not in failed.stderr


def test_a_smaller_set_of_stages_leaves_none_of_a_larger_one(run, clip, tmp_path):
    keep = tmp_path / "keep"
    assert run("restore", clip, tmp_path / "a.png", "--keep", keep, *QUICKEST)[0] == 0
    assert (
        run("restore", clip, tmp_path / "b.png", "--keep", keep, "--until", "centroid", "--overwrite", *QUICK)[0] == 0
    )
    images = {"frame.png", "mean.png", "centroid.png"}
    assert {path.name for path in keep.iterdir()} == {"centroid.npz", "images.npz", "run.json", *images}


def test_stage_commands_check_their_settings(run, clip, tmp_path):
    fails(run("centroid", clip, tmp_path / "c.npz", "--train", "-3"), 2, "train")
    assert run("centroid", clip, tmp_path / "C.NPZ", *QUICK[:2], "--quiet")[0] == 0
    assert run("identify", tmp_path / "C.NPZ", tmp_path / "d.npz", "--quiet")[0] == 0
    fails(run("filter", SAMPLE / "chart.mkv", tmp_path / "C.NPZ", tmp_path / "d.npz", tmp_path / "f.npz"), 65, "shape")
