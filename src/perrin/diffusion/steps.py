"""Steps of a motion: their vectors, durations and links, the noise of their frames, its model."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from perrin._arrays import distinct, expanded, frozen, mean_row, repeated, stored_once
from perrin.errors import TooFewFramesError
from perrin.geometry.rigid import degrees_of_freedom
from perrin.geometry.rotations import exp_map, log_map, successive_product
from perrin.geometry.wahba import svd_rotation
from perrin.motion.residuals import unit_center_variance, unit_covariance

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from perrin._arrays import Bools, Floats, Ints
    from perrin.diffusion.noise_model import Noise
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.motion.rods import RodMotion

Quantity = Literal["rotation", "translation"]
MemoryFrame = Literal["body", "lab", "mean"]

# Axes whose noise differs by less than this are equally noisy: the errors of the common shape make
# such differences, and their effect on D is of the order of their square.
_EQUALLY_NOISY_AXES = 0.02

# Steps are even, and a sine transform is used, if times and noise agree to this.
_EVEN_STEPS = 1e-9

# Frames of motions that are computed together: as many as stay in the processor's cache.
_FRAMES_TOGETHER = 20_000

# Steps of motions that are in use: a motion does not change, and neither do its steps, which
# estimates and tests of one motion share.
_STEPS_OF_MOTIONS: WeakKeyDictionary[RigidMotion, dict[Quantity, Steps]] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Steps:
    """The S steps of one motion: vectors of c components, and the noise of the T frames.

    A step over the time t has covariance 2 D t plus the noise of its two frames; the frame that two
    neighbours share enters them with opposite signs. The tensor likelihood takes the covariances as
    they are, the likelihood of a single D their diagonal.

    Attributes
    ----------
    vectors : ndarray, shape (S, c)
        Rotation vectors (rad), displacements (um), or both, translation first.
    duration : ndarray, shape (S,)
        Time between the two frames of each step, s; a gap is one longer step.
    start, stop : ndarray of int, shape (S,)
        Frame in which each step begins, and in which it ends.
    noise : ndarray, shape (r, T, c, c)
        Noise covariance of every frame for an amplitude of 1, by independent source: per um^2 of
        sigma^2, or with an amplitude that is known to be 1.
    dt : float
        Time between frames, s.
    sigma : float
        Localisation error from the rigid-fit residuals, um.
    freedom : int
        Degrees of freedom of those residuals.
    complete : float
        Mean noise variance of the frames with the most particles, for an amplitude of 1; NaN
        for steps in body axes, whose likelihood does not need it.
    steady : ndarray, shape (S, c, p)
        What each component of a steady velocity (um/s) or spin (rad/s) along the p lab axes adds to
        each step: the time it takes, and for a rotation the turn from lab to body axes. Empty where
        a steady motion cannot be removed.
    """

    vectors: Floats
    duration: Floats
    start: Ints
    stop: Ints
    noise: Floats
    dt: float
    sigma: float
    freedom: int
    complete: float = np.nan
    steady: Floats = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def __post_init__(self) -> None:
        frozen(self.vectors, self.duration, self.start, self.stop, self.noise, self.steady)

    @cached_property
    def linked(self) -> Bools:
        """Whether the next step begins with the frame that this one ends with, (S,)."""
        linked = np.zeros(len(self.start), dtype=np.bool_)
        np.equal(self.start[1:], self.stop[:-1], out=linked[:-1])
        return linked

    @cached_property
    def before(self) -> Floats:
        """Noise covariance of the frame in which each step begins, (r, S, c, c)."""
        return self.of_frames(self.start)

    @cached_property
    def after(self) -> Floats:
        """Noise covariance of the frame in which each step ends, (r, S, c, c)."""
        return self.of_frames(self.stop)

    def of_frames(self, frames: Ints) -> Floats:
        """Return the noise covariance of some frames, (r, F, c, c)."""
        if self.noise.strides[1] == 0:  # the frames are stored once
            return self.noise[:, : len(frames)]
        return self.noise[:, frames]

    @cached_property
    def mean_noise(self) -> Floats:
        """Noise covariance of a frame, mean over the ends of the steps, (r, c, c)."""
        if self.noise.strides[1] == 0:
            return self.noise[:, 0]
        return np.asarray(0.5 * (self.before + self.after).mean(axis=1))

    @cached_property
    def variances(self) -> tuple[Floats, Floats]:
        """Noise variances of the first and the last frame of each step by component, (S, c)."""
        if self.noise.strides[1] == 0:
            rows = repeated(self.noise[0, 0].diagonal(), len(self.vectors))
            return rows, rows
        diagonal = np.ascontiguousarray(np.einsum("tcc->tc", self.noise[0]))
        return stored_once(diagonal[self.start]), stored_once(diagonal[self.stop])

    @cached_property
    def mean_variance(self) -> float:
        """Noise variance of a component, mean over components and the ends of all steps."""
        before, after = self.variances
        mean = float(mean_row(before).mean())
        return mean if after is before else 0.5 * (mean + float(mean_row(after).mean()))

    @cached_property
    def sum_of_squares(self) -> float:
        """Sum of the squares of all components of the steps."""
        return float(np.vdot(self.vectors, self.vectors))

    @cached_property
    def neighbour_products(self) -> Floats:
        """Sum of the products of neighbouring steps that share a frame, symmetric, (c, c)."""
        linked = self.linked[:-1]
        first, second = self.vectors[:-1], self.vectors[1:]
        product = first.T @ second if linked.all() else first[linked].T @ second[linked]
        return np.asarray(0.5 * (product + product.T))

    @cached_property
    def total_duration(self) -> float:
        """Time that all steps take, s."""
        return float(self.duration.sum())

    @cached_property
    def above_least(self) -> tuple[float, Floats, tuple[Floats, Floats]]:
        """Least noise variance, ones (S, c), and by how much the noise of both ends exceeds it."""
        count, axes = self.vectors.shape
        before, after = (self.sigma**2 * distinct(n) for n in self.variances)
        least = min(float(before.min()), float(after.min()))
        known = expanded(before - least, count), expanded(after - least, count)
        return least, repeated(np.ones(axes), count), known

    @cached_property
    def even(self) -> bool:
        """Whether all steps are linked, equally long and equally noisy."""
        same_time = np.ptp(self.duration) <= _EVEN_STEPS * self.duration[0]
        if not (same_time and self.linked[:-1].all()):
            return False
        if self.noise.strides[1] == 0:  # the frames are stored once
            return True
        ends = np.zeros(self.noise.shape[1], dtype=np.bool_)
        ends[self.start] = ends[self.stop] = True
        noise = self.noise[:, ends]
        return bool(np.ptp(noise, axis=1).max() <= _EVEN_STEPS * np.abs(noise).max())

    def without_steady_motion(self, *, kept: Bools | None = None) -> tuple[Steps, Floats]:
        """Return the steps less their least-squares steady motion, and that motion (p,).

        `kept` (S,) marks the steps that it is fitted to; all by default.

        The restricted likelihood is the same for both; its searches begin from the steps' own size,
        and every other statistic of the steps would contain the steady motion.
        """
        steady, vectors = self.steady, self.vectors
        if kept is not None:
            steady, vectors = steady[kept], vectors[kept]
        rows = steady.reshape(vectors.size, -1)
        # The columns are orthogonal, or nearly so: squaring them loses no digits.
        normal = rows.T @ rows, rows.T @ vectors.ravel()
        try:
            mean: Floats = np.linalg.solve(*normal).astype(np.float64)
        except np.linalg.LinAlgError:  # no step that a steady motion would change
            mean = np.linalg.lstsq(*normal, rcond=None)[0].astype(np.float64)
        moved = (self.steady.reshape(self.vectors.size, -1) @ mean).reshape(self.vectors.shape)
        return replace(self, vectors=self.vectors - moved), mean


@dataclass(frozen=True, eq=False)
class NoisySteps:
    """The steps of one motion with what is known of their noise, for a single D.

    The noise variance of a frame is s = weight theta + known, and its offset s - b D where motion
    blur takes b D from it. Only the diagonal of the noise covariances is used.

    Attributes
    ----------
    steps : Steps
        Steps along axes in which the noise is diagonal, without their steady motion where that is
        free.
    weight : tuple of ndarray, shape (S, A)
        Noise variance of the frames before and after each step, per unit of theta.
    known : tuple of ndarray, shape (S, A)
        Known part of these variances.
    blur : float
        b of the offset s - b D, s.
    theta : float
        Value of a fixed theta, or the estimate of a free one from the residuals.
    freedom : float
        Degrees of freedom of that estimate: 0 where there is none, inf where theta is fixed.
    level : float
        Mean of `known` over the frames with the most particles.
    drift : bool
        Whether a steady velocity or spin is free.
    steady : ndarray, shape (p,)
        Least-squares steady motion that was subtracted; zeros without drift.
    """

    steps: Steps
    weight: tuple[Floats, Floats]
    known: tuple[Floats, Floats]
    blur: float
    theta: float
    freedom: float
    level: float
    drift: bool
    steady: Floats

    def theta_at(self, D: float, offset: float) -> float:
        """Return the free part of the noise: the offset is theta + level - blur D."""
        return 0.0 if np.isinf(self.freedom) else max(offset - self.level + self.blur * D, 0.0)

    @classmethod
    def of(cls, steps: Steps, noise: Noise) -> NoisySteps:
        """Return the steps with the noise that the options state; blur takes b D from it."""
        if noise.model == "joint":
            # An unknown exposure may blur up to the limit at which steps stop being possible; so
            # may a scan, which averages the pose over the times of the particles.
            unknown = noise.exposure is None or min(float(n.min()) for n in steps.variances) < 0
            blur = steps.duration.min() / 2 if unknown else (noise.exposure or 0.0) * steps.dt / 3
            return cls.free(steps, blur=float(blur), drift=noise.drift)
        blur = (noise.exposure or 0.0) * steps.dt / 3
        if noise.model == "residual":
            return cls.from_residuals(steps, blur=blur, drift=noise.drift)
        return cls.fixed(steps, sigma=float(noise.model), blur=blur, drift=noise.drift)

    @classmethod
    def free(cls, steps: Steps, *, blur: float, drift: bool) -> NoisySteps:
        """Leave the offset free; known is by how much a frame exceeds the least noisy one."""
        least, one, known = steps.above_least
        level = steps.sigma**2 * steps.complete - least
        steps, steady = _subtracted(steps, drift=drift)
        return cls(steps, (one, one), known, blur, 0.0, 0.0, level, drift, steady)

    @classmethod
    def from_residuals(cls, steps: Steps, *, blur: float, drift: bool) -> NoisySteps:
        """Estimate theta from the rigid-fit residuals, with their degrees of freedom."""
        theta = steps.sigma**2 * steps.complete
        if theta == 0:
            return cls.fixed(steps, sigma=0.0, blur=blur, drift=drift)
        before, after = steps.variances
        weight = before / steps.complete, after / steps.complete
        none = np.zeros_like(before)
        freedom = float(steps.freedom)
        steps, steady = _subtracted(steps, drift=drift)
        return cls(steps, weight, (none, none), blur, theta, freedom, 0.0, drift, steady)

    @classmethod
    def fixed(cls, steps: Steps, *, sigma: float, blur: float, drift: bool) -> NoisySteps:
        """Take the localisation error sigma (um) as known."""
        before, after = steps.variances
        known = sigma**2 * before, sigma**2 * after
        none = np.zeros_like(before)
        level = sigma**2 * steps.complete
        steps, steady = _subtracted(steps, drift=drift)
        return cls(steps, (none, none), known, blur, 0.0, np.inf, level, drift, steady)


def _subtracted(steps: Steps, *, drift: bool) -> tuple[Steps, Floats]:
    """Return the steps without their steady motion, and that motion; unchanged without drift."""
    return steps.without_steady_motion() if drift else (steps, np.zeros(steps.steady.shape[2]))


def steps_of(motion: RigidMotion, quantity: Quantity) -> Steps:
    """Return the steps of a motion along axes in which their noise is diagonal.

    The steps of a rotation are body-frame rotation vectors along the axes in which the mean
    covariance of the orientation of complete frames is diagonal; only the variances along them are
    kept, and those that differ by less than 2 % are taken as equal. The steps of a translation are
    displacements of the centre, in lab axes.

    Raises
    ------
    TooFewFramesError
        If there are fewer than two steps.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=100, rng=3)
    >>> steps = steps_of(truth, "rotation")
    >>> steps.vectors.shape, steps.even
    ((99, 3), True)
    """
    steps = steps_of_each([motion], quantity)[0]
    if isinstance(steps, TooFewFramesError):
        raise steps
    return steps


def steps_of_each(
    motions: Sequence[RigidMotion], quantity: Quantity
) -> list[Steps | TooFewFramesError]:
    """Return the steps of several motions, as `steps_of`, or the error; alike ones together.

    Parameters
    ----------
    motions : sequence of RigidMotion
    quantity : {"rotation", "translation"}

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> [len(steps.duration) for steps in steps_of_each([truth, truth], "translation")]
    [8, 8]
    """
    known = [_STEPS_OF_MOTIONS.setdefault(motion, {}) for motion in motions]
    new = [k for k, steps in enumerate(known) if quantity not in steps]
    errors: dict[int, TooFewFramesError] = {}
    for k in new:
        if len(motions[k].steps()[0]) < 2:
            count = int(motions[k].fitted.size)
            errors[k] = TooFewFramesError(
                f"{count} frames with a pose in too few steps: at least 3 in a row (gaps allowed) "
                "are needed to separate diffusion from noise",
                count,
            )
    new = [k for k in new if k not in errors]
    axes_of = _noise_axes if quantity == "rotation" else _lab_axes
    for rows in alike_motions([motions[k] for k in new]):
        some = [motions[new[i]] for i in rows]
        for i, steps in zip(rows, _steps_together(some, axes_of(some)), strict=True):
            known[new[i]][quantity] = steps
    return [errors[k] if k in errors else known[k][quantity] for k in range(len(motions))]


class _StepsAlongAxes(NamedTuple):
    """Steps of B motions whose frames are alike along axes of each, and the noise along them.

    The noise is that of all T frames, or one row where it is the same in all.
    """

    vectors: Floats
    noise: Floats
    steady: Floats


def _noise_axes(motions: Sequence[RigidMotion]) -> _StepsAlongAxes:
    """Return the rotation vectors along the axes in which the noise is diagonal."""
    covariance = np.stack([unit_noise(motion)[0] for motion in motions])
    whole = _complete_frames(motions[0], covariance.shape[1])
    values, axes = np.linalg.eigh(covariance[:, whole].mean(axis=1))
    noise = np.einsum("bji,btji->bti", axes, covariance @ axes[:, None])
    # Axes that are equally noisy have the mean of their noise.
    group = np.zeros(values.shape, dtype=np.int64)
    np.cumsum(np.diff(values) > _EQUALLY_NOISY_AXES * values[:, 1:], axis=1, out=group[:, 1:])
    same = group[:, :, None] == group[:, None, :]
    share = same / same.sum(axis=2, keepdims=True)
    noise[:, whole] = (noise[:, whole, None, :] * share[:, None]).sum(axis=3)
    start, stop = motions[0].steps()
    vectors = np.stack([motion.step_vectors() for motion in motions])[:, stop - 1] @ axes
    # A spin of the lab moves the body by R^T of it; in the plane both are one number.
    turned = np.ones((len(motions), len(start), 1, 1))
    if axes.shape[1] == 3:
        rotation = np.stack([motion.rotation for motion in motions])[:, start]
        turned = (rotation.reshape(len(motions), -1, 3) @ axes).reshape(rotation.shape)
    return _StepsAlongAxes(vectors, noise, np.swapaxes(turned, -1, -2))


def _lab_axes(motions: Sequence[RigidMotion]) -> _StepsAlongAxes:
    """Return the displacements of the centre in lab axes, all equally noisy."""
    start, stop = motions[0].steps()
    center = np.stack([motion.center for motion in motions])
    vectors = center[:, stop] - center[:, start]
    d = vectors.shape[2]
    noise = np.repeat(np.stack([unit_noise(m)[1] for m in motions])[..., None], d, axis=2)
    return _StepsAlongAxes(vectors, noise, np.eye(d)[None, None])


def _steps_together(motions: Sequence[RigidMotion], along: _StepsAlongAxes) -> list[Steps]:
    """Return the steps of motions whose frames are alike."""
    start, stop = motions[0].steps()
    frames, count, d = len(motions[0].time), len(start), along.vectors.shape[2]
    time = np.stack([motion.time for motion in motions])
    duration = time[:, stop] - time[:, start]
    noise = along.noise[:, None, :, :, None] * np.eye(d)
    noise = np.broadcast_to(noise, (len(motions), 1, frames, d, d))
    complete = along.noise[:, _complete_frames(motions[0], along.noise.shape[1])].mean(axis=(1, 2))
    if along.steady.shape[1] == 1 and np.all(duration == duration[:, :1]):
        steady = along.steady * duration[:, :1, None, None]
        steady = np.broadcast_to(steady, (len(motions), count, d, d))
    else:
        steady = along.steady * duration[:, :, None, None]
    return [
        Steps(
            vectors=along.vectors[k],
            duration=duration[k],
            start=start,
            stop=stop,
            noise=noise[k],
            dt=motion.dt,
            sigma=motion.sigma,
            freedom=residual_freedom(motion),
            complete=float(complete[k]),
            steady=steady[k],
        )
        for k, motion in enumerate(motions)
    ]


def _complete_frames(motion: RigidMotion, rows: int) -> Bools:
    """Return which rows of the noise, of each frame or one of all, have the most particles."""
    if rows == 1:
        return np.ones(1, dtype=np.bool_)
    present = np.where(np.isfinite(motion.center[:, 0]), motion.n_present, -1)
    return np.asarray(present == present.max())


def unit_noise(motion: RigidMotion) -> tuple[Floats, Floats]:
    """Return the noise of the frames for a localisation error of 1 um; one row where all agree.

    Returns
    -------
    covariance : ndarray, shape (T, a, a) or (1, a, a)
        Step noise of the orientations.
    variance : ndarray, shape (T,) or (1,)
        Step noise of a coordinate of the centres.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> [noise.shape for noise in unit_noise(truth)]
    [(1, 3, 3), (1,)]
    """
    noise = unit_covariance(motion), unit_center_variance(motion)
    covariance, variance = (distinct(stored_once(rows)) for rows in noise)
    return covariance, variance


def alike_motions(motions: Sequence[RigidMotion]) -> list[list[int]]:
    """Return the numbers of motions in groups without gaps whose arrays can be stacked.

    Motions with gaps, or with frames that are not equally noisy, are alone.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> alike_motions([truth, truth])
    [[0, 1]]
    """
    keys: list[Hashable] = []
    for k, motion in enumerate(motions):
        frames, steps = len(motion.time), len(motion.steps()[0])
        stacked = steps == frames - 1 and all(len(rows) == 1 for rows in unit_noise(motion))
        keys.append((frames, motion.dimension) if stacked else k)
    return groups_alike(keys, [len(motion.time) for motion in motions], most=_FRAMES_TOGETHER)


def groups_alike(keys: Sequence[Hashable], sizes: Sequence[int], *, most: int) -> list[list[int]]:
    """Return the numbers of items in groups of equal keys that are computed at once.

    Parameters
    ----------
    keys : sequence
        Key of every item.
    sizes : sequence of int
        Size of every item, the same for equal keys.
    most : int
        Largest sum of the sizes of a group of more than one.

    Examples
    --------
    >>> groups_alike(["a", "b", "a", "a"], [2, 9, 2, 2], most=4)
    [[0, 2], [3], [1]]
    """
    alike: dict[Hashable, list[int]] = {}
    for k, key in enumerate(keys):
        alike.setdefault(key, []).append(k)
    groups = []
    for rows in alike.values():
        at_once = max(1, most // max(sizes[rows[0]], 1))
        groups += [rows[low : low + at_once] for low in range(0, len(rows), at_once)]
    return groups


def pooled_steps(motions: Sequence[RigidMotion], quantity: Quantity) -> list[Steps]:
    """Return the steps of every motion; an error names the motion where there are several.

    Parameters
    ----------
    motions : sequence of RigidMotion
    quantity : {"rotation", "translation"}

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> [len(steps.duration) for steps in pooled_steps([truth, truth], "translation")]
    [8, 8]
    """
    steps = []
    for number, one in enumerate(steps_of_each(motions, quantity)):
        if isinstance(one, TooFewFramesError):
            if len(motions) == 1:
                raise one
            raise TooFewFramesError(f"motion {number}: {one}", one.n_frames)
        steps.append(one)
    return steps


def principal_steps(
    motion: RigidMotion, quantity: Quantity, *, frame: MemoryFrame = "body"
) -> Steps:
    """Return the steps along axes in which the diffusion is diagonal, with the noise along them.

    The steps of a rotation are turned into the eigenvectors of the noise-corrected tensor
    <w_j w_j^T>/2 + sym<w_j w_{j+1}^T> of the steps w; those of a translation, and of a rotation in
    the plane, keep their axes. Every axis then has its own D and noise, and the noise of a frame
    along each axis follows the turning body.

    Parameters
    ----------
    motion : RigidMotion
    quantity : {"rotation", "translation"}
    frame : {"body", "lab", "mean"}
        Steps of a rotation: body-frame rotation vectors, the same vectors in lab axes, or
        differences of the rotation vectors from the mean orientation of the piece.

    Raises
    ------
    TooFewFramesError
        If there are fewer than two steps.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> D_R = [[4e-3, 2e-3, 0], [2e-3, 4e-3, 0], [0, 0, 1e-3]]
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=D_R, dt=0.7, n_frames=3000, rng=3)
    >>> square = np.mean(principal_steps(truth, "rotation").vectors ** 2, axis=0)
    >>> (square / 1.4).round(3)
    array([0.001, 0.002, 0.006])
    """
    return principal_steps_of_each([motion], quantity, frame=frame)[0]


def principal_steps_of_each(
    motions: Sequence[RigidMotion], quantity: Quantity, *, frame: MemoryFrame = "body"
) -> list[Steps]:
    """Return the steps of several motions as `principal_steps`, those of alike motions together.

    Parameters
    ----------
    motions, quantity, frame
        As in `principal_steps`.

    Raises
    ------
    TooFewFramesError
        If a motion has fewer than two steps.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> [len(s.duration) for s in principal_steps_of_each([truth, truth], "rotation")]
    [8, 8]
    """
    found = pooled_steps(motions, quantity)
    if quantity == "translation" or motions[0].dimension == 2:
        return found
    for rows in alike_motions(motions):
        some = [motions[k] for k in rows]
        turned = _principal_axes(some, frame=frame)
        shape = len(rows), 1, len(some[0].time), 3, 3
        noise = np.broadcast_to((turned.noise[..., None] * np.eye(3))[:, None], shape)
        duration = np.stack([found[k].duration for k in rows])
        steady = turned.steady * duration[..., None, None]
        for i, k in enumerate(rows):
            found[k] = replace(
                found[k], vectors=turned.vectors[i], noise=noise[i], steady=steady[i]
            )
    return found


def _principal_axes(motions: Sequence[RigidMotion], *, frame: MemoryFrame) -> _StepsAlongAxes:
    """Return the rotations along the axes in which their diffusion is diagonal."""
    start, stop = motions[0].steps()
    rotation = np.stack([motion.rotation for motion in motions])
    w = np.stack([motion.step_vectors() for motion in motions])[:, stop - 1]
    # Rotation of the noise and of a spin, from body axes and from lab axes, into those of the steps
    from_body, from_lab = np.eye(3)[None, None], np.swapaxes(rotation, -1, -2)
    if frame == "lab":
        from_body, from_lab = rotation, np.eye(3)[None, None]
        w = (rotation[:, start] @ w[..., None])[..., 0]
    elif frame == "mean":
        about = np.stack([orientation_about_mean(motion) for motion in motions])
        w = about[:, stop] - about[:, start]
        from_body = exp_map(about)
        from_lab = from_body @ from_lab
    linked = (start[1:] == stop[:-1])[:, None]
    tensor = 0.5 * np.swapaxes(w, 1, 2) @ w + np.swapaxes(w[:, :-1] * linked, 1, 2) @ w[:, 1:]
    axes = np.linalg.eigh((tensor + np.swapaxes(tensor, 1, 2)) / 2)[1]
    across = np.swapaxes(axes, 1, 2)[:, None]
    from_lab = from_lab[:, start] if from_lab.shape[1] > 1 else from_lab
    from_body = across @ from_body
    covariance = np.stack([unit_noise(motion)[0] for motion in motions])
    noise = np.sum((from_body @ covariance) * from_body, axis=3)
    return _StepsAlongAxes(w @ axes, noise, across @ from_lab)


def orientation_about_mean(motion: RigidMotion) -> Floats:
    """Return the rotation vector of every frame from the mean orientation of its piece, (T, 3).

    The mean is the rotation nearest to the mean matrix; the vectors are in its body axes, and NaN
    for frames without a pose.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> orientation_about_mean(truth).shape
    (9, 3)
    """
    about = np.full((len(motion.time), 3), np.nan)
    for piece in np.unique(motion.piece[motion.fitted]):
        rows = motion.fitted[motion.piece[motion.fitted] == piece]
        mean = svd_rotation(motion.rotation[rows].mean(axis=0)[None], np.zeros(1))[0][0]
        about[rows] = log_map(mean.T @ motion.rotation[rows])
    return about


def body_steps(motion: RigidMotion, quantity: Quantity | Literal["both"], turn: Floats) -> Steps:
    """Return the steps of a motion in three dimensions in body axes, with their full covariances.

    Parameters
    ----------
    motion : RigidMotion
    quantity : {"rotation", "translation", "both"}
        Rotation vectors; displacements of the centre in the axes that the body has half way through
        each step; or SE(3) logarithms, translation first, with one source of noise for the centre
        and one for the orientation.
    turn : ndarray, shape (3, 3)
        Rotation from the axes of the template to those of the steps; not for "both".

    Notes
    -----
    The translation of a logarithm is V^-1 R_k^T (x_{k+1} - x_k) with
    V^-1 = 1 - [w]/2 + (1 - (a/2) cot(a/2)) [w]^2/a^2 for the rotation vector w of angle a.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> steps = body_steps(truth, "both", np.eye(3))
    >>> steps.vectors.shape, steps.noise.shape
    ((8, 6), (2, 9, 6, 6))
    """
    start, stop = motion.steps()
    w, frames = motion.step_vectors()[stop - 1], len(motion.time)
    covariance, variance = unit_noise(motion)
    displacement = motion.center[stop] - motion.center[start]
    center_noise = variance[:, None, None] * np.eye(3)
    if quantity == "rotation":
        vectors = w @ turn.T
        noise = expanded(turn @ covariance @ turn.T, frames)[None]
    elif quantity == "translation":
        middle = motion.rotation[start] @ exp_map(0.5 * w)
        vectors = np.einsum("sji,sj->si", middle, displacement) @ turn.T
        noise = expanded(center_noise, frames)[None]
    else:
        jump = np.einsum("sji,sj->si", motion.rotation[start], displacement)
        half = 0.5 * np.linalg.norm(w, axis=1)
        # (1 - h cot h)/(2h)^2 -> 1/12 at small h, where the quotient loses its digits; the next
        # term, h^2/180, changes a step by 1e-14 at most.
        small = half < 1e-3
        h = np.where(small, 1.0, half)
        factor = np.where(small, 1 / 12, (1 - h / np.tan(h)) / (4 * h * h))
        once = np.cross(w, jump)
        u = jump - 0.5 * once + factor[:, None] * np.cross(w, once)
        vectors = np.concatenate([u, w], axis=1)
        noise = np.zeros((2, frames, 6, 6))
        noise[0, :, :3, :3] = center_noise
        noise[1, :, 3:, 3:] = covariance
    return Steps(
        vectors=vectors,
        duration=motion.time[stop] - motion.time[start],
        start=start,
        stop=stop,
        noise=noise,
        dt=motion.dt,
        sigma=motion.sigma,
        freedom=residual_freedom(motion),
    )


def direction_steps(motion: RodMotion) -> Steps:
    """Return the steps of a rod's direction as two angles, in axes carried along without turning.

    Each step is the vector along u(t) x (u(t + dt) x u(t)) as long as the angle between the two,
    in two axes perpendicular to u that are carried by the least rotations (parallel transport),
    so that the noise of one frame enters two neighbouring steps with opposite signs. The noise
    variance is known, not a multiple of sigma^2, so that sigma is 1.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion, track_direction
    >>> truth = simulate_motion(Cluster.touching(2, 2.0), D_R=0.01, dt=0.5, n_frames=9, rng=2)
    >>> rod = track_direction(truth.positions(), dt=0.5)
    >>> direction_steps(rod).vectors.shape
    (8, 2)
    """
    rows = motion.fitted
    u, v = motion.direction[rows[:-1]], motion.direction[rows[1:]]
    cross = np.cross(u, v)
    sine = np.linalg.norm(cross, axis=1)
    angle = np.arctan2(sine, np.einsum("ti,ti->t", u, v))
    turn = cross * np.divide(angle, sine, out=np.ones_like(sine), where=sine > 0)[:, None]
    carried = successive_product(exp_map(turn))[:-1]
    first = motion.direction[rows[0]]
    axes = np.linalg.svd(first[None])[2][1:]
    vectors = np.einsum("tij,aj,ti->ta", carried, axes, turn)[np.isin(rows[1:], motion.steps()[1])]
    return _rod_steps(motion, vectors, motion.variance)


def center_steps(motion: RodMotion) -> Steps:
    """Return the steps of a rod's centre; their noise variance is known, so that sigma is 1.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion, track_direction
    >>> truth = simulate_motion(Cluster.touching(2, 2.0), D_R=0.01, dt=0.5, n_frames=9, rng=2)
    >>> center_steps(track_direction(truth.positions(), dt=0.5)).vectors.shape
    (8, 3)
    """
    start, stop = motion.steps()
    return _rod_steps(motion, motion.center[stop] - motion.center[start], motion.center_variance)


def _rod_steps(motion: RodMotion, vectors: Floats, variance: Floats) -> Steps:
    """Return steps of a rod whose components have this noise variance in every frame, (T,)."""
    start, stop = motion.steps()
    return Steps(
        vectors=vectors,
        duration=motion.time[stop] - motion.time[start],
        start=start,
        stop=stop,
        noise=(variance[:, None, None] * np.eye(vectors.shape[1]))[None],
        dt=motion.dt,
        sigma=1.0,
        freedom=0,
        complete=float(np.nanmean(variance)),
        steady=np.zeros((*vectors.shape, 0)),
    )


def residual_freedom(motion: RigidMotion) -> int:
    """Return the degrees of freedom of all rigid-fit residuals, less those of the template.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> residual_freedom(
    ...     simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    ... )
    48
    """
    n, d = motion.template.shape
    freedom = degrees_of_freedom(motion.n_present[motion.fitted], d).sum()
    return int(freedom - degrees_of_freedom(np.array(n), d))
