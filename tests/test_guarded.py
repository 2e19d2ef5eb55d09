"""A reader that crashes, loops or takes any memory costs a frame; stated sizes are checked."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.images.formats import isolation
from perrin.images.formats.directories import check_directories
from perrin.tracks.file_limits import allowed_memory

# A reader of .h5 files that does what the file says. The first word of the file is about its
# header, the others are about its frames.
READER = """
import os, signal
import numpy as np

class Frames:
    ndim, shape, dtype = 3, (4, 8, 9), np.dtype("u2")
    def __init__(self, words): self.words = words
    def __getitem__(self, t): return act(self.words[t]) or np.full((8, 9), t, "u2")

def act(word):
    if word == "crash": os.kill(os.getpid(), signal.SIGSEGV)
    if word == "loop":
        while True: pass
    if word == "grow": return np.ones(2**33, "u1")
    if word == "print": print("noise")
    if word == "fail": raise KeyError("chunk 7")

class File(dict):
    def __init__(self, path, mode):
        head, *words = open(path).read().split()
        act(head)
        self["m"] = Frames(words)
    def visititems(self, see): see("m", self["m"])
    def close(self): pass
"""
GIVEN = {"planes": 1, "voxel": (0.2, 0.2), "dt": 0.5}


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """Put the reader in the place of h5py, read files apart, and give a maker of files."""
    (tmp_path / "h5py.py").write_text(READER)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PERRIN_GUARD", "on")

    def file(words):
        path = tmp_path / "movie.h5"
        path.write_text(words)
        return path

    return file


def test_a_frame_that_breaks_its_reader_is_lost_alone(reader, monkeypatch):
    """Crash, memory and an error of any class; the frames after it are read."""
    with perrin.open_stack(reader("print crash grow fail print"), **GIVEN) as stack:
        for i, message in enumerate(
            [r"its reader crashed \(signal 11\)", "takes more memory than its length", "chunk 7"]
        ):
            with pytest.raises(perrin.FrameError, match=message):
                stack.frame(i)
        np.testing.assert_array_equal(stack.frame(3), np.full((1, 8, 9), 3))
        assert stack.shape == (4, 1, 8, 9)


def test_a_loop_ends_after_its_processor_time(reader, monkeypatch):
    """Not after a time of the clock: a disk that is slow is no loop."""
    module = "perrin.images.formats.isolation"
    start = (
        f"import sys; sys.path[:0] = {{path!r}}; import {module} as g; g._SECONDS = 0; g.serve()"
    )
    monkeypatch.setattr(isolation, "_START", start)
    with (
        perrin.open_stack(reader("ok ok loop ok ok"), **GIVEN) as stack,
        pytest.raises(perrin.FrameError, match="did not end within 60 s of processor time"),
    ):
        stack.frame(1)


@pytest.mark.parametrize("word", ["crash", "fail"])
def test_a_header_that_breaks_its_reader_is_refused(reader, word):
    """In one line that names the file and what to do."""
    with pytest.raises(
        ValueError, match=r"movie.h5: HDF5: (its reader crashed|cannot be read \(Key)"
    ):
        perrin.open_stack(reader(f"{word} ok ok ok ok"), **GIVEN)


def test_a_reader_that_is_not_installed_is_named(tmp_path, monkeypatch):
    """As without a process of its own."""
    monkeypatch.setenv("PERRIN_GUARD", "on")
    (tmp_path / "a.lif").write_bytes(b"")
    (tmp_path / "liffile.py").write_text("raise ImportError('no')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=r"a.lif: .*pip install 'perrin\[lif\]'"):
        perrin.open_stack(tmp_path / "a.lif")


# ---- TIFF ----------------------------------------------------------------------------------------


def directory(tags, following=0):
    """Return an image directory of a little-endian TIFF file."""
    body = b"".join(struct.pack("<HHII", code, 4, 1, value) for code, value in sorted(tags.items()))
    return struct.pack("<H", len(tags)) + body + struct.pack("<I", following)


def tiff_file(path, *directories):
    """Write directories one after another; each is (tags, number of the next or None)."""
    sizes = [2 + 12 * len(tags) + 4 for tags, _ in directories]
    starts = [8 + sum(sizes[:k]) for k in range(len(sizes))]
    data = b"II*\0" + struct.pack("<I", 8)
    for tags, following in directories:
        data += directory(tags, starts[following] if following is not None else 0)
    path.write_bytes(data + bytes(200))
    return path


SMALL = {256: 4, 257: 4, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 279: 16}


def test_directories_that_loop_are_refused(tmp_path):
    """A chain that returns to an earlier image has no end."""
    pytest.importorskip("tifffile")
    for loop in ([0], [1, 0], [1, 2, 1]):
        path = tiff_file(tmp_path / "a.tif", *((SMALL, following) for following in loop))
        with pytest.raises(
            ValueError, match=r"a\.tif: .*its chain of images returns to an earlier"
        ):
            perrin.open_stack(path, voxel=(1, 1, 1), dt=1)


@pytest.mark.parametrize(
    ("tags", "message"),
    [
        ({256: 2**31, 257: 2**20}, r"an image of 1048576 x 2147483648 x 1 \(2\.?\d* PiB|TiB"),
        ({322: 2**16, 323: 2**16}, r"an image of 65536 x 65536 x 1 \(4 GiB\) is larger than"),
        ({277: 2**30}, "is larger than the file's length warrants"),
    ],
)
def test_sizes_that_the_length_does_not_warrant_are_refused(tmp_path, monkeypatch, tags, message):
    """The limit can be raised; it never refuses what the file holds uncompressed."""
    path = tiff_file(tmp_path / "a.tif", (SMALL | tags, None))
    with pytest.raises(ValueError, match=message):
        check_directories(str(path))
    monkeypatch.setenv("PERRIN_MEMORY", "9000T")
    check_directories(str(path))
    monkeypatch.setenv("PERRIN_MEMORY", "much")
    with pytest.raises(ValueError, match="PERRIN_MEMORY: expected a size as 8G, got 'much'"):
        check_directories(str(path))


def test_a_tag_longer_than_the_file_is_refused(tmp_path):
    """A count of values for which there is no place."""
    path = tmp_path / "a.tif"
    path.write_bytes(b"II*\0" + struct.pack("<IHHHIII", 8, 1, 273, 4, 2**30, 8, 0))
    with pytest.raises(
        ValueError, match="its tag 273 of 1073741824 values is longer than the file"
    ):
        check_directories(str(path))


def test_whole_and_cut_files_pass(tmp_path):
    """Classic, big and of either order of bytes; what a cut file still holds is for its reader."""
    tifffile = pytest.importorskip("tifffile")
    movie = np.zeros((3, 5, 12, 16), np.uint16)
    kinds = ({}, {"bigtiff": True}, {"byteorder": ">"}, {"compression": "zlib"})
    for k, kind in enumerate(kinds):
        path = tmp_path / f"{k}.tif"
        tifffile.imwrite(path, movie, metadata={"axes": "TZYX"}, **kind)
        check_directories(str(path))
        data = path.read_bytes()
        for n in (4, 9, len(data) // 2, len(data) - 1):
            path.write_bytes(data[:n])
            check_directories(str(path))


# ---- tables --------------------------------------------------------------------------------------


def test_packed_tables_larger_than_they_warrant_are_refused(tmp_path, monkeypatch):
    """Zip, gzip and Parquet: a small file cannot take all memory."""
    pytest.importorskip("python_calamine")
    monkeypatch.setattr("perrin.tracks.file_limits._ALWAYS", 2**20)
    (tmp_path / "t.csv.gz").write_bytes(gzip.compress(b"frame,particle,x,y\n" + b"0" * 2**22))
    column = pd.DataFrame({"frame": np.zeros(10**6, int), "particle": 0, "x": 0.0, "y": 0.0})
    column.to_parquet(tmp_path / "t.parquet")
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", b"0" * 2**22)
    (tmp_path / "t.xlsx").write_bytes(buffer.getvalue())
    for name in ("t.csv.gz", "t.parquet", "t.xlsx"):
        with pytest.raises(perrin.TrackTableError, match=r"larger than the file's length warrants"):
            perrin.read_tracks(tmp_path / name)
    monkeypatch.setenv("PERRIN_MEMORY", "1 GiB")
    with pytest.raises(perrin.TrackTableError, match=r"csv.gz: (?!.*warrants)"):
        perrin.read_tracks(tmp_path / "t.csv.gz")


def test_the_limit_grows_with_the_file():
    """A file may take 32 times its length, and 256 MiB always."""
    assert allowed_memory(0) == 2**28
    assert allowed_memory(2**30) == 2**28 + 2**35


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("t.xyz", b"9" * 5000 + b"\n\n"),
        ("t.csv", b'frame,particle,x,y\n0,1,"2,3'),
        ("t.parquet", b"PAR1" + bytes(20) + b"PAR1"),
        (
            "t.xml",
            b"<TrackMate><Model><Spot ID='1' FRAME='x'/><Track TRACK_ID='q'/></Model></TrackMate>",
        ),
    ],
)
def test_foreign_errors_name_the_file(tmp_path, name, content):
    """The decoders' errors are of any class; a user sees one line with the file."""
    (tmp_path / name).write_bytes(content)
    with pytest.raises(perrin.TrackTableError, match=rf"{name}: "):
        perrin.read_tracks(tmp_path / name)
