"""Errors and warnings of the library, in the words of the command line and in one line each."""

from __future__ import annotations

import os
import re
import sys
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, get_type_hints

import typer

from perrin._text import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path
    from typing import TextIO

    from rich.console import Console


STOPPED = "Stopped: nothing is written, and what was there is kept."

# Arguments of the library that have another name on the command line.
_RENAMED_ARGUMENTS = {
    "n_frames": "--frames",
    "total_time": "--time",
    "D_R": "--d-r",
    "D_T": "--d-t",
    "R": "--radius",
    "centers": "--positions",
    "anew": "--overwrite",
}

# Arguments whose names are symbols of physics: "dt = 0.5 s" may be a statement about the data,
# except in a list of arguments that are not positive.
_PHYSICAL_SYMBOLS = ("dt", "sigma", "D_R", "D_T", "R")

_LIST_OF_FAULTS = re.compile(r"(?<=expected a finite number > 0: )[^;]*")

# Arguments whose names are no words of the language, and name nothing else.
_ARGUMENTS_ALONE = ("n_frames", "total_time", "plane_time", "minmass", "keep_jumps")

_ARGUMENT_VALUE = r"\{[^{}]*\}|\([^()]*\)|\[[^\[\]]*\]|'[^']*'|\"[^\"]*\"|[^\s,;:()]*"


@cache
def options_of(command: Callable[..., object]) -> dict[str, str]:
    """Return the options of a command by the arguments of the library that they become.

    Parameters
    ----------
    command : callable
        A function whose options are annotated for typer.

    Returns
    -------
    dict of str to str

    Examples
    --------
    >>> from typing import Annotated
    >>> import typer
    >>> def plan(time: Annotated[float, typer.Option(help="s.")] = 1.0) -> None: ...
    >>> options_of(plan)
    {'time': '--time', 'total_time': '--time'}
    """
    from typer.models import OptionInfo

    options = {}
    for name, hint in get_type_hints(command, include_extras=True).items():
        for about in getattr(hint, "__metadata__", ()):
            if isinstance(about, OptionInfo):
                # typer takes the first name of an option for its default.
                names = (about.default, *(about.param_decls or ()))
                stated = [d for d in names if isinstance(d, str) and d.startswith("--")]
                options[name] = max(stated, key=len, default=f"--{name.replace('_', '-')}")
    return options | {
        argument: option
        for argument, option in _RENAMED_ARGUMENTS.items()
        if option in options.values()
    }


def in_options(text: str, options: Mapping[str, str]) -> str:
    """Return a message with the options of the command line in place of the library's arguments.

    Parameters
    ----------
    text : str
        A message in the words of Python: ``dt=``, ``columns={'x': 'X'}``, ``n_frames: expected``.
    options : mapping of str to str
        From `options_of`.

    Returns
    -------
    str

    Examples
    --------
    >>> options = {"columns": "--columns", "n_frames": "--frames", "overwrite": "--overwrite"}
    >>> in_options("rename it, or state columns={'frame': 'Frame'}", options)
    'rename it, or state --columns frame=Frame'
    >>> in_options("n_frames: expected 3; or overwrite=True", options)
    '--frames: expected 3; or --overwrite'
    """
    if not options:
        return text
    names = "|".join(sorted(options, key=len, reverse=True))

    def option(match: re.Match[str]) -> str:
        return options[match[1]]

    def with_value(match: re.Match[str]) -> str:
        # A value of Python becomes one behind an option; True needs none.
        name, value = options[match[1]], match[2]
        if value.startswith("{"):
            pairs = re.findall(r"['\"]?(\w+)['\"]?: *['\"]?([^,'\"}]+)['\"]?", value)
            value = ",".join(f"{key}={column}" for key, column in pairs)
        elif value.startswith(("(", "[")):
            value = value[1:-1].replace(" ", "")
        else:
            value = {"True": "", "None": "none"}.get(value, value.strip("'\""))
        return f"{name} {value}" if value else name

    # name=value anywhere, "name: " where a clause begins, "name = value".
    text = re.sub(rf"(?<![\w-])({names})=({_ARGUMENT_VALUE})", with_value, text)
    text = re.sub(rf"(?:(?<=[:;] )|(?<=- )|^)({names})(?=: )", option, text)
    text = _LIST_OF_FAULTS.sub(lambda found: re.sub(rf"\b({names}) =(?= )", option, found[0]), text)
    words = "|".join(name for name in options if name not in _PHYSICAL_SYMBOLS)
    if words:
        text = re.sub(rf"(?<![\w-])({words}) =(?= )", option, text)
    alone = "|".join(name for name in _ARGUMENTS_ALONE if name in options)
    return re.sub(rf"(?<![\w-])({alone})\b", option, text) if alone else text


class StoppedError(BaseException):
    """The operating system, or the keyboard, stops the process; no library handles it on the way.

    Attributes
    ----------
    number : int
        Number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def status_of(stop: BaseException) -> int:
    """Return the exit status of a process that was stopped: 128 and the number of the signal.

    Examples
    --------
    >>> status_of(KeyboardInterrupt()), status_of(StoppedError(15))
    (130, 143)
    """
    return 128 + (stop.number if isinstance(stop, StoppedError) else 2)


def stop_in_order() -> None:
    """Let SIGINT and SIGTERM raise an error once, and end the process at once the second time.

    The error lets finished work be written; what is written appears whole or not at all, so that
    the second signal does no harm.
    """
    import signal

    signals = (signal.SIGINT, signal.SIGTERM)

    def stop(number: int, _: object) -> None:
        for each in signals:
            signal.signal(each, signal.SIG_DFL)
        raise StoppedError(number)

    for each in signals:
        if signal.getsignal(each) is not signal.SIG_IGN:  # as under nohup
            signal.signal(each, stop)


def escape(text: object) -> str:
    r"""Return a text for the tables of the terminal: no markup, and no codes of a terminal.

    Parameters
    ----------
    text : object
        With the names that users give to clusters and files.

    Returns
    -------
    str

    Examples
    --------
    >>> escape("[bold]a\x1b[0m")
    '\\[bold]a\\x1b[0m'
    """
    from rich.markup import escape as without_markup

    # At the end of its text rich doubles a backslash, which is right before a tag only.
    return without_markup(f"{printable(text)} ")[:-1]


@contextmanager
def messages_of(command: Callable[..., object]) -> Iterator[None]:
    """Print warnings and an error in one line each, in the words of the command line.

    Parameters
    ----------
    command : callable
        The command that runs inside.

    Raises
    ------
    typer.Exit
        With status 1 where the data cannot answer, 2 where the input or the place of the output is
        wrong, 130 after an interruption from the keyboard, 143 after SIGTERM.
    """
    import perrin

    no_answer = (
        perrin.DegenerateClusterError,
        perrin.IdentityError,
        perrin.NoSpheresError,
        perrin.TooFewFramesError,
    )
    options = options_of(command)
    try:
        with warnings_in_one_line(options):
            yield
    except (KeyboardInterrupt, StoppedError) as stop:
        print(STOPPED, file=sys.stderr)
        raise typer.Exit(status_of(stop)) from None
    except BrokenPipeError:
        # The reader has stopped (a pipe into head); the run itself is written. Python's own flush
        # at the end would complain again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (ValueError, OSError, ImportError, MemoryError) as error:
        if isinstance(error, MemoryError):
            text = f"not enough memory: {error}" if str(error) else "not enough memory"
        elif isinstance(error, OSError) and error.strerror and error.filename:
            text = f"{error.filename}: {error.strerror}"
        else:
            text = "; ".join(line.strip().removeprefix("- ") for line in str(error).splitlines())
        print(f"perrin: {printable(in_options(text, options))}", file=sys.stderr)
        raise typer.Exit(1 if isinstance(error, no_answer) else 2) from None


def output_console() -> Console:
    """Return what writes tables to standard output.

    Where the reader has stopped, it raises the BrokenPipeError that `messages_of` expects; rich's
    own console ends the program with status 1.
    """
    from rich.console import Console

    class OutputConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    return OutputConsole(highlight=False)


@contextmanager
def claimed_output(command: Callable[..., object], folder: Path) -> Iterator[Path]:
    """Hold the folder of a command's output, with messages as in `messages_of`.

    Parameters
    ----------
    command : callable
        The command that runs inside.
    folder : Path

    Yields
    ------
    Path
        The folder.

    Raises
    ------
    typer.Exit
        As in `messages_of`; with status 2 if another process is writing there.
    """
    with messages_of(command):
        from perrin.run.folders import claimed_folder

        with claimed_folder(folder) as place:
            yield place


@contextmanager
def warnings_in_one_line(options: Mapping[str, str]) -> Iterator[None]:
    """Print the library's warnings when they are raised, each text once.

    Parameters
    ----------
    options : mapping of str to str
        From `options_of`.
    """
    import warnings

    import perrin

    ours = (perrin.PrecisionWarning, perrin.IdentityWarning)
    printed: set[str] = set()
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if not issubclass(category, ours):
                usual(message, category, filename, lineno, file, line)
                return
            text = printable(in_options(" ".join(str(message).split()), options))
            if text not in printed:
                print(f"warning: {text}", file=sys.stderr)
                printed.add(text)

        for category in ours:
            warnings.simplefilter("always", category)
        warnings.showwarning = show
        yield


@contextmanager
def state_kept_frames(output: Path) -> Iterator[None]:
    """State, when a run is stopped from outside, that its finished frames are kept.

    Parameters
    ----------
    output : Path
        The run folder.

    Raises
    ------
    typer.Exit
        With status 130 after an interruption from the keyboard, 143 after SIGTERM.
    """
    try:
        yield
    except (OSError, KeyboardInterrupt, StoppedError) as stop:
        kept = any((output / "located").glob("part-*")) and not (output / "run.json").exists()
        if kept:
            print(
                f"Finished frames are kept in {printable(output)}: the same command resumes the "
                "run.",
                file=sys.stderr,
            )
        if isinstance(stop, OSError) or not kept:
            raise
        raise typer.Exit(status_of(stop)) from None
