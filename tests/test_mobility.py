"""The mobility of rigid clusters: published numbers, exact series, laws, error estimates."""

from __future__ import annotations

import dataclasses
import json
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perrin import Cluster, Mobility, PrecisionWarning, apparent_translation, cluster_mobility
from perrin.hydrodynamics import resistance

WATERY = {"viscosity": 1e-3, "temperature": 300.0}
KT_OVER_ETA = 1.380649e-23 * 300 / 1e-3 * 1e18  # um^3/s
TURN = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
# A body without any symmetry, of unequal spheres that touch, overlap and are separate.
ODD = np.array([[0.0, 0, 0], [2.2, 0, 0], [2.2, 1.7, 0.3], [-0.4, 1.2, 1.9]])
ODD_RADII = np.array([1.0, 1.2, 0.7, 0.9])


def line(n):
    """Return n centres of touching unit spheres on the z axis."""
    return np.array([[0.0, 0, 2 * i] for i in range(n)])


BODIES = {
    "dimer": line(2),
    "line 3": line(3),
    "triangle": Cluster.touching(3, 2.0).positions,
    "tetrahedron": Cluster.touching(4, 2.0).positions,
    "square": np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]),
    "line 4": line(4),
    "bipyramid": Cluster.touching(5, 2.0).positions,
    "pentahedron": Cluster.pentahedron(2**0.5).positions,
    "octahedron": Cluster.touching(6, 2.0).positions,
    "pentagonal bipyramid": Cluster.touching(7, 2.0).positions,
}

# Converged values, D over that of one sphere: mean and principal values, rising
# (facts/hydrodynamics.md, 1: an independent code, bracketed by bead-shells), good to 1e-5.
TABLE = {
    "dimer": (0.718327, (0.689978, 0.775024), 0.363118, (0.267374, 0.554605)),
    "line 3": (0.578580, (0.543486, 0.648766), 0.201551, (0.109572, 0.385509)),
    "triangle": (0.615994, (0.579805, 0.634089), 0.216541, (0.176222, 0.236700)),
    "tetrahedron": (0.560433, (0.560433,), 0.166348, (0.166348,)),
    "square": (0.542216, (0.501286, 0.562681), 0.146351, (0.118957, 0.160047)),
    "line 4": (0.491272, (0.454592, 0.564632), 0.136041, (0.056171, 0.295781)),
    "bipyramid": (0.517884, (0.505532, 0.542590), 0.132136, (0.119427, 0.157553)),
    "pentahedron": (0.507878, (0.503279, 0.517075), 0.124202, (0.122669, 0.127266)),
    "octahedron": (0.490147, (0.490147,), 0.113726, (0.113726,)),
    "pentagonal bipyramid": (0.463198, (0.439349, 0.475122), 0.094764, (0.082670, 0.100810)),
}


@cache
def body(name, degree=None):
    """Return the mobility of a body of touching unit spheres."""
    return cluster_mobility(BODIES[name], radius=1.0, degree=degree, **WATERY)


@cache
def odd():
    """Return the mobility of the body without symmetry."""
    return cluster_mobility(ODD, radius=ODD_RADII, **WATERY)


def dimer(q, **options):
    """Return the mobility of two touching spheres of radius 1 and q on the z axis."""
    return cluster_mobility([[0, 0, 0], [0, 0, 1 + q]], radius=[1.0, q], **(WATERY | options))


@cache
def uneven_dimer():
    """Return the mobility of touching spheres of radius 1 and 3."""
    return dimer(3.0)


def ratios(mobility):
    """Return D_T and D_R over those of one unit sphere: means, then principal values."""
    t = mobility.principal_D_T.values * 6 * np.pi / KT_OVER_ETA
    r = mobility.principal_D_R.values * 8 * np.pi / KT_OVER_ETA
    return t.mean(), t, r.mean(), r


def deviation(D, reference):
    """Return the largest relative deviation over all directions of motion, units cancelled."""
    white = np.linalg.inv(np.linalg.cholesky(reference))
    return np.abs(np.linalg.eigvalsh(white @ D @ white.T) - 1).max()


# ---- numbers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TABLE)
def test_published_and_converged_values(name, repeats):
    """Means and principal values of ten bodies come out within 1e-4 with the defaults.

    The quick form leaves out four of the ten.
    """
    if name in repeats(("square", "bipyramid", "pentahedron", "pentagonal bipyramid"), ()):
        pytest.skip("with --long only")
    mean_T, principal_T, mean_R, principal_R = TABLE[name]
    t, values_T, r, values_R = ratios(body(name))
    assert t == pytest.approx(mean_T, rel=1e-4)
    assert r == pytest.approx(mean_R, rel=1e-4)
    for values, principal in ((values_T, principal_T), (values_R, principal_R)):
        nearest = np.array(principal)[np.abs(values[:, None] - principal).argmin(axis=1)]
        np.testing.assert_allclose(values, nearest, rtol=1e-4)
        assert set(nearest) == set(principal)
    assert body(name).error <= 1e-4


# Rows by q: D_T mean, perp, par; D_R mean, perp, par; centroid to centre of diffusion; apparent D_T
# at the centroid over the true one (facts/hydrodynamics.md, 1).
UNEQUAL = {
    1.05: (0.70059, 0.67300, 0.75577, 0.33680, 0.24826, 0.51388, 0.0473, 1.0004),
    1.5: (0.56297, 0.54376, 0.60140, 0.17290, 0.13554, 0.24762, 0.4603, 1.0255),
    2.0: (0.45317, 0.44134, 0.47682, 0.08984, 0.07627, 0.11699, 0.8758, 1.0646),
}


@pytest.mark.parametrize("q", UNEQUAL)
def test_unequal_dimers(q):
    """Five printed digits: 1e-4 relative and half the last digit."""
    t, par, r, rpar, offset, apparent = (UNEQUAL[q][i] for i in (0, 2, 3, 5, 6, 7))
    mobility = dimer(q)
    mean_T, values_T, mean_R, values_R = ratios(mobility)
    got = [mean_T, values_T[0], values_T[1], values_T[2]]
    np.testing.assert_allclose(got, [t, UNEQUAL[q][1], UNEQUAL[q][1], par], rtol=1e-4, atol=6e-6)
    got = [mean_R, values_R[0], values_R[1], values_R[2]]
    np.testing.assert_allclose(got, [r, UNEQUAL[q][4], UNEQUAL[q][4], rpar], rtol=1e-4, atol=6e-6)
    # Both centres are on the axis; the larger sphere draws that of diffusion.
    shift = mobility.center - mobility.centroid
    np.testing.assert_allclose(shift, [0, 0, offset], atol=1e-4)
    seen = apparent_translation(mobility, point=mobility.centroid)
    assert seen / np.trace(mobility.D_T) * 3 == pytest.approx(apparent, abs=1e-4)


def test_spheres_of_one_to_three_reach_the_accuracy():
    """Unequal spheres need a higher degree, which is found: against degree 14, 1e-4."""
    mobility = uneven_dimer()
    assert 8 <= mobility.degree <= 12
    assert deviation(mobility.D, dimer(3.0, degree=14).D) < 1e-4


def test_a_sphere_is_exact():
    """One sphere: Stokes, Einstein and Debye to 1e-9, wherever it is."""
    mobility = cluster_mobility([[3.0, -1.0, 2.0]], radius=0.7, **WATERY)
    np.testing.assert_allclose(mobility.D_T, np.eye(3) * KT_OVER_ETA / (4.2 * np.pi), atol=1e-9)
    stokes = np.eye(3) * KT_OVER_ETA / (8 * np.pi * 0.343)
    np.testing.assert_allclose(mobility.D_R, stokes, atol=1e-9)
    np.testing.assert_allclose(mobility.center, [3.0, -1.0, 2.0], atol=1e-9)
    assert mobility.diameter_factor_T == pytest.approx(1, abs=1e-9)
    assert mobility.diameter_factor_R == pytest.approx(1, abs=1e-9)


def axial_drag(gap):
    """Return the drag of one of two equal spheres on their axis (Stimson and Jeffery 1926)."""
    if gap == 0:
        return 0.645141
    alpha, n = np.arccosh(1 + gap / 2), np.arange(1, 100)
    high = 4 * np.sinh((n + 0.5) * alpha) ** 2 - ((2 * n + 1) * np.sinh(alpha)) ** 2
    low = 2 * np.sinh((2 * n + 1) * alpha) + (2 * n + 1) * np.sinh(2 * alpha)
    terms = n * (n + 1) / ((2 * n - 1) * (2 * n + 3)) * (1 - high / low)
    return 4 / 3 * np.sinh(alpha) * terms.sum()


def axial_torque(gap):
    """Return the torque of one of two equal spheres that turn about their axis (Jeffery 1915)."""
    if gap == 0:
        return 0.9015427  # 3/4 zeta(3)
    alpha, m = np.arccosh(1 + gap / 2), np.arange(100)
    return np.sum((-1.0) ** m * (np.sinh(alpha) / np.sinh((m + 1) * alpha)) ** 3)


@pytest.mark.parametrize(("gap", "degree"), [(0.0, 12), (0.1, 12), (1.0, 6), (3.0, 5)])
def test_exact_series_of_the_dimer(gap, degree):
    """Along and about the axis the exact series hold within 1e-5, at a distance at low degrees."""
    mobility = cluster_mobility([[0, 0, 0], [0, 0, 2 + gap]], radius=1.0, degree=degree, **WATERY)
    along = KT_OVER_ETA / (12 * np.pi * axial_drag(gap))
    about = KT_OVER_ETA / (16 * np.pi * axial_torque(gap))
    assert mobility.D_T[2, 2] == pytest.approx(along, rel=1e-5)
    assert mobility.D_R[2, 2] == pytest.approx(about, rel=1e-5)


def test_spheres_far_apart():
    """Two spheres 200 radii apart move by Kirkwood's formula, D_T = (1 + a/r)/2, up to (a/r)^3."""
    mobility = cluster_mobility([[0, 0, 0], [0, 0, 200]], radius=1.0, **WATERY)
    assert ratios(mobility)[0] == pytest.approx(0.5 * (1 + 1 / 200), rel=1e-6)


# ---- laws ---------------------------------------------------------------------------------------


def test_moved_and_relabelled_bodies():
    """Translation and another order of the spheres change nothing but rounding."""
    shift = np.array([1e3, -20, 7])
    moved = cluster_mobility(ODD + shift, radius=ODD_RADII, **WATERY)
    np.testing.assert_allclose(moved.D, odd().D, rtol=1e-8, atol=1e-9 * odd().D[0, 0])
    np.testing.assert_allclose(moved.center - shift, odd().center, atol=1e-8)
    order = [2, 0, 3, 1]
    other = cluster_mobility(ODD[order], radius=ODD_RADII[order], **WATERY)
    np.testing.assert_allclose(other.D, odd().D, rtol=1e-8, atol=1e-9 * odd().D[0, 0])


@pytest.mark.parametrize("turn", [TURN, -TURN])
def test_a_turned_and_a_mirrored_body(turn):
    """D turns with the body within the stated error; a mirror image couples the other way."""
    turned = cluster_mobility(ODD @ turn.T, radius=ODD_RADII, **WATERY)
    proper = turn * np.linalg.det(turn)
    both = np.kron(np.diag([np.linalg.det(turn), 1.0]), proper)
    expected = both @ odd().D @ both.T
    assert deviation(turned.D, expected) < turned.error + odd().error
    np.testing.assert_allclose(turned.center, turn @ odd().center, atol=2e-4)
    # The coupling is seen: it is larger than the error, so that the sign is tested.
    assert np.abs(odd().coupling).max() > 10 * odd().error * np.sqrt(
        odd().D_T[0, 0] * odd().D_R[0, 0]
    )


def test_units():
    """Lengths in another unit, a power of two: the same digits; D is proportional to kT/eta."""
    scaled = cluster_mobility(8 * ODD, radius=8 * ODD_RADII, **WATERY)
    units = np.repeat([8**-0.5, 8**-1.5], 3)
    np.testing.assert_allclose(scaled.D, odd().D * units[:, None] * units, rtol=1e-10, atol=1e-12)
    thick = cluster_mobility(ODD, radius=ODD_RADII, viscosity=2e-3, temperature=330.0)
    np.testing.assert_allclose(thick.D, odd().D * 0.55, rtol=1e-12)
    assert thick.diameter_factor_R == pytest.approx(odd().diameter_factor_R, rel=1e-12)


@pytest.mark.parametrize("mobility", [odd, lambda: body("line 4"), uneven_dimer])
def test_a_mobility_is_symmetric_and_positive(mobility):
    """D is positive definite about any point, its coupling symmetric at the centre."""
    D = mobility().D
    np.testing.assert_allclose(D, D.T, rtol=1e-12, atol=1e-14 * D[0, 0])
    np.testing.assert_allclose(D[:3, 3:], D[:3, 3:].T, atol=1e-12 * D[0, 0])
    for point in ([0, 0, 0], [5.0, -3.0, 1.0]):
        assert np.linalg.eigvalsh(mobility().at(point))[0] > 0
    np.testing.assert_allclose(mobility().at(mobility().center), D, rtol=1e-12)


def test_a_larger_body_is_slower():
    """Adding a sphere takes mobility from every motion (Hill and Power): D falls as a matrix."""
    whole, part = odd(), cluster_mobility(ODD[:3], radius=ODD_RADII[:3], **WATERY)
    point = [1.0, 0.5, 0.2]
    loss = part.at(point) - whole.at(point)
    assert np.linalg.eigvalsh(loss)[0] > 0


def test_overlapping_spheres():
    """From one sphere to a touching dimer D falls steadily; a hidden sphere changes nothing."""
    mean = [
        ratios(cluster_mobility([[0, 0, 0], [0, 0, s]], radius=1.0, **WATERY))[0]
        for s in (0.02, 0.5, 1.0, 1.5, 2.0)
    ]
    # Half the length of the body more than a sphere's is 0.01, the mean radius 0.005.
    assert 1 - 0.005 < mean[0] < 1
    assert np.all(np.diff(mean) < 0)
    pair = np.array([[0.0, 0, -0.5], [0, 0, 0.5]])
    without = cluster_mobility(pair, radius=1.0, **WATERY)
    hidden = cluster_mobility([*pair, [0, 0, 0]], radius=[1.0, 1.0, 0.8], **WATERY)
    shift = hidden.at([0, 0, 0])
    np.testing.assert_allclose(shift, without.at([0, 0, 0]), rtol=1e-6, atol=1e-9)


def test_volume_counts_overlaps_once():
    """Separate spheres add up; two spheres with a common lens are the closed formula (1e-4)."""
    assert odd().volume == pytest.approx(float((4 / 3 * np.pi * ODD_RADII**3).sum()), rel=1e-2)
    assert body("octahedron").volume == pytest.approx(8 * np.pi, rel=1e-12)
    fused = cluster_mobility([[0, 0, 0], [0, 0, 1.5]], radius=1.0, degree=2, **WATERY)
    lens = 2 * np.pi * 0.25**2 * (3 - 0.25) / 3
    assert fused.volume == pytest.approx(8 * np.pi / 3 - lens, rel=1e-4)


# ---- tracked points -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "ratio"),
    [("dimer", 1.186), ("triangle", 1.223), ("tetrahedron", 1.223), ("octahedron", 1.232)],
)
def test_a_tracked_sphere_and_the_centroid(name, ratio):
    """Tracking one sphere of a cluster shows a D_T that is 20 % high, the centroid none at all."""
    mobility = body(name)
    mean = np.trace(mobility.D_T) / 3
    one = apparent_translation(mobility, point=mobility.centers[0])
    assert one / mean == pytest.approx(ratio, abs=6e-4)
    assert apparent_translation(mobility, point=mobility.centroid) == pytest.approx(mean, rel=1e-6)
    r = mobility.centers[0] - mobility.center
    formula = np.trace(mobility.D_R) * (r @ r) - r @ mobility.D_R @ r
    assert one == pytest.approx(mean + formula / 3, rel=1e-9)


# ---- errors -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["dimer", "line 3", "triangle", "tetrahedron"])
def test_the_error_estimate_bounds_the_error(name, repeats):
    """At degrees 1 to 8 the estimate is never under a third of the error (against degree 11).

    The quick form takes three of these degrees, against degree 8.

    benchmarks/mobility.py does the same for every row of the table and for unequal spheres.
    """
    truth = body(name, repeats(8, 11)).D
    for degree in repeats((1, 2, 5), range(1, 9)):
        mobility = body(name, degree)
        assert mobility.error > deviation(mobility.D, truth) / 3
    assert body(name, 8).error < 1e-4


def test_the_error_of_unequal_and_fused_bodies(repeats):
    """The same holds where convergence is slow: 1:3 touching, and fused spheres."""
    for centers, radius in (
        ([[0, 0, 0], [0, 0, 4.0]], [1.0, 3.0]),
        ([[0, 0, 0], [0, 0, 1.0], [0.9, 0, 0.3]], [1.0, 1.0, 0.8]),
    ):
        truth = cluster_mobility(centers, radius=radius, degree=repeats(10, 12), **WATERY).D
        for degree in repeats((3, 6), (3, 4, 6, 8)):
            mobility = cluster_mobility(centers, radius=radius, degree=degree, **WATERY)
            assert mobility.error > deviation(mobility.D, truth) / 3


def test_a_higher_accuracy_on_request():
    """With accuracy=1e-5 the tetrahedron's factors are the converged ones within 1e-5."""
    mobility = cluster_mobility(BODIES["tetrahedron"], radius=1.0, accuracy=1e-5, **WATERY)
    assert mobility.error < 1e-5
    assert mobility.diameter_factor_T == pytest.approx(1.78433, abs=1.5e-5)
    assert mobility.diameter_factor_R == pytest.approx(1.81828, abs=1.5e-5)


def test_work_is_bounded(monkeypatch):
    """Seven equal spheres are done at degree 8: the work of a second, and no more."""
    assert body("pentagonal bipyramid").degree <= 8
    monkeypatch.setattr(resistance, "_MOST_UNKNOWNS", 300)
    with pytest.warns(PrecisionWarning, match=r"degree 5 leaves .* above 1\.0e-04"):
        short = dimer(1.0)
    assert short.error > 1e-4


# ---- what comes out, what may go in -------------------------------------------------------------


def test_a_mobility_is_read_only_and_fits_into_json():
    """Arrays cannot be changed after the fact; to_dict holds plain numbers that lead back to D."""
    mobility = odd()
    with pytest.raises(ValueError, match="read-only"):
        mobility.D[0, 0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        mobility.error = 0.0
    entry = json.loads(json.dumps(mobility.to_dict(), allow_nan=False))
    np.testing.assert_array_equal(entry["D"], mobility.D)
    axes, values = np.array(entry["D_R_axes"]), entry["D_R_principal"]
    np.testing.assert_allclose(axes.T @ np.diag(values) @ axes, mobility.D_R, atol=1e-12)
    assert repr(mobility).startswith("Mobility(n=4, D_T=")


@pytest.mark.parametrize(
    "result", [odd, lambda: resistance.solve_resistance(ODD, ODD_RADII, degree=2)]
)
def test_a_prediction_comes_back_from_json(result):
    """Every field of a Mobility and of a Resistance is the same to the last bit."""
    result = result()
    back = type(result).from_dict(json.loads(json.dumps(result.to_dict(), allow_nan=False)))
    for field in dataclasses.fields(result):
        one, two = getattr(back, field.name), getattr(result, field.name)
        np.testing.assert_array_equal(one, two)
        assert type(one) is type(two)


def test_a_cluster_is_its_positions():
    """A Cluster is accepted in place of its positions."""
    cluster = Cluster.touching(4, 2.0)
    mobility = cluster_mobility(cluster, radius=1.0, **WATERY)
    assert isinstance(mobility, Mobility)
    np.testing.assert_array_equal(mobility.D, body("tetrahedron").D)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"radius": 0}, ["radius"]),
        ({"radius": -1.0}, ["radius"]),
        ({"radius": [1.0, 1.0]}, ["radius", "one for each centre"]),
        ({"radius": [1.0, np.nan, 1.0]}, ["radius"]),
        ({"centers": [[0, 0, 0], [0, 0, 0], [0, 0, 2]]}, ["spheres 0 and 1", "remove one"]),
        ({"centers": [[0, 0, 0], [0, 0, 0.3], [0, 0, 9]], "radius": [1, 0.5, 1]}, ["sphere 1"]),
        ({"centers": [[0, 0], [2, 0]]}, ["(n, 3)", "z = 0"]),
        ({"centers": [[0, 0, np.nan]]}, ["NaN"]),
        ({"centers": np.zeros((0, 3))}, ["centers"]),
        ({"viscosity": 0}, ["viscosity"]),
        ({"viscosity": np.inf}, ["viscosity"]),
        ({"temperature": 22}, ["kelvin", "295.15"]),
        ({"temperature": 501}, ["kelvin"]),
        ({"temperature": -5}, ["temperature"]),
        ({"temperature": 22, "viscosity": -1, "radius": 0}, ["kelvin", "viscosity", "radius"]),
        ({"degree": 0}, ["degree"]),
        ({"degree": 2.5}, ["degree"]),
        ({"degree": 41}, ["degree"]),
        ({"accuracy": 0}, ["accuracy"]),
        ({"centers": np.arange(300.0).reshape(100, 3)}, ["100 spheres", "state a degree"]),
    ],
)
def test_invalid_bodies_are_refused(options, words):
    """Every fault is named, all of them in one message."""
    given = {"centers": line(3), "radius": 1.0} | WATERY | options
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the words are checked below)
        cluster_mobility(given.pop("centers"), **given)
    for word in words:
        assert word in str(error.value)


@pytest.mark.parametrize("point", [[0, 0], [0, 0, np.nan], 3.0])
def test_a_point_has_three_coordinates(point):
    """A tracked point that is none is refused."""
    with pytest.raises(ValueError, match="point"):
        apparent_translation(body("dimer"), point=point)
