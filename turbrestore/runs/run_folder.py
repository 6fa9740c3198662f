"""The folder of a run: results of stages are kept as they are made, and a later run continues from them.

``run.json`` (:mod:`turbrestore.runs.run_files`) says what each stage depends on and holds a checksum of each file.  A
stage is taken over if nothing that it or an earlier stage depends on has changed, and its files are as they were
written.  :func:`turbrestore.runs.dependencies.stage_dependencies` lists what that is, package versions among it.

Results, ``mean.npy`` among them, are kept as the stages made them: stretched, where frames use a part of the scale.
Threads and a memory limit change no result, so nothing depends on them; but where a limit leaves fewer training frames,
or whole frames do not fit, the centroid depends on those frames and on the size of the tiles.
"""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from ..blur.estimation import BlurEstimate
from ..blur.posterior import BlurPosterior
from ..core.arrays import check_image
from ..core.errors import DataError, OutputError, require
from ..core.remarks import counted
from ..deblurring.remove_blur import Deblurred
from ..deconvolution.deconvolve import Deconvolution
from ..filtering.filter_records import FilterCheckpoint
from ..footage.levels import Levels
from ..io.npy import map_npy
from ..io.output import atomic_output
from ..io.source import FrameSource
from ..memory_plan import plan_memory
from ..results import Restoration
from ..runtime.runtime import DEFAULT, Runtime
from ..settings import RestoreParams
from .checkpoint import load_checkpoint, save_checkpoint
from .dependencies import filter_key, list_changes, stage_dependencies
from .digests import file_digest
from .run_files import MEAN, RUN_FILES, read_stages, save_results, write_record
from .run_record import RunRecord
from .stage_files import KINDS, load_stage, save_stage
from .typed_records import DeblurringRecord, KeptRecord

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

CHECKPOINT = "checkpoint.npz"
FILES = {
    "centroid": ("centroid.npz",),
    "dynamics": ("dynamics.npz",),
    "filtered": ("filtered.npz", MEAN),
    "deblurred": ("deconvolution.npz", "blur.npz", "posterior.npz"),
}
TITLES = {"centroid": "centroid", "dynamics": "flow model", "filtered": "filter", "deblurred": "deconvolution"}
# The file that tells whether a result is kept, unless it is named after the result.
_FILE_OF = {"mean": MEAN, "deblurred": FILES["deblurred"][0]}
_TILE = re.compile(r"filtered_tile_\d+")
# Left by a writer that was killed.
_PART = re.compile(r"\.[0-9a-f]{16}\.part")

Result = TypeVar("Result")
Stage = TypeVar("Stage", bound="DataclassInstance")


class RunFolder:
    """Results of one restoration in a folder, and what an earlier run of it has left there.

    It is a :class:`turbrestore.results.Store`.  The folder should be held by
    :func:`turbrestore.runs.folder_lock.lock_folder`.

    With ``resume`` it takes over what still holds, and ``notes`` say what that is, what starts again and why;
    otherwise everything starts anew.  Opening the folder removes files of other runs.  ``checkpoint_every`` is the
    number of frames between two checkpoints of the filter.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        source: FrameSource,
        params: RestoreParams,
        runtime: Runtime = DEFAULT,
        resume: bool = False,
        checkpoint_every: int = 50,
    ) -> None:
        require(checkpoint_every >= 1, f"checkpoint_every: expected at least 1 frame, found {checkpoint_every}")
        self.folder, self._checkpoint_every, self._block = Path(folder), checkpoint_every, params.filter.block
        plan = plan_memory(source.shape, params, runtime)
        self._scratch = plan.runtime.scratch
        facts = stage_dependencies(source, params, plan)
        self._key = filter_key(facts)
        self._record = KeptRecord(facts)
        self._newest: FilterCheckpoint | None = None
        self._levels = Levels()
        self._written = 0
        self.notes = tuple[str, ...]()
        record = read_stages(self.folder) if resume else None
        if record is not None:
            self._take_over(record, facts)
        self._remove_the_rest()

    def has(self, name: str) -> bool:
        """Tell whether a result of this name is kept."""
        return _FILE_OF.get(name, f"{name}.npz") in self._record.files

    def get(self, name: str, compute: Callable[[], Result]) -> Result:
        """Return a result that was kept, else compute and keep it."""
        kept = self._load(name)
        if kept is not None:
            return cast(Result, kept)
        result = compute()
        if name == "mean":
            self._save_mean(result)
        else:
            self._save(name, result)
        return result

    def set_levels(self, levels: Levels) -> None:
        """Take the levels of the stages, which their files record."""
        self._levels = levels

    def filter_start(self) -> FilterCheckpoint | None:
        """Return the checkpoint from which the filter continues."""
        return self._newest

    def checkpoint(self, state: FilterCheckpoint) -> None:
        """Take the newest checkpoint of the filter, and write it if enough frames have passed since the last."""
        self._newest = state
        if len(state.records) + self._block > self._written + self._checkpoint_every:
            self.flush()

    def flush(self) -> None:
        """Write the newest checkpoint, if it is not written yet; StorageError if that fails."""
        if self._newest is None or len(self._newest.records) <= self._written:
            return
        save_checkpoint(self.folder / CHECKPOINT, self._newest, self._key)
        self._written = len(self._newest.records)

    def announce_outputs(self, *outputs: Path) -> None:
        """Note which outputs are about to be written, so that a run that dies meanwhile may replace its own."""
        self._record.outputs = tuple(str(path.absolute()) for path in outputs)
        write_record(self.folder, self._record)

    def describe_progress(self) -> str:
        """Say how far the results on disk go."""
        stages = itertools.takewhile(self.has, FILES)
        last = [TITLES[stage] for stage in stages][-1:]
        words = f"after the {last[0]}" if last else "from the start"
        tiles = _tiles(self._record.files)
        if tiles:
            return f"{words} and {counted(len(tiles), 'tile')} of the filter"
        return f"{words} and {counted(self._written, 'frame')} of the filter" if self._written else words

    def withdraw(self) -> None:
        """Remove the record of a run that failed before it stored a result."""
        if self._record.files or self._written:
            return
        for name in (*RUN_FILES, CHECKPOINT):
            (self.folder / name).unlink(missing_ok=True)

    def complete(self, restoration: Restoration, run: RunRecord) -> None:
        """Write what :func:`turbrestore.load_run` needs beside the results of the stages."""
        save_results(self.folder, restoration, run, self._record)

    def _take_over(self, record: KeptRecord, facts: dict[str, dict[str, Any]]) -> None:
        """Find what still holds, and say where and why something starts again."""
        if not record.facts:
            self.notes = ("starts again: an earlier version of turbrestore kept these stages",)
            return
        notes: list[str] = []
        holds = []
        for stage, expected in facts.items():
            changes = list(list_changes(record.facts.get(stage, {}), expected))
            if changes:
                notes.append(f"starts again at the {TITLES[stage]}: {'; '.join(changes)}")
                break
            holds.append(stage)
        names = [name for stage in holds for name in FILES[stage]]
        if "filtered" in holds:
            names += _tiles(record.files)
        for name in names:
            wanted = record.files.get(name)
            if wanted is not None and _is_intact(self.folder / name, wanted):
                self._record.files[name] = wanted
            elif wanted is not None:
                notes.append(f"{name} is missing or damaged and is made again")
        self._record.deblurred, self._record.outputs = record.deblurred, record.outputs
        if "filtered" in holds and not self.has("filtered") and (self.folder / CHECKPOINT).exists():
            try:
                self._newest = load_checkpoint(self.folder / CHECKPOINT, self._key)
                self._written = len(self._newest.records)
            except DataError as error:
                notes.append(str(error))
        self.notes = (*notes, *([] if notes and not self._record.files else [f"continues {self.describe_progress()}"]))

    def _load(self, name: str) -> object | None:
        """Read a result whose files are as they were written."""
        if name == "deblurred":
            return self._load_deblurred()
        if name == "mean":
            return check_image(map_npy(self.folder / MEAN), MEAN) if self.has("mean") else None
        return self._load_stage(name, KINDS["filtered" if _TILE.fullmatch(name) else name], self._scratch)

    def _load_stage(self, name: str, kind: type[Stage], scratch: Path | None = None) -> Stage | None:
        return load_stage(self.folder / f"{name}.npz", kind, scratch) if self.has(name) else None

    def _load_deblurred(self) -> Deblurred | None:
        known, result = self._record.deblurred, self._load_stage("deconvolution", Deconvolution, self._scratch)
        if known is None or result is None:
            return None
        blur, posterior = self._load_stage("blur", BlurEstimate), self._load_stage("posterior", BlurPosterior)
        if (known.estimated, known.measured) != (blur is not None, posterior is not None):
            return None
        return Deblurred(result, blur, known.readings, known.decisions, posterior)

    def _save_mean(self, mean: Any) -> None:
        """Write the mean of the frames, and then the record that it is there."""
        with atomic_output(self.folder / MEAN, overwrite=True) as temporary, temporary.open("wb") as stream:
            np.save(stream, np.asarray(mean), allow_pickle=False)
        self._record.files[MEAN] = file_digest(self.folder / MEAN)
        write_record(self.folder, self._record)

    def _save(self, name: str, result: Any) -> None:
        """Write the files of a stage, and then the record that they are there."""
        results, record = {name: result}, self._record
        if name == "deblurred":
            results = {"deconvolution": result.deconvolution, "blur": result.blur, "posterior": result.posterior}
            record.deblurred = DeblurringRecord(
                result.blur is not None, result.posterior is not None, result.readings, result.decisions
            )
        for part, value in results.items():
            record.files.pop(f"{part}.npz", None)
            if value is not None:
                save_stage(self.folder / f"{part}.npz", value, self._levels)
                record.files[f"{part}.npz"] = file_digest(self.folder / f"{part}.npz")
        write_record(self.folder, record)
        if name == "filtered":
            self._remove_filter_states()

    def _remove_filter_states(self) -> None:
        """Remove checkpoint and tiles once the filter is done."""
        tiles = _tiles(self._record.files)
        for name in (CHECKPOINT, *tiles):
            self._record.files.pop(name, None)
            (self.folder / name).unlink(missing_ok=True)
        self._newest, self._written = None, 0
        if tiles:
            write_record(self.folder, self._record)

    def _remove_the_rest(self) -> None:
        """Remove what does not belong to this run, such as files of other runs."""
        kept = {*self._record.files, *([CHECKPOINT] if self._written else [])}
        try:
            there = [path.name for path in self.folder.iterdir()]
            parts = [name for name in there if is_part(self.folder / name)]
            for name in {*RUN_FILES, CHECKPOINT, *_tiles(there), *parts} - kept:
                (self.folder / name).unlink(missing_ok=True)
            # Written before any result, so that every later file belongs to this run.
            write_record(self.folder, self._record)
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written to ({error.strerror or error})") from error


def is_part(path: Path) -> bool:
    """Tell whether a file was left by a writer that was killed."""
    return _PART.fullmatch(path.name) is not None


def _tiles(names: Iterable[str]) -> list[str]:
    """Return those of the names that are files of filtered tiles."""
    return [name for name in names if name.endswith(".npz") and _TILE.fullmatch(name.removesuffix(".npz"))]


def _is_intact(path: Path, digest: str) -> bool:
    try:
        return file_digest(path) == digest
    except OSError:
        return False
