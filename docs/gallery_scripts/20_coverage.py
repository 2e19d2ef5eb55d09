"""
Do the error bars hold?
=======================

D_R of 60 simulated tracks, each with its interval of 68 %. About a third of the intervals miss
the planted value, as they should. :doc:`/validation` has the same over thousands of tracks.
"""

import matplotlib.pyplot as plt

import perrin

plt.style.use("perrin.plot.perrin")

body, D_R = perrin.Cluster.touching(4, diameter=2.45), 4.93e-3
found = []
for k in range(60):
    truth = perrin.simulate_motion(body, D_R=D_R, dt=0.73, n_frames=100, rng=k)
    positions = perrin.add_noise(truth.positions(), sigma=0.03, rng=1000 + k)
    found.append(perrin.estimate_diffusion(perrin.track_rotation(positions, dt=0.73)))
hit = [low <= D_R <= high for low, high in (estimate.ci68 for estimate in found)]

figure, ax = plt.subplots(figsize=(10, 4.2), layout="constrained")
for k, (estimate, inside) in enumerate(zip(found, hit, strict=True)):
    color = "#1f5f95" if inside else "#c4500c"
    ax.plot([k, k], estimate.ci68, color=color, lw=2)
    ax.plot(k, estimate.value, "o", color=color, ms=4)
ax.axhline(D_R, color="k", ls="--", lw=1)
ax.set(xlabel="track", ylabel="$D_R$ (rad²/s)")
ax.set_title(f"planted value inside {sum(hit)} of 60 intervals of 68 %")
plt.show()
