"""Independent tasks: in this process, on several cores, or on a Dask cluster."""

from __future__ import annotations

import os
import sys
import warnings
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from perrin._arrays import flag_fault, number_fault, numpy_to_python, refuse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from typing import TypeAlias

    from threadpoolctl import ThreadpoolController

    Progress: TypeAlias = Callable[[int, int, str], None]


S = TypeVar("S")
T = TypeVar("T")
_ITEMS_AT_ONCE = 4  # items that a worker gets at once
_TIMEOUT = 15  # s, to find the scheduler
_KEPT_MEMORY = 2**28  # bytes that the memory allocator of a worker does not return to the system


@dataclass(frozen=True, kw_only=True)
class Work:
    """Where the work of a movie or of a table is done, and where the results of a movie are kept.

    Parameters
    ----------
    keep : path, optional
        Folder of finished frames: the same call resumes there. None uses a temporary folder.
    anew : bool
        Remove the parts of another input or of other settings in the folder, instead of an error.
    workers : int
        Number of processes of this machine; 0 does the work in this one. A script calls with
        workers below the line ``if __name__ == "__main__":``, since each process imports it.
    scheduler : str, optional
        Address of a Dask scheduler whose workers do the work; they must be able to read the file.
    progress : callable, optional
        Called with (done, total, title) while the work is done.

    Raises
    ------
    ValueError
        If a value is out of its range; all faults in one message.

    Examples
    --------
    >>> Work(workers=8).workers
    8
    >>> Work(scheduler="node7")
    Traceback (most recent call last):
        ...
    ValueError: scheduler: expected an address like tcp://node7:8786, got 'node7'
    """

    keep: str | os.PathLike[str] | None = None
    anew: bool = False
    workers: int = 0
    scheduler: str | None = None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        import re

        faults = number_fault("workers", self.workers, least=0, whole=True)
        if not faults and self.workers and self.scheduler is not None:
            faults.append(
                "workers: expected processes of this machine, 0 or more, or a scheduler instead, "
                f"got {self.workers} and {self.scheduler!r}"
            )
        is_address = isinstance(self.scheduler, str) and re.fullmatch(
            r"\w+://\S+:\d+", self.scheduler
        )
        if self.scheduler is not None and not is_address:
            faults.append(
                f"scheduler: expected an address like tcp://node7:8786, got {self.scheduler!r}"
            )
        faults += flag_fault("anew", self.anew)
        if self.keep is not None and not isinstance(self.keep, str | os.PathLike):
            faults.append(f"keep: expected the path of a folder, got {self.keep!r}")
        if self.progress is not None and not callable(self.progress):
            faults.append(f"progress: expected a function, got {self.progress!r}")
        refuse(faults)
        numpy_to_python(self)

    def report(self, done: int, total: int, title: str) -> None:
        """Report the progress of the work.

        Parameters
        ----------
        done, total : int
            Number of finished items, and of all items; 0 of 0 if it is not known.
        title : str
            Name of the work.
        """
        if self.progress is not None:
            self.progress(done, total, title)


def work_through(
    task: Callable[[S], T],
    items: Iterable[S],
    *,
    workers: int = 0,
    scheduler: str | None = None,
    client: Any = None,  # noqa: ANN401 (a client of the optional package distributed)
    at_once: int = _ITEMS_AT_ONCE,
) -> Iterator[T]:
    """Yield the result of a task for every item, in the order in which they are finished.

    Parameters
    ----------
    task : callable
        ``task(item)``; task, items and results can be pickled for other processes.
    items : iterable
    workers : int
        Number of processes of this machine; 0 does the work in this one.
    scheduler : str, optional
        Address of a running Dask scheduler, such as ``tcp://node7:8786``, whose workers do the
        work.
    client : distributed.Client, optional
        An open client of `dask_client`, instead of workers or a scheduler.
    at_once : int
        Number of items that a worker gets at once.

    Raises
    ------
    ModuleNotFoundError
        If dask.distributed is needed and not installed.
    OSError
        If the scheduler does not answer, or a task kills its workers repeatedly.

    Notes
    -----
    Numerical libraries use one thread for each item everywhere, so that sums are taken in the same
    order and results do not depend on the number of workers. Dask repeats the work of a lost worker
    on another one.

    Examples
    --------
    >>> list(work_through(float, [1, 2]))
    [1.0, 2.0]
    """
    if not workers and scheduler is None and client is None:
        for item in items:
            yield one_thread(task, item)
        return
    from concurrent.futures import CancelledError

    opened = dask_client(workers, scheduler) if client is None else nullcontext(client)
    with opened as client:
        from distributed import KilledWorker, as_completed

        rest, futures = iter(items), []
        with warnings.catch_warnings():
            # The items are the data: they have to be sent, and again where a worker is lost.
            warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
            # Workers begin with the first items while the others are made.
            while chunk := list(islice(rest, at_once)):
                futures.append(client.submit(_several_items, task, chunk, pure=False, retries=0))
        try:
            for future in as_completed(futures, loop=client.loop):
                yield from future.result()
                future.release()
        except KilledWorker as fault:
            raise OSError(
                "workers were killed repeatedly by the same piece of work (out of memory, or out "
                f"of time?): {fault}"
            ) from fault
        except CancelledError as fault:
            raise ConnectionError(
                "the Dask scheduler has stopped; finished frames are kept"
            ) from fault


def check_workers(work: Work) -> None:
    """Check, before any work is done, that dask is installed and the scheduler answers.

    Parameters
    ----------
    work : Work

    Raises
    ------
    ModuleNotFoundError, OSError
        As in `work_through`.

    Examples
    --------
    >>> check_workers(Work())
    """
    if work.scheduler is not None:
        with dask_client(0, work.scheduler):
            pass
    elif work.workers:
        _dask()


def _dask() -> tuple[Any, Any, Any]:
    """Return dask, and distributed's Client and LocalCluster."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "other workers need dask.distributed, which is not installed: "
            "pip install 'perrin[cluster]'"
        ) from missing
    return dask, Client, LocalCluster


def one_thread(task: Callable[[S], T], item: S) -> T:
    """Return ``task(item)``, numerical libraries on one thread.

    Raises
    ------
    ModuleNotFoundError
        If threadpoolctl is not installed.

    Examples
    --------
    >>> one_thread(float, 1)
    1.0
    """
    with _thread_pools(len(sys.modules)).limit(limits=1):
        return task(item)


@lru_cache(maxsize=1)
def _thread_pools(_modules: int) -> ThreadpoolController:
    """Return the controller of the threads of all loaded libraries.

    The search for them takes milliseconds; it is repeated only after an import, which may load
    another one.
    """
    try:
        from threadpoolctl import ThreadpoolController
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "threadpoolctl is not installed: pip install 'perrin[images]'"
        ) from missing
    return ThreadpoolController()


def _several_items(task: Callable[[S], T], items: list[S]) -> list[T]:
    return [one_thread(task, item) for item in items]


@contextmanager
def dask_client(workers: int, scheduler: str | None) -> Iterator[Any]:
    """Give a client of the cluster at an address, or of processes started on this machine.

    Parameters
    ----------
    workers, scheduler
        As in `work_through`.

    Yields
    ------
    distributed.Client

    Raises
    ------
    ModuleNotFoundError, OSError
        As in `work_through`.
    RuntimeError
        If the processes do not start: every one imports the script that starts them, whose work
        must therefore be below the line ``if __name__ == "__main__":``.
    """
    from multiprocessing import current_process

    if getattr(current_process(), "_inheriting", False):
        # A worker imports the script that starts it, and begins its work again: the worker stops,
        # and the process that started it reports why.
        raise SystemExit(1)
    dask, Client, LocalCluster = _dask()
    if scheduler is not None:
        with Client(scheduler, timeout=_TIMEOUT, set_as_default=False) as client:
            yield client
        return
    # Returning the memory of every array, Dask's default, takes a third of the time.
    environ = {
        **dask.config.get("distributed.nanny.pre-spawn-environ", {}),
        "MALLOC_TRIM_THRESHOLD_": _KEPT_MEMORY,
        "MALLOC_MMAP_THRESHOLD_": _KEPT_MEMORY,
    }
    # The profiler and the clock of Dask's dashboard, which nobody looks at here, take a tenth of a
    # core on each side.
    quiet = {
        "distributed.nanny.pre-spawn-environ": environ,
        "distributed.worker.profile.enabled": False,
        "distributed.admin.tick.interval": "1s",
    }
    with dask.config.set(quiet):
        try:
            cluster = LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                silence_logs=50,
            )
        except RuntimeError:
            path = Path(getattr(sys.modules["__main__"], "__file__", None) or os.devnull)
            script = path.read_text(errors="replace") if path.suffix == ".py" else ""
            if not script or "__main__" in script:
                raise
            raise RuntimeError(
                f"workers={workers} starts processes that import {path.name}, and each began its "
                "work anew; move the work into a function, and end the script with\n"
                'if __name__ == "__main__":\n    main()'
            ) from None
    with cluster, Client(cluster, set_as_default=False, direct_to_workers=True) as client:
        yield client
