"""Entry point; it imports next to nothing, so that Ctrl-C during the imports ends like any other."""

from __future__ import annotations

import sys
from typing import NoReturn

from .signals import INTERRUPTED, termination_raises


def main(arguments: list[str] | None = None) -> int:
    """Run one command, and leave the handling of signals as it was before.

    Parameters
    ----------
    arguments : list of str, optional
        Words after the program's name; by default those of the process.

    Returns
    -------
    int
        Exit code, see :func:`turbrestore_cli.commands.run`; 130 interrupted, 143 terminated.
    """
    return _command(sys.argv[1:] if arguments is None else arguments, ends_process=False)


def program() -> NoReturn:
    """Run the command that this process was started for, and end the process."""
    sys.exit(_command(sys.argv[1:], ends_process=True))


def _command(arguments: list[str], ends_process: bool) -> int:
    heard: list[KeyboardInterrupt] = []
    try:
        with termination_raises(heard, ends_process):
            from .streams import open_closed

            open_closed()
            if arguments in (["--help"], ["-h"]):
                return _list_commands()
            from .commands import run

            return run(arguments)
    except BaseException:
        # Libraries may turn an interruption of their import into an error of their own.
        if not heard:
            raise
    sys.stderr.write(f"turbrestore: {heard[0] or 'interrupted'}\n")
    return getattr(heard[0], "exit_code", INTERRUPTED)


def _list_commands() -> int:
    from turbrestore.core.errors import StorageError

    from .overview import overview
    from .streams import put, silence, tell

    try:
        put(overview())
    except BrokenPipeError:
        silence(sys.stdout)
    except StorageError as error:
        tell(f"turbrestore: {error}")
        return error.exit_code
    return 0


if __name__ == "__main__":
    program()
