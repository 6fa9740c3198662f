"""Many clips: what counts as a clip, names, failures, what is resumed, and processes that are killed."""

import csv
import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
import tomllib
from concurrent.futures import Future
from functools import partial
from pathlib import Path

import numpy as np
import psutil
import pytest

from conftest import make_sequence
from turbrestore.core.errors import ConfigurationError, DataError, InputNotFoundError, TurbrestoreError
from turbrestore.io.images.image_files import read_image, write_image
from turbrestore.io.video import open_frames, write_video
from turbrestore.report.batch_page import ClipRow, render_batch
from turbrestore.runtime.runtime import Runtime
from turbrestore_cli import batch as command
from turbrestore_cli import batch_plan, cluster
from turbrestore_cli.__main__ import main
from turbrestore_cli.batch_plan import find_clips, journal_line, name_outputs, read_journal
from turbrestore_cli.inputs import open_input
from turbrestore_cli.options import Machine

QUICK = ["--centroid.iterations", "1", "--filter.inner-iterations", "1", "--sigma", "1", "--threads", "1"]


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clips")
    for number in range(5):
        write_video(folder / f"{number}.mkv", make_sequence(seed=number, count=8, size=64, rms=0.8).frames, 25)
    return folder


@pytest.fixture(scope="module")
def scheduler():
    """A scheduler with one worker, both of them threads of this process."""
    from distributed import LocalCluster

    # Any free port: without an address the dashboard takes 8787, which another run of the tests may hold.
    with LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol="tcp",
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def run(run, scheduler):
    return partial(run, "batch", "--scheduler", scheduler, *QUICK)


def rows(out):
    with (out / "summary.csv").open(newline="") as table:
        return list(csv.DictReader(table))


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix in (".png", ".toml")}


class TestClips:
    def test_files_folders_and_patterns(self, clips, tmp_path):
        names = [clips / f"{number}.mkv" for number in range(5)]
        assert find_clips([clips]) == names
        assert find_clips([clips / "3.mkv", clips / "[0-4].mkv"]) == [names[3], *names[:3], names[4]]
        for night in ("a", "b"):
            (tmp_path / night / "notes").mkdir(parents=True)
            write_image(tmp_path / night / "1.png", np.zeros((4, 4), np.float32))
        assert find_clips([tmp_path]) == [tmp_path / "a", tmp_path / "b"]

    def test_what_is_none(self, tmp_path):
        for path, error in (("x.mkv", InputNotFoundError), ("*.mkv", InputNotFoundError), ("", DataError)):
            with pytest.raises(error):
                find_clips([tmp_path / path])
        with pytest.raises(ConfigurationError):
            find_clips([])

    def test_names(self, tmp_path):
        paths = [tmp_path / name for name in ("a/x.mkv", "b/x.mkv", "y.mkv", "Y.ser", "z.mkv")]
        for path in paths:
            path.parent.mkdir(exist_ok=True)
            path.touch()
        names = [path.name for path in name_outputs(paths, tmp_path, ".png")]
        assert names == ["a_x.mkv.png", "b_x.mkv.png", "y.mkv.png", "Y.ser.png", "z.png"]
        (tmp_path / "c" / "a").mkdir(parents=True)
        (tmp_path / "c" / "a" / "x.mkv").touch()
        with pytest.raises(ConfigurationError, match="twice"):
            name_outputs([tmp_path / "a/x.mkv", tmp_path / "c/a/x.mkv"], tmp_path, ".png")


def test_processes(monkeypatch):
    monkeypatch.setattr(command, "available_cores", lambda: 8)
    cases = [(60, None, None), (3, None, None), (60, 4.5e9, None), (60, 1e8, None), (60, None, 20), (2, None, 20)]
    assert [command.processes(*case) for case in cases] == [8, 3, 4, 1, 20, 2]


class TestJournal:
    def test_the_newest_row_counts_and_a_torn_line_does_not(self, tmp_path):
        done = ClipRow("a.mkv", "out/a.png", "done", frames=8, blur=1.25)
        text = journal_line(ClipRow("a.mkv", "out/a.png")) + journal_line(done) + '{"input": 3}\n[]\n'
        text += journal_line(dataclasses.replace(done, blur="wide")) + "[" * 100_000 + "\n"
        (tmp_path / "j").write_text(text + journal_line(dataclasses.replace(done, state="failed"))[:40])
        assert read_journal(tmp_path / "j") == {"a.png": done}
        assert read_journal(tmp_path / "none") == {}

    def test_page_escapes_what_it_is_told(self):
        page = render_batch([ClipRow("<i>.mkv", "out/<i>#.png", "done"), ClipRow("b", "b.png")], "<b>")
        assert "looks right" in page and "looks right" not in render_batch([ClipRow("a", "a.png", "done", checks="b")])
        assert "<i>" not in page and "<b>" not in page and "%3Ci%3E%23.png" in page and "not done yet" in page


class TestBatch:
    def test_a_clip_that_fails_is_a_row(self, run, clips, tmp_path):
        (tmp_path / "bad.mkv").write_bytes(b"no video")
        code, out, err = run(
            clips / "0.mkv", tmp_path / "bad.mkv", clips / "1.mkv", "--out", tmp_path / "out", "--json"
        )
        assert code == 1 and "1 of 3 clips failed" in err.splitlines()[-1], err
        table = rows(tmp_path / "out")
        assert [row["state"] for row in table] == ["done", "failed", "done"]
        assert table[1]["reason"].startswith("cannot be opened as a video") and table[1]["frames"] == ""
        verdicts = [row["checks"] or "looks right" for row in json.loads(out)["clips"]]
        assert [row["checks"] for row in table] == [verdicts[0], "", verdicts[2]]
        assert [row["frames"] for row in table[::2]] == ["8", "8"]
        assert [row["state"] for row in json.loads(out)["clips"]] == ["done", "failed", "done"]
        page = (tmp_path / "out" / "index.html").read_text()
        assert page.count("data:image/webp") == 4 and "cannot be opened" in page
        assert {path.name for path in (tmp_path / "out").iterdir()} == {
            *("0.png", "0.png.toml", "1.png", "1.png.toml", "batch.jsonl", "index.html", "summary.csv")
        }
        assert main(["restore", str(clips / "0.mkv"), str(tmp_path / "0.png"), *QUICK, "--quiet"]) == 0
        assert contents(tmp_path / "out").items() >= contents(tmp_path).items()

    def test_resume_does_what_is_missing_or_changed(self, run, clips, tmp_path):
        out, own = tmp_path / "out", tmp_path / "2.mkv"
        own.write_bytes(b"not there yet")
        words = [clips / "0.mkv", clips / "1.mkv", own, "--out", out]
        assert run(*words)[0] == 1
        first = contents(out)
        own.write_bytes((clips / "2.mkv").read_bytes())
        (out / "1.png").unlink()
        (out / f".{16 * '0'}.part").touch()
        times = {path: path.stat().st_mtime_ns for path in out.glob("0.*")}
        code, _, err = run(*words, "--resume")
        assert code == 0 and "of 2: " in err and "0.mkv" not in err, err
        assert contents(out).items() >= first.items() and (out / "2.png").exists()
        assert {path: path.stat().st_mtime_ns for path in times} == times
        assert not list(out.glob(".*"))
        assert [row["state"] for row in rows(out)] == ["done"] * 3
        code, _, err = run(*words, "--resume", "--bit-depth", "16")
        assert code == 0 and "3 of 3: " in err and contents(out)["0.png"] != first["0.png"]

    def test_what_others_made_is_not_replaced(self, run, clips, tmp_path):
        (tmp_path / "0.png").touch()
        for words in ([], ["--resume"]):
            code, _, err = run(clips / "0.mkv", "--out", tmp_path, *words)
            assert code == 73 and "0.png: exists already" in err
        assert [path.name for path in tmp_path.iterdir()] == ["0.png"]
        assert run(clips / "0.mkv", "--out", tmp_path, "--overwrite", "--reports")[0] == 0
        assert (tmp_path / "0.html").read_text().startswith("<!doctype html>")
        code, _, err = run(clips / "0.mkv", "--out", tmp_path)
        assert code == 73 and "holds a batch; choose another folder, add --overwrite, or --resume" in err

    def test_a_static_mask_is_an_input_of_every_clip(self, run, clips, tmp_path):
        out, mask = tmp_path / "out", np.zeros((64, 64), np.float32)
        mask[:6] = 1
        write_image(tmp_path / "mask.png", mask)
        words = [clips / "0.mkv", clips / "1.mkv", "--out", out, "--static-mask", tmp_path / "mask.png"]
        assert run(*words)[0] == 0
        first = contents(out)
        mask[:12] = 1
        write_image(tmp_path / "mask.png", mask, overwrite=True)
        code, _, err = run(*words, "--resume")
        assert code == 0 and "2 of 2: " in err, err
        # A clip without it would be the same in both.
        assert contents(out)["0.png"] != first["0.png"]
        (tmp_path / "mask.png").replace(out / "0.png")
        given = (out / "0.png").read_bytes()
        code, _, err = run(*words[:-1], out / "0.png", "--overwrite")
        assert code == 73 and "0.png: is an input" in err, err
        assert main(["restore", str(words[0]), str(out / "0.png"), "--static-mask", str(out / "0.png")]) == 73
        assert (out / "0.png").read_bytes() == given

    def test_paths_of_settings_hold_where_the_worker_has_another_folder(self, run, clips, tmp_path, monkeypatch):
        (tmp_path / "elsewhere").mkdir()
        (tmp_path / "0.mkv").write_bytes((clips / "0.mkv").read_bytes())
        for name, level in (("dark", 0.02), ("flat", 0.5), ("mask", np.arange(64) < 6)):
            write_image(tmp_path / f"{name}.png", np.full((64, 64), level, np.float32), 8)
        write_image(tmp_path / "still.png", open_frames(clips / "0.mkv").read().mean(axis=0), 8)
        real = command.work

        def elsewhere(order):
            os.chdir(tmp_path / "elsewhere")
            return real(order)

        monkeypatch.setattr(command, "work", elsewhere)
        words = ["--dark", "dark.png", "--flat", "flat.png", "--static-mask", "mask.png"]
        words += ["--reference", "still.png", "--scale", "1.5"]
        for more, count in (([], "1 of 1: "), (["--resume"], "")):
            monkeypatch.chdir(tmp_path)
            code, _, err = run("0.mkv", "--out", tmp_path / "out", *words, *more)
            assert code == 0 and count in err, err
        assert "1 of 1: " not in err
        settings = tomllib.loads((tmp_path / "out" / "0.png.toml").read_text())
        assert (settings["dark"], settings["reference"]) == (str(tmp_path / "dark.png"), str(tmp_path / "still.png"))
        assert read_image(tmp_path / "out" / "0.png").image.shape == (96, 96)

    def test_reasons(self, monkeypatch, clips):
        monkeypatch.setattr(command, "restore_clip", lambda order: (_ for _ in ()).throw(MemoryError))
        monkeypatch.setattr(command, "key_of", lambda order: "")
        order = command.Order(
            clips / "0.mkv", clips / "0.png", command.Selection(), command.RestoreParams(), command.Machine()
        )
        assert command.work(order).reason.startswith("out of memory")
        monkeypatch.setattr(command, "restore_clip", lambda order: 1 / 0)
        assert command.work(order).reason == "ZeroDivisionError: division by zero"

    @pytest.mark.parametrize(
        ("words", "code", "part"),
        [
            (["--scheduler", "tcp://127.0.0.1:1"], 2, "expected a running scheduler"),
            (["--workers", "0"], 2, "--workers: expected at least 1"),
            (["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"], 2, "--workers: has no effect"),
        ],
    )
    def test_usage(self, clips, tmp_path, capsys, monkeypatch, words, code, part):
        monkeypatch.setattr(cluster, "_PATIENCE", 0.3)
        assert main(["batch", str(clips / "0.mkv"), "--out", str(tmp_path / "out"), *words]) == code
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.count("\n") == 1 and part in captured.err

    def test_without_the_extra_clips_are_restored_one_after_the_other(self, clips, tmp_path, capsys, monkeypatch):
        for module in (cluster, batch_plan):
            monkeypatch.setattr(module, "find_spec", lambda name: None)
        monkeypatch.setattr(command, "connected", None)
        (tmp_path / "0.mkv").write_bytes(b"no video")
        words = [str(tmp_path / "0.mkv"), str(clips / "1.mkv"), str(clips / "2.mkv"), str(tmp_path / "out")]
        assert main(["batch", *words, *QUICK]) == 1
        told = capsys.readouterr().err.splitlines()
        assert told[0].startswith("turbrestore: one clip after the other; pip install 'distributed")
        assert [line.split(":")[1] for line in told[1:4]] == [f" {number} of 3" for number in (1, 2, 3)]
        assert [row["state"] for row in rows(tmp_path / "out")] == ["failed", "done", "done"]
        assert not (tmp_path / "out" / "index.html").exists()
        assert told[4].startswith(f"turbrestore: {tmp_path / 'out' / 'index.html'}: not written; pip install ")
        assert main(["batch", *words, "--workers", "2"]) == 2
        assert "pip install 'distributed" in capsys.readouterr().err


class TestTiles:
    """One clip whose frames are larger than a tile."""

    WORDS = ("--until", "filter", "--centroid.iterations", "1", "--filter.inner-iterations", "1", "--threads", "1")

    def test_tiles_are_the_same_bytes_in_other_processes(self, scheduler, tmp_path, capsys, monkeypatch):
        frames = make_sequence(seed=3, count=3, size=448, rms=0.8).frames[:, 100:180]
        write_video(tmp_path / "a.npy", frames, 25)
        opened = []
        monkeypatch.setattr(
            "turbrestore_cli.clip.open_input", lambda path, *rest: opened.append(path) or open_input(path, *rest)
        )
        monkeypatch.chdir(tmp_path)
        for name, words in {
            "here": ["--tile", "384"],
            "there": ["--tile", "384", "--scheduler", scheduler],
            "one": ["--scheduler", scheduler],
        }.items():
            assert main(["restore", "a.npy", str(tmp_path / f"{name}.png"), *self.WORDS, *words]) == 0
        found = contents(tmp_path)
        assert found["here.png"] == found["there.png"] and found["here.png"] != found["one.png"]
        assert found["here.png.toml"] == found["there.png.toml"] and b"tile = 384" in found["there.png.toml"]
        # A worker may have another folder to work in.
        assert opened[1] == tmp_path / "a.npy"
        assert "frames of 448×80 are one tile" in capsys.readouterr().err

    def test_usage(self, clips, tmp_path, capsys):
        few = [["--tile", "100"], ["--tile", "0", "--workers", "1"]]
        for words in (["--workers", "0"], ["--workers", "2", "--scheduler", "tcp://127.0.0.1:1"], *few):
            assert main(["restore", str(clips / "0.mkv"), str(tmp_path / "a.png"), *words]) == 2
            assert capsys.readouterr().err.count("\n") == 1

    def test_settings_keep_the_limit_of_all_processes(self, clips, tmp_path, monkeypatch):
        limits = []
        monkeypatch.setattr(Machine, "runtime", lambda _, *given: limits.extend(given[:1]) or Runtime(*[1, *given[:1]]))
        words = ["--workers", "1", "--memory-limit", "8GB", *self.WORDS]
        assert main(["restore", str(clips / "0.mkv"), str(tmp_path / "a.png"), *words]) == 0
        assert limits[-1] == 4e9
        assert tomllib.loads((tmp_path / "a.png.toml").read_text())["memory_limit"] == 8e9

    @pytest.mark.parametrize("times", [1, 9])
    def test_a_tile_that_loses_its_process_is_sent_again(self, times):
        from distributed import CancelledError, KilledWorker

        losses = [KilledWorker.__new__(KilledWorker), CancelledError()] * times

        class Lossy:
            def scheduler_info(self):
                return {"workers": {}}

            def scatter(self, task, hash):
                return task

            def submit(self, function, task, pure):
                future = Future()
                if losses and task == 2:
                    future.set_exception(losses.pop())
                else:
                    future.set_result(function(task))
                return future

        squares = cluster.over_workers(Lossy())(lambda number: number**2, iter([1, 2, 3]))
        if times == 1:
            assert list(squares) == [1, 4, 9]
        else:
            with pytest.raises(TurbrestoreError, match="killed again and again"):
                list(squares)


def children(process):
    family = psutil.Process(process.pid).children(recursive=True)
    return [child for child in family if "spawn_main" in " ".join(child.cmdline())]


def start(words, workers):
    """Start a batch with so many processes; it has restored one clip when this returns."""
    process = subprocess.Popen(
        [sys.executable, "-m", "turbrestore_cli", *words, "--workers", str(workers)],
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    timer = threading.Timer(300, process.kill)
    timer.start()
    line = process.stderr.readline()
    assert line.startswith("turbrestore: 1 of "), line
    return process, timer


@pytest.mark.long
def test_an_interrupted_batch_whose_processes_are_killed_loses_no_clip(clips, tmp_path):
    # So many that they are not all done before the signal comes.
    chosen = [str(clips / f"{number}.mkv") for number in range(5)]
    words = ["batch", *chosen, "--out", str(tmp_path / "out"), *QUICK]
    process, timer = start(words, 2)
    family = children(process)
    assert len(family) == 2
    process.send_signal(signal.SIGINT)
    _, err = process.communicate()
    timer.cancel()
    assert process.returncode == 130 and "--resume does the others" in err and err.count("\n") <= 4, err
    assert not any(child.is_running() for child in family)
    assert {row["state"] for row in rows(tmp_path / "out")} == {"done", "planned"}

    # Nobody else can do what the only process has begun.
    process, timer = start([*words, "--resume"], 1)
    children(process)[0].kill()
    _, err = process.communicate()
    timer.cancel()
    assert process.returncode == 0, err
    assert [row["state"] for row in rows(tmp_path / "out")] == ["done"] * 5
    singly = tmp_path / "singly"
    singly.mkdir()
    for clip in chosen:
        assert main(["restore", clip, str(singly / f"{Path(clip).stem}.png"), *QUICK, "--quiet"]) == 0
    assert contents(tmp_path / "out") == contents(singly)
    assert not list((tmp_path / "out").glob(".*"))
