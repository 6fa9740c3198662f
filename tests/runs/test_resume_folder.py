"""The folder of a run: what is resumed, refused or begun anew in it, and its lock."""

import subprocess
import sys

import pytest

from turbrestore.core.errors import ConfigurationError, OutputError
from turbrestore.runs.folder_lock import lock_folder
from turbrestore_cli.__main__ import main

from .conftest import STAGES, WORDS, contents, spy


class TestFolder:
    def test_resuming_nothing_just_starts(self, whole, place):
        (place / "kept").mkdir()
        assert main([*WORDS, "--resume", "--quiet"]) == 0
        assert contents(place) == contents(whole)

    def test_without_resume_a_folder_in_use_is_refused_or_starts_anew(self, ended, monkeypatch, capsys):
        called = spy(monkeypatch)
        words = [word.replace("sharp", "other") for word in WORDS]
        assert main(words) == OutputError.exit_code
        assert "resume the run in it" in capsys.readouterr().err
        assert main([*words, "--overwrite"]) == 0
        assert called == list(STAGES)

    def test_resume_needs_a_folder_and_checkpoints_a_distance(self, place, capsys):
        assert main(["restore", "clip.mkv", "o.png", "--resume"]) == ConfigurationError.exit_code
        assert main([word.replace("every=8", "every=0") for word in WORDS]) == ConfigurationError.exit_code
        assert capsys.readouterr().err.count("\n") == 2
        assert [path.name for path in place.iterdir()] == ["clip.mkv"]

    def test_a_complete_result_is_not_replaced_unasked(self, ended, capsys):
        assert main([*WORDS, "--resume"]) == OutputError.exit_code
        assert "sharp.png: exists already" in capsys.readouterr().err

    def test_a_second_run_in_the_folder_is_refused(self, place, capsys):
        with lock_folder("kept"):
            assert main([*WORDS, "--resume"]) == OutputError.exit_code
        assert "another run is at work in this folder" in capsys.readouterr().err
        assert [path.name for path in place.iterdir()] == ["clip.mkv"]

    def test_the_lock_dies_with_its_owner(self, place):
        importing = "from turbrestore.runs.folder_lock import lock_folder"
        code = f"{importing}\nwith lock_folder('kept'):\n print(flush=True); input()"
        with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as owner:
            owner.stdout.readline()
            with pytest.raises(OutputError, match="another run"), lock_folder(place / "kept"):
                pass
            owner.kill()
        with lock_folder(place / "kept") as locks:
            assert locks

    def test_a_file_system_without_locks_is_told(self, place, monkeypatch, capsys):
        monkeypatch.setattr("turbrestore.runs.folder_lock._lock", lambda _: False)
        assert main([*WORDS, "--until=centroid"]) == 0
        assert "does not support locks" in capsys.readouterr().err
