"""
The best time between frames
============================

Frames that are too close in time show noise, frames that are too far apart are few.
``plan_sampling`` computes the expected error of D_R against the time between frames, for a fixed
duration of the movie.
"""

import matplotlib.pyplot as plt

import perrin
from perrin.plot import plot_plan

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
figure, axes = plt.subplots(1, 2, figsize=(10, 4.4), sharey=True, layout="constrained")
for ax, sigma in zip(axes, (0.03, 0.1), strict=True):
    plan = perrin.plan_sampling(body, D_R=4.93e-3, sigma=sigma, total_time=220.0, n_frames=2000)
    plot_plan(plan, ax=ax)
    ax.text(0.05, 0.05, f"localisation error {1e3 * sigma:.0f} nm", transform=ax.transAxes)
plt.show()
