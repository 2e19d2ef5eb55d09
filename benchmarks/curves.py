"""Straight lines and generalised least squares on curves against the bound, and their intervals.

Noisy Brownian walks in three dimensions, the noise unknown to the fit.

Usage: python benchmarks/curves.py [--seed S] [--tracks M] [--cells N:SNR ...]
"""

import argparse

import numpy as np

import perrin

CELLS = [(100, 0.05), (100, 5), (300, 0.2), (300, 1), (300, 20), (1000, 0.05), (1000, 50)]
FITS = {
    "paper's window": lambda curve: perrin.fit_line(curve, lag_range="paper"),
    "best window": perrin.fit_line,
    "gls": perrin.fit_gls,
}


def estimates(n_frames, snr, rng):
    """Return every fit to one track with D dt = 1."""
    walk = np.cumsum(rng.normal(scale=np.sqrt(2.0), size=(n_frames, 1, 3)), axis=0)
    walk += rng.normal(scale=snr**-0.5, size=walk.shape)
    curve = perrin.msd(walk, dt=1.0)
    return {name: fit(curve) for name, fit in FITS.items()}


def row(runs, bound):
    """Return one line of the table: what the estimates are worth."""
    count = len(runs)
    value = np.array([e.value for e in runs])
    scatter = value.std(ddof=1)
    ends = np.array([[r.ci68, r.ci95] for r in runs])
    cover = np.mean((ends[..., 0] <= 1) & (ends[..., 1] >= 1), axis=0)
    inside = " | ".join(f"{c:.3f}({1e3 * np.sqrt(c * (1 - c) / count):.0f})" for c in cover)
    stated = np.mean([e.stderr for e in runs])
    return (
        f"{100 * (value.mean() - 1):+.1f}({100 * scatter / np.sqrt(count):.1f}) | "
        f"{100 * scatter:.1f}({100 * scatter / np.sqrt(2 * count):.1f}) | "
        f"{(bound / scatter) ** 2:.2f}({(bound / scatter) ** 2 * np.sqrt(2 / count):.2f}) | "
        f"{stated / scatter:.2f} | {inside}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tracks", type=int, default=300)
    parser.add_argument("--cells", nargs="*", default=[f"{n}:{snr}" for n, snr in CELLS])
    given = parser.parse_args()
    print("| frames | SNR | fit | bias % | sd % | efficiency | error / sd | covers 68 % | 95 % |")
    print("|---|---|---|---|---|---|---|---|---|")
    for cell in given.cells:
        n_frames, snr = int(cell.split(":")[0]), float(cell.split(":")[1])
        rng = np.random.default_rng([given.seed, n_frames, round(1000 * snr)])
        runs = [estimates(n_frames, snr, rng) for _ in range(given.tracks)]
        bound = perrin.cramer_rao(n_frames=n_frames, snr=snr)
        for name in FITS:
            print(
                f"| {n_frames} | {snr:g} | {name} | {row([r[name] for r in runs], bound)} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
