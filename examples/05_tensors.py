"""
5. Anisotropic clusters and tensors
===================================

A body with unequal axes has three rotational diffusion coefficients. D_R of a report is their
mean. This page measures the tensor and compares it with the prediction.
"""

import matplotlib.pyplot as plt
import numpy as np

import perrin

# %%
# A body with three unequal axes
# ------------------------------
#
# Four touching spheres in an L. The prediction has the three principal values of D_R in ascending
# order.

spheres = 2.0 * np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0]])
fluid = perrin.cluster_mobility(spheres, radius=1.0, viscosity=1e-3, temperature=295.0)
print("predicted:", np.round(np.linalg.eigvalsh(fluid.D_R), 4), "rad^2/s")

truth = perrin.simulate_motion(fluid, dt=0.5, n_frames=3000, rng=1)
motion = perrin.track_rotation(
    perrin.add_noise(truth.positions(), sigma=(0.02, 0.02, 0.03), rng=2), dt=0.5
)

# %%
# The tensor
# ----------
#
# ``diffusion_tensor`` maximises the likelihood of the steps in the axes of the body.
# ``p_isotropic`` is the p-value of three equal axes, ``p_axial`` that of two equal ones.

tensor = perrin.diffusion_tensor(motion)
for value, error in zip(tensor.principal_values, tensor.stderr, strict=True):
    print(f"D = {value:.4f} +- {error:.4f} rad^2/s")
print(f"p of an isotropic body: {tensor.p_isotropic:.1e}, of an axial body: {tensor.p_axial:.1e}")
print(f"mean: {tensor.mean:.4f}, and D_R: {perrin.estimate_diffusion(motion)}")

# %%
# The body is slow about two axes and fast about the third, the long one.
#
# The principal axes are columns, in the axes of the template. The fast axis is along the chain,
# apart from the sphere at its end:

long_axis = np.linalg.svd(motion.template)[2][0]
print(f"angle between the fast axis and the chain: "
      f"{np.degrees(np.arccos(abs(tensor.axes[:, 2] @ long_axis))):.0f} degrees")  # fmt: skip

# %%
# One curve for each axis
# -----------------------
#
# ``msad_axes`` has the mean square of the rotation about each principal axis. The dashed lines
# are 2 D t.

figure, ax = plt.subplots(figsize=(7, 4.6), layout="constrained")
curves = perrin.msad_axes(motion, axes=tensor.axes)
for curve, D, name in zip(curves, tensor.principal_values, ("1", "2", "3"), strict=True):
    shown = curve.lagtime < 60
    (line,) = ax.loglog(curve.lagtime[shown], curve.value[shown], ".", ms=4, label=f"axis {name}")
    ax.loglog(curve.lagtime[shown], 2 * D * curve.lagtime[shown], "--", color=line.get_color())
ax.set(xlabel="lag time (s)", ylabel="mean square angle (rad²)")
ax.legend(frameon=False)
# sphinx_gallery_alt = "Mean square angle about three body axes against lag time, with fitted lines"
plt.show()

# %%
# Bodies with symmetry
# --------------------
#
# The axes of a symmetric body are equal, and the estimate uses it: ``tensor.symmetry`` is the
# point group that was found in the shape. A tetrahedron has one value, a trimer two.

trimer = perrin.Cluster.touching(3, diameter=2.0)
fluid_3 = perrin.cluster_mobility(trimer, radius=1.0, viscosity=1e-3, temperature=295.0)
turning = perrin.simulate_motion(fluid_3, dt=0.5, n_frames=600, rng=3)
symmetric = perrin.diffusion_tensor(
    perrin.track_rotation(perrin.add_noise(turning.positions(), sigma=0.02, rng=4), dt=0.5)
)
print(symmetric.symmetry, np.round(symmetric.principal_values, 4))
print("predicted:", np.round(np.linalg.eigvalsh(fluid_3.D_R), 4))

# %%
# Translation, and coupling
# -------------------------
#
# ``quantity="translation"`` measures the translational tensor in body axes. ``coupled_tensor``
# measures all 36 numbers, with the coupling of rotation and translation.

print(np.round(perrin.diffusion_tensor(motion, quantity="translation").principal_values, 3))
coupled = perrin.coupled_tensor(motion)
print("trace of D_T about the centre of diffusion / 3:", round(float(np.trace(coupled.D_T)) / 3, 3))

# %%
# Next: :doc:`/theory/tensors`.
