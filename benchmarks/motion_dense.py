"""What is plotted of dense systems, on motions with known truth: four tables with their errors.

D of long times in cages, correlation of translation and rotation in time and over clusters, and
viscoelastic moduli. Numbers in brackets are Monte-Carlo standard errors in the last digits.

Usage: python benchmarks/motion_dense.py [--quick] [--seed S] [--tables NAME ...]
"""

import argparse
import sys
from dataclasses import replace
from math import gamma
from pathlib import Path

import numpy as np

import perrin
from perrin._text import number_text, with_error

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from dense_motions import caged, fractional_walk, moving, switching_speed

KT = 1.380649e-23 * 300 * 1e18  # Pa um^3


def mean_text(values):
    """Write a mean with its standard error."""
    return number_text(np.mean(values), np.std(values, ddof=1) / np.sqrt(len(values)))


def share_text(hits):
    """Write a share in percent with its standard error."""
    share = np.mean(hits)
    return with_error(
        100 * share, 100 * np.sqrt(max(share * (1 - share), 0.1 / len(hits)) / len(hits))
    )


def long_times(rng, *, quick):
    """Long-time D of cages with and without hops, by the rule of the threshold."""
    frames, tracks = (2000, 8) if quick else (6000, 60)
    motions = {
        "cage only": ({}, 0.0),
        "hops 0.8 rad each 100 frames": ({"hop": 0.8}, 0.64 / 600),
        "the same, noise x5": ({"hop": 0.8, "noise": 2e-3}, 0.64 / 600),
        "hops 0.3 rad each 100": ({"hop": 0.3}, 0.09 / 600),
        "cage relaxing in 1 frame, hops 0.8": ({"hop": 0.8, "relaxation": 1.0}, 0.64 / 600),
        "cage relaxing in 20 frames, hops 0.8": ({"hop": 0.8, "relaxation": 20.0}, 0.64 / 600),
    }
    print(f"\nLong-time D, {tracks} tracks of {frames} frames, cage 0.1 rad")
    print("| motion | true D | steps | threshold | mean D | sd | stated | 68 % | 95 % | resolved |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, (settings, truth) in motions.items():
        tracks_ = [caged(frames, rng, **settings) for _ in range(tracks)]
        steps = mean_text([perrin.estimate_diffusion(m).value for m in tracks_[:4]])
        for threshold in (None, 0.0, 0.5, 0.8):
            found = [perrin.long_time_diffusion(m, threshold=threshold) for m in tracks_]
            value = [f.value for f in found]
            inside = (
                share_text([getattr(f, ci)[0] <= truth <= getattr(f, ci)[1] for f in found])
                for ci in ("ci68", "ci95")
            )
            stated = np.sqrt(np.mean([f.stderr**2 for f in found]))
            chosen = f"{np.median([f.threshold for f in found]):.2f}"
            print(
                f"| {name} | {truth:.3g} | {steps} | {chosen}{' (rule)' * (threshold is None)} | "
                f"{mean_text(value)} | {np.std(value, ddof=1):.2g} | {stated:.2g} | "
                f"{' | '.join(inside)} | {share_text([f.resolved for f in found])} % |",
                flush=True,
            )


def in_time(rng, *, quick):
    """Correlation of translational and rotational mobility in time."""
    cases = [
        ("Brownian", False, 1, 5.0),
        ("both intermittent (x10), independent", False, 10, 5.0),
        ("common x10", True, 10, 5.0),
        ("common x10", True, 10, 0.5),
        ("common x2", True, 2, 5.0),
    ]
    print("\nTranslation and rotation in time, dwell 20 steps, tests at 5 %")
    print("| motion | SNR | steps | runs | mean rho | sd | stated | found, % | uncorrected, % |")
    print("|---|---|---|---|---|---|---|---|---|")
    for steps, runs in ((300, 60 if quick else 1000), (1000, 30 if quick else 400)):
        for name, common, ratio, snr in cases:
            found = []
            for _ in range(runs):
                one = switching_speed(steps, rng, ratio=ratio, dwell=20)
                two = one if common else switching_speed(steps, rng, ratio=ratio, dwell=20)
                motion = moving(one, two, rng, snr=snr)
                found.append(perrin.translation_rotation_correlation(motion))
            rho = np.array([f.value for f in found])
            stated = np.mean([f.stderr for f in found])
            plain = np.abs(rho) * np.sqrt(steps - 1) > 1.96
            print(
                f"| {name} | {snr:g} | {steps} | {runs} | {mean_text(rho)} | "
                f"{rho.std(ddof=1):.3f} | {stated:.3f} | "
                f"{share_text([f.p < 0.05 for f in found])} | {share_text(plain)} |",
                flush=True,
            )


def over_clusters(rng, *, quick):
    """Correlation of ln D_T and ln D_R over clusters with a common spread."""
    from perrin.diffusion import DiffusionEstimate, Found

    def estimates(values, error, quantity):
        return [
            DiffusionEstimate.judged(
                Found.normal(v, error * v, 0.0, 0.0), quantity=quantity, method="mle",
                n_frames=300, dt=1.0, noise_variance=0.0,
            )
            for v in values
        ]  # fmt: skip

    runs = 200 if quick else 2000
    print(f"\nD_T against D_R over 40 clusters, {runs} runs")
    print("| true | spread | error | measured | predicted | corrected | 95 % covers, % | none, % |")
    print("|---|---|---|---|---|---|---|---|")
    cells = ((1, 0.3, 0.087), (1, 0.3, 0.15), (1, 0.1, 0.087), (0.5, 0.3, 0.15), (0, 0.0, 0.087))
    for truth, spread, error in cells:
        found = []
        for _ in range(runs):
            own = rng.normal(size=(2, 40))
            own[1] = truth * own[0] + np.sqrt(1 - truth**2) * own[1]
            D_T, D_R = np.exp(spread * own + error * rng.normal(size=(2, 40)))
            found.append(
                perrin.diffusion_correlation(
                    estimates(D_T, error, "translation"), estimates(D_R, error, "rotation")
                )
            )
        known = [f for f in found if f.value is not None]
        corrected = covers = "-"
        if len(known) > 9:
            corrected = mean_text([f.value for f in known])
            covers = share_text([f.ci95[0] <= truth <= f.ci95[1] for f in known])
        predicted = truth * spread**2 / (spread**2 + error**2)
        print(
            f"| {truth} | {spread} | {error} | {mean_text([f.measured for f in found])} | "
            f"{predicted:.3f} | {corrected} | {covers} | "
            f"{share_text([f.value is None for f in found])} |",
            flush=True,
        )


def moduli(rng, *, quick):
    """Moduli of power-law fluids, the noise fitted or known."""
    runs = 30 if quick else 200
    sphere = perrin.Cluster(np.zeros((1, 3)), diameter=2.0)
    print(f"\nModuli from the MSD of a sphere, {runs} runs: median |G*|/true (sd), alpha (sd)")
    print(
        "| frames | alpha | SNR | lag | raw |G*|, alpha | noise | |G*| | alpha "
        "| 68 % covers |G*|, alpha, G', G'', % |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    cells = [(300, 0.5, 5.0), (300, 0.5, 0.5), (300, 1.0, 5.0), (1000, 0.5, 5.0)]
    for frames, alpha, snr in cells if quick else [*cells, (5000, 0.5, 5.0)]:
        curves = []
        for _ in range(runs):
            walk = fractional_walk(frames, rng, alpha=alpha)
            walk += np.sqrt(0.5 / snr) * rng.normal(size=walk.shape)
            curves.append(replace(perrin.msd(walk[:, None], dt=1.0), noise=0.5 / snr))
        for noise in ("joint", "residual"):
            found = [
                perrin.viscoelastic_moduli(c, cluster=sphere, temperature=300, noise=noise)
                for c in curves
            ]
            for wanted in (1, 7, 15, 68):
                if wanted > frames / 10:
                    continue
                at = int(np.argmin(np.abs(np.log(found[0].frequency * wanted))))
                lag = round(1 / found[0].frequency[at])
                true = KT / (np.pi * 3 * lag**alpha * gamma(1 + alpha))
                size = np.array([f.modulus[at] for f in found]) / true
                slope = np.array([f.exponent[at] for f in found])
                truths = {
                    "modulus": true,
                    "exponent": alpha,
                    "storage": true * np.cos(np.pi * alpha / 2),
                    "loss": true * np.sin(np.pi * alpha / 2),
                }
                inside = []
                for name, truth in truths.items():
                    low, high = np.array([getattr(f, f"{name}_ci68")[at] for f in found]).T
                    # The edge of G' = 0 is where rounding decides.
                    inside.append(np.mean((low <= truth + 1e-12) & (truth - 1e-12 <= high)))
                value = np.array([c.value[[lag - 1, 2 * lag - 1]] for c in curves])
                rise = np.log2(value[:, 1] / value[:, 0])
                ratio = 3 * lag**alpha * gamma(1 + alpha) / value[:, 0]
                raw = [r / gamma(1 + a) for r, a in zip(ratio, rise, strict=True)]
                print(
                    f"| {frames} | {alpha} | {snr:g} | {lag} | {np.median(raw):.2f}, "
                    f"{np.median(rise):.2f} | {noise} | {np.median(size):.2f} ({size.std():.2f}) | "
                    f"{np.median(slope):.2f} ({slope.std():.2f}) | "
                    f"{', '.join(f'{100 * x:.0f}' for x in inside)} |",
                    flush=True,
                )


TABLES = {"long": long_times, "time": in_time, "clusters": over_clusters, "moduli": moduli}


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="few repeats, under a minute")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tables", nargs="*", choices=list(TABLES), default=list(TABLES))
    given = parser.parse_args()
    for number, name in enumerate(TABLES):
        if name in given.tables:
            TABLES[name](np.random.default_rng([given.seed, number]), quick=given.quick)


if __name__ == "__main__":
    main()
