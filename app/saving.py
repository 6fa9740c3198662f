"""What the page saves: the files that ``turbrestore restore`` writes, and the command that repeats the run."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from turbrestore.io.output import check_output
from turbrestore.io.pixels import check_depth
from turbrestore_cli.inputs import files_read
from turbrestore_cli.options import Machine
from turbrestore_cli.output import repeating_command, settings_record, write_result, write_settings

from .restoring import Order, Restored


@dataclass(frozen=True)
class Outputs:
    """What to save.

    Parameters
    ----------
    image : Path
        .png, .tif or .fits.
    bit_depth : int, optional
        8, 16 or 32; that of the clip by default.
    report : bool
        Whether a report is written beside the image.
    overwrite : bool
        Replace existing files.
    """

    image: Path
    bit_depth: int | None = None
    report: bool = False
    overwrite: bool = False

    @property
    def settings(self) -> Path:
        """The settings file beside the image."""
        return self.image.with_name(self.image.name + ".toml")

    @property
    def page(self) -> Path:
        """The report beside the image."""
        return self.image.with_name(self.image.name + ".html")


def settings_of(order: Order, bit_depth: int | None) -> dict[str, Any]:
    """All settings of an order, as in a settings file."""
    return settings_record(order.params, order.selection, bit_depth, Machine(), None, order.preset)


def command_line(order: Order, bit_depth: int | None, input: Path, output: Path) -> str:
    """Return the command that repeats an order, ready to be pasted into a shell.

    Parameters
    ----------
    order : Order
    bit_depth : int or None
    input, output : Path
        As the command is to name them.

    Returns
    -------
    str
    """
    return shlex.join(repeating_command(input, output, settings_of(order, bit_depth)))


def check_outputs(outputs: Outputs, order: Order) -> None:
    """Raise an error if something could not be saved."""
    inputs = files_read(order.selection, order.path, params=order.params)
    if outputs.bit_depth is not None:
        check_depth(outputs.bit_depth)
    check_output(outputs.image, inputs, outputs.overwrite)
    check_output(outputs.settings, inputs, outputs.overwrite, suffixes=None)
    if outputs.report:
        from turbrestore.report import check_report

        check_report(outputs.page, inputs, outputs.overwrite)


def save(restored: Restored, outputs: Outputs, name: Path, shown: Path) -> list[Path]:
    """Write the image, its settings and, if wanted, the report.

    Parameters
    ----------
    restored : Restored
    outputs : Outputs
    name, shown : Path
        Input and image as a command names them.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    OutputError, StorageError, ConfigurationError
        A file exists already, or cannot be written.
    """
    check_outputs(outputs, restored.order)
    record = settings_of(restored.order, outputs.bit_depth)
    depth = restored.source.bit_depth if outputs.bit_depth is None else outputs.bit_depth
    command = repeating_command(name, shown, record)
    write_result(outputs.image, restored.restoration, restored.source, depth, command, outputs.overwrite)
    write_settings(outputs.settings, record)
    written = [outputs.image, outputs.settings]
    if outputs.report:
        from turbrestore.report import write_report
        from turbrestore.runs.run_record import describe_run

        run = describe_run(restored.source, record, command)
        write_report(outputs.page, restored.restoration, run, overwrite=outputs.overwrite)
        written.append(outputs.page)
    return written
