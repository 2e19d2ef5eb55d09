"""Errors of D_R in movies taken as `plan_sampling` recommends, compared with the planned error.

Usage: python benchmarks/planning.py [TRACKS] [FIRST_SEED]
"""

import sys

import numpy as np

import perrin

D_R, SIGMA = 4.93e-3, (0.03, 0.03, 0.04)
FOUR, SEVEN = (perrin.Cluster.touching(n, 2.45) for n in (4, 7))
PLANS = {
    "tetrahedron, 100 frames": (FOUR, {"n_frames": 100}),
    "tetrahedron, 100 frames in 20 s": (FOUR, {"n_frames": 100, "total_time": 20.0}),
    "tetrahedron, 40 s": (FOUR, {"total_time": 40.0}),
    "tetrahedron, light of 60 frames in 40 s": (
        FOUR,
        {"n_frames": 60, "total_time": 40.0, "photons": True},
    ),
    "seven spheres, 100 frames": (SEVEN, {"n_frames": 100}),
}


def scatter(body, budget, tracks, seed):
    """Return the plan, and the standard deviation of D_R over D_R of movies taken by it."""
    plan = perrin.plan_sampling(body, D_R=D_R, sigma=SIGMA, **budget)
    dimmed = 1.0
    if budget.get("photons"):
        dimmed = np.sqrt(budget["total_time"] / (budget["n_frames"] - 1) / plan.dt_best)
    values = []
    for k in range(tracks):
        rng = np.random.default_rng(seed + k)
        truth = perrin.simulate_motion(
            body, D_R=D_R, dt=plan.dt_best, n_frames=plan.n_frames, rng=rng
        )
        x = perrin.add_noise(truth.positions(), sigma=np.multiply(SIGMA, dimmed), rng=rng)
        motion = perrin.track_rotation(x, dt=plan.dt_best)
        values.append(perrin.estimate_diffusion(motion).value / D_R)
    return plan, np.std(values, ddof=1), np.mean(values)


def main(tracks=400, first_seed=0):
    print(f"{tracks} tracks a row")
    print(
        "| budget | frames | dt (s) | SNR | expected error | scatter / expected | mean / planted |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, (body, budget) in PLANS.items():
        plan, sd, mean = scatter(body, budget, tracks, first_seed)
        ratio, error = sd / plan.expected_error, sd / np.sqrt(tracks)
        print(
            f"| {name} | {plan.n_frames} | {plan.dt_best:.3f} | {plan.snr:.2g} | "
            f"{100 * plan.expected_error:.2f} % | {ratio:.3f}({ratio / np.sqrt(2 * tracks):.3f}) | "
            f"{mean:.3f}({error:.3f}) |"
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
