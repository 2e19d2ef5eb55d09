"""Mobility of a rigid body of spheres in a viscous fluid: its 6x6 diffusion tensor."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import Floats, from_plain, frozen, number_fault, refuse
from perrin._display import Shown
from perrin.errors import UnitWarning
from perrin.geometry.rigid import diffusion_center, shifted
from perrin.geometry.shapes import Cluster, pair_distances
from perrin.hydrodynamics.resistance import converge_resistance, exposed_surface, solve_resistance
from perrin.hydrodynamics.units import viscosity_remarks

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Self

    from numpy.typing import ArrayLike

BOLTZMANN = 1.380649e-23  # J/K, exact in the SI

# Temperatures of liquids under a microscope, K; values in degrees Celsius are outside.
_COLDEST, _HOTTEST = 200.0, 500.0

_HIGHEST_DEGREE = 40  # of the harmonics that a user may request

# Surface points of a sphere from which the volume of an overlapping body is computed, to 1e-4.
_VOLUME_POINTS = 20_000


class Principal(NamedTuple):
    """Principal values of a tensor and its principal axes.

    Attributes
    ----------
    values : ndarray, shape (3,)
        Principal values in increasing order.
    axes : ndarray, shape (3, 3)
        Unit vectors along the principal axes, one per column.
    """

    values: Floats
    axes: Floats


@dataclass(frozen=True, eq=False)
class Mobility(Shown):
    """The predicted diffusion tensor of a rigid body of spheres.

    Attributes
    ----------
    D : ndarray, shape (6, 6)
        Diffusion tensor about the centre of diffusion, in the axes of `centers`: translation
        (um^2/s) first, rotation (rad^2/s) last, their coupling (um rad/s) off the diagonal.
    center : ndarray, shape (3,)
        Centre of diffusion, um: the point about which the coupling is symmetric.
    centers : ndarray, shape (n, 3)
        Centres of the spheres, um.
    radius : ndarray, shape (n,)
        Radii of the spheres, um.
    viscosity : float
        Viscosity of the fluid, Pa s.
    temperature : float
        Temperature of the fluid, K.
    degree : int
        Highest degree of the harmonics used.
    error : float
        Estimated relative error of D in its worst direction: the larger of three quarters of the
        change over the last two degrees and three times the violation of reciprocity.
    residual : float
        Root mean square residual velocity on the surface, relative.
    """

    D: Floats
    center: Floats
    centers: Floats
    radius: Floats
    viscosity: float
    temperature: float
    degree: int
    error: float
    residual: float

    def __post_init__(self) -> None:
        frozen(self.D, self.center, self.centers, self.radius)

    def __repr__(self) -> str:
        return (
            f"Mobility(n={len(self.radius)}, D_T={np.trace(self.D_T) / 3:.4g} um^2/s, "
            f"D_R={np.trace(self.D_R) / 3:.4g} rad^2/s, error={self.error:.1g})"
        )

    @property
    def D_T(self) -> Floats:
        """Translational diffusion tensor, (3, 3), um^2/s."""
        return self.D[:3, :3]

    @property
    def D_R(self) -> Floats:
        """Rotational diffusion tensor, (3, 3), rad^2/s."""
        return self.D[3:, 3:]

    @property
    def coupling(self) -> Floats:
        """Coupling of translation and rotation, (3, 3), um rad/s; 0 for most symmetric bodies."""
        return self.D[:3, 3:]

    @property
    def principal_D_T(self) -> Principal:
        """Principal values and axes of D_T; axes of equal values are arbitrary."""
        return Principal(*np.linalg.eigh(self.D_T))

    @property
    def principal_D_R(self) -> Principal:
        """Principal values and axes of D_R; axes of equal values are arbitrary."""
        return Principal(*np.linalg.eigh(self.D_R))

    @property
    def centroid(self) -> Floats:
        """Mean of the sphere centres, um."""
        return np.asarray(self.centers.mean(0))

    def at(self, point: ArrayLike) -> Floats:
        """Return the 6x6 tensor about another point of the body (um), such as its centroid."""
        return shifted(self.D, np.asarray(point, dtype=np.float64) - self.center)

    @property
    def diameter_T(self) -> float:
        """Diameter (um) of the sphere whose D_T is a third of the trace of this D_T."""
        volume = _thermal_volume(self.viscosity, self.temperature)
        return volume / float(np.pi * np.trace(self.D_T))

    @property
    def diameter_R(self) -> float:
        """Diameter (um) of the sphere whose D_R is a third of the trace of this D_R."""
        volume = _thermal_volume(self.viscosity, self.temperature)
        return float(np.cbrt(3 * volume / (np.pi * np.trace(self.D_R))))

    @property
    def sphere_diameter(self) -> float:
        """Mean diameter of the spheres, um."""
        return 2 * float(self.radius.mean())

    @property
    def diameter_factor_T(self) -> float:
        """Ratio of `diameter_T` to the mean sphere diameter."""
        return self.diameter_T / self.sphere_diameter

    @property
    def diameter_factor_R(self) -> float:
        """Ratio of `diameter_R` to the mean sphere diameter."""
        return self.diameter_R / self.sphere_diameter

    @cached_property
    def volume(self) -> float:
        """Volume of the body, um^3; volume shared by several spheres is counted once."""
        volumes = 4 / 3 * np.pi * self.radius**3
        i, j = np.triu_indices(len(volumes), 1)
        sum_of_radii = self.radius[i] + self.radius[j]
        # Spheres that touch may overlap by rounding.
        if not (pair_distances(self.centers) < sum_of_radii - 1e-9 * sum_of_radii).any():
            return float(volumes.sum())
        # Divergence theorem: a third of the flux of the position vector through the surface.
        total = 0.0
        for k, points in exposed_surface(self.centers, self.radius, count=_VOLUME_POINTS):
            outward = (points - self.centers[k]) / self.radius[k]
            flux = np.sum((points - self.centroid) * outward)
            total += float(flux) * volumes[k] / self.radius[k] / _VOLUME_POINTS
        return total

    def to_dict(self) -> dict[str, Any]:
        """Return the prediction for JSON: plain numbers, lists, units in the names."""
        arrays = {
            "D": self.D,
            "D_T_um2_per_s": self.D_T,
            "D_R_rad2_per_s": self.D_R,
            "coupling_um_rad_per_s": self.coupling,
            "D_T_principal": self.principal_D_T.values,
            "D_T_axes": self.principal_D_T.axes.T,
            "D_R_principal": self.principal_D_R.values,
            "D_R_axes": self.principal_D_R.axes.T,
            "D_at_centroid": self.at(self.centroid),
            "center_of_diffusion_um": self.center,
            "centroid_um": self.centroid,
            "centers_um": self.centers,
            "radius_um": self.radius,
        }
        numbers = {
            "D_T_mean_um2_per_s": float(np.trace(self.D_T)) / 3,
            "D_R_mean_rad2_per_s": float(np.trace(self.D_R)) / 3,
            "diameter_T_um": self.diameter_T,
            "diameter_R_um": self.diameter_R,
            "diameter_factor_T": self.diameter_factor_T,
            "diameter_factor_R": self.diameter_factor_R,
            "viscosity_Pa_s": self.viscosity,
            "temperature_K": self.temperature,
            "degree": self.degree,
            "error": self.error,
            "residual": self.residual,
        }
        return numbers | {name: array.tolist() for name, array in arrays.items()}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the prediction that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        return cls(
            D=from_plain(entry["D"]),
            center=from_plain(entry["center_of_diffusion_um"]),
            centers=from_plain(entry["centers_um"]),
            radius=from_plain(entry["radius_um"]),
            viscosity=entry["viscosity_Pa_s"],
            temperature=entry["temperature_K"],
            degree=entry["degree"],
            error=entry["error"],
            residual=entry["residual"],
        )


def cluster_mobility(
    centers: ArrayLike | Cluster,
    *,
    radius: ArrayLike,
    viscosity: float,
    temperature: float,
    degree: int | None = None,
    accuracy: float = 1e-4,
) -> Mobility:
    """Predict how a rigid cluster of spheres diffuses: its 6x6 tensor in an unbounded fluid.

    Parameters
    ----------
    centers : array_like, shape (n, 3), or Cluster
        Sphere centres, um. Spheres may be apart, touch or overlap.
    radius : float or array_like, shape (n,)
        Sphere radius, um.
    viscosity : float
        Viscosity of the fluid, Pa s.
    temperature : float
        Temperature of the fluid, K.
    degree : int, optional
        Highest degree of the harmonics about each sphere, 1 to 40. Default: the first one whose
        error estimate is under `accuracy`.
    accuracy : float
        Required relative error in the worst direction of motion; not used with a degree.

    Returns
    -------
    Mobility

    Raises
    ------
    ValueError
        For wrong shapes or values, centres that coincide, a sphere inside another one, a
        temperature that is not in kelvin, or too many spheres for an error estimate.

    Warns
    -----
    PrecisionWarning
        If `accuracy` is not reached.
    UnitWarning
        If the viscosity is above 0.5 Pa s.

    Notes
    -----
    The flow is a sum of Lamb's solutions about every sphere, fitted by least squares to rigid
    motion at points spread evenly over the exposed surface. The forces and torques of six motions
    are the resistance; its inverse times kT is D (Einstein).

    Examples
    --------
    >>> body = cluster_mobility(
    ...     Cluster.touching(4, 2.45), radius=1.225, viscosity=2.18e-3, temperature=295
    ... )
    >>> round(body.diameter_factor_T, 3), round(body.diameter_factor_R, 3)
    (1.784, 1.818)
    """
    faults = condition_faults(viscosity=viscosity, temperature=temperature)
    if degree is None and not (np.ndim(accuracy) == 0 and 0 < accuracy < 1):
        faults.append(f"accuracy: expected a relative error between 0 and 1, got {accuracy}")
    elif degree is not None and degree not in range(1, _HIGHEST_DEGREE + 1):
        faults.append(f"degree: expected 1 to {_HIGHEST_DEGREE}, got {degree!r}")
    x, a = _valid_spheres(centers, radius, faults)
    for remark in viscosity_remarks(viscosity):
        warnings.warn(remark, UnitWarning, stacklevel=2)
    # With the mean radius as the unit of length no power of a length can overflow.
    unit = float(a.mean())
    scaled, relative = (x - x.mean(0)) / unit, a / unit
    if degree is None:
        solution = converge_resistance(scaled, relative, accuracy=accuracy)
    else:
        solution = solve_resistance(scaled, relative, degree=int(degree))
    thermal = _thermal_volume(viscosity, temperature)
    lengths = np.repeat([unit**-0.5, unit**-1.5], 3)
    D = thermal * np.linalg.inv(solution.matrix) * lengths[:, None] * lengths
    arm = diffusion_center(D)
    return Mobility(
        D=shifted(D, arm),
        center=x.mean(0) + arm,
        centers=x,
        radius=a,
        viscosity=float(viscosity),
        temperature=float(temperature),
        degree=solution.degree,
        error=solution.error,
        residual=solution.residual,
    )


def apparent_translation(mobility: Mobility, *, point: ArrayLike) -> float:
    """Return the apparent D_T of a tracked point of the body at short lag times.

    Parameters
    ----------
    mobility : Mobility
    point : array_like, shape (3,)
        The point, um, in the axes of ``mobility.centers``; the centroid, or one sphere.

    Returns
    -------
    float
        D_T + (tr(D_R) r^2 - r D_R r)/3, um^2/s, at the distance r from the centre of diffusion.

    Raises
    ------
    ValueError
        If the point is not three finite numbers.

    Notes
    -----
    The excess comes from rotation and lasts for about 1/(2 D_R): for an isotropic D_R the mean
    square displacement is 6 D_T t + 2 r^2 (1 - exp(-2 D_R t)), so a fit of late lag times is
    unbiased and a fit of early ones is not.

    Examples
    --------
    >>> body = cluster_mobility(
    ...     Cluster.touching(4, 2.45), radius=1.225, viscosity=2.18e-3, temperature=295
    ... )
    >>> one = apparent_translation(body, point=body.centers[0])
    >>> print(round(3 * one / np.trace(body.D_T), 2))
    1.22
    """
    location = np.asarray(point, dtype=np.float64)
    if location.shape != (3,) or not np.isfinite(location).all():
        raise ValueError(f"point: expected three finite coordinates (um), got {point!r}")
    return float(np.trace(mobility.at(location)[:3, :3])) / 3


def condition_faults(**values: object) -> list[str]:
    """Return one line for each value that is not a positive number, or not in kelvin.

    Parameters
    ----------
    **values
        Physical conditions by their names; ``temperature`` must be in kelvin.

    Returns
    -------
    list of str
        Empty if there is no fault.

    Examples
    --------
    >>> condition_faults(viscosity=1e-3, temperature=300.0)
    []
    >>> condition_faults(temperature=22)
    ['temperature: expected kelvin, 200 to 500, got 22; if it is in degrees Celsius, use 295.15']
    """
    numbers: dict[str, Any] = {
        name: value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
        for name, value in values.items()
    }
    faults = [fault for name, n in numbers.items() for fault in number_fault(name, n, above=0)]
    kelvin = numbers.get("temperature", _COLDEST)
    if not number_fault("", kelvin, above=0) and not _COLDEST <= kelvin <= _HOTTEST:
        hint = f"; if it is in degrees Celsius, use {kelvin + 273.15:g}"
        faults.append(
            f"temperature: expected kelvin, {_COLDEST:g} to {_HOTTEST:g}, got {kelvin!r}"
            + (hint if kelvin < _COLDEST else "")
        )
    return faults


def _thermal_volume(viscosity: float, temperature: float) -> float:
    """Return kT/eta, um^3/s."""
    # A number of numpy in single precision would be computed with in single precision.
    return BOLTZMANN * float(temperature) / float(viscosity) * 1e18


def _valid_spheres(
    centers: ArrayLike | Cluster, radius: ArrayLike, faults: list[str]
) -> tuple[Floats, Floats]:
    """Return centres (n, 3) and radii (n,) of a body, or raise all faults in one error."""
    given = centers.positions if isinstance(centers, Cluster) else centers
    x, a = np.array(given, dtype=np.float64), np.array(radius, dtype=np.float64)
    wrong = []
    if x.ndim != 2 or x.shape[1] != 3 or len(x) < 1 or not np.isfinite(x).all():
        wrong.append(
            "centers: expected finite coordinates of shape (n, 3), one row a sphere (z = 0 in a "
            f"plane), got shape {x.shape}{'' if np.isfinite(x).all() else ' with NaN or inf'}"
        )
    if a.shape not in ((), x.shape[:1]) or not (np.isfinite(a) & (a > 0)).all():
        wrong.append(f"radius: expected one number > 0 or one for each centre (um), got {radius!r}")
    refuse(wrong + faults if wrong else [])
    a = np.broadcast_to(a, len(x)).copy()
    first, second = np.triu_indices(len(x), 1)
    sum_of_radii, distance = a[first] + a[second], pair_distances(x)
    inside = distance < np.abs(a[first] - a[second]) + 1e-9 * sum_of_radii
    for i, j in zip(first[inside].tolist(), second[inside].tolist(), strict=True):
        if np.array_equal(x[i], x[j]):
            wrong.append(f"centers: spheres {i} and {j} are both at {x[i].tolist()}; remove one")
            continue
        small, large = (i, j) if a[i] <= a[j] else (j, i)
        wrong.append(
            f"centers: sphere {small} (radius {a[small]:g}) lies inside sphere {large} (radius "
            f"{a[large]:g}, {np.linalg.norm(x[i] - x[j]):.3g} um away); remove it or correct the "
            "radii"
        )
    refuse(wrong + faults)
    return x, a
