"""How the point spread changes with the height of a sphere in the stack."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.images.optics.asymmetry import FROM_NOISE, SAMPLES_LEVEL, Asymmetry

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats


class DepthChange(NamedTuple):
    """Slopes of moments of the point spread against the height of a sphere in the stack.

    A sample with another refractive index than the immersion widens the point spread with the
    depth of the focus, and makes it differ above and below the focus.

    Attributes
    ----------
    middle : float
        Height at which the point spread is that of the optics, um.
    low, high : float
        Heights of the lowest and of the highest sphere from which it was learned, um; spheres
        beyond have the point spread at these.
    wide_z, wide : float
        Change of the variances along z and in the plane, um^2 per um of height.
    zzz, zrr : float
        Change of the third moments of this name of `Asymmetry`, um^3 per um of height.
    stderr : tuple of float
        Standard errors of the four.

    Examples
    --------
    >>> deeper = DepthChange(5.0, 2.0, 8.0, wide_z=0.01)
    >>> deeper.variances(7.0), deeper.variances(9.0)
    ((0.02, 0.0), (0.03, 0.0))
    """

    middle: float
    low: float
    high: float
    wide_z: float = 0.0
    wide: float = 0.0
    zzz: float = 0.0
    zrr: float = 0.0
    stderr: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    @property
    def slopes(self) -> tuple[float, float, float, float]:
        """The changes of the four moments per um of height."""
        return self.wide_z, self.wide, self.zzz, self.zrr

    def with_slopes(self, slopes: Floats, stderr: Floats) -> DepthChange:
        """Return the same heights with other slopes (4,) and their standard errors."""
        wide_z, wide, zzz, zrr = slopes.tolist()
        errors = tuple(stderr.tolist())
        return self._replace(wide_z=wide_z, wide=wide, zzz=zzz, zrr=zrr, stderr=errors)

    def above_middle(self, height: float) -> float:
        """Return the distance from the middle of a height within the range, um."""
        return min(max(height, self.low), self.high) - self.middle

    def psf(self, at_middle: tuple[float, float], height: float) -> tuple[float, float]:
        """Return the standard deviations (z, plane) at a height from those at the middle, um.

        Examples
        --------
        >>> along, across = DepthChange(5.0, 2.0, 8.0, wide_z=0.03).psf((0.4, 0.15), 8.0)
        >>> round(along, 6), across
        (0.5, 0.15)
        """
        more = self.variances(height)
        along, across = (
            float(np.sqrt(max(width**2 + change, 0.0)))
            for width, change in zip(at_middle, more, strict=True)
        )
        return along, across

    def variances(self, height: float) -> tuple[float, float]:
        """Return by how much the variances (z, plane) differ from those at the middle, um^2."""
        return self.wide_z * self.above_middle(height), self.wide * self.above_middle(height)

    def asymmetry(self, at_middle: Asymmetry | None, height: float) -> Asymmetry:
        """Return the asymmetry of the point spread at a height."""
        even, up = at_middle or Asymmetry(), self.above_middle(height)
        return even._replace(zzz=even.zzz + up * self.zzz, zrr=even.zrr + up * self.zrr)

    def nodes(self, count: int) -> Floats:
        """Return heights between which images are interpolated."""
        return np.linspace(self.low, self.high, count)


def significant_slopes(information: Floats, scores: Floats) -> Bools:
    """Return which parameters are not 0, by their noise and by estimates without each sample.

    What a sample adds to a slope depends on its height, so that the scatter of these contributions
    is no measure of its error; that of the estimates without one sample each (the jackknife) is.

    Parameters
    ----------
    information : ndarray, shape (N, k, k)
        Information of each of N samples on k parameters.
    scores : ndarray, shape (N, k)
        Their scores at 0.

    Returns
    -------
    ndarray of bool, shape (k,)
        True beyond five standard errors of the noise and at a level of 1e-4 of Student's t of the
        jackknife; False where there is one sample.

    Examples
    --------
    >>> own, even = np.ones((15, 1, 1)), np.full((15, 1), 2.0)
    >>> significant_slopes(own, even), significant_slopes(own, even * np.arange(-7, 8)[:, None])
    (array([ True]), array([False]))
    """
    from scipy.special import stdtrit

    total, score, count = information.sum(axis=0), scores.sum(axis=0), len(scores)
    if count < 2:
        return np.zeros(len(score), dtype=np.bool_)
    covariance = np.linalg.pinv(total, hermitian=True)
    without = np.linalg.pinv(total - information, hermitian=True)
    values = np.squeeze(without @ (score - scores)[..., None], axis=-1)
    scatter = (count - 1) ** 2 / count * values.var(axis=0, ddof=1)
    found = np.abs(covariance @ score)
    by_noise = found > FROM_NOISE * np.sqrt(np.diag(covariance))
    by_samples = found > stdtrit(count - 1, 1 - SAMPLES_LEVEL / 2) * np.sqrt(scatter)
    return np.asarray(by_noise & by_samples)
