"""The parameters of a sphere's image in the search for the optics, and derivatives by them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.images.optics.ball_image import BallBlur, PsfTail, SphereImage, sphere_image
from perrin.images.optics.optics import Optics
from perrin.images.optics.point_spread import voxel_variances
from perrin.images.optics.pupil import AIRY, MOST_DIAMETER, Pupil, PupilBall

if TYPE_CHECKING:
    from perrin._arrays import Floats
    from perrin.images.optics.asymmetry import Asymmetry
    from perrin.images.optics.depth import DepthChange
    from perrin.images.optics.optics import CameraNoise
    from perrin.images.optics.point_spread import PointSpread

# Change of a parameter for the central differences.
_PARAMETER_DIFFERENCE = 0.01

# Largest step of a parameter.
_MAX_STEP = 0.25

# Least ratios of the blur along z to that in the plane (both are varied), of the blur to that of
# the voxel alone, and of the tail's blur to that of the narrower Gaussian.
_LEAST_ELONGATION, _LEAST_OVER_VOXEL, _LEAST_TAIL = 1.025, 1.02, 1.2

# Blurs and share of the tail at the start of its search, over the Gaussian point spread found.
_NARROWED, _WIDENED, _TAIL_SHARE, _MAX_TAIL_SHARE = 0.85, 3.0, 0.15, 0.6

# `Pupil.lateral` and `Pupil.slope` at the start of the search for a confocal point spread, and the
# least and the largest values of the three: apertures of 0.3 to 1.5 and visible light, or, where
# voxels are points, a narrower point spread.
_PUPIL_START = 13.0, 0.55
_PUPIL_LEAST, _PUPIL_MOST = np.log([2.5, 0.1, 0.02]), np.log([40.0, 0.75, 4.0])


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
        return np.sqrt(voxel_variances(self.voxel))

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
            size = float(np.exp(values[0]))
            return BallBlur.of_point_spread(
                size, self.measured.components, voxel=self.voxel, shell=self.shell
            )
        diameter, blur_z, blur = np.exp(values[:3]).tolist()
        if len(values) == 3:
            return BallBlur(diameter, ((1.0, (blur_z, blur)),), self.shell)
        share, (tail_z, tail) = float(values[3]), np.exp(values[4:]).tolist()
        both = ((1.0 - share, (blur_z, blur)), (share, (tail_z, tail)))
        return BallBlur(diameter, both, self.shell)

    def image(self) -> SphereImage:
        """Return the sphere's image."""
        ball, tail, pupil = self.ball(self.values), None, None
        if self.measured is not None:
            psf = self.measured.components[0][1]
        elif isinstance(ball, PupilBall):
            psf, pupil = ball.pupil.psf, ball.pupil
        else:
            (psf_z, plane), *wider = (
                np.sqrt(np.square(blur) - self.voxel_blur**2).tolist()
                for _, blur in ball.components
            )
            psf = psf_z, plane
            if wider:
                tail = PsfTail(ball.components[1][0], (wider[0][0], wider[0][1]))
        return sphere_image(
            diameter=ball.diameter,
            psf=psf,
            voxel=self.voxel,
            tail=tail,
            spread=self.spread,
            measured=self.measured,
            shell=self.shell,
            asymmetry=self.asymmetry,
            depth=self.depth,
            pupil=pupil,
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
        the tail is wider than the other Gaussian, and narrower than the sphere. Behind a pinhole
        they are those of apertures, and of spheres that the space of the point spread holds.
        """
        n = len(self.values)
        low, high = np.full(n, -np.inf), np.full(n, np.inf)
        if n == 1:
            return low, high
        if self.of_pupil:
            low[1:], high[1:] = _PUPIL_LEAST, _PUPIL_MOST
            high[0] = np.log(MOST_DIAMETER)
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
        """Return the optics, with standard errors from the information on the parameters.

        Parameters
        ----------
        noise : CameraNoise
        information : ndarray, shape (k, k)
            Information on the parameters, which are the first of k.
        """
        image, ball = self.image(), self.ball(self.values)
        covariance = np.linalg.pinv(information, hermitian=True)
        error, pupil = np.sqrt(np.diag(covariance)), None
        if isinstance(ball, PupilBall):
            # The width in the plane is as 1 / lateral, that along z as 1 / (lateral slope).
            along = float(np.sqrt(max(covariance[1:3, 1:3].sum(), 0.0)))
            relative, pupil = np.array([along, error[1]]), ball.pupil
        elif self.measured is not None:
            relative = np.zeros(2)
        else:
            # The blur is the root of the sum of squares of point spread and voxel.
            relative = error[1:3] * np.square(image.blur) / np.square(image.psf)
        psf_z, psf = (relative * image.psf).tolist()
        return Optics(
            diameter=image.diameter,
            psf=image.psf,
            noise=noise,
            stderr=(float(image.diameter * error[0]), psf_z, psf),
            tail=image.tail,
            spread=self.spread,
            measured=self.measured,
            shell=self.shell,
            asymmetry=self.asymmetry,
            depth=self.depth,
            pupil=pupil,
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
