"""Bias, efficiency and cover of fitted fractional, confined and spinning motion.

Usage: python benchmarks/motion_models.py [--tracks N] [--seed N] [--quick]

Prints three tables for docs/validation.md: exponents of fractional motion, relaxation times and
sizes of cages, and spins with the D that is left, each with its Monte-Carlo error in brackets. The
bound is that of Cramer and Rao from the information of the sine modes. Limits are checked; the exit
status is the number of figures that miss theirs by more than three Monte-Carlo errors. --quick
takes 40 tracks a row.
"""

import argparse
import sys
from dataclasses import replace

import numpy as np
from scipy.linalg import cholesky, toeplitz

import perrin
from perrin.diffusion import (
    confined_autocovariance,
    difference_eigenvalues,
    fractional_autocovariance,
    sine_spectrum,
)
from perrin.geometry import cumulative_product, exp_map

CLUSTER = perrin.Cluster.tetrahedron(1.5)
LEAST_EFFICIENCY, COVER = 0.8, (0.92, 0.98)

# alpha, steps, signal-to-noise ratio, open fraction that is stated, data
FRACTIONAL = (
    (0.5, 100, 5, None),
    (0.5, 300, 0.5, None),
    (0.5, 300, 5, None),
    (0.5, 1000, 5, None),
    (0.8, 100, 5, None),
    (0.8, 300, 5, None),
    (0.8, 1000, 5, None),
    (1.0, 300, 5, None),
    (1.5, 100, 5, None),
    (1.5, 300, 5, None),
    (1.5, 1000, 5, None),
    (0.5, 300, 5, 1.0),
    (1.5, 300, 5, 1.0),
)
# Cage in rms steps of one axis, steps, signal-to-noise ratio
CONFINED = (
    (2, 100, 5),
    (2, 300, 5),
    (2, 1000, 0.5),
    (5, 100, 5),
    (5, 300, 5),
    (5, 1000, 5),
    (10, 1000, 5),
    (20, 1000, 5),
)
# Spin in rms steps of one axis, steps
SPIN = ((0.0, 300), (0.3, 300), (1.0, 300))


def motion_of(walk, noise, rng, **fields):
    """Return a motion whose centre is a walk (T, 3) with noise of this variance."""
    n = len(walk)
    if n not in motion_of.blank:
        motion_of.blank[n] = perrin.simulate_motion(CLUSTER, D_R=1e-3, dt=1.0, n_frames=n, rng=0)
    center = walk + np.sqrt(noise) * rng.normal(size=walk.shape)
    return replace(motion_of.blank[n], center=center, **fields)


motion_of.blank = {}


def bound(spectrum, noise, derivative, axes=3):
    """Return the least standard error of the shape parameter, D = 1 and the noise free."""
    c = 2 * difference_eigenvalues(len(spectrum))
    rows = np.stack([derivative, spectrum, c]) / (spectrum + noise * c)
    return np.sqrt(np.linalg.inv(0.5 * axes * rows @ rows.T)[0, 0])


def confined_walk(rate, n, rng):
    """Return n + 1 places of an Ornstein-Uhlenbeck process with D = 1 along three axes."""
    walk = rng.normal(size=(n + 1, 3)) / np.sqrt(rate)
    kept = np.exp(-rate)
    for i in range(1, n + 1):
        walk[i] = kept * walk[i - 1] + np.sqrt(1 - kept**2) * walk[i]
    return walk


class Table:
    """Rows of a table, and the number of figures outside their limits."""

    def __init__(self):
        self.missed = 0

    def checked(self, value, error, least=-np.inf, most=np.inf, digits=2):
        """Return a figure with its Monte-Carlo error, marked where it misses its limits."""
        bad = value < least - 3 * error or value > most + 3 * error
        self.missed += bad
        return f"{value:.{digits}f}({error:.{digits}f}){' MISSED' if bad else ''}"

    def cover(self, inside, limits=(-np.inf, np.inf)):
        """Return the share of intervals that contain the truth."""
        share = np.mean(inside)
        error = np.sqrt(max(share * (1 - share), 0.02) / len(inside))
        return self.checked(share, error, *limits)


def fractional_rows(table, tracks, rng):
    """Print the table of exponents."""
    print(
        "| alpha | N | SNR | exposure | bias | sd | bound | efficiency | 95 % | 68 % | MSD 68 % |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    for alpha, n, snr, exposure in FRACTIONAL:
        open_fraction = exposure or 0.0
        curve = [
            fractional_autocovariance(a, n, exposure=open_fraction)
            for a in (alpha, alpha - 1e-4, alpha + 1e-4)
        ]
        spectrum, less, more = (sine_spectrum(g) for g in curve)
        least = bound(spectrum, 1 / snr, (more - less) / 2e-4)
        factor = cholesky(toeplitz(curve[0]), lower=True)
        found = []
        for _ in range(tracks):
            walk = np.vstack([np.zeros(3), np.cumsum(factor @ rng.normal(size=(n, 3)), axis=0)])
            motion = motion_of(walk, 1 / snr, rng)
            found.append(perrin.fit_anomalous(motion, quantity="translation", exposure=exposure))
        values = np.array([f.alpha for f in found])
        inside = [
            [low <= alpha <= high for low, high in (getattr(f, name) for f in found)]
            for name in ("ci95", "ci68")
        ]
        msd = [
            abs(f.msd_at_best_lag - 6 * f.best_lag**alpha) < f.msd_at_best_lag_stderr for f in found
        ]
        sd, error = values.std(ddof=1), 1 / np.sqrt(2 * tracks)
        print(
            f"| {alpha} | {n} | {snr} | {exposure} | "
            f"{table.checked(values.mean() - alpha, sd / np.sqrt(tracks), digits=3)} | {sd:.3f} | "
            f"{least:.3f} | "
            f"{table.checked((least / sd) ** 2, 2 * error * (least / sd) ** 2, LEAST_EFFICIENCY)}"
            f" | {table.cover(inside[0], COVER)} | {table.cover(inside[1])} | {table.cover(msd)} |",
            flush=True,
        )


def confined_rows(table, tracks, rng):
    """Print the table of cages."""
    print(
        "| cage | N k | N | SNR | bias ln k | sd | bound | efficiency | 95 % | cage 95 % | "
        "D 95 % | cage/true (sd) | open |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|---|")
    for cage, n, snr in CONFINED:
        rate = 0.5 / cage**2
        near = rate * np.exp([0, -1e-4, 1e-4])
        spectrum, less, more = (sine_spectrum(confined_autocovariance(k, n)) for k in near)
        least = bound(spectrum, 1 / snr, (more - less) / 2e-4)
        found = []
        for _ in range(tracks):
            motion = motion_of(confined_walk(rate, n, rng), 1 / snr, rng)
            found.append(perrin.fit_confined(motion, quantity="translation"))
        truths = {
            "relaxation_time_ci95": 1 / rate,
            "cage_ci95": 1 / np.sqrt(rate),
            "D_short_ci95": 1.0,
        }
        limits = COVER if n * rate >= 6 else (0.9, 1.0)
        covers = [
            table.cover(
                [low <= truth <= high for low, high in (getattr(f, name) for f in found)], limits
            )
            for name, truth in truths.items()
        ]
        closed = np.array([f.resolved for f in found])
        finite = [f for f in found if np.isfinite(f.cage)]
        logs = -np.log([f.relaxation_time * rate for f in finite])
        sizes = np.array([f.cage for f in finite]) * np.sqrt(rate)
        sd, error = np.std(logs, ddof=1), 1 / np.sqrt(2 * tracks)
        worth = (least / sd) ** 2
        floor = LEAST_EFFICIENCY if n * rate >= 6 else -np.inf
        print(
            f"| {cage} | {n * rate:g} | {n} | {snr} | {np.mean(logs):.2f} | {sd:.2f} | {least:.2f}"
            f" | {table.checked(worth, 2 * error * worth, floor)} | {' | '.join(covers)} | "
            f"{np.mean(sizes):.2f} ({np.std(sizes):.2f}) | {1 - closed.mean():.0%} |",
            flush=True,
        )


def spin_rows(table, tracks, rng):
    """Print the table of spins: the lab's spin and D after it is removed."""
    print("| spin (steps) | N | spin/true | sd/stated | D/true | D uncorrected | D 95 % |")
    print("|---|---|---|---|---|---|---|")
    D = 0.003
    for size, n in SPIN:
        spin = size * np.sqrt(2 * D)
        axis = np.array([1.0, 2.0, 2.0]) / 3
        found = []
        for _ in range(tracks):
            steps = exp_map(np.sqrt(2 * D) * rng.normal(size=(n, 3)))
            # Turning of the lab's frame by the spin, applied from the left after every step.
            body = cumulative_product(steps) if spin == 0 else spun(steps, spin * axis)
            noisy = body @ exp_map(np.sqrt(D / 5) * rng.normal(size=(n + 1, 3)))
            motion = motion_of(np.zeros((n + 1, 3)), 0.0, rng, rotation=noisy)
            found.append(
                [perrin.estimate_diffusion(motion, drift=drift) for drift in (True, False)]
            )
        vector = np.array([f.drift[0] for f, _ in found])
        stated = np.array([f.drift_stderr[0] for f, _ in found])
        values = np.array([[f.value, g.value] for f, g in found]) / D
        inside = [f.ci95[0] <= D <= f.ci95[1] for f, _ in found]
        ratio = (vector @ axis) / spin if spin else vector @ axis
        pull = (vector - spin * axis) / stated
        spread, error = values.std(axis=0), 1 / np.sqrt(tracks)
        of_one = float(size > 0)
        width = ratio.std() * error
        print(
            f"| {size} | {n} | {table.checked(ratio.mean(), width, of_one, of_one, 3)} | "
            f"{table.checked(pull.std(), error / np.sqrt(6), 0.95, 1.05)} | "
            f"{table.checked(values[:, 0].mean(), spread[0] * error, 0.99, 1.01, 3)} | "
            f"{values[:, 1].mean():.3f} | {table.cover(inside, COVER)} |",
            flush=True,
        )


def spun(steps, spin):
    """Return the orientations of a body that makes these body steps in a lab frame that turns."""
    turn = exp_map(spin)
    rotation = [np.eye(3)]
    for step in steps:
        rotation.append(turn @ rotation[-1] @ step)
    return np.array(rotation)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--tracks", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--table", choices=("fractional", "confined", "spin"))
    options = parser.parse_args()
    tracks = 40 if options.quick else options.tracks
    table = Table()
    rows = {"fractional": fractional_rows, "confined": confined_rows, "spin": spin_rows}
    for name, print_rows in rows.items():
        if options.table in (None, name):
            print_rows(table, tracks, np.random.default_rng(options.seed))
            print()
    print(f"{table.missed} figures outside their limits")
    return table.missed


if __name__ == "__main__":
    sys.exit(main())
