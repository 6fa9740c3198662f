"""Entry point: the commands, and how failures end."""

from __future__ import annotations

import io
import logging
import os
import sys
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import App, CycloptsError
from cyclopts.config import Dict

from turbrestore import __version__
from turbrestore.errors import ConfigurationError, InputNotFoundError, StorageError, TurbrestoreError

if TYPE_CHECKING:
    from cyclopts.argument import Argument, ArgumentCollection

INTERRUPTED = 130
BUG = 1
# What a settings file must not decide behind the user's back.
NOT_SETTINGS = {"config", "overwrite", "keep", "truth", "json", "quiet"}


def settings_file(app: App, commands: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Fill what no flag has set from the TOML file named by ``--config``, and check whole numbers."""
    for argument in arguments:
        if "--config" in argument.names and argument.tokens:
            path = Path(argument.tokens[0].value)
            # Sections are named after stages, and so are commands: under the command's name the two cannot be confused.
            record: dict[str, Any] = _read_toml(path)
            for command in reversed(commands):
                record = {command: record}
            Dict(record, source=str(path))(app, commands, arguments)
    for argument in arguments:
        if argument.hint in (int, int | None):
            _refuse_fractions(argument)


def _refuse_fractions(argument: Argument) -> None:
    """Whole numbers must be written as such: conversion alone would round 3.5 frames to 4."""
    for token in argument.tokens:
        if token.value and not token.value.lstrip("+-").isdecimal():
            raise ConfigurationError(f"{argument.name}: expected a whole number, found {token.value!r}")


def _read_toml(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputNotFoundError(f"{path}: no such settings file")
    try:
        record = tomllib.loads(path.read_text("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: expected settings as TOML, found {error}") from error
    for name in NOT_SETTINGS & {key.replace("-", "_") for key in record}:
        raise ConfigurationError(f"{path}: {name} belongs on the command line, not in a settings file")
    return record


def build() -> App:
    """Assemble the application; commands are imported when they run."""
    app = App(
        name="turbrestore",
        help="Restore one sharp image from a video of a static scene seen through atmospheric turbulence.",
        help_epilogue="Example: turbrestore restore haze.mp4 sharp.png",
        version=__version__,
        config=settings_file,
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    package = __package__ or "turbrestore_cli"
    app.command(f"{package}.restore:restore", help="Restore a video: the whole chain, input first, output last.")
    app.command(f"{package}.stages:centroid", help="Find the centroid of a video.")
    app.command(f"{package}.stages:flow", help="Measure the flow from one image to every frame of a video.")
    app.command(f"{package}.stages:identify", help="Identify the dynamics of flows.")
    app.command(f"{package}.stages:filter_", name="filter", help="Filter a video with known centroid and dynamics.")
    app.command(f"{package}.stages:deconvolve", help="Deblur an image.")
    app.command(f"{package}.synthesis:synthesize", help="Make a turbulent video with known truth and flow.")
    app.command(f"{package}.inspection:info", help="Say what a video is.")
    app.command(f"{package}.inspection:evaluate", help="Compare a result with the truth.")
    moments = App(name="moments", help="Compare estimators for slow sensors of fast motion, on simulated frames.")
    moments.command(f"{package}.moments:wavefront", help="A wavefront sensor that is exposed all the time.")
    moments.command(f"{package}.moments:mirror", help="A steered mirror seen by a slow camera.")
    app.command(moments)
    return app


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    arguments : list of str, optional
        Words after the program's name; by default those of the process.

    Returns
    -------
    int
        Exit code: 0 done, 2 usage, 65 bad data, 66 no such input, 73 cannot create the output, 74 I/O error,
        130 interrupted, 1 a bug.
    """
    words = sys.argv[1:] if arguments is None else arguments
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    # The libraries that decode images print their own complaints; ours is the one line that counts.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    try:
        build()(words, exit_on_error=False, print_error=False)
    except BrokenPipeError:
        # The reader has seen enough; a second complaint at exit would be about the same.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (CycloptsError, TurbrestoreError, KeyboardInterrupt, OSError, MemoryError) as error:
        message, code = _explain(error)
        sys.stderr.write(f"turbrestore: {' '.join(message.split())}\n")
        return code
    return 0


def _explain(error: BaseException) -> tuple[str, int]:
    """One line and an exit code for a failure that is no bug."""
    if isinstance(error, TurbrestoreError):
        return str(error), error.exit_code
    if isinstance(error, CycloptsError):
        return str(error), ConfigurationError.exit_code
    if isinstance(error, OSError):
        return f"{error.filename or 'system'}: {error.strerror or error}", StorageError.exit_code
    if isinstance(error, MemoryError):
        return "out of memory; use --roi, fewer --train frames or a smaller video", BUG
    return "interrupted", INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
