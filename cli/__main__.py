"""Entry point; it imports next to nothing, so that Ctrl-C during the imports ends like any other."""

from __future__ import annotations

import sys

from .signals import INTERRUPTED, termination_raises


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    arguments : list of str, optional
        Words after the program's name; by default those of the process.

    Returns
    -------
    int
        Exit code, see :func:`turbrestore_cli.application.run`; 130 interrupted, 143 terminated.
    """
    heard: list[KeyboardInterrupt] = []
    try:
        with termination_raises(heard):
            from .streams import open_closed

            open_closed()
            from .application import run

            return run(sys.argv[1:] if arguments is None else arguments)
    except BaseException:
        # Libraries may turn an interruption of their import into an error of their own.
        if not heard:
            raise
    sys.stderr.write(f"turbrestore: {heard[0] or 'interrupted'}\n")
    return getattr(heard[0], "exit_code", INTERRUPTED)


if __name__ == "__main__":
    sys.exit(main())
