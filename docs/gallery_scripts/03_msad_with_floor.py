"""
MSAD with its noise floor
=========================

Localisation errors add a constant to the mean square angular displacement, the noise floor. A
measurement resolves rotation where the line 4 D_R t is above it.
"""

import matplotlib.pyplot as plt

import perrin
from perrin.plot import plot_lag_curve

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
truth = perrin.simulate_motion(body, D_R=4e-4, dt=1.0, n_frames=1000, rng=3)

figure, axes = plt.subplots(1, 2, figsize=(10, 4.4), sharey=True, layout="constrained")
for ax, sigma in zip(axes, (0.01, 0.06), strict=True):
    motion = perrin.track_rotation(perrin.add_noise(truth.positions(), sigma=sigma, rng=5), dt=1.0)
    plot_lag_curve(
        perrin.msad(motion),
        ax=ax,
        estimate=perrin.estimate_diffusion(motion),
        floor=perrin.noise_floor(body, sigma=sigma).phi2,
    )
    ax.text(
        0.96, 0.05, f"localisation error {1e3 * sigma:.0f} nm", transform=ax.transAxes, ha="right"
    )
plt.show()
