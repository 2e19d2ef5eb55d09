"""A damaged file of a run is found when it is read, whatever the damage."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.images.imaging import Imaging, View
from perrin.movie.parts import PartWriter, open_parts, read_parts
from perrin.tracks.checksums import CHECKSUMS, CheckedFiles, read_sealed, write_sealed


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Write a run with one cluster, and images; return its folder."""
    body = perrin.Cluster.touching(4, 2.45)
    motion = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=20, rng=1)
    places = perrin.add_noise(motion.positions(), sigma=0.02, rng=2)
    frame, particle = np.indices(places.shape[:2])
    columns = dict(zip("xyz", places.reshape(-1, 3).T, strict=True))
    table = pd.DataFrame({"frame": frame.ravel(), "particle": particle.ravel(), **columns})
    report = perrin.analyze(table, dt=0.7)
    spheres = table.assign(mass=1.0, cluster=0, piece=0)
    frames = pd.DataFrame({"frame": np.arange(20), "time": 0.7 * np.arange(20), "fault": ""})
    views = (View(0, np.ones((4, 5)), np.ones((3, 5)), np.ones((3, 4))),)
    imaging = Imaging(
        spheres, frames, spheres[["frame", "mass"]], views, None, 0.0, (0.3, 0.2, 0.2), 2.45, 2.45,
        False, None,
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("runs") / "run"
    from dataclasses import replace

    replace(report, imaging=imaging).save(folder)
    return folder


def damaged(data, rng):
    """Return bytes with a flipped bit, a part that is lost, zeros, or other bytes."""
    kind = rng.integers(5)
    at = int(rng.integers(len(data)))
    if kind < 2:
        return data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :]
    if kind == 2:
        return data[:at]
    end = at + int(rng.integers(1, 600))
    other = b"\0" * (end - at) if kind == 3 else rng.bytes(end - at)
    return (data[:at] + other + data[end:])[: len(data)]


def test_no_damage_of_a_finished_run_is_accepted(saved, tmp_path, repeats):
    """Every damage is refused with the file's name, or the data are the same."""
    rng = np.random.default_rng(21)
    folder = tmp_path / "run"
    shutil.copytree(saved, folder)
    whole = perrin.load_run(folder)
    names = sorted(p.name for p in folder.iterdir() if p.suffix not in (".csv", ".toml"))
    assert len(names) == 10
    accepted = 0
    for _ in range(repeats(25, 3000)):
        name = names[rng.integers(len(names))]
        data = (saved / name).read_bytes()
        hurt = damaged(data, rng)
        if hurt == data:
            continue
        (folder / name).write_bytes(hurt)
        try:
            report = perrin.load_run(folder)
        except perrin.DamagedFileError as refused:
            assert name in str(refused) or name == CHECKSUMS  # noqa: PT017
            assert str(refused).count("\n") == 0  # noqa: PT017
        else:
            # Blanks and names of other files in the list of checksums are no data.
            assert name == CHECKSUMS
            assert report == whole
            accepted += 1
        (folder / name).write_bytes(data)
    assert accepted < 0.05 * repeats(25, 3000)
    assert perrin.load_run(folder) == whole


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("summary.json", b"{}"),
        ("summary.json", b'{"clusters": [7]'),
        ("run.json", b"\xff"),
        ("motion.parquet", b"PAR1"),
        ("tracks.parquet", b""),
        ("views.npz", b"PK\x03\x04"),
        ("features.parquet", b"PAR1PAR1"),
    ],
)
def test_a_folder_without_checksums_is_read_and_its_damage_refused(saved, tmp_path, name, content):
    """Runs of earlier versions have no checksums; the decoder's errors name the file."""
    folder = tmp_path / "run"
    shutil.copytree(saved, folder)
    (folder / CHECKSUMS).unlink()
    perrin.load_run(folder)
    (folder / name).write_bytes(content)
    where = "run" if content == b"{}" else name.replace(".", r"\.")
    with pytest.raises(perrin.DamagedFileError, match=rf"{where}: is damaged \(\w+: .*backup"):
        perrin.load_run(folder)


def test_missing_files_are_named(saved, tmp_path):
    """Also those that only the list of checksums knows of."""
    folder = tmp_path / "run"
    shutil.copytree(saved, folder)
    for name in ("imaging.json", "tracks.parquet", "summary.json"):
        (folder / name).rename(tmp_path / name)
        with pytest.raises(FileNotFoundError, match=name.replace(".", r"\.")):
            perrin.load_run(folder)
        (tmp_path / name).rename(folder / name)


def test_no_damage_of_a_part_is_accepted(tmp_path, repeats):
    """A part that is damaged is removed and named; the others are read as they were written."""
    rng = np.random.default_rng(5)
    with PartWriter(tmp_path, seconds=0.0) as writer:
        for i in range(3):
            table = pd.DataFrame({"frame": i, "x": rng.normal(size=4), "y": np.arange(4.0)})
            writer.add(table, {"frame": i, "digest": "a" * i})
    parts = sorted(tmp_path.iterdir())
    assert len(parts) == 3
    whole, entries, _ = read_parts(tmp_path)
    assert whole["frame"].tolist() == [0] * 4 + [1] * 4 + [2] * 4
    data = parts[1].read_bytes()
    for _ in range(repeats(25, 2000)):
        hurt = damaged(data, rng)
        parts[1].write_bytes(hurt)
        table, kept, bad = read_parts(tmp_path)
        if hurt == data:
            continue
        assert bad == [parts[1].name]
        assert not parts[1].exists()
        pd.testing.assert_frame_equal(
            table, whole[whole["frame"] != 1].reset_index(drop=True), check_exact=True
        )
        assert kept == entries[::2]


def test_a_part_that_the_disk_does_not_give_is_kept(tmp_path, monkeypatch):
    """An error of the disk is no damage of the part."""
    with PartWriter(tmp_path) as writer:
        writer.add(pd.DataFrame({"frame": [0]}), {"frame": 0})
    (part,) = tmp_path.iterdir()
    part.rename(tmp_path / "elsewhere")
    part.mkdir()
    with pytest.raises(IsADirectoryError):
        read_parts(tmp_path)
    assert part.exists()


def test_sealed_settings(tmp_path, repeats):
    """No damage gives other settings; what JSON changes, such as tuples, is no damage."""
    rng = np.random.default_rng(8)
    path = tmp_path / "settings.json"
    content = {"voxel": (0.25, None, 1e-7), "name": "µ", "n": np.int64(3), "ok": True}
    write_sealed(path, content)
    plain = {"voxel": [0.25, None, 1e-7], "name": "µ", "n": 3, "ok": True}
    assert read_sealed(path) == plain
    data = path.read_bytes()
    for _ in range(repeats(150, 20000)):
        path.write_bytes(damaged(data, rng))
        try:
            assert read_sealed(path) == plain
        except perrin.DamagedFileError as refused:
            assert "settings.json" in str(refused)  # noqa: PT017
    path.write_bytes(data.replace(b"0.25", b"0.35"))
    with pytest.raises(perrin.DamagedFileError, match=r"settings\.json: is damaged \(it does not"):
        open_parts(tmp_path, plain)
    assert json.loads(data)["content"] == plain


def test_a_list_of_checksums_that_is_none(tmp_path):
    """A list of another kind is refused by its name."""
    for content in (b"{}", b"[]", b'{"blake2b-128": {"a": 3}}', b'{"blake2b-128": 3}', b"\xff"):
        (tmp_path / CHECKSUMS).write_bytes(content)
        with pytest.raises(perrin.DamagedFileError, match=r"checksums\.json: is damaged"):
            CheckedFiles.of(tmp_path)
