"""
A tumbling cluster and its MSAD
===============================

A tetrahedron of touching spheres under the conditions of Hunter et al. (2011): six views of its
motion, and the mean square angular displacement with the fitted line and the noise floor.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin
from perrin.plot import plot_cluster, plot_lag_curve

plt.style.use("perrin.plot.perrin")
body = perrin.Cluster.touching(4, diameter=2.45)
truth = perrin.simulate_motion(body, D_R=4.93e-3, D_T=3.85e-2, dt=0.73, n_frames=300, rng=1)
motion = perrin.track_rotation(
    perrin.add_noise(truth.positions(), sigma=(0.03, 0.03, 0.04), rng=2), dt=0.73
)

figure = plt.figure(figsize=(10, 4.6), layout="constrained")
left, right = figure.subfigures(1, 2, width_ratios=(1, 1.1))
for ax, frame in zip(left.subplots(2, 3).ravel(), range(0, 300, 50), strict=False):
    turned = perrin.Cluster(body.positions @ motion.rotation[frame].T)
    plot_cluster(turned, ax=ax, diameter=2.45, view=np.eye(3))
    ax.set(xlim=(-2.8, 2.8), ylim=(-2.8, 2.8))
    ax.axis("off")
    ax.set_title(f"{motion.time[frame]:.0f} s", fontsize=10, y=0.93)

plot_lag_curve(
    perrin.msad(motion),
    ax=right.subplots(),
    estimate=perrin.estimate_diffusion(motion),
    floor=perrin.noise_floor(body, sigma=(0.03, 0.03, 0.04)).phi2,
)
plt.show()
