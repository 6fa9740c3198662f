"""Results of a restoration kept in a folder as they come, and taken up again by a later run.

Beside the artifacts of :mod:`turbrestore.runs.run_record` the folder holds ``stages.json``: what each stage depends
on, and
a checksum of each file.  A stage is taken over if nothing that it or a stage before it depends on has changed and its
files are those that were written:

==========  =========================================================================================================
stage       depends on
==========  =========================================================================================================
centroid    content of the input, training frames, region, settings of flow and centroid, versions of all packages
dynamics    the centroid, settings of the dynamics, the displacement cue
filtered    the dynamics, all frames selected, settings of the filter, the share of best frames
deblurred   the filtered image, settings of deconvolution and guards, the bounds of the blur
==========  =========================================================================================================

Neither the number of threads nor a memory limit changes a result, so nothing depends on them; but where a limit leaves
fewer training frames, or whole frames do not fit, the centroid depends on those frames and on the size of the tiles.

The content of the input is a checksum of all its bytes: of a folder, the names and bytes of its images.  Reading a file
takes a few thousandths of the time of measuring flow in it, and no time stamp is believed.  Only where there are
more than 4 GiB the size, the time of the last change and 64 MiB spread evenly over the file stand for all of it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ..blind.remove_blur import Deblurred
from ..blur.blur_cues import BlurBounds
from ..blur.estimation import BlurEstimate
from ..core.arrays import FloatArray, check_image
from ..core.errors import DataError, OutputError, require
from ..deconvolution.deconvolve import Deconvolution
from ..dynamics.flow_model import FlowDynamics
from ..filtering.alternating import Filtered
from ..io.npy import map_npy
from ..io.output import atomic_output, atomic_write
from ..io.source import FrameSource
from ..pipeline import memory_plan
from ..registration.centroid import Centroid
from ..runtime.scratch import drop_pages
from ..settings import RestoreParams, StageResults, place_stages
from .artifacts import load_artifact, save_artifact
from .checkpoint import load_checkpoint, load_tiles, save_checkpoint, save_tiles
from .digests import content_digest, file_digest
from .record_fields import RecordFields
from .run_record import RECORD as RUN_RECORD
from .run_record import versions

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SCHEMA = 1
# Raised where the same frames and settings begin to give another image.
_RESULTS = 7
STAGES_RECORD, CHECKPOINT, MEAN = "stages.json", "checkpoint.npz", "mean.npy"
FILES = {
    "centroid": ("centroid.npz",),
    "dynamics": ("dynamics.npz",),
    "filtered": ("filtered.npz", MEAN),
    "deblurred": ("deconvolution.npz", "blur.npz", "blur_bounds.npz"),
}
_ALL_FILES = tuple(name for names in FILES.values() for name in names)
# All files that are kept beside those of a complete run.
STAGE_FILES = (STAGES_RECORD, CHECKPOINT, MEAN)
# Left by a writer that was killed.
_PART = re.compile(r"\.[0-9a-f]{16}\.part")
_ANEW = "start anew with --overwrite, or keep the stages in another folder"
TITLES = {"centroid": "centroid", "dynamics": "flow model", "filtered": "filter", "deblurred": "deconvolution"}

Loaded = TypeVar("Loaded", bound="DataclassInstance")


class KeptStages:
    """Results of one restoration in a folder, and what an earlier run of it has left there.

    The folder should be held by :func:`turbrestore.runs.folder_lock.lock_folder`.

    Parameters
    ----------
    folder : path
        An existing folder.
    source : FrameSource
        Frames to restore.
    params : RestoreParams
        Settings.
    resume : bool
        Take over what still holds; otherwise everything starts anew.
    every : int
        Frames between two checkpoints of the filter.

    Attributes
    ----------
    folder : Path
    done : StageResults
        For :func:`turbrestore.restore`.
    notes : tuple of str
        What was taken over, and what starts again and why.

    Raises
    ------
    ConfigurationError
        ``every`` is below 1.
    OutputError
        The folder cannot be written to.

    Examples
    --------
    >>> import tempfile
    >>> from turbrestore.pipeline import restore
    >>> frames = FrameSource.from_array(np.random.default_rng(0).uniform(size=(4, 32, 32)))
    >>> params = RestoreParams(until="centroid")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     first = KeptStages(folder, frames, params)
    ...     _ = restore(frames, params, done=first.done, on_result=first.keep)
    ...     KeptStages(folder, frames, RestoreParams(), resume=True).notes
    ('goes on after the centroid',)
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        source: FrameSource,
        params: RestoreParams,
        resume: bool = False,
        every: int = 50,
    ) -> None:
        require(every >= 1, f"checkpoint_every: expected at least 1 frame, found {every}")
        self.folder, self._every, self._block = Path(folder), every, params.filter.block
        self._facts = stage_facts(source, params)
        plan = memory_plan(source, params)
        self._scratch, self._in_tiles = self.folder if plan.in_file else None, plan.tile is not None
        self._key = _key(self._facts)
        self._files: dict[str, str] = {}
        self._verdict: dict[str, Any] = {}
        self._outputs: tuple[str, ...] = ()
        self._written = 0
        self.done, self.notes = StageResults(), tuple[str, ...]()
        record = read_stages(self.folder) if resume else None
        if record is not None:
            self._take_over(record)
        self._drop_the_rest()

    @property
    def stored(self) -> frozenset[str]:
        """Names of the results whose artifacts are on disk."""
        return frozenset(name.removesuffix(".npz") for name in self._files if name.endswith(".npz"))

    def keep(self, done: StageResults) -> None:
        """Write what is new; the callback ``on_result`` of :func:`turbrestore.restore`.

        Parameters
        ----------
        done : StageResults

        Raises
        ------
        OutputError, StorageError
            It cannot be written.
        """
        before, self.done = self.done, done
        fresh = [stage for stage in FILES if getattr(done, stage) is not getattr(before, stage)]
        for stage in fresh:
            for name in FILES[stage]:
                self._files.pop(name, None)
            self._files |= {path.name: file_digest(path) for path in self._save(stage)}
        if fresh:
            self._write_record()
        if done.filtered is not None:
            (self.folder / CHECKPOINT).unlink(missing_ok=True)
            self._written = 0
        elif self._in_tiles:
            # Every tile is written again with each, so the further it is, the rarer.
            if _steps(done) >= self._written + max(1, self._written // 8):
                self.flush()
        elif _steps(done) + self._block > self._written + self._every:
            self.flush()

    def flush(self) -> None:
        """Write the newest checkpoint, if there is one that is not written yet.

        Raises
        ------
        OutputError, StorageError
            It cannot be written.
        """
        checkpoint, tiles = self.done.checkpoint, self.done.tiles
        if _steps(self.done) <= self._written:
            return
        if checkpoint is not None:
            save_checkpoint(self.folder / CHECKPOINT, checkpoint, self._key)
        elif tiles is not None:
            save_tiles(self.folder / CHECKPOINT, tiles, self._key)
        self._written = _steps(self.done)

    def expect(self, *outputs: Path) -> None:
        """Note which files are about to be written, so that a run that dies meanwhile may replace its own ones.

        Parameters
        ----------
        *outputs : Path
            None once they are complete.
        """
        self._outputs = tuple(str(path.absolute()) for path in outputs)
        self._write_record()

    def progress(self) -> str:
        """Say how far the results on disk go.

        Returns
        -------
        str
        """
        stages = itertools.takewhile(self._holds, FILES)
        last = [TITLES[stage] for stage in stages][-1:]
        words = f"after the {last[0]}" if last else "from the start"
        steps = "tiles" if self._in_tiles else "frames"
        return f"{words} and {self._written} {steps} of the filter" if self._written else words

    def withdraw(self) -> None:
        """Leave no record of a run that has failed before it had anything to keep."""
        if self._files or self._written:
            return
        for name in (*_ALL_FILES, CHECKPOINT, STAGES_RECORD):
            (self.folder / name).unlink(missing_ok=True)

    def _holds(self, stage: str) -> bool:
        """Whether a result is there and on disk."""
        return getattr(self.done, stage) is not None and FILES[stage][0] in self._files

    def _take_over(self, record: dict[str, Any]) -> None:
        """Load what still holds, and say where and why something starts again."""
        notes: list[str] = []
        holds = []
        for stage, expected in self._facts.items():
            changes = list(_changes(record["facts"].get(stage, {}), expected))
            if changes:
                notes.append(f"starts again at the {TITLES[stage]}: {'; '.join(changes)}")
                break
            holds.append(stage)
        for name in (name for stage in holds for name in FILES[stage]):
            wanted = record["files"].get(name)
            if wanted is not None and _is_whole(self.folder / name, wanted):
                self._files[name] = wanted
            elif wanted is not None:
                notes.append(f"{name} is missing or damaged and is made again")
        self._verdict = record["deblurred"]
        self.done = self._load()
        if "filtered" in holds and self.done.filtered is None and (self.folder / CHECKPOINT).exists():
            try:
                if self._in_tiles:
                    tiles = load_tiles(self.folder / CHECKPOINT, self._key, self._scratch)
                    self.done = replace(self.done, tiles=tiles)
                else:
                    self.done = replace(self.done, checkpoint=load_checkpoint(self.folder / CHECKPOINT, self._key))
            except DataError as error:
                notes.append(str(error))
        self._written = _steps(self.done)
        self.notes = (*notes, *([] if notes and not self._files else [f"goes on {self.progress()}"]))

    def _load(self) -> StageResults:
        """Read the results whose files are as they were written."""

        def load(name: str, kind: type[Loaded]) -> Loaded | None:
            path = self.folder / f"{name}.npz"
            return load_artifact(path, kind, self._scratch) if path.name in self._files else None

        filtered, deconvolution = load("filtered", Filtered), load("deconvolution", Deconvolution)
        mean = _load_mean(self.folder / MEAN) if MEAN in self._files else None
        complete = filtered is not None and mean is not None
        return StageResults(
            centroid=load("centroid", Centroid),
            dynamics=load("dynamics", FlowDynamics),
            filtered=filtered if complete else None,
            mean=mean if complete else None,
            blur_bounds=load("blur_bounds", BlurBounds),
            deblurred=None
            if deconvolution is None
            else _deblurred(deconvolution, load("blur", BlurEstimate), self._verdict),
        )

    def _drop_the_rest(self) -> None:
        """Remove what does not belong to this run: nobody must take it for a part of it."""
        kept = {*self._files, *([CHECKPOINT] if _steps(self.done) else [])}
        try:
            for name in {RUN_RECORD, *_ALL_FILES, CHECKPOINT} - kept:
                (self.folder / name).unlink(missing_ok=True)
            for path in [path for path in self.folder.iterdir() if is_part(path)]:
                path.unlink(missing_ok=True)
            # It comes first, so that whatever is found in the folder later is known to be of this run.
            self._write_record()
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be written to ({error.strerror or error})") from error

    def _save(self, stage: str) -> list[Path]:
        """Write the files of a stage."""
        results: dict[str, DataclassInstance | None] = {stage: getattr(self.done, stage)}
        paths: list[Path] = []
        if stage == "filtered":
            paths.append(self.folder / MEAN)
            with atomic_output(paths[0], overwrite=True) as temporary, temporary.open("wb") as stream:
                np.save(stream, np.asarray(self.done.mean), allow_pickle=False)
            drop_pages(self.done.mean)
        deblurred = self.done.deblurred
        if stage == "deblurred" and deblurred is not None:
            results = {"deconvolution": deblurred.deconvolution, "blur": deblurred.blur}
            results["blur_bounds"] = self.done.blur_bounds
            self._verdict = _verdict(deblurred)
        for name, result in results.items():
            if result is not None:
                paths.append(self.folder / f"{name}.npz")
                save_artifact(paths[-1], result, overwrite=True)
        return paths

    def _write_record(self) -> None:
        record = {
            "schema": SCHEMA,
            "facts": self._facts,
            "files": self._files,
            "deblurred": self._verdict,
            "outputs": self._outputs,
        }
        atomic_write(
            self.folder / STAGES_RECORD, (json.dumps(record, indent=1, sort_keys=True) + "\n").encode(), overwrite=True
        )


def stage_facts(source: FrameSource, params: RestoreParams) -> dict[str, dict[str, Any]]:
    """List what each stage depends on beside the stage before it; reads the input once.

    Parameters
    ----------
    source : FrameSource
    params : RestoreParams

    Returns
    -------
    dict of str to dict
        As JSON holds it.

    Examples
    --------
    >>> facts = stage_facts(FrameSource.from_array(np.zeros((5, 16, 16))), RestoreParams())
    >>> list(facts), facts["filtered"]["frames"]
    (['centroid', 'dynamics', 'filtered', 'deblurred'], [0, 5, 1])
    """
    settings = dataclasses.asdict(place_stages(params))
    # The number of threads changes nothing but the time; a memory limit, training frames and tiles at most.
    flow = {name: value for name, value in settings["flow"].items() if name != "threads"}
    del settings["deconvolution"]["memory"]
    plan = memory_plan(source, params)
    training = source.numbers[: plan.train]
    rows, columns = source.window
    facts = {
        "centroid": {
            "input": content_digest(source),
            "training_frames": _span(training),
            # What is repaired is found by looking at all frames.
            "repaired": None if source.repair is None else [_span(source.numbers), *source.warnings],
            **({} if plan.tile is None else {"tile": plan.tile}),
            "region": [columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start],
            "flow": flow,
            "centroid": settings["centroid"],
            "versions": versions(),
            "results": _RESULTS,
        },
        "dynamics": {name: settings[name] for name in ("dynamics", "displacement_cue")},
        "filtered": {"frames": _span(source.numbers), **{name: settings[name] for name in ("keep_best", "filter")}},
        "deblurred": {name: settings[name] for name in ("deconvolution", "guards", "blur_bounds")},
    }
    return json.loads(json.dumps(facts))


def read_stages(folder: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Record of the stages that are kept in a folder.

    Parameters
    ----------
    folder : path

    Returns
    -------
    dict or None
        None where there is no such record.

    Raises
    ------
    DataError
        It is damaged or of another version of the layout.

    Examples
    --------
    >>> read_stages("nowhere") is None
    True
    """
    path = Path(folder) / STAGES_RECORD
    if path.exists() and not path.is_file():
        raise DataError(f"{path}: expected the record of stages, found no file; {_ANEW}")
    try:
        record = json.loads(path.read_text("utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: expected the record of stages, found something else or damage; {_ANEW}") from error
    found = record.get("schema") if isinstance(record, dict) else "none"
    if type(found) is not int or found != SCHEMA:
        raise DataError(f"{path}: expected the record of stages, layout {SCHEMA}, found {found!r:.40}; {_ANEW}")
    try:
        _check_stages(RecordFields(path, record))
    except DataError as error:
        raise DataError(f"{error}; {_ANEW}") from error
    return record


def _check_stages(fields: RecordFields) -> None:
    """Refuse a record of stages whose values are of other types than those that are written."""
    facts = fields.part("facts")
    for stage in facts.record:
        facts.part(stage)
    fields.named_texts("files")
    fields.texts("outputs")
    verdict = fields.part("deblurred")
    if verdict.record:
        verdict.flag("estimated")
        verdict.guard_readings("readings")
        verdict.decisions("decisions")


def is_part(path: Path) -> bool:
    """Tell whether a file is what a writer leaves that is killed.

    Parameters
    ----------
    path : Path

    Returns
    -------
    bool

    Examples
    --------
    >>> is_part(Path(".0123456789abcdef.part")), is_part(Path("letter.part"))
    (True, False)
    """
    return _PART.fullmatch(path.name) is not None


def _is_whole(path: Path, digest: str) -> bool:
    try:
        return file_digest(path) == digest
    except OSError:
        return False


def _key(facts: dict[str, dict[str, Any]]) -> str:
    """Of all that the filter depends on."""
    parts = [facts[stage] for stage in ("centroid", "dynamics", "filtered")]
    return hashlib.blake2b(json.dumps(parts, sort_keys=True).encode(), digest_size=16).hexdigest()


def _span(numbers: Sequence[int]) -> list[int]:
    return [numbers.start, numbers.stop, numbers.step] if isinstance(numbers, range) else list(numbers)


def _changes(before: Any, now: Any, name: str = "") -> Iterator[str]:
    """Say what differs, one line for each value."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in {**before, **now}:
            yield from _changes(before.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif name == "input" and before != now:
        yield "the content of the input has changed"
    elif before != now:
        yield f"{name} was {before} and is {now}"


def _steps(done: StageResults) -> int:
    """Frames that the filter has passed over, or tiles."""
    if done.tiles is not None:
        return len(done.tiles.parts)
    return 0 if done.checkpoint is None else len(done.checkpoint.records)


def _load_mean(path: Path) -> FloatArray:
    try:
        return check_image(map_npy(path), str(path))
    except DataError as error:
        raise DataError(f"{path}: expected an image in a .npy file, found something else") from error


def _verdict(deblurred: Deblurred) -> dict[str, Any]:
    """List what of a deblurred image is no artifact."""
    return {
        "estimated": deblurred.blur is not None,
        "readings": [dataclasses.asdict(item) for item in deblurred.readings],
        "decisions": [dataclasses.asdict(item) for item in deblurred.decisions],
    }


def _deblurred(deconvolution: Deconvolution, blur: BlurEstimate | None, verdict: dict[str, Any]) -> Deblurred | None:
    """Put a deblurred image together again, unless a part of it is lost."""
    fields = RecordFields(Path(STAGES_RECORD), verdict)
    if (blur is not None) is not verdict.get("estimated"):
        return None
    return Deblurred(deconvolution, blur, None, fields.guard_readings("readings"), fields.decisions("decisions"))
