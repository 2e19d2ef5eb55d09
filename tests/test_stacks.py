"""Stacks of every format are read as they were written, and their faults are reported."""

from __future__ import annotations

import json
import pickle
import sys
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

import perrin
from perrin import FrameError, PrecisionWarning, open_stack, write_stack

tifffile = pytest.importorskip("tifffile")

VOXEL, DT = (0.25, 0.2, 0.1), 0.73
GIVEN = {"voxel": VOXEL, "dt": DT}


@pytest.fixture
def movie():
    return np.random.default_rng(1).integers(0, 60000, (5, 4, 12, 16), dtype=np.uint16)


def assert_same(stack, movie, voxel=VOXEL, dt=DT):
    """Compare voxels bit by bit, sizes and times."""
    assert stack.shape == movie.shape
    assert stack.dtype == movie.dtype
    for i in range(len(movie)):
        np.testing.assert_array_equal(stack.frame(i), movie[i])
    np.testing.assert_allclose(stack.voxel, voxel, rtol=1e-6)  # rational tags, float32 headers
    np.testing.assert_allclose(stack.times, np.arange(len(movie)) * dt, rtol=1e-6)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32"])
def test_written_stack_reads_back_exactly(tmp_path, movie, dtype):
    """Voxels, voxel size and uneven times come back to the last bit."""
    source = open_stack(
        movie.astype(dtype), voxel=(0.1 + 0.2, 1 / 3, 0.1), dt=1 / 7, plane_time=0.01
    )
    uneven = source.times + np.array([0, 1, 0, 2, 0]) * 0.0123456789
    stack = perrin.Stack(source.shape, source.dtype, source.voxel, uneven, 0.01, "x", source.read)
    write_stack(stack, tmp_path / "movie.ome.tif")
    assert [f.name for f in tmp_path.iterdir()] == ["movie.ome.tif"]
    with open_stack(tmp_path / "movie.ome.tif") as again:
        np.testing.assert_array_equal(again.voxel, stack.voxel)
        np.testing.assert_array_equal(again.times, stack.times)
        assert again.plane_time == pytest.approx(0.01, rel=1e-12)  # a difference of two times
        for a, b in zip(again, stack, strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype


@pytest.mark.parametrize("shape", [(1, 4, 12, 16), (5, 1, 12, 16), (1, 1, 12, 16), (2, 3, 1, 16)])
def test_thin_stacks_read_back(tmp_path, shape):
    """A single stack, a 2-D movie, a single image, a line: the shape is kept."""
    movie = np.arange(np.prod(shape), dtype=np.uint16).reshape(shape)
    voxel = (np.nan if shape[1] == 1 else VOXEL[0], *VOXEL[1:])
    stack = open_stack(movie, voxel=VOXEL[1:] if shape[1] == 1 else VOXEL, dt=DT)
    write_stack(stack, tmp_path / "a.ome.tif")
    with open_stack(tmp_path / "a.ome.tif") as again:
        assert_same(again, movie, voxel=voxel)


def test_types_that_ome_does_not_have_are_refused(tmp_path, movie):
    with pytest.raises(ValueError, match="OME-TIFF has no bool"):
        write_stack(open_stack(movie > 5, **GIVEN), tmp_path / "a.ome.tif")
    with pytest.raises(ValueError, match=r"written as \.ome\.tif"):
        write_stack(open_stack(movie, **GIVEN), tmp_path / "a.tif")


def test_a_bad_frame_leaves_no_file(tmp_path, movie):
    """A stack that cannot be read to its end is not written, and nothing is left."""

    def read(i):
        if i == 3:
            raise OSError("bad sector")
        return movie[i]

    stack = perrin.Stack(movie.shape, movie.dtype, np.array(VOXEL), np.arange(5.0), None, "x", read)
    with pytest.raises(FrameError, match="frame 3 of 5 cannot be read: bad sector"):
        write_stack(stack, tmp_path / "movie.ome.tif")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("axes", ["TZYX", "ZTYX"])
def test_ome_axes_units_and_interval(tmp_path, movie, axes):
    """An OME file states which axis is time; units are converted."""
    header = {"axes": axes, "TimeIncrement": DT * 1e3, "TimeIncrementUnit": "ms"}
    for axis, length in zip("ZYX", VOXEL, strict=True):
        header |= {f"PhysicalSize{axis}": length * 1e3, f"PhysicalSize{axis}Unit": "nm"}
    data = movie if axes == "TZYX" else movie.swapaxes(0, 1)
    tifffile.imwrite(tmp_path / "a.ome.tif", data, ome=True, metadata=header, compression="zlib")
    with open_stack(tmp_path / "a.ome.tif") as stack:
        assert_same(stack, movie)
        assert stack.plane_time is None


@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_imagej_hyperstack(tmp_path, movie, byteorder):
    """An ImageJ file has its spacing in a header and its pixel size in the resolution tags."""
    tifffile.imwrite(
        tmp_path / "a.tif",
        movie,
        imagej=True,
        byteorder=byteorder,
        resolution=(1 / VOXEL[2], 1 / VOXEL[1]),
        metadata={"axes": "TZYX", "spacing": VOXEL[0], "unit": "micron", "finterval": DT},
    )
    with open_stack(tmp_path / "a.tif") as stack:
        assert_same(stack, movie)


def test_a_channel_must_be_chosen(tmp_path, movie):
    """Several channels are refused unless one is named."""
    both = np.stack([movie, movie[::-1]], axis=2)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, both, imagej=True, metadata={"axes": "TZCYX"})
    with pytest.raises(ValueError, match="2 channels: pass channel=0 to 1"):
        open_stack(path, **GIVEN)
    with pytest.raises(ValueError, match="no channel 2"):
        open_stack(path, channel=2, **GIVEN)
    for channel, wanted in ((0, movie), (1, movie[::-1])):
        with open_stack(path, channel=channel, **GIVEN) as stack:
            assert_same(stack, wanted)


def test_a_plain_tiff_states_nothing_and_nothing_is_guessed(tmp_path, movie):
    """Pages may be times or planes; sizes and times are requested in one message."""
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as file:
        for page in movie.reshape(-1, 12, 16):
            file.write(page, contiguous=False, metadata=None)
    with pytest.raises(ValueError, match="20 images are times or planes: pass planes=1"):
        open_stack(path, **GIVEN)
    with pytest.raises(ValueError, match="do not make whole frames of planes=3"):
        open_stack(path, planes=3, **GIVEN)
    with pytest.raises(ValueError, match=r"along z, y, x: pass voxel=.*; no times.*pass dt="):
        open_stack(path, planes=4)
    with open_stack(path, planes=4, **GIVEN) as stack:
        assert_same(stack, movie)
    with open_stack(path, voxel=(0.2, 0.1), dt=DT) as stack:  # (y, x): a 2-D movie
        assert_same(stack, movie.reshape(20, 1, 12, 16), voxel=(np.nan, 0.2, 0.1))
    with open_stack(path, planes=20, voxel=VOXEL) as stack:  # one stack needs no dt
        assert_same(stack, movie.reshape(1, 20, 12, 16))


UNNAMED = {
    "(t, z)": ((5, 6), {}, "(t, z, y, x)"),
    "(t, 1)": ((5, 1), {}, "(t, z, y, x)"),
    "(1, z)": ((1, 5), {}, "(t, z, y, x)"),
    "(t, c, z)": ((2, 3, 5), {"planes": 5, "channel": 1}, "(t, c, z, y, x)"),
    "(t, z, c)": ((2, 5, 3), {"planes": 5, "channel": 1}, "(t, z, c, y, x)"),
    "(t, 1, z)": ((2, 1, 5), {"planes": 5}, "(t, 1, z, y, x)"),
    "colours": ((5, 4), {"planes": 4}, "(t, z, y, x)"),
}


def as_colours(wanted):
    """Return how `imwrite` stores three or four images by default today, and how it is to be."""
    if not wanted:
        return {"photometric": "minisblack"}
    return {"photometric": "rgb", "planarconfig": "separate"}


@pytest.mark.parametrize("written", [{}, {"compression": "zlib"}, {"byteorder": ">"}])
@pytest.mark.parametrize("name", UNNAMED)
def test_axes_without_names_keep_every_image_in_its_place(tmp_path, name, written):
    """An array in imwrite gets axes QQYX, or imwrite takes the last four images for colours."""
    sizes, chosen, read = UNNAMED[name]
    data = np.random.default_rng(1).integers(0, 4000, (*sizes, 12, 16), dtype=np.uint16)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, data, **written, **as_colours(name == "colours"))
    wanted = data if "channel" not in chosen else data.take(1, axis=read.split(", ").index("c"))
    if name == "(t, 1, z)":
        wanted = data[:, 0]
    with open_stack(path, voxel=VOXEL, dt=DT, **chosen) as stack:
        assert_same(stack, wanted)
        assert stack.notes == (
            f"the file does not name the axes of its shape {data.shape}: read as {read}",
        )


@pytest.mark.parametrize(
    ("shape", "axes", "asked", "message"),
    [
        (
            (5, 12, 16),
            None,
            {},
            "does not state whether its 5 images are times or planes: pass plan",
        ),
        ((5, 4, 12, 16), None, {}, "4 images along axis 1 tifffile took for colours: pass planes"),
        ((2, 3, 5, 12, 16), None, {}, "does not state what its axes of 2, 3, 5 images are: pass"),
        ((2, 3, 5, 12, 16), None, {"planes": 5}, "does not state what its axes of 2, 3, 5 images"),
        ((2, 5, 5, 12, 16), None, {"planes": 5, "channel": 1}, "does not state what its axes of 2"),
        ((2, 1, 5, 12, 16), None, {}, "does not state what its axes of 2, 5 images are"),
        ((2, 5, 12, 16), None, {"planes": 1}, "has 5 planes a frame, not planes=1"),
        ((2, 5, 12, 16), "TQYX", {}, "does not state what its axes of 5 images are"),
        ((2, 5, 12, 16), "TTYX", {}, "has axes TTYX, several of one name"),
    ],
)
def test_undecided_axes_are_refused(tmp_path, shape, axes, asked, message):
    path = tmp_path / "a.tif"
    named = {} if axes is None else {"metadata": {"axes": axes}}
    colours = as_colours("colours" in message)
    tifffile.imwrite(path, np.zeros(shape, dtype=np.uint16), **named, **colours)
    with pytest.raises(ValueError, match=message):
        open_stack(path, voxel=VOXEL, dt=DT, **asked)


@pytest.mark.parametrize(("axes", "order"), [("TZYX", (0, 1)), ("ZTYX", (1, 0)), ("TQYX", (0, 1))])
def test_named_axes_are_kept(tmp_path, movie, axes, order):
    data, named = movie.transpose(*order, 2, 3), {"metadata": {"axes": axes}}
    tifffile.imwrite(tmp_path / "a.tif", data, **named, **as_colours(axes == "TZYX"))
    with open_stack(tmp_path / "a.tif", planes=4, **GIVEN) as stack:
        assert_same(stack, movie)


@pytest.mark.parametrize("as_glob", [False, True])
def test_sequence_of_files(tmp_path, movie, as_glob):
    """A file per frame, or a file per plane, in the order of the numbers: 9 before 10."""
    movie = np.concatenate([movie, movie + 1, movie + 2])  # 15 files
    for i, frame in enumerate(movie):
        tifffile.imwrite(tmp_path / f"t{i}.tif", frame, photometric="minisblack")
    (tmp_path / "._t0.tif").write_bytes(b"an operating system's own")
    (tmp_path / "notes.txt").write_text("no image")
    path = f"{tmp_path}/t*.tif" if as_glob else tmp_path
    with open_stack(path, **GIVEN) as stack:
        assert_same(stack, movie)
    with pytest.raises(ValueError, match="files of 4 images each, not planes=5"):
        open_stack(path, planes=5, **GIVEN)
    (tmp_path / "planes").mkdir()
    for i, plane in enumerate(movie.reshape(-1, 12, 16)):
        tifffile.imwrite(tmp_path / "planes" / f"p{i}.tif", plane)
    with open_stack(tmp_path / "planes", planes=4, **GIVEN) as stack:
        assert_same(stack, movie)
    tifffile.imwrite(tmp_path / "t3.tif", movie[0, :2], photometric="minisblack")
    with open_stack(path, **GIVEN) as stack:
        np.testing.assert_array_equal(stack.frame(4), movie[4])
        with pytest.raises(FrameError, match=r"frame 3 .*t3.tif is \(2, 12, 16\)"):
            stack.frame(3)


def test_given_values_replace_those_of_the_file_with_a_warning(tmp_path, movie):
    """The user's voxel size and interval are used; a warning states the difference."""
    write_stack(open_stack(movie, **GIVEN), tmp_path / "a.ome.tif")
    with pytest.warns(PrecisionWarning, match=r"voxel z 0.3 \(in the file 0.25\); dt 0.7 \(in"):
        stack = open_stack(tmp_path / "a.ome.tif", voxel=(0.3, 0.2, 0.1), dt=0.7)
    with stack:
        assert_same(stack, movie, voxel=(0.3, 0.2, 0.1), dt=0.7)
    with open_stack(tmp_path / "a.ome.tif", **GIVEN) as stack:  # the same values: no warning
        assert_same(stack, movie)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"voxel": (0, 0.2, 0.2), "dt": 1}, "expected lengths > 0"),
        ({"voxel": (0.2, 0.2), "dt": 1}, "has no frames of planes=1"),
        ({"voxel": 0.2, "dt": 1}, r"voxel: expected \(z, y, x\)"),
        ({"voxel": VOXEL, "dt": -1}, r"dt: expected a finite number > 0 \(s\), got -1"),
        ({"voxel": VOXEL, "dt": 1, "plane_time": np.nan}, "plane_time: expected"),
        ({}, "pass voxel=.*pass dt="),
    ],
)
def test_bad_values_are_refused(movie, given, message):
    with pytest.raises(ValueError, match=message):
        open_stack(movie, **given)


def test_arrays(movie):
    """Arrays (t, z, y, x), (z, y, x) and, with a voxel (y, x), (t, y, x)."""
    assert_same(open_stack(movie, **GIVEN), movie)
    assert_same(open_stack(movie[0], voxel=VOXEL), movie[:1])
    flat = open_stack(movie[:, 0], voxel=VOXEL[1:], dt=DT)
    assert_same(flat, movie[:, :1], voxel=(np.nan, *VOXEL[1:]))
    assert "shape=(5, 4, 12, 16)" in repr(open_stack(movie, **GIVEN))
    with pytest.raises(IndexError, match="no frame 5: it has 5"):
        flat.frame(5)


def test_an_imagej_file_cut_short_keeps_its_good_frames(tmp_path, movie):
    """The header states the number of frames; the lost ones are FrameErrors."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, movie, imagej=True, metadata={"axes": "TZYX"})
    path.write_bytes(path.read_bytes()[: 1000 + 3 * movie[0].nbytes])
    with open_stack(path, **GIVEN) as stack:
        assert stack.shape == movie.shape
        for i in range(3):
            np.testing.assert_array_equal(stack.frame(i), movie[i])
        for i in (3, 4):
            with pytest.raises(FrameError, match=f"frame {i} of 5 cannot be read: the file ends"):
                stack.frame(i)


def test_pages_cut_short_keep_their_good_frames(tmp_path, movie):
    """If a file does not state its number of frames, the one in which it ends is the last."""
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as file:
        for page in movie.reshape(-1, 12, 16):
            file.write(page, contiguous=False, metadata=None)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 11 // 20])
    with open_stack(path, planes=4, **GIVEN) as stack:
        assert len(stack) == 3
        np.testing.assert_array_equal(stack.frame(1), movie[1])
        with pytest.raises(FrameError, match="frame 2 of 3 cannot be read: ") as caught:
            stack.frame(2)
    assert caught.value.frame == 2


def test_an_ome_chain_cut_short_keeps_its_good_frames(tmp_path, movie):
    """The OME header counts: images missing from the chain are FrameErrors."""
    path = tmp_path / "a.ome.tif"
    tifffile.imwrite(path, movie, ome=True, metadata={"axes": "TZYX"}, compression="zlib")
    with tifffile.TiffFile(path) as file:
        page = file.pages[10]
        link = page.offset + 2 + 12 * len(page.tags)
    data = bytearray(path.read_bytes())
    data[link : link + 4] = bytes(4)
    path.write_bytes(data)
    with open_stack(path, **GIVEN) as stack:
        assert stack.shape == movie.shape
        np.testing.assert_array_equal(stack.frame(1), movie[1])
        with pytest.raises(FrameError, match="frame 2 of 5 cannot be read: image 11 is not in"):
            stack.frame(2)


def test_an_ome_file_without_its_header_is_refused(tmp_path, movie):
    """If the header is at the end, as tifffile writes it, half the file is not a stack."""
    path = tmp_path / "a.ome.tif"
    tifffile.imwrite(path, movie, ome=True, metadata={"axes": "TZYX"})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    for planes in (None, 4):
        with pytest.raises(ValueError, match="cut short"):
            open_stack(path, planes=planes, **GIVEN)


@pytest.mark.parametrize("share", [0.35, 0.48, 0.65, 0.8, 0.95])
def test_a_written_stack_that_is_cut_short_keeps_its_good_frames(tmp_path, movie, share):
    """The OME header comes first, and each image follows its own header."""
    path = tmp_path / "a.ome.tif"
    write_stack(open_stack(movie, **GIVEN), path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with open_stack(path) as stack:
        assert stack.shape == movie.shape
        np.testing.assert_array_equal(stack.voxel, VOXEL)
        good = []
        for i in range(len(stack)):
            try:
                np.testing.assert_array_equal(stack.frame(i), movie[i])
                good.append(i)
            except FrameError as fault:
                assert fault.frame == i  # noqa: PT017 (some frames do come back)
    # The header takes some of the file; the rest is frames of equal size.
    assert good == list(range(len(good)))
    assert share * len(movie) - 2 < len(good) < len(movie)


def test_a_file_cut_within_an_images_header_is_refused(tmp_path, movie):
    path = tmp_path / "a.ome.tif"
    write_stack(open_stack(movie, **GIVEN), path)
    with tifffile.TiffFile(path) as file:
        end = file.pages[10].offset + 5
    path.write_bytes(path.read_bytes()[:end])
    with pytest.raises(ValueError, match="is cut short, within the header of an image"):
        open_stack(path)


def test_corrupt_frame_is_named(tmp_path, movie):
    """Damaged bytes within a frame spoil that frame alone."""
    path = tmp_path / "a.ome.tif"
    tifffile.imwrite(path, movie, ome=True, metadata={"axes": "TZYX"}, compression="zlib")
    with tifffile.TiffFile(path) as file:
        offset = file.pages[9].dataoffsets[0]
    data = bytearray(path.read_bytes())
    data[offset : offset + 40] = b"\xff" * 40
    path.write_bytes(data)
    with open_stack(path, **GIVEN) as stack:
        for i in (0, 1, 3, 4):
            np.testing.assert_array_equal(stack.frame(i), movie[i])
        with pytest.raises(FrameError, match="frame 2 of 5 cannot be read") as caught:
            stack.frame(2)
    assert (caught.value.frame, caught.value.source) == (2, str(path))


@pytest.mark.parametrize("content", [b"", b"not a tiff at all", b"II*\x00\x08\x00\x00\x00\xff"])
def test_no_tiff_at_all(tmp_path, content):
    """Other files are refused by name; for a missing file there is a FileNotFoundError."""
    (tmp_path / "a.tif").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.tif: "):
        open_stack(tmp_path / "a.tif", **GIVEN)
    with pytest.raises(FileNotFoundError):
        open_stack(tmp_path / "b.tif", **GIVEN)


def test_memory_stays_under_three_frames(tmp_path):
    """A pass through a movie of 30 frames holds less than three at any moment."""
    frame = np.zeros((16, 128, 128), dtype=np.uint16)
    movie = open_stack(np.broadcast_to(frame, (30, *frame.shape)), **GIVEN)
    path = tmp_path / "a.ome.tif"
    write_stack(movie, path)
    with open_stack(path) as stack:
        stack.frame(0)
        tracemalloc.start()
        for i in range(len(stack)):
            stack.frame(i)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 3 * frame.nbytes


def test_another_process_opens_the_file_again(tmp_path, movie):
    """An open stack is pickled as the path of its file."""
    write_stack(open_stack(movie, **GIVEN), tmp_path / "a.ome.tif")
    with open_stack(tmp_path / "a.ome.tif") as stack:
        sent = pickle.dumps(stack)
        assert len(sent) < 2000
        with pickle.loads(sent) as other:
            assert_same(other, movie)


def test_a_worker_opens_a_file_once(tmp_path, movie, monkeypatch):
    """It unpickles a stack with every piece of its work; one that is opened anew is another."""
    from perrin.images import stack as module

    write_stack(open_stack(movie, **GIVEN), tmp_path / "a.ome.tif")
    opened, known = [], module.file_contents
    monkeypatch.setattr(module, "file_contents", lambda *a: opened.append(a) or known(*a))
    for _ in range(2):
        with open_stack(tmp_path / "a.ome.tif") as stack:
            sent = pickle.dumps(stack)
        opened.clear()
        pieces = [pickle.loads(sent), pickle.loads(sent)]
        pieces.append(pickle.loads(pickle.dumps(pieces[1])))
        for i, piece in enumerate(pieces):
            np.testing.assert_array_equal(piece.frame(i), movie[i])
        assert len(opened) == 1
        pieces[0].close()


def test_missing_reader_is_named(tmp_path, monkeypatch):
    """Without the library of a format the error names the package to install."""
    for suffix, module in ((".lif", "liffile"), (".nd2", "nd2"), (".ims", "h5py")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ImportError, match=rf"{module}.*pip install 'perrin\[{suffix[1:]}\]'"):
            open_stack(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("version", ["0.4", "0.5"])
def test_ome_zarr(tmp_path, movie, version):
    """OME-Zarr as its two specifications write it: finest level, scales multiplied, units."""
    zarr = pytest.importorskip("zarr", minversion="3")
    group = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2 if version == "0.4" else 3)
    group.create_array("0", data=movie, chunks=(1, 2, 8, 8))
    scales = {
        "axes": [{"name": "t", "type": "time", "unit": "millisecond"}]
        + [{"name": a, "type": "space", "unit": "nanometer"} for a in "zyx"],
        "datasets": [
            {
                "path": "0",
                "coordinateTransformations": [
                    {"type": "scale", "scale": [1.0, *(1e3 * v for v in VOXEL)]}
                ],
            }
        ],
        "coordinateTransformations": [{"type": "scale", "scale": [DT * 1e3, 1.0, 1.0, 1.0]}],
    }
    if version == "0.4":
        group.attrs["multiscales"] = [scales]
    else:
        group.attrs["ome"] = {"version": "0.5", "multiscales": [scales]}
    with open_stack(tmp_path / "a.zarr") as stack:
        assert_same(stack, movie)
    array = zarr.open_group(tmp_path / "a.zarr", mode="r")["0"]
    assert_same(open_stack(array, **GIVEN), movie)


def test_imaris(tmp_path, movie):
    """An Imaris file: blocks padded beyond the image, sizes from its extent, times of day."""
    h5py = pytest.importorskip("h5py")

    def text(value):
        return np.array(list(str(value)), dtype="S1")

    with h5py.File(tmp_path / "a.ims", "w") as file:
        for t, frame in enumerate(movie):
            padded = np.pad(frame, ((0, 2), (0, 4), (0, 0)))
            where = f"DataSet/ResolutionLevel 0/TimePoint {t}/Channel 0/Data"
            file.create_dataset(where, data=padded, chunks=(2, 8, 8))
        about = file.create_group("DataSetInfo/Image").attrs
        for i, axis in enumerate("XYZ"):
            n = movie.shape[3 - i]
            about[axis] = text(n)
            about[f"ExtMin{i}"], about[f"ExtMax{i}"] = text(-1.5), text(-1.5 + n * VOXEL[2 - i])
        about["Unit"] = text("um")
        clock = file.create_group("DataSetInfo/TimeInfo").attrs
        for t in range(5):
            clock[f"TimePoint{t + 1}"] = text(f"2024-03-01 23:59:59.{t * 150:03d}")
    with open_stack(tmp_path / "a.ims") as stack:
        assert_same(stack, movie, dt=0.15)
    with h5py.File(tmp_path / "a.ims", "a") as file:
        for t in range(1, 5):
            del file[f"DataSet/ResolutionLevel 0/TimePoint {t}"]
    with open_stack(tmp_path / "a.ims", planes=1, dt=0.15) as stack:  # slices are times
        assert_same(stack, movie[0][:, None], dt=0.15)


@pytest.mark.parametrize("compression", ["uncompressed:", "zstd0:", "zstd1:"])
def test_zeiss(tmp_path, movie, compression):
    """A .czi file written by Zeiss's own library, two channels."""
    czi = pytest.importorskip("pylibCZIrw.czi")
    pytest.importorskip("czifile")
    with czi.create_czi(str(tmp_path / "a.czi"), compression_options=compression) as file:
        for t, z, c in np.ndindex(5, 4, 2):
            plane = {"T": t, "Z": z, "C": c}
            file.write(movie[t, z, :, :, None] // (c + 1), plane=plane)
        x, y, z = (1e-6 * length for length in VOXEL[::-1])
        file.write_metadata("a", scale_x=x, scale_y=y, scale_z=z)
    with pytest.raises(ValueError, match="no times of its 5 frames: pass dt="):
        open_stack(tmp_path / "a.czi", channel=0)
    with open_stack(tmp_path / "a.czi", channel=1, dt=DT) as stack:
        assert_same(stack, movie // 2)
    with pytest.raises(ValueError, match="no image 1 among its only image"):
        open_stack(tmp_path / "a.czi", channel=1, dt=DT, image=1)


class NikonFile:
    """A replacement of nd2.ND2File, with its axes, times and calibration as documented."""

    def __init__(self, path):
        self.movie = np.load(path)
        t, z, y, x = self.movie.shape
        self.sizes = {"T": t, "Z": z, "C": 2, "Y": y, "X": x}
        self.dtype = self.movie.dtype
        volume = SimpleNamespace(axesCalibration=VOXEL[::-1], axesCalibrated=(True, True, False))
        self.metadata = SimpleNamespace(channels=[SimpleNamespace(volume=volume)] * 2)

    def frame_metadata(self, number):
        time = SimpleNamespace(relativeTimeMs=500.0 + 1e3 * (number // 4 * DT + number % 4 * 0.01))
        return SimpleNamespace(channels=[SimpleNamespace(time=time)] * 2)

    def read_frame(self, number):
        plane = self.movie[number // 4, number % 4]
        return np.stack([plane, plane // 2])

    def close(self):
        pass


def test_nikon(tmp_path, movie, monkeypatch):
    """Planes, channel and times as nd2 gives them; an uncalibrated axis needs a voxel size."""
    monkeypatch.setitem(sys.modules, "nd2", SimpleNamespace(ND2File=NikonFile))
    with open(tmp_path / "a.nd2", "wb") as file:
        np.save(file, movie)
    with pytest.raises(ValueError, match="no voxel size along z: "):
        open_stack(tmp_path / "a.nd2", channel=1)
    with open_stack(tmp_path / "a.nd2", channel=1, voxel=VOXEL) as stack:
        np.testing.assert_array_equal(stack.frame(3), movie[3] // 2)
        np.testing.assert_allclose(stack.times, 0.5 + np.arange(5) * DT)
        assert stack.plane_time == pytest.approx(0.01)


def lif_bytes(movie, voxel, dt, scan="xyzt", stamps=()):
    """Return a small Leica file: an XML header in UTF-16, then one block of memory.

    The letters of `scan` are the axes, fastest first; those left out have one element. `stamps`
    are times of its images, s.
    """
    t, z, y, x = movie.shape
    about = {
        "x": (1, x, voxel[2] * 1e-6, "m"),
        "y": (2, y, voxel[1] * 1e-6, "m"),
        "z": (3, z, voxel[0] * 1e-6, "m"),
        "t": (4, t, dt, "s"),
    }
    single = set("tzyx") - set(scan)
    memory = movie.transpose(["tzyx".index(axis) for axis in (*single, *scan[::-1])])
    step = movie.itemsize
    dimensions = ""
    for number, n, length, unit in (about[axis] for axis in scan):
        dimensions += (
            f'<DimensionDescription DimID="{number}" NumberOfElements="{n}" Origin="0" '
            f'Length="{(n - 1) * length!r}" Unit="{unit}" BitInc="0" BytesInc="{step}"/>'
        )
        step *= n
    # Stamps count 100 ns since 1601.
    ticks = [f"{int(133e15) + round(stamp * 1e7):x}" for stamp in stamps]
    listed = f'<TimeStampList NumberOfTimeStamps="{len(ticks)}">{" ".join(ticks)}</TimeStampList>'
    image = (
        '<Data><Image><ImageDescription><Channels><ChannelDescription DataType="0" ChannelTag="0" '
        'Resolution="16" NameOfMeasuredQuantity="" Min="0" Max="65535" Unit="" LUTName="Gray" '
        'IsLUTInverted="0" BytesInc="0" BitInc="0"/></Channels>'
        f"<Dimensions>{dimensions}</Dimensions></ImageDescription>{listed}</Image></Data>"
        f'<Memory Size="{movie.nbytes}" MemoryBlockID="MemBlock_1"/>'
    )
    xml = (
        '<LMSDataContainerHeader Version="2"><Element Name="a.lif"><Memory Size="0" '
        'MemoryBlockID="MemBlock_0"/><Children><Element Name="Series001" UniqueID="1">'
        f"{image}</Element></Children></Element></LMSDataContainerHeader>"
    ).encode("utf-16-le")

    def number(value, n=4):
        return int(value).to_bytes(n, "little")

    def block(name, data):
        text = name.encode("utf-16-le")
        head = b"\x2a" + number(len(data), 8) + b"\x2a" + number(len(name)) + text
        return number(0x70) + number(len(head)) + head + data

    start = number(0x70) + number(len(xml) + 5) + b"\x2a" + number(len(xml) // 2) + xml
    return start + block("MemBlock_0", b"") + block("MemBlock_1", memory.tobytes())


def test_leica(tmp_path, movie):
    """A .lif file laid out as Leica does; cut short, it keeps its good frames."""
    pytest.importorskip("liffile")
    data = lif_bytes(movie, VOXEL, DT)
    (tmp_path / "a.lif").write_bytes(data)
    with open_stack(tmp_path / "a.lif") as stack:
        assert_same(stack, movie)
        assert stack.plane_time is None
    clock = np.arange(5)[:, None] * DT + np.arange(4) * 0.15
    (tmp_path / "c.lif").write_bytes(lif_bytes(movie, VOXEL, DT, stamps=clock.ravel()))
    with open_stack(tmp_path / "c.lif") as stack:
        assert_same(stack, movie)
        assert stack.plane_time == pytest.approx(0.15)
    (tmp_path / "b.lif").write_bytes(data[: -movie[0].nbytes])
    with open_stack(tmp_path / "b.lif") as stack:
        np.testing.assert_array_equal(stack.frame(3), movie[3])
        with pytest.raises(FrameError, match="frame 4 of 5"):
            stack.frame(4)


@pytest.mark.parametrize("scan", ["xzyt", "xyzt", "xzy", "xzt", "xz"])
def test_leica_scans_across_the_planes(tmp_path, movie, scan):
    """A scan of x and z at many y is a volume; at one y its z is the y of a movie of a plane."""
    pytest.importorskip("liffile")
    movie = movie if "t" in scan else movie[:1]
    movie = movie if "y" in scan else movie[:, :, :1]
    (tmp_path / "a.lif").write_bytes(lif_bytes(movie, VOXEL, DT, scan))
    with open_stack(tmp_path / "a.lif") as stack:
        if "y" in scan:
            assert_same(stack, movie)
        else:
            assert_same(stack, movie.swapaxes(1, 2), voxel=(np.nan, VOXEL[0], VOXEL[2]))
            assert stack.notes == ("the images are sections (z, x): their z is read as y",)


def test_zarr_folder_without_scales(tmp_path):
    """A zarr folder without OME-Zarr metadata is refused, and the message states what to pass."""
    pytest.importorskip("zarr")
    (tmp_path / "a.zarr").mkdir()
    header = {"zarr_format": 3, "node_type": "group", "attributes": {}}
    (tmp_path / "a.zarr" / "zarr.json").write_text(json.dumps(header))
    with pytest.raises(ValueError, match="without OME-Zarr"):
        open_stack(tmp_path / "a.zarr", **GIVEN)
