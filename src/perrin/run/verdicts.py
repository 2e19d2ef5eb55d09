"""What kind of motion every cluster shows, and all rigid ones together."""

from __future__ import annotations

import warnings as python_warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin.diffusion.anomalous import fit_anomalous
from perrin.diffusion.confined import fit_confined
from perrin.diffusion.goodness_of_fit import FEWEST_STEPS
from perrin.diffusion.step_tests import without_spin
from perrin.diffusion.switching import fit_switching
from perrin.diffusion.verdict import MotionVerdict, judge_each, judge_together
from perrin.errors import PrecisionWarning

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.diffusion.noise_model import Noise
    from perrin.diffusion.steps import Quantity
    from perrin.diffusion.verdict import JudgedMotion, Model
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.run.experiment import MotionModel


def is_at_rest(motion: RigidMotion, quantity: Quantity) -> bool:
    """Return whether a body does not move, or turn, within rounding.

    Parameters
    ----------
    motion : RigidMotion
    quantity : {"rotation", "translation"}

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> turning = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> is_at_rest(turning, "rotation"), is_at_rest(turning, "translation")
    (False, True)
    """
    path = motion.center if quantity == "translation" else motion.rotation
    path = path[motion.fitted]
    size = float(np.abs(path).max(initial=0.0))
    if quantity == "translation":
        size += float(np.abs(motion.template).max())
    return bool(np.ptp(path, axis=0).max(initial=0.0) <= 1e-13 * size)


def judge_alone(
    motions: Sequence[RigidMotion], *, quantity: Quantity, noise: Noise
) -> list[JudgedMotion | None]:
    """Judge every motion that can be judged.

    Parameters
    ----------
    motions : sequence of RigidMotion
        Motions before any jump is cut and before a steady motion is subtracted.
    quantity : {"rotation", "translation"}
    noise : Noise
        What the estimates assume of the noise.

    Returns
    -------
    list of JudgedMotion or None
        None for a motion of fewer than 20 steps, and for a body without this motion.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> long, short = (
    ...     simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=n, rng=3)
    ...     for n in (300, 10)
    ... )
    >>> first, second = judge_alone([long, short], quantity="rotation", noise=Noise())
    >>> first.verdict.kind, second
    ('diffusion', None)
    """
    settings = replace(noise, drift=False)

    def judged(some: Sequence[RigidMotion]) -> list[JudgedMotion | None]:
        with python_warnings.catch_warnings():
            python_warnings.simplefilter("ignore", PrecisionWarning)
            try:
                return [*judge_each(some, quantity=quantity, noise=settings)]
            except ValueError:
                # The one that cannot be judged is found by itself.
                return [None] if len(some) == 1 else [one for m in some for one in judged([m])]

    moving = [
        k
        for k, motion in enumerate(motions)
        if len(motion.steps()[0]) >= FEWEST_STEPS and not is_at_rest(motion, quantity)
    ]
    found = dict(zip(moving, judged([motions[k] for k in moving]) if moving else [], strict=True))
    return [found.get(k) for k in range(len(motions))]


def judge_pool(
    motions: Sequence[RigidMotion], judged: Sequence[JudgedMotion | None], *, noise: Noise
) -> MotionVerdict | None:
    """Judge together the motions that could be judged alone.

    Parameters
    ----------
    motions : sequence of RigidMotion
    judged : sequence of JudgedMotion or None
        Result of `judge_alone` for these motions.
    noise : Noise

    Returns
    -------
    MotionVerdict or None
        The verdict on one motion, if only one could be judged; None if none could.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> free = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> alone = judge_alone([free, free], quantity="rotation", noise=Noise())
    >>> judge_pool([free, free], alone, noise=Noise()).n_frames
    600
    """
    known = [k for k, one in enumerate(judged) if one is not None]
    each = [one for one in judged if one is not None]
    if len(each) < 2:
        return each[0].verdict if each else None
    with python_warnings.catch_warnings():
        python_warnings.simplefilter("ignore", PrecisionWarning)
        try:
            settings = replace(noise, drift=False)
            together = judge_together([motions[k] for k in known], each, noise=settings)
        except ValueError:
            return None
    return replace(together, each=())


def fit_model(
    motions: Sequence[RigidMotion],
    estimates: Sequence[DiffusionEstimate],
    *,
    noise: Noise,
    model: MotionModel,
) -> Model:
    """Fit one model to motions, without the steady motion that their estimates leave out.

    Parameters
    ----------
    motions : sequence of RigidMotion
        Motions that the estimates were made from, cut at jumps.
    estimates : sequence of DiffusionEstimate
        Estimate of every motion.
    noise : Noise
    model : {"anomalous", "confined", "switching"}

    Returns
    -------
    AnomalousEstimate, ConfinedEstimate or SwitchingEstimate

    Raises
    ------
    TooFewFramesError, ValueError
        As in `fit_anomalous`, `fit_confined` and `fit_switching`.

    Examples
    --------
    >>> from perrin import Cluster, Noise, estimate_diffusion, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> found = fit_model([truth], [estimate_diffusion(truth)], noise=Noise(), model="anomalous")
    >>> found.ci95[0] < 1 < found.ci95[1]
    True
    """
    quantity, diffusing = estimates[0].quantity, []
    for motion, estimate in zip(motions, estimates, strict=True):
        if estimate.drift is None:
            diffusing.append(motion)
        elif quantity == "rotation":
            diffusing.append(without_spin(motion, estimate.drift[0]))
        else:
            path = np.outer(motion.time, estimate.drift[0])
            diffusing.append(replace(motion, center=motion.center - path))
    fits: dict[str, Callable[..., Model]] = {
        "anomalous": fit_anomalous,
        "confined": fit_confined,
        "switching": fit_switching,
    }
    some = diffusing if len(diffusing) > 1 else diffusing[0]
    with python_warnings.catch_warnings():
        python_warnings.simplefilter("ignore", PrecisionWarning)
        return fits[model](some, quantity=quantity, noise=replace(noise, drift=False))


def verdicts_to_dict(verdicts: Mapping[str, MotionVerdict | None]) -> dict[str, Any]:
    """Return the entry "motion" of ``summary.json``; null where a motion was not judged.

    Examples
    --------
    >>> verdicts_to_dict({"rotation": None})
    {'rotation': None, 'translation': None}
    """
    found = {name: verdicts.get(name) for name in ("rotation", "translation")}
    return {name: None if one is None else one.to_dict() for name, one in found.items()}


def verdicts_from_dict(entry: Mapping[str, Any]) -> dict[str, MotionVerdict | None]:
    """Return the verdicts that `verdicts_to_dict` wrote.

    Examples
    --------
    >>> verdicts_from_dict({"rotation": None, "translation": None})
    {'rotation': None, 'translation': None}
    """
    return {
        name: None if one is None else MotionVerdict.from_dict(one) for name, one in entry.items()
    }
