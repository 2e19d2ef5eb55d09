"""What is known about an experiment beside its positions."""

from __future__ import annotations

import warnings as python_warnings
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from perrin.diffusion.estimators import estimate_diffusion
from perrin.diffusion.noise_model import Noise
from perrin.errors import PrecisionWarning
from perrin.hydrodynamics.mobility import Mobility, condition_faults
from perrin.run.predictions import Body, Shape, find_sizes, solve_bodies

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.diffusion.steps import Quantity
    from perrin.hydrodynamics.sizes import Size
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.tracks.clock import Clock


@dataclass(frozen=True, eq=False, kw_only=True)
class Experiment:
    """Known conditions of an experiment.

    Parameters
    ----------
    dt : float, optional
        Time between frames, s.
    sigma : array_like, optional
        Known localisation error, um, one number or one per axis.
    viscosity : float, optional
        Viscosity of the fluid, Pa s.
    temperature : float, optional
        Temperature of the fluid, K.
    diameter : float, optional
        Sphere diameter, um.
    noise : Noise
        Assumptions on the measurement noise.
    keep_jumps : bool
        Include steps in the estimates that Brownian motion cannot make.
    """

    dt: float | None = None
    sigma: ArrayLike | None = None
    viscosity: float | None = None
    temperature: float | None = None
    diameter: float | None = None
    noise: Noise = field(default_factory=Noise)
    keep_jumps: bool = False


@dataclass(frozen=True, eq=False)
class Conditions:
    """What the user knows of the experiment: see `analyze`."""

    dt: float
    sigma: ArrayLike | None
    viscosity: float | None
    temperature: float | None
    diameter: float | None
    noise: Literal["joint", "residual"] | float
    exposure: float | None
    drift: bool
    keep_jumps: bool = False
    times: Clock | None = None  # where frames are not dt apart
    sigma_ratio: ArrayLike | None = None  # of the axes, where that alone is known
    first_frame: int = 0  # what the table calls its first frame
    recorded: Ints | None = None  # the frames that any row of the table has

    def clock(self, frames: Ints) -> Floats:
        """Return the times of frames, s."""
        return np.asarray(frames * self.dt if self.times is None else self.times.at(frames))

    def estimate(
        self, motion: RigidMotion | list[RigidMotion], quantity: Quantity
    ) -> DiffusionEstimate:
        """Estimate D_R or D_T; what has to be known of it goes into the report's own warnings."""
        with python_warnings.catch_warnings():
            python_warnings.simplefilter("ignore", PrecisionWarning)
            return estimate_diffusion(
                motion,
                quantity=quantity,
                noise=self.noise,
                exposure=self.exposure,
                drift=self.drift,
            )

    def bodies(self, shapes: list[Shape]) -> list[Body]:
        """Solve for the flow around every shape; only for a stated temperature."""
        # Without a viscosity the bodies give ratios of sizes only, in which it cancels.
        assumed = {"viscosity": self.viscosity or 1e-3, "temperature": self.temperature or 300.0}
        return solve_bodies(shapes, diameter=self.diameter, **assumed)

    def sizes(
        self, mobility: Mobility, *, D_T: DiffusionEstimate, D_R: DiffusionEstimate
    ) -> dict[str, Size]:
        """Return the sizes that the coefficients imply under these conditions."""
        if self.temperature is None:
            return {}
        return find_sizes(
            mobility, D_T=D_T, D_R=D_R, viscosity=self.viscosity, temperature=self.temperature
        )


def told_conditions(conditions: Conditions) -> dict[str, Any]:
    """Return the conditions as run.json keeps them."""
    entry = asdict(replace(conditions, times=None, sigma_ratio=None, recorded=None))
    for name in ("times", "sigma_ratio", "first_frame", "recorded"):
        del entry[name]
    return entry | {"sigma": _plain(conditions.sigma)}


def check_arguments(*, dt: float, **given: float | None) -> None:
    """Refuse arguments out of range, all in one message."""
    known = {name: value for name, value in given.items() if value is not None}
    faults = condition_faults(dt=dt, **known)
    if "viscosity" in known and "temperature" not in known:
        faults.append(
            "sizes need both viscosity (Pa s) and temperature (K): the temperature is missing"
        )
    if "diameter" in known and not {"viscosity", "temperature"} <= set(known):
        faults.append(
            "diameter: a prediction needs the viscosity (Pa s) and the temperature (K) as well"
        )
    if faults:
        raise ValueError("; ".join(faults))


def _plain(given: ArrayLike | None) -> Any:  # noqa: ANN401 (whatever JSON holds)
    return None if given is None else np.asarray(given, dtype=np.float64).tolist()
