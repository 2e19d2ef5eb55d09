"""Coverage of the intervals of population means: `python benchmarks/study_coverage.py [--quick]`.

Populations of 2 to 50 clusters in 1 to 10 movies are drawn with ln D normal between clusters and
between movies. A cluster of N steps without noise has the exact likelihood of 3 N normal numbers;
the numbers of steps are log-uniform from 10 to 300. With --tracks the clusters are simulated as
motions with localisation errors and estimated by `estimate_diffusion`.
"""

from __future__ import annotations

import argparse
import time
import warnings

import numpy as np

import perrin
from perrin.diffusion.estimate import NORMAL
from perrin.study import Coefficient, PopulationMean, population_mean

ROOTS = np.array([-NORMAL[0.95], -NORMAL[0.68], 0.0, NORMAL[0.68], NORMAL[0.95]])
SPREADS = ((0.0, 0.0), (0.2, 0.0), (0.0, 0.3), (0.2, 0.2), (0.5, 0.5))
# Number of movies, and of clusters in a movie: fixed, or uniform from the first to the second.
DESIGNS = (
    (1, (2, 2)), (1, (5, 5)), (1, (50, 50)),
    (2, (1, 1)), (2, (1, 5)), (2, (10, 25)),
    (3, (1, 5)), (5, (1, 1)), (5, (1, 3)), (5, (2, 10)), (10, (1, 1)), (10, (1, 9)),
)  # fmt: skip


def exact_coefficient(D: float, steps: int, rng: np.random.Generator) -> Coefficient:
    """Return the estimate of D from steps without noise, with exact likelihood intervals."""
    count = 3 * steps
    u = np.linspace(-3, 8, 8001)
    roots = np.sign(u) * np.sqrt(count * np.maximum(u + np.exp(-u) - 1, 0))
    low95, low68, value, high68, high95 = (
        D * rng.chisquare(count) / count * np.exp(np.interp(ROOTS, roots, u))
    )
    return Coefficient(value, (low68, high68), (low95, high95))


def tracked_coefficient(D: float, steps: int, rng: np.random.Generator) -> perrin.DiffusionEstimate:
    """Return D_R of a simulated tetrahedron with localisation errors of 30 nm."""
    body = perrin.Cluster.tetrahedron(1.5)
    truth = perrin.simulate_motion(body, D_R=5e-3 * D, dt=0.73, n_frames=steps + 1, rng=rng)
    noisy = perrin.add_noise(truth.positions(), sigma=0.03, rng=rng)
    return perrin.estimate_diffusion(perrin.track_rotation(noisy, dt=0.73))


def covered(
    design: tuple[int, tuple[int, int]],
    spread: tuple[float, float],
    *,
    repeats: int,
    rng: np.random.Generator,
    tracks: bool = False,
) -> dict[str, float]:
    """Return how often the intervals contain the planted values."""
    (k, (fewest, most)), (between_clusters, between_movies) = design, spread
    hits = np.zeros(5)
    separated = 0
    unit = 5e-3 if tracks else 1.0
    for _ in range(repeats):
        shift = rng.normal(0, between_movies, k)
        movie = np.repeat(np.arange(k), rng.integers(fewest, most + 1, k))
        D = np.exp(shift[movie] + rng.normal(0, between_clusters, movie.size))
        steps = np.exp(rng.uniform(np.log(10), np.log(300), movie.size)).round().astype(int)
        make = tracked_coefficient if tracks else exact_coefficient
        found = [make(one, n, rng) for one, n in zip(D, steps, strict=True)]
        mean = population_mean(found, movies=movie.tolist())
        planted = unit * np.exp(shift[0] if k == 1 else 0.0)
        spread_here = between_clusters
        if mean.spread_movies is None and k > 1:
            spread_here = float(np.hypot(between_clusters, between_movies))
        hits[0] += mean.ci95[0] <= planted <= mean.ci95[1]
        hits[1] += mean.ci68[0] <= planted <= mean.ci68[1]
        hits[2] += mean.spread_clusters_ci95[0] <= spread_here <= mean.spread_clusters_ci95[1]
        if mean.spread_movies_ci95 is not None:
            separated += 1
            hits[3] += mean.spread_movies_ci95[0] <= between_movies <= mean.spread_movies_ci95[1]
        hits[4] += normal_covers(found, movie, mean, planted)
    hits[3] = hits[3] / separated if separated else np.nan
    hits[[0, 1, 2, 4]] /= repeats
    names = ("ci95", "ci68", "spread_clusters", "spread_movies", "normal")
    return dict(zip(names, map(float, hits), strict=True))


def normal_covers(
    found: list[Coefficient], movie: np.ndarray, mean: PopulationMean, planted: float
) -> bool:
    """Return whether the usual interval, 1.96 standard errors with these spreads, covers."""
    centre = np.log([one.value for one in found])
    error = np.array([np.log(one.ci95[1] / one.ci95[0]) / 2 / 1.96 for one in found])
    inner = 1 / (error**2 + mean.spread_clusters**2)
    weight = np.bincount(movie, inner)
    each, variance = np.bincount(movie, inner * centre) / weight, 1 / weight
    outer = 1 / (variance + (mean.spread_movies or 0.0) ** 2)
    middle = float(outer @ each / outer.sum())
    return bool(abs(np.log(planted) - middle) <= 1.96 / np.sqrt(outer.sum()))


def main() -> int:
    """Print a table of all designs; the status counts those that fail."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="40 repeats of every design")
    parser.add_argument("--tracks", action="store_true", help="simulated motions, not exact laws")
    parser.add_argument("--designs", default="", help="numbers of the designs: 0,3")
    stated = parser.parse_args()
    repeats = 40 if stated.quick else stated.repeats
    chosen = [int(k) for k in stated.designs.split(",") if k] or range(len(DESIGNS))
    warnings.simplefilter("ignore", perrin.PrecisionWarning)
    failures, start = 0, time.perf_counter()
    print("movies clusters  spread: clusters movies |  95 %  68 %  spreads' 95 %  | normal 95 %")
    for number in chosen:
        for spread in SPREADS:
            rng = np.random.default_rng([stated.seed, number, SPREADS.index(spread)])
            design = DESIGNS[number]
            found = covered(design, spread, repeats=repeats, rng=rng, tracks=stated.tracks)
            # Three Monte-Carlo errors are allowed on top of the bounds.
            error = np.sqrt(0.95 * 0.05 / repeats)
            most = 0.97 if design[0] >= 5 else 1.0
            wrong = not 0.93 - 3 * error <= found["ci95"] <= most + 3 * error
            failures += wrong
            k, (fewest, several) = design
            print(
                f"{k:6d} {fewest:3d}-{several:2d}  {spread[0]:.1f} {spread[1]:.1f} | "
                f"{found['ci95']:.3f} {found['ci68']:.3f}  {found['spread_clusters']:.3f} "
                f"{found['spread_movies']:.3f} | {found['normal']:.3f}{'  FAILS' * wrong}",
                flush=True,
            )
    print(
        f"{repeats} populations a line, Monte-Carlo error of 0.95: {error:.4f}; "
        f"{failures} fail; {time.perf_counter() - start:.0f} s"
    )
    return failures


if __name__ == "__main__":
    raise SystemExit(main())
