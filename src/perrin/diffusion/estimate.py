"""DiffusionEstimate: one diffusion coefficient with its interval."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from perrin._arrays import to_plain
from perrin._display import Shown
from perrin._text import number_text, unit_text, with_error
from perrin.diffusion.noise_model import Noise

UNITS = {"rotation": "rad^2/s", "translation": "um^2/s"}

CHI2 = {0.68: 0.9889, 0.95: 3.8415}  # quantiles of chi-squared with one degree of freedom

NORMAL = {0.68: 0.9945, 0.95: 1.9600}  # half widths of intervals in standard errors

# Over which times a value holds, by the kind of the motion. Where the motion has a memory a fit of
# diffusion takes a part of it for noise, so that its value holds at no time.
_TIME_SCALES = {
    "diffusion": "holds {frame} and at longer times",
    "jumps": "holds {frame}; it does not describe the jumps",
    "drift": "holds {frame}; the steady motion dominates at long times",
    "spin": "holds {frame}; the steady motion dominates at long times",
    "changing D": "holds {frame}, as a mean over the track",
    "confined": "is below that {frame}, which the fit of a cage gives, and is 0 at long times",
    "subdiffusion": "is below that {frame}, which the fit of the exponent gives, and decreases "
    "with time",
    "superdiffusion": "is above that {frame}, which the fit of the exponent gives, and increases "
    "with time",
    "vibration": "holds {frame} only; it contains the vibration",
}

# Below ten times its resolution floor a D_R is not resolved.
_RESOLVED_FLOORS = 10.0


@dataclass(frozen=True)
class Found:
    """A value with its intervals, offset and drift, before the signal-to-noise ratio is known.

    The attributes are those of `DiffusionEstimate`; without a `stderr` it is half the width of
    `ci68`.
    """

    value: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    offset: float
    offset_stderr: float
    drift: tuple[tuple[float, ...], ...] | None = None
    drift_stderr: tuple[tuple[float, ...], ...] | None = None
    p_same: float | None = None
    stderr: float | None = None  # half the width of ci68 unless given

    @classmethod
    def normal(cls, value: float, stderr: float, offset: float, offset_stderr: float) -> Found:
        """Return a value with the intervals of a normal distribution."""
        ci68, ci95 = (
            (float(value - z * stderr), float(value + z * stderr))
            for z in (NORMAL[0.68], NORMAL[0.95])
        )
        return cls(float(value), ci68, ci95, offset, offset_stderr)


@dataclass(frozen=True, repr=False)
class DiffusionEstimate(Shown):
    """A diffusion coefficient with its intervals, and the data and noise that they are based on.

    Attributes
    ----------
    value : float
        D_R in rad^2/s or D_T in um^2/s.
    ci68, ci95 : tuple of float
        Confidence intervals; an end that the data do not bound is 0 or inf.
    stderr : float
        Half the width of the 68 % interval.
    offset : float
        Variance of one orientation (rad^2) or centre coordinate (um^2) from noise, mean over axes;
        negative where motion blur outweighs the noise.
    offset_stderr : float
        Standard error of the offset; NaN where the offset lies on the edge of its range.
    resolution_floor : float or None
        D_R that would be measured for a motionless cluster, rad^2/s; None for D_T.
    resolved : bool
        Whether the value is above ten such floors and its 95 % interval above 0; if not, it is an
        upper limit.
    unit : str
        Unit of the value: "rad^2/s" or "um^2/s".
    method : str
        Estimator: "mle", "cve" or "trace"; "line" or "gls" for a fit to a curve; "none" where the
        data show no value. "mle, error from states" (or "from blocks") where D changes in time.
    n_frames : int
        Frames with a pose, of all motions.
    snr : float
        D dt/s, s the noise variance of one orientation or centre coordinate that the rigid-fit
        residuals predict (or the stated sigma); inf without noise, NaN where s is not known.
    dt : float
        Time between the frames that exist, s: the median step, mean over motions.
    noise : "joint", "residual" or float
        Model of the noise: fitted with D, from the residuals of the rigid fits, or the known
        localisation error, um.
    exposure : float or None
        Open fraction of dt as stated; None for unknown.
    drift : tuple of tuple of float, or None
        Mean velocity of every motion along x, y, z, um/s; for D_R mean spin about the lab's x, y,
        z, rad/s (in the plane one number); None where it was not fitted.
    drift_stderr : tuple of tuple of float, or None
        Standard errors of the drift.
    p_same : float or None
        Probability that equal coefficients of the pooled motions scatter at least as much as these
        do (likelihood ratio); None for one motion and for other methods than "mle".
    warnings : tuple of str
        Conditions of the estimate that are not fulfilled; for an absent value the reason.
    motion : str or None
        Kind of the motion that `judge_motion` found ("diffusion", "confined", ...), set by
        `analyze`; None where the motion was not judged.
    """

    value: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    stderr: float
    offset: float
    offset_stderr: float
    resolution_floor: float | None
    resolved: bool
    unit: str
    method: str
    n_frames: int
    snr: float
    dt: float = np.nan
    noise: Literal["joint", "residual"] | float = "joint"
    exposure: float | None = None
    drift: tuple[tuple[float, ...], ...] | None = None
    drift_stderr: tuple[tuple[float, ...], ...] | None = None
    p_same: float | None = None
    warnings: tuple[str, ...] = ()
    motion: str | None = None

    @classmethod
    def judged(
        cls,
        found: Found,
        *,
        quantity: Literal["rotation", "translation"],
        method: str,
        n_frames: int,
        dt: float,
        noise_variance: float,
        resolution_floor: float | None = None,
        noise: Noise | None = None,
        warnings: tuple[str, ...] = (),
    ) -> DiffusionEstimate:
        """Return the estimate with its signal-to-noise ratio, and whether it is resolved.

        Parameters
        ----------
        found : Found
        quantity, method, n_frames, dt, resolution_floor, warnings
            As in the attributes.
        noise_variance : float
            Noise variance of one orientation (rad^2) or centre coordinate (um^2); NaN where it is
            not known.
        noise : Noise, optional
            Model of the noise and exposure; by default fitted with D, the exposure unknown.
        """
        noise = Noise() if noise is None else noise
        if np.isnan(noise_variance):
            snr = np.nan
        else:
            snr = found.value * dt / noise_variance if noise_variance > 0 else np.inf
        half_width = (found.ci68[1] - found.ci68[0]) / 2
        floor = _RESOLVED_FLOORS * (resolution_floor or 0.0)
        return cls(
            value=found.value,
            ci68=found.ci68,
            ci95=found.ci95,
            stderr=half_width if found.stderr is None else found.stderr,
            offset=found.offset,
            offset_stderr=found.offset_stderr,
            resolution_floor=resolution_floor,
            resolved=bool(found.ci95[0] > 0 and found.value > floor),
            unit=UNITS[quantity],
            method=method,
            n_frames=n_frames,
            snr=float(snr),
            dt=dt,
            noise=noise.model,
            exposure=noise.exposure,
            drift=found.drift,
            drift_stderr=found.drift_stderr,
            p_same=found.p_same,
            warnings=warnings,
        )

    @classmethod
    def absent(
        cls, *, quantity: Literal["rotation", "translation"], n_frames: int, reason: str
    ) -> DiffusionEstimate:
        """Return the estimate of a coefficient that the data cannot show, all numbers NaN."""
        unknown = (np.nan, np.nan)
        found = Found(np.nan, unknown, unknown, np.nan, np.nan)
        return cls.judged(
            found,
            quantity=quantity,
            method="none",
            n_frames=n_frames,
            dt=np.nan,
            noise_variance=np.nan,
            warnings=(reason,),
        )

    @property
    def absent_because(self) -> str | None:
        """Reason why the data show no value; None where there is a value."""
        return self.warnings[0].partition(":")[0] if np.isnan(self.value) else None

    @property
    def quantity(self) -> Literal["rotation", "translation"]:
        """Motion that diffuses: "rotation" or "translation"."""
        return "rotation" if self.unit == UNITS["rotation"] else "translation"

    @property
    def time_scale(self) -> str:
        """Over which times the value holds, with its verb; empty where it was not judged."""
        if self.motion is None or self.absent_because is not None:
            return ""
        frame = f"at one frame ({self.dt:.3g} s)"
        return _TIME_SCALES[self.motion].format(frame=frame)

    @property
    def settings(self) -> Noise:
        """Options of the noise with which the value was estimated."""
        return Noise(self.noise, self.exposure, self.drift is not None)

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate for JSON.

        An end of an interval, an error or a signal-to-noise ratio without bound is None; a stated
        sigma is text with its unit and six digits.
        """
        entry: dict[str, Any] = to_plain(asdict(self)) | {"noise": self.settings.text}
        if np.isnan(self.snr) and not np.isnan(self.value):
            del entry["snr"]  # None would mean that there is no noise
        return entry

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> DiffusionEstimate:
        """Return the estimate that `to_dict` wrote."""
        read = dict(entry)
        for name in ("ci68", "ci95"):
            low, high = read[name]
            unknown = low is None
            read[name] = (np.nan,) * 2 if unknown else (low, np.inf if high is None else high)
        for name in ("value", "offset", "offset_stderr", "dt"):
            read[name] = np.nan if entry[name] is None else entry[name]
        # Without a value None is an unknown number; with a value it is an infinite one.
        unbounded = np.nan if entry["value"] is None else np.inf
        for name in ("stderr", "snr"):
            number = entry.get(name, np.nan)
            read[name] = unbounded if number is None else number
        read["warnings"] = tuple(entry["warnings"])
        for name in ("drift", "drift_stderr"):
            if entry[name] is not None:
                read[name] = tuple(map(tuple, entry[name]))
        if entry["noise"] not in ("joint", "residual"):
            read["noise"] = float(entry["noise"].removesuffix(" um"))
        return cls(**read)

    def __str__(self) -> str:
        name = "D_R" if self.quantity == "rotation" else "D_T"
        if self.absent_because is not None:
            return f"{name}: none ({self.absent_because})"
        text = self.settings.text
        how = self.method if text == "joint" else f"{self.method}, {text} noise"
        taken = "mean spin" if name == "D_R" else "drift"
        how += f", {taken} removed" if self.drift else ""
        tail = f"{self.unit} [{how}, {self.n_frames} frames]"
        if not self.resolved and self.ci95[1] > 0:
            return f"{name} < {self.ci95[1]:.2g} {tail}, 95 % limit"
        return f"{name} = {with_error(self.value, self.stderr)} {tail}"

    def __float__(self) -> float:
        return self.value


def value_text(estimate: DiffusionEstimate) -> str:
    """Write an estimate with the error in its last digits, or as an upper limit, and its unit.

    Parameters
    ----------
    estimate : DiffusionEstimate
        Estimate in rad^2/s or um^2/s.

    Returns
    -------
    str

    Examples
    --------
    >>> found = Found.normal(5e-3, 4e-4, 0.0, 0.0)
    >>> value_text(DiffusionEstimate.judged(
    ...     found, quantity="rotation", method="mle", n_frames=300, dt=0.7, noise_variance=0.0
    ... ))
    '0.0050(4) rad²/s'
    """
    if estimate.absent_because is not None:
        return "none"
    limit = "" if estimate.resolved else " (95 %)"
    return f"{bare_text(estimate)} {unit_text(estimate.unit)}{limit}"


def bare_text(estimate: DiffusionEstimate) -> str:
    """Write an estimate as `value_text` does, without its unit.

    Examples
    --------
    >>> found = Found.normal(5e-3, 4e-4, 0.0, 0.0)
    >>> bare_text(DiffusionEstimate.judged(
    ...     found, quantity="rotation", method="mle", n_frames=300, dt=0.7, noise_variance=0.0
    ... ))
    '0.0050(4)'
    """
    if estimate.absent_because is not None:
        return "none"
    if estimate.resolved:
        return number_text(estimate.value, estimate.stderr)
    return f"< {number_text(estimate.ci95[1], digits=2)}".replace("inf", "∞")
