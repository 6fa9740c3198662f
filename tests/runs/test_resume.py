"""A run that dies goes on where it stopped, and ends as if nothing had happened."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from turbrestore.io.video import open_frames
from turbrestore.runs.folder_lock import LOCK
from turbrestore.runs.run_files import read_stages
from turbrestore.runs.run_folder import RunFolder
from turbrestore_cli.__main__ import main

from .conftest import WORDS, contents, interrupt, params_of, spy

PLACES = {
    "centroid": ("turbrestore.pipeline.centroid_steps", 1),
    "flow model": ("turbrestore.pipeline.identify", 1),
    "first block": ("turbrestore.filtering.alternating.pass_over", 1),
    "third block": ("turbrestore.filtering.alternating.pass_over", 4),
    "deconvolution": ("turbrestore.pipeline.remove_blur_steps", 1),
    "kept images": ("turbrestore_cli.output.write_image", 2),
    "output": ("turbrestore_cli.clip.write_result", 1),
    "settings": ("turbrestore_cli.clip.write_settings", 1),
}


@pytest.mark.parametrize("where", PLACES)
def test_an_interrupted_run_ends_as_if_nothing_had_happened(whole, place, capsys, where):
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, *PLACES[where])
        assert main(WORDS) == 130
    message = capsys.readouterr().err.splitlines()[-1]
    assert message.startswith("turbrestore: interrupted; --keep kept --resume continues")
    assert not (place / "kept" / LOCK).exists()
    assert main([*WORDS, "--resume"]) == 0
    assert contents(place) == contents(whole)


def test_what_is_done_is_not_done_again(place, monkeypatch):
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, "turbrestore.filtering.alternating.pass_over", 4)
        main(WORDS)
    # Eight training frames, then blocks of eight: two are done and kept.
    kept = RunFolder("kept", open_frames("clip.mkv"), params_of(WORDS), resume=True)
    assert len(kept.filter_start().records) == 16
    called, blocks = spy(monkeypatch), []
    real = sys.modules["turbrestore.filtering.alternating"].pass_over
    monkeypatch.setattr(
        "turbrestore.filtering.alternating.pass_over", lambda *words: blocks.append(words[4]) or real(*words)
    )
    assert main([*WORDS, "--resume"]) == 0
    assert called == ["filter_steps", "remove_blur_steps"]
    # The third block begins anew, then it is finished while the fourth begins.
    assert blocks == [0, 8, 4]


def test_the_record_names_outputs_while_they_are_written_and_a_run_that_dies_twice_replaces_them(place):
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, "turbrestore_cli.clip.write_settings", 1)
        assert main(WORDS) == 130
    names = {Path(name).name for name in read_stages("kept").outputs}
    assert names == {"sharp.png", "sharp.png.toml"}
    assert (place / "sharp.png").exists()
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, "turbrestore.pipeline._find_crop", 1)
        assert main([*WORDS, "--resume"]) == 130
    assert main([*WORDS, "--resume"]) == 0
    assert read_stages("kept").outputs == ()


# The run waits for a signal after a checkpoint, so that it does not come too late on a fast machine.  It may come
# before the wait as well: hence the alarm.
WAITING = """
import signal, sys
from turbrestore.runs import run_folder
from turbrestore_cli.__main__ import main
save = run_folder.save_checkpoint
signal.signal(signal.SIGALRM, lambda *_: None)
def save_and_wait(*words):
    save(*words)
    signal.alarm(5)
    signal.pause()
run_folder.save_checkpoint = save_and_wait
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_signals(whole, place, number):
    command = [sys.executable, "-c", WAITING, *WORDS]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        while not (place / "kept" / "checkpoint.npz").exists() and process.poll() is None:
            time.sleep(0.005)
        process.send_signal(number)
        _, err = process.communicate()
    expected = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}[number]
    assert process.returncode == expected, err
    assert err.count("\n") == (0 if number == signal.SIGKILL else 1)
    assert not (place / "sharp.png").exists()
    parts = [path for path in place.rglob("*") if path.suffix == ".part"]
    assert len(parts) <= (number == signal.SIGKILL)
    assert main([*WORDS, "--resume", "--quiet"]) == 0
    assert contents(place) == contents(whole)
