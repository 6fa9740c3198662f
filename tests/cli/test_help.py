"""``--help`` fits a screen and has what people use; ``--help-all`` has everything; neither shows the inside."""

import re

import pytest

from turbrestore_cli.__main__ import main
from turbrestore_cli.commands import COMMANDS, build
from turbrestore_cli.help import _cut


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


def option_names(text):
    return re.findall(r"(?m)^  (--[\w.-]+)", text)


def test_the_help_of_restore_fits_a_screen(run):
    code, short, _ = run("restore", "--help")
    assert code == 0
    assert len(short.splitlines()) <= 42
    assert 18 <= len(option_names(short)) <= 24
    assert {"--sigma", "--frames", "--roi", "--report", "--keep-best", "--overwrite"} <= set(option_names(short))
    assert "--help-all explains these and" in short
    assert all(len(line) <= 80 for line in short.split("Examples:")[0].splitlines())
    # Every line of an option says something, and no clause is cut in two.
    assert not re.search(r"…$|\($", short.split("Examples:")[0], re.MULTILINE)


def test_all_help_has_every_option_by_stage(run):
    code, everything, _ = run("restore", "--help-all")
    assert code == 0
    command = build()["restore"]
    names = {item.names[0] for item in command.assemble_argument_collection() if item.show and item.names[0][0] == "-"}
    assert names == set(option_names(everything))
    assert re.search(r"(?m)^deconvolution.weights:$", everything)
    assert "One of centroid, identify, filter, deconvolve." in " ".join(everything.split())


def test_the_list_of_commands_has_a_line_for_each(run):
    _, text, _ = run("--help")
    lines = text.split("Commands:")[1].split("Examples:")[0].strip().splitlines()
    assert len(lines) == len({words.split()[0] for words in COMMANDS}) + 2
    assert all(len(line) <= 80 for line in lines)


@pytest.mark.parametrize("columns", ["60", "80", "200"])
def test_the_list_that_comes_at_once_is_that_of_the_parser(run, capsys, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", columns)
    _, parsed, _ = run("--help")
    assert main(["--help"]) == 0
    assert capsys.readouterr().out.split("\n") == [line.rstrip() for line in parsed.split("\n")]


def test_a_text_is_cut_at_the_end_of_a_clause():
    assert (
        _cut("Most memory to take, such as 2GB. By default there is no limit.", 40)
        == "Most memory to take, such as 2GB"
    )
    assert _cut("Region of pixels, from the corner: four numbers.", 20) == "Region of pixels"
    assert _cut("Short.", 20) == "Short"
    assert _cut("Antidisestablishmentarianism reconsidered", 34) == "Antidisestablishmentarianism…"
