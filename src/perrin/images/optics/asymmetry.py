"""Third moments and tilts of a point spread that is no even body of revolution."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from perrin._arrays import Bools, Floats

# Step of the finite differences of the image, in units of the blur along each axis.
_STEP = 0.1

# Where a table is divided by the height or by the distance from the axis, their least values in
# units of the blur: the quotient is even, and differs from its limit by the square of this.
_NEAR_AXIS = 0.1

# A component is used if it is this many standard errors of the noise from 0, and if it is not 0 at
# this level by its scatter between the samples.
FROM_NOISE, SAMPLES_LEVEL = 5.0, 1e-4


class Asymmetry(NamedTuple):
    """What distinguishes a point spread from a body of revolution that is even along z.

    With small values the image of a sphere changes by each of them times a derivative of the image.

    Attributes
    ----------
    zx, zy : float
        Covariances of z with x and y, um^2: the long axis of the point spread is tilted.
    ellipse, xy : float
        Half the difference of the variances along x and y, and their covariance, um^2: the point
        spread is elliptical in the plane.
    zzz, zrr : float
        Factors of -d^3/dz^3 and of -d/dz times the Laplacian in the plane, um^3: the point spread
        differs above and below the focus (spherical aberration, another refractive index).
    xrr, yrr, zzx, zzy : float
        Factors of -d/dx and -d/dy times the Laplacian in the plane, and times d^2/dz^2, um^3: the
        point spread has a tail to one side (coma).
    z_ellipse, zxy : float
        Factors of -d/dz times the derivatives of `ellipse` and `xy`, um^3: it is elliptical, with
        axes that change about at the focus (astigmatism).

    Examples
    --------
    >>> Asymmetry(zx=0.02).zx, Asymmetry() == Asymmetry(0.0)
    (0.02, True)
    """

    zx: float = 0.0
    zy: float = 0.0
    ellipse: float = 0.0
    xy: float = 0.0
    zzz: float = 0.0
    zrr: float = 0.0
    xrr: float = 0.0
    yrr: float = 0.0
    zzx: float = 0.0
    zzy: float = 0.0
    z_ellipse: float = 0.0
    zxy: float = 0.0

    @property
    def kinds(self) -> tuple[str, ...]:
        """What a microscopist calls the components that are not 0.

        Examples
        --------
        >>> Asymmetry(zy=0.02, xrr=0.001).kinds
        ('a tilted axis', 'a tail to one side (coma)')
        """
        named = {
            "a tilted axis": self[:2],
            "an elliptical section": self[2:4],
            "a difference above and below the focus (spherical aberration)": self[4:6],
            "a tail to one side (coma)": self[6:10],
            "an ellipse that turns at the focus (astigmatism)": self[10:],
        }
        return tuple(name for name, values in named.items() if any(values))


# Components that differ above and below the focus alone, and may change with the height.
ABOVE_FOCUS = [Asymmetry._fields.index(name) for name in ("zzz", "zrr")]

# The table of each component (see `asymmetry_tables`), its factor in the plane (see
# `plane_factors`), whether it is also multiplied by the height, and its sign.
_COMPONENTS = (
    *((0, 1, True, 1), (0, 2, True, 1), (1, 3, False, 1), (1, 4, False, 1)),
    *((2, 0, True, -1), (3, 0, True, -1), (4, 1, False, -1), (4, 2, False, -1)),
    *((5, 1, False, -1), (5, 2, False, -1), (6, 3, True, -1), (6, 4, True, -1)),
)


def asymmetry_tables(
    intensity: Callable[[Floats, Floats], Floats],
    z: Floats,
    rho: Floats,
    *,
    blur: tuple[float, float],
) -> Floats:
    """Return derivatives of an image, each over its polynomial, by height and distance.

    Parameters
    ----------
    intensity : callable
        The image (len(z), len(rho)), a body of revolution that is even along z.
    z, rho : ndarray
        Heights and distances from the axis, um, from 0 on.
    blur : tuple of float
        Blur (z, plane), um.

    Returns
    -------
    ndarray, shape (7, len(z), len(rho))
        Even along both axes.

    Examples
    --------
    >>> gauss = lambda z, rho: np.exp(-0.5 * (np.square(z)[:, None] + np.square(rho)))
    >>> tables = asymmetry_tables(gauss, np.array([0.0, 1.0]), np.array([0.0, 1.0]), blur=(1, 1))
    >>> tables[0].round(1)  # that of d^2/dx dz is x z times the image
    array([[1. , 0.6],
           [0.6, 0.4]])
    """
    a, h = _STEP * blur[0], _STEP * blur[1]
    z, rho = np.maximum(z, _NEAR_AXIS * blur[0]), np.maximum(rho, _NEAR_AXIS * blur[1])
    known: dict[tuple[int, int, int], Floats] = {}

    def f(up: int, out: int, across: int = 0) -> Floats:
        """Return the image at z + up a, x = rho + out h and y = across h."""
        key = up, out, across
        if key not in known:
            known[key] = intensity(np.abs(z + up * a), np.hypot(rho + out * h, across * h))
        return known[key]

    def laplacian(up: int, out: int) -> Floats:
        beside = f(up, out + 1) + f(up, out - 1) + 2 * f(up, out, 1)
        return np.asarray((beside - 4 * f(up, out)) / h**2)

    def ellipse(up: int) -> Floats:
        return np.asarray((f(up, 1) + f(up, -1) - 2 * f(up, 0, 1)) / (2 * h**2))

    def curved(out: int) -> Floats:
        return np.asarray((f(1, out) - 2 * f(0, out) + f(-1, out)) / a**2)

    high = z[:, None]
    return np.stack(
        [
            (f(1, 1) - f(1, -1) - f(-1, 1) + f(-1, -1)) / (4 * a * h) / (high * rho),
            ellipse(0) / rho**2,
            (f(2, 0) - 2 * f(1, 0) + 2 * f(-1, 0) - f(-2, 0)) / (2 * a**3) / high,
            (laplacian(1, 0) - laplacian(-1, 0)) / (2 * a) / high,
            (laplacian(0, 1) - laplacian(0, -1)) / (2 * h) / rho,
            (curved(1) - curved(-1)) / (2 * h) / rho,
            (ellipse(1) - ellipse(-1)) / (2 * a) / (high * rho**2),
        ]
    )


def plane_factors(y: Floats, x: Floats) -> Floats:
    """Return 1, x, y, x^2 - y^2 and 2 x y on the grid of y and x, um, (5, len(y) len(x)).

    Examples
    --------
    >>> plane_factors(np.array([3.0]), np.array([5.0])).ravel().tolist()
    [1.0, 5.0, 3.0, 16.0, 30.0]
    """
    wide, deep = (np.broadcast_to(v, (len(y), len(x))).ravel() for v in (x, y[:, None]))
    return np.stack([np.ones_like(wide), wide, deep, wide**2 - deep**2, 2 * wide * deep])


def change_of_image(
    asymmetry: Asymmetry, tables: Floats, *, along: Floats, across: Floats, z: Floats, plane: Floats
) -> Floats:
    """Return what an asymmetry adds to the image of a sphere, (len(z), m).

    Parameters
    ----------
    asymmetry : Asymmetry
    tables : ndarray, shape (7, a, b)
        Knots of the tables of `asymmetry_tables`.
    along, across : ndarray, shape (len(z), a), (m, b)
        Splines along the height and along the distance from the axis.
    z : ndarray
        Heights, um.
    plane : ndarray, shape (5, m)
        What `plane_factors` returns.

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> change_of_image(
    ...     Asymmetry(zzz=2.0, zrr=3.0),
    ...     np.ones((7, 1, 1)),
    ...     along=one,
    ...     across=one,
    ...     z=np.array([0.5]),
    ...     plane=np.ones((5, 1)),
    ... )
    array([[-2.5]])
    """
    sums: dict[int, Floats] = {}
    for value, (table, factor, odd, sign) in zip(asymmetry, _COMPONENTS, strict=True):
        if value:
            own = sign * value * (along @ tables[table])
            own = own * z[:, None] if odd else own
            sums[factor] = sums[factor] + own if factor in sums else own
    change = np.zeros((len(z), len(across)))
    for factor, profile in sums.items():
        change += (profile @ across.T) * plane[factor]
    return change


def component_images(
    tables: Floats, *, along: Floats, across: Floats, z: Floats, plane: Floats
) -> Floats:
    """Return the derivatives of an image by the components of an `Asymmetry`, (12, len(z), m).

    The parameters are those of `change_of_image`.

    Examples
    --------
    >>> one = np.ones((1, 1))
    >>> component_images(
    ...     np.ones((7, 1, 1)),
    ...     along=one,
    ...     across=one,
    ...     z=np.array([0.5]),
    ...     plane=np.arange(5.0)[:, None],
    ... )[:5].ravel().tolist()
    [0.5, 1.0, 3.0, 4.0, -0.0]
    """
    values = along @ tables @ across.T
    rows = [
        sign * values[table] * plane[factor] * (z[:, None] if odd else 1.0)
        for table, factor, odd, sign in _COMPONENTS
    ]
    return np.stack(rows)


def significant_sums(shares: Floats, variance: Floats) -> Bools:
    """Return which sums over samples are not 0, by their noise and by the scatter of the samples.

    Parameters
    ----------
    shares : ndarray, shape (N, k)
        What each of N samples adds to k sums.
    variance : ndarray, shape (k,)
        Variance of the sums by noise alone.

    Returns
    -------
    ndarray of bool, shape (k,)
        True beyond five standard errors of the noise and at a level of 1e-4 of Student's t of the
        samples; False where there is one sample.

    Examples
    --------
    >>> even, uneven = np.full(15, 0.6), np.where(np.arange(15) % 5, -0.4, 4.6)
    >>> significant_sums(np.stack([even, uneven], axis=1), np.ones(2))
    array([ True, False])
    """
    from scipy.special import stdtrit

    total, freedom = shares.sum(axis=0), len(shares) - 1
    if freedom < 1:
        return np.zeros(len(variance), dtype=np.bool_)
    scatter = np.sum((shares - total / len(shares)) ** 2, axis=0) * len(shares) / freedom
    by_noise = np.abs(total) > FROM_NOISE * np.sqrt(variance)
    by_scatter = np.abs(total) > stdtrit(freedom, 1 - SAMPLES_LEVEL / 2) * np.sqrt(scatter)
    return np.asarray(by_noise & by_scatter)
