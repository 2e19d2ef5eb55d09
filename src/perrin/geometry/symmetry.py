"""Symmetry of a set of points: its rotation group and its point group.

A symmetry element is found as a permutation of the particles, with a sign: +1 for a rotation, -1
for a rotation times the inversion. On a body that is not a line the two determine the matrix.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import number_fault, refuse
from perrin.geometry.rotations import axis_angle, fit_rotations
from perrin.geometry.shapes import Cluster, lengths

if TYPE_CHECKING:
    from collections.abc import Mapping

    from perrin._arrays import Bools, Floats, Ints

# Sign of a symmetry element, then for each particle the number of the one it is mapped to.
_Element: TypeAlias = tuple[int, ...]


def rotation_group(positions: ArrayLike, *, tolerance: float) -> Floats:
    """Return the rotations that map a body of indistinguishable particles on itself.

    Parameters
    ----------
    positions : array_like, shape (n, d)
        Centres, um; their mean is taken as the origin.
    tolerance : float
        Largest distance (um) of a rotated particle from the one it is mapped to.

    Returns
    -------
    ndarray, shape (g, d, d)
        Exact rotations that form a group, the identity first. For a collinear body, all rotations
        about its line are represented by the identity, and all that exchange its ends by one.

    Raises
    ------
    ValueError
        For a bad shape, or a tolerance that is not a number >= 0.

    Notes
    -----
    Every rotation carries a pair of particles onto another pair, so all pairs are tried, each
    refined by a fit to all particles. Rotations within the tolerance are accepted, best first, if
    all their products are within twice the tolerance; the body is then averaged over the group,
    which makes the rotations exact.

    Examples
    --------
    >>> rotation_group(Cluster.tetrahedron(1.5).positions, tolerance=0.01).shape
    (12, 3, 3)
    """
    x = _centred_positions(positions, tolerance)
    d = x.shape[1]
    line = projected_on_line(x, tolerance)
    if line is not None:
        return _line_rotations(line, d, tolerance)
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
        Largest distance (um) of a mapped particle from the one it is mapped to; default a
        millionth of the mean distance to the centre.

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
    x = _centred_positions(positions, 0.0 if tolerance is None else tolerance)
    x = np.pad(x, ((0, 0), (0, 3 - x.shape[1])))
    allowed = 1e-6 * float(np.linalg.norm(x, axis=1).mean()) if tolerance is None else tolerance
    line = projected_on_line(x, allowed)
    if line is not None:
        if np.abs(line).max() <= allowed:
            return "K_h"
        return "D_inf_h" if len(_line_rotations(line, 3, allowed)) == 2 else "C_inf_v"
    return schoenflies(symmetry_elements(x, allowed))


def matching_rotation(x: Floats, onto: Floats, *, tolerance: float) -> Floats | None:
    """Return the rotation that carries a body onto another one, in any order of the particles.

    Parameters
    ----------
    x, onto : ndarray, shape (n, 3)
        Centred positions of indistinguishable particles that are not on one line.
    tolerance : float
        Largest distance (um) of a rotated particle from the one it is mapped to.

    Returns
    -------
    ndarray, shape (3, 3), or None
        R with onto = R x up to the order, the best one of several; None if there is none.

    Examples
    --------
    >>> x = Cluster.touching(4, 2.45).positions
    >>> R = matching_rotation(x, x[::-1, [1, 2, 0]], tolerance=0.01)
    >>> np.allclose(np.sort((x @ R.T)[:, 0]), np.sort(x[:, 1]))
    True
    """
    _, order, miss = _congruences(x[None], onto[None], np.array([tolerance]))
    if not miss.size:
        return None
    rotation: Floats = fit_rotations(onto[order[np.argmin(miss)]][None], x)[0][0]
    return rotation


def _centred_positions(positions: ArrayLike, tolerance: float) -> Floats:
    """Check positions and tolerance; return the positions with their mean at the origin."""
    refuse(number_fault("tolerance", tolerance, least=0, unit="um"))
    return Cluster.from_positions(positions).positions


def projected_on_line(x: Floats, tolerance: float) -> Floats | None:
    """Return the projections on the line of a collinear body, None for any other body.

    Parameters
    ----------
    x : ndarray, shape (n, d)
        Centred positions.
    tolerance : float
        Largest distance (um) of a particle from the line.

    Examples
    --------
    >>> projected_on_line(np.eye(3) - 1 / 3, 0.1) is None
    True
    """
    if not are_collinear(x[None], np.array([tolerance]))[0]:
        return None
    axis = np.linalg.svd(x)[2][0]
    along = x @ axis
    projected: Floats = along[:, None] * axis
    return projected


def are_collinear(x: Floats, tolerance: Floats) -> Bools:
    """Return which of several bodies have all their particles on one line.

    Parameters
    ----------
    x : ndarray, shape (B, n, d)
        Centred positions of the particles of each body.
    tolerance : ndarray, shape (B,)
        Largest distance (um) of a particle from the line.

    Examples
    --------
    >>> x = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    >>> are_collinear(np.stack([x, np.eye(3) - 1 / 3]), np.full(2, 0.1))
    array([ True, False])
    """
    axis = np.linalg.svd(x, full_matrices=False)[2][:, :1]
    off = x - (x @ np.swapaxes(axis, 1, 2)) * axis
    least = 1e-12 * np.abs(x).max(axis=(1, 2))
    return np.asarray(np.linalg.norm(off, axis=2).max(axis=1) <= np.maximum(tolerance, least))


def _line_rotations(line: Floats, d: int, tolerance: float) -> Floats:
    """Return the identity and, if the two ends of a line are alike, a half turn across it."""
    axis = np.linalg.svd(line)[2][0]
    along = np.sort(line @ axis)
    if not along.any() or np.abs(along + along[::-1]).max() > max(tolerance, 1e-12 * along.max()):
        return np.eye(d)[None]
    across = np.linalg.svd(axis[None])[2][-1]
    half = -np.eye(2) if d == 2 else 2 * np.outer(across, across) - np.eye(3)
    return np.stack([np.eye(d), half])


def _congruences(x: Floats, onto: Floats, tolerance: Floats) -> tuple[Ints, Ints, Floats]:
    """Return the permutations p with R x_i = onto_p(i) for a rotation R, of each of B bodies.

    Two particles that are not on one line with the origin determine R. Each pair of `onto` at the
    same distances is tried as their image, and the permutation of all particles is refined.

    Parameters
    ----------
    x, onto : ndarray, shape (B, n, 3)
    tolerance : ndarray, shape (B,)

    Returns
    -------
    body : ndarray of int, shape (K,)
        Body that each of the permutations belongs to.
    order : ndarray of int, shape (K, n)
    misfit : ndarray, shape (K,)
        Largest distance of a rotated particle from the one it is mapped to.
    """
    bodies, n = np.arange(len(x)), x.shape[1]
    # The pair with the largest cross product determines R most precisely.
    area = np.linalg.norm(np.cross(x[:, :, None], x[:, None]), axis=3)
    i, j = np.unravel_index(np.argmax(area.reshape(len(x), -1), axis=1), (n, n))
    first, second = x[bodies, i], x[bodies, j]
    gap = np.linalg.norm(first - second, axis=1)[:, None, None]
    radius = np.linalg.norm(np.stack([first, second]), axis=2)[..., None]
    onto_radius = np.linalg.norm(onto, axis=2)
    near = 2 * tolerance[:, None]
    alike = (np.abs(onto_radius - radius[0]) <= near)[:, :, None]
    alike = alike & (np.abs(onto_radius - radius[1]) <= near)[:, None]
    apart = np.linalg.norm(onto[:, :, None] - onto[:, None], axis=3)
    alike &= np.abs(apart - gap) <= 4 * tolerance[:, None, None]
    body, k, m = np.nonzero(alike)
    origin = np.zeros((len(body), 3))
    images = np.stack([origin, onto[body, k], onto[body, m]], axis=1)
    rotation, unique = fit_rotations(images, np.stack([origin, first[body], second[body]], axis=1))
    rotation, body, order = rotation[unique], body[unique], np.empty((0, n), dtype=np.int64)
    for _ in range(3):
        rotated, before = x[body] @ np.swapaxes(rotation, 1, 2), order
        away = lengths(rotated[:, :, None] - onto[body][:, None])
        order = np.argmin(away, axis=2)
        permutes = np.asarray((np.sort(order, axis=1) == np.arange(n)).all(axis=1))
        order, body = order[permutes], body[permutes]
        if np.array_equal(order, before):
            break
        rotation, unique = fit_rotations(onto[body[:, None], order], x[body])
        order, rotation, body = order[unique], rotation[unique], body[unique]
    away = x[body] @ np.swapaxes(rotation, 1, 2) - onto[body[:, None], order]
    misfit = lengths(away).max(axis=1)
    kept = misfit <= tolerance[body]
    return body[kept], order[kept], misfit[kept]


def symmetry_elements(x: Floats, tolerance: float) -> Floats:
    """Return the point group of a body as orthogonal matrices.

    Parameters
    ----------
    x : ndarray, shape (n, 3)
        Centred positions of indistinguishable particles that are not on one line.
    tolerance : float
        Largest distance (um) of a mapped particle from the one it is mapped to.

    Returns
    -------
    ndarray, shape (g, 3, 3)
        The identity first.

    Examples
    --------
    >>> symmetry_elements(Cluster.tetrahedron(1.5).positions, 0.01).shape
    (24, 3, 3)
    """
    return symmetry_elements_of_each(x[None], np.array([tolerance]))[0]


def symmetry_elements_of_each(x: Floats, tolerance: Floats) -> list[Floats]:
    """Return the point groups of several bodies, as `symmetry_elements`.

    Bodies with the same permutations have the same group.

    Parameters
    ----------
    x : ndarray, shape (B, n, 3)
        Centred positions of the particles of each body, which are not on one line.
    tolerance : ndarray, shape (B,)
        Largest distance (um) of a mapped particle from the one it is mapped to.

    Returns
    -------
    list of ndarray, shape (g, 3, 3)

    Examples
    --------
    >>> x = np.stack([Cluster.tetrahedron(1.5).positions, Cluster.tetrahedron(2.0).positions])
    >>> [len(elements) for elements in symmetry_elements_of_each(x, np.full(2, 0.01))]
    [24, 24]
    """
    tolerance = np.maximum(tolerance, 1e-12 * np.abs(x).max(axis=(1, 2)))
    groups: dict[tuple[_Element, ...], list[int]] = {}
    for k, group in enumerate(_groups_of_permutations(x, tolerance)):
        groups.setdefault(group, []).append(k)
    matrices: dict[int, Floats] = {}
    for group, bodies in groups.items():
        elements = np.array(group, dtype=np.int64)
        sign_of, order = elements[:, 0, None, None], elements[:, 1:]
        # Averaging a body over the group makes it symmetric, and the matrices exact, to rounding.
        symmetric, moving = x[bodies], np.arange(len(bodies))
        exact = np.empty((len(bodies), len(order), 3, 3))
        rounds = 0
        while moving.size and rounds < 50:
            some, rounds = symmetric[moving], rounds + 1
            exact[moving] = sign_of * fit_rotations(sign_of * some[:, order], some[:, None])[0]
            images = np.moveaxis(some[:, order], 1, 2).reshape(len(some), x.shape[1], -1)
            mean = images @ exact[moving].reshape(len(some), -1, 3) / len(order)
            change = np.abs(mean - some).max(axis=(1, 2))
            symmetric[moving] = mean
            moving = moving[~(change <= 1e-15 * np.abs(mean).max(axis=(1, 2)))]
        matrices.update(zip(bodies, exact, strict=True))
    return [matrices[k] for k in range(len(x))]


def _groups_of_permutations(x: Floats, tolerance: Floats) -> list[tuple[_Element, ...]]:
    """Return the symmetry elements of several bodies, the identity first."""
    n = x.shape[1]
    identity: _Element = (1, *range(n))
    found = [_congruences(x, sign * x, 2 * tolerance) for sign in (1, -1)]
    body, order, misfit = (np.concatenate(part) for part in zip(*found, strict=True))
    sign = np.repeat([1, -1], [len(part[0]) for part in found])
    elements = np.column_stack([sign, order])
    rows = np.lexsort((*elements.T[::-1], body))
    body, elements, misfit = body[rows], elements[rows], misfit[rows]
    within = misfit <= tolerance[body]
    ends = np.searchsorted(body, np.arange(len(x) + 1)).tolist()
    # Most bodies have the same elements as the one before, all of which generate a group.
    together: dict[tuple[bytes, bytes], frozenset[_Element] | None] = {}
    groups: list[tuple[_Element, ...]] = []
    for low, high in pairwise(ends):
        some, close = elements[low:high], within[low:high]
        key = some.tobytes(), close.tobytes()
        if key not in together:
            allowed = frozenset(map(tuple, some.tolist()))
            together[key] = _generated_group(
                frozenset(map(tuple, some[close].tolist())) | {identity}, allowed
            )
        group = together[key]
        if group is None:
            misfits = dict(zip(map(tuple, some.tolist()), misfit[low:high].tolist(), strict=True))
            group = _group_of_best(misfits, float(tolerance[len(groups)]), identity)
        groups.append((identity, *sorted(group - {identity}, reverse=True)))
    return groups


def _group_of_best(
    misfits: Mapping[_Element, float], tolerance: float, identity: _Element
) -> frozenset[_Element]:
    """Return a group of elements, accepted best first, whose products all have a known misfit."""
    group = frozenset({identity})
    within = [element for element, misfit in misfits.items() if misfit <= tolerance]
    for element in sorted(within, key=lambda e: (misfits[e], e)):
        if element not in group:
            group = _generated_group(group | {element}, frozenset(misfits)) or group
    return group


@lru_cache(maxsize=128)
def _generated_group(
    generators: frozenset[_Element], allowed: frozenset[_Element]
) -> frozenset[_Element] | None:
    """Return the group that some elements generate, or None if it is not a subset of `allowed`."""
    group, fresh = set(generators), set(generators)
    while fresh:
        products = {(a[0] * b[0], *(a[1 + i] for i in b[1:])) for a in group for b in fresh}
        fresh = products - group
        if not fresh <= allowed:
            return None
        group |= fresh
    return frozenset(group)


def schoenflies(elements: Floats) -> str:
    """Return the Schoenflies symbol of a finite point group.

    Parameters
    ----------
    elements : ndarray, shape (g, 3, 3)
        All its orthogonal matrices.

    Examples
    --------
    >>> schoenflies(np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0]), -np.eye(3),
    ...                       np.diag([1.0, 1.0, -1.0])]))
    'C_2h'
    """
    trace = np.trace(elements, axis1=1, axis2=2)
    det = np.linalg.det(elements)
    proper = elements[det > 0]
    # A mirror is the inversion times a half turn about its normal.
    normals = axis_angle(-elements[(np.abs(trace - 1.0) < 1e-3) & (det < 0)])[0]
    inversion = bool((np.abs(trace + 3.0) < 1e-3).any())
    angle = np.arccos(np.clip((np.trace(proper, axis1=1, axis2=2) - 1) / 2, -1, 1))
    orders = np.rint(2 * np.pi / np.where(angle > 1e-3, angle, 2 * np.pi)).astype(np.int64)
    n, size = int(orders.max()), len(proper)
    improper = len(elements) > size
    if size in (12, 24, 60) and size // n in (4, 6, 12):
        family = {12: "T", 24: "O", 60: "I"}[size]
        return family + (("_d" if family == "T" and not inversion else "_h") if improper else "")
    main_axes = axis_angle(proper[orders == n])[0]
    horizontal = n > 1 and bool((np.abs(normals @ main_axes.T) > 0.99).any())
    if size > n:
        return f"D_{n}" + (("h" if horizontal else "d") if improper else "")
    if not improper:
        return f"C_{n}"
    if n == 1:
        return "C_i" if inversion else "C_s"
    if horizontal:
        return f"C_{n}h"
    return f"C_{n}v" if len(normals) else f"S_{2 * n}"
