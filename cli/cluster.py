"""Processes of Dask, of a running scheduler or of this machine, to which clips or tiles of frames are sent."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from turbrestore.core.errors import ConfigurationError, TurbrestoreError, require
from turbrestore.core.extras import missing_package
from turbrestore.io.limits import first_line
from turbrestore.restoration_run import TileMap

from .progress import say

if TYPE_CHECKING:
    from distributed import Client, Future

# Seconds to wait for a scheduler.
_PATIENCE = 10
# Processes that a piece of work may lose; one that has died may have been the victim of another one.
_LOST_PROCESSES = 3
# Dask would look a hundred times a second at what each process is doing, and have its memory trimmed so eagerly that
# arrays are mapped anew all the time: an eighth of the processor time of small clips, a third of that of big ones.
_SETTINGS = {
    "distributed.scheduler.allowed-failures": _LOST_PROCESSES,
    "distributed.worker.profile.enabled": False,
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
}


def check_cluster(command: str, scheduler: str | None, workers: int | None) -> bool:
    """Refuse options that make no sense or lack a package; return whether there can be other processes."""
    there = find_spec("distributed") is not None
    if not there and (scheduler is not None or workers is not None):
        raise missing_package(command, "distributed", "distributed")
    require(workers is None or workers >= 1, f"--workers: expected at least 1, found {workers}")
    require(workers is None or scheduler is None, "--workers: has no effect with --scheduler; leave it out")
    return there


@contextmanager
def connected(scheduler: str | None, count: int, quiet: bool) -> Iterator[Client]:
    """Connect to a scheduler, or start one and its processes; they are reached from this machine alone."""
    import dask
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_PATIENCE)
        except (OSError, ValueError) as error:
            raise ConfigurationError(
                f"--scheduler: expected a running scheduler, found none at {scheduler} ({first_line(error)})"
            ) from error
        with client:
            _tell_dashboard(client.dashboard_link, quiet)
            yield client
        return
    with (
        TemporaryDirectory(prefix="turbrestore-", ignore_cleanup_errors=True) as scratch,
        dask.config.set(_SETTINGS),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            memory_limit=0,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            local_directory=scratch,
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        _tell_dashboard(cluster.dashboard_link, quiet)
        yield client


def over_workers(client: Client) -> TileMap:
    """Make a ``map`` whose calls run in the processes of a client.

    Two tasks for each process are under way, and one whose process or arrays are lost is sent again.
    """

    def map_tiles(function: Callable[[Any], Any], tasks: Iterable[Any]) -> Iterator[Any]:
        sent: deque[tuple[Any, Future[Any]]] = deque()
        for task in tasks:
            sent.append((task, _send(client, function, task)))
            if len(sent) >= 2 * max(1, len(client.scheduler_info()["workers"])):
                yield _result(client, function, *sent.popleft())
        while sent:
            yield _result(client, function, *sent.popleft())

    return map_tiles


def _send(client: Client, function: Callable[[Any], Any], task: Any) -> Future[Any]:
    # Arrays within a call would stay in the graph of the scheduler; scattered ones go to a process at once.
    return client.submit(function, client.scatter(task, hash=False), pure=False)


def _result(client: Client, function: Callable[[Any], Any], task: Any, future: Future[Any]) -> Any:
    from distributed import CancelledError, KilledWorker

    for _ in range(_LOST_PROCESSES):
        try:
            return future.result()
        except (CancelledError, KilledWorker):
            future = _send(client, function, task)
    try:
        return future.result()
    except (CancelledError, KilledWorker) as error:
        raise TurbrestoreError(
            "a tile: its process was killed again and again, perhaps for want of memory; "
            "fewer --workers or a smaller --tile take less"
        ) from error


def _tell_dashboard(link: str | None, quiet: bool) -> None:
    if link and find_spec("bokeh") is not None:
        say(f"dashboard: {link}", quiet)
