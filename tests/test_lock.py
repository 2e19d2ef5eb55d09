"""One process at a time writes into a folder, and a crash leaves no lock behind."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import perrin
from perrin.run import lock
from perrin.run.folders import claimed_folder, staged_folder
from perrin.run.lock import locked

HOLD = """
import sys, time
from perrin.run.lock import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Hold the folder "run" in another process; give that process."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path / "run"], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_process_is_refused_and_a_killed_one_holds_nothing(tmp_path, holder):
    """One line names process, machine and time; after kill -9 the folder is free at once."""
    folder = tmp_path / "run"
    link = tmp_path / "link"
    link.symlink_to(folder, target_is_directory=True)
    for path in (folder, link, tmp_path / "." / "run"):
        with (
            pytest.raises(perrin.FolderInUseError, match="is writing there") as refused,
            locked(path),
        ):
            pass
        text = str(refused.value)
        assert "\n" not in text
        assert f"process {holder.pid} on {os.uname().nodename} is writing there, since 20" in text
    with pytest.raises(perrin.FolderInUseError), staged_folder(folder):
        pass
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with locked(folder) as first:
        assert first
    assert [p.name for p in tmp_path.iterdir()] == ["link"]


def test_a_lock_is_given_back_and_leaves_no_trace(tmp_path):
    """Also after an exception, and with the folders that were made for it alone."""

    def fail():
        with locked(tmp_path / "a" / "b" / "run"):
            assert (tmp_path / "a" / "b" / ".run.lock").is_file()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list(tmp_path.iterdir()) == []
    with locked(tmp_path / "a" / "run"):
        (tmp_path / "a" / "run").mkdir()
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["run"]


def test_another_thread_of_the_same_process_is_refused(tmp_path):
    """The same thread may take the lock again, and gives it back at the outermost end only."""
    refused = []

    def other():
        with (
            pytest.raises(perrin.FolderInUseError, match="another thread"),
            locked(tmp_path / "run"),
        ):
            pass
        refused.append(True)

    with locked(tmp_path / "run") as first, locked(tmp_path / "run") as second:
        assert (first, second) == (True, False)
    with locked(tmp_path / "run"):
        with locked(tmp_path / "run"):
            pass
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert refused


@pytest.mark.parametrize("locks", [True, False])
def test_locks_that_other_machines_do_not_see(tmp_path, monkeypatch, locks):
    """A lock file of another machine counts while it is renewed; a silent one does not."""
    if not locks:

        def without(*_):
            raise OSError(errno.ENOLCK, "No locks available")

        monkeypatch.setattr("fcntl.flock", without)
    record = {"pid": 7, "host": "node9", "system": "another", "since": time.time() - 3600}
    path = tmp_path / ".run.lock"
    path.write_text(json.dumps(record))
    message = r"process 7 on node9 is writing there, since .*, or 120 s if that process was"
    with pytest.raises(perrin.FolderInUseError, match=message), locked(tmp_path / "run"):
        pass
    assert json.loads(path.read_text()) == record
    long_ago = time.time() - 130
    os.utime(path, (long_ago, long_ago))
    with locked(tmp_path / "run"):
        assert json.loads(path.read_text())["pid"] == os.getpid()
        if not locks:
            lock._HELD.clear()  # as another process sees it
            with pytest.raises(perrin.FolderInUseError), locked(tmp_path / "run"):
                pass
            lock._HELD[os.path.realpath(tmp_path / "run")] = (threading.get_ident(), 1)
    assert list(tmp_path.iterdir()) == []


def test_a_long_run_shows_that_it_lives(tmp_path, monkeypatch):
    """The time of the lock file is renewed while the lock is held."""
    monkeypatch.setattr(lock, "_BEAT", 0.01)
    path = tmp_path / ".run.lock"
    with locked(tmp_path / "run"):
        os.utime(path, (0, 0))
        deadline = time.monotonic() + 5
        while path.stat().st_mtime == 0 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert path.stat().st_mtime > 0


def test_a_damaged_lock_file_and_names_of_any_length(tmp_path):
    """What a file left by a crash holds does not matter; long names have lock files too."""
    for content in (b"", b"\xff{", b"[1]", b"{}"):
        (tmp_path / ".run.lock").write_bytes(content)
        with locked(tmp_path / "run"):
            pass
    for name in ("n" * 250, "a\nb", "'; \"", os.fsdecode(b"\xff\xfe")):
        with staged_folder(tmp_path / name) as stage:
            (stage / "run.json").write_text("{}")
        assert [p.name for p in tmp_path.iterdir()] == [name]
        (tmp_path / name / "run.json").unlink()
        (tmp_path / name).rmdir()


def test_a_finished_run_survives_a_stop_while_it_is_replaced(tmp_path):
    """Stopped between the two renamings, the old run is back at the next start."""
    old = tmp_path / ".run.77.part.old"
    old.mkdir()
    (old / "run.json").write_text("old")
    (tmp_path / ".run.77.part").mkdir()
    (tmp_path / ".running.5.part").mkdir()  # of another folder
    with claimed_folder(tmp_path / "run") as place:
        assert (place / "run.json").read_text() == "old"
        assert sorted(p.name for p in tmp_path.iterdir()) == [
            ".run.lock", ".running.5.part", "run",
        ]  # fmt: skip


def test_a_folder_in_a_place_that_cannot_be_written(tmp_path, monkeypatch):
    """The lock file is then in the folder itself, and does not count as its content."""
    from perrin.run.folders import check_resumable

    (tmp_path / "run").mkdir()
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path and access(path, mode))
    with locked(tmp_path / "run"):
        assert [p.name for p in tmp_path.rglob("*")] == ["run", ".lock"]
        check_resumable(tmp_path / "run", parts="located")
    with pytest.raises(PermissionError, match="is not a writable folder"), locked(tmp_path / "new"):
        pass
    assert [Path(p).name for p in tmp_path.rglob("*")] == ["run"]
