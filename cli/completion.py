"""``turbrestore --install-completion``: completion of commands, options and their values in a shell."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from cyclopts.completion.detect import ShellDetectionError

from turbrestore.core.errors import ConfigurationError

from .streams import tell


def install_completion(*, shell: Literal["bash", "zsh", "fish"] | None = None, output: Path | None = None) -> None:
    """Install completion of commands, options and their values for bash, zsh or fish.

    Parameters
    ----------
    shell : {"bash", "zsh", "fish"}
        By default the shell that the command runs in.
    output : Path
        File to write, for you to load; by default where the shell looks for it, and bash and zsh are told in their
        start file.
    """
    from .application import build

    try:
        written = build().install_completion(shell=shell, output=output, add_to_startup=output is None)
    except ShellDetectionError as error:
        raise ConfigurationError("--shell: expected bash, zsh or fish, found no shell around; name one") from error
    tell(f"turbrestore: {written}: completion is written; open a new shell to use it")
