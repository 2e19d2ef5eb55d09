"""Crowds of touching spheres in rendered images: missed and false ones, errors, and speed.

Random packings of 2.45 um balls, pushed apart until they overlap by at most 3 %, one a frame; voxel
0.25 x 0.2 x 0.2 um (z, y, x), point spread 0.4 and 0.15 um, 40 photons, 8 % spread of brightness,
15 % depth loss, uneven background, gain 3, read noise 2. With --cut the stack ends within the
packing on all sides, and the images of spheres beyond its border reach into it. Given are a
diameter 3 % wrong and the contact distance. Errors are those about their mean; the stated ones
(Fisher) are the limit by photon noise.

Usage: python benchmarks/crowd.py [--spheres 36] [--crowds 4] [--cut] [--seed 0]
"""

import argparse
import time

import numpy as np
from scipy.spatial.distance import cdist

import perrin
from perrin.images.spheres.localisation import Search, choose_method, sample_frames

DIAMETER = 2.45
VOXEL = np.array([0.25, 0.2, 0.2])


def packed(n, rng):
    """Throw balls into a box of twice their volume and push them apart."""
    x = DIAMETER * n ** (1 / 3) * rng.random((n, 3))
    for _ in range(3000):
        apart = x[:, None] - x
        distance = np.linalg.norm(apart, axis=2) + np.diag(np.full(n, np.inf))
        overlap = np.maximum(DIAMETER - distance, 0)
        if overlap.max() < 0.03 * DIAMETER:
            break
        x += 0.4 * np.sum(apart * (overlap / distance)[..., None], axis=1)
    return x - x.min(axis=0)


def rendered(places, margin, seed):
    """Return the movie of one frame that ends `margin` um beyond the outer centres."""
    places = places + margin
    shape = tuple(np.ceil((places.max(axis=0)[::-1] + margin) / VOXEL).astype(int).tolist())
    movie = perrin.render_stack(
        places[None], voxel=VOXEL, shape=shape, diameter=DIAMETER, psf=(0.4, 0.15, 0.15),
        photons=40, spread=0.08, depth_loss=0.15, background=4, gradient=(0, 0, 0.08), gain=3,
        read_noise=2, rng=seed,
    )  # fmt: skip
    end = (np.array(shape[::-1]) - 1) * VOXEL[::-1]
    return movie, places[np.all((places >= 0) & (places <= end), axis=1)]


def errors(table, places):
    """Return missed, false, and the errors (n, 3) of the others, nm."""
    found = table[["x", "y", "z"]].to_numpy()
    distance = cdist(places, found)
    met = distance.min(axis=1) < DIAMETER / 4
    off = found[distance.argmin(axis=1)] - places
    return np.sum(~met), len(found) - np.sum(met), 1e3 * off[met]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--spheres", type=int, default=36)
    parser.add_argument("--crowds", type=int, default=4)
    parser.add_argument("--cut", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    rng = np.random.default_rng(args.seed)
    asked = {"diameter": 1.03 * DIAMETER, "contact": DIAMETER}
    lost, off, stated, seconds = {None: [], "model": []}, {None: [], "model": []}, [], []
    for _ in range(args.crowds):
        places = packed(args.spheres, rng)
        movie, places = rendered(places, -1.2 if args.cut else 1.8, int(rng.integers(2**31)))
        search = Search(**asked, crowds=True)
        sample = sample_frames(movie, search, range(movie.shape[0]))
        optics = choose_method(movie, search, sample).optics
        for refine in (None, "model"):
            start = time.perf_counter()
            table = perrin.locate(movie, refine=refine, optics=optics, crowds=True, **asked)
            seconds += [time.perf_counter() - start] if refine else []
            missed, false, off_here = errors(table, places)
            lost[refine].append([missed, false, len(places)])
            off[refine].append(off_here - off_here.mean(axis=0))
        stated.append(table[["sigma_x", "sigma_y", "sigma_z"]].to_numpy() * 1e3)
    for refine in (None, "model"):
        missed, false, true = np.sum(lost[refine], axis=0)
        each = np.concatenate(off[refine])
        print(
            f"{refine!s:6s} spheres {true}, missed {missed}, false {false}; errors x, y, z: sd "
            f"{each.std(axis=0).round(1)}, median of abs/0.674 "
            f"{(np.median(np.abs(each), axis=0) / 0.674).round(1)} nm"
        )
    print("stated (Fisher)", np.sqrt(np.mean(np.concatenate(stated) ** 2, axis=0)).round(1), "nm")
    print(f"a frame takes {np.median(seconds):.1f} s")


if __name__ == "__main__":
    main()
