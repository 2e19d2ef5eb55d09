"""Files that appear whole or not at all, and files of JSON and Parquet."""

from __future__ import annotations

import hashlib
import json
import os
import re
from contextlib import contextmanager
from typing import TYPE_CHECKING

from perrin._arrays import to_plain

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    import pandas as pd


# File systems have names of up to 255 bytes; an ending must have its place.
_LONGEST_NAME = 200


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Provide a path to write to, which is renamed to `path` when all has been written.

    The file is flushed to the disk before it is renamed, and its folder afterwards, so that a power
    cut leaves the old file or the new one.

    Parameters
    ----------
    path : Path
        Final path of the file.

    Yields
    ------
    Path
        Path in the same folder; it is removed if the writing fails.

    Raises
    ------
    OSError
        If the file cannot be written; the message names `path`.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with written_whole(Path(folder) / "a.txt") as part:
    ...         _ = part.write_text("all of it")
    ...     [path.name for path in Path(folder).iterdir()]
    ['a.txt']
    """
    part = hidden_beside(path, f"{os.getpid()}.part")
    try:
        yield part
        _flush(part)
        part.replace(path)
        if os.name == "posix":
            _flush(path.parent)
    except OSError as fault:
        if fault.errno is None:
            raise
        # The system's message names the temporary path, or none.
        raise type(fault)(fault.errno, fault.strerror, str(path)) from fault
    finally:
        part.unlink(missing_ok=True)


def hidden_beside(path: Path, ending: str) -> Path:
    """Return a hidden path in the folder of `path`, of a name that a file system can hold.

    Parameters
    ----------
    path : Path
    ending : str
        End of the name, without its dot.

    Returns
    -------
    Path

    Examples
    --------
    >>> from pathlib import Path
    >>> hidden_beside(Path("a/run"), "lock").as_posix()
    'a/.run.lock'
    >>> len(hidden_beside(Path("n" * 250), "lock").name)
    38
    """
    name = path.name
    if len(os.fsencode(name)) > _LONGEST_NAME:
        name = hashlib.blake2b(os.fsencode(name), digest_size=16).hexdigest()
    return path.with_name(f".{name}.{ending}")


def write_json(path: Path, content: object) -> None:
    r"""Write a file of JSON in UTF-8, indented, in which no number is infinite or missing.

    Parameters
    ----------
    path : Path
        File that is written.
    content : object
        Values that JSON can hold, NumPy's numbers and arrays among them.

    Raises
    ------
    ValueError
        If a number is not finite.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_json(Path(folder, "sizes.json"), {"diameter": 2.45})
    ...     Path(folder, "sizes.json").read_text()
    '{\n  "diameter": 2.45\n}\n'
    """
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False, default=to_plain)
    # Half a pair of surrogates is what Python makes of a file's name that is not UTF-8.
    text = re.sub(r"[\ud800-\udfff]", lambda half: f"\\u{ord(half[0]):04x}", text)
    path.write_text(text + "\n", encoding="utf-8")


def _flush(path: Path) -> None:
    """Force a file or a folder onto the disk."""
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_parquet(path: Path, table: pd.DataFrame) -> None:
    """Write a table as Parquet, without its index, into a folder of any name.

    Parameters
    ----------
    path : Path
        File that is written.
    table : pandas.DataFrame

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import pandas as pd
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_parquet(Path(folder, "t.parquet"), pd.DataFrame({"x": [1.0, 2.0]}))
    ...     pd.read_parquet(Path(folder, "t.parquet"))["x"].tolist()
    [1.0, 2.0]
    """
    # By an open file: pyarrow itself opens no path that is not UTF-8.
    with path.open("wb") as file:
        table.to_parquet(file, index=False)
