"""The commands, the application that they make up, and how failures end."""

from __future__ import annotations

import io
import logging
import os
import sys

from cyclopts import (
    App,
    CycloptsError,
    MissingArgumentError,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
)

from turbrestore import __version__
from turbrestore.core.errors import ConfigurationError, StorageError, TurbrestoreError

from .examples import EXAMPLES, FIRST_STEPS, epilogue
from .help import EVERYTHING, Formatter
from .hints import unknown_option, with_meaning
from .overview import COMMANDS, MOMENTS, SUMMARY
from .settings import settings_file
from .signals import INTERRUPTED
from .streams import flush, silence, tell

USAGES = {
    "align": "Usage: turbrestore align [OPTIONS] RESULT... FOLDER",
    "batch": "Usage: turbrestore batch [OPTIONS] INPUT... FOLDER",
    "deconvolve": "Usage: turbrestore deconvolve [OPTIONS] INPUT [OUTPUT]",
    # Found by the parser, this line would take a tenth of a second: restore has so many options.
    "restore": "Usage: turbrestore restore [OPTIONS] INPUT OUTPUT",
}
BUG = 1


def build(explain_all: bool = False) -> App:
    """Assemble the application; commands are imported when they run."""
    app = App(
        name="turbrestore",
        help=SUMMARY,
        help_epilogue=epilogue(FIRST_STEPS),
        version=__version__,
        config=settings_file,
        help_formatter=Formatter(explain_all),
        help_format="plaintext",
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    groups = {
        "": app,
        "moments": App(
            name="moments",
            help=MOMENTS,
            help_epilogue=epilogue(EXAMPLES["moments wavefront"] + EXAMPLES["moments mirror"]),
        ),
    }
    app.command(groups["moments"])
    package = __package__ or "turbrestore_cli"
    for words, (place, summary) in COMMANDS.items():
        group, _, name = words.rpartition(" ")
        shown = EXAMPLES[words] if explain_all else EXAMPLES[words][:3]
        texts = {"help": summary, "usage": USAGES.get(words), "help_epilogue": epilogue(shown)}
        groups[group].command(f"{package}.{place}", name=name, **texts)
    return app


def run(words: list[str]) -> int:
    """Run one command.

    Parameters
    ----------
    words : list of str
        Words after the program's name.

    Returns
    -------
    int
        Exit code: 0 done, 2 usage, 65 bad data, 66 no such input, 73 cannot create the output, 74 I/O error,
        130 interrupted, 143 terminated, 1 a bug.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    # The libraries that decode images print their own complaints; ours is the one line that counts.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    try:
        _refuse_empty(words)
        # The parser takes a lone hyphen for an option; as a path, this is the same.
        paths = ["./-" if word == "-" else word for word in words]
        explain_all = EVERYTHING in paths
        paths = ["--help" if word == EVERYTHING else word for word in paths]
        app, command = build(explain_all), _explained_command(paths)
        if command:
            app.help_print(command)
        else:
            app(paths, exit_on_error=False, print_error=False)
        flush()
    except BrokenPipeError:
        # The reader has seen enough; a second complaint at exit would be about the same.
        silence(sys.stdout)
    except (CycloptsError, TurbrestoreError, KeyboardInterrupt, OSError, MemoryError) as error:
        message, code = explain(error)
        tell(f"turbrestore: {' '.join(with_meaning(as_typed(message, words), words).split())}")
        return code
    return 0


def _explained_command(words: list[str]) -> list[str]:
    """Words of the command whose help is asked for; none if the parser has to look at what else was typed.

    The parser would read the settings of every stage twice, once to see whether one of them is called help.
    """
    if not {"--help", "-h"} & set(words) or "--" in words:
        return []
    return next((words[:count] for count in (2, 1) if " ".join(words[:count]) in COMMANDS), [])


def _refuse_empty(words: list[str]) -> None:
    """Refuse empty words, which mostly come from empty variables of a shell; as paths they would name this folder."""
    for word in words:
        if not word or (word.startswith("--") and word.endswith("=")):
            raise ConfigurationError(f"{word.rstrip('=') or 'command line'}: expected a value, found an empty word")


def explain(error: BaseException) -> tuple[str, int]:
    """One line and an exit code for a failure that is no bug."""
    if isinstance(error, TurbrestoreError):
        return str(error), error.exit_code
    if isinstance(error, CycloptsError):
        return _misuse(error), ConfigurationError.exit_code
    if isinstance(error, OSError):
        return f"{error.filename or _full_output() or 'system'}: {error.strerror or error}", StorageError.exit_code
    if isinstance(error, MemoryError):
        return (
            "out of memory; a part of the input takes less (--roi, --frames), and restore has --memory-limit",
            BUG,
        )
    return str(error) or "interrupted", getattr(error, "exit_code", INTERRUPTED)


def _misuse(error: CycloptsError) -> str:
    """Say what is wrong with the words of a command, and where to look."""
    if isinstance(error, UnusedCliTokensError):
        extra = " ".join(error.unused_tokens or [])
        return f"{extra}: one word too many; a name with spaces needs quotes, and --help says what is expected"
    if isinstance(error, MissingArgumentError) and error.argument is not None:
        command = " ".join(["turbrestore", *(error.command_chain or ())])
        return f"{error.argument.name}: expected a value, found none; {command} --help says what is expected"
    if isinstance(error, UnknownOptionError):
        return unknown_option(error)
    if isinstance(error, UnknownCommandError) and error.unused_tokens and "Did you mean" not in str(error):
        return f"{error.unused_tokens[0]}: no such command; turbrestore --help lists them"
    return str(error)


def as_typed(message: str, words: list[str]) -> str:
    """Name options in a message as they were typed; the library names the setting, such as keep_best."""
    name, colon, rest = message.partition(": ")
    typed = dict.fromkeys(word.partition("=")[0] for word in words if word.startswith("--"))
    wanted = name.replace("_", "-").rpartition(".")[2]
    fitting = [option for option in typed if option.removeprefix("--").rpartition(".")[2] == wanted]
    if len(fitting) == 1:
        message = f"{fitting[0]}{colon}{rest}"
    message = message.replace("allow damaged ones to be skipped", "add --skip-damaged")
    return message.replace("pass overwrite=True", "add --overwrite")


def _full_output() -> str:
    """Name standard output if it is to blame: what it has not taken before it does not take now."""
    try:
        flush()
    except StorageError:
        return "standard output"
    except BrokenPipeError:
        silence(sys.stdout)
    return ""
