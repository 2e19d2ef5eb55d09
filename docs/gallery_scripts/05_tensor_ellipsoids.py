"""
Tensors of anisotropic clusters
===============================

The rotational diffusion tensor of a body in its own axes, drawn as an ellipsoid whose half axes
are the square roots of its principal values, for touching spheres in water: a chain of three, a
trimer, a tetrahedron and a bipyramid.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

plt.style.use("perrin.plot.perrin")

chain = np.array([[-1.0, 0, 0], [0, 0, 0], [1.0, 0, 0]])
bodies = {
    "chain": chain,
    "trimer": perrin.Cluster.touching(3, diameter=1.0).positions,
    "tetrahedron": perrin.Cluster.touching(4, diameter=1.0).positions,
    "bipyramid": perrin.Cluster.touching(5, diameter=1.0).positions,
}
polar, azimuth = np.mgrid[0 : np.pi : 24j, 0 : 2 * np.pi : 40j]
sphere = np.stack(
    [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
)

figure = plt.figure(figsize=(11, 3.6), layout="constrained")
for place, (name, centers) in enumerate(bodies.items(), start=1):
    body = perrin.cluster_mobility(centers, radius=0.5, viscosity=1e-3, temperature=295.0)
    value, axes = np.linalg.eigh(body.D_R)
    surface = sphere * np.sqrt(value) @ axes.T
    ax = figure.add_subplot(1, 4, place, projection="3d")
    ax.plot_surface(*np.moveaxis(surface, -1, 0), color="#4f94cd", alpha=0.85, lw=0)
    ax.scatter(*(centers - centers.mean(axis=0)).T, s=60, color="k", depthshade=False)
    ax.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1), xticks=[], yticks=[], zticks=[])
    ax.set_box_aspect((1, 1, 1))
    ax.set_title(f"{name}\n{', '.join(f'{v:.2f}' for v in value)} rad²/s", fontsize=10)
plt.show()
