"""
4. Sizes and viscosity
======================

What a measured D_R and D_T say about the size of the particles and the viscosity of the fluid.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

# %%
# A measurement
# -------------
#
# A tetrahedron of spheres of 2.45 um in a fluid of 2.18 mPa s at 295 K. Its coefficients are
# those that hydrodynamics predicts.

temperature, viscosity = 295.0, 2.18e-3
body = perrin.Cluster.touching(4, diameter=2.45)
fluid = perrin.cluster_mobility(body, radius=2.45 / 2, viscosity=viscosity, temperature=temperature)
truth = perrin.simulate_motion(fluid, dt=0.73, n_frames=600, rng=1)
positions = perrin.add_noise(truth.positions(), sigma=(0.03, 0.03, 0.04), rng=2)

motion = perrin.track_rotation(positions, dt=0.73)
D_R = perrin.estimate_diffusion(motion)
D_T = perrin.estimate_diffusion(motion, quantity="translation")
print(D_R)
print(D_T)

# %%
# Sizes, if the viscosity is known
# --------------------------------
#
# D_T is proportional to 1/d and D_R to 1/d³. An error of 9 % in D_R is therefore an error of 3 %
# in the size. ``cluster`` is the shape: the body is scaled as a whole until its coefficient is
# the measured one.

known = {"cluster": motion.template, "viscosity": viscosity, "temperature": temperature}
from_translation = perrin.size_from_translation(D_T, **known)
from_rotation = perrin.size_from_rotation(D_R, **known)
for name, size in (("D_T", from_translation), ("D_R", from_rotation)):
    print(f"sphere diameter from {name}: {size.sphere:.2f} +- {size.sphere_stderr:.2f} um")

# %%
# ``Size.cluster`` is the hydrodynamic diameter of the whole cluster, that of a sphere with the
# same coefficient.
#
# If the viscosity is not known
# -----------------------------
#
# The two coefficients depend on the size in different ways, so together they give the size *and*
# the viscosity.

both = perrin.size_and_viscosity(D_T, D_R, cluster=motion.template, temperature=temperature)
print(f"sphere diameter: {both.sphere:.2f} +- {both.sphere_stderr:.2f} um")
print(f"viscosity: {1e3 * both.viscosity:.2f} +- {1e3 * both.viscosity_stderr:.2f} mPa s")

# %%
# An error of the viscosity or of the temperature is stated as a pair (value, standard error); it
# is included in the error of the size.

water = perrin.water_viscosity(temperature)
uncertain = perrin.size_from_rotation(
    D_R, cluster=motion.template, viscosity=(viscosity, 0.1e-3), temperature=(temperature, 1.0)
)
print(f"with these errors: {uncertain.sphere:.2f} +- {uncertain.sphere_stderr:.2f} um")
print(f"water at {temperature:.0f} K: {1e3 * water:.3f} mPa s")

# %%
# Agreement of the two sizes
# --------------------------
#
# If the sizes differ, the spheres are not what was assumed, the body is near a wall
# (:doc:`/howto/walls`), or the motion is not diffusion. A viscosity that is wrong moves the two
# sizes by different amounts.

assumed = np.linspace(1.4e-3, 3.4e-3, 41)
shape = perrin.cluster_mobility(
    motion.template, radius=2.45 / 2, viscosity=viscosity, temperature=temperature
)
figure, ax = plt.subplots(figsize=(7, 4.4), layout="constrained")
for size_from, D, label in (
    (perrin.size_from_translation, D_T, "from $D_T$"),
    (perrin.size_from_rotation, D_R, "from $D_R$"),
):
    sizes = [size_from(D, cluster=shape, viscosity=eta, temperature=temperature) for eta in assumed]
    value, error = np.array([(s.sphere, s.sphere_stderr) for s in sizes]).T
    ax.plot(1e3 * assumed, value, label=label)
    ax.fill_between(1e3 * assumed, value - error, value + error, alpha=0.25)
ax.axvline(1e3 * viscosity, color="0.5", ls=":", label="true viscosity")
ax.axhline(2.45, color="0.5", ls="--", label="true diameter")
ax.set(xlabel="assumed viscosity (mPa s)", ylabel="sphere diameter (µm)")
ax.legend(frameon=False)
# sphinx_gallery_alt = "Sphere diameter from D_T and from D_R against the assumed viscosity"
plt.show()

# %%
# On the command line ``perrin analyze ... --viscosity 2.18e-3 --temperature 295 --diameter 2.45``
# adds the sizes and the prediction to the report. Next: :doc:`/theory/hydrodynamics`.
