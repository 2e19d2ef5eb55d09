"""Progress of long work: a bar on a terminal, lines in a log."""

from __future__ import annotations

import sys
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import TextIO

    from rich.progress import TaskID

    Show: TypeAlias = Callable[[int, int, str], None]

# Work that takes less than this, s, has no lines in a log.
_SHORT = 2.0
# Longest time without a line in a log, s, while parts of the work are finished.
_LONGEST_PAUSE = 60.0


@contextmanager
def shown_progress(*, quiet: bool = False, unit: str = "") -> Iterator[Show]:
    """Give a function that shows the progress of the work on the standard error stream.

    Parameters
    ----------
    quiet : bool
        Show nothing.
    unit : str
        What is counted, for the rate on a terminal: "frames". Empty: no rate.

    Yields
    ------
    callable
        Takes the number of finished parts, their total (0: unknown) and what is done.

    Examples
    --------
    >>> with shown_progress(quiet=True) as show:
    ...     show(1, 2, "fitting")
    """
    if quiet:
        yield lambda *_: None
    elif sys.stderr.isatty():
        with _bar(unit) as show:
            yield show
    else:
        yield progress_lines(sys.stderr)


def progress_lines(stream: TextIO, *, clock: Callable[[], float] = time.monotonic) -> Show:
    """Return a function that writes a line for each tenth of the work, or each minute, flushed.

    Parameters
    ----------
    stream : text stream
    clock : callable
        Returns the time, s.

    Returns
    -------
    callable
        As in `shown_progress`. Nothing is written in the two seconds after its first call.

    Examples
    --------
    >>> seconds = iter([0.0, 3.0, 64.0, 65.0, 66.0])
    >>> show = progress_lines(sys.stdout, clock=lambda: next(seconds))
    >>> for done in (0, 40, 42, 43, 80):
    ...     show(done, 80, "fitting clusters")
    fitting clusters: 50 % (40 of 80), 3 s
    fitting clusters: 52 % (42 of 80), 64 s
    fitting clusters: 100 % (80 of 80), 66 s
    """
    calls: list[float] = []
    written: dict[str, tuple[int, float]] = {}

    def show(done: int, total: int, title: str) -> None:
        calls[1:] = [clock()]
        passed = calls[-1] - calls[0]
        tenth = 10 * done // total if total else 0
        last, when = written.get(title, (-1, 0.0))
        if passed < _SHORT or (last >= tenth and passed < when + _LONGEST_PAUSE):
            return
        written[title] = tenth, passed
        share = f": {100 * done // total} % ({done} of {total})" if total else ""
        print(f"{title}{share}, {passed:.0f} s", file=stream, flush=True)

    return show


@contextmanager
def _bar(unit: str) -> Iterator[Show]:
    """Give a function that moves a bar with rate and remaining time."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[count]}"),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True, highlight=False)
    with Progress(*columns, console=console, transient=not unit) as bar:
        tasks: dict[str, TaskID] = {}

        def show(done: int, total: int, title: str) -> None:
            if title not in tasks:
                for task in bar.tasks:  # earlier tasks are done
                    bar.update(task.id, total=task.total or 1, completed=task.total or 1)
                tasks[title] = bar.add_task(
                    title, total=total or None, completed=done, count="", rate=""
                )
            task = bar.tasks[tasks[title]]
            rate = f"{task.speed:.2g} {unit}/s" if task.speed and unit else ""
            count = f"{done}/{total}" if total else ""
            bar.update(task.id, completed=done, total=total or None, count=count, rate=rate)

        yield show
