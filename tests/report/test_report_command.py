"""Commands that write a report, and the command that a report names."""

import dataclasses
import html
import shlex
from pathlib import Path

import pytest

from turbrestore.core.errors import OutputError
from turbrestore.io.video import write_video
from turbrestore.pipeline import RestoreParams
from turbrestore.registration.centroid import CentroidParams
from turbrestore.runtime.memory_size import MemorySize
from turbrestore_cli.__main__ import main
from turbrestore_cli.commands import build
from turbrestore_cli.options import Machine, Selection, known_sigma
from turbrestore_cli.output import repeating_command, settings_record

from .conftest import QUICK


@pytest.fixture(scope="module")
def clip(tmp_path_factory, frames):
    path = tmp_path_factory.mktemp("clip") / "a clip's $name.mkv"
    write_video(path, frames, 25)
    return path


class TestCommand:
    def test_restore_and_report_write_the_same(self, clip, tmp_path, capsys):
        words = ["restore", *map(str, (clip, tmp_path / "o.png")), "--until=centroid", "--centroid.iterations=1"]
        words.append("--quiet")
        files = {name: tmp_path / name for name in ("r.html", "kept", "again.html")}
        assert main([*words, "--report", str(files["r.html"]), "--keep", str(files["kept"])]) == 0
        assert main(["report", str(files["kept"]), str(files["again.html"]), "--quiet"]) == 0
        assert files["r.html"].read_bytes() == files["again.html"].read_bytes()
        assert main(["report", str(files["kept"])]) == 0
        assert (files["kept"] / "report.html").read_bytes() == files["r.html"].read_bytes()
        assert capsys.readouterr().err.endswith(f"report of {clip.name}\n")
        assert main(["report", str(files["kept"])]) == OutputError.exit_code
        page = files["r.html"].read_text("utf-8")
        # The command needs the folder; nothing else does.
        assert html.unescape(page).count(str(clip.parent)) == 1
        command = shlex.split(html.unescape(page.split('<pre tabindex="0"><code>')[1].split("</code>")[0]))
        assert command == ["turbrestore", *words[:5]]

    @pytest.mark.parametrize(("name", "code"), [("r.txt", 2), ("none/r.html", 73), ("there.html", 73)])
    def test_a_report_that_cannot_be_written_stops_at_once(self, clip, tmp_path, capsys, name, code):
        (tmp_path / "there.html").touch()
        words = ["restore", str(clip), str(tmp_path / "o.png"), "--report", str(tmp_path / name)]
        assert main(words) == code
        assert capsys.readouterr().err.count("\n") == 1
        assert [path.name for path in tmp_path.iterdir()] == ["there.html"]

    def test_the_command_says_what_differs(self, tmp_path):
        params = RestoreParams(
            train=7,
            keep_best=0.5,
            centroid=CentroidParams(mode="single", tolerance=0.1 + 0.2),
            deconvolution=dataclasses.replace(QUICK.deconvolution, sharpen_guide=False, sigma=1e-7),
        )
        selection = Selection(frames=":30:2", roi="0,0,64,48")
        machine = Machine(threads=3)
        record = settings_record(params, selection, 16, machine, MemorySize("2GB"))
        words = repeating_command(tmp_path / "-in put.mkv", tmp_path / "o.png", record)
        assert len(words) == 4 + 11
        _, bound, _ = build().parse_args(words[1:], exit_on_error=False, print_error=False)
        read = bound.arguments["params"]
        deconvolution = known_sigma(bound.arguments["sigma"], read.deconvolution)
        assert dataclasses.replace(read, deconvolution=deconvolution) == params
        assert "--sigma=1e-07" in words
        assert bound.arguments["selection"] == selection
        assert bound.arguments["machine"] == machine
        assert bound.arguments["memory_limit"] == 2e9
        assert bound.arguments["bit_depth"] == 16
        assert bound.arguments["input"] == tmp_path / "-in put.mkv"

    def test_names_that_look_like_flags_stay_names(self, tmp_path):
        words = repeating_command(
            Path("-x.mkv"), Path("o.png"), settings_record(RestoreParams(), Selection(), None, Machine(), None)
        )
        assert words == ("turbrestore", "restore", "./-x.mkv", "o.png")
