"""Kinds of bodies in one run: same size and shape, pooled each by itself; single spheres."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import perrin
from left_out import leave_out_tensors, leave_out_verdicts
from perrin._text import with_error
from perrin.geometry.rotations import exp_map
from perrin.report.page import render_html
from perrin.run.experiment import Experiment, Recording
from perrin.run.kinds import part_of, shape_numbers
from perrin.run.measure import measure_free_spheres, measure_table
from perrin.run.results import Report
from perrin.run.singles import measure_singles

DIAMETER, DT, D_T = 2.45, 0.7, 0.05


def test_shapes_are_the_same_after_moves_and_permutations_and_noise():
    """Bipyramid and square pyramid, both of five touching spheres, differ; mirror images do not."""
    rng = np.random.default_rng(0)
    octahedron = perrin.Cluster.touching(6, DIAMETER).positions
    shapes = [
        perrin.Cluster.touching(4, DIAMETER).positions,
        octahedron[:5],
        perrin.Cluster.touching(5, DIAMETER).positions,
    ]
    many, true = [], []
    for k in rng.permutation(np.repeat(np.arange(3), 4)):
        x = rng.permutation(shapes[k]) @ exp_map(rng.normal(size=3)).T + rng.normal(size=3)
        many.append(x * [1, 1, rng.choice([-1, 1])] + 0.02 * rng.normal(size=x.shape))
        true.append(k)
    found = shape_numbers(many)
    pairs = set(zip(true, found.tolist(), strict=True))
    assert len(pairs) == 3
    assert (0, 0) in pairs  # the smallest number of particles comes first


def test_parts_of_bodies_are_recognised_in_any_pose():
    """Three or five spheres of an octahedron are a part of it; four of a tetrahedron are not."""
    rng = np.random.default_rng(1)
    octahedron = perrin.Cluster.touching(6, DIAMETER).positions
    turn = exp_map([0.4, -1.0, 0.3])
    for n in (3, 5):
        part = rng.permutation(octahedron)[:n] @ turn.T + 5.0
        assert part_of(part, octahedron)
        assert not part_of(octahedron, part)
        assert not part_of(1.3 * part, octahedron)
    assert not part_of(perrin.Cluster.touching(4, DIAMETER).positions, octahedron)


@pytest.fixture(scope="module")
def mixed():
    """Return a table of two tetrahedra, two trimers and two dimers with tenfold D of each."""
    tables, first = [], 0
    planted = ((4, 1e-3), (3, 1e-2), (2, 1e-2), (4, 1e-3), (3, 1e-2), (2, 1e-2))
    for number, (n, D_R) in enumerate(planted):
        truth = perrin.simulate_motion(
            perrin.Cluster.touching(n, DIAMETER),
            D_R=D_R, D_T=10 * D_R, dt=DT, n_frames=210, rng=number,
        )  # fmt: skip
        x = perrin.add_noise(truth.positions(), sigma=0.01, rng=10 + number)
        table = perrin.positions_table(x).assign(cluster=number)
        table["particle"] += first
        first += n
        tables.append(table)
    return pd.concat(tables, ignore_index=True)


@pytest.fixture(scope="module")
def report(mixed):
    with pytest.MonkeyPatch.context() as patch:
        leave_out_tensors(patch)
        leave_out_verdicts(patch)
        return perrin.analyze(mixed, dt=DT)


def leaves(entry):
    """Yield the values of nested dictionaries and lists in order."""
    if isinstance(entry, dict | list):
        for part in entry.values() if isinstance(entry, dict) else entry:
            yield from leaves(part)
    else:
        yield entry


@pytest.mark.usefixtures("no_tensors")
@pytest.mark.usefixtures("no_verdicts")
def test_each_kind_has_pooled_values_of_its_own(mixed, report):
    """They are those of the bodies of this kind alone; nothing is pooled over kinds."""
    assert [kind.size for kind in report.kinds] == [2, 3, 4]
    assert [kind.point_group for kind in report.kinds] == ["D_inf_h", "D_3h", "T_d"]
    assert [kind.clusters for kind in report.kinds] == [(2, 5), (1, 4), (0, 3)]
    assert report.pooled is None
    for kind in report.kinds:
        alone = perrin.analyze(mixed[mixed["cluster"].isin(kind.clusters)], dt=DT)
        (only,) = alone.kinds
        assert only.size == kind.size
        # Bodies that are fitted together end their searches within rounding of each other.
        assert list(leaves(only.to_dict())) == [
            pytest.approx(value, rel=1e-7) if isinstance(value, float) else value
            for value in leaves(kind.to_dict())
        ]
        assert [name for name, _ in kind.coefficients] == [
            "D_perp" if kind.size == 2 else "D_R",
            "D_T",
        ]
        for name, estimate in kind.coefficients:
            planted = 1e-3 if kind.size == 4 else 1e-2
            off = estimate.value - (10 * planted if name == "D_T" else planted)
            assert abs(off) < 3.5 * estimate.stderr
    assert [r.cluster for r in report.clusters] == [1, 4, 0, 3]
    names = [(e["kind"]["size"], e["cluster"]) for e in report.to_dict()["clusters"]]
    assert names == [(2, 2), (2, 5), (3, 1), (3, 4), (4, 0), (4, 3)]


def free_spheres(count, frames, seed):
    """Return tracks of free spheres with noise."""
    rng = np.random.default_rng(seed)
    x = np.sqrt(2 * D_T * DT) * rng.normal(size=(frames, count, 3))
    x = x.cumsum(axis=0) + 0.02 * rng.normal(size=x.shape)
    table = pd.DataFrame(x.reshape(-1, 3), columns=list("xyz"))
    number = np.tile(np.arange(count), frames)
    return table.assign(frame=np.repeat(np.arange(frames), count), particle=number)


def test_single_spheres_have_one_planted_coefficient(repeats):
    """Its stated error covers the scatter; the order of rows and lost detections do not matter."""
    off = []
    for seed in range(repeats(20, 200)):
        table = free_spheres(12, 25, seed)
        lost = np.random.default_rng(seed).random(len(table)) < 0.1
        found = measure_singles(table[~lost], perrin.Noise(), Recording(dt=DT))
        off.append((found.D_T.value - D_T) / found.D_T.stderr)
    # The scatter of 20 numbers is known to 16 %.
    assert 0.55 < np.std(off) < 1.5
    assert abs(np.mean(off)) < 4 / np.sqrt(len(off))
    shuffled = table[~lost].sample(frac=1, random_state=1)
    again = measure_singles(shuffled, perrin.Noise(), Recording(dt=DT))
    assert again.D_T.value == pytest.approx(found.D_T.value, rel=1e-9)
    assert measure_singles(table[:20], perrin.Noise(), Recording(dt=DT)) is None


def test_a_movie_of_free_spheres_has_a_report_without_clusters(tmp_path):
    """It names no cluster, says why, has D_T, and comes back from its folder."""
    table = free_spheres(12, 25, 3).assign(frame=lambda t: t["frame"] + 7)
    run = {"source": {"path": None, "sha256": None}, "arguments": {}}
    found = measure_free_spheres(table, Experiment(dt=DT), Recording(dt=DT), **run)
    assert found.clusters == ()
    assert found.pooled is None
    assert "free spheres" in found.warnings[0]
    assert found.singles.n_tracks == 12
    perrin.write_run(found, tmp_path / "run")
    back = perrin.load_run(tmp_path / "run")
    assert back.to_dict() == found.to_dict()
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Translational diffusion of single spheres" in page
    assert "12" in page
    with pytest.raises(perrin.DegenerateClusterError, match="too few frames"):
        measure_free_spheres(table[:20], Experiment(dt=DT), Recording(dt=DT), **run)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_kinds_and_single_spheres_come_back_and_are_on_the_page(mixed, tmp_path):
    """The folder of a run with several kinds and single spheres holds all of them."""
    run = {"source": {"path": None, "sha256": None}, "arguments": {}}
    known = measure_table(
        mixed[mixed["frame"] < 15].copy(), Experiment(dt=DT), singles=free_spheres(12, 25, 3),
        recording=Recording(dt=DT), **run,
    )  # fmt: skip
    known.save(tmp_path / "run")
    back = perrin.load_run(tmp_path / "run")
    assert isinstance(back, Report)
    assert back.to_dict() == known.to_dict()
    page = render_html(back, [])
    for text in ("3, D_3h", "4, T_d", "2, D_∞_h", "1 (single spheres)"):
        assert text in page


def test_the_text_of_a_report_names_every_kind(report):
    """Each with its pooled coefficients and their errors, as in the table."""
    assert f"{len(report.kinds)} kinds" in repr(report)
    lines = str(report).splitlines()
    for kind in report.kinds:
        (line,) = [one for one in lines if one.startswith(f"  {kind.name}, pooled: ")]
        for name, found in kind.coefficients:
            assert f"{name} = {with_error(found.value, found.stderr)} {found.unit}" in line
