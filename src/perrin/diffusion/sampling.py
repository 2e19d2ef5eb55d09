"""How to sample: which time between frames, how many frames, and what data in hand lack."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from perrin._arrays import Floats, as_sigma, frozen, require_positive
from perrin._text import ordinal, percent, short
from perrin.diffusion.bounds import NoiseKnowledge, cramer_rao, whole
from perrin.diffusion.estimate import UNITS
from perrin.errors import UnitWarning
from perrin.geometry.rigid import degrees_of_freedom
from perrin.geometry.shapes import Cluster
from perrin.hydrodynamics.units import length_remarks
from perrin.motion.floor import noise_floor

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from perrin.diffusion.estimate import DiffusionEstimate


# The window in SNR = D_R dt/s. With a given number of frames the error is within 7 % of its limit
# at the first, and within 2 % at the second.
_LEAST_SNR, _AMPLE_SNR = 5.0, 20.0


# The same light divided among more frames: the error is 17 % above its limit at the first SNR and
# 7 % at the second. With the noise from the residuals it is flat within 2 % below the third.
_LIGHT_SNR, _FAINT_SNR, _LIGHT_SNR_RESIDUAL = 0.5, 0.1, 2.0


_LONGEST = 0.1 / 4  # D_R dt up to which steps are small and particles can be told apart


# Half the angle (or distance) to a neighbour, in standard deviations of one step, at which a step
# is confused: by nearest neighbours in 0.04 % of the steps at most, by rigid fits in 0.5 %.
_LINKED, _FITTED = 4.2, 3.3


# Highest rotation axis of the bodies whose symmetry is known: a rigid fit confuses a turn by more
# than half of its angle with a permutation of the particles.
_FOLD = {"T_d": 3, "D_3h": 3, "O_h": 4, "D_5h": 5}


_USUAL_FRAMES = 300  # stated where neither frames nor time are given


_POINTS = 121  # of the curve


@dataclass(frozen=True, eq=False)
class SamplingPlan:
    """When to take frames, and how well D_R can then be known.

    Times are between frames, in s; errors are standard errors over D_R: the least that any
    estimator can have, which `estimate_diffusion` reaches.

    Attributes
    ----------
    dt_min, dt_max : float
        The window: below `dt_min` noise hides the steps (SNR 5; for a given amount of light 0.1),
        above `dt_max` they are too long (4 D_R dt = 0.1, or less where a body of high symmetry is
        confused earlier). It is empty where dt_min > dt_max.
    dt_best : float
        The advice.
    n_frames : int
        Frames that the budget allows at `dt_best`.
    snr : float
        D_R dt/s at `dt_best`, s the noise variance of one orientation angle; in space this is
        4 D_R dt/Phi^2.
    phi2 : float
        Noise floor of the MSAD for the stated sigma, rad^2.
    dt_link, dt_rigid : float
        Longest times over which particles keep their identity: by nearest neighbours (0.04 % of the
        steps wrong at most; where D_T is given the centre moves too), and by the best rigid fit
        (0.5 %).
    paper_dt_min, paper_dt_max : float
        The two rules of Hunter 2011, section 4.1: 4 D_R dt = Phi^2 and 4 D_R dt = 1.
    dt, error, error_residual : ndarray, shape (K,)
        Time between frames, and the error there with the noise estimated along (the default of
        `estimate_diffusion`) and taken from the residuals of the rigid fits.
    axes, residual_dof : int
        Angles that share D_R, and degrees of freedom of one frame's residuals.
    reasons : tuple of str
        Why, and what else to know.
    """

    dt_min: float
    dt_max: float
    dt_best: float
    n_frames: int
    snr: float
    phi2: float
    dt_link: float
    dt_rigid: float
    paper_dt_min: float
    paper_dt_max: float
    dt: Floats
    error: Floats
    error_residual: Floats
    axes: int
    residual_dof: int
    reasons: tuple[str, ...] = ()

    def __str__(self) -> str:
        head = (
            f"{self.n_frames} frames every {self.dt_best:.3g} s: D_R to "
            f"{percent(self.expected_error)}, or {percent(self.expected_error_residual)} with "
            "the noise from the residuals"
        )
        return "\n- ".join((head, *self.reasons))

    @property
    def expected_error(self) -> float:
        """Standard error over D_R of the default estimator at `dt_best`."""
        return self._error(self.n_frames, "joint")

    @property
    def expected_error_residual(self) -> float:
        """The same with the noise taken from the residuals of the rigid fits."""
        return self._error(self.n_frames, "residual")

    def frames_for(self, relative_error: float, *, noise: NoiseKnowledge = "joint") -> int:
        """Return how many frames, `dt_best` apart, bring the standard error down to a share of D_R.

        Parameters
        ----------
        relative_error : float
            Wanted standard error over D_R.
        noise : {"joint", "residual", "known"}
            As in `cramer_rao`; "joint" is the default of `estimate_diffusion`.

        Returns
        -------
        int
            At least 3; of one cluster, or of several together.

        Raises
        ------
        ValueError
            Unless the error is a positive number and the noise one of the three words.
        """
        require_positive(relative_error=relative_error)
        low, high = 2, 3
        while self._error(high, noise) > relative_error:
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            enough = self._error(middle, noise) <= relative_error
            low, high = (low, middle) if enough else (middle, high)
        return high

    def _error(self, n_frames: int, noise: NoiseKnowledge) -> float:
        return cramer_rao(
            n_frames=n_frames,
            snr=self.snr,
            axes=self.axes,
            noise=noise,
            residual_dof=self.residual_dof,
        )


@dataclass(frozen=True)
class _Experiment:
    """What limits a measurement: D_R, noise, and the budget.

    `spread` is the noise variance of one orientation angle; with `photons` that of the movie with
    `n_frames` frames in `total_time`, whose light is then divided anew.
    """

    D_R: float
    spread: float
    axes: int
    residual_dof: int
    n_frames: int | None
    total_time: float | None
    photons: bool

    @classmethod
    def of(
        cls,
        body: Cluster,
        spread: float,
        *,
        D_R: float,
        n_frames: int | None,
        total_time: float | None,
        photons: bool,
    ) -> _Experiment:
        """Add what follows from the body, and the usual budget where none was given."""
        n, d = body.positions.shape
        if n_frames is None and total_time is None:
            n_frames = _USUAL_FRAMES
        dof = int(degrees_of_freedom(np.array(n), d))
        return cls(D_R, spread, 2 * d - 3, dof, n_frames, total_time, photons)

    @property
    def dt_stated(self) -> float | None:
        """The time between frames at which a photon budget's sigma is stated, s."""
        if not self.photons or self.total_time is None or self.n_frames is None:
            return None
        return self.total_time / (self.n_frames - 1)

    @property
    def msad_rate(self) -> float:
        """The slope of the MSAD, rad^2/s."""
        return (4 if self.axes == 3 else 2) * self.D_R

    def snr(self, dt: float) -> float:
        """Return D_R dt over the noise variance that a frame has at that dt."""
        longer_exposure = 1.0 if self.dt_stated is None else dt / self.dt_stated
        return self.D_R * dt / self.spread * longer_exposure

    def dt_at(self, snr: float) -> float:
        """Return the time between frames at which the SNR is that."""
        dt = snr * self.spread / self.D_R
        return dt if self.dt_stated is None else float(np.sqrt(dt * self.dt_stated))

    def frames(self, dt: float) -> int:
        """Return how many frames the budget allows."""
        in_time = np.inf
        if self.total_time is not None:
            # A time that is a whole number of dt up to rounding holds that many steps.
            in_time = int(self.total_time / dt * (1 + 1e-9)) + 1
        limit = np.inf if self.photons or self.n_frames is None else self.n_frames
        return int(min(in_time, limit))

    def error(self, dt: float, noise: NoiseKnowledge) -> float:
        """Return the relative standard error at that dt."""
        return cramer_rao(
            n_frames=self.frames(dt),
            snr=self.snr(dt),
            axes=self.axes,
            noise=noise,
            residual_dof=self.residual_dof,
        )

    def best_dt(self, longest: float) -> float:
        """Return the time between frames that the budget calls for, at most `longest`."""
        if self.photons:
            return min(self.dt_at(_LIGHT_SNR), longest)
        if self.n_frames is None:
            return min(self.dt_at(_LEAST_SNR), longest)
        ample = min(self.dt_at(_AMPLE_SNR), longest)
        if self.total_time is None:
            return ample
        return min(ample, self.total_time / (self.n_frames - 1))


def plan_sampling(
    cluster: Cluster | ArrayLike,
    *,
    D_R: float,
    sigma: ArrayLike,
    D_T: float | None = None,
    n_frames: int | None = None,
    total_time: float | None = None,
    photons: bool = False,
) -> SamplingPlan:
    """Find the time between frames that measures D_R best, and the error to expect.

    Parameters
    ----------
    cluster : Cluster or array_like, shape (n, d)
        The body; positions in um.
    D_R : float
        Rotational diffusion coefficient as far as it is known, rad^2/s.
    sigma : float or array_like, shape (d,)
        Localisation error of one coordinate in one frame, um; one number or one per axis.
    D_T : float, optional
        Translational diffusion coefficient, um^2/s: how far particles travel between frames then
        counts for linking.
    n_frames : int, optional
        The most frames that can be taken.
    total_time : float, optional
        The longest movie, s. With `n_frames` both are limits. Neither: 300 frames.
    photons : bool
        A given amount of light instead of frames (the dye bleaches): it lasts for `total_time` and
        may be divided among any number of frames, sigma^2 being inversely proportional to a frame's
        share. `sigma` is then that of the movie with `n_frames` frames; all three are needed.

    Returns
    -------
    SamplingPlan
        For a given number of frames dt is as long as steps stay small, up to SNR 20. For a given
        time it is the short end of the window (there is no optimum: more frames always help). For
        given light it is where more frames bring little more, SNR 0.5.

    Raises
    ------
    DegenerateClusterError
        If the particles do not fix an orientation.
    ValueError
        For values out of range or a budget that contradicts itself, all in one message.

    Warns
    -----
    UnitWarning
        If sigma is larger than the cluster, or the nearest particles are less than 0.05 or more
        than 50 um apart.

    Notes
    -----
    Errors are the Cramér-Rao bound of `cramer_rao` without motion blur. Two particles are confused
    when a step covers half the way from one to the other; that way has a standard deviation of
    sqrt(2 D_R dt) in angle.

    Examples
    --------
    >>> from perrin import Cluster
    >>> plan = plan_sampling(
    ...     Cluster.touching(4, 2.45), D_R=4.93e-3, sigma=(0.03, 0.03, 0.04), n_frames=300
    ... )
    >>> round(plan.dt_min, 3), round(plan.dt_best, 3), round(plan.dt_max, 3)
    (0.191, 0.766, 5.071)
    >>> round(100 * plan.expected_error, 1), plan.frames_for(0.03)
    (8.3, 2297)
    """
    body = cluster if isinstance(cluster, Cluster) else Cluster.from_positions(cluster)
    _check(body, D_R, sigma, D_T, n_frames, total_time, photons=photons)
    for remark in _unit_remarks(body, sigma):
        warnings.warn(remark, UnitWarning, stacklevel=2)
    floor = noise_floor(body, sigma=sigma)
    experiment = _Experiment.of(
        body,
        float(np.trace(floor.covariance)) / len(floor.covariance),
        D_R=D_R,
        n_frames=n_frames,
        total_time=total_time,
        photons=photons,
    )
    dt_link, dt_rigid = _identity_limits(body, D_R, D_T or 0.0)
    dt_max = min(_LONGEST / D_R, dt_rigid)
    dt_best = experiment.best_dt(dt_max)
    if experiment.frames(dt_best) < 3:
        raise ValueError(
            f"total_time = {total_time!r} s holds fewer than 3 frames at their best distance, "
            f"{dt_best:.3g} s: the cluster hardly turns in it"
        )
    dt, error, error_residual = _curve(experiment, dt_best, 1.5 / experiment.msad_rate)
    plan = SamplingPlan(
        dt_min=experiment.dt_at(_FAINT_SNR if photons else _LEAST_SNR),
        dt_max=dt_max,
        dt_best=dt_best,
        n_frames=experiment.frames(dt_best),
        snr=experiment.snr(dt_best),
        phi2=floor.phi2,
        dt_link=dt_link,
        dt_rigid=dt_rigid,
        paper_dt_min=experiment.dt_at(1.0),
        paper_dt_max=1 / experiment.msad_rate,
        dt=dt,
        error=error,
        error_residual=error_residual,
        axes=experiment.axes,
        residual_dof=experiment.residual_dof,
    )
    return replace(plan, reasons=_reasons(plan, experiment, body, D_T))


def _check(
    body: Cluster,
    D_R: float,
    sigma: ArrayLike,
    D_T: float | None,
    n_frames: int | None,
    total_time: float | None,
    *,
    photons: bool,
) -> None:
    """Refuse values out of range and budgets that contradict themselves, all in one message."""
    positive = {"D_R": D_R} | ({} if total_time is None else {"total_time": total_time})
    faults = _faults(lambda: require_positive(**positive))
    faults += _faults(lambda: _require_noise(sigma, body.positions.shape[1]))
    if D_T is not None and not (np.ndim(D_T) == 0 and 0 <= D_T < np.inf):
        faults.append(f"D_T: expected a finite number >= 0 (um^2/s), got {D_T!r}")
    if n_frames is not None and not whole(n_frames, least=3):
        faults.append(f"n_frames: expected a whole number >= 3, got {n_frames!r}")
    if photons and (n_frames is None or total_time is None):
        faults.append(
            "photons: expected n_frames and total_time too, the movie for which sigma is stated"
        )
    if not _distances(body).all():
        faults.append("cluster: two of its particles are at the same place")
    if faults:
        raise ValueError("; ".join(faults))


def _faults(check: Callable[[], None]) -> list[str]:
    """Return what a check complains about."""
    try:
        check()
    except ValueError as error:
        return [str(error)]
    return []


def _require_noise(sigma: ArrayLike, dimensions: int) -> None:
    if not as_sigma(sigma, dimensions).any():
        raise ValueError("sigma: expected more than 0 um; without noise there is nothing to plan")


def _unit_remarks(body: Cluster, sigma: ArrayLike) -> list[str]:
    """Return a line for each length that is possible, but usual only in another unit."""
    remarks = length_remarks("the distance of the nearest particles", float(_distances(body).min()))
    largest = as_sigma(sigma, body.positions.shape[1]).max()
    if largest > body.R:
        remarks.append(
            f"sigma: {largest:.4g} um is more than the mean distance of the particles to the "
            f"centre, R = {body.R:.4g} um: no orientation can be measured so; if sigma is in nm, "
            f"state {1e-3 * largest:.4g}"
        )
    return remarks


def _distances(body: Cluster) -> Floats:
    """Return the distances (um) of all pairs of particles."""
    first, second = np.triu_indices(len(body.positions), 1)
    distances: Floats = np.linalg.norm(body.positions[first] - body.positions[second], axis=1)
    return distances


def _identity_limits(body: Cluster, D_R: float, D_T: float) -> tuple[float, float]:
    """Return the longest dt for linking by nearest neighbours, and for assignment by rigid fits.

    A turn by `angle` brings a particle half the way to another one, as does a shift by `half`.
    """
    first, second = np.triu_indices(len(body.positions), 1)
    start, way = body.positions[first], body.positions[second] - body.positions[first]
    half = _distances(body) / 2
    middle = start + way * (-np.sum(start * way, axis=1) / (4 * half**2))[:, None]
    angle = np.arctan2(half, np.linalg.norm(middle, axis=1))
    spread = 2 * D_T + 2 * D_R * (half / angle) ** 2
    # Without a known symmetry: no permutation turns the body by less than neighbours are apart.
    turn = np.pi / _FOLD[body.symmetry] if body.symmetry in _FOLD else float(angle.min())
    dt_link = float(np.min(half**2 / spread)) / _LINKED**2
    return dt_link, float(turn**2 / (2 * D_R)) / _FITTED**2


def _curve(
    experiment: _Experiment, dt_best: float, longest: float
) -> tuple[Floats, Floats, Floats]:
    """Return dt and the two errors there, from a little below what anyone would try."""
    low, high = min(dt_best, experiment.dt_at(1.0)) / 4, longest
    if experiment.total_time is not None:
        high = min(high, experiment.total_time / 9)  # ten frames: fewer go in visible jumps
    dt = np.geomspace(low, max(high, dt_best), _POINTS)
    joint = np.array([experiment.error(float(t), "joint") for t in dt])
    residual = np.array([experiment.error(float(t), "residual") for t in dt])
    frozen(dt, joint, residual)
    return dt, joint, residual


def _reasons(
    plan: SamplingPlan, experiment: _Experiment, body: Cluster, D_T: float | None
) -> tuple[str, ...]:
    """Say in words why the plan is what it is."""
    said = [_about_window(plan, experiment), _about_budget(plan, experiment)]
    said.append(_about_identity(plan, centre_moves=D_T is not None))
    if D_T is not None:
        said.append(_about_travel(plan, experiment, body, D_T))
    said.append(_about_paper(plan, experiment))
    bias = experiment.D_R * plan.dt_best / 6
    if experiment.axes == 3 and bias > plan.expected_error / 3:
        said.append(
            f"Steps of this length make D_R {percent(bias)} too small, which counts beside the "
            "expected error: take shorter steps or correct for it."
        )
    return tuple(said)


def _about_window(plan: SamplingPlan, experiment: _Experiment) -> str:
    least = _FAINT_SNR if experiment.photons else _LEAST_SNR
    if plan.dt_min > plan.dt_max:
        return (
            f"The window is empty: SNR {least:g} needs {plan.dt_min:.3g} s, but steps are small "
            f"and particles told apart only up to {plan.dt_max:.3g} s. Stay there, and buy frames "
            "or particles (more clusters, or larger ones)."
        )
    return (
        f"Window {plan.dt_min:.3g} to {plan.dt_max:.3g} s: from SNR = {least:g} to 4 D_R dt = "
        f"{4 * experiment.D_R * plan.dt_max:.2g}."
    )


def _about_budget(plan: SamplingPlan, experiment: _Experiment) -> str:
    if experiment.photons:
        return (
            f"Given light: the error is nearly flat below SNR {_LIGHT_SNR:g}, and below SNR "
            f"{_LIGHT_SNR_RESIDUAL:g} ({experiment.dt_at(_LIGHT_SNR_RESIDUAL):.3g} s) with the "
            "noise from the residuals. The camera's own noise is not counted: it is a reason for "
            "fewer frames."
        )
    if experiment.n_frames is None:
        more = plan.dt_best / 5
        return (
            "Given time: there is no optimum, more frames always help, but slowly: five times as "
            f"many (every {more:.3g} s) would give {percent(experiment.error(more, 'joint'))}. "
            "Disk and bleaching set dt."
        )
    if experiment.total_time is not None:
        return _about_both(plan, experiment.total_time)
    return (
        f"Given frames ({experiment.n_frames}): longer steps are better; beyond SNR "
        f"{_AMPLE_SNR:g} the error falls by less than 2 % of itself."
    )


def _about_both(plan: SamplingPlan, total_time: float) -> str:
    lasts = plan.dt_best * (plan.n_frames - 1)
    if lasts < 0.999 * total_time:
        return (
            f"Given frames and time: the {plan.n_frames} frames are taken in {lasts:.3g} s; "
            f"stretching them over all of {total_time:.3g} s would gain little or lose particles."
        )
    below = plan.dt_best < plan.dt_min
    limited = " That is below the window: time more than frames limits the error." if below else ""
    return (
        f"Given frames and time: all {plan.n_frames} frames, evenly over {total_time:.3g} s, "
        f"SNR {short(plan.snr)}.{limited}"
    )


def _about_identity(plan: SamplingPlan, *, centre_moves: bool) -> str:
    proviso = "" if centre_moves else ", if the centre's motion is removed first"
    verdict = ": do that here" if plan.dt_best > plan.dt_link else ""
    return (
        f"Identity: nearest-neighbour linking keeps particles apart up to {plan.dt_link:.3g} s"
        f"{proviso}; assignment by the best rigid fit up to {plan.dt_rigid:.3g} s{verdict}."
    )


def _about_travel(plan: SamplingPlan, experiment: _Experiment, body: Cluster, D_T: float) -> str:
    shift = np.sqrt(2 * body.positions.shape[1] * D_T * plan.dt_best)
    turn = body.R * np.sqrt(experiment.msad_rate * plan.dt_best)
    return (
        f"Between frames the centre moves {shift:.2g} um and the turn moves a particle "
        f"{turn:.2g} um (rms); the nearest particles are {_distances(body).min():.3g} um apart."
    )


def _about_paper(plan: SamplingPlan, experiment: _Experiment) -> str:
    cost = ""
    if experiment.frames(plan.paper_dt_min) >= 3:
        cost = f", error {percent(experiment.error(plan.paper_dt_min, 'joint'))}"
    return (
        f"The paper's rules: {plan.paper_dt_min:.3g} s (SNR 1{cost}) to {plan.paper_dt_max:.3g} s, "
        "at which nearest-neighbour linking is wrong in a third of the steps or more."
    )


@dataclass(frozen=True)
class SamplingVerdict:
    """How the time between frames of a measurement compares with the best one.

    Attributes
    ----------
    text : str
        The verdict in words; also what ``print`` shows.
    factor : float
        The best time between frames over that of the data: above 1 the data are oversampled.
    dt, dt_best : float
        Both times, s.
    snr : float
        D dt/s of the data.
    error, bound, bound_best : float
        Standard error over D: as estimated; the Cramér-Rao bound with the noise unknown; that bound
        for as many frames, `dt_best` apart.
    """

    text: str
    factor: float
    dt: float
    dt_best: float
    snr: float
    error: float
    bound: float
    bound_best: float

    def __str__(self) -> str:
        return self.text


def judge_sampling(estimate: DiffusionEstimate, *, axes: int = 3) -> SamplingVerdict:
    """Say whether the frames of a measurement were too close, too far apart, or right.

    Parameters
    ----------
    estimate : DiffusionEstimate
        D_R or D_T, from `estimate_diffusion`. Where it is not resolved its 95 % limit is taken for
        D, and the verdict is on the cautious side.
    axes : {3, 2, 1}
        Axes that share D: 3 in space; in the plane 1 for D_R and 2 for D_T.

    Returns
    -------
    SamplingVerdict
        `dt_best` is that of `plan_sampling` for as many frames: SNR 20, and for D_R not beyond
        4 D_R dt = 0.1. D_T has no such limit: only SNR counts.

    Raises
    ------
    ValueError
        If the estimate carries no dt, or has neither a value nor an upper limit.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, estimate_diffusion, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.06, n_frames=300, rng=3)
    >>> noisy = add_noise(truth.positions(), sigma=0.03, rng=3)
    >>> verdict = judge_sampling(estimate_diffusion(track_rotation(noisy, dt=0.06)))
    >>> print(str(verdict).partition(":")[0])
    Oversampled 11 times (SNR 1.8, 4 D_R dt = 0.0011)
    """
    D = estimate.value if estimate.resolved else estimate.ci95[1]
    if not (estimate.dt > 0 and 0 < D < np.inf):
        raise ValueError(
            f"estimate: expected a time between frames and a D above 0, or a limit to it, got "
            f"dt = {estimate.dt:g} s and D = {D:g} {estimate.unit}; use estimate_diffusion"
        )
    if np.isnan(estimate.snr):
        raise ValueError(
            "estimate: the localisation noise under it is not known (a curve of positions has no "
            "rigid-fit residuals); use estimate_diffusion on a motion"
        )
    # Without a value the offset is all there is; that of a straight line may lie below zero.
    no_value = max(estimate.offset, 0.0)
    spread = estimate.value * estimate.dt / estimate.snr if estimate.value > 0 else no_value
    rotation = estimate.unit == UNITS["rotation"]
    dt_best = min(_AMPLE_SNR * spread / D, _LONGEST / D if rotation else np.inf)
    snr, best_snr = (D * t / spread if spread > 0 else np.inf for t in (estimate.dt, dt_best))
    verdict = SamplingVerdict(
        text="",
        factor=dt_best / estimate.dt,
        dt=estimate.dt,
        dt_best=dt_best,
        snr=snr,
        error=estimate.stderr / estimate.value if estimate.value > 0 else np.inf,
        bound=_bound(estimate.n_frames, snr, axes),
        bound_best=_bound(estimate.n_frames, best_snr, axes),
    )
    said = [] if estimate.resolved else ["Not resolved: judged at the 95 % limit of D."]
    said += [_about_step(verdict, estimate, axes=axes, step=4 * D * estimate.dt * rotation)]
    said += [_about_error(verdict, estimate)]
    return replace(verdict, text=" ".join(said))


def _bound(n_frames: int, snr: float, axes: int) -> float:
    """Return the bound, to rounding that without noise where the SNR is beyond any measurement."""
    return cramer_rao(n_frames=n_frames, snr=min(snr, 1e12), axes=axes)


def _about_step(
    verdict: SamplingVerdict, estimate: DiffusionEstimate, *, axes: int, step: float
) -> str:
    """Say how dt compares with the window; `step` is 4 D_R dt, 0 for D_T."""
    state = f"SNR {short(verdict.snr)}" + (f", 4 D_R dt = {step:.2g}" if step else "")
    if step > 4 * _LONGEST:
        return _about_long_steps(verdict, state, step)
    if verdict.snr >= _LEAST_SNR:
        return f"Well sampled ({state}): more frames are all that would help."
    least = "" if estimate.resolved else "at least "
    every = max(round(verdict.factor), 1)
    thinned = _bound(max(estimate.n_frames // every, 3), every * verdict.snr, axes)
    return (
        f"Oversampled {least}{short(verdict.factor)} times ({state}): in a longer movie every "
        f"{ordinal(every)} frame would have done; as many frames every {verdict.dt_best:.3g} s "
        f"could have given {percent(verdict.bound_best)} instead of {percent(verdict.bound)}. Of "
        f"this movie use all frames: every {ordinal(every)} alone gives {percent(thinned)}."
    )


def _about_long_steps(verdict: SamplingVerdict, state: str, step: float) -> str:
    slow = f" and D_R reads {percent(step / 24)} low" if step > 0.2 else ""
    said = (
        f"Undersampled ({state}): beyond 4 D_R dt = {4 * _LONGEST:g} particles can be confused"
        f"{slow}. Take frames every {verdict.dt_best:.3g} s, {short(1 / verdict.factor)} times "
        "closer."
    )
    if verdict.snr * verdict.factor < _LEAST_SNR:
        said += " Noise is then large: buy frames or particles."
    return said


def _about_error(verdict: SamplingVerdict, estimate: DiffusionEstimate) -> str:
    if verdict.error == np.inf:
        return f"The bound for {estimate.n_frames} frames is {percent(verdict.bound)}."
    said = (
        f"Standard error {percent(verdict.error)}, the bound with the noise unknown "
        f"{percent(verdict.bound)}."
    )
    worth = (verdict.bound / verdict.error) ** 2
    if worth < 0.6:
        said += (
            f" The estimate [{estimate.method}] is worth {percent(worth)} of its frames: look at "
            "gaps, missing particles and the method."
        )
    return said
