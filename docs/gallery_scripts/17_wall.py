"""
Diffusion near a wall
=====================

A wall slows translation, most along its normal, and hardly rotation. The factors are those of a
sphere with the hydrodynamic radius of the cluster.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

plt.style.use("perrin.plot.perrin")

body = perrin.cluster_mobility(
    perrin.Cluster.touching(4, diameter=2.45), radius=1.225, viscosity=1e-3, temperature=295.0
)
radius = body.diameter_T / 2
height = np.linspace(2.6, 12, 60) * radius
factors = [perrin.wall_factor(body, height=h) for h in height]

figure, ax = plt.subplots(figsize=(7, 4.4), layout="constrained")
for name, label in (
    ("R_perpendicular", "rotation about the normal"),
    ("R_parallel", "rotation about axes in the plane"),
    ("T_parallel", "translation along the wall"),
    ("T_perpendicular", "translation along the normal"),
):
    ax.plot(height, [getattr(factor, name) for factor in factors], label=label)
ax.set(xlabel="height of the centre (µm)", ylabel="D over D without the wall", ylim=(0.5, 1.02))
ax.legend(frameon=False, loc="lower right")
plt.show()
