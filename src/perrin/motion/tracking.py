"""Fits of a rigid body to particle positions: its motion, or the positions without it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import (
    Bools,
    Floats,
    Ints,
    as_positions,
    as_sigma,
    choice_fault,
    count_present,
    number_fault,
    present,
    refuse,
    require_positive,
    stored_once,
)
from perrin._text import counted
from perrin.geometry.rotations import successive_product
from perrin.motion.degenerate import mean_present, no_orientation, require_points
from perrin.motion.procrustes import (
    PoseFit,
    chain_steps,
    fit_chain,
    fit_template,
    fit_templates,
    fit_weighted,
    pose_errors,
    step_residuals,
)
from perrin.motion.rigid_motion import RigidMotion
from perrin.motion.scanning import fit_scanned

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin.errors import DegenerateClusterError, TooFewFramesError

Reference = Literal["template", "previous"]

Weights = Literal["equal", "sigma"]

# Standard deviation (rad) of the orientation about its most uncertain axis above which a pose is
# refused: the particles lie on a line within the noise, and small-angle errors no longer hold.
_LOST_AXIS = 0.3


def track_rotation(
    positions: ArrayLike,
    *,
    dt: float,
    frames: ArrayLike | None = None,
    times: ArrayLike | None = None,
    reference: Reference = "template",
    sigma: ArrayLike | None = None,
    weights: Weights = "equal",
    piece: ArrayLike | None = None,
    delays: ArrayLike | None = None,
    crossing: float = 0.0,
) -> RigidMotion:
    """Fit a rigid body to a cluster's particles in every frame and return its motion.

    Parameters
    ----------
    positions : array_like, shape (T, n, d)
        Particle centres, um, d = 2 or 3; NaN where a particle is missing. A column is the
        same particle in all frames.
    dt : float
        Time between frames, s.
    frames : array_like of int, shape (T,), optional
        Frame numbers of the rows, rising; missing numbers are gaps. Default 0, 1, 2, ...
    times : array_like, shape (T,), optional
        Times of the rows, s, where frames are not evenly spaced.
    reference : {"template", "previous"}
        "template" fits every frame to one common shape built from all frames (generalised
        Procrustes). "previous" is the paper's product of successive rotations (Hunter 2011,
        Eq. 13), whose orientation drifts under noise.
    sigma : float or array_like, shape (d,), optional
        Known localisation error, um, for `covariance`; default: from the residuals. With
        ``weights="sigma"`` also (n, 1) or (n, d), one for each particle.
    weights : {"equal", "sigma"}
        "sigma" weighs every coordinate of every particle with 1/sigma^2 (poses, not the template):
        for a tetrahedron the variance of the orientation falls to 0.94, 0.70 and 0.42 where sigma_z
        is 1.33, 2 and 3 times sigma_xy.
    piece : array_like of int, shape (T,), optional
        Pieces of the track within which identity is certain, as `settle_identity` finds them; no
        pair of frames is formed across two of them. Default: one piece.
    delays : array_like, shape (T, n), optional
        Time of each particle after that of its frame, s, where particles are recorded one after
        another, as by planes of a scan; NaN where a particle is missing. The body moves between
        them: poses are those at the mean time of the particles of each frame, fitted by
        generalised least squares, with the errors that this motion leaves.
    crossing : float
        Time in which the planes through one particle are recorded, s, where there are `delays`.

    Returns
    -------
    RigidMotion
        Frames that cannot be fitted are missing, with their reason.

    Raises
    ------
    DegenerateClusterError
        If there are fewer than 3 particles (2 in the plane), or they lie on one line within the
        noise.
    TooFewFramesError
        If there are fewer than 2 frames with a pose.
    ValueError
        If a shape or value is not valid.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin import Cluster, simulate_motion, track_rotation
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=50, rng=np.random.default_rng(1)
    ... )
    >>> motion = track_rotation(truth.positions(), dt=0.7)
    >>> bool(np.allclose(motion.rotation, truth.rotation))
    True
    """
    x = as_positions(positions)
    require_positive(dt=dt)
    refuse(
        [
            *choice_fault("reference", reference, ("template", "previous")),
            *choice_fault("weights", weights, ("equal", "sigma")),
            *number_fault("crossing", crossing, least=0, unit="s"),
        ]
    )
    time = _row_times(len(x), dt=dt, frames=frames, times=times)
    pieces = np.zeros(len(x), dtype=np.int64) if piece is None else np.asarray(piece)
    if pieces.shape != (len(x),) or not np.issubdtype(pieces.dtype, np.integer):
        raise ValueError(
            f"piece: expected {len(x)} whole numbers (one a row), got {pieces.dtype} of shape "
            f"{pieces.shape}"
        )
    seen = present(x)
    if delays is not None:
        if reference != "template" or weights != "equal":
            raise ValueError(
                'delays weigh particles by their times: they need reference="template" and '
                'weights="equal"'
            )
        motion, _ = track_scanned(
            x, delays, time=time, dt=dt, sigma=sigma, piece=pieces, crossing=crossing
        )
    elif weights == "equal":
        known = None if sigma is None else as_sigma(sigma, x.shape[2])
        require_points(seen, x.shape[2])
        fit = fit_chain(x, seen) if reference == "previous" else fit_template(x, seen)
        motion = _motion_of(fit, x, seen, time=time, dt=dt, sigma=known)
    elif sigma is None or reference != "template":
        raise ValueError('weights="sigma" needs sigma, and reference="template"')
    else:
        known = np.asarray(sigma, dtype=np.float64)
        if known.shape not in ((x.shape[1], 1), x.shape[1:]):
            known = as_sigma(sigma, x.shape[2])
        known = np.broadcast_to(known, x.shape[1:])
        if not (np.isfinite(known) & (known > 0)).all():
            raise ValueError(f"sigma: expected finite numbers > 0 for the weights, got {sigma!r}")
        require_points(seen, x.shape[2])
        fit, errors = fit_weighted(fit_template(x, seen), x, seen, known**2)
        mean = known.mean(axis=0)
        motion = _motion_of(fit, x, seen, time=time, dt=dt, sigma=mean, errors=errors)
    return replace(motion, piece=np.array(pieces, dtype=np.int64))


def track_scanned(
    x: Floats,
    delays: ArrayLike,
    *,
    time: Floats,
    dt: float,
    piece: Ints,
    sigma: ArrayLike | None = None,
    crossing: float = 0.0,
    least: Floats | None = None,
) -> tuple[RigidMotion, Floats]:
    """Fit a body whose particles are recorded at their own times, for positions already checked.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
        Positions, um, NaN where missing.
    delays : array_like, shape (T, n)
        Time of each particle after that of its frame, s.
    time : ndarray, shape (T,)
        Time of each frame, s.
    dt : float
        Time between frames, s.
    piece : ndarray of int, shape (T,)
        Pieces of the track.
    sigma : float or array_like, shape (d,), optional
        Known localisation error, um; default: from the residuals.
    crossing : float
        Time in which the planes through one particle are recorded, s.
    least : ndarray, shape (d,), optional
        Smallest localisation error of each axis that is possible, um.

    Returns
    -------
    motion : RigidMotion
        Poses at the mean time of the particles of each frame.
    instant : ndarray, shape (T, n, d)
        Positions at that time, as far as the particles determine them, um.

    Raises
    ------
    DegenerateClusterError, TooFewFramesError, ValueError
        As in `track_rotation`.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=50, rng=1)
    >>> x = truth.positions()
    >>> _, instant = track_scanned(
    ...     x, np.zeros((50, 4)), time=truth.time, dt=0.7, piece=truth.piece
    ... )
    >>> bool(np.allclose(instant, x))
    True
    """
    seen = present(x)
    known = None if sigma is None else as_sigma(sigma, x.shape[2])
    require_points(seen, x.shape[2])
    own_times = np.asarray(delays, dtype=np.float64)
    if own_times.shape != seen.shape:
        raise ValueError(
            f"delays: expected an array {seen.shape}, a time (s) for each particle in each frame, "
            f"got shape {own_times.shape}"
        )
    unknown = seen & ~np.isfinite(own_times)
    if unknown.any():
        row, particle = (int(k[0]) for k in np.nonzero(unknown))
        raise ValueError(
            f"delays: {counted(int(unknown.sum()), 'particle', 'have')} coordinates but no time, "
            f"the first is particle {particle} in row {row}: state all times, or leave these "
            "particles out (NaN)"
        )
    scanned = fit_scanned(
        x, seen, own_times, time=time, piece=piece, sigma=known, crossing=crossing, least=least
    )
    errors = scanned.covariance, scanned.center_variance
    motion = _motion_of(scanned.fit, x, seen, time=time, dt=dt, sigma=scanned.noise, errors=errors)
    lost = np.isnan(motion.center[:, 0])
    motion = replace(
        motion,
        piece=np.array(piece, dtype=np.int64),
        turn_noise=np.where(lost[:, None, None], np.nan, scanned.turn_noise),
        shift_noise=np.where(lost, np.nan, scanned.center_noise),
    )
    return motion, scanned.instant


def track_each(
    positions: Floats,
    *,
    time: Floats,
    dt: float,
    sigma: Floats | None = None,
    piece: Ints | None = None,
) -> list[RigidMotion | DegenerateClusterError | TooFewFramesError | ValueError]:
    """Fit each of several bodies to its common shape, as `track_rotation`, all of them together.

    Parameters
    ----------
    positions : ndarray, shape (B, T, n, d)
        Positions of B bodies of n particles, um, NaN where missing.
    time : ndarray, shape (B, T)
        Time of each frame, s.
    dt : float
        Time between frames, s.
    sigma : ndarray, shape (d,), optional
        Known localisation error, um; default: from the residuals.
    piece : ndarray of int, shape (B, T), optional
        Pieces of the tracks; default: one piece.

    Returns
    -------
    list of RigidMotion, DegenerateClusterError, TooFewFramesError or ValueError
        The error that `track_rotation` raises, where there is no motion.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=50, rng=1)
    >>> x = np.stack([truth.positions(), truth.positions() + 9.0])
    >>> motions = track_each(x, time=np.stack([truth.time] * 2), dt=0.7)
    >>> bool(np.allclose(motions[0].rotation, motions[1].rotation))
    True
    """
    found: list[RigidMotion | DegenerateClusterError | TooFewFramesError | ValueError | None]
    found = [None] * len(positions)
    seen = present(positions)
    for k, here in enumerate(seen):
        try:
            require_points(here, positions.shape[3])
        except ValueError as error:
            found[k] = error
    rows = np.array([k for k, one in enumerate(found) if one is None], dtype=np.int64)
    if rows.size:
        some, here = positions[rows], seen[rows]
        fit, faults = fit_templates(some, here)
        pieces = None if piece is None else piece[rows]
        motions = _motions_of(
            fit, faults, some, here, time=time[rows], dt=dt, sigma=sigma, piece=pieces
        )
        for k, motion in zip(rows.tolist(), motions, strict=True):
            found[k] = motion
    return [one for one in found if one is not None]


def remove_rotation(
    positions: ArrayLike, *, dt: float = 1.0, frames: ArrayLike | None = None
) -> tuple[Floats, RigidMotion]:
    """Remove the bulk rotation and drift of a many-body system (Hunter 2011, conclusion).

    The rotation between successive frames is fitted to the particles present in both, whose own
    diffusion acts as noise; the product of the steps (Eq. 13) is then reversed.

    Parameters
    ----------
    positions : array_like, shape (T, n, d)
        Particles that diffuse in a frame that turns and drifts, um; NaN where missing.
    dt : float
        Time between frames, s.
    frames : array_like of int, shape (T,), optional
        Frame numbers of the rows.

    Returns
    -------
    positions : ndarray, shape (T, n, d)
        Positions in the axes of the first fitted frame, about the centre of the particles' mean
        positions, um; NaN in frames without a pose.
    motion : RigidMotion
        Motion that was removed.

    Raises
    ------
    DegenerateClusterError, TooFewFramesError
        As in `track_rotation`.
    ValueError
        If a shape or value is not valid, or a particle is present only in frames without a pose.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin import Cluster, remove_rotation, simulate_motion
    >>> truth = simulate_motion(Cluster.touching(7, 2.0), D_R=1e-3, dt=1.0, n_frames=50, rng=0)
    >>> still, motion = remove_rotation(truth.positions())
    >>> bool(np.allclose(still, still[0]))
    True
    """
    x = as_positions(positions)
    require_positive(dt=dt)
    time = _row_times(len(x), dt=dt, frames=frames, times=None)
    seen = present(x)
    require_points(seen, x.shape[2])
    usable = seen
    while True:
        rows, step = chain_steps(x, usable)
        shift, residual, sigma2 = step_residuals(x, usable, rows, step)
        rotation = np.full((len(x), x.shape[2], x.shape[2]), np.nan)
        rotation[rows] = successive_product(step)
        # c_{k+1} = R^k c_k + v^k becomes a sum in the axes of the body.
        jumps = np.einsum("tji,tj->ti", rotation[rows[1:]], shift)
        origin = np.concatenate([mean_present(x[rows[:1]], axis=-2), jumps]).cumsum(axis=0)
        center = np.full((len(x), x.shape[2]), np.nan)
        center[rows] = np.einsum("tij,tj->ti", rotation[rows], origin)
        body = np.einsum("tji,tnj->tni", rotation, x - center[:, None])
        mean = mean_present(body, axis=0)
        middle = mean_present(mean, axis=-2)
        fit = PoseFit(rotation, center + rotation @ middle, mean - middle, residual, sigma2)
        motion = _motion_of(fit, x, seen, time=time, dt=dt)
        uncertain = np.isfinite(fit.center[:, 0]) & np.isnan(motion.center[:, 0])
        if not uncertain.any():
            return body - middle, motion
        # The error of a frame with an uncertain rotation would remain in all later frames.
        usable = usable & ~uncertain[:, None]


def _row_times(
    count: int, *, dt: float, frames: ArrayLike | None, times: ArrayLike | None
) -> Floats:
    """Return the time of each row, from times, or from frame numbers, or from the count."""
    if frames is not None and times is not None:
        raise ValueError("frames and times both give the times of the rows: give one of them")
    source = times if times is not None else frames
    t = np.arange(count, dtype=np.float64) if source is None else np.array(source, np.float64)
    name = "frames" if times is None else "times"
    if t.shape != (count,):
        raise ValueError(f"{name}: expected {count} numbers (one a row), got shape {t.shape}")
    bad = ~np.isfinite(t) | np.append(False, ~(np.diff(t) > 0))
    if bad.any():
        k = int(np.argmax(bad))
        raise ValueError(f"{name}: expected finite, rising numbers, got {t[k]} at row {k}")
    return t if times is not None else t * dt


def _motion_of(
    fit: PoseFit,
    x: Floats,
    seen: Bools,
    *,
    time: Floats,
    dt: float,
    sigma: Floats | None = None,
    errors: tuple[Floats, Floats] | None = None,
) -> RigidMotion:
    """Return the motion of fitted poses with their errors, without the poses too uncertain."""
    together = PoseFit(*(np.asarray(part)[None] for part in fit))
    given = None if errors is None else (errors[0][None], errors[1][None])
    motion = _motions_of(
        together, [None], x[None], seen[None], time=time[None], dt=dt, sigma=sigma, errors=given
    )[0]
    if not isinstance(motion, RigidMotion):
        raise motion
    return motion


def _motions_of(
    fit: PoseFit,
    faults: Sequence[DegenerateClusterError | TooFewFramesError | None],
    x: Floats,
    seen: Bools,
    *,
    time: Floats,
    dt: float,
    sigma: Floats | None = None,
    errors: tuple[Floats, Floats] | None = None,
    piece: Ints | None = None,
) -> list[RigidMotion | DegenerateClusterError | TooFewFramesError]:
    """Return the motions of the fitted poses of several bodies, or why there is none."""
    d = x.shape[3]
    sigma2 = np.asarray(fit.sigma2)
    own = sigma2[:, None] if sigma is None else sigma**2
    noise = np.broadcast_to(own, (len(x), d))
    covariance, variance = pose_errors(fit, seen, noise) if errors is None else errors
    # The largest variance of an orientation about any axis is at most their sum.
    lost = np.trace(covariance, axis1=2, axis2=3) > _LOST_AXIS**2
    worst = np.sqrt(np.linalg.eigvalsh(covariance[lost])[:, -1])
    lost[lost] = worst > _LOST_AXIS
    fitted = np.isfinite(fit.rotation[..., 0, 0]) & ~lost
    square = np.einsum("btni,btni->btn", fit.residual, fit.residual)
    if not seen.all():
        square = np.where(seen, square, np.nan)
    distance = np.sqrt(mean_present(square, axis=2))
    count = count_present(seen)
    center, rotation = fit.center, fit.rotation
    if not fitted.all():
        nan = np.where(fitted, 0.0, np.nan)
        center, rotation = center + nan[..., None], rotation + nan[..., None, None]
        covariance, variance = covariance + nan[..., None, None], variance + nan
        distance = distance + nan
    # Why frames have no pose; the texts are those of all numbers of particles.
    numbers = range(x.shape[2] + 1)
    few = [f"{c} of {numbers[-1]} particles, {d} needed" if c else "no particles" for c in numbers]
    near = [
        f"the {c} particles present lie too near one line for their noise: the orientation is "
        f"uncertain by over {_LOST_AXIS} rad"
        for c in numbers
    ]
    unfixed = [f"the {c} particles present do not fix a rotation" for c in numbers]
    why = np.full(fitted.shape, "", dtype=object)
    c = count[~fitted]
    texts = [np.array(part)[c] for part in (few, near, unfixed)]
    why[~fitted] = np.select([c < d, lost[~fitted]], texts[:2], texts[2])
    pieces = np.zeros(fitted.shape, dtype=np.int64) if piece is None else piece
    motions: list[RigidMotion | DegenerateClusterError | TooFewFramesError] = []
    for k, fault in enumerate(faults):
        if fault is None and fitted[k].sum() < 2:
            frames = tuple(np.flatnonzero(lost[k]).tolist())
            fault = no_orientation(x[k], fit.template[k], float(np.sqrt(noise[k].mean())), frames)
        if fault is not None:
            motions.append(fault)
            continue
        motions.append(
            RigidMotion(
                time=time[k],
                center=center[k],
                rotation=rotation[k],
                residual=distance[k],
                n_present=count[k],
                covariance=stored_once(covariance[k]),
                center_variance=stored_once(variance[k]),
                piece=pieces[k],
                reason=tuple(why[k].tolist()),
                template=fit.template[k],
                sigma=float(np.sqrt(sigma2[k])),
                noise=np.sqrt(noise[k]),
                dt=float(dt),
            )
        )
    return motions
