"""``turbrestore report``: the report of a run that was kept."""

from __future__ import annotations

from pathlib import Path

from turbrestore.report import check_report, write_report
from turbrestore.runs.run_files import load_run

from .options import Flag
from .progress import say


def report(folder: Path, output: Path | None = None, /, *, overwrite: Flag = False, quiet: Flag = False) -> None:
    """Write the report of a run from the folder that ``restore --keep`` wrote.

    Parameters
    ----------
    folder : Path
        Folder of a kept run.
    output : Path
        HTML file to write, .html.  By default report.html in the folder.
    overwrite : bool
        Replace an existing output.
    quiet : bool
        No remarks.
    """
    target = folder / "report.html" if output is None else output
    restoration, run = load_run(folder)
    check_report(target, overwrite=overwrite)
    write_report(target, restoration, run, overwrite)
    say(f"{target}: report of {run.name}", quiet)
