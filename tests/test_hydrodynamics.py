"""Sizes from diffusion coefficients: the paper's Table 1, planted sizes, errors counted once."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest

from perrin import (
    Cluster,
    UnitWarning,
    cluster_mobility,
    estimate_diffusion,
    simulate_motion,
    size_and_viscosity,
    size_from_rotation,
    size_from_translation,
    track_rotation,
    water_viscosity,
)
from perrin.hydrodynamics import Size

PAPER = {"viscosity": 2.18e-3, "temperature": 295.0}
TETRAHEDRON = Cluster.touching(4, 2.45)
D_T, D_R = (3.85e-2, 0.49e-2), (4.93e-3, 0.49e-3)  # the paper's Table 1
BENT = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [2, 2, 2]])  # touching, diameter 2


@pytest.fixture(scope="module")
def tetrahedron():
    """Return the mobility of the tetrahedron, whose shape the sizes need."""
    return cluster_mobility(TETRAHEDRON, radius=1.225, **PAPER)


@pytest.fixture(scope="module")
def bent():
    """Return the mobility of four touching spheres of 1.7 um under the paper's conditions."""
    return cluster_mobility(0.85 * BENT, radius=0.85, **PAPER)


def means(mobility):
    """Return D_T and D_R, a third of the traces."""
    return np.trace(mobility.D_T) / 3, np.trace(mobility.D_R) / 3


def test_the_papers_table():
    """Factor 1.844: both sizes of Table 1, errors propagated (facts/estimation.md, 6)."""
    t = size_from_translation(D_T, cluster=TETRAHEDRON, factor="hoffmann2009", **PAPER)
    r = size_from_rotation(D_R, cluster=TETRAHEDRON, factor="hoffmann2009", **PAPER)
    got = [t.cluster, t.cluster_stderr, t.sphere, t.sphere_stderr]
    np.testing.assert_allclose(got, [5.149, 0.655, 2.792, 0.355], atol=6e-4)
    got = [r.cluster, r.cluster_stderr, r.sphere, r.sphere_stderr]
    np.testing.assert_allclose(got, [4.941, 0.164, 2.680, 0.089], atol=6e-4)
    assert t.factor == r.factor == "hoffmann2009"


def test_the_papers_option_to_the_last_bit():
    """The named option is the plain arithmetic of Eqs. 25 to 27, bit for bit."""
    rng = np.random.default_rng(1)
    thermal = 1.380649e-23 * 295.0
    for value, relative in zip(rng.uniform(1e-4, 1, 50), rng.uniform(0.01, 0.3, 50), strict=True):
        stderr = value * relative
        t, r = (
            size((value, stderr), cluster=TETRAHEDRON, factor="hoffmann2009", **PAPER)
            for size in (size_from_translation, size_from_rotation)
        )
        by_t = thermal / (3 * np.pi * 2.18e-3 * value * 1e-12) * 1e6
        by_r = float(np.cbrt(thermal / (np.pi * 2.18e-3 * value))) * 1e6
        assert (t.cluster, t.sphere) == (by_t, by_t / 1.844)
        assert (r.cluster, r.sphere) == (by_r, by_r / 1.844)
        assert t.cluster_stderr == by_t * (stderr / value)
        assert r.sphere_stderr == by_r / 1.844 * (stderr / value / 3)


def test_the_papers_data_with_the_right_factors(tetrahedron):
    """1.784 and 1.818: the sizes of facts/hydrodynamics.md, 5, 6.2 % apart, not 4.2 %."""
    t = size_from_translation(D_T, cluster=tetrahedron, **PAPER)
    r = size_from_rotation(D_R, cluster=tetrahedron, **PAPER)
    assert (t.sphere, t.sphere_stderr) == pytest.approx((2.89, 0.37), abs=6e-3)
    assert (r.sphere, r.sphere_stderr) == pytest.approx((2.717, 0.090), abs=6e-4)
    assert t.sphere / r.sphere == pytest.approx(1.062, abs=6e-4)
    joint = size_and_viscosity(D_T, D_R, cluster=tetrahedron, temperature=295.0)
    assert (joint.sphere, joint.sphere_stderr) == pytest.approx((2.64, 0.21), abs=6e-3)
    assert joint.viscosity == pytest.approx(2.39e-3, abs=6e-6)
    assert joint.viscosity_stderr == pytest.approx(0.47e-3, abs=6e-6)


@pytest.mark.parametrize("unit", [1.0, 0.4])
def test_planted_sizes_come_back(bent, unit):
    """What cluster_mobility predicts leads back to the diameter, whatever the shape's scale."""
    translation, rotation = means(bent)
    shape = unit * BENT
    t = size_from_translation(translation, cluster=shape, **PAPER)
    r = size_from_rotation(rotation, cluster=shape, **PAPER)
    joint = size_and_viscosity(translation, rotation, cluster=shape, temperature=295.0)
    for size in (t, r, joint):
        # Shapes of another scale round differently; the error is that of the last digits.
        assert size.sphere == pytest.approx(1.7, rel=1e-9)
        assert size.sphere_stderr == 0
    assert t.cluster == pytest.approx(bent.diameter_T, rel=1e-12)
    assert r.cluster == pytest.approx(bent.diameter_R, rel=1e-12)
    assert joint.viscosity == pytest.approx(2.18e-3, rel=1e-9)


def test_spheres_that_do_not_touch_and_unequal_ones():
    """A stated diameter and a Mobility determine the spheres that positions alone do not."""
    apart = Cluster(1.2 * BENT, diameter=2.0)
    mobility = cluster_mobility(0.6 * BENT, radius=0.5, **PAPER)
    got = size_from_rotation(means(mobility)[1], cluster=apart, **PAPER)
    assert got.sphere == pytest.approx(1.0, rel=1e-9)
    unequal = cluster_mobility([[0, 0, 0], [0, 0, 1.5]], radius=[0.5, 1.0], **PAPER)
    got = size_from_translation(means(unequal)[0] / 3, cluster=unequal, **PAPER)
    assert got.sphere == pytest.approx(3 * 1.5, rel=1e-9)


def test_sizes_come_back_from_json():
    """Every field of a Size, with its viscosity and without."""
    t = size_from_translation(D_T, cluster=TETRAHEDRON, factor="hoffmann2009", **HOT)
    joint = size_and_viscosity(D_T, D_R, cluster=[[0.0, 0, 0], [0, 0, 2]], temperature=295.0)
    for size in (t, joint):
        assert Size.from_dict(json.loads(json.dumps(size.to_dict()))) == size


def test_neighbours_set_the_scale():
    """Measured positions: the mean over touching pairs; the paper's pentahedron touches in six."""
    body = TETRAHEDRON.positions
    stretched = body * [1.0, 1.0, 1.01]
    i, j = np.triu_indices(4, 1)
    mean = np.linalg.norm(stretched[i] - stretched[j], axis=1).mean()
    planted = cluster_mobility(stretched, radius=mean / 2, **PAPER)
    got = size_from_rotation(means(planted)[1], cluster=stretched, **PAPER)
    assert got.sphere == pytest.approx(mean, rel=1e-9)
    paper = Cluster.pentahedron(1.0)
    planted = cluster_mobility(paper, radius=0.5**0.5, **PAPER)
    assert size_from_rotation(means(planted)[1], cluster=paper, **PAPER).sphere == pytest.approx(
        2**0.5, rel=1e-9
    )
    one = size_from_translation(0.1, cluster=[[1.0, 2.0, 3.0]], **PAPER)
    assert one.sphere == pytest.approx(one.cluster, rel=1e-9)


def test_an_estimate_carries_its_error():
    """A DiffusionEstimate gives the same as its value and standard error."""
    truth = simulate_motion(TETRAHEDRON, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=100, rng=1)
    motion = track_rotation(truth.positions(), dt=0.7)
    shape = cluster_mobility(motion.template, radius=1.225, **PAPER)
    for quantity, size in (
        ("translation", size_from_translation),
        ("rotation", size_from_rotation),
    ):
        estimate = estimate_diffusion(motion, quantity=quantity)
        pair = (estimate.value, estimate.stderr)
        known = {"cluster": shape, **PAPER}
        assert size(estimate, **known) == size(pair, **known)
        assert size(estimate, **known).sphere_stderr > 0
        bare = size(estimate.value, **known)
        assert bare == replace(size(estimate, **known), cluster_stderr=0.0, sphere_stderr=0.0)


# ---- errors -------------------------------------------------------------------------------------

HOT = {"viscosity": (2.18e-3, 0.04 * 2.18e-3), "temperature": (295.0, 0.03 * 295.0)}


def test_errors_of_the_conditions(tetrahedron):
    """kT/eta is 5 % uncertain: so is d from D_T, and d from D_R by a third of that."""
    shape = {"cluster": tetrahedron}
    t = size_from_translation(D_T[0], **shape, **HOT)
    r = size_from_rotation(D_R[0], **shape, **HOT)
    assert t.sphere_stderr / t.sphere == pytest.approx(0.05, rel=1e-9)
    assert r.sphere_stderr / r.sphere == pytest.approx(0.05 / 3, rel=1e-9)
    assert t.shared_stderr == pytest.approx(t.sphere_stderr, rel=1e-12)
    both = size_from_translation((D_T[0], 0.12 * D_T[0]), **shape, **HOT)
    assert both.cluster_stderr / both.cluster == pytest.approx(0.13, rel=1e-9)
    assert both.shared_stderr == pytest.approx(t.shared_stderr, rel=1e-12)


def test_the_difference_of_two_routes_counts_conditions_once(tetrahedron):
    """Monte Carlo: D_T, D_R and one kT/eta for both drawn; the spread of the difference (2 %)."""
    rng = np.random.default_rng(3)
    shape = {"cluster": tetrahedron}
    t = size_from_translation((D_T[0], 0.02 * D_T[0]), **shape, **HOT)
    r = size_from_rotation((D_R[0], 0.03 * D_R[0]), **shape, **HOT)
    count = 20_000  # the spread is known to 0.5 %; second order in the 5 % adds 0.3 %
    draw = rng.normal(size=(4, count)) * np.array([[0.02], [0.03], [0.04], [0.03]])
    thermal = (1 + draw[3]) / (1 + draw[2])
    difference = t.sphere * thermal / (1 + draw[0]) - r.sphere * np.cbrt(thermal / (1 + draw[1]))
    value, stderr = t.difference(r)
    assert value == t.sphere - r.sphere
    assert stderr == pytest.approx(difference.std(), rel=0.02)
    assert stderr < 0.9 * np.hypot(t.sphere_stderr, r.sphere_stderr)
    sure = size_from_translation(D_T[0], **shape, **HOT)
    assert sure.difference(sure) == (0.0, 0.0)
    assert t.difference(t)[1] == pytest.approx(0.02 * 2**0.5 * t.sphere, rel=1e-9)


def test_a_viscosity_that_follows_the_temperature(tetrahedron):
    """One kelvin moves kT/eta of water by 2.7 % at 20 C: both effects, of one sign, once."""
    known = {"cluster": tetrahedron, "viscosity": water_viscosity, "temperature": (293.15, 1.0)}
    t = size_from_translation(D_T[0], **known)
    slope = np.log(294.15 / water_viscosity(294.15)) - np.log(292.15 / water_viscosity(292.15))
    assert t.sphere_stderr / t.sphere == pytest.approx(slope / 2, rel=1e-3)
    assert t.sphere_stderr / t.sphere == pytest.approx(0.027, abs=1e-3)
    cold = known | {"temperature": 293.15}
    fixed = cold | {"viscosity": water_viscosity(293.15)}
    assert size_from_rotation(D_R, **cold) == size_from_rotation(D_R, **fixed)


def test_the_joint_errors_by_monte_carlo(tetrahedron, repeats):
    """Drawn D_T, D_R and temperature: spreads of d and eta (3 errors), and no error of T in d."""
    shape, count = tetrahedron, repeats(1000, 5000)
    given = [(D_T[0], 0.02 * D_T[0]), (D_R[0], 0.03 * D_R[0])]
    joint = size_and_viscosity(*given, cluster=shape, temperature=(295.0, 6.0))
    rng = np.random.default_rng(5)
    draws = [
        size_and_viscosity(t, r, cluster=shape, temperature=kelvin)
        for t, r, kelvin in zip(
            rng.normal(*given[0], count),
            rng.normal(*given[1], count),
            rng.normal(295.0, 6.0, count),
            strict=True,
        )
    ]
    # The standard error of a standard deviation is 1/sqrt(2 N): 2.2 % of 1000 draws.
    allowed = 3 / np.sqrt(2 * count)
    spread = np.std([d.sphere for d in draws])
    assert joint.sphere_stderr == pytest.approx(spread, rel=allowed)
    spread = np.std([d.viscosity for d in draws])
    assert joint.viscosity_stderr == pytest.approx(spread, rel=allowed)
    assert joint.shared_stderr == 0


# ---- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize("size", [size_from_translation, size_from_rotation])
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"D": 0.0}, ["D: "]),
        ({"D": np.nan}, ["D: "]),
        ({"D": (0.04, -0.001)}, ["D: ", "standard error"]),
        ({"viscosity": 0.0}, ["viscosity"]),
        ({"viscosity": (1e-3, np.nan)}, ["viscosity", "standard error"]),
        ({"viscosity": lambda kelvin: -kelvin}, ["viscosity"]),
        ({"temperature": 22.0}, ["kelvin", "295.15"]),
        ({"factor": "best"}, ["factor", "'best'"]),
        ({"D": -1, "viscosity": 0, "temperature": 20}, ["D: ", "viscosity", "kelvin"]),
        ({"cluster": Cluster.touching(5, 2.0), "factor": "hoffmann2009"}, ["tetrahedra"]),
        ({"cluster": [[0, 0, 0], [0, 0, 0]]}, ["both at"]),
        ({"cluster": [[0, 0], [2, 0], [1, 2]]}, ["(n, 3)"]),
    ],
)
def test_bad_input_is_refused(size, options, words):
    """Every fault of the numbers is in one message; shapes that cannot be used are refused."""
    given = {"D": 0.04, "cluster": TETRAHEDRON, **PAPER} | options
    with pytest.raises(ValueError) as error:  # noqa: PT011 (the words are checked below)
        size(given.pop("D"), **given)
    for word in words:
        assert word in str(error.value)


def test_bad_input_to_the_joint_size():
    """The same for size_and_viscosity."""
    with pytest.raises(ValueError, match=r"D_T.*kelvin.*D_R"):
        size_and_viscosity(-1.0, (0.1, -1), cluster=TETRAHEDRON, temperature=22.0)


@pytest.mark.parametrize("size", [size_from_translation, size_from_rotation])
def test_a_viscosity_in_another_unit_is_warned_of(size, tetrahedron):
    """Above 0.5 Pa s each function warns with the value and what it is in mPa s; 0.2 is quiet."""
    for viscosity in (2.18, (2.18, 0.1), lambda kelvin: 2.18):
        with pytest.warns(UnitWarning, match=r"viscosity: 2\.18 Pa s .* state 0\.00218") as caught:
            size(0.01, cluster=tetrahedron, viscosity=viscosity, temperature=295.0)
        assert len(caught) == 1
        assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        size(0.01, cluster=tetrahedron, viscosity=0.2, temperature=295.0)
