"""Where independent pieces of work are done: here, on several cores, or on a Dask cluster."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence


S = TypeVar("S")


T = TypeVar("T")


_CHUNK = 4  # items a worker takes at once: a file is opened once for all of them


_TIMEOUT = 15  # s, to find the scheduler


_KEPT = 2**28  # bytes that a worker's memory allocator does not give back


def work_through(
    task: Callable[[S], T],
    items: Sequence[S],
    *,
    workers: int = 0,
    scheduler: str | None = None,
) -> Iterator[T]:
    """Yield what the task makes of every item, in the order in which they are done.

    Parameters
    ----------
    task : callable
        ``task(item)``; all three can be pickled where they go to other processes.
    items : sequence
    workers : int
        Processes of this machine; 0 does the work in this one.
    scheduler : str, optional
        Address of a running Dask scheduler, as in ``tcp://node7:8786``; its workers do the work.

    Raises
    ------
    ModuleNotFoundError
        If dask.distributed is needed and not installed.
    OSError
        If the scheduler does not answer, or workers die over a task again and again.

    Notes
    -----
    Numerical libraries use one thread for each item wherever it is done, so that sums are taken in
    the same order and results do not depend on the place. Work that a lost worker had is repeated
    by another one (Dask's own doing).

    Examples
    --------
    >>> list(work_through(float, [1, 2]))
    [1.0, 2.0]
    """
    if not workers and scheduler is None:
        for item in items:
            yield _one_thread(task, item)
        return
    with _client(workers, scheduler) as client:
        yield from _spread_out(client, task, items)


def check_workers(workers: int, scheduler: str | None) -> None:
    """Find out, before any work is done, whether dask is there and the scheduler answers.

    Raises
    ------
    ValueError
        For an address that is none.
    ModuleNotFoundError, OSError
        As in `work_through`.
    """
    import re

    if scheduler is not None:
        if not re.fullmatch(r"\w+://\S+:\d+", scheduler):
            raise ValueError(
                f"scheduler: expected an address like tcp://node7:8786, got {scheduler!r}"
            )
        with _client(0, scheduler):
            pass
    elif workers:
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


def _one_thread(task: Callable[[S], T], item: S) -> T:
    try:
        from threadpoolctl import threadpool_limits
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "threadpoolctl is not installed: pip install 'perrin[images]'"
        ) from missing
    with threadpool_limits(1):
        return task(item)


def _chunk_done(task: Callable[[S], T], chunk: list[S]) -> list[T]:
    return [_one_thread(task, item) for item in chunk]


def _spread_out(
    client: Any,  # noqa: ANN401 (a library that is not always there)
    task: Callable[[S], T],
    items: Sequence[S],
) -> Iterator[T]:
    from concurrent.futures import CancelledError

    from distributed import KilledWorker, as_completed

    chunks = [list(items[k : k + _CHUNK]) for k in range(0, len(items), _CHUNK)]
    futures = client.map(_chunk_done, [task] * len(chunks), chunks, pure=False, retries=0)
    try:
        for future in as_completed(futures, loop=client.loop):
            yield from future.result()
            future.release()
    except KilledWorker as fault:
        raise OSError(
            "workers die again and again over the same piece of work (out of memory, or out of "
            f"time?): {fault}"
        ) from fault
    except CancelledError as fault:
        raise ConnectionError("the Dask scheduler is gone; what was done is kept") from fault


@contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Any]:
    """Give a client of the cluster at that address, or of processes started here."""
    dask, Client, LocalCluster = _dask()
    if scheduler is not None:
        with Client(scheduler, timeout=_TIMEOUT, set_as_default=False) as client:
            yield client
        return
    with dask.config.set({"distributed.nanny.pre-spawn-environ": _memory()}):
        cluster = LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address=None, silence_logs=50
        )
    with cluster, Client(cluster, set_as_default=False) as client:
        yield client


def _memory() -> dict[str, int]:
    """Let workers keep their memory: Dask's default gives every array back, a third of the time."""
    import dask

    default = dask.config.get("distributed.nanny.pre-spawn-environ", {})
    return {**default, "MALLOC_TRIM_THRESHOLD_": _KEPT, "MALLOC_MMAP_THRESHOLD_": _KEPT}
