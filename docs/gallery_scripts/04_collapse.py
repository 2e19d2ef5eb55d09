"""
The noise floor subtracted (Fig. 4)
===================================

Five noise levels give five curves; less their predicted floors they fall on the line of pure
diffusion, as in Fig. 4 of Hunter et al. (2011). Lags at which less than the scatter remains have
no logarithm and are left out.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.tetrahedron(1.5)  # um, from the centre to each sphere
truth = perrin.simulate_motion(body, D_R=1e-4, dt=1.0, n_frames=5000, rng=7)
shown = np.unique(np.geomspace(1, 2000, 30).astype(int)) - 1

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.6), sharey=True, layout="constrained")
for sigma in (0.01, 0.02, 0.04, 0.06, 0.1):
    motion = perrin.track_rotation(perrin.add_noise(truth.positions(), sigma=sigma, rng=8), dt=1.0)
    curve = perrin.msad(motion)
    floor = perrin.noise_floor(body, sigma=sigma).phi2
    label = f"{1e3 * sigma:.0f} nm"
    left.loglog(curve.lagtime[shown], curve.value[shown], ".-", label=label)
    less = curve.value[shown] - floor
    right.loglog(curve.lagtime[shown], np.where(less > 0, less, np.nan), ".-", label=label)
for ax, title in ((left, "measured"), (right, "less the floor $Φ^2$")):
    ax.loglog(curve.lagtime[shown], 4e-4 * curve.lagtime[shown], "k--", label="$4 D_R t$")
    ax.set(xlabel="lag time (s)", title=title)
left.set_ylabel("MSAD (rad²)")
left.legend(frameon=False)
plt.show()
