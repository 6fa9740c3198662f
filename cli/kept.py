"""The folder of ``--keep`` while a run is at work in it: lock, checkpoints, and what becomes of an interruption."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from turbrestore.io.output import check_space
from turbrestore.io.source import FrameSource
from turbrestore.memory_plan import plan_memory
from turbrestore.runs.folder_lock import lock_folder
from turbrestore.runs.run_files import RECORD, read_stages
from turbrestore.runs.run_folder import RunFolder
from turbrestore.runtime.runtime import Runtime
from turbrestore.settings import RestoreParams

from .progress import say

# Images that a kept run holds, some of them twice while they are replaced, at most four bytes a channel.
_IMAGES = 24
# The flow model has at most one mode for so many training frames.
_FRAMES_A_MODE = 2


@contextmanager
def kept_stages(
    folder: Path | None,
    source: FrameSource,
    params: RestoreParams,
    runtime: Runtime,
    resume: bool,
    checkpoint_every: int,
    quiet: bool,
) -> Iterator[RunFolder | None]:
    """Hold the folder, take over what an earlier run has left, and keep the newest state if this one is interrupted."""
    if folder is None:
        yield None
        return
    with lock_folder(folder) as locks:
        if not locks:
            say(
                f"{folder}: this file system does not support locks; make sure that no other run uses the folder", quiet
            )
        stages = RunFolder(folder, source, params, runtime, resume, checkpoint_every)
        for note in stages.notes:
            say(f"{folder}: {note}", quiet)
        try:
            yield stages
        except KeyboardInterrupt as stop:
            try:
                stages.flush()
                stages.withdraw()
            finally:
                stop.args = (
                    f"{str(stop) or 'interrupted'}; --keep {folder} --resume continues {stages.describe_progress()}",
                )
            raise
        except Exception:
            stages.withdraw()
            raise


def own_outputs(folder: Path) -> set[Path]:
    """List the outputs that an earlier run was writing when it died; it may replace them."""
    # A link is refused later on.
    record = None if (folder / RECORD).is_symlink() else read_stages(folder)
    return set() if record is None else {Path(name) for name in record.outputs}


def check_room(source: FrameSource, params: RestoreParams, runtime: Runtime, output: Path, folder: Path | None) -> None:
    """Raise an error if the disk has too little space for the run."""
    height, width = source.shape[1:3]
    image = 4 * height * width * (3 if len(source.shape) == 4 else 1)
    check_space(output, image)
    if folder is not None:
        flow = 8 * height * width
        plan = plan_memory(source.shape, params, runtime)
        size = flow * (plan.train + plan.train // _FRAMES_A_MODE) + _IMAGES * image
        check_space(folder, size + plan.scratch_bytes)
