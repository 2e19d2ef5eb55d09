"""Readers of formats in a process of their own: a file that breaks one costs a frame, not the run.

The decoders of damaged files may crash, loop or ask for any amount of memory. Each file has a
process, whose memory and whose processor time for one image are limited. The processes exchange
lines of JSON and the bytes of images; nothing is unpickled.
"""

from __future__ import annotations

import json
import os
import sys
import time
import weakref
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from perrin.images.formats.contents import Contents, Pick
from perrin.tracks.file_limits import LIMIT, allowed_memory, length_of

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Callable

SWITCH = "PERRIN_GUARD"  # environment variable; "off" reads files in the same process

# Processor time, s, for the header of a file or one image: both take under a second.
_SECONDS = 60

# Memory of the libraries themselves, and of the stacks of their threads, bytes.
_BYTES_OF_LIBRARIES = 2**29

_START = """
import sys
sys.path[:0] = {path!r}
from perrin.images.formats.isolation import serve
serve()
"""

_ERRORS: dict[str, type[Exception]] = {
    error.__name__: error
    for error in (ValueError, ImportError, FileNotFoundError, PermissionError, IsADirectoryError)
}


def guarded(path: str, pick: Pick) -> Contents:
    """Describe a file of a vendor's format, read by another process.

    Parameters
    ----------
    path : str
    pick : Pick
        The user's choices.

    Returns
    -------
    Contents

    Raises
    ------
    ValueError
        If the file cannot be read, or its reader crashes, takes too long or too much memory.
    ImportError
        If the reader of the format is not installed.
    """
    reader = _Reader(path, pick)
    try:
        about, _ = reader.ask({})
        shape = tuple(int(n) for n in about["shape"])
        dtype = np.dtype(about["dtype"])
    except BaseException:
        reader.close()
        raise

    def plane(t: int, z: int) -> NDArray[Any]:
        image, data = reader.ask({"plane": [int(t), int(z)]})
        return np.frombuffer(data, dtype=np.dtype(image["dtype"])).reshape(image["shape"])

    times = about["times"]
    return Contents(
        shape=(shape[0], shape[1], shape[2], shape[3]),
        dtype=dtype,
        plane=plane,
        close=reader.close,
        voxel=np.array(about["voxel"], dtype=np.float64),
        times=None if times is None else np.array(times, dtype=np.float64),
        plane_time=about["plane_time"],
        notes=tuple(about["notes"]),
        without_times=about["without_times"],
    )


class _Reader:
    """A process that reads one file; started again after it has ended."""

    def __init__(self, path: str, pick: Pick) -> None:
        # Addresses in object stores are not paths.
        where = path if "://" in path else os.path.abspath(path)
        self._request = {"path": where, "pick": pick._asdict()}
        self._end: Callable[[], object] | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def ask(self, question: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
        """Return an answer and its bytes.

        Raises
        ------
        ValueError, ImportError, OSError
            The error of the reader, or how it ended.
        """
        if self._process is None:
            self._start()
            if question:
                self._exchange(self._request)
        return self._exchange(question or self._request)

    def _exchange(self, question: dict[str, Any]) -> tuple[dict[str, Any], bytes]:
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(question).encode() + b"\n")
            process.stdin.flush()
            answer = json.loads(process.stdout.readline())
            data = process.stdout.read(answer["length"]) if answer.get("length") else b""
        except (OSError, ValueError):
            import signal

            self._process, status = None, process.wait()
            self.close()
            ending = f"its reader stopped (status {status})"
            if status == -getattr(signal, "SIGXCPU", 0):
                ending = f"its reader did not end within {_SECONDS} s of processor time"
            elif status < 0:
                ending = f"its reader crashed (signal {-status})"
            raise ValueError(ending) from None
        if "error" in answer:
            raise _ERRORS.get(answer["error"], ValueError)(answer["message"])
        return answer, data

    def _start(self) -> None:
        import subprocess

        process = subprocess.Popen(
            # Not with the working directory on its path, whose files could take a library's name.
            [sys.executable, "-P", "-c", _START.format(path=[p for p in sys.path if p])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"OMP_NUM_THREADS": "1", SWITCH: "off"},
            # An interruption from the keyboard is for the process that asks.
            start_new_session=True,
        )
        self._process = process
        self._end = weakref.finalize(self, _ended, process)

    def close(self) -> None:
        """End the process."""
        self._process = None
        if self._end is not None:
            self._end()


def _ended(process: subprocess.Popen[bytes]) -> None:
    """End a reader and close its pipes."""
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            try:
                pipe.close()
            except OSError:
                continue


def serve() -> None:
    """Answer the questions about one file: read lines of JSON, write lines of JSON and bytes."""
    out = os.fdopen(os.dup(1), "wb")
    # What libraries print must not be among the answers.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    contents: Contents | None = None
    from perrin.images.formats.vendors import WAY_OUT, vendor

    for line in sys.stdin.buffer:
        question = json.loads(line)
        data = b""
        try:
            _limit("RLIMIT_CPU", int(time.process_time()) + 1 + _SECONDS)
            _limit("RLIMIT_CORE", 0)
            if "path" in question:
                path = question["path"]
                found = vendor(path)
                if found is None:
                    raise ValueError("is of no format that is read")
                # Mapped files do not count.
                _limit("RLIMIT_DATA", allowed_memory(length_of(path)) + _BYTES_OF_LIBRARIES)
                contents = found.read(path, Pick(**question["pick"]))
                times, interval = contents.times, contents.plane_time
                answer = {
                    "shape": [int(n) for n in contents.shape],
                    "dtype": np.dtype(contents.dtype).str,
                    "voxel": [float(length) for length in contents.voxel],
                    "times": None if times is None else np.asarray(times, np.float64).tolist(),
                    "plane_time": None if interval is None else float(interval),
                    "notes": list(contents.notes),
                    "without_times": contents.without_times,
                }
            else:
                assert contents is not None
                image = np.ascontiguousarray(contents.plane(*question["plane"]))
                data = image.tobytes()
                answer = {"dtype": image.dtype.str, "shape": image.shape, "length": len(data)}
        except MemoryError:
            text = f"takes more memory than its length warrants: it is damaged, or raise {LIMIT}"
            answer = {"error": "ValueError", "message": text}
        # The decoders of damaged files raise errors of any class.
        except Exception as fault:
            name, text = type(fault).__name__, str(fault)
            kind = next((known for known in _ERRORS if isinstance(fault, _ERRORS[known])), "")
            # That of a decoder is reported with its class, and what to do.
            if type(fault) is not ValueError and kind in ("", "ValueError"):
                advice = "" if "plane" in question else f": {WAY_OUT}"
                kind, text = "ValueError", f"cannot be read ({name}: {text[:500]}){advice}"
            answer = {"error": kind, "message": text}
        out.write(json.dumps(answer).encode() + b"\n" + data)
        out.flush()


def _limit(name: str, amount: int) -> None:
    """Limit what this process may use of a resource; without such limits it may use any amount."""
    try:
        import resource
    except ImportError:
        return
    kind = getattr(resource, name)
    _, hard = resource.getrlimit(kind)
    soft = amount if hard == resource.RLIM_INFINITY else min(amount, hard)
    resource.setrlimit(kind, (soft, hard))
