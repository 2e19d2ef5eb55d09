"""What a cluster looks like: the paper's bodies, touching spheres, measured shapes, symmetry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Floats, frozen, require_positive


@dataclass(frozen=True, eq=False)
class Cluster:
    """A rigid arrangement of particle centres, its own centre at the origin.

    Attributes
    ----------
    positions : ndarray, shape (n, d)
        Centres, um, with their mean at the origin.
    symmetry : str or None
        Schoenflies symbol of the point group, None where nobody has determined it.
    diameter : float or None
        Sphere diameter, um, where it is known (touching spheres).

    Examples
    --------
    >>> Cluster.tetrahedron(1.5)
    Cluster(n=4, d=3, R=1.5 um, T_d)
    """

    positions: Floats
    symmetry: str | None = None
    diameter: float | None = None

    def __post_init__(self) -> None:
        x = np.array(self.positions, dtype=np.float64)
        if x.ndim != 2 or x.shape[0] < 1 or x.shape[1] not in (2, 3) or not np.isfinite(x).all():
            raise ValueError(
                "positions: expected finite numbers of shape (n, d), d = 2 or 3 (one row a "
                f"particle), got shape {x.shape}"
            )
        x -= x.mean(0)
        frozen(x)
        object.__setattr__(self, "positions", x)

    def __repr__(self) -> str:
        n, d = self.positions.shape
        known = f", {self.symmetry}" if self.symmetry else ""
        return f"Cluster(n={n}, d={d}, R={self.R:.4g} um{known})"

    @property
    def R(self) -> float:
        """Mean distance of the particles to the centre, um: the R of Hunter 2011, Eq. 23."""
        return float(np.linalg.norm(self.positions, axis=1).mean())

    @classmethod
    def tetrahedron(cls, R: float) -> Cluster:
        """Four particles at distance `R` (um) from the centre (Hunter 2011, Eq. 14).

        Examples
        --------
        >>> Cluster.tetrahedron(3**0.5).positions
        array([[ 1.,  1.,  1.],
               [ 1., -1., -1.],
               [-1.,  1., -1.],
               [-1., -1.,  1.]])
        """
        require_positive(R=R)
        corners = [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]
        return cls(np.array(corners, dtype=np.float64) * (R / np.sqrt(3)), "T_d")

    @classmethod
    def pentahedron(cls, R: float) -> Cluster:
        """Five particles, all at distance `R` (um) from the centre (Hunter 2011, Eq. 15).

        Real clusters of five touching spheres are `touching(5, diameter)`, a longer body.

        Examples
        --------
        >>> Cluster.pentahedron(2.0)
        Cluster(n=5, d=3, R=2 um, D_3h)
        """
        require_positive(R=R)
        return cls(_bipyramid(3, R, R), "D_3h")

    @classmethod
    def trimer(cls, R: float) -> Cluster:
        """Three particles in an equilateral triangle, at distance `R` (um) from the centre.

        Examples
        --------
        >>> Cluster.trimer(1.0).positions.shape
        (3, 3)
        """
        require_positive(R=R)
        return cls(_ring(3, R), "D_3h")

    @classmethod
    def touching(cls, n: int, diameter: float) -> Cluster:
        """Return `n` = 2..7 equal touching spheres in their usual compact arrangement.

        Dumbbell, triangle, tetrahedron, trigonal bipyramid, octahedron, pentagonal bipyramid.

        Parameters
        ----------
        n : int
            Number of spheres, 2 to 7.
        diameter : float
            Sphere diameter, um.

        Raises
        ------
        ValueError
            If `n` is not 2..7 or the diameter is not positive.

        Examples
        --------
        >>> round(Cluster.touching(4, 2.45).R, 4)
        1.5003
        """
        require_positive(diameter=diameter)
        if n not in range(2, 8):
            raise ValueError(f"n: expected 2 to 7 touching spheres, got {n!r}; use from_positions")
        unit, symmetry = _touching_unit(n)
        return cls(unit * diameter, symmetry, float(diameter))

    @classmethod
    def from_positions(cls, positions: ArrayLike) -> Cluster:
        """Take any measured or planned arrangement; the centre is moved to the origin.

        Parameters
        ----------
        positions : array_like, shape (n, d)
            Centres, um.

        Examples
        --------
        >>> Cluster.from_positions([[0, 0, 0], [2, 0, 0], [1, 1.5, 0]])
        Cluster(n=3, d=3, R=1.079 um)
        """
        return cls(np.asarray(positions, dtype=np.float64))


def _ring(n: int, radius: float) -> Floats:
    """Place n particles on a circle in the plane z = 0."""
    angle = 2 * np.pi * np.arange(n) / n
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)


def _bipyramid(n: int, radius: float, height: float) -> Floats:
    """Return a ring of n and two poles at z = +-height."""
    return np.concatenate([_ring(n, radius), [[0, 0, height], [0, 0, -height]]])


def _touching_unit(n: int) -> tuple[Floats, str]:
    """Return n touching spheres of diameter 1 and their point group.

    In the bipyramids ring and pole spheres touch, so height^2 + radius^2 = 1.
    """
    if n == 2:
        return np.array([[0.0, 0.0, 0.5], [0.0, 0.0, -0.5]]), "D_inf_h"
    if n == 3:
        return _ring(3, 1 / np.sqrt(3)), "D_3h"
    if n == 4:
        return Cluster.tetrahedron(np.sqrt(3 / 8)).positions, "T_d"
    radius = 0.5 / np.sin(np.pi / (n - 2))
    symmetry = {5: "D_3h", 6: "O_h", 7: "D_5h"}[n]
    return _bipyramid(n - 2, radius, np.sqrt(1 - radius**2)), symmetry


def pair_distances(points: Floats) -> Floats:
    """Return the distances of all pairs of points.

    Parameters
    ----------
    points : array of shape (..., n, d)

    Returns
    -------
    array of shape (..., n (n - 1) / 2)
        In the order (0, 1), (0, 2), ..., (1, 2), ...; NaN where a point is missing.

    Examples
    --------
    >>> pair_distances(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]]))
    array([3., 4., 5.])
    """
    first, second = np.triu_indices(points.shape[-2], 1)
    distances: Floats = np.linalg.norm(points[..., first, :] - points[..., second, :], axis=-1)
    return distances


def is_tetrahedron(positions: Floats, *, tolerance: float = 0.1) -> bool:
    """Return whether four particles in space have six pair distances alike, within `tolerance`."""
    if positions.shape != (4, 3):
        return False
    first, second = np.triu_indices(4, 1)
    distance = np.linalg.norm(positions[first] - positions[second], axis=1)
    return bool(distance.max() - distance.min() < tolerance * distance.mean())
