"""The imaging results of a run are read back as they were written."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from perrin.images.imaging import Imaging, View, read_imaging, write_imaging
from perrin.images.optics.optics import CameraNoise, Optics


def imaging(**changes):
    rng = np.random.default_rng(8)
    features = pd.DataFrame(rng.normal(5, 1, (6, 4)), columns=["x", "y", "z", "mass"])
    features.insert(0, "frame", [3, 3, 3, 11, 11, 11])
    features["sigma_x"] = [0.004, np.nan, 0.005, 0.004, 0.004, 0.004]
    features["refined"] = [True, False, True, True, True, True]
    features["reason"] = ["", "did not settle", "", "", "", ""]
    features["cluster"] = [0, 0, -1, 0, 0, -1]
    frames = pd.DataFrame({"frame": [3, 11], "time": [0.3, 1.1], "fault": ["", 'page "7" <cut>']})
    usual = Imaging(
        features=features,
        frames=frames,
        spots=features[["frame", "mass"]],
        views=tuple(
            View(k, *(rng.normal(size=shape) for shape in ((4, 5), (3, 5), (3, 4))))
            for k in (3, 11)
        ),
        optics=Optics(2.4, (0.41, 0.152), CameraNoise(3.1, -2.0), (0.1, 0.2, 0.3)),
        minmass=np.pi * 1e3,
        voxel=(0.25, 0.2, 1 / 3),
        diameter=2.45,
        contact=2.5,
        dark=True,
        refine="model",
    )
    return replace(usual, **changes)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"optics": None, "refine": None, "dark": False, "minmass": 0.0},
        {"voxel": (np.nan, 0.2, 0.2)},
        {"views": ()},
        {"views": tuple(View(k, *[np.full((2, 2), k)] * 3) for k in (2, 10, 100))},
    ],
    ids=["all", "not refined", "plane", "no views", "many views"],
)
def test_the_round_trip_is_exact(tmp_path, changes):
    """Tables, grey levels and numbers to the last bit, views in the order of their frames."""
    written = imaging(**changes)
    write_imaging(written, tmp_path)
    back = read_imaging(tmp_path)
    for name in ("features", "frames", "spots"):
        pd.testing.assert_frame_equal(getattr(back, name), getattr(written, name), check_exact=True)
    for one, other in zip(back.views, written.views, strict=True):
        assert one.frame == other.frame
        for side in ("xy", "xz", "yz"):
            assert np.array_equal(getattr(one, side), getattr(other, side))
            assert getattr(one, side).dtype == getattr(other, side).dtype
    assert np.array_equal(back.voxel, written.voxel, equal_nan=True)
    for name in ("optics", "minmass", "diameter", "contact", "dark", "refine"):
        assert getattr(back, name) == getattr(written, name), name


def test_the_results_survive_json():
    """What `from_dict` reads from the JSON of `to_dict` equals the original, gaps included."""
    written = imaging(voxel=(np.nan, 0.2, 0.2))
    back = Imaging.from_dict(json.loads(json.dumps(written.to_dict())))
    for name in ("features", "frames", "spots"):
        pd.testing.assert_frame_equal(getattr(back, name), getattr(written, name), check_exact=True)
    for one, other in zip(back.views, written.views, strict=True):
        assert one.frame == other.frame
        assert all(np.array_equal(getattr(one, s), getattr(other, s)) for s in ("xy", "xz", "yz"))
    assert np.array_equal(back.voxel, written.voxel, equal_nan=True)
    for name in ("optics", "minmass", "diameter", "contact", "dark", "refine"):
        assert getattr(back, name) == getattr(written, name), name


def test_imaging_json_keeps_its_keys(tmp_path):
    """The file has the keys of earlier versions; a tail and a spread have been added."""
    written = imaging()
    write_imaging(written, tmp_path)
    entry = json.loads((tmp_path / "imaging.json").read_text())
    assert list(entry) == [
        "optics", "minmass", "voxel", "diameter", "contact", "dark", "refine",
    ]  # fmt: skip
    assert entry["optics"] == {
        "diameter": 2.4, "psf": [0.41, 0.152], "noise": [3.1, -2.0], "stderr": [0.1, 0.2, 0.3],
        "tail": None, "spread": 0.0,
    }  # fmt: skip


def test_a_missing_file_is_named(tmp_path):
    write_imaging(imaging(), tmp_path)
    (tmp_path / "spots.parquet").unlink()
    with pytest.raises(FileNotFoundError, match=r"spots\.parquet"):
        read_imaging(tmp_path)
