"""Movies of an independent renderer through the pipeline: one property of a microscope at a time.

The renderer shares no code with perrin. A ball is its own Fourier transform, multiplied by that of
the point spread (Gaussian, or the product of two focal fields of a confocal microscope), sampled on
a fine grid and interpolated at every voxel; each plane is drawn at its own time. Bodies move in a
box with hard walls, by rejection of steps that would make spheres overlap, so that encounters
happen. The base case: four touching tetrahedra of balls 2.45 um, 40 x 128 x 128 voxels of 0.25 x
0.2 x 0.2 um, 20 frames 0.73 s apart, D_R 0.0049 rad^2/s, D_T 0.0385 um^2/s, 40 photons over a
background of 3, gain 3.

Printed for every movie: spheres missed and false, false ones in clusters, the standard deviation of
positions and the stated error (nm), their mean squared ratio, planted clusters that were found,
false ones, orientation errors with their mean squared ratio to the stated ones, and D minus that of
the true positions at one instant, in its standard errors, with the ratio of the standard errors.
The true positions are those of frames in which most of a body is in the field. With several movies
a case ends with means and their Monte-Carlo errors. "bright field" is a 2-D movie of dark-rim
rings, with and without dark=True: printed are clusters and warnings.

Usage: python benchmarks/microscopes.py [--only NAME] [--movies 1] [--seed 0] [--warnings]
"""

import argparse
import io
import time
import warnings
from dataclasses import dataclass, field, replace

import numpy as np
from pupil import Lens, behind_pinhole
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

DIAMETER, DT, D_R, D_T = 2.45, 0.73, 0.0049, 0.0385
LENS = Lens()
SHAPES = {
    1: np.zeros((1, 3)),
    2: np.array([[-0.5, 0, 0], [0.5, 0, 0]]),
    3: np.array([[0, 1, 0], [-np.sqrt(3) / 2, -0.5, 0], [np.sqrt(3) / 2, -0.5, 0]]) / np.sqrt(3),
    4: np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(8),
    6: np.concatenate([np.eye(3), -np.eye(3)]) / np.sqrt(2),
}


@dataclass(frozen=True)
class Microscope:
    """What is between the spheres and the file."""

    shape: tuple[int, int, int] = (40, 128, 128)
    voxel: tuple[float, float, float] = (0.25, 0.2, 0.2)
    psf: str = "gaussian"  # or "tails" (30 % of it Lorentzian), "confocal", "lens", "widefield"
    blur: tuple[float, float] = (0.4, 0.15)  # z and xy, um; of the Gaussian
    last_blur: tuple[float, float] | None = None  # the same at the last plane, where it differs
    tilt: float = 0.0  # of the optical axis, or of the light sheet where there is one, degrees
    sheet: float = 0.0  # standard deviation of the thickness of a light sheet, um
    lens: Lens = LENS
    pinhole: float = 0.0  # diameter, Airy units of 1.22 wavelengths over the aperture
    cover: float | None = None  # depth of the first plane below the cover glass, um
    haze: float = 0.0  # light of the spheres that is spread over 3 um, in units of the rest
    stage_noise: float = 0.0  # of the height of every frame, um
    photons: float = 40.0
    background: float = 3.0
    gain: float = 3.0
    read_noise: float = 1.0  # grey levels
    pixel_spread: float = 0.0  # of the gain from pixel to pixel (sCMOS)
    pixel_offset: float = 0.0  # standard deviation of the offset from pixel to pixel, grey levels
    pixel_noise: float = 0.0  # standard deviation of the logarithm of the read noise of a pixel
    offset: float = 0.0  # added before the range of the camera clips, grey levels
    bits: int = 8
    line_flicker: float = 0.0  # of the light, from row to row of the scan
    plane_flicker: float = 0.0  # of the light, from plane to plane
    curved: float = 0.0  # bright background, photons at its middle; a third of the field wide
    smooth: float = 0.0  # of the grey levels before they are saved, standard deviation, voxels
    jpeg: int = 0  # quality with which every plane is compressed; 0 for none
    bleached: float = 0.0  # share of the light lost at the last frame
    depth_loss: float = 0.0  # share of the light lost at the last plane
    plane_time: float = 0.0
    shell: bool = False

    @property
    def box(self):
        """Return lengths of the field along x, y, z, um."""
        return (np.array(self.shape) * self.voxel)[::-1]


@dataclass
class Body:
    """Spheres that move together."""

    shape: np.ndarray  # (n, 3), um
    place: np.ndarray
    turn: Rotation
    bright: np.ndarray  # (n,)
    path: list = field(default_factory=list)

    def spheres(self):
        """Return the positions (n, 3) of the spheres."""
        return self.place + self.turn.apply(self.shape)


def scene(kinds, box, *, rng, bright=None, walls=DIAMETER, fixed=(), tries=20000):
    """Place bodies at random without overlap with each other and with `fixed` bodies.

    `kinds` lists numbers of spheres, in order; `bright` has factors of the light of the spheres of
    each body; centres of all spheres keep `walls` from the sides (negative: they may leave).
    """
    bodies = []
    for i, kind in enumerate(kinds):
        shape = DIAMETER * SHAPES[kind]
        light = np.ones(kind) if bright is None else np.asarray(bright[i], dtype=float)
        for _ in range(tries):
            body = Body(shape, rng.uniform(walls, box - walls), Rotation.random(rng=rng), light)
            if allowed(body.spheres(), [*bodies, *fixed], box, walls):
                bodies.append(body)
                break
        else:
            raise RuntimeError("no space is left for another body")
    return bodies


def allowed(x, bodies, box, walls):
    """Return whether spheres are inside the walls and overlap no sphere of other bodies."""
    if np.any(x < walls) or np.any(x > box - walls):
        return False
    others = [b.spheres() for b in bodies]
    return not others or cdist(x, np.concatenate(others)).min() >= 1.001 * DIAMETER


def diffuse(bodies, times, box, *, rng, walls=DIAMETER, fixed=(), longest=0.1):
    """Move all bodies through the times; each body's `path` becomes (len(times), n, 3).

    They do not overlap with each other nor with `fixed` bodies.

    D_T and D_R of a body of n spheres are those of a tetrahedron times 4 / n and (4 / n)^2 up to
    the sizes of the shapes; a single sphere has 1.8 D_T.
    """
    now = times[0]
    sizes = [len(b.shape) for b in bodies]
    first = np.cumsum([0, *sizes])
    x = np.concatenate([b.spheres() for b in (*bodies, *fixed)])
    owner = np.repeat(np.arange(len(bodies)), sizes)
    owner = np.append(owner, np.full(len(x) - len(owner), -1))
    for t in times:
        steps = max(1, int(np.ceil((t - now) / longest - 1e-9))) if t > now else 0
        for _ in range(steps):
            h = (t - now) / steps
            for i, b in enumerate(bodies):
                slow = (sizes[i] / 4) ** (1 / 3)
                move = rng.normal(0, np.sqrt(2 * h * D_T / slow), 3)
                spin = rng.normal(0, np.sqrt(2 * h * D_R / slow**3), 3)
                place, turn = b.place + move, Rotation.from_rotvec(spin) * b.turn
                new = place + turn.apply(b.shape)
                if np.any(new < walls) or np.any(new > box - walls):
                    continue
                other = x[owner != i]
                near = other[np.abs(other - place).max(axis=1) < 3 * DIAMETER]
                if len(near) and cdist(new, near).min() < DIAMETER:
                    continue
                b.place, b.turn = place, turn
                x[first[i] : first[i + 1]] = new
        now = t
        for b in bodies:
            b.path.append(b.spheres())
    for b in bodies:
        b.path = np.array(b.path)


def focal_field(rho, z, *, wave, aperture=1.3, index=1.4):
    """Return the intensity of a focused wave near the focus (scalar Debye integral)."""
    from scipy.special import j0

    k = 2 * np.pi * index / wave
    nodes, weights = np.polynomial.legendre.leggauss(60)
    high = np.arcsin(aperture / index)
    theta = high * (nodes + 1) / 2
    ring = np.sqrt(np.cos(theta)) * np.sin(theta) * weights
    phase = np.exp(1j * k * z[:, None] * np.cos(theta))
    return np.abs(np.einsum("zt,rt,t->zr", phase, j0(k * np.outer(rho, np.sin(theta))), ring)) ** 2


def blurred_ball(light, *, grid=0.05, half=(3.4, 2.3), diameter=DIAMETER, depth=0.0):
    """Return spline coefficients of the image of one ball on a fine grid, and its spacing, um.

    The image is scaled to 1 at its middle, that of a shell at its brightest place.
    """
    if light.psf in ("lens", "widefield", "tails"):
        half = (5.0, 3.4)
    n = [2 * round(half[0] / grid), 2 * round(half[1] / grid), 2 * round(half[1] / grid)]
    k = [2 * np.pi * np.fft.fftfreq(m, grid) for m in n]
    kz, ky, kx = np.meshgrid(*k, indexing="ij", sparse=True)
    kr = np.sqrt(kz**2 + ky**2 + kx**2) * diameter / 2
    kr[0, 0, 0] = 1e-6
    ball = np.sin(kr) / kr if light.shell else 3 * (np.sin(kr) - kr * np.cos(kr)) / kr**3
    if light.psf in ("gaussian", "tails"):
        otf = gaussian_transfer(light, kz, ky, kx)
    else:
        otf = np.fft.fftn(np.fft.ifftshift(point_image(light, n, grid, depth)))
    image = np.fft.fftshift(np.fft.ifftn(ball * otf).real)
    brightest = image.max() if light.shell else image[tuple(m // 2 for m in n)]
    return spline_filter(image / brightest, order=3), grid


def gaussian_transfer(light, kz, ky, kx):
    """Return the transfer function of a Gaussian, its axis tilted towards x, with its tails."""
    width = np.diag(np.square([light.blur[0], light.blur[1], light.blur[1]]))
    turn = np.radians(light.tilt)
    if light.sheet:
        normal = np.array([np.cos(turn), 0.0, np.sin(turn)])
        width = np.linalg.inv(np.linalg.inv(width) + np.outer(normal, normal) / light.sheet**2)
    elif turn:
        c, s = np.cos(turn), np.sin(turn)
        axes = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        width = axes @ width @ axes.T
    k = (kz, ky, kx)
    square = sum(width[i, j] * k[i] * k[j] for i in range(3) for j in range(3))
    if light.psf == "gaussian":
        return np.exp(-square / 2)
    return 0.7 * np.exp(-square / 2) + 0.3 * np.exp(-np.sqrt(square))


def point_image(light, n, grid, depth):
    """Return the image (z, y, x) of a point at this depth below the cover glass, um."""
    z, y, x = ((np.arange(m) - m // 2) * grid for m in n)
    if light.psf == "confocal":
        fine = np.linspace(0, 1.5 * n[1] * grid / 2, 400)
        point = focal_field(fine, z, wave=0.488) * focal_field(fine, z, wave=0.52)
        r = np.hypot(*np.meshgrid(y, x, indexing="ij"))
        return np.stack([np.interp(r, fine, line) for line in point])
    lens, where = light.lens, {"depth": depth, "scale": 1.0}
    if light.cover is not None:
        # The user's heights are those of the spheres: the mean shift of the focus is taken off.
        middle = light.cover + light.box[2] / 2
        where["scale"] = lens.focal_scale(middle)
    emitted = lens.intensity(n[1], grid, z, wave=0.52, **where)
    if light.psf == "widefield":
        return emitted
    radius = light.pinhole * 1.22 * 0.52 / lens.aperture / 2
    excited = lens.intensity(n[1], grid, z, wave=0.488, **where)
    return excited * behind_pinhole(emitted, grid, radius)


def blurred_at(light, height):
    """Return a microscope whose Gaussian is that at a height in the stack, um."""
    if light.last_blur is None:
        return light
    share = height / light.box[2]
    first, last = np.square(light.blur), np.square(light.last_blur)
    wide_z, wide = np.sqrt(first + share * (last - first)).tolist()
    return replace(light, blur=(wide_z, wide))


def image_of(light, *, diameter=DIAMETER):
    """Return the image of a ball as a function of its height: spline coefficients and spacing."""
    if light.cover is None and light.last_blur is None:
        table = blurred_ball(light, diameter=diameter)
        return lambda _: table
    heights = np.linspace(0, light.box[2], 6)
    tables = [
        blurred_ball(blurred_at(light, z), diameter=diameter, depth=(light.cover or 0.0) + z)
        for z in heights
    ]

    def between(height):
        at = np.clip(height / heights[1], 0, len(heights) - 1.001)
        low, share = int(at), at - int(at)
        one, two = tables[low][0], tables[low + 1][0]
        return (1 - share) * one + share * two, tables[0][1]

    return between


def exposed(bodies, light, *, frame, image, dust=(), images=None, lift=0.0):
    """Return the mean light of every voxel of one frame, all bodies `lift` um higher.

    `image` is that of a sphere by its height; `images` are those of the spheres of `bodies` in
    their order, where they differ.
    """
    images = iter(images or ())
    planes, ny, nx = light.shape
    voxel = np.array(light.voxel)
    out = np.zeros(light.shape)
    # Paths have one position per plane where planes are drawn at their own times.
    per = planes if light.plane_time else 1
    for b in (*bodies, *dust):
        for j, bright in enumerate(b.bright):
            x = b.path[frame * per : frame * per + per, j] + [0, 0, lift]
            x = np.broadcast_to(x, (planes, 3))
            coefficients, grid = next(images, image)(x[:, 2].mean())
            size = np.array(coefficients.shape)
            reach = size / 2 * grid - 2 * grid
            z = np.arange(planes) * voxel[0] - x[:, 2]
            seen = np.flatnonzero(np.abs(z) < reach[0])
            if not seen.size or bright == 0:
                continue
            ys, xs = x[seen, 1], x[seen, 0]
            y0 = max(0, int(np.ceil((ys.min() - reach[1]) / voxel[1])))
            y1 = min(ny, int((ys.max() + reach[1]) / voxel[1]) + 1)
            x0 = max(0, int(np.ceil((xs.min() - reach[2]) / voxel[2])))
            x1 = min(nx, int((xs.max() + reach[2]) / voxel[2]) + 1)
            if y0 >= y1 or x0 >= x1:
                continue
            dy = np.arange(y0, y1) * voxel[1] - ys[:, None]
            dx = np.arange(x0, x1) * voxel[2] - xs[:, None]
            where = np.broadcast_arrays(
                z[seen][:, None, None] / grid + size[0] // 2,
                dy[:, :, None] / grid + size[1] // 2,
                dx[:, None, :] / grid + size[2] // 2,
            )
            part = map_coordinates(coefficients, where, order=3, prefilter=False)
            out[seen, y0:y1, x0:x1] += bright * np.maximum(part, 0)
    if light.haze:
        out += light.haze * gaussian_filter(out, 3.0 / voxel)
    return out


def recorded(bodies, light, *, n_frames, rng, dust=(), radius_spread=0.0):
    """Return the movie (T, z, y, x) as the camera writes it."""
    image, images = image_of(light), None
    if radius_spread:
        n = sum(len(b.bright) for b in bodies)
        sizes = DIAMETER * (1 + radius_spread * rng.normal(size=n))
        images = [image_of(light, diameter=size) for size in sizes]
    camera = Camera(light, rng)
    depth = 1 - light.depth_loss * np.arange(light.shape[0]) / max(light.shape[0] - 1, 1)
    movie = np.empty((n_frames, *light.shape), dtype="uint8" if light.bits == 8 else "uint16")
    for i in range(n_frames):
        left = (1 - light.bleached) ** (i / max(n_frames - 1, 1))
        lift = rng.normal(0, light.stage_noise) if light.stage_noise else 0.0
        mean = (
            light.photons
            * left
            * exposed(bodies, light, frame=i, image=image, dust=dust, images=images, lift=lift)
        )
        mean = mean * depth[:, None, None] + light.background
        movie[i] = camera.grey_levels(mean)
    return movie


class Camera:
    """The detector, with a pattern of its own, and what is done to an image before it is saved."""

    def __init__(self, light, rng):
        self.light, self.rng = light, rng
        size = light.shape[1:]
        self.gain = light.gain * (1 + light.pixel_spread * rng.normal(size=size))
        self.offset, self.noise = light.offset, light.read_noise
        # Cases without these keep their random numbers.
        if light.pixel_offset:
            self.offset = self.offset + light.pixel_offset * rng.normal(size=size)
        if light.pixel_noise:
            self.noise = self.noise * np.exp(light.pixel_noise * rng.normal(size=size))

    def grey_levels(self, mean):
        """Return a frame (z, y, x) as it is saved."""
        light, rng = self.light, self.rng
        if light.curved:
            place = np.stack(np.meshgrid(*(np.linspace(-1, 1, n) for n in light.shape[1:])))
            mean = mean + light.curved * np.exp(-0.5 * np.sum(place**2, axis=0) / (2 / 3) ** 2)
        if light.line_flicker:
            mean = mean * (1 + light.line_flicker * rng.normal(size=(*light.shape[:2], 1)))
        if light.plane_flicker:
            mean = mean * (1 + light.plane_flicker * rng.normal(size=(light.shape[0], 1, 1)))
        photons = rng.poisson(np.maximum(mean, 0))
        grey = self.gain * photons + rng.normal(0, 1, light.shape) * self.noise + self.offset
        if light.smooth:
            grey = gaussian_filter(grey, light.smooth)
        grey = np.clip(np.round(grey), 0, 2**light.bits - 1)
        return np.stack([compressed(plane, light.jpeg) for plane in grey]) if light.jpeg else grey


def compressed(plane, quality):
    """Return a plane of 8 bits as a JPEG file holds it."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(plane.astype("uint8")).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file), dtype=float)


def ring_movie(*, n_frames, rng, rim=0.75):
    """Return a movie (T, 1, y, x) of four planar trimers in bright field, and their paths.

    A sphere is a dark rim, at a share of its radius, with a bright middle on a bright background.
    """
    shape = SHAPES[3][:, :2] * DIAMETER
    field, pixel, size = 40.0, 0.2, 200
    place = np.array([[10.0, 10.0], [30.0, 10.0], [10.0, 30.0], [30.0, 30.0]])
    place += rng.uniform(-2, 2, place.shape)
    turn = rng.uniform(0, 2 * np.pi, 4)
    paths, movie = [], np.empty((n_frames, 1, size, size), dtype=np.uint8)
    y, x = np.mgrid[:size, :size] * pixel
    for i in range(n_frames):
        cos, sin = np.cos(turn), np.sin(turn)
        spin = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
        spheres = place[:, None] + np.einsum("bij,nj->bni", spin, shape)
        paths.append(spheres)
        mean = np.full((size, size), 40.0)
        for a, b in spheres.reshape(-1, 2):
            r = np.hypot(x - a, y - b)
            mean -= 22.0 * np.exp(-(((r - rim * DIAMETER / 2) / 0.25) ** 2) / 2)
            mean += 8.0 * np.exp(-((r / 0.5) ** 2) / 2)
        movie[i, 0] = np.clip(3.0 * rng.poisson(np.maximum(mean, 2.0)) + 10.0, 0, 255)
        place = place + rng.normal(0, np.sqrt(2 * D_T * DT), place.shape)
        place = np.clip(place, 4.0, field - 4.0)
        turn = turn + rng.normal(0, np.sqrt(2 * 3 * D_R * DT), 4)
    return movie, np.array(paths).swapaxes(0, 1)


def plane_times(light, n_frames):
    """Return the times at which bodies are needed: of each frame, or of each of its planes."""
    frames = np.arange(n_frames) * DT
    if light.plane_time == 0:
        return frames
    return (frames[:, None] + np.arange(light.shape[0]) * light.plane_time).ravel()


@dataclass(frozen=True)
class Case:
    """A movie: what is in it, through which microscope, and how it is analysed."""

    kinds: tuple = (4, 4, 4, 4)
    light: Microscope = Microscope()
    bright: tuple | None = None
    walls: float = DIAMETER
    jump: float = 0.0  # um, of everything, before frame 10
    dust: int = 0
    radius_spread: float = 0.0  # relative, from sphere to sphere; contacts stay those of equal ones
    n_frames: int = 20
    beads: bool = False  # the point spread is measured on a stack of beads of 0.1 um
    shift: tuple = ()  # x, y, z, um: every other sphere is in a second channel, with this offset
    options: dict = field(default_factory=dict)


def monomers(share, light):
    """Return how many single spheres fill a share of the volume of the field."""
    return round(share * np.prod(light.box) / (np.pi / 6 * DIAMETER**3))


BASE = Microscope()
# A camera chip whose pixels differ in read noise.
SCMOS = {"offset": 30.0, "read_noise": 2.0, "pixel_noise": 0.5, "bits": 16}
CASES = {
    "base": Case(),
    "planes 18 ms": Case(light=replace(BASE, plane_time=0.018)),
    "planes 5 ms": Case(light=replace(BASE, plane_time=0.005)),
    "bleaching 95 %": Case(light=replace(BASE, bleached=0.95)),
    "monomers 10 %": Case((4, 4, 4) + (1,) * monomers(0.10, BASE), walls=DIAMETER / 2),
    "monomers 25 %": Case((4, 4, 4) + (1,) * monomers(0.25, BASE), walls=DIAMETER / 2),
    "monomers alone": Case((1,) * 60, walls=DIAMETER / 2),
    "dust": Case(dust=14),
    "monomers, dimers": Case((4, 4, 4, 4, 2, 2, 2, 1, 1, 1, 1, 1)),
    "mixture": Case((2, 2, 3, 3, 4, 4, 6, 6)),
    "dimers": Case((2, 2, 2, 2, 2)),
    "one undyed": Case(bright=((0, 1, 1, 1), (1, 1, 1, 1), (1, 1, 1, 1), (1, 1, 1, 1))),
    "one at 12 %": Case(bright=((0.12, 1, 1, 1), (1, 1, 1, 1), (1, 1, 1, 1), (1, 1, 1, 1))),
    "entering": Case((4,) * 5, walls=-0.4 * DIAMETER),
    "stage jump 1.2 um": Case(jump=1.2),
    "stage jump 2 um": Case(jump=2.0),
    "confocal": Case(light=replace(BASE, psf="confocal")),
    "confocal, beads": Case(light=replace(BASE, psf="confocal"), beads=True),
    "confocal, 200 photons": Case(light=replace(BASE, psf="confocal", photons=200, bits=16)),
    "radii spread by 5 %": Case(radius_spread=0.05),
    "radii spread by 8 %": Case(radius_spread=0.08),
    "shells": Case(light=replace(BASE, shell=True)),
    "Lorentzian tails": Case(light=replace(BASE, psf="tails")),
    "tilted axis": Case(light=replace(BASE, tilt=20.0)),
    "astigmatism and coma": Case(
        light=replace(BASE, psf="lens", lens=Lens(astigmatism=0.1, coma=0.1))
    ),
    "pinhole of 2 Airy units": Case(light=replace(BASE, psf="lens", pinhole=2.0)),
    "pinhole of 4 Airy units": Case(light=replace(BASE, psf="lens", pinhole=4.0)),
    "index 1.42 at the cover glass": Case(
        light=replace(BASE, psf="lens", lens=Lens(index=1.518, medium=1.42), cover=0.0)
    ),
    "index 1.33 at the cover glass": Case(
        light=replace(BASE, psf="lens", lens=Lens(index=1.518, medium=1.33), cover=0.0)
    ),
    "index 1.33, 20 um deep": Case(
        light=replace(BASE, psf="lens", lens=Lens(index=1.518, medium=1.33), cover=20.0)
    ),
    "widens with depth": Case(
        light=replace(BASE, blur=(0.3, 0.15), last_blur=(0.42, 0.15), depth_loss=0.2)
    ),
    "widens much with depth": Case(
        light=replace(BASE, blur=(0.3, 0.15), last_blur=(0.8, 0.2), depth_loss=0.2)
    ),
    "widefield": Case(light=replace(BASE, psf="widefield")),
    "haze": Case(light=replace(BASE, haze=2.0)),
    "light sheet tilted by 20 degrees": Case(
        light=replace(BASE, blur=(1.0, 0.15), sheet=0.4, tilt=20.0)
    ),
    "light sheet tilted by 45 degrees": Case(
        light=replace(BASE, blur=(1.0, 0.15), sheet=0.4, tilt=45.0)
    ),
    "stage noise": Case(light=replace(BASE, stage_noise=0.115)),
    "two colours": Case((4, 4, 4, 3, 3), shift=(0.12, -0.09, 0.2)),
    "5 photons": Case(light=replace(BASE, photons=5)),
    "sCMOS mild": Case(light=replace(BASE, **SCMOS, pixel_spread=0.03, pixel_offset=2.0)),
    "sCMOS strong": Case(light=replace(BASE, **SCMOS, pixel_spread=0.1, pixel_offset=8.0)),
    "sCMOS strong, 10 photons": Case(
        light=replace(BASE, **SCMOS, pixel_spread=0.1, pixel_offset=8.0, photons=10)
    ),
    "saturation": Case(light=replace(BASE, photons=110.0)),
    "clipped at zero": Case(light=replace(BASE, offset=-12.0)),
    "JPEG 75": Case(light=replace(BASE, jpeg=75)),
    "JPEG 20": Case(light=replace(BASE, jpeg=20)),
    "smoothing": Case(light=replace(BASE, smooth=0.8)),
    "line flicker 10 %": Case(light=replace(BASE, line_flicker=0.1)),
    "line flicker 30 %": Case(light=replace(BASE, line_flicker=0.3)),
    "plane flicker 5 %": Case(light=replace(BASE, plane_flicker=0.05)),
    "plane flicker 20 %": Case(light=replace(BASE, plane_flicker=0.2)),
    "curved background": Case(light=replace(BASE, curved=20.0)),
    "realistic": Case(
        light=replace(
            BASE, psf="confocal", bleached=0.28, plane_time=0.008, pixel_spread=0.03,
            depth_loss=0.1, read_noise=2.0,
        )
    ),
}  # fmt: skip


def drawn(case, seed):
    """Return the movie of a case, and its bodies with their paths."""
    rng = np.random.default_rng(seed)
    light = case.light
    specks = specks_of(case, rng)
    where = {"rng": rng, "walls": case.walls, "fixed": specks}
    bodies = scene(case.kinds, light.box, bright=case.bright, **where)
    diffuse(bodies, plane_times(light, case.n_frames), light.box, **where)
    per = light.shape[0] if light.plane_time else 1
    for b in (*bodies, *specks):
        b.path[10 * per :, :, 0] += case.jump
    settings = {"n_frames": case.n_frames, "rng": rng, "dust": specks}
    settings["radius_spread"] = case.radius_spread
    if not case.shift:
        return recorded(bodies, light, **settings), bodies
    channels = [
        [
            replace(b, path=b.path + k * np.array(case.shift), bright=b.bright * (odd == k))
            for b, odd in ((b, np.arange(len(b.bright)) % 2) for b in bodies)
        ]
        for k in (0, 1)
    ]
    return [recorded(channel, light, **settings) for channel in channels], bodies


def specks_of(case, rng):
    """Return dust: lumps of balls that overlap, brighter than spheres, and stuck where they are."""
    specks = []
    for _ in range(case.dust):
        n = int(rng.integers(1, 5))
        spread = rng.uniform(0.1, 0.7) * DIAMETER
        shape = rng.normal(0, spread / 2, (n, 3)) * rng.uniform(0.3, 1.5, 3)
        place = rng.uniform(0, case.light.box)
        count = len(plane_times(case.light, case.n_frames))
        path = np.repeat((place + shape)[None], count, axis=0)
        bright = rng.uniform(0.3, 2.5, n)
        specks.append(Body(shape, place, Rotation.identity(), bright, path))
    return specks


def instants(body, case, plane=None):
    """Return positions (T, n, 3) of a body at the instant of one plane; default: the middle."""
    planes = case.light.shape[0]
    if not case.light.plane_time:
        return body.path
    return body.path[(planes // 2 if plane is None else plane) :: planes]


def true_report(bodies, case):
    """Return the report of the same estimators for the true positions at one instant."""
    import pandas as pd

    import perrin

    tables, first = [], 0
    for c, body in enumerate(bodies):
        x = instants(body, case)
        inside = np.all((x > 0) & (x < case.light.box), axis=2).sum(axis=1)
        x = x - np.where(np.arange(len(x)) < 10, 0.0, case.jump)[:, None, None] * [1.0, 0.0, 0.0]
        seen = np.flatnonzero(inside >= min(3, x.shape[1]))
        if len(seen):
            table = perrin.positions_table(x[seen], frames=seen).assign(cluster=c)
            table["particle"] += first
            tables.append(table)
        first += len(body.shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return perrin.analyze(pd.concat(tables, ignore_index=True), dt=DT)


def analysed(movie, case):
    """Return perrin's report of a movie."""
    import perrin

    light = case.light
    movies = movie if isinstance(movie, list) else [movie]
    scale = {"voxel": light.voxel, "dt": DT, "plane_time": light.plane_time or None}
    stack = [perrin.open_stack(one, **scale) for one in movies]
    options = {"contact": DIAMETER} | case.options
    if case.beads:
        options["psf"] = measured_psf(light)
    return perrin.analyze_stack(stack, diameter=DIAMETER, **options)


def measured_psf(light):
    """Return the point spread that perrin measures on nine beads, with the voxels of the movie."""
    import perrin

    fine = replace(light, shape=(26, 50, 50), photons=1000.0, bits=16)
    bead = blurred_ball(fine, grid=0.04, diameter=0.1)
    places = [[x + 0.03 * y, y, 3.0 + 0.02 * x] for x in (1.9, 5.0, 8.1) for y in (1.9, 5.0, 8.1)]
    bodies = [
        Body(np.zeros((1, 3)), np.array(x), Rotation.identity(), np.ones(1), np.array([[x]]))
        for x in places
    ]
    rng = np.random.default_rng(0)
    light = exposed(bodies, fine, frame=0, image=lambda _: bead)
    mean = fine.photons * light + fine.background
    grey = fine.gain * rng.poisson(mean) + rng.normal(0, fine.read_noise, fine.shape)
    stack = perrin.open_stack(np.round(np.clip(grey, 0, None))[None], voxel=fine.voxel, dt=1.0)
    return perrin.measure_point_spread(stack, diameter=0.1)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument("--movies", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--warnings", action="store_true", help="print the warnings of each run")
    args = parser.parse_args()
    for name, case in CASES.items():
        if args.only in name:
            rows = []
            for seed in range(args.seed, args.seed + args.movies):
                rows += run_movie(name, case, seed, told=args.warnings)
            if args.movies > 1:
                print_summary(name, rows, args.movies)
    if args.only in "bright field":
        for seed in range(args.seed, args.seed + args.movies):
            for dark in (True, False):
                run_rings(seed, dark=dark)


def run_movie(name, case, seed, *, told):
    """Print the results of one movie, and return a list of its numbers; [] if it is refused."""
    begun = time.process_time()
    movie, bodies = drawn(case, seed)
    print(name, seed, f"drawn in {time.process_time() - begun:.1f} s", flush=True)
    begun = time.process_time()
    try:
        report = analysed(movie, case)
    except Exception as error:  # a refusal is a result here
        print(f"  refused: {error}")
        return []
    row = print_case(report, bodies, case, seconds=time.process_time() - begun)
    for text in report.warnings if told else []:
        print("   !", text[:300])
    return [row]


def run_rings(seed, *, dark):
    """Print clusters and warnings of a bright-field movie of rings."""
    import perrin

    movie, _ = ring_movie(n_frames=40, rng=np.random.default_rng(seed))
    stack = perrin.open_stack(movie, voxel=(0.2, 0.2), dt=DT)
    print("bright field", seed, "with dark=True" if dark else "without dark", flush=True)
    try:
        report = perrin.analyze_stack(stack, diameter=DIAMETER, contact=DIAMETER, dark=dark)
    except Exception as error:  # a refusal is a result here
        print(f"  refused: {error}")
        return
    print(f"  {len(report.imaging.features)} of 480 spheres, {len(report.clusters)} of 4 clusters")
    for text in report.warnings:
        print("   !", text[:120])


def print_summary(name, rows, count):
    """Print means over movies, with their Monte-Carlo errors."""
    print(f"{name}: means of {len(rows)} of {count} movies")
    for key in dict.fromkeys(k for row in rows for k in row):
        values = np.array([row[key] for row in rows if key in row and np.isfinite(row[key])])
        if len(values) > 1:
            print(f"  {key} {values.mean():.3f} +- {values.std(ddof=1) / len(values) ** 0.5:.3f}")


def places_in(bodies, case, frame):
    """Return the true positions (n, 3) of all spheres when they are recorded, and their light."""
    places, light, per = [], [], case.light.shape[0]
    for b in bodies:
        for j in range(len(b.shape)):
            if case.light.plane_time:
                # The instant at which the scan reaches the sphere.
                own = b.path[frame * per : (frame + 1) * per, j]
                heights = np.arange(per) * case.light.voxel[0]
                places.append(own[np.abs(own[:, 2] - heights).argmin()])
            else:
                places.append(b.path[frame, j])
            light.append(b.bright[j])
    return np.array(places), np.array(light)


def place_errors(report, bodies, case):
    """Return the errors (k, 3) of places, the stated ones, and counts.

    The counts are those of the spheres in the field, of missed and of false ones, and of false ones
    in clusters. What the fits found to be no sphere is not used.
    """
    x, stated, counts = [np.empty((0, 3))], [np.empty((0, 3))], np.zeros(4, dtype=int)
    table = report.imaging.features
    if "refined" in table:
        table = table[table["refined"] | table["chi2"].isna()]
    for i in range(case.n_frames):
        part = table[table["frame"] == i]
        places, light = places_in(bodies, case, i)
        inside = np.all((places > 0) & (places < case.light.box), axis=1) & (light > 0)
        away = cdist(part[["x", "y", "z"]].to_numpy(), places)
        good = away.min(axis=1) < DIAMETER / 4
        met = away.min(axis=0, initial=np.inf) <= DIAMETER / 4
        owned = (part["cluster"] >= 0).to_numpy()
        counts += [inside.sum(), (inside & ~met).sum(), (~good).sum(), (owned & ~good).sum()]
        x.append((part[["x", "y", "z"]].to_numpy() - places[away.argmin(axis=1)])[good])
        stated.append(part.loc[good, ["sigma_x", "sigma_y", "sigma_z"]].to_numpy())
    return np.concatenate(x), np.concatenate(stated), counts.tolist()


def print_case(report, bodies, case, *, seconds):
    """Print how a report compares with the truth, and return the numbers of the summary."""
    rigid = [b for b in bodies if len(b.shape) >= 2]
    error, stated, (n, missed, false, owned) = place_errors(report, bodies, case)
    off = error - np.median(error, axis=0)
    sd, said = (
        1e3 * np.sqrt(np.mean(off**2, axis=0)),
        1e3 * np.sqrt(np.nanmedian(stated**2, axis=0)),
    )
    row = {"missed": missed / n, "false": false / n, "false in clusters": owned / n}
    row |= {"place (error/stated)^2": float(np.nanmean((off / stated) ** 2)), "seconds": seconds}
    print(f"  {n} spheres: {missed} missed, {false} false ({owned} in clusters);", end=" ")
    print(f"sd {sd.round(1)}, stated {said.round(1)} nm; {seconds:.1f} s")
    print_singles(report, [b for b in bodies if len(b.shape) == 1], case)
    if not rigid:
        print(f"  no body was planted; {len(report.clusters)} clusters, {len(report.rods)} rods")
        return row | {"false clusters": len(report.clusters)}
    true = true_report(rigid, case)
    pairs, others = matched(report, rigid, case)
    sizes = [len(rigid[c].shape) for c in pairs]
    row |= {"clusters found": len(pairs) / len(rigid), "false clusters": len(others)}
    print(f"  clusters: {len(pairs)} of {len(rigid)} found (sizes {sizes}),", end=" ")
    print(f"{len(others)} false, {len(report.rods)} rods")
    apart = distance_of_touching(report, case)
    if np.isfinite(apart):
        row["distances (%)"] = apart
        print(f"  distances of touching spheres {apart:+.2f} %")
    turns = [
        turn_errors(result, rigid[c], case)
        for c, result in pairs.items()
        if len(rigid[c].shape) > 2
    ]
    if turns:
        turn, square = (np.concatenate(part) for part in zip(*turns, strict=True))
        row["turn (error/stated)^2"] = float(np.mean(square))
        print(f"  turn errors {np.sqrt(np.mean(turn**2, axis=0)).round(1)} mrad,", end=" ")
        print(f"(error/stated)^2 {np.mean(square):.2f}, median {np.median(square):.2f}")
    known = {r.cluster: r for r in true.results}
    for c, result in pairs.items():
        if c in known:
            print(f"  body {c}:", compared(result, known[c])[0])
    if report.pooled is not None and true.pooled is not None:
        text, numbers = compared(report.pooled, true.pooled)
        print("  pooled:", text)
        row |= numbers
    for kind in report.kinds:
        for other in true.kinds:
            if (kind.size, kind.point_group) == (other.size, other.point_group):
                print(f"  {kind.name} ({len(kind.clusters)}):", end=" ")
                print(compared_values(dict(kind.coefficients), dict(other.coefficients))[0])
    return row


def distance_of_touching(report, case):
    """Return how much longer the distances of touching spheres are than planted, in percent."""
    table, away = report.imaging.features, []
    if "refined" in table:
        table = table[table["refined"]]
    for _, part in table[table["cluster"] >= 0].groupby(["frame", "cluster"]):
        x = cdist(*[part[["x", "y", "z"]].to_numpy()] * 2)[np.triu_indices(len(part), 1)]
        away.append(x[x < 1.2 * DIAMETER])
    away = np.concatenate(away) if away and not case.shift else np.empty(0)
    return 100 * (away.mean() / DIAMETER - 1) if away.size else np.nan


def print_singles(report, singles, case):
    """Print D_T of single spheres against that of their true positions."""
    import pandas as pd

    from perrin import Noise
    from perrin.run.experiment import Recording
    from perrin.run.singles import measure_singles

    if not singles or report.singles is None:
        return
    x = np.concatenate([instants(b, case)[:, 0] for b in singles])
    table = pd.DataFrame(x, columns=["x", "y", "z"])
    frame, particle = np.indices((case.n_frames, len(singles)))
    table = table.assign(frame=frame.T.ravel(), particle=particle.T.ravel())
    true = measure_singles(table, Noise(), Recording(dt=DT))
    one = compared_values({"D_T": report.singles.D_T}, {"D_T": true.D_T})
    print(f"  single spheres ({report.singles.n_tracks} tracks of {len(singles)}):", one[0])


def compared(found, true):
    """Return D_R and D_T against the truth in its standard errors, and the ratio of errors."""
    names = [name for name in ("D_R", "D_perp", "D_T") if getattr(found, name, None) is not None]
    return compared_values(*({name: getattr(one, name) for name in names} for one in (found, true)))


def compared_values(found, true):
    """Return the comparison of each coefficient, by name, with the true one, and its numbers."""
    texts, numbers = [], {}
    for name in found:
        one, other = found[name], true[name]
        off, ratio = (one.value - other.value) / other.stderr, one.stderr / other.stderr
        texts.append(f"{name} {one.value:.5f} ({off:+.2f} errors, error x {ratio:.2f})")
        numbers |= {f"{name} off (errors)": off, f"{name} error ratio": ratio}
    return "; ".join(texts), numbers


def rows_of(result):
    """Return the frame of each row of a result's motion."""
    return np.rint(result.motion.time / DT).astype(int)


def matched(report, bodies, case):
    """Return {planted body: result} and the results that are no planted body."""
    pairs, others = {}, []
    for result in report.results:
        rows = rows_of(result)
        away = [
            np.nanmedian(
                np.linalg.norm(instants(b, case).mean(axis=1)[rows] - result.motion.center, axis=1)
            )
            for b in bodies
        ]
        best = int(np.argmin(away))
        if away[best] < DIAMETER / 4 and best not in pairs:
            pairs[best] = result
        else:
            others.append(result)
    return pairs, others


def orientations(body, case):
    """Return the true orientations (T) of a body when its own planes are recorded."""
    shape, planes = body.shape - body.shape.mean(axis=0), case.light.shape[0]

    def turned(x):
        return Rotation.concatenate(
            [Rotation.align_vectors(p - p.mean(axis=0), shape)[0] for p in x]
        )

    if not case.light.plane_time:
        return turned(body.path)
    # The instant of a pose is the mean time of the spheres, between those of two planes.
    first = np.arange(case.n_frames) * planes
    height = np.full(case.n_frames, planes / 2)
    for _ in range(3):
        at = np.clip(height, 0, planes - 1.001)
        height = body.path[first + at.astype(int), :, 2].mean(axis=1) / case.light.voxel[0]
    low = np.clip(height, 0, planes - 1.001).astype(int)
    before, after = turned(body.path[first + low]), turned(body.path[first + low + 1])
    between = (before.inv() * after).as_rotvec() * (height - low)[:, None]
    return before * Rotation.from_rotvec(between)


def turn_errors(result, body, case):
    """Return errors (T, 3) of the orientation against the true one, mrad.

    Also the mean squared ratios (T,) of these errors to the stated ones, of three components.
    """
    true = orientations(body, case)[rows_of(result)]
    fitted = np.isfinite(result.motion.rotation).all(axis=(1, 2))
    apart = true[fitted].inv() * Rotation.from_matrix(result.motion.rotation[fitted])
    mean = apart.mean()
    error = (apart * mean.inv()).as_rotvec()
    axes = mean.as_matrix()
    stated = axes @ result.motion.covariance[fitted] @ axes.T
    square = np.einsum("ti,tij,tj->t", error, np.linalg.pinv(stated), error) / 3
    return 1e3 * error, square


if __name__ == "__main__":
    main()
