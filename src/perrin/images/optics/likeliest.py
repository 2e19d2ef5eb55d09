"""The optics of greatest likelihood for some samples, and what the samples show besides."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.errors import NoSpheresError
from perrin.images.optics.flicker import LineChanges, Lines, find_flicker, find_gain_spread
from perrin.images.optics.image_parameters import ImageVariations
from perrin.images.optics.neighbours import find_neighbours
from perrin.images.optics.optics import photon_transfer
from perrin.images.optics.pupil import MOST_DIAMETER
from perrin.images.optics.samples import GroupSample, UsualImage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats
    from perrin.images.optics.ball_image import SphereImage
    from perrin.images.optics.image_parameters import ImageParameters
    from perrin.images.optics.optics import CameraNoise
    from perrin.images.optics.samples import CrowdSample, SampleFit

# The search ends at steps below this, or below this fraction of their standard errors: voxels that
# enter and leave the windows change the maximum by up to a fifth.
_STEP_CONVERGED, STEP_IN_ERRORS = 1e-3, 0.3

_MAX_LEARNING_ROUNDS = 15

# The same for another point spread of half of the groups, which only has to be good enough to be
# chosen; and the rounds of the search for it, with a tail and behind a pinhole.
_TRIAL_STEP_IN_ERRORS, _MAX_TRIAL_ROUNDS, _MAX_PUPIL_ROUNDS = 2.0, 6, 12

# Share of the tail from which on a confocal point spread is tried, which takes seconds.
_OPEN_SHARE = 0.4

# Pinholes with which its search may start, of which the likeliest is taken, in Airy units.
_PINHOLES_TRIED = (0.7, 2.0, 5.0)

# A tail is searched for if its share is this many standard errors above 0 to first order, and it is
# kept if it increases the logarithm of the likelihood of other groups by at least this.
_LEAST_SHARE_ERRORS, _LEAST_HELD_OUT_GAIN = 3.0, 3.0

# Median chi-squared per voxel above which shells are tried in place of balls.
_SHELL_MISFIT = 1.3

# Spread of the diameters with which they are fitted first; a spread is used if it is at least this,
# and increases the logarithm of the likelihood of the diameters by at least this.
_FIRST_SPREAD, _LEAST_SPREAD, _LEAST_SPREAD_GAIN = 0.06, 0.007, 5.0

# Change of the spread, relative to it, at which its search ends.
_SPREAD_CONVERGED = 0.05

# Searches for the optics, each without the samples that the one before found to be no spheres.
_MAX_SEARCHES, _FEWEST_SAMPLES = 4, 2


class LikeliestOptics(NamedTuple):
    """Parameters of the image and noise at the maximum of the likelihood of some samples.

    Attributes
    ----------
    parameters : ImageParameters
    noise : CameraNoise
    samples : list of GroupSample or CrowdSample
        The samples, with their fitted positions.
    fits : list of SampleFit
        The last fit to each.
    information : ndarray, shape (k, k)
        Information of all samples on the parameters, of a single Gaussian and on the share of a
        tail, and on the moments of the point spread that are in use.
    score : ndarray, shape (k,)
        Score of the parameters, of a single Gaussian and of the share of a tail.

    Examples
    --------
    >>> from perrin.images import CameraNoise, ImageParameters
    >>> start = ImageParameters(np.log([2.0, 0.4, 0.2]), (0.25, 0.2, 0.2))
    >>> frame = np.random.default_rng(1).poisson(9.0, (24, 20, 20)).astype(np.float64)
    >>> center = np.array([[3.0, 2.0, 2.0]])
    >>> spot = start.image().spot(center[0], frame.shape)
    >>> frame[spot.box] += 300 * spot.value
    >>> samples = [GroupSample(frame, center, np.empty((0, 3)))]
    >>> found = LikeliestOptics.search(samples, start, CameraNoise(1.0, 1.0))
    >>> round(found.parameters.image().diameter, 2), found.in_groups
    (2.0, True)
    """

    parameters: ImageParameters
    noise: CameraNoise
    samples: list[GroupSample | CrowdSample]
    fits: list[SampleFit]
    information: Floats
    score: Floats

    @classmethod
    def search(
        cls,
        samples: Sequence[GroupSample | CrowdSample],
        parameters: ImageParameters,
        noise: CameraNoise,
        *,
        rounds: int = _MAX_LEARNING_ROUNDS,
        tolerance: float = STEP_IN_ERRORS,
    ) -> LikeliestOptics:
        """Return the parameters of greatest likelihood, from a start.

        Parameters
        ----------
        samples : sequence of GroupSample or CrowdSample
        parameters : ImageParameters
            Those at the start.
        noise : CameraNoise
            That at the start.
        rounds : int
            Largest number of rounds.
        tolerance : float
            Step at which the search ends, in standard errors.

        Raises
        ------
        NoSpheresError
            Where the search does not converge.
        """
        n, samples = len(parameters.values), list(samples)
        for number in range(rounds):
            variations = ImageVariations.about(parameters)
            fits = [s.fit(variations, noise) for s in samples]
            samples = [
                s._replace(centers=fit.centers) for s, fit in zip(samples, fits, strict=True)
            ]
            information = np.sum([fit.information for fit in fits], axis=0)
            score = np.sum([fit.score for fit in fits], axis=0)
            transfer = photon_transfer(
                np.concatenate([fit.level for fit in fits]),
                np.concatenate([fit.variance for fit in fits]),
            )
            noise = noise._replace(gain=transfer.gain, floor=transfer.floor)
            spread, larger = parameters.spread, None
            if spread > 0:
                sizes = np.concatenate([fit.sizes for fit in fits])
                variance = np.concatenate([fit.size_variance for fit in fits])
                larger = float(sizes.mean())
                spread = float(np.sqrt(np.mean((sizes - larger) ** 2 + variance)))
            moved = parameters.moved(information[:n, :n], score[:n], larger=larger)
            step = moved.values - parameters.values
            same = abs(spread - parameters.spread) <= _SPREAD_CONVERGED * spread
            parameters = replace(moved, spread=spread)
            in_errors = float(np.sqrt(step @ information[:n, :n] @ step))
            # The information of the first round is that of a guessed noise.
            settled = np.abs(step).max() < _STEP_CONVERGED or (number > 0 and in_errors < tolerance)
            if settled and same:
                return cls(parameters, noise, samples, fits, information, score)
        found = parameters.ball(parameters.values)
        psf_z, psf = found.components[0][1]
        raise NoSpheresError(
            f"sphere size and point spread do not converge: diameter {found.diameter:.3g}, blur "
            f"({psf_z:.3g}, {psf:.3g}) um after {rounds} rounds "
            f"on {len(samples)} groups: are these spheres, bright enough, or dark (dark=True), and "
            "is the voxel size right? State the optics (optics=), or keep the positions found "
            "first (refine=None)"
        )

    @classmethod
    def of_ball_or_shell(
        cls,
        samples: Sequence[GroupSample | CrowdSample],
        start: ImageParameters,
        noise: CameraNoise,
    ) -> LikeliestOptics:
        """Return the parameters of balls, or of shells if the samples are likelier with them.

        Shells are tried where the search for balls does not converge, or leaves large residuals;
        the start may be that of shells already.
        """
        if start.shell:
            return cls.search(samples, start, noise)
        ball: LikeliestOptics | None = None
        try:
            ball = cls.search(samples, start, noise)
            chi2 = np.median([fit.chi2(ball.noise) for fit in ball.fits])
            if chi2 < _SHELL_MISFIT or not ball.in_groups:
                return ball
            shell = cls.search(ball.samples, replace(start, shell=True), noise)
        except NoSpheresError:
            if ball is not None:
                return ball
            return cls.search(samples, replace(start, shell=True), noise)
        images = [one.parameters.image() for one in (ball, shell)]
        within = max(images, key=lambda image: float(image.extent.max()))
        without, gain = (
            sum(s.log_likelihood(image, shell.noise, within=within) for s in one.groups)
            for one, image in zip((ball, shell), images, strict=True)
        )
        return shell if gain - without > _LEAST_HELD_OUT_GAIN else ball

    @property
    def groups(self) -> list[GroupSample]:
        """The samples that are groups of spheres, not crowds."""
        return [s for s in self.samples if isinstance(s, GroupSample)]

    @property
    def in_groups(self) -> bool:
        """Whether no sample is a crowd."""
        return len(self.groups) == len(self.samples)

    @property
    def usual(self) -> UsualImage:
        """What most spheres of the samples have in common."""
        chi2 = [fit.chi2(self.noise) for fit in self.fits]
        return UsualImage.of(chi2, [fit.brightness for fit in self.fits])

    @property
    def shows_tail(self) -> bool:
        """Whether the share of a second, wider Gaussian is significant to first order.

        That is its first step over the error of this step.
        """
        variance = np.linalg.pinv(self.information, hermitian=True)[-1]
        return bool(variance @ self.score > _LEAST_SHARE_ERRORS * np.sqrt(variance[-1]))

    def without_dust(self) -> tuple[LikeliestOptics, int]:
        """Return the parameters without samples that are no spheres, and the number of these."""
        found, left_out = self, 0
        for _ in range(_MAX_SEARCHES - 1):
            kept = found.usual.spheres_among(found.samples, found.fits, noise=found.noise)
            if len(kept) == len(found.samples) or len(kept) < _FEWEST_SAMPLES:
                break
            left_out += len(found.samples) - len(kept)
            found = found.search(kept, found.parameters, found.noise)
        return found, left_out

    def refitted_to(
        self, samples: Sequence[GroupSample | CrowdSample]
    ) -> tuple[LikeliestOptics, int]:
        """Return the parameters for those of other samples that are spheres by the present image.

        Parameters
        ----------
        samples : sequence of GroupSample or CrowdSample

        Returns
        -------
        LikeliestOptics
            The present ones if fewer than two samples are spheres.
        int
            Number of samples that are none.
        """
        variations = ImageVariations.about(self.parameters)
        usable = [s for s in samples if s.has_enough_voxels(variations.image)]
        fits = [s.fit(variations, self.noise) for s in usable]
        kept = self.usual.spheres_among(usable, fits, noise=self.noise)
        left_out = len(usable) - len(kept)
        if len(kept) < _FEWEST_SAMPLES:
            return self, left_out
        return self.search(kept, self.parameters, self.noise), left_out

    def with_common_noise(self, *, camera_pattern: bool) -> LikeliestOptics:
        """Return the parameters with noise that voxels have in common, if the residuals show any.

        That is the gain of pixels where a camera has a pattern, and flicker of the light otherwise.
        """
        if not self.in_groups:
            return self
        # Differences along a line are free from what its voxels have in common.
        axis, lines_of = (0, Lines.of_pixels) if camera_pattern else (2, Lines.of_scan)
        along = [fit.variance_along(axis) for fit in self.fits]
        noise = photon_transfer(*(np.concatenate(part) for part in zip(*along, strict=True)))
        if noise.gain <= 0:
            return self
        windows = []
        for fit in self.fits:
            light, weight = noise.light(fit.expected), noise.weight(fit.expected)
            windows.append(LineChanges.of(lines_of(fit.mask), fit.residual, light, weight))
        if camera_pattern:
            noise = noise._replace(pixel=find_gain_spread(windows))
        else:
            plane, line = find_flicker(windows)
            noise = noise._replace(plane=plane, line=line)
        return self.search(self.samples, self.parameters, noise) if noise.correlated else self

    def with_neighbours(self) -> LikeliestOptics:
        """Return the same with the correlation of the noise of neighbouring voxels, if any."""
        if self.noise.correlated:
            return self
        neighbours, along_z = find_neighbours(
            [
                (fit.mask, fit.residual * np.sqrt(self.noise.weight(fit.expected)))
                for fit in self.fits
            ]
        )
        noise = self.noise._replace(neighbours=neighbours, along_z=along_z)
        if along_z:
            # Of smoothed noise, differences of neighbours show little but the rounding.
            transfer = photon_transfer(
                np.concatenate([fit.expected for fit in self.fits]),
                np.concatenate([fit.residual**2 for fit in self.fits]),
            )
            noise = noise._replace(gain=transfer.gain, floor=transfer.floor)
        return self._replace(noise=noise)

    def with_spread(self) -> LikeliestOptics:
        """Return the parameters with a spread of the diameters if their likelihood shows one."""
        trial = replace(self.parameters, spread=_FIRST_SPREAD)
        variations = ImageVariations.about(trial)
        fits = [s.fit(variations, self.noise) for s in self.samples]
        sizes = np.concatenate([fit.sizes for fit in fits])
        posterior = np.concatenate([fit.size_variance for fit in fits])
        # Deviations and variances from the images alone, without the distribution.
        variance = 1.0 / np.maximum(1.0 / posterior - _FIRST_SPREAD**-2, 1e-3 / posterior)
        deviation = sizes * variance / posterior
        deviation -= np.average(deviation, weights=1.0 / variance)
        spreads = np.geomspace(_LEAST_SPREAD, 0.2, 30)
        total = variance + spreads[:, None] ** 2
        gain = 0.5 * np.sum(
            deviation**2 * (1.0 / variance - 1.0 / total) - np.log(total / variance), axis=1
        )
        best = int(np.argmax(gain))
        if gain[best] < _LEAST_SPREAD_GAIN:
            return self
        try:
            start = replace(self.parameters, spread=float(spreads[best]))
            return self.search(self.samples, start, self.noise)
        except NoSpheresError:
            # Equal diameters have settled, and different ones have not: the first are used.
            return self

    def with_tail(self) -> LikeliestOptics:
        """Return the parameters with a tail if groups that were not fitted are more likely with it.

        Samples of which one is a crowd, or of which fewer than two have enough voxels for the wider
        image, have none.
        """
        if not self.in_groups:
            return self
        start = self.parameters.with_tail()
        widest = start.image()
        groups = [s for s in self.groups if s.has_enough_voxels(widest)]
        return self._or_likelier(start, groups, rounds=_MAX_TRIAL_ROUNDS)

    def with_pupil(self) -> LikeliestOptics:
        """Return those of a confocal point spread if groups not fitted are likelier with it.

        It is tried where the sum of two Gaussians is not used, or much of the light is in the wider
        one, as behind an open pinhole, and where spheres are at most 10 um large. The present ones
        have Gaussians, and are fitted to all groups; the others to half of them.
        """
        before = self.parameters.image()
        closed = before.tail is not None and before.tail.share < _OPEN_SHARE
        groups = self.groups
        few = not self.in_groups or len(groups) < _FEWEST_SAMPLES
        if closed or few or before.diameter > MOST_DIAMETER:
            return self

        def likelihood(start: ImageParameters) -> float:
            image = start.image()
            return sum(s.log_likelihood(image, self.noise, within=before) for s in groups[::2])

        starts = [self.parameters.with_pupil(pinhole) for pinhole in _PINHOLES_TRIED]
        start = max(starts, key=likelihood)
        return self._or_likelier(start, groups, rounds=_MAX_PUPIL_ROUNDS, within=before)

    def _or_likelier(
        self,
        start: ImageParameters,
        groups: list[GroupSample],
        *,
        rounds: int,
        within: SphereImage | None = None,
    ) -> LikeliestOptics:
        """Return parameters from another start if groups that were not fitted are likelier.

        They are compared on the voxels of the image `within`, by default that of the other
        parameters.
        """
        if len(groups) < _FEWEST_SAMPLES:
            return self
        try:
            half = self.search(
                groups[::2], start, self.noise, rounds=rounds, tolerance=_TRIAL_STEP_IN_ERRORS
            )
            before, image = self.parameters.image(), half.parameters.image()
            within = within or image
            gain = sum(
                s.log_likelihood(image, half.noise, within=within)
                - s.log_likelihood(before, half.noise, within=within)
                for s in groups[1::2]
            )
            if gain < _LEAST_HELD_OUT_GAIN:
                return self
            return self.search(groups, half.parameters, half.noise)
        except NoSpheresError:
            # The present point spread has settled, and the other one has not: the first is used.
            return self
