"""Which bodies have the same number of particles and the same shape."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from perrin.geometry.shapes import pair_distances

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats, Ints

# Sorted distances of the pairs of two bodies of one shape differ by under this share of the least
# distance: those of touching spheres differ by 0.22 of it at least (square pyramid, bipyramid).
_SAME_SHAPE = 0.15


def shape_numbers(templates: Sequence[Floats], *, rigid: Sequence[bool] | None = None) -> Ints:
    """Return the number of the shape of each body: by particles, then by the first of each shape.

    Mirror images, which diffuse alike, have one number.

    Parameters
    ----------
    templates : sequence of ndarray, shape (n, d)
        Positions of the particles of each body, um.
    rigid : sequence of bool, optional
        Which bodies are rigid; default all. The others count to the most similar shape of as many
        particles, whatever the difference.

    Returns
    -------
    ndarray of int64, shape (B,)

    Examples
    --------
    >>> from perrin import Cluster
    >>> bodies = [Cluster.touching(n, 2.0).positions for n in (4, 3, 4)]
    >>> shape_numbers(bodies)
    array([1, 0, 1])
    """
    distances = [np.sort(pair_distances(template)) for template in templates]
    firm = [True] * len(templates) if rigid is None else list(rigid)
    kinds: list[int] = []  # the first body of each shape
    kind_of = np.zeros(len(templates), dtype=np.int64)
    for b in sorted(range(len(templates)), key=lambda b: not firm[b]):
        distance, best = distances[b], (np.inf, -1)
        for number, first in enumerate(kinds):
            other = distances[first]
            if len(other) == len(distance):
                off = float(np.abs(distance - other).max() / min(distance[0], other[0]))
                best = min(best, (off, number))
        if best[1] < 0 or (firm[b] and best[0] >= _SAME_SHAPE):
            best = 0.0, len(kinds)
            kinds.append(b)
        kind_of[b] = best[1]
    order = np.argsort([len(templates[first]) for first in kinds], kind="stable")
    rank = np.empty(len(kinds), dtype=np.int64)
    rank[order] = np.arange(len(kinds))
    return rank[kind_of]


def usual_symmetry(symmetries: Sequence[str]) -> str:
    """Return the point group that most bodies of a kind have; the first of equals.

    Examples
    --------
    >>> usual_symmetry(["C_1", "T_d", "T_d"])
    'T_d'
    """
    return Counter(symmetries).most_common(1)[0][0]


def part_of(template: Floats, whole: Floats) -> bool:
    """Return whether a body has the shape of a part of another one with more particles.

    Parameters
    ----------
    template : ndarray, shape (m, d)
        Positions of its particles, um.
    whole : ndarray, shape (n, d)
        Positions of the particles of the other body.

    Returns
    -------
    bool

    Examples
    --------
    >>> from perrin import Cluster
    >>> pair, triangle, tetrahedron = (Cluster.touching(n, 2.0).positions for n in (2, 3, 4))
    >>> part_of(triangle, tetrahedron), part_of(tetrahedron, triangle), part_of(2 * pair, triangle)
    (True, False, False)
    """
    return bool(matched_particles(template, whole))


def matched_particles(template: Floats, whole: Floats) -> list[tuple[int, ...]]:
    """Return all ways in which the particles of a body have the distances of those of a larger one.

    Parameters
    ----------
    template, whole
        As in `part_of`.

    Returns
    -------
    list of tuple of int
        Particle of `whole` for each particle of `template`; empty for a body that is not smaller.

    Examples
    --------
    >>> from perrin import Cluster
    >>> triangle, tetrahedron = (Cluster.touching(n, 2.0).positions for n in (3, 4))
    >>> len(matched_particles(triangle, tetrahedron)), matched_particles(tetrahedron, triangle)
    (24, [])
    """
    if len(template) >= len(whole):
        return []
    part, full = (np.linalg.norm(x[:, None] - x, axis=2) for x in (template, whole))
    bound = _SAME_SHAPE * float(pair_distances(template).min())
    # Particles are placed one by one where the distances to those before agree.
    partial: list[tuple[int, ...]] = [()]
    for k in range(len(part)):
        partial = [
            (*chosen, j)
            for chosen in partial
            for j in range(len(full))
            if j not in chosen and np.all(np.abs(full[j, list(chosen)] - part[k, :k]) < bound)
        ]
    return partial
