"""Options of a command in a TOML file, which --config reads: that of a run folder, or one's own."""

from __future__ import annotations

import tomllib
from pathlib import Path  # noqa: TC003 (typer reads the annotations of callbacks)
from typing import Any

import typer

# Arguments that are paths.
_PATHS = ("tracks", "stack", "output")


def take_config(ctx: typer.Context, path: Path | None) -> Path | None:
    """Take the options of a file as defaults; those of the command line outrank them.

    Paths in the file are relative to its folder.

    Parameters
    ----------
    ctx : typer.Context
        Of a command with an option --config.
    path : Path or None

    Returns
    -------
    Path or None
        The same path.

    Raises
    ------
    typer.BadParameter
        If the file is no TOML, belongs to another command, or has names that are no options.
    """
    if path is None:
        return None
    try:
        stated = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise typer.BadParameter(f"{path}: {reason}") from None
    command = stated.pop("command", ctx.info_name)
    if command != ctx.info_name:
        raise typer.BadParameter(f"{path} is of the command {command}, not of {ctx.info_name}")
    # The argument of each option, by its name without dashes.
    names = {
        max(one.opts, key=len, default=one.name).lstrip("-").replace("_", "-"): one.name
        for one in ctx.command.params
        if one.name is not None and one.name != "config"
    }
    unknown = [name for name in stated if name.replace("_", "-") not in names]
    if unknown:
        offered = ", ".join(sorted(names))
        raise typer.BadParameter(f"{path}: unknown: {', '.join(unknown)}; expected {offered}")
    values = {names[n.replace("_", "-")]: _as_option(value) for n, value in stated.items()}
    for name in set(_PATHS) & set(values):
        # A configuration means the same wherever it is read from.
        values[name] = str(path.absolute().parent / values[name])
    if ctx.info_name in ("analyze", "run") and "output" not in values:
        beside = _beside(path)
        values |= {} if beside is None else {"output": beside}
    ctx.default_map = {**(ctx.default_map or {}), **values}
    return path


def _as_option(value: Any) -> Any:  # noqa: ANN401 (whatever TOML holds)
    """Return a list or a table of TOML as the text that one types."""
    if isinstance(value, list):
        return ",".join(str(part) for part in value)
    if isinstance(value, dict):
        return ",".join(f"{name}={part}" for name, part in value.items())
    return value


def _beside(path: Path) -> str | None:
    """Return the name of a new folder beside the run folder that holds a configuration."""
    folder = path.absolute().parent
    if not (folder / "run.json").is_file():
        return None
    number = 2
    while folder.with_name(f"{folder.name}-{number}").exists():
        number += 1
    return str(folder.with_name(f"{folder.name}-{number}"))
