"""What repeats a run: its command with options, the same in Python, and as a TOML file."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

# Defaults of `analyze`, of `open_stack`, and of `analyze_stack`, where a command has the option.
TABLE_DEFAULTS: dict[str, Any] = {
    "dt": None, "scale": 1.0, "columns": None, "contact": None, "size": None, "sigma": None,
    "noise": "joint", "exposure": None, "drift": False, "keep_jumps": False, "model": None,
    "viscosity": None, "temperature": None, "diameter": None, "frames": None,
}  # fmt: skip
OPENING = ("voxel", "dt", "plane_time", "planes", "channel", "image")
MOVIE_DEFAULTS: dict[str, Any] = {
    "diameter": None, "contact": None, "size": None, "frames": None, "exclude": [],
    "refine": "model", "optics": None, "dark": False, "minmass": None, "percentile": 95.0,
    "border": True, "noise": "joint", "exposure": None, "drift": False, "keep_jumps": False,
    "model": None, "viscosity": None, "temperature": None,
}  # fmt: skip

# How a table was read; the tracks of a run folder need none of it.
_READING = ("scale", "columns", "contact", "frames", "size")

# The command that a configuration belongs to is its first line.
COMMAND_KEY = "command"


class Repetition(NamedTuple):
    """The arguments of a run that differ from the defaults.

    Attributes
    ----------
    command : str
        "analyze", or "run" for a movie.
    source : str or None
        Path of the input; None for a table or a movie in memory.
    opening : dict
        Keywords of `open_stack`; empty for a table. A tuple of channels is one for each kind of
        sphere, each opened by itself.
    options : dict
        Keywords of `analyze` or `analyze_stack`.
    """

    command: str
    source: str | None
    opening: dict[str, Any]
    options: dict[str, Any]


def stated_arguments(settings: Mapping[str, Any], *, dt: float | None = None) -> Repetition:
    """Return what repeats a run.

    Parameters
    ----------
    settings : mapping
        `Report.settings`.
    dt : float, optional
        Time between frames, s, where the settings do not state it.

    Returns
    -------
    Repetition

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> stated_arguments(report.settings).options
    {'dt': 0.73}
    """
    given: dict[str, Any] = {"dt": dt} | dict(settings.get("arguments", {}))
    path = settings.get("input", {}).get("path")
    if "shape" not in given:  # that of a movie
        return Repetition("analyze", path, {}, _differing(given, TABLE_DEFAULTS))
    given |= {name: given.get(f"stated_{name}") for name in ("voxel", "dt", "plane_time")}
    first, last = given.get("first_frame", 0), given.get("last_frame")
    count = given.get("shape", [None])[0]
    if last is not None and (first, last) != (0, count and count - 1):
        given["frames"] = (first, last + 1)
    opening = _differing(given, dict.fromkeys(OPENING))
    others = given.get("other_channels")  # spheres of another kind each
    if others and "channel" in given:  # a movie in memory has none
        opening["channel"] = (given["channel"], *(one["channel"] for one in others))
    options = _differing(given, MOVIE_DEFAULTS)
    if "refine" in given and given["refine"] is None:
        options["refine"] = None
    if given.get("psf") is not None:
        options["psf"] = given["psf"]
    return Repetition("run", path, opening, options)


def command_line(settings: Mapping[str, Any]) -> str:
    """Return the command that repeats a run.

    Parameters
    ----------
    settings : mapping
        `Report.settings`.

    Returns
    -------
    str
        A line for a shell; empty if the input was not a file.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> command_line(report.settings).split()[-4:]
    ['--dt', '0.73', '-o', 'my-run']
    """
    again = stated_arguments(settings)
    if not again.source:
        return ""
    words = ["perrin", again.command, shlex.quote(str(again.source))]
    for name, value in (again.opening | again.options).items():
        option = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            words += [f"--{option}", shlex.quote(str(_typed(name, value)))]
    return " ".join([*words, "-o", "my-run"])


def python_lines(settings: Mapping[str, Any]) -> str:
    """Return the Python lines that repeat a run.

    Parameters
    ----------
    settings : mapping
        `Report.settings`.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> print(python_lines(report.settings).splitlines()[0])
    import perrin
    """
    again = stated_arguments(settings)
    lines, options = ["import perrin", ""], dict(again.options)
    optics, psf = options.pop("optics", None), options.pop("psf", None)
    given = "".join(f", {name}={value!r}" for name, value in options.items())
    if optics is not None:
        given += f", optics=perrin.Optics.from_dict({optics!r})"
    if psf is not None:
        given += f", psf=perrin.PointSpread.from_dict({psf!r})"
    if again.command == "run":
        stated, kinds = dict(again.opening), again.opening.get("channel")
        if isinstance(kinds, tuple):
            stated.pop("channel")
        opening = "".join(f", {name}={value!r}" for name, value in stated.items())
        source = "movie" if again.source is None else repr(str(again.source))
        if isinstance(kinds, tuple):
            each = f"perrin.open_stack({source}{opening}, channel=kind) for kind in {kinds!r}"
            lines.append(f"stack = [{each}]")
        else:
            lines.append(f"stack = perrin.open_stack({source}{opening})")
        lines.append(f"report = perrin.analyze_stack(stack{given})")
    else:
        source = "table" if again.source is None else repr(str(again.source))
        lines.append(f"report = perrin.analyze({source}{given})")
    return "\n".join([*lines, "print(report)", 'report.to_frame().to_csv("results.csv")'])


def config_text(settings: Mapping[str, Any], *, dt: float | None = None) -> str:
    """Return the options of a run as TOML: ``run.toml``, which `--config` reads.

    Parameters
    ----------
    settings, dt
        As in `stated_arguments`.

    Returns
    -------
    str
        The input is its file. Where the table or movie was in memory it is ``tracks.parquet``, the
        tracks beside the TOML file, and the command is `analyze`.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> table = perrin.read_tracks(files("perrin") / "data" / "demo_tracks.csv.gz")
    >>> print(config_text(perrin.analyze(table, dt=0.73).settings))
    command = "analyze"
    tracks = "tracks.parquet"
    dt = 0.73
    <BLANKLINE>
    """
    again = stated_arguments(settings, dt=dt)
    command, options = again.command, again.opening | again.options
    lines = []
    source = "" if again.source is None else str(Path(again.source).absolute())
    if source.encode(errors="ignore").decode() != source:
        lines.append("# The name of the input is not UTF-8: this measures the positions it gave.")
        source = ""
    if not source:
        source = "tracks.parquet"
        options = {name: value for name, value in options.items() if name not in _READING}
        if command == "run":
            if again.source is None:
                lines.append("# The movie was in memory: this measures the positions in it.")
            command = "analyze"
            left_out = (*_READING, "diameter", *set(MOVIE_DEFAULTS) - set(TABLE_DEFAULTS))
            options = {k: value for k, value in again.options.items() if k not in left_out}
            options = {"dt": settings["arguments"]["dt"]} | options
    values = {COMMAND_KEY: command, "stack" if command == "run" else "tracks": source}
    values |= {name.replace("_", "-"): _typed(name, value) for name, value in options.items()}
    # Text, numbers and truth values are written in TOML as in JSON.
    lines += [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in values.items()]
    return "\n".join(lines) + "\n"


def _differing(given: dict[str, Any], defaults: dict[str, Any]) -> dict[str, Any]:
    """Return the values that are stated and not the defaults."""
    return {
        name: given[name]
        for name, default in defaults.items()
        if name in given and given[name] is not None and given[name] != default
    }


def _typed(name: str, value: Any) -> Any:  # noqa: ANN401 (arguments of any type)
    """Return a value as it is typed on the command line; numbers and truth values as they are."""
    if name == "frames":
        return ":".join("" if end is None else str(end) for end in value)
    if name == "refine" and value is None:
        return "none"
    if name == "channel" and isinstance(value, tuple):
        return ":".join(str(_typed(name, kind)) for kind in value)
    if name == "psf":
        return "beads.tif"  # the stack on which it was measured, whose name is not kept
    if name == "optics":
        tail = [] if value["tail"] is None else [value["tail"][0], *value["tail"][1]]
        spread = [value["spread"]] if value["spread"] else []
        value = [value["diameter"], *value["psf"], *value["noise"], *tail, *spread]
    if isinstance(value, dict):
        return ",".join(f"{key}={part}" for key, part in value.items())
    if isinstance(value, list | tuple):
        return ",".join(map(str, value))
    return value
