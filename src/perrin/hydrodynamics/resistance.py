"""What resistance a rigid body of spheres meets in a viscous fluid: Lamb's flows, least squares."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from perrin._arrays import Floats, frozen
from perrin.errors import PrecisionWarning
from perrin.geometry.rotations import skew

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray


# Surface points over a third of the unknowns, per sphere. At 2 the points add less to the error
# than the degree does, for touching spheres; at 3 the error falls by a tenth.
_OVERSAMPLING = 2.0


# A sphere of which less than this fraction shows is sampled no more densely.
_LEAST_EXPOSED = 0.05


_PROBES = 2000


# On normal equations with a unit diagonal. Flows about spheres deep inside each other nearly
# coincide; this shifts the forces by less than 1e-7 and keeps the factorisation positive.
_RIDGE = 1e-13


# Two degrees change at least 1.8 times the error that they leave where spheres are alike, 0.6 times
# it at radii 1:10 (benchmarks/mobility.py); this keeps the estimate above a third of the error.
_CHANGE = 0.75


# The antisymmetric part shows a third or less of the error that the surface points make where
# spheres overlap.
_ASYMMETRY = 3.0


# Degrees tried. Equal touching spheres end at 7, unequal ones higher.
_DEGREES = (5, 7, *range(8, 42, 2))


# Unknowns that a solution of rising degree may reach: a minute and half a gigabyte.
_MOST_UNKNOWNS = 7000


_BLOCK = 4_000_000


@dataclass(frozen=True, eq=False)
class Resistance:
    """Forces and torques on a rigid body that moves in a fluid of viscosity 1.

    Attributes
    ----------
    matrix : ndarray, shape (6, 6)
        (force, torque) = matrix (velocity, angular velocity) about the origin, symmetrised.
    degree : int
        Highest degree of the harmonics.
    asymmetry : float
        Antisymmetric part before symmetrisation, relative: reciprocity makes it 0.
    change : float
        Largest relative change of the resistance, over all directions of motion, from the solution
        two degrees lower (from degree 1 for degree 2, from degree 2 for degree 1).
    residual : float
        Root mean square velocity left over on the surface, relative, the worst of six motions.
    """

    matrix: Floats
    degree: int
    asymmetry: float
    change: float
    residual: float

    def __post_init__(self) -> None:
        frozen(self.matrix)

    @property
    def error(self) -> float:
        """Estimated relative error of the resistance in its worst direction of motion."""
        noise = float(np.finfo(np.float64).eps)
        return max(_CHANGE * self.change, _ASYMMETRY * self.asymmetry, noise)


@dataclass(frozen=True, eq=False)
class _Solution:
    """One least-squares solution: its raw 6x6 matrix and the rms of what is left over."""

    raw: Floats
    residual: float

    @property
    def matrix(self) -> Floats:
        """The symmetric part."""
        return 0.5 * (self.raw + self.raw.T)


def solve_resistance(centers: Floats, radii: Floats, *, degree: int) -> Resistance:
    """Solve for the resistance with harmonics up to `degree`, and estimate its error.

    Parameters
    ----------
    centers : ndarray, shape (n, 3)
    radii : ndarray, shape (n,)
        Spheres may touch or overlap.
    degree : int
        At least 1.

    Returns
    -------
    Resistance
        In powers of the unit of length: force L, torque L^3.

    Examples
    --------
    >>> sphere = solve_resistance(np.zeros((1, 3)), np.ones(1), degree=2)
    >>> (np.diag(sphere.matrix) / np.pi).round(6)
    array([6., 6., 6., 8., 8., 8.])
    """
    # Of degree 1 nothing lower exists; the step up from it is its error.
    other = _solve(centers, radii, max(degree - 2, 1) if degree > 1 else 2)
    return _compared(_solve(centers, radii, degree), other, degree)


def converge_resistance(centers: Floats, radii: Floats, *, accuracy: float) -> Resistance:
    """Raise the degree from 5 until the error estimate is under `accuracy`.

    Parameters
    ----------
    centers, radii
        As in `solve_resistance`.
    accuracy : float
        Relative.

    Returns
    -------
    Resistance

    Raises
    ------
    ValueError
        If there are more spheres than degree 5 can serve.

    Warns
    -----
    PrecisionWarning
        If the largest system that is tried does not reach `accuracy`.
    """
    lowest = _DEGREES[0]
    most = _MOST_UNKNOWNS // _unknowns(lowest)
    if len(centers) > most:
        raise ValueError(
            f"centers: {len(centers)} spheres; up to {most} are served with an error estimate; "
            f"state a degree (1 to {lowest - 1}) for more"
        )
    solved = {lowest - 2: _solve(centers, radii, lowest - 2)}
    for degree, further in pairwise(_DEGREES):
        for needed in (degree - 2, degree):
            if needed not in solved:
                solved[needed] = _solve(centers, radii, needed)
        result = _compared(solved[degree], solved[degree - 2], degree)
        if result.error <= accuracy:
            return result
        if _unknowns(further) * len(centers) > _MOST_UNKNOWNS:
            break
    warnings.warn(
        f"degree {degree} leaves a relative error of {result.error:.1e}, above {accuracy:.1e}; "
        "state a higher degree if that matters",
        PrecisionWarning,
        stacklevel=3,
    )
    return result


def _unknowns(degree: int) -> int:
    """Count the flows about one sphere: three kinds, degree 1 to `degree`, all orders."""
    return 3 * degree * (degree + 2)


def _compared(solution: _Solution, other: _Solution, degree: int) -> Resistance:
    """Measure reciprocity and the change between two solutions in every direction of motion.

    Both are relative to the dissipation of a motion, so that no unit and no point of reference
    enters.
    """
    from scipy.linalg import eigh

    matrix = solution.matrix
    whiten = np.linalg.inv(np.linalg.cholesky(matrix))
    odd = whiten @ (0.5 * (solution.raw - solution.raw.T)) @ whiten.T
    ratio = eigh(other.matrix, matrix, eigvals_only=True)
    return Resistance(
        matrix=matrix,
        degree=degree,
        asymmetry=float(np.linalg.norm(odd, 2)),
        change=float(np.abs(ratio - 1).max()),
        residual=solution.residual,
    )


def _solve(centers: Floats, radii: Floats, degree: int) -> _Solution:
    """Fit the flows of all spheres to rigid motion on the surface and add up their forces."""
    from scipy.linalg import cho_factor, cho_solve

    points, weight, shows = _surface(centers, radii, degree)
    spheres = list(zip(centers[shows], radii[shows], strict=True))
    normal, right, power = _normal_equations(spheres, points, weight, degree)
    scale = 1 / np.sqrt(np.diag(normal))
    normal *= scale[:, None]
    normal *= scale
    normal[np.diag_indices(len(normal))] += _RIDGE
    right *= scale[:, None]
    factor = cho_factor(normal, lower=True, overwrite_a=True, check_finite=False)
    strength = cho_solve(factor, right, check_finite=False)
    # Rounding may leave a residual of -1e-16 where the fit is exact, as for one sphere.
    left = np.maximum(1 - np.sum(right * strength, axis=0) / power, 0.0)
    raw = _forces(spheres, degree) @ (scale[:, None] * strength)
    return _Solution(raw, float(np.sqrt(left.max())))


def _normal_equations(
    spheres: list[tuple[Floats, float]], points: Floats, weight: Floats, degree: int
) -> tuple[Floats, Floats, Floats]:
    """Return products of all flows with each other and with the six motions, and the motions' own.

    The flows are nearly orthogonal, so that normal equations are as good as a QR factorisation, and
    several times faster.
    """
    size = _unknowns(degree) * len(spheres)
    normal, right, power = np.zeros((size, size)), np.zeros((size, 6)), np.zeros(6)
    for rows in _blocks(len(points), size):
        at, root = points[rows], np.sqrt(weight[rows])
        flow = np.concatenate([_flows((at - c) / a, degree) for c, a in spheres])
        flow = (flow * root).reshape(size, -1)
        wanted = (_rigid_motions(at) * root).reshape(6, -1).T
        normal += flow @ flow.T
        right += flow @ wanted
        power += np.sum(wanted**2, axis=0)
    return normal, right, power


def _blocks(count: int, width: int) -> Iterator[slice]:
    """Cut the surface points into pieces whose flows fit into a moderate memory."""
    step = max(1, _BLOCK // (3 * width))
    return (slice(start, start + step) for start in range(0, count, step))


def _surface(
    centers: Floats, radii: Floats, degree: int
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return points on the outer surface, the weight of each, and which spheres show at all."""
    points, weights, shows = [], [], np.ones(len(centers), dtype=np.bool_)
    for i, (center, radius) in enumerate(zip(centers, radii, strict=True)):
        distance = np.linalg.norm(centers - center, axis=1)
        near = (distance < radii + radius) & (np.arange(len(centers)) != i)
        covers = list(zip(centers[near], radii[near], strict=True))
        fraction = _exposed(center, radius, covers, _PROBES)[1] if covers else 1.0
        if fraction == 0:
            shows[i] = False
            continue
        wanted = _OVERSAMPLING * _unknowns(degree) / 3
        count = int(np.ceil(wanted / max(fraction, _LEAST_EXPOSED)))
        at = _exposed(center, radius, covers, count)[0]
        points.append(at)
        weights.append(np.full(len(at), 1 / count))
    return np.concatenate(points), np.concatenate(weights), shows


def _exposed(
    center: Floats, radius: float, covers: list[tuple[Floats, float]], count: int
) -> tuple[Floats, float]:
    """Return those of `count` even points on a sphere outside its neighbours, and their share."""
    points = center + radius * even_directions(count)
    outside = np.ones(count, dtype=np.bool_)
    for at, reach in covers:
        outside &= np.sum((points - at) ** 2, axis=1) >= reach**2 * (1 - 1e-9)
    return points[outside], float(outside.mean())


def exposed_surface(centers: Floats, radii: Floats, *, count: int) -> Iterator[tuple[int, Floats]]:
    """Yield, sphere by sphere, its number and those of `count` even points that show.

    Parameters
    ----------
    centers : ndarray, shape (n, 3)
    radii : ndarray, shape (n,)
    count : int
        Points on a whole sphere.
    """
    for i, (center, radius) in enumerate(zip(centers, radii, strict=True)):
        others = [(centers[j], radii[j]) for j in range(len(centers)) if j != i]
        yield i, _exposed(center, radius, others, count)[0]


def even_directions(count: int) -> Floats:
    """Return `count` nearly even directions: the golden-angle spiral, equal steps in z.

    Examples
    --------
    >>> even_directions(2).round(3)
    array([[ 0.314, -0.807,  0.5  ],
           [-0.777,  0.383, -0.5  ]])
    """
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def _rigid_motions(points: Floats) -> Floats:
    """Return the velocities (6, 3, P) of unit translations, and of unit rotations about 0."""
    shift = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, len(points)))
    # The columns of -[r]x are e_k x r.
    turn = np.moveaxis(-skew(points), 0, -1).swapaxes(0, 1)
    return np.concatenate([shift, turn])


def _flows(x: Floats, degree: int) -> Floats:
    """Return Lamb's flows outside a unit sphere, shape (3 degree (degree + 2), 3, P).

    With a solid harmonic J of degree -(n + 1) they are a flow with pressure J,
    (n + 1)/(n(2n - 1)) r J - (n - 2)/(2n(2n - 1)) r^2 grad J, the potential flow grad J, and the
    toroidal flow grad J x r (Lamb, Hydrodynamics, art. 336; Happel and Brenner, section 3-2).
    """
    n, m = _orders(degree)
    harmonic = _solid_harmonics(x, degree + 1)
    J = harmonic[n, m]
    # (d/dx + i d/dy) J, (d/dx - i d/dy) J and d/dz J are harmonics one degree on.
    up, along = -harmonic[n + 1, m + 1], -harmonic[n + 1, m]
    down = np.where((m > 0)[:, None], harmonic[n + 1, np.abs(m - 1)], up.conj())
    gradient = np.stack([0.5 * (up + down), -0.5j * (up - down), along], axis=1)
    r2 = np.sum(x**2, axis=1)
    radial = ((n + 1) / (n * (2 * n - 1)))[:, None] * J
    inward = ((n - 2) / (2 * n * (2 * n - 1)))[:, None] * r2
    pressure = radial[:, None] * x.T - inward[:, None] * gradient
    toroidal = np.cross(gradient, x.T[None], axis=1)
    flow = np.concatenate([pressure, gradient, toroidal])
    return np.concatenate([flow.real, flow.imag[np.tile(m, 3) > 0]])


def _orders(degree: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return degree n and order m >= 0 of the complex harmonics, n = 1 to `degree`."""
    pairs = [(n, m) for n in range(1, degree + 1) for m in range(n + 1)]
    n, m = np.array(pairs, dtype=np.int64).T
    return n, m


def _solid_harmonics(x: Floats, degree: int) -> NDArray[np.complex128]:
    """Return (n - m)! P_n^m(cos theta) exp(i m phi)/r^(n + 1), shape (degree + 1, degree + 1, P).

    In this norm, and without the sign (-1)^m, derivatives are harmonics without factors.
    """
    r2 = np.sum(x**2, axis=1)
    sideways, upward = (x[:, 0] + 1j * x[:, 1]) / r2, x[:, 2] / r2
    value = np.zeros((degree + 1, degree + 1, len(x)), dtype=np.complex128)
    value[0, 0] = 1 / np.sqrt(r2)
    for n in range(1, degree + 1):
        value[n, n] = (2 * n - 1) * sideways * value[n - 1, n - 1]
        value[n, :n] = (2 * n - 1) * upward * value[n - 1, :n]
        if n > 1:
            m = np.arange(n)[:, None]
            value[n, :n] -= ((n - 1) ** 2 - m**2) / r2 * value[n - 2, :n]
    return value


def _forces(spheres: list[tuple[Floats, float]], degree: int) -> Floats:
    """Return force and torque about the origin that each flow takes, shape (6, unknowns).

    Of a flow with pressure x/r^3 about a sphere of radius a the force is 4 pi a, of the toroidal
    flow of x/r^3 the torque 8 pi a^2; all others take none.
    """
    whole = degree * (degree + 3) // 2  # complex harmonics, whose real parts come first
    part = degree * (degree + 1) // 2  # those with an imaginary part
    # Places of the real and imaginary part of order 1 and of order 0: the x, y and z directions.
    pressure = np.array([1, 3 * whole, 0])
    toroidal = np.array([2 * whole + 1, 3 * whole + 2 * part, 2 * whole])
    width = _unknowns(degree)
    force = np.zeros((6, width * len(spheres)))
    for j, (center, radius) in enumerate(spheres):
        force[:3, j * width + pressure] = 4 * np.pi * radius * np.eye(3)
        force[3:, j * width + pressure] = 4 * np.pi * radius * skew(center)
        force[3:, j * width + toroidal] = 8 * np.pi * radius**2 * np.eye(3)
    return force
