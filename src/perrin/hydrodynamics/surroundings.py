"""Effects of a sample cell on a body: slowing by a wall, gravity, viscosity of water."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from perrin._arrays import choice_fault, number_fault, refuse
from perrin._display import Shown
from perrin.hydrodynamics.mobility import BOLTZMANN, Mobility, condition_faults

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Self

    from perrin._arrays import Floats

_GRAVITY = 9.80665  # m/s^2, standard

# Height over the hydrodynamic radius below which the series of a sphere has an error above 2 % for
# the translation of a cluster along the normal.
_LOWEST_HEIGHT = 2.5

# Liquid water at 0.1 MPa in uPa s: sum of a (T/300 K)^b, 253.15 K to 383.15 K
# (IAPWS SR6-08, Revised Supplementary Release on Properties of Liquid Water at 0.1 MPa).
_WATER_TERMS = ((280.68, -1.9), (511.45, -7.7), (61.131, -19.6), (0.45903, -40.0))

_WATER_RANGE = (253.15, 383.15)


@dataclass(frozen=True, repr=False)
class WallFactor(Shown):
    """D near one flat wall over D far from it.

    Attributes
    ----------
    T_parallel : float
        Factor of the translation along the wall.
    T_perpendicular : float
        Factor of the translation along the normal of the wall.
    R_parallel : float
        Factor of the rotation about an axis along the wall.
    R_perpendicular : float
        Factor of the rotation about the normal of the wall.
    height : float
        Height of the body's centre above the wall, um.
    """

    T_parallel: float
    T_perpendicular: float
    R_parallel: float
    R_perpendicular: float
    height: float

    def to_dict(self) -> dict[str, float]:
        """Return the factors for JSON, units in the names.

        Examples
        --------
        >>> wall_factor(2.45, height=5.0).to_dict()["height_um"]
        5.0
        """
        entry = asdict(self)
        return {name: entry[name] for name in entry if name != "height"} | {
            "height_um": self.height
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, float]) -> Self:
        """Return the factors that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        return cls(
            **{name: value for name, value in entry.items() if name != "height_um"},
            height=entry["height_um"],
        )


def wall_factor(body: Mobility | float, *, height: float) -> WallFactor:
    """Return by what factors a flat no-slip wall reduces the diffusion of a body.

    Parameters
    ----------
    body : Mobility or float
        A cluster, averaged over its orientations, or the diameter of a sphere, um.
    height : float
        Height of the body's centre above the wall, um; at least 2.5 hydrodynamic radii.

    Returns
    -------
    WallFactor

    Raises
    ------
    ValueError
        If a number is not positive, or the body is too near the wall for the series.

    Notes
    -----
    The series of a sphere in x = radius/height: 1 - 9x/16 + x^3/8 - 45x^4/256 - x^5/16 along the
    wall (Faxen), 1 - 9x/8 + x^3/2 - x^5/8 along the normal, 1 - 5x^3/16 and 1 - x^3/8 for rotation
    about an axis along the wall and about the normal. With the cluster's hydrodynamic radius of
    each mode its error is below 1 % for compact clusters three hydrodynamic radii away. The
    deficits of two walls add up approximately.

    Examples
    --------
    >>> near = wall_factor(2.45, height=5.0)
    >>> round(near.T_parallel, 3), round(near.T_perpendicular, 3)
    (0.863, 0.732)
    """
    by_T, by_R = (
        (body.diameter_T / 2, body.diameter_R / 2)
        if isinstance(body, Mobility)
        else (body / 2, body / 2)
    )
    faults = condition_faults(diameter=2 * by_T, height=height)
    if not faults and height < _LOWEST_HEIGHT * max(by_T, by_R):
        faults.append(
            f"height: the series needs at least {_LOWEST_HEIGHT:g} hydrodynamic radii, "
            f"{_LOWEST_HEIGHT * max(by_T, by_R):.3g} um, got {height:g} um; nearer to the wall use "
            "D_R"
        )
    refuse(faults)
    x, y = float(by_T) / float(height), float(by_R) / float(height)
    return WallFactor(
        T_parallel=1 - 9 * x / 16 + x**3 / 8 - 45 * x**4 / 256 - x**5 / 16,
        T_perpendicular=1 - 9 * x / 8 + x**3 / 2 - x**5 / 8,
        R_parallel=1 - 5 * y**3 / 16,
        R_perpendicular=1 - y**3 / 8,
        height=float(height),
    )


def wall_diffusion(
    body: Mobility, *, height: float, normal: Literal["x", "y", "z"] = "z"
) -> tuple[Floats, Floats]:
    """Return D_T and D_R along and about each lab axis near a wall, over all orientations.

    A D along the normal below the two others indicates a wall without any model.

    Parameters
    ----------
    body : Mobility
    height : float
        Height of the body's centre above the wall, um.
    normal : {"x", "y", "z"}
        Lab axis perpendicular to the wall.

    Returns
    -------
    D_T, D_R : ndarray, shape (3,)
        um^2/s and rad^2/s along and about x, y, z.

    Raises
    ------
    ValueError
        As in `wall_factor`, or for another axis.

    Examples
    --------
    >>> from perrin import Cluster, cluster_mobility
    >>> body = cluster_mobility(
    ...     Cluster.touching(4, 2.45), radius=1.225, viscosity=2.18e-3, temperature=295
    ... )
    >>> D_T, D_R = wall_diffusion(body, height=7.5)
    >>> D_T.round(3)
    array([0.038, 0.038, 0.031])
    """
    refuse(choice_fault("normal", normal, "xyz"))
    near = wall_factor(body, height=height)
    across = np.array([axis == normal for axis in "xyz"])
    D_T = np.where(across, near.T_perpendicular, near.T_parallel) * np.trace(body.D_T) / 3
    D_R = np.where(across, near.R_perpendicular, near.R_parallel) * np.trace(body.D_R) / 3
    return D_T, D_R


def gravitational_height(body: Mobility, *, density_difference: float) -> float:
    """Return the height over which the density of clusters falls by a factor e: kT/(F - buoyancy).

    Parameters
    ----------
    body : Mobility
        Volume and temperature are used.
    density_difference : float
        Density of the particles less that of the solvent, kg/m^3; negative if they rise.

    Returns
    -------
    float
        Height, um; inf for matched densities.

    Raises
    ------
    ValueError
        If the difference is not finite.

    Examples
    --------
    >>> from perrin import Cluster, cluster_mobility
    >>> body = cluster_mobility(
    ...     Cluster.touching(4, 2.45), radius=1.225, viscosity=2.18e-3, temperature=295
    ... )
    >>> round(gravitational_height(body, density_difference=10.0), 2)
    1.35
    """
    force = abs(_weight(body, density_difference))
    return BOLTZMANN * body.temperature / force * 1e6 if force else float("inf")


def settling_velocity(body: Mobility, *, density_difference: float) -> float:
    """Return the mean sedimentation velocity of a cluster over all orientations.

    Parameters
    ----------
    body : Mobility
    density_difference : float
        Density of the particles less that of the solvent, kg/m^3.

    Returns
    -------
    float
        Velocity D_T (F - buoyancy)/kT, um/s; negative if the cluster rises.

    Raises
    ------
    ValueError
        If the difference is not finite.

    Examples
    --------
    >>> from perrin import Cluster, cluster_mobility
    >>> body = cluster_mobility(
    ...     Cluster.touching(4, 2.45), radius=1.225, viscosity=2.18e-3, temperature=295
    ... )
    >>> round(settling_velocity(body, density_difference=10.0), 3)
    0.034
    """
    weight = _weight(body, density_difference)
    return float(np.trace(body.D_T)) / 3 * weight / (BOLTZMANN * body.temperature) * 1e-6


def water_viscosity(temperature: float) -> float:
    """Return the viscosity of water at 0.1 MPa (IAPWS SR6-08).

    Parameters
    ----------
    temperature : float
        Temperature, K, from 253.15 to 383.15.

    Returns
    -------
    float
        Viscosity, Pa s.

    Raises
    ------
    ValueError
        If the temperature is outside that range.

    Examples
    --------
    >>> round(1e3 * water_viscosity(293.15), 4), round(1e3 * water_viscosity(298.15), 4)
    (1.0016, 0.89)
    """
    faults = condition_faults(temperature=temperature)
    low, high = _WATER_RANGE
    if not faults and not low <= temperature <= high:
        faults.append(f"temperature: expected {low} to {high} K, liquid water, got {temperature!r}")
    refuse(faults)
    # A number of numpy in single precision would be computed with in single precision.
    reduced = float(temperature) / 300
    return float(sum(a * reduced**b for a, b in _WATER_TERMS)) * 1e-6


def _weight(body: Mobility, density_difference: float) -> float:
    """Return the weight of a body less its buoyancy, N."""
    refuse(number_fault("density_difference", density_difference, unit="kg/m^3"))
    return float(density_difference) * _GRAVITY * body.volume * 1e-18
