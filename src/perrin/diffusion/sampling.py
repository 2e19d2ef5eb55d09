"""Planning of measurements: best time between frames, their number, a verdict on given data."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import (
    Floats,
    as_sigma,
    from_plain,
    frozen,
    number_fault,
    refuse,
    require_positive,
    sigma_fault,
    to_plain,
)
from perrin._display import Shown
from perrin._text import ordinal, percent, short
from perrin.diffusion.bounds import NoiseKnowledge, cramer_rao
from perrin.diffusion.estimate import UNITS
from perrin.errors import UnitWarning
from perrin.geometry.rigid import degrees_of_freedom
from perrin.geometry.shapes import Cluster, pair_distances
from perrin.hydrodynamics.units import length_remarks
from perrin.motion.floor import noise_floor

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin.diffusion.estimate import DiffusionEstimate

# The window in SNR = D_R dt/s. With a given number of frames the error is within 7 % of its limit
# at the first, and within 2 % at the second.
_LEAST_SNR, _AMPLE_SNR = 5.0, 20.0

# The same photons divided among more frames: the error is 17 % above its limit at the first SNR and
# 7 % at the second. With the noise from the residuals it is flat within 2 % below the third.
_PHOTON_SNR, _LEAST_PHOTON_SNR, _PHOTON_SNR_RESIDUAL = 0.5, 0.1, 2.0

# D_R dt up to which steps are small and nearest neighbours are linked correctly: 4 D_R dt = 0.1.
_LONGEST_STEP = 0.1 / 4

# Half the angle (or distance) to a neighbour, in standard deviations of one step, at which a step
# is confused: by nearest neighbours in 0.04 % of the steps at most, by rigid fits in 0.5 %.
_LINKING_DEVIATIONS, _FITTING_DEVIATIONS = 4.2, 3.3

# Highest rotation axis of the bodies whose symmetry is known: a rigid fit confuses a turn by more
# than half of its angle with a permutation of the particles.
_HIGHEST_FOLD = {"T_d": 3, "D_3h": 3, "O_h": 4, "D_5h": 5}

_DEFAULT_FRAMES = 300  # where neither frames nor time are given

_CURVE_POINTS = 121  # of the errors against the time between frames


@dataclass(frozen=True, eq=False, repr=False)
class SamplingPlan(Shown):
    """Recommended time between frames, and the expected error of D_R.

    Times are between frames, in s; errors are standard errors over D_R: the least that any
    estimator can have, which `estimate_diffusion` reaches.

    Attributes
    ----------
    dt_min : float
        Shortest time between frames of the recommended window, s. Below it noise hides the steps:
        SNR 5, or 0.1 for a given number of photons. The window is empty where dt_min > dt_max.
    dt_max : float
        Longest time between frames of the recommended window, s. Above it steps are too long:
        4 D_R dt = 0.1, or less where a body of high symmetry is confused earlier.
    dt_best : float
        Recommended time between frames, s.
    n_frames : int
        Number of frames that the budget allows at `dt_best`.
    snr : float
        Signal-to-noise ratio D_R dt/s at `dt_best`, s the noise variance of one orientation angle;
        in space this is 4 D_R dt/Phi^2.
    phi2 : float
        Noise floor of the MSAD for the stated sigma, rad^2.
    dt_link : float
        Longest time between frames at which nearest-neighbour linking is wrong in at most 0.04 % of
        the steps, s; where D_T is given the motion of the centre counts too.
    dt_rigid : float
        Longest time between frames at which assignment by the best rigid fit is wrong in at most
        0.5 % of the steps, s.
    paper_dt_min : float
        Shortest time between frames by Hunter 2011, section 4.1: 4 D_R dt = Phi^2, s.
    paper_dt_max : float
        Longest time between frames by Hunter 2011, section 4.1: 4 D_R dt = 1, s.
    dt : ndarray, shape (K,)
        Times between frames at which the errors below are given, s.
    error : ndarray, shape (K,)
        Relative standard error of D_R at each `dt` with the noise fitted together with D_R (the
        default of `estimate_diffusion`).
    error_residual : ndarray, shape (K,)
        Relative standard error of D_R at each `dt` with the noise from the residuals of the rigid
        fits.
    axes : int
        Number of angles that share D_R.
    residual_dof : int
        Degrees of freedom of one frame's residuals.
    reasons : tuple of str
        Sentences that explain the plan.
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

    def __post_init__(self) -> None:
        frozen(self.dt, self.error, self.error_residual)

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
        return self.error_of(self.n_frames)

    @property
    def expected_error_residual(self) -> float:
        """Standard error over D_R at `dt_best` with the noise from the residuals of rigid fits."""
        return self.error_of(self.n_frames, noise="residual")

    def frames_for(self, relative_error: float, *, noise: NoiseKnowledge = "joint") -> int:
        """Return the number of frames, `dt_best` apart, for a given relative standard error.

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
        while self.error_of(high, noise=noise) > relative_error:
            low, high = high, 2 * high
        while high - low > 1:
            middle = (low + high) // 2
            enough = self.error_of(middle, noise=noise) <= relative_error
            low, high = (low, middle) if enough else (middle, high)
        return high

    def error_of(self, n_frames: int, *, noise: NoiseKnowledge = "joint") -> float:
        """Return the standard error over D_R of a number of frames, `dt_best` apart.

        Parameters
        ----------
        n_frames : int
            Number of frames, at least 3.
        noise : {"joint", "residual", "known"}
            As in `cramer_rao`.

        Returns
        -------
        float
        """
        return cramer_rao(
            n_frames=n_frames,
            snr=self.snr,
            axes=self.axes,
            noise=noise,
            residual_dof=self.residual_dof,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the plan for JSON: lists for arrays and tuples.

        Returns
        -------
        dict
            An entry per attribute.

        Examples
        --------
        >>> plan = plan_sampling(Cluster.touching(4, 2.45), D_R=4.93e-3, sigma=0.03, n_frames=300)
        >>> plan.to_dict()["n_frames"]
        300
        """
        return {field.name: to_plain(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> SamplingPlan:
        """Return the plan that `to_dict` wrote.

        Parameters
        ----------
        entry : dict
            As `to_dict` returns it, also after a round trip through JSON.

        Returns
        -------
        SamplingPlan

        Examples
        --------
        >>> plan = plan_sampling(Cluster.touching(4, 2.45), D_R=4.93e-3, sigma=0.03, n_frames=300)
        >>> SamplingPlan.from_dict(plan.to_dict()).dt_best == plan.dt_best
        True
        """
        arrays = {name: from_plain(entry[name]) for name in ("dt", "error", "error_residual")}
        return cls(**(entry | arrays | {"reasons": tuple(entry["reasons"])}))


@dataclass(frozen=True, repr=False)
class SamplingBudget(Shown):
    """What limits a measurement of D_R: the noise, and the number of frames, time or photons.

    Attributes
    ----------
    D_R : float
        Rotational diffusion coefficient, rad^2/s.
    noise_variance : float
        Noise variance of one orientation angle, rad^2; with `photons` that of the movie with
        `n_frames` frames in `total_time`, whose photons are then divided among other frames.
    axes : int
        Number of angles that share D_R.
    residual_dof : int
        Degrees of freedom of one frame's residuals.
    n_frames : int or None
        Largest number of frames; None where only the time is limited.
    total_time : float or None
        Longest movie, s; None where only the number of frames is limited.
    photons : bool
        Whether the number of photons is limited instead of the number of frames.
    """

    D_R: float
    noise_variance: float
    axes: int
    residual_dof: int
    n_frames: int | None
    total_time: float | None
    photons: bool

    @property
    def dt_stated(self) -> float | None:
        """Time between frames at which a photon budget's sigma is stated, s; else None."""
        if not self.photons or self.total_time is None or self.n_frames is None:
            return None
        return self.total_time / (self.n_frames - 1)

    @property
    def msad_rate(self) -> float:
        """Slope of the MSAD, rad^2/s."""
        return (4 if self.axes == 3 else 2) * self.D_R

    def snr(self, dt: float) -> float:
        """Return D_R dt over the noise variance that a frame has at that dt."""
        longer_exposure = 1.0 if self.dt_stated is None else dt / self.dt_stated
        return self.D_R * dt / self.noise_variance * longer_exposure

    def dt_at(self, snr: float) -> float:
        """Return the time between frames with a given SNR, s."""
        dt = snr * self.noise_variance / self.D_R
        return dt if self.dt_stated is None else float(np.sqrt(dt * self.dt_stated))

    def frames(self, dt: float) -> int:
        """Return the number of frames that the budget allows."""
        in_time = np.inf
        if self.total_time is not None:
            # A time that is a whole number of dt up to rounding holds that many steps.
            in_time = int(self.total_time / dt * (1 + 1e-9)) + 1
        limit = np.inf if self.photons or self.n_frames is None else self.n_frames
        return int(min(in_time, limit))

    def error(self, dt: float, noise: NoiseKnowledge) -> float:
        """Return the relative standard error of D_R at that dt."""
        return cramer_rao(
            n_frames=self.frames(dt),
            snr=self.snr(dt),
            axes=self.axes,
            noise=noise,
            residual_dof=self.residual_dof,
        )

    def best_dt(self, longest: float) -> float:
        """Return the best time between frames of at most `longest`, s."""
        if self.photons:
            return min(self.dt_at(_PHOTON_SNR), longest)
        if self.n_frames is None:
            return min(self.dt_at(_LEAST_SNR), longest)
        ample = min(self.dt_at(_AMPLE_SNR), longest)
        if self.total_time is None:
            return ample
        return min(ample, self.total_time / (self.n_frames - 1))

    def limit_text(self, plan: SamplingPlan) -> str:
        """Return the sentence that explains the best dt of a plan from what is limited."""
        if self.photons:
            return (
                f"Limited photons: the error is nearly constant below SNR {_PHOTON_SNR:g}, and "
                f"below SNR {_PHOTON_SNR_RESIDUAL:g} ({self.dt_at(_PHOTON_SNR_RESIDUAL):.3g} s) "
                "with the noise from the residuals. The camera's own noise is not included: where "
                "it matters, take fewer frames."
            )
        if self.n_frames is None:
            more = plan.dt_best / 5
            return (
                "Limited time: there is no optimum, more frames always help, but slowly: five "
                f"times as many (every {more:.3g} s) would give "
                f"{percent(self.error(more, 'joint'))}. "
                "Storage and bleaching limit the number of frames."
            )
        if self.total_time is None:
            return (
                f"Limited frames ({self.n_frames}): longer steps are better; beyond SNR "
                f"{_AMPLE_SNR:g} the error falls by less than 2 % of itself."
            )
        lasts = plan.dt_best * (plan.n_frames - 1)
        if lasts < 0.999 * self.total_time:
            return (
                f"Limited frames and time: the {plan.n_frames} frames are taken in {lasts:.3g} s; "
                f"stretching them over all of {self.total_time:.3g} s would gain little or lose "
                "the identity of particles."
            )
        below = plan.dt_best < plan.dt_min
        limited = (
            " That is below the window: time more than frames limits the error." if below else ""
        )
        return (
            f"Limited frames and time: all {plan.n_frames} frames, evenly over "
            f"{self.total_time:.3g} s, SNR {short(plan.snr)}.{limited}"
        )


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
        The rigid body; positions in um.
    D_R : float
        Approximate rotational diffusion coefficient, rad^2/s.
    sigma : float or array_like, shape (d,)
        Localisation error of one coordinate in one frame, um; one number or one per axis.
    D_T : float, optional
        Translational diffusion coefficient, um^2/s: the displacement of the particles between
        frames then limits linking too.
    n_frames : int, optional
        Largest number of frames that can be taken.
    total_time : float, optional
        Longest movie, s. With `n_frames` both are limits. Neither: 300 frames.
    photons : bool
        A given number of photons instead of frames (the dye bleaches): they last for `total_time`
        and may be divided among any number of frames, sigma^2 being inversely proportional to the
        photons of a frame. `sigma` is then that of the movie with `n_frames` frames; all three are
        needed.

    Returns
    -------
    SamplingPlan
        For a given number of frames dt is as long as steps stay small, up to SNR 20. For a given
        time it is the short end of the window (there is no optimum: more frames always help). For
        a given number of photons it is where more frames reduce the error little, SNR 0.5.

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
    n, d = body.positions.shape
    refuse(_plan_faults(body, D_R, sigma, D_T, n_frames, total_time, photons=photons))
    distances = pair_distances(body.positions)
    remarks = length_remarks("the distance of the nearest particles", float(distances.min()))
    largest = as_sigma(sigma, d).max()
    if largest > body.R:
        remarks.append(
            f"sigma: {largest:.4g} um is more than the mean distance of the particles to the "
            f"centre, R = {body.R:.4g} um: no orientation can be measured so; if sigma is in nm, "
            f"state {1e-3 * largest:.4g}"
        )
    for remark in remarks:
        warnings.warn(remark, UnitWarning, stacklevel=2)

    floor = noise_floor(body, sigma=sigma)
    budget = SamplingBudget(
        D_R=D_R,
        noise_variance=float(np.trace(floor.covariance)) / len(floor.covariance),
        axes=2 * d - 3,
        residual_dof=int(degrees_of_freedom(np.array(n), d)),
        n_frames=_DEFAULT_FRAMES if n_frames is None and total_time is None else n_frames,
        total_time=total_time,
        photons=photons,
    )
    dt_link, dt_rigid = identity_limits(body, D_R=D_R, D_T=D_T or 0.0)
    dt_max = min(_LONGEST_STEP / D_R, dt_rigid)
    dt_best = budget.best_dt(dt_max)
    if budget.frames(dt_best) < 3:
        raise ValueError(
            f"total_time = {total_time!r} s holds fewer than 3 frames at the best time between "
            f"frames, {dt_best:.3g} s: the cluster hardly turns in it"
        )
    shortest, longest = min(dt_best, budget.dt_at(1.0)) / 4, 1.5 / budget.msad_rate
    if total_time is not None:
        longest = min(longest, total_time / 9)  # below ten frames the error is no smooth curve
    dt = np.geomspace(shortest, max(longest, dt_best), _CURVE_POINTS)
    plan = SamplingPlan(
        dt_min=budget.dt_at(_LEAST_PHOTON_SNR if photons else _LEAST_SNR),
        dt_max=dt_max,
        dt_best=dt_best,
        n_frames=budget.frames(dt_best),
        snr=budget.snr(dt_best),
        phi2=floor.phi2,
        dt_link=dt_link,
        dt_rigid=dt_rigid,
        paper_dt_min=budget.dt_at(1.0),
        paper_dt_max=1 / budget.msad_rate,
        dt=dt,
        error=np.array([budget.error(float(t), "joint") for t in dt]),
        error_residual=np.array([budget.error(float(t), "residual") for t in dt]),
        axes=budget.axes,
        residual_dof=budget.residual_dof,
    )
    return replace(plan, reasons=_plan_reasons(plan, budget, body, D_T))


def _plan_faults(
    body: Cluster,
    D_R: float,
    sigma: ArrayLike,
    D_T: float | None,
    n_frames: int | None,
    total_time: float | None,
    *,
    photons: bool,
) -> list[str]:
    """Return a line for each value out of range, and for a budget that contradicts itself."""
    d = body.positions.shape[1]
    faults = number_fault("D_R", D_R, above=0, unit="rad^2/s")
    if total_time is not None:
        faults += number_fault("total_time", total_time, above=0, unit="s")
    noise_faults = sigma_fault(sigma, d)
    faults += noise_faults
    if not (noise_faults or np.any(sigma)):
        faults.append("sigma: expected more than 0 um (without noise there is nothing to plan)")
    if D_T is not None:
        faults += number_fault("D_T", D_T, least=0, unit="um^2/s")
    if n_frames is not None:
        faults += number_fault("n_frames", n_frames, least=3, whole=True)
    if photons and (n_frames is None or total_time is None):
        faults.append(
            "photons: expected n_frames and total_time too, the movie for which sigma is stated"
        )
    if not pair_distances(body.positions).all():
        faults.append("cluster: two of its particles are at the same place")
    return faults


def identity_limits(body: Cluster, *, D_R: float, D_T: float) -> tuple[float, float]:
    """Return the longest dt for linking by nearest neighbours, and for assignment by rigid fits.

    A particle is linked to a wrong one where its step covers half the distance to it, by a turn of
    the body or by a shift; a rigid fit is wrong where the body turns by half an angle of symmetry.

    Parameters
    ----------
    body : Cluster
        Positions in um.
    D_R : float
        Rotational diffusion coefficient, rad^2/s.
    D_T : float
        Translational diffusion coefficient, um^2/s; 0 where the motion of the centre is removed.

    Returns
    -------
    dt_link, dt_rigid : float
        Times between frames, s.

    Examples
    --------
    >>> link, rigid = identity_limits(Cluster.touching(4, 1.0), D_R=1.0, D_T=0.0)
    >>> round(4 * link, 3), round(4 * rigid, 3)  # 4 D_R dt
    (0.103, 0.201)
    """
    first, second = np.triu_indices(len(body.positions), 1)
    start, way = body.positions[first], body.positions[second] - body.positions[first]
    half = pair_distances(body.positions) / 2
    middle = start + way * (-np.sum(start * way, axis=1) / (4 * half**2))[:, None]
    angle = np.arctan2(half, np.linalg.norm(middle, axis=1))
    variance_rate = 2 * D_T + 2 * D_R * (half / angle) ** 2
    # Without a known symmetry: no permutation turns the body by less than neighbours are apart.
    fold = _HIGHEST_FOLD.get(body.symmetry or "")
    turn = float(angle.min()) if fold is None else np.pi / fold
    dt_link = float(np.min(half**2 / variance_rate)) / _LINKING_DEVIATIONS**2
    return dt_link, float(turn**2 / (2 * D_R)) / _FITTING_DEVIATIONS**2


def _plan_reasons(
    plan: SamplingPlan, budget: SamplingBudget, body: Cluster, D_T: float | None
) -> tuple[str, ...]:
    """Return the sentences that explain a plan."""
    least = _LEAST_PHOTON_SNR if budget.photons else _LEAST_SNR
    if plan.dt_min > plan.dt_max:
        window = (
            f"The window is empty: SNR {least:g} needs {plan.dt_min:.3g} s, but only up to "
            f"{plan.dt_max:.3g} s steps are small and particles keep their identity. Use that "
            "time, and take more frames or particles (more clusters, or larger ones)."
        )
    else:
        window = (
            f"Window {plan.dt_min:.3g} to {plan.dt_max:.3g} s: from SNR = {least:g} to 4 D_R dt = "
            f"{4 * budget.D_R * plan.dt_max:.2g}."
        )
    centre = "" if D_T is not None else ", if the centre's motion is removed first"
    verdict = ": do that here" if plan.dt_best > plan.dt_link else ""
    reasons = [
        window,
        budget.limit_text(plan),
        f"Identity: nearest-neighbour linking is reliable up to {plan.dt_link:.3g} s{centre}; "
        f"assignment by the best rigid fit up to {plan.dt_rigid:.3g} s{verdict}.",
    ]
    if D_T is not None:
        shift = np.sqrt(2 * body.positions.shape[1] * D_T * plan.dt_best)
        turn = body.R * np.sqrt(budget.msad_rate * plan.dt_best)
        nearest = pair_distances(body.positions).min()
        reasons.append(
            f"Between frames the centre moves {shift:.2g} um and the turn moves a particle "
            f"{turn:.2g} um (rms); the nearest particles are {nearest:.3g} um apart."
        )
    cost = ""
    if budget.frames(plan.paper_dt_min) >= 3:
        cost = f", error {percent(budget.error(plan.paper_dt_min, 'joint'))}"
    reasons.append(
        f"The paper's rules: {plan.paper_dt_min:.3g} s (SNR 1{cost}) to {plan.paper_dt_max:.3g} "
        "s, at which nearest-neighbour linking is wrong in a third of the steps or more."
    )
    bias = budget.D_R * plan.dt_best / 6
    if budget.axes == 3 and bias > plan.expected_error / 3:
        reasons.append(
            f"Steps of this length make D_R {percent(bias)} too small, which is more than a third "
            "of the expected error: take shorter steps or correct for it."
        )
    return tuple(reasons)


@dataclass(frozen=True, repr=False)
class SamplingVerdict(Shown):
    """How the time between frames of a measurement compares with the best one.

    Attributes
    ----------
    text : str
        Verdict in words; ``print`` shows it.
    factor : float
        Best time between frames over that of the data: above 1 the data are oversampled.
    dt : float
        Time between frames of the data, s.
    dt_best : float
        Best time between frames, s.
    snr : float
        Signal-to-noise ratio D dt/s of the data; inf without noise.
    error : float
        Estimated standard error over D; inf where D is not above 0.
    bound : float
        Cramér-Rao bound of the standard error over D for the data, with the noise unknown.
    bound_best : float
        Cramér-Rao bound of the standard error over D for as many frames, `dt_best` apart.
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

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict for JSON: None for what is infinite.

        Returns
        -------
        dict
            An entry per attribute.

        Examples
        --------
        >>> verdict = SamplingVerdict("Well sampled", 1.0, 0.5, 0.5, np.inf, 0.1, 0.1, 0.1)
        >>> verdict.to_dict()["snr"], verdict.to_dict()["error"]
        (None, 0.1)
        """
        return {field.name: to_plain(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> SamplingVerdict:
        """Return the verdict that `to_dict` wrote.

        Parameters
        ----------
        entry : dict
            As `to_dict` returns it, also after a round trip through JSON.

        Returns
        -------
        SamplingVerdict

        Examples
        --------
        >>> verdict = SamplingVerdict("Well sampled", 1.0, 0.5, 0.5, 20.0, np.inf, 0.1, 0.1)
        >>> SamplingVerdict.from_dict(verdict.to_dict()) == verdict
        True
        """
        read: dict[str, Any] = {k: np.inf if v is None else v for k, v in entry.items()}
        return cls(**read)


def judge_sampling(estimate: DiffusionEstimate, *, axes: int = 3) -> SamplingVerdict:
    """Judge whether the frames of a measurement were too close, too far apart, or well chosen.

    Parameters
    ----------
    estimate : DiffusionEstimate
        Estimate of D_R or D_T. Where it is not resolved, D is replaced by its 95 % limit, which
        makes the verdict cautious.
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
        If the estimate has no dt, no noise, or neither a value nor an upper limit.

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
            "estimate: its localisation noise is not known (a curve of positions has no "
            "rigid-fit residuals); use estimate_diffusion on a motion"
        )
    if estimate.value > 0:
        noise_variance = estimate.value * estimate.dt / estimate.snr
    else:  # only the offset is known; that of a straight line may lie below zero
        noise_variance = max(estimate.offset, 0.0)
    rotation = estimate.unit == UNITS["rotation"]
    longest = _LONGEST_STEP / D if rotation else np.inf
    dt_best = min(_AMPLE_SNR * noise_variance / D, longest)
    snr, best_snr = (
        D * t / noise_variance if noise_variance > 0 else np.inf for t in (estimate.dt, dt_best)
    )
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
    text = _verdict_text(verdict, estimate, axes=axes, step=4 * D * estimate.dt * rotation)
    return replace(verdict, text=text)


def _bound(n_frames: int, snr: float, axes: int) -> float:
    """Return the bound; at an SNR beyond any measurement that without noise, to rounding."""
    return cramer_rao(n_frames=n_frames, snr=min(snr, 1e12), axes=axes)


def _verdict_text(
    verdict: SamplingVerdict, estimate: DiffusionEstimate, *, axes: int, step: float
) -> str:
    """Return a verdict in words; `step` is 4 D_R dt, 0 for D_T."""
    text = "" if estimate.resolved else "Not resolved: judged at the 95 % limit of D. "
    state = f"SNR {short(verdict.snr)}" + (f", 4 D_R dt = {step:.2g}" if step else "")
    if step > 4 * _LONGEST_STEP:
        slow = f" and D_R is {percent(step / 24)} too low" if step > 0.2 else ""
        text += (
            f"Undersampled ({state}): beyond 4 D_R dt = {4 * _LONGEST_STEP:g} particles can be "
            f"confused{slow}. Take frames every {verdict.dt_best:.3g} s, "
            f"{short(1 / verdict.factor)} times closer."
        )
        if verdict.snr * verdict.factor < _LEAST_SNR:
            text += " Noise is then large: take more frames or particles."
    elif verdict.snr >= _LEAST_SNR:
        text += f"Well sampled ({state}): only more frames would reduce the error."
    else:
        least = "" if estimate.resolved else "at least "
        every = max(round(verdict.factor), 1)
        thinned = _bound(max(estimate.n_frames // every, 3), every * verdict.snr, axes)
        text += (
            f"Oversampled {least}{short(verdict.factor)} times ({state}): in a longer movie every "
            f"{ordinal(every)} frame would have been enough; as many frames every "
            f"{verdict.dt_best:.3g} s could have given {percent(verdict.bound_best)} instead of "
            f"{percent(verdict.bound)}. Of this movie use all frames: every {ordinal(every)} alone "
            f"gives {percent(thinned)}."
        )
    if verdict.error == np.inf:
        return text + f" The bound for {estimate.n_frames} frames is {percent(verdict.bound)}."
    text += (
        f" Standard error {percent(verdict.error)}, the bound with the noise unknown "
        f"{percent(verdict.bound)}."
    )
    efficiency = (verdict.bound / verdict.error) ** 2
    if estimate.motion == "changing D":
        text += " The error contains the scatter of a D that changes; the bound does not."
    elif efficiency < 0.6:
        text += (
            f" The efficiency of the estimate [{estimate.method}] is {percent(efficiency)}: check "
            "gaps, missing particles and the method."
        )
    return text
