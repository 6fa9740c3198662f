"""Several clips, one after the other, by the same settings: a clip that fails is a row with its reason."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from turbrestore.core.errors import ConfigurationError
from turbrestore_cli.batch_plan import name_outputs
from turbrestore_cli.output import summary

from .folders import Entry, Folders
from .job import Job, Stopped, one_line
from .restoring import Order, restore_order
from .saving import Outputs, check_outputs, save


@dataclass(frozen=True)
class Row:
    """What became of one clip.

    Attributes
    ----------
    name : str
    state : {"waiting", "running", "done", "failed", "stopped"}
    words : str
        Where the result is and the verdict on it, or why there is none.
    """

    name: str
    state: str = "waiting"
    words: str = ""


@dataclass(frozen=True)
class Task:
    """One clip to restore.

    Attributes
    ----------
    order : Order
    outputs : Outputs
    name, shown : Path
        Clip and image as a command names them.
    """

    order: Order
    outputs: Outputs
    name: Path
    shown: Path


def plan_several(clips: Sequence[Path], folder: str, like: Order, overwrite: bool, folders: Folders) -> list[Task]:
    """Give every clip the settings of one order and the name of its result; the folder is made where it is missing.

    Parameters
    ----------
    clips : sequence of Path
    folder : str
        Where the results go, as it was typed.
    like : Order
        Its settings are taken; its region and frames belong to the clip that it is of.
    overwrite : bool
        Replace existing files.
    folders : Folders
        What may be read and written.

    Returns
    -------
    list of Task

    Raises
    ------
    ConfigurationError
        There is no clip, or the folder lies outside.
    OSError
        The folder cannot be made.
    """
    if not clips:
        raise ConfigurationError("several clips: expected at least one, found none; choose some in the list")
    out = folders.output(folder)
    out.mkdir(exist_ok=True)
    return [
        Task(
            Order(clip, params=like.params, preset=like.preset),
            Outputs(output, overwrite=overwrite),
            folders.shown(clip),
            folders.shown(output.resolve()),
        )
        for clip, output in zip(clips, name_outputs(clips, out, ".png"), strict=True)
    ]


def inputs_of(entries: Sequence[Entry]) -> list[Entry]:
    """Leave out folders, and videos that turbrestore itself has written: their settings lie beside them."""
    return [
        entry
        for entry in entries
        if not entry.is_folder and not entry.path.with_name(f"{entry.path.name}.toml").exists()
    ]


def restore_all(tasks: Sequence[Task], rows: list[Row], job: Job[None]) -> None:
    """Restore clips one after the other, as ``turbrestore restore`` does, and save each at once.

    Parameters
    ----------
    tasks : sequence of Task
    rows : list of Row
        One for each task; replaced by what comes of it.
    job : Job
        Hears of the progress of the clip that is at work.
    """
    for place, task in enumerate(tasks):
        try:
            job.begin_next()
            rows[place] = dataclasses.replace(rows[place], state="running")
            rows[place] = dataclasses.replace(rows[place], state="done", words=_restore(task, job))
        except Stopped:
            rows[place:] = [dataclasses.replace(row, state="stopped") for row in rows[place:]]
            raise
        except Exception as error:  # whatever happens to one clip, the others are restored
            reason = one_line(error).removeprefix(f"{task.order.path}: ").removeprefix(f"{task.order.path.name}: ")
            rows[place] = dataclasses.replace(rows[place], state="failed", words=reason)
    # Each row has the verdict on its clip.
    job.message = ""


def _restore(task: Task, job: Job[None]) -> str:
    """Restore and save one clip; return what to say of it."""
    check_outputs(task.outputs, task.order)
    restored = restore_order(task.order, job)
    job.check()
    save(restored, task.outputs, task.name, task.shown)
    return summary(task.shown, restored.restoration)
