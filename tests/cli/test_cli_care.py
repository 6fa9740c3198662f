"""Help that teaches, errors that suggest, settings files, completion and the doctor."""

import importlib
import json
import re
import shlex
import subprocess
import sys
import tomllib
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import pytest

from turbrestore.core.errors import TurbrestoreError
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.video import open_frames, write_video
from turbrestore.pipeline import RestoreParams
from turbrestore_cli import doctor
from turbrestore_cli.commands import COMMANDS, build
from turbrestore_cli.examples import EXAMPLES, FIRST_STEPS
from turbrestore_cli.options import Machine, Selection
from turbrestore_cli.settings import settings

ROOT = Path(__file__).parents[2]
STEPS = ["--deconvolution.iterations", "3", "--quiet"]
QUICK = ["--centroid.iterations", "1", "--filter.inner-iterations", "1", *STEPS]
# Examples as they stand, but on fewer frames and fewer runs.
SMALLER = {("--frames", "0:24"): "0:4", ("--frames", "120"): "6", ("--frames", "300"): "6", ("--train", "40"): "5"}
SMALLER |= {("--seeds", "20"): "2", ("--roi", "64,32,96,96"): "16,8,64,64"}
# The other examples find the corner of the sample clip and not the whole one.
SMALLER |= {("sample", "sample_data"): "whole_sample"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder to work in, with a corner of six frames of the sample clip and of the truth."""
    samples = tmp_path / "sample_data"
    samples.mkdir()
    corner = open_frames(ROOT / "sample_data" / "chart.mkv", roi=(64, 48, 96, 80))
    write_video(samples / "chart.mkv", corner.read(0, 6), 25)
    truth = read_image(ROOT / "sample_data" / "chart_truth.png").image[48:128, 64:160]
    write_image(samples / "chart_truth.png", truth, 16)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("SHELL", "/bin/bash")
    return tmp_path


def smaller(words):
    """Words of an example with the numbers in ``SMALLER``, and settings that take less time."""
    quick = [SMALLER.get(pair, pair[1]) for pair in pairwise(["", *words])]
    quick += {
        "restore": QUICK,
        "batch": [*QUICK, "--workers", "1"],
        "deconvolve": STEPS,
        "synthesize": ["--size", "64x64", *([] if "--like" in words else ["--pupil-samples", "24"])],
    }.get(words[0], [])
    blurred = words[0] in ("restore", "deconvolve") and not {"--sigma", "--sweep"} & set(words)
    return [*quick, "--sigma", "1"] if blurred else quick


class TestHelp:
    @pytest.mark.parametrize("words", [*EXAMPLES, "moments"])
    def test_every_command_shows_its_examples_no_markup_and_no_path_of_the_source(self, run, words):
        for flag in ("--help", "--help-all"):
            code, out, _ = run(*words.split(), flag)
            assert code == 0
            assert not re.search(r":\w+:`|``|turbrestore\.\w+\.|\w+Params\b|\bNone\b", out), out
        shown = " ".join(out.split("Examples:")[1].split())
        for name in (words,) if words in EXAMPLES else ("moments wavefront", "moments mirror"):
            for example in EXAMPLES[name]:
                assert " ".join(example.split()) in shown

    def test_no_command_is_without(self):
        assert set(COMMANDS) == set(EXAMPLES)
        assert all(example.split()[1] in {name.split()[0] for name in COMMANDS} for example in FIRST_STEPS)
        for words, examples in EXAMPLES.items():
            assert all(example.startswith(f"turbrestore {words}") for example in examples)

    def test_version_is_that_of_the_library(self, run):
        import turbrestore

        assert run("--version") == (0, f"{turbrestore.__version__}\n", "")

    def test_examples_run(self, run, folder):
        # The app serves until it is interrupted: tests/app starts it.
        for words in (name for name in EXAMPLES if name != "app"):
            for example in EXAMPLES[words]:
                code, _, err = run(*smaller(shlex.split(example)[1:]))
                assert code == 0, f"{example}: {err}"
        made = {path.name for path in folder.iterdir()}
        assert len(open_frames("sample_data/chart.mkv")) == 6
        assert {"whole_sample", "sharp.png", "all.png", "tv.png", "haze.flow.npy", "more.mkv", "run.toml"} <= made


class TestSettings:
    def test_written_file_is_what_a_restoration_without_it_uses(self, run, folder):
        write_video("small.mkv", open_frames("sample_data/chart.mkv", roi=(16, 8, 64, 64)).read(0, 4), 25)
        assert run("config", "--init", "run.toml")[0] == 0
        assert run("restore", "small.mkv", "a.png", "--quiet", "--config", "run.toml")[0] == 0
        assert tomllib.loads(Path("a.png.toml").read_text()) == tomllib.loads(Path("run.toml").read_text())
        assert run("restore", "small.mkv", "b.png", "--quiet")[0] == 0
        assert Path("a.png.toml").read_text() == Path("b.png.toml").read_text()
        assert Path("a.png").read_bytes() == Path("b.png").read_bytes()

    def test_a_changed_file_is_what_a_restoration_uses(self, run, folder):
        run("config", "--init", "run.toml")
        text = Path("run.toml").read_text().replace('method = "dis"', 'method = "farneback"')
        text = text.replace("# sigma =", "sigma = 0.9", 1).replace("# train =", "train = 5")
        Path("run.toml").write_text(text)
        code, out, _ = run("config", "--check", "run.toml")
        assert code == 0
        assert out.splitlines() == [
            "run.toml: valid",
            "sigma = 0.9 (default: left open)",
            "train = 5 (default: left open)",
            "flow.method = 'farneback' (default: 'dis')",
        ]
        assert run("restore", "sample_data/chart.mkv", "a.png", "--quiet", "--config", "run.toml")[0] == 0
        asked = tomllib.loads(text)
        used = tomllib.loads(Path("a.png.toml").read_text())
        assert used.pop("sigma", asked["sigma"]) == asked.pop("sigma")
        assert used["deconvolution"].pop("sigma") == 0.9
        assert used == asked

    def test_every_setting_is_there_and_explained(self, run, folder):
        run("config", "--init", "run.toml")
        lines = Path("run.toml").read_text().splitlines()

        def names(record, head=""):
            for name in record.__dataclass_fields__:
                value = getattr(record, name)
                yield from names(value, f"{head}{name}.") if hasattr(value, "__dataclass_fields__") else [head + name]

        table, found = "", {}
        for before, line in zip(["", *lines], lines, strict=False):
            if line.startswith("["):
                table = line[1:-1] + "."
            elif " =" in line and line.removeprefix("# ").split(" =")[0].isidentifier():
                found[table + line.removeprefix("# ").split(" =")[0]] = before
        assert set(found) == {
            *names(RestoreParams()),
            *names(Selection()),
            *names(Machine()),
            "preset",
            "sigma",
            "bit_depth",
            "memory_limit",
            "tile",
        }
        assert all(comment.startswith("# ") and len(comment) > 4 for comment in found.values())
        text = "\n".join(lines)
        assert "(dis | tvl1 | farneback)" in text
        assert ":func:" not in text

    def test_existing_file_is_kept(self, run, folder):
        Path("run.toml").write_text("mine")
        assert run("config", "--init", "run.toml")[0] == 73
        assert Path("run.toml").read_text() == "mine"
        assert run("config", "--init", "run.toml", "--overwrite")[0] == 0
        assert run("config", "--check", "none.toml")[0] == 66


@pytest.mark.parametrize("command", ["restore", "steady", "batch"])
def test_no_settings_file_names_a_file_to_write(command):
    arguments = build()[command].assemble_argument_collection(parse_docstring=True)
    paths = {argument.name for argument in arguments if Path in (argument.hint, *get_args(argument.hint))}
    known = {f"--{key.replace('_', '-')}" for key in settings(arguments)}
    assert len(paths) > 1
    assert not paths & known
    assert "--raw" not in known


class TestCompletion:
    def test_script_knows_commands_options_and_values_and_bash_completes(self, run, folder):
        for shell in ("bash", "zsh", "fish"):
            assert run("--install-completion", "--shell", shell, "--output", f"c.{shell}")[0] == 0
            script = Path(f"c.{shell}").read_text()
            for word in ("synthesize", "wavefront", "farneback"):
                assert word in script
        # Files that are named are for the user to load.
        assert not (folder / ".bashrc").exists()
        assert not (folder / ".zshrc").exists()
        line = (
            'source c.bash; COMP_WORDS=(turbrestore res); COMP_CWORD=1; COMP_LINE="turbrestore res"; COMP_POINT=15; '
            '$(complete -p turbrestore | sed "s/.*-F \\([^ ]*\\).*/\\1/"); echo "${COMPREPLY[*]}"'
        )
        done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
        assert done.stdout.split() == ["restore"]
        assert done.stderr == ""

    def test_without_a_shell_around(self, run, folder, monkeypatch):
        from cyclopts.completion import detect

        def nothing(*_):
            raise detect.ShellDetectionError

        monkeypatch.setattr(detect, "detect_shell", nothing)
        code, out, err = run("--install-completion")
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert "--shell" in err

    def test_files_are_named_before_they_are_edited(self, run, folder, monkeypatch):
        code, _, err = run("--install-completion", "--shell", "bash")
        assert code == 2 and str(folder / ".bashrc") in err and "--yes" in err
        assert not (folder / ".bashrc").exists()
        monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
        for answer, edited in (("n", False), ("y", True)):
            monkeypatch.setattr("builtins.input", lambda _, answer=answer: answer)
            code, _, err = run("--install-completion", "--shell", "bash")
            assert (code, (folder / ".bashrc").exists()) == ((0, True) if edited else (2, False))
            assert f"adds a line to {folder / '.bashrc'}" in err


class TestDoctor:
    def test_this_installation_is_healthy(self, run):
        code, out, err = run("doctor", "--json")
        assert (code, err) == (0, "")
        found = {item["name"]: item for item in json.loads(out)["findings"]}
        assert {name for name, item in found.items() if item["state"] == "broken"} == set()
        assert {"turbrestore", "Python", "numpy", "scipy", "cv2", "av", "read ffv1", "write ffv1", "cores"} <= set(
            found
        )
        assert found["scipy"]["found"] == metadata.version("scipy")
        code, out, _ = run("doctor")
        assert code == 0
        assert all(name in out for name in found)

    def test_what_is_missing_of_the_extras_is_no_failure(self, run, monkeypatch):
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        monkeypatch.setitem(sys.modules, "torch", None)
        code, out, _ = run("doctor")
        assert code == 0
        lines = out.splitlines()
        at = next(index for index, line in enumerate(lines) if line.startswith("missing  matplotlib"))
        assert "pip install 'matplotlib" in lines[at + 1]
        assert "GPU" not in out

    def test_what_every_run_needs_is(self, run, monkeypatch):
        monkeypatch.setitem(sys.modules, "tifffile", None)
        code, out, err = run("doctor")
        assert code == TurbrestoreError.exit_code
        assert "broken   tifffile" in out
        assert err.count("\n") == 1
        assert "tifffile" in err

    def test_old_opencv_is_refused(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "cv2", SimpleNamespace(__version__="4.11.0"))
        finding = doctor.check_library("cv2", "opencv-contrib-python-headless")
        assert finding.state == "broken"
        assert "opencv-contrib-python-headless<6,>=5" in finding.advice

    def test_two_opencvs_are_a_warning(self, monkeypatch):
        both = ["opencv-python", "opencv-contrib-python-headless"]
        monkeypatch.setattr(metadata, "packages_distributions", lambda: {"cv2": both})
        finding = next(iter(doctor.check_opencv()))
        assert finding.state == "warning"
        assert "overwrite each other" in finding.found
        assert "pip uninstall -y opencv-contrib-python-headless opencv-python" in finding.advice
        monkeypatch.setattr(metadata, "packages_distributions", lambda: {"cv2": both[:1]})
        assert next(iter(doctor.check_opencv())).state == "warning"

    def test_a_library_that_does_not_load(self, monkeypatch):
        def load(name):
            raise ImportError("libGL.so.1: cannot open\nshared object")

        monkeypatch.setattr(importlib, "import_module", load)
        finding = doctor.check_library("cv2", "opencv-contrib-python-headless")
        assert finding.state == "broken"
        assert finding.found == "does not load: ImportError: libGL.so.1: cannot open shared object"
        assert list(doctor.check_codecs()) == []

    def test_a_codec_that_is_missing(self, monkeypatch):
        monkeypatch.setattr(doctor, "READ", ("ffv1", "nosuchcodec"))
        states = {item.name: item.state for item in doctor.check_codecs()}
        assert states["read ffv1"] == "ok"
        assert states["read nosuchcodec"] == "warning"
