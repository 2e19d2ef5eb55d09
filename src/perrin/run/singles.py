"""The translational diffusion of spheres that belong to no body."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._display import Shown
from perrin._text import with_error
from perrin.diffusion.estimate import DiffusionEstimate
from perrin.diffusion.estimators import by_likelihood, precision_limits
from perrin.diffusion.steps import NoisySteps, Steps

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

    from perrin._arrays import Floats
    from perrin.diffusion.noise_model import Noise
    from perrin.run.experiment import Recording

# Tracks of fewer frames do not count, and fewer steps in all give no coefficient.
_FEWEST_FRAMES_OF_A_TRACK, _FEWEST_STEPS_OF_ALL = 3, 30


@dataclass(frozen=True, eq=False, repr=False)
class SingleSpheres(Shown):
    """The diffusion of the single spheres of a movie, pooled.

    Attributes
    ----------
    D_T : DiffusionEstimate
        One translational diffusion coefficient for all of them, um^2/s.
    n_tracks : int
        Number of tracks: a sphere that is lost for a while may have several.
    warnings : tuple of str
        Reasons to doubt the coefficient.
    """

    D_T: DiffusionEstimate
    n_tracks: int
    warnings: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The coefficient in one line."""
        value = with_error(self.D_T.value, self.D_T.stderr)
        return f"single spheres: D_T = {value} {self.D_T.unit} ({self.n_tracks} tracks)"

    def __str__(self) -> str:
        return self.text

    def to_dict(self) -> dict[str, Any]:
        """Return the entry "singles" of ``summary.json``."""
        return {
            "D_T": self.D_T.to_dict(),
            "n_tracks": self.n_tracks,
            "warnings": list(self.warnings),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> SingleSpheres:
        """Read back what `to_dict` wrote."""
        D_T = DiffusionEstimate.from_dict(entry["D_T"])
        return cls(D_T, entry["n_tracks"], tuple(entry["warnings"]))


def measure_singles(
    table: pd.DataFrame, noise: Noise, recording: Recording
) -> SingleSpheres | None:
    """Estimate one D_T for the tracks of single spheres.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns frame, particle and the coordinates, um; a row per detection.
    noise : Noise
        What is assumed of the noise; single spheres have no residuals, so that "residual" is as
        "joint": one offset, the same for all of them.
    recording : Recording
        Times of the frames.

    Returns
    -------
    SingleSpheres or None
        None for fewer than 30 steps.

    Examples
    --------
    >>> import pandas as pd
    >>> from perrin import Noise
    >>> from perrin.run.experiment import Recording
    >>> path = np.random.default_rng(1).normal(size=(40, 10, 3)).cumsum(axis=0)
    >>> table = pd.DataFrame(path.reshape(-1, 3), columns=["x", "y", "z"])
    >>> table = table.assign(frame=np.repeat(np.arange(40), 10), particle=np.tile(range(10), 40))
    >>> found = measure_singles(table, Noise(), Recording(dt=1.0))
    >>> found.n_tracks, abs(found.D_T.value - 0.5) < 3 * found.D_T.stderr
    (10, True)
    """
    count = table.groupby("particle")["frame"].transform("size")
    used = table[count >= _FEWEST_FRAMES_OF_A_TRACK].sort_values(["particle", "frame"])
    n_tracks = used["particle"].nunique()
    if len(used) - n_tracks < _FEWEST_STEPS_OF_ALL:
        return None
    steps = track_steps(used, recording)
    settings = replace(noise, model="joint") if noise.model == "residual" else noise
    sigma = np.nan if isinstance(settings.model, str) else settings.model
    estimate = DiffusionEstimate.judged(
        by_likelihood([NoisySteps.of(steps, settings)]),
        quantity="translation",
        method="mle",
        n_frames=len(used),
        dt=recording.dt,
        noise_variance=sigma**2,
        noise=settings,
    )
    return SingleSpheres(estimate, n_tracks, precision_limits(estimate, [steps]))


def track_steps(table: pd.DataFrame, recording: Recording) -> Steps:
    """Return the steps of many tracks as those of one motion with a piece for each track.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns frame, particle and the coordinates, sorted by particle and frame.
    recording : Recording

    Returns
    -------
    Steps
    """
    axes = [axis for axis in "xyz" if axis in table]
    x: Floats = table[axes].to_numpy(dtype=np.float64)
    frame = table["frame"].to_numpy(dtype=np.int64)
    time = recording.clock(frame)
    start = np.flatnonzero(np.diff(table["particle"].to_numpy()) == 0)
    stop = start + 1
    duration = time[stop] - time[start]
    d = len(axes)
    return Steps(
        vectors=x[stop] - x[start],
        duration=duration,
        start=start,
        stop=stop,
        noise=np.tile(np.eye(d), (1, len(x), 1, 1)),
        dt=recording.dt,
        sigma=1.0,
        freedom=0,
        complete=1.0,
        steady=np.eye(d) * duration[:, None, None],
    )
