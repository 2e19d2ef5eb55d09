"""Shapes of clusters: the paper's bodies, touching spheres, measured arrangements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Floats, from_plain, frozen, require_positive
from perrin._display import Shown

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Self


@dataclass(frozen=True, eq=False)
class Cluster(Shown):
    """A rigid arrangement of particle centres, its own centre at the origin.

    Attributes
    ----------
    positions : ndarray, shape (n, d)
        Centres, um, with their mean at the origin.
    symmetry : str or None
        Schoenflies symbol of the point group; None if it is not known.
    diameter : float or None
        Sphere diameter, um; None if it is not known.

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
        """Return four particles at distance `R` (um) from the centre (Hunter 2011, Eq. 14).

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
        """Return five particles, all at distance `R` (um) from the centre (Hunter 2011, Eq. 15).

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
        """Return three particles in an equilateral triangle, at distance `R` (um) from the centre.

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

        In the order of `n` these are the dumbbell, triangle, tetrahedron, trigonal bipyramid,
        octahedron and pentagonal bipyramid.

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
        symmetry = {2: "D_inf_h", 3: "D_3h", 4: "T_d", 5: "D_3h", 6: "O_h", 7: "D_5h"}[n]
        if n == 2:
            unit = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, -0.5]])
        elif n == 3:
            unit = _ring(3, 1 / np.sqrt(3))
        elif n == 4:
            unit = cls.tetrahedron(np.sqrt(3 / 8)).positions
        else:
            # Ring and pole spheres touch, so height^2 + radius^2 = 1.
            radius = 0.5 / np.sin(np.pi / (n - 2))
            unit = _bipyramid(n - 2, radius, np.sqrt(1 - radius**2))
        return cls(unit * diameter, symmetry, float(diameter))

    @classmethod
    def from_positions(cls, positions: ArrayLike) -> Cluster:
        """Return any arrangement of particles as a cluster; its centre is moved to the origin.

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

    def to_dict(self) -> dict[str, Any]:
        """Return the cluster for JSON: plain numbers, lists, units in the names.

        Examples
        --------
        >>> Cluster.touching(2, 2.0).to_dict()["positions_um"]
        [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
        """
        return {
            "positions_um": self.positions.tolist(),
            "symmetry": self.symmetry,
            "diameter_um": self.diameter,
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the cluster that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping

        Examples
        --------
        >>> Cluster.from_dict(Cluster.tetrahedron(1.5).to_dict())
        Cluster(n=4, d=3, R=1.5 um, T_d)
        """
        cluster = cls(entry["positions_um"], entry["symmetry"], entry["diameter_um"])
        # Centring once more could change the last bit.
        object.__setattr__(cluster, "positions", from_plain(entry["positions_um"]))
        return cluster


def _ring(n: int, radius: float) -> Floats:
    """Place n particles on a circle in the plane z = 0."""
    angle = 2 * np.pi * np.arange(n) / n
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)


def _bipyramid(n: int, radius: float, height: float) -> Floats:
    """Return a ring of n and two poles at z = +-height."""
    return np.concatenate([_ring(n, radius), [[0, 0, height], [0, 0, -height]]])


def pair_distances(points: Floats) -> Floats:
    """Return the distances of all pairs of points.

    Parameters
    ----------
    points : ndarray, shape (..., n, d)

    Returns
    -------
    ndarray, shape (..., n (n - 1) / 2)
        In the order (0, 1), (0, 2), ..., (1, 2), ...; NaN where a point is missing.

    Examples
    --------
    >>> pair_distances(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]]))
    array([3., 4., 5.])
    """
    parts = [
        lengths(points[..., k + 1 :, :] - points[..., k : k + 1, :])
        for k in range(points.shape[-2])
    ]
    return np.concatenate([np.zeros((*points.shape[:-2], 0)), *parts], axis=-1)


def centroids(points: Floats) -> Floats:
    """Return the means of sets of points (..., n, d); NaN where a point is missing.

    Examples
    --------
    >>> centroids(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 6.0]]))
    array([1., 2.])
    """
    return np.asarray(np.einsum("...ni->...i", points) / points.shape[-2])


def centred(points: Floats) -> Floats:
    """Return sets of points (..., n, d) relative to their means.

    Examples
    --------
    >>> centred(np.array([[0.0, 0.0], [4.0, 2.0]]))
    array([[-2., -1.],
           [ 2.,  1.]])
    """
    return np.asarray(points - centroids(points)[..., None, :])


def lengths(vectors: Floats) -> Floats:
    """Return the lengths of vectors (..., d), without the temporary arrays of `numpy.linalg.norm`.

    Examples
    --------
    >>> lengths(np.array([[3.0, 4.0], [0.0, 2.0]]))
    array([5., 2.])
    """
    return np.sqrt(squared_lengths(vectors))


def squared_lengths(vectors: Floats) -> Floats:
    """Return the squared lengths of vectors (..., d), d so small that `sum` is slow.

    Examples
    --------
    >>> squared_lengths(np.array([[3.0, 4.0], [0.0, 2.0]]))
    array([25.,  4.])
    """
    return np.asarray(np.einsum("...i,...i->...", vectors, vectors))


def is_tetrahedron(positions: Floats, *, tolerance: float = 0.1) -> bool:
    """Return whether four particles in space have six equal pair distances, within a tolerance.

    Parameters
    ----------
    positions : ndarray, shape (n, d)
    tolerance : float
        Largest spread of the distances, relative to their mean.

    Examples
    --------
    >>> is_tetrahedron(Cluster.touching(4, 2.45).positions)
    True
    """
    if positions.shape != (4, 3):
        return False
    distance = pair_distances(positions)
    return bool(distance.max() - distance.min() < tolerance * distance.mean())
