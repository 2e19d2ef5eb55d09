"""How rigid clusters stand and are turned, by the likelihood of their image."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.images.optics.window_fit import RigidCenters, cut_window, fit_window

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

    from perrin._arrays import Floats, Ints
    from perrin.images.optics.ball_image import SphereImage
    from perrin.images.optics.optics import CameraNoise, Optics
    from perrin.images.spheres.localisation import StackLike
    from perrin.motion.rigid_motion import RigidMotion


class Pose(NamedTuple):
    """Where one body is in one frame: x, y, z.

    Attributes
    ----------
    center : ndarray, shape (3,)
        um.
    rotation : ndarray, shape (3, 3)
        Lab from body.
    turn_covariance : ndarray, shape (3, 3)
        Of a small turn about the lab's axes, rad^2.
    center_variance : float
        Of one coordinate of the centre, um^2.
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
    """Fit the six numbers of a rigid cluster's pose to the images themselves.

    Parameters
    ----------
    stack : Stack
    motion : RigidMotion
        Of the free centres: the common shape, and every frame's start.
    optics : Optics
        How a sphere is seen.
    frames : ndarray of int, shape (T,), optional
        The stack's frame of each row of `motion`; default 0, 1, ...
    others : DataFrame, optional
        Spheres (``frame, x, y, z``) of other clusters, whose light is left out.

    Returns
    -------
    RigidMotion
        The same with `center`, `rotation`, `covariance` and `center_variance` from the images; a
        frame whose fit does not settle has no pose and says so in `reason`.

    Notes
    -----
    The shape is taken as known: an error in it goes into the pose unseen. `residual` stays that of
    the free centres, which shows whether the cluster is rigid at all.
    """
    number = np.arange(len(motion.time)) if frames is None else np.asarray(frames)
    z, y, x = (float(h) for h in stack.voxel)
    image = optics.image((z, y, x))
    poses: dict[int, Pose] = {}
    for k in motion.fitted.tolist():
        frame = np.asarray(stack.frame(int(number[k])), dtype=np.float64)
        away = np.empty((0, 3))
        if others is not None:
            away = others.loc[others["frame"] == number[k], ["x", "y", "z"]].to_numpy(np.float64)
        found = pose_in(frame, start_of(motion, k), image, optics.noise, others=away)
        if found is not None:
            poses[k] = found
    lost = {k: "the pose fit to the image did not settle" for k in motion.fitted if k not in poses}
    return with_poses(motion, poses, lost=lost)


def start_of(motion: RigidMotion, row: int) -> RigidCenters:
    """Return a body's pose in one row of its motion."""
    return RigidCenters(motion.center[row], motion.rotation[row], motion.template)


def pose_in(
    frame: Floats, start: RigidCenters, image: SphereImage, noise: CameraNoise, *, others: Floats
) -> Pose | None:
    """Fit one pose to one frame; None where the fit does not settle.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
    start : RigidCenters
    image : SphereImage
    noise : CameraNoise
    others : ndarray, shape (m, 3)
        Places (x, y, z) of spheres of other clusters, um.
    """
    window = cut_window(frame, image, start.centers, others=others[:, ::-1])
    if not window.shows(len(start.template)):
        return None
    fit = fit_window(window, image, noise, start)
    pose = fit.arrangement
    if not (fit.converged and isinstance(pose, RigidCenters)):
        return None
    spread = fit.covariance
    return Pose(pose.center, pose.rotation, spread[3:, 3:], float(np.trace(spread[:3, :3]) / 3))


def with_poses(
    motion: RigidMotion, poses: Mapping[int, Pose], *, lost: Mapping[int, str] | None = None
) -> RigidMotion:
    """Return the motion with other poses in some rows, its first one the identity again.

    Parameters
    ----------
    motion : RigidMotion
    poses : mapping
        By row.
    lost : mapping, optional
        Rows that have no pose any more, and why.
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
    )
