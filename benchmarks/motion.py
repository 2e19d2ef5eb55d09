"""False alarms, power and names of `judge_motion`, for simulated motions of known kind.

Usage: python benchmarks/motion.py [--quick] [--jobs N] [TABLE ...]

The tables are those of docs/validation.md: "levels" (share of Brownian tracks that each test
rejects at 5 % and at 1 %, and the family of tests), "pools" (the same for one verdict on several
tracks), "bodies" (the same for tracks of bodies with
unequal axes, through particles and rigid fits), "power" (share of other motions that each test
rejects at 5 %) and "words" (what they are called). Steps of three axes are drawn directly for
levels and power; bodies and words go through `judge_motion`. The exit status is the number of
figures beyond their limit by more than three Monte-Carlo errors. --quick takes few tracks.
"""

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

import perrin
from perrin.diffusion import (
    AxisModel,
    approximate_p,
    brownian_tests,
    combined_p,
    confined_autocovariance,
    fractional_autocovariance,
    holm,
)
from perrin.diffusion.goodness_of_fit import TESTS

TETRAHEDRON = perrin.Cluster.tetrahedron(1.5)
# An irregular body of six particles, um.
IRREGULAR = perrin.Cluster.from_positions(
    [[0, 0, 0], [2, 0, 0], [0.3, 1.7, 0], [0.5, 0.4, 2.1], [-1.6, 0.5, 0.7], [1.2, 1.5, 1.4]]
)
# Limits of the share rejected at 5 % and 1 %, %, by test and for the family.
LEVEL, LEVEL_1, FAMILY = (4.3, 5.7), (0.7, 1.3), (0.0, 5.5)


def even_model(n_steps):
    """Return the model of even steps of three axes with a free offset, time in frames."""
    one = np.ones(n_steps)
    steady = np.broadcast_to(np.eye(3), (n_steps, 3, 3)).copy()
    linked = np.arange(n_steps) < n_steps - 1
    none = np.zeros((3, n_steps))
    return AxisModel(
        start=np.arange(float(n_steps)),
        tau=one,
        linked=linked,
        known=(none, none),
        blur=0.0,
        free=True,
        steady=steady,
    )


def steps_of_kind(kind, n_steps, tracks, rng):
    """Return noiseless steps (tracks, 3, N) of D = 1 of a kind such as "alpha 0.5"."""
    name, *numbers = kind.split()
    z = rng.standard_normal((tracks, 3, n_steps))
    if name in ("alpha", "cage"):
        value = float(numbers[0])
        g = (
            fractional_autocovariance(value, n_steps)
            if name == "alpha"
            else confined_autocovariance(1 / (2 * value**2), n_steps)
        )
        lags = np.abs(np.subtract.outer(np.arange(n_steps), np.arange(n_steps)))
        return z @ np.linalg.cholesky(g[lags]).T
    y = np.sqrt(2) * z
    if name == "drift":
        direction = rng.standard_normal((tracks, 3, 1))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        return y + float(numbers[0]) * np.sqrt(2) * direction
    if name == "switching":
        ratio, dwell = (float(x) for x in numbers)
        first = rng.integers(0, 2, (tracks, 1))
        fast = (first + np.cumsum(rng.random((tracks, n_steps)) < 1 / dwell, axis=1)) % 2
        return y * np.sqrt(np.where(fast, ratio, 1.0) * 2 / (1 + ratio))[:, None]
    if name == "growing":
        return y * np.sqrt(np.linspace(2 / 3, 4 / 3, n_steps))
    if name == "jumps":
        return y * np.where(rng.random((tracks, 1, n_steps)) < 0.01, 5.0, 1.0)
    if name == "student":
        return y / np.sqrt(rng.chisquare(5, (tracks, 1, n_steps)) / 3)
    if name == "shaken":
        phase = 2 * np.pi * (np.arange(n_steps + 1) / 20 + rng.random((tracks, 1)))
        y[:, 0] += np.sqrt(2) * np.diff(np.sin(phase))
    return y


def brownian_paths(n_steps, tracks, rng, *, substeps):
    """Return steps of Brownian motion with an open shutter, from means over substeps."""
    shape = (tracks, 3, n_steps + 1, substeps)
    walk = np.cumsum(rng.standard_normal((tracks, 3, shape[2] * substeps)), axis=-1)
    return np.diff(np.sqrt(2 / substeps) * walk.reshape(shape).mean(axis=-1), axis=-1)


def with_noise(steps, snr, rng):
    """Return the steps with those of the localisation noise of variance 1/SNR."""
    shape = (*steps.shape[:-1], steps.shape[-1] + 1)
    return steps + np.diff(rng.standard_normal(shape) / np.sqrt(snr), axis=-1)


def with_gaps(y, share, rng):
    """Return the model and the steps of one track (3, N) without a share of its frames."""
    frames = y.shape[-1] + 1
    keep = rng.random(frames) > share
    keep[[0, -1]] = True
    rows = np.flatnonzero(keep)
    places = np.concatenate([np.zeros((3, 1)), np.cumsum(y, axis=-1)], axis=-1)
    tau = np.diff(rows).astype(np.float64)
    model = even_model(len(tau))
    return (
        replace(
            model,
            start=rows[:-1].astype(np.float64),
            tau=tau,
            steady=model.steady * tau[:, None, None],
        ),
        np.diff(places[:, rows], axis=-1)[None],
    )


@dataclass(frozen=True)
class Cell:
    """Tracks of one kind: N steps, SNR, and what is done to them."""

    kind: str
    n_steps: int
    snr: float
    tracks: int
    open_shutter: bool = False
    missing: float = 0.0

    def __str__(self):
        text = f"{self.kind}, N = {self.n_steps}, SNR {self.snr:g}"
        text += ", shutter open" if self.open_shutter else ""
        return text + (f", {self.missing:.0%} of frames missing" if self.missing else "")


def p_values(cell, seed):
    """Return the p-values (tracks, tests) of all tracks of a cell."""
    rng = np.random.default_rng([seed, cell.n_steps, int(100 * cell.snr)])
    model = even_model(cell.n_steps)
    ranked = cell.n_steps < 200 or cell.n_steps * cell.snr < 10
    found = []
    batch = min(cell.tracks, 100)
    for _ in range(0, cell.tracks, batch):
        if cell.open_shutter:
            y = brownian_paths(cell.n_steps, batch, rng, substeps=12)
        else:
            y = steps_of_kind(cell.kind, cell.n_steps, batch, rng)
        y = with_noise(y, cell.snr, rng)
        if cell.missing:
            tests = [brownian_tests(*with_gaps(one, cell.missing, rng)) for one in y]
            found += [list(t.p.values()) for t in tests]
        elif ranked:
            found += [list(brownian_tests(model, one[None]).p.values()) for one in y]
        else:
            fit = model.fit(y)
            p = approximate_p(model, fit, model.scores(fit), model.squared_errors(fit))
            found += list(np.stack(list(p.values()), 1))
    return np.array(found)


def level_cells(quick):
    """Return the cells of the table of levels."""
    many, some, few = (200, 20, 0) if quick else (4000, 1000, 400)
    cells = [
        Cell("brownian", n, snr, many, open_shutter=shutter)
        for n in (300, 1000)
        for snr, shutter in ((0.5, False), (5, False), (50, False), (50, True))
    ]
    cells += [Cell("brownian", 100, snr, some) for snr in ((5,) if quick else (0.05, 0.5, 5, 50))]
    cells += [Cell("brownian", 50, snr, some) for snr in (() if quick else (0.05, 5))]
    cells += [Cell("brownian", 400, 5, some, missing=0.3)]
    cells += [Cell("brownian", 100, 5, few, missing=0.3)] if few else []
    return cells


def pool_row(task):
    """Return the line of one verdict on several tracks, and how many figures are beyond."""
    n_steps, tracks, pools, seed = task
    rng = np.random.default_rng([seed, n_steps, tracks])
    model, p = even_model(n_steps), []
    for _ in range(pools):
        y = with_noise(steps_of_kind("brownian", n_steps, tracks, rng), 5.0, rng)
        p.append(list(combined_p([brownian_tests(model, one[None]).summary for one in y]).values()))
    p, cells, bad = np.array(p), [], 0
    for one in p.T:
        at_5, at_1 = np.mean(one < 0.05), np.mean(one < 0.01)
        bad += beyond(at_5, pools, LEVEL) + beyond(at_1, pools, LEVEL_1)
        cells.append(f"{100 * at_5:.1f}/{100 * at_1:.1f}")
    family = np.mean([holm(one) < 0.05 for one in p])
    bad += beyond(family, pools, FAMILY)
    text = f"| {tracks} tracks, N = {n_steps}, SNR 5 | {pools} | "
    return text + " | ".join(cells) + f" | {percent(family, pools)} |", bad


POWER = {
    "alpha 0.5": ("fractional", 95),
    "alpha 0.8": ("fractional", 45),
    "alpha 1.5": ("fractional", 95),
    "cage 2": ("cage", 98),
    "cage 5": ("cage", 40),
    "drift 0.1": ("steady", 0),
    "drift 0.3": ("steady", 97),
    "switching 10 20": ("clustering", 98),
    "switching 2 20": ("clustering", 72),
    "growing": ("slow change", 85),
    "jumps": ("largest", 87),
    "student": ("tails", 95),
    "shaken": ("line", 0),
}


def percent(share, count):
    """Return a share in percent with its Monte-Carlo error."""
    error = 100 * np.sqrt(max(share * (1 - share), 0.5 / count) / count)
    return f"{100 * share:.1f}({error:.1f})"


def beyond(share, count, limits):
    """Return whether a share is outside limits (%) by more than three Monte-Carlo errors."""
    middle = np.clip(share, limits[0] / 100, limits[1] / 100)
    error = 3 * np.sqrt(max(middle * (1 - middle), 0.5 / count) / count)
    return bool(abs(share - middle) > error)


def level_row(task):
    """Return the line of one cell of levels, and how many figures are beyond their limits."""
    cell, seed = task
    p = p_values(cell, seed)
    count, cells, bad = len(p), [], 0
    for one in p.T:
        at_5, at_1 = np.mean(one < 0.05), np.mean(one < 0.01)
        bad += beyond(at_5, count, LEVEL) + beyond(at_1, count, LEVEL_1)
        cells.append(f"{100 * at_5:.1f}/{100 * at_1:.1f}")
    family = np.mean([holm(one) < 0.05 for one in p])
    bad += beyond(family, count, FAMILY)
    return f"| {cell} | {count} | " + " | ".join(cells) + f" | {percent(family, count)} |", bad


def power_row(task):
    """Return the line of one kind of motion, and whether its own test is too weak."""
    cell, seed = task
    p = p_values(cell, seed)
    shares = np.mean(p < 0.05, axis=0)
    test, least = POWER[cell.kind]
    bad = beyond(shares[TESTS.index(test)], len(p), (least, 100))
    family = np.mean([holm(one) < 0.05 for one in p])
    cells = " | ".join(f"{100 * share:.0f}" for share in shares)
    return f"| {cell} | {len(p)} | {cells} | {100 * family:.0f} |", int(bad)


def body_row(task):
    """Return the line of tracks of one body through particles and rigid fits."""
    name, quantity, tracks, seed = task
    body, axes, sigma_z = {
        "tetrahedron, sigma_z 2": (TETRAHEDRON, (1, 1, 1), 2.0),
        "irregular, D 1:1.5:3, sigma_z 2": (IRREGULAR, (1, 1.5, 3), 2.0),
    }[name]
    rng = np.random.default_rng([seed, len(name)])
    sigma = np.array([1.0, 1.0, sigma_z]) * 0.03
    noise = perrin.noise_floor(body, sigma=float(np.sqrt(np.mean(sigma**2)))).covariance
    D = 5 * np.trace(noise) / 3 * np.array(axes) / np.mean(axes)
    p = []
    for _ in range(tracks):
        truth = perrin.simulate_motion(
            body, D_R=D if np.ptp(axes) else D[0], D_T=5e-3, dt=1.0, n_frames=301, rng=rng
        )
        x = perrin.add_noise(truth.positions(), sigma=sigma, rng=rng)
        motion = perrin.track_rotation(x, dt=1.0)
        p.append(list(perrin.judge_motion(motion, quantity=quantity).p.values()))
    p = np.array(p)
    shares = np.mean(p < 0.05, axis=0)
    family = np.mean([holm(one) < 0.05 for one in p])
    bad = sum(beyond(share, tracks, (0, 7)) for share in shares) + beyond(family, tracks, FAMILY)
    cells = " | ".join(f"{100 * share:.1f}" for share in shares)
    return f"| {name}, {quantity} | {tracks} | {cells} | {percent(family, tracks)} |", bad


# Kinds of rotation: what is planted, the word for it, and the least share of it at N = 1000, %.
STEP = 0.05  # rms turn of a frame and axis, rad
WORDS = {
    "diffusion": (None, "diffusion", 90),
    "alpha 0.5": (perrin.Fractional(0.5), "subdiffusion", 85),
    "alpha 0.8": (perrin.Fractional(0.8), "subdiffusion", 85),
    "alpha 1.5": (perrin.Fractional(1.5), "superdiffusion", 85),
    "cage 2": (perrin.Confined(8.0), "confined", 85),
    "cage 5": (perrin.Confined(50.0), "confined", 85),
    "spin 0.3": (perrin.Spin((0.0, 0.0, 0.3 * STEP)), "spin", 85),
    "switching 10 20": (perrin.Switching(10.0, 20.0), "changing D", 85),
    "switching 10 100": (perrin.Switching(10.0, 100.0), "changing D", 85),
    "switching 2 20": (perrin.Switching(2.0, 20.0), "changing D", 85),
    "jumps": ("jumps", "jumps", 85),
    "student": ("student", "jumps", 85),
    "shaken": ("shaken", "vibration", 60),
}


def rotation_of_kind(name, frames, rng):
    """Return a noisy tetrahedron's motion of a kind; SNR about 8."""
    planted = WORDS[name][0]
    D = STEP**2 / 2
    if isinstance(planted, str):
        y = steps_of_kind(planted, frames - 1, 1, rng)[0].T * np.sqrt(D)
        turns = perrin.geometry.cumulative_product(perrin.geometry.exp_map(y))
        truth = perrin.simulate_motion(TETRAHEDRON, D_R=0.0, dt=1.0, n_frames=frames, rng=rng)
        truth = replace(truth, rotation=turns)
    else:
        truth = perrin.simulate_motion(
            TETRAHEDRON, D_R=D, dt=1.0, n_frames=frames, dynamics=planted, rng=rng
        )
    x = perrin.add_noise(truth.positions(), sigma=0.03, rng=rng)
    return perrin.track_rotation(x, dt=1.0)


def word_row(task):
    """Return the line of one kind of motion: how often each word is given."""
    name, frames, tracks, seed = task
    rng = np.random.default_rng([seed, frames, sorted(WORDS).index(name)])
    kinds = [perrin.judge_motion(rotation_of_kind(name, frames, rng)).kind for _ in range(tracks)]
    _, word, least = WORDS[name]
    share = np.mean([kind == word for kind in kinds])
    bad = frames > 1000 and beyond(share, tracks, (least, 100))
    counts = {kind: kinds.count(kind) for kind in sorted(set(kinds), key=kinds.count, reverse=True)}
    found = ", ".join(f"{kind} {100 * n / tracks:.0f}" for kind, n in counts.items())
    return f"| {name} | {frames - 1} | {tracks} | {percent(share, tracks)} {word} | {found} |", bad


def tables(quick, seed):
    """Return every table: its title, its head, its function and its tasks."""
    tests = " | ".join(TESTS)
    few, some, words = (0, 60, 3) if quick else (400, 600, 100)
    lengths = (1001,) if quick else (301, 1001)
    return {
        "levels": (
            f"| Brownian steps | tracks | {tests} | family at 5 % |",
            level_row,
            [(cell, seed) for cell in level_cells(quick)],
        ),
        "pools": (
            f"| tracks of Brownian steps | pools | {tests} | family at 5 % |",
            pool_row,
            [(300, 5, 20, seed)] if quick else [(60, 20, 300, seed), (300, 5, 1000, seed)],
        ),
        "bodies": (
            f"| body | tracks | {tests} | family at 5 % |",
            body_row,
            [
                (name, quantity, few or 10, seed)
                for name in ("tetrahedron, sigma_z 2", "irregular, D 1:1.5:3, sigma_z 2")
                for quantity in ("rotation", "translation")
            ],
        ),
        "power": (
            f"| motion | tracks | {tests} | family |",
            power_row,
            [(Cell(kind, 300, 5, some), seed) for kind in POWER],
        ),
        "words": (
            "| rotation | N | tracks | right word, % | all words, % |",
            word_row,
            [(name, frames, words, seed) for name in WORDS for frames in lengths],
        ),
    }


def main():
    """Print the tables; the exit status is the number of figures beyond their limits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "table", nargs="*", help="levels, pools, bodies, power, words; all by default"
    )
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    bad = 0
    with ProcessPoolExecutor(options.jobs) as pool:
        for name, (head, row, tasks) in tables(options.quick, options.seed).items():
            if options.table and name not in options.table:
                continue
            print(f"\n{name}\n\n{head}\n|{'---|' * (head.count('|') - 1)}", flush=True)
            for line, beyond_limit in pool.map(row, tasks):
                print(line + (" beyond the limit" if beyond_limit else ""), flush=True)
                bad += int(beyond_limit)
    print(f"\n{bad} figures beyond their limits")
    return bad


if __name__ == "__main__":
    sys.exit(main())
