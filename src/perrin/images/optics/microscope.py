"""Options of a simulated microscope: intensity of the spheres, scan of the planes, and camera."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perrin._arrays import (
    Floats,
    PlainOptions,
    choice_fault,
    flag_fault,
    number_fault,
    numpy_to_python,
    refuse,
)
from perrin.images.optics.optics import CameraNoise

_Dtype = Literal["uint8", "uint16", "float32", "float64"]


class RenderSettings(TypedDict, total=False):
    """Single keywords of `render_stack` that are fields of `Light`, `Scan` and `Camera`."""

    photons: float
    spread: float
    background: float
    gradient: ArrayLike
    bleaching: float
    depth_loss: float
    drop: float
    plane_time: float
    exposure: float
    substeps: int
    gain: float
    offset: float
    read_noise: float
    noise: bool
    dtype: _Dtype


@dataclass(frozen=True, kw_only=True)
class Light(PlainOptions):
    """Intensity of the spheres and of the background of a rendered movie.

    Parameters
    ----------
    photons : float
        Photons in the central voxel of a sphere, before all losses.
    spread : float
        Relative standard deviation of the brightness among spheres; log-normal.
    background : float
        Photons per voxel of the background, in the middle of the frame.
    gradient : array_like, shape (3,)
        Change of the background along (z, y, x), photons per voxel per um.
    bleaching : float
        Fraction of the spheres' intensity lost from the first frame to the last, exponential in
        time.
    depth_loss : float
        Fraction of the spheres' intensity lost from the first plane to the last, exponential in
        depth.
    drop : float
        Probability that a sphere is dark in a frame.

    Raises
    ------
    ValueError
        If a value is out of its range; all faults in one message.

    Examples
    --------
    >>> Light(photons=100.0, bleaching=0.3).bleaching
    0.3
    """

    photons: float = 40.0
    spread: float = 0.0
    background: float = 2.0
    gradient: ArrayLike = (0.0, 0.0, 0.0)
    bleaching: float = 0.0
    depth_loss: float = 0.0
    drop: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        faults = []
        for name in ("photons", "spread", "background"):
            faults += number_fault(name, getattr(self, name), least=0)
        for name in ("bleaching", "depth_loss", "drop"):
            faults += number_fault(name, getattr(self, name), least=0, below=1)
        try:
            slope = np.array(self.gradient, dtype=np.float64)
        except (TypeError, ValueError):
            slope = np.array(np.nan)
        if slope.shape != (3,) or not np.all(np.isfinite(slope)):
            faults.append(
                "gradient: expected three finite numbers (z, y, x), photons per voxel per um, got "
                f"{self.gradient!r}"
            )
        refuse(faults)
        object.__setattr__(self, "gradient", tuple(slope.tolist()))
        numpy_to_python(self)

    def background_photons(self, shape: tuple[int, int, int], voxel: Floats) -> Floats:
        """Return the expected photons of the background in every voxel.

        Parameters
        ----------
        shape : tuple of int
            Voxels (z, y, x).
        voxel : ndarray, shape (3,)
            Voxel size (z, y, x), um.

        Returns
        -------
        ndarray, shape (z, y, x)

        Raises
        ------
        ValueError
            If the gradient makes the background negative anywhere.
        """
        z, y, x = (
            (np.arange(n) - (n - 1) / 2) * size * rise
            for n, size, rise in zip(shape, voxel, np.asarray(self.gradient), strict=True)
        )
        photons: Floats = self.background + z[:, None, None] + y[:, None] + x
        if photons.min() < 0:
            raise ValueError(
                f"the gradient takes the background down to {photons.min():.3g} photons"
            )
        return photons

    def brightness(self, n: int, *, peak: float, rng: np.random.Generator) -> Floats:
        """Return the factor by which the unit image of each sphere is multiplied.

        Parameters
        ----------
        n : int
            Number of spheres.
        peak : float
            Value of the unit image at the centre of the sphere.
        rng : numpy.random.Generator
            Source of the log-normal spread.

        Returns
        -------
        ndarray, shape (n,)
        """
        width = np.sqrt(np.log1p(self.spread**2))
        factor: Floats = self.photons / peak * np.exp(rng.normal(-(width**2) / 2, width, n))
        return factor

    def remaining(self, age: float, n_planes: int) -> Floats:
        """Return the fraction of the spheres' intensity that bleaching and depth leave.

        Parameters
        ----------
        age : float
            Time of the frame, from 0 for the first frame to 1 for the last.
        n_planes : int
            Number of planes.

        Returns
        -------
        ndarray, shape (n_planes, 1, 1)
        """
        depth = np.linspace(0.0, 1.0, n_planes)[:, None, None]
        fraction: Floats = (1 - self.bleaching) ** age * (1 - self.depth_loss) ** depth
        return fraction


@dataclass(frozen=True, kw_only=True)
class Scan(PlainOptions):
    """Times at which the planes of a rendered frame are recorded.

    Parameters
    ----------
    plane_time : float
        Time from the start of one plane to the start of the next, s; 0 records all planes at once.
    exposure : float
        Exposure time of each plane, s, from its start.
    substeps : int
        Number of moments over which the motion during an exposure is averaged.

    Raises
    ------
    ValueError
        If a value is out of its range; all faults in one message.

    Examples
    --------
    >>> Scan(plane_time=0.5, exposure=0.25).duration(11)
    5.25
    """

    plane_time: float = 0.0
    exposure: float = 0.0
    substeps: int = 8

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        refuse(
            number_fault("plane_time", self.plane_time, least=0, unit="s")
            + number_fault("exposure", self.exposure, least=0, unit="s")
            + number_fault("substeps", self.substeps, above=0, whole=True)
        )
        numpy_to_python(self)

    def duration(self, n_planes: int) -> float:
        """Return the time that a frame takes, from the start of its first plane, s."""
        return self.plane_time * (n_planes - 1) + self.exposure

    def moments(self) -> Floats:
        """Return the times within an exposure at which the spheres are drawn, s."""
        count = self.substeps if self.exposure > 0 else 1
        moments: Floats = (np.arange(count) + 0.5) / count * self.exposure
        return moments

    def frame_starts(self, time: Floats, times: ArrayLike | None, n_planes: int) -> Floats:
        """Return the times at which the frames start, s.

        Parameters
        ----------
        time : ndarray, shape (T,)
            Times at which the positions are known, s.
        times : array_like, shape (t,), or None
            Times chosen by the user; None starts a frame at every known time from which a whole
            frame fits into the motion.
        n_planes : int
            Number of planes of a frame.

        Returns
        -------
        ndarray, shape (t,)

        Raises
        ------
        ValueError
            If a frame is not within the motion.
        """
        duration = self.duration(n_planes)
        end = time[-1] + 1e-9 * (time[-1] - time[0])
        if times is None:
            start: Floats = time[time + duration <= end].copy()
            if start.size == 0:
                raise ValueError(
                    f"a frame takes {duration:g} s, longer than the motion ({time[-1]:g} s)"
                )
            return start
        start = np.array(times, dtype=np.float64)
        if start.ndim != 1 or start.size == 0 or np.any(np.diff(start) <= 0):
            raise ValueError("times: expected growing numbers, shape (t,)")
        if not (start[0] >= time[0] and start[-1] + duration <= end):
            raise ValueError(
                f"times: frames of {duration:g} s from {start[0]:g} to {start[-1]:g} s are not "
                f"within the motion ({time[0]:g} to {time[-1]:g} s)"
            )
        return start


@dataclass(frozen=True, kw_only=True)
class Camera(PlainOptions):
    """Conversion of photons into grey levels.

    Parameters
    ----------
    gain : float
        Grey levels per photon.
    offset : float
        Grey level without photons.
    read_noise : float
        Standard deviation of the Gaussian read noise, grey levels.
    noise : bool
        False gives the expected grey levels, without photon noise and read noise.
    dtype : {"uint8", "uint16", "float32", "float64"}
        Type of the grey levels; those of an integer type are rounded, and cut at the ends of its
        range.

    Raises
    ------
    ValueError
        If a value is out of its range; all faults in one message.

    Examples
    --------
    >>> Camera(gain=3.0, offset=100.0, read_noise=2.0).variance_model()[:2]
    (3.0, -296.0)
    """

    gain: float = 1.0
    offset: float = 0.0
    read_noise: float = 0.0
    noise: bool = True
    dtype: _Dtype = "uint16"

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        dtype = self.dtype if isinstance(self.dtype, str) else np.dtype(self.dtype).name
        refuse(
            number_fault("gain", self.gain, above=0)
            + number_fault("offset", self.offset)
            + number_fault("read_noise", self.read_noise, least=0)
            + flag_fault("noise", self.noise)
            + choice_fault("dtype", dtype, ("uint8", "uint16", "float32", "float64"))
        )
        object.__setattr__(self, "dtype", dtype)
        numpy_to_python(self)

    def variance_model(self) -> CameraNoise:
        """Return the variance of a voxel as a function of its expected grey level.

        A photon number n has the variance n, so that the grey level g = gain n + offset has the
        variance gain (g - offset) + read_noise^2.

        Returns
        -------
        CameraNoise
        """
        return CameraNoise(self.gain, self.read_noise**2 - self.gain * self.offset)

    def grey_levels(self, photons: Floats, rng: np.random.Generator) -> NDArray[Any]:
        """Return the grey levels that the camera records.

        Parameters
        ----------
        photons : ndarray
            Expected photons.
        rng : numpy.random.Generator
            Source of photon noise and read noise.

        Returns
        -------
        ndarray of `dtype`, the shape of `photons`
        """
        dtype = np.dtype(self.dtype)
        counts = self.offset + self.gain * (rng.poisson(photons) if self.noise else photons)
        if self.noise and self.read_noise > 0:
            counts = counts + rng.normal(0.0, self.read_noise, photons.shape)
        if dtype.kind != "f":
            counts = np.clip(np.rint(counts), 0, np.iinfo(dtype).max)
        return np.asarray(counts, dtype=dtype)


# The single keywords of `render_stack`.
RENDER_KEYWORDS = tuple(field.name for kind in (Light, Scan, Camera) for field in fields(kind))
