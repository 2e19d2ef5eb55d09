"""What microscope and camera make of a sphere: its size in the light, point spread and noise."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.errors import NoSpheresError
from perrin.images.optics.ball_image import SphereImage, sphere_image
from perrin.images.optics.crowd_equations import told_apart, total
from perrin.images.optics.crowd_fit import fit_crowd
from perrin.images.optics.optics import CameraNoise, Optics
from perrin.images.optics.window_fit import FreeCenters, cut_window, fit_window

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from perrin._arrays import Floats
    from perrin.images.optics.window_fit import Window


_PROBE = 0.01  # change of a logarithm for a central difference


_LONGEST = 0.25  # longest step of a logarithm


_CONVERGED = 1e-3


_ROUNDS = 15


_LOOKS = 2  # at the light left over by a crowd, in every round


# Saturation: fewer voxels, or a smaller share, spoil no place.
_FEWEST_CLIPPED, _LEAST_CLIPPED = 10, 1e-5


_LEVELS = 3  # occupied grey levels below the highest, with which it is compared


_PILED_UP = 1e-6  # level of the test in one frame: movies have thousands


def saturated_share(data: NDArray[Any]) -> float:
    """Return the share of voxels whose light was clipped at the highest value; 0 where none was.

    Parameters
    ----------
    data : ndarray
        One frame, in the type in which it was recorded.

    Notes
    -----
    The largest value of a frame is always somebody's. It is the end of the range where it is the
    largest of an integer type, or where significantly more voxels have it than have any of the
    three occupied grey levels below it: without clipping, fewer voxels are brighter, level by
    level. The numbers of voxels at two levels are compared by the binomial test.

    Examples
    --------
    >>> import numpy as np
    >>> light = np.random.default_rng(1).poisson(200.0, size=100_000).astype(np.uint16)
    >>> saturated_share(light), round(saturated_share(np.minimum(light, 230)), 3)
    (0.0, 0.02)
    """
    from scipy.special import bdtrc

    top = data.max()
    count = int(np.count_nonzero(data == top))
    share = count / data.size
    if count < _FEWEST_CLIPPED or share <= _LEAST_CLIPPED:
        return 0.0
    if data.dtype.kind in "iu" and top == np.iinfo(data.dtype).max:
        return share
    numbers = np.unique(data, return_counts=True)[1]
    if len(numbers) == 1:
        return 0.0
    most = int(numbers[-1 - _LEVELS : -1].max())
    # One of the voxels is there by the choice of the level.
    return share if bdtrc(count - 2, count - 1 + most, 0.5) < _PILED_UP else 0.0


class Told(NamedTuple):
    """What one look at a sample tells."""

    centers: Floats
    information: Floats  # (3, 3), on the logarithms of diameter, psf z and psf plane
    score: Floats  # (3,)
    light: Floats  # expected, of every voxel that counts
    square: Floats  # and the squared residual there


class Sample(NamedTuple):
    """One group of spheres in one frame, to learn from."""

    frame: Floats
    centers: Floats
    others: Floats

    def shows(self, image: SphereImage) -> bool:
        """Return whether there are voxels enough."""
        return self._window(image).shows(len(self.centers))

    def look(self, lens: _Lens, noise: CameraNoise) -> Told:
        """Fit places and background, and tell what the rest says of the optics."""
        image = lens.image
        window = self._window(image)
        fit = fit_window(window, image, noise, FreeCenters(self.centers))
        slope = lens.slope(lambda shifted: fit.brightness @ window.spots(shifted, fit.centers)[0])
        weighted = slope * fit.weight
        nuisance = fit.jacobian * fit.weight
        shared = nuisance @ slope.T
        taken = np.linalg.lstsq(nuisance @ fit.jacobian.T, shared, rcond=None)[0]
        residual = window.data - fit.expected
        information = weighted @ slope.T - shared.T @ taken
        score = weighted @ residual - taken.T @ (nuisance @ residual)
        return Told(fit.centers, information, score, fit.expected, residual**2)

    def _window(self, image: SphereImage) -> Window:
        return cut_window(self.frame, image, self.centers, others=self.others)


class CrowdSample(NamedTuple):
    """A piece of a frame full of touching spheres, to learn from."""

    frame: Floats
    centers: Floats
    others: Floats
    contact: float

    def look(self, lens: _Lens, noise: CameraNoise) -> Told:
        """Fit places and background, and tell what the rest says of the optics."""
        found = fit_crowd(
            self.frame,
            self.centers,
            others=self.others,
            contact=self.contact,
            image=lens.image,
            noise=noise,
            looks=_LOOKS,
        )
        scene, light = found.scene, found.light
        slope = lens.slope(
            lambda shifted: total(scene, scene.spots(shifted, light.centers), light.brightness)
        )
        information, score = told_apart(scene, light, slope)
        count = scene.mask
        residual = (scene.data - light.expected)[count]
        return Told(light.centers, information, score, light.expected[count], residual**2)


class _Lens(NamedTuple):
    """The sphere's image where the search stands, and with each logarithm a little up and down."""

    image: SphereImage
    pairs: list[tuple[SphereImage, ...]]

    @classmethod
    def at(cls, log: Floats, voxel: tuple[float, float, float]) -> _Lens:
        """Return it for the logarithms of diameter, psf z and psf plane."""
        steps = _PROBE * np.eye(3)
        pairs = [tuple(_image(log + s * d, voxel) for s in (1, -1)) for d in steps]
        return cls(_image(log, voxel), pairs)

    def slope(self, light: Callable[[SphereImage], Floats]) -> Floats:
        """Return the central differences (3, ...) of some light by the logarithms."""
        return np.stack([(light(up) - light(down)) / (2 * _PROBE) for up, down in self.pairs])


def _image(log: Floats, voxel: tuple[float, float, float]) -> SphereImage:
    size, psf_z, psf = np.exp(log)
    return sphere_image(diameter=float(size), psf=(float(psf_z), float(psf)), voxel=voxel)


def fit_samples(
    samples: Sequence[Sample | CrowdSample], *, diameter: float, voxel: tuple[float, float, float]
) -> Optics:
    """Find sphere diameter, point spread and noise of greatest likelihood for all samples.

    Parameters
    ----------
    samples : sequence of Sample or CrowdSample
    diameter : float
        Where the search starts, um; the answer is the diameter seen.
    voxel : tuple of float
        (z, y, x), um.

    Raises
    ------
    NoSpheresError
        Without samples, or where the search does not settle.

    Notes
    -----
    Gauss-Newton steps in the logarithms of the three lengths, with every sphere's place and
    brightness and every background eliminated exactly (the Schur complement of the information).
    """
    log = np.log([diameter, max(voxel[0], 0.15 * diameter), max(voxel[1] / 2, 0.06 * diameter)])
    log[1] = max(log[1], _roundest(log[2], voxel))
    image = _image(log, voxel)
    samples = [s for s in samples if isinstance(s, CrowdSample) or s.shows(image)]
    if not samples:
        raise NoSpheresError(
            "no spheres to learn the optics from: none was found, or none has voxels to itself; "
            "check diameter, contact and minmass, and whether spheres are dark (dark=True), state "
            "the optics (optics=), or take the places as found (refine=None)"
        )
    mean = float(np.mean([s.frame.mean() for s in samples]))
    noise = CameraNoise(1.0, 0.05 * abs(mean))
    for _ in range(_ROUNDS):
        lens = _Lens.at(log, voxel)
        looks = [s.look(lens, noise) for s in samples]
        samples = [s._replace(centers=k.centers) for s, k in zip(samples, looks, strict=True)]
        information = np.sum([k.information for k in looks], axis=0)
        step = np.linalg.solve(information, np.sum([k.score for k in looks], axis=0))
        noise = _noise(looks)
        log = log + step * min(1.0, _LONGEST / np.abs(step).max())
        log[1] = max(log[1], _roundest(log[2], voxel))
        if np.abs(step).max() < _CONVERGED:
            break
    else:
        raise NoSpheresError(
            f"sphere size and point spread do not settle: diameter {np.exp(log[0]):.3g}, psf "
            f"({np.exp(log[1]):.3g}, {np.exp(log[2]):.3g}) um after {_ROUNDS} rounds on "
            f"{len(samples)} groups: are these spheres, bright enough, or dark (dark=True), and is "
            "the voxel size right? State the optics (optics=), or take the places as found "
            "(refine=None)"
        )
    size, psf_z, psf = (float(v) for v in np.exp(log))
    error = np.exp(log) * np.sqrt(np.diag(np.linalg.inv(information)))
    return Optics(size, (psf_z, psf), noise, (float(error[0]), float(error[1]), float(error[2])))


def _roundest(log_psf: float, voxel: tuple[float, float, float]) -> float:
    """Return the logarithm of the least point spread along z: flatter is no microscope's.

    With the widths of the voxels the blur along z stays the larger one, probes included.
    """
    plane = np.exp(2 * (log_psf + _PROBE)) + (voxel[1] * voxel[2] - voxel[0] ** 2) / 12
    narrowest = np.exp(2 * log_psf)
    return 0.5 * float(np.log(max(plane, narrowest))) + _PROBE + 1e-3


def _noise(looks: Sequence[Told]) -> CameraNoise:
    """Return gain and floor from how squared residuals grow with the expected light.

    A gain below nothing (a processed image) is nothing, and so is a floor that would make the
    variance of the darkest voxels negative.
    """
    light = np.concatenate([look.light for look in looks])
    square = np.concatenate([look.square for look in looks])
    design = np.stack([light, np.ones_like(light)])
    noise = CameraNoise(0.0, float(square.mean()))
    for _ in range(4):
        weighted = design * noise.weight(light) ** 2
        gain, floor = np.linalg.solve(weighted @ design.T, weighted @ square)
        if gain <= 0:
            return CameraNoise(0.0, float(square.mean()))
        noise = CameraNoise(float(gain), float(floor))
    return noise
