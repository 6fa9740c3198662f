"""``turbrestore moments``: tables, JSON, pictures and refusals."""

import json
import subprocess
import sys

import pytest

from turbrestore.core.errors import DataError
from turbrestore_cli.__main__ import main


@pytest.fixture
def run(capsys):
    def call(*words):
        code = main(["moments", *map(str, words)])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


SHORT = ["--seeds", 2, "--params.frames", 4, "--params.burn-in", 1]


class TestWavefront:
    def test_json(self, run):
        code, out, err = run("wavefront", *SHORT, "--json")
        assert (code, err) == (0, "")
        record = json.loads(out)
        assert record["seeds"] == 2
        assert set(record["bounds"]) == {"moments", "moments_1_to_4", "image"}
        assert record["observers"]["O1"]["ratio"] == 1.0
        one = record["observers"]["image_map"]
        assert one["cramer_rao_bound"] == record["bounds"]["image"]
        assert len(f"{one['error']:g}".replace("0.", "").lstrip("0")) <= 4
        assert one["innovation_band"][0] < 1 < one["innovation_band"][1]

    def test_table(self, run):
        code, out, err = run("wavefront", *SHORT)
        assert (code, err) == (0, "")
        lines = out.splitlines()
        assert lines[0] == "wavefront, 2 seeds, error of the state"
        assert [line.split()[0] for line in lines[2:11]] == [
            "O1", "O2", "O3", "O3_legendre", "O3_unscented", "O3_iterated", "moments_1_to_4", "image_one_step",
            "image_map",
        ]  # fmt: skip
        assert len({len(line) for line in lines[1:11] if not line.endswith("*")}) == 1

    def test_an_observer_that_loses_its_light_is_said(self, run):
        words = ["--seeds", 4, "--params.slope-disturbance", 0.316, "--json"]
        code, out, err = run("wavefront", *words)
        assert code == 0
        assert json.loads(out)["lit"] < 0.95
        assert "turbrestore: image_map errs " in err
        assert "times as much as O1: an image without its light misleads it" in err

    def test_settings_are_used(self, run):
        _, quiet, _ = run("wavefront", *SHORT, "--params.noise", 0.001, "--json")
        _, loud, _ = run("wavefront", *SHORT, "--json")
        first, second = (json.loads(out)["observers"]["O1"]["error"] for out in (quiet, loud))
        assert first < 0.8 * second


class TestMirror:
    def test_json_and_a_picture(self, run, tmp_path):
        path = tmp_path / "figures.png"
        code, out, err = run("mirror", "--seeds", 2, "--json", "--plot", path)
        assert (code, err) == (0, "")
        assert path.read_bytes()[1:4] == b"PNG"
        record = json.loads(out)
        assert record["plant_known"]["observers"]["O3"]["ratio"] < 0.6
        assert record["plant_unknown"]["observers"]["augmented"]["cramer_rao_bound"] is None
        assert record["plant_unknown"]["bounds"] == {}


class TestPlots:
    def test_written(self, run, tmp_path):
        path = tmp_path / "figures.png"
        code, _, err = run("wavefront", *SHORT, "--plot", path)
        assert (code, err) == (0, "")
        assert path.read_bytes()[1:4] == b"PNG"

    def test_missing_package(self, run, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
        code, _, err = run("wavefront", *SHORT, "--plot", tmp_path / "figures.png")
        assert code == 2
        assert "not installed; run pip install 'matplotlib" in err and err.count("\n") == 1

    def test_nothing_is_written_by_a_run_that_fails_later(self, run, tmp_path, monkeypatch):
        def fails_unless_known(seeds, params=None):
            if params is not None:
                raise DataError("plant: expected this failure")

        monkeypatch.setattr("turbrestore_cli.moments.new_figure", lambda: None)
        monkeypatch.setattr("turbrestore_cli.moments.draw_mirror", lambda experiment: b"picture")
        monkeypatch.setattr("turbrestore_cli.moments.run_mirror", fails_unless_known)
        code, out, _ = run("mirror", "--seeds", 2, "--plot", tmp_path / "figures.png")
        assert (code, out) == (65, "")
        assert not list(tmp_path.iterdir())


class TestRefusals:
    @pytest.mark.parametrize(
        ("words", "code", "part"),
        [
            (["wavefront", "--seeds", 1], 2, "--seeds"),
            (["wavefront", "--seeds", 2.5], 2, "whole number"),
            (["mirror", "--seeds", 0], 2, "--seeds"),
            (["mirror", "--deviation", 9], 2, "--deviation"),
            (["wavefront", "--plot", "figures.txt"], 2, "figures.txt"),
            (["wavefront", "--plot", "/nowhere/figures.png"], 73, "/nowhere"),
            (["wavefront", "--params.frames", 5], 2, "frames"),
            (["wavefront", "--params.noise", 0], 2, "noise"),
            (["wavefront", "--params.pixels", 2], 2, "pixels"),
            (["wavefront", "--params.kernel-width", 1e-6], 2, "kernel-width"),
            (["wavefront", "--params.amplitude", "inf"], 2, "amplitude"),
        ],
    )
    def test_one_line(self, run, words, code, part):
        found, out, err = run(*words)
        assert (found, out) == (code, "")
        assert err.startswith("turbrestore: ")
        assert err.count("\n") == 1
        assert part in err

    def test_existing_picture_is_kept(self, run, tmp_path):
        path = tmp_path / "figures.png"
        path.write_bytes(b"mine")
        code, _, err = run("mirror", "--plot", path)
        assert code == 73
        assert "figures.png" in err
        assert path.read_bytes() == b"mine"


def test_help_loads_no_numbers():
    code = "import turbrestore_cli.__main__ as m, sys; m.main(['moments', '--help']); print('numpy' in sys.modules)"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "wavefront" in output
    assert output.splitlines()[-1] == "False"
