"""Speed of `kabsch` against its peers in the same run: consecutive frames of a noisy tetrahedron.

Processor time, one thread (set OMP_NUM_THREADS=1), medians of interleaved rounds; loops are timed
on 2000 pairs. Usage: python benchmarks/rotations.py [PAIRS]
"""

import sys
import time

import numpy as np
from scipy.spatial.transform import Rotation

import perrin


def batched_svd(points, reference):
    """Solve Hunter 2011, Eqs. 8-10, with numpy's batched SVD."""
    y = points - points.mean(axis=1, keepdims=True)
    x = reference - reference.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(y, 1, 2) @ x)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def scipy_loop(points, reference):
    """Call scipy's align_vectors pair by pair."""
    y = points - points.mean(axis=1, keepdims=True)
    x = reference - reference.mean(axis=1, keepdims=True)
    return np.array(
        [Rotation.align_vectors(a, b)[0].as_matrix() for a, b in zip(y, x, strict=True)]
    )


def main(pairs=100_000, rounds=7):
    truth = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=pairs + 1, rng=0
    )
    x = perrin.add_noise(truth.positions(), sigma=0.03, rng=1)
    contenders = {
        "perrin.kabsch": (perrin.kabsch, pairs),
        "numpy batched svd": (batched_svd, pairs),
        "scipy align_vectors loop": (scipy_loop, min(pairs, 2000)),
    }
    nanoseconds = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, (solve, count) in contenders.items():
            start = time.process_time()
            solve(x[1 : count + 1], x[:count])
            nanoseconds[name].append((time.process_time() - start) / count * 1e9)
    ours = np.median(nanoseconds["perrin.kabsch"])
    for name, times in nanoseconds.items():
        print(f"{name:26s} {np.median(times):9.0f} ns/pair {np.median(times) / ours:8.1f} x")
    difference = np.abs(perrin.kabsch(x[1:], x[:-1]) - batched_svd(x[1:], x[:-1])).max()
    print(f"largest difference from the SVD: {difference:.1e}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
