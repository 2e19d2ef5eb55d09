"""
Translation against rotation
============================

D_T against D_R of clusters in a dense suspension, and the line of a dilute fluid, on which
viscosity and temperature cancel. Points above the line: rotation is slowed more than translation.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
fluid = perrin.cluster_mobility(body, radius=2.45 / 2, viscosity=1e-3, temperature=295.0)
dilute = np.trace(fluid.D_T) / np.trace(fluid.D_R)

rng = np.random.default_rng(3)
found = []
for slowing in np.geomspace(1, 30, 14):
    D_R = np.trace(fluid.D_R) / 3 / slowing**1.25 * np.exp(0.1 * rng.normal())
    D_T = np.trace(fluid.D_T) / 3 / slowing
    dt = 0.012 / (4 * D_R)
    truth = perrin.simulate_motion(body, D_R=D_R, D_T=D_T, dt=dt, n_frames=300, rng=rng)
    motion = perrin.track_rotation(perrin.add_noise(truth.positions(), sigma=0.02, rng=rng), dt=dt)
    found.append(
        [perrin.estimate_diffusion(motion, quantity=q) for q in ("rotation", "translation")]
    )

figure, ax = plt.subplots(figsize=(6.5, 5), layout="constrained")
ax.errorbar(
    [R.value for R, _ in found], [T.value for _, T in found],
    [T.stderr for _, T in found], [R.stderr for R, _ in found], fmt="o", label="clusters",
)  # fmt: skip
line = np.array(ax.get_xlim())
ax.plot(line, dilute * line, "k--", label="dilute fluid")
ax.set(xscale="log", yscale="log", xlabel="$D_R$ (rad²/s)", ylabel="$D_T$ (µm²/s)")
ax.legend(frameon=False)
plt.show()
