"""Options of a command in a TOML file: read by --config, and written into every run folder."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from collections.abc import Mapping

# Names of a configuration that are no options: the command that it belongs to.
_COMMAND = "command"

# Options that a repeated run states anew.
_NOT_KEPT = ("config", "output", "overwrite", "as_json", "quiet", "workers", "scheduler")


def take_config(ctx: typer.Context, path: Path | None) -> Path | None:
    """Take the options of a file as defaults; those of the command line outrank them.

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
    command = stated.pop(_COMMAND, ctx.info_name)
    if command != ctx.info_name:
        raise typer.BadParameter(f"{path} is of the command {command}, not of {ctx.info_name}")
    names = _names_of(ctx)
    unknown = [name for name in stated if name.replace("_", "-") not in names]
    if unknown:
        offered = ", ".join(sorted(names))
        raise typer.BadParameter(f"{path}: unknown: {', '.join(unknown)}; expected {offered}")
    values = {names[n.replace("_", "-")]: _as_option(value) for n, value in stated.items()}
    if ctx.info_name in ("analyze", "run") and "output" not in values:
        beside = _beside(path)
        values |= {} if beside is None else {"output": beside}
    ctx.default_map = {**(ctx.default_map or {}), **values}
    return path


def config_text(
    command: str, values: Mapping[str, Any], names: Mapping[str, str] | None = None
) -> str:
    """Return the options of a command as TOML.

    Parameters
    ----------
    command : str
    values : mapping
        Values by the names of the command's arguments; paths are made absolute, and values of
        None or False are left out.
    names : mapping of str to str, optional
        Name of an argument on the command line, without dashes before it, where it differs.

    Returns
    -------
    str

    Examples
    --------
    >>> print(config_text("analyze", {"dt": 0.5, "d_r": None, "drift": True}, {"d_r": "d-r"}))
    command = "analyze"
    dt = 0.5
    drift = true
    <BLANKLINE>
    """
    lines = [f'{_COMMAND} = "{command}"']
    for key, value in values.items():
        if key in _NOT_KEPT or value is None or value is False:
            continue
        plain = str(value.absolute()) if isinstance(value, Path) else value
        # Text, numbers and true are written in TOML as in JSON.
        lines.append(f"{(names or {}).get(key, key)} = {json.dumps(plain, ensure_ascii=False)}")
    return "\n".join(lines) + "\n"


def write_config(folder: Path, ctx: typer.Context) -> None:
    """Write the options of this call into a run folder, as run.toml.

    Parameters
    ----------
    folder : Path
        A finished run folder.
    ctx : typer.Context
    """
    from perrin.tracks.writing import written_whole

    names = {key: name for name, key in _names_of(ctx).items()}
    values = {key: ctx.params[key] for key in names if key in ctx.params}
    text = config_text(str(ctx.info_name), values, names)
    with written_whole(folder / "run.toml") as part:
        part.write_text(text, encoding="utf-8")


def _names_of(ctx: typer.Context) -> dict[str, str]:
    """Return the argument of each option of the command, by its name without dashes."""
    found = {}
    for parameter in ctx.command.params:
        if parameter.name is not None and parameter.name != "config":
            longest = max(parameter.opts, key=len, default=parameter.name)
            found[longest.lstrip("-").replace("_", "-")] = parameter.name
    return found


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
