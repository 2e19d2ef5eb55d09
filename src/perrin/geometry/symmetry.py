"""Rotational symmetry of a set of points: its rotation group and point group."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from perrin.geometry.rotations import axis_angle, fit_rotations
from perrin.geometry.shapes import Cluster

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats, Ints

# A symmetry element: its sign, then the number of the particle that each particle comes to.
_Element: TypeAlias = tuple[int, ...]


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
