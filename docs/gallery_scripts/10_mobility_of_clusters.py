"""
Mobility of clusters
====================

Hydrodynamic diameters of clusters of 1 to 7 touching spheres over the diameter of one sphere,
from ``cluster_mobility``. A cluster rotates like a smaller sphere than it translates, or a larger
one, depending on its shape: one factor cannot serve both.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

plt.style.use("perrin.plot.perrin")

clusters = {"1": np.zeros((1, 3)), "2": np.array([[-0.5, 0, 0], [0.5, 0, 0]])}
clusters |= {str(n): perrin.Cluster.touching(n, diameter=1.0).positions for n in range(3, 8)}
translation, rotation = [], []
for centers in clusters.values():
    body = perrin.cluster_mobility(centers, radius=0.5, viscosity=1e-3, temperature=295.0)
    translation.append(body.diameter_factor_T)
    rotation.append(body.diameter_factor_R)

figure, ax = plt.subplots(figsize=(7, 4.4), layout="constrained")
ax.plot(list(clusters), translation, "o-", label="from $D_T$")
ax.plot(list(clusters), rotation, "s--", label="from $D_R$")
ax.axhline(1.844, color="0.5", lw=1, ls=":", label="1.844, used in 2011 for tetrahedra")
ax.set(xlabel="number of spheres", ylabel="hydrodynamic over sphere diameter")
ax.legend(frameon=False)
plt.show()
