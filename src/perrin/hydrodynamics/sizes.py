"""From diffusion coefficients to sizes: Stokes-Einstein-Sutherland and Stokes-Einstein-Debye."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np

from perrin._arrays import to_plain
from perrin.errors import UnitWarning
from perrin.geometry.shapes import Cluster, is_tetrahedron
from perrin.hydrodynamics.mobility import BOLTZMANN, Mobility, cluster_mobility, condition_faults
from perrin.hydrodynamics.units import viscosity_remarks

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin._arrays import Floats


@runtime_checkable
class HasStandardError(Protocol):
    """A measured number with its standard error, as a `DiffusionEstimate` has them."""

    @property
    def value(self) -> float:
        """The measured value."""

    @property
    def stderr(self) -> float:
        """Its standard error."""


Measured: TypeAlias = HasStandardError | float | tuple[float, float]


Viscosity: TypeAlias = float | tuple[float, float] | Callable[[float], float]


Factor: TypeAlias = Literal["exact", "hoffmann2009"]


# d_tetra / d_sphere of Hunter 2011, Eq. 25. One number for both modes is the paper's: resolved
# hydrodynamics of touching spheres gives 1.784 for translation and 1.818 for rotation.
_HOFFMANN = 1.844


# Pairs up to this much farther apart than the closest one count as touching. Spheres of one kind
# vary by a few per cent; the next neighbours in compact clusters are 1.41 diameters away, those of
# the paper's pentahedron 1.22.
_TOUCHING = 1.2


# Half the interval (K) over which the slope of a viscosity is taken.
_SLOPE = 0.01


@dataclass(frozen=True)
class Size:
    """Hydrodynamic diameters that follow from diffusion coefficients.

    Attributes
    ----------
    cluster, cluster_stderr : float
        Diameter of the sphere that diffuses as fast as the cluster, um; by translation where both
        coefficients went in.
    sphere, sphere_stderr : float
        Diameter of one of its particles, um; the mean one where they differ.
    factor : str
        Where cluster/sphere comes from.
    viscosity, viscosity_stderr : float or None
        Pa s, where it was found along with the size.
    shared_stderr : float
        The part of `sphere_stderr` that comes from temperature and viscosity, um. It moves the
        sizes from D_T and D_R the same way: their covariance is the product of their shared parts.
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
        """Return by how much this sphere diameter exceeds another's, and the standard error.

        For two sizes under the same conditions: what temperature and viscosity do to both is
        counted once. Errors of the coefficients are taken as independent.

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
        """Return the size for JSON; what is not finite is None.

        Examples
        --------
        >>> Size(4.4, 0.1, 2.45, 0.06, "exact").to_dict()["sphere"]
        2.45
        """
        return {name: to_plain(value) for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> Size:
        """Read back what `to_dict` wrote; a diameter or an error that is None becomes NaN."""
        optional = ("factor", "viscosity", "viscosity_stderr")
        read: dict[str, Any] = {
            k: np.nan if v is None and k not in optional else v for k, v in entry.items()
        }
        return cls(**read)


class _Known(NamedTuple):
    """A coefficient and the conditions it was measured under, with their relative errors."""

    value: float
    viscosity: float
    temperature: float
    by_value: float
    by_conditions: float


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
        The shape. Equal spheres of ``cluster.diameter``; without one they touch: their diameter is
        the mean distance of neighbours. A `Mobility` says it for any spheres. The whole body is
        scaled to the D measured.
    viscosity : float, (value, stderr) or callable
        Pa s; a function of the temperature in K, such as `water_viscosity`, takes the error of the
        temperature into account.
    temperature : float or (value, stderr)
        K.
    factor : {"exact", "hoffmann2009"}
        Cluster over sphere diameter: from `cluster_mobility`, or the paper's 1.844, for tetrahedra
        only and to compare with the paper.

    Returns
    -------
    Size

    Raises
    ------
    ValueError
        If a number is not positive, the temperature is not in kelvin, the shape cannot be used, or
        the paper's factor is asked for another body than a tetrahedron.

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
    known = _known(D, viscosity, temperature, factor)
    thermal = BOLTZMANN * known.temperature
    diameter = thermal / (3 * np.pi * known.viscosity * known.value * 1e-12) * 1e6
    ratio = _HOFFMANN if _is_papers(factor, cluster) else _body(cluster).diameter_factor_T
    return _size(diameter, known, ratio=ratio, order=1, factor=factor)


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
        directions is not). A third of every relative error carries.
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
    known = _known(D, viscosity, temperature, factor)
    thermal = BOLTZMANN * known.temperature
    diameter = float(np.cbrt(thermal / (np.pi * known.viscosity * known.value))) * 1e6
    ratio = _HOFFMANN if _is_papers(factor, cluster) else _body(cluster).diameter_factor_R
    return _size(diameter, known, ratio=ratio, order=3, factor=factor)


def size_and_viscosity(
    D_T: Measured,
    D_R: Measured,
    *,
    cluster: Cluster | Mobility | ArrayLike,
    temperature: float | tuple[float, float],
) -> Size:
    """Return the size that D_T and D_R imply together, and the viscosity, without knowing either.

    Parameters
    ----------
    D_T, D_R : DiffusionEstimate, float or (value, stderr)
        um^2/s and rad^2/s, their errors independent.
    cluster : Cluster, Mobility or array_like, shape (n, 3)
        As in `size_from_translation`.
    temperature : float or (value, stderr)
        K; enters the viscosity only.

    Returns
    -------
    Size
        With `viscosity`, Pa s.

    Raises
    ------
    ValueError
        As in `size_from_translation`.

    Notes
    -----
    With the diameter factors c_T and c_R of the body d = sqrt(3 c_T D_T/(c_R^3 D_R)) and
    eta = kT/(3 pi c_T d D_T). A wall, which slows translation most, makes d too small and eta too
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
    _require([], D_T=(d_t, e_t), D_R=(d_r, e_r), temperature=(kelvin, e_k))
    body = _body(cluster)
    c_t, c_r = body.diameter_factor_T, body.diameter_factor_R
    sphere = float(np.sqrt(3 * c_t * d_t / (c_r**3 * d_r)))
    viscosity = BOLTZMANN * kelvin / (3 * np.pi * c_t * sphere * d_t) * 1e18
    by_t, by_r, by_k = e_t / d_t, e_r / d_r, e_k / kelvin
    spread = 0.5 * float(np.hypot(by_t, by_r))
    thickness = float(np.sqrt((1.5 * by_t) ** 2 + (0.5 * by_r) ** 2 + by_k**2))
    return Size(
        cluster=c_t * sphere,
        cluster_stderr=c_t * sphere * spread,
        sphere=sphere,
        sphere_stderr=sphere * spread,
        factor="exact",
        viscosity=viscosity,
        viscosity_stderr=viscosity * thickness,
    )


def _size(diameter: float, known: _Known, *, ratio: float, order: int, factor: str) -> Size:
    """Return the sizes for d^order = kT/(eta D) up to a factor, errors carried along."""
    relative = float(np.hypot(known.by_value, known.by_conditions)) / order
    sphere = diameter / ratio
    return Size(
        cluster=diameter,
        cluster_stderr=diameter * relative,
        sphere=sphere,
        sphere_stderr=sphere * relative,
        factor=factor,
        shared_stderr=sphere * (known.by_conditions / order),
    )


def _known(
    D: Measured, viscosity: Viscosity, temperature: float | tuple[float, float], factor: str
) -> _Known:
    """Return the numbers that go into a size, all of them fit for it."""
    (value, error), (kelvin, kelvin_error) = _pair(D), _pair(temperature)
    eta, eta_error = (1.0, 0.0) if callable(viscosity) else _pair(viscosity)
    wrong = [] if factor in ("exact", "hoffmann2009") else [f"factor: {factor!r} is unknown"]
    _require(
        wrong, D=(value, error), viscosity=(eta, eta_error), temperature=(kelvin, kelvin_error)
    )
    by_conditions = float(np.hypot(kelvin_error / kelvin, eta_error / eta))
    if callable(viscosity):
        eta = viscosity(kelvin)
        _require([], viscosity=(eta, 0.0))
        rise = viscosity(kelvin + _SLOPE) - viscosity(kelvin - _SLOPE)
        by_conditions = abs(1 / kelvin - rise / (2 * _SLOPE * eta)) * kelvin_error
    for remark in viscosity_remarks(eta):
        warnings.warn(remark, UnitWarning, stacklevel=3)
    return _Known(value, eta, kelvin, error / value, by_conditions)


def _pair(measured: Measured) -> tuple[float, float]:
    """Return a value and its standard error, 0 for a bare number."""
    if isinstance(measured, HasStandardError):
        return measured.value, measured.stderr
    if np.shape(measured) == (2,):
        value, stderr = measured  # type: ignore[misc]
        return float(value), float(stderr)
    return measured, 0.0  # type: ignore[return-value]


def _require(faults: list[str], **pairs: tuple[float, float]) -> None:
    """Raise one ValueError for all faults of values and their standard errors."""
    faults = faults + condition_faults(**{name: value for name, (value, _) in pairs.items()})
    faults += [
        f"{name}: expected a finite standard error >= 0, got {stderr!r}"
        for name, (_, stderr) in pairs.items()
        if not (np.isfinite(stderr) and stderr >= 0)
    ]
    if faults:
        raise ValueError("; ".join(faults))


def _is_papers(factor: str, cluster: Cluster | Mobility | ArrayLike) -> bool:
    """Return whether the paper's factor is asked for; refuse it for what is no tetrahedron."""
    if factor != "hoffmann2009":
        return False
    if not is_tetrahedron(_centers(cluster)):
        raise ValueError('factor="hoffmann2009" holds for tetrahedra only (Hunter 2011, Eq. 25)')
    return True


def _centers(cluster: Cluster | Mobility | ArrayLike) -> Floats:
    if isinstance(cluster, Mobility):
        return cluster.centers
    return (cluster if isinstance(cluster, Cluster) else Cluster.from_positions(cluster)).positions


def _body(cluster: Cluster | Mobility | ArrayLike) -> Mobility:
    """Return a body of the cluster's shape; neither its size nor its conditions matter here."""
    if isinstance(cluster, Mobility):
        return cluster
    known = cluster.diameter if isinstance(cluster, Cluster) else None
    positions = _centers(cluster)
    diameter = neighbour_distance(positions) if known is None else known
    return cluster_mobility(positions, radius=diameter / 2, viscosity=1e-3, temperature=300.0)


def neighbour_distance(positions: Floats) -> float:
    """Return the mean distance of spheres that touch; 1 for a single sphere."""
    first, second = np.triu_indices(len(positions), 1)
    distance = np.linalg.norm(positions[first] - positions[second], axis=1)
    if not len(distance) or distance.min() == 0:
        return 1.0  # a single sphere; coincident ones are refused where the body is made
    return float(distance[distance < _TOUCHING * distance.min()].mean())
