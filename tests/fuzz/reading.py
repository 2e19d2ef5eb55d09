"""Read files, whole or damaged, as a user does; report every error that is not one of perrin's own.

Run as a program, it reads damaged files until its time is over, in a process whose memory is
limited; the process that started it sees from the last line which file ended it.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import signal
import sys
import time
import traceback
import warnings
import zlib
from pathlib import Path

import perrin
from perrin.tracks.files import read_spheres

_VOXEL, _DT = (0.3, 0.2, 0.2), 0.7
_SLOW = 90.0  # s, after which one file counts as a loop
HANGING = 40.0  # s, after which the process is ended

# Environment variable by which files of microscopes are read in the same process, which is faster;
# those that break it are read once more in a process of their own.
SWITCH = "PERRIN_GUARD"


def read(path):
    """Read a file or folder; raise what its reader raises."""
    name = path.name
    if name.startswith(("run.toml",)):
        read_config(path)
    elif name.startswith("spheres"):
        read_spheres(path)
    elif name.startswith(("run", "unchecked")):
        perrin.load_run(path)
    elif name.startswith("parts"):
        read_kept(path)
    elif path.suffix in (
        ".csv",
        ".gz",
        ".parquet",
        ".gdf",
        ".xyz",
        ".xml",
        ".txt",
        ".xlsx",
        ".c3d",
        ".gsd",
    ):
        perrin.read_tracks(path)
    else:
        read_stack(path)


def read_stack(path):
    """Open a stack with choices that fit it, and read frames of it one by one."""
    choice = {"voxel": _VOXEL, "dt": _DT}
    if path.suffix in (".nd2", ".oib", ".dv"):
        choice["channel"] = 0
    with perrin.open_stack(path, **choice) as stack:
        for i in {0, len(stack) // 2, len(stack) - 1}:
            try:
                stack.frame(i)
            except perrin.FrameError as fault:
                check_error(fault, path)


def read_kept(path):
    """Read the finished frames of a folder."""
    from perrin.movie.parts import open_parts, read_parts

    open_parts(path, {"size": 4})
    read_parts(path)


def read_config(path):
    """Take a configuration, as the command line does."""
    import tomllib

    import typer

    from perrin.cli.config import take_config

    context = typer.main.get_command(perrin.cli.app.app).commands["analyze"]
    with context.make_context("analyze", [], resilient_parsing=True) as ctx:
        try:
            take_config(ctx, path)
        except (typer.BadParameter, tomllib.TOMLDecodeError) as fault:
            raise ValueError(str(fault)) from fault


def check_error(fault, path):
    """Raise an AssertionError if an error is not one that a user can act upon."""
    assert isinstance(fault, (ValueError, OSError, ImportError)), f"{type(fault).__name__}: {fault}"
    assert type(fault).__module__.startswith(("perrin", "builtins")), repr(fault)
    assert (
        isinstance(fault, OSError) or str(path.parent) in str(fault) or path.name in str(fault)
    ), f"the file is not named: {fault!r}"
    assert len(str(fault)) < 20000


def verdict(path):
    """Return the complaint about reading a file: empty where it is read, or properly refused."""
    start = time.monotonic()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(path)
    except MemoryError:
        return "MemoryError"
    except Exception as fault:
        try:
            check_error(fault, path)
        except AssertionError as complaint:
            return f"{complaint}\n{''.join(traceback.format_exception(fault))[-3000:]}"
    passed = time.monotonic() - start
    return f"took {passed:.0f} s" if passed > _SLOW else ""


def put(content, path):
    """Write files by their relative names; "" is the path itself."""
    if path.is_dir():
        shutil.rmtree(path)
    for name, data in content.items():
        place = path / name if name else path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(data)


def seed_content(path):
    """Return the files of a seed."""
    stored = json.loads(path.read_text())
    return {name: zlib.decompress(base64.b64decode(data)) for name, data in stored.items()}


def limit_memory(n_bytes):
    """Limit the memory of this process beyond what its libraries take."""
    import resource

    resource.setrlimit(resource.RLIMIT_DATA, (n_bytes, n_bytes))


def main():
    """Damage the files of a corpus by numbers from FIRST on, for SECONDS, or MOST of them."""
    from corpus import whole
    from damage import case

    place, names = Path(sys.argv[1]), sys.argv[2].split(",")
    first, seconds, most = map(float, sys.argv[3:])
    contents = {name: whole(place / name) for name in names}
    limit_memory(3 * 2**30)
    folder = place / f"damaged-{int(first)}"
    folder.mkdir(exist_ok=True)
    end = time.monotonic() + seconds
    number, done = int(first), 0
    while time.monotonic() < end and done < most:
        name = names[number % len(names)]
        print(json.dumps({"reading": [name, number]}), flush=True)
        path = folder / name
        put(case(contents[name], number), path)
        signal.setitimer(signal.ITIMER_REAL, HANGING)
        complaint = verdict(path)
        if complaint and os.environ.get(SWITCH) == "off":
            signal.setitimer(signal.ITIMER_REAL, 0)
            os.environ[SWITCH] = "on"
            complaint = verdict(path)
            os.environ[SWITCH] = "off"
        signal.setitimer(signal.ITIMER_REAL, 0)
        if complaint:
            print(json.dumps({"complaint": [name, number, complaint]}), flush=True)
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        number += 1
        done += 1
    print(json.dumps({"done": done}), flush=True)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    main()
