"""``turbrestore steady`` from the command line."""

import io
import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from turbrestore.io.video import open_frames, write_video
from turbrestore_cli.__main__ import main

SAMPLE = Path(__file__).parents[2] / "sample_data" / "chart.mkv"
PART = ("--frames", "0:6", "--roi", "40,40,64,48")


@pytest.fixture
def run(capfd):
    def call(*words):
        code = main([str(word) for word in words])
        out, err = capfd.readouterr()
        return code, out, err

    return call


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".npy"])
def test_output_has_the_frames_of_the_input(run, tmp_path, suffix):
    output = tmp_path / f"o{suffix}"
    code, out, err = run("steady", SAMPLE, output, *PART, "--json")
    assert (code, err) == (0, "")
    record = json.loads(out)
    assert record["frames"] == 6
    assert record["scenes"] == 1
    assert record["sigma"] >= 0
    assert open_frames(output).shape[:3] == (6, 48, 64)


def test_bits_that_the_output_does_not_hold_are_named(run, tmp_path):
    write_video(tmp_path / "a.mkv", np.random.default_rng(0).uniform(0, 1, (3, 20, 32)).astype(np.float32), 25, 10)
    for name, told in {"b.mp4": 1, "b.mkv": 0}.items():
        code, _, err = run("steady", tmp_path / "a.mkv", tmp_path / name, "--sigma", "0")
        assert code == 0 and err.count("h264 holds 8 of the 10 bits of the input") == told


def test_doubts_about_the_input_are_in_the_verdict(run, tmp_path):
    columns = np.random.default_rng(0).uniform(0, 1, (48, 64, 5)).astype(np.float32)
    np.save(tmp_path / "a.npy", columns)
    page = tmp_path / "report.html"
    code, out, _ = run("steady", tmp_path / "a.npy", tmp_path / "b.npy", "--sigma", "0", "--json", "--report", page)
    checks = json.loads(out)["verdict"]["checks"]
    assert code == 0 and checks[0]["kind"] == "input"
    doubt = checks[0]["text"]
    assert doubt.startswith("its axes are taken for ")
    assert page.read_text().count(doubt) == 1


def test_settings_repeat_the_run(run, tmp_path):
    first, second = tmp_path / "a.npy", tmp_path / "b.npy"
    assert run("steady", SAMPLE, first, *PART, "--camera", "lock", "--sigma", "1.1", "--bit-depth", "32")[0] == 0
    assert run("steady", SAMPLE, second, "--config", tmp_path / "a.npy.toml", "--quiet") == (0, "", "")
    assert first.read_bytes() == second.read_bytes()


def test_mask_shows_what_moves(run, tmp_path):
    frames = np.full((8, 64, 96), 0.4, np.float32)
    frames += np.random.default_rng(0).normal(0, 0.1, (64, 96)).astype(np.float32)
    for number, frame in enumerate(frames):
        frame[20:40, 10 + 4 * number : 30 + 4 * number] = 0.95
    write_video(tmp_path / "a.npy", frames.clip(0, 1), 25, 32)
    mask = tmp_path / "mask.mkv"
    assert run("steady", tmp_path / "a.npy", tmp_path / "o.mkv", "--sigma", "0", "--mask", mask, "--quiet")[0] == 0
    shown = open_frames(mask).read()
    assert set(np.unique(shown)) <= {0.0, 1.0}
    assert shown[4, :12].mean() < 0.05 < shown[4, 18:42].mean()


def test_duplicated_and_blank_frames_and_cuts_stay(run, tmp_path):
    rng = np.random.default_rng(0)
    one, two = rng.random((2, 32, 32)).astype(np.float32)
    write_video(tmp_path / "a.npy", [one, one, 0 * one, one, two, two, two], 25, 32)
    code, out, err = run("steady", tmp_path / "a.npy", tmp_path / "o.npy", "--sigma", "0", "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["frames"] == 7
    assert np.allclose(np.load(tmp_path / "o.npy")[5], two, atol=0.02)


def stand_in(monkeypatch, data):
    """Let data come from standard input."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))


def test_a_pipe_takes_and_gives_raw_frames():
    scene = np.random.default_rng(0).integers(0, 256, (20, 32, 3), np.uint8)
    words = [sys.executable, "-m", "turbrestore_cli", "steady", "-", "-", "--raw=32x20", "--sigma=0", "--quiet"]
    done = subprocess.run(words, input=scene.tobytes() * 4, capture_output=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert np.abs(np.frombuffer(done.stdout, np.uint8).reshape(4, 20, 32, 3) - scene.astype(float)).max() <= 2


def test_pipes_of_matroska_stand_in_a_row(tmp_path, monkeypatch, capfdbinary):
    quick = ["--sigma", "0", "--quiet"]
    assert main(["steady", str(SAMPLE), "-", *PART, *quick]) == 0
    stand_in(monkeypatch, capfdbinary.readouterr().out)
    assert main(["steady", "-", str(tmp_path / "o.mkv"), *quick]) == 0
    assert capfdbinary.readouterr() == (b"", b"")
    assert open_frames(tmp_path / "o.mkv").shape == (6, 48, 64)


def test_a_camera_is_recorded_until_it_is_interrupted(run, tmp_path, monkeypatch):
    frames = np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8)

    class Camera:
        taken = 0

        def __init__(self, name):
            assert name == "/dev/video3"

        def set(self, *_):
            pass

        def get(self, _):
            return 12.5

        def release(self):
            Camera.taken = -Camera.taken

        def read(self):
            Camera.taken += 1
            if Camera.taken == 6:
                signal.raise_signal(signal.SIGINT)
            return True, frames[..., ::-1]

    monkeypatch.setattr("cv2.VideoCapture", Camera)
    output = tmp_path / "o.mkv"
    assert run("steady", "/dev/video3", output, "--live", "--sigma", "0", "--quiet") == (0, "", "")
    written = open_frames(output)
    # The first frame only tells the size, and the last one arrives with the interruption.
    assert (Camera.taken, len(written), written.fps) == (-6, 4, 12.5)
    assert np.abs(written.read(2, 3)[0] * 255 - frames).max() <= 2


def test_an_empty_pipe_is_named(run, monkeypatch):
    stand_in(monkeypatch, b"")
    told = "turbrestore: standard input: expected at least one frame, found no data\n"
    assert run("steady", "-", "-", "--raw", "32x20", "--sigma", "0") == (65, "", told)


@pytest.mark.long
def test_a_reader_that_has_seen_enough_is_no_failure():
    words = [sys.executable, "-m", "turbrestore_cli", "steady", str(SAMPLE), "-", "--roi=40,40,64,48", "--sigma=0"]
    script = '{ "$@"; echo "code $?" >&2; } | head -c 100 >/dev/null'
    words += ["--quiet"]
    done = subprocess.run(["sh", "-c", script, "sh", *words], capture_output=True, text=True, timeout=120, check=False)
    assert done.stderr == "code 0\n"


@pytest.mark.parametrize(
    ("words", "code", "part"),
    [
        (["-", "o.mkv"], 65, "standard input"),
        (["-", "o.mkv", "--roi", "0,0,9,9"], 2, "stream"),
        (["/dev/video99", "o.mkv", "--live"], 65, "/dev/video99: expected a camera"),
        (["-", "o.mkv", "--raw", "20"], 2, "--raw"),
        (["-", "-", "--json"], 2, "--json"),
        (["-", "-", "--crf", "20"], 2, "--crf"),
        (["-", "-", "--raw", "0x64:gray"], 2, "--raw: expected WIDTHxHEIGHT"),
        (["-", "-", "--raw", "64x4", "--bit-depth", "16"], 2, "--bit-depth: has no effect"),
        (["-", "o.mkv", "--report", "o.html"], 2, "--report"),
        (["none.mkv", "o.mkv"], 66, "none.mkv"),
        ([SAMPLE, "o.jpg"], 2, ".mkv"),
        ([SAMPLE, "o.mkv", "--camera", "still"], 2, "camera"),
        ([SAMPLE, "o.mkv", "--mask", "o.mkv"], 73, "two outputs"),
        ([SAMPLE, "o.mp4", "--bit-depth", "16"], 2, "at most 8, as h264 has"),
        ([SAMPLE, "o.mkv", "--crf", "20", "--bit-depth", "10"], 2, "at most 8, as h264 has"),
        ([SAMPLE, "o.mkv", "--codec", "hevc", "--bit-depth", "12"], 2, "at most 10, as hevc has"),
        ([SAMPLE, "o.gif", "--bit-depth", "16"], 2, "at most 8, as .gif has"),
        ([SAMPLE, "o.mkv", "--report", "o.txt"], 2, ".html"),
        ([SAMPLE, "no/o.mkv"], 73, "does not exist"),
        ([SAMPLE, "o.mkv", "--roi", "0,0,8,8", "--sigma", "0"], 65, "16×16"),
    ],
)
def test_wrong_words_leave_nothing_behind(run, tmp_path, monkeypatch, words, code, part):
    monkeypatch.chdir(tmp_path)
    stand_in(monkeypatch, b"no video")
    found, out, err = run("steady", *words)
    assert (found, out) == (code, "")
    assert part in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_outputs_are_not_replaced_unasked(run, tmp_path):
    output = tmp_path / "o.npy"
    output.write_bytes(b"mine")
    assert run("steady", SAMPLE, output, *PART)[0] == 73
    assert output.read_bytes() == b"mine"
    assert run("steady", SAMPLE, output, *PART, "--overwrite", "--quiet")[0] == 0
