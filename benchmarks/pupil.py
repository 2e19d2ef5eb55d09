"""Point spreads of lenses with aberrations, from the wave in their pupil (scalar, numerical).

The field near the focus is the sum of the plane waves that leave the pupil, each with the phase of
its path: Zernike terms of the lens, and where the sample has another refractive index than the
immersion, the difference of the paths in the two media down to the depth of the light source.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Lens:
    """A lens, and the medium of the sample.

    Lengths are um; aberrations are root mean squares over the pupil, in waves.
    """

    aperture: float = 1.3
    index: float = 1.4
    medium: float = 1.4
    astigmatism: float = 0.0
    coma: float = 0.0

    def intensity(self, size, grid, z, *, wave, depth=0.0, scale=1.0):
        """Return the intensity (len(z), size, size) of a point at the middle of a grid of pixels.

        The stage moves the focus to the nominal depth `scale` (depth + z), in the index of the
        immersion; the point is at `depth` below the cover glass.
        """
        fine = 2 * size  # so that the pupil has enough samples
        k = np.fft.fftfreq(fine, grid) * wave
        ky, kx = np.meshgrid(k, k, indexing="ij")
        sine = np.hypot(ky, kx)
        # Where the medium is thinner than the aperture, the outer rays are reflected.
        seen = sine < min(self.aperture, 0.999 * self.medium)
        lens, sample = (
            np.sqrt(np.maximum(n**2 - sine[seen] ** 2, 0.0)) for n in (self.index, self.medium)
        )
        radius, angle = sine[seen] / self.aperture, np.arctan2(ky, kx)[seen]
        waves = self.astigmatism * np.sqrt(6) * radius**2 * np.cos(2 * angle)
        waves = waves + self.coma * np.sqrt(8) * (3 * radius**3 - 2 * radius) * np.cos(angle)
        cosine = lens / self.index
        out, middle = np.empty((len(z), size, size)), slice((fine - size) // 2, (fine + size) // 2)
        for j, own in enumerate(z):
            path = (sample * depth - lens * scale * (depth + own)) / wave
            pupil = np.zeros((fine, fine), dtype=complex)
            pupil[seen] = np.exp(2j * np.pi * (path + waves)) / np.sqrt(cosine)
            field = np.fft.fftshift(np.fft.fft2(pupil))[middle, middle]
            out[j] = np.abs(field) ** 2
        return out

    def focal_scale(self, depth, *, wave=0.5):
        """Return by how much farther the stage moves than the brightest place, at this depth."""
        trial = np.linspace(0.9, 1.25, 351) * self.index / self.medium
        k = np.linspace(1e-3, min(self.aperture, 0.999 * self.medium), 400)
        lens, sample = (np.sqrt(n**2 - k**2) for n in (self.index, self.medium))
        path = depth / wave * (sample - lens * trial[:, None])
        field = np.sum(np.exp(2j * np.pi * path) * k / np.sqrt(lens / self.index), axis=1)
        return float(trial[np.abs(field).argmax()])


def behind_pinhole(intensity, grid, radius):
    """Return the intensity (z, y, x) that a pinhole of this radius in the sample's plane collects.

    A radius below a pixel is a point.
    """
    if radius < grid:
        return intensity
    x = (np.arange(intensity.shape[-1]) - intensity.shape[-1] // 2) * grid
    hole = (np.hypot(x[:, None], x) <= radius).astype(float)
    turned = np.fft.fft2(np.fft.ifftshift(hole / hole.sum()))
    return np.fft.ifft2(np.fft.fft2(intensity) * turned).real
