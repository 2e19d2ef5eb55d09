"""From diffusion coefficients to sizes: Stokes-Einstein-Sutherland and Stokes-Einstein-Debye."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from perrin._arrays import require_positive
from perrin.diffusion import DiffusionEstimate
from perrin.shapes import Cluster, is_tetrahedron

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

BOLTZMANN = 1.380649e-23  # J/K, exact in the SI

# d_tetra / d_sphere of Hunter 2011, Eq. 25. One number for both modes is the paper's: resolved
# hydrodynamics of touching spheres gives 1.784 for translation and 1.818 for rotation.
_HOFFMANN = 1.844


@dataclass(frozen=True)
class Size:
    """Hydrodynamic diameters that follow from a diffusion coefficient.

    Attributes
    ----------
    cluster, cluster_stderr : float
        Diameter of the sphere that diffuses as fast as the cluster, um.
    sphere, sphere_stderr : float
        Diameter of one of its particles, um.
    factor : str
        Where cluster/sphere comes from.
    """

    cluster: float
    cluster_stderr: float
    sphere: float
    sphere_stderr: float
    factor: str


def size_from_translation(
    D: DiffusionEstimate | float,
    *,
    cluster: Cluster | ArrayLike,
    viscosity: float,
    temperature: float,
    factor: Literal["hoffmann2009"],
) -> Size:
    """Return the sizes that a D_T implies, d = kT/(3 pi eta D_T) (Hunter 2011, Eqs. 25 and 26).

    Parameters
    ----------
    D : DiffusionEstimate or float
        D_T, um^2/s; the error of an estimate carries, a number has none.
    cluster : Cluster or array_like, shape (4, 3)
        A tetrahedron; the paper's factor is for no other body.
    viscosity : float
        Pa s.
    temperature : float
        K.
    factor : {"hoffmann2009"}
        The paper's d_tetra = 1.844 d_sphere.

    Returns
    -------
    Size

    Raises
    ------
    ValueError
        If the cluster is no tetrahedron or a number is not positive.

    Examples
    --------
    >>> size = size_from_translation(  # the paper's Table 1
    ...     3.85e-2, cluster=Cluster.tetrahedron(1.5), viscosity=2.18e-3, temperature=295,
    ...     factor="hoffmann2009",
    ... )
    >>> round(size.cluster, 2), round(size.sphere, 2)
    (5.15, 2.79)
    """
    value, relative = _checked(D, cluster, viscosity, temperature, factor)
    diameter = BOLTZMANN * temperature / (3 * np.pi * viscosity * value * 1e-12) * 1e6
    return _size(diameter, relative)


def size_from_rotation(
    D: DiffusionEstimate | float,
    *,
    cluster: Cluster | ArrayLike,
    viscosity: float,
    temperature: float,
    factor: Literal["hoffmann2009"],
) -> Size:
    """Return the sizes that a D_R implies, d^3 = kT/(pi eta D_R) (Hunter 2011, Eqs. 25 and 27).

    Parameters
    ----------
    D : DiffusionEstimate or float
        D_R, rad^2/s; the error of an estimate carries, a third of its relative error.
    cluster, viscosity, temperature, factor
        As in `size_from_translation`.

    Returns
    -------
    Size

    Raises
    ------
    ValueError
        If the cluster is no tetrahedron or a number is not positive.

    Examples
    --------
    >>> size = size_from_rotation(
    ...     4.93e-3, cluster=Cluster.tetrahedron(1.5), viscosity=2.18e-3, temperature=295,
    ...     factor="hoffmann2009",
    ... )
    >>> round(size.cluster, 2), round(size.sphere, 2)
    (4.94, 2.68)
    """
    value, relative = _checked(D, cluster, viscosity, temperature, factor)
    diameter = float(np.cbrt(BOLTZMANN * temperature / (np.pi * viscosity * value))) * 1e6
    return _size(diameter, relative / 3)


def _checked(
    D: DiffusionEstimate | float,
    cluster: Cluster | ArrayLike,
    viscosity: float,
    temperature: float,
    factor: str,
) -> tuple[float, float]:
    """Return the value and the relative error of D, all inputs being fit for a size."""
    value = float(D)
    require_positive(D=value, viscosity=viscosity, temperature=temperature)
    body = cluster if isinstance(cluster, Cluster) else Cluster.from_positions(cluster)
    if factor != "hoffmann2009":
        raise ValueError(f'factor: expected "hoffmann2009", got {factor!r}')
    if not is_tetrahedron(body.positions):
        raise ValueError('factor="hoffmann2009" holds for tetrahedra only (Hunter 2011, Eq. 25)')
    return value, D.stderr / value if isinstance(D, DiffusionEstimate) else 0.0


def _size(diameter: float, relative: float) -> Size:
    sphere = diameter / _HOFFMANN
    return Size(diameter, diameter * relative, sphere, sphere * relative, "hoffmann2009")
