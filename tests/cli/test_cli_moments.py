"""``turbrestore moments``: tables, JSON and refusals."""

import json
import subprocess
import sys
from functools import partial

import pytest


@pytest.fixture
def run(run):
    return partial(run, "moments")


class TestWavefront:
    def test_json(self, run):
        code, out, err = run("wavefront", "--seeds", 2, "--json")
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
        code, out, err = run("wavefront", "--seeds", 2)
        assert (code, err) == (0, "")
        lines = out.splitlines()
        assert lines[0] == "wavefront, 2 seeds, error of the state"
        names = ["O1", "O2", "O3", "O3_legendre", "moments_1_to_4", "image_map"]
        assert [line.split()[0] for line in lines[2:8]] == names
        assert len({len(line) for line in lines[1:8] if not line.endswith("*")}) == 1

    def test_an_observer_that_loses_its_light_is_said(self, run):
        code, out, err = run("wavefront", "--seeds", 4, "--slope-disturbance", 0.316, "--json")
        assert code == 0
        assert json.loads(out)["lit"] < 0.95
        assert "turbrestore: image_map errs " in err
        assert "times as much as O1: an image without its light misleads it" in err


class TestMirror:
    def test_json(self, run):
        code, out, err = run("mirror", "--seeds", 2, "--json")
        assert (code, err) == (0, "")
        record = json.loads(out)
        assert record["plant_known"]["observers"]["O3"]["ratio"] < 0.6
        assert record["plant_unknown"]["observers"]["augmented"]["cramer_rao_bound"] is None
        assert record["plant_unknown"]["bounds"] == {}


def test_help_loads_no_numbers():
    code = "import turbrestore_cli.__main__ as m, sys; m.main(['moments', '--help']); print('numpy' in sys.modules)"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "wavefront" in output
    assert output.splitlines()[-1] == "False"
