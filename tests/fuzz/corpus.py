"""Small whole files of every format that is read, from which the damaged ones are made."""

from __future__ import annotations

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd

import perrin
from perrin.movie.parts import PartWriter
from perrin.tracks.checksums import write_sealed

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import test_formats
import test_stacks
import test_tables

VOXEL, DT = (0.3, 0.2, 0.2), 0.7
MOVIE = np.random.default_rng(0).integers(0, 200, (3, 4, 12, 16)).astype(np.uint16)
SCALES = [{"type": "scale", "scale": [DT, *VOXEL]}]


def tiffs():
    """Yield the names of TIFF files of several programs, and functions that write them."""
    import tifffile

    axes = {"metadata": {"axes": "TZYX"}}
    yield "plain.tif", lambda p: tifffile.imwrite(p, MOVIE, **axes)
    yield "packed.tif", lambda p: tifffile.imwrite(p, MOVIE, compression="zlib", **axes)
    yield "big.tif", lambda p: tifffile.imwrite(p, MOVIE, bigtiff=True, byteorder=">", **axes)
    yield "tiles.tif", lambda p: tifffile.imwrite(p, MOVIE, tile=(16, 16), **axes)
    yield "movie.ome.tif", lambda p: tifffile.imwrite(p, MOVIE, ome=True, **axes)
    yield "imagej.tif", lambda p: tifffile.imwrite(p, MOVIE, imagej=True, **axes)
    yield "pages.tif", lambda p: _pages(tifffile, p)


def _pages(tifffile, path):
    """Write a directory for every image."""
    with tifffile.TiffWriter(path) as file:
        for image in MOVIE[0]:
            file.write(image, contiguous=False, metadata=None)


def stacks():
    """Yield the names of files of microscopes, and functions that write them, where they can be."""
    yield "a.lif", lambda p: p.write_bytes(test_stacks.lif_bytes(MOVIE, VOXEL, DT))
    clock = DT * np.arange(3)[:, None] + 0.01 * np.arange(4)
    yield "a.dv", lambda p: p.write_bytes(test_formats.deltavision(MOVIE, 0, clock))
    yield "a.npy", lambda p: np.save(p, MOVIE)
    yield "a.npz", lambda p: np.savez_compressed(p, m=MOVIE)
    yield "a.h5", _hdf5
    yield "a.ims", _imaris
    yield "2.zarr", lambda p: _zarr(p, 2)
    yield "3.zarr", lambda p: _zarr(p, 3)
    yield "a.czi", _zeiss
    data = Path(__file__).resolve().parents[3] / "shared" / "data" / "microscopes"
    for name in ("nd2/cluster.nd2", "other/test.oib"):
        if (data / name).is_file():
            yield Path(name).name, lambda p, name=name: p.write_bytes((data / name).read_bytes())


def _hdf5(path):
    import h5py

    with h5py.File(path, "w") as file:
        file.create_dataset("m", data=MOVIE, chunks=(1, 4, 12, 16), compression="gzip")


def _imaris(path):
    import h5py

    extent = {"ExtMax0": 3.2, "ExtMax1": 2.4, "ExtMax2": 1.2}
    stated = {"X": 16, "Y": 12, "Z": 4, "Unit": "um", **extent}
    stated |= {f"ExtMin{k}": 0 for k in range(3)}
    with h5py.File(path, "w") as file:
        about = file.create_group("DataSetInfo/Image").attrs
        about.update({name: np.array(list(str(value)), "S1") for name, value in stated.items()})
        for t, frame in enumerate(MOVIE):
            place = f"DataSet/ResolutionLevel 0/TimePoint {t}/Channel 0/Data"
            file.create_dataset(place, data=frame, chunks=(2, 12, 16), compression="gzip")


def _zarr(path, version):
    import numcodecs
    import zarr

    blosc = numcodecs.Blosc(cname="lz4") if version == 2 else zarr.codecs.BloscCodec(cname="lz4")
    group = zarr.open_group(path, mode="w", zarr_format=version)
    array = group.create_array(
        "0", shape=MOVIE.shape, chunks=(1, 2, 12, 16), dtype="u2", compressors=[blosc]
    )
    array[:] = MOVIE
    axes = [{"name": "t", "type": "time", "unit": "second"}]
    axes += [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    datasets = [{"path": "0", "coordinateTransformations": SCALES}]
    header = {"multiscales": [{"axes": axes, "datasets": datasets}]}
    group.attrs.update(header if version == 2 else {"ome": {"version": "0.5", **header}})


def _zeiss(path):
    from pylibCZIrw import czi

    with czi.create_czi(str(path)) as file:
        for t, z in np.ndindex(MOVIE.shape[:2]):
            packed = "zstd1:ExplicitLevel=2" if t % 2 else "uncompressed:"
            file.write(MOVIE[t, z, :, :, None], plane={"T": t, "Z": z}, compression_options=packed)


def tables():
    """Yield the names of track tables, and functions that write them."""
    table = test_tables.planted()
    for name in ("t.csv", "t.csv.gz", "t.parquet", "t.gdf", "t.xyz", "t.napari.csv"):
        yield name, lambda p: perrin.write_tracks(table, p)
    texts = {
        "trackmate.csv": test_tables.trackmate_csv,
        "trackmate.xml": test_tables.trackmate_xml,
        "exported.xml": test_tables.trackmate_exported,
        "imaris.csv": test_tables.imaris,
        "motive.csv": test_tables.motive,
        "semicolons.csv": test_tables.semicolons,
        "unicode.txt": test_tables.excel_unicode,
        "t.xlsx": test_tables.xlsx,
    }
    for name, make in texts.items():
        yield name, lambda p, make=make: _write(p, make(table))
    yield "t.c3d", _c3d
    yield "t.gsd", _gsd


def _write(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())


def _c3d(path):
    import c3d

    writer = c3d.Writer(point_rate=100.0)
    for i in range(4):
        points = np.zeros((3, 5))
        points[:, :3] = np.arange(9).reshape(3, 3) + i
        writer.add_frames([(points, np.zeros((0, 0)))])
    writer.set_point_labels(["a", "b", "c"])
    with open(path, "wb") as file:
        writer.write(file)


def _gsd(path):
    import gsd.hoomd

    with gsd.hoomd.open(path, "w") as file:
        for i in range(3):
            frame = gsd.hoomd.Frame()
            frame.configuration.step = i
            frame.configuration.box = [9, 9, 9, 0, 0, 0]
            frame.particles.N = 3
            frame.particles.position = np.arange(9.0).reshape(3, 3) + 0.1 * i
            file.append(frame)


def _run(path):
    """Write a finished run without pictures."""
    body = perrin.Cluster.touching(3, 2.45)
    motion = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=DT, n_frames=8, rng=1)
    places = perrin.add_noise(motion.positions(), sigma=0.02, rng=2)
    frame, particle = np.indices(places.shape[:2])
    columns = dict(zip("xyz", places.reshape(-1, 3).T, strict=True))
    table = pd.DataFrame({"frame": frame.ravel(), "particle": particle.ravel(), **columns})
    perrin.analyze(table, dt=DT).save(path)


def _unchecked_run(path):
    """Write a run as earlier versions did, without checksums."""
    _run(path)
    (path / "checksums.json").unlink()


def _parts(path):
    """Write a folder of finished frames."""
    path.mkdir()
    write_sealed(path / "settings.json", {"size": 4})
    with PartWriter(path, seconds=0.0) as writer:
        for i in range(3):
            writer.add(pd.DataFrame({"frame": [i] * 2, "x": [0.5, i]}), {"frame": i, "fault": ""})


def _config(path):
    path.write_text('command = "analyze"\ndt = 0.5\nscale = [0.1, 0.2]\n')


def _spheres(path):
    path.write_text("x,y,z,radius\n0,0,0,1\n0,0,2.5,1.5\n")


def folders():
    """Yield the names of what a run writes, and functions that write it."""
    yield "run", _run
    yield "unchecked", _unchecked_run
    yield "parts", _parts
    yield "run.toml", _config
    yield "spheres.csv", _spheres


CORPORA = {"tiffs": tiffs, "stacks": stacks, "tables": tables, "folders": folders}


def write_corpus(place, kinds):
    """Write all files of these kinds whose libraries are installed; return their paths by name."""
    made = {}
    for kind in kinds:
        for name, write in CORPORA[kind]():
            path = place / name
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # what libraries advise those who write files
                    write(path)
            except ImportError:
                continue
            made[name] = path
    return made


def whole(path):
    """Return the content of a file, or of all files in a folder, by relative names."""
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    return {str(p.relative_to(path)) if path.is_dir() else "": p.read_bytes() for p in files}


def as_json(content):
    """Return a content by names as JSON, for a file of seeds."""
    import base64
    import zlib

    return json.dumps(
        {n: base64.b64encode(zlib.compress(data, 9)).decode() for n, data in content.items()}
    )
