"""Recovery of planted values, and coverage of their intervals, for tetrahedra as in the demo.

Usage: python benchmarks/recovery.py [TRACKS] [FIRST_SEED]
"""

import sys

import numpy as np

import perrin

PLANTED = {"rotation": 4.93e-3, "translation": 3.85e-2}


def measure(seed):
    """Simulate one track and estimate it by the default and by the paper's procedure."""
    rng = np.random.default_rng(seed)
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(4, 2.45),
        D_R=PLANTED["rotation"],
        D_T=PLANTED["translation"],
        dt=0.73,
        n_frames=300,
        rng=rng,
    )
    x = perrin.add_noise(truth.positions(), sigma=(0.03, 0.03, 0.04), rng=rng)
    motion = perrin.track_rotation(x, dt=0.73)
    curves = {"rotation": perrin.msad(motion), "translation": perrin.msd(motion)}
    return {
        (quantity, method): estimate
        for quantity, curve in curves.items()
        for method, estimate in (
            ("likelihood", perrin.estimate_diffusion(motion, quantity=quantity)),
            ("line 3-22 s", perrin.fit_line(curve, lag_range=(3, 22))),
        )
    }


def main(tracks=400, first_seed=0):
    runs = [measure(first_seed + k) for k in range(tracks)]
    print(f"{tracks} tracks of 300 frames")
    print("quantity, method: mean/planted, sd/planted, mean stderr/planted, cover 68 %, cover 95 %")
    for key in runs[0]:
        estimates = [run[key] for run in runs]
        planted = PLANTED[key[0]]
        value = np.array([e.value for e in estimates]) / planted
        stderr = np.array([e.stderr for e in estimates]) / planted
        cover = [
            np.mean([getattr(e, ci)[0] <= planted <= getattr(e, ci)[1] for e in estimates])
            for ci in ("ci68", "ci95")
        ]
        error = [np.sqrt(c * (1 - c) / tracks) for c in cover]
        print(
            f"{key[0]:12s} {key[1]:12s} {value.mean():.4f}({value.std() / np.sqrt(tracks):.4f}) "
            f"{value.std():.4f}({value.std() / np.sqrt(2 * tracks):.4f}) {stderr.mean():.4f} "
            f"{cover[0]:.3f}({error[0]:.3f}) {cover[1]:.3f}({error[1]:.3f})"
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
