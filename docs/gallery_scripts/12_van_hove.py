"""
Distribution of rotations
=========================

The distribution of rotation vectors at one lag time against the law of Brownian rotation, for a
body that diffuses and for one that switches between two values of D_R.
"""

import matplotlib.pyplot as plt

import perrin
from perrin.plot import plot_van_hove

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
motions = {
    "diffusion": None,
    "D switches by a factor of 12": perrin.Switching(ratio=12.0, dwell=40.0),
}
figure, axes = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
for ax, (name, dynamics) in zip(axes, motions.items(), strict=True):
    motion = perrin.simulate_motion(body, D_R=2e-3, dt=1.0, n_frames=6000, dynamics=dynamics, rng=3)
    result = perrin.van_hove(motion, lag=2.0, noise=None)
    plot_van_hove(result, ax=ax)
    ax.set_title(f"{name}: $α_2$ = {result.alpha2:.2f} ± {result.alpha2_stderr:.2f}")
    ax.legend(frameon=False, fontsize="small")
plt.show()
