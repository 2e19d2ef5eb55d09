"""
Rattling in a cage, and hops
============================

In a dense suspension a cluster rattles in a cage and leaves it by hops. The mean square angular
displacement is flat until the hops add up; ``long_time_diffusion`` finds their coefficient.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
dynamics = perrin.Hopping(angle=0.3, interval=60.0, relaxation_time=3.0)
motion = perrin.simulate_motion(body, D_R=8e-4, dt=1.0, n_frames=6000, dynamics=dynamics, rng=2)
curve = perrin.msad_vector(motion)
long = perrin.long_time_diffusion(motion)

figure, ax = plt.subplots(figsize=(7, 4.6), layout="constrained")
shown = curve.lagtime < 1500
ax.loglog(curve.lagtime[shown], curve.value[shown], ".", ms=3, label="MSAD")
lag = np.geomspace(*long.lag_range)
ax.loglog(lag, 6 * (long.value * lag + long.offset), "k", lw=2, label="long-time line")
ax.set(xlabel="lag time (s)", ylabel="mean square of rotation vectors (rad²)", title=str(long))
ax.title.set_fontsize(10)
ax.legend(frameon=False)
plt.show()
