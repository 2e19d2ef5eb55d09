"""From diffusion coefficients to sizes: Stokes-Einstein-Sutherland and Stokes-Einstein-Debye."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, get_args, runtime_checkable

import numpy as np

from perrin._arrays import choice_fault, refuse
from perrin._display import Shown
from perrin.errors import UnitWarning
from perrin.geometry.shapes import Cluster, is_tetrahedron, pair_distances
from perrin.hydrodynamics.mobility import BOLTZMANN, Mobility, cluster_mobility, condition_faults
from perrin.hydrodynamics.units import viscosity_remarks

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from perrin._arrays import Floats

# Units of the numbers of a `Size`, as they end its keys in JSON.
_SIZE_UNITS = {
    **dict.fromkeys(("cluster", "cluster_stderr", "sphere", "sphere_stderr"), "_um"),
    **dict.fromkeys(("viscosity", "viscosity_stderr"), "_Pa_s"),
    "shared_stderr": "_um",
}


@runtime_checkable
class HasStandardError(Protocol):
    """A measured number with its standard error, such as a `DiffusionEstimate`."""

    @property
    def value(self) -> float:
        """Measured value."""

    @property
    def stderr(self) -> float:
        """Standard error of the value."""


Measured: TypeAlias = HasStandardError | float | tuple[float, float]

Viscosity: TypeAlias = float | tuple[float, float] | Callable[[float], float]

Factor: TypeAlias = Literal["exact", "hoffmann2009"]

# d_tetra / d_sphere of Hunter 2011, Eq. 25, for both modes. Resolved hydrodynamics of touching
# spheres gives 1.784 for translation and 1.818 for rotation.
_HOFFMANN = 1.844

# Largest distance of touching spheres over the smallest pair distance. Diameters vary by a few per
# cent; the next neighbours in compact clusters are 1.41 diameters away, those of the paper's
# pentahedron 1.22.
_NEIGHBOUR_RATIO = 1.2

# Half the interval (K) of the central difference of a viscosity.
_HALF_INTERVAL = 0.01


@dataclass(frozen=True, repr=False)
class Size(Shown):
    """Hydrodynamic diameters that follow from diffusion coefficients.

    Attributes
    ----------
    cluster : float
        Diameter of the sphere that diffuses as fast as the cluster, um; by translation if both
        coefficients were used.
    cluster_stderr : float
        Standard error of `cluster`, um.
    sphere : float
        Diameter of one particle of the cluster, um; the mean diameter if they differ.
    sphere_stderr : float
        Standard error of `sphere`, um.
    factor : str
        Source of the ratio cluster/sphere: "exact" or "hoffmann2009".
    viscosity : float or None
        Viscosity, Pa s, if it was determined together with the size.
    viscosity_stderr : float or None
        Standard error of `viscosity`, Pa s.
    shared_stderr : float
        Part of `sphere_stderr` from temperature and viscosity, um. Sizes from D_T and D_R share it:
        their covariance is the product of their shared parts.
    """

    cluster: float
    cluster_stderr: float
    sphere: float
    sphere_stderr: float
    factor: str
    viscosity: float | None = None
    viscosity_stderr: float | None = None
    shared_stderr: float = 0.0

    def difference(self, other: Size) -> tuple[float, float]:
        """Return the difference of two sphere diameters and its standard error.

        Both sizes must be under the same conditions: errors of temperature and viscosity are common
        to them. Errors of the coefficients are taken as independent.

        Examples
        --------
        >>> known = {"cluster": Cluster.touching(4, 2.45), "temperature": 295}
        >>> known["viscosity"] = (2.18e-3, 0.11e-3)
        >>> translation = size_from_translation((3.85e-2, 0.49e-2), **known)
        >>> rotation = size_from_rotation((4.93e-3, 0.49e-3), **known)
        >>> [round(x, 2) for x in translation.difference(rotation)]
        [0.17, 0.39]
        """
        variance = (self.shared_stderr - other.shared_stderr) ** 2
        for size in (self, other):
            variance += size.sphere_stderr**2 - size.shared_stderr**2
        return self.sphere - other.sphere, float(np.sqrt(variance))

    def to_dict(self) -> dict[str, Any]:
        """Return the size for JSON, units in the names.

        Examples
        --------
        >>> size_from_translation(
        ...     3.85e-2, cluster=Cluster.tetrahedron(1.5), viscosity=2.18e-3, temperature=295
        ... ).to_dict()["factor"]
        'exact'
        """
        entry = asdict(self)
        return {name + _SIZE_UNITS.get(name, ""): value for name, value in entry.items()}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Size:
        """Return the size that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        return cls(**{f.name: entry[f.name + _SIZE_UNITS.get(f.name, "")] for f in fields(cls)})


def size_from_translation(
    D: Measured,
    *,
    cluster: Cluster | Mobility | ArrayLike,
    viscosity: Viscosity,
    temperature: float | tuple[float, float],
    factor: Factor = "exact",
) -> Size:
    """Return the sizes that a D_T implies, d = kT/(3 pi eta D_T) (Hunter 2011, Eqs. 25 and 26).

    Parameters
    ----------
    D : DiffusionEstimate, float or (value, stderr)
        D_T, um^2/s, for an anisotropic body a third of the trace; a bare number has no error.
    cluster : Cluster, Mobility or array_like, shape (n, 3)
        Shape of the cluster: equal spheres of ``cluster.diameter``, or without one, touching
        spheres, whose diameter is the mean distance of neighbours. A `Mobility` may have any
        spheres. The whole body is scaled to the measured D.
    viscosity : float, (value, stderr) or callable
        Viscosity, Pa s. With a function of the temperature in K, such as `water_viscosity`, the
        error of the temperature is included in that of the viscosity.
    temperature : float or (value, stderr)
        Temperature, K.
    factor : {"exact", "hoffmann2009"}
        Ratio of cluster to sphere diameter: from `cluster_mobility`, or the paper's 1.844, which is
        for tetrahedra only and for a comparison with the paper.

    Returns
    -------
    Size

    Raises
    ------
    ValueError
        If a number is not positive, the temperature is not in kelvin, the shape is no rigid body,
        or the paper's factor is requested for another body than a tetrahedron.

    Warns
    -----
    UnitWarning
        If the viscosity is above 0.5 Pa s.

    Examples
    --------
    >>> known = {"cluster": Cluster.tetrahedron(1.5), "viscosity": 2.18e-3, "temperature": 295}
    >>> round(size_from_translation(3.85e-2, **known).sphere, 2)
    2.89
    >>> size = size_from_translation(3.85e-2, **known, factor="hoffmann2009")  # Table 1
    >>> round(size.cluster, 2), round(size.sphere, 2)
    (5.15, 2.79)
    """
    return _stokes_einstein(D, cluster, viscosity, temperature, factor, mode="translation")


def size_from_rotation(
    D: Measured,
    *,
    cluster: Cluster | Mobility | ArrayLike,
    viscosity: Viscosity,
    temperature: float | tuple[float, float],
    factor: Factor = "exact",
) -> Size:
    """Return the sizes that a D_R implies, d^3 = kT/(pi eta D_R) (Hunter 2011, Eqs. 25 and 27).

    Parameters
    ----------
    D : DiffusionEstimate, float or (value, stderr)
        D_R, rad^2/s, for an anisotropic body a third of the trace (which the MSAD of the particles'
        directions is not). The relative error of the size is a third of that of D_R.
    cluster, viscosity, temperature, factor
        As in `size_from_translation`.

    Returns
    -------
    Size

    Raises
    ------
    ValueError
        As in `size_from_translation`.

    Warns
    -----
    UnitWarning
        As in `size_from_translation`.

    Examples
    --------
    >>> known = {"cluster": Cluster.tetrahedron(1.5), "viscosity": 2.18e-3, "temperature": 295}
    >>> round(size_from_rotation(4.93e-3, **known).sphere, 2)
    2.72
    >>> size = size_from_rotation(4.93e-3, **known, factor="hoffmann2009")  # Table 1
    >>> round(size.cluster, 2), round(size.sphere, 2)
    (4.94, 2.68)
    """
    return _stokes_einstein(D, cluster, viscosity, temperature, factor, mode="rotation")


def size_and_viscosity(
    D_T: Measured,
    D_R: Measured,
    *,
    cluster: Cluster | Mobility | ArrayLike,
    temperature: float | tuple[float, float],
) -> Size:
    """Return the size and the viscosity that D_T and D_R imply together.

    Parameters
    ----------
    D_T, D_R : DiffusionEstimate, float or (value, stderr)
        um^2/s and rad^2/s, their errors independent.
    cluster : Cluster, Mobility or array_like, shape (n, 3)
        As in `size_from_translation`.
    temperature : float or (value, stderr)
        Temperature, K; only the viscosity depends on it.

    Returns
    -------
    Size
        Size together with the `viscosity`, Pa s.

    Raises
    ------
    ValueError
        As in `size_from_translation`.

    Notes
    -----
    With the diameter factors c_T and c_R of the body d = sqrt(3 c_T D_T/(c_R^3 D_R)) and
    eta = kT/(3 pi c_T d D_T). Near a wall, which slows translation most, d is too small and eta too
    large.

    Examples
    --------
    >>> size = size_and_viscosity(
    ...     (3.85e-2, 0.49e-2), (4.93e-3, 0.49e-3), cluster=Cluster.touching(4, 2.45),
    ...     temperature=295,
    ... )
    >>> round(size.sphere, 2), round(size.sphere_stderr, 2), round(1e3 * size.viscosity, 2)
    (2.64, 0.21, 2.39)
    """
    (d_t, e_t), (d_r, e_r), (kelvin, e_k) = _pair(D_T), _pair(D_R), _pair(temperature)
    refuse(_pair_faults(D_T=(d_t, e_t), D_R=(d_r, e_r), temperature=(kelvin, e_k)))
    body = shape_mobility(cluster)
    c_t, c_r = body.diameter_factor_T, body.diameter_factor_R
    sphere = float(np.sqrt(3 * c_t * d_t / (c_r**3 * d_r)))
    viscosity = BOLTZMANN * kelvin / (3 * np.pi * c_t * sphere * d_t) * 1e18
    by_t, by_r, by_k = e_t / d_t, e_r / d_r, e_k / kelvin
    size_error = 0.5 * float(np.hypot(by_t, by_r))
    viscosity_error = float(np.sqrt((1.5 * by_t) ** 2 + (0.5 * by_r) ** 2 + by_k**2))
    return Size(
        cluster=c_t * sphere,
        cluster_stderr=c_t * sphere * size_error,
        sphere=sphere,
        sphere_stderr=sphere * size_error,
        factor="exact",
        viscosity=viscosity,
        viscosity_stderr=viscosity * viscosity_error,
    )


def _stokes_einstein(
    D: Measured,
    cluster: Cluster | Mobility | ArrayLike,
    viscosity: Viscosity,
    temperature: float | tuple[float, float],
    factor: Factor,
    *,
    mode: Literal["translation", "rotation"],
) -> Size:
    """Return the sizes from d = kT/(3 pi eta D_T), or d^3 = kT/(pi eta D_R), and their errors."""
    (value, error), (kelvin, kelvin_error) = _pair(D), _pair(temperature)
    eta, eta_error = (1.0, 0.0) if callable(viscosity) else _pair(viscosity)
    faults = choice_fault("factor", factor, get_args(Factor))
    faults += _pair_faults(
        D=(value, error), viscosity=(eta, eta_error), temperature=(kelvin, kelvin_error)
    )
    refuse(faults)
    by_conditions = float(np.hypot(kelvin_error / kelvin, eta_error / eta))
    if callable(viscosity):
        eta = viscosity(kelvin)
        refuse(_pair_faults(viscosity=(eta, 0.0)))
        rise = viscosity(kelvin + _HALF_INTERVAL) - viscosity(kelvin - _HALF_INTERVAL)
        by_conditions = abs(1 / kelvin - rise / (2 * _HALF_INTERVAL * eta)) * kelvin_error
    for remark in viscosity_remarks(eta):
        warnings.warn(remark, UnitWarning, stacklevel=3)

    thermal = BOLTZMANN * kelvin
    if mode == "translation":
        diameter, order = thermal / (3 * np.pi * eta * value * 1e-12) * 1e6, 1
    else:
        diameter, order = float(np.cbrt(thermal / (np.pi * eta * value))) * 1e6, 3
    if factor == "exact":
        body = shape_mobility(cluster)
        ratio = body.diameter_factor_T if mode == "translation" else body.diameter_factor_R
    elif is_tetrahedron(_centers_of(cluster)):
        ratio = _HOFFMANN
    else:
        raise ValueError('factor="hoffmann2009" holds for tetrahedra only (Hunter 2011, Eq. 25)')

    relative = float(np.hypot(error / value, by_conditions)) / order
    sphere = diameter / ratio
    return Size(
        cluster=diameter,
        cluster_stderr=diameter * relative,
        sphere=sphere,
        sphere_stderr=sphere * relative,
        factor=factor,
        shared_stderr=sphere * (by_conditions / order),
    )


def _pair(measured: Measured) -> tuple[float, float]:
    """Return a value and its standard error, 0 for a bare number."""
    if isinstance(measured, HasStandardError):
        return measured.value, measured.stderr
    if np.shape(measured) == (2,):
        value, stderr = measured  # type: ignore[misc]
        return float(value), float(stderr)
    return measured, 0.0  # type: ignore[return-value]


def _pair_faults(**pairs: tuple[float, float]) -> list[str]:
    """Return the faults of values and their standard errors."""
    faults = condition_faults(**{name: value for name, (value, _) in pairs.items()})
    return faults + [
        f"{name}: expected a finite standard error >= 0, got {stderr!r}"
        for name, (_, stderr) in pairs.items()
        if not (np.isfinite(stderr) and stderr >= 0)
    ]


def _centers_of(cluster: Cluster | Mobility | ArrayLike) -> Floats:
    if isinstance(cluster, Mobility):
        return cluster.centers
    return (cluster if isinstance(cluster, Cluster) else Cluster.from_positions(cluster)).positions


def neighbour_distance(positions: Floats) -> float:
    """Return the mean distance of touching spheres; 1 for a single sphere.

    Parameters
    ----------
    positions : ndarray, shape (n, d)

    Examples
    --------
    >>> round(neighbour_distance(Cluster.touching(6, 2.45).positions), 12)
    2.45
    """
    distance = pair_distances(positions)
    if not len(distance) or distance.min() == 0:
        return 1.0  # coincident spheres are refused by `cluster_mobility`
    return float(distance[distance < _NEIGHBOUR_RATIO * distance.min()].mean())


def shape_mobility(cluster: Cluster | Mobility | ArrayLike) -> Mobility:
    """Return a mobility of the cluster, at any viscosity and temperature: they cancel in ratios.

    Parameters
    ----------
    cluster : Cluster, Mobility or array_like, shape (n, 3)
        As in `size_from_translation`.

    Returns
    -------
    Mobility
        The same object for a `Mobility`.

    Examples
    --------
    >>> round(shape_mobility(Cluster.touching(4, 2.45)).diameter_T, 2)
    4.37
    """
    if isinstance(cluster, Mobility):
        return cluster
    known = cluster.diameter if isinstance(cluster, Cluster) else None
    positions = _centers_of(cluster)
    diameter = neighbour_distance(positions) if known is None else known
    return cluster_mobility(positions, radius=diameter / 2, viscosity=1e-3, temperature=300.0)
