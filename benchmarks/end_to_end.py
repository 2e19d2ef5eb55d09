"""A whole movie through the pipeline: its results, compared with those of the true positions.

Twelve touching tetrahedra of balls 2.45 um diffuse (D_R 0.0049 rad^2/s, D_T 0.0385 um^2/s) for 40
frames, 0.73 s apart, in 64 x 256 x 256 voxels of 0.25 x 0.2 x 0.2 um (z, y, x). Point spread 0.4
and 0.15 um, 40 photons, background 2 to 6 photons along x, gain 3, read noise 2, 30 % bleaching,
8 % spread of brightness, 15 % loss of intensity over depth, 8 bits. Point spread, gain and
background are unknown to the analysis. The movie is kept as OME-TIFF, with a file of its true
positions, and rendered only once.

The same estimator takes the true positions of the same paths: differences between the two are in
units of the standard errors that it states for the true positions.

Usage: python benchmarks/end_to_end.py [--movie FILE.ome.tif] [--seed 0] [--photons 40]
"""

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

import perrin
from perrin.geometry.rotations import exp_map, log_map

DIAMETER, DT = 2.45, 0.73
VOXEL = np.array([0.25, 0.2, 0.2])
SHAPE = (64, 256, 256)
OPTICS = {
    "voxel": VOXEL, "diameter": DIAMETER, "psf": (0.4, 0.15, 0.15), "background": 4.0,
    "spread": 0.08, "bleaching": 0.3, "depth_loss": 0.15, "gain": 3.0, "read_noise": 2.0,
    "dtype": "uint8",
}  # fmt: skip
BODY = perrin.Cluster.touching(4, DIAMETER)
# Nearer to the place of a true cluster than a sphere's radius, a found one is that cluster.
SAME = DIAMETER / 2


def paths(clusters, n_frames, shape, rng):
    """Return motions and the positions of their origins; all stay a contact from each other.

    A path that comes nearer to another one or to the border is drawn again as a whole. The paths
    kept diffuse a little less than planted, which does not matter here: results are compared with
    those of the true positions of the same paths, not with the planted values.
    """
    box = (np.array(shape) - 1)[::-1] * VOXEL[::-1]
    motions, places, taken = [], [], []
    while len(motions) < clusters:
        motion = perrin.simulate_motion(
            BODY, D_R=0.0049, D_T=0.0385, dt=DT, n_frames=n_frames, rng=rng
        )
        place = rng.uniform(0, box)
        path = motion.positions() + place
        if path.min() < DIAMETER or (box - path).min() < DIAMETER:
            continue
        # Surfaces a contact apart: centres two.
        if any(nearest(path, other) < 2 * DIAMETER for other in taken):
            continue
        motions.append(motion)
        places.append(place)
        taken.append(path)
    return motions, np.array(places), np.stack(taken)


def nearest(path, other):
    """Return the least distance of spheres of two clusters in the same frame."""
    return min(cdist(a, b).min() for a, b in zip(path, other, strict=True))


def rendered(*, clusters=12, n_frames=40, shape=SHAPE, photons=40.0, seed=0):
    """Return the movie and the true positions (clusters, frames, 4, 3)."""
    rng = np.random.default_rng(seed)
    motions, places, truth = paths(clusters, n_frames, shape, rng)
    slope = (0.0, 0.0, 4.0 / (shape[2] * VOXEL[2]))
    stack = perrin.render_stack(
        motions, centers=places, shape=shape, photons=photons, gradient=slope, rng=rng, **OPTICS
    )
    return stack, truth


def kept(movie, **recipe):
    """Return the movie's file and its true positions, rendered if they do not exist yet."""
    positions_file = movie.with_name(movie.name.partition(".")[0] + "-truth.npz")
    if not (movie.exists() and positions_file.exists()):
        stack, truth = rendered(**recipe)
        perrin.write_stack(stack, movie)
        np.savez(positions_file, positions=truth, **recipe)
    with np.load(positions_file) as known:
        other = {k: known[k].tolist() for k, v in recipe.items() if np.any(known[k] != v)}
        if other:
            raise SystemExit(f"{movie} is of another recipe: {other}")
        return perrin.open_stack(movie), known["positions"]


def pipeline(stack):
    """Return the report, and the seconds of every stage."""
    begun, last = {"opening": time.perf_counter()}, 0.0

    def tick(_done, _total, title):
        nonlocal last
        last = time.perf_counter()
        begun.setdefault(title, last)

    report = perrin.analyze_stack(stack, diameter=DIAMETER, contact=DIAMETER, progress=tick)
    begun["the rest"] = last
    ends = [*begun.values(), time.perf_counter()]
    return report, dict(zip(begun, np.diff(ends), strict=True))


def true_report(truth):
    """Return the report of the same estimators for the true positions."""
    import pandas as pd

    tables = [perrin.positions_table(x).assign(cluster=c) for c, x in enumerate(truth)]
    for c, table in enumerate(tables):
        table["particle"] += 4 * c
    return perrin.analyze(pd.concat(tables, ignore_index=True), dt=DT)


def frames_of(motion):
    """Return the frame of each row of a motion."""
    return np.rint(motion.time / DT).astype(int)


def matched(report, truth):
    """Return {true cluster: result} and the results that are no true cluster's."""
    middles = truth.mean(axis=2)
    pairs, false = {}, []
    for result in report.clusters:
        away = middles[:, frames_of(result.motion)] - result.motion.center
        away = np.linalg.norm(away, axis=2)
        typical = np.nanmedian(away, axis=1)
        best = int(typical.argmin())
        if typical[best] < SAME and best not in pairs:
            pairs[best] = result
        else:
            false.append(result)
    return pairs, false


def deviations(found, true):
    """Return differences of D_R and D_T in units of the true positions' standard errors."""
    return [
        (getattr(found, q).value - getattr(true, q).value) / getattr(true, q).stderr
        for q in ("D_R", "D_T")
    ]


def place_errors(table, truth):
    """Return errors (n, 3) of spheres within a radius of a true one, um, and the stated ones."""
    errors, stated = [], []
    for i, part in table.groupby("frame"):
        places = truth[:, i].reshape(-1, 3)
        x = part[["x", "y", "z"]].to_numpy()
        away = cdist(x, places)
        hit = away.min(axis=1) < DIAMETER / 2
        errors.append((x - places[away.argmin(axis=1)])[hit])
        stated.append(part.loc[hit, ["sigma_x", "sigma_y", "sigma_z"]].to_numpy())
    return np.concatenate(errors), np.concatenate(stated)


def print_spheres(table, truth):
    """Print the number of spheres, and the errors of their positions."""
    spheres = truth.shape[0] * truth.shape[1] * truth.shape[2]
    print(f"spheres: {len(table)}, true {spheres}, not refined {int((~table['refined']).sum())}")
    errors, stated = (1e3 * e for e in place_errors(table, truth))
    print(f"x, y, z, nm: offset {errors.mean(axis=0).round(1)}", end="")
    print(f", spread {errors.std(axis=0).round(2)}", end="")
    print(f", stated {np.sqrt(np.nanmean(stated**2, axis=0)).round(2)}", end="")
    print(f"; chi2 {table['chi2'].mean():.3f}")


def print_coefficients(report, true, truth):
    """Print D_R and D_T, found and true, pooled and of every cluster."""
    pairs, false = matched(report, truth)
    print(f"clusters: {len(pairs)} of {len(truth)} found, {len(false)} false")
    columns = ("D_R found", "true", "differ", "D_T found", "true", "differ")
    widths = (12, 12, 8) * 2
    print(" " * 8 + "".join(f"{c:>{w}s}" for c, w in zip(columns, widths, strict=True)))
    rows = [("pooled", report.pooled, true.pooled)]
    rows += [(str(c), pairs[c], true.clusters[c]) for c in sorted(pairs)]
    for name, one, other in rows:
        off = deviations(one, other)
        line = "".join(
            f"{getattr(one, q).value:12.6f}{getattr(other, q).value:12.6f}{d:8.3f}"
            for q, d in zip(("D_R", "D_T"), off, strict=True)
        )
        print(f"{name:8s}{line}")
    off = np.abs([deviations(pairs[c], true.clusters[c]) for c in pairs])
    print(f"largest of a cluster: D_R {off[:, 0].max():.3f}, D_T {off[:, 1].max():.3f}; ", end="")
    print(f"rms {np.sqrt(np.mean(off**2, axis=0)).round(3)} standard errors")


def pose_errors(motion, true):
    """Return errors of the centre, nm, and of the turn, mrad, both (T, 3)."""
    rows = frames_of(motion)
    apart = np.swapaxes(true.rotation[rows], -1, -2) @ motion.rotation
    # The body's own axes are arbitrary: the mean rotation of all frames is removed.
    first = apart[motion.fitted[0]]
    axes = first @ exp_map(np.nanmean(log_map(first.T @ apart), axis=0))
    turn = log_map(axes.T @ apart)
    return 1e3 * (motion.center - true.center[rows]), 1e3 * turn


def print_poses(report, true, truth):
    """Print the errors of the poses from the free centres, and of those fitted to the images."""
    spheres = report.imaging.features
    free = perrin.analyze(spheres[spheres["cluster"] >= 0], dt=DT)
    for name, results in (("free centres", free), ("image", report)):
        pairs, _ = matched(results, truth)
        errors = [pose_errors(r.motion, true.clusters[c].motion) for c, r in pairs.items()]
        center, turn = (np.nanstd(e, axis=(0, 1)).round(2) for e in zip(*errors, strict=True))
        print(f"pose from the {name}: centre {center} nm, turn {turn} mrad")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--movie", type=Path, help="an .ome.tif to keep, or kept before")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--photons", type=float, default=40.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        movie = args.movie or Path(folder) / "movie.ome.tif"
        stack, truth = kept(movie, seed=args.seed, photons=args.photons)
        with stack:
            report, seconds = pipeline(stack)
    # Linux counts in kB.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    true = true_report(truth)
    print_spheres(report.imaging.features, truth)
    print_coefficients(report, true, truth)
    print_poses(report, true, truth)
    for stage, spent in seconds.items():
        print(f"{stage:32s}{spent:8.2f} s{1e3 * spent / truth.shape[1]:8.0f} ms/frame")
    print(f"peak memory {peak:.0f} MB")


if __name__ == "__main__":
    main()
