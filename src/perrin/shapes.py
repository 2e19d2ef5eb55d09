"""What a cluster looks like: the paper's bodies, touching spheres, measured shapes, symmetry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Bools, Floats, Ints, frozen, require_positive
from perrin.rotations import axis_angle, fit_rotations

# A symmetry element: its sign, then the number of the particle that each particle comes to.
_Element: TypeAlias = tuple[int, ...]


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


def is_tetrahedron(positions: Floats, *, tolerance: float = 0.1) -> bool:
    """Return whether four particles in space have six pair distances alike, within `tolerance`."""
    if positions.shape != (4, 3):
        return False
    first, second = np.triu_indices(4, 1)
    distance = np.linalg.norm(positions[first] - positions[second], axis=1)
    return bool(distance.max() - distance.min() < tolerance * distance.mean())


def rotation_group(positions: ArrayLike, *, tolerance: float) -> Floats:
    """Return the rotations that map a body of indistinguishable particles on itself.

    Parameters
    ----------
    positions : array_like, shape (n, d)
        Centres, um; their mean is taken as the origin.
    tolerance : float
        How far (um) a turned particle may be from the place of another one.

    Returns
    -------
    ndarray, shape (g, d, d)
        Exact rotations that form a group, the identity first. Of the turns about the line of a
        collinear body, which move nothing, only the identity is given, and of those that exchange
        its ends only one.

    Raises
    ------
    ValueError
        For a bad shape, or a tolerance that is not a number >= 0.

    Notes
    -----
    Every rotation carries a pair of particles onto another pair, so all pairs are tried, each
    refined by a fit to all particles. Rotations within the tolerance are admitted, best first,
    where all their products stay within twice the tolerance; the body is then averaged over the
    group, which makes the rotations exact.

    Examples
    --------
    >>> rotation_group(Cluster.tetrahedron(1.5).positions, tolerance=0.01).shape
    (12, 3, 3)
    """
    x = _checked(positions, tolerance)
    d = x.shape[1]
    line = _along_line(x, tolerance)
    if line is not None:
        return _line_group(line, d, tolerance)
    spatial = np.pad(x, ((0, 0), (0, 3 - d)))
    elements = symmetry_elements(spatial, tolerance)
    proper: Floats = elements[np.linalg.det(elements) > 0]
    if d == 3:
        return proper
    return np.ascontiguousarray(proper[proper[:, 2, 2] > 0, :2, :2])


def point_group(positions: ArrayLike, *, tolerance: float | None = None) -> str:
    """Return the Schoenflies symbol of a body of indistinguishable particles, mirrors included.

    Parameters
    ----------
    positions : array_like, shape (n, d)
        Centres, um; points of the plane are a flat body in space.
    tolerance : float, optional
        How far (um) a mapped particle may be from the place of another one; default a millionth
        of the mean distance to the centre.

    Returns
    -------
    str
        "T_d", "O_h", "D_3h", "C_2v", "C_1", ..., "D_inf_h" and "C_inf_v" for particles on a line,
        "K_h" for one particle.

    Raises
    ------
    ValueError
        For a bad shape, or a tolerance that is not a number >= 0.

    Examples
    --------
    >>> point_group(Cluster.touching(7, 2.45).positions)
    'D_5h'
    >>> point_group([[0, 0, 0], [2, 0, 0], [1, 1.5, 0]])
    'C_2v'
    """
    x = _checked(positions, 0.0 if tolerance is None else tolerance)
    x = np.pad(x, ((0, 0), (0, 3 - x.shape[1])))
    allowed = 1e-6 * float(np.linalg.norm(x, axis=1).mean()) if tolerance is None else tolerance
    line = _along_line(x, allowed)
    if line is not None:
        if np.abs(line).max() <= allowed:
            return "K_h"
        return "D_inf_h" if len(_line_group(line, 3, allowed)) == 2 else "C_inf_v"
    return schoenflies(symmetry_elements(x, allowed))


def matching_rotation(x: Floats, onto: Floats, *, tolerance: float) -> Floats | None:
    """Return the rotation that carries a body onto another one, whatever their labels.

    Parameters
    ----------
    x, onto : ndarray, shape (n, 3)
        Centred, of indistinguishable particles, not on one line.
    tolerance : float
        How far (um) a turned particle may be from its place.

    Returns
    -------
    ndarray, shape (3, 3), or None
        onto = R x but for the order, the best one of several; None where there is none.

    Examples
    --------
    >>> x = Cluster.touching(4, 2.45).positions
    >>> R = matching_rotation(x, x[::-1, [1, 2, 0]], tolerance=0.01)
    >>> np.allclose(np.sort((x @ R.T)[:, 0]), np.sort(x[:, 1]))
    True
    """
    order, miss = _mappings(x, onto, tolerance)
    if not miss.size:
        return None
    rotation: Floats = fit_rotations(onto[order[np.argmin(miss)]][None], x)[0][0]
    return rotation


def _checked(positions: ArrayLike, tolerance: float) -> Floats:
    """Return centred positions after checking them and the tolerance."""
    if not (np.ndim(tolerance) == 0 and np.isfinite(tolerance) and tolerance >= 0):
        raise ValueError(f"tolerance: expected a finite number >= 0 (um), got {tolerance!r}")
    return Cluster.from_positions(positions).positions


def _along_line(x: Floats, tolerance: float) -> Floats | None:
    """Return places along the line if all particles lie on one within the tolerance, else None."""
    axis = np.linalg.svd(x)[2][0]
    place = x @ axis
    off = np.linalg.norm(x - place[:, None] * axis, axis=1).max()
    return place[:, None] * axis if off <= max(tolerance, 1e-12 * np.abs(x).max()) else None


def _line_group(line: Floats, d: int, tolerance: float) -> Floats:
    """Return the identity, and a half turn across the line if that exchanges like ends."""
    axis = np.linalg.svd(line)[2][0]
    place = np.sort(line @ axis)
    if not place.any() or np.abs(place + place[::-1]).max() > max(tolerance, 1e-12 * place.max()):
        return np.eye(d)[None]
    across = np.linalg.svd(axis[None])[2][-1]
    half = -np.eye(2) if d == 2 else 2 * np.outer(across, across) - np.eye(3)
    return np.stack([np.eye(d), half])


def symmetry_elements(x: Floats, tolerance: float) -> Floats:
    """Return the point group as orthogonal matrices (g, 3, 3), the identity first.

    An element is known by its sign (-1 for a rotation times the inversion) and by the particles'
    permutation: on a body that is not a line the two fix the matrix.
    """
    tolerance = max(tolerance, 1e-12 * float(np.abs(x).max()))
    found = {
        (sign, *map(int, order)): worst
        for sign in (1, -1)
        for order, worst in zip(*_mappings(x, sign * x, 2 * tolerance), strict=True)
    }
    identity = (1, *range(len(x)))
    group = {identity}
    for element in sorted(found, key=lambda e: (found[e], e)):
        if found[element] > tolerance:
            break
        if element not in group:
            group = _closure(group | {element}, set(found)) or group
    ordered = [identity, *sorted(group - {identity}, reverse=True)]
    return _exact_matrices(x, np.array(ordered))


def _mappings(x: Floats, onto: Floats, tolerance: float) -> tuple[Ints, Floats]:
    """Return the permutations with R x_i = onto_p(i) within the tolerance, and the worst miss."""
    i, j = _widest_pair(x)
    gap, reach = np.linalg.norm(x[i] - x[j]), np.linalg.norm(x[[i, j]], axis=1)
    there = np.linalg.norm(onto, axis=1)
    like = (
        (np.abs(there[:, None] - reach[0]) <= 2 * tolerance)
        & (np.abs(there - reach[1]) <= 2 * tolerance)
        & (np.abs(np.linalg.norm(onto[:, None] - onto, axis=2) - gap) <= 4 * tolerance)
    )
    k, m = np.nonzero(like)
    origin = np.zeros((len(k), 3))
    rotation, unique = fit_rotations(
        np.stack([origin, onto[k], onto[m]], axis=1), np.stack([np.zeros(3), x[i], x[j]])
    )
    rotation = rotation[unique]
    for _ in range(3):
        order = _nearest(rotation, x, onto)
        order = order[(np.sort(order, axis=1) == np.arange(len(x))).all(axis=1)]
        rotation, unique = fit_rotations(onto[order], x)
        order, rotation = order[unique], rotation[unique]
    miss = np.linalg.norm(x @ np.swapaxes(rotation, 1, 2) - onto[order], axis=2).max(axis=1)
    return order[miss <= tolerance], miss[miss <= tolerance]


def _nearest(rotation: Floats, x: Floats, onto: Floats) -> Ints:
    """Return which place each turned particle is nearest to, (K, n)."""
    turned = x @ np.swapaxes(rotation, 1, 2)
    return np.asarray(np.argmin(np.linalg.norm(turned[:, :, None] - onto, axis=3), axis=2))


def _widest_pair(x: Floats) -> tuple[int, int]:
    """Return the two particles that fix a frame best: the largest cross product."""
    area = np.linalg.norm(np.cross(x[:, None], x[None]), axis=2)
    i, j = np.unravel_index(np.argmax(area), area.shape)
    return int(i), int(j)


def _closure(group: set[_Element], allowed: set[_Element]) -> set[_Element] | None:
    """Return the group that some elements generate, or None if it leaves the allowed ones."""
    closed, fresh = set(group), set(group)
    while fresh:
        fresh = {_product(a, b) for a in closed for b in fresh} - closed
        if not fresh <= allowed:
            return None
        closed |= fresh
    return closed


def _product(a: _Element, b: _Element) -> _Element:
    """Return the element that does b first, then a."""
    return (a[0] * b[0], *(a[1 + i] for i in b[1:]))


def _exact_matrices(x: Floats, elements: Ints) -> Floats:
    """Average the body over its group until it is symmetric to rounding; return the matrices."""
    sign, order = elements[:, 0, None, None], elements[:, 1:]
    for _ in range(50):
        matrix = sign * fit_rotations(sign * x[order], x)[0]
        mean = np.einsum("gji,gnj->ni", matrix, x[order]) / len(elements)
        change = np.abs(mean - x).max()
        x = mean
        if change <= 1e-15 * np.abs(x).max():
            break
    return matrix


def schoenflies(elements: Floats) -> str:
    """Name a finite point group from its matrices."""
    proper = elements[np.linalg.det(elements) > 0]
    mirrors = _axes(-elements[_is_trace(elements, 1.0) & (np.linalg.det(elements) < 0)])
    inverted = bool(_is_trace(elements, -3.0).any())
    angle = np.arccos(np.clip((np.trace(proper, axis1=1, axis2=2) - 1) / 2, -1, 1))
    orders = np.rint(2 * np.pi / np.where(angle > 1e-3, angle, 2 * np.pi)).astype(np.int64)
    n, size = int(orders.max()), len(proper)
    improper = len(elements) > size
    if size in (12, 24, 60) and size // n in (4, 6, 12):
        family = {12: "T", 24: "O", 60: "I"}[size]
        return family + (("_d" if family == "T" and not inverted else "_h") if improper else "")
    flat = bool((np.abs(mirrors @ _axes(proper[orders == n]).T) > 0.99).any()) if n > 1 else False
    if size == n:
        return _cyclic(n, improper=improper, flat=flat, mirrors=len(mirrors), inverted=inverted)
    return f"D_{n}" + (("h" if flat else "d") if improper else "")


def _cyclic(n: int, *, improper: bool, flat: bool, mirrors: int, inverted: bool) -> str:
    """Name a group with a single axis of order n; `flat`: a mirror stands across that axis."""
    if not improper:
        return f"C_{n}"
    if n == 1:
        return "C_i" if inverted else "C_s"
    if flat:
        return f"C_{n}h"
    return f"C_{n}v" if mirrors else f"S_{2 * n}"


def _is_trace(matrix: Floats, value: float) -> Bools:
    """Return which matrices have this trace."""
    return np.asarray(np.abs(np.trace(matrix, axis1=1, axis2=2) - value) < 1e-3)


def _axes(rotation: Floats) -> Floats:
    """Return the axes of rotations, (K, 3)."""
    return axis_angle(rotation)[0]
