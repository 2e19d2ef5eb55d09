"""A lock on a folder: one process at a time writes into it, and a crash leaves no lock behind."""

from __future__ import annotations

import errno
import json
import os
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perrin.errors import FolderInUseError
from perrin.tracks.writing import hidden_beside

if TYPE_CHECKING:
    from collections.abc import Iterator

LOCK_INSIDE = ".lock"  # name of the lock file where the folder above may not be written

_BEAT = 20.0  # s, between two signs of life in the lock file
_SILENT = 6 * _BEAT  # s without a sign of life after which another machine counts as stopped

# Errors of file systems that have no locks.
_WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL)

# Folders that this process holds: what the operating system knows too, but does not tell.
_HELD: dict[str, tuple[int, int]] = {}
_GUARD = threading.Lock()


@contextmanager
def locked(folder: str | os.PathLike[str]) -> Iterator[bool]:
    """Hold a folder against all other processes, also on other machines.

    Parameters
    ----------
    folder : path
        It need not exist. Several paths to one folder count as the same.

    Yields
    ------
    bool
        False where the same thread holds the folder already; nothing is done then.

    Raises
    ------
    FolderInUseError
        If another process, or another thread, holds the folder; one line with process, machine and
        time.
    OSError
        If the lock file cannot be written.

    Notes
    -----
    The lock file is hidden, beside the folder (in it, where the folder above is not writable), and
    is removed at the end. It is locked by ``flock``, which the operating system undoes when a
    process ends, however it ends. Between machines this works on NFS and on all file systems that
    pass locks to their server. For the others the lock file names its process and machine and is
    renewed every 20 s: a file of another machine that was renewed in the last 120 s is respected
    although its lock is not seen. Ages are those of the clock of the file server.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as parent:
    ...     with locked(Path(parent, "run")) as first, locked(Path(parent, "run")) as again:
    ...         first, again
    (True, False)
    """
    place = os.path.realpath(folder)
    me = threading.get_ident()
    with _GUARD:
        owner, times = _HELD.get(place, (me, 0))
        if owner != me:
            raise FolderInUseError(f"{folder}: another thread of this process is writing there")
        _HELD[place] = (me, times + 1)
    try:
        if times:
            yield False
        else:
            with _lock_file(folder, Path(place)):
                yield True
    finally:
        with _GUARD:
            if times:
                _HELD[place] = (me, times)
            else:
                del _HELD[place]


@contextmanager
def _lock_file(folder: str | os.PathLike[str], place: Path) -> Iterator[None]:
    """Hold the lock file of a folder; folders that were made for it and stay empty are removed."""
    above = [p for p in place.parents if not p.exists()]
    standing = place.parents[len(above)]
    inside = place.is_dir() and not os.access(standing, os.W_OK)
    if not inside and not (standing.is_dir() and os.access(standing, os.W_OK)):
        raise PermissionError(f"{folder} cannot be made: {standing} is not a writable folder")
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        path = place / LOCK_INSIDE if inside else hidden_beside(place, "lock")
        handle = _acquired(path, folder)
        silence = threading.Event()

        def renew() -> None:
            """Renew the time of the lock file until the lock is given back."""
            while not silence.wait(_BEAT):
                with suppress(OSError):
                    os.utime(path)

        beat = threading.Thread(target=renew, daemon=True)
        beat.start()
        try:
            yield
        finally:
            silence.set()
            beat.join()
            # Removed while it is locked: who opens it meanwhile notices that it is gone. Windows
            # removes closed files only.
            if os.name == "nt":
                os.close(handle)
            with suppress(OSError):
                path.unlink()
            if os.name != "nt":
                os.close(handle)
    finally:
        for made in above:
            with suppress(OSError):
                made.rmdir()


def _acquired(path: Path, folder: str | os.PathLike[str]) -> int:
    """Return the handle of the lock file, locked and with the name of this process."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            seen = _flock(handle)
            if seen is False:
                raise _in_use(folder, _Holder.of(handle))
            try:
                there = path.stat()
            except FileNotFoundError:
                there = None
            if there is None or not os.path.samestat(there, os.fstat(handle)):
                # Its last holder has removed it meanwhile.
                os.close(handle)
                continue
            holder = _Holder.of(handle)
            if (seen is None or not holder.here) and holder.age(path) < _SILENT:
                raise _in_use(
                    folder, holder, unless=f", or {_SILENT:.0f} s if that process was stopped"
                )
            if seen is None:
                os.close(handle)
                path.unlink(missing_ok=True)
                handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
            record = {"pid": os.getpid(), "host": _host(), "system": _system()}
            os.ftruncate(handle, 0)
            os.lseek(handle, 0, os.SEEK_SET)
            os.write(handle, json.dumps(record | {"since": time.time()}).encode())
        except FileExistsError:
            continue
        except BaseException:
            os.close(handle)
            raise
        return handle


def _flock(handle: int) -> bool | None:
    """Lock an open file; False if another process has locked it, None without locks here."""
    try:
        import fcntl
    except ImportError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as fault:
        if fault.errno in _WITHOUT_LOCKS:
            return None
        if fault.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return False
        raise
    return True


@dataclass(frozen=True)
class _Holder:
    """What a lock file states about the process that holds the lock."""

    record: dict[str, Any]
    renewed: float

    @classmethod
    def of(cls, handle: int) -> _Holder:
        """Read an open lock file; nothing is known where it is empty or damaged."""
        try:
            os.lseek(handle, 0, os.SEEK_SET)
            record = json.loads(os.read(handle, 4096))
        except ValueError:
            record = {}
        return cls(record if isinstance(record, dict) else {}, os.fstat(handle).st_mtime)

    @property
    def here(self) -> bool:
        """Whether it is a process of this machine, whose locks are always seen."""
        return bool(self.record.get("system", _system()) == _system())

    def age(self, path: Path) -> float:
        """Return the time since the last sign of life, s, by the clock of the file server."""
        if not self.record:
            return float("inf")
        import tempfile

        with tempfile.TemporaryFile(dir=path.parent) as now:
            return os.fstat(now.fileno()).st_mtime - self.renewed


def _in_use(
    folder: str | os.PathLike[str], holder: _Holder, *, unless: str = ""
) -> FolderInUseError:
    """Return the error that names who holds a folder."""
    record = holder.record
    pid, host = record.get("pid"), record.get("host")
    since = record.get("since")
    who = "another process" if pid is None else f"process {pid} on {host}"
    when = ""
    if isinstance(since, int | float):
        when = time.strftime(", since %Y-%m-%d %H:%M:%S", time.localtime(since))
    return FolderInUseError(
        f"{os.fspath(folder)}: {who} is writing there{when}: wait until it ends{unless}, or choose "
        "another folder"
    )


def _host() -> str:
    """Return the name of this machine."""
    import platform

    return platform.node()


def _system() -> str:
    """Return what names the running operating system: equal in all its containers."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return _host()
