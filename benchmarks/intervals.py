"""Efficiency, bias and coverage of the estimates, for simulated tracks with known values.

Usage: python benchmarks/intervals.py [--tracks N] [--seed N] [--quick] [--paper]

Prints a table for docs/validation.md: for each cell (body, frames, signal-to-noise ratio, what is
done to the track) and each estimator the bias, the spread, the efficiency (Cramer-Rao bound over
variance) and the coverage of both intervals, each with its Monte-Carlo error in brackets. Limits of
an estimator are checked; the exit status is the number of figures that miss theirs by
more than three Monte-Carlo errors. --quick takes 60 tracks a cell. --paper adds the paper's own
procedure (chained rotations, straight line in the paper's window, error from the scatter about
the line), which misses nearly all of them.
"""

import argparse
import sys
import warnings
from dataclasses import dataclass

import numpy as np

import perrin

SIGMA_OVER_R, R = 0.03, 1.5
BODIES = {
    "tetrahedron": perrin.Cluster.tetrahedron(R),
    "pentahedron": perrin.Cluster.pentahedron(R),
    "trimer": perrin.Cluster.trimer(R),
}
# The lines: least efficiency, cover of the 68 % and the 95 % interval, greatest bias in standard
# deviations.
LINES = {"efficiency": 0.90, "cover68": (0.66, 0.72), "cover95": (0.93, 0.97), "bias": 0.3}
SHORT = LINES | {"cover68": (0.62, 0.74)}
TRIMER = LINES | {"efficiency": 0.85}
GAPS = {"cover95": (0.92, 1.0), "percent": 2.0}
BLUR = {"percent": 1.0}
COVER = {"cover68": LINES["cover68"], "cover95": LINES["cover95"]}


@dataclass(frozen=True)
class Cell:
    """One kind of track, and the lines that estimates of it must keep."""

    body: str
    frames: int
    snr: float
    lines: dict
    missing: float = 0.0
    substeps: int = 1
    axes: tuple = (1.0, 1.0, 1.0)
    sigma_z: float = 1.0
    quantity: str = "rotation"

    def __str__(self):
        text = f"{self.body}, {self.frames} frames, SNR {self.snr:g}"
        text += ", D_T" if self.quantity == "translation" else ""
        text += f", axes {self.axes[0]:g}:{self.axes[1]:g}:{self.axes[2]:g}" if self.uneven else ""
        text += f", sigma_z {self.sigma_z:g} times sigma_xy" if self.sigma_z != 1 else ""
        text += f", {self.missing:.0%} missing" if self.missing else ""
        return text + (", full blur" if self.substeps > 1 else "")

    @property
    def uneven(self):
        """Whether the axes of the body diffuse unequally."""
        return len(set(self.axes)) > 1

    @property
    def sigma(self):
        """Localisation error of each axis, um; its mean square is the same in all cells."""
        sigma = np.array([1.0, 1.0, self.sigma_z])
        return SIGMA_OVER_R * R * sigma / np.sqrt(np.mean(sigma**2))


CELLS = (
    Cell("tetrahedron", 100, 5, SHORT),
    Cell("tetrahedron", 300, 1, LINES),
    Cell("tetrahedron", 300, 20, LINES),
    Cell("tetrahedron", 1000, 50, LINES),
    Cell("pentahedron", 300, 0.2, LINES),
    Cell("trimer", 300, 5, TRIMER),
    Cell("tetrahedron", 300, 5, GAPS, missing=0.3),
    Cell("tetrahedron", 300, 5, BLUR, substeps=20),
    Cell("tetrahedron", 300, 5, COVER, axes=(1, 1, 4)),
    Cell("tetrahedron", 300, 2, COVER, sigma_z=3, quantity="translation"),
    Cell("tetrahedron", 300, 2, COVER, sigma_z=5, quantity="translation"),
)
METHODS = {
    "joint": lambda track: perrin.estimate_diffusion(track.motion, quantity=track.quantity),
    "residual": lambda track: perrin.estimate_diffusion(
        track.motion, quantity=track.quantity, noise="residual", exposure=track.exposure
    ),
}


@dataclass(frozen=True)
class Track:
    """Noisy positions, the motion fitted to them, the open shutter, and what is asked for."""

    positions: np.ndarray
    motion: perrin.RigidMotion
    exposure: float
    quantity: str


def planted(cell):
    """Return the D (per frame) of a cell: the noise variance of a coordinate times the ratio."""
    if cell.quantity == "translation":
        return cell.snr * (SIGMA_OVER_R * R) ** 2 / len(BODIES[cell.body].positions)
    covariance = perrin.noise_floor(BODIES[cell.body], sigma=SIGMA_OVER_R * R).covariance
    return cell.snr * np.trace(covariance) / 3


def simulate(cell, rng):
    """Return one track of a cell; substeps within a frame are averaged, as an open shutter does."""
    D = planted(cell) if cell.quantity == "rotation" else 1e-3
    truth = perrin.simulate_motion(
        BODIES[cell.body],
        D_R=D * np.array(cell.axes) / np.mean(cell.axes) if cell.uneven else D,
        D_T=planted(cell) if cell.quantity == "translation" else 0.0,
        dt=1 / cell.substeps,
        n_frames=cell.frames * cell.substeps,
        rng=rng,
    )
    x = truth.positions()
    x = x.reshape(cell.frames, cell.substeps, *x.shape[1:]).mean(axis=1)
    x = perrin.add_noise(x, sigma=cell.sigma, rng=rng)
    x[1:-1][rng.random(cell.frames - 2) < cell.missing] = np.nan
    return Track(x, perrin.track_rotation(x, dt=1.0), float(cell.substeps > 1), cell.quantity)


@dataclass(frozen=True)
class Simple:
    """Value and intervals of a procedure that is not perrin's own."""

    value: float
    ci68: tuple
    ci95: tuple


def by_the_paper(track):
    """Return the slope of the MSAD of chained rotations, its error from the scatter."""
    motion = perrin.track_rotation(track.positions, dt=1.0, reference="previous")
    curve = perrin.msad(motion)
    count = len(curve.lagtime) + 1
    use = slice(max(round(count * 3 / 220) - 1, 0), max(count // 10, 4))
    (slope, _), scatter = np.polyfit(curve.lagtime[use], curve.value[use], 1, cov=True)
    value, error = slope / 4, np.sqrt(scatter[0, 0]) / 4
    return Simple(
        value, (value - error, value + error), (value - 1.96 * error, value + 1.96 * error)
    )


def bound(cell, method):
    """Return the least relative standard error: residuals where used, else noise unknown."""
    noise = "residual" if method == "residual" else "joint"
    particles = len(BODIES[cell.body].positions)
    freedom = 3 * particles - 6
    return perrin.cramer_rao(n_frames=cell.frames, snr=cell.snr, noise=noise, residual_dof=freedom)


def judge(cell, method, estimates):
    """Return every figure of one method in one cell: value, Monte-Carlo error, and its line."""
    truth, count = planted(cell), len(estimates)
    values = np.array([e.value for e in estimates]) / truth
    spread = values.std(ddof=1)
    kurtosis = np.mean((values - values.mean()) ** 4) / values.var() ** 2
    figures = {"bias %": (100 * (values.mean() - 1), 100 * spread / np.sqrt(count), None)}
    figures["spread %"] = (100 * spread, 50 * spread * np.sqrt((kurtosis - 1) / count), None)
    if "percent" in cell.lines and method != "paper":
        line = (-cell.lines["percent"], cell.lines["percent"])
        figures["bias %"] = (*figures["bias %"][:2], line)
    if "bias" in cell.lines:
        line = 100 * cell.lines["bias"] * spread
        figures["bias %"] = (*figures["bias %"][:2], (-line, line))
    if "efficiency" in cell.lines:
        efficiency = (bound(cell, method) / spread) ** 2
        error = efficiency * np.sqrt((kurtosis - 1) / count)
        figures["efficiency"] = (efficiency, error, (cell.lines["efficiency"], np.inf))
    for name in ("cover68", "cover95"):
        intervals = [getattr(e, name.replace("cover", "ci")) for e in estimates]
        cover = np.mean([low <= truth <= high for low, high in intervals])
        p = np.clip(cover, 0.5 / count, 1 - 0.5 / count)
        figures[name] = (cover, np.sqrt(p * (1 - p) / count), cell.lines.get(name))
    return figures


def missed(figures):
    """Return the names of the figures beyond their line by more than three Monte-Carlo errors."""
    return [
        name
        for name, (value, error, line) in figures.items()
        if line and not line[0] - 3 * error <= value <= line[1] + 3 * error
    ]


def run(cell, methods, *, tracks, seed):
    """Simulate one cell and return the figures of every method."""
    found = {name: [] for name in methods}
    for k in range(tracks):
        track = simulate(cell, np.random.default_rng([seed, k]))
        for name, estimate in methods.items():
            found[name].append(estimate(track))
    return {name: judge(cell, name, estimates) for name, estimates in found.items()}


def shown(figures, name):
    """Write a figure with its Monte-Carlo error; a star where it misses its line."""
    if name not in figures:
        return "-"
    value, error, line = figures[name]
    digits = 1 if "%" in name else 3
    star = ""
    if line and not line[0] <= value <= line[1]:
        star = "*" if name not in missed(figures) else "**"
    return f"{value:.{digits}f}({error:.{digits}f}){star}"


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tracks", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--paper", action="store_true")
    asked = parser.parse_args(argv)
    warnings.simplefilter("ignore", perrin.PrecisionWarning)
    methods = METHODS | ({"paper": by_the_paper} if asked.paper else {})
    columns = ("bias %", "spread %", "efficiency", "cover68", "cover95")
    print("| cell | noise | " + " | ".join(columns) + " |")
    print("|---|---|" + "---|" * len(columns))
    failures = 0
    for cell in CELLS:
        found = run(cell, methods, tracks=60 if asked.quick else asked.tracks, seed=asked.seed)
        for name, figures in found.items():
            print(f"| {cell} | {name} | " + " | ".join(shown(figures, c) for c in columns) + " |")
            failures += len(missed(figures)) if name != "paper" else 0
        sys.stdout.flush()
    print(f"\n{failures} figures beyond their line by more than three Monte-Carlo errors")
    return min(failures, 100)


if __name__ == "__main__":
    raise SystemExit(main())
