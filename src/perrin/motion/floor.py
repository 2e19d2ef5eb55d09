"""Noise floor of the MSAD: the apparent rotation of a motionless cluster, from its shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Floats, as_sigma, from_plain, frozen, to_plain
from perrin._display import Shown
from perrin.errors import DegenerateClusterError
from perrin.geometry.rigid import inertia_tensor, orientation_covariance
from perrin.geometry.shapes import Cluster


@dataclass(frozen=True, eq=False, repr=False)
class NoiseFloor(Shown):
    """Mean square angle by which a motionless cluster appears to turn, from localisation error.

    Attributes
    ----------
    phi2 : float
        Noise floor Phi^2 of the MSAD, rad^2, averaged over all directions (Hunter 2011,
        Eqs. 21-23; exact for any shape).
    covariance : ndarray, shape (3, 3) or (1, 1)
        Covariance of one fitted orientation as a rotation vector in body axes, rad^2.
    """

    phi2: float
    covariance: Floats

    def __post_init__(self) -> None:
        frozen(self.covariance)

    def along(self, direction: ArrayLike) -> float:
        """Return Phi^2 (rad^2) of the MSAD of one body-fixed direction, 2 (tr C - p.C.p).

        Parameters
        ----------
        direction : array_like, shape (d,)
            Direction in body axes, of any length but zero. In the plane every direction has the
            same floor.
        """
        if self.covariance.shape == (1, 1):
            return self.phi2
        p = np.asarray(direction, dtype=np.float64)
        if p.shape != (3,) or not 0 < np.linalg.norm(p) < np.inf:
            raise ValueError(f"direction: expected 3 numbers, not all zero, got {direction!r}")
        p = p / np.linalg.norm(p)
        return float(2 * (np.trace(self.covariance) - p @ self.covariance @ p))

    def to_dict(self) -> dict[str, Any]:
        """Return the floor for JSON.

        Examples
        --------
        >>> NoiseFloor(0.25, np.array([[0.125]])).to_dict()
        {'phi2': 0.25, 'covariance': [[0.125]]}
        """
        return {"phi2": to_plain(self.phi2), "covariance": to_plain(self.covariance)}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> NoiseFloor:
        """Return the floor that `to_dict` wrote.

        Parameters
        ----------
        entry : dict

        Examples
        --------
        >>> NoiseFloor.from_dict({"phi2": 0.25, "covariance": [[0.125]]}).phi2
        0.25
        """
        return cls(float(from_plain(entry["phi2"])), from_plain(entry["covariance"]))


def noise_floor(cluster: Cluster | ArrayLike, *, sigma: ArrayLike) -> NoiseFloor:
    """Predict the noise floor Phi^2 of the MSAD from a cluster's shape and localisation error.

    Parameters
    ----------
    cluster : Cluster or array_like, shape (n, d)
        The body; positions in um.
    sigma : float or array_like, shape (d,)
        Localisation error (standard deviation) of one coordinate, um; one number or one per
        axis of the body frame.

    Returns
    -------
    NoiseFloor

    Raises
    ------
    DegenerateClusterError
        If the particles are collinear or fewer than 3 (2 in the plane).

    Notes
    -----
    First order in sigma/R, any shape: cov = M^-1 (sum [r]x S [r]x^T) M^-1 with
    M = sum (r^2 - r r^T). For a tetrahedron this is 6 sigma^2/(n R^2) (Hunter 2011, Eq. 23); for
    bodies that are not spherical tops that formula is only approximate.

    Examples
    --------
    >>> floor = noise_floor(Cluster.tetrahedron(1.5), sigma=0.03)
    >>> round(floor.phi2 / (6 * 0.03**2 / (4 * 1.5**2)), 12)
    1.0
    >>> round(noise_floor(Cluster.trimer(1.0), sigma=0.01).phi2 / 0.01**2, 9)  # 20/9
    2.222222222
    """
    body = cluster if isinstance(cluster, Cluster) else Cluster.from_positions(cluster)
    n, d = body.positions.shape
    noise = np.diag(as_sigma(sigma, d) ** 2)
    extent = np.linalg.svd(body.positions, compute_uv=False)
    needed = 1 if d == 2 else 2  # number of extents that must differ from 0
    if n <= needed or extent[needed - 1] <= 1e-9 * extent[0] or extent[0] == 0:
        raise DegenerateClusterError(
            f"the cluster's {n} particles do not fix an orientation: {d} dimensions need at "
            f"least {d} particles" + (" apart" if d == 2 else ", not on one line"),
            (n,),
        )
    covariance = orientation_covariance(body.positions, noise)
    return NoiseFloor(float(floor_of(covariance)), covariance)


def floor_of(covariance: Floats) -> Floats:
    """Return Phi^2 (rad^2) averaged over directions, (4/3) tr C, or 2 C in the plane.

    Parameters
    ----------
    covariance : ndarray, shape (..., 3, 3) or (..., 1, 1)
        Covariance of an orientation, rad^2.

    Returns
    -------
    ndarray, shape (...)

    Examples
    --------
    >>> floor_of(np.diag([0.25, 0.25, 0.25]))
    np.float64(1.0)
    """
    factor = 2.0 if covariance.shape[-1] == 1 else 4.0 / 3.0
    floor: Floats = factor * np.trace(covariance, axis1=-2, axis2=-1)
    return floor


def floor_range(template: Floats, rotation: Floats, *, ratio: float) -> tuple[float, float]:
    """Return by which factors an unknown sigma_z/sigma_xy may change the predicted floor.

    Parameters
    ----------
    template : ndarray, shape (n, 3)
        Particles of the body, um, their centre at the origin.
    rotation : ndarray, shape (T, 3, 3)
        Orientations, lab from body, without NaN.
    ratio : float
        Bound of sigma_z over sigma_xy, which is between 1/ratio and ratio.

    Returns
    -------
    tuple of float
        Least and greatest Phi^2 over the one of equal errors, for the same mean square residual.

    Notes
    -----
    Orientation covariance C and expected square residual, (n - 1) tr S - tr M C, are both linear in
    the noise S in body axes, so their ratio is monotonic in (sigma_z/sigma_xy)^2.

    Examples
    --------
    >>> body, still = Cluster.tetrahedron(1.5).positions, np.eye(3)[None]
    >>> [round(factor, 9) for factor in floor_range(body, still, ratio=3.0)]
    [1.0, 1.0]
    """
    axis = rotation[:, 2]
    along_z = axis.T @ axis / len(axis)
    squares = np.array([1.0, ratio**-2, ratio**2])
    noise = np.eye(3) + (squares - 1)[:, None, None] * along_z
    covariance = orientation_covariance(template, noise)
    left = (len(template) - 1) * np.trace(noise, axis1=1, axis2=2)
    left = left - np.einsum("ij,sij->s", inertia_tensor(template), covariance)
    floor = np.trace(covariance, axis1=1, axis2=2) / left
    ends = (floor[1:] / floor[0]).tolist()
    return min(1.0, *ends), max(1.0, *ends)
