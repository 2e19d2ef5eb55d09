"""How a rigid body of spheres moves in a viscous fluid: cluster_mobility -> Mobility."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import Floats, frozen
from perrin.errors import UnitWarning
from perrin.geometry.rotations import skew
from perrin.geometry.shapes import Cluster
from perrin.hydrodynamics.resistance import converge_resistance, exposed_surface, solve_resistance
from perrin.hydrodynamics.units import viscosity_remarks

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin.hydrodynamics.resistance import Resistance


BOLTZMANN = 1.380649e-23  # J/K, exact in the SI


# Liquids that anyone looks at through a microscope; degrees Celsius fall outside.
_COLDEST, _HOTTEST = 200.0, 500.0


_HIGHEST_DEGREE = 40


# Surface points a sphere of an overlapping body has for its volume: 1e-4 and better.
_VOLUME_POINTS = 20_000


class Principal(NamedTuple):
    """Principal values, rising, and unit axes of a tensor, one axis a column."""

    values: Floats
    axes: Floats


@dataclass(frozen=True, eq=False)
class Mobility:
    """The diffusion tensor of a rigid body of spheres, and what follows from it.

    Attributes
    ----------
    D : ndarray, shape (6, 6)
        About the centre of diffusion, in the axes of `centers`: translation (um^2/s) first,
        rotation (rad^2/s) last, their coupling (um rad/s) beside.
    center : ndarray, shape (3,)
        The centre of diffusion, um: the point about which the coupling is symmetric.
    centers : ndarray, shape (n, 3)
        The spheres, um.
    radius : ndarray, shape (n,)
        Their radii, um.
    viscosity, temperature : float
        Pa s, K.
    degree : int
        Highest degree of the harmonics used.
    error : float
        Estimated relative error of D in its worst direction: the larger of three quarters of what
        the last two degrees changed and three times the violation of reciprocity.
    residual : float
        Root mean square velocity on the surface that the solution leaves over, relative.
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
        """Translation from torque, (3, 3), um rad/s; symmetric, 0 for most symmetric bodies."""
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
        return _moved(self.D, np.asarray(point, dtype=np.float64) - self.center)

    @property
    def diameter_T(self) -> float:
        """Diameter (um) of the sphere whose D_T is a third of the trace."""
        volume = _thermal_volume(self.viscosity, self.temperature)
        return volume / float(np.pi * np.trace(self.D_T))

    @property
    def diameter_R(self) -> float:
        """Diameter (um) of the sphere whose D_R is a third of the trace."""
        volume = _thermal_volume(self.viscosity, self.temperature)
        return float(np.cbrt(3 * volume / (np.pi * np.trace(self.D_R))))

    @property
    def sphere_diameter(self) -> float:
        """Mean diameter of the spheres, um."""
        return 2 * float(self.radius.mean())

    @property
    def diameter_factor_T(self) -> float:
        """`diameter_T` over the mean sphere diameter."""
        return self.diameter_T / self.sphere_diameter

    @property
    def diameter_factor_R(self) -> float:
        """`diameter_R` over the mean sphere diameter."""
        return self.diameter_R / self.sphere_diameter

    @cached_property
    def volume(self) -> float:
        """Volume of the body, um^3, what overlaps counted once."""
        balls = 4 / 3 * np.pi * self.radius**3
        if not len(_pairs(self.centers, self.radius, overlapping=True)):
            return float(balls.sum())
        # Divergence theorem: a third of the flux of the position vector through the surface.
        total = 0.0
        for i, points in exposed_surface(self.centers, self.radius, count=_VOLUME_POINTS):
            outward = (points - self.centers[i]) / self.radius[i]
            flux = np.sum((points - self.centroid) * outward)
            total += float(flux) * balls[i] / self.radius[i] / _VOLUME_POINTS
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
        Pa s.
    temperature : float
        K.
    degree : int, optional
        Highest degree of the harmonics about each sphere, 1 to 40. Default: it rises until the
        error estimate is under `accuracy`.
    accuracy : float
        Relative error aimed at in the worst direction of motion, where no degree is stated.

    Returns
    -------
    Mobility

    Raises
    ------
    ValueError
        For bad shapes or values, centres that coincide, a sphere inside another one, a temperature
        that is not in kelvin, or more spheres than can be served.

    Warns
    -----
    PrecisionWarning
        If `accuracy` is not reached.
    UnitWarning
        If the viscosity is above 0.5 Pa s.

    Notes
    -----
    The flow is a sum of Lamb's solutions about every sphere, fitted by least squares to rigid
    motion at points spread evenly over the exposed surface. Forces and torques of six motions give
    the resistance, its inverse D/kT (Einstein).

    Examples
    --------
    >>> body = cluster_mobility(
    ...     Cluster.touching(4, 2.45), radius=1.225, viscosity=2.18e-3, temperature=295
    ... )
    >>> round(body.diameter_factor_T, 3), round(body.diameter_factor_R, 3)
    (1.784, 1.818)
    """
    x, a = _body(centers, radius, viscosity=viscosity, temperature=temperature)
    for remark in viscosity_remarks(viscosity):
        warnings.warn(remark, UnitWarning, stacklevel=2)
    # Lengths in mean radii, so that no power of a unit can overflow or look small.
    unit = float(a.mean())
    scaled, relative = (x - x.mean(0)) / unit, a / unit
    solution = _solution(scaled, relative, degree=degree, accuracy=accuracy)
    thermal = _thermal_volume(viscosity, temperature)
    lengths = np.repeat([unit**-0.5, unit**-1.5], 3)
    D = thermal * np.linalg.inv(solution.matrix) * lengths[:, None] * lengths
    arm = _center_of_diffusion(D)
    return Mobility(
        D=_moved(D, arm),
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
    """Return the D_T that a tracked point of the body shows at short lag times.

    Parameters
    ----------
    mobility : Mobility
    point : array_like, shape (3,)
        The point, um, in the axes of ``mobility.centers``; the centroid, or one sphere.

    Returns
    -------
    float
        um^2/s: D_T + (tr(D_R) r^2 - r D_R r)/3 at a distance r from the centre of diffusion.

    Raises
    ------
    ValueError
        If the point is not three finite numbers.

    Notes
    -----
    The excess comes from rotation. It ends after a time of about 1/(2 D_R): for one D_R the mean
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
    at = np.asarray(point, dtype=np.float64)
    if at.shape != (3,) or not np.isfinite(at).all():
        raise ValueError(f"point: expected three finite coordinates (um), got {point!r}")
    return float(np.trace(mobility.at(at)[:3, :3])) / 3


def condition_faults(**values: float) -> list[str]:
    """Return what is wrong with numbers that must be positive; a temperature must be in kelvin."""
    faults = [
        f"{name}: expected a finite number > 0, got {value!r}"
        for name, value in values.items()
        if not (np.ndim(value) == 0 and np.isfinite(value) and value > 0)
    ]
    kelvin = values.get("temperature", _COLDEST)
    if np.ndim(kelvin) == 0 and (0 < kelvin < _COLDEST or _HOTTEST < kelvin < np.inf):
        hint = f"; if it is in degrees Celsius, say {kelvin + 273.15:g}"
        faults.append(
            f"temperature: expected kelvin, {_COLDEST:g} to {_HOTTEST:g}, got {kelvin!r}"
            + (hint if kelvin < _COLDEST else "")
        )
    return faults


def _thermal_volume(viscosity: float, temperature: float) -> float:
    """Return kT over viscosity, um^3/s."""
    return BOLTZMANN * temperature / viscosity * 1e18


def _solution(centers: Floats, radii: Floats, *, degree: int | None, accuracy: float) -> Resistance:
    """Solve with the degree that is stated, or with the one that reaches the accuracy."""
    if degree is None:
        if not (np.ndim(accuracy) == 0 and 0 < accuracy < 1):
            raise ValueError(f"accuracy: expected a relative error between 0 and 1, got {accuracy}")
        return converge_resistance(centers, radii, accuracy=accuracy)
    if degree not in range(1, _HIGHEST_DEGREE + 1):
        raise ValueError(f"degree: expected 1 to {_HIGHEST_DEGREE}, got {degree!r}")
    return solve_resistance(centers, radii, degree=int(degree))


def _moved(D: Floats, arm: Floats) -> Floats:
    """Return the tensor about a point at `arm` from the one it refers to: v' = v + w x arm."""
    shift = np.eye(6)
    shift[:3, 3:] = -skew(arm)
    return np.asarray(shift @ D @ shift.T)


def _center_of_diffusion(D: Floats) -> Floats:
    """Return where the coupling is symmetric, from the point that D refers to.

    Moving by r takes [r]x D_R off the coupling; its antisymmetric part is
    [(tr(D_R) - D_R) r / 2]x.
    """
    odd = D[:3, 3:] - D[3:, :3]
    vector = np.array([odd[2, 1], odd[0, 2], odd[1, 0]])
    rotation = D[3:, 3:]
    return np.asarray(np.linalg.solve(np.trace(rotation) * np.eye(3) - rotation, vector))


def _body(
    centers: ArrayLike | Cluster, radius: ArrayLike, **conditions: float
) -> tuple[Floats, Floats]:
    """Return centres (n, 3) and radii (n,) that can be one body, under conditions that can be."""
    given = centers.positions if isinstance(centers, Cluster) else centers
    x, a = np.array(given, dtype=np.float64), np.array(radius, dtype=np.float64)
    faults = []
    if x.ndim != 2 or x.shape[1] != 3 or len(x) < 1 or not np.isfinite(x).all():
        faults.append(
            "centers: expected finite coordinates of shape (n, 3), one row a sphere (z = 0 in a "
            f"plane), got shape {x.shape}{'' if np.isfinite(x).all() else ' with NaN or inf'}"
        )
    if a.shape not in ((), x.shape[:1]) or not (np.isfinite(a) & (a > 0)).all():
        faults.append(
            f"radius: expected one number > 0 or one for each centre (um), got {radius!r}"
        )
    if not faults:
        a = np.broadcast_to(a, len(x)).copy()
        faults += [_pair_fault(i, j, x, a) for i, j in _pairs(x, a, overlapping=False)]
    faults += condition_faults(**conditions)
    if faults:
        raise ValueError("; ".join(faults))
    return x, a


def _pairs(x: Floats, a: Floats, *, overlapping: bool) -> list[tuple[int, int]]:
    """Return the pairs of spheres that overlap, or of which one lies inside the other."""
    i, j = np.triu_indices(len(x), 1)
    distance = np.linalg.norm(x[i] - x[j], axis=1)
    limit = a[i] + a[j] if overlapping else np.abs(a[i] - a[j])
    # Spheres that touch do not overlap, though rounding may say so.
    rounding = 1e-9 * (a[i] + a[j]) * (-1 if overlapping else 1)
    found = distance < limit + rounding
    return list(zip(i[found].tolist(), j[found].tolist(), strict=True))


def _pair_fault(i: int, j: int, x: Floats, a: Floats) -> str:
    """Say what is wrong with two spheres."""
    if np.array_equal(x[i], x[j]):
        return f"centers: spheres {i} and {j} are both at {x[i].tolist()}; remove one"
    small, large = (i, j) if a[i] <= a[j] else (j, i)
    return (
        f"centers: sphere {small} (radius {a[small]:g}) lies inside sphere {large} (radius "
        f"{a[large]:g}, {np.linalg.norm(x[i] - x[j]):.3g} um away); remove it or correct the radii"
    )
