"""Simulated confocal movies of spheres whose positions are known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perrin._arrays import (
    Floats,
    as_positions,
    frozen,
    number_fault,
    options_from,
    refuse_unknown,
    require_positive,
)
from perrin.geometry.rotations import exp_map, log_map
from perrin.images.optics.microscope import RENDER_KEYWORDS, Camera, Light, RenderSettings, Scan
from perrin.images.stack import Stack
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import TypeAlias

    Motions: TypeAlias = RigidMotion | Sequence[RigidMotion] | ArrayLike


# Range of a Gaussian in standard deviations: 3e-7 of its peak is left there.
_GAUSSIAN_RANGE = 5.0

# Largest ratio of diameter to point spread: the table of a ball takes 200 MB there.
_MAX_SHARPNESS = 280.0


def blurred_ball(offsets: tuple[Floats, Floats, Floats], *, radius: float, psf: Floats) -> Floats:
    """Return a solid ball convolved with an anisotropic Gaussian, on planes of voxels.

    A ball convolved with an isotropic Gaussian has a closed form in erf; the rest of the PSF is
    applied along each axis by the trapezoidal rule, whose error for Gaussians falls as
    exp(-2 pi^2 s^2 / h^2) with the step h. The error is below 1e-9 of the peak for balls larger
    than the PSF, and below 1e-6 for any ball.

    Parameters
    ----------
    offsets : tuple of ndarray, shapes (k,), (k, m) and (k, n)
        Distances of k planes from the centre of the ball along z, and in each plane those of its
        rows along y and of its columns along x, um.
    radius : float
        Radius of the ball, um.
    psf : ndarray, shape (3,)
        Standard deviations of the point spread function (z, y, x), um.

    Returns
    -------
    ndarray, shape (k, m, n)
        1 inside a ball far larger than the PSF.

    Examples
    --------
    >>> import numpy as np
    >>> z, line = np.array([0.0]), np.array([[0.0, 1.0, 2.0]])
    >>> image = blurred_ball((z, line, line), radius=1.0, psf=np.array([0.2, 0.1, 0.1]))
    >>> image[0, 0].round(3)
    array([1.   , 0.406, 0.   ])
    """
    from scipy.special import erf

    sigma = psf.min() / np.sqrt(2)
    step = psf.min() / 2
    nodes = np.arange(int(np.ceil((radius + _GAUSSIAN_RANGE * sigma) / step)) + 1) * step
    square = nodes**2
    r = np.sqrt(square[:, None, None] + square[:, None] + square)
    # The ball blurred isotropically by sigma, at distances r from its centre:
    # (erf((a + r)/s√2) + erf((a - r)/s√2))/2 - s/(r√2π) (exp(-(a - r)²/2s²) - exp(-(a + r)²/2s²)),
    # its last factor without the difference of nearly equal numbers at r = 0.
    root = np.sqrt(2) * sigma
    far = np.maximum(r, 1e-3 * sigma)
    edge = -np.exp(-(((radius - far) / root) ** 2)) * np.expm1(-2 * radius * far / sigma**2)
    inside = 0.5 * (erf((radius + r) / root) + erf((radius - r) / root))
    ball = inside - sigma / np.sqrt(2 * np.pi) * edge / far
    # The rest of the blur, axis by axis.
    axes = []
    for distance, blur in zip(offsets, np.sqrt(psf**2 - sigma**2), strict=True):
        scale = 1 / (blur * np.sqrt(2))
        to_node = np.exp(-(((distance[..., None] - nodes) * scale) ** 2))
        to_mirror = np.exp(-(((distance[..., None] + nodes) * scale) ** 2))
        weights: Floats = (to_node + to_mirror) * (nodes[1] * scale / np.sqrt(np.pi))
        weights[..., 0] /= 2
        axes.append(weights)
    z, y, x = axes
    planes = np.tensordot(z, ball, axes=1)
    image: Floats = y @ planes @ np.swapaxes(x, -1, -2)
    return image


@dataclass(frozen=True, eq=False)
class _BodyPaths:
    """Particles (T, n, 3) of rigid bodies at any times: straight centres, shortest turns."""

    motions: tuple[RigidMotion, ...]
    origins: Floats

    def __call__(self, times: Floats) -> Floats:
        bodies = []
        for motion, origin in zip(self.motions, self.origins, strict=True):
            i, part = _between(motion.time, times)
            j = np.minimum(i + 1, len(motion.time) - 1)
            turn = log_map(np.swapaxes(motion.rotation[i], -1, -2) @ motion.rotation[j])
            turn = _interpolated(np.zeros_like(turn), turn, part)
            rotation = motion.rotation[i] @ exp_map(turn)
            center = _interpolated(motion.center[i], motion.center[j], part)
            arms = np.einsum("tij,nj->tni", rotation, motion.template)
            bodies.append(np.asarray(arms + center[:, None]) + origin)
        return np.concatenate(bodies, axis=1)


@dataclass(frozen=True, eq=False)
class _PointPaths:
    """Particles (T, n, 3) that move straight between the times of their frames."""

    positions: Floats
    time: Floats

    def __call__(self, times: Floats) -> Floats:
        i, part = _between(self.time, times)
        here, there = self.positions[i], self.positions[np.minimum(i + 1, len(self.time) - 1)]
        return _interpolated(here, there, part)


def _between(time: Floats, at: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the frame before each moment, and the elapsed fraction of the interval after it."""
    if len(time) == 1:
        return np.zeros(len(at), dtype=np.int64), np.zeros(len(at))
    i = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    part = (at - time[i]) / (time[i + 1] - time[i])
    # Rounding of times must not mix in the next frame, whose particle may be missing.
    whole = np.abs(part - np.round(part)) < 1e-9
    part = np.where(whole, np.round(part), part)
    return np.where(part >= 1, i + 1, i), np.where(part >= 1, 0.0, np.maximum(part, 0.0))


def _interpolated(here: Floats, there: Floats, part: Floats) -> Floats:
    """Interpolate linearly; where `part` is 0 a NaN in `there` has no effect."""
    p = part.reshape(-1, *(1,) * (here.ndim - 1))
    return np.where(p > 0, here + p * (there - here), here)


@dataclass(frozen=True, eq=False)
class RenderedFrames:
    """Frames of a rendered movie; frame i depends on i and the seed alone.

    Attributes
    ----------
    paths : callable
        ``paths(times)`` returns the positions (T, n, 3) of the spheres as (x, y, z), um.
    times : ndarray, shape (t,)
        Times at which the frames start, s.
    voxel : ndarray, shape (3,)
        Voxel size (z, y, x), um.
    shape : tuple of int
        Voxels (z, y, x) of a frame.
    radius : float
        Radius of the fluorescent spheres, um.
    psf : ndarray, shape (3,)
        Standard deviations of the point spread function (z, y, x), um.
    brightness : ndarray, shape (n,)
        Factor by which the unit image of each sphere is multiplied, photons.
    background : ndarray, shape (z, y, x)
        Expected photons of the background.
    light : Light
        Intensity of the spheres.
    scan : Scan
        Times of the planes.
    camera : Camera
        Conversion of photons into grey levels.
    seed : int
        Seed of all frames.
    """

    paths: Callable[[Floats], Floats]
    times: Floats
    voxel: Floats
    shape: tuple[int, int, int]
    radius: float
    psf: Floats
    brightness: Floats
    background: Floats
    light: Light
    scan: Scan
    camera: Camera
    seed: int

    def __call__(self, i: int) -> NDArray[Any]:
        """Return the grey levels (z, y, x) of frame i."""
        rng = np.random.default_rng([self.seed, i])
        return self.camera.grey_levels(self.expected_photons(i, rng), rng)

    def expected_photons(self, i: int, rng: np.random.Generator) -> Floats:
        """Return the expected photons (z, y, x) of frame i.

        Parameters
        ----------
        i : int
            Number of the frame.
        rng : numpy.random.Generator
            Decides which spheres are dark in this frame.

        Returns
        -------
        ndarray, shape (z, y, x)
        """
        n_planes = self.shape[0]
        photons = np.zeros(self.shape)
        bright = rng.random(len(self.brightness)) >= self.light.drop
        plane_starts = self.times[i] + np.arange(n_planes) * self.scan.plane_time
        if self.scan.plane_time == 0:
            plane_starts = plane_starts[:1]
        moments = self.scan.moments()
        for moment in moments:
            positions = self.paths(plane_starts + moment)
            for n in np.flatnonzero(bright & np.isfinite(positions).all(axis=(0, 2))):
                path = np.broadcast_to(positions[:, n], (n_planes, 3))
                self.add_sphere(photons, path, brightness=float(self.brightness[n]))
        duration = self.times[-1] - self.times[0]
        age = (self.times[i] - self.times[0]) / duration if duration > 0 else 0.0
        photons *= self.light.remaining(age, n_planes) / len(moments)
        return photons + self.background

    def add_sphere(self, photons: Floats, path: Floats, *, brightness: float) -> None:
        """Add the image of one sphere to the photons of a frame, in place.

        Parameters
        ----------
        photons : ndarray, shape (z, y, x)
            The frame.
        path : ndarray, shape (z, 3)
            Position (x, y, z) of the sphere while each plane is recorded, um.
        brightness : float
            Factor of the unit image, photons.
        """
        reach = self.radius + _GAUSSIAN_RANGE * self.psf
        axes = path[:, ::-1] / self.voxel
        low = np.ceil(axes - reach / self.voxel).astype(int)
        high = np.floor(axes + reach / self.voxel).astype(int) + 1
        k = np.arange(self.shape[0])
        k = k[(k >= low[:, 0]) & (k < high[:, 0])]
        if k.size == 0:
            return
        box = [
            np.arange(max(low[k, a].min(), 0), min(high[k, a].max(), self.shape[a])) for a in (1, 2)
        ]
        offsets = (
            k * self.voxel[0] - path[k, 2],
            box[0] * self.voxel[1] - path[k, 1, None],
            box[1] * self.voxel[2] - path[k, 0, None],
        )
        if box[0].size and box[1].size:
            image = blurred_ball(offsets, radius=self.radius, psf=self.psf)
            photons[np.ix_(k, *box)] += brightness * image


def render_stack(
    motions: Motions,
    *,
    voxel: ArrayLike,
    shape: tuple[int, int, int],
    diameter: float,
    psf: ArrayLike,
    rng: np.random.Generator | int,
    core: float | None = None,
    dt: float | None = None,
    times: ArrayLike | None = None,
    centers: ArrayLike | None = None,
    light: Light | None = None,
    scan: Scan | None = None,
    camera: Camera | None = None,
    **settings: Unpack[RenderSettings],
) -> Stack:
    """Render a confocal movie of spheres whose positions are known.

    The value of a voxel is the intensity at its centre; the centre of voxel (0, 0, 0) is the origin
    of x, y, z. Photons are Poisson distributed; a grey level is gain times photons, plus offset and
    Gaussian read noise, rounded, and cut at the ends of `dtype`.

    Parameters
    ----------
    motions : RigidMotion, sequence of them, or array_like, shape (T, n, 3)
        Rigid bodies of spheres, interpolated between their frames by straight lines and shortest
        turns; or the positions (x, y, z), um, of single spheres, NaN where one is missing. Real
        motion within a frame (`plane_time` and `exposure` of the scan) needs motions sampled more
        finely than the frames.
    voxel : array_like, shape (3,)
        Voxel size (z, y, x), um.
    shape : tuple of int
        Voxels (z, y, x) of a frame. Spheres may lie partly or wholly outside.
    diameter : float
        Sphere diameter, um.
    psf : array_like, shape (3,)
        Standard deviations of the Gaussian point spread function (z, y, x), um.
    rng : numpy.random.Generator or int
        Source of random numbers, or a seed. Each frame has its own stream: frame i is the same in
        whatever order the frames are read.
    core : float, optional
        Diameter of the fluorescent core of core-shell spheres, um; by default the whole sphere is
        fluorescent.
    dt : float, optional
        Time between the rows of positions, s; motions have their own times.
    times : array_like, shape (t,), optional
        Times at which the frames start, s. By default every time of the motions from which a whole
        frame fits into them.
    centers : array_like, shape (m, 3), optional
        Position (x, y, z) of the origin of each motion (or of the positions, m = 1), um.
    light : Light, optional
        Intensity of the spheres and of the background.
    scan : Scan, optional
        Times at which the planes of a frame are recorded.
    camera : Camera, optional
        Conversion of photons into grey levels.
    **settings
        Single fields of `Light`, `Scan` and `Camera` in place of these objects, as in
        ``render_stack(..., photons=100, plane_time=0.01, gain=3)``.

    Returns
    -------
    Stack
        A frame is rendered when it is read.

    Raises
    ------
    ValueError
        For values out of range, all in one message, an option stated both in an object and as a
        keyword, or times outside those of the motions.
    TypeError
        For an unknown keyword.

    Examples
    --------
    >>> stack = render_stack(
    ...     [[[3.0, 2.0, 1.0]]], voxel=(0.2, 0.1, 0.1), shape=(11, 41, 61), diameter=1.0,
    ...     psf=(0.3, 0.15, 0.15), dt=1.0, light=Light(background=0.0),
    ...     camera=Camera(noise=False, dtype="float64"), rng=1,
    ... )
    >>> frame = stack.frame(0)
    >>> frame[5, 20, 30].round(6), np.unravel_index(frame.argmax(), frame.shape)
    (np.float64(40.0), (np.int64(5), np.int64(20), np.int64(30)))
    """
    refuse_unknown("render_stack", settings, RENDER_KEYWORDS)
    faults: list[str] = []
    light = options_from(Light, light, settings, name="light", faults=faults)
    scan = options_from(Scan, scan, settings, name="scan", faults=faults)
    camera = options_from(Camera, camera, settings, name="camera", faults=faults)
    size, blur = np.array(voxel, dtype=np.float64), np.array(psf, dtype=np.float64)
    fluorescent = diameter if core is None else core
    faults += [
        f"{name}: expected three lengths > 0 (z, y, x) in um, got {lengths.tolist()}"
        for name, lengths in (("voxel", size), ("psf", blur))
        if lengths.shape != (3,) or not np.all(np.isfinite(lengths) & (lengths > 0))
    ]
    if len(shape) != 3 or any(n != int(n) or n < 1 for n in shape):
        faults.append(f"shape: expected three whole numbers > 0 (z, y, x), got {shape!r}")
    faults += number_fault("diameter", diameter, above=0, unit="um")
    if core is not None:
        faults += number_fault("core", core, above=0, unit="um")
    if not faults and fluorescent > diameter:
        faults.append(f"core: {core!r} um is more than diameter={diameter!r}")
    if not faults:
        faults += drawing_faults(fluorescent, blur, extent=np.array(shape) * size)
    if faults:
        raise ValueError("render_stack: " + "; ".join(faults))
    background = light.background_photons(shape, size)
    paths, time, n = sphere_paths(motions, centers, dt)
    starts = scan.frame_starts(time, times, shape[0])
    generator = np.random.default_rng(rng)
    middle = np.zeros((1, 1))
    peak = blurred_ball((middle[0], middle, middle), radius=fluorescent / 2, psf=blur).item()
    brightness = light.brightness(n, peak=peak, rng=generator)
    frozen(brightness, background)
    frames = RenderedFrames(
        paths=paths,
        times=starts,
        voxel=size,
        shape=shape,
        radius=fluorescent / 2,
        psf=blur,
        brightness=brightness,
        background=background,
        light=light,
        scan=scan,
        camera=camera,
        seed=int(generator.integers(2**63)),
    )
    return Stack(
        shape=(len(starts), *shape),
        dtype=np.dtype(camera.dtype),
        voxel=size,
        times=starts,
        plane_time=float(scan.plane_time),
        source="rendered movie",
        read=frames,
    )


def drawing_faults(diameter: float, psf: Floats, *, extent: Floats) -> list[str]:
    """Return a line where the image of a sphere does not fit into memory: a length not in um.

    The ball is tabulated on cubes of half the narrowest point spread, so that its table grows with
    the cube of the ratio of diameter to point spread. A sphere may be cut by the border of the
    stack, but a sphere longer than the longest side shows no surface.

    Parameters
    ----------
    diameter : float
        Diameter of the fluorescent sphere, um.
    psf : ndarray, shape (3,)
        Standard deviations of the point spread function (z, y, x), um.
    extent : ndarray, shape (3,)
        Size of the stack (z, y, x), um.

    Returns
    -------
    list of str
        Empty, or one line.

    Examples
    --------
    >>> drawing_faults(1.0, np.full(3, 0.2), extent=np.full(3, 8.0))
    []
    >>> drawing_faults(2450.0, np.full(3, 0.2), extent=np.full(3, 8.0))[0][:44]
    'a sphere of 2450 um is larger than the stack'
    """
    sides = " x ".join(f"{side:.4g}" for side in extent)
    if diameter > extent.max():
        return [
            f"a sphere of {diameter:g} um is larger than the stack, which is {sides} "
            "um (z, y, x); are the lengths in um?"
        ]
    if psf.min() < diameter / _MAX_SHARPNESS:
        return [
            f"a point spread of {psf.min():g} um is too narrow for a sphere of "
            f"{diameter:g} um in a stack of {sides} um (z, y, x): expected at least "
            f"{diameter / _MAX_SHARPNESS:.2g} um; are the lengths in um?"
        ]
    return []


def sphere_paths(
    motions: Motions, centers: ArrayLike | None, dt: float | None
) -> tuple[Callable[[Floats], Floats], Floats, int]:
    """Return the positions of all spheres as a function of time.

    Parameters
    ----------
    motions, centers, dt
        The arguments of `render_stack`.

    Returns
    -------
    paths : callable
        ``paths(times)`` returns positions (T, n, 3), um.
    time : ndarray, shape (T,)
        The times at which positions were given, s.
    n : int
        Number of spheres.

    Raises
    ------
    ValueError
        For motions in the plane or of different times, or shapes that do not match.

    Examples
    --------
    >>> paths, time, n = sphere_paths([[[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]]], None, 0.5)
    >>> time, n, paths(np.array([0.25]))
    (array([0. , 0.5]), 1, array([[[0.5, 0. , 0. ]]]))
    """
    bodies: tuple[RigidMotion, ...] = ()
    if isinstance(motions, RigidMotion):
        bodies = (motions,)
    elif isinstance(motions, (list, tuple)) and all(isinstance(m, RigidMotion) for m in motions):
        bodies = tuple(motions)
    origins = np.zeros((max(len(bodies), 1), 3))
    if centers is not None:
        given = np.asarray(centers, dtype=np.float64)
        if given.shape != origins.shape or not np.all(np.isfinite(given)):
            raise ValueError(f"centers: expected shape {origins.shape}, finite, got {given.shape}")
        origins = given.copy()
    if not bodies:
        x = as_positions(np.asarray(motions, dtype=np.float64)) + origins
        if x.shape[2] != 3 or (dt is None and len(x) > 1):
            raise ValueError(f"positions: expected (T, n, 3) and dt=, got {x.shape} and dt={dt!r}")
        require_positive(dt=1.0 if dt is None else dt)
        time = np.arange(len(x), dtype=np.float64) * float(dt or 1.0)
        return _PointPaths(x, time), time, x.shape[1]
    time = bodies[0].time
    if dt is not None:
        raise ValueError("dt: the motions have their own times; leave it out")
    if any(m.dimension != 3 or not np.array_equal(m.time, time) for m in bodies):
        raise ValueError("motions: expected bodies in three dimensions with the same times")
    return _BodyPaths(bodies, origins), time, sum(len(m.template) for m in bodies)
