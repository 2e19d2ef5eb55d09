"""Poses of rigid clusters, by the likelihood of their image."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.images.optics.clipping import without_clipped
from perrin.images.optics.window_fit import RigidCenters, cut_window, fit_window

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

    from perrin._arrays import Floats, Ints
    from perrin.images.optics.ball_image import SphereImage
    from perrin.images.optics.optics import CameraNoise, Optics
    from perrin.images.optics.point_spread import StackLike
    from perrin.motion.rigid_motion import RigidMotion


# Spheres whose centres are beyond the border by this share of the reach of their images are hidden.
_SHOWN = 0.95


class Pose(NamedTuple):
    """Pose of one body in one frame.

    Attributes
    ----------
    center : ndarray, shape (3,)
        Position (x, y, z) of the centre, um.
    rotation : ndarray, shape (3, 3)
        Rotation matrix, lab from body.
    turn_covariance : ndarray, shape (3, 3)
        Covariance of a small rotation about the lab's axes, rad^2.
    center_variance : float
        Variance of one coordinate of the centre, um^2.
    """

    center: Floats
    rotation: Floats
    turn_covariance: Floats
    center_variance: float


def fit_pose(
    stack: StackLike,
    motion: RigidMotion,
    *,
    optics: Optics,
    frames: Ints | None = None,
    others: pd.DataFrame | None = None,
) -> RigidMotion:
    """Fit the six parameters of a rigid cluster's pose to the images.

    Parameters
    ----------
    stack : Stack
    motion : RigidMotion
        Motion of the free centres: the common shape, and the pose at which every fit starts.
    optics : Optics
        Size, point spread and noise of the image of a sphere.
    frames : ndarray of int, shape (T,), optional
        Frame of the stack for each row of `motion`; by default 0, 1, ...
    others : DataFrame, optional
        Spheres (``frame, x, y, z``) of other clusters, whose voxels are not used.

    Returns
    -------
    RigidMotion
        The same motion with `center`, `rotation`, `covariance` and `center_variance` from the
        images; a frame whose fit does not converge has no pose, and `reason` gives the cause.

    Notes
    -----
    The shape is taken as known: an error in it biases the pose. `residual` stays that of the free
    centres, which shows whether the cluster is rigid.

    Examples
    --------
    >>> import perrin
    >>> from perrin.images import CameraNoise
    >>> body, optics = perrin.Cluster.touching(3, 2.0), perrin.Optics(
    ...     2.0, (0.4, 0.15), CameraNoise(1.0, 0.0)
    ... )
    >>> truth = perrin.simulate_motion(body, D_R=0.01, D_T=0.01, dt=1.0, n_frames=2, rng=1)
    >>> movie = perrin.render_stack(
    ...     truth, centers=[[3.0, 3.0, 3.0]], voxel=(0.25, 0.2, 0.2), shape=(25, 30, 30),
    ...     diameter=2.0, psf=(0.4, 0.15, 0.15), rng=1,
    ... )
    >>> start = perrin.track_rotation(truth.positions() + 3.0, dt=1.0)
    >>> posed = fit_pose(movie, start, optics=optics)
    >>> bool(abs(posed.center - truth.center - 3.0).max() < 0.03)
    True
    """
    number = np.arange(len(motion.time)) if frames is None else np.asarray(frames)
    z, y, x = (float(h) for h in stack.voxel)
    image = optics.image((z, y, x))
    poses: dict[int, Pose] = {}
    for k in motion.fitted.tolist():
        frame = without_clipped(np.asarray(stack.frame(int(number[k]))))
        away = np.empty((0, 3))
        if others is not None:
            away = others.loc[others["frame"] == number[k], ["x", "y", "z"]].to_numpy(np.float64)
        found = pose_in(frame, start_of(motion, k), image, optics.noise, others=away)
        if found is not None:
            poses[k] = found
    lost = {k: "the pose fit to the image did not settle" for k in motion.fitted if k not in poses}
    return with_poses(motion, poses, lost=lost)


def start_of(motion: RigidMotion, row: int) -> RigidCenters:
    """Return the pose of a body in one row of its motion, at which a fit starts."""
    return RigidCenters(motion.center[row], motion.rotation[row], motion.template)


def pose_in(
    frame: Floats, start: RigidCenters, image: SphereImage, noise: CameraNoise, *, others: Floats
) -> Pose | None:
    """Fit one pose to one frame.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    start : RigidCenters
        The pose at the start.
    image : SphereImage
        The image of a sphere.
    noise : CameraNoise
        The variance of a voxel.
    others : ndarray, shape (m, 3)
        Positions (x, y, z) of spheres of other clusters, um.

    Returns
    -------
    Pose or None
        None where the fit does not converge.
    """
    last = (np.array(frame.shape) - 1) * np.array(image.voxel)
    beyond = np.maximum(-start.centers, start.centers - last)
    shown = np.all(beyond < _SHOWN * image.extent, axis=1)
    if not shown.all():  # a sphere that is out of view has no brightness
        start = RigidCenters(start.center, start.rotation, start.template[shown])
    window = cut_window(frame, image, start.centers, others=others[:, ::-1])
    if not window.has_enough_voxels(len(start.template)):
        return None
    fit = fit_window(window, image, noise, start)
    pose = fit.arrangement
    if not (fit.converged and isinstance(pose, RigidCenters)):
        return None
    turn, variance = fit.covariance[3:, 3:], float(np.trace(fit.covariance[:3, :3]) / 3)
    return Pose(pose.center, pose.rotation, turn, variance)


def with_poses(
    motion: RigidMotion, poses: Mapping[int, Pose], *, lost: Mapping[int, str] | None = None
) -> RigidMotion:
    """Return a motion with other poses in some rows, its first rotation the identity.

    Parameters
    ----------
    motion : RigidMotion
        The motion.
    poses : mapping of int to Pose
        The new poses, by row.
    lost : mapping of int to str, optional
        Rows that have no pose any more, and the reason.

    Returns
    -------
    RigidMotion
    """
    rotation, center = motion.rotation.copy(), motion.center.copy()
    covariance, variance = motion.covariance.copy(), motion.center_variance.copy()
    for k, pose in poses.items():
        rotation[k], center[k], variance[k] = pose.rotation, pose.center, pose.center_variance
        covariance[k] = pose.rotation.T @ pose.turn_covariance @ pose.rotation
    reason = list(motion.reason)
    for k, why in (lost or {}).items():
        rotation[k], center[k], covariance[k], variance[k] = (np.nan,) * 4
        reason[k] = why
    fitted = np.flatnonzero(np.isfinite(rotation[:, 0, 0]))
    gauge = rotation[fitted[0]] if fitted.size else np.eye(3)
    covariance = gauge @ covariance @ gauge.T
    return replace(
        motion,
        rotation=rotation @ gauge.T,
        center=center,
        covariance=(covariance + np.swapaxes(covariance, -1, -2)) / 2,
        center_variance=variance,
        template=motion.template @ gauge.T,
        reason=tuple(reason),
        turn_noise=None,
        shift_noise=None,
    )
