"""Arguments and settings files that are wrong: each is refused in one line that says what to change."""

import contextlib
import io
import shutil
from dataclasses import dataclass

import numpy as np
import pytest

from turbrestore.io.images.image_files import write_image
from turbrestore_cli.__main__ import main

USAGE, MISSING = 2, 66
RESTORE = ["restore", "clip.npy", "o.png"]
CENTROID = ["centroid", "clip.npy", "c.npz"]
FLOW = ["flow", "image.png", "clip.npy", "f.npy"]
IDENTIFY = ["identify", "flows.npy", "d.npz"]
FILTER = ["filter", "clip.npy", "c.npz", "d.npz", "o.png"]
DECONVOLVE = ["deconvolve", "image.png", "o.png"]
SYNTHESIZE = ["synthesize", "chart", "s.mkv"]
EVALUATE = ["evaluate", "image.png", "image.png"]
INFO = ["info", "clip.npy"]
WAVEFRONT, MIRROR = ["moments", "wavefront"], ["moments", "mirror"]
CHECK = ["config", "--check", "run.toml"]


@dataclass(frozen=True)
class Case:
    """Words, what the line must hold, the settings file if there is one, the exit code."""

    words: list[str]
    holds: tuple[str, ...]
    toml: str | bytes | None = None
    code: int = USAGE

    def __str__(self):
        return " ".join(self.words) + ("" if self.toml is None else f" {self.toml!r:.50}")


def misspelt():
    """Commands, options and values that are nearly right."""
    for words, near in (
        (["restor"], "restore"),
        (["moments", "miror"], "mirror"),
        ([*RESTORE, "--sigm", "1"], "--sigma"),
        ([*RESTORE, "--memory-limt", "2GB"], "--memory-limit"),
        ([*RESTORE, "--flow.metod", "dis"], "--flow.method"),
        ([*RESTORE, "--overwrit"], "--overwrite"),
        ([*CENTROID, "--trian", "3"], "--train"),
        ([*FLOW, "--flow.dis.smothness", "3"], "--flow.dis.smoothness"),
        ([*SYNTHESIZE, "--strenght", "weak"], "--strength"),
        ([*WAVEFRONT, "--seed", "3"], "--seeds"),
        (["report", "kept", "--overwite"], "--overwrite"),
    ):
        wrong = next((word for word in reversed(words) if word.startswith("--")), None)
        yield Case(words, (wrong or words[1 if words[0] == "moments" else 0], near))
    for words, option, near in (
        (RESTORE, "--flow.method=tvl2", "tvl1"),
        (RESTORE, "--until=filtr", "filter"),
        (DECONVOLVE, "--deconvolution.method=nltvv", "nltv"),
        (SYNTHESIZE, "--model=phase-scren", "phase-screen"),
    ):
        yield Case([*words, option], (*option.split("="), near))
    yield Case([*RESTORE, "--memory-limit=2GBB"], ("memory_limit", "2GBB", "2GB?"))


def of_another_type():
    """Values that are no numbers where numbers belong, and the like."""
    for words, option in (
        (RESTORE, "--sigma=wide"),
        (RESTORE, "--frames=a:b"),
        (RESTORE, "--frames=1:2:3:4"),
        (RESTORE, "--frames=5"),
        (RESTORE, "--roi=1,2,3"),
        (RESTORE, "--roi=1,2,x,4"),
        (RESTORE, "--train=3.5"),
        (RESTORE, "--bit-depth=eight"),
        (FLOW, "--flow.global-shift=perhaps"),
        (FILTER, "--filter.block=1e1"),
        (DECONVOLVE, "--deconvolution.fidelity=1,5"),
        (SYNTHESIZE, "--size=axb"),
        (EVALUATE, "--max-pixels=big"),
        (WAVEFRONT, "--seeds=some"),
        (WAVEFRONT, "--seeds=2.5"),
        (MIRROR, "--deviation=7dB"),
    ):
        yield Case([*words, option], (option.split("=")[0],))
    yield Case([*RESTORE, "--keep-best=thirty"], ("keep_best", "thirty"))
    yield Case([*RESTORE, "--keep-best=30"], ("keep_best", "found 30; write 0.3"))
    yield Case([*RESTORE, "--memory-limit=plenty"], ("memory_limit", "plenty"))
    yield Case([*RESTORE, "--memory-limit=2QB"], ("memory_limit", "2QB"))


def out_of_range():
    """Numbers that no stage can work with."""
    for words, option in (
        (RESTORE, "--train=1"),
        (RESTORE, "--keep-best=0"),
        (RESTORE, "--keep-best=150%"),
        (RESTORE, "--memory-limit=-2GB"),
        (RESTORE, "--memory-limit=1MB"),
        (RESTORE, "--bit-depth=12"),
        (RESTORE, "--bit-depth=32"),
        (RESTORE, "--sigma=-1"),
        *((RESTORE, f"--sigma={value}") for value in ("nan", "inf", "60")),
        (RESTORE, "--train=900"),
        (RESTORE, "--frames=90:99"),
        (RESTORE, "--roi=40,40,64,64"),
        (RESTORE, "--bit-depth=7000"),
        (RESTORE, "--max-pixels=0"),
        (RESTORE, "--roi=-1,0,8,8"),
        ([*RESTORE, "--keep=kept"], "--checkpoint-every=0"),
        (CENTROID, "--centroid.iterations=0"),
        (FLOW, "--flow.threads=-1"),
        (FLOW, "--flow.farneback.neighbourhood=6"),
        (IDENTIFY, "--dynamics.rank=-1"),
        (FILTER, "--filter.block=0"),
        (DECONVOLVE, "--deconvolution.iterations=0"),
        (DECONVOLVE, "--bit-depth=33"),
        (DECONVOLVE, "--sigma=500"),
        (SYNTHESIZE, "--frames=0"),
        (SYNTHESIZE, "--seed=-1"),
        (SYNTHESIZE, "--size=0x0"),
        *((WAVEFRONT, option) for option in ("--seeds=0", "--seeds=1", "--slope-disturbance=0")),
        (WAVEFRONT, "--params.noise=-1"),
        (MIRROR, "--deviation=9"),
    ):
        yield Case([*words, option], (option.split("=")[0].removeprefix("--").rpartition(".")[2],))


def contradicting():
    """Options that do not go together, words that are missing or too many."""
    yield Case([*RESTORE, "--sigma=1", "--deconvolution.sigma=2"], ("--sigma", "deconvolution.sigma"))
    yield Case([*RESTORE, "--until=filter", "--sigma=1"], ("until = filter",))
    yield Case([*RESTORE, "--until=filter", "--deconvolution.sigma=1"], ("until = filter",))
    yield Case(["register", "a.mkv", "b.mkv", "--verbose"], ("Unknown option: --verbose.\n",))
    yield Case(["steady", "a.mkv", "b.mkv", "--quiet", "--verbose"], ("--verbose: contradicts --quiet",))
    yield Case(["restore", "-a.mkv", "b.png"], ("-a.mkv: taken for an option; write ./-a.mkv, or -- before the paths",))
    yield Case(["--install-completion", "--shell", "fsh"], ('Did you mean "fish"?',))
    yield Case(["config", "--init", "a.txt"], (".toml",))
    yield Case([*RESTORE, "--strict", "--skip-damaged"], ("--strict", "--skip-damaged"))
    yield Case([*RESTORE, "--resume"], ("--resume", "--keep"))
    yield Case([*RESTORE, "--report=r.txt"], ("r.txt", ".html"))
    yield Case([*RESTORE, "--frames"], ("--frames",))
    yield Case([*RESTORE, "more.png"], ("more.png: one word too many",))
    yield Case(["restore", "clip.npy"], ("OUTPUT",))
    yield Case(["restore", "clip.npy", "o.gif"], ("o.gif", ".png"))
    yield Case(["centroid", "clip.npy", "c.zip"], ("c.zip", ".npz"))
    yield Case(["flow", "image.png", "clip.npy", "f.npz"], ("f.npz", ".npy"))
    yield Case(["identify", "flows.npy", "d.npy"], ("d.npy", ".npz"))
    yield Case(["synthesize", "chart", "s.avi"], ("s.avi", ".mkv"))
    yield Case(["deconvolve", "image.png", "o.npz", "--bit-depth=8"], ("--bit-depth",))
    yield Case([*SYNTHESIZE, "--like=clip.npy"], ("--like",))
    yield Case([*SYNTHESIZE, "--model=dynamic-texture", "--strength=weak"], ("--strength",))
    yield Case(["evaluate", "image.png"], ("--reference",))
    yield Case(["evaluate", "flows.npy", "flows.npy", "--reference=image.png"], ("--reference",))
    yield Case(["config"], ("--init", "--check"))
    yield Case(["config", "--init=a.toml", "--check=a.toml"], ("--init", "--check"))
    yield Case(["config", "--check=a.toml", "--overwrite"], ("--overwrite",))


def missing():
    """Files that are not there."""
    for words in (
        ["restore", "none.mkv", "o.png"],
        [*RESTORE, "--config=none.toml"],
        [*RESTORE, "--truth=none.png"],
        ["centroid", "none.mkv", "c.npz"],
        ["flow", "none.png", "clip.npy", "f.npy"],
        ["identify", "none.npy", "d.npz"],
        ["filter", "clip.npy", "none.npz", "d.npz", "o.png"],
        ["deconvolve", "none.png", "o.png"],
        ["deconvolve", "image.png", "o.png", "--guide=none.png"],
        ["synthesize", "none.png", "s.mkv"],
        ["evaluate", "none.png", "image.png"],
        ["info", "none.mkv"],
        ["config", "--check=none.toml"],
        ["report", "none"],
    ):
        name = next(word for word in words if "none" in word).split("=")[-1]
        yield Case(words, (name,), code=MISSING)


def settings_files():
    """Settings files: keys that mean nothing or are in the wrong place, wrong types and ranges, no TOML."""
    for text, holds in (
        ("trian = 3\n", ("trian", "did you mean train?")),
        ("[flow]\nmetod = 'dis'\n", ("flow.metod", "flow.method")),
        ("[flow.dis]\nsmothness = 3\n", ("flow.dis.smothness", "flow.dis.smoothness")),
        ("[flwo]\nmethod = 'dis'\n", ("flwo", "did you mean flow?")),
        ("fidelity = 3\n", ("fidelity", "deconvolution.fidelity")),
        ("[flow]\nfidelity = 3\n", ("flow.fidelity", "deconvolution.fidelity")),
        ("flow = 'dis'\n", ("flow", "section")),
        ("[train]\n", ("train", "section")),
        ("quiet = true\n", ("quiet", "command line")),
        ("[flow]\nmethod = 'tvl2'\n", ("method", "tvl1")),
        ("train = 'x'\n", ("train", "whole number")),
        ("train = 3.5\n", ("train", "whole number")),
        ("train = true\n", ("train",)),
        ("train = 1979-05-27\n", ("train",)),
        ("sigma = 'wide'\n", ("sigma",)),
        ("strict = 'perhaps'\n", ("strict",)),
        ("keep_best = 'thirty'\n", ("keep",)),
        ("keep_best = 2.0\n", ("keep_best",)),
        ("memory_limit = '2 big'\n", ("memory_limit", "2GB")),
        ("memory_limit = true\n", ("memory_limit",)),
        ("train = 1\n", ("train",)),
        ("qqq = 3\n", ("turbrestore config --init",)),
        ("report = 'a.html'\n", ("report belongs on the command line",)),
        ("sigma = 1e999\n", ("sigma: expected",)),
        ("a = " + "[" * 100_000, ("run.toml: expected settings as TOML",)),
        ("train = " + "9" * 6000, ("run.toml: expected settings as TOML",)),
        ("frames = 'a:b'\n", ("--frames",)),
        ("bit_depth = 20\n", ("bit_depth",)),
        ("[deconvolution]\niterations = -1\n", ("iterations",)),
        ("sigma = 1\n[deconvolution]\nsigma = 2\n", ("--sigma", "contradicts")),
        ("train = \n", ("run.toml", "TOML")),
        ("train = 3\ntrain = 4\n", ("run.toml", "TOML")),
        ('{"train": 3}\n', ("run.toml", "TOML")),
        (b"\xff\xfe\x00", ("run.toml", "TOML")),
    ):
        yield Case(CHECK, holds, text)
    # A command that is given the file checks it in the same way.
    yield Case([*RESTORE, "--config=run.toml"], ("trian", "did you mean train?"), "trian = 3\n")
    yield Case([*RESTORE, "--config=run.toml"], ("run.toml", "TOML"), bytes(64))


def write_inputs(folder):
    """A clip, an image and flows that the commands could work with, were the arguments right."""
    rng = np.random.default_rng(0)
    np.save(folder / "clip.npy", rng.uniform(size=(6, 32, 32)).astype(np.float32))
    np.save(folder / "flows.npy", rng.normal(size=(6, 8, 8, 2)).astype(np.float32))
    write_image(folder / "image.png", rng.uniform(size=(32, 32)).astype(np.float32), 8)


def complaint(case, folder):
    """What is wrong with how a case is refused; empty if nothing is."""
    settings = folder / "run.toml"
    settings.unlink(missing_ok=True)
    if case.toml is not None:
        settings.write_bytes(case.toml if isinstance(case.toml, bytes) else case.toml.encode())
    before = set(folder.iterdir())
    out, err = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(list(case.words))
    line = err.getvalue()
    left = [path for path in folder.iterdir() if path not in before]
    for path in left:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    if left:
        return f"left {', '.join(path.name for path in left)}: {line!r}"
    if code != case.code:
        return f"exit code {code} in place of {case.code}: {line!r}"
    if line.count("\n") != 1 or not line.startswith("turbrestore: ") or out.getvalue():
        return f"not one line: {line!r}, {out.getvalue()!r}"
    # Keys have underscores where options have hyphens, and either names the setting.
    lacking = [word for word in case.holds if word.replace("_", "-") not in line.replace("_", "-")]
    return f"{', '.join(lacking)} not in {line!r}" if lacking else ""


KINDS = (misspelt, of_another_type, out_of_range, contradicting, missing, settings_files)


@pytest.mark.parametrize("kind", KINDS, ids=lambda f: f.__name__)
def test_is_refused_in_one_line_that_names_it(kind, tmp_path):
    write_inputs(tmp_path)
    wrong = {str(case): found for case in kind() if (found := complaint(case, tmp_path))}
    assert not wrong


def test_a_refusal_that_is_not_as_it_should_be_is_seen(tmp_path):
    write_inputs(tmp_path)
    assert "exit code 2" in complaint(Case(["restor"], (), code=MISSING), tmp_path)
    assert "nonsense not in" in complaint(Case(["restor"], ("nonsense",)), tmp_path)
    assert "left a.toml" in complaint(Case(["config", "--init=a.toml"], ()), tmp_path)
    assert "exit code 0" in complaint(Case(INFO, ()), tmp_path)
