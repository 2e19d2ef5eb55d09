"""Rotations: the one that carries a point set onto another, and maps to vectors and back.

Rotations are active matrices, lab from body: ``x = R x0``. All functions take leading batch axes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Bools, Floats, from_plain, present, to_plain
from perrin.compiled.loading import compiled_kernels
from perrin.errors import DegenerateClusterError
from perrin.geometry.shapes import lengths
from perrin.geometry.wahba import by_svd, planar_rotation, spatial_rotation

if TYPE_CHECKING:
    from collections.abc import Mapping

_CACHED_ROWS = 2048  # rows whose working arrays fit into the second-level cache
_MANY_ROWS = 32  # rows from which copies of a reference take longer than a call of their own


def kabsch(points: ArrayLike, reference: ArrayLike, *, weights: ArrayLike | None = None) -> Floats:
    """Find the proper rotation that carries each reference set onto its points.

    Both sets are centred (with the weights) and the rotation minimises the weighted squared
    distance ``sum w |points - R reference|^2`` with ``det R = +1``, also for planar sets and for
    mirrored data.

    Parameters
    ----------
    points : array_like, shape (..., n, d)
        Measured coordinates, d = 2 or 3, any unit. A row with a NaN is an absent particle.
    reference : array_like, shape (..., n, d)
        The coordinates to be turned, in the same order; leading axes broadcast.
    weights : array_like, shape (..., n), optional
        Weight of each particle, >= 0; 0 means absent.

    Returns
    -------
    ndarray, shape (..., d, d)
        Active rotation matrices.

    Raises
    ------
    ValueError
        If shapes do not fit, a coordinate is infinite, or a weight is negative or not finite.
    DegenerateClusterError
        If a row has no unique rotation (too few particles, collinear ones, a mirror image);
        ``indices`` names the rows, counted along the flattened leading axes.

    Notes
    -----
    The rotation of Hunter 2011, Eqs. 5-10 (Challis). It is computed without an SVD: the largest
    root of the characteristic quartic by Newton's method, the rotation in closed form from it
    (Markley, J. Astronaut. Sci. 41, 261 (1993)), and one Newton step on SO(3) whose Hessian, if
    positive definite, proves the global maximum. Rows without that proof go through an SVD.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin import Cluster, kabsch
    >>> quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    >>> x0 = Cluster.tetrahedron(1.5).positions
    >>> bool(np.allclose(kabsch(x0 @ quarter.T + 7.0, x0), quarter))
    True
    """
    rotation, unique = fit_rotations(points, reference, weights=weights)
    if not unique.all():
        rows = tuple(int(i) for i in np.flatnonzero(~unique))
        raise DegenerateClusterError(
            f"no unique rotation for {len(rows)} of {unique.size} rows (first: "
            f"{', '.join(map(str, rows[:10]))}): fewer than {rotation.shape[-1]} particles "
            "present, collinear ones, or an exact mirror image; leave these rows out",
            rows,
        )
    return rotation


class Similarity(NamedTuple):
    """Scale, rotation and shift of ``y = s R x + v`` (Hunter 2011, Eq. 1).

    Attributes
    ----------
    s : ndarray, shape (...)
        Scale.
    R : ndarray, shape (..., d, d)
        Proper rotation matrices.
    v : ndarray, shape (..., d)
        Shift, in the unit of y.
    """

    s: Floats
    R: Floats
    v: Floats

    def to_dict(self) -> dict[str, Any]:
        """Return the similarity as values that JSON holds."""
        plain: dict[str, Any] = to_plain(self._asdict())
        return plain

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Similarity:
        """Return the similarity that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping

        Examples
        --------
        >>> found = similarity([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]], [[0, 0], [1, 0], [0, 1]])
        >>> Similarity.from_dict(found.to_dict()).s
        array(2.)
        """
        return cls(*(from_plain(entry[name]) for name in cls._fields))


def similarity(points: ArrayLike, reference: ArrayLike) -> Similarity:
    """Find the scale, rotation and shift that carry each reference set onto its points.

    Parameters
    ----------
    points : array_like, shape (..., n, d)
        y of ``y = s R x + v``; a row with a NaN is an absent particle.
    reference : array_like, shape (..., n, d)
        x; leading axes broadcast.

    Returns
    -------
    Similarity
        ``s`` of shape (...), positive, ``R`` (..., d, d) proper, ``v`` (..., d): the least-squares
        solution.

    Raises
    ------
    DegenerateClusterError
        As in `kabsch`.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin import Cluster, similarity
    >>> x = Cluster.tetrahedron(1.0).positions
    >>> s, R, v = similarity(2.0 * x + [1.0, 0.0, -1.0], x)
    >>> float(s.round(12)), v.round(12).tolist()
    (2.0, [1.0, 0.0, -1.0])
    """
    R = kabsch(points, reference)
    y, x, w = _without_absent(*_checked(points, reference, None))
    weight = np.ones(y.shape[-2]) if w is None else w[..., 0]
    total = weight.sum(-1)[..., None]
    y0 = (weight[..., None] * y).sum(-2) / total
    x0 = (weight[..., None] * x).sum(-2) / total
    turned = np.einsum("...ij,...nj->...ni", R, x - x0[..., None, :])
    along = np.sum(weight[..., None] * (y - y0[..., None, :]) * turned, axis=(-2, -1))
    s = along / np.sum(weight[..., None] * turned**2, axis=(-2, -1))
    v = y0 - s[..., None] * np.einsum("...ij,...j->...i", R, x0)
    return Similarity(np.asarray(s), R, np.asarray(v))


def fit_rotations(
    points: ArrayLike, reference: ArrayLike, *, weights: ArrayLike | None = None
) -> tuple[Floats, Bools]:
    """Return the rotations of `kabsch` and which of them are unique, without raising.

    Parameters
    ----------
    points, reference, weights
        As in `kabsch`.

    Returns
    -------
    rotation : ndarray, shape (..., d, d)
        NaN where the answer is not unique.
    unique : ndarray of bool, shape (...)
        Whether the row has a unique rotation.

    Examples
    --------
    >>> square, line = np.eye(4, 2), np.zeros((4, 2))
    >>> fit_rotations(np.stack([square, line]), square)[1]
    array([ True, False])
    """
    y, x, w = _checked(points, reference, weights)
    batch = y.shape[:-2]
    if w is not None or x.shape[:-2] != batch:
        batch = np.broadcast_shapes(batch, x.shape[:-2], () if w is None else w.shape[:-1])
    d, size = y.shape[-1], math.prod(batch)
    # Many neighbouring rows with one reference are solved together, without copies of it.
    shared = w is None and y.shape[:-2] == batch and x.shape[:-2] == (*batch[:-1], 1)
    shared = shared and size > 0 and batch[-1] >= _MANY_ROWS
    x = _rows(x[..., 0, :, :], batch[:-1]) if shared else _rows(x, batch)
    y = _rows(y, batch)
    w = None if w is None else _rows(w[..., None], batch)
    rotation, unique = np.empty((size, d, d)), np.zeros(size, dtype=np.bool_)
    together = batch[-1] if shared else max(size, 1)
    kernels = compiled_kernels() if d == 3 else None
    if kernels is not None:
        for k, low in enumerate(range(0, size, together)):
            part = slice(low, low + together)
            one = x[k : k + 1] if shared else x
            kernels.wahba(y[part], one, rotation[part], unique[part], w)
    rest = np.flatnonzero(~unique)
    solve = planar_rotation if d == 2 else spatial_rotation if kernels is None else by_svd
    for low in range(0, rest.size, _CACHED_ROWS):
        rows = rest[low : low + _CACHED_ROWS]
        some_y, some_x, some_w = _without_absent(
            y if len(y) == 1 else y[rows],
            x if len(x) == 1 else x[rows // together if shared else rows],
            w if w is None or len(w) == 1 else w[rows],
        )
        last_w = None if some_w is None else _batch_last(some_w)
        rotation[rows], unique[rows] = solve(_batch_last(some_y), _batch_last(some_x), last_w)
    rotation[~unique] = np.nan
    return rotation.reshape(*batch, d, d), unique.reshape(batch)


def exp_map(vector: ArrayLike) -> Floats:
    """Return the rotation matrix of a rotation vector (angle times axis).

    Parameters
    ----------
    vector : array_like, shape (..., 3) or (..., 1)
        Rotation vectors, rad; one number in the plane.

    Returns
    -------
    ndarray, shape (..., 3, 3) or (..., 2, 2)

    Examples
    --------
    >>> import numpy as np
    >>> exp_map([0.0, 0.0, np.pi / 2]).round(12) + 0.0
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    v = np.asarray(vector, dtype=np.float64)
    if v.shape[-1] == 1:
        c, s = np.cos(v[..., 0]), np.sin(v[..., 0])
        return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    angle = np.linalg.norm(v, axis=-1)
    # Rodrigues: sin(a)/a and (1 - cos a)/a^2 as sinc, which stays exact through a = 0.
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    # The matrix 1 + a [v]x + b [v]x [v]x, element by element.
    u = [v[..., i] for i in range(3)]
    of_b = [b * one for one in u]
    square = [one * other for one, other in zip(of_b, u, strict=True)]
    rotation = np.empty((*v.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        rotation[..., i, i] = 1.0 - (square[j] + square[k])
        even, odd = of_b[i] * u[j], a * u[k]
        rotation[..., i, j] = even - odd
        rotation[..., j, i] = even + odd
    return rotation


def log_map(rotation: ArrayLike) -> Floats:
    """Return the rotation vector (angle times axis, angle in [0, pi]) of a rotation matrix.

    Parameters
    ----------
    rotation : array_like, shape (..., 3, 3) or (..., 2, 2)
        Proper rotation matrices; NaN passes through.

    Returns
    -------
    ndarray, shape (..., 3) or (..., 1)
        Rotation vectors, rad. In the plane the angle is signed, in (-pi, pi].

    Examples
    --------
    >>> log_map(exp_map([0.1, -0.2, 3.0])).round(12)
    array([ 0.1, -0.2,  3. ])
    """
    r = np.asarray(rotation, dtype=np.float64)
    if r.shape[-1] == 2:
        return np.arctan2(r[..., 1, 0], r[..., 0, 0])[..., None]
    q = unit_quaternion(r)
    v, w = q[..., 1:], q[..., 0]
    sine = lengths(v)
    angle = 2.0 * np.arctan2(sine, w)
    # sine < 1e-9 means cos = 1 to rounding: the angle is 2 sine, so the ratio is 2.
    ratio = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-9)
    return np.ascontiguousarray(v * ratio[..., None])


def axis_angle(rotation: ArrayLike) -> tuple[Floats, Floats]:
    """Return axis and angle of a rotation (Hunter 2011, Eqs. 28-31), safe at every angle and axis.

    Parameters
    ----------
    rotation : array_like, shape (..., 3, 3)
        Proper rotation matrices.

    Returns
    -------
    axis : ndarray, shape (..., 3)
        Unit vectors; NaN where the angle is 0 and there is no axis.
    angle : ndarray, shape (...)
        Angles, rad, in [0, pi]. At pi either sign of the axis is right.

    Raises
    ------
    ValueError
        For another shape; a rotation of the plane has no axis.

    Examples
    --------
    >>> axis, angle = axis_angle(exp_map([0.5, 0.0, 0.0]))  # along x, where Eq. 29 is 0/0
    >>> axis.round(12).tolist(), float(angle.round(12))
    ([1.0, 0.0, 0.0], 0.5)
    """
    r = np.asarray(rotation, dtype=np.float64)
    if r.shape[-2:] != (3, 3):
        raise ValueError(f"rotation: expected matrices (..., 3, 3), got shape {r.shape}")
    vector = log_map(r)
    # hypot does not square, so that an angle of 1e-200 is not rounded to 0.
    angle = np.asarray(np.minimum(np.hypot.reduce(vector, axis=-1), np.pi))
    axis = np.full_like(vector, np.nan)
    np.divide(vector, angle[..., None], out=axis, where=angle[..., None] > 0)
    return axis, angle


def skew(vector: Floats) -> Floats:
    """Return the matrix [v]x of the cross product: [v]x u = v x u.

    Parameters
    ----------
    vector : ndarray, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., 3, 3)

    Examples
    --------
    >>> skew(np.array([0.0, 0.0, 2.0])) @ [1.0, 0.0, 0.0]
    array([0., 2., 0.])
    """
    matrix = np.zeros((*vector.shape, 3))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        matrix[..., k, j] = vector[..., i]
        matrix[..., j, k] = -vector[..., i]
    return matrix


def unit_quaternion(rotation: Floats) -> Floats:
    """Return the unit quaternion (w, x, y, z), w >= 0, of a rotation matrix.

    It is read from a well-conditioned column of q q^T, which is accurate at every angle: the first
    one, w q, up to 120 degrees, and the best one beyond.

    Parameters
    ----------
    rotation : ndarray, shape (..., 3, 3)

    Returns
    -------
    ndarray, shape (..., 4)

    Examples
    --------
    >>> unit_quaternion(np.diag([1.0, -1.0, -1.0]))
    array([0., 1., 0., 0.])
    """
    r = rotation
    # Each component is one vector in memory.
    q = np.moveaxis(np.empty((4, *r.shape[:-2])), 0, -1)
    q[..., 0] = 1.0 + r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    for i, (a, b) in enumerate(((2, 1), (0, 2), (1, 0))):
        np.subtract(r[..., a, b], r[..., b, a], out=q[..., i + 1])
    far = ~(q[..., 0] >= 1.0)
    if far.any():
        q[far] = _best_column(r[far])
    return np.asarray(q / lengths(q)[..., None])


def _best_column(r: Floats) -> Floats:
    """Return the longest column of 4 q q^T, with w >= 0, of rotation matrices (K, 3, 3)."""
    t = np.trace(r, axis1=-2, axis2=-1)
    k = np.empty((*r.shape[:-2], 4, 4))
    k[..., 0, 0] = 1.0 + t
    for i, (a, b) in enumerate(((2, 1), (0, 2), (1, 0))):
        k[..., i + 1, i + 1] = 1.0 + 2.0 * r[..., i, i] - t
        k[..., 0, i + 1] = k[..., i + 1, 0] = r[..., a, b] - r[..., b, a]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        k[..., i + 1, j + 1] = k[..., j + 1, i + 1] = r[..., i, j] + r[..., j, i]
    best = np.argmax(np.einsum("...ii->...i", k), axis=-1)
    q: Floats = np.take_along_axis(k, best[..., None, None], axis=-1)[..., 0]
    return np.where(q[..., :1] < 0, -q, q)


def cumulative_product(steps: Floats) -> Floats:
    """Return the running products Q_0 = 1, Q_{k+1} = Q_k S_k of step rotations.

    Parameters
    ----------
    steps : ndarray, shape (K, d, d)

    Returns
    -------
    ndarray, shape (K + 1, d, d)

    Notes
    -----
    The steps are multiplied in two levels of blocks, so that the Python loops have about sqrt(K)
    passes.

    Examples
    --------
    >>> eighth = exp_map([np.pi / 4])
    >>> log_map(cumulative_product(np.stack([eighth, eighth]))).ravel().round(3)
    array([0.   , 0.785, 1.571])
    """
    count, d = steps.shape[0], steps.shape[-1]
    length = max(1, int(np.ceil(np.sqrt(count))))
    blocks = -(-count // length) if count else 0
    inside = np.broadcast_to(np.eye(d), (blocks * length, d, d)).copy()
    inside[:count] = steps
    inside = inside.reshape(blocks, length, d, d)
    for i in range(1, length):
        inside[:, i] = inside[:, i - 1] @ inside[:, i]
    for b in range(1, blocks):
        inside[b] = inside[b - 1, -1] @ inside[b]
    product = np.empty((count + 1, d, d))
    product[0] = np.eye(d)
    product[1:] = inside.reshape(-1, d, d)[:count]
    return product


def successive_product(steps: Floats) -> Floats:
    """Return the products of successive rotations Q_0 = 1, Q_{k+1} = R^k Q_k (Hunter 2011, Eq. 13).

    Parameters
    ----------
    steps : ndarray, shape (K, d, d)
        Rotations R^k of the steps, in lab axes.

    Returns
    -------
    ndarray, shape (K + 1, d, d)

    Examples
    --------
    >>> about_x, about_z = exp_map([np.pi / 2, 0, 0]), exp_map([0, 0, np.pi / 2])
    >>> products = successive_product(np.stack([about_x, about_z]))
    >>> np.allclose(products[2], about_z @ about_x)
    True
    """
    return np.swapaxes(cumulative_product(np.swapaxes(steps, -1, -2)), -1, -2)


def _checked(
    points: ArrayLike, reference: ArrayLike, weights: ArrayLike | None
) -> tuple[Floats, Floats, Floats | None]:
    """Check shapes and weights, and return arrays."""
    y, x = np.asarray(points, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if y.ndim < 2 or y.shape[-2:] != x.shape[-2:] or y.shape[-1] not in (2, 3) or not y.shape[-2]:
        raise ValueError(
            "points and reference: expected two sets (..., n, d) with the same n and d = 2 or 3, "
            f"got {y.shape} and {x.shape}"
        )
    w = None if weights is None else np.asarray(weights, dtype=np.float64)
    if w is not None and (w.shape[-1:] != y.shape[-2:-1] or not (np.isfinite(w) & (w >= 0)).all()):
        raise ValueError(
            f"weights: expected finite numbers >= 0 of shape (..., {y.shape[-2]}), got shape "
            f"{w.shape}" + ("" if w.size == 0 else f" with minimum {np.min(w)}")
        )
    return y, x, w


def _without_absent(y: Floats, x: Floats, w: Floats | None) -> tuple[Floats, Floats, Floats | None]:
    """Give absent particles the coordinate 0 and the weight 0; weights are (..., n, 1)."""
    if np.isfinite(y).all() and np.isfinite(x).all():
        return y, x, w
    if np.isinf(y).any() or np.isinf(x).any():
        raise ValueError("points and reference: infinite coordinate; use NaN for a missing point")
    here_y, here_x = present(y)[..., None], present(x)[..., None]
    w = np.where(here_y & here_x, 1.0 if w is None else w, 0.0)
    return np.where(here_y, y, 0.0), np.where(here_x, x, 0.0), w


def _rows(a: Floats, batch: tuple[int, ...]) -> Floats:
    """Flatten the leading axes to one, or keep a single set as it is (it broadcasts)."""
    if math.prod(a.shape[:-2]) != 1 and a.shape[:-2] != batch:
        a = np.broadcast_to(a, (*batch, *a.shape[-2:]))
    return np.ascontiguousarray(a.reshape(math.prod(a.shape[:-2]), *a.shape[-2:]))


def _batch_last(a: Floats) -> Floats:
    """Return (n, d, B) with the batch last: every component one contiguous vector."""
    return np.ascontiguousarray(a.transpose(1, 2, 0))
