"""``turbrestore --install-completion``: completion of commands, options and their values in a shell."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

from cyclopts.completion import detect, install

from turbrestore.core.errors import ConfigurationError

from .options import Flag
from .streams import tell

# Start files that get a line; fish needs none.
STARTED_BY = {"bash": ".bashrc", "zsh": ".zshrc"}


def install_completion(
    *, shell: Literal["bash", "zsh", "fish"] | None = None, output: Path | None = None, yes: Flag = False
) -> None:
    """Install completion of commands, options and their values for bash, zsh or fish.

    Parameters
    ----------
    shell : {"bash", "zsh", "fish"}
        By default the shell that the command runs in.
    output : Path
        File to write, for you to load.  By default it is written where the shell looks for it, and bash and zsh are
        told in their start file; the command names both files and asks first.
    yes : bool
        Do not ask.
    """
    from .commands import build

    try:
        chosen = shell or detect.detect_shell()
    except detect.ShellDetectionError as error:
        raise ConfigurationError("--shell: expected bash, zsh or fish, found no shell around; name one") from error
    if output is None and not yes:
        _ask(chosen)
    written = build().install_completion(shell=chosen, output=output, add_to_startup=output is None)
    tell(f"turbrestore: {written}: completion is written; open a new shell to use it")


def _ask(shell: Literal["bash", "zsh", "fish", "powershell"]) -> None:
    """Name the files that will be written and edited, and go on only if a person agrees."""
    start = STARTED_BY.get(shell)
    edited = "" if start is None else f" and adds a line to {Path.home() / start}"
    what = f"writes {install.get_default_completion_path(shell, 'turbrestore')}{edited}"
    if not sys.stdin.isatty():
        raise ConfigurationError(f"--install-completion: {what}; add --yes to agree, or name another file by --output")
    tell(f"turbrestore: --install-completion {what}")
    if input("Go on? [y/N] ").strip().lower() not in ("y", "yes"):
        raise ConfigurationError("--install-completion: nothing was written")
