"""
Decay of the orientation
========================

Correlations of a direction, of degree 1 and 2, with fitted exponentials. For diffusion the second
decays three times as fast as the first.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
truth = perrin.simulate_motion(body, D_R=0.02, dt=0.5, n_frames=3000, rng=2)
motion = perrin.track_rotation(perrin.add_noise(truth.positions(), sigma=0.03, rng=3), dt=0.5)
curves = [perrin.orientation_correlation(motion, degree=degree) for degree in (1, 2)]
fit = perrin.fit_relaxation(*curves)

figure, ax = plt.subplots(figsize=(7, 4.6), layout="constrained")
for degree, curve in enumerate(curves, start=1):
    shown = curve.lagtime < 80
    t = curve.lagtime[shown]
    (line,) = ax.plot(t, curve.value[shown], label=f"$C_{degree}$")
    ax.fill_between(t, *(curve.value[shown] + s * curve.stderr[shown] for s in (-1, 1)), alpha=0.25)
    ax.plot(t, np.exp(-degree * (degree + 1) * 0.02 * t), "k--", lw=1)
ax.plot([], [], "k--", lw=1, label="planted: $e^{-l(l+1) D_R t}$")
ax.set(xlabel="lag time (s)", ylabel="orientation correlation", title=f"τ₁ = {fit.tau:.0f} s")
ax.legend(frameon=False)
plt.show()
