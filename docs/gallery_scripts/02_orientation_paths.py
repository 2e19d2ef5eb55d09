"""
Paths of orientations
=====================

Each particle of a cluster has a direction from the centre. The directions wander on the unit
sphere; the cross marks the start (compare Fig. 2 of Hunter et al. 2011).
"""

import matplotlib.pyplot as plt

import perrin
from perrin.plot import plot_orientations

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
figure = plt.figure(figsize=(10, 4.8), layout="constrained")
for place, D_R in ((121, 2e-4), (122, 2e-3)):
    motion = perrin.simulate_motion(body, D_R=D_R, dt=1.0, n_frames=300, rng=4)
    ax = plot_orientations(motion, ax=figure.add_subplot(place, projection="3d"))
    ax.set_title(f"$D_R$ = {D_R:g} rad²/s")
plt.show()
