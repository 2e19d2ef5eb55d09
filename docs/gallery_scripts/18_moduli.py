"""
Viscoelastic moduli from rotation
=================================

Storage and loss modulus of a fluid from the mean square rotation of a cluster in it: here a
fractional motion with exponent 0.6, for which both are power laws of the frequency with this
exponent.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

plt.style.use("perrin.plot.perrin")

body = perrin.Cluster.touching(4, diameter=2.45)
motion = perrin.simulate_motion(
    body, D_R=2e-3, dt=0.5, n_frames=4000, dynamics=perrin.Fractional(0.6), rng=8
)
moduli = perrin.viscoelastic_moduli(motion, cluster=body, temperature=295.0)
good = moduli.reliable

figure, ax = plt.subplots(figsize=(7, 4.6), layout="constrained")
for value, interval, label in (
    (moduli.storage, moduli.storage_ci68, "storage modulus G'"),
    (moduli.loss, moduli.loss_ci68, "loss modulus G''"),
):
    low, high = np.moveaxis(np.asarray(interval), -1, 0)
    (line,) = ax.loglog(moduli.frequency[good], value[good], ".-", label=label)
    ax.fill_between(
        moduli.frequency[good], low[good], high[good], alpha=0.25, color=line.get_color()
    )
ax.set(xlabel="angular frequency (rad/s)", ylabel="modulus (Pa)")
ax.legend(frameon=False)
plt.show()
