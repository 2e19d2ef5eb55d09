"""The steps of a motion as estimators take them: size, duration, noise of both ends."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from perrin.errors import TooFewFramesError
from perrin.geometry.rigid import degrees_of_freedom, orientation_covariance
from perrin.geometry.rotations import exp_map, successive_product

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats, Ints
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.motion.rods import RodMotion

Quantity = Literal["rotation", "translation"]


# Axes whose noise differs by less than this are equally noisy: the errors of the common shape make
# such differences, and their effect on D is of the order of their square.
_ALIKE = 0.02


@dataclass(frozen=True, eq=False)
class Steps:
    """The S steps of one motion along A axes.

    Attributes
    ----------
    size : ndarray, shape (S, A)
        Rotation angles (rad) about body axes, or displacements of the centre (um) along lab axes.
    duration : ndarray, shape (S,)
        s; a gap is one longer step.
    linked : ndarray of bool, shape (S,)
        Whether the next step begins with the frame that this one ends with.
    before, after : ndarray, shape (S, A)
        Noise variance of the frame at the beginning and at the end, per um^2 of sigma^2.
    complete : float
        Mean noise variance of the frames that show the most particles, per um^2 of sigma^2.
    sigma : float
        Localisation error from the rigid-fit residuals, um.
    freedom : int
        Degrees of freedom of those residuals.
    dt : float
        Time between frames, s.
    steady : ndarray, shape (S, A, p)
        What each component of a steady velocity (um/s) or spin (rad/s) along the p lab axes adds to
        each step: the time it takes, and for a rotation the turn from lab to body axes.
    """

    size: Floats
    duration: Floats
    linked: Bools
    before: Floats
    after: Floats
    complete: float
    sigma: float
    freedom: int
    dt: float
    steady: Floats

    def without_steady_motion(self, *, kept: Bools | None = None) -> tuple[Steps, Floats]:
        """Return the steps less their least-squares steady motion, and that motion (p,).

        `kept` (S,) marks the steps that it is fitted to; all by default.

        The restricted likelihood is the same for both; its searches begin from the steps' own size,
        and every other statistic of the steps would contain the steady motion.
        """
        steady, size = self.steady, self.size
        if kept is not None:
            steady, size = steady[kept], size[kept]
        rows = steady.reshape(size.size, -1)
        mean: Floats = np.linalg.lstsq(rows, size.ravel(), rcond=None)[0].astype(np.float64)
        return replace(self, size=self.size - self.steady @ mean), mean

    @property
    def even(self) -> bool:
        """Whether all steps take equally long, hang together, and are equally noisy."""
        same_time = np.ptp(self.duration) <= 1e-9 * self.duration[0]
        noise = np.concatenate([self.before, self.after])
        same_noise = np.all(np.ptp(noise, axis=0) <= 1e-9 * noise.max())
        return bool(same_time and same_noise and self.linked[:-1].all())


def steps_of(motion: RigidMotion, quantity: Quantity) -> Steps:
    """Return the steps of a motion and the noise of their frames.

    Rotation: body-frame rotation vectors along the axes in which the covariance of the orientation
    is diagonal, so that one number an axis describes the noise. Translation: the centre.
    """
    start, stop = motion.steps()
    if len(start) < 2:
        raise TooFewFramesError(
            f"{motion.fitted.size} frames with a pose in too few steps: at least 3 in a row (gaps "
            "allowed) are needed to tell diffusion from noise",
            int(motion.fitted.size),
        )
    duration = motion.time[stop] - motion.time[start]
    if quantity == "rotation":
        axes, noise = _noise_axes(motion)
        size = motion.step_vectors()[stop - 1] @ axes
        # A spin of the lab moves the body by R^T of it; in the plane both are one number.
        turned = motion.rotation[start] @ axes if len(axes) == 3 else np.ones((len(start), 1, 1))
        steady = np.swapaxes(turned, -1, -2) * duration[:, None, None]
    else:
        size, noise = _displacements(motion, start, stop)
        steady = np.eye(size.shape[1]) * duration[:, None, None]
    return Steps(
        size=size,
        duration=duration,
        linked=np.append(start[1:] == stop[:-1], False),
        before=noise[start],
        after=noise[stop],
        complete=float(np.mean(noise[_complete(motion)])),
        sigma=motion.sigma,
        freedom=residual_freedom(motion),
        dt=motion.dt,
        steady=steady,
    )


def residual_freedom(motion: RigidMotion) -> int:
    """Return the degrees of freedom of all rigid-fit residuals; the template costs those of one."""
    n, d = motion.template.shape
    freedom = degrees_of_freedom(motion.n_present[motion.fitted], d).sum()
    return int(freedom - degrees_of_freedom(np.array(n), d))


def unit_covariance(motion: RigidMotion) -> Floats:
    """Return the covariance of every orientation for a localisation error of 1 um, (T, a, a)."""
    square = float(np.mean(motion.noise**2))
    if square > 0:
        return np.asarray(motion.covariance / square)
    unit = orientation_covariance(motion.template, np.eye(motion.template.shape[1]))
    return np.broadcast_to(unit, motion.covariance.shape)


def unit_center_variance(motion: RigidMotion) -> Floats:
    """Return the variance of every centre for a localisation error of 1 um, (T,)."""
    square = float(np.mean(motion.noise**2))
    if square > 0:
        return np.asarray(motion.center_variance / square)
    return np.full(len(motion.time), 1 / len(motion.template))


def _noise_axes(motion: RigidMotion) -> tuple[Floats, Floats]:
    """Return the axes (A, A) of the mean covariance, and the noise (T, A) along them."""
    c = unit_covariance(motion)
    complete = _complete(motion)
    values, axes = np.linalg.eigh(np.mean(c[complete], axis=0))
    noise = np.einsum("ji,tjk,ki->ti", axes, c, axes)
    for group in np.split(np.arange(len(values)), 1 + np.flatnonzero(_apart(values))):
        noise[np.ix_(complete, group)] = noise[np.ix_(complete, group)].mean(axis=1)[:, None]
    return axes, noise


def _apart(values: Floats) -> Bools:
    """Return whether each of the rising values stands clear of the one before."""
    clear: Bools = np.diff(values) > _ALIKE * values[1:]
    return clear


def _displacements(
    motion: RigidMotion, start: np.ndarray, stop: np.ndarray
) -> tuple[Floats, Floats]:
    """Return displacements of the centre (S, A) and its noise (T, A)."""
    size = motion.center[stop] - motion.center[start]
    return size, np.repeat(unit_center_variance(motion)[:, None], size.shape[1], axis=1)


def _complete(motion: RigidMotion) -> Bools:
    """Return the fitted frames that show the most particles."""
    fitted = np.isfinite(motion.center[:, 0])
    complete: Bools = fitted & (motion.n_present == motion.n_present[fitted].max())
    return complete


class Walk(NamedTuple):
    """Steps of one walk whose noise is known: what a likelihood needs.

    Step i goes from frame start[i] to stop[i] in tau[i] seconds; y (S, c) are its c components,
    each of variance 2 D tau plus the noise of its two frames, `variance` (T,) apart from an offset.
    """

    y: Floats
    tau: Floats
    start: Ints
    stop: Ints
    variance: Floats


def direction_steps(motion: RodMotion) -> Walk:
    """Return the steps of the direction as two angles, in axes carried along without turning.

    Each step is the vector along u(t) x (u(t + dt) x u(t)) as long as the angle between the two,
    in two axes perpendicular to u that are carried by the least rotations (parallel transport),
    so that the noise of one frame enters two neighbouring steps with opposite signs.
    """
    start, stop = motion.steps()
    rows = motion.fitted
    u, v = motion.direction[rows[:-1]], motion.direction[rows[1:]]
    cross = np.cross(u, v)
    sine = np.linalg.norm(cross, axis=1)
    angle = np.arctan2(sine, np.einsum("ti,ti->t", u, v))
    turn = cross * np.divide(angle, sine, out=np.ones_like(sine), where=sine > 0)[:, None]
    carried = successive_product(exp_map(turn))[:-1]
    first = motion.direction[rows[0]]
    axes = np.linalg.svd(first[None])[2][1:]
    y = np.einsum("tij,aj,ti->ta", carried, axes, turn)
    here = np.isin(rows[1:], stop)
    tau = motion.time[stop] - motion.time[start]
    return Walk(y[here], tau, start, stop, motion.variance)


def center_steps(motion: RodMotion) -> Walk:
    """Return the steps of the centre."""
    start, stop = motion.steps()
    tau = motion.time[stop] - motion.time[start]
    y = motion.center[stop] - motion.center[start]
    return Walk(y, tau, start, stop, motion.center_variance)
