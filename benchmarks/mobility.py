"""Accuracy of the mobility, its error estimate compared with the true error, and its cost.

Usage: OMP_NUM_THREADS=1 python benchmarks/mobility.py [BODIES] [SEED]
"""

import sys
import time

import numpy as np

import perrin
from perrin.hydrodynamics import resistance

KNOWN = {"viscosity": 1e-3, "temperature": 300.0}
KT_OVER_ETA = 1.380649e-23 * 300 / 1e-3 * 1e18


def line(n):
    return np.array([[0.0, 0, 2 * i] for i in range(n)])


def touching(n):
    return perrin.Cluster.touching(n, 2.0).positions


# Rows of the table: centres, radii.
ROWS = {
    "dimer": (line(2), 1.0),
    "line of 3": (line(3), 1.0),
    "triangle": (touching(3), 1.0),
    "tetrahedron": (touching(4), 1.0),
    "square": (np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]), 1.0),
    "line of 4": (line(4), 1.0),
    "bipyramid, 5": (touching(5), 1.0),
    "the paper's pentahedron": (perrin.Cluster.pentahedron(2**0.5).positions, 1.0),
    "octahedron": (touching(6), 1.0),
    "pentagonal bipyramid, 7": (touching(7), 1.0),
    "dimer 1:1.05": (np.array([[0, 0, 0], [0, 0, 2.05]]), [1.0, 1.05]),
    "dimer 1:1.5": (np.array([[0, 0, 0], [0, 0, 2.5]]), [1.0, 1.5]),
    "dimer 1:2": (np.array([[0, 0, 0], [0, 0, 3.0]]), [1.0, 2.0]),
    "dimer 1:3": (np.array([[0, 0, 0], [0, 0, 4.0]]), [1.0, 3.0]),
    "dimer 1:10": (np.array([[0, 0, 0], [0, 0, 11.0]]), [1.0, 10.0]),
}


def solve(body, **options):
    """Return the mobility of centres and radii, and the seconds it took."""
    # A body that was solved before is not solved again.
    resistance._fit_flows.cache_clear()
    start = time.perf_counter()
    mobility = perrin.cluster_mobility(body[0], radius=body[1], **KNOWN, **options)
    return mobility, time.perf_counter() - start


def deviation(D, truth):
    """Return the largest relative deviation over all directions of motion."""
    white = np.linalg.inv(np.linalg.cholesky(truth))
    return np.abs(np.linalg.eigvalsh(white @ D @ white.T) - 1).max()


def check_rows():
    print("body | D_T | D_R | factor T, R | degree | stated error | true | worst stated/true | ms")
    for name, body in ROWS.items():
        reference = {2: 22, 3: 16, 4: 14, 5: 14}.get(len(body[0]), 12)
        truth = solve(body, degree=reference)[0]
        mobility, seconds = min((solve(body) for _ in range(3)), key=lambda pair: pair[1])
        honesty = [
            coarse.error / deviation(coarse.D, truth.D)
            for coarse in (solve(body, degree=degree)[0] for degree in range(2, 11))
        ]
        t, r = np.trace(truth.D_T) * 2 * np.pi, np.trace(truth.D_R) * 8 / 3 * np.pi
        print(
            f"{name} | {t / KT_OVER_ETA:.6f} | {r / KT_OVER_ETA:.6f} | "
            f"{truth.diameter_factor_T:.5f}, {truth.diameter_factor_R:.5f} | {mobility.degree} | "
            f"{mobility.error:.0e} | {deviation(mobility.D, truth.D):.0e} | {min(honesty):.1f} | "
            f"{1e3 * seconds:.0f}",
            flush=True,
        )


def random_body(n, *, ratio, reach, rng):
    """Grow a body of n spheres, radii 1 to `ratio`; centres at `reach` times the contact."""
    a = rng.uniform(1, ratio, n)
    x = [np.zeros(3)]
    while len(x) < n:
        i, k = len(x), rng.integers(len(x))
        way = rng.normal(size=3)
        at = x[k] + way / np.linalg.norm(way) * (a[i] + a[k]) * reach
        if all(np.linalg.norm(at - x[j]) > (a[i] + a[j]) * reach * 0.999 for j in range(i)):
            x.append(at)
    return np.array(x), a


def check_random(count, seed):
    rng = np.random.default_rng(seed)
    print(
        "random bodies of 3: radii, centre distance | worst true error, least stated/true, turned"
    )
    for ratio, reach in ((1, 1), (2, 1), (3, 1), (1, 0.8), (2, 0.6), (1, 0.5), (1, 1.2)):
        errors, honesty, turned = [], [], []
        for _ in range(count):
            x, a = random_body(3, ratio=ratio, reach=reach, rng=rng)
            truth, mobility = solve((x, a), degree=15)[0], solve((x, a))[0]
            errors.append(deviation(mobility.D, truth.D))
            honesty.append(mobility.error / errors[-1])
            turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            turn *= np.linalg.det(turn)
            both = np.kron(np.eye(2), turn)
            other = solve((x @ turn.T, a))[0]
            turned.append(deviation(other.D, both @ mobility.D @ both.T) / mobility.error)
        print(
            f"1 to {ratio}, {reach} of contact | {max(errors):.0e}, {min(honesty):.1f}, "
            f"{max(turned):.2f} of the stated error",
            flush=True,
        )


def main(bodies=6, seed=0):
    check_rows()
    check_random(bodies, seed)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
