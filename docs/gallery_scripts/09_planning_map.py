"""
A map of the expected error
===========================

The smallest possible standard error of D_R (the Cramér-Rao bound) for 300 frames of a
tetrahedron, against the time between frames and the localisation error.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

plt.style.use("perrin.plot.perrin")

body, D_R = perrin.Cluster.touching(4, diameter=2.45), 4.93e-3
dt = np.geomspace(0.003, 3, 40)
sigma = np.geomspace(0.005, 0.2, 36)
error = np.empty((sigma.size, dt.size))
for row, s in enumerate(sigma):
    angle_variance = perrin.noise_floor(body, sigma=s).phi2 / 4
    for column, t in enumerate(dt):
        error[row, column] = perrin.cramer_rao(n_frames=300, snr=D_R * t / angle_variance)

figure, ax = plt.subplots(figsize=(7.5, 5), layout="constrained")
levels = (8.3, 8.6, 9, 10, 12, 15, 20, 30, 50, 100)
shades = ax.contourf(dt, 1e3 * sigma, 100 * error, levels, cmap="viridis_r", extend="both")
lines = ax.contour(dt, 1e3 * sigma, 100 * error, levels, colors="w", linewidths=0.6)
ax.clabel(lines, fmt=lambda level: f"{level:g} %", fontsize=8)
ax.plot(0.73, 30, "o", color="#c4500c", ms=9, label="Hunter et al. 2011")
ax.set(xscale="log", yscale="log", xlabel="time between frames (s)")
ax.set(ylabel="localisation error (nm)", title="standard error of $D_R$, 300 frames")
ax.legend(loc="lower right")
figure.colorbar(shades, label="%")
plt.show()
