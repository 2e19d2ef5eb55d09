"""Movies with a known truth: spheres as a confocal microscope would show them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perrin._arrays import Floats, as_positions, frozen, require_positive
from perrin.geometry.rotations import exp_map, log_map
from perrin.images.stack import Stack
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import TypeAlias

    _Motions: TypeAlias = RigidMotion | Sequence[RigidMotion] | ArrayLike


# Where a Gaussian ends: 5 sigma, 3e-7 of its peak.
_REACH = 5.0


# Diameters over point spreads up to which a ball is drawn: a table of 200 MB.
_FINEST = 280.0


def ball_image(offsets: tuple[Floats, Floats, Floats], *, radius: float, psf: Floats) -> Floats:
    """Return a solid ball convolved with an anisotropic Gaussian, on planes of voxels.

    A ball convolved with an isotropic Gaussian has a closed form in erf; the rest of the PSF is
    applied along each axis by the trapezoidal rule, whose error for Gaussians falls as
    exp(-2 pi^2 s^2 / h^2) with the step h. Within 1e-9 of the peak for balls larger than the PSF,
    1e-6 for any.

    Parameters
    ----------
    offsets : tuple of ndarray, shapes (k,), (k, m) and (k, n)
        Distances of k planes from the centre of the ball along z, and in each plane those of its
        rows along y and of its columns along x, um.
    radius : float
        um.
    psf : ndarray, shape (3,)
        Standard deviations (z, y, x), um.

    Returns
    -------
    ndarray, shape (k, m, n)
        1 inside a ball far larger than the PSF.

    Examples
    --------
    >>> import numpy as np
    >>> z, line = np.array([0.0]), np.array([[0.0, 1.0, 2.0]])
    >>> image = ball_image((z, line, line), radius=1.0, psf=np.array([0.2, 0.1, 0.1]))
    >>> image[0, 0].round(3)
    array([1.   , 0.406, 0.   ])
    """
    narrow = psf.min() / np.sqrt(2)
    step = psf.min() / 2
    nodes = np.arange(int(np.ceil((radius + _REACH * narrow) / step)) + 1) * step
    square = nodes**2
    distance = np.sqrt(square[:, None, None] + square[:, None] + square)
    ball = _round_ball(distance, radius, narrow)
    rest = np.sqrt(psf**2 - narrow**2)
    z, y, x = (_spread(d, nodes, s) for d, s in zip(offsets, rest, strict=True))
    planes = np.tensordot(z, ball, axes=1)
    image: Floats = y @ planes @ np.swapaxes(x, -1, -2)
    return image


def _spread(offsets: Floats, nodes: Floats, sigma: float) -> Floats:
    """Return the weight of each node, and of its mirror image, at each offset."""
    step, scale = nodes[1], 1 / (sigma * np.sqrt(2))
    to_node = np.exp(-(((offsets[..., None] - nodes) * scale) ** 2))
    to_mirror = np.exp(-(((offsets[..., None] + nodes) * scale) ** 2))
    weights: Floats = (to_node + to_mirror) * (step * scale / np.sqrt(np.pi))
    weights[..., 0] /= 2
    return weights


def _round_ball(r: Floats, a: float, s: float) -> Floats:
    """Return a ball of radius a convolved with an isotropic Gaussian, at distances r."""
    from scipy.special import erf

    root = np.sqrt(2) * s
    # exp(-(a - r)^2 / 2s^2) - exp(-(a + r)^2 / 2s^2) without the difference of near equals at r = 0
    far = np.maximum(r, 1e-3 * s)
    gap = -np.exp(-(((a - far) / root) ** 2)) * np.expm1(-2 * a * far / s**2)
    inside = 0.5 * (erf((a + r) / root) + erf((a - r) / root))
    value: Floats = inside - s / np.sqrt(2 * np.pi) * gap / far
    return value


@dataclass(frozen=True, eq=False)
class _Paths:
    """Particles (T, n, 3) of bodies that move rigidly between the times of their frames."""

    motions: tuple[RigidMotion, ...]
    centers: Floats

    def __call__(self, times: Floats) -> Floats:
        parts = [_carried(m, times) + c for m, c in zip(self.motions, self.centers, strict=True)]
        return np.concatenate(parts, axis=1)


@dataclass(frozen=True, eq=False)
class _Points:
    """Particles (T, n, 3) that move straight between the times of their frames."""

    positions: Floats
    time: Floats

    def __call__(self, times: Floats) -> Floats:
        i, part = _between(self.time, times)
        here, there = self.positions[i], self.positions[np.minimum(i + 1, len(self.time) - 1)]
        return _mixed(here, there, part)


def _between(time: Floats, at: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the frame before each moment, and the part of the interval gone since."""
    if len(time) == 1:
        return np.zeros(len(at), dtype=np.int64), np.zeros(len(at))
    i = np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 2)
    part = (at - time[i]) / (time[i + 1] - time[i])
    # Rounding of times must not blend in a neighbour that may be missing.
    whole = np.abs(part - np.round(part)) < 1e-9
    part = np.where(whole, np.round(part), part)
    return np.where(part >= 1, i + 1, i), np.where(part >= 1, 0.0, np.maximum(part, 0.0))


def _mixed(here: Floats, there: Floats, part: Floats) -> Floats:
    """Interpolate; at a frame itself the next one does not matter, missing or not."""
    p = part.reshape(-1, *(1,) * (here.ndim - 1))
    return np.where(p > 0, here + p * (there - here), here)


def _carried(motion: RigidMotion, times: Floats) -> Floats:
    """Return the particles of a body at any times: straight centre, shortest turn."""
    i, part = _between(motion.time, times)
    j = np.minimum(i + 1, len(motion.time) - 1)
    turn = log_map(np.swapaxes(motion.rotation[i], -1, -2) @ motion.rotation[j])
    turn = _mixed(np.zeros_like(turn), turn, part)
    rotation = motion.rotation[i] @ exp_map(turn)
    center = _mixed(motion.center[i], motion.center[j], part)
    return np.asarray(np.einsum("tij,nj->tni", rotation, motion.template) + center[:, None])


@dataclass(frozen=True, eq=False)
class _Movie:
    """Everything that makes a frame; frame i depends on i and the seed alone."""

    paths: Callable[[Floats], Floats]
    times: Floats
    plane_time: float
    exposure: float
    substeps: int
    voxel: Floats
    shape: tuple[int, int, int]
    radius: float
    psf: Floats
    brightness: Floats
    drop: float
    bleaching: float
    depth_loss: float
    background: Floats
    gain: float
    offset: float
    read_noise: float
    dtype: np.dtype[Any]
    noise: bool
    seed: int

    def __call__(self, i: int) -> NDArray[Any]:
        rng = np.random.default_rng([self.seed, i])
        light = self._light(i, rng)
        counts = self.offset + self.gain * (rng.poisson(light) if self.noise else light)
        if self.noise and self.read_noise > 0:
            counts = counts + rng.normal(0.0, self.read_noise, light.shape)
        if self.dtype.kind != "f":
            # A camera saturates: the ends of its range are its own.
            counts = np.clip(np.rint(counts), 0, np.iinfo(self.dtype).max)
        return np.asarray(counts, dtype=self.dtype)

    def _light(self, i: int, rng: np.random.Generator) -> Floats:
        """Return the photons to expect in every voxel of frame i."""
        n_planes = self.shape[0]
        light = np.zeros(self.shape)
        seen = rng.random(len(self.brightness)) >= self.drop
        moments = (np.arange(self.substeps) + 0.5) / self.substeps * self.exposure
        scan = self.times[i] + np.arange(n_planes) * self.plane_time
        for moment in moments:
            still = self.plane_time == 0
            places = self.paths(scan[:1] + moment if still else scan + moment)
            for n in np.flatnonzero(seen & np.isfinite(places).all(axis=(0, 2))):
                path = np.broadcast_to(places[:, n], (n_planes, 3))
                self._add(light, path, float(self.brightness[n]))
        light *= self._fading(i) / self.substeps
        return light + self.background

    def _fading(self, i: int) -> Floats:
        """Return the light left by bleaching and on the way up from each plane, (z, 1, 1)."""
        whole = self.times[-1] - self.times[0]
        age = (self.times[i] - self.times[0]) / whole if whole > 0 else 0.0
        depth = np.linspace(0.0, 1.0, self.shape[0])[:, None, None]
        fading: Floats = (1 - self.bleaching) ** age * (1 - self.depth_loss) ** depth
        return fading

    def _add(self, light: Floats, path: Floats, brightness: float) -> None:
        """Add one sphere, its place (x, y, z) known for every plane, to the light of a frame."""
        reach = self.radius + _REACH * self.psf
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
            image = ball_image(offsets, radius=self.radius, psf=self.psf)
            light[np.ix_(k, *box)] += brightness * image


def render_stack(
    motions: _Motions,
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
    photons: float = 40.0,
    spread: float = 0.0,
    background: float = 2.0,
    gradient: ArrayLike = (0.0, 0.0, 0.0),
    bleaching: float = 0.0,
    depth_loss: float = 0.0,
    drop: float = 0.0,
    plane_time: float = 0.0,
    exposure: float = 0.0,
    substeps: int = 8,
    gain: float = 1.0,
    offset: float = 0.0,
    read_noise: float = 0.0,
    noise: bool = True,
    dtype: Literal["uint8", "uint16", "float32", "float64"] = "uint16",
) -> Stack:
    """Render a confocal movie of spheres whose places are known.

    A voxel has the light at its centre; the centre of voxel (0, 0, 0) is the origin of x, y, z.
    Photons are Poisson; a count is gain times photons, plus offset and Gaussian read noise,
    rounded, and cut at the ends of `dtype`.

    Parameters
    ----------
    motions : RigidMotion, sequence of them, or array_like, shape (T, n, 3)
        Rigid bodies of spheres, interpolated between their frames by straight lines and shortest
        turns; or the positions (x, y, z), um, of single spheres, NaN where one is not there.
        Real motion within a frame (for `plane_time` and `exposure`) wants a truth sampled finer
        than the frames.
    voxel : array_like, shape (3,)
        (z, y, x), um.
    shape : tuple of int
        Voxels (z, y, x) of a frame. Spheres may lie partly or wholly outside.
    diameter : float
        Of a sphere, um.
    psf : array_like, shape (3,)
        Standard deviation of the Gaussian point spread function (z, y, x), um.
    rng : numpy.random.Generator or int
        Source of random numbers, or a seed. Each frame has its own stream: frame i is the same in
        whatever order frames are asked for.
    core : float, optional
        Diameter of the fluorescent core of core-shell spheres, um; without it a sphere shines all
        through.
    dt : float, optional
        Time between the rows of positions, s; motions know theirs.
    times : array_like, shape (t,), optional
        When frames start, s. By default at every time of the motions whose frame ends within them.
    centers : array_like, shape (m, 3), optional
        Where the origin of each motion (or of the positions, m = 1) is put, (x, y, z), um.
    photons : float
        Photons in the central voxel of a sphere, before all losses.
    spread : float
        Relative standard deviation of the spheres' brightness; log-normal.
    background : float
        Photons per voxel in the middle of the frame.
    gradient : array_like, shape (3,)
        Change of the background along (z, y, x), photons per voxel per um.
    bleaching : float
        Part of the spheres' light lost from the first frame to the last, exponential in time.
    depth_loss : float
        Part of the spheres' light lost from the first plane to the last, exponential in depth.
    drop : float
        Probability that a sphere is dark in a frame.
    plane_time : float
        Time from one plane to the next, s; 0 takes all planes at once.
    exposure : float
        How long each plane is exposed, s, from its start on.
    substeps : int
        Moments by which the motion within an exposure is averaged.
    gain, offset, read_noise : float
        Counts per photon, counts in the dark, and their standard deviation in counts.
    noise : bool
        False gives the expected counts.
    dtype : str
        Of the counts.

    Returns
    -------
    Stack
        Frames are rendered when asked for.

    Raises
    ------
    ValueError
        For bad values, all in one message, or times outside those of the motions.

    Examples
    --------
    >>> stack = render_stack(
    ...     [[[3.0, 2.0, 1.0]]], voxel=(0.2, 0.1, 0.1), shape=(11, 41, 61), diameter=1.0,
    ...     psf=(0.3, 0.15, 0.15), dt=1.0, background=0.0, noise=False, dtype="float64", rng=1,
    ... )
    >>> frame = stack.frame(0)
    >>> frame[5, 20, 30].round(6), np.unravel_index(frame.argmax(), frame.shape)
    (np.float64(40.0), (np.int64(5), np.int64(20), np.int64(30)))
    """
    size, blur = np.array(voxel, dtype=np.float64), np.array(psf, dtype=np.float64)
    slope = np.array(gradient, dtype=np.float64)
    labelled = diameter if core is None else core
    positive = {"diameter": diameter, "core": labelled, "gain": gain, "substeps": substeps}
    not_negative = {
        "photons": photons, "spread": spread, "background": background, "plane_time": plane_time,
        "exposure": exposure, "read_noise": read_noise,
    }  # fmt: skip
    parts = {"bleaching": bleaching, "depth_loss": depth_loss, "drop": drop}
    _check_numbers(
        {"voxel": size, "psf": blur}, shape, positive, not_negative, parts, slope, offset
    )
    if labelled > diameter:
        raise ValueError(f"core: {core!r} um is more than diameter={diameter!r}")
    _check_sphere(labelled, blur, extent=np.array(shape) * size)
    dark = _background(shape, size, background, slope)
    paths, time, n = _paths(motions, centers, dt)
    scan = plane_time * (shape[0] - 1) + exposure
    start = _starts(time, times, scan)
    generator = np.random.default_rng(rng)
    shine = _brightness(photons, spread, n=n, radius=labelled / 2, psf=blur, rng=generator)
    movie = _Movie(
        paths=paths,
        times=start,
        plane_time=float(plane_time),
        exposure=float(exposure),
        substeps=int(substeps) if exposure > 0 else 1,
        voxel=size,
        shape=shape,
        radius=labelled / 2,
        psf=blur,
        brightness=shine,
        drop=drop,
        bleaching=bleaching,
        depth_loss=depth_loss,
        background=dark,
        gain=gain,
        offset=offset,
        read_noise=read_noise,
        dtype=np.dtype(dtype),
        noise=noise,
        seed=int(generator.integers(2**63)),
    )
    frozen(shine, dark)
    return Stack(
        shape=(len(start), *shape),
        dtype=movie.dtype,
        voxel=size,
        times=start,
        plane_time=float(plane_time),
        source="rendered movie",
        read=movie,
    )


def _check_numbers(
    lengths: dict[str, Floats],
    shape: tuple[int, int, int],
    positive: dict[str, float],
    not_negative: dict[str, float],
    parts: dict[str, float],
    slope: Floats,
    offset: float,
) -> None:
    """Raise one error that lists every bad number."""
    faults = [
        f"{name}: expected three lengths > 0 (z, y, x) in um, got {v.tolist()}"
        for name, v in lengths.items()
        if v.shape != (3,) or not np.all(np.isfinite(v) & (v > 0))
    ]
    if len(shape) != 3 or any(n != int(n) or n < 1 for n in shape):
        faults.append(f"shape: expected three whole numbers > 0 (z, y, x), got {shape!r}")
    ranges = ((positive, "> 0"), (not_negative, ">= 0"), (parts, "from 0 to below 1"))
    for values, wanted in ranges:
        faults += [
            f"{name}: expected a number {wanted}, got {v!r}"
            for name, v in values.items()
            if not (np.isfinite(v) and v >= 0)
            or (v == 0 and values is positive)
            or (v >= 1 and values is parts)
        ]
    if slope.shape != (3,) or not np.all(np.isfinite(slope)) or not np.isfinite(offset):
        faults.append("gradient, offset: expected finite numbers, three of them for the gradient")
    if faults:
        raise ValueError("render_stack: " + "; ".join(faults))


def _check_sphere(diameter: float, psf: Floats, *, extent: Floats) -> None:
    """Refuse a sphere whose image would not fit into memory: its lengths are not in um.

    The ball is tabulated on cubes of half the narrowest point spread, so that its table grows with
    the cube of their ratio. A sphere may be cut by the stack, but one longer than its longest side
    shows no surface.
    """
    sides = " x ".join(f"{side:.4g}" for side in extent)
    if diameter > extent.max():
        raise ValueError(
            f"render_stack: a sphere of {diameter:g} um is larger than the stack, which is {sides} "
            "um (z, y, x); are the lengths in um?"
        )
    if psf.min() < diameter / _FINEST:
        raise ValueError(
            f"render_stack: a point spread of {psf.min():g} um is too narrow for a sphere of "
            f"{diameter:g} um in a stack of {sides} um (z, y, x): expected at least "
            f"{diameter / _FINEST:.2g} um; are the lengths in um?"
        )


def _background(shape: tuple[int, int, int], voxel: Floats, level: float, slope: Floats) -> Floats:
    """Return the photons of the background in every voxel."""
    z, y, x = (
        (np.arange(n) - (n - 1) / 2) * size * rise
        for n, size, rise in zip(shape, voxel, slope, strict=True)
    )
    dark: Floats = level + z[:, None, None] + y[:, None] + x
    if dark.min() < 0:
        raise ValueError(
            f"render_stack: the gradient takes the background down to {dark.min():.3g} photons"
        )
    return dark


def _brightness(
    photons: float, spread: float, *, n: int, radius: float, psf: Floats, rng: np.random.Generator
) -> Floats:
    """Return what each sphere's image is multiplied with, so that its centre has the photons."""
    center = np.zeros((1, 1))
    peak = ball_image((center[0], center, center), radius=radius, psf=psf).item()
    width = np.sqrt(np.log1p(spread**2))
    shine: Floats = photons / peak * np.exp(rng.normal(-(width**2) / 2, width, n))
    return shine


def _paths(
    motions: _Motions, centers: ArrayLike | None, dt: float | None
) -> tuple[Callable[[Floats], Floats], Floats, int]:
    """Return where the spheres are at any times, the times known, and how many spheres."""
    listed = _as_motions(motions)
    place = np.zeros((max(len(listed), 1), 3))
    if centers is not None:
        given = np.asarray(centers, dtype=np.float64)
        if given.shape != place.shape or not np.all(np.isfinite(given)):
            raise ValueError(f"centers: expected shape {place.shape}, finite, got {given.shape}")
        place = given.copy()
    if not listed:
        x = as_positions(np.asarray(motions, dtype=np.float64)) + place
        if x.shape[2] != 3 or (dt is None and len(x) > 1):
            raise ValueError(f"positions: expected (T, n, 3) and dt=, got {x.shape} and dt={dt!r}")
        require_positive(dt=1.0 if dt is None else dt)
        time = np.arange(len(x), dtype=np.float64) * float(dt or 1.0)
        return _Points(x, time), time, x.shape[1]
    time = listed[0].time
    if dt is not None:
        raise ValueError("dt: the motions have their own times; leave it out")
    if any(m.template.shape[1] != 3 or not np.array_equal(m.time, time) for m in listed):
        raise ValueError("motions: expected bodies in three dimensions with the same times")
    return _Paths(listed, place), time, sum(len(m.template) for m in listed)


def _as_motions(motions: _Motions) -> tuple[RigidMotion, ...]:
    """Return the bodies; none where positions were given."""
    if isinstance(motions, RigidMotion):
        return (motions,)
    if isinstance(motions, (list, tuple)) and all(isinstance(m, RigidMotion) for m in motions):
        return tuple(motions)
    return ()


def _starts(time: Floats, times: ArrayLike | None, scan: float) -> Floats:
    """Return when the frames start: as given, or whenever a whole frame fits into the motion."""
    end = time[-1] + 1e-9 * (time[-1] - time[0])
    if times is None:
        start: Floats = time[time + scan <= end].copy()
        if start.size == 0:
            raise ValueError(f"a frame takes {scan:g} s, longer than the motion ({time[-1]:g} s)")
        return start
    start = np.array(times, dtype=np.float64)
    if start.ndim != 1 or start.size == 0 or np.any(np.diff(start) <= 0):
        raise ValueError("times: expected growing numbers, shape (t,)")
    if not (start[0] >= time[0] and start[-1] + scan <= end):
        raise ValueError(
            f"times: frames of {scan:g} s from {start[0]:g} to {start[-1]:g} s are not within the "
            f"motion ({time[0]:g} to {time[-1]:g} s)"
        )
    return start
