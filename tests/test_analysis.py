"""`analyze`: the right clusters and coefficients of tables, and refused tables."""

from __future__ import annotations

import json
import re
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import perrin
import perrin.run
from perrin.diffusion.noise_model import Noise
from perrin.report.page import render_html

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data" / "optitrack"


# From 200 steps on, and below 20, no test of Brownian motion is ranked among draws: this is half of
# the time of an analysis.
LENGTH, SHORT = 210, 20


def tracks(*, seed: int = 0, n_frames: int = LENGTH, cluster: int = 0, sigma: float = 0.03):
    rng = np.random.default_rng(seed)
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(4, 2.45), D_R=5e-3, D_T=0.04, dt=0.73, n_frames=n_frames, rng=rng
    )
    table = perrin.positions_table(perrin.add_noise(truth.positions(), sigma=sigma, rng=rng))
    shift = [20.0 * cluster, -5.0, 3.0]
    table[["x", "y", "z"]] += shift
    return table.assign(cluster=cluster, particle=table["particle"] + 4 * cluster)


def values(report: perrin.Report) -> np.ndarray:
    return np.array([[c.D_R.value, *c.D_R.ci95, c.D_T.value, *c.D_T.ci95] for c in report.clusters])


@pytest.fixture
def everything() -> None:
    """Leave nothing out of the analyses of a test."""


@pytest.fixture(autouse=True)
def coefficients_alone(request: pytest.FixtureRequest) -> None:
    """Leave out the kind of motion and the tensor, but where results are written or compared."""
    if not {"tmp_path", "everything"} & set(request.fixturenames):
        request.getfixturevalue("no_tensors")
        request.getfixturevalue("no_verdicts")


@pytest.fixture(scope="module")
def base() -> pd.DataFrame:
    return tracks(seed=4)


@pytest.fixture(scope="module")
def short(base: pd.DataFrame) -> pd.DataFrame:
    return base[base["frame"] < SHORT]


@pytest.fixture(scope="module")
def whole(base: pd.DataFrame) -> perrin.Report:
    return perrin.analyze(base, dt=0.73)


@pytest.fixture(scope="module")
def answer(whole: perrin.Report) -> np.ndarray:
    return values(whole)


@pytest.fixture(scope="module")
def short_answer(short: pd.DataFrame) -> np.ndarray:
    return values(perrin.analyze(short, dt=0.73))


@pytest.fixture(scope="module")
def sized(base: pd.DataFrame) -> perrin.Report:
    return perrin.analyze(base, dt=0.73, **KNOWN)


@pytest.mark.parametrize(
    "change",
    [
        lambda t: t.sample(frac=1.0, random_state=1),
        lambda t: t.assign(particle=t["particle"].map({0: 91, 1: 7, 2: 55, 3: 8})),
        lambda t: t.assign(particle=t["particle"].map({0: "a", 1: "c", 2: "d", 3: "b"})),
        lambda t: t.assign(frame=t["frame"] + 1000),
        lambda t: t.assign(x=t["x"] + 1e4, y=t["y"] - 3e3),
        lambda t: t.assign(x=t["y"], y=-t["x"]),
    ],
    ids=["rows shuffled", "ids permuted", "text ids", "frames renumbered", "moved", "turned"],
)
def test_the_same_table_written_otherwise_gives_the_same_answer(short, short_answer, change):
    """Row order, ids, frame numbers, origin and axes of the lab do not matter (1e-7)."""
    np.testing.assert_allclose(
        values(perrin.analyze(change(short), dt=0.73)), short_answer, rtol=1e-7
    )


def test_a_rotated_lab_gives_the_same_answer(short, short_answer):
    """A rotation by any angle mixes the lab axes; D_R, D_T and their intervals stay (1e-7)."""
    turn = perrin.simulate_motion(
        perrin.Cluster.trimer(1.0), D_R=1.0, dt=1.0, n_frames=2, rng=3
    ).rotation[1]
    turned = short.copy()
    turned[["x", "y", "z"]] = short[["x", "y", "z"]].to_numpy() @ turn.T
    np.testing.assert_allclose(values(perrin.analyze(turned, dt=0.73)), short_answer, rtol=1e-7)


def test_units_scale_the_answer(short, short_answer):
    """Millimetres read with scale 1000 give the same; another dt divides every coefficient."""
    mm = short.assign(**{a: short[a] / 1000 for a in "xyz"})
    np.testing.assert_allclose(
        values(perrin.analyze(mm, dt=0.73, scale=1000)), short_answer, rtol=1e-7
    )
    np.testing.assert_allclose(values(perrin.analyze(short, dt=7.3)), short_answer / 10, rtol=1e-7)


def test_anisotropic_scale_undoes_anisotropic_pixels(short, short_answer):
    """One scale per axis turns voxels into um."""
    voxels = short.assign(x=short["x"] / 0.2, y=short["y"] / 0.2, z=short["z"] / 0.25)
    report = perrin.analyze(voxels, dt=0.73, scale=(0.2, 0.2, 0.25))
    np.testing.assert_allclose(values(report), short_answer, rtol=1e-7)


def test_frames_and_particles_may_be_missing(short):
    """Dropping frames and single points leaves D_R within its error; both are counted in notes."""
    thinned = short[
        (short["frame"] % 10 != 3) & ~((short["frame"] == 7) & (short["particle"] == 2))
    ]
    thinned = thinned[~((thinned["frame"] == 9) & (thinned["particle"] < 2))]
    report = perrin.analyze(thinned, dt=0.73)
    (result,) = report.clusters
    (full,) = perrin.analyze(short, dt=0.73).clusters
    assert result.motion.fitted.size == SHORT - 2 - 1
    assert result.motion.n_present[7] == 3
    assert "2 of 4 particles" in result.motion.reason[9]
    assert abs(result.D_R.value - full.D_R.value) < full.D_R.stderr
    assert any("frames without a pose: 1 of 18" in w for w in result.notes)
    assert any("2 frame numbers have no row (the first is 3)" in w for w in report.notes)


def test_nan_coordinates_are_missing_points_counted_in_a_warning(short):
    """A NaN row is the same as no row, but for the warning that counts it."""
    holes = short.copy()
    holes.loc[holes["frame"] == 11, "z"] = np.nan
    with_nan = perrin.analyze(holes, dt=0.73)
    without = perrin.analyze(short[short["frame"] != 11], dt=0.73)
    np.testing.assert_array_equal(values(with_nan), values(without))
    assert any("4 rows" in w and "NaN" in w for w in with_nan.notes)
    assert not any("NaN" in w for w in without.notes)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_without_a_cluster_column_bodies_are_found(short):
    """One body is noted as one; two are found with and without contact; a gas is refused."""
    plain = short.drop(columns="cluster")
    report = perrin.analyze(plain, dt=0.73)
    assert len(report.clusters) == 1
    assert any("one cluster" in w for w in report.notes)
    crowd = pd.concat([tracks(seed=k, cluster=k, n_frames=SHORT) for k in range(2)])
    marked = values(perrin.analyze(crowd, dt=0.73))
    for contact in (2.45, None):
        found = perrin.analyze(crowd.drop(columns="cluster"), dt=0.73, contact=contact)
        np.testing.assert_allclose(values(found), marked, rtol=1e-9)
    assert any("2 bodies found" in w for w in found.notes)
    gas = np.random.default_rng(3).normal(size=(40, 9, 3)).cumsum(axis=0)
    with pytest.raises(perrin.TrackTableError, match=r"keep their distance.*contact="):
        perrin.analyze(perrin.positions_table(gas).drop(columns="cluster"), dt=0.73)


def test_several_clusters_are_pooled():
    """Pooling four clusters halves the error, and equals pooling their motions."""
    table = pd.concat([tracks(seed=10 + k, cluster=k) for k in range(4)])
    report = perrin.analyze(table, dt=0.73)
    pooled = perrin.estimate_diffusion([c.motion for c in report.clusters])
    assert report.pooled.D_R.value == pooled.value
    assert report.pooled.clusters == (0, 1, 2, 3)
    single = np.mean([c.D_R.stderr for c in report.clusters])
    assert 0.4 < report.pooled.D_R.stderr / single < 0.6
    assert abs(report.pooled.D_R.value - 5e-3) < 3 * report.pooled.D_R.stderr
    assert abs(report.pooled.D_T.value - 0.04) < 3 * report.pooled.D_T.stderr


def test_a_bad_cluster_among_good_ones_is_a_warning():
    """A single particle and a single frame are left out by name; the good cluster is measured."""
    good = tracks(seed=1, cluster=0, n_frames=SHORT)
    single = tracks(seed=2, cluster=1, n_frames=SHORT)
    single = single[single["particle"] < 5]
    flash = tracks(seed=3, cluster=2, n_frames=SHORT)
    flash = flash[flash["frame"] == 0]
    report = perrin.analyze(pd.concat([good, single, flash]), dt=0.73)
    assert [c.cluster for c in report.clusters] == [0]
    assert any("cluster 1 was left out: 1 particle" in w for w in report.warnings)
    assert any("cluster 2 was left out: 1 frame" in w for w in report.warnings)
    with pytest.raises(perrin.DegenerateClusterError, match="1 particle"):
        perrin.analyze(single, dt=0.73)
    with pytest.raises(perrin.TooFewFramesError, match="1 frame"):
        perrin.analyze(flash, dt=0.73)


def test_loose_particles_are_counted_and_left_out(short):
    """Rows with cluster -1 take no part but stay in the table."""
    loose = short.assign(cluster=-1, particle=short["particle"] + 50)
    report = perrin.analyze(pd.concat([short, loose]), dt=0.73)
    assert len(report.clusters) == 1
    assert any("4 particles belong to no cluster" in w for w in report.notes)
    assert len(report.tracks) == 2 * len(short)


def test_a_constant_z_is_warned_of(base, whole):
    """A table whose z never changes is analysed with a warning that advises."""
    flat = perrin.Cluster.from_positions([[0, 0], [2, 0], [1, 1.7]])
    truth = perrin.simulate_motion(flat, D_R=5e-3, D_T=0.03, dt=1.0, n_frames=SHORT, rng=1)
    noisy = perrin.add_noise(truth.positions(), sigma=0.02, rng=2)
    flat_table = perrin.positions_table(noisy).assign(z=1.5)
    warnings = perrin.analyze(flat_table, dt=1.0).warnings
    assert any("z never changes" in w for w in warnings)
    assert not any("z never changes" in w for w in whole.warnings)


def test_a_contact_distance_that_finds_nothing_is_refused(base):
    """Too small a contact distance leaves every particle loose: an error that names it."""
    with pytest.raises(perrin.TrackTableError, match=r"loose at contact = 0\.3 um"):
        perrin.analyze(base.drop(columns="cluster"), dt=0.73, contact=0.3)


def test_frames_are_sliced(short):
    """frames=(A, B) uses A <= frame < B; an empty slice is refused with the frames of the table."""
    report = perrin.analyze(short, dt=0.73, frames=(4, 18))
    assert len(report.clusters[0].motion.time) == 14
    expected = values(perrin.analyze(short[short["frame"].between(4, 17)], dt=0.73))
    np.testing.assert_array_equal(values(report), expected)
    with pytest.raises(ValueError, match=r"500.*0 to 19"):
        perrin.analyze(short, dt=0.73, frames=(500, None))


KNOWN = {"viscosity": 2.18e-3, "temperature": 295.0}


def spheres(
    body: perrin.Mobility, *, seed: int, cluster: int = 0, n_frames: int = 400
) -> pd.DataFrame:
    """Tracks of a body that diffuses by its own hydrodynamics."""
    truth = perrin.simulate_motion(body, dt=0.5, n_frames=n_frames, rng=seed)
    table = perrin.positions_table(perrin.add_noise(truth.positions(), sigma=0.02, rng=seed + 1))
    first = 100 * cluster
    return table.assign(cluster=cluster, particle=table["particle"] + first, x=table["x"] + first)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_sizes_are_those_of_the_measured_shape(base, sized):
    """Tetrahedron and trimer: the sizes of `size_from_*` at the template, by factors of its own."""
    kT = 1.380649e-23 * 295
    factors = {4: (1.784, 1.818), 3: (1.623, 1.665)}
    trimer = perrin.analyze(base[base["particle"] < 3], dt=0.73, **KNOWN)
    for result in (sized.clusters[0], trimer.clusters[0]):
        c_t, c_r = factors[len(result.motion.template)]
        d_t = kT / (3 * np.pi * 2.18e-3 * result.D_T.value * 1e-12) * 1e6
        d_r = (kT / (np.pi * 2.18e-3 * result.D_R.value)) ** (1 / 3) * 1e6
        assert result.sizes["translation"].cluster == pytest.approx(d_t)
        # The measured shape differs from touching spheres by 30 nm/sqrt(210) in 2.45 um.
        assert result.sizes["translation"].sphere == pytest.approx(d_t / c_t, rel=2e-3)
        assert result.sizes["rotation"].sphere == pytest.approx(d_r / c_r, rel=2e-3)
        relative = result.D_R.stderr / result.D_R.value / 3
        assert result.sizes["rotation"].cluster_stderr == pytest.approx(d_r * relative)
        shape = result.motion.template
        both = perrin.size_and_viscosity(result.D_T, result.D_R, cluster=shape, temperature=295.0)
        assert result.sizes["both"].sphere == pytest.approx(both.sphere, rel=1e-9)
        assert result.sizes["both"].viscosity == pytest.approx(both.viscosity, rel=1e-9)
        assert result.prediction is None


def test_conditions_are_asked_for_together(base, sized):
    """The temperature alone gives what needs no viscosity; other gaps and Celsius are refused."""
    (result,) = perrin.analyze(base, dt=0.73, temperature=295.0).clusters
    assert list(result.sizes) == ["both"]
    full = sized.clusters[0].sizes["both"]
    assert result.sizes["both"].viscosity == pytest.approx(full.viscosity, rel=1e-12)
    with pytest.raises(ValueError, match="both viscosity"):
        perrin.analyze(base, dt=0.73, viscosity=2.18e-3)
    for lacking in ({}, {"temperature": 295.0}, {"viscosity": 1e-3}):
        with pytest.raises(ValueError, match="a prediction needs the viscosity"):
            perrin.analyze(base, dt=0.73, diameter=2.45, **lacking)
    with pytest.raises(ValueError, match=r"diameter.*> 0.*kelvin.*295\.15"):
        perrin.analyze(base, dt=0.73, viscosity=1e-3, temperature=22.0, diameter=-1.0)


@pytest.mark.parametrize("n", [3, 4])
def test_what_is_predicted_is_measured(n, tmp_path, repeats):
    """Bodies that diffuse by their own hydrodynamics: pulls within 3.5, sizes within 3 errors.

    The trimer is compared axis by axis as well: D_R differs by 28 %, D_T by 9 %.
    """
    body = perrin.cluster_mobility(perrin.Cluster.touching(n, 2.0), radius=1.0, **KNOWN)
    table = spheres(body, seed=20 + n, n_frames=repeats(200, 400))
    report = perrin.analyze(table, dt=0.5, diameter=2.0, **KNOWN)
    (result,) = report.clusters
    found = result.prediction
    axes = (*found.principal_D_T, *found.principal_D_R)
    assert len(axes) == (6 if n == 3 else 0)
    for one in (found.D_T, found.D_R, *axes):
        assert abs(one.pull) < 3.5
    assert found.D_R.pull == (result.D_R.value - found.D_R.predicted) / result.D_R.stderr
    # The shape is known to 1 or 2 nm in 2 um; D_R goes with the third power of it.
    assert found.D_T.predicted == pytest.approx(np.trace(body.D_T) / 3, rel=2e-3)
    assert found.D_R.predicted == pytest.approx(np.trace(body.D_R) / 3, rel=6e-3)
    if n == 3:
        # In the plane of a trimer all directions are alike, and it moves and turns fastest there.
        assert axes[1].measured == pytest.approx(axes[2].measured, rel=1e-6)
        assert axes[4].measured == pytest.approx(axes[5].measured, rel=1e-6)
    planted = [*body.principal_D_T.values, *body.principal_D_R.values]
    np.testing.assert_allclose([c.predicted for c in axes], planted[: len(axes)], rtol=1e-2)
    for size in result.sizes.values():
        assert abs(size.sphere - 2.0) < 3 * size.sphere_stderr
    both = result.sizes["both"]
    assert abs(both.viscosity - KNOWN["viscosity"]) < 3 * both.viscosity_stderr
    report.save(tmp_path / "run")
    again = perrin.load_run(tmp_path / "run")
    assert again.clusters[0].prediction == found
    assert again.clusters[0].sizes == result.sizes


def test_like_clusters_share_one_solution(monkeypatch):
    """Relabelled and turned tetrahedra are solved once, another shape once more."""
    tables = [tracks(seed=k, cluster=k, n_frames=SHORT) for k in range(3)]
    swap = {4: 6, 5: 4, 6: 7, 7: 5}
    tables[1] = tables[1].assign(particle=tables[1]["particle"].map(swap))
    trimer = tracks(seed=5, cluster=3, n_frames=SHORT)
    tables.append(trimer[trimer["particle"] < 15])
    solved = []

    def counted(positions, **known):
        solved.append(len(positions))
        return perrin.cluster_mobility(positions, **known)

    monkeypatch.setattr("perrin.run.predictions.cluster_mobility", counted)
    report = perrin.analyze(pd.concat(tables), dt=0.73, diameter=2.45, **KNOWN)
    assert solved == [3, 4]  # by number of particles
    trimer, *values = (c.prediction.D_R.predicted for c in report.clusters)
    np.testing.assert_allclose(values, values[0], rtol=1e-12)
    assert trimer > 1.1 * values[0]


@pytest.mark.usefixtures("everything")
def test_a_shared_solution_is_turned_into_the_axes_of_each_body(monkeypatch):
    """A bent chain of four, relabelled and turned: along its axes the same as solved for itself."""
    bent = 2.0 * np.array([[0.0, 0, 0], [1, 0, 0], [1.5, 0.9, 0], [1.5, 0.9, 1.1]])
    body = perrin.cluster_mobility(bent, radius=1.0, **KNOWN)
    one = spheres(body, seed=31, n_frames=LENGTH)
    other = spheres(body, seed=35, n_frames=LENGTH, cluster=1)
    other = other.assign(particle=other["particle"].map({100: 102, 101: 100, 102: 103, 103: 101}))
    measured = list(perrin.analyze(pd.concat([one, other]), dt=0.5).clusters)
    experiment = perrin.run.Experiment(diameter=2.0, **KNOWN)
    both, _ = perrin.run.add_predictions(measured, [], experiment)
    monkeypatch.setattr("perrin.run.predictions.matching_rotation", lambda *_, **__: None)
    alone, _ = perrin.run.add_predictions(measured, [], experiment)
    # The templates differ by 20 nm/sqrt(210) a coordinate, a thousandth of the diameter.
    for shared, own in zip(both, alone, strict=True):
        for quantity in ("principal_D_T", "principal_D_R"):
            for a, b in zip(
                getattr(shared.prediction, quantity), getattr(own.prediction, quantity), strict=True
            ):
                assert a.predicted == pytest.approx(b.predicted, rel=5e-3)
                assert a.measured == pytest.approx(b.measured, rel=2e-2)
                assert a.stderr == pytest.approx(b.stderr, rel=2e-2)


def test_rods_are_predicted():
    """A dimer of the planted diameter: D_T and D_perp within 3.5 standard errors."""
    body = perrin.cluster_mobility(perrin.Cluster.touching(2, 2.0), radius=1.0, **KNOWN)
    report = perrin.analyze(spheres(body, seed=7), dt=0.5, diameter=2.0, **KNOWN)
    (rod,) = report.rods
    across = body.principal_D_R.values[0]
    assert rod.prediction.D_perp.predicted == pytest.approx(across, rel=6e-3)
    assert abs(rod.prediction.D_perp.pull) < 3.5
    assert abs(rod.prediction.D_T.pull) < 3.5
    assert "pull" in str(rod.prediction)


def test_shapes_that_cannot_be_solved_are_warned_of(short, whole, monkeypatch):
    """A plane, a diameter in nm, overlaps, too many spheres, poor accuracy: a warning each."""

    def measured(**known: float) -> tuple[perrin.ClusterResult, str]:
        experiment = perrin.run.Experiment(**KNOWN, **known)
        ((result,), _) = perrin.run.add_predictions([whole.clusters[0]], [], experiment)
        return result, "; ".join(result.warnings)

    plane = perrin.analyze(short.drop(columns="z"), dt=0.73, diameter=2.45, **KNOWN)
    (flat,) = plane.clusters
    assert flat.sizes is flat.prediction is None
    assert "no sizes and no prediction: they follow from motion in three dimensions" in "; ".join(
        flat.warnings
    )
    wrong, words = measured(diameter=2450.0)
    assert wrong.sizes is wrong.prediction is None
    assert "2.45 um apart, which spheres of 2450 um cannot be" in words
    assert "would overlap" in measured(diameter=3.0)[1]
    assert "do not touch" in measured(diameter=1.2)[1]
    assert measured(diameter=2.45)[1] == ""
    monkeypatch.setattr("perrin.hydrodynamics.resistance._MOST_UNKNOWNS", 430)
    rough, words = measured(diameter=2.45)
    assert rough.prediction.error > 1e-4
    assert "predicted flow: degree 5 leaves a relative error" in words
    monkeypatch.setattr("perrin.hydrodynamics.resistance._MOST_UNKNOWNS", 300)
    refused, words = measured()
    assert refused.sizes is None
    assert "no sizes: cluster_mobility refuses this shape: centers: 4 spheres" in words


def test_a_soft_body_is_flagged_and_a_noisy_one_is_not():
    """Breathing particles warn; white noise as large does not; a stated sigma decides."""
    rng = np.random.default_rng(5)
    noisy = tracks(seed=5, sigma=0.12)
    soft = tracks(seed=5, sigma=0.01)
    walk = np.cumsum(rng.normal(size=(LENGTH, 4, 3)), axis=0)
    walk = 0.12 * (walk - walk.mean(0)) / walk.std()
    soft[["x", "y", "z"]] += walk.reshape(-1, 3)

    def flagged(table: pd.DataFrame, **known: float) -> bool:
        (result,) = perrin.analyze(table, dt=0.73, **known).clusters
        return any("not rigid" in w for w in result.warnings)

    assert flagged(soft)
    assert not flagged(noisy)
    assert not flagged(soft, sigma=0.1)
    assert flagged(noisy, sigma=0.03)


def test_a_soft_body_is_left_out_of_the_pool():
    """Pooling takes the rigid clusters and names those it leaves out."""
    rng = np.random.default_rng(6)
    walk = np.cumsum(rng.normal(size=(LENGTH, 4, 3)), axis=0)
    soft = tracks(seed=7, cluster=1)
    soft[["x", "y", "z"]] += (0.2 * walk / walk.std()).reshape(-1, 3)
    report = perrin.analyze(pd.concat([tracks(seed=8), soft]), dt=0.73)
    assert report.pooled.clusters == (0,)
    assert any("leave out what is not rigid: cluster 1" in w for w in report.warnings)


def test_a_wrong_sigma_shows_in_the_noise_floor():
    """Residuals of 30 nm and steps with ten times that offset raise a warning."""
    rng = np.random.default_rng(9)
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(4, 2.45), D_R=1e-3, dt=0.73, n_frames=600, rng=rng
    )
    # The steps of another motion are independent rotations.
    jitter = perrin.simulate_motion(
        perrin.Cluster.touching(4, 2.45), D_R=3e-3, dt=1.0, n_frames=601, rng=rng
    ).rotation
    turns = np.swapaxes(jitter[:-1], -1, -2) @ jitter[1:]
    shaken = truth.positions() @ np.swapaxes(turns, -1, -2)
    x = perrin.add_noise(shaken, sigma=0.03, rng=rng)
    (result,) = perrin.analyze(perrin.positions_table(x), dt=0.73).clusters
    assert any("noise floor" in w for w in result.warnings)
    quiet = perrin.analyze(tracks(seed=9), dt=0.73).clusters[0]
    assert not any("noise floor" in w for w in quiet.warnings)


def test_a_motionless_cluster_is_an_upper_limit():
    """Without diffusion nothing is resolved, and the report states it."""
    x = np.repeat(perrin.Cluster.touching(4, 2.45).positions[None], LENGTH, axis=0)
    table = perrin.positions_table(perrin.add_noise(x, sigma=0.03, rng=2))
    report = perrin.analyze(table, dt=0.73, viscosity=1e-3, temperature=300, diameter=2.45)
    (result,) = report.clusters
    assert not result.D_R.resolved
    assert result.sizes is None
    assert any("no sizes: D_R and D_T: an upper limit only" in w for w in result.notes)
    entry = report.to_dict()["clusters"][0]["prediction"]["D_R"]
    assert entry["pull"] is entry["stderr"] is None
    assert entry["predicted"] > 0
    assert any("not resolved: D_R <" in w for w in result.notes)


def test_text_clusters_are_numbered_and_named(short):
    """Names become numbers in the order of the names and stay as labels; no name is no cluster."""
    other = tracks(seed=2, cluster=1, n_frames=SHORT).assign(cluster="knee")
    loose = short.assign(cluster=None, particle=short["particle"] + 70)
    table = pd.concat([short.assign(cluster="leg"), other, loose])
    report = perrin.analyze(table, dt=0.73)
    assert [(c.cluster, c.label) for c in report.clusters] == [(0, "knee"), (1, "leg")]
    assert any("belong to no cluster" in w for w in report.notes)


@pytest.mark.parametrize("bad", [{"dt": 0.0}, {"dt": -1.0}, {"dt": np.nan}, {"scale": 0.0}])
def test_arguments_out_of_range_are_refused(base, bad):
    """Arguments dt and scale must be positive."""
    with pytest.raises(ValueError, match=next(iter(bad))):
        perrin.analyze(base, **({"dt": 0.73} | bad))


@pytest.mark.skipif(not SHARED.exists(), reason="the real data is not here")
@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_real_marker_bodies(repeats):
    """Leg and knee are rigid at 0.39 and 0.70 mm, the foot in its soft shoe (1.83 mm) is not.

    In frame 1952 two markers of the foot have exchanged their labels; uncorrected it has 1.94 mm.
    The residuals are those of the whole record; the quick form takes 205 frames about the exchange.
    """
    whole = bool(repeats(0, 1))
    start, stop = (0, 3361) if whole else (1850, 2055)
    table = pd.read_csv(SHARED / "walking.csv.gz")
    bodies = pd.read_csv(SHARED / "walking_labels.csv").rename(columns={"body": "cluster"})
    table = table.merge(bodies[["particle", "cluster"]], on="particle")
    report = perrin.analyze(table, dt=1 / 160, scale=1000, frames=(start, stop))
    found = {c.label: c for c in report.clusters}
    assert {k: len(c.motion.template) for k, c in found.items()} == {"Foot": 5, "Knee": 4, "Leg": 3}
    for name, sigma in (("Leg", 0.39), ("Knee", 0.70), ("Foot", 1.83)):
        result = found[name]
        # Two markers repeat their last place to the last digit, which is no measurement.
        seen = report.tracks.dropna(subset=["x", "y", "z"])
        counts = seen[seen["cluster"] == result.cluster].groupby("frame").size()
        assert result.motion.fitted.size == (counts >= 3).sum()
        if whole:
            complete = counts.index[counts == len(result.motion.template)]
            rows = table[(table["cluster"] == name) & table["frame"].isin(complete)]
            alone = perrin.analyze(rows, dt=1 / 160, scale=1000).clusters[0]
            assert alone.motion.sigma / 1000 == pytest.approx(sigma, rel=0.05)
        assert any("not rigid" in w for w in result.warnings) == (name == "Foot")
        assert (result.quality.swaps == (1952 - start, 1953 - start)) == (name == "Foot")


@pytest.mark.skipif(not SHARED.exists(), reason="the real data is not here")
def test_real_marker_bodies_are_found_without_labels():
    """Leg, knee and foot are the three bodies of the table, each with its own markers."""
    table = pd.read_csv(SHARED / "walking.csv.gz")
    key = pd.read_csv(SHARED / "walking_labels.csv").set_index("particle")["body"]
    found = perrin.find_clusters(table).groupby("particle")["cluster"].first()
    assert (found >= 0).all()
    assert len(set(zip(found, key[found.index], strict=True))) == 3


def test_exchanged_labels_are_corrected_and_reported(base, answer):
    """Pairs and cycles exchanged for good: the answer stays, each frame is in a note."""
    x, _ = perrin.cluster_positions(base)
    mixed = x.copy()
    mixed[40:, [0, 2]] = mixed[40:, [2, 0]]
    mixed[77:, [1, 2, 3]] = mixed[77:, [2, 3, 1]]
    report = perrin.analyze(perrin.positions_table(mixed), dt=0.73)
    np.testing.assert_allclose(values(report), answer, rtol=1e-6)
    (text,) = (w for w in report.clusters[0].notes if "labels change" in w)
    assert "40" in text
    assert "77" in text
    assert report.to_dict()["clusters"][0]["quality"]["swaps"] == [40, 77]


def test_ids_that_break_off_do_not_split_a_cluster(base, whole):
    """A tracker that loses a particle and finds it again gives it a new id: one cluster of four."""
    broken = base.drop(columns="cluster")
    later = (broken["particle"] == 2) & (broken["frame"] >= 80)
    broken = broken.assign(particle=broken["particle"].mask(later, 9))
    broken = broken[~((broken["particle"] == 2) & (broken["frame"] >= 76))]
    (result,) = perrin.analyze(broken, dt=0.73, contact=2.45).clusters
    assert len(result.motion.template) == 4
    assert result.motion.fitted.size == LENGTH
    full = whole.clusters[0]
    assert abs(result.D_R.value - full.D_R.value) < full.D_R.stderr


def test_rods_are_measured_and_full_rotation_refused(tmp_path):
    """A dumbbell and a tetrahedron: D_perp in the summary, D_R null with the reason."""
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(2, 2.45), D_R=0.01, D_T=0.05, dt=0.73, n_frames=LENGTH, rng=1
    )
    pair = perrin.positions_table(perrin.add_noise(truth.positions(), sigma=0.03, rng=2))
    pair = pair.assign(cluster=5, particle=pair["particle"] + 50)
    both = perrin.analyze(pd.concat([tracks(seed=1), pair]), dt=0.73)
    assert [c.cluster for c in both.clusters] == [0]
    alone = perrin.analyze(pair, dt=0.73)
    assert alone.pooled is None
    for name, report in (("both", both), ("alone", alone)):
        (rod,) = report.rods
        assert rod.D_perp.ci95[0] < 0.01 < rod.D_perp.ci95[1]
        report.save(tmp_path / name)
        again = perrin.load_run(tmp_path / name)
        assert again.to_dict() == report.to_dict()
        (entry,) = (e for e in report.to_dict()["clusters"] if e["cluster"] == 5)
        assert entry["D_R"] is None
        assert any("no D_R" in w for w in entry["notes"])
        assert entry["D_perp"]["value"] == rod.D_perp.value


def test_a_pair_in_the_plane_has_one_angle():
    """In two dimensions n = 2 is a body: 2 D_R dt per step, the planted D_R comes back."""
    pair = perrin.Cluster.from_positions([[0.0, 0.0], [2.0, 0.0]])
    truth = perrin.simulate_motion(pair, D_R=0.02, D_T=0.03, dt=0.5, n_frames=400, rng=3)
    table = perrin.positions_table(perrin.add_noise(truth.positions(), sigma=0.02, rng=4))
    (result,) = perrin.analyze(table.drop(columns="cluster"), dt=0.5).clusters
    assert result.msad.dof == 1
    assert result.D_R.ci95[0] < 0.02 < result.D_R.ci95[1]
    assert result.noise.phi2 == pytest.approx(2 * 0.02**2 / 2.0, rel=0.2)


def test_noise_exposure_and_drift_reach_the_estimates(base, whole):
    """Held noise narrows the interval and is noted; a flow is subtracted from D_T and noted."""
    free = whole.clusters[0]
    held = perrin.analyze(base, dt=0.73, noise="residual")
    assert held.clusters[0].D_R.stderr < 0.8 * free.D_R.stderr
    assert any("exposure is not stated" in w for w in held.notes)
    stated = perrin.analyze(base, dt=0.73, noise=0.03, exposure=0.0)
    assert stated.warnings == ()
    assert stated.clusters[0].D_R.noise == 0.03
    moving = base.assign(x=base["x"] + 0.5 * base["frame"])
    flow = perrin.analyze(moving, dt=0.73, drift=True).clusters[0]
    assert flow.D_T.value == pytest.approx(free.D_T.value, rel=0.05)
    assert any("mean velocity of x 0.6" in w for w in flow.notes)


def test_clusters_that_differ_are_pooled_with_a_warning():
    """A cluster that turns three times as fast makes p_same small and raises a warning."""
    tables = [tracks(seed=k, cluster=k) for k in range(2)]
    alike = perrin.analyze(pd.concat(tables), dt=0.73)
    assert alike.to_dict()["pooled"]["p_same"] > 0.01
    assert not any("do not agree" in w for w in alike.warnings)
    rng = np.random.default_rng(9)
    fast = perrin.simulate_motion(
        perrin.Cluster.touching(4, 2.45), D_R=1.5e-2, D_T=0.04, dt=0.73, n_frames=LENGTH, rng=rng
    )
    noisy = perrin.add_noise(fast.positions() + np.array([0.0, 50.0, 0.0]), sigma=0.03, rng=rng)
    table = perrin.positions_table(noisy)
    table = table.assign(cluster=9, particle=table["particle"] + 100)
    mixed = perrin.analyze(pd.concat([*tables, table]), dt=0.73)
    assert mixed.pooled.D_R.p_same < 1e-3
    assert any("do not agree on one D_R" in w for w in mixed.warnings)
    assert not any("do not agree on one D_T" in w for w in mixed.warnings)


def test_coarse_sampling_and_few_frames_are_warned_of():
    """What estimate_diffusion warns of is in the cluster's warnings; nothing is raised."""
    short = perrin.analyze(tracks(n_frames=SHORT), dt=0.73).clusters[0]
    assert any("19 steps, fewer than 30" in w for w in short.warnings)


def test_the_tensor_of_unequal_axes_reaches_the_summary(short, tmp_path, whole):
    """Planted axes come back in the summary and from the run folder; a plane has no tensor."""
    body = perrin.Cluster.from_positions([[0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]])
    planted = np.array([2e-3, 4e-3, 12e-3])
    truth = perrin.simulate_motion(body, D_R=planted, D_T=0.04, dt=0.7, n_frames=400, rng=1)
    table = perrin.positions_table(perrin.add_noise(truth.positions(), sigma=0.03, rng=2))
    report = perrin.analyze(table, dt=0.7)
    entry = report.to_dict()["clusters"][0]["tensor"]
    pull = (np.array(entry["principal_values"]) - planted) / entry["stderr"]
    assert np.all(np.abs(pull) < 3.5)
    assert max(entry["p_isotropic"], entry["p_axial"]) < 1e-3
    report.save(tmp_path / "run")
    assert perrin.load_run(tmp_path / "run").to_dict() == report.to_dict()
    assert "<th>axis 3</th>" in render_html(report, [])
    assert perrin.analyze(short.drop(columns="z"), dt=0.73).clusters[0].tensor is None
    even = whole
    assert even.clusters[0].tensor.symmetry == "T_d"
    assert "<th>axis 3</th>" not in render_html(even, [])


def test_a_swap_reports_the_residual_it_would_have_left():
    """Two exchanged spheres are a mirror image: far from the body, with the residual in numbers."""
    body = perrin.Cluster.touching(4, 2.45)
    truth = perrin.simulate_motion(body, D_R=5e-3, dt=0.73, n_frames=SHORT, rng=1)
    x = perrin.add_noise(truth.positions(), sigma=0.03, rng=2)
    x[9:] = x[9:, [1, 0, 2, 3]]
    report = perrin.analyze(perrin.positions_table(x), dt=0.73)
    (text,) = (w for w in report.clusters[0].warnings if "labels change" in w)
    assert text.startswith("identity: labels change particles at frame 9; corrected (residual as")
    swapped, usual = (float(word) for word in re.findall(r"([0-9.]+) (?:um|median)", text))
    mirrored = body.positions[[1, 0, 2, 3]]
    # What no proper rotation can do: the least singular value counts against the fit.
    s = np.linalg.svd(mirrored.T @ body.positions, compute_uv=False)
    left = 2 * (body.positions**2).sum() - 2 * (s[0] + s[1] - s[2])
    assert swapped == pytest.approx(np.sqrt(left / 4), rel=0.05)
    assert swapped > 20 * usual
    # Six of twelve numbers are fitted; a median of 20 has an error of 1.25/sqrt(2*6*20) of itself.
    assert usual == pytest.approx(0.03 * np.sqrt(3 / 2), rel=0.2)


def test_a_cut_reports_how_far_the_body_turned():
    """A turn by about half the angle of the body's symmetry may be either of two."""
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(4, 2.45), D_R=0.08, dt=0.73, n_frames=LENGTH, rng=1
    )
    x = perrin.add_noise(truth.positions(), sigma=0.03, rng=1)
    raw = perrin.positions_table(x).drop(columns="particle")
    found = perrin.identify(raw, contact=2.45, size=4)
    report = perrin.analyze(found, dt=0.73)
    (text,) = (w for w in report.clusters[0].warnings if "in doubt" in w)
    angles = re.search(r"step angles ([0-9, ]+), \.\.\. deg: a jump of the body's symmetry", text)
    # The least angle between two assignments of a tetrahedron is 120 degrees.
    assert all(40 < float(word) < 90 for word in angles.group(1).split(","))
    assert "cannot be distinguished from a real turn" in text


def test_an_experiment_states_what_arguments_state(short):
    """The same report from arguments, from an Experiment, and from both, each stating a part."""
    known = perrin.run.Experiment(dt=0.73, sigma=0.03, noise=Noise("residual", exposure=0.5))
    one = perrin.analyze(short, experiment=known).to_dict()
    assert (
        one == perrin.analyze(short, dt=0.73, sigma=0.03, noise="residual", exposure=0.5).to_dict()
    )
    part = perrin.run.Experiment(sigma=0.03, noise=Noise(exposure=0.5))
    assert one == perrin.analyze(short, dt=0.73, noise="residual", experiment=part).to_dict()
    with pytest.raises(ValueError, match="dt: needed"):
        perrin.analyze(short)


def test_a_value_stated_twice_is_refused(base):
    """Every value stated both as a keyword and in the experiment is named."""
    known = perrin.run.Experiment(
        dt=0.5, noise=Noise("residual", drift=True), sigma=[0.1, 0.1, 0.2]
    )
    with pytest.raises(ValueError, match=r"^dt: stated in experiment=.*; sigma: stated in exp"):
        perrin.analyze(base, dt=0.73, sigma=0.1, experiment=known)
    with pytest.raises(
        ValueError, match=r"^noise: stated in experiment= and as a keyword; state it once"
    ):
        perrin.analyze(base, noise=0.1, experiment=known)


def test_faults_of_an_experiment_are_one_message():
    """Values out of range, incomplete conditions and the noise are refused together."""
    with pytest.raises(ValueError, match=r"dt: .*diameter: .*sigma: .*got \[-1\.0, 0\.0, 0\.0\]"):
        perrin.run.Experiment(dt=0.0, diameter=2.0, sigma=[-1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"dt: .*exposure: "):
        perrin.analyze(pd.DataFrame(), dt=-1.0, exposure=2.0)
    with pytest.raises(ValueError, match=r"noise: expected Noise"):
        perrin.run.Experiment(noise="joint")
    for wrong in ("wide", [[0.1]], np.nan):
        with pytest.raises(ValueError, match=r"sigma: expected one number >= 0 or one per axis"):
            perrin.run.Experiment(sigma=wrong)


def same(one: object, other: object) -> bool:
    """Return whether two results are equal field by field; NaN equals NaN."""
    if is_dataclass(one):
        return type(one) is type(other) and all(
            same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one)
        )
    if isinstance(one, pd.DataFrame):
        return one.equals(other)
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[k], other[k]) for k in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float | np.ndarray):
        return np.array_equal(one, other, equal_nan=True)
    return bool(one == other)


@pytest.mark.usefixtures("everything")
def test_results_come_back_from_json(base):
    """Clusters, rods, pooled values, predictions and sizes are the same after JSON."""
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(2, 2.45), D_R=0.01, D_T=0.05, dt=0.73, n_frames=SHORT, rng=1
    )
    pair = perrin.positions_table(perrin.add_noise(truth.positions(), sigma=0.03, rng=2))
    pair = pair.assign(cluster=5, particle=pair["particle"] + 50)
    report = perrin.analyze(pd.concat([base, pair]), dt=0.73, diameter=2.45, **KNOWN)
    entry = json.loads(json.dumps(report.to_dict()))
    motions = {result.cluster: result.motion for result in report.results}
    again = perrin.Report.from_dict(
        entry, motions=motions, tracks=report.tracks, settings=report.settings
    )
    assert same(again, report)
    parts = [*report.clusters[0].sizes.values(), report.clusters[0].prediction]
    parts += [report.clusters[0].prediction.D_R, report.pooled]
    parts.append(
        perrin.run.Experiment(dt=0.5, sigma=[0.1, 0.1, 0.2], noise=Noise(0.02, drift=True))
    )
    for part in parts:
        assert same(type(part).from_dict(json.loads(json.dumps(part.to_dict()))), part)
    limit = perrin.Compared(1.0, 2.0, np.nan)
    assert same(perrin.Compared.from_dict(json.loads(json.dumps(limit.to_dict()))), limit)
