"""Which rotation carries one point set onto another, and the maps between rotations and vectors.

Rotations are active matrices, lab from body: ``x = R x0``. All functions take leading batch axes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Bools, Floats, present
from perrin.errors import DegenerateClusterError

_CHUNK = 2048  # rows whose working arrays stay in the second-level cache


_EPS = float(np.finfo(np.float64).eps)


def kabsch(points: ArrayLike, reference: ArrayLike, *, weights: ArrayLike | None = None) -> Floats:
    """Find the proper rotation that carries each reference set onto its points.

    Both sets are centred (with the weights) and the rotation minimises the weighted squared
    distance ``sum w |points - R reference|^2`` with ``det R = +1``, also for planar sets and for
    data that look mirrored.

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
        If a row has no unique answer (too few particles, collinear ones, an exact mirror image);
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
    """Scale, rotation and shift of ``y = s R x + v`` (Hunter 2011, Eq. 1)."""

    s: Floats
    R: Floats
    v: Floats


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
    y, x, w = _paired(points, reference, None)
    weight = np.ones(y.shape[-2]) if w is None else w
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
    """Do the work of `kabsch` without raising: rotations, and which of them are unique.

    Parameters
    ----------
    points, reference, weights
        As in `kabsch`.

    Returns
    -------
    rotation : ndarray, shape (..., d, d)
        NaN where the answer is not unique.
    unique : ndarray of bool, shape (...)
        Whether the row has one answer.
    """
    y, x, w = _paired(points, reference, weights)
    batch = np.broadcast_shapes(y.shape[:-2], x.shape[:-2], () if w is None else w.shape[:-1])
    d, size = y.shape[-1], int(np.prod(batch))
    rotation = np.empty((size, d, d))
    unique = np.empty(size, dtype=np.bool_)
    y_rows, x_rows = _rows(y, batch), _rows(x, batch)
    w_rows = None if w is None else _rows(w[..., None], batch)
    solve = _solve_planar if d == 2 else _solve_spatial
    for low in range(0, size, _CHUNK):
        rows = slice(low, low + _CHUNK)
        chunk_w = None if w_rows is None else _transposed(w_rows, rows)
        sets = _transposed(y_rows, rows), _transposed(x_rows, rows), chunk_w
        rotation[rows], unique[rows] = solve(*sets)
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
    k = skew(v)
    # Rodrigues: sin(a)/a and (1 - cos a)/a^2 as sinc, which stays exact through a = 0.
    a = np.sinc(angle / np.pi)[..., None, None]
    b = (0.5 * np.sinc(angle / (2 * np.pi)) ** 2)[..., None, None]
    rotation: Floats = np.eye(3) + a * k + b * (k @ k)
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
        rad. In the plane the angle is signed, in (-pi, pi].

    Examples
    --------
    >>> log_map(exp_map([0.1, -0.2, 3.0])).round(12)
    array([ 0.1, -0.2,  3. ])
    """
    r = np.asarray(rotation, dtype=np.float64)
    if r.shape[-1] == 2:
        return np.arctan2(r[..., 1, 0], r[..., 0, 0])[..., None]
    q = _quaternion(r)
    v, w = q[..., 1:], q[..., 0]
    sine = np.linalg.norm(v, axis=-1)
    angle = 2.0 * np.arctan2(sine, w)
    # sine < 1e-9 means cos = 1 to rounding: the angle is 2 sine, so the ratio is 2.
    ratio = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 1e-9)
    out: Floats = v * ratio[..., None]
    return out


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
        rad, in [0, pi]. At pi either sign of the axis is right.

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
    # hypot does not square: an angle of 1e-200 is one too.
    angle = np.asarray(np.minimum(np.hypot.reduce(vector, axis=-1), np.pi))
    axis = np.full_like(vector, np.nan)
    np.divide(vector, angle[..., None], out=axis, where=angle[..., None] > 0)
    return axis, angle


def skew(vector: Floats) -> Floats:
    """Return the matrix [v]x with [v]x u = v x u, shape (..., 3, 3)."""
    zero = np.zeros(vector.shape[:-1])
    x, y, z = np.moveaxis(vector, -1, 0)
    rows = [(zero, -z, y), (z, zero, -x), (-y, x, zero)]
    return np.stack([np.stack(row, -1) for row in rows], -2)


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
    Two levels of blocks, so that the Python loops have about sqrt(K) turns.
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
        In lab axes.

    Returns
    -------
    ndarray, shape (K + 1, d, d)
    """
    return np.swapaxes(cumulative_product(np.swapaxes(steps, -1, -2)), -1, -2)


def _paired(
    points: ArrayLike, reference: ArrayLike, weights: ArrayLike | None
) -> tuple[Floats, Floats, Floats | None]:
    """Coerce and check the three inputs; absent particles get weight 0 and coordinate 0."""
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
    if np.isfinite(y).all() and np.isfinite(x).all():
        return y, x, w
    if np.isinf(y).any() or np.isinf(x).any():
        raise ValueError("points and reference: infinite coordinate; use NaN for a missing point")
    here_y, here_x = present(y), present(x)
    w = np.where(here_y & here_x, 1.0 if w is None else w, 0.0)
    return np.where(here_y[..., None], y, 0.0), np.where(here_x[..., None], x, 0.0), w


def _rows(a: Floats, batch: tuple[int, ...]) -> Floats:
    """Flatten the leading axes to one, or keep a single set as it is (it broadcasts)."""
    if int(np.prod(a.shape[:-2])) == 1:
        return a.reshape(1, *a.shape[-2:])
    return np.broadcast_to(a, (*batch, *a.shape[-2:])).reshape(-1, *a.shape[-2:])


def _transposed(a: Floats, rows: slice) -> Floats:
    """Return (n, d, B) with the batch last: every component one contiguous vector."""
    part = a if a.shape[0] == 1 else a[rows]
    return np.ascontiguousarray(part.transpose(1, 2, 0))


def _dispersion(y: Floats, x: Floats, w: Floats | None) -> tuple[Floats, Floats]:
    """Return the cross-dispersion C = sum w y x^T (Eq. 8), (d, d, B), and its rounding error, (B,).

    Centring a set at distance L leaves it uncertain by eps L.
    """
    total = float(y.shape[0]) if w is None else np.maximum(w.sum(0), 1e-300)
    y0 = (y if w is None else y * w).sum(0) / total
    x0 = (x if w is None else x * w).sum(0) / total
    y, x = y - y0, x - x0
    x_weighted = x if w is None else x * w
    c: Floats = y[0][:, None] * x_weighted[0][None]
    for i in range(1, y.shape[0]):
        c = c + y[i][:, None] * x_weighted[i][None]
    y_size, x_size = _reach(y, w), _reach(x, w)
    near = np.abs(y).max((0, 1)) * x_size * y.shape[0]
    far = np.abs(y0).max(0) * x_size + np.abs(x0).max(0) * y_size
    return c, 8 * _EPS * (near + far)


def _reach(centred: Floats, w: Floats | None) -> Floats:
    """Return the weighted sum of the absolute coordinates, (B,)."""
    size: Floats = np.abs(centred if w is None else centred * w).sum((0, 1))
    return size


def _solve_planar(y: Floats, x: Floats, w: Floats | None) -> tuple[Floats, Bools]:
    """Maximise Tr(R^T C) over rotations of the plane: one angle."""
    c, error = _dispersion(y, x, w)
    cosine, sine = c[0, 0] + c[1, 1], c[1, 0] - c[0, 1]
    length = np.hypot(cosine, sine)
    unique = length > error
    length = np.where(unique, length, 1.0)
    cosine, sine = cosine / length, sine / length
    return np.stack([cosine, -sine, sine, cosine], -1).reshape(-1, 2, 2), unique


def _solve_spatial(y: Floats, x: Floats, w: Floats | None) -> tuple[Floats, Bools]:
    """Maximise Tr(R^T C) over SO(3): fast path with a certificate, SVD for the rows without one."""
    c, error = _dispersion(y, x, w)
    rotation, certain = _newton(c, error)
    out = np.ascontiguousarray(rotation.transpose(2, 0, 1))
    rest = np.flatnonzero(~certain)
    if rest.size:
        out[rest], certain[rest] = _svd(c[:, :, rest].transpose(2, 0, 1), error[rest])
    return out, certain


def _svd(c: Floats, error: Floats) -> tuple[Floats, Bools]:
    """Solve Eqs. 9 and 10; the answer is unique where s_2 + det(U V^T) s_3 > 0 beyond rounding."""
    u, s, vt = np.linalg.svd(c)
    sign = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    u[:, :, 2] *= sign[:, None]
    return u @ vt, s[:, 1] + sign * s[:, 2] > error


def _newton(c: Floats, error: Floats) -> tuple[Floats, Bools]:
    """Return rotations (3, 3, B) and whether each is proven to be the one maximum."""
    largest = np.abs(c).max((0, 1))
    b = c / np.where(largest > 0, largest, 1.0)
    norm = np.sqrt((b * b).sum((0, 1)))
    b = b / np.where(norm > 0, norm, 1.0)
    cofactor = _cofactor(b)
    det = (b[0] * cofactor[0]).sum(0)
    root, gap = _largest_root(det, (cofactor * cofactor).sum((0, 1)))
    # Markley's closed form with |B| = 1: ((k + 1) B + l cof B - B B^T B) / gap, k = (l^2 - 1)/2.
    gram = _product(b.transpose(1, 0, 2), b)
    r = 0.5 * (root * root + 1.0) * b + root * cofactor - _product(b, gram)
    r = r / np.maximum(gap, 1e-12)
    # One Newton-Schulz step squares away the rounding that a small gap lets in.
    schulz = 0.5 * (r - _product(r, _product(r.transpose(1, 0, 2), r)))
    r = r + schulz
    step, definite = _newton_step(_product(r.transpose(1, 0, 2), b))
    # Both steps are quadratic: short ones land within rounding, and a long one betrays a root
    # that has not settled. The error left by the second grows as the gap closes.
    settled = ((schulz * schulz).sum((0, 1)) < 1e-16) & ((step * step).sum(0) < 1e-14 * gap)
    # |B| = 1 bounds two factors of the gap by sqrt(2), so the third, s2 + s3, is over gap / 2.
    certain = definite & settled & (gap > 1e-7) & (0.5 * gap * norm * largest > error)
    turned = r + np.stack([_cross(r[i], step) for i in range(3)])
    return turned, certain


def _largest_root(det: Floats, cofactor2: Floats) -> tuple[Floats, Floats]:
    """Return the largest root l of (l^2 - 1)^2 - 8 l det - 4 |cof|^2 and (its slope)/8, the gap.

    sqrt(3) bounds the root from above, from where Newton's method falls monotonically; the gap is
    (s1 + s2)(s2 + s3)(s3 + s1) of the signed singular values, zero where the answer is not unique.
    """
    root = np.full_like(det, np.sqrt(3.0))
    for _ in range(30):
        square = root * root - 1.0
        slope = 0.5 * root * square - det
        value = 0.125 * square * square - root * det - 0.5 * cofactor2
        change = value / np.maximum(slope, 1e-12)
        root = root - change
        # Rows near a double root creep; they fail the certificate and go through the SVD.
        if np.count_nonzero(np.abs(change) > 1e-9) <= change.size // 100:
            break
    return root, 0.5 * root * (root * root - 1.0) - det


def _newton_step(s: Floats) -> tuple[Floats, Bools]:
    """Solve (tr S - sym S) w = axial(S - S^T), S = R^T C; say if it is positive definite."""
    trace = s[0, 0] + s[1, 1] + s[2, 2]
    p, q, r = trace - s[0, 0], trace - s[1, 1], trace - s[2, 2]
    f, g, h = (-0.5 * (s[i, j] + s[j, i]) for i, j in ((0, 1), (0, 2), (1, 2)))
    a = np.stack([s[2, 1] - s[1, 2], s[0, 2] - s[2, 0], s[1, 0] - s[0, 1]])
    m00, m01, m02 = q * r - h * h, g * h - f * r, f * h - g * q
    m11, m12, m22 = p * r - g * g, f * g - p * h, p * q - f * f
    det = p * m00 + f * m01 + g * m02
    w = np.stack(
        [
            m00 * a[0] + m01 * a[1] + m02 * a[2],
            m01 * a[0] + m11 * a[1] + m12 * a[2],
            m02 * a[0] + m12 * a[1] + m22 * a[2],
        ]
    ) / np.where(det != 0, det, 1.0)
    return w, (p > 0) & (m22 > 0) & (det > 0)


def _product(a: Floats, b: Floats) -> Floats:
    """Multiply matrices with the batch last, (3, 3, B)."""
    product: Floats = a[:, 0, None] * b[0] + a[:, 1, None] * b[1] + a[:, 2, None] * b[2]
    return product


def _cross(a: Floats, b: Floats) -> Floats:
    """Return a x b of vectors with the batch last, (3, B)."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def _cofactor(b: Floats) -> Floats:
    return np.stack([_cross(b[1], b[2]), _cross(b[2], b[0]), _cross(b[0], b[1])])


def _quaternion(r: Floats) -> Floats:
    """Return unit quaternions (w, x, y, z), w >= 0, from the best-conditioned column of q q^T."""
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
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)
