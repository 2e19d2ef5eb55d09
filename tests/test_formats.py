"""Headers that microscope programs write are read as they mean, or refused with the reason."""

from __future__ import annotations

import json
import pickle
import re
import struct
import warnings
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from perrin import FrameError, PrecisionWarning, open_stack
from perrin.images.formats import Pick, czi_times, layout, stk_scale

tifffile = pytest.importorskip("tifffile")

VOXEL, DT = (0.25, 0.2, 0.1), 0.73
GIVEN = {"voxel": VOXEL, "dt": DT}
REAL = Path(__file__).resolve().parents[2] / "shared" / "data" / "microscopes"
CASES = json.loads((REAL / "expected.json").read_text()) if REAL.is_dir() else []


@pytest.fixture
def movie():
    return np.random.default_rng(1).integers(0, 60000, (5, 4, 12, 16), dtype=np.uint16)


def assert_frames(stack, movie, *, times=None, voxel=VOXEL):
    """Compare voxels bit by bit, the voxel size, and times from the first frame."""
    assert stack.shape == movie.shape
    for i in range(len(movie)):
        np.testing.assert_array_equal(stack.frame(i), movie[i])
    np.testing.assert_allclose(stack.voxel, voxel, rtol=1e-5)
    if times is not None:
        np.testing.assert_allclose(stack.times - stack.times[0], times, rtol=1e-5, atol=1e-9)


def imagej(path, movie, **header):
    """Write an ImageJ hyperstack with pixels of 0.2 and 0.1 units."""
    resolution = (1 / VOXEL[2], 1 / VOXEL[1])
    metadata = {"axes": "TZYX", "spacing": VOXEL[0], "unit": "micron", **header}
    tifffile.imwrite(path, movie, imagej=True, resolution=resolution, metadata=metadata)


@pytest.mark.parametrize(
    ("header", "dt"),
    [
        ({"finterval": 500, "tunit": "ms"}, 0.5),
        ({"finterval": 2, "tunit": "min"}, 120),
        ({"finterval": 0.5, "fps": 7.0}, 0.5),
        ({"finterval": 0.5, "tunit": "sec"}, 0.5),
    ],
)
def test_imagej_interval_has_its_own_unit(tmp_path, movie, header, dt):
    """`tunit` is the unit of the interval; the speed of the player does not change it."""
    imagej(tmp_path / "a.tif", movie, **header)
    with open_stack(tmp_path / "a.tif") as stack:
        assert_frames(stack, movie, times=np.arange(5) * dt)


def test_imagej_player_speed_is_no_interval(tmp_path, movie):
    imagej(tmp_path / "a.tif", movie, fps=7.0)
    with pytest.raises(ValueError, match=r"fps=7.* is the speed of ImageJ's player.*pass dt="):
        open_stack(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("units", "factors"),
    [
        ({"unit": "nm", "zunit": "micron"}, (1, 1e-3 * 50, 1e-3 * 50)),
        ({"yunit": "mm"}, (1, 1e3 / 500, 1)),
        ({"unit": "Angstrom", "zunit": "micron", "yunit": "micron"}, (1, 1, 1e-4 * 100)),
    ],
)
def test_imagej_axes_have_units_of_their_own(tmp_path, movie, units, factors):
    """`zunit` and `yunit` replace `unit` along their axes; pixels are scaled to be plausible."""
    scale = {"unit": (50, 50), "yunit": (1, 1 / 500)}
    x, y = scale["unit"] if units.get("unit") == "nm" else (1, 1)
    x, y = (100, 1) if units.get("unit") == "Angstrom" else (x, y)
    y = 1 / 500 if units.get("yunit") == "mm" else y
    metadata = {"axes": "TZYX", "spacing": VOXEL[0], "unit": "micron", "finterval": DT, **units}
    tifffile.imwrite(
        tmp_path / "a.tif",
        movie,
        imagej=True,
        resolution=(1 / (VOXEL[2] * x), 1 / (VOXEL[1] * y)),
        metadata=metadata,
    )
    with open_stack(tmp_path / "a.tif") as stack:
        assert_frames(stack, movie, voxel=np.multiply(VOXEL, factors))


def test_pixels_that_no_microscope_has_are_doubted(tmp_path, movie):
    """A size that is wrong by its unit is asked for; the user's own is not doubted."""
    tifffile.imwrite(
        tmp_path / "a.tif",
        movie,
        imagej=True,
        resolution=(10.0, 5.0),
        metadata={"axes": "TZYX", "spacing": 0.25, "unit": "mm", "finterval": DT},
    )
    with pytest.raises(ValueError, match=r"x = 100 um, is not between 1 nm and 20 um: pass voxel="):
        open_stack(tmp_path / "a.tif")
    with pytest.warns(PrecisionWarning, match="in the file"):
        open_stack(tmp_path / "a.tif", voxel=VOXEL).close()


def ome_header(path):
    with tifffile.TiffFile(path) as file:
        return file.ome_metadata


def ome(path, movie, clock, **pixels):
    """Write an OME file whose planes have the times of `clock`; NaN are left out."""
    header = {"axes": "TZYX", **pixels}
    header |= {f"PhysicalSize{axis}": v for axis, v in zip("ZYX", VOXEL, strict=True)}
    header["Plane"] = {"DeltaT": np.nan_to_num(clock, nan=-1).ravel().tolist()}
    tifffile.imwrite(path, movie, ome=True, metadata=header)
    xml = ome_header(path)
    cut = re.sub(r'DeltaT="-1.0"', "", xml)
    tifffile.tiffcomment(path, cut.encode())


CLOCK = np.arange(5)[:, None] * 1.2 + np.arange(4) * 0.1


def test_one_lost_plane_time_does_not_change_the_interval(tmp_path, movie):
    """The frame's other planes give its time; the 1 ms that was asked for is not used."""
    clock = CLOCK.copy()
    clock[2, 0] = np.nan
    ome(tmp_path / "a.ome.tif", movie, clock, TimeIncrement=1.0, TimeIncrementUnit="ms")
    with open_stack(tmp_path / "a.ome.tif") as stack:
        assert_frames(stack, movie, times=CLOCK[:, 0])
        assert stack.plane_time == pytest.approx(0.1)
        assert stack.notes == ("the times of frames 2 come from planes other than the first",)


def test_a_frame_without_any_time_is_asked_for(tmp_path, movie):
    clock = CLOCK.copy()
    clock[3] = np.nan
    ome(tmp_path / "a.ome.tif", movie, clock, TimeIncrement=1.0, TimeIncrementUnit="ms")
    with pytest.raises(ValueError, match=r"lacks those of 1 frames, the first of them 3.*pass dt="):
        open_stack(tmp_path / "a.ome.tif")
    with open_stack(tmp_path / "a.ome.tif", dt=1.2) as stack:
        assert_frames(stack, movie, times=CLOCK[:, 0])


def test_planes_that_take_longer_than_their_frame_are_refused(tmp_path, movie):
    ome(tmp_path / "a.ome.tif", movie, np.arange(5)[:, None] * 0.2 + np.arange(4) * 0.1)
    with pytest.raises(ValueError, match=r"4 planes of 0.1 s each take longer .* 0.2 s: pass dt="):
        open_stack(tmp_path / "a.ome.tif")
    with open_stack(tmp_path / "a.ome.tif", plane_time=0.05) as stack:
        assert stack.dt == pytest.approx(0.2)


def test_a_position_of_a_set_has_the_header_of_its_own(tmp_path, movie):
    """The header of a set lists all positions; the file of the second has the second's times."""
    for name, step in (("first", 1.0), ("second", 2.0)):
        ome(tmp_path / f"{name}.ome.tif", movie, CLOCK * step)
    headers = [ome_header(tmp_path / f"{name}.ome.tif") for name in ("first", "second")]
    images = [re.search(r"<Image .*</Image>", xml, re.S)[0] for xml in headers]
    named = [
        re.sub(r'Name="[^"]*"', f'Name="{name}"', image, count=1)
        for name, image in zip(("first", "second"), images, strict=True)
    ]
    # The images of the first position are in a file that is not there.
    named[0] = re.sub(
        r"<TiffData([^>]*)/>",
        r'<TiffData\1><UUID FileName="gone.ome.tif">urn:uuid:1</UUID></TiffData>',
        named[0],
    )
    whole = headers[1].replace(images[1], "".join(named))
    tifffile.tiffcomment(tmp_path / "second.ome.tif", whole.encode())
    with open_stack(tmp_path / "second.ome.tif", image="second") as stack:
        assert_frames(stack, movie, times=2 * CLOCK[:, 0])


NAMES = {
    "LAS X": "a_Series014_t{t:02d}_z{z:03d}_ch{c:02d}",
    "Micro-Manager 1.4": "img_{t:09d}_{colour}_{z:03d}",
    "Micro-Manager 2": "img_channel{c:03d}_position000_time{t:09d}_z{z:03d}",
    "FluoView": "s_C{c:03d}Z{z:03d}T{t:03d}",
    "MetaMorph": "s_w{c}{colour}_z{z}_t{t}",
}


@pytest.mark.parametrize("program", NAMES)
def test_names_count_times_planes_and_channels(tmp_path, movie, program):
    """Files of one plane each come back in their places, whatever the order of the counters."""
    for t, z, c in np.ndindex(5, 4, 2):
        # Numbers from 8 on: 10 comes after 9.
        name = NAMES[program].format(t=t + 8, z=z, c=c, colour=("Blue", "Green")[c])
        tifffile.imwrite(tmp_path / f"{name}.tif", movie[t, z] // (c + 1))
    with pytest.raises(ValueError, match="2 channels: pass channel=0 to 1"):
        open_stack(tmp_path, **GIVEN)
    with pytest.raises(ValueError, match="4 planes a frame, not planes=3"):
        open_stack(tmp_path, channel=0, planes=3, **GIVEN)
    for c in (0, 1):
        with open_stack(tmp_path, channel=c, planes=4, **GIVEN) as stack:
            assert_frames(stack, movie // (c + 1))


def test_names_of_volumes_count_channels(tmp_path, movie):
    """A file of several planes is one frame of one channel, as BigDataProcessor writes them."""
    for t, c in np.ndindex(5, 2):
        name = f"vol--C{c:02d}--T{t:05d}.tif"
        tifffile.imwrite(tmp_path / name, movie[t] // (c + 1), photometric="minisblack")
    with open_stack(tmp_path, channel=1, **GIVEN) as stack:
        assert_frames(stack, movie // 2)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a1_b1", "a1_b2", "a2_b1", "a2_b2"], "2 numbers vary.*meaning is not clear"),
        (["red1", "red2", "green1", "green2"], "differ in more than numbers"),
        (["t1_z1", "t1_z2", "t2_z1"], r"lacks the image \{'T': 2, 'Z': 2\}"),
        (["t1", "t2", "t4"], "times are numbered unevenly, with none between 2 and 4"),
        (["t1_z0", "t1_z1", "t1_z3"], "planes are numbered unevenly, with none between 1 and 3"),
        (["s_t1_xy1", "s_t1_xy2", "s_t2_xy1", "s_t2_xy2"], "2 images .*pass image="),
    ],
)
def test_names_that_do_not_state_their_order_are_refused(tmp_path, movie, names, message):
    for name in names:
        tifffile.imwrite(tmp_path / f"{name}.tif", movie[0, 0])
    with pytest.raises(ValueError, match=message):
        open_stack(tmp_path, planes=1, **GIVEN)


def test_an_image_that_is_not_there_is_refused(tmp_path, movie):
    imagej(tmp_path / "a.tif", movie, finterval=DT)
    with pytest.raises(ValueError, match="no image 7 among its only image"):
        open_stack(tmp_path / "a.tif", image=7)


def test_a_header_in_another_file(tmp_path, movie):
    """The companion is asked for by name, and read where it is there."""
    path = tmp_path / "a.ome.tif"
    ome(path, movie, CLOCK)
    whole = ome_header(path)
    tifffile.tiffcomment(
        path,
        b'<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">'
        b'<BinaryOnly MetadataFile="a.companion.ome" UUID="urn:uuid:1"/></OME>',
    )
    with pytest.raises(ValueError, match=r"another file, a\.companion\.ome; put that file"):
        open_stack(path)
    (tmp_path / "a.companion.ome").write_text(whole, encoding="utf-8")
    with open_stack(path) as stack:
        assert_frames(stack, movie, times=CLOCK[:, 0])


def test_channels_are_summed(tmp_path, movie):
    """Clusters of two colours: grey levels add up in a wider type, also in another process."""
    both = np.stack([movie, movie[::-1]], axis=2)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, both, imagej=True, metadata={"axes": "TZCYX"})
    with open_stack(path, channel=(0, 1), **GIVEN) as stack:
        assert stack.dtype == np.uint32
        with pickle.loads(pickle.dumps(stack)) as elsewhere:
            assert_frames(elsewhere, movie.astype(np.uint32) + movie[::-1])
        assert stack.choice["channel"] == [0, 1]
    with pytest.raises(ValueError, match="channel: expected different numbers from 0"):
        open_stack(path, channel=(0, 0), **GIVEN)
    with pytest.raises(ValueError, match="no channel 2"):
        open_stack(path, channel=(0, 2), **GIVEN)


def test_saved_arrays(tmp_path, movie):
    """Arrays of numpy and HDF5 files are read as arrays in memory are."""
    np.save(tmp_path / "a.npy", movie)
    np.savez(tmp_path / "a.npz", first=movie, second=movie[::-1])
    with open_stack(tmp_path / "a.npy", **GIVEN) as stack:
        assert_frames(stack, movie)
    with open_stack(tmp_path / "a.npz", image="second", **GIVEN) as stack:
        assert_frames(stack, movie[::-1])
    with pytest.raises(ValueError, match=r"no voxel size along z, y, x.*no times of its 5 frames"):
        open_stack(tmp_path / "a.npy")
    with pytest.raises(ValueError, match=r"2 images .*'first', 'second'"):
        open_stack(tmp_path / "a.npz", **GIVEN)
    (tmp_path / "b.npy").write_bytes(b"no array")
    with pytest.raises(ValueError, match="no array of numbers"):
        open_stack(tmp_path / "b.npy", **GIVEN)
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["images/raw"], file["drift"] = movie[:, 0], np.zeros(5)
    with open_stack(tmp_path / "a.h5", voxel=VOXEL[1:], dt=DT) as stack:
        assert_frames(stack, movie[:, :1], voxel=(np.nan, *VOXEL[1:]))


def deltavision(movie, sequence, clock, order="<"):
    """Return a DeltaVision file of two channels; `clock` (t, z) is the time of their planes."""
    t, z, y, x = movie.shape
    axes = {0: "CTZ", 1: "TZC", 2: "TCZ"}[sequence]
    head = bytearray(1024)
    put = struct.pack_into
    put(f"{order}4i", head, 0, x, y, 2 * t * z, 6)
    put(f"{order}3f", head, 40, *VOXEL[::-1])
    put(f"{order}ih", head, 92, 40 * 2 * t * z, -16224)
    put(f"{order}2h", head, 128, 8, 2)
    put(f"{order}2h", head, 180, t, sequence)
    put(f"{order}h", head, 196, 2)
    about, planes = b"", b""
    sizes = {"T": t, "Z": z, "C": 2}
    for place in np.ndindex(*(sizes[axis] for axis in axes)):
        at = dict(zip(axes, place, strict=True))
        about += struct.pack(f"{order}8i2f", *[0] * 9, clock[at["T"], at["Z"]] + 0.01 * at["C"])
        plane = movie[at["T"], at["Z"]] // (at["C"] + 1)
        planes += plane.astype(f"{order}u2").tobytes()
    return bytes(head) + about + planes


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("sequence", [0, 1, 2])
def test_deltavision(tmp_path, movie, sequence, order):
    """Planes in the order of the header, their times, and the frames before a file's end."""
    data = deltavision(movie, sequence, CLOCK, order)
    (tmp_path / "a.dv").write_bytes(data)
    with open_stack(tmp_path / "a.dv", channel=1) as stack:
        assert_frames(stack, movie // 2, times=CLOCK[:, 0])
        assert stack.plane_time == pytest.approx(0.1, rel=1e-4)
    (tmp_path / "b.dv").write_bytes(data[:-10])
    with open_stack(tmp_path / "b.dv", channel=1) as stack, pytest.raises(FrameError):
        stack.frame(4)
    (tmp_path / "c.dv").write_bytes(bytes(2000))
    with pytest.raises(ValueError, match=r"DeltaVision: is not a DeltaVision file"):
        open_stack(tmp_path / "c.dv")


def test_a_folder_of_an_ome_set_is_read_once(tmp_path, movie):
    """Files that each have the header of all planes are one stack, not copies of it."""
    whole = tmp_path / "whole.ome.tif"
    tifffile.imwrite(whole, movie[0], ome=True, metadata={"axes": "ZYX"})
    data = "".join(
        f'<TiffData FirstZ="{z}" IFD="0" PlaneCount="1">'
        f'<UUID FileName="run{z}.ome.tif">urn:uuid:{z}</UUID></TiffData>'
        for z in range(4)
    )
    xml = re.sub(r"<TiffData.*?/>", data, ome_header(whole), count=1)
    whole.unlink()
    for z in range(4):
        own = xml.replace("<OME ", f'<OME UUID="urn:uuid:{z}" ', 1)
        own = re.sub(r' UUID="urn:uuid:[0-9a-f]{8}-[^"]*"', "", own)
        path = tmp_path / f"run{z}.ome.tif"
        tifffile.imwrite(path, movie[0, z], description=own, metadata=None)
    with open_stack(tmp_path, **GIVEN) as stack:
        assert_frames(stack, movie[:1])


@pytest.mark.parametrize("lost", [None, 3, "two files"])
def test_ndtiff(tmp_path, movie, lost):
    """Every image of Micro-Manager's NDTiff states its axes, height and time."""
    places = list(np.ndindex(5, 4, 2))
    if lost == "two files":
        ndtiff(tmp_path / "a_NDTiffStack.tif", movie, places[:17])
        ndtiff(tmp_path / "a_NDTiffStack_1.tif", movie, places[17:])
        with open_stack(tmp_path, channel=1) as stack:
            assert_frames(stack, movie // 2, times=CLOCK[:, 0], voxel=(0.25, 0.2, 0.2))
        return
    path = tmp_path / "a_NDTiffStack.tif"
    ndtiff(path, movie, [place for i, place in enumerate(places) if i != lost])
    if lost is not None:
        with pytest.raises(ValueError, match=r"NDTiff.*lacks the image .*'C': 'red'"):
            open_stack(path, channel=1)
        return
    with pytest.raises(ValueError, match=r"Micro-Manager TIFF \(NDTiff\): has 2 channels"):
        open_stack(path)
    with open_stack(path, channel=1) as stack:
        assert_frames(stack, movie // 2, times=CLOCK[:, 0], voxel=(0.25, 0.2, 0.2))
        assert stack.plane_time == pytest.approx(0.1)


def ndtiff(path, movie, places):
    """Write the images at some (t, z, channel) as Micro-Manager does."""
    with tifffile.TiffWriter(path) as file:
        for t, z, c in places:
            about = {
                "Axes": {"time": t, "z": z, "channel": "red" if c else "green"},
                "ElapsedTime-ms": 1e3 * CLOCK[t, z] + 10 * c,
                "PixelSizeUm": 0.2,
                "ZPosition_um_Intended": 7 - 0.25 * z,
            }
            tag = (51123, 2, 0, json.dumps(about), True)
            file.write(movie[t, z] // (c + 1), extratags=[tag], contiguous=False, metadata=None)


def test_the_root_of_bioformats2raw(tmp_path, movie):
    """Images of a set are chosen by number, the set's list or the names of its folders."""
    zarr = pytest.importorskip("zarr", minversion="3")
    root = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2)
    root.attrs["bioformats2raw.layout"] = 3
    for name, data in (("0", movie), ("1", movie[::-1])):
        group = root.create_group(name)
        group.create_array("0", data=data)
        scale = {"type": "scale", "scale": [DT, *VOXEL]}
        group.attrs["multiscales"] = [
            {
                "axes": [{"name": "t", "unit": "second"}]
                + [{"name": a, "unit": "micrometer"} for a in "zyx"],
                "datasets": [{"path": "0", "coordinateTransformations": [scale]}],
            }
        ]
    with pytest.raises(ValueError, match=r"OME-Zarr: has 2 images \['0', '1'\]: pass image="):
        open_stack(tmp_path / "a.zarr")
    with open_stack(tmp_path / "a.zarr", image=1) as stack:
        assert_frames(stack, movie[::-1], times=np.arange(5) * DT)


def test_a_minimal_imaris_file(tmp_path, movie):
    """The size of the image is an attribute of its channels; texts end with a zero."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.ims", "w") as file:
        channel = file.create_group("DataSet/ResolutionLevel 0/TimePoint 0/Channel 0")
        channel["Data"] = np.pad(movie[0], ((0, 0), (0, 4), (0, 0)))
        image = file.create_group("DataSetInfo/Image").attrs
        for i, axis in enumerate("XYZ"):
            n = movie.shape[3 - i]
            channel.attrs[f"ImageSize{axis}"] = np.array(list(str(n)), dtype="S1")
            image[f"ExtMin{i}"] = np.bytes_(b"0.0")
            image[f"ExtMax{i}"] = np.array([*f"{n * VOXEL[2 - i]:.6f}", "\0"], dtype="S1")
    with open_stack(tmp_path / "a.ims") as stack:
        assert_frames(stack, movie[:1])


def test_scenes_and_colours_of_a_zeiss_file(tmp_path, movie):
    """A scene is an image; an image in colours is refused before any frame is read."""
    czi = pytest.importorskip("pylibCZIrw.czi")
    pytest.importorskip("czifile")
    with czi.create_czi(str(tmp_path / "a.czi")) as file:
        for t, z, scene in np.ndindex(5, 4, 2):
            data = movie[t, z, :, :, None] // (scene + 1)
            file.write(data, plane={"T": t, "Z": z}, scene=scene, location=(40 * scene, 7))
    with pytest.raises(ValueError, match=r"Zeiss CZI: has 2 images .*pass image="):
        open_stack(tmp_path / "a.czi", **GIVEN)
    with open_stack(tmp_path / "a.czi", image=1, **GIVEN) as stack:
        assert_frames(stack, movie // 2)
    with czi.create_czi(str(tmp_path / "b.czi")) as file:
        file.write(np.zeros((12, 16, 3), np.uint8), plane={"T": 0, "Z": 0})
    with pytest.raises(ValueError, match="has colours: save one channel"):
        open_stack(tmp_path / "b.czi", **GIVEN)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.vsi", "an Olympus cellSens file, which is not read: export it as OME-TIFF, or save"),
        ("a.mp4", "a video, which is not read: export it"),
        ("a.xyz", r"cannot be read \(TiffFileError.*\): export it as OME-TIFF, or save the array"),
    ],
)
def test_a_refusal_states_what_to_do(tmp_path, name, message):
    (tmp_path / name).write_bytes(b"no image" * 200)
    with pytest.raises(ValueError, match=message):
        open_stack(tmp_path / name, **GIVEN)


@pytest.mark.parametrize("stamped", [False, True])
def test_lsm(tmp_path, movie, stamped):
    """A LSM file: thumbnails are left out, three channels share a page, times are stamps."""
    channels = np.stack([movie, movie // 2, movie // 3], axis=2)
    about = bytearray(380)
    struct.pack_into(
        "<10i3d", about, 0, 0x0400494C, 380, 16, 12, 4, 3, 5, 2, 8, 6, 1e-7, 2e-7, 25e-8
    )
    struct.pack_into("<H", about, 88, 6)  # x, y, channel, z, time
    struct.pack_into("<d", about, 112, DT)
    path = tmp_path / "a.lsm"
    how = {"planarconfig": "separate", "photometric": "minisblack", "contiguous": False}
    with tifffile.TiffWriter(path, byteorder="<") as file:
        for t, z in np.ndindex(5, 4):
            tags = [(34412, 1, 380, bytes(about), True)] if t == z == 0 else []
            file.write(channels[t, z], extratags=tags, metadata=None, **how)
            file.write(channels[t, z, :, ::2, ::2], subfiletype=1, metadata=None, **how)
    times = np.arange(5) * DT
    if stamped:
        times = np.array([0, 0.7, 1.5, 2.2, 3.0])
        data = bytearray(path.read_bytes())
        struct.pack_into("<i", data, data.index(bytes(about[:40])) + 132, len(data))
        path.write_bytes(bytes(data) + struct.pack("<2i5d", 48, 5, *times))
    with pytest.raises(ValueError, match="Zeiss LSM: has 3 channels"):
        open_stack(path)
    for c in range(3):
        with open_stack(path, channel=c) as stack:
            assert_frames(stack, movie // (c + 1), times=times)


def test_metamorph_headers(tmp_path, movie):
    """The calibration of a MetaMorph image, and distances and dates of a series."""
    properties = {
        "spatial-calibration-state": ("bool", "on"),
        "spatial-calibration-x": ("float", "0.1"),
        "spatial-calibration-y": ("float", "0.2"),
        "spatial-calibration-units": ("string", "um"),
    }
    text = "".join(
        f'<prop id="{name}" type="{kind}" value="{value}"/>'
        for name, (kind, value) in properties.items()
    )
    xml = f"<MetaData><PlaneInfo>{text}</PlaneInfo></MetaData>"
    written = {"description": xml, "software": "MetaSeries", "metadata": None}
    tifffile.imwrite(tmp_path / "a.tif", movie[0, 0], **written)
    with open_stack(tmp_path / "a.tif") as stack:
        assert_frames(stack, movie[:1, :1], voxel=(np.nan, 0.2, 0.1))
    start = np.datetime64("2024-03-01T23:59:59")
    header = {
        "SpatialCalibration": 1,
        "XCalibration": 100.0,
        "YCalibration": 200.0,
        "CalibrationUnits": "nm",
        "ZDistance": np.full(5, -0.25),
        "DatetimeCreated": start + np.arange(5) * np.timedelta64(730, "ms"),
    }
    scale = stk_scale(header, layout({"T": 5}, Pick()))
    np.testing.assert_allclose(scale.voxel, VOXEL)
    np.testing.assert_allclose(scale.times, np.arange(5) * DT)


def test_measured_times_of_a_zeiss_file_come_first():
    """Stamps, then offsets, then the times of planes, then the interval that was asked for."""
    header = ElementTree.fromstring(
        "<T><T><Positions><Interval><Increment>9</Increment></Interval></Positions></T></T>"
    )
    unknown = [np.nan] * 3
    np.testing.assert_array_equal(czi_times(header, [5, 6, 8], unknown), [5, 6, 8])
    np.testing.assert_array_equal(czi_times(header, [5], [10.0, 11.0, 13.0]), [0, 1, 3])
    np.testing.assert_array_equal(czi_times(header, [], unknown), [0, 9, 18])


def real_faults(case):
    """Return how a real file was read otherwise than expected; skip where its reader is missing."""
    try:
        stack = open_stack(REAL / case["path"], **case["kw"])
    except ImportError as missing:
        pytest.skip(str(missing))
    except ValueError as fault:
        said = str(fault).split(case["path"], 1)[-1]
        right = case["ok"] is not True and re.search(case.get("say", ""), said, re.I | re.S)
        return [] if right else [said]
    with stack:
        if case["ok"] is False:
            return [f"opened: {stack}"]
        sums = [int(frame.astype(np.int64).sum()) for frame in stack]
        wanted = [np.nan if v is None else v for v in case.get("voxel", stack.voxel)]
        times = np.array(case.get("times", stack.times - stack.times[0]))
        checks = {
            "shape": list(stack.shape) == case.get("shape", list(stack.shape)),
            "frames": sums == case.get("frame_sums", sums),
            "voxel": np.all(np.isnan(wanted) | np.isclose(stack.voxel, wanted, rtol=1e-4)),
            "times": np.allclose(stack.times - stack.times[0], times, rtol=1e-3, atol=2e-4),
            "dt": not np.isclose(stack.dt, case.get("not_dt", np.nan)),
        }
        if "plane_time" in case:
            checks["plane_time"] = stack.plane_time == pytest.approx(case["plane_time"], rel=0.05)
        return [name for name, right in checks.items() if not right]


@pytest.mark.skipif(not CASES, reason="the real files of microscopes are not here")
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case['path']} {case['kw']}")
def test_real_files_of_microscopes(case):
    """Values as other readers and the files' own metadata state them (expected.json)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert not real_faults(case)
