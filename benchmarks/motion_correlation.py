"""Orientation correlations, relaxation times and non-Gaussian parameters against simulated truth.

The noise factor of C_l and its correction, the errors that are stated against the scatter over
tracks, and the non-Gaussian parameter of motion whose D switches tenfold, through the poses of
tetrahedra with localisation noise. Numbers in parentheses are Monte-Carlo errors of the last
digits.

Usage: python benchmarks/motion_correlation.py [--seed S] [--tracks M] [--quick]
"""

import argparse

import numpy as np

import perrin
from perrin.curves import brownian_alpha2
from perrin.geometry.rotations import cumulative_product, exp_map

BODY = perrin.Cluster.tetrahedron(1.5)
D = 1e-2  # rad^2 per frame, of the correlations
CELLS = [(300, 5.0), (1000, 5.0), (1000, 0.5), (4000, 5.0)]


def tracked(D_of_step, snr, rng, *, mean=None):
    """Return the tracked motion of a tetrahedron whose D dt is given for every step."""
    D_of_step = np.asarray(D_of_step)
    turn = np.sqrt(2 * D_of_step)[:, None] * rng.normal(size=(len(D_of_step), 3))
    rotation = cumulative_product(exp_map(turn))
    positions = np.einsum("tij,nj->tni", rotation, BODY.positions)
    # A tetrahedron of radius R has the orientation variance 3/8 sigma^2/R^2.
    radius = np.linalg.norm(BODY.positions, axis=1).mean()
    s = (np.mean(D_of_step) if mean is None else mean) / snr
    noisy = perrin.add_noise(positions, sigma=np.sqrt(8 / 3 * s) * radius, rng=rng)
    return perrin.track_rotation(noisy, dt=1.0)


def switching(count, rng, *, ratio=10.0, dwell=50.0, mean=1e-4):
    """Return D of every step of a body that switches between two states."""
    state = (np.cumsum(rng.random(count) < 1 / dwell) + rng.integers(2)) % 2
    return 2 * mean * np.where(state == 1, ratio, 1.0) / (1 + ratio)


def with_mc(values, digits=3):
    """Return a mean with its Monte-Carlo error."""
    error = np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{np.mean(values):.{digits}f}({round(error * 10**digits)})"


def correlations(cell, tracks, seed):
    """Return for every track the curves of both degrees, raw and corrected."""
    frames, snr = cell
    rng = np.random.default_rng([seed, frames, round(10 * snr)])
    rows = []
    for _ in range(tracks):
        motion = tracked(np.full(frames, D), snr, rng)
        rows.append(
            {
                (degree, noise): perrin.orientation_correlation(motion, degree=degree, noise=noise)
                for degree in (1, 2)
                for noise in (None, "residual", "joint")
            }
        )
    return rows


def factor_table(cells):
    """Print the noise factor of C_l at the first three lags, and the errors of C_l."""
    print("| N, SNR, l | measured / exp(-l(l+1)s) C | residual | joint | stated error / sd |")
    print("|---|---|---|---|---|")
    for (frames, snr), rows in cells.items():
        for degree in (1, 2):
            rate = degree * (degree + 1)
            lag = np.arange(1, 4)
            truth = np.exp(-rate * D * lag)
            factor = {None: np.exp(-rate * D / snr), "residual": 1.0, "joint": 1.0}
            cells_of_row = []
            for noise, expected in factor.items():
                values = np.array([row[degree, noise].value[lag - 1] for row in rows])
                cells_of_row.append(with_mc((values / truth / expected).mean(axis=1), 4))
            at = np.array([3, 10, round(1 / (rate * D))])
            value = np.array([row[degree, None].value[at - 1] for row in rows])
            stated = np.array([row[degree, None].stderr[at - 1] for row in rows])
            share = stated.mean(axis=0) / value.std(axis=0, ddof=1)
            spread = 1 / np.sqrt(2 * len(rows))
            errors = ", ".join(f"{x:.2f}({round(100 * x * spread)})" for x in share)
            print(f"| {frames}, {snr:g}, {degree} | {' | '.join(cells_of_row)} | {errors} |")


def relaxation_table(cells):
    """Print relaxation times, exponents and ratios: bias, scatter, stated error and cover."""
    print("\n| N, SNR | quantity | mean | sd | stated error / sd | cover 95 % |")
    print("|---|---|---|---|---|---|")
    for (frames, snr), rows in cells.items():
        found = [
            [perrin.fit_relaxation(row[1, None], row[2, None]), perrin.fit_relaxation(row[2, None])]
            for row in rows
        ]
        for name, truth, index, fields in (
            ("tau_1 2D", 1 / (2 * D), 0, ("tau", "stderr", "ci95")),
            ("tau_2 6D", 1 / (6 * D), 1, ("tau", "stderr", "ci95")),
            ("beta, l = 1", 1.0, 0, ("beta", "beta_stderr", "beta_ci95")),
            ("beta, l = 2", 1.0, 1, ("beta", "beta_stderr", "beta_ci95")),
            ("tau_1/tau_2", 1.0, 0, ("ratio", "ratio_stderr", "ratio_ci95")),
        ):
            value, stated, ends = (
                np.array([getattr(pair[index], field) for pair in found]) for field in fields
            )
            exact = 3.0 if name == "tau_1/tau_2" else truth
            cover = np.mean((ends[:, 0] < exact) & (exact < ends[:, 1]))
            sd = value.std(ddof=1) / truth
            error = np.sqrt(cover * (1 - cover) / len(found))
            print(
                f"| {frames}, {snr:g} | {name} | {with_mc(value / truth, 2)} | "
                f"{sd:.3f}({round(1e3 * sd / np.sqrt(2 * len(found)))}) | "
                f"{stated.mean() / truth / sd:.2f} | {cover:.3f}({round(1e3 * error)}) |",
                flush=True,
            )


def excess_table(tracks, seed):
    """Print alpha_2 of tenfold switching, dwell 50, lag 5, N = 1000, raw and corrected."""
    print("\n| SNR | raw | residual | joint | van Hove | no noise | sd | stated error / sd |")
    print("|---|---|---|---|---|---|---|---|")
    for snr in (0.5, 2.0, 5.0, 50.0):
        rng = np.random.default_rng([seed, round(10 * snr)])
        rows, errors = [], []
        for _ in range(tracks):
            motion = tracked(switching(1000, rng), snr, rng, mean=1e-4)
            curves = [
                perrin.non_gaussian(motion, lags=[5.0], noise=noise)
                for noise in (None, "residual", "joint")
            ]
            rows.append(
                [float(c.value[0]) for c in curves] + [perrin.van_hove(motion, lag=5.0).alpha2]
            )
            errors.append(float(curves[1].stderr[0]))
        rows = np.array(rows)
        clean = [
            float(perrin.non_gaussian(tracked(switching(1000, rng), 1e9, rng), lags=[5.0]).value[0])
            for _ in range(tracks)
        ]
        sd = rows[:, 1].std(ddof=1)
        print(
            f"| {snr:g} | {' | '.join(with_mc(column) for column in rows.T)} | {with_mc(clean)} | "
            f"{sd:.3f} | {np.mean(errors) / sd:.2f} |",
            flush=True,
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tracks", type=int, default=400)
    parser.add_argument("--quick", action="store_true", help="30 tracks of the shorter cells")
    given = parser.parse_args()
    tracks = 30 if given.quick else given.tracks
    cells = {
        cell: correlations(cell, tracks, given.seed)
        for cell in (CELLS[:3] if given.quick else CELLS)
    }
    factor_table(cells)
    relaxation_table(cells)
    excess_table(tracks, given.seed)
    print("\nalpha_2 of Brownian rotation at D t = 0.05, 0.1, 0.25, 0.5, 1:")
    print(", ".join(f"{x:.5f}" for x in brownian_alpha2([0.05, 0.1, 0.25, 0.5, 1.0])))


if __name__ == "__main__":
    main()
