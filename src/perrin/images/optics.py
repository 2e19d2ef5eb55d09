"""What microscope and camera make of a sphere: its size in the light, point spread and noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.images.image_fit import CameraNoise, FreeCenters, cut_window, fit_window
from perrin.images.sphere_image import SphereImage, sphere_image

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from perrin._arrays import Floats
    from perrin.images.image_fit import ImageFit, Window

_PROBE = 0.01  # change of a logarithm for a central difference
_LONGEST = 0.25  # longest step of a logarithm
_CONVERGED = 1e-3
_ROUNDS = 15


@dataclass(frozen=True)
class Optics:
    """How a sphere is seen.

    Attributes
    ----------
    diameter : float
        Of the ball that is seen, um.
    psf : tuple of float
        Standard deviations of the Gaussian point spread, (z, plane), um.
    noise : CameraNoise
        ``(gain, floor)``: a voxel's variance is gain times its expected value plus floor, in
        squared grey levels; the floor takes in read noise and the camera's offset.
    stderr : tuple of float
        Standard errors of diameter, psf z and psf plane, um; 0 where stated by the user.
    """

    diameter: float
    psf: tuple[float, float]
    noise: CameraNoise
    stderr: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Optics:
        """Read back what `dataclasses.asdict` made."""
        (psf_z, psf), (a, b, c) = entry["psf"], entry["stderr"]
        return cls(entry["diameter"], (psf_z, psf), CameraNoise(*entry["noise"]), (a, b, c))

    def image(self, voxel: tuple[float, float, float]) -> SphereImage:
        """Return the table of the sphere's image for voxels (z, y, x), um."""
        return sphere_image(diameter=self.diameter, psf=self.psf, voxel=voxel)


class Sample(NamedTuple):
    """One group of spheres in one frame, to learn from."""

    frame: Floats
    centers: Floats
    others: Floats


def fit_samples(
    samples: Sequence[Sample], *, diameter: float, voxel: tuple[float, float, float]
) -> Optics:
    """Find sphere diameter, point spread and noise of greatest likelihood for all samples.

    Parameters
    ----------
    samples : sequence of Sample
    diameter : float
        Where the search starts, um; the answer is the diameter seen.
    voxel : tuple of float
        (z, y, x), um.

    Raises
    ------
    ValueError
        Without samples, or where the search does not settle.

    Notes
    -----
    Gauss-Newton steps in the logarithms of the three lengths, with every sphere's place and
    brightness and every background eliminated exactly (the Schur complement of the information).
    """
    log = np.log([diameter, max(voxel[0], 0.15 * diameter), max(voxel[1] / 2, 0.06 * diameter)])
    samples = [
        s for s in samples if _window(s, s.centers, _image(log, voxel)).shows(len(s.centers))
    ]
    if not samples:
        raise ValueError(
            "no spheres to learn the optics from: none was found, or all stand in a crowd; check "
            "diameter, contact and minmass, state optics, or take the places as found (refine=None)"
        )
    mean = float(np.mean([s.frame.mean() for s in samples]))
    noise = CameraNoise(1.0, 0.05 * abs(mean))
    centers = [s.centers for s in samples]
    for _ in range(_ROUNDS):
        image = _image(log, voxel)
        fits = [_fitted(s, c, image, noise) for s, c in zip(samples, centers, strict=True)]
        centers = [fit.centers for _, fit in fits]
        probes = _probes(log, voxel)
        information, score = (
            np.sum(part, axis=0)
            for part in zip(*(_told(window, fit, probes) for window, fit in fits), strict=True)
        )
        step = np.linalg.solve(information, score)
        noise = _noise(fits)
        log = log + step * min(1.0, _LONGEST / np.abs(step).max())
        # A point spread flatter than round is no microscope's: such a step ends at round.
        log[1] = max(log[1], log[2] + 1e-3)
        if np.abs(step).max() < _CONVERGED:
            break
    else:
        raise ValueError(
            f"sphere size and point spread do not settle: diameter {np.exp(log[0]):.3g}, psf "
            f"({np.exp(log[1]):.3g}, {np.exp(log[2]):.3g}) um after {_ROUNDS} rounds on "
            f"{len(samples)} groups; state optics=Optics(diameter, psf, noise)"
        )
    size, psf_z, psf = (float(v) for v in np.exp(log))
    error = np.exp(log) * np.sqrt(np.diag(np.linalg.inv(information)))
    return Optics(size, (psf_z, psf), noise, (float(error[0]), float(error[1]), float(error[2])))


def _image(log: Floats, voxel: tuple[float, float, float]) -> SphereImage:
    size, psf_z, psf = np.exp(log)
    return sphere_image(diameter=float(size), psf=(float(psf_z), float(psf)), voxel=voxel)


def _fitted(
    sample: Sample, centers: Floats, image: SphereImage, noise: CameraNoise
) -> tuple[Window, ImageFit]:
    window = _window(sample, centers, image)
    return window, fit_window(window, image, noise, FreeCenters(centers))


def _window(sample: Sample, centers: Floats, image: SphereImage) -> Window:
    return cut_window(sample.frame, image, centers, others=sample.others)


def _probes(log: Floats, voxel: tuple[float, float, float]) -> list[tuple[SphereImage, ...]]:
    """Return the images of spheres with each logarithm a little larger, and a little smaller."""
    shifts = _PROBE * np.eye(3)
    return [(_image(log + shift, voxel), _image(log - shift, voxel)) for shift in shifts]


def _told(
    window: Window, fit: ImageFit, probes: list[tuple[SphereImage, ...]]
) -> tuple[Floats, Floats]:
    """Return one fit's information (3, 3) on the logarithms, and its score."""
    seen = [[fit.brightness @ window.spots(p, fit.centers)[0] for p in pair] for pair in probes]
    slope = np.stack([(up - down) / (2 * _PROBE) for up, down in seen])
    weighted = slope * fit.weight
    nuisance = fit.jacobian * fit.weight
    shared = nuisance @ slope.T
    taken = np.linalg.lstsq(nuisance @ fit.jacobian.T, shared, rcond=None)[0]
    residual = window.data - fit.expected
    return weighted @ slope.T - shared.T @ taken, weighted @ residual - taken.T @ (
        nuisance @ residual
    )


def _noise(fits: Sequence[tuple[Window, ImageFit]]) -> CameraNoise:
    """Return gain and floor from how squared residuals grow with the expected light.

    A gain below nothing (a processed image) is nothing, and so is a floor that would make the
    variance of the darkest voxels negative.
    """
    light = np.concatenate([fit.expected for _, fit in fits])
    square = np.concatenate([(window.data - fit.expected) ** 2 for window, fit in fits])
    design = np.stack([light, np.ones_like(light)])
    noise = CameraNoise(0.0, float(square.mean()))
    for _ in range(4):
        weighted = design * noise.weight(light) ** 2
        gain, floor = np.linalg.solve(weighted @ design.T, weighted @ square)
        if gain <= 0:
            return CameraNoise(0.0, float(square.mean()))
        noise = CameraNoise(float(gain), float(floor))
    return noise
