"""Optics learned from frames: sphere diameter, point spread and camera noise; and saturation."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.errors import NoSpheresError
from perrin.images.optics.asymmetry import Asymmetry, significant_sums
from perrin.images.optics.ball_image import BallBlur, PsfTail, SphereImage, sphere_image
from perrin.images.optics.crowd_equations import profile_information, slopes_of_spheres
from perrin.images.optics.crowd_fit import fit_crowd
from perrin.images.optics.depth import DepthChange, significant_slopes
from perrin.images.optics.flicker import LineChanges, Lines, find_flicker, find_gain_spread
from perrin.images.optics.neighbours import (
    THIRD_DIFFERENCE,
    find_neighbours,
    neighbour_variance,
)
from perrin.images.optics.optics import CameraNoise, Optics
from perrin.images.optics.pupil import AIRY, Pupil, PupilBall
from perrin.images.optics.window_fit import FreeCenters, cut_window, fit_window

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from perrin._arrays import Bools, Floats
    from perrin.images.optics.point_spread import PointSpread
    from perrin.images.optics.window_fit import Window


# Change of a parameter for the central differences.
_PARAMETER_DIFFERENCE = 0.01

# Largest step of a parameter; the search ends at steps below this, or below this fraction of their
# standard errors: voxels that enter and leave the windows change the maximum by up to a fifth.
_MAX_STEP, _STEP_CONVERGED, _STEP_IN_ERRORS = 0.25, 1e-3, 0.3

_MAX_LEARNING_ROUNDS = 15

# The same two for the tail of half of the groups, which only has to be good enough to be chosen.
_MAX_TRIAL_ROUNDS, _TRIAL_STEP_IN_ERRORS = 6, 2.0

# Least ratios of the blur along z to that in the plane (both are varied), of the blur to that of
# the voxel alone, and of the tail's blur to that of the narrower Gaussian.
_LEAST_ELONGATION, _LEAST_OVER_VOXEL, _LEAST_TAIL = 1.025, 1.02, 1.2

# Blurs and share of the tail at the start of its search, over the Gaussian point spread found.
_NARROWED, _WIDENED, _TAIL_SHARE, _MAX_TAIL_SHARE = 0.85, 3.0, 0.15, 0.6

# Share of the tail from which on a confocal point spread is tried, which takes seconds.
_OPEN_SHARE = 0.4

# Values of a `Pupil` at the start of the search for a confocal point spread, pinholes of which the
# likeliest is the start, in Airy units, and the least and the largest values: apertures of 0.3 to
# 1.5 and visible light, or, where voxels are points, a narrower point spread.
_PUPIL_START, _PINHOLES_TRIED = (13.0, 0.55), (0.7, 2.0, 5.0)
_PUPIL_LEAST, _PUPIL_MOST = np.log([2.5, 0.1, 0.02]), np.log([40.0, 0.75, 4.0])
_MAX_PUPIL_ROUNDS = 12

# A tail is searched for if its share is this many standard errors above 0 to first order, and it is
# kept if it increases the logarithm of the likelihood of other groups by at least this.
_LEAST_SHARE_ERRORS, _LEAST_HELD_OUT_GAIN = 3.0, 3.0

# Median chi-squared per voxel above which shells are tried in place of balls.
_SHELL_MISFIT = 1.3

# Spread of the diameters with which they are fitted first; a spread is used if it is at least this,
# and increases the logarithm of the likelihood of the diameters by at least this.
_FIRST_SPREAD, _LEAST_SPREAD, _LEAST_SPREAD_GAIN = 0.06, 0.007, 5.0

# Rounds of the search for moments of the point spread, and their number: the components of an
# asymmetry, and the slopes of four moments against the height.
_MOMENT_ROUNDS, _N_SLOPES = 4, len(DepthChange(0.0, 0.0, 0.0).slopes)
_N_MOMENTS = len(Asymmetry._fields) + _N_SLOPES
_OF_DEPTH = np.arange(_N_MOMENTS) >= _N_MOMENTS - _N_SLOPES

# Components of an asymmetry that differ above and below the focus alone.
_ABOVE_FOCUS = [Asymmetry._fields.index(name) for name in ("zzz", "zrr")]

# Change of the spread, relative to it, at which its search ends.
_SPREAD_CONVERGED = 0.05

# What is no sphere has over this multiple of the usual chi-squared, beyond this number of standard
# errors of it, or over this multiple of the usual brightness, beyond this number of standard
# deviations.
_WORST_CHI2, _CHI2_DEVIATIONS, _BRIGHTEST, _BRIGHT_DEVIATIONS = 1.6, 6.0, 1.4, 8.0

# Searches for the optics, each without the samples that the one before found to be no spheres.
_MAX_SEARCHES, _FEWEST_SAMPLES = 4, 2

# Searches of a crowd's residuals for missing spheres, in every round.
_LEARNING_SEARCHES = 2

# Saturation below this number of voxels, or this fraction of them, does not affect any position.
_MIN_CLIPPED, _MIN_CLIPPED_FRACTION = 10, 1e-5

# Number of occupied grey levels below the highest, with which it is compared.
_COMPARED_LEVELS = 3

# Share of a voxel and its neighbours at the lowest grey level from which on it is left out.
_MANY_AT_FLOOR = 0.1

# Number of voxels in which a floor is searched for.
_FLOOR_SAMPLE = 50_000

# Voxels at the lowest grey level over those at the next ones, and largest ratio of the next two.
_PILED, _FLAT = 3.0, 2.0

# Level of the saturation test in one frame: movies have thousands of frames.
_SATURATION_LEVEL = 1e-6


def saturated_share(data: NDArray[Any]) -> float:
    """Return the fraction of voxels that are clipped at the highest grey level; 0 where none is.

    Parameters
    ----------
    data : ndarray
        One frame, in the type in which it was recorded.

    Returns
    -------
    float

    Notes
    -----
    The highest grey level of a frame is the end of the camera's range where it is the largest value
    of an integer type, or where significantly more voxels have it than have any of the three
    occupied grey levels below it: without clipping, the number of voxels decreases from level to
    level. The numbers of voxels at two levels are compared by the binomial test.

    Examples
    --------
    >>> import numpy as np
    >>> frame = np.random.default_rng(1).poisson(200.0, size=100_000).astype(np.uint16)
    >>> saturated_share(frame), round(saturated_share(np.minimum(frame, 230)), 3)
    (0.0, 0.02)
    """
    from scipy.special import bdtrc

    top = data.max()
    count = int(np.count_nonzero(data == top))
    share = count / data.size
    if count < _MIN_CLIPPED or share <= _MIN_CLIPPED_FRACTION:
        return 0.0
    if data.dtype.kind in "iu" and top == np.iinfo(data.dtype).max:
        return share
    numbers = np.unique(data, return_counts=True)[1]
    if len(numbers) == 1:
        return 0.0
    most = int(numbers[-1 - _COMPARED_LEVELS : -1].max())
    # The level is the highest because one voxel has it: that voxel is no evidence.
    return share if bdtrc(count - 2, count - 1 + most, 0.5) < _SATURATION_LEVEL else 0.0


def floor_share(data: NDArray[Any]) -> float:
    """Return the fraction of voxels that are clipped at the lowest grey level; 0 where none is.

    Parameters
    ----------
    data : ndarray
        One frame, in the type in which it was recorded.

    Returns
    -------
    float

    Notes
    -----
    The offset of a camera that is set too low, or a background that was subtracted, cuts the
    distribution of the grey levels where it hardly changes from level to level. The lowest grey
    level is the end of the range where over three times as many voxels have it as have any of the
    next three occupied levels, and the first of these is less than twice as frequent as the
    second. Counts of few photons, which are also often zero, decrease faster.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> grey = rng.normal(-4.0, 5.0, (9, 40, 40)).round()
    >>> round(floor_share(np.maximum(grey, 0)), 2), floor_share(rng.poisson(0.3, (9, 40, 40)))
    (0.82, 0.0)
    """
    # An odd step visits all columns of a frame.
    rest = data.ravel()[:: max(data.size // _FLOOR_SAMPLE, 1) | 1]
    numbers, size = [], rest.size
    for _ in range(1 + _COMPARED_LEVELS):
        if not rest.size:
            return 0.0
        low = rest == rest.min()
        numbers.append(int(np.count_nonzero(low)))
        rest = rest[~low]
    piled = numbers[0] > _PILED * max(numbers[1:]) and numbers[1] < _FLAT * numbers[2]
    return numbers[0] / size if piled else 0.0


def without_clipped(data: NDArray[Any]) -> Floats:
    """Return a frame as float64, with NaN in voxels that are clipped and in their neighbours.

    A voxel that noise keeps just below the end of the range is no sample of its distribution, so
    that all voxels beside clipped ones are left out too: their selection does not depend on their
    own noise. At the floor of the range, where most of a frame may be, those are left out of whose
    neighbours a tenth is clipped: with fewer, the mean of Gaussian noise is moved by less than a
    twentieth of its standard deviation.

    Parameters
    ----------
    data : ndarray
        One frame, in the type in which it was recorded.

    Returns
    -------
    ndarray
        The frame itself where `saturated_share` and `floor_share` find no clipping.

    Examples
    --------
    >>> frame = np.random.default_rng(1).poisson(9.0, size=(9, 40, 40)).astype(np.uint8)
    >>> frame[3:6, 20:23, 20:23] = 255
    >>> int(np.isnan(without_clipped(frame)).sum())
    125
    """
    from scipy.ndimage import binary_dilation, uniform_filter

    frame = np.asarray(data, dtype=np.float64)
    if saturated_share(data) > 0:
        beside = np.ones((3,) * frame.ndim, dtype=np.bool_)
        frame = np.where(binary_dilation(data == data.max(), beside), np.nan, frame)
    if floor_share(data) > 0:
        low = uniform_filter((data == data.min()).astype(np.float64), size=3)
        frame = np.where(low > _MANY_AT_FLOOR, np.nan, frame)
    return frame


@dataclass(frozen=True, eq=False)
class ImageParameters:
    """The parameters of a sphere's image in the search for the optics.

    Attributes
    ----------
    values : ndarray, shape (1,), (3,), (4,) or (6,)
        Logarithms of the diameter and of the blurs along z and in the plane, um; with a tail its
        share, and the logarithms of its blurs. Blurs include the voxel. With a measured point
        spread the diameter alone; of a confocal one the logarithms of the diameter and of the
        three values of a `Pupil`.
    voxel : tuple of float
        Voxel size (z, y, x), um.
    spread : float
        Relative standard deviation of the diameters of different spheres.
    measured : PointSpread or None
        A point spread that was measured, and is not searched for.
    shell : bool
        The surface of the spheres is fluorescent, in place of all of them.
    asymmetry : Asymmetry or None
        By what the point spread differs from an even body of revolution.
    depth : DepthChange or None
        How the point spread changes with the height of a sphere.

    Examples
    --------
    >>> plain = ImageParameters(np.log([2.45, 0.4, 0.15]), (0.25, 0.2, 0.2))
    >>> plain.image().psf[0].__round__(3), len(plain.with_tail().values)
    (0.393, 6)
    """

    values: Floats
    voxel: tuple[float, float, float]
    spread: float = 0.0
    measured: PointSpread | None = None
    shell: bool = False
    asymmetry: Asymmetry | None = None
    depth: DepthChange | None = None

    @property
    def voxel_blur(self) -> Floats:
        """Standard deviations (z, plane) of a voxel, um."""
        return np.sqrt(np.array([self.voxel[0] ** 2, self.voxel[1] * self.voxel[2]]) / 12)

    @property
    def of_pupil(self) -> bool:
        """Whether the point spread is that of a confocal microscope."""
        return len(self.values) == 1 + len(Pupil._fields)

    def ball(self, values: Floats) -> BallBlur | PupilBall:
        """Return the blurred ball at other values of the parameters."""
        if self.of_pupil:
            size, lateral, slope, pinhole = np.exp(values).tolist()
            wide_z, wide = np.square(self.voxel_blur).tolist()
            pupil = Pupil(lateral, slope, pinhole)
            return PupilBall(size, pupil, (wide_z, wide), self.shell)
        if self.measured is not None:
            wide_z, wide = self.voxel_blur.tolist()
            measured = tuple(
                (share, (float(np.hypot(z, wide_z)), float(np.hypot(plane, wide))))
                for share, (z, plane) in self.measured.components
            )
            return BallBlur(float(np.exp(values[0])), measured, self.shell)
        diameter, blur_z, blur = np.exp(values[:3]).tolist()
        if len(values) == 3:
            return BallBlur(diameter, ((1.0, (blur_z, blur)),), self.shell)
        share, (tail_z, tail) = float(values[3]), np.exp(values[4:]).tolist()
        both = ((1.0 - share, (blur_z, blur)), (share, (tail_z, tail)))
        return BallBlur(diameter, both, self.shell)

    def image(self) -> SphereImage:
        """Return the sphere's image."""
        ball = self.ball(self.values)
        if self.measured is not None:
            return sphere_image(
                diameter=ball.diameter,
                psf=self.measured.components[0][1],
                voxel=self.voxel,
                spread=self.spread,
                measured=self.measured,
                shell=self.shell,
                asymmetry=self.asymmetry,
                depth=self.depth,
            )
        if isinstance(ball, PupilBall):
            return sphere_image(
                diameter=ball.diameter,
                psf=ball.pupil.psf,
                voxel=self.voxel,
                spread=self.spread,
                shell=self.shell,
                asymmetry=self.asymmetry,
                depth=self.depth,
                pupil=ball.pupil,
            )
        (psf_z, psf), *wider = (
            np.sqrt(np.square(blur) - self.voxel_blur**2).tolist() for _, blur in ball.components
        )
        tail = None
        if wider:
            tail = PsfTail(ball.components[1][0], (wider[0][0], wider[0][1]))
        return sphere_image(
            diameter=ball.diameter,
            psf=(psf_z, psf),
            voxel=self.voxel,
            tail=tail,
            spread=self.spread,
            shell=self.shell,
            asymmetry=self.asymmetry,
            depth=self.depth,
        )

    def with_tail(self) -> ImageParameters:
        """Return parameters with a tail at the start of its search."""
        blurs = self.values[1:]
        start = [
            self.values[:1],
            blurs + np.log(_NARROWED),
            [_TAIL_SHARE],
            blurs + np.log(_WIDENED),
        ]
        return replace(self, values=np.concatenate(start)).within_bounds()

    def with_pupil(self, airy_units: float) -> ImageParameters:
        """Return parameters of a confocal point spread at the start of its search."""
        lateral, slope = _PUPIL_START
        start = np.log([lateral, slope, airy_units * AIRY / lateral])
        return replace(self, values=np.append(self.values[:1], start))

    def bounds(self) -> tuple[Floats, Floats]:
        """Return the least and the largest values of the parameters.

        A blur is at least that of the voxel, and a microscope's point spread is elongated along z;
        the tail is wider than the other Gaussian, and narrower than the sphere.
        """
        n = len(self.values)
        low, high = np.full(n, -np.inf), np.full(n, np.inf)
        if n == 1:
            return low, high
        if self.of_pupil:
            low[1:], high[1:] = _PUPIL_LEAST, _PUPIL_MOST
            return low, high
        least = np.log(_LEAST_OVER_VOXEL * self.voxel_blur)
        low[2] = least[1]
        low[1] = max(least[0], max(self.values[2], low[2]) + np.log(_LEAST_ELONGATION))
        if n > 3:
            low[3], high[3] = 0.0, _MAX_TAIL_SHARE
            low[4:] = np.maximum(self.values[1:3], low[1:3]) + np.log(_LEAST_TAIL)
            low[4] = max(low[4], max(self.values[5], low[5]) + np.log(_LEAST_ELONGATION))
            high[4:] = np.maximum(self.values[0], low[4:])
        return low, high

    def within_bounds(self) -> ImageParameters:
        """Return the nearest parameters within the bounds."""
        return replace(self, values=np.clip(self.values, *self.bounds()))

    def moved(
        self, information: Floats, score: Floats, *, larger: float | None = None
    ) -> ImageParameters:
        """Return the parameters after a Gauss-Newton step that stays within the bounds.

        A parameter that would leave its bound is set to it, and the step of the others is computed
        again. The step of the diameter may be given as `larger`.
        """
        low, high = self.bounds()
        step, free = np.zeros_like(score), np.ones(len(score), dtype=np.bool_)
        if larger is not None:
            step[0], free[0] = larger, False
        while free.any():
            pull = score[free] - information[free][:, ~free] @ step[~free]
            # Without a share there is no information on the widths of the tail.
            step[free] = np.linalg.lstsq(information[free][:, free], pull, rcond=None)[0]
            moved = self.values + step
            left = free & ((moved < low) | (moved > high))
            if not left.any():
                break
            step[left] = np.clip(moved, low, high)[left] - self.values[left]
            free &= ~left
        step *= min(1.0, _MAX_STEP / max(np.abs(step).max(), _MAX_STEP))
        return replace(self, values=self.values + step).within_bounds()

    def optics(self, noise: CameraNoise, information: Floats) -> Optics:
        """Return the optics, with standard errors from the information on the parameters."""
        image = self.image()
        covariance = np.linalg.pinv(information, hermitian=True)
        error = np.sqrt(np.diag(covariance))[:3]
        ball = self.ball(self.values)
        if isinstance(ball, PupilBall):
            # The width in the plane is as 1 / lateral, that along z as 1 / (lateral slope).
            along = float(np.sqrt(max(covariance[1:3, 1:3].sum(), 0.0)))
            z, plane = ball.pupil.psf
            stderr = (float(image.diameter * error[0]), z * along, plane * float(error[1]))
            return Optics(
                *(image.diameter, image.psf, noise, stderr, None, self.spread),
                shell=self.shell,
                asymmetry=self.asymmetry,
                depth=self.depth,
                pupil=ball.pupil,
            )
        if self.measured is not None:
            stderr = (float(image.diameter * error[0]), 0.0, 0.0)
            return Optics(
                *(image.diameter, image.psf, noise, stderr, None, self.spread, self.measured),
                shell=self.shell,
                asymmetry=self.asymmetry,
                depth=self.depth,
            )
        # The blur is the root of the sum of squares of point spread and voxel.
        factor = np.array([image.diameter, *(np.square(image.blur) / np.array(image.psf))])
        a, b, c = (float(value) for value in factor * error)
        return Optics(
            *(image.diameter, image.psf, noise, (a, b, c), image.tail, self.spread),
            shell=self.shell,
            asymmetry=self.asymmetry,
            depth=self.depth,
        )


class MomentTables(NamedTuple):
    """Tables of the derivatives of an image by the moments of the point spread.

    Attributes
    ----------
    asymmetry : ndarray
        Those by the components of an `Asymmetry` (`SphereImage.asymmetry_knots`).
    widths : ndarray
        Those by the variances along z and in the plane.
    heights : DepthChange
        The middle and the range of the heights of the spheres.
    """

    asymmetry: Floats
    widths: Floats
    heights: DepthChange


class ImageVariations(NamedTuple):
    """The sphere's image and its derivatives by the parameters.

    Attributes
    ----------
    image : SphereImage
        The image at the present values.
    slopes : ndarray, shape (k, ...)
        Tables of the derivatives (`SphereImage.slopes`); of a single Gaussian the last one is that
        by the share of a tail, at a share of 0.
    moments : MomentTables or None
        Tables of the derivatives by the moments of the point spread, if they are wanted.
    """

    image: SphereImage
    slopes: Floats
    moments: MomentTables | None = None

    @classmethod
    def about(
        cls, parameters: ImageParameters, *, heights: DepthChange | None = None
    ) -> ImageVariations:
        """Return image and derivatives at the values of parameters.

        Those by the moments of the point spread are wanted where `heights` are stated.
        """
        values, d = parameters.values, _PARAMETER_DIFFERENCE
        pairs = [
            (parameters.ball(values + shift), parameters.ball(values - shift))
            for shift in d * np.eye(len(values))
        ]
        if len(values) == 3:
            plain = parameters.ball(values)
            wide = np.concatenate([values, [2 * d], values[1:] + np.log(_WIDENED)])
            pairs.append((parameters.ball(wide), plain))
        image = parameters.image()
        slopes = image.slopes(pairs, 2 * d)
        if heights is None:
            return cls(image, slopes)
        ball, square = parameters.ball(values), np.square(image.blur)
        changes = ((d * square[0], 0.0), (0.0, d * square[1]))
        widths = [
            image.slopes([(ball.widened(*c), ball.widened(*(-x for x in c)))], 2 * sum(c))[0]
            for c in changes
        ]
        tables = MomentTables(image.asymmetry_knots(), np.stack(widths), heights)
        return cls(image, slopes, tables)


class SampleFit(NamedTuple):
    """A fit to one sample of a frame, and its information on the optics.

    Attributes
    ----------
    centers : ndarray, shape (n, 3)
        Fitted positions (z, y, x), um.
    information : ndarray, shape (k, k)
        Information on the k parameters of the image, the parameters of the spheres eliminated.
    score : ndarray, shape (k,)
        Score of these parameters.
    expected, squared_residual : ndarray, shape (m,)
        Expected grey levels of the voxels of the fit, and squared differences of their grey levels
        from these, without those that flicker explains.
    brightness : ndarray, shape (n,)
        Fitted intensity inside each sphere, grey levels.
    level, variance : ndarray, shape (q,)
        Expected grey levels of groups of neighbouring voxels, and estimates of the variance of
        these voxels from their differences (`neighbour_variance`).
    sizes, size_variance : ndarray, shape (n,)
        Deviations of the logarithms of the diameters and their variances, where they are fitted.
    residual : ndarray, shape (m,)
        Grey levels minus expected grey levels.
    mask : ndarray of bool, shape (nz, ny, nx)
        The voxels of the fit.
    """

    centers: Floats
    information: Floats
    score: Floats
    expected: Floats
    squared_residual: Floats
    brightness: Floats
    level: Floats
    variance: Floats
    sizes: Floats
    size_variance: Floats
    residual: Floats
    mask: Bools

    def chi2(self, noise: CameraNoise) -> float:
        """Return the mean squared residual over the variance that a camera noise predicts."""
        return float(np.mean(self.squared_residual * noise.weight(self.expected)))


@dataclass(frozen=True)
class UsualImage:
    """What the images of the spheres of a movie have in common.

    Attributes
    ----------
    chi2 : float
        Chi-squared per degree of freedom of the fits to spheres: over 1 where the model of the
        image is not exact.
    brightness : float
        Median intensity inside a sphere, grey levels; negative for dark spheres.
    spread : float
        Standard deviation of its logarithm over the spheres, from the median deviation.
    left_out : int
        Number of groups that were left out in learning it, because they are no spheres.

    Examples
    --------
    >>> usual = UsualImage(1.0, 100.0, 0.1)
    >>> usual.brightest, UsualImage(1.0, 100.0, 0.3).brightest > 2 * usual.brightest
    (2.225540928492468, True)
    """

    chi2: float
    brightness: float
    spread: float
    left_out: int = 0

    @classmethod
    def of(cls, chi2: Sequence[float], brightness: Sequence[Floats]) -> UsualImage:
        """Return what most spheres of some groups have in common.

        Parameters
        ----------
        chi2 : sequence of float
            Chi-squared per degree of freedom of the fit to each group.
        brightness : sequence of ndarray
            Intensity inside each sphere of each group.
        """
        count = [len(b) for b in brightness]
        every = np.concatenate(brightness)
        median = float(np.median(every))
        relative = every[every * median > 0] / median
        deviation = np.median(np.abs(np.log(relative))) if relative.size else 0.0
        # A low quantile, because what is no sphere has a larger chi-squared.
        return cls(float(np.quantile(np.repeat(chi2, count), 0.25)), median, 1.4826 * deviation)

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> UsualImage:
        """Return the values that `to_dict` wrote."""
        return cls(**entry)

    @property
    def worst_chi2(self) -> float:
        """Return the largest chi-squared per degree of freedom of a sphere."""
        return _WORST_CHI2 * self.chi2

    @property
    def brightest(self) -> float:
        """Return the largest brightness of a sphere over the median."""
        return max(_BRIGHTEST, float(np.exp(_BRIGHT_DEVIATIONS * self.spread)))

    def excess(self, chi2: Floats, brightness: Floats, *, voxels: Floats) -> Floats:
        """Return how far images are from those of spheres: over 1 for what is no single sphere.

        Parameters
        ----------
        chi2 : ndarray, shape (n,)
            Chi-squared per voxel, averaged over the voxels of each sphere.
        brightness : ndarray, shape (n,)
            Intensity inside each sphere over the usual one in this frame and depth.
        voxels : ndarray, shape (n,)
            Number of voxels in each sphere.
        """
        bound = self.chi2 * np.maximum(_WORST_CHI2, _chance(voxels))
        return np.maximum(chi2 / bound, brightness / self.brightest)

    def disturbed(self, chi2: Floats, *, voxels: Floats) -> Bools:
        """Return which images of spheres have more residual than chance leaves.

        Parameters
        ----------
        chi2, voxels : ndarray, shape (n,)
            As in `excess`.
        """
        return np.asarray(chi2 > self.chi2 * _chance(voxels))


def _chance(voxels: Floats) -> Floats:
    """Return the largest ratio of a chi-squared per voxel to the usual one by chance."""
    return 1 + _CHI2_DEVIATIONS * np.sqrt(2 / np.maximum(voxels, 1.0))


class LearnedOptics(NamedTuple):
    """Optics that were learned from samples of frames.

    Attributes
    ----------
    optics : Optics
        Sphere diameter, point spread and noise.
    usual : UsualImage
        What the images of the spheres have in common.
    """

    optics: Optics
    usual: UsualImage


class GroupSample(NamedTuple):
    """One group of spheres in one frame, from which the optics are learned.

    Attributes
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    centers, others : ndarray, shape (n, 3), (m, 3)
        Positions (z, y, x) of the group and of all other spheres, um.
    """

    frame: Floats
    centers: Floats
    others: Floats

    def window(self, image: SphereImage) -> Window:
        """Return the voxels of the fit."""
        return cut_window(self.frame, image, self.centers, others=self.others)

    def fit(self, variations: ImageVariations, noise: CameraNoise) -> SampleFit:
        """Fit positions, brightness and background, and return the information on the optics.

        Parameters
        ----------
        variations : ImageVariations
        noise : CameraNoise

        Returns
        -------
        SampleFit
        """
        image = variations.image
        window = self.window(image)
        fit = fit_window(window, image, noise, FreeCenters(self.centers))
        slope = window.slopes(image, variations.slopes, fit.centers, fit.brightness, fit.sizes)
        if variations.moments is not None:
            knots, widths, heights = variations.moments
            spheres = fit.centers, fit.brightness
            more = window.asymmetry_slopes(image, knots, *spheres)
            deep = window.depth_slopes(image, widths, knots[2:4], *spheres, heights=heights)
            slope = np.concatenate([slope, more, deep])
        # The Schur complement of the information, with the fit's own parameters eliminated.
        weighted = fit.precision.times(slope)
        nuisance = fit.precision.times(fit.jacobian)
        shared = nuisance @ slope.T
        own = nuisance @ fit.jacobian.T + np.diag(fit.prior)
        taken = np.linalg.lstsq(own, shared, rcond=None)[0]
        residual = window.data - fit.expected
        information = weighted @ slope.T - shared.T @ taken
        left_over = nuisance @ residual
        if image.spread > 0:
            left_over[fit.prior > 0] -= fit.sizes / image.spread**2
        score = weighted @ residual - taken.T @ left_over
        # Flicker is noise that the voxels of a line have in common.
        flickers = noise.correlated and not noise.pixel
        axis = 2 if flickers else _most_blurred_axis(image, window.mask.shape)
        level, variance = _variance_along(axis, window.mask, residual, fit.expected)
        return SampleFit(
            fit.centers,
            information,
            score,
            fit.expected,
            fit.precision.left(residual) ** 2,
            fit.brightness,
            level,
            variance,
            fit.sizes,
            fit.size_variance,
            residual,
            window.mask,
        )

    def log_likelihood(
        self, image: SphereImage, noise: CameraNoise, *, within: SphereImage
    ) -> float:
        """Return the logarithm of the likelihood of the group's voxels, up to a constant.

        The variance of the factors of flicker, which the image hardly changes, is left out.

        Parameters
        ----------
        image : SphereImage
            The image with which the group is fitted.
        noise : CameraNoise
        within : SphereImage
            The image that sets the voxels.

        Returns
        -------
        float
        """
        window = self.window(within)
        fit = fit_window(window, image, noise, FreeCenters(self.centers))
        residual = window.data - fit.expected
        square = residual * fit.precision.times(residual)
        return -0.5 * float(np.sum(square - np.log(fit.weight)))


class CrowdSample(NamedTuple):
    """A piece of a frame full of touching spheres, from which the optics are learned.

    Attributes
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    centers, others : ndarray, shape (n, 3), (m, 3)
        Positions (z, y, x) of the crowd and of all other spheres, um.
    contact : float
        Centre distance of touching spheres, um.
    """

    frame: Floats
    centers: Floats
    others: Floats
    contact: float

    def fit(self, variations: ImageVariations, noise: CameraNoise) -> SampleFit:
        """Fit positions, brightness and background, and return the information on the optics.

        Parameters
        ----------
        variations : ImageVariations
        noise : CameraNoise

        Returns
        -------
        SampleFit
        """
        found = fit_crowd(
            self.frame,
            self.centers,
            others=self.others,
            contact=self.contact,
            image=variations.image,
            noise=noise,
            searches=_LEARNING_SEARCHES,
        )
        window, state = found.window, found.intensity
        slope = slopes_of_spheres(window, variations.slopes, state.centers, state.brightness)
        information, score = profile_information(window, state, slope)
        residual = window.data - state.expected
        used = window.mask
        axis = _most_blurred_axis(variations.image, used.shape)
        level, variance = neighbour_variance(residual, state.expected, used, axis=axis)
        equal = np.zeros(len(state.centers))
        return SampleFit(
            state.centers,
            information,
            score,
            state.expected[used],
            residual[used] ** 2,
            state.brightness,
            level,
            variance,
            equal,
            equal,
            residual[used],
            used,
        )


def _variance_along(
    axis: int, mask: Bools, residual: Floats, expected: Floats
) -> tuple[Floats, Floats]:
    """Return `neighbour_variance` of the voxels (m,) of a window."""
    left, level = np.zeros((2, *mask.shape))
    left[mask], level[mask] = residual, expected
    return neighbour_variance(left, level, mask, axis=axis)


def _most_blurred_axis(image: SphereImage, shape: tuple[int, ...]) -> int:
    """Return the axis along which the blur covers most voxels, of those with four neighbours."""
    blur = np.array([image.blur[0], image.blur[1], image.blur[1]]) / image.voxel
    return int(np.argmax(np.where(np.array(shape) >= len(THIRD_DIFFERENCE), blur, -1.0)))


class _Settled(NamedTuple):
    """Parameters at the maximum of the likelihood of some samples."""

    parameters: ImageParameters
    noise: CameraNoise
    samples: list[GroupSample | CrowdSample]
    fits: list[SampleFit]
    information: Floats
    score: Floats

    def with_neighbours(self) -> _Settled:
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


def fit_samples(
    samples: Sequence[GroupSample | CrowdSample],
    *,
    diameter: float,
    voxel: tuple[float, float, float],
    measured: PointSpread | None = None,
    shell: bool = False,
    camera_pattern: bool = False,
) -> LearnedOptics:
    """Find the sphere diameter, point spread and noise of greatest likelihood for most samples.

    Samples whose images are not those of spheres (dust, spheres that the border cuts) are left out.

    Parameters
    ----------
    samples : sequence of GroupSample or CrowdSample
        Pieces of frames.
    diameter : float
        Diameter at the start of the search, um; the diameter of the result is fitted.
    voxel : tuple of float
        Voxel size (z, y, x), um.
    measured : PointSpread, optional
        A point spread that was measured; diameter and noise are learned.
    shell : bool
        The surface of the spheres is fluorescent; otherwise it is tried where balls do not fit, and
        where it is likelier the result is that of this comparison alone, without tail, spread or
        asymmetry.
    camera_pattern : bool
        The pixels of the camera differ, so that their gains are compared.

    Returns
    -------
    LearnedOptics

    Raises
    ------
    NoSpheresError
        Without samples, or where the search does not converge.

    Notes
    -----
    Gauss-Newton steps in the logarithms of the lengths, with every sphere's position and brightness
    and every background eliminated exactly (the Schur complement of the information). The noise is
    that of the differences between neighbouring voxels.

    The point spread is a Gaussian. Where the derivative of the likelihood by the share of a wider
    second Gaussian is significant, the sum of two Gaussians is fitted to every other group, and it
    is used if the likelihood of the groups between them is the larger one. Where it is not, or much
    of the light is in the wider Gaussian, the point spread of an aperture with a pinhole (`Pupil`)
    is tried in the same way. Where the diameters of single spheres, fitted with a wide
    distribution, differ by more than their errors, their spread
    is learned too: that of greatest likelihood, and the mean diameter is the mean of the spheres.
    A point spread that is no body of revolution, or differs above and below the focus, changes the
    image by derivatives of it (`Asymmetry`), whose factors are found where they are significant;
    so are changes with the height of a sphere in the stack (`DepthChange`).
    Crowds have one even Gaussian and one diameter. Samples are left out first, because dust among
    them would appear as a tail or as a spread, and all are judged again by the image that is found.
    """
    psf = np.array([max(voxel[0], 0.15 * diameter), max(voxel[1] / 2, 0.06 * diameter)])
    start = ImageParameters(np.log([diameter, 1.0, 1.0]), voxel)
    start.values[1:] = np.log(np.hypot(psf, start.voxel_blur))
    if measured is not None:
        start = ImageParameters(np.log([diameter]), voxel, measured=measured)
    start = start.within_bounds()
    usable = _with_enough_voxels(samples, start.image())
    if not usable:
        raise NoSpheresError(
            "no spheres to learn the optics from: none was found, or none has voxels to itself; "
            "check diameter, contact and minmass, and whether spheres are dark (dark=True), state "
            "the optics (optics=), or keep the positions found first (refine=None)"
        )
    mean = float(np.mean([np.nanmean(s.frame) for s in usable]))
    noise = CameraNoise(1.0, 0.05 * abs(mean))
    plain = _ball_or_shell(usable, replace(start, shell=shell), noise)
    if plain.parameters.shell and not shell:
        # Spheres whose surface is fluorescent are searched for in another way first.
        optics = plain.parameters.optics(plain.noise, plain.information)
        return LearnedOptics(optics, _usual_of(plain))
    plain = _with_common_noise(plain, camera_pattern=camera_pattern)
    plain, left_out = _without_dust(plain)
    found = plain
    if not any(isinstance(s, CrowdSample) for s in found.samples):
        found = _with_spread(found)
    if measured is None:
        # The first step of the share of a tail, and its error.
        variance = np.linalg.pinv(found.information, hermitian=True)
        if variance[-1] @ found.score > _LEAST_SHARE_ERRORS * np.sqrt(variance[-1, -1]):
            found = _with_pupil(_with_tail(found))
    if found is not plain and left_out:
        # All samples are judged again by the image that was found.
        variations = ImageVariations.about(found.parameters)
        usable = _with_enough_voxels(usable, variations.image)
        fits = [s.fit(variations, found.noise) for s in usable]
        kept = _spheres_among(usable, fits, noise=found.noise, usual=_usual_of(found))
        left_out = len(usable) - len(kept)
        if len(kept) >= _FEWEST_SAMPLES:
            found = _settled(kept, found.parameters, found.noise)
    elif found is not plain:
        found, left_out = _without_dust(found)
    found = _with_moments(found.with_neighbours())
    optics = found.parameters.optics(found.noise, found.information)
    return LearnedOptics(optics, replace(_usual_of(found), left_out=left_out))


def _ball_or_shell(
    samples: list[GroupSample | CrowdSample], start: ImageParameters, noise: CameraNoise
) -> _Settled:
    """Return the parameters of balls, or of shells if the samples are likelier with them.

    Shells are tried where the search for balls does not converge, or leaves large residuals; the
    start may be that of shells already.
    """
    if start.shell:
        return _settled(samples, start, noise)
    ball: _Settled | None = None
    try:
        ball = _settled(samples, start, noise)
        chi2 = np.median([fit.chi2(ball.noise) for fit in ball.fits])
        if chi2 < _SHELL_MISFIT or not all(isinstance(s, GroupSample) for s in samples):
            return ball
        shell = _settled(ball.samples, replace(start, shell=True), noise)
    except NoSpheresError:
        if ball is not None:
            return ball
        return _settled(samples, replace(start, shell=True), noise)
    images = [one.parameters.image() for one in (ball, shell)]
    within = max(images, key=lambda image: float(image.extent.max()))
    gain = 0.0
    for one, image, sign in zip((ball, shell), images, (-1, 1), strict=True):
        for s in one.samples:
            if isinstance(s, GroupSample):
                gain += sign * s.log_likelihood(image, shell.noise, within=within)
    return shell if gain > _LEAST_HELD_OUT_GAIN else ball


def _with_enough_voxels(
    samples: Sequence[GroupSample | CrowdSample], image: SphereImage
) -> list[GroupSample | CrowdSample]:
    """Return the samples that have enough voxels to fit their spheres with an image."""
    return [
        s
        for s in samples
        if isinstance(s, CrowdSample) or s.window(image).has_enough_voxels(len(s.centers))
    ]


def _usual_of(found: _Settled) -> UsualImage:
    """Return what most spheres of the samples have in common."""
    chi2 = [fit.chi2(found.noise) for fit in found.fits]
    return UsualImage.of(chi2, [fit.brightness for fit in found.fits])


def _spheres_among(
    samples: Sequence[GroupSample | CrowdSample],
    fits: Sequence[SampleFit],
    *,
    noise: CameraNoise,
    usual: UsualImage,
) -> list[GroupSample | CrowdSample]:
    """Return the samples whose images are those of spheres."""
    return [
        s
        for s, fit in zip(samples, fits, strict=True)
        if usual.excess(
            np.full(len(fit.brightness), fit.chi2(noise)),
            fit.brightness / usual.brightness,
            voxels=np.full(len(fit.brightness), len(fit.expected) / len(fit.brightness)),
        ).max(initial=0.0)
        <= 1
    ]


def _without_dust(found: _Settled) -> tuple[_Settled, int]:
    """Return the parameters without samples that are no spheres, and the number of these."""
    left_out = 0
    for _ in range(_MAX_SEARCHES - 1):
        kept = _spheres_among(found.samples, found.fits, noise=found.noise, usual=_usual_of(found))
        if len(kept) == len(found.samples) or len(kept) < _FEWEST_SAMPLES:
            break
        left_out += len(found.samples) - len(kept)
        found = _settled(kept, found.parameters, found.noise)
    return found, left_out


def _settled(
    samples: list[GroupSample | CrowdSample],
    parameters: ImageParameters,
    noise: CameraNoise,
    *,
    rounds: int = _MAX_LEARNING_ROUNDS,
    tolerance: float = _STEP_IN_ERRORS,
) -> _Settled:
    """Return the parameters of greatest likelihood, from a start; steps in standard errors."""
    n = len(parameters.values)
    for number in range(rounds):
        variations = ImageVariations.about(parameters)
        fits = [s.fit(variations, noise) for s in samples]
        samples = [s._replace(centers=fit.centers) for s, fit in zip(samples, fits, strict=True)]
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
            return _Settled(parameters, noise, samples, fits, information, score)
    found = parameters.ball(parameters.values)
    psf_z, psf = found.components[0][1]
    raise NoSpheresError(
        f"sphere size and point spread do not converge: diameter {found.diameter:.3g}, blur "
        f"({psf_z:.3g}, {psf:.3g}) um after {rounds} rounds "
        f"on {len(samples)} groups: are these spheres, bright enough, or dark (dark=True), and "
        "is the voxel size right? State the optics (optics=), or keep the positions found "
        "first (refine=None)"
    )


def _with_common_noise(plain: _Settled, *, camera_pattern: bool) -> _Settled:
    """Return the parameters with noise that voxels have in common, if the residuals show any.

    That is the gain of pixels where a camera has a pattern, and flicker of the light otherwise.
    """
    if not all(isinstance(s, GroupSample) for s in plain.samples):
        return plain
    # Differences along a line are free from what its voxels have in common.
    axis, lines_of = (0, Lines.of_pixels) if camera_pattern else (2, Lines.of_scan)
    along = [_variance_along(axis, fit.mask, fit.residual, fit.expected) for fit in plain.fits]
    noise = photon_transfer(*(np.concatenate(part) for part in zip(*along, strict=True)))
    if noise.gain <= 0:
        return plain
    windows = []
    for fit in plain.fits:
        light, weight = noise.light(fit.expected), noise.weight(fit.expected)
        windows.append(LineChanges.of(lines_of(fit.mask), fit.residual, light, weight))
    if camera_pattern:
        noise = noise._replace(pixel=find_gain_spread(windows))
    else:
        plane, line = find_flicker(windows)
        noise = noise._replace(plane=plane, line=line)
    return _settled(plain.samples, plain.parameters, noise) if noise.correlated else plain


def _with_spread(equal: _Settled) -> _Settled:
    """Return the parameters with a spread of the diameters if their likelihood shows one."""
    trial = replace(equal.parameters, spread=_FIRST_SPREAD)
    variations = ImageVariations.about(trial)
    fits = [s.fit(variations, equal.noise) for s in equal.samples]
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
        return equal
    try:
        start = replace(equal.parameters, spread=float(spreads[best]))
        return _settled(equal.samples, start, equal.noise)
    except NoSpheresError:
        # Equal diameters have settled, and different ones have not: the first are used.
        return equal


def _with_tail(plain: _Settled) -> _Settled:
    """Return the parameters with a tail if groups that were not fitted are more likely with it."""
    groups = [s for s in plain.samples if isinstance(s, GroupSample)]
    if len(groups) < max(2, len(plain.samples)):
        return plain
    start = plain.parameters.with_tail()
    widest = start.image()
    groups = [s for s in groups if s.window(widest).has_enough_voxels(len(s.centers))]
    if len(groups) < 2:
        return plain
    try:
        half = _settled(
            list(groups[::2]),
            start,
            plain.noise,
            rounds=_MAX_TRIAL_ROUNDS,
            tolerance=_TRIAL_STEP_IN_ERRORS,
        )
        tailed, image = half.parameters.image(), plain.parameters.image()
        gain = sum(
            s.log_likelihood(tailed, half.noise, within=tailed)
            - s.log_likelihood(image, half.noise, within=tailed)
            for s in groups[1::2]
        )
        if gain < _LEAST_HELD_OUT_GAIN:
            return plain
        return _settled(list(groups), half.parameters, half.noise)
    except NoSpheresError:
        # The Gaussian has settled, and the sum of two Gaussians has not: the first one is used.
        return plain


def _with_pupil(found: _Settled) -> _Settled:
    """Return the parameters of a confocal point spread if groups not fitted are likelier with it.

    It is tried where the sum of two Gaussians is not used, or much of the light is in the wider
    one, as behind an open pinhole. `found` has Gaussians, and is fitted to all groups; the other to
    half of them.
    """
    tail = found.parameters.image().tail
    if tail is not None and tail.share < _OPEN_SHARE:
        return found
    groups = [s for s in found.samples if isinstance(s, GroupSample)]
    if len(groups) < max(2, len(found.samples)):
        return found
    starts = [found.parameters.with_pupil(pinhole) for pinhole in _PINHOLES_TRIED]
    before = found.parameters.image()

    def likelihood(parameters: ImageParameters, noise: CameraNoise, part: Sequence[int]) -> float:
        image = parameters.image()
        return sum(groups[k].log_likelihood(image, noise, within=before) for k in part)

    fitted, others = range(0, len(groups), 2), range(1, len(groups), 2)
    try:
        start = max(starts, key=lambda one: likelihood(one, found.noise, fitted))
        half = _settled(
            list(groups[::2]),
            start,
            found.noise,
            rounds=_MAX_PUPIL_ROUNDS,
            tolerance=_TRIAL_STEP_IN_ERRORS,
        )
        gain = likelihood(half.parameters, half.noise, others)
        if gain - likelihood(found.parameters, half.noise, others) < _LEAST_HELD_OUT_GAIN:
            return found
        return _settled(list(groups), half.parameters, half.noise)
    except NoSpheresError:
        # The Gaussians have settled, and this point spread has not: they are used.
        return found


def _with_moments(even: _Settled) -> _Settled:
    """Return the parameters with moments of the point spread that the residuals show.

    These are an asymmetric point spread, and moments that change with the height of a sphere. They
    multiply derivatives of the image, so that they are the solution of linear equations together
    with the other parameters; few rounds are enough. Those are kept that differ from 0 by more than
    the noise and by more than the scatter between the samples, in which spheres that move during a
    scan, say, have images that are asymmetric in one way or another.
    """
    of_groups = all(isinstance(s, GroupSample) for s in even.samples)
    if not of_groups or even.noise.neighbours:
        return even
    found = _MomentFit.of(even).with_asymmetry()
    if found.used.any():
        found = found.settled()
    deeper = found.with_depth()
    if deeper is not found:
        found = (deeper.refitted() if found.used.any() else deeper).settled()
    return found.now if found.used.any() else even


class _MomentFit(NamedTuple):
    """Fits of the samples with derivatives by the moments of the point spread.

    Attributes
    ----------
    now : _Settled
        Parameters and fits.
    used : ndarray of bool, shape (16,)
        Which components of `Asymmetry` and which slopes of `DepthChange` are fitted.
    values : ndarray, shape (16,)
        Their values.
    heights : DepthChange
        The middle and the range of the heights.
    """

    now: _Settled
    used: Bools
    values: Floats
    heights: DepthChange

    @classmethod
    def of(cls, even: _Settled) -> _MomentFit:
        """Return the fits without any of the moments."""
        z = np.concatenate([s.centers[:, 0] for s in even.samples])
        heights = DepthChange(float(z.mean()), float(z.min()), float(z.max()))
        none = np.zeros(_N_MOMENTS, dtype=np.bool_)
        return cls(even, none, np.zeros(_N_MOMENTS), heights).refitted()

    def refitted(self) -> _MomentFit:
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

    def with_asymmetry(self) -> _MomentFit:
        """Return the fits with the components of an asymmetry that are significant."""
        tested = ~_OF_DEPTH
        information, scores = self.equations(tested)
        covariance = np.linalg.pinv(information.sum(axis=0), hermitian=True)
        shown = significant_sums(scores @ covariance, np.diag(covariance))
        used = self.used.copy()
        used[tested] = shown[-np.count_nonzero(tested) :]
        return self._replace(used=used)

    def with_depth(self) -> _MomentFit:
        """Return the fits with the slopes against the height, if that of a width is significant.

        Both widths change then, and with a point spread that differs above and below the focus its
        third moments too. Light of other spheres that is spread over the field changes third
        moments alone.
        """
        shown = significant_slopes(*self.equations(self.used | _OF_DEPTH))
        if not shown[-_N_SLOPES:][:2].any():
            return self
        uneven = self.used[_ABOVE_FOCUS].any()
        used = self.used.copy()
        used[_OF_DEPTH] = [True, True, uneven, uneven]
        return self._replace(used=used)

    def settled(self) -> _MomentFit:
        """Return the fits with the moments in use of greatest likelihood."""
        found = self
        for number in range(_MOMENT_ROUNDS):
            if number:
                found = found.refitted()
            information, scores = found.equations(found.used)
            information = information.sum(axis=0)
            step = np.linalg.pinv(information, hermitian=True) @ scores.sum(axis=0)
            found = found.moved(information, step)
            if step @ information @ step < _STEP_IN_ERRORS**2:
                break
        return found

    def moved(self, information: Floats, step: Floats) -> _MomentFit:
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
        now = self.now._replace(parameters=parameters, information=own)
        return self._replace(now=now, values=values)


def photon_transfer(expected: Floats, variance: Floats) -> CameraNoise:
    """Return gain and floor of the camera from the growth of the variance with the mean.

    Parameters
    ----------
    expected : ndarray, shape (m,)
        Expected grey levels.
    variance : ndarray, shape (m,)
        Estimates of their variance.

    Returns
    -------
    CameraNoise
        A negative gain (of a processed image) is replaced by 0 and a constant variance.

    Examples
    --------
    >>> noise = photon_transfer(np.array([10.0, 20.0, 30.0]), np.array([34.0, 64.0, 94.0]))
    >>> round(noise.gain, 6), round(noise.floor, 6)
    (3.0, 4.0)
    """
    design = np.stack([expected, np.ones_like(expected)])
    noise = CameraNoise(0.0, float(variance.mean()))
    for _ in range(4):
        weighted = design * noise.weight(expected) ** 2
        gain, floor = np.linalg.solve(weighted @ design.T, weighted @ variance)
        if gain <= 0:
            return CameraNoise(0.0, float(variance.mean()))
        noise = CameraNoise(float(gain), float(floor))
    return noise
