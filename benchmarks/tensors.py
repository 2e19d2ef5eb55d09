"""Planted tensors: bias, coverage of the errors, and levels of the tests of symmetry.

An irregular body of six particles, sigma/R = 0.03, principal axes at a slant to everything. SNR is
the mean of D dt over the mean noise variance of an orientation angle. Columns: along each true axis
the mean, the spread, the mean stated error (all over the planted value) and how often the 68 and
95 % intervals (normal) hold it; how often isotropy and axial symmetry are rejected at 5 %; how
often the error of an axis is given, and the true median error of these axes. Brackets: one
Monte-Carlo standard error.

Usage: python benchmarks/tensors.py [--tracks 2000] [--seed 0] [--cell NAME ...]
"""

import argparse
from typing import NamedTuple

import numpy as np

import perrin
from perrin.geometry.rotations import exp_map

SLANT = exp_map(np.array([0.4, -0.7, 0.3]))
BODY = perrin.Cluster.from_positions(np.random.default_rng(5).normal(size=(6, 3)))
SIGMA = 0.03 * BODY.R


class Cell(NamedTuple):
    """What is simulated, and how it is estimated."""

    ratio: tuple[float, float, float]
    snr: float = 9.0
    n_frames: int = 300
    blur: float = 0.0
    missing: float = 0.0
    options: dict | None = None


KNOWN = {"noise": "residual", "exposure": 0.0}
CELLS = {
    "isotropic": Cell((1, 1, 1)),
    "isotropic, SNR 1": Cell((1, 1, 1), snr=1),
    "isotropic, open shutter": Cell((1, 1, 1), blur=1.0),
    "isotropic, residual": Cell((1, 1, 1), options=KNOWN),
    "2:1:1": Cell((1, 1, 2)),
    "1:1.5:3": Cell((1, 1.5, 3)),
    "1:1.5:3, SNR 1": Cell((1, 1.5, 3), snr=1),
    "1:1.5:3, SNR 50": Cell((1, 1.5, 3), snr=50),
    "1:1.5:3, residual": Cell((1, 1.5, 3), options=KNOWN),
    "1:1.5:3, open shutter": Cell((1, 1.5, 3), blur=1.0),
    "1:1.5:3, half open, stated": Cell((1, 1.5, 3), blur=0.5, options={"exposure": 0.5}),
    "1:1.5:3, 10 % missing": Cell((1, 1.5, 3), missing=0.1),
    "1:1.1:2": Cell((1, 1.1, 2)),
    "1:1.1:2, 3000 frames": Cell((1, 1.1, 2), n_frames=3000),
}


def simulated(cell, rng):
    """Return a motion of one cell and the planted principal values."""
    floor = perrin.noise_floor(BODY, sigma=SIGMA)
    values = np.array(cell.ratio) / np.mean(cell.ratio)
    values = values * cell.snr * np.trace(floor.covariance) / 3
    parts = 10 if cell.blur else 1
    truth = perrin.simulate_motion(
        BODY,
        D_R=SLANT @ np.diag(values) @ SLANT.T,
        dt=1 / parts,
        n_frames=cell.n_frames * parts,
        rng=rng,
    )
    x = truth.positions().reshape(cell.n_frames, parts, *BODY.positions.shape)
    x = x[:, : max(1, round(parts * cell.blur))].mean(axis=1)
    x = perrin.add_noise(x, sigma=SIGMA, rng=rng)
    x[1:-1][rng.random(cell.n_frames - 2) < cell.missing] = np.nan
    return perrin.track_rotation(x, dt=1.0), values


def measured(cell, rng):
    """Return values and errors along the true axes, p-values, and the warnings about the axes."""
    motion, values = simulated(cell, rng)
    axes = perrin.kabsch(motion.template, BODY.positions) @ SLANT
    found = perrin.diffusion_tensor(motion, symmetry="C_1", **(cell.options or {}))
    along = np.array([found.along(axis) for axis in axes.T]) / values[:, None]
    off = np.degrees(np.arccos(np.minimum(np.abs(np.sum(found.axes * axes, axis=0)), 1)))
    known = found.resolved_axes
    return [*along.ravel(), found.p_isotropic, found.p_axial, *known, *np.where(known, off, np.nan)]


def listed(numbers):
    return " ".join(f"{x:.3f}" for x in numbers)


def reported(name, cell, tracks, seed):
    """Print one cell."""
    rows = np.array([measured(cell, np.random.default_rng([seed, k])) for k in range(tracks)])
    value, error = rows[:, 0:6:2], rows[:, 1:6:2]
    z = np.abs(value - 1) / error
    cover = [(z < 0.994).mean(axis=0), (z < 1.96).mean(axis=0)]
    rejected = (rows[:, 6:8] < 0.05).mean(axis=0)
    mc = np.sqrt(rejected * (1 - rejected) / tracks)
    columns = (
        " ".join(f"{v:.3f}" for v in value.mean(axis=0)) + f" ({value.std() / tracks**0.5:.3f})",
        " ".join(f"{v:.3f}" for v in value.std(axis=0))
        + f" ({value.std() / (2 * tracks) ** 0.5:.3f})",
        " ".join(f"{v:.3f}" for v in error.mean(axis=0)),
        " ".join(f"{c:.2f}/{d:.2f}" for c, d in zip(*cover, strict=True)),
        f"{rejected[0]:.3f}({mc[0]:.3f})",
        f"{rejected[1]:.3f}({mc[1]:.3f})",
        " ".join(f"{k:.2f}" for k in rows[:, 8:11].mean(axis=0)),
        " ".join(
            f"{np.median(off[known == 1]):.0f}" if (known == 1).any() else "-"
            for off, known in zip(rows[:, 11:].T, rows[:, 8:11].T, strict=True)
        ),
    )
    print(f"| {name} | " + " | ".join(columns) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tracks", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cell", nargs="*", choices=list(CELLS), default=list(CELLS))
    given = parser.parse_args()
    print(f"{given.tracks} tracks a cell, seed {given.seed}")
    print(
        "| cell | mean / planted | sd / planted | mean stderr | covers 68/95 % | "
        "isotropy rejected | axial rejected | axis known | median error then, deg |\n"
        + "|---" * 9
        + "|"
    )
    for name in given.cell:
        reported(name, CELLS[name], given.tracks, given.seed)


if __name__ == "__main__":
    main()
