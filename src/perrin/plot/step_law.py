"""The steps between neighbouring frames of a cluster, and the normal law of its fit."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from typing import Literal

    from perrin._arrays import Floats
    from perrin.run.results import ClusterResult

_BINS = 31


class StepDistribution(NamedTuple):
    """Components of the steps between neighbouring frames, counted in bins.

    Attributes
    ----------
    edges : ndarray, shape (bins + 1,)
        Ends of the bins, rad or um.
    number : ndarray, shape (bins,)
        Number of components in each bin, of all axes together.
    variance : ndarray, shape (axes,)
        Variance that the fit predicts for the component along each axis, rad^2 or um^2.
    """

    edges: Floats
    number: Floats
    variance: Floats

    def density(self, x: Floats) -> Floats:
        """Return the probability density of the fit: the mean of the normal laws of the axes.

        Examples
        --------
        >>> law = StepDistribution(np.array([-1.0, 1.0]), np.array([5.0]), np.array([1.0]))
        >>> law.density(np.array([0.0])).round(4)
        array([0.3989])
        """
        variance = self.variance[self.variance > 0][:, None]
        each = np.exp(-(np.asarray(x) ** 2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
        return np.asarray(each.sum(axis=0) / len(self.variance))


def step_distribution(
    result: ClusterResult, quantity: Literal["rotation", "translation"] = "rotation"
) -> StepDistribution | None:
    """Return the distribution of the steps of a cluster, and the law of its fit.

    Parameters
    ----------
    result : ClusterResult
    quantity : {"rotation", "translation"}
        Rotation vectors along the axes of the rotational tensor (body axes without one), rad, or
        displacements of the centre along the lab axes, um.

    Returns
    -------
    StepDistribution or None
        The variance of each axis is 2 (D dt + offset); None without an estimate or without a step
        of the usual duration.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> int(step_distribution(report.clusters[0]).number.sum())  # 299 steps, three axes
    897
    """
    motion = result.motion
    estimate = result.D_R if quantity == "rotation" else result.D_T
    start, stop = motion.steps()
    uneven = np.abs(motion.time[stop] - motion.time[start] - motion.usual_interval)
    regular = uneven < 1e-3 * motion.usual_interval
    if estimate.absent_because is not None or not regular.any():
        return None
    if quantity == "rotation":
        steps = motion.step_vectors()[stop - 1]
    else:
        steps = motion.center[stop] - motion.center[start]
    steps, D = steps[regular], np.full(steps.shape[1], estimate.value)
    if quantity == "rotation" and result.tensor is not None:
        # Steps are in body axes: along the axes of the tensor they have its values.
        steps, D = steps @ result.tensor.axes, result.tensor.principal_values
    variance = np.maximum(2 * D * motion.usual_interval + 2 * estimate.offset, 0.0)
    width = float(np.sqrt(variance.mean())) or float(steps.std()) or 1.0
    half = max(4.0 * width, float(np.abs(steps).max()))
    edges = np.linspace(-half, half, _BINS + 1)
    number = np.histogram(steps, edges)[0].astype(np.float64)
    return StepDistribution(edges, number, variance)
