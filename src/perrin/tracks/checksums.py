"""Checksums of the files of a run: a file that is damaged is found when it is read."""

from __future__ import annotations

import hashlib
import io
import json
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perrin._arrays import to_plain
from perrin.errors import DamagedFileError
from perrin.tracks.writing import write_json, written_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    import pandas as pd
    from numpy.typing import NDArray

CHECKSUMS = "checksums.json"
_METHOD = "blake2b-128"

# Kinds of files whose checksums are listed.
_DATA = (".json", ".parquet", ".npz", ".csv")


def checksum(data: bytes) -> str:
    """Return the BLAKE2b checksum of bytes, 32 hexadecimal digits.

    Examples
    --------
    >>> checksum(b"D_R")
    '36b837bdc9f4f7aeaa54ceefd35f9248'
    """
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def write_checksums(folder: Path) -> None:
    """Write the checksums of all data in a folder to its file ``checksums.json``.

    Parameters
    ----------
    folder : Path
        With files of JSON, Parquet, .npz and .csv.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "run.json").write_text("{}")
    ...     write_checksums(Path(folder))
    ...     CheckedFiles.of(folder).json("run.json")
    {}
    """
    sums = {
        path.name: checksum(path.read_bytes())
        for path in sorted(folder.iterdir())
        if path.suffix in _DATA and path.name != CHECKSUMS
    }
    write_json(folder / CHECKSUMS, {_METHOD: sums})


@dataclass(frozen=True)
class CheckedFiles:
    """The files of a folder, read with their checksums compared.

    Attributes
    ----------
    folder : Path
    sums : mapping of str to str, or None
        The checksum of every file; None for a folder of an earlier version, which has none.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "run.json").write_text("{]")
    ...     CheckedFiles.of(folder).json("run.json")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    perrin.errors.DamagedFileError: .../run.json: is damaged (...): ...
    """

    folder: Path
    sums: Mapping[str, str] | None

    @classmethod
    def of(cls, folder: Path | str) -> CheckedFiles:
        """Read the list of checksums of a folder.

        Parameters
        ----------
        folder : Path or str

        Returns
        -------
        CheckedFiles

        Raises
        ------
        DamagedFileError
            If the list is damaged.
        """
        path = Path(folder) / CHECKSUMS
        if not path.is_file():
            return cls(Path(folder), None)
        with refusing_damage(path):
            sums = json.loads(path.read_bytes())[_METHOD]
            if not all(isinstance(text, str) for text in (*sums.keys(), *sums.values())):
                raise TypeError("it lists no checksums")
        return cls(Path(folder), sums)

    def has(self, name: str) -> bool:
        """Return whether a file is there, or should be."""
        return (self.folder / name).is_file() or name in (self.sums or {})

    def read(self, name: str) -> bytes:
        """Return the bytes of a file.

        Parameters
        ----------
        name : str

        Returns
        -------
        bytes

        Raises
        ------
        DamagedFileError
            If they do not have the checksum that is listed.
        FileNotFoundError
            If there is no such file.
        """
        path = self.folder / name
        data = path.read_bytes()
        if self.sums is None:
            return data
        if self.sums.get(name) != checksum(data):
            listed = "another checksum" if name in self.sums else "no checksum"
            raise _damaged(path, f"{CHECKSUMS} lists {listed} for it, {len(data)} bytes")
        return data

    def json(self, name: str) -> Any:  # noqa: ANN401 (whatever JSON holds)
        """Return the content of a file of JSON; errors as in `read`."""
        return self._parsed(name, json.loads)

    def table(self, name: str) -> pd.DataFrame:
        """Return the table of a Parquet file; errors as in `read`."""
        import pandas as pd

        return self._parsed(name, lambda data: pd.read_parquet(io.BytesIO(data)))

    def arrays(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the arrays of a .npz file by their names; errors as in `read`."""
        import numpy as np

        def unpacked(data: bytes) -> dict[str, NDArray[Any]]:
            with np.load(io.BytesIO(data), allow_pickle=False) as stored:
                return dict(stored)

        arrays: dict[str, NDArray[Any]] = self._parsed(name, unpacked)
        return arrays

    def _parsed(self, name: str, parse: Callable[[bytes], Any]) -> Any:  # noqa: ANN401
        """Return the content of a file; a damaged one of an earlier version has no checksum."""
        data = self.read(name)
        with refusing_damage(self.folder / name):
            return parse(data)


@contextmanager
def refusing_damage(path: Path) -> Iterator[None]:
    """Turn every error of a decoder into one that names the damaged file or folder.

    Parameters
    ----------
    path : Path

    Raises
    ------
    DamagedFileError

    Examples
    --------
    >>> with refusing_damage(Path("run/summary.json")):
    ...     json.loads("")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
        ...
    perrin.errors.DamagedFileError: run/summary.json: is damaged (JSONDecodeError: ...
    """
    try:
        yield
    except (MemoryError, DamagedFileError):
        raise
    # The decoders of damaged files raise errors of any class.
    except Exception as fault:
        words = " ".join(str(fault).split())
        raise _damaged(path, f"{type(fault).__name__}: {words[:200]}") from fault


def _damaged(path: Path, reason: str) -> DamagedFileError:
    return DamagedFileError(
        f"{path}: is damaged ({reason}): copy it from a backup, or repeat the run", str(path)
    )


def write_sealed(path: Path, content: object) -> None:
    """Write a file of JSON with its checksum inside, whole or not at all.

    Parameters
    ----------
    path : Path
    content : object
        Values that JSON can hold.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_sealed(Path(folder, "settings.json"), {"size": 4})
    ...     read_sealed(Path(folder, "settings.json"))
    {'size': 4}
    """
    plain = json.loads(json.dumps(content, allow_nan=False, default=to_plain))
    with written_whole(path) as unfinished:
        write_json(unfinished, {"content": plain, _METHOD: checksum(_canonical(plain))})


def read_sealed(path: Path) -> Any:  # noqa: ANN401 (whatever JSON holds)
    """Read what `write_sealed` wrote.

    Parameters
    ----------
    path : Path

    Returns
    -------
    object

    Raises
    ------
    DamagedFileError
        If its content does not have its checksum.
    FileNotFoundError
        If there is no such file.
    """
    data = path.read_bytes()
    with refusing_damage(path):
        stored = json.loads(data)
        content, stated = stored["content"], stored[_METHOD]
    if checksum(_canonical(content)) != stated:
        raise _damaged(path, "it does not have its checksum")
    return content


def _canonical(content: object) -> bytes:
    """Return a content that JSON has given as JSON of one form."""
    return json.dumps(content, sort_keys=True).encode()
