"""What the user knows of an experiment, and what the recording of a table adds."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from perrin._arrays import choice_fault, flag_fault, numpy_to_python, refuse, stated_twice
from perrin.diffusion.noise_model import Noise
from perrin.hydrodynamics.mobility import condition_faults

if TYPE_CHECKING:
    from collections.abc import Mapping

    from perrin._arrays import Bools, Floats, Ints
    from perrin.tracks.clock import Clock

MotionModel = Literal["anomalous", "confined", "switching"]


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """What is known of an experiment besides the positions.

    Parameters
    ----------
    dt : float, optional
        Time between successive frame numbers, s; None where a movie's file states it.
    sigma : float or sequence of float, optional
        Known localisation error, um, one number or one per axis: for the predicted noise floor and
        the test of rigidity, not for the estimates.
    viscosity : float, optional
        Viscosity of the fluid, Pa s.
    temperature : float, optional
        Temperature of the fluid, K. With the viscosity, sizes follow from D_T and from D_R; alone
        it gives the size and the viscosity that both coefficients imply together.
    diameter : float, optional
        Sphere diameter, um, from which D_T and D_R are predicted.
    noise : Noise
        What the estimates assume of the measurement noise, the exposure and a drift.
    keep_jumps : bool
        Whether steps that Brownian motion cannot make stay in the estimates.
    model : {"anomalous", "confined", "switching"}, optional
        Other motion that is fitted to every cluster, whatever kind of motion it shows: by
        `fit_anomalous`, `fit_confined` or `fit_switching`.

    Raises
    ------
    ValueError
        If values are out of range or incomplete; all faults in one message.

    Examples
    --------
    >>> from perrin.diffusion.noise_model import Noise
    >>> experiment = Experiment(dt=0.73, sigma=[0.03, 0.03, 0.04], noise=Noise(exposure=0.5))
    >>> experiment.sigma, experiment.noise.exposure
    ((0.03, 0.03, 0.04), 0.5)
    """

    dt: float | None = None
    sigma: float | tuple[float, ...] | None = None
    viscosity: float | None = None
    temperature: float | None = None
    diameter: float | None = None
    noise: Noise = field(default_factory=Noise)
    keep_jumps: bool = False
    model: MotionModel | None = None

    def __post_init__(self) -> None:
        faults = argument_faults(
            dt=self.dt,
            viscosity=self.viscosity,
            temperature=self.temperature,
            diameter=self.diameter,
        )
        if not isinstance(self.noise, Noise):
            faults.append(f"noise: expected Noise(...), got {self.noise!r}")
        faults += flag_fault("keep_jumps", self.keep_jumps)
        if self.model is not None:
            faults += choice_fault("model", self.model, get_args(MotionModel))
        if self.sigma is not None:
            try:
                plain = np.asarray(self.sigma)
                # Text and booleans would become numbers without a fault.
                plain = (
                    plain.astype(np.float64)
                    if plain.dtype.kind in "iuf"
                    else np.full((1, 1), np.nan)
                )
            except (TypeError, ValueError):
                plain = np.full((1, 1), np.nan)
            if plain.ndim > 1 or not (np.isfinite(plain) & (plain >= 0)).all():
                faults.append(
                    "sigma: expected one number >= 0 or one per axis, in um, got "
                    f"{np.asarray(self.sigma).tolist()!r}"
                )
            given = plain.tolist()
            object.__setattr__(self, "sigma", tuple(given) if plain.ndim else given)
        refuse(faults)
        numpy_to_python(self)

    def to_dict(self) -> dict[str, Any]:
        """Return the experiment as ``run.json`` keeps it, the parts of the noise among the others.

        Examples
        --------
        >>> entry = Experiment(dt=0.5).to_dict()
        >>> entry["dt"], entry["noise"], entry["drift"]
        (0.5, 'joint', False)
        """
        return {
            "dt": self.dt,
            "sigma": list(self.sigma) if isinstance(self.sigma, tuple) else self.sigma,
            "viscosity": self.viscosity,
            "temperature": self.temperature,
            "diameter": self.diameter,
            "noise": self.noise.model,
            "exposure": self.noise.exposure,
            "drift": self.noise.drift,
            "keep_jumps": self.keep_jumps,
            "model": self.model,
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Experiment:
        """Read back what `to_dict` wrote; further keys of ``run.json`` are ignored."""
        # Runs of earlier versions have no model.
        read = {"model": None} | dict(entry)
        own = {one.name: read[one.name] for one in fields(cls) if one.name != "noise"}
        noise = Noise(entry["noise"], exposure=entry["exposure"], drift=entry["drift"])
        return cls(**own, noise=noise)


def merged_experiment(experiment: Experiment | None, **given: Any) -> Experiment:  # noqa: ANN401
    """Return one experiment from an `Experiment` and from single keywords.

    Parameters
    ----------
    experiment : Experiment or None
    **given
        Values by the names of the fields, of `Noise` (``exposure``, ``drift``; ``noise`` is its
        model) and of further lengths that must be positive (``contact``).

    Returns
    -------
    Experiment
        Every value is the one that is not its default; a keyword that is its default does not
        count as stated.

    Raises
    ------
    ValueError
        If a value is stated both in `experiment` and as a keyword, or out of range; all faults in
        one message.

    Examples
    --------
    >>> merged_experiment(Experiment(temperature=295.0), dt=0.73, noise="residual").noise.model
    'residual'
    >>> merged_experiment(Experiment(dt=0.5), dt=0.73)
    Traceback (most recent call last):
        ...
    ValueError: dt: stated in experiment= and as a keyword; state it once
    """
    defaults = {f.name: f.default for f in fields(Experiment) if f.default is not MISSING}
    defaults |= {"noise": "joint", "exposure": None, "drift": False}
    if not isinstance(experiment, Experiment | None):
        raise TypeError(f"experiment: expected Experiment(...), got {experiment!r}")
    known = defaults if experiment is None else experiment.to_dict()
    faults, values = [], dict(known)
    for name, value in given.items():
        is_default = isinstance(value, str | bool) and value == defaults.get(name)
        stated = value is not None and not is_default
        if stated and name in known and known[name] != defaults[name]:
            faults.append(stated_twice(name, "experiment"))
        elif stated:
            values[name] = value
    lengths = {name: values.pop(name) for name in set(values) - set(defaults)}
    faults += argument_faults(**lengths)
    parts = {name: values.pop(name) for name in ("exposure", "drift")}
    try:
        noise = Noise(values.pop("noise"), **parts)
    except ValueError as fault:
        faults.append(str(fault))
        noise = Noise()
    try:
        whole = Experiment(**values | {"noise": noise})
    except ValueError as fault:
        faults.insert(0, str(fault))
    refuse(faults)
    return whole


@dataclass(frozen=True, eq=False)
class Recording:
    """What a table or a movie states of its frames and axes.

    Attributes
    ----------
    dt : float
        Time between successive frame numbers, s.
    times : Clock or None
        Times of the frames where they are not `dt` apart.
    stated_sigma : ndarray, shape (d,), or None
        Localisation error of each axis that the fits to the images state, um: at least that of the
        light, and in the right ratio.
    first_frame : int
        The table's own number of its first frame.
    recorded : ndarray of int or None
        Frames, counted from the first, that any row of the table has.
    crossing : float
        Time in which the planes through one particle are recorded, s.
    """

    dt: float
    times: Clock | None = None
    stated_sigma: Floats | None = None
    first_frame: int = 0
    recorded: Ints | None = None
    crossing: float = 0.0

    def clock(self, frames: Ints) -> Floats:
        """Return the times of frames, s."""
        return np.asarray(frames * self.dt if self.times is None else self.times.at(frames))

    def has(self, frames: Ints) -> Bools:
        """Return which frames any row of the table has."""
        if self.recorded is None:
            return np.ones(len(frames), dtype=np.bool_)
        return np.isin(frames, self.recorded)


def argument_faults(**given: float | None) -> list[str]:
    """Return what is wrong with conditions of an experiment, one line each.

    Parameters
    ----------
    **given
        Numbers that must be positive, by name; None where they are not stated.

    Returns
    -------
    list of str

    Examples
    --------
    >>> argument_faults(dt=0.5, viscosity=1e-3, temperature=None)
    ['sizes need both viscosity (Pa s) and temperature (K): the temperature is missing']
    """
    known = {name: value for name, value in given.items() if value is not None}
    faults = condition_faults(**known)
    if "viscosity" in known and "temperature" not in known:
        faults.append(
            "sizes need both viscosity (Pa s) and temperature (K): the temperature is missing"
        )
    if "diameter" in known and not {"viscosity", "temperature"} <= set(known):
        faults.append(
            "diameter: a prediction needs the viscosity (Pa s) and the temperature (K) as well"
        )
    return faults
