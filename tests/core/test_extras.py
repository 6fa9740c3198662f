"""What to install for an extra, named so that it works without a clone and without an index that has turbrestore."""

import re
import shlex
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from turbrestore.core.extras import install_command

PROJECT = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]


def packages(names):
    """Requirements with those of the extras of turbrestore itself put in their place."""
    for name in names:
        own = re.fullmatch(r"turbrestore\[(.+)\]", name)
        yield from packages(PROJECT["optional-dependencies"][own[1]]) if own else [Requirement(name)]


@pytest.mark.parametrize("extra", ["report", "app", "fits", "distributed", "torch", "napari"])
def test_the_command_names_the_packages_of_the_extra(extra):
    words = shlex.split(install_command(extra))
    assert words[:2] == ["pip", "install"]
    assert {Requirement(word) for word in words[2:]} == set(packages(PROJECT["optional-dependencies"][extra]))


def test_without_metadata_the_clone_is_installed(monkeypatch):
    def unknown(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "requires", unknown)
    assert install_command("fits") == "pip install '.[fits]'"
