"""Large jobs: processor time and memory at a quarter, a half and the whole of a size.

Every job runs in a process of its own. The exponent is that of the size in the processor time
between a quarter and the whole, without the start of the program: 1 is linear.

Usage: python benchmarks/load.py [--share S] [--jobs NAME ...]
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile

import numpy as np

import perrin

DT = 0.7


def tetrahedra(n_clusters, n_frames, rng):
    """Return a table of clusters side by side, with noise."""
    import pandas as pd

    body = perrin.Cluster.touching(4, 2.45)
    rows = []
    for k in range(n_clusters):
        motion = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=DT, n_frames=n_frames, rng=rng)
        places = perrin.add_noise(motion.positions(), sigma=0.02, rng=rng) + 50.0 * k
        frame, particle = np.indices(places.shape[:2])
        columns = dict(zip("xyz", places.reshape(-1, 3).T, strict=True))
        ids = {"frame": frame.ravel(), "particle": particle.ravel() + 4 * k, "cluster": k}
        rows.append(pd.DataFrame({**ids, **columns}))
    return pd.concat(rows, ignore_index=True)


def frames(n, rng):
    """Measure one cluster of n frames."""
    table = tetrahedra(1, n, rng)
    return lambda: perrin.analyze(table, dt=DT)


def clusters(n, rng):
    """Measure n clusters of 100 frames."""
    table = tetrahedra(n, 100, rng)
    return lambda: perrin.analyze(table, dt=DT)


def particles(n, rng):
    """Fit a body of n particles to 100 frames, and measure it."""
    body = perrin.Cluster(rng.normal(size=(n, 3)) * n ** (1 / 3))
    motion = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=DT, n_frames=100, rng=rng)
    places = perrin.add_noise(motion.positions(), sigma=0.02, rng=rng)

    def job():
        found = perrin.track_rotation(places, dt=DT)
        return perrin.estimate_diffusion(found), perrin.msad(found)

    return job


def lags(n, rng):
    """Compute the MSAD and the MSD at n lags, with errors."""
    body = perrin.Cluster.touching(4, 2.45)
    motion = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=DT, n_frames=n + 1, rng=rng)
    return lambda: (perrin.msad(motion), perrin.msd(motion))


def rendered(n, rng):
    """Return a movie of n frames of one cluster, which are rendered when they are read."""
    body = perrin.Cluster.touching(4, 2.45)
    motion = perrin.simulate_motion(body, D_R=5e-3, D_T=1e-4, dt=DT, n_frames=n, rng=rng)
    return perrin.render_stack(
        motion, centers=[(4.5, 4.5, 4.0)], voxel=(0.3, 0.25, 0.25), shape=(27, 36, 36),
        diameter=2.45, psf=(0.4, 0.15, 0.15), photons=75, background=5, gain=3, read_noise=2,
        offset=5, rng=7,
    )  # fmt: skip


def stack(n, rng):
    """Locate the spheres of a movie of n frames, and measure their cluster."""
    movie = rendered(n, rng)
    return lambda: perrin.analyze_stack(movie, diameter=2.45, contact=2.45)


def file(n, rng):
    """Find the spheres in a TIFF file of n frames of 27 planes, with one worker."""
    folder = tempfile.mkdtemp(prefix="perrin-")
    path = f"{folder}/movie.ome.tif"
    perrin.write_stack(rendered(n, rng), path)

    def job():
        with perrin.open_stack(path) as movie:
            perrin.analyze_stack(movie, diameter=2.45, contact=2.45, refine=None, workers=1)
        shutil.rmtree(folder)

    return job


JOBS = {
    "frames of one cluster": (frames, 1_000_000),
    "clusters of 100 frames": (clusters, 3000),
    "particles of a body": (particles, 200),
    "lags of two curves": (lags, 20_000),
    "frames of a stack": (stack, 2000),
    "frames of a file": (file, 2000),
}


def used():
    """Return processor time, s, and largest memory, MiB, of this process and those it started."""
    kinds = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    usage = [resource.getrusage(kind) for kind in kinds]
    seconds = sum(one.ru_utime + one.ru_stime for one in usage)
    return seconds, max(one.ru_maxrss for one in usage) / 1024


def measured(name, n):
    """Return processor time, s, and the largest memory, MiB, of a job in another process."""
    command = [sys.executable, __file__, "--one", name, "--size", str(n)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{name}, {n}: {done.stderr[-500:]}")
    return json.loads(done.stdout.splitlines()[-1])


def main():
    """Measure the jobs, or one of them in this process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the sizes")
    parser.add_argument("--jobs", nargs="*", default=list(JOBS))
    parser.add_argument("--one")
    parser.add_argument("--size", type=int)
    options = parser.parse_args()
    if options.one:
        job = JOBS[options.one][0](options.size, np.random.default_rng(1))
        start, before = used()
        job()
        end, largest = used()
        print(json.dumps([end - start, before, largest]))
        return
    for name in options.jobs:
        whole = max(int(JOBS[name][1] * options.share), 8)
        sizes = [whole // 4, whole // 2, whole]
        results = [measured(name, n) for n in sizes]
        times = [r[0] for r in results]
        exponent = np.log(times[2] / times[0]) / np.log(sizes[2] / sizes[0])
        steps = " ".join(
            f"{n}: {t:.3g} s, {r[2]:.0f} MiB ({r[1]:.0f} before);"
            for n, t, r in zip(sizes, times, results, strict=True)
        )
        print(f"{name}: {steps} exponent {exponent:.2f}", flush=True)


if __name__ == "__main__":
    main()
