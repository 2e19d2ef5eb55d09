"""
Size and viscosity from two coefficients
========================================

D_T is proportional to 1/(viscosity × d) and D_R to 1/(viscosity × d³): together they give the
sphere diameter and the viscosity. Here the values of Table 1 of Hunter et al. (2011).
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

plt.style.use("perrin.plot.perrin")

temperature = 295.0
tetrahedron = perrin.Cluster.touching(4, diameter=2.45)
body = perrin.cluster_mobility(  # solved once; only its shape matters
    tetrahedron, radius=1.225, viscosity=1e-3, temperature=temperature
)
D_T, D_R = (3.85e-2, 0.49e-2), (4.93e-3, 0.49e-3)
both = perrin.size_and_viscosity(D_T, D_R, cluster=body, temperature=temperature)

viscosity = np.linspace(1.2e-3, 4e-3, 60)
figure, ax = plt.subplots(figsize=(7, 4.8), layout="constrained")
for size_from, D, label in (
    (perrin.size_from_translation, D_T, "from $D_T$"),
    (perrin.size_from_rotation, D_R, "from $D_R$"),
):
    sizes = [
        size_from(D, cluster=body, viscosity=eta, temperature=temperature) for eta in viscosity
    ]
    center = np.array([size.sphere for size in sizes])
    error = np.array([size.sphere_stderr for size in sizes])
    ax.plot(1e3 * viscosity, center, label=label)
    ax.fill_between(1e3 * viscosity, center - error, center + error, alpha=0.25)
ax.errorbar(
    1e3 * both.viscosity, both.sphere, both.sphere_stderr, 1e3 * both.viscosity_stderr,
    fmt="ko", capsize=3, label="from both",
)  # fmt: skip
ax.axhline(2.45, color="0.4", ls=":", label="2.45 µm, of the manufacturer")
ax.set(xlabel="viscosity (mPa s)", ylabel="sphere diameter (µm)", ylim=(1.5, 5))
ax.legend(frameon=False)
plt.show()
