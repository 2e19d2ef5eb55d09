"""Movies in object stores: OME-Zarr by address."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from perrin import open_stack
from perrin.images.stack import digest


def write_ome_zarr(place, movie):
    """Write an OME-Zarr image, a chunk for every frame."""
    zarr = pytest.importorskip("zarr", minversion="3")
    root = zarr.open_group(place, mode="w", zarr_format=2)
    root.create_array("0", data=movie, chunks=(1, *movie.shape[1:]))
    scale = {"type": "scale", "scale": [0.5, 0.3, 0.2, 0.2]}
    axes = [{"name": "t", "unit": "second"}]
    axes += [{"name": a, "unit": "micrometer"} for a in "zyx"]
    entry = {"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": [scale]}]}
    root.attrs["multiscales"] = [entry]


@pytest.mark.parametrize("store", ["memory", "file"])
def test_a_movie_is_read_by_address_and_by_range(store, tmp_path, monkeypatch):
    """Frames, times and sizes are those of the array; one frame reads one chunk."""
    # A reader in a process of its own, as users have it, shares no memory with this one.
    monkeypatch.setenv("PERRIN_GUARD", "off" if store == "memory" else "on")
    fsspec = pytest.importorskip("fsspec")
    movie = np.random.default_rng(1).integers(0, 900, (3, 4, 8, 8)).astype(np.uint16)
    address = f"memory://{tmp_path.name}/a.zarr" if store == "memory" else f"file://{tmp_path}/a"
    write_ome_zarr(address if store == "memory" else tmp_path / "a", movie)
    stack = open_stack(address)
    assert stack.path is None
    assert stack.dt == 0.5
    np.testing.assert_array_equal(stack.voxel, [0.3, 0.2, 0.2])
    np.testing.assert_array_equal(stack.frame(1), movie[1])
    first = digest(stack)
    # Other processes would import zarr again, which takes a second each.
    monkeypatch.setenv("PERRIN_GUARD", "off")
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(stack)).frame(1), movie[1])
    # A chunk that is missing in the store is not needed for the others.
    system, root = fsspec.core.url_to_fs(address)
    system.rm(next(p for p in system.find(root) if p.rsplit("/", 1)[0].endswith("0/0/0/0")
                   or p.endswith("0/0.0.0.0")))  # fmt: skip
    np.testing.assert_array_equal(open_stack(address).frame(2), movie[2])
    assert digest(open_stack(address)) != first
