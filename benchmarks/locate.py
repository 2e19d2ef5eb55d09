"""Spheres in simulated images: errors of positions, their limit by photon noise, and speed.

Touching tetrahedra at random poses, one a frame, drawn by brute force: balls on a grid four times
finer than the voxels, blurred there, averaged over voxels; nothing is shared with the model that is
fitted. Balls 2.45 um, voxel 0.25 x 0.2 x 0.2 um (z, y, x), point spread 0.4 and 0.15 um, background
2 to 6 photons with a gradient along x, gain 3, read noise 2, 8 % spread of brightness, 15 % depth
loss, 30 % bleaching over the movie, 8 bits. Point spread, gain and background are unknown to the
fit, and the diameter given is 3 % wrong. Positions are compared after subtraction of the constant
offset, which is printed. The floor is the Fisher information of the brute-force image, by finite
differences, with brightness and a flat background free.

With --core the spheres are core-shell: only a core of that diameter, um, is fluorescent.

Usage: python benchmarks/locate.py [--frames 60] [--photons 40] [--core 1.2] [--seed 0]
"""

import argparse
import time

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.distance import cdist

import perrin
from perrin.geometry.rotations import exp_map, log_map
from perrin.images.optics.window_fit import FreeCenters, cut_window, fit_window
from perrin.images.spheres.by_trackpy import refine_by_trackpy
from perrin.images.spheres.localisation import Search, choose_method, sample_frames
from perrin.images.spheres.spots import at_contact

VOXEL = np.array([0.25, 0.2, 0.2])
PSF = np.array([0.4, 0.15, 0.15])
DIAMETER, GAIN, READ, FINE = 2.45, 3.0, 2.0, 4
SHAPE = (42, 44, 44)
BODY = perrin.Cluster.touching(4, DIAMETER)


class Movie:
    """Frames in memory."""

    def __init__(self, frames):
        self.frames = np.asarray(frames)
        self.shape, self.voxel = self.frames.shape, tuple(VOXEL)

    def frame(self, i):
        """Return frame i."""
        return self.frames[i]


def rendered(places, brightness, fluorescent, depth_loss=0.15):
    """Return the photons of balls of diameter `fluorescent` at positions (n, 3), x, y, z in um."""
    grid = [
        ((np.arange(n * FINE) + 0.5) / FINE - 0.5) * h for n, h in zip(SHAPE, VOXEL, strict=True)
    ]
    photons = np.zeros([n * FINE for n in SHAPE], dtype=np.float32)
    for (x, y, z), bright in zip(places, brightness, strict=True):
        r2 = ((grid[0] - z) ** 2)[:, None, None] + ((grid[1] - y) ** 2)[:, None]
        r = np.sqrt(r2 + (grid[2] - x) ** 2)
        photons += bright * np.clip((fluorescent / 2 - r) / 0.05 + 0.5, 0, 1)
    # Across the whole of a stack of 64 planes.
    photons *= (1 - depth_loss * grid[0] / 16)[:, None, None]
    blurred = gaussian_filter(photons, PSF / VOXEL * FINE, truncate=5)
    return blurred.reshape([k for n in SHAPE for k in (n, FINE)]).mean(axis=(1, 3, 5))


def simulated(n_frames, photons, fluorescent, rng):
    """Return a movie, its rotations and its true positions."""
    rotation = exp_map(rng.normal(size=(n_frames, 3)) * 2)
    middle = VOXEL[::-1] * (np.array(SHAPE[::-1]) / 2) + rng.uniform(-0.1, 0.1, (n_frames, 3))
    places = middle[:, None] + np.einsum("tij,nj->tni", rotation, BODY.positions)
    own = photons * (1 + 0.08 * rng.normal(size=4))
    background = 2 + 4 * np.arange(SHAPE[2]) / 256
    frames = []
    for i, where in enumerate(places):
        expected = rendered(where, own * (1 - 0.3 * i / n_frames), fluorescent) + background
        grey = GAIN * rng.poisson(expected) + rng.normal(0, READ, SHAPE)
        frames.append(np.clip(np.round(grey), 0, 255).astype(np.uint8))
    return Movie(frames), rotation, places


def numerical_floor(places, photons, fluorescent):
    """Return standard errors: of free centres (rms of the spheres), and of the pose first six."""
    step = 0.02
    base = rendered(places, np.full(4, photons), fluorescent)
    slopes = []
    for i in range(4):
        for axis in range(3):
            shift = np.zeros((4, 3))
            shift[i, axis] = step
            up, down = (
                rendered(places + s * shift, np.full(4, photons), fluorescent) for s in (1, -1)
            )
            slopes.append((up - down) / (2 * step))
    columns = [rendered(places[[i]], np.ones(1), fluorescent) for i in range(4)] + [np.ones(SHAPE)]
    jacobian = np.array([c.ravel() for c in slopes + columns]) * GAIN
    weight = 1 / (GAIN**2 * (base + 4) + READ**2).ravel()
    arm = places - places.mean(axis=0)
    turn = np.stack([np.cross(axis, arm) for axis in np.eye(3)]).reshape(3, 12)
    rigid = np.concatenate([np.tile(np.eye(3), 4), turn]) @ jacobian[:12]
    free = errors(jacobian, weight)[:12].reshape(4, 3)
    return np.sqrt(np.mean(free**2, axis=0)), errors(np.concatenate([rigid, jacobian[12:]]), weight)


def errors(jacobian, weight):
    return np.sqrt(np.diag(np.linalg.inv((jacobian * weight) @ jacobian.T)))


def in_true_order(table, places):
    """Return located positions in the order of the true ones; NaN where four were not found."""
    found = np.full_like(places, np.nan)
    for i, truth in enumerate(places):
        part = table.loc[table["frame"] == i, ["x", "y", "z"]].to_numpy()
        nearest = cdist(truth, part).argmin(axis=1)
        if len(part) == 4 and len(set(nearest)) == 4:
            found[i] = part[nearest]
    return found


def timed(work, items):
    """Return the median seconds of one piece of work."""
    seconds = []
    for item in items:
        start = time.perf_counter()
        work(item)
        seconds.append(time.perf_counter() - start)
    return np.median(seconds)


def report(name, found, places):
    e = 1e3 * (found - places)
    line = np.concatenate([np.nanmean(e, axis=(0, 1)), np.nanstd(e, axis=(0, 1))])
    missed = np.isnan(e[:, 0, 0]).sum()
    print(f"{name:24s}" + "".join(f"{v:8.2f}" for v in line) + f"{missed:8d}")


def pose_errors(motion, rotation, places):
    """Return errors of centres (T, 3), nm, and of orientations (T, 3), mrad, constant parts off."""
    gauge = perrin.kabsch(motion.template, BODY.positions)
    turn = log_map(motion.rotation @ gauge @ np.swapaxes(rotation, 1, 2))
    off = motion.center - places.mean(axis=1)
    return 1e3 * (off - np.nanmean(off, axis=0)), 1e3 * turn


def print_speed(movie, table, optics, fluorescent):
    """Print the time of one cluster's refinement in one frame, by the model and by trackpy."""
    image = optics.image(movie.voxel)
    contact = {"contact": DIAMETER}

    def start(i):
        return table.loc[table["frame"] == i, ["z", "y", "x"]].to_numpy()

    def model(i):
        near, frame = at_contact(start(i), **contact), movie.frame(i).astype(float)
        window = cut_window(frame, image, near, others=np.empty((0, 3)))
        fit_window(window, image, optics.noise, FreeCenters(near))

    def discs(i):
        frame, near = movie.frame(i).astype(float), at_contact(start(i), **contact)
        refine_by_trackpy(frame, near, diameter=fluorescent, voxel=movie.voxel, **contact)

    count = range(min(10, len(movie.frames)))
    own, theirs = timed(model, count), timed(discs, count)
    print(
        f"per cluster-frame: model {own * 1e3:.0f} ms, trackpy's discs {theirs * 1e3:.0f} ms, ",
        end="",
    )
    print(f"ratio {own / theirs:.2f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--photons", type=float, default=40.0)
    parser.add_argument("--core", type=float, default=DIAMETER)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    movie, rotation, places = simulated(args.frames, args.photons, args.core, rng)
    search = {"diameter": 1.03 * args.core, "contact": DIAMETER}
    options = Search(**search)
    sample = sample_frames(movie, options, range(args.frames))
    optics = choose_method(movie, options, sample).optics
    print(optics)
    # Bleaching takes 15 % on average, depth 9 %.
    floor, rigid = numerical_floor(places[0], 0.85 * args.photons, args.core)
    print(f"{'nm':24s}{'offset x, y, z':>24s}{'sd x, y, z':>24s}{'lost':>8s}")
    tables = {r: perrin.locate(movie, refine=r, **search) for r in (None, "trackpy")}
    tables["model"] = perrin.locate(movie, optics=optics, **search)
    for name, table in tables.items():
        report(str(name), in_true_order(table, places), places)
    stated = tables["model"][["sigma_x", "sigma_y", "sigma_z"]].pow(2).mean().pow(0.5) * 1e3
    print("stated (Fisher)", stated.round(2).tolist(), "floor", (1e3 * floor).round(2))
    found = in_true_order(tables["model"], places)
    free = perrin.track_rotation(found, dt=1.0)
    posed = perrin.fit_pose(movie, free, optics=optics)
    for name, motion in (("free centres", free), ("pose in the image", posed)):
        center, turn = pose_errors(motion, rotation, places)
        spread = [np.nanstd(e, axis=0).round(2) for e in (center, turn)]
        print(f"{name}: centre {spread[0]} nm, turn {spread[1]} mrad")
    print("floor of the pose", (1e3 * rigid[:6]).round(2))
    print_speed(movie, tables[None], optics, args.core)


if __name__ == "__main__":
    main()
