"""Two states of diffusion: false calls, bias, errors and cover of `fit_switching`.

Usage: python benchmarks/motion_switching.py [--tracks N] [--seed N] [--quick] [--cell N]

Prints a table for docs/validation.md. Each line is a tetrahedron with localisation noise, fitted
with the noise free: mean and spread of D_slow, D_fast and D_mean over the truth (D_mean: over the
long-time mean), dwell times over the truth (median), share of steps whose state is right, cover of
the 95 % intervals, and how often two states are called (BIC). Limits are checked; the exit status
is the number of figures that miss theirs by more than three Monte-Carlo errors.
--quick takes 12 tracks a cell.
"""

import argparse
import sys
import warnings

import numpy as np

import perrin
from perrin.diffusion import fit_switching, steps_of
from perrin.motion import fast_states

BODY = perrin.Cluster.tetrahedron(1.5)
D = 1e-3
# Steps, signal-to-noise ratio D dt/s of the mean D, ratio of the two, mean dwell in frames.
CELLS = [
    (300, 5, 1, 20),
    (300, 50, 1, 20),
    (1000, 5, 1, 20),
    (300, 5, 2, 50),
    (300, 5, 10, 20),
    (300, 50, 10, 20),
    (1000, 5, 2, 50),
    (1000, 5, 10, 20),
    (1000, 5, 10, 100),
    (1000, 50, 10, 100),
]


def planted(cell, seed, *, dt=1.0):
    """Return a noisy motion of one cell, and which of its steps were fast."""
    count, snr, ratio, dwell = cell
    dynamics = perrin.Switching(ratio, dwell=dwell * dt) if ratio > 1 else None
    truth = perrin.simulate_motion(
        BODY, D_R=D, dt=dt, n_frames=count + 1, dynamics=dynamics, rng=np.random.default_rng(seed)
    )
    # The states are the first numbers that the simulation draws.
    fast = fast_states(1 / dwell, count, generator=np.random.default_rng(seed))
    sigma = np.sqrt(D * dt / snr / steps_of(truth, "rotation").complete)
    positions = perrin.add_noise(truth.positions(), sigma=sigma, rng=seed + 1_000_000)
    return perrin.track_rotation(positions, dt=dt), fast


def measure(cell, *, tracks, seed, noise="joint"):
    """Return figures of one cell: name -> (value, Monte-Carlo error)."""
    ratio, dwell = cell[2:]
    true = {"D_slow": 2 * D / (1 + ratio), "D_fast": 2 * ratio * D / (1 + ratio), "D_mean": D}
    true |= {"dwell_slow": dwell, "dwell_fast": dwell}
    found, right = [], []
    for number in range(tracks):
        motion, fast = planted(cell, seed + number)
        found.append(fit_switching(motion, noise=noise))
        right.append(np.mean((found[-1].states[0][1:] == 1) == fast))
    called = np.array([f.two_states for f in found])
    figures = {"two states %": (100 * called.mean(), 100 * share_error(called))}
    if ratio == 1:
        gain = [2 * f.log_likelihood_gain for f in found]
        figures["2 dl 95 %"] = (float(np.quantile(gain, 0.95)), np.nan)
    for name, value in true.items() if ratio > 1 else [("D_mean", D)]:
        parameters = [getattr(f, name) for f in found]
        values = np.array([p.value for p in parameters]) / value
        if name.startswith("D"):
            figures[name] = (values.mean(), values.std() / np.sqrt(tracks))
            figures[f"sd {name}"] = (values.std(), values.std() / np.sqrt(2 * tracks))
        else:
            figures[name] = (float(np.median(values)), 1.25 * values.std() / np.sqrt(tracks))
        inside = np.array([p.ci95[0] <= value <= p.ci95[1] for p in parameters])
        figures[f"cover {name}"] = (inside.mean(), share_error(inside))
    if ratio > 1:
        figures["right %"] = (100 * np.mean(right), 100 * np.std(right) / np.sqrt(tracks))
    return figures


def share_error(flags):
    """Return the standard error of a share, never below that of one in all."""
    share = np.clip(flags.mean(), 1 / (len(flags) + 2), 1 - 1 / (len(flags) + 2))
    return float(np.sqrt(share * (1 - share) / len(flags)))


def missed(cell, figures):
    """Return the names of the figures beyond their limit by more than three errors."""
    limits = {"two states %": (0, 1)}
    if cell[2] > 1:
        limits = {"D_slow": (0.9, 1.1), "D_fast": (0.93, 1.07), "right %": (85, 100)}
        limits |= {f"cover {name}": (0.92, 0.98) for name in ("D_slow", "D_fast")}
    return [
        name
        for name, (low, high) in limits.items()
        if not low - 3 * figures[name][1] <= figures[name][0] <= high + 3 * figures[name][1]
    ]


def main(argv=None):
    """Print the table; return the number of figures that miss their limit."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tracks", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--cell", type=int, help="number of one cell")
    parser.add_argument("--noise", default="joint")
    asked = parser.parse_args(argv)
    warnings.simplefilter("ignore", perrin.PrecisionWarning)
    failures = 0
    for number, cell in enumerate(CELLS):
        if asked.cell not in (None, number):
            continue
        figures = measure(
            cell, tracks=12 if asked.quick else asked.tracks, seed=asked.seed, noise=asked.noise
        )
        bad = missed(cell, figures)
        failures += len(bad)
        count, snr, ratio, dwell = cell
        print(f"N = {count}, SNR {snr:g}, ratio {ratio:g}, dwell {dwell:g} frames:")
        for name, (value, error) in figures.items():
            print(f"    {name:<18}{value:9.3f} +- {error:.3f}{' **' if name in bad else ''}")
        sys.stdout.flush()
    print(f"\n{failures} figures beyond their limit by more than three Monte-Carlo errors")
    return min(failures, 100)


if __name__ == "__main__":
    raise SystemExit(main())
