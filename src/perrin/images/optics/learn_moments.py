"""Moments of the point spread that samples show: asymmetry, and a change with the height."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.images.optics.asymmetry import ABOVE_FOCUS, Asymmetry, significant_sums
from perrin.images.optics.depth import DepthChange, significant_slopes
from perrin.images.optics.image_parameters import ImageVariations
from perrin.images.optics.likeliest import STEP_IN_ERRORS, LikeliestOptics

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats

# Rounds of the search for moments of the point spread, and their number: the components of an
# asymmetry, and the slopes of four moments against the height.
_MOMENT_ROUNDS, _N_SLOPES = 4, len(DepthChange(0.0, 0.0, 0.0).slopes)
_N_MOMENTS = len(Asymmetry._fields) + _N_SLOPES
_OF_DEPTH = np.arange(_N_MOMENTS) >= _N_MOMENTS - _N_SLOPES


class MomentFit(NamedTuple):
    """Fits of the samples with derivatives by the moments of the point spread.

    Attributes
    ----------
    now : LikeliestOptics
        Parameters and fits.
    used : ndarray of bool, shape (16,)
        Which components of `Asymmetry` and which slopes of `DepthChange` are fitted.
    values : ndarray, shape (16,)
        Their values.
    heights : DepthChange
        The middle and the range of the heights.
    """

    now: LikeliestOptics
    used: Bools
    values: Floats
    heights: DepthChange

    @classmethod
    def shown_by(cls, even: LikeliestOptics) -> LikeliestOptics:
        """Return the parameters with the moments that the residuals show.

        These are an asymmetric point spread, and moments that change with the height of a sphere.
        They multiply derivatives of the image, so that they are the solution of linear equations
        together with the other parameters; few rounds are enough. Those are kept that differ from 0
        by more than the noise and by more than the scatter between the samples, in which spheres
        that move during a scan, say, have images that are asymmetric in one way or another.
        """
        if not even.in_groups or even.noise.neighbours:
            return even
        found = cls.of(even).with_asymmetry()
        if found.used.any():
            found = found.settled()
        deeper = found.with_depth()
        if deeper is not found:
            found = (deeper.refitted() if found.used.any() else deeper).settled()
        return found.now if found.used.any() else even

    @classmethod
    def of(cls, even: LikeliestOptics) -> MomentFit:
        """Return the fits without any of the moments."""
        z = np.concatenate([s.centers[:, 0] for s in even.samples])
        heights = DepthChange(float(z.mean()), float(z.min()), float(z.max()))
        none = np.zeros(_N_MOMENTS, dtype=np.bool_)
        return cls(even, none, np.zeros(_N_MOMENTS), heights).refitted()

    def refitted(self) -> MomentFit:
        """Return fits of the samples at the present parameters."""
        variations = ImageVariations.about(self.now.parameters, heights=self.heights)
        fits = [s.fit(variations, self.now.noise) for s in self.now.samples]
        samples = [
            s._replace(centers=fit.centers) for s, fit in zip(self.now.samples, fits, strict=True)
        ]
        return self._replace(now=self.now._replace(samples=samples, fits=fits))

    def equations(self, moments: Bools) -> tuple[Floats, Floats]:
        """Return information (N, k, k) and scores (N, k) of the image and of some moments."""
        fits, n = self.now.fits, len(self.now.parameters.values)
        size = len(fits[0].score) - _N_MOMENTS  # those of the image, and of the share of a tail
        kept = np.r_[:n, size + np.flatnonzero(moments)]
        information = np.array([fit.information[np.ix_(kept, kept)] for fit in fits])
        return information, np.array([fit.score[kept] for fit in fits])

    def with_asymmetry(self) -> MomentFit:
        """Return the fits with the components of an asymmetry that are significant."""
        tested = ~_OF_DEPTH
        information, scores = self.equations(tested)
        covariance = np.linalg.pinv(information.sum(axis=0), hermitian=True)
        shown = significant_sums(scores @ covariance, np.diag(covariance))
        used = self.used.copy()
        used[tested] = shown[-np.count_nonzero(tested) :]
        return self._replace(used=used)

    def with_depth(self) -> MomentFit:
        """Return the fits with the slopes against the height, if that of a width is significant.

        Both widths change then, and with a point spread that differs above and below the focus its
        third moments too. Light of other spheres that is spread over the field changes third
        moments alone.
        """
        shown = significant_slopes(*self.equations(self.used | _OF_DEPTH))
        if not shown[-_N_SLOPES:][:2].any():
            return self
        uneven = self.used[ABOVE_FOCUS].any()
        used = self.used.copy()
        used[_OF_DEPTH] = [True, True, uneven, uneven]
        return self._replace(used=used)

    def settled(self) -> MomentFit:
        """Return the fits with the moments in use of greatest likelihood."""
        found = self
        for number in range(_MOMENT_ROUNDS):
            if number:
                found = found.refitted()
            information, scores = found.equations(found.used)
            information = information.sum(axis=0)
            step = np.linalg.pinv(information, hermitian=True) @ scores.sum(axis=0)
            found = found.moved(information, step)
            if step @ information @ step < STEP_IN_ERRORS**2:
                break
        return found

    def moved(self, information: Floats, step: Floats) -> MomentFit:
        """Return the fits at the parameters after a step."""
        n, values = len(self.now.parameters.values), self.values.copy()
        values[self.used] += step[n:]
        own = information[:n, :n]
        parameters = self.now.parameters.moved(own, own @ step[:n])
        stderr = np.zeros(len(values))
        stderr[self.used] = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True))[n:])
        uneven, slopes = values[~_OF_DEPTH], values[_OF_DEPTH]
        depth = self.heights.with_slopes(slopes, stderr[_OF_DEPTH])
        parameters = replace(
            parameters,
            asymmetry=Asymmetry(*uneven.tolist()) if uneven.any() else None,
            depth=depth if slopes.any() else None,
        )
        now = self.now._replace(parameters=parameters, information=information)
        return self._replace(now=now, values=values)
