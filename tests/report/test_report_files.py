"""The file of a report, and the folder it can be made from later."""

import dataclasses
import json
import math
import subprocess
import sys

import numpy as np
import pytest

from turbrestore.core.errors import ConfigurationError, DataError, InputNotFoundError, OutputError
from turbrestore.pipeline import restore
from turbrestore.report import check_report, render_report, write_report
from turbrestore.runs.run_files import MEAN, RUN_FILES, load_run, save_run
from turbrestore_cli.__main__ import main

from .conftest import EVIL, QUICK


class TestFiles:
    def test_written_whole_or_not_at_all(self, whole, run, tmp_path, monkeypatch):
        monkeypatch.setattr("turbrestore.report.page.render_report", lambda restoration, run: f"{run.name} ±")
        path = tmp_path / "r.html"
        write_report(path, whole, run)
        assert path.read_text("utf-8") == f"{EVIL} ±"
        with pytest.raises(OutputError, match="exists already"):
            write_report(path, whole, run)
        write_report(path, whole, run, overwrite=True)
        with pytest.raises(ConfigurationError, match=r"\.html"):
            write_report(tmp_path / "r.pdf", whole, run)
        assert [item.name for item in tmp_path.iterdir()] == ["r.html"]

    @pytest.mark.parametrize("package", ["jinja2", "matplotlib"])
    def test_missing_package_is_told_before_the_work(self, tmp_path, monkeypatch, package):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ConfigurationError, match=r"pip install 'matplotlib.*' 'jinja2.*'$"):
            check_report(tmp_path / "r.html")

    def test_packages_are_loaded_only_when_they_are_used(self, tmp_path):
        code = (
            "import sys; from turbrestore.report import check_report; check_report('r.html'); "
            "print(*{'matplotlib', 'jinja2'} & set(sys.modules))"
        )
        done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
        assert done.stdout == "\n"

    def test_a_run_comes_back(self, whole, run, tmp_path):
        save_run(tmp_path / "kept", whole, run)
        assert {path.name for path in (tmp_path / "kept").iterdir()} == set(RUN_FILES) - {MEAN}
        restoration, record = load_run(tmp_path / "kept")
        same(restoration, whole)
        same(record, run)

    def test_what_an_earlier_run_left_goes(self, frames, whole, run, tmp_path):
        save_run(tmp_path, whole, run)
        part = restore(frames, dataclasses.replace(QUICK, until="centroid"))
        save_run(tmp_path, part, run)
        same(load_run(tmp_path)[0], part)
        assert not (tmp_path / "filtered.npz").exists()

    def test_maps_and_gaps_come_back(self, whole, run, tmp_path):
        blur = dataclasses.replace(whole.blur, uncertainty=math.inf)
        filtered = dataclasses.replace(whole.filtered, innovations=np.full(6, np.nan))
        share = np.full(whole.image.shape[:2], 0.25, np.float32)
        found = dataclasses.replace(whole, blur=blur, filtered=filtered, disagreement=share)
        save_run(tmp_path, found, run)
        same(load_run(tmp_path)[0], found)
        assert "Detail taken from the mean" in render_report(dataclasses.replace(whole, disagreement=share), run)


def same(found, expected):
    """Equal, field by field, down to every array."""
    assert type(found) is type(expected)
    if dataclasses.is_dataclass(expected):
        for item in dataclasses.fields(expected):
            same(getattr(found, item.name), getattr(expected, item.name))
    elif isinstance(expected, np.ndarray):
        assert found.dtype == expected.dtype
        assert np.array_equal(found, expected, equal_nan=expected.dtype.kind == "f")
    else:
        assert found == expected


def spoil(key, value):
    def change(folder):
        path = folder / "run.json"
        record = json.loads(path.read_text())
        part = record
        *above, last = key.split(".")
        for name in above:
            part = part[name]
        part[last] = value
        path.write_text(json.dumps(record))

    return change


def cut(name):
    def change(folder):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: len(data) // 2])

    return change


def swap_image(folder):
    with np.load(folder / "images.npz") as archive:
        arrays = dict(archive)
    np.savez(folder / "images.npz", **{**arrays, "frame": arrays["frame"][:-3]})


def swap_share(folder):
    with np.load(folder / "images.npz") as archive:
        arrays = dict(archive)
    np.savez(folder / "images.npz", **{**arrays, "disagreement": np.full(arrays["image"].shape[:2], 1.5, np.float32)})


DAMAGE = {
    "no record": (lambda folder: (folder / "run.json").unlink(), InputNotFoundError),
    "no folder": (lambda folder: folder.rename(folder.with_name("gone")), InputNotFoundError),
    "cut record": (cut("run.json"), DataError),
    "binary record": (lambda folder: (folder / "run.json").write_bytes(b"\xff\xfe\x00"), DataError),
    "nested record": (lambda folder: (folder / "run.json").write_text("[" * 100_000), DataError),
    "list": (lambda folder: (folder / "run.json").write_text("[]"), DataError),
    "newer": (spoil("schema", 99), DataError),
    "no part": (spoil("run", None), DataError),
    "number for text": (spoil("run.name", 3), DataError),
    "schema is a flag": (spoil("schema", True), DataError),
    "no section of settings": (spoil("run.settings.centroid", None), DataError),
    "text in a setting": (spoil("run.settings.centroid", {"tolerance": "small"}), DataError),
    "reading is no record": (spoil("restoration.guard_readings", [1]), DataError),
    "half a decision": (spoil("restoration.decisions", [{"subject": "blur"}]), DataError),
    "unknown result": (spoil("restoration.results", ["centroid", "hologram"]), DataError),
    "no centroid": (spoil("restoration.results", []), DataError),
    "path for result": (spoil("restoration.results", ["centroid", "../dynamics"]), DataError),
    "cut images": (cut("images.npz"), DataError),
    "no images": (lambda folder: (folder / "images.npz").unlink(), InputNotFoundError),
    "sizes": (swap_image, DataError),
    "more than the whole": (swap_share, DataError),
    "lost stage": (lambda folder: (folder / "filtered.npz").unlink(), InputNotFoundError),
    "cut stage": (cut("centroid.npz"), DataError),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damage_is_one_line(whole, run, tmp_path, capsys, case):
    folder = tmp_path / "kept"
    save_run(folder, whole, run)
    change, error = DAMAGE[case]
    change(folder)
    with pytest.raises(error):
        load_run(folder)
    assert main(["report", str(folder), str(tmp_path / "r.html")]) == error.exit_code
    message = capsys.readouterr().err
    assert message.startswith("turbrestore: ")
    assert message.count("\n") == 1
    assert not (tmp_path / "r.html").exists()
