"""Standard streams that are closed or full, and signals at any time."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from conftest import make_sequence
from turbrestore_cli import commands, signals
from turbrestore_cli.__main__ import main

pytestmark = pytest.mark.skipif(os.name == "nt", reason="streams are closed and signals sent as POSIX has it")
COMMAND = [sys.executable, "-m", "turbrestore_cli"]
RESTORE = ["restore", "clip.npy", "o.png", "--json", "--sigma=1", "--train=4", "--centroid.iterations=1"]
RESTORE += ["--deconvolution.iterations=2"]
full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no device that is always full")


@pytest.fixture
def place(tmp_path):
    np.save(tmp_path / "clip.npy", make_sequence(seed=71, count=6, size=32, scene="camera", rms=0.5).frames)
    return tmp_path


def call(place, words, redirections):
    """Run a command with the redirections of a shell."""
    shell = ["sh", "-c", f'exec "$@" {redirections}', "sh", *COMMAND, *words]
    return subprocess.run(shell, cwd=place, capture_output=True, text=True, check=False, timeout=100)


@pytest.mark.long
@pytest.mark.parametrize("closed", [">&-", "<&- >&- 2>&-"])
def test_closed_streams_hold_nothing_up(place, closed):
    done = call(place, RESTORE, closed)
    assert done.returncode == 0, done.stderr
    assert (place / "o.png").exists()
    assert done.stderr == ""


def test_no_file_takes_the_place_of_a_closed_stream(place):
    code = "import os, sys; from turbrestore_cli.streams import open_closed; open_closed()"
    code += "; print(open('clip.npy').fileno(), file=sys.stdout); sys.stderr.write('x')"
    shell = ["sh", "-c", 'exec "$@" <&- 2>&-', "sh", sys.executable, "-c", code]
    done = subprocess.run(shell, cwd=place, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "3\n")


@pytest.mark.long
@full
def test_nobody_can_be_told_that_standard_error_is_full(place):
    done = call(place, ["restore", "clip.npy", "o.png", *RESTORE[4:]], "2>/dev/full")
    assert done.returncode == 0
    assert (place / "o.png").exists()
    assert call(place, ["info", "gone.npy"], "2>/dev/full").returncode == 66


@pytest.mark.long
@full
@pytest.mark.parametrize("words", [["info", "clip.npy"], ["info", "clip.npy", "--json"], ["--help"]])
def test_a_full_standard_output_is_named(place, words):
    done = call(place, words, ">/dev/full")
    assert done.returncode == 74
    assert done.stderr.startswith("turbrestore: standard output: ")
    assert done.stderr.count("\n") == 1
    assert "No space left on device" in done.stderr


@pytest.mark.parametrize("words", [["info", ""], ["restore", "clip.npy", "o.png", "--keep="]])
def test_empty_words_name_no_folder(place, monkeypatch, capsys, words):
    monkeypatch.chdir(place)
    assert main(words) == 2
    err = capsys.readouterr().err
    assert "empty word" in err
    assert err.count("\n") == 1


# Says where it is, so that the signal comes there.
STARTING = """
import sys, time
class Slow:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            print(flush=True)
            try:
                time.sleep(30)
            except KeyboardInterrupt:
                if len(sys.argv[2]) > 1:
                    raise ImportError("made of an interruption")
                raise
sys.meta_path.insert(0, Slow())
from turbrestore_cli.__main__ import main
sys.exit(main(["info", "clip.npy"]))
"""


@pytest.mark.parametrize("module", ["turbrestore_cli.commands", "cyclopts", "numpy", "turbrestore.io.video"])
@pytest.mark.parametrize("kind", ["-", "turned into another error"])
def test_an_interruption_of_the_start_is_one_line(place, module, kind):
    words = [sys.executable, "-c", STARTING, module, kind]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(words, cwd=place, text=True, **streams) as process:
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "turbrestore: interrupted\n")


ENDING = """
import atexit, os, signal, time
from turbrestore_cli import commands
from turbrestore_cli.__main__ import program
def slow(words):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(30)
        print("slept", flush=True)
    finally:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.05)
        print("saved", flush=True)
def late():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.05)
commands.run = slow
atexit.register(late)
program()
"""


def test_more_signals_do_not_disturb_the_saving():
    done = subprocess.run([sys.executable, "-c", ENDING], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "saved\n", "turbrestore: interrupted\n")


def test_a_saving_that_hangs_can_be_ended(monkeypatch):
    monkeypatch.setattr(signals, "PATIENCE", 0.0)
    heard = []
    with pytest.raises(signals.Terminated), signals.termination_raises(heard):
        with pytest.raises(signals.Terminated):
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.001)
        signal.raise_signal(signal.SIGTERM)
    assert [stop.exit_code for stop in heard] == [130, 143]


def test_an_interrupted_command_leaves_the_handlers_of_its_caller(monkeypatch, capsys):
    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    before = [signal.getsignal(number) for number in numbers]
    for number, code, word in zip(numbers, [130, 143, 129], ["interrupted", "terminated", "terminated"], strict=True):
        monkeypatch.setattr(commands, "run", lambda _, number=number: signal.raise_signal(number))
        assert main(["info", "clip.npy"]) == code
        assert capsys.readouterr().err == f"turbrestore: {word}\n"
        assert [signal.getsignal(number) for number in numbers] == before
