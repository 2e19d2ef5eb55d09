"""Position and orientation of one rigid cluster in every frame."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import (
    Bools,
    Floats,
    Ints,
    choice_fault,
    from_plain,
    frozen,
    number_fault,
    refuse,
    require_positive,
    to_plain,
)
from perrin._display import Shown
from perrin.errors import TooFewFramesError
from perrin.geometry.rotations import log_map, skew
from perrin.geometry.shapes import lengths
from perrin.geometry.symmetry import (
    are_collinear,
    point_group,
    schoenflies,
    symmetry_elements_of_each,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import pandas as pd
    from scipy.spatial.transform import Rotation

# Apparent D_R dt of a tetrahedron at rest, over (sigma/R)^4.
_RESTING_DIFFUSION = 0.04

# Nodes of the nominal template of a body whose particles are not known.
_UNEVEN_POINTS = (0.0, 1.0, 2.0, 4.0, 7.0)

# Distances of particles of bodies whose symmetries are searched for at once: bounds the memory.
_MOST_COMPARED = 1_000_000

# Steps whose rotation vectors are found at once: more do not stay in the processor's cache.
_VECTORS_TOGETHER = 4_000

_ROTATION_ERROR = 1e-5  # largest departure of R^T R from the identity

_WHOLE_NUMBERS = ("n_present", "piece")


@dataclass(frozen=True, eq=False)
class RigidMotion(Shown):
    """Position and orientation of one rigid cluster in every frame; missing frames are NaN.

    Attributes
    ----------
    time : ndarray, shape (T,)
        Time of each frame, s.
    center : ndarray, shape (T, d)
        Centre of the whole template, um.
    rotation : ndarray, shape (T, d, d)
        Lab from body, ``x = R x0``; the identity at the first fitted frame.
    residual : ndarray, shape (T,)
        Root mean square distance of the particles present to the fitted body, um. For
        ``reference="previous"`` the residual of the step that ends here, over sqrt(2).
    n_present : ndarray of int, shape (T,)
        Number of particles present.
    covariance : ndarray, shape (T, 3, 3) or (T, 1, 1)
        Covariance of the fitted orientation, rad^2, body axes.
    center_variance : ndarray, shape (T,)
        Variance of the centre from localisation error, um^2, mean over axes.
    piece : ndarray of int, shape (T,)
        Number of the track piece that the frame belongs to. Within a piece the identity of the
        particles is certain; no pair of frames is formed across two pieces.
    reason : tuple of str, length T
        Reason why a frame has no pose; empty where it has one.
    template : ndarray, shape (n, d)
        Particles of the common shape, um, their centre at the origin.
    sigma : float
        Localisation error of one coordinate from the rigid-fit residuals, um.
    noise : ndarray, shape (d,)
        Localisation error of each lab axis that `covariance` and `center_variance` assume, um: the
        known one where it was given, else sigma.
    dt : float
        Time between frames, s.
    turn_noise : ndarray, shape (T, 3, 3) or (T, 1, 1), or None
        Covariance that the orientations' errors add to steps, rad^2, where particles were recorded
        at different times (`track_rotation` with `delays`); None where it is `covariance`.
    shift_noise : ndarray, shape (T,), or None
        The same for the centre, um^2; None where it is `center_variance`. Negative where averaging
        over the scan makes steps shorter.
    """

    time: Floats
    center: Floats
    rotation: Floats
    residual: Floats
    n_present: Ints
    covariance: Floats
    center_variance: Floats
    piece: Ints
    reason: tuple[str, ...]
    template: Floats
    sigma: float
    noise: Floats
    dt: float
    turn_noise: Floats | None = None
    shift_noise: Floats | None = None

    def __post_init__(self) -> None:
        frozen(self.time, self.center, self.rotation, self.residual, self.n_present)
        frozen(*(x for x in (self.turn_noise, self.shift_noise) if x is not None))
        frozen(self.covariance, self.center_variance, self.piece, self.template, self.noise)

    def __repr__(self) -> str:
        n, d = self.template.shape
        return (
            f"RigidMotion(n={n}, d={d}, {self.fitted.size} of {len(self.time)} frames, "
            f"dt={self.dt:g} s, sigma={self.sigma:.3g} um)"
        )

    @property
    def dimension(self) -> int:
        """Number of coordinates of a point: 2 or 3."""
        return int(self.template.shape[1])

    @cached_property
    def fitted(self) -> Ints:
        """Indices of the frames that have a pose."""
        rows = np.flatnonzero(np.isfinite(self.center[:, 0]))
        frozen(rows)
        return rows

    @cached_property
    def R(self) -> float:
        """Mean distance of the particles to the centre, um."""
        return float(lengths(self.template).mean())

    @cached_property
    def template_error(self) -> float:
        """Bound of the error of the template's positions, um.

        Six standard errors, the second-order inflation of the shape by noise, and rounding. Where
        particles are recorded at different times, the errors of the poses are in the shape too.
        """
        square = self.sigma**2
        if self.turn_noise is not None:
            turn = np.trace(self.covariance[self.fitted], axis1=1, axis2=2).mean()
            square += self.R**2 * turn / 3 + self.center_variance[self.fitted].mean()
        first_order = 6 * np.sqrt(square / self.fitted.size)
        return float(first_order + 2 * self.sigma**2 / self.R + 1e-6 * self.R)

    @cached_property
    def symmetry_elements(self) -> Floats | None:
        """The point group of the template within its error, as orthogonal matrices (g, 3, 3).

        None in the plane and for particles on one line.
        """
        find_symmetries([self])
        found: Floats | None = vars(self)["symmetry_elements"]
        return found

    @cached_property
    def point_group(self) -> str:
        """The point group of the template within its error (Schoenflies symbol)."""
        find_symmetries([self])
        found: str = vars(self)["point_group"]
        return found

    @cached_property
    def usual_interval(self) -> float:
        """The median time between neighbouring poses of one piece, s; dt where there is no step."""
        start, stop = self.steps()
        interval = np.sort(self.time[stop] - self.time[start])
        middle = interval[[(start.size - 1) // 2, start.size // 2]] if start.size else self.dt
        return float(np.mean(middle))

    @property
    def step_covariance(self) -> Floats:
        """What the error of every orientation adds to the covariance of steps, rad^2, (T, a, a)."""
        return self.covariance if self.turn_noise is None else self.turn_noise

    @property
    def step_center_variance(self) -> Floats:
        """What the error of every centre adds to the variance of steps, um^2, (T,)."""
        return self.center_variance if self.shift_noise is None else self.shift_noise

    @cached_property
    def orientation_noise(self) -> Floats:
        """The noise of one orientation, mean over the ends of all steps, rad^2, (3, 3)."""
        rows = np.concatenate(self.steps())
        rows = rows if rows.size else self.fitted
        used, number = np.unique(rows, return_counts=True)
        covariance = self.step_covariance
        covariance = covariance if used.size == len(covariance) else covariance[used]
        mean = np.asarray(np.einsum("t,tij->ij", number / rows.size, covariance))
        frozen(mean)
        return mean

    @property
    def center_noise(self) -> float:
        """The noise variance of one centre coordinate, mean over the ends of all steps, um^2."""
        rows = np.concatenate(self.steps())
        return float(self.step_center_variance[rows if rows.size else self.fitted].mean())

    @property
    def resolution_floor(self) -> float:
        """The apparent D_R of a motionless cluster, rad^2/s.

        The sum of noisy body-frame steps diffuses at second order in the noise: a tetrahedron at
        rest has the apparent D_R 0.04 (sigma/R)^4/dt.
        """
        return float(_RESTING_DIFFUSION * (self.sigma / self.R) ** 4 / self.usual_interval)

    def steps(self) -> tuple[Ints, Ints]:
        """Return the first and last frame index of every step between neighbouring poses.

        A gap is one longer step; no step joins two pieces.
        """
        return self._step_ends

    @cached_property
    def _step_ends(self) -> tuple[Ints, Ints]:
        rows = self.fitted
        start, stop = rows[:-1], rows[1:]
        same = self.piece[start] == self.piece[stop]
        ends = start[same], stop[same]
        frozen(*ends)
        return ends

    def step_vectors(self) -> Floats:
        """Return the body-frame rotation vector of every step, log(R_k^T R_{k+1}).

        Returns
        -------
        ndarray, shape (T - 1, 3) or (T - 1, 1)
            Row k is the rotation (rad) that ends at frame k + 1, from the last pose before it; NaN
            where frame k + 1 has no pose or begins a piece.
        """
        if "_step_vectors" not in vars(self):
            find_step_vectors([self])
        found: Floats = vars(self)["_step_vectors"]
        return found

    def orientation(self, p0: ArrayLike) -> Floats:
        """Follow body-fixed directions through time (Hunter 2011, Eq. 17).

        Parameters
        ----------
        p0 : array_like, shape (d,) or (K, d)
            Directions at the first fitted frame; any length but zero.

        Returns
        -------
        ndarray, shape (T, d) or (T, K, d)
            Unit vectors in the lab frame.
        """
        p = np.atleast_1d(np.asarray(p0, dtype=np.float64))
        d = self.dimension
        length = np.linalg.norm(p, axis=-1, keepdims=True)
        if p.ndim > 2 or p.shape[-1] != d or not np.all((length > 0) & (length < np.inf)):
            raise ValueError(f"p0: expected directions ({d},) or (K, {d}), none zero, got {p0!r}")
        turned = self.rotation.reshape(-1, d) @ (p / length).T
        return np.asarray(np.moveaxis(turned.reshape(-1, d, *p.shape[:-1]), 1, -1))

    def rotational_displacement(self, p0: ArrayLike) -> Floats:
        """Integrate the unbounded vector angle phi of body-fixed directions (Hunter 2011, Eq. 18).

        Each step adds a vector along p(t) x p(t + dt) as long as the angle between the two,
        by arctan2 of cross and dot product. A gap is crossed by the one direct rotation between
        its ends; phi starts at 0 in every piece.

        Parameters
        ----------
        p0 : array_like, shape (d,) or (K, d)
            Directions at the first fitted frame.

        Returns
        -------
        ndarray, shape (T, 3) or (T, K, 3); in the plane (T, 1) or (T, K, 1)
            Rotation vectors, rad, lab axes.
        """
        p = self.orientation(p0)
        start, stop = self.steps()
        before, after = p[start], p[stop]
        dot = np.sum(before * after, axis=-1, keepdims=True)
        if self.dimension == 2:
            cross = before[..., :1] * after[..., 1:] - before[..., 1:] * after[..., :1]
            return self._summed(np.arctan2(cross, dot))
        normal = np.cross(before, after)
        sine = np.linalg.norm(normal, axis=-1, keepdims=True)
        axis = np.divide(normal, sine, out=np.zeros_like(normal), where=sine > 0)
        opposite = (sine < 1e-12 * -dot) & (dot < 0)
        if opposite.any():
            # p(t) and p(t + dt) = -p(t) span no plane, or one of rounding: the axis is that of the
            # rotation itself.
            step = self.rotation[stop] @ np.swapaxes(self.rotation[start], -1, -2)
            own = (log_map(step) / np.pi).reshape(len(step), *[1] * (p.ndim - 2), 3)
            axis = np.where(opposite, own, axis)
        return self._summed(np.arctan2(sine, dot) * axis)

    def accumulated_rotation(self, *, axes: Literal["lab", "body"] = "lab") -> Floats:
        """Add up the rotation vectors of all steps (Hunter 2011, appendix).

        Parameters
        ----------
        axes : {"lab", "body"}
            Axes of the components. In body axes each component is the sum of the rotations about
            one axis of the cluster, which has its own diffusion coefficient.

        Returns
        -------
        ndarray, shape (T, 3); in the plane (T, 1)
            Accumulated rotation, rad; 0 at the beginning of every piece, NaN in frames without a
            pose.
        """
        start, stop = self.steps()
        before, after = self.rotation[start], self.rotation[stop]
        if axes == "body":
            return self._summed(log_map(np.swapaxes(before, -1, -2) @ after))
        return self._summed(log_map(after @ np.swapaxes(before, -1, -2)))

    def _summed(self, steps: Floats) -> Floats:
        """Sum the vectors of all steps (S, ..., c) to a walk that starts at 0 in every piece."""
        _, stop = self.steps()
        walk = np.full((len(self.time), *steps.shape[1:]), np.nan)
        walk[self.fitted] = 0.0
        walk[stop] = steps
        total = np.cumsum(walk[self.fitted], axis=0)
        first = np.isin(self.fitted, stop, invert=True)
        origin = np.maximum.accumulate(np.where(first, np.arange(first.size), 0))
        walk[self.fitted] = total - total[origin]
        return walk

    def positions(self) -> Floats:
        """Return the particles of the rigid body in the lab frame, (T, n, d), um."""
        turned = np.einsum("tij,nj->tni", self.rotation, self.template)
        return np.asarray(turned + self.center[:, None])

    def as_scipy(self) -> tuple[Rotation, Ints]:
        """Return the fitted rotations as a scipy `Rotation`, and their frame indices."""
        from scipy.spatial.transform import Rotation

        if self.dimension == 2:
            raise ValueError("scipy rotations are three-dimensional; this motion is in the plane")
        return Rotation.from_matrix(self.rotation[self.fitted]), self.fitted

    def to_frame(self) -> pd.DataFrame:
        """Return a table with a row per frame; template, sigma, noise and dt are in ``attrs``."""
        import pandas as pd

        axes = "xyz"[: self.dimension]
        columns: dict[str, object] = {"time": self.time}
        columns |= {a: self.center[:, i] for i, a in enumerate(axes)}
        columns |= {
            f"r_{a}{b}": self.rotation[:, i, j]
            for i, a in enumerate(axes)
            for j, b in enumerate(axes)
        }
        columns |= {"residual": self.residual, "n_present": self.n_present}
        angles = "xyz" if len(axes) == 3 else "z"
        columns |= {
            f"cov_{a}{b}": self.covariance[:, i, j]
            for i, a in enumerate(angles)
            for j, b in enumerate(angles)
            if j >= i
        }
        columns |= {"center_variance": self.center_variance, "piece": self.piece}
        if self.turn_noise is not None:
            columns |= {
                f"step_cov_{a}{b}": self.turn_noise[:, i, j]
                for i, a in enumerate(angles)
                for j, b in enumerate(angles)
                if j >= i
            }
        if self.shift_noise is not None:
            columns["step_center_variance"] = self.shift_noise
        columns |= {"reason": list(self.reason)}
        table = pd.DataFrame(columns)
        table.attrs = {"template": self.template.tolist(), "sigma": self.sigma, "dt": self.dt}
        table.attrs["noise"] = self.noise.tolist()
        return table

    @classmethod
    def from_frame(cls, table: pd.DataFrame) -> RigidMotion:
        """Return the motion that `to_frame` wrote.

        Parameters
        ----------
        table : DataFrame

        Raises
        ------
        ValueError
            If ``attrs`` lacks the template, sigma, noise or dt, or a column is missing.
        """
        missing = sorted({"template", "sigma", "noise", "dt"} - set(table.attrs))
        if missing:
            raise ValueError(f"this table was not made by to_frame: attrs lack {missing}")
        template = np.array(table.attrs["template"], dtype=np.float64)
        axes = "xyz"[: template.shape[1]]
        angles = "xyz" if len(axes) == 3 else "z"
        rotation = [[f"r_{a}{b}" for b in axes] for a in axes]
        covariance = [[f"cov_{min(a, b)}{max(a, b)}" for b in angles] for a in angles]
        step_noise = [[f"step_{name}" for name in row] for row in covariance]
        plain = ("time", *axes, "residual", "n_present", "center_variance", "piece", "reason")
        matrix = {name for row in (*rotation, *covariance) for name in row}
        missing = sorted({*plain, *matrix} - set(table))
        if missing:
            raise ValueError(f"this table was not made by to_frame: it lacks the columns {missing}")

        def matrices(names: list[list[str]]) -> Floats:
            rows = [[np.array(table[name], dtype=np.float64) for name in row] for row in names]
            return np.moveaxis(np.array(rows), -1, 0).copy()

        return cls(
            time=np.array(table["time"], dtype=np.float64),
            center=np.stack([np.array(table[a], dtype=np.float64) for a in axes], axis=1),
            rotation=matrices(rotation),
            residual=np.array(table["residual"], dtype=np.float64),
            n_present=np.array(table["n_present"], dtype=np.int64),
            covariance=matrices(covariance),
            center_variance=np.array(table["center_variance"], dtype=np.float64),
            piece=np.array(table["piece"], dtype=np.int64),
            reason=tuple(np.array(table["reason"], dtype=str).tolist()),
            template=template,
            sigma=float(table.attrs["sigma"]),
            noise=np.array(table.attrs["noise"], dtype=np.float64),
            dt=float(table.attrs["dt"]),
            turn_noise=matrices(step_noise) if step_noise[0][0] in table else None,
            shift_noise=np.array(table["step_center_variance"], dtype=np.float64)
            if "step_center_variance" in table
            else None,
        )

    @classmethod
    def from_rotations(
        cls,
        rotations: ArrayLike | Rotation,
        centers: ArrayLike | None = None,
        *,
        dt: float,
        sigma: float = 0.0,
        center_sigma: float = 0.0,
        order: Literal["xyzw", "wxyz"] | None = None,
    ) -> RigidMotion:
        """Return the motion of a body whose orientations are known, without its particles.

        Parameters
        ----------
        rotations : array_like, shape (T, d, d) or (T, 4), or scipy Rotation
            Lab from body, in every frame: matrices, d = 2 or 3, or quaternions of any length but
            zero. A frame with a NaN has no pose.
        centers : array_like, shape (T, d), optional
            Centre in every frame, um. Without it the body turns on the spot.
        dt : float
            Time between frames, s.
        sigma : float
            Standard error of one orientation about each axis, rad.
        center_sigma : float
            Standard error of one coordinate of the centre, um.
        order : {"xyzw", "wxyz"}, optional
            Order of the components of quaternions, with the scalar w last (scipy) or first. It must
            be stated for quaternions.

        Returns
        -------
        RigidMotion
            Its body axes are those of the lab at the first frame with a pose. Its template is five
            nominal points without symmetry at a mean distance of 1 um, whose localisation error
            `RigidMotion.sigma` makes orientations as uncertain as stated, so that no symmetry of
            the body is assumed. It has no residuals.

        Raises
        ------
        ValueError
            If shapes do not fit, a matrix is no proper rotation, the order of quaternions is
            missing, fewer than two frames have a pose, or a number is out of range.

        Examples
        --------
        >>> from perrin import RigidMotion
        >>> quarter = [[0, 0, 0, 1], [0, 0, 1, 1], [0, 0, 1, 0]]
        >>> RigidMotion.from_rotations(quarter, dt=0.5, order="xyzw").rotation[1].round(3)
        array([[ 0., -1.,  0.],
               [ 1.,  0.,  0.],
               [ 0.,  0.,  1.]])
        """
        require_positive(dt=dt)
        named = {"sigma": sigma, "center_sigma": center_sigma}
        refuse(f for k, x in named.items() for f in number_fault(k, x, least=0.0))
        given = _rotation_matrices(rotations, order)
        count, d = given.shape[:2]
        center = np.zeros((count, d)) if centers is None else np.array(centers, dtype=np.float64)
        if center.shape != (count, d):
            raise ValueError(
                f"centers: expected the shape ({count}, {d}) of the rotations, got {center.shape}"
            )
        known = np.isfinite(given).all(axis=(1, 2)) & np.isfinite(center).all(axis=1)
        lost: Bools = np.asarray(~known, dtype=np.bool_)
        rows = np.flatnonzero(~lost)
        if rows.size < 2:
            raise TooFewFramesError(
                f"{rows.size} of {count} frames have a rotation: two or more are needed", rows.size
            )
        rotation = given @ given[rows[0]].T
        rotation[lost], center[lost] = np.nan, np.nan
        # Orthogonal polynomials over uneven points: equal moments along all axes, no symmetry.
        basis = np.linalg.qr(np.vander(_UNEVEN_POINTS, d + 1, increasing=True))[0][:, 1:]
        size = 1 / np.linalg.norm(basis, axis=1).mean()
        # Both in the plane and in space the moment of inertia is 2 size^2 about every axis.
        error = float(np.sqrt(2) * size * sigma)
        angles = 1 if d == 2 else 3
        return cls(
            time=float(dt) * np.arange(count, dtype=np.float64),
            center=center,
            rotation=rotation,
            residual=np.where(lost, np.nan, 0.0),
            n_present=np.where(lost, 0, len(basis)).astype(np.int64),
            covariance=np.where(lost[:, None, None], np.nan, sigma**2 * np.eye(angles)),
            center_variance=np.where(lost, np.nan, center_sigma**2),
            piece=np.zeros(count, dtype=np.int64),
            reason=tuple("no rotation was given" if gone else "" for gone in lost.tolist()),
            template=size * basis,
            sigma=error,
            noise=np.full(d, error),
            dt=float(dt),
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the motion for JSON: lists for arrays, None for NaN."""
        return {field.name: to_plain(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> RigidMotion:
        """Return the motion that `to_dict` wrote.

        Parameters
        ----------
        entry : dict

        Examples
        --------
        >>> from perrin import Cluster, simulate_motion
        >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.01, dt=0.5, n_frames=9, rng=1)
        >>> RigidMotion.from_dict(truth.to_dict())
        RigidMotion(n=4, d=3, 9 of 9 frames, dt=0.5 s, sigma=0 um)
        """
        arrays = {
            name: from_plain(value, dtype=np.int64 if name in _WHOLE_NUMBERS else np.float64)
            for name, value in entry.items()
            if name not in ("reason", "sigma", "dt") and value is not None
        }
        sigma, dt = (float(from_plain(entry[name])) for name in ("sigma", "dt"))
        return cls(reason=tuple(entry["reason"]), sigma=sigma, dt=dt, **arrays)


def find_symmetries(motions: Iterable[RigidMotion]) -> None:
    """Find the point groups of several bodies together.

    They become `RigidMotion.symmetry_elements` and `RigidMotion.point_group` of each.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> find_symmetries([truth])
    >>> truth.symmetry_elements.shape, truth.point_group
    ((24, 3, 3), 'T_d')
    """
    alike: dict[tuple[int, ...], list[RigidMotion]] = {}
    for motion in motions:
        alike.setdefault(motion.template.shape, []).append(motion)
    for (n, _), bodies in alike.items():
        at_once = max(1, _MOST_COMPARED // n**4)
        for low in range(0, len(bodies), at_once):
            _find_symmetries_together(bodies[low : low + at_once])


def find_step_vectors(motions: Sequence[RigidMotion]) -> None:
    """Find the rotation vectors of the steps of several bodies together.

    They become what `RigidMotion.step_vectors` of each returns.

    Parameters
    ----------
    motions : sequence of RigidMotion
        All in space, or all in the plane.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> find_step_vectors([truth])
    >>> truth.step_vectors().shape
    (8, 3)
    """
    at_once = max(1, _VECTORS_TOGETHER // max([1, *(len(motion.time) for motion in motions)]))
    for some in (motions[low : low + at_once] for low in range(0, len(motions), at_once)):
        ends = [motion.steps() for motion in some]
        edges = np.cumsum([0, *(stop.size for _, stop in ends)]).tolist()
        parts = [slice(low, high) for low, high in pairwise(edges)]
        # With the steps last, products of a few numbers are those of long vectors.
        before, after = np.empty((2, *some[0].rotation.shape[1:], edges[-1]))
        for motion, (start, stop), part in zip(some, ends, parts, strict=True):
            before[..., part] = motion.rotation.take(start, axis=0).transpose(1, 2, 0)
            after[..., part] = motion.rotation.take(stop, axis=0).transpose(1, 2, 0)
        vectors = log_map(np.moveaxis(np.einsum("jik,jlk->ilk", before, after), -1, 0))
        for motion, (_, stop), part in zip(some, ends, parts, strict=True):
            vector = np.full((len(motion.time) - 1, vectors.shape[-1]), np.nan)
            vector[stop - 1] = vectors[part]
            frozen(vector)
            vars(motion)["_step_vectors"] = vector


def _find_symmetries_together(motions: Sequence[RigidMotion]) -> None:
    """Find the point groups of bodies with the same number of particles."""
    templates = np.stack([motion.template for motion in motions])
    errors = np.array([motion.template_error for motion in motions])
    solid = ~are_collinear(templates, errors) & (templates.shape[2] == 3)
    for k in np.flatnonzero(~solid).tolist():
        vars(motions[k])["symmetry_elements"] = None
        vars(motions[k])["point_group"] = point_group(templates[k], tolerance=errors[k])
    rows = np.flatnonzero(solid)
    if not rows.size:
        return
    found = symmetry_elements_of_each(templates[rows], errors[rows])
    symbols: dict[bytes, str] = {}
    for k, elements in zip(rows.tolist(), found, strict=True):
        # Groups with the same angles between all their elements have the same symbol.
        flat = elements.reshape(len(elements), -1)
        key = np.rint(1e4 * (flat @ flat.T)).astype(np.int32).tobytes()
        if key not in symbols:
            symbols[key] = schoenflies(elements)
        vars(motions[k])["symmetry_elements"] = elements
        vars(motions[k])["point_group"] = symbols[key]


def _rotation_matrices(
    rotations: ArrayLike | Rotation, order: Literal["xyzw", "wxyz"] | None
) -> Floats:
    """Return matrices (T, d, d) from matrices, quaternions or a scipy rotation, each checked."""
    if hasattr(rotations, "as_matrix"):
        return np.array(np.atleast_3d(rotations.as_matrix()), dtype=np.float64)
    given = np.array(rotations, dtype=np.float64)
    if given.ndim == 2 and given.shape[1] == 4:
        refuse(choice_fault("order of the quaternions", order, ("xyzw", "wxyz")))
        length = np.linalg.norm(given, axis=1, keepdims=True)
        if np.any(length == 0):
            raise ValueError(f"rotations: the quaternion of row {np.argmin(length)} is zero")
        given = given / length
        w, vector = (given[:, 3], given[:, :3]) if order == "xyzw" else (given[:, 0], given[:, 1:])
        cross = skew(vector)
        turned = np.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross
        return np.asarray(turned)
    if given.ndim != 3 or given.shape[1:] not in ((2, 2), (3, 3)):
        raise ValueError(
            "rotations: expected matrices (T, 3, 3) or (T, 2, 2), quaternions (T, 4) or a scipy "
            f"Rotation, got the shape {given.shape}"
        )
    known = np.isfinite(given).all(axis=(1, 2))
    rows = np.flatnonzero(known)
    unit = np.swapaxes(given[rows], 1, 2) @ given[rows]
    wrong = np.abs(unit - np.eye(given.shape[1])).max(axis=(1, 2)) > _ROTATION_ERROR
    wrong |= np.linalg.det(given[rows]) < 0
    if wrong.any():
        raise ValueError(
            f"rotations: {int(wrong.sum())} of {len(given)} matrices are no proper rotations "
            f"(the first is row {rows[wrong][0]}): R^T R must be the identity and det R = +1"
        )
    return given


def threshold_displacement(motion: RigidMotion, *, threshold: float) -> Floats:
    """Add up rotation vectors from a reference that is renewed where a threshold is exceeded.

    In the sum of all steps, `RigidMotion.accumulated_rotation`, motion in a cage and localisation
    noise appear as diffusion, because rotations do not commute. Here the rotation is measured from
    the last reference, and only where it exceeds the threshold does its end become the next
    reference: a rotation that returns adds nothing.

    Parameters
    ----------
    motion : RigidMotion
    threshold : float
        Angle, rad, 0 to pi: above the rotations in a cage, below those of interest. With 0 all
        steps are summed; with pi the result is the rotation vector from the first frame of the
        piece, which is bounded.

    Returns
    -------
    ndarray, shape (T, 3); in the plane (T, 1)
        Sum of the rotation vectors, rad, lab axes; 0 at the beginning of every piece, NaN in
        frames without a pose.

    Raises
    ------
    ValueError
        If the threshold is out of range.

    Notes
    -----
    The threshold rule of Simon, Bobas, Villemot, Barrat and Berthier, arXiv 2604.21512 (2026). Free
    diffusion is unchanged up to 1 - threshold^2/60 in D at long times (mean first-passage time of
    Brownian rotation); lags shorter than threshold^2/(6 D) follow the rotation vector instead of
    the sum.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=50, rng=0)
    >>> from_first = threshold_displacement(truth, threshold=3.0)
    >>> bool(np.allclose(from_first, truth.as_scipy()[0].as_rotvec()))
    True
    """
    if not 0 <= threshold <= np.pi:
        raise ValueError(f"threshold: expected an angle from 0 to pi (rad), got {threshold!r}")
    if threshold == 0:
        return motion.accumulated_rotation()
    rows = motion.fitted
    rotation = motion.rotation[rows]
    reference = threshold_references(rotation, motion.piece[rows], threshold=threshold)
    turn = log_map(rotation @ np.swapaxes(rotation[reference], -1, -2))
    origins = np.unique(reference)
    total = np.cumsum(turn[origins], axis=0)
    first = np.where(reference[origins] == origins, np.arange(origins.size), 0)
    base = total - total[np.maximum.accumulate(first)]
    walk = np.full((len(motion.time), turn.shape[1]), np.nan)
    walk[rows] = base[np.searchsorted(origins, reference)] + turn
    return walk


def threshold_references(rotation: Floats, piece: Ints, *, threshold: float) -> Ints:
    """Return for every pose the pose that its rotation is measured from.

    Parameters
    ----------
    rotation : ndarray, shape (K, d, d)
        Rotations of the fitted frames, without NaN.
    piece : ndarray of int, shape (K,)
        Pieces; the reference of the first pose of a piece is itself.
    threshold : float
        Angle, rad, at which the reference changes.

    Returns
    -------
    ndarray of int, shape (K,)

    Notes
    -----
    The trace of the relative rotation, d - 2 + 2 cos(angle), is a dot product of nine numbers.

    Examples
    --------
    >>> from perrin.geometry import exp_map
    >>> turn = exp_map(np.outer([0.0, 0.2, 0.5, 0.6, 0.9], [0, 0, 1.0]))
    >>> threshold_references(turn, np.zeros(5, dtype=np.int64), threshold=0.4)
    array([0, 0, 0, 2, 2])
    """
    flat = rotation.reshape(len(rotation), -1)
    # Less a rounding error: half a turn exceeds no threshold of pi.
    least = rotation.shape[-1] - 2 + 2 * np.cos(threshold) - 1e-12
    reference = np.zeros(len(flat), dtype=np.int64)
    origin = 0
    for row in range(1, len(flat)):
        if piece[row] != piece[origin]:
            origin = row
        reference[row] = origin
        if flat[row] @ flat[origin] < least:
            origin = row
    return reference
