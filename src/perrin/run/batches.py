"""The clusters of a table in batches, which one or several processes work through."""

from __future__ import annotations

import pickle
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from perrin.run.workers import dask_client, one_thread, work_through

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from perrin.run.workers import Work

S = TypeVar("S")
T = TypeVar("T")

# Clusters of a batch have so many poses together, which take a second or two: a process starts in
# longer. More clusters gain no time, and fewer are not efficient. Results may depend on it in the
# last digits, and so it does not depend on the number of processes.
_POSES_TOGETHER, _FEWEST_MEASURED, _MOST_MEASURED = 80_000, 16, 256


class InOrder(Protocol):
    """A way to do the same with every batch."""

    def __call__(self, task: Callable[[list[S]], T], batches: Iterable[list[S]]) -> Iterator[T]:
        """Yield the result of each batch, in the order of the batches."""


@dataclass(frozen=True)
class _PickledTask:
    """A task on numbered batches that are pickled, and whose results are.

    Dask sends every array of a batch, tens of thousands of small ones, by itself: that takes as
    long as the work.
    """

    task: Callable[[list[Any]], Any]

    def __call__(self, item: tuple[int, bytes]) -> tuple[int, bytes]:
        number, batch = item
        return number, pickle.dumps(self.task(pickle.loads(batch)))


def clusters_together(count: int, poses: int) -> int:
    """Return how many of `count` clusters, which have this many poses together, are a batch.

    The batches are of about the same size, so that processes end together.

    Examples
    --------
    >>> [clusters_together(500, 500 * frames) for frames in (100, 400, 10_000)]
    [250, 167, 16]
    """
    count = max(count, 1)
    most = min(max(count * _POSES_TOGETHER // max(poses, 1), _FEWEST_MEASURED), _MOST_MEASURED)
    parts = -(-count // most)
    return -(-count // parts)


def batches_of(items: Iterable[S], *, size: int) -> Iterator[list[S]]:
    """Yield the items in lists of one size, the last one perhaps shorter.

    Parameters
    ----------
    items : iterable
    size : int

    Yields
    ------
    list

    Examples
    --------
    >>> list(batches_of(range(5), size=2))
    [[0, 1], [2, 3], [4]]
    """
    rest = iter(items)
    while batch := list(islice(rest, size)):
        yield batch


@contextmanager
def shared_work(work: Work | None) -> Iterator[InOrder]:
    """Give a way to work through batches: in this process, or in those that `work` states.

    Each batch is computed on one thread (in this process only if threadpoolctl is installed), so
    that its result is the same to the last bit in every process.

    Parameters
    ----------
    work : Work, optional

    Yields
    ------
    callable
        ``in_order(task, batches)`` yields the results in the order of the batches. For other
        processes task, items and results can be pickled.

    Raises
    ------
    ModuleNotFoundError, OSError
        As in `work_through`.

    Examples
    --------
    >>> with shared_work(None) as in_order:
    ...     list(in_order(sum, [[1, 2], [3]]))
    [3, 3]
    """
    if work is None or not (work.workers or work.scheduler):
        limited = find_spec("threadpoolctl") is not None

        def alone(task: Callable[[list[S]], T], batches: Iterable[list[S]]) -> Iterator[T]:
            for batch in batches:
                yield one_thread(task, batch) if limited else task(batch)

        yield alone
        return
    with dask_client(work.workers, work.scheduler) as client:

        def shared(task: Callable[[list[S]], T], batches: Iterable[list[S]]) -> Iterator[T]:
            done: dict[int, bytes] = {}
            numbered = ((k, pickle.dumps(batch)) for k, batch in enumerate(batches))
            expected = 0
            found = work_through(_PickledTask(task), numbered, client=client, at_once=1)
            for number, result in found:
                done[number] = result
                while expected in done:
                    yield pickle.loads(done.pop(expected))
                    expected += 1

        yield shared
