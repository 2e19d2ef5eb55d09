"""Wahba's problem: the proper rotation R that maximises Tr(R^T C), for many matrices C at once.

C is the cross-dispersion of two point sets. The batch axis is the last one, so that every
component is one contiguous vector.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats

# Up to this many rows a singular value decomposition is faster than the closed form.
_FEW_ROWS = 64

_EPS = float(np.finfo(np.float64).eps)


def dispersion(y: Floats, x: Floats, w: Floats | None) -> tuple[Floats, Floats]:
    """Return the cross-dispersion C = sum w y x^T (Hunter 2011, Eq. 8) and its rounding error.

    Parameters
    ----------
    y, x : ndarray, shape (n, d, B)
        Both point sets; a batch of length 1 broadcasts.
    w : ndarray, shape (n, 1, B), or None
        Weights; None means that all are 1.

    Returns
    -------
    c : ndarray, shape (d, d, B)
    error : ndarray, shape (B,)
        Bound of the rounding error of C: centring a set at distance L leaves an error of eps L.

    Examples
    --------
    >>> x = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 2.0], [0.0, -2.0]])[:, :, None]
    >>> dispersion(x, x, None)[0][..., 0]
    array([[2., 0.],
           [0., 8.]])
    """
    total = float(y.shape[0]) if w is None else np.maximum(w.sum(0), 1e-300)
    y0 = (y if w is None else y * w).sum(0) / total
    x0 = (x if w is None else x * w).sum(0) / total
    y, x = y - y0, x - x0
    x_weighted = x if w is None else x * w
    c: Floats = y[0][:, None] * x_weighted[0][None]
    for i in range(1, y.shape[0]):
        c = c + y[i][:, None] * x_weighted[i][None]
    y_size = np.abs(y if w is None else y * w).sum((0, 1))
    x_size = np.abs(x_weighted).sum((0, 1))
    near = np.abs(y).max((0, 1)) * x_size * y.shape[0]
    far = np.abs(y0).max(0) * x_size + np.abs(x0).max(0) * y_size
    return c, 8 * _EPS * (near + far)


def planar_rotation(y: Floats, x: Floats, w: Floats | None) -> tuple[Floats, Bools]:
    """Maximise Tr(R^T C) over the rotations of the plane: one angle.

    Parameters
    ----------
    y, x, w
        As in `dispersion`.

    Returns
    -------
    rotation : ndarray, shape (B, 2, 2)
    unique : ndarray of bool, shape (B,)
        Whether the maximum is unique beyond rounding.

    Examples
    --------
    >>> x = np.array([[1.0, 0.0], [-1.0, 0.0]])[:, :, None]
    >>> planar_rotation(x[:, ::-1], x, None)[0][0]
    array([[ 0., -1.],
           [ 1.,  0.]])
    """
    c, error = dispersion(y, x, w)
    cosine, sine = c[0, 0] + c[1, 1], c[1, 0] - c[0, 1]
    length = np.hypot(cosine, sine)
    unique = length > error
    length = np.where(unique, length, 1.0)
    cosine, sine = cosine / length, sine / length
    return np.stack([cosine, -sine, sine, cosine], -1).reshape(-1, 2, 2), unique


def spatial_rotation(y: Floats, x: Floats, w: Floats | None) -> tuple[Floats, Bools]:
    """Maximise Tr(R^T C) over SO(3): closed form with a certificate, SVD for rows without one.

    Few rows go to the SVD at once, which then takes less time.

    Parameters
    ----------
    y, x, w
        As in `dispersion`.

    Returns
    -------
    rotation : ndarray, shape (B, 3, 3)
    unique : ndarray of bool, shape (B,)
        Whether the maximum is unique beyond rounding.

    Examples
    --------
    >>> x = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])[:, :, None]
    >>> spatial_rotation(x[:, [1, 2, 0]], x, None)[0][0].round(12) + 0.0
    array([[0., 1., 0.],
           [0., 0., 1.],
           [1., 0., 0.]])
    """
    c, error = dispersion(y, x, w)
    if len(error) <= _FEW_ROWS:
        return svd_rotation(c.transpose(2, 0, 1), error)
    rotation, certain = certified_rotation(c, error)
    out = np.ascontiguousarray(rotation.transpose(2, 0, 1))
    rest = np.flatnonzero(~certain)
    if rest.size:
        out[rest], certain[rest] = svd_rotation(c[:, :, rest].transpose(2, 0, 1), error[rest])
    return out, certain


def by_svd(y: Floats, x: Floats, w: Floats | None) -> tuple[Floats, Bools]:
    """Maximise Tr(R^T C) over SO(3) by a singular value decomposition, as `spatial_rotation`.

    It is meant for rows that are known to have no certificate in closed form.

    Parameters
    ----------
    y, x, w
        As in `dispersion`.

    Returns
    -------
    rotation : ndarray, shape (B, 3, 3)
    unique : ndarray of bool, shape (B,)

    Examples
    --------
    >>> x = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])[:, :, None]
    >>> by_svd(x[:, [1, 2, 0]], x, None)[0][0].round(12) + 0.0
    array([[0., 1., 0.],
           [0., 0., 1.],
           [1., 0., 0.]])
    """
    c, error = dispersion(y, x, w)
    return svd_rotation(c.transpose(2, 0, 1), error)


def svd_rotation(c: Floats, error: Floats) -> tuple[Floats, Bools]:
    """Maximise Tr(R^T C) by a singular value decomposition (Hunter 2011, Eqs. 9 and 10).

    Parameters
    ----------
    c : ndarray, shape (B, 3, 3)
    error : ndarray, shape (B,)
        Rounding error of C.

    Returns
    -------
    rotation : ndarray, shape (B, 3, 3)
    unique : ndarray of bool, shape (B,)
        Whether s_2 + det(U V^T) s_3 exceeds the rounding error, which makes the maximum unique.

    Examples
    --------
    >>> rotation, unique = svd_rotation(np.diag([3.0, 2.0, -1.0])[None], np.array([1e-15]))
    >>> np.allclose(rotation[0], np.eye(3)), unique
    (True, array([ True]))
    """
    u, s, vt = np.linalg.svd(c)
    sign = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    u[:, :, 2] *= sign[:, None]
    return u @ vt, s[:, 1] + sign * s[:, 2] > error


def certified_rotation(c: Floats, error: Floats) -> tuple[Floats, Bools]:
    """Maximise Tr(R^T C) in closed form (Markley 1993), with a proof where there is one.

    Parameters
    ----------
    c : ndarray, shape (3, 3, B)
    error : ndarray, shape (B,)
        Rounding error of C.

    Returns
    -------
    rotation : ndarray, shape (3, 3, B)
    certain : ndarray of bool, shape (B,)
        Whether a positive definite Hessian proves the rotation to be the only maximum.

    Examples
    --------
    >>> C = np.diag([3.0, 2.0, 1.0])[:, :, None]
    >>> rotation, certain = certified_rotation(C, np.array([1e-15]))
    >>> np.allclose(rotation[..., 0], np.eye(3)), certain
    (True, array([ True]))
    """
    largest = np.abs(c).max((0, 1))
    b = c / np.where(largest > 0, largest, 1.0)
    norm = np.sqrt((b * b).sum((0, 1)))
    b = b / np.where(norm > 0, norm, 1.0)
    cofactor = np.stack([_cross(b[1], b[2]), _cross(b[2], b[0]), _cross(b[0], b[1])])
    det = (b[0] * cofactor[0]).sum(0)
    root, gap = characteristic_root(det, (cofactor * cofactor).sum((0, 1)))
    # Markley's closed form with |B| = 1: ((k + 1) B + l cof B - B B^T B) / gap, k = (l^2 - 1)/2.
    gram = _matrix_product(b.transpose(1, 0, 2), b)
    r = 0.5 * (root * root + 1.0) * b + root * cofactor - _matrix_product(b, gram)
    r = r / np.maximum(gap, 1e-12)
    # One Newton-Schulz step squares the rounding error, which a small gap makes large.
    schulz = 0.5 * (r - _matrix_product(r, _matrix_product(r.transpose(1, 0, 2), r)))
    r = r + schulz
    step, definite = _newton_step(_matrix_product(r.transpose(1, 0, 2), b))
    # Both steps converge quadratically: after short steps the error is rounding, and a long step
    # shows that the root has not converged. The error after the second grows as the gap closes.
    converged = ((schulz * schulz).sum((0, 1)) < 1e-16) & ((step * step).sum(0) < 1e-14 * gap)
    # |B| = 1 bounds two factors of the gap by sqrt(2), so the third, s2 + s3, is over gap / 2.
    certain = definite & converged & (gap > 1e-7) & (0.5 * gap * norm * largest > error)
    turned = r + np.stack([_cross(r[i], step) for i in range(3)])
    return turned, certain


def characteristic_root(det: Floats, cofactor2: Floats) -> tuple[Floats, Floats]:
    """Return the largest root of Wahba's characteristic quartic, and the gap to the next one.

    The quartic of a matrix B with |B| = 1 is (l^2 - 1)^2 - 8 l det B - 4 |cof B|^2. Its roots are
    at most sqrt(3), from where Newton's method decreases monotonically.

    Parameters
    ----------
    det : ndarray, shape (B,)
    cofactor2 : ndarray, shape (B,)
        Sum of the squared cofactors.

    Returns
    -------
    root : ndarray, shape (B,)
    gap : ndarray, shape (B,)
        Slope at the root over 8: (s1 + s2)(s2 + s3)(s3 + s1) of the signed singular values, zero
        where the rotation is not unique.

    Examples
    --------
    >>> root, gap = characteristic_root(np.array([3**-1.5]), np.array([1 / 3]))  # B = 1/sqrt(3)
    >>> print(float(root.round(9)[0]), float(gap.round(3)[0]))
    1.732050808 1.54
    """
    root = np.full_like(det, np.sqrt(3.0))
    for _ in range(30):
        square = root * root - 1.0
        slope = 0.5 * root * square - det
        value = 0.125 * square * square - root * det - 0.5 * cofactor2
        change = value / np.maximum(slope, 1e-12)
        root = root - change
        # Near a double root convergence is slow; those rows fail the certificate and go to the SVD.
        if np.count_nonzero(np.abs(change) > 1e-9) <= change.size // 100:
            break
    return root, 0.5 * root * (root * root - 1.0) - det


def _newton_step(s: Floats) -> tuple[Floats, Bools]:
    """Solve (tr S - sym S) w = axial(S - S^T), S = R^T C; and report positive definiteness."""
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


def _matrix_product(a: Floats, b: Floats) -> Floats:
    """Multiply matrices with the batch last, (3, 3, B)."""
    product: Floats = a[:, 0, None] * b[0] + a[:, 1, None] * b[1] + a[:, 2, None] * b[2]
    return product


def _cross(a: Floats, b: Floats) -> Floats:
    """Return a x b of vectors with the batch last, (3, B)."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )
