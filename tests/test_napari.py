"""Layers of napari: the numbers of a run in napari's order, without napari."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import perrin
from left_out import leave_out_tensors, leave_out_verdicts
from perrin.run.layers import napari_layers, napari_reader, table_layers
from perrin.tracks.formats import READABLE_SUFFIXES


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """Return a tetrahedron and a trimer of dumbbell labels, from frame 5 on, one point missing."""
    tables = []
    for k, size in enumerate((4, 2)):
        body = perrin.Cluster.touching(size, 2.0)
        truth = perrin.simulate_motion(body, D_R=0.02, D_T=0.05, dt=0.5, n_frames=40, rng=k)
        x = truth.positions() + 30.0 * k
        tables.append(perrin.positions_table(perrin.add_noise(x, sigma=0.01, rng=k)))
        tables[-1]["cluster"] = k
    table = pd.concat(tables, ignore_index=True).assign(frame=lambda t: t["frame"] + 5)
    table.loc[6, ["x", "y", "z"]] = np.nan
    return table


@pytest.fixture(scope="module")
def report(table: pd.DataFrame) -> perrin.Report:
    with pytest.MonkeyPatch.context() as patch:
        leave_out_tensors(patch)
        leave_out_verdicts(patch)
        return perrin.analyze(table, dt=0.5)


def test_points_lie_at_fixed_places_of_the_drawn_axes(table, report):
    """Points minus centre, along the arrows of their frame, are the shape within 5 sigma."""
    points, tracks, vectors = napari_layers(report)
    assert [layer[2] for layer in (points, tracks, vectors)] == ["points", "tracks", "vectors"]
    data, about = points[:2]
    known = table.dropna()
    np.testing.assert_array_equal(data[:, 0], known["frame"])
    np.testing.assert_allclose(data[:, 1:], known[["z", "y", "x"]])
    arrows = vectors[0][vectors[1]["features"]["cluster"] == "0"]
    motion = report.clusters[0].motion
    assert len(arrows) == 3 * 40
    np.testing.assert_allclose(np.linalg.norm(arrows[:, 1], axis=1), motion.R)
    ours = data[about["features"]["cluster"] == 0]
    for frame in (5, 20, 44):
        start, direction = np.moveaxis(arrows[arrows[:, 0, 0] == frame][:, :, 1:], 1, 0)
        offsets = ours[ours[:, 0] == frame][:, 1:] - start[0]
        places = offsets @ direction.T / motion.R
        np.testing.assert_allclose(places, motion.template[: len(places)], atol=0.05)
    rod = vectors[0][vectors[1]["features"]["cluster"] == "1"]
    np.testing.assert_allclose(np.linalg.norm(rod[:, 1], axis=1), 1.0, atol=0.02)


def test_tracks_are_sorted_by_id_and_time_whatever_the_rows(table):
    """Permuted rows give the same paths; ids of two clusters stay apart."""
    plain = table_layers(table)[1][0]
    mixed = table_layers(table.sample(frac=1, random_state=2))[1][0]
    assert (np.lexsort((plain[:, 1], plain[:, 0])) == np.arange(len(plain))).all()
    assert len(np.unique(plain[:, 0])) == 6
    by_path = [np.sort(layer[:, 1:].view("f8,f8,f8,f8"), axis=0) for layer in (plain, mixed)]
    assert (by_path[0] == by_path[1]).all()
    flat = table_layers(table.drop(columns="z"))
    assert flat[0][0].shape[1] == 3
    np.testing.assert_array_equal(flat[1][0][:, 2:], plain[:, 3:])


def test_the_reader_gives_the_layers_of_run_folders_and_tables(table, report, tmp_path):
    """A run folder read back gives the layers of its report; a table its points and tracks."""
    from perrin.run.results import write_data

    folder = tmp_path / "run"
    folder.mkdir()
    write_data(report, folder)
    perrin.write_tracks(table, tmp_path / "t.csv")
    for path, expected in (
        (folder, napari_layers(report)),
        (tmp_path / "t.csv", table_layers(table)),
    ):
        read = napari_reader(str(path))
        assert read is not None
        for (data, about, kind), (data2, about2, kind2) in zip(
            read(str(path)), expected, strict=True
        ):
            np.testing.assert_allclose(data, data2)
            assert kind == kind2
            assert about.keys() == about2.keys()
    assert napari_reader(str(tmp_path)) is None
    assert napari_reader(["a.csv", "b.csv"]) is None


def test_the_manifest_names_a_function_that_exists_and_every_suffix():
    """Napari finds the reader by the entry point, for every file that can be read."""
    yaml = pytest.importorskip("yaml")
    root = Path(perrin.__file__).parent
    manifest = yaml.safe_load((root / "napari.yaml").read_text())
    (command,) = manifest["contributions"]["commands"]
    module, function = command["python_name"].split(":")
    assert getattr(import_module(module), function) is napari_reader
    (reader,) = manifest["contributions"]["readers"]
    assert reader["command"] == command["id"]
    assert reader["accepts_directories"]
    assert set(reader["filename_patterns"]) == {f"*{suffix}" for suffix in READABLE_SUFFIXES}
