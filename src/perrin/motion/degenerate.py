"""Clusters whose particles determine no orientation: tests, and errors that state the cause."""

from __future__ import annotations

import numpy as np

from perrin._arrays import Bools, Floats, present
from perrin.errors import DegenerateClusterError
from perrin.geometry.shapes import pair_distances

# Least standard deviation of a pair's distance over its mean at which a body is refused as not
# rigid: localisation errors are below a tenth of the distance of two spheres.
_DISTANCE_CHANGE = 0.2

# Least width of particles on a line over their localisation error at which the line is no effect of
# noise: noise alone keeps the width of the mean shape below 2, and sigma_z may be three times the
# sigma of a distance across it.
_LINE_WIDTH = 6.0

# Ratio of median absolute deviation and standard deviation of Gaussian numbers.
_MEDIAN_DEVIATION = 0.6745


def require_points(seen: Bools, d: int) -> None:
    """Raise an error where the particles are too few for a rotation, or one is never present.

    Parameters
    ----------
    seen : ndarray of bool, shape (T, n)
        Whether each particle is present.
    d : int
        Number of coordinates, 2 or 3.

    Raises
    ------
    DegenerateClusterError
        If there are fewer than d particles.
    ValueError
        If a particle is missing in every row.

    Examples
    --------
    >>> require_points(np.ones((2, 2), dtype=bool), 3)
    Traceback (most recent call last):
    perrin.errors.DegenerateClusterError: 2 particles: a rotation in 3 dimensions needs at least 3
    """
    n = seen.shape[1]
    if n < d:
        raise DegenerateClusterError(
            f"{n} particle{'s' if n != 1 else ''}: a rotation in {d} dimensions needs at least {d}",
            (n,),
        )
    never = np.flatnonzero(~seen.any(axis=0))
    if never.size:
        raise ValueError(
            f"particles {never.tolist()} are missing in every frame with a pose: leave them out"
        )


def no_rotation(x: Floats) -> DegenerateClusterError:
    """Return the error for frames that no rotation relates to each other, with its cause.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)

    Examples
    --------
    >>> print(no_rotation(np.zeros((5, 3, 2))))
    no rotation can be found: the 3 particles are in one place
    """
    _, n, d = x.shape
    seen = present(x).astype(np.float64)
    shared = seen @ seen[np.argmax(seen.sum(axis=1))]
    if np.sum(shared >= d) < 2:
        text = f"no frame shares {d} of the {n} particles with the frame that contains most of them"
    elif d == 2:
        text = f"the {n} particles are in one place"
    else:
        text = f"the {n} particles lie on one line"
    return DegenerateClusterError(
        f"no rotation can be found: {text}", (n,), collinear=text.endswith("line")
    )


def no_orientation(
    x: Floats, template: Floats, noise: float, lost: tuple[int, ...]
) -> DegenerateClusterError:
    """Return the error for a body of which no frame determines the orientation, with its cause.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
        Positions, um.
    template : ndarray, shape (n, d)
        The fitted common shape, um.
    noise : float
        Localisation error of one coordinate, um.
    lost : tuple of int
        Frames whose orientation is uncertain.

    Notes
    -----
    The cause is distances that change, or particles on a line. On a line the width of the shape is
    of the order of the localisation error that the steadiest distance shows: that distance scatters
    by sqrt(2) sigma, and half of the absolute deviations from the median are below 0.6745 of it.

    Examples
    --------
    >>> print(no_orientation(np.zeros((5, 3, 2)), np.zeros((3, 2)), 0.1, ()))
    the 3 particles are in one place within the noise: extent 0 um, localisation error 0.1 um
    """
    n, d = template.shape
    change, pair, scale = distance_change(x)
    extent = np.linalg.svd(template, compute_uv=False) / np.sqrt(n)
    rigid = change <= _DISTANCE_CHANGE
    if d == 3 and 0 < change <= _DISTANCE_CHANGE:
        distance = pair_distances(x)
        distance = distance[:, np.isfinite(distance).any(axis=0)]
        off = np.nanmedian(np.abs(distance - np.nanmedian(distance, axis=0)), axis=0)
        steadiest = float(off.min(initial=np.inf) / _MEDIAN_DEVIATION / np.sqrt(2))
        rigid = not extent[1] > _LINE_WIDTH * steadiest
    if not rigid:
        cause = (
            "more than one body under this number, or labels that change?"
            if scale is None
            else f"with z multiplied by {scale:.3g} all are constant: z is in another unit?"
        )
        return DegenerateClusterError(
            f"the {n} particles are no rigid body: the distance of particles {pair[0]} and "
            f"{pair[1]} (counted from 0) changes by {change:.0%} (standard deviation over mean): "
            f"{cause}",
            lost,
        )
    if d == 2:
        return DegenerateClusterError(
            f"the {n} particles are in one place within the noise: extent {extent[0]:.3g} um, "
            f"localisation error {noise:.3g} um",
            lost,
        )
    return DegenerateClusterError(
        f"the {n} particles lie on one line within the noise: length {extent[0]:.3g} um, width "
        f"{extent[1]:.3g} um (root mean squares), localisation error {noise:.3g} um",
        lost,
        collinear=True,
    )


def distance_change(x: Floats) -> tuple[float, tuple[int, int], float | None]:
    """Return the largest relative scatter of a pair's distance, the pair, and the scale of z.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
        Positions, NaN where missing.

    Returns
    -------
    change : float
        Standard deviation of the distance over its mean.
    pair : tuple of int
        Columns of the two particles.
    scale : float or None
        Factor on z with which the distances are constant within a tenth of their scatter; None
        where there is none.

    Notes
    -----
    The factor makes the squared distances most constant: of w . (x^2 + y^2, z^2) the ratio of mean
    square to variance is largest for the w of a generalised eigenvector.

    Examples
    --------
    >>> x = np.array([[[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [3.0, 0.0]]])
    >>> distance_change(x)
    (0.5, (0, 1), None)
    """
    i, j = np.triu_indices(x.shape[1], 1)
    distance = pair_distances(x)
    mean = mean_present(distance, axis=0)
    scatter = np.sqrt(mean_present((distance - mean) ** 2, axis=0))
    change = np.divide(scatter, mean, out=np.zeros_like(mean), where=mean > 0)
    k = int(np.argmax(np.nan_to_num(change)))
    worst, pair = float(np.nan_to_num(change)[k]), (int(i[k]), int(j[k]))
    if x.shape[2] == 2 or not worst > 0:
        return worst, pair, None
    square = (x[:, i] - x[:, j]) ** 2
    parts = np.stack([square[..., :2].sum(axis=2), square[..., 2]], axis=-1)
    middle = mean_present(parts, axis=0)
    off = (parts - middle)[np.isfinite(parts).all(axis=2)]
    variance, power = off.T @ off, middle.T @ middle
    if not np.linalg.cond(variance) < 1e12:
        return worst, pair, None
    value, vector = np.linalg.eig(np.linalg.solve(variance, power))
    w = vector[:, int(np.argmax(value.real))].real
    left = float(w @ variance @ w) / float(w @ power @ w)
    before = float(variance.sum()) / float(power.sum())
    if not (w[0] * w[1] > 0 and left < 0.01 * before):
        return worst, pair, None
    return worst, pair, float(np.sqrt(w[1] / w[0]))


def mean_present(x: Floats, *, axis: int) -> Floats:
    """Return the mean over the values of an axis that are not NaN; NaN where there are none.

    Examples
    --------
    >>> mean_present(np.array([[1.0, np.nan], [3.0, np.nan]]), axis=0)
    array([ 2., nan])
    """
    whole = x.sum(axis=axis)
    if x.shape[axis] and np.isfinite(whole).all():
        return np.asarray(whole / x.shape[axis])
    here = np.isfinite(x)
    count = here.sum(axis=axis)
    total = np.where(here, x, 0.0).sum(axis=axis)
    mean: Floats = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    return mean
