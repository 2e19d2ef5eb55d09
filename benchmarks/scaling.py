"""How the time of a job grows with its size: exponents fitted to processor time.

Each job is timed at sizes a factor of two apart, the median of nine rounds, in turn; the exponent
is the slope of a straight line through the logarithms of the larger half of the sizes, where the
constant part does not matter any more. Processor time, one thread (set OMP_NUM_THREADS=1). The last
row is by the clock, on a machine that does nothing else: what a further cluster takes with one and
with two workers, without their start.

Usage: OMP_NUM_THREADS=1 python benchmarks/scaling.py [--quick] [--only WORD ...]
"""

import argparse
import time

import numpy as np
from peers import tetrahedra_table, walk_of

import perrin


def noisy_motion(n_frames, body=None):
    """Return positions of a noisy body."""
    body = perrin.Cluster.tetrahedron(1.0) if body is None else body
    truth = perrin.simulate_motion(body, D_R=1e-3, D_T=1e-3, dt=1.0, n_frames=n_frames, rng=0)
    return perrin.add_noise(truth.positions(), sigma=0.03, rng=1)


def body_of(n):
    """Return a body of n particles at random places."""
    return perrin.Cluster.from_positions(np.random.default_rng(n).normal(size=(n, 3)))


def with_gaps(x):
    """Return positions of which 5 % of the frames are missing."""
    x = x.copy()
    x[np.random.default_rng(2).random(len(x)) < 0.05] = np.nan
    return x


def rotation_fit(n_frames):
    x = noisy_motion(n_frames)
    return lambda: perrin.track_rotation(x, dt=1.0)


def mean_square(n_frames):
    walk = walk_of(n_frames)
    return lambda: perrin.msd(walk, dt=1.0)


def estimate(n_frames):
    motion = perrin.track_rotation(noisy_motion(n_frames), dt=1.0)
    return lambda: perrin.estimate_diffusion(motion)


def estimate_with_gaps(n_frames):
    motion = perrin.track_rotation(with_gaps(noisy_motion(n_frames)), dt=1.0)
    return lambda: perrin.estimate_diffusion(motion)


def tensor_with_gaps(n_frames):
    motion = perrin.track_rotation(with_gaps(noisy_motion(n_frames)), dt=1.0)
    return lambda: perrin.diffusion_tensor(motion)


def rotation_fit_of_particles(n):
    x = noisy_motion(300, body_of(n))
    return lambda: perrin.track_rotation(x, dt=1.0)


def analysis_of_clusters(count):
    table = tetrahedra_table(count, 300)
    return lambda: perrin.analyze(table, dt=0.73)


# Sizes of the whole and of the quick form; the largest demanded exponent.
JOBS = {
    "frames: track_rotation": (rotation_fit, 2 ** np.arange(12, 18), 1.1),
    "frames: msd, all lags": (mean_square, 2 ** np.arange(13, 19), 1.1),
    "frames: D_R": (estimate, 2 ** np.arange(11, 17), 1.1),
    "frames: D_R, 5 % missing": (estimate_with_gaps, 2 ** np.arange(11, 17), 1.1),
    "frames: tensor, 5 % missing": (tensor_with_gaps, 2 ** np.arange(10, 15), 1.1),
    "particles: track_rotation": (rotation_fit_of_particles, 2 ** np.arange(4, 10), 1.1),
    "clusters: analyze": (analysis_of_clusters, 2 ** np.arange(3, 9), 1.1),
}


def seconds_by_size(job, sizes, rounds):
    """Return the median seconds at every size."""
    work = [job(int(n)) for n in sizes]
    work[0]()
    found = np.empty((rounds, len(sizes)))
    for k in range(rounds):
        for i, one in enumerate(work):
            start = time.process_time()
            one()
            found[k, i] = time.process_time() - start
    return np.median(found, axis=0)


def seconds_a_cluster(workers, quick):
    """Return the seconds by the clock that a further cluster takes with so many workers."""
    sizes, seconds = (16, 48) if quick else (500, 1500), []
    for count in sizes:
        table = tetrahedra_table(count, 300)
        start = time.perf_counter()
        perrin.analyze(table, dt=0.73, workers=workers)
        seconds.append(time.perf_counter() - start)
    return (seconds[1] - seconds[0]) / (sizes[1] - sizes[0])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", nargs="*", default=[""])
    given = parser.parse_args()
    print("| job | sizes | seconds | exponent | at most |")
    print("|---|---|---|---|---|")
    for name, (job, sizes, most) in JOBS.items():
        if not any(word in name for word in given.only):
            continue
        sizes = sizes[:-2] if given.quick else sizes
        seconds = seconds_by_size(job, sizes, 1 if given.quick else 9)
        half = len(sizes) // 2
        exponent = np.polyfit(np.log(sizes[half:]), np.log(seconds[half:]), 1)[0]
        spread = ", ".join(f"{s:.2g}" for s in seconds)
        cells = (name, f"{sizes[0]} to {sizes[-1]}", spread, f"{exponent:.2f}", str(most))
        print(f"| {' | '.join(cells)} |", flush=True)
    name = "workers: analyze, a further cluster"
    if any(word in name for word in given.only):
        one, two = (seconds_a_cluster(workers, given.quick) for workers in (1, 2))
        cells = (name, "1 to 2", f"{one:.2g}, {two:.2g}", f"{np.log2(two / one):.2f}", "")
        print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
