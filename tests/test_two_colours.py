"""Clusters of spheres in two colours, of which each channel shows one, are those of one colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import perrin
from left_out import leave_out_tensors, leave_out_verdicts
from perrin.movie.colours import channel_offset, one_of_each
from perrin.movie.stacks import with_own_times

pytest.importorskip("trackpy")

DIAMETER, DT, FRAMES = 2.45, 0.73, 3
SHIFT = np.array([0.12, -0.09, 0.2])
CENTERS = np.array([(4.2, 4.2, 4.3), (10.2, 9.6, 4.4)])
SCENE = {
    "voxel": (0.35, 0.3, 0.3),
    "shape": (25, 46, 48),
    "diameter": DIAMETER,
    "psf": (0.4, 0.15, 0.15),
    "background": 5,
    "gain": 3,
    "dt": DT,
}
SEARCH = {"diameter": DIAMETER, "contact": DIAMETER}


def planted(n_frames=FRAMES, shapes=(3, 4)):
    """Return motions of clusters, and the kind of each of their spheres: the first is of kind 1."""
    motions = [
        perrin.simulate_motion(
            perrin.Cluster.touching(n, DIAMETER),
            D_R=5e-3,
            D_T=0.01,
            dt=DT,
            n_frames=n_frames,
            rng=40 + n,
        )
        for n in shapes
    ]
    return motions, [(np.arange(n) == 0).astype(int) for n in shapes]


@pytest.fixture(scope="module")
def channels():
    """Return a movie of each channel, the second shifted and half as bright, and the truth."""
    motions, kinds = planted()
    x = np.concatenate([m.positions() + c for m, c in zip(motions, CENTERS, strict=True)], axis=1)
    kind = np.concatenate(kinds)
    movies = []
    for k in (0, 1):
        drawn = perrin.render_stack(
            x[:, kind == k] + k * SHIFT, photons=(80, 40)[k], rng=k, **SCENE
        )
        movies.append(perrin.open_stack(np.stack(list(drawn)), voxel=drawn.voxel, dt=DT))
    return movies, motions, kinds


@pytest.fixture(scope="module")
def report(channels):
    with pytest.MonkeyPatch.context() as patch:
        leave_out_tensors(patch)
        leave_out_verdicts(patch)
        return perrin.analyze_stack(channels[0], **SEARCH)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_clusters_of_two_colours_give_what_their_true_positions_give(channels, report):
    """All are found, with D_R and D_T of the true positions within 0.2 standard errors."""
    _, motions, _ = channels
    sizes = sorted(len(c.motion.template) for c in report.clusters)
    assert sizes == [3, 4]
    for found in report.clusters:
        (truth,) = [m for m in motions if len(m.template) == len(found.motion.template)]
        for quantity, name in (("rotation", "D_R"), ("translation", "D_T")):
            true = perrin.estimate_diffusion(
                perrin.track_rotation(truth.positions(), dt=DT), quantity=quantity
            )
            off = getattr(found, name).value - true.value
            assert abs(off) < 0.2 * true.stderr, (name, off / true.stderr)
        assert found.motion.residual.max() < 0.03  # a shift of 0.25 um would leave 0.1


def test_the_shift_of_a_channel_is_measured_and_stated(report):
    """It comes back within four standard errors (under 10 nm), and stands in the notes."""
    (shift,) = report.imaging.channel_offsets
    assert np.abs(np.subtract(shift, SHIFT)).max() < 0.02
    assert any("channel 1 is offset against channel 0 by" in note for note in report.notes)


def test_every_sphere_keeps_its_kind(report):
    """The first particle of each cluster is of kind 1: 2 + 1 and 3 + 1 spheres."""
    own = report.imaging.features.query("cluster >= 0")
    kinds = own.groupby(["cluster", "particle"])["kind"]
    assert (kinds.nunique() == 1).all()
    assert sorted(kinds.first().groupby("cluster").sum()) == [1, 1]
    assert "kind" in report.tracks
    (note,) = [note for note in report.notes if "column kind" in note]
    assert "1 cluster of 2 + 1" in note
    assert "1 cluster of 3 + 1" in note
    assert not report.warnings


def test_a_report_of_two_channels_reads_back(tmp_path, report):
    """Optics and shift of every channel are in the folder and on the page."""
    report.save(tmp_path / "run")
    again = perrin.load_run(tmp_path / "run")
    assert again.imaging.to_dict() == report.imaging.to_dict()
    assert len(again.imaging.other_optics) == 1


def test_channels_of_different_movies_are_refused():
    """Other shapes, voxels and times are named in one message."""
    movie = np.zeros((3, 4, 16, 16))
    one = perrin.open_stack(movie, voxel=(1, 1, 1), dt=0.5)
    late = replace(one, times=one.times + 0.6, voxel=np.array([1.0, 2.0, 1.0]))
    with pytest.raises(ValueError, match=r"voxels \[1.0, 2.0, 1.0\] um.*up to 0.6 s"):
        perrin.analyze_stack([one, late], diameter=2.0, contact=2.0)
    with pytest.raises(ValueError, match="stack 1 has shape"):
        perrin.analyze_stack([one, replace(one, shape=(2, 4, 16, 16))], diameter=2.0, contact=2.0)
    with pytest.raises(ValueError, match="expected a stack or several, got none"):
        perrin.analyze_stack([], diameter=2.0, contact=2.0)


def test_channels_recorded_one_after_another_have_their_own_times():
    """A sphere has the time of its channel's frame, and that of the planes through it."""
    one = perrin.open_stack(np.zeros((3, 4, 8, 8)), voxel=(0.5, 1, 1), dt=1.0)
    late = replace(one, times=one.times + 0.25)
    table = pd.DataFrame({"frame": [0, 2], "z": [1.0, 1.5], "kind": [0, 1]})
    assert with_own_times(table, one, late)["delay"].tolist() == [0.0, 0.25]
    scanned = replace(one, plane_time=0.01)
    assert np.allclose(with_own_times(table, scanned, late)["delay"], [0.02, 0.28])
    assert "delay" not in with_own_times(table, one, one)


def test_the_light_of_the_other_dye_makes_no_spheres():
    """Dim copies of the spheres of another channel are left out, whatever the gain of each."""
    rng = np.random.default_rng(7)
    x = 10.0 * np.arange(40)[:, None] + rng.normal(0, 0.05, (40, 3))
    kind = np.arange(40) % 2
    spheres = pd.DataFrame(x, columns=["x", "y", "z"]).assign(frame=0, kind=kind)
    spheres["mass"] = np.where(kind == 0, 900.0, 30.0) * rng.uniform(0.9, 1.1, 40)
    copies = spheres.assign(kind=1 - kind, mass=np.where(kind == 0, 9.0, 200.0), x=x[:, 0] + 0.2)
    left = one_of_each(pd.concat([copies, spheres], ignore_index=True), contact=2.0)
    pd.testing.assert_frame_equal(left[spheres.columns], spheres)


def test_a_shift_comes_back_within_its_error():
    """The squares over the stated ones of 30 planted shifts average 1 within 3 errors (0.45)."""
    ratio = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        away = rng.normal(size=(60, 3))
        away *= rng.normal(2.0, 0.02, 60)[:, None] / np.linalg.norm(away, axis=1)[:, None]
        away[:6] *= 1.2  # near, and not in contact
        one = 20.0 * np.arange(60)[:, None] + rng.normal(size=(60, 3))
        x = np.concatenate([one, one + away + SHIFT])
        table = pd.DataFrame(x, columns=["x", "y", "z"]).assign(frame=0, kind=np.repeat([0, 1], 60))
        found = channel_offset(table, 1, contact=2.0)
        ratio.append(((found.value - SHIFT) / found.stderr) ** 2)
    assert abs(np.mean(ratio) - 1) < 0.45


def test_the_command_line_reads_kinds_of_channels():
    """0,1 is a sum, 0:1 are two kinds; what cannot be two kinds is refused."""
    from perrin.cli.options import read_channels

    assert read_channels("0:1") == [0, 1]
    for wrong in ("0:", "0:0", "0,1:1"):
        with pytest.raises(ValueError, match="--channel"):
            read_channels(wrong)
