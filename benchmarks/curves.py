"""Straight lines and generalised least squares on curves against the bound, and their intervals.

Noisy Brownian walks in three dimensions, the noise unknown to the fit.

Usage: python benchmarks/curves.py [--seed S] [--tracks M] [--cells FRAMES:SNR ...]
"""

import argparse

import numpy as np

import perrin

CELLS = ["100:0.05", "100:5", "300:0.2", "300:1", "300:20", "1000:0.05", "1000:50"]


def scatter_error(curve):
    """Fit the paper's window and believe the scatter about the line, as fitting programs do."""
    n = len(curve.lagtime) + 1
    use = slice(-(-3 * n // 220) - 1, n // 10)
    (slope, _), covariance = np.polyfit(curve.lagtime[use], curve.value[use], 1, cov=True)
    D, stderr = slope / (2 * curve.dof), np.sqrt(covariance[0, 0]) / (2 * curve.dof)
    return D, stderr, (D - stderr, D + stderr), (D - 1.96 * stderr, D + 1.96 * stderr)


def with_interval(estimate):
    """Return value, error and intervals of an estimate."""
    return estimate.value, estimate.stderr, estimate.ci68, estimate.ci95


FITS = {
    "paper's window, scatter about the line": scatter_error,
    "paper's window": lambda curve: with_interval(perrin.fit_line(curve, lag_range="paper")),
    "best window": lambda curve: with_interval(perrin.fit_line(curve)),
    "gls": lambda curve: with_interval(perrin.fit_gls(curve)),
}


def noisy_msd(n_frames, snr, rng):
    """Return the MSD of one track with D dt = 1."""
    walk = np.cumsum(rng.normal(scale=np.sqrt(2.0), size=(n_frames, 1, 3)), axis=0)
    walk += rng.normal(scale=snr**-0.5, size=walk.shape)
    return perrin.msd(walk, dt=1.0)


def row(runs, bound):
    """Return one line of the table: what the estimates are worth."""
    count = len(runs)
    value, stated = np.array([run[:2] for run in runs]).T
    ends = np.array([run[2:] for run in runs])
    cover = np.mean((ends[..., 0] <= 1) & (ends[..., 1] >= 1), axis=0)
    inside = " | ".join(f"{c:.3f}({1e3 * np.sqrt(c * (1 - c) / count):.0f})" for c in cover)
    scatter = value.std(ddof=1)
    efficiency = (bound / scatter) ** 2
    return (
        f"{100 * (value.mean() - 1):+.1f}({100 * scatter / np.sqrt(count):.1f}) | "
        f"{100 * scatter:.1f}({100 * scatter / np.sqrt(2 * count):.1f}) | "
        f"{efficiency:.2f}({efficiency * np.sqrt(2 / count):.2f}) | "
        f"{stated.mean() / scatter:.2f} | {inside}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tracks", type=int, default=300)
    parser.add_argument("--cells", nargs="*", default=CELLS)
    given = parser.parse_args()
    print("| frames | SNR | fit | bias % | sd % | efficiency | error / sd | covers 68 % | 95 % |")
    print("|---|---|---|---|---|---|---|---|---|")
    for cell in given.cells:
        n_frames, snr = int(cell.split(":")[0]), float(cell.split(":")[1])
        rng = np.random.default_rng([given.seed, n_frames, round(1000 * snr)])
        curves = [noisy_msd(n_frames, snr, rng) for _ in range(given.tracks)]
        bound = perrin.cramer_rao(n_frames=n_frames, snr=snr)
        for name, fit in FITS.items():
            line = row([fit(curve) for curve in curves], bound)
            print(f"| {n_frames} | {snr:g} | {name} | {line} |", flush=True)


if __name__ == "__main__":
    main()
