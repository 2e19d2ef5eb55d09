"""Close-packed dark spheres in a real confocal stack: number found, and errors of positions.

The folder holds `small_confocal_image.tif` (48 x 64 x 64) and `particle-positions.npy`, 37 starting
positions (z, y, x), voxels, of the walkthrough of PERI (peri-source/peri, docs/_static); its
authors state that they are centroids by trackpy of most of the spheres. Distances to them show
which spheres are found. Errors of positions follow from the image itself, and from a simulated
copy: the fitted spheres drawn again with noise, whose positions are known.

Usage: python benchmarks/peri.py FOLDER [--out peri.png] [--seed 0]
"""

import argparse
import time
import warnings
from pathlib import Path

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageSequence
from scipy.spatial.distance import cdist

import perrin
from perrin.images.optics.crowd_equations import fit_brightness
from perrin.images.optics.crowd_fit import fit_crowd
from perrin.images.spheres.by_trackpy import find_features
from perrin.images.spheres.localisation import Search, choose_method, sample_frames

D = 11.0  # voxels, the diameter stated in the walkthrough
VOXEL = (1.0, 1.0, 1.0)


class Movie:
    """One frame in memory, voxels as the unit of length."""

    def __init__(self, frame):
        self.shape, self.voxel, self.image = (1, *frame.shape), VOXEL, frame

    def frame(self, _):
        """Return the frame."""
        return self.image


def read(folder):
    """Return the frame and the listed places (z, y, x)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the file was written by Python 2
        listed = np.load(folder / "particle-positions.npy")
    with Image.open(folder / "small_confocal_image.tif") as pages:
        return np.array([np.array(page) for page in ImageSequence.Iterator(pages)], float), listed


def plain(frame):
    """Return the places of trackpy's locate, its own defaults, on the inverted image."""
    import trackpy

    found = trackpy.locate((frame.max() - frame).astype(np.uint8), 11)
    return found[["z", "y", "x"]].to_numpy()


def zyx(table):
    return table[["z", "y", "x"]].to_numpy()


def report(name, places, listed):
    """Print the number of listed spheres that are found, and the least distance of two spheres."""
    off = cdist(listed, places).min(axis=1)
    apart = cdist(places, places) + np.diag(np.full(len(places), np.inf))
    met = "".join(f"{np.sum(off < r):5d}" for r in (1, 2, D / 2))
    print(f"{name:26s}{len(places):8d}{met}{apart.min():12.2f}")


def misfit_at(fit, places):
    """Return chi-squared per voxel with the spheres at other places, their brightness refitted."""
    centers = fit.intensity.centers.copy()
    distance = cdist(places, centers)
    for place, k, near in zip(places, distance.argmin(1), distance.min(1), strict=True):
        if near < D / 3:
            centers[k] = place
    state = fit_brightness(fit.window, centers)
    return fit.intensity.chi2(fit.window, state.expected) / fit.intensity.n_voxels


def draw(frame, places, listed, path):
    """Draw slices along the three axes: circles where spheres are cut, crosses where listed."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    slices = [(0, 13), (0, 17), (0, 24), (1, 8), (1, 25), (2, 31)]
    figure, panels = plt.subplots(
        2, 3, figsize=(13, 8.4), height_ratios=[4, 3], layout="constrained"
    )
    for panel, (axis, k) in zip(panels.flat, slices, strict=True):
        across, along = (i for i in range(3) if i != axis)
        panel.imshow(frame.take(k, axis=axis), cmap="gray", origin="lower")
        for place in places:
            cut = (D / 2) ** 2 - (place[axis] - k) ** 2
            if cut > 0:
                at = (place[along], place[across])
                panel.add_patch(plt.Circle(at, np.sqrt(cut), fill=False, color="tab:cyan", lw=1.5))
        near = listed[np.abs(listed[:, axis] - k) < D / 2]
        panel.plot(near[:, along], near[:, across], "x", color="tab:orange", ms=7, mew=1.8)
        names = "zyx"
        panel.set(title=f"{names[axis]} = {k}", xlabel=names[along], ylabel=names[across])
        panel.set_xlim(-0.5, frame.shape[along] - 0.5)
        panel.set_ylim(-0.5, frame.shape[across] - 0.5)
    figure.suptitle("circles: found, where the slice cuts them; crosses: listed, within a radius")
    figure.savefig(path, dpi=110)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("peri.png"))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    frame, listed = read(args.folder)
    movie, asked = Movie(frame), {"diameter": D, "contact": D, "dark": True}
    print(f"{'':26s}{'spheres':>8s}{'<1':>5s}{'<2':>5s}{'<D/2':>5s}{'least apart':>12s}")
    report("listed", listed, listed)
    report("trackpy, its defaults", plain(frame), listed)
    first = zyx(perrin.locate(movie, refine=None, **asked))
    report("found first", first, listed)
    start = time.perf_counter()
    search = Search(**asked, crowds=True)
    sample = sample_frames(movie, search, range(movie.shape[0]))
    optics = choose_method(movie, search, sample).optics
    learned = time.perf_counter()
    table = perrin.locate(movie, optics=optics, crowds=True, **asked)
    seconds = time.perf_counter() - learned
    report("refined", zyx(table), listed)
    print(optics)
    print(f"optics {learned - start:.1f} s, refined {seconds:.1f} s")
    print("stated errors, x, y, z:", table.filter(like="sigma").mean().round(3).tolist(), "voxels")
    none = np.empty((0, 3))
    image = optics.image(VOXEL)
    fit = fit_crowd(frame, first, others=none, contact=D, image=image, noise=optics.noise)
    for name, places in (("refined", fit.centers), ("found first", first), ("listed", listed)):
        print(f"chi2 with the spheres at the places {name}: {misfit_at(fit, places):.3f}")
    left = (fit.window.data - fit.intensity.expected)[fit.window.mask].std()
    white = [np.diff(frame, 2, axis=axis).std() / np.sqrt(6) for axis in range(3)]
    print(f"left over by the model {left:.2f} grey levels; second differences of the image along")
    print("z, y, x, which need no model, give a noise of", np.round(white, 2).tolist())
    rng = np.random.default_rng(args.seed)
    noise = rng.normal(size=frame.shape) / np.sqrt(optics.noise.weight(fit.intensity.expected))
    copy = np.clip(np.round(fit.intensity.expected + noise), 0, 255)
    search = {"diameter": D, "contact": D, "voxel": VOXEL, "dark": True}
    again = find_features(copy, percentile=95, border=True, **search)
    bright = again.centers[again.mass > 0.5 * np.median(again.mass)]
    refit = fit_crowd(copy, bright, others=none, contact=D, image=image, noise=optics.noise)
    for name, places in (("found first", bright), ("refined", refit.centers)):
        off = fit.centers - places[cdist(fit.centers, places).argmin(axis=1)]
        rms = np.sqrt(np.median(off**2, axis=0) / 0.455)
        print(f"errors on the simulated copy, z, y, x, {name}: {rms.round(3)} voxels")
    draw(frame, zyx(table), listed, args.out)


if __name__ == "__main__":
    main()
