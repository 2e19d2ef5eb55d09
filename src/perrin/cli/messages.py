"""Messages of the library in the words of the command line: arguments become options."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, get_type_hints

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


# Arguments of the library that are called otherwise on the command line.
_RENAMED = {
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
_SYMBOLS = ("dt", "sigma", "D_R", "D_T", "R")


_NOT_POSITIVE = re.compile(r"(?<=expected a finite number > 0: )[^;]*")


# Arguments whose names are no words of the language, and name nothing else.
_PYTHON_ONLY = ("n_frames", "total_time", "plane_time", "minmass", "keep_jumps")


_VALUE = r"\{[^{}]*\}|\([^()]*\)|\[[^\[\]]*\]|'[^']*'|\"[^\"]*\"|[^\s,;:()]*"


def options_of(command: Callable[..., object]) -> dict[str, str]:
    """Return the options of a command by the arguments of the library that they become.

    Parameters
    ----------
    command : callable
        A function whose options are annotated in the way of typer.

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
                default = f"--{name.replace('_', '-')}"
                options[name] = max(about.param_decls or (default,), key=len)
    return options | {
        argument: option for argument, option in _RENAMED.items() if option in options.values()
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
        value = _plain_value(match[2])
        return f"{options[match[1]]} {value}" if value else options[match[1]]

    # name=value anywhere, "name: " where a clause begins, "name = value".
    text = re.sub(rf"(?<![\w-])({names})=({_VALUE})", with_value, text)
    text = re.sub(rf"(?:(?<=[:;] )|(?<=- )|^)({names})(?=: )", option, text)
    text = _NOT_POSITIVE.sub(lambda found: re.sub(rf"\b({names}) =(?= )", option, found[0]), text)
    words = "|".join(name for name in options if name not in _SYMBOLS)
    if words:
        text = re.sub(rf"(?<![\w-])({words}) =(?= )", option, text)
    alone = "|".join(name for name in _PYTHON_ONLY if name in options)
    return re.sub(rf"(?<![\w-])({alone})\b", option, text) if alone else text


def _plain_value(value: str) -> str:
    """Return a value of Python as it is written behind an option; nothing for True."""
    if value.startswith("{"):
        pairs = re.findall(r"['\"]?(\w+)['\"]?: *['\"]?([^,'\"}]+)['\"]?", value)
        return ",".join(f"{name}={column}" for name, column in pairs)
    if value.startswith(("(", "[")):
        return value[1:-1].replace(" ", "")
    return {"True": "", "None": "none"}.get(value, value.strip("'\""))
