"""Walls, gravity and water: published numbers, limits, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from perrin import (
    Cluster,
    cluster_mobility,
    gravitational_height,
    settling_velocity,
    wall_diffusion,
    wall_factor,
    water_viscosity,
)
from perrin.hydrodynamics import WallFactor

PAPER = {"viscosity": 2.18e-3, "temperature": 295.0}


@pytest.fixture(scope="module")
def bodies():
    """Return touching spheres of 2.45 um by their number."""
    known = {"radius": 1.225, "degree": 5, **PAPER}  # within 1e-4, enough for 1 %
    return {n: cluster_mobility(Cluster.touching(n, 2.45), **known) for n in (4, 6)}


# D/D_bulk by height: T_par, T_perp, and R about an axis parallel and perpendicular to the wall, of
# a calibrated shell of beads with Blake's image, four random orientations
# (facts/hydrodynamics.md, 5).
SHELL = {
    4: {
        7.5: (0.836, 0.686, 0.992, 0.997),
        10: (0.879, 0.757, 0.996, 0.999),
        20: (0.939, 0.878, 1.0, 1.0),
        50: (0.975, 0.951, 1.0, 1.0),
    },
    6: {
        7.5: (0.815, 0.638, 0.988, 0.995),
        10: (0.861, 0.725, 0.995, 0.998),
        20: (0.930, 0.860, 0.999, 1.0),
        50: (0.972, 0.944, 1.0, 1.0),
    },
}


@pytest.mark.parametrize("n", SHELL)
@pytest.mark.parametrize("height", [7.5, 10, 20, 50])
def test_the_series_against_resolved_clusters(bodies, n, height):
    """Within 1 % (their orientations spread by as much) from 7.5 um = 3 hydrodynamic radii on."""
    near = wall_factor(bodies[n], height=height)
    got = [near.T_parallel, near.T_perpendicular, near.R_parallel, near.R_perpendicular]
    np.testing.assert_allclose(got, SHELL[n][height], rtol=0.01)


def test_a_sphere_near_a_wall():
    """A 2.45 um sphere at 5 and 10 um: the resolved values of the same table within 0.3 %."""
    for height, T_par, T_perp in ((5, 0.863, 0.730), (10, 0.931, 0.863)):
        near = wall_factor(2.45, height=height)
        assert near.T_parallel == pytest.approx(T_par, rel=3e-3)
        assert near.T_perpendicular == pytest.approx(T_perp, rel=3e-3)


def test_the_walls_effect_fades():
    """Far away there is no effect; nearer, translation slows more than rotation, normal most."""
    far = wall_factor(1.0, height=1e6)
    assert far.T_perpendicular == pytest.approx(1, abs=1e-6)
    for height in (1.3, 2.0, 10.0):
        near = wall_factor(1.0, height=height)
        order = [near.T_perpendicular, near.T_parallel, near.R_parallel, near.R_perpendicular, 1.0]
        assert np.all(np.diff(order) > 0)


@pytest.mark.parametrize("normal", "xyz")
def test_the_signature_of_a_wall(bodies, normal):
    """D along the normal is the low one, the others are equal; units are those of D."""
    D_T, D_R = wall_diffusion(bodies[4], height=7.5, normal=normal)
    near, axis = wall_factor(bodies[4], height=7.5), "xyz".index(normal)
    ratio = D_T / (np.trace(bodies[4].D_T) / 3)
    expected = np.full(3, near.T_parallel)
    expected[axis] = near.T_perpendicular
    np.testing.assert_allclose(ratio, expected, rtol=1e-12)
    assert D_R.argmax() == axis


def test_gravity(bodies):
    """Heights of 13.5, 1.35, 0.27 um and speeds of 0.0034, 0.034, 0.17 um/s for 1, 10, 50 kg/m^3.

    (facts/hydrodynamics.md, 5.) What floats rises, and gathers over the same height.
    """
    body = bodies[4]
    for difference, height, speed in ((1, 13.5, 0.0034), (10, 1.35, 0.034), (50, 0.27, 0.17)):
        got = gravitational_height(body, density_difference=difference)
        assert got == pytest.approx(height, rel=0.01)
        falling = settling_velocity(body, density_difference=difference)
        assert falling == pytest.approx(speed, rel=0.02)
        assert got * falling == pytest.approx(np.trace(body.D_T) / 3, rel=1e-12)
        assert settling_velocity(body, density_difference=-difference) == -falling
        assert gravitational_height(body, density_difference=-difference) == got
    assert gravitational_height(body, density_difference=0.0) == np.inf
    assert settling_velocity(body, density_difference=0.0) == 0


def test_a_stokes_sphere_settles():
    """One sphere settles by Stokes: 2/9 delta-rho g a^2/eta."""
    sphere = cluster_mobility([[0, 0, 0]], radius=0.5, **PAPER)
    stokes = 2 / 9 * 50 * 9.80665 * (0.5e-6) ** 2 / 2.18e-3 * 1e6
    assert settling_velocity(sphere, density_difference=50) == pytest.approx(stokes, rel=1e-9)


@pytest.mark.parametrize(
    ("celsius", "millipascal"),
    [(0, 1.792), (20, 1.0016), (25, 0.8900), (40, 0.6527), (60, 0.4660), (100, 0.2818)],
)
def test_water(celsius, millipascal):
    """The viscosity of water in handbooks, within 0.1 %; 2.4 % per kelvin at 20 C."""
    assert water_viscosity(celsius + 273.15) == pytest.approx(1e-3 * millipascal, rel=1e-3)
    step = water_viscosity(294.15) / water_viscosity(293.15)
    assert step == pytest.approx(1 - 0.024, abs=5e-4)


def test_invalid_conditions_are_refused(bodies):
    """Too near a wall, no height, another axis, no number, Celsius, ice and steam."""
    for body in (bodies[4], bodies[6], 2.45):
        with pytest.raises(ValueError, match=r"2\.5 hydrodynamic radii"):
            wall_factor(body, height=2.9)
    with pytest.raises(ValueError, match=r"diameter.*height"):
        wall_factor(-1.0, height=np.nan)
    with pytest.raises(ValueError, match="normal"):
        wall_diffusion(bodies[4], height=20.0, normal="w")
    for function in (gravitational_height, settling_velocity):
        with pytest.raises(ValueError, match="density_difference"):
            function(bodies[4], density_difference=np.nan)
    for kelvin in (20.0, 250.0, 390.0, -3, np.nan):
        with pytest.raises(ValueError, match="temperature"):
            water_viscosity(kelvin)


def test_a_wall_factor_comes_back_from_json():
    """Every field is the same."""
    near = wall_factor(2.45, height=5.0)
    assert WallFactor.from_dict(json.loads(json.dumps(near.to_dict()))) == near
